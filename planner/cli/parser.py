"""The commands of the command line and their flags, and a script that lets a shell complete them.

Flags are added to those commands alone that are asked for, because cases and solver take half a second to import.
"""

from __future__ import annotations

import argparse
import difflib
import re
from collections.abc import Callable, Container
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any, NoReturn

from planner.base.arguments import choice, short_repr
from planner.base.errors import PlannerError
from planner.cli.console import Console
from planner.cli.flags import (
    BUDGET,
    COMMON,
    IMPORTS,
    LOOKS,
    NO_VIDEO,
    PROBLEM_FILE,
    PROOF,
    ROLLOUT,
    WORKERS,
    Flags,
    add,
    boolean_flag,
    counted,
    natural,
    number,
    value_flag,
    value_of,
    whole,
)

SHELLS = ("bash", "zsh", "tcsh")
"""Shells that completion is written for."""
FORMATS = {"csv": ".csv", "json": ".json", "yaml": ".yaml", "keyframes": ".keys.xml"}
"""Ending of the file of each form of export."""

_PLAN: Flags = {"plan": {"metavar": "PLAN", "help": "A plan.npz."}}
_DRIVE: Flags = {
    "--push": {"action": "append", "metavar": "BODY=FORCE@TIME", "default": [],
               "help": "A push: torso=50N@1.0s is along x, torso=0,50,0N@1.0s/0.2s lasts 0.2 s. May be repeated."},
    "--latency": value_flag("TIME", "From the measurement until the new plan acts, e.g. 4ms. Default: what its "
                                    "calls take here, rounded up."),
    "--rate": value_flag("HZ", "Plans per second. Default: one per stage, or as many as its calls allow.", kind=number),
    "--iterations": value_flag("N", "Iterations of each plan.", 1, counted),
    "--stages": value_flag("N", "Stages that each plan looks ahead. Default: those of the problem.", kind=counted),
    "--seconds": value_flag("S", "Length of the run. Default: the task's and two seconds more.", kind=number),
    "--mass-error": value_flag("X", "All bodies are heavier by this share, e.g. 0.2.", 0.0, number),
    "--joint-friction": value_flag("X", "Dry friction in each joint, as a share of its largest force.", 0.0, number),
    "--noise": value_flag("X", "Standard deviation of the noise on each measured number.", 0.0, number),
    "--encoders": boolean_flag("Measure positions by encoders of 17 bits, and speeds by their differences."),
    "--robustness-map": {"metavar": "BODY", "help": "Also find the largest push at this body, the largest latency "
                                                    "and the largest "
                                         "mass with which it still arrives, beside the plan with its gains alone."},
}  # fmt: skip
_SWEEP: Flags = {
    "--set": {"action": "append", "metavar": "NAME=VALUES", "required": True,
              "help": "Values of a parameter: a range START:STOP:COUNT, e.g. height=1:60:60, or a list, e.g. "
                      "duration=0.8,1. A problem file's parameters are its keys, e.g. weights.effort=0.1,1. Given "
                      "several times: all combinations."},
    "--out": value_flag("DIR", "Folder of the table, the plans and the page. Default: renders/sweep-CASE."),
    "--continuation": value_flag("NAME", "Start each problem from the controls of its neighbour along this parameter.")
                  | {"dest": "along"},
    "--timeout": value_flag("S", "Longest time of one solve, s.", kind=number),
    "--prove": boolean_flag("Prove each plan."),
    "--rollouts": value_flag("N", "Number of perturbed simulations of each proof.", 0, natural),
    "--resume": boolean_flag("Go on with the sweep in the folder: tasks without a row, tasks that lost their "
                             "worker, and, if --timeout is longer now, tasks that took too long."),
}  # fmt: skip


class _Parser(argparse.ArgumentParser):
    """An ArgumentParser that raises a PlannerError instead of printing the usage and exiting."""

    def __init__(self, **options: Any) -> None:
        layout = partial(argparse.HelpFormatter, max_help_position=32, width=110)
        super().__init__(allow_abbrev=False, formatter_class=layout, **options)

    def format_help(self) -> str:
        """The help, with the flags that all machines of the command share."""
        shared, text = self.get_default("shared"), super().format_help()
        if shared is None:
            return text
        formatter = self._get_formatter()
        formatter.start_section("flags of every CASE, after its name")
        formatter.add_arguments(shared)
        formatter.end_section()
        return f"{text}\n{formatter.format_help()}"

    def error(self, message: str) -> NoReturn:
        """Raise the message, with the choices of the arguments that it names."""
        for action in self._actions:
            for name in (action.option_strings or [str(action.metavar)]) if action.choices is not None else ():
                told = f"{name} (one of: {', '.join(action.choices or ())})"
                message = re.sub(rf"(?<![\w-]){re.escape(name)}(?![\w-])", lambda _, told=told: told, message)
        raise PlannerError(f"{message.removeprefix('argument ').rstrip('.')} (see {self.prog} --help).")

    def _get_values(self, action: argparse.Action, arg_strings: list[str]) -> Any:
        if arg_strings == ["--"] and action.option_strings:  # argparse would drop it, and then miss it
            raise argparse.ArgumentError(action, "expected another value than '--'")
        return super()._get_values(action, arg_strings)  # type: ignore[misc]

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        if action.choices is not None:
            choice("/".join(action.option_strings) or str(action.metavar), value, tuple(action.choices))


def _list(parser: argparse.ArgumentParser) -> None:
    help = f"A machine, to see its flags, or {PROBLEM_FILE}, to see the keys of a problem file."
    add(parser, {"machine": {"metavar": "NAME", "nargs": "?", "help": help}}, COMMON)


def _model(parser: argparse.ArgumentParser) -> None:
    add(
        parser,
        {"model": {"metavar": "FILE", "help": "An MJCF or URDF file."},
         "--write": value_flag("FILE", "Also write a problem file to start from, which runs as it is."),
         "--package-path": value_flag("DIR", "Folder of the packages that a URDF names."),
         "--out": value_flag("DIR", "Folder of the picture of its keyframes. Default: renders/MODEL or /TOML."),
         "--no-picture": boolean_flag("Draw no picture (drawing needs OpenGL).")},
        COMMON,
    )  # fmt: skip


def _with_cases(*groups: Flags) -> Callable[[argparse.ArgumentParser], None]:
    def add_flags(parser: argparse.ArgumentParser) -> None:
        from planner.cli.case_flags import add_cases

        add_cases(parser, *groups)

    return add_flags


def _prove(parser: argparse.ArgumentParser) -> None:
    engines = value_of("planner.proof.engines", "ENGINES")
    add(
        parser,
        {"plan": {"metavar": "PLAN", "nargs": "?", "help": "A plan.npz; leave it out with --controls."},
         "--controls": value_flag("FILE", "Instead of a plan: a CSV of times and controls, or of joint positions; or "
                                          "joint positions of a ROS bag or a LeRobot data set."),
         "--part": value_flag("PART", "With --controls, topic of a bag or episode of a data set; where several are."),
         "--degrees": boolean_flag("With --controls, the file has degrees."),
         "--model": value_flag("FILE", "Replay in this MJCF or URDF, not in the plan's own; with --controls, the model "
                                       "of the controls."),
         "--start": value_flag("STATE", "With --controls, the start: a keyframe, numbers 0,1.57 or joints elbow=0.3."),
         "--goal": value_flag("STATE", "With --controls, the goal, in the same form."),
         "--save": value_flag("FILE", "With --controls, save them as a plan, e.g. for planner render."),
         "--feasible": boolean_flag("Judge feasibility alone: a solve that did not converge may pass.")},
        {"--engine": {"action": "append", "metavar": "NAME", "choices": engines, "default": [],
                      "help": f"Also repeat the plan in {' or '.join(engines)}. May be given twice."},
         "--plot": value_flag("FILE", "Draw plan or recording and its replays over time into this picture."),
         "--out": value_flag("FILE", "Write the proof to this JSON file.")}, PROOF, ROLLOUT, WORKERS, IMPORTS, COMMON,
    )  # fmt: skip


def _render(parser: argparse.ArgumentParser) -> None:
    add(
        parser, _PLAN,
        {"--out": value_flag("FILE", "The name of a film, .mp4, .gif or .apng, or of a strip of poses, .png.",
                             "video.mp4"),
         "--fps": value_flag("N", "Frames per second.", 30, counted),
         "--speed": value_flag("X", "Playback speed, e.g. 0.25. Default: the case's.", kind=number)},
        LOOKS, ROLLOUT, IMPORTS, COMMON,
    )  # fmt: skip


def _view(parser: argparse.ArgumentParser) -> None:
    add(
        parser,
        {"plan": {"metavar": "PLAN", "help": "A plan.npz, or a folder of planner run."},
         "--rollouts": value_flag("N", "Number of perturbed simulations that key 7 shows.", 8, natural),
         "--browser": boolean_flag("Play it in a browser instead, drag the goal there and plan again."),
         "--port": value_flag("N", "With --browser, port of this machine.", 8080, whole),
         "--speed": value_flag("X", "Playback speed, e.g. 0.25. Default: the case's.", kind=number)}, IMPORTS, COMMON,
    )  # fmt: skip


def _report(parser: argparse.ArgumentParser) -> None:
    add(
        parser, _PLAN, NO_VIDEO, LOOKS,
        {"--out": value_flag("DIR", "Folder of the results.", "report"),
         "--files": boolean_flag("Only list what is packed into the plan; prove and write nothing.")},
        PROOF, IMPORTS, COMMON,
    )  # fmt: skip


def _export(parser: argparse.ArgumentParser) -> None:
    parts = value_of("planner.problem.export", "PARTS")
    add(
        parser, _PLAN,
        {"--to": {"choices": FORMATS, "required": True,
                  "help": "csv: a table; json, yaml: ROS 2's JointTrajectory; keyframes: an MJCF to include."},
         "--rate": value_flag("HZ", "Samples per second. Default: the plan's own knots.", kind=number),
         "--only": {"choices": parts, "help": "Write only these columns of a csv. Default: both."},
         "--out": value_flag("FILE", "The file to write. Default: PLAN with the ending of the format.")},
        IMPORTS, COMMON,
    )  # fmt: skip


def _check(parser: argparse.ArgumentParser) -> None:
    add(
        parser,
        {"paths": {"metavar": "DIR", "nargs": "+", "help": "Folders of plans, or plan files."},
         "--update": boolean_flag("Store the new numbers where they differ, and accept a changed model."),
         "--model": value_flag("FILE", "Compare the plans' models with this MJCF or URDF. Default: the file that each "
                                       "was made from, if it is in the plan's folder."),
         "--tolerance": value_flag("X", "Report numbers whose relative change is larger.", 0.05, number)},
        WORKERS, IMPORTS, COMMON,
    )  # fmt: skip


def _paper(parser: argparse.ArgumentParser) -> None:
    from planner.paper.studies.page import STUDIES

    names = ", ".join(study.name for study in STUDIES)
    add(
        parser,
        {"studies": {"metavar": "STUDY", "nargs": "*",
                     "help": f"Studies to compute, each on a page of its own: {names}. Default: all."},
         "--proofs": boolean_flag("Write the table of proofs of all machines instead."),
         "--full": boolean_flag("Compute the numbers of the documents, with more random starts and arms."),
         "--out": value_flag("DIR", "Folder of the results. Default: paper, with --full in a checkout docs and "
                                    "renders/gallery/paper; for single studies and for --proofs renders/paper.")},
        WORKERS, COMMON,
    )  # fmt: skip


def _completion(parser: argparse.ArgumentParser) -> None:
    add(parser, {"shell": {"choices": SHELLS, "metavar": "SHELL", "help": f"One of {', '.join(SHELLS)}."}}, COMMON)


def _warmup(parser: argparse.ArgumentParser) -> None:
    add(parser, {"--all": boolean_flag("Also compile the kernels that only --hessian exact needs.")}, COMMON)


COMMANDS: dict[str, tuple[str, str, Callable[[argparse.ArgumentParser], None]]] = {
    "list": ("case_flags.list_cases", "List the machines, a line each, or the flags of one.", _list),
    "model": ("describing.describe_model",
              "Describe a model of your own: its joints, actuators and contacts, and what looks wrong.", _model),
    "run": ("running.run", "Plan, prove, plot and film a case or a problem file.", _with_cases(
        {"--no-refine": boolean_flag("Do not solve a failed plan again at a finer step.")}, BUDGET, PROOF, NO_VIDEO,
        LOOKS, {"--out": value_flag("DIR", "Folder of the results. Default: renders/CASE.")}, WORKERS)),
    "drive": ("driving.drive", "Plan again and again in the loop with MuJoCo, and judge the loop.", _with_cases(
        _DRIVE, NO_VIDEO, {"--out": value_flag("DIR", "Folder of the results. Default: renders/CASE-loop.")})),
    "solve": ("solving.solve_case", "Plan a case or a problem file and save the plan.", _with_cases(
        {"--out": value_flag("FILE", "The plan's file.", "plan.npz")}, WORKERS)),
    "sweep": ("solving.sweep_case", "Plan a case or a problem file at many parameters, into one table.",
              _with_cases(_SWEEP, WORKERS)),
    "prove": ("proving.prove_plan", "Replay a stored plan, or controls of your own, in MuJoCo and judge them.", _prove),
    "render": ("plan_commands.render_plan", "Film the replay of a stored plan.", _render),
    "view": ("plan_commands.view_plan", "Look at a stored plan in MuJoCo's viewer or in a browser.", _view),
    "report": ("plan_commands.report_plan",
               "Prove a stored plan again and write report.html with all its pictures.", _report),
    "export": ("plan_commands.export_plan", "Write a stored plan for other programs.", _export),
    "check": ("proving.check_plans",
              "Prove stored plans again and compare with the numbers stored beside them.", _check),
    "paper": ("paper.paper", "Compute every figure and number of the paper and show it beside the paper's.", _paper),
    "completion": ("parser.print_completion", "Print a script that lets a shell complete commands and flags.",
                   _completion),
    "warmup": ("solving.warmup", "Compile the numerical core now, so that the first run need not.", _warmup),
}  # fmt: skip
"""By name a command's function, as FILE.NAME of this folder, its text and what adds its flags.

Only the file of the command that is run is imported: that saves 0.3 s.
"""


def build(words: Container[str] | None = None) -> argparse.ArgumentParser:
    """All commands, with the flags of those among some words; None stands for all of them.

    Parsed arguments have `command` and, where a case is named, `case` and `case_*`. A problem file is parsed as a case:
    `run crane.toml` as `run PROBLEM.toml crane.toml`.
    """
    top = _Parser(prog="planner", description="Plan a robot's motion, then prove the plan in MuJoCo.")
    top.add_argument("--version", action="store_true", help="Print versions and exit.")
    commands = top.add_subparsers(dest="command", metavar="COMMAND")
    for name, (_, text, add_flags) in COMMANDS.items():
        parser = commands.add_parser(name, help=text, description=text)
        parser.set_defaults(parser=parser)
        if words is None or name in words:
            add_flags(parser)
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
            written = f"{Path(argv[1]).stem}.toml"
            raise PlannerError(
                f"{argv[1]} is a model, expected a problem file: `planner model {argv[1]} --write {written}` writes "
                f"one, then `planner {argv[0]} {written}`."
            )
    arguments, unknown = build(argv).parse_known_args(argv)
    if not unknown:
        return arguments
    parser = getattr(arguments, "parser", None)
    where = parser.prog if parser is not None else "planner"
    word = unknown[0]
    known = [flag for action in parser._actions for flag in action.option_strings] if parser is not None else []
    key = word.split("=")[0].lstrip("-")
    near = difflib.get_close_matches(key, [flag.lstrip("-") for flag in known], n=1)  # dashes make all flags alike
    hint = f"Did you mean --{near[0]}?" if near else f"See {where} --help."
    if getattr(arguments, "case", None) == PROBLEM_FILE:
        keys = value_of("planner.cases.problem_file.keys", "KEYS")
        if (named := key.replace("-", "_")) in keys:
            hint = f"{named} is a key of the file: write it in {arguments.problem}."
    kind = "flag" if word.startswith("-") else "argument"
    raise PlannerError(f"{where!r} has no {kind} {short_repr(word)}. {hint}")


def print_completion(arguments: argparse.Namespace, console: Console) -> int:
    """Print the script with which a shell completes commands, machines and flags. shtab writes it.

    It knows every word by itself, so a key press does not start Python. Files are completed where no word fits, so that
    `planner run reach.toml` is too.
    """
    try:
        shtab = import_module("shtab")
    except ImportError:
        raise PlannerError(
            "shtab is not installed, expected it for completion: pip install slq-planner[completion]."
        ) from None
    parser = build()
    for action in _subcommands(parser):
        for command in action.choices.values():
            for machines in _subcommands(command):
                machines.choices.pop(PROBLEM_FILE, None)  # it stands for a file, and nobody types it
                machines._choices_actions = [one for one in machines._choices_actions if one.dest != PROBLEM_FILE]
    script = shtab.complete(parser, shell=arguments.shell)
    if arguments.shell == "bash":  # files, where no word fits
        script = re.sub(r"^complete -o", "complete -o default -o", script, flags=re.M)
    console.write_result(script)
    return console.finish("completion", 0, shell=arguments.shell, script=script)


def _subcommands(parser: argparse.ArgumentParser) -> list[argparse._SubParsersAction]:
    return [action for action in parser._actions if isinstance(action, argparse._SubParsersAction)]
