"""Make docs/gallery.md and its pictures: `python docs/figures/gallery.py [FOLDER]`, `make gallery` too.

Each entry is planned, proved and drawn as its command does: what the page says of it is what came out.
"""

from __future__ import annotations

import sys
from pathlib import Path

import planner
from planner.base.data_files import problem_files
from planner.cases.problem_file import ProblemFile, load

ROOT = Path(__file__).parents[2]
CASES = ("hopper", "two_link", "acrobot", "puma", "high_dive", "human_step")  # the paper's first
SHOWN = 5  # poses
SIZE = 1000, 220  # pixels
HEAD = """# Gallery

Each picture is the replay in MuJoCo that the verdict judges, at equal times: with gains where it says PASS (feedback).
The verdict is that of `planner run`, before its perturbed simulations. `python docs/figures/gallery.py` makes this page
again: it plans, proves and draws everything on it.
"""


def entries() -> list[tuple[str, str, ProblemFile]]:
    """Title, command, and problem and how to solve it of each."""
    found = []
    for name in CASES:
        case = name.replace("_", "-")
        found.append((case, f"planner run {case}", ProblemFile(getattr(planner.cases, name)(), 1, 0, None, None)))
    found += [(name, f"planner run {name}", load(path)) for name, path in problem_files().items()]
    files = [*sorted((ROOT / "examples" / "tasks").glob("*.toml")), ROOT / "examples" / "crane.toml"]
    files += sorted((ROOT / "examples" / "closed_chains").glob("*.toml"))
    for file in files:
        where = file.relative_to(ROOT).as_posix()
        found.append((file.stem.replace("_", " "), f"planner run {where}", load(file)))
    return found


def entry(title: str, command: str, asked: ProblemFile, pictures: Path) -> str:
    """Text of an entry, whose picture is drawn into a folder."""
    of_cycles = asked.problem.periodic is not None
    plan = asked.solved(lambda _: None) if of_cycles else planner.solve(asked.problem)
    proof = planner.prove(plan, rollouts=0)
    name = command.split("/")[-1].split()[-1].replace(".toml", "").replace("_", "-")
    name += "-chain" if "closed_chains" in command else ""
    planner.render_strip(proof.replay, pictures / f"{name}.png", poses=SHOWN, width=SIZE[0], height=SIZE[1])
    print(title, proof.headline, flush=True)
    text = f"## {title.capitalize()}\n\n![{title}](figures/gallery/{name}.png)\n\n"
    own_step = f" {proof.own_step}" if proof.own_step else ""
    iterations = plan.total_iterations if of_cycles else plan.nit
    return f"{text}`{command}`\n\n{proof.headline}. {plan.N} stages, {iterations} iterations.{own_step}\n"


def main(folder: Path) -> None:
    """Write gallery.md into a folder, and its pictures beside it."""
    pictures, page = folder / "figures" / "gallery", [HEAD]
    pictures.mkdir(parents=True, exist_ok=True)
    for title, command, asked in entries():
        page.append(entry(title, command, asked, pictures))
    (folder / "gallery.md").write_text("\n".join(page), encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "docs")
