"""Build and solve the problem that a command line names, and print the plan: commands `solve`, `sweep`, `warmup`."""

from __future__ import annotations

import argparse
import shutil
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from planner import cases
from planner.base.arguments import count, number
from planner.base.errors import PlannerError
from planner.base.files import write_atomically
from planner.cases.problem_file import ProblemFile
from planner.cli.commands import durations_of, objective_of
from planner.cli.console import Console
from planner.cli.flags import PROBLEM_FILE
from planner.problem.archive import plan_name
from planner.problem.limits import EXACT, Limits
from planner.problem.objective import with_found_duration, with_objective
from planner.problem.plan import Plan, Status
from planner.problem.problem_parts import checked_durations, durations_or_default
from planner.solvers.options import MAX_STARTS
from planner.solvers.slq import solve
from planner.solvers.work import WorkBudget, work_of_stage
from planner.sweeps.processes import executor_of

if TYPE_CHECKING:
    from planner.proof.diagnostics import SuggestedFix

INTERRUPTED = 130  # exit code
LONG_ITERATION = 0.5  # s, by its work: said before planning


def asked_problem(arguments: argparse.Namespace) -> ProblemFile:
    """The problem of a case or a file, its number of starts, objective and durations."""
    objective, durations = objective_of(arguments.objective), durations_of(arguments.durations)
    named = None
    if arguments.case == PROBLEM_FILE:
        from planner.cases.problem_file import case_in, load  # local: a case needs none of it

        named = case_in(arguments.problem)
        if named is None:
            words = {name: getattr(arguments, name) for name in ("starts", "seed")}
            words["package_path"] = absolute(arguments.package_path)
            return _with_durations(load(arguments.problem, **words, objective=objective, durations=durations))
    case, given, starts, seed = named or (arguments.case, flags_of_case(arguments), 1, 0)
    starts = starts if arguments.starts is None else count("starts", arguments.starts, maximum=MAX_STARTS)
    seed = seed if arguments.seed is None else arguments.seed
    problem = cases.build(case, **given)
    limits = limits_of(arguments)
    if limits is not None:
        problem = replace(problem, limits=limits)
    if durations is not None and problem.periodic is not None:
        raise PlannerError(
            "--durations is given for a periodic motion, whose cycle has a fixed duration; leave it out."
        )
    if objective is not None:
        problem = with_objective(problem, objective)
    checked_durations(durations_or_default(durations, objective or {}, problem.duration), objective or {})
    return _with_durations(ProblemFile(problem, starts, seed, objective, durations))


def _with_durations(asked: ProblemFile) -> ProblemFile:
    """With the durations that an objective with time chooses between, which are said where nobody gave them."""
    own = asked.problem.N * asked.problem.dynamics.dt
    between = durations_or_default(asked.durations, asked.objective or {}, own)
    if between is asked.durations:
        return asked
    said = "{:.3g} to {:.3g} s, a fifth and twice the problem's own: --durations SHORTEST,LONGEST asks for others."
    return asked._replace(durations=list(between), notes=(*asked.notes, "durations " + said.format(*between)))


def absolute(folder: str | None) -> str | None:
    """A folder of the command line, which is not relative to the problem file."""
    return None if folder is None else str(Path(folder).absolute())


def flags_of_case(arguments: argparse.Namespace) -> dict[str, Any]:
    """The flags of the case's own that were given, by the names of its parameters."""
    return {name[5:]: value for name, value in vars(arguments).items() if name.startswith("case_")}


def limits_of(arguments: argparse.Namespace) -> Limits | None:
    """The limits that --control-limit and --exact-goal ask for in place of the problem's own."""
    limit = arguments.control_limit
    if limit is None and not arguments.exact_goal:
        return None
    bound = None if limit is None else number("control-limit", limit, greater_than=0.0)
    return Limits(control=bound, final=EXACT if arguments.exact_goal else None)


def name_of(arguments: argparse.Namespace) -> str:
    """Name of a run: its case, or its file's name without folder and suffix."""
    return Path(arguments.problem).stem if arguments.case == PROBLEM_FILE else arguments.case


def solved(
    asked: ProblemFile, arguments: argparse.Namespace, console: Console, executor: Executor | None = None,
    purpose: str = "", budget: WorkBudget | None = None,
) -> tuple[Plan, float]:  # fmt: skip
    """The plan and the time of its solve, s; `purpose` of a solve after the first is printed with its table."""
    problem = asked.problem
    iteration = problem.N * work_of_stage(problem)
    if iteration > LONG_ITERATION and not purpose:  # or nothing is seen for that long, and nobody knows why
        console.write_progress(f"an iteration takes about {float(f'{iteration:.2g}'):g} s")
    # compiles outside of the measured time
    solve(with_found_duration(problem), hessian=arguments.hessian, max_iterations=1)
    several = f", {asked.starts} starts" if asked.starts > 1 else ""
    for note in asked.notes:
        console.write_progress(note)
    console.write_progress(
        f"planning {name_of(arguments)}: {problem.N} stages of {problem.dynamics.dt:.4g} s{several}{purpose}"
    )
    began = time.perf_counter()
    options = {
        "update": arguments.update, "line_search": arguments.line_search, "hessian": arguments.hessian,
        "starts": asked.starts, "seed": asked.seed, "max_iterations": arguments.max_iterations,
        "rank": _rank(arguments.rank), "executor": executor, "budget": budget,
    }  # fmt: skip
    alone = asked.durations is None and asked.starts == 1 and problem.periodic is None and not asked.phase_times
    plan = asked.solved(console.iteration if alone else console.row, **options)
    return plan, time.perf_counter() - began


def _rank(name: str) -> Callable[[Plan], float] | None:
    """What --rank orders several starts by."""
    if name == "cost":
        return None
    from planner.proof.replays.replaying import proven_cost  # local, so that `solve` does not import what replays

    return proven_cost


def plan_facts(plan: Plan) -> dict[str, Any]:
    """A plan as JSON values, without its arrays."""
    return {
        "case": plan.case, "parameters": plan.parameters, "status": plan.status.name, "success": plan.success,
        "message": plan.message, "cost": plan.cost, "gradient_norm": plan.gradient_norm, "iterations": plan.nit,
        "starts": [start._asdict() | {"status": start.status.name} for start in plan.starts], "start": plan.start,
        "relaxation": plan.options.get("relaxation"),
        "horizon": plan.N, "dt": plan.dt, "versions": plan.versions,
        "objective": None if plan.problem is None or plan.problem.objective is None else plan.problem.objective.weights,
    }  # fmt: skip


def show_plan(plan: Plan, seconds: float | None, console: Console, which: str = "") -> None:
    """Print the solve in two lines; `which` names a plan that takes the place of the first, "refined" say."""
    took = "" if seconds is None else f", {1e3 * seconds:.3g} ms"
    which = f"{which} plan, " if which else ""
    iterations = plan.total_iterations if {"passes", "phase_times"} & set(plan.options) else plan.nit
    console.write_result(
        f"{which}{plan.status.name}: {iterations} iterations, cost {plan.cost:.8g}, "
        f"|gradient| {plan.gradient_norm:.2e}{took}"
    )
    if plan.starts:
        converged = sum(start.status is Status.CONVERGED for start in plan.starts)
        console.write_result(f"start {plan.start} of {len(plan.starts)} is the best; {converged} converged")
    if "relaxation" in plan.options:
        solves = len(plan.options["relaxation"]["steps"])
        console.write_result(f"relaxed: {solves} solves, {plan.total_iterations} iterations in all")
    if not plan.success or plan.missed_goals:
        console.write_result(plan.message)
    shortest = plan.options.get("durations", (0.0,))[0]
    if plan.success and not plan.missed_goals and plan.t[-1] <= shortest * (1.0 + 1e-9):
        console.write_result("The shortest duration that was allowed suffices: write a shorter one in `durations`.")
    for key in ("first_guess", "not_finite", "cut"):  # what became of a guess that ran away; what a budget cut
        if key in plan.options and plan.options[key] != plan.status.name:
            console.write_result(f"{key.replace('_', ' ')}: {plan.options[key]}")


def show_fixes(fixes: Sequence[SuggestedFix], console: Console) -> None:
    """Print what to write so that a plan passes, the most likely first, and what was tried and does not pass."""
    known = [one for one in fixes if one.tried != "fails"]
    for i, one in enumerate(known):
        console.write_result(f"{'or' if i else 'to pass'}: {one}")
    for one in fixes:
        if one.tried == "fails":
            console.write_result(f"tried: {one}")


def solve_case(arguments: argparse.Namespace, console: Console) -> int:
    """Plan a case and save the plan."""
    out = plan_name(arguments.out)
    asked = asked_problem(arguments)
    # an unwritable file fails before the work
    with write_atomically(out) as unfinished, executor_of(arguments.workers, arguments.scheduler) as executor:
        plan, seconds = solved(asked, arguments, console, executor)
        plan.save(unfinished)
    show_plan(plan, seconds, console)
    done = plan.success and not plan.missed_goals
    if not done:
        from planner.proof.diagnostics import suggested_fixes  # local: they import all that replays and judges

        show_fixes(suggested_fixes(plan), console)
    console.write_result(str(out))
    return console.finish("solve", 0 if done else 1, plan=plan_facts(plan), solve_seconds=seconds, file=str(out))


def warmup(arguments: argparse.Namespace, console: Console) -> int:
    """Compile the numerical core once; print the time only where something was compiled."""
    from planner.kernels.numba.jit import is_warm  # local, like parity, so that `solve` imports what it needs
    from planner.kernels.precompile import KERNELS, SECOND_ORDER, compile_these, compile_together
    from planner.proof.compare.model_parity import parity

    names = [name for name in KERNELS if arguments.all or name not in SECOND_ORDER]
    cold = not all(is_warm(*KERNELS[name]) for name in names)
    began = time.perf_counter()
    compile_together(names)
    compile_these([name for name in names if not is_warm(*KERNELS[name])])  # what is left on one processor
    for problem in (cases.hopper(horizon=8, duration=0.04), cases.acrobot(horizon=8, duration=0.04)):
        plan = solve(problem, max_iterations=2)
        problem.dynamics.step(plan.xs[:1], plan.us[:1])
        problem.dynamics.linearize(plan.xs, plan.us)
        parity(problem)  # rates, or every term of the mechanics
    seconds = time.perf_counter() - began
    if cold:
        console.write_result(f"compiled in {seconds:.1f} s")
    return console.finish("warmup", 0, compiled=cold, seconds=seconds)


def sweep_case(arguments: argparse.Namespace, console: Console) -> int:
    """Plan a case or a problem file at every point of a grid."""
    out = Path(arguments.out or f"renders/sweep-{name_of(arguments)}")
    try:
        return _swept(arguments, out, console)
    except KeyboardInterrupt:  # a second time, while processes ended or tables were written
        from planner.sweeps.store import read_head

        if read_head(out) is None:
            raise
        console.write_error(
            f"interrupted; what is done is in {out}, and --resume goes on with it and writes its tables."
        )
        return INTERRUPTED


def _swept(arguments: argparse.Namespace, out: Path, console: Console) -> int:
    if arguments.rank != "cost":
        raise PlannerError("--rank is for one problem, expected a sweep without it: its starts are ranked by cost.")
    from planner.sweeps.sweeping import sweep  # local, so that `solve` does not import what proves and draws
    from planner.view.report.sweep_page import NAME

    name, folder = name_of(arguments), absolute(getattr(arguments, "package_path", None))
    fixed = flags_of_case(arguments) | ({} if folder is None else {"package_path": folder})
    passed_on = ("update", "line_search", "hessian", "max_iterations", "starts", "seed")
    options = {name: getattr(arguments, name) for name in passed_on}
    local = arguments.scheduler is None  # sweep() starts processes of its own, which load the problem's kernels first
    with executor_of(None if local else arguments.workers, arguments.scheduler) as executor:
        done = sweep(
            Path(arguments.problem) if arguments.case == PROBLEM_FILE else arguments.case, arguments.set,
            out=out, executor=executor, workers=arguments.workers, fixed=fixed,
            prove={"rollouts": arguments.rollouts} if arguments.prove else False,
            continued=arguments.along, timeout=arguments.timeout, resume=arguments.resume,
            objective=objective_of(arguments.objective), durations=durations_of(arguments.durations),
            limits=limits_of(arguments), progress=console.progress(f"planning {name}"), **options,
        )  # fmt: skip
    page = done.folder / NAME
    reasons = done.reasons
    counted = [(status, str(tasks), reasons[status]) for status, tasks in done.statuses.items()]
    console.table(("status", "tasks", "the first one's reason"), counted, shutil.get_terminal_size().columns)
    console.write_result(str(page))
    if done.interrupted:
        console.write_error(
            f"interrupted; {done.finished} of {len(done.grid)} are done, and --resume goes on with them."
        )
    converged = done.statuses.get("CONVERGED", 0)
    code = INTERRUPTED if done.interrupted else 0 if converged == len(done.grid) else 1
    facts = {"tasks": len(done.grid), "finished": done.finished, "statuses": done.statuses, "reasons": reasons}
    return console.finish("sweep", code, **facts, folder=str(out))
