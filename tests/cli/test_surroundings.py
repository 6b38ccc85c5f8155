"""Commands where the home is missing, a disk is full or nobody reads what they print."""

import os
import subprocess
import sys
import time

import pytest
from commands import PLANNER, launch, refused, run

import planner
from planner.cli import commands as cli_commands
from planner.cli.console import Console
from planner.kernels.numba import jit

LIMITED = (
    "import resource, signal, sys; signal.signal(signal.SIGXFSZ, signal.SIG_IGN);"
    "sys.dont_write_bytecode = True;"  # a module that is cut off there would break the next import
    "resource.setrlimit(resource.RLIMIT_FSIZE, ({0}, {0}));"
    "from planner.__main__ import main; sys.exit(main(sys.argv[1:]))"
)
"""A command that cannot write files of more than so many bytes, which stands in for a full disk."""


def test_a_failed_run_leaves_older_results_alone(finished, tmp_path):
    folder, _ = finished
    for name in ("plan.npz", "proof.json"):
        (tmp_path / name).write_bytes((folder / "out" / name).read_bytes())
    (tmp_path / "notes.txt").write_text("mine")
    before = {p.name: p.read_bytes() for p in tmp_path.iterdir()}
    refused(run("run", "hopper", "--height", "-1", "--out", tmp_path, cwd=tmp_path), "height")
    words = ["run", "two-link", "--no-video", "--quiet", "--rollouts", "0", "--out", str(tmp_path)]
    command = [sys.executable, "-c", LIMITED.format(12000), *words]  # the plan is larger than that
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 2, done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
    assert {p.name: p.read_bytes() for p in tmp_path.iterdir()} == before


def test_a_pipe_that_closes_early_is_no_error(tmp_path):
    code = f"{sys.executable} -m planner list | head -n 1"
    done = subprocess.run(["sh", "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert done.stdout.count("\n") == 1
    assert done.stderr == ""


@pytest.mark.slow
def test_without_a_writable_home_it_compiles_for_itself(tmp_path):
    """Compiles for this process only, and says that it compiles."""
    environment = {k: v for k, v in os.environ.items() if k not in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME")}
    done = launch(
        "solve", "hopper", "--quiet", "--out", "p.npz", cwd=tmp_path, env=environment | {"HOME": "/proc/nowhere"}
    )
    assert done.returncode == 0, done.stderr
    assert "first run only" in done.stderr


def test_a_full_stdout_exits_2_and_keeps_the_files(tmp_path):
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [*PLANNER, "solve", "two-link", "--horizon", "40", "--quiet", "--out", "p.npz"],
            cwd=tmp_path, stdout=full, stderr=subprocess.PIPE, text=True, timeout=300,
        )  # fmt: skip
    assert done.returncode == 2
    assert "could not be printed" in done.stderr
    assert "Traceback" not in done.stderr
    assert planner.load_plan(tmp_path / "p.npz").success


@pytest.mark.parametrize(
    ("words", "code"),
    [(["list"], 0), ([], 0), (["run", "--help"], 0), (["fly"], 2),
     pytest.param(["solve", "two-link", "--horizon", "40", "--quiet", "--out", "p.npz"], 0, marks=pytest.mark.slow)],
    ids=lambda value: " ".join(value) if isinstance(value, list) else None,
)  # fmt: skip
def test_nobody_needs_to_listen(tmp_path, words, code):
    """With stdout closed, then all three: no traceback, the usual exit code, and the work is done."""
    quiet = subprocess.run(["sh", "-c", 'exec "$@" >&-', "sh", *PLANNER, *words], cwd=tmp_path, stderr=subprocess.PIPE)
    silent = subprocess.run(["sh", "-c", 'exec "$@" <&- >&- 2>&-', "sh", *PLANNER, *words], cwd=tmp_path)
    assert (quiet.returncode, silent.returncode) == (code, code)
    assert b"Traceback" not in quiet.stderr
    if words[:1] == ["solve"]:
        assert planner.load_plan(tmp_path / "p.npz").success


@pytest.mark.slow
def test_a_full_disk_of_the_cache_is_not_taken_for_that_of_the_plan(tmp_path):
    """Machine code that cannot be kept is used all the same: files of more than 20 kB, which the plan is not."""
    words = ["solve", "two-link", "--horizon", "40", "--quiet", "--out", "p.npz"]
    done = subprocess.run(
        [sys.executable, "-c", LIMITED.format(20000), *words], cwd=tmp_path, capture_output=True, text=True,
        timeout=300, env=os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "cache")},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert planner.load_plan(tmp_path / "p.npz").success
    assert all(file.stat().st_size <= 20000 for file in (tmp_path / "cache").rglob("*.nbc"))


def test_who_waited_for_a_kernel_does_not_wait_for_the_rest(monkeypatch, tmp_path):
    """At a terminal the rest of the core is compiled in the background; a script, and a warm cache, start nothing."""
    started = []
    monkeypatch.setattr(cli_commands.subprocess, "Popen", lambda words, **options: started.append(words))
    monkeypatch.setattr(jit, "cache_directory", lambda: tmp_path)
    console = Console()
    (tmp_path / "kernel.nbc").touch()
    for live, began in ((False, 0.0), (True, time.time() + 60.0), (True, 0.0)):
        console.live = live
        cli_commands._compile_the_rest(console, began)
    (words,) = started
    assert words[-2:] == ["warmup", "--quiet"]


ENDING = """
import atexit, sys
from planner.__main__ import run
class Loud:
    def __del__(self):
        print("taken apart")
loud = Loud()
atexit.register(print, "at exit", end="")
sys.argv = ["planner", "list", *sys.argv[1:]]
run()
"""


def test_a_command_ends_without_taking_apart_what_was_imported():
    """That takes a fifth of a short command; what is printed is there, and functions registered for the end run."""
    for words, code, last in ([], 0, "at exit"), (["hoper"], 2, "at exit"):
        done = subprocess.run([sys.executable, "-c", ENDING, *words], capture_output=True, text=True, timeout=60)
        assert (done.returncode, done.stdout.splitlines()[-1]) == (code, last), done.stderr
