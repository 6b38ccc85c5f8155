"""The command `completion`: a script that lets a shell complete commands, machines and flags. shtab writes it.

The script knows every word by itself, so a key press does not start Python. Files are completed where no word fits, so
that `planner run reach.toml` is too.
"""

from __future__ import annotations

import argparse
import re
from importlib import import_module

from planner.base.errors import PlannerError
from planner.cli.console import Console
from planner.cli.flags import PROBLEM_FILE
from planner.cli.parser import build


def print_completion(arguments: argparse.Namespace, console: Console) -> int:
    """Print the completion script of a shell."""
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
