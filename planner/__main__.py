"""The command line: `planner`, or `python -m planner`.

Exit codes: 0 done (and PASS, where a proof ran), 1 not converged or FAIL (files still written), 2 wrong usage or
input, 70 an error of the planner itself, 130 interrupted outside of a solve (a solve keeps its best plan so far).
"""

from __future__ import annotations

import atexit
import gc
import os
import signal
import sys
import threading
from _thread import interrupt_main
from collections.abc import Sequence
from typing import Any, NoReturn

_done: list[int] = []  # the exit code of this process, once its command has written all


def _end() -> None:
    """End the process as it is: to take apart all that was imported takes a fifth of a short command's time."""
    if not _done:
        return
    for stream in filter(None, (sys.stdout, sys.stderr)):
        try:
            stream.flush()
        except (OSError, ValueError):
            return  # Python says so, and ends with another code
    os._exit(_done[0])


if not atexit._ncallbacks():  # what is registered first runs after all others; else Python ends as ever
    atexit.register(_end)


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code."""
    before = signal.getsignal(signal.SIGINT)
    if before is signal.default_int_handler:  # packages turn an interruption of their import into errors of their own
        signal.signal(signal.SIGINT, _leave)
    try:
        from planner.cli.commands import command
    finally:
        signal.signal(signal.SIGINT, before)
    return command(list(sys.argv[1:] if argv is None else argv))


def run() -> NoReturn:
    """Run the command of this process, which has nothing to do after it."""
    gc.disable()  # until the command is imported, see commands: no garbage is found in what stays
    sys.unraisablehook = _unraisable
    _done.append(main())
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # all is written: Ctrl-C may end the rest
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    sys.exit(_done[0])


def _unraisable(ignored: Any) -> None:
    """Interrupt again where Python has to ignore it, since it fell into the callback of a weak reference."""
    if ignored.exc_type is KeyboardInterrupt:
        threading.Timer(0.05, interrupt_main).start()  # s: here it would be ignored as well
    else:
        sys.__unraisablehook__(ignored)


def _leave(*_: object) -> NoReturn:
    os.write(2, b"planner: interrupted; nothing was written.\n")
    os._exit(130)


if __name__ == "__main__":
    run()
