"""The command line: `planner`, or `python -m planner`.

Exit codes: 0 done (and PASS, where a proof ran), 1 not converged or FAIL (files still written), 2 wrong usage or
input, 70 an error of the planner itself, 130 interrupted outside of a solve (a solve keeps its best plan so far).
"""

from __future__ import annotations

import os
import signal
import sys
<<<<<<< HEAD
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from planner.base.errors import PlannerError
from planner.base.versions import installed_versions
from planner.cli.console import Console

_INTERRUPTED = "interrupted; nothing was written."
=======
from collections.abc import Sequence
from typing import NoReturn
>>>>>>> v-a


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code."""
    before = signal.getsignal(signal.SIGINT)
    if before is signal.default_int_handler:  # packages turn an interruption of their import into errors of their own
        signal.signal(signal.SIGINT, _leave)
    try:
<<<<<<< HEAD
        with _left_at_once(console):
            parser, commands = _commands()
        arguments = parser.parse(words)
        if arguments.version:
            console.say("  ".join(f"{name} {version}" for name, version in installed_versions().items()))
            return 0
        if arguments.command is None:
            parser.build().print_help()
            return 0
        code = commands[arguments.command](arguments, console)
        if console.lost:
            console.complain(f"the results could not be printed: {console.lost}.")
            return 2
        return code
    except PlannerError as error:
        return _refuse(console, str(error), 2)
    except MemoryError:
        return _refuse(console, "there is not enough memory for this problem, expected a shorter horizon.", 2)
    except KeyboardInterrupt:
        return _refuse(console, _INTERRUPTED, 130)


def _commands() -> tuple[Any, dict[str, Callable[..., int]]]:
    """The parser and the commands, whose libraries take a second to be imported."""
    from planner.cli import checking, compiling, listing, paper, parser, proving, rendering, reporting, running, solving

    return parser, {
        "list": listing.list_cases, "run": running.run, "solve": solving.solve_case, "prove": proving.prove_plan,
        "render": rendering.render_plan, "report": reporting.report_plan, "check": checking.check_plans,
        "paper": paper.paper, "warmup": compiling.warmup,
    }  # fmt: skip


@contextmanager
def _left_at_once(console: Console) -> Iterator[None]:
    """Have Ctrl-C end the process while it imports: some libraries swallow the exception, others print a traceback."""

    def leave(*_: object) -> None:
        os._exit(_refuse(console, _INTERRUPTED, 130))

    usual = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if usual:
        signal.signal(signal.SIGINT, leave)
    try:
        yield
    finally:
        if usual:
            signal.signal(signal.SIGINT, signal.default_int_handler)
=======
        from planner.cli.commands import command
    finally:
        signal.signal(signal.SIGINT, before)
    return command(list(sys.argv[1:] if argv is None else argv))
>>>>>>> v-a


def _leave(*_: object) -> NoReturn:
    os.write(2, b"planner: interrupted; nothing was written.\n")
    os._exit(130)


if __name__ == "__main__":
    sys.exit(main())
