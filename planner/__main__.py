"""The command line: `planner`, or `python -m planner`.

Exit codes: 0 done (and PASS, where a proof ran), 1 not converged or FAIL (files still written), 2 wrong usage or
input, 130 interrupted outside of a solve (a solve keeps its best plan so far).
"""

from __future__ import annotations

import signal
import sys
from collections.abc import Sequence

from planner.commands import about, paper, parser, plans
from planner.console import Console
from planner.errors import PlannerError

_COMMANDS = {
    "list": about.list_cases, "warmup": about.warmup, "run": plans.run, "solve": plans.solve_case,
    "prove": plans.prove_plan, "render": plans.render_plan, "report": plans.report_plan, "paper": paper.paper,
}  # fmt: skip


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code."""
    # A kill must clean up like an exception: no hidden folders are left behind.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    words = list(sys.argv[1:] if argv is None else argv)
    console = Console(as_json="--json" in words, quiet="--quiet" in words)
    try:
        arguments = parser.parse(words)
        if arguments.version:
            return about.versions(console)
        if arguments.command is None:
            parser.build().print_help()
            return 0
        return _COMMANDS[arguments.command](arguments, console)
    except PlannerError as error:
        console.complain(str(error))
        console.document({"error": str(error), "exit_code": 2})
        return 2
    except MemoryError:
        console.complain("there is not enough memory for this problem, expected a shorter horizon.")
        return 2
    except BrokenPipeError:  # the reader of our output went away, e.g. `planner list | head`
        sys.stderr.close()
        return 1
    except KeyboardInterrupt:
        console.complain("interrupted; nothing was written.")
        return 130


if __name__ == "__main__":
    sys.exit(main())
