"""The command `report`: prove a stored plan again and write all its files."""

from __future__ import annotations

import argparse
from contextlib import ExitStack
from pathlib import Path

from planner.base.files import staged_folder
from planner.cli.allowed_imports import load_allowed
from planner.cli.background_render import BackgroundRender
from planner.cli.console import Console
from planner.cli.results import OUTPUTS, completed, draw_results, is_finite, show_proof, write_proof
from planner.problem.archive import plan_digest
from planner.proof import prove
from planner.proof.diagnostics import suggested_fixes


def report_plan(arguments: argparse.Namespace, console: Console) -> int:
    """Prove a stored plan again and write all its files."""
    plan = load_allowed(arguments.plan, arguments)
    with staged_folder(arguments.out, OUTPUTS) as staged, ExitStack() as drawing:
        proof, films = None, None
        if is_finite(plan):
            proof = prove(plan, rollouts=0, hold_seconds=arguments.hold)
            if not arguments.no_video:
                films = drawing.enter_context(BackgroundRender(proof, staged, (), console))
            proof = completed(proof, arguments.rollouts, console)
        plan.save(staged / "plan.npz")
        fixes = suggested_fixes(plan, proof)
        write_proof(plan, proof, staged, plan_digest(staged / "plan.npz"), fixes)
        if proof is not None:
            show_proof(proof, fixes, console)
        draw_results(plan, proof, staged, fixes, not arguments.no_video, console, films=films)
    console.write_result(f"\n{Path(arguments.out) / 'report.html'}")
    passed = plan.success and proof is not None and proof.passed
    return console.finish("report", 0 if passed else 1, folder=arguments.out)
