"""The command line's grammar. The flags of a case come from its signature: names, types and defaults."""

from __future__ import annotations

import argparse
import difflib
import inspect
import re
from collections.abc import Callable
from typing import Any, NoReturn, get_args, get_type_hints

from planner.base.errors import PlannerError
from planner.cases import CASES, problem_keys
from planner.dynamics import INTEGRATORS
from planner.paper.studies.catalogue import STUDIES
from planner.problem.objective import OBJECTIVES
from planner.solvers.slq import HESSIANS, LINE_SEARCHES, UPDATES

PROBLEM_FILE = "PROBLEM.toml"
"""Stands for any file of that kind where a case may be named."""

_OWN = "A machine of your own: an MJCF file, a start, a goal, weights (docs/own-machine.md)."


class _Parser(argparse.ArgumentParser):
    """argparse that raises one sentence instead of printing the usage and leaving."""

    def __init__(self, **options: Any) -> None:
        super().__init__(allow_abbrev=False, formatter_class=_help, **options)

    def error(self, message: str) -> NoReturn:
        raise PlannerError(f"{message.rstrip('.')} (see {self.prog} --help).")


def _help(prog: str) -> argparse.HelpFormatter:
    return argparse.HelpFormatter(prog, max_help_position=32, width=110)


def documented_arguments(case: Callable[..., Any]) -> dict[str, str]:
    """Descriptions of a case's arguments, from the Args section of its docstring."""
    doc = inspect.getdoc(case) or ""
    section = doc.split("Args:\n", 1)[-1].split("\n\n", 1)[0]
    return {name: " ".join(text.split()) for name, text in re.findall(r"^    (\w+): (.*(?:\n {8}.*)*)", section, re.M)}


def summary(case: Callable[..., Any]) -> str:
    """The first line of a case's docstring."""
    return (inspect.getdoc(case) or "").split("\n", 1)[0]


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number") from None


def _whole(text: str) -> int:
    try:
        return int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number") from None


def _size(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"(\d+)x(\d+)", text)
    if match is None:
        raise argparse.ArgumentTypeError(f"{text!r} is not a size like 1280x720")
    return int(match[1]), int(match[2])


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
    """Whether a parameter of this type can be said in one word: no arrays."""
    return ... not in _leaves(hint)


def _leaves(hint: Any) -> tuple[Any, ...]:
    """The types and words that a type hint is made of: those of `Literal["a", "b"] | None` are "a", "b" and None."""
    parts = get_args(hint)
    return (hint,) if not parts else tuple(leaf for part in parts for leaf in _leaves(part))


def _add_solver(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--update", choices=UPDATES, default="feedback",
        help="feedback: us + step k + K (x - xs); open-loop: the paper's Eq. 36. Default: feedback.",
    )  # fmt: skip
    parser.add_argument("--line-search", choices=LINE_SEARCHES, default="armijo", help="Default: armijo.")
    parser.add_argument(
        "--hessian", choices=HESSIANS, default="gauss-newton",
        help="exact: with the second derivatives of the dynamics (hinges, slides, hopper). Default: gauss-newton.",
    )  # fmt: skip
    parser.add_argument(
        "--max-iterations", type=_whole, default=1000, metavar="N", help="Limit of the solver. Default: 1000."
    )
    parser.add_argument(
        "--starts", type=_whole, default=None, metavar="N",
        help="First guesses to try: the problem's own and smooth random changes of it; the best counts. Default: 1.",
    )  # fmt: skip
    parser.add_argument(
        "--seed", type=_whole, default=None, metavar="N", help="Of the random first guesses. Default: 0."
    )


def _add_objective(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--objective", default=None, metavar="NAME",
        help=f"What to be sparing of: {', '.join(OBJECTIVES)}, or weights, e.g. effort=1,time=2. Default: effort.",
    )  # fmt: skip
    parser.add_argument(
        "--durations", default=None, metavar="A,B", help="The shortest and longest, s, that time may choose."
    )


def _add_rank(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--rank", choices=("cost", "proven-cost"), default="cost",
        help="What counts among several starts: the plan's cost, or what MuJoCo reaches with it. Default: cost.",
    )  # fmt: skip


def _add_proof(parser: argparse.ArgumentParser, note: str = "") -> None:
    parser.add_argument(
        "--rollouts", type=_whole, default=512, metavar="N",
        help=f"Perturbed rollouts of the proof, 0 for none. Default: 512{note}.",
    )  # fmt: skip
    parser.add_argument(
        "--hold", type=_number, default=0.0, metavar="S",
        help="Also hold the goal for so many seconds after arriving, by an infinite-horizon LQR. Default: 0.",
    )  # fmt: skip


def _add_case_of(parser: argparse.ArgumentParser) -> None:
    """Which rollout, and what was varied in it."""
    parser.add_argument(
        "--replay-case", type=_whole, default=None, metavar="K", help="One perturbed rollout in detail."
    )
    parser.add_argument(
        "--mode", choices=("feedback", "open-loop"), default="feedback", help="Of that rollout. Default: feedback."
    )
    parser.add_argument("--seed", type=_whole, default=0, metavar="N", help="Of the perturbations. Default: 0.")
    parser.add_argument(
        "--perturb", action="append", default=None, metavar="NAME=X",
        help="What varies, e.g. mass=0.1 or delay=0; may be given again for others (docs/proof.md).",
    )  # fmt: skip


def _add_output(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--json", action="store_true", help="Print one JSON document on stdout.")
    parser.add_argument("--quiet", action="store_true", help="No progress.")


def build() -> argparse.ArgumentParser:
    """The whole grammar; parsed arguments carry `command` and, where a case is named, `case` and `case_*`.

    A problem file is named as if it were a case: `run crane.toml` is parsed as `run PROBLEM.toml crane.toml`.
    """
    top = _Parser(prog="planner", description="Plan a robot's motion, then prove the plan in MuJoCo.")
    top.add_argument("--version", action="store_true", help="Print versions and exit.")
    commands = top.add_subparsers(dest="command", metavar="COMMAND")

    def command(name: str, text: str) -> argparse.ArgumentParser:
        parser = commands.add_parser(name, help=text, description=text)
        parser.set_defaults(parser=parser)
        return parser

    def with_case(name: str, text: str) -> list[argparse.ArgumentParser]:
        parser = command(name, text)
        machines = parser.add_subparsers(dest="case", metavar="CASE", required=True)
        children = []
        for case, build_case in CASES.items():
            child = machines.add_parser(case, help=summary(build_case), description=f"{text} {summary(build_case)}")
            child.set_defaults(parser=child)
            _add_case(child, build_case)
            _add_solver(child)
            _add_rank(child)
            _add_objective(child)
            child.add_argument(
                "--control-limit", type=_number, default=None, metavar="X", help="Bound of all controls."
            )
            child.add_argument("--exact-goal", action="store_true", help="Meet the goal exactly, to 1e-4.")
            children.append(child)
        own = machines.add_parser(
            PROBLEM_FILE, help=_OWN, description=f"{text} {_OWN}", epilog=f"Its keys: {', '.join(problem_keys.KEYS)}."
        )
        own.set_defaults(parser=own)
        own.add_argument("problem", metavar="FILE", help="A problem.toml.")
        _add_solver(own)
        _add_rank(own)
        _add_objective(own)
        own.set_defaults(control_limit=None, exact_goal=False)
        return [*children, own]

    _add_output(command("list", "List the machines, what each shows and its parameters."))
    for parser in with_case("run", "Plan, prove, plot and film a case."):
        parser.add_argument("--no-refine", action="store_true", help="Do not refine a plan that fails.")
        _add_proof(parser, ", fewer where they would take more than 20 s")
        parser.add_argument("--no-video", action="store_true", help="No pictures that need OpenGL.")
        parser.add_argument("--out", default=None, metavar="DIR", help="Folder of the results. Default: renders/CASE.")
        _add_output(parser)
    for parser in with_case("solve", "Plan a case and save the plan."):
        parser.add_argument("--out", default="plan.npz", metavar="FILE", help="Default: plan.npz.")
        _add_output(parser)
    parser = command("prove", "Replay a stored plan in MuJoCo and judge it.")
    parser.add_argument("plan", metavar="PLAN", help="A plan.npz.")
    parser.add_argument("--mjcf", default=None, metavar="FILE", help="Replay in this model instead of the plan's own.")
    parser.add_argument("--out", default=None, metavar="FILE", help="Write the proof as JSON here.")
    _add_proof(parser)
    _add_case_of(parser)
    _add_output(parser)
    parser = command("render", "Film the replay of a stored plan.")
    parser.add_argument("plan", metavar="PLAN", help="A plan.npz.")
    parser.add_argument(
        "--out", default="video.mp4", metavar="FILE", help="*.mp4, or *.png for a strip. Default: video.mp4."
    )
    parser.add_argument("--size", type=_size, default=None, metavar="WxH", help="Pixels. Default: 1280x720.")
    parser.add_argument("--fps", type=_whole, default=60, metavar="N", help="Frames per second. Default: 60.")
    parser.add_argument("--speed", type=_number, default=None, metavar="X", help="Playback speed. Default: the case's.")
    _add_case_of(parser)
    _add_output(parser)
    parser = command("report", "Prove a stored plan again and write report.html with all its pictures.")
    parser.add_argument("plan", metavar="PLAN", help="A plan.npz.")
    parser.add_argument("--no-video", action="store_true", help="No pictures that need OpenGL.")
    parser.add_argument("--out", default="report", metavar="DIR", help="Folder of the results. Default: report.")
    _add_proof(parser)
    _add_output(parser)
    parser = command("check", "Prove stored plans again and compare with the figures stored beside them.")
    parser.add_argument("paths", metavar="DIR", nargs="+", help="Folders of plans, or plan files.")
    parser.add_argument("--update", action="store_true", help="Store the new figures.")
    parser.add_argument(
        "--tolerance", type=_number, default=0.05, metavar="X", help="Relative change that counts. Default: 0.05."
    )
    _add_output(parser)
    parser = command("paper", "Every figure and number of the paper beside ours.")
    names = ", ".join(study.name for study in STUDIES)
    parser.add_argument(
        "studies", metavar="STUDY", nargs="*", help=f"Some studies, each on a page of its own: {names}. Default: all."
    )
    parser.add_argument("--proofs", action="store_true", help="The table of proofs of all machines instead.")
    parser.add_argument(
        "--out", default=None, metavar="DIR",
        help="Folder of the results. Default: in a checkout docs and renders/gallery/paper, elsewhere paper; for some "
        "studies and for --proofs renders/paper.",
    )  # fmt: skip
    _add_output(parser)
    parser = command("warmup", "Compile the numerical core, once.")
    parser.add_argument("--all", action="store_true", help='Also what only hessian="exact" needs.')
    _add_output(parser)
    return top


def parse(argv: list[str]) -> argparse.Namespace:
    """Parsed arguments.

    Raises:
        PlannerError: Wrong usage, in one sentence that guesses what was meant.
    """
    if argv[:1] in (["run"], ["solve"]) and argv[1:]:
        ending = argv[1].lower()
        if ending.endswith(".toml"):
            argv = [argv[0], PROBLEM_FILE, *argv[1:]]
        elif ending.endswith((".xml", ".mjcf")):
            raise PlannerError(
                f"{argv[1]} is a model, expected a case ({', '.join(CASES)}) or a {PROBLEM_FILE} that names the model "
                "(see docs/own-machine.md)."
            )
    arguments, unknown = build().parse_known_args(argv)
    if not unknown:
        return arguments
    parser = getattr(arguments, "parser", None)
    where = parser.prog if parser is not None else "planner"
    word = unknown[0]
    known = [flag for action in parser._actions for flag in action.option_strings] if parser is not None else []
    near = difflib.get_close_matches(word.split("=")[0], known, n=1)
    hint = f" Did you mean {near[0]}?" if near else f" See {where} --help."
    kind = "flag" if word.startswith("-") else "argument"
    raise PlannerError(f"{where} knows no {kind} {word!r}.{hint}")
