"""Ctrl-C, kills and two commands at once: nothing is half-written, and the same command goes on."""

import json
import os
import random
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from commands import ARM as QUICK
from commands import PLANNER, refused, run
from PIL import Image

import planner
from planner.cli.results import OUTPUTS
from planner.cli.running import MARK, ROLLOUTS

ARM = ["run", "two-link", "--horizon", "100", "--no-video", "--quiet"]


LONG = ["hopper", "--height", "50", "--smoothing", "1e-4", "--horizon", "4000", "--integrator", "euler",
        "--max-iterations", "1000000"]  # fmt: skip
"""A problem that needs thousands of iterations, so that signals arrive while it runs."""


def start(words, cwd):
    command = [*PLANNER, *words]
    return subprocess.Popen(command, cwd=cwd, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def started(words, cwd):
    """The command in the tenth iteration of its solve."""
    child = start(words, cwd)
    assert child.stderr is not None
    for line in child.stderr:
        if line.strip().startswith("9 "):
            break
    return child


def wait_for(file, child, seconds=120.0):
    until = time.monotonic() + seconds
    while not file.exists():
        assert time.monotonic() < until
        assert child.poll() is None, child.communicate()
        time.sleep(0.02)


def test_ctrl_c_keeps_the_best_plan(tmp_path):
    child = started(["solve", *LONG, "--out", "p.npz"], tmp_path)
    try:
        child.send_signal(signal.SIGINT)
        out, _ = child.communicate(timeout=60)
    finally:
        child.kill()
    assert child.returncode == 1, out
    plan = planner.load_plan(tmp_path / "p.npz")
    assert plan.status is planner.Status.INTERRUPTED
    assert plan.cost < plan.history[0].cost
    assert plan.problem is not None
    assert plan.cost == pytest.approx(plan.problem.cost.value(plan.xs, plan.us), rel=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("kill", [signal.SIGKILL, signal.SIGINT])
def test_a_killed_run_keeps_what_was_finished_and_is_resumed(tmp_path, kill):
    """Killed among its rollouts: plan and proof are there, and the same command does the rest and no more."""
    words = [*ARM, "--rollouts", "64", "--json", "--out", "o"]
    folder = tmp_path / "o"
    child = start(words, tmp_path)
    wait_for(folder / ROLLOUTS, child)
    os.kill(child.pid, kill)
    child.communicate(timeout=60)
    assert child.returncode != 0
    assert (folder / MARK).is_file()
    before = (folder / "plan.npz").read_bytes()
    assert json.loads((folder / "proof.json").read_text())["verdict"] == "PASS"

    done = start(words, tmp_path)
    out, err = done.communicate(timeout=300)
    assert done.returncode == 0, err
    resumed = json.loads(out)
    assert resumed["resumed"]
    assert (folder / "plan.npz").read_bytes() == before
    assert not (folder / MARK).exists()
    assert not (folder / ROLLOUTS).exists()

    whole = start([*words[:-1], "whole"], tmp_path)
    out, err = whole.communicate(timeout=300)
    assert whole.returncode == 0, err
    fresh = json.loads(out)
    assert not fresh["resumed"]
    assert fresh["proof"]["monte_carlo"] == resumed["proof"]["monte_carlo"]  # as if it had never been interrupted


@pytest.mark.parametrize("kill", [signal.SIGTERM, pytest.param(signal.SIGHUP, marks=pytest.mark.slow)])
def test_a_kill_leaves_nothing_half_written(tmp_path, kill):
    child = started(["run", *LONG, "--no-video", "--out", "o"], tmp_path)
    child.send_signal(kill)
    child.communicate(timeout=60)
    assert child.returncode == 128 + kill
    assert list(tmp_path.iterdir()) == []


def test_two_runs_do_not_write_into_one_folder(tmp_path):
    """The second one is refused; when the first is killed, the folder is free at once."""
    other = ["run", *QUICK, "--no-video", "--quiet", "--rollouts", "0", "--out", "o"]
    first = started(["run", *LONG, "--no-video", "--out", "o"], tmp_path)
    try:
        refused(run(*other, cwd=tmp_path), "'o'", "another planner is writing into it")
        assert first.poll() is None
    finally:
        first.kill()
        first.communicate(timeout=60)
    assert run(*other, cwd=tmp_path).returncode == 0
    assert {file.name for file in (tmp_path / "o").iterdir()} <= set(OUTPUTS)


def test_ctrl_c_while_libraries_are_imported_is_one_sentence(tmp_path):
    code = (
        "import sys, time, types; slow = types.ModuleType('numpy');"
        "sys.meta_path.insert(0, type('Slow', (), {'find_spec': staticmethod(lambda name, path=None, target=None:"
        " (print('importing', flush=True), time.sleep(60)) and None if name == 'numpy' else None)}));"
        "from planner.__main__ import main; sys.exit(main(['list']))"
    )
    child = subprocess.Popen(
        [sys.executable, "-c", code], cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert child.stdout is not None
    assert child.stdout.readline() == "importing\n"
    child.send_signal(signal.SIGINT)
    _, err = child.communicate(timeout=60)
    assert (child.returncode, err) == (130, "planner: interrupted; nothing was written.\n")


def test_ctrl_c_while_python_ends_prints_no_traceback(tmp_path):
    code = (
        "import atexit, sys, time; atexit.register(lambda: (print('ending', flush=True), time.sleep(60)));"
        "from planner.__main__ import run; sys.argv[1:] = ['--version']; run()"
    )
    child = subprocess.Popen(
        [sys.executable, "-c", code], cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert child.stdout is not None
    assert any(line == "ending\n" for line in child.stdout)
    child.send_signal(signal.SIGINT)
    _, err = child.communicate(timeout=60)
    assert (child.returncode, err) == (-signal.SIGINT, "")


def test_a_script_of_ones_own_goes_on_after_main(tmp_path):
    """main() ended the process with its own exit code and left open files without their data."""
    code = (
        "import gc, sys; from planner.__main__ import main; out = open('own.txt', 'w'); sys.argv[1:] = ['--version'];"
        "out.write(f'{main()} {gc.isenabled()}'); sys.exit(7)"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, timeout=60)
    assert (done.returncode, (tmp_path / "own.txt").read_text()) == (7, "0 True")


UP = "import sys; print('up', flush=True); from planner.__main__ import run; run()"


def whole(folder):
    """Names of the files of a folder, of which those of a run can be read to their ends."""
    names = {file.name for file in folder.iterdir()} if folder.exists() else set()
    for name in names & {*OUTPUTS, MARK, ROLLOUTS}:
        file = folder / name
        if name == "plan.npz":
            planner.load_plan(file)
        elif file.suffix == ".json":
            json.loads(file.read_text())
        elif file.suffix == ".png":
            Image.open(file).load()
        elif file.suffix == ".html":
            assert file.read_text().rstrip().endswith("</html>")
        elif name == ROLLOUTS:
            with np.load(file) as arrays:
                assert all(arrays[part].size >= 0 for part in arrays.files)
    return names


@pytest.mark.slow
def test_at_whatever_time_a_run_is_stopped_it_is_resumed_to_the_same_plan_and_proof(tmp_path):
    """Ctrl-C and SIGKILL at random times of one run after the other, until the last one is left alone."""
    words, rng = [*ARM, "--rollouts", "8", "--out"], random.Random(15)

    def begin(out):
        child = subprocess.Popen(
            [sys.executable, "-c", UP, *words, out],
            cwd=tmp_path,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert child.stdout is not None
        assert child.stdout.readline() == "up\n"
        return child

    began = time.monotonic()
    undisturbed = begin("whole")
    _, err = undisturbed.communicate(timeout=300)
    seconds = time.monotonic() - began
    assert undisturbed.returncode == 0, err
    for kill in [signal.SIGINT, signal.SIGKILL] * 5:
        child = begin("o")
        time.sleep(rng.uniform(0.1, 0.9) * seconds)
        child.send_signal(kill)
        _, err = child.communicate(timeout=300)
        whole(tmp_path / "o")
        if kill == signal.SIGINT:
            assert child.returncode in (0, 1, 130, -2), err  # 1: in the solve; -2: while Python itself begins or ends
            assert err == "" or (err.startswith("planner: interrupted") and err.count("\n") == 1), err
    last = begin("o")
    _, err = last.communicate(timeout=300)
    assert last.returncode == 0, err
    assert {name for name in whole(tmp_path / "o") if not name.startswith(".")} == whole(tmp_path / "whole")
    for name in ("plan.npz", "proof.json"):
        assert (tmp_path / "o" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()


def test_an_interruption_that_falls_into_a_callback_comes_again_behind_it():
    """Python prints and drops what a weak reference's callback raises, Ctrl-C too."""
    text = (
        "import sys, time, weakref\n"
        "from planner.__main__ import _unraisable\n"
        "sys.unraisablehook = _unraisable\n"
        "def interrupt(_): raise KeyboardInterrupt\n"
        "class Thing: pass\n"
        "thing = Thing()\n"
        "reference = weakref.ref(thing, interrupt)\n"
        "try:\n"
        "    del thing\n"
        "    time.sleep(10)\n"
        "except KeyboardInterrupt:\n"
        "    print('again')\n"
    )
    done = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, timeout=60, check=False)
    assert (done.stdout, done.stderr) == ("again\n", "")
