"""The commands and flags of the command line. A case's signature gives the names, types and defaults of its flags."""

from __future__ import annotations

import argparse
import difflib
import inspect
import re
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NoReturn, get_args, get_type_hints

from planner.base.arguments import choice, shown
from planner.base.errors import PlannerError
from planner.cases import CASES
from planner.cases.problem_file import keys as problem_keys
from planner.cli.exporting import FORMATS
from planner.dynamics import INTEGRATORS
from planner.paper.studies.catalogue import STUDIES
from planner.problem.export.table import PARTS
from planner.problem.objective import OBJECTIVES
from planner.proof.engines import ENGINES
from planner.solvers.slq import HESSIANS, LINE_SEARCHES, UPDATES

PROBLEM_FILE = "PROBLEM.toml"
"""Stands for any problem file where a case may be named."""

SHELLS = ("bash", "zsh", "tcsh")
"""Shells that completion is written for."""

Flags = dict[str, dict[str, Any]]  # options of add_argument() by flag

_OWN = "A machine of your own: an MJCF file, a start, a goal, weights (docs/own-machine.md)."


class _Parser(argparse.ArgumentParser):
    """An ArgumentParser that raises a PlannerError instead of printing the usage and exiting."""

    def __init__(self, **options: Any) -> None:
        layout = partial(argparse.HelpFormatter, max_help_position=32, width=110)
        super().__init__(allow_abbrev=False, formatter_class=layout, **options)

    def error(self, message: str) -> NoReturn:
        raise PlannerError(f"{message.removeprefix('argument ').rstrip('.')} (see {self.prog} --help).")

    def _get_values(self, action: argparse.Action, arg_strings: list[str]) -> Any:
        if arg_strings == ["--"] and action.option_strings:  # argparse would drop it, and then miss it
            raise argparse.ArgumentError(action, "expected another value than '--'")
        return super()._get_values(action, arg_strings)  # type: ignore[misc]

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        if action.choices is not None:
            choice("/".join(action.option_strings) or str(action.metavar), value, tuple(action.choices))


def documented_arguments(case: Callable[..., Any]) -> dict[str, str]:
    """Descriptions of the arguments of a case, from the Args section of its docstring."""
    doc = inspect.getdoc(case) or ""
    section = doc.split("Args:\n", 1)[-1].split("\n\n", 1)[0]
    return {name: " ".join(text.split()) for name, text in re.findall(r"^    (\w+): (.*(?:\n {8}.*)*)", section, re.M)}


def summary(case: Callable[..., Any]) -> str:
    """The first line of a case's docstring."""
    return (inspect.getdoc(case) or "").split("\n", 1)[0]


def _word_as(parse: Callable[[str], Any], expected: str) -> Callable[[str], Any]:
    """A type of add_argument() that names what it expected."""

    def convert(text: str) -> Any:
        try:
            return parse(text)
        except ValueError:
            raise argparse.ArgumentTypeError(f"{shown(text)} is not {expected}") from None

    return convert


def _width_and_height(text: str) -> tuple[int, int]:
    width, height = map(int, text.split("x"))
    return width, height


_number, _whole = _word_as(float, "a number"), _word_as(int, "a whole number")
_size = _word_as(_width_and_height, "a size like 1280x720")


def _add_case(parser: argparse.ArgumentParser, case: Callable[..., Any]) -> None:
    texts, hints = documented_arguments(case), get_type_hints(case)
    for name, parameter in inspect.signature(case).parameters.items():
        if not has_flag(hints[name]):
            continue
        flag, default = f"--{name.replace('_', '-')}", parameter.default
        words = [word for word in _leaves(hints[name]) if isinstance(word, str)]
        options: dict[str, Any] = {"default": argparse.SUPPRESS, "help": texts.get(name, "")}
        if default is not None:
            options["help"] += f" Default: {default}."
        if name == "integrator":
            options["choices"] = INTEGRATORS
        elif words:
            options["choices"] = words
        elif str in _leaves(hints[name]):
            options |= {"metavar": "FILE"}
        elif int in _leaves(hints[name]):
            options |= {"type": _whole, "metavar": "N"}
        else:
            options |= {"type": _number, "metavar": "X"}
        parser.add_argument(flag, dest=f"case_{name}", **options)


def has_flag(hint: Any) -> bool:
    """Whether one word can hold a parameter of this type; arrays have no flag."""
    return ... not in _leaves(hint)


def _leaves(hint: Any) -> tuple[Any, ...]:
    """Types and words in a type hint: "a", "b" and None for `Literal["a", "b"] | None`."""
    parts = get_args(hint)
    return (hint,) if not parts else tuple(leaf for part in parts for leaf in _leaves(part))


def _takes(metavar: str, text: str, default: Any = None, kind: Callable[[str], Any] = str) -> dict[str, Any]:
    """Options of add_argument() for a flag with a value."""
    told = text if default is None else f"{text} Default: {default}."
    return {"metavar": metavar, "help": told, "default": default, "type": kind}


def _one_of(choices: Sequence[str], text: str, default: str) -> dict[str, Any]:
    """Options of add_argument() for a flag with one of some words."""
    return {"choices": choices, "default": default, "help": f"{text} Default: {default}."}


def _switch(text: str) -> dict[str, Any]:
    """Options of add_argument() for a flag without a value."""
    return {"action": "store_true", "help": text}


_LIMITS: Flags = {
    "--control-limit": _takes("X", "Largest magnitude of every control.", kind=_number),
    "--exact-goal": _switch("Reach the goal to 1e-4 instead of weighing the distance to it."),
}
_SOLVER: Flags = {
    "--update": _one_of(UPDATES, "New controls: feedback, us + step k + K (x - xs), or open-loop, the paper's Eq. 36.",
                        "feedback"),
    "--line-search": _one_of(LINE_SEARCHES, "Rule that accepts a step length.", "armijo"),
    "--hessian": _one_of(HESSIANS, "exact adds second derivatives of the dynamics (hinges, slides, hopper).",
                         "gauss-newton"),
    "--max-iterations": _takes("N", "Largest number of iterations of the solver.", 1000, _whole),
    "--starts": _takes("N", "Number of first guesses to try: the problem's own and smooth random changes of it; the "
                            "best plan wins. Default: 1.", kind=_whole),
    "--seed": _takes("N", "Seed of the random first guesses. Default: 0.", kind=_whole),
    "--rank": _one_of(("cost", "proven-cost"), "Rank starts by cost of the plan, or of its replay in MuJoCo.",
                      "cost"),
    "--objective": _takes("NAME", f"Minimize one of {', '.join(OBJECTIVES)}, or weights, e.g. effort=1,time=2. "
                                  "Default: effort."),
    "--durations": _takes("A,B", "Shortest and longest duration, s, for an objective with time."),
}  # fmt: skip
_URDF: Flags = {
    "--package-path": _takes("DIR", "Folder of the packages that the file's URDF names, instead of its package_path."),
}
_SWEEP: Flags = {
    "--set": {"action": "append", "metavar": "NAME=VALUES", "required": True,
              "help": "Values of a parameter: START:STOP:COUNT, e.g. height=1:60:60, or a list, duration=0.8,1. Of a "
                      "problem file a key, e.g. weights.effort=0.1,1. Repeat it for others: all combinations."},
    "--out": _takes("DIR", "Folder of table, plans and page. Default: renders/sweep-CASE."),
    "--continue": _takes("NAME", "Start each problem from its neighbour's controls along this parameter.")
                  | {"dest": "along"},
    "--timeout": _takes("S", "Longest time of one solve, s.", kind=_number),
    "--prove": _switch("Prove each plan."),
    "--rollouts": _takes("N", "Perturbed simulations of each proof.", 0, _whole),
    "--resume": _switch("Go on with the sweep that is in the folder: do what has no row, what lost its worker, and "
                        "with a longer --timeout what took too long; keep the rest."),
}  # fmt: skip
_WORKERS: Flags = {
    "--workers": _takes("N", "Processes on this machine. Default: one a processor for sweep and paper, else threads of "
                             "one process.", kind=_whole),
    "--scheduler": _takes("ADDRESS", "Of a running Dask scheduler, tcp://HOST:8786, or local for a Dask cluster here."),
}  # fmt: skip
_PROOF: Flags = {
    "--rollouts": _takes("N", "Number of perturbed simulations, 0 for none; `run` stops them after 20 s.", 512, _whole),
    "--hold": _takes("S", "Also hold the goal for S seconds after the end, by an infinite-horizon LQR.", 0.0, _number),
}
_ROLLOUT: Flags = {
    "--replay-case": _takes("K", "Show perturbed simulation K in detail.", kind=_whole),
    "--mode": _one_of(("feedback", "open-loop"), "Simulate it with the plan's gains or open loop.", "feedback"),
    "--seed": _takes("N", "Seed of the perturbations.", 0, _whole),
    "--perturb": {"action": "append", "metavar": "NAME=X",
                  "help": "Size of a perturbation, e.g. mass=0.1 or delay=0; repeat it for others (docs/proof.md)."},
}  # fmt: skip
_NO_VIDEO = {"--no-video": _switch("Make no video and no strip of poses, which need OpenGL.")}
_OUTPUT: Flags = {"--json": _switch("Print one JSON document on stdout."), "--quiet": _switch("Print no progress.")}


def _add(parser: argparse.ArgumentParser, *groups: Flags) -> None:
    for group in groups:
        for flag, options in group.items():
            parser.add_argument(flag, **options)


def build() -> argparse.ArgumentParser:
    """All commands and flags. Parsed arguments have `command` and, where a case is named, `case` and `case_*`.

    A problem file is parsed as a case: `run crane.toml` as `run PROBLEM.toml crane.toml`.
    """
    top = _Parser(prog="planner", description="Plan a robot's motion, then prove the plan in MuJoCo.")
    top.add_argument("--version", action="store_true", help="Print versions and exit.")
    commands = top.add_subparsers(dest="command", metavar="COMMAND")

    def command(name: str, text: str, *groups: Flags) -> argparse.ArgumentParser:
        parser = commands.add_parser(name, help=text, description=text)
        parser.set_defaults(parser=parser)
        _add(parser, *groups)
        return parser

    def with_case(name: str, text: str, *groups: Flags) -> None:
        machines = command(name, text).add_subparsers(dest="case", metavar="CASE", required=True)
        for case, build_case in CASES.items():
            child = machines.add_parser(case, help=summary(build_case), description=f"{text} {summary(build_case)}")
            child.set_defaults(parser=child)
            _add_case(child, build_case)
            _add(child, _LIMITS, _SOLVER, *groups, _OUTPUT)
        own = machines.add_parser(
            PROBLEM_FILE, help=_OWN, description=f"{text} {_OWN}", epilog=f"Its keys: {', '.join(problem_keys.KEYS)}."
        )
        own.set_defaults(parser=own, control_limit=None, exact_goal=False)
        own.add_argument("problem", metavar="FILE", help="A problem.toml.")
        _add(own, _URDF)
        _add(own, _SOLVER, *groups, _OUTPUT)

    plan = {"plan": {"metavar": "PLAN", "help": "A plan.npz."}}
    no_refine = {"--no-refine": _switch("Do not solve a failed plan again at a finer step.")}
    folder = {"--out": _takes("DIR", "Folder of the results. Default: renders/CASE.")}
    machine = {"metavar": "NAME", "nargs": "?", "help": f"A machine, for its flags; {PROBLEM_FILE} for a file's keys."}
    command("list", "List the machines, a line each, or the flags of one.", {"machine": machine}, _OUTPUT)
    command(
        "model", "Describe a model of your own: its joints, actuators and contacts, and what looks wrong.",
        {"model": {"metavar": "FILE", "help": "An MJCF or URDF file."},
         "--write": _takes("FILE", "Also write a problem file to start from, which runs as it is."),
         "--out": _takes("DIR", "Folder of the picture of its keyframes. Default: renders/MODEL."),
         "--no-picture": _switch("Draw no picture, which needs OpenGL.")},
        _OUTPUT,
    )  # fmt: skip
    with_case(
        "run", "Plan, prove, plot and film a case or a problem file.", no_refine, _PROOF, _NO_VIDEO, folder, _WORKERS
    )
    with_case(
        "drive", "Plan again and again in the loop with MuJoCo, and judge the loop.",
        {"--push": {"action": "append", "metavar": "BODY=FORCE@TIME", "default": [],
                    "help": "A push, e.g. torso=50N@1.0s, along x, or torso=0,50,0N@1.0s/0.2s; repeat it for others."},
         "--latency": _takes("TIME", "From asking for a plan until it acts, e.g. 4ms. Default: as measured here."),
         "--rate": _takes("HZ", "Plans per second. Default: one per stage.", kind=_number),
         "--iterations": _takes("N", "Iterations of each plan.", 1, _whole),
         "--stages": _takes("N", "Stages that each plan looks ahead. Default: those of the problem.", kind=_whole),
         "--seconds": _takes("S", "How long it is driven. Default: the task and one second more.", kind=_number),
         "--heavier": _takes("X", "All bodies are heavier by this share, e.g. 0.2.", 0.0, _number),
         "--rubbing": _takes("X", "Dry friction in each joint, as a share of its largest force.", 0.0, _number),
         "--noise": _takes("X", "Standard deviation of what is measured.", 0.0, _number),
         "--encoders": _switch("Positions come from encoders of 17 bits, speeds are their differences."),
         "--map": {"metavar": "BODY", "help": "Also find the largest push at this body that is survived at 20 times, "
                                              "the latency and the mass, beside the plan with its gains alone."}},
        _NO_VIDEO, {"--out": _takes("DIR", "Folder of the results. Default: renders/CASE-loop.")},
    )  # fmt: skip
    with_case(
        "solve",
        "Plan a case or a problem file and save the plan.",
        {"--out": _takes("FILE", "The plan's file.", "plan.npz")},
        _WORKERS,
    )
    with_case("sweep", "Plan a case or a problem file at many parameters, into one table.", _SWEEP, _WORKERS)
    command(
        "prove", "Replay a stored plan in MuJoCo and judge it, or anybody's controls.",
        {"plan": {"metavar": "PLAN", "nargs": "?", "help": "A plan.npz; none where --controls are given."},
         "--controls": _takes("FILE", "In place of a plan: a CSV of time and controls, or of joint positions."),
         "--model": _takes("FILE", "The MJCF or URDF that the controls are for."),
         "--start": _takes("STATE", "Of the controls: a keyframe, numbers 0,1.57 or joints elbow=0.3."),
         "--goal": _takes("STATE", "Of the controls: where they are to end, in the same form."),
         "--save": _takes("FILE", "Write the plan that the controls make, for planner render."),
         "--feasible": _switch("Judge feasibility alone: a solve that did not converge may pass.")},
        {"--mjcf": _takes("FILE", "Replay in this model instead of the plan's own."),
         "--engine": {"action": "append", "metavar": "NAME", "choices": ENGINES, "default": [],
                      "help": f"Also repeat the plan in {' or '.join(ENGINES)}, where installed; repeat it for both."},
         "--out": _takes("FILE", "Write the proof to this JSON file.")}, _PROOF, _ROLLOUT, _WORKERS, _OUTPUT,
    )  # fmt: skip
    command(
        "render", "Film the replay of a stored plan.", plan,
        {"--out": _takes("FILE", "A name.mp4 for a video, a name.png for a strip of poses.", "video.mp4"),
         "--size": _takes("WxH", "Pixels. Default: 1280x720, of a strip 1920x540.", kind=_size),
         "--fps": _takes("N", "Frames per second.", 30, _whole),
         "--speed": _takes("X", "Playback speed, e.g. 0.25. Default: the case's.", kind=_number)},
        _ROLLOUT, _OUTPUT,
    )  # fmt: skip
    command(
        "view", "Look at a stored plan in MuJoCo's viewer.",
        {"plan": {"metavar": "PLAN", "help": "A plan.npz, or a folder of planner run."},
         "--rollouts": _takes("N", "Number of perturbed simulations that key 7 shows.", 8, _whole),
         "--speed": _takes("X", "Playback speed, e.g. 0.25. Default: the case's.", kind=_number)}, _OUTPUT,
    )  # fmt: skip
    command(
        "report", "Prove a stored plan again and write report.html with all its pictures.", plan, _NO_VIDEO,
        {"--out": _takes("DIR", "Folder of the results.", "report")}, _PROOF, _OUTPUT,
    )  # fmt: skip
    command(
        "export", "Write a stored plan for other programs.", plan,
        {"--to": {"choices": FORMATS, "required": True,
                  "help": "csv: a table; json, yaml: ROS 2's JointTrajectory; keyframes: an MJCF to include."},
         "--rate": _takes("HZ", "Samples a second. Default: the plan's own knots.", kind=_number),
         "--only": {"choices": PARTS, "help": "Of a csv: these columns alone. Default: both."},
         "--out": _takes("FILE", "The file. Default: PLAN with the ending of the form.")}, _OUTPUT,
    )  # fmt: skip
    command(
        "check", "Prove stored plans again and compare with the numbers stored beside them.",
        {"paths": {"metavar": "DIR", "nargs": "+", "help": "Folders of plans, or plan files."},
         "--update": _switch("Store the new numbers where they differ."),
         "--tolerance": _takes("X", "Relative change of a number that is reported.", 0.05, _number)},
        _WORKERS, _OUTPUT,
    )  # fmt: skip
    names = ", ".join(study.name for study in STUDIES)
    command(
        "paper", "Compute every figure and number of the paper and show it beside the paper's.",
        {"studies": {"metavar": "STUDY", "nargs": "*",
                     "help": f"Studies to compute, each on a page of its own: {names}. Default: all."},
         "--proofs": _switch("Write the table of proofs of all machines instead."),
         "--out": _takes("DIR", "Folder of the results. Default: paper, in a checkout docs and renders/gallery/paper; "
                                "for single studies and for --proofs renders/paper.")},
        _WORKERS, _OUTPUT,
    )  # fmt: skip
    every = {"--all": _switch("Also compile the kernels that only --hessian exact needs.")}
    shell = {"choices": SHELLS, "metavar": "SHELL", "help": f"One of {', '.join(SHELLS)}."}
    command("completion", "Print a script by which a shell completes commands and flags.", {"shell": shell}, _OUTPUT)
    command("warmup", "Compile the numerical core, once.", every, _OUTPUT)
    return top


def parse(argv: list[str]) -> argparse.Namespace:
    """Parsed arguments.

    Raises:
        PlannerError: Wrong usage; the sentence suggests the nearest flag.
    """
    if argv[:1] in (["run"], ["solve"], ["drive"], ["sweep"]) and argv[1:]:
        ending = argv[1].lower()
        if ending.endswith(".toml"):
            argv = [argv[0], PROBLEM_FILE, *argv[1:]]
        elif ending.endswith((".xml", ".mjcf", ".urdf", ".xacro")):
            raise PlannerError(
                f"{argv[1]} is a model, expected a case ({', '.join(CASES)}) or a {PROBLEM_FILE} that names the model "
                f"(planner model {argv[1]} --write {Path(argv[1]).stem}.toml writes one to start from)."
            )
    arguments, unknown = build().parse_known_args(argv)
    if not unknown:
        return arguments
    parser = getattr(arguments, "parser", None)
    where = parser.prog if parser is not None else "planner"
    word = unknown[0]
    known = [flag for action in parser._actions for flag in action.option_strings] if parser is not None else []
    near = difflib.get_close_matches(word.split("=")[0], known, n=1)
    hint = f"Did you mean {near[0]}?" if near else f"See {where} --help."
    kind = "flag" if word.startswith("-") else "argument"
    raise PlannerError(f"{where!r} has no {kind} {shown(word)}. {hint}")
