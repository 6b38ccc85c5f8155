"""The command `paper`: the paper's own numbers beside ours. Its failures are results: the exit code is 0."""

from __future__ import annotations

import argparse
from pathlib import Path

from planner.console import Console
from planner.files import staged_folder
from planner.jsonable import json_text
from planner.paper import draw_hopper, hopper_markdown, hopper_results
from planner.paper_proofs import proofs, proofs_markdown


def paper(arguments: argparse.Namespace, console: Console) -> int:
    """Compute, draw and write the paper's numbers beside ours."""
    folder = Path(arguments.out or "renders/paper")
    if arguments.proofs:
        return _proofs(folder, console)
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


def _proofs(folder: Path, console: Console) -> int:
    """The table of proofs, PASS and FAIL."""
    names = ("proofs.md", "proofs.json")
    with staged_folder(folder, names) as staged:
        rows = proofs(progress=lambda name: console.note(f"planning and proving {name}"))
        text = proofs_markdown(rows)
        (staged.path / "proofs.md").write_text(text, encoding="utf-8")
        (staged.path / "proofs.json").write_text(json_text({"proofs": rows}), encoding="utf-8")
    console.say(text)
    console.say(f"{folder}: {', '.join(names)}")
    console.document({"command": "paper", "proofs": rows, "folder": str(folder), "files": list(names), "exit_code": 0})
    return 0
