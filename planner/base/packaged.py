"""What comes with the package: models, and problem files of machines that need no code of their own."""

from __future__ import annotations

from pathlib import Path

# In the wheel mjcf/ lies inside the package, in a checkout beside it.
MODEL_FOLDERS = (Path(__file__).parents[1] / "mjcf", Path(__file__).parents[2] / "mjcf")


def problem_files() -> dict[str, Path]:
    """Problem files by the names of their machines, e.g. "quadrotor"; mjcf/quadrotor/quadrotor.toml."""
    files = (folder / f"{folder.name}.toml" for root in MODEL_FOLDERS for folder in sorted(root.glob("*")))
    return {file.stem: file for file in files if file.is_file()}


def problem_summary(file: Path) -> str:
    """What a problem file says of itself: the comment that it begins with."""
    return file.read_text(encoding="utf-8").split("\n", 1)[0].lstrip("# ")
