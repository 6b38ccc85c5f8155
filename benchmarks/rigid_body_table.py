"""The records of rigid_body.py as tables for a reader, and as JSON."""

from __future__ import annotations

import math
from typing import Any

from rigid_body_problems import SHORT
from serving import Answer

WORDS = {True: "met", False: "MISSED"}
LABELS = {"native": "planner", "baseline": "planner, plain", "crocoddyl": "Crocoddyl", "casadi": "fatrop"}


def table(rows: list[Answer]) -> str:
    """All records, one block per kind."""
    blocks = []
    for kind, header in HEADERS.items():
        lines = [text(line) for line in rows if line["kind"] == kind]
        if lines:
            blocks.append("\n".join(["", header, *lines]))
    return "\n".join(blocks)


def text(line: Answer) -> str:
    """A record as a row of its table."""
    start = f"{line['problem']:<9} {SHORT[line['integrator']]:<6} "

    def number(key: str, form: str) -> str:
        width = int(form.split(".")[0])
        value = line.get(key)
        return f"{'-':>{width}}" if value is None else f"{value:{form}}"

    if line["kind"] == "check":
        if "failed" in line:
            return f"{start}{LABELS[line['solver']]:<15} failed: {line['failed']}"
        figures = (
            f"{key.replace('_', ' ')} {line[key]:.0e}"
            for key in ("at_rest", "accelerations", "pinocchio", "sample", "cost", "stepped_cost")
            if key in line
        )
        return (
            f"{start}{LABELS[line['solver']]:<15} {'agrees' if line['agrees'] else 'DISAGREES'}: {', '.join(figures)}"
        )
    if line["kind"] == "start":
        if "failed" in line:
            return f"{start}{line['what']:<15} failed: {line['failed']}"
        return f"{start}{line['what']:<15} {line['seconds']:8.2f} {line['target']:8.1f} {WORDS[line['met']]}"
    if line["kind"] == "iteration":
        failed = "; ".join(f"{s}: {line[f'{s}_failed']}" for s in ("ours", "crocoddyl") if f"{s}_failed" in line)
        verdict = WORDS.get(line.get("met"), "")
        return (
            f"{start}{line['isa']:<9} {number('crocoddyl_min_us', '9.1f')} {number('crocoddyl_median_us', '9.1f')} "
            f"{number('ours_min_us', '9.1f')} {number('ours_median_us', '9.1f')} {number('ratio_min', '6.2f')} "
            f"{number('ratio_median', '6.2f')} {line['target']:>6.1f} {verdict} {failed}"
        ).rstrip()
    if "failed" in line:
        return f"{start}{LABELS[line['solver']]:<15} failed: {line['failed']}"
    verdict = ""
    if "met" in line:
        verdict = (
            f"{line['target_ms']:g} ms: {WORDS[line['met']]}, cost {line['target_cost']:.6g}: {WORDS[line['cost_met']]}"
        )
    converged = "" if line["converged"] else " not converged"
    return (
        f"{start}{LABELS[line['solver']]:<15} {number('cost', '11.5f')} {number('judged_cost', '11.5f')} "
        f"{line['iterations']:>5} {number('min_ms', '10.3f')} {number('median_ms', '10.3f')} {number('ratio', '7.2f')}"
        f"  {verdict}{converged}"
    ).rstrip()


HEADERS = {
    "check": "relative differences from ours",
    "iteration": (
        f"{'one iteration, us':<16} {'ours for':<9}{'Crocoddyl':>9} {'median':>9} {'ours':>9} {'median':>9} "
        f"{'ratio':>6} {'median':>6} {'target':>6}"
    ),
    "solve": (
        f"{'whole solve':<16} {'solver':<15} {'cost':>11} {'judged':>11} {'iter':>5} {'min ms':>10} {'median':>10} "
        f"{'ratio':>7}"
    ),
    "start": f"{'fresh process, s':<16} {'':<15} {'seconds':>8} {'target':>8}",
}


def finite(value: Any) -> Any:
    """JSON has no NaN and no infinity: null."""
    if isinstance(value, dict):
        return {key: finite(part) for key, part in value.items()}
    return None if isinstance(value, float) and not math.isfinite(value) else value
