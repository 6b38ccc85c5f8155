"""Ctrl-C, kills and two commands at once: nothing is half-written, and the same command goes on."""

import json
import os
import signal
import subprocess
import sys
import time

import pytest
from commands import PLANNER, refused, run

import planner
from planner.cli.results import OUTPUTS
from planner.cli.run_folder import MARK, ROLLOUTS

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


@pytest.mark.parametrize("kill", [signal.SIGTERM, signal.SIGHUP])
def test_a_kill_leaves_nothing_half_written(tmp_path, kill):
    child = started(["run", *LONG, "--no-video", "--out", "o"], tmp_path)
    child.send_signal(kill)
    child.communicate(timeout=60)
    assert child.returncode == 128 + kill
    assert list(tmp_path.iterdir()) == []


def test_two_runs_do_not_write_into_one_folder(tmp_path):
    """The second one is refused; when the first is killed, the folder is free at once."""
    other = [*ARM, "--rollouts", "0", "--out", "o"]
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
