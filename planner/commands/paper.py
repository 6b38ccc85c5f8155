"""The command `paper`: the paper's own numbers beside ours. Its failures are results: the exit code is 0."""

from __future__ import annotations

import argparse
from pathlib import Path

from planner.commands.results import json_text
from planner.console import Console
from planner.files import staged_folder
from planner.paper import draw_hopper, hopper_markdown, hopper_results


def paper(arguments: argparse.Namespace, console: Console) -> int:
    """Compute, draw and write the paper's numbers beside ours."""
    folder = Path(arguments.out or "renders/paper")
    names = ("hopper.md", "hopper.json", "hopper.png")
    with staged_folder(folder, names) as staged:
        console.note("solving the paper's hopper for every height, weight and smoothing")
        results = hopper_results()
        text = hopper_markdown(results)
        (staged.path / "hopper.md").write_text(text, encoding="utf-8")
        (staged.path / "hopper.json").write_text(json_text(results), encoding="utf-8")
        draw_hopper(results, staged.path / "hopper.png")
    console.say(text)
    console.say(f"{folder}: {', '.join(names)}")
    console.document({"command": "paper", **results, "folder": str(folder), "files": list(names), "exit_code": 0})
    return 0
