"""The command line, in this process or in one of its own, and what a refusal looks like."""

import contextlib
import io
import subprocess
import sys

from planner.__main__ import main

PLANNER = [sys.executable, "-m", "planner"]
# The two-link arm in a third of its time, with weights that still bring it to its goal: a proof takes a third, too.
QUICK_ARM = {"duration": 0.6, "horizon": 30, "position_weight": 2e3, "velocity_weight": 2e3}
ARM = ["two-link", *(word for name, value in QUICK_ARM.items() for word in (f"--{name.replace('_', '-')}", str(value)))]


def without_rollouts(words):
    """A command line without the perturbed rollouts (test_run.py has them)."""
    if words and words[0] in ("run", "prove", "report") and "--rollouts" not in words and len(words) > 2:
        words = (*words, "--rollouts", 0)
    return [str(word) for word in words]


def run(*words, cwd):
    """The command in this process."""
    words, out, err = without_rollouts(words), io.StringIO(), io.StringIO()
    with contextlib.chdir(cwd), contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code = main(words)
        except SystemExit as end:  # --help
            code = end.code
    return subprocess.CompletedProcess(words, code, out.getvalue(), err.getvalue())


def launch(*words, cwd, **options):
    """The command in a process of its own."""
    command = [*PLANNER, *without_rollouts(words)]
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True, timeout=300, **options)


def refused(done, *fragments):
    """Exit 2, one sentence, no traceback, nothing on stdout."""
    assert done.returncode == 2, done.stderr
    lines = done.stderr.strip().splitlines()
    assert len(lines) == 1, done.stderr
    assert lines[0].startswith("planner: ")
    assert done.stdout == ""
    for fragment in fragments:
        assert fragment in lines[0], lines[0]
