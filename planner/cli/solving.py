"""The command `solve`: a plan and its file, without proof and pictures."""

from __future__ import annotations

import argparse

from planner.base.files import write_atomically
from planner.cli.console import Console
from planner.cli.problems import asked_problem, solved
from planner.cli.showing import plan_facts, show_fixes, show_plan
from planner.problem.archive import plan_name
from planner.proof.diagnostics import suggested_fixes
from planner.sweeps.executors import executor_of


def solve_case(arguments: argparse.Namespace, console: Console) -> int:
    """Plan a case and save the plan."""
    out = plan_name(arguments.out)
    asked = asked_problem(arguments)
    # an unwritable file fails before the work
    with write_atomically(out) as unfinished, executor_of(arguments.workers, arguments.scheduler) as executor:
        plan, seconds = solved(asked, arguments, console, executor)
        plan.save(unfinished)
    show_plan(plan, seconds, console)
    show_fixes(suggested_fixes(plan), console)
    console.write_result(str(out))
    facts = plan_facts(plan)
    return console.finish(
        "solve", 0 if plan.success and not plan.missed_goals else 1, plan=facts, solve_seconds=seconds, file=str(out)
    )
