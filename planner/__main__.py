"""The command line: `planner`, or `python -m planner`.

Exit codes: 0 done (and PASS, where a proof ran), 1 not converged or FAIL (files still written), 2 wrong usage or
input, 70 an error of the planner itself, 130 interrupted outside of a solve (a solve keeps its best plan so far).
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Sequence
from typing import NoReturn


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code."""
    before = signal.getsignal(signal.SIGINT)
    if before is signal.default_int_handler:  # packages turn an interruption of their import into errors of their own
        signal.signal(signal.SIGINT, _leave)
    try:
        from planner.cli.commands import command
    finally:
        signal.signal(signal.SIGINT, before)
    code = command(list(sys.argv[1:] if argv is None else argv))
    if (
        argv is None and before is signal.default_int_handler
    ):  # all is written: Ctrl-C ends the rest without a traceback
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    return code


def _leave(*_: object) -> NoReturn:
    os.write(2, b"planner: interrupted; nothing was written.\n")
    os._exit(130)


if __name__ == "__main__":
    sys.exit(main())
