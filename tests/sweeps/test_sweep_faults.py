"""Workers that are killed or hang, on processes of this machine and on a local Dask cluster."""

import csv
import os
import signal
import subprocess
import sys
import time
from contextlib import contextmanager, nullcontext
from functools import partial

import numpy as np
import pytest
from troubled_problems import mortal, slow, troubled

import planner
from planner.sweeps import processes, running
from planner.sweeps.processes import dask_executor
from planner.sweeps.store import TIMES, plan_place
from planner.sweeps.sweeping import sweep

GRID = {"height": [1, 2, 3, 4, 5, 6]}


def statuses(folder):
    with open(folder / "table.csv", encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [int(row["task"]) for row in rows] == list(range(len(rows)))
    return {int(row["height"]): row["status"] for row in rows if row["status"] != "CONVERGED"}, rows


@contextmanager
def on_dask():
    pytest.importorskip("distributed")
    with dask_executor("local", workers=2) as executor:
        yield executor


EXECUTORS = [pytest.param(nullcontext, id="processes"), pytest.param(on_dask, id="dask")]
pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore")]  # Dask's own warnings about lost workers


@pytest.mark.parametrize("executor", EXECUTORS)
def test_a_task_that_kills_its_worker_costs_that_task_alone(executor, tmp_path):
    with executor() as pool:
        done = sweep(troubled, GRID, out=tmp_path / "out", executor=pool, workers=2, fixed={"how": "kill"})
    bad, rows = statuses(tmp_path / "out")
    assert bad == {3: "WORKER_LOST"}
    assert "killed" in rows[2]["reason"]
    assert done.complete


@pytest.mark.parametrize("executor", EXECUTORS)
def test_a_worker_that_is_killed_once_costs_nothing(executor, tmp_path):
    fixed = {"how": "kill", "once": str(tmp_path / "killed")}
    with executor() as pool:
        sweep(troubled, GRID, out=tmp_path / "out", executor=pool, workers=2, fixed=fixed)
    assert (tmp_path / "killed").exists()
    assert statuses(tmp_path / "out")[0] == {}


def test_ten_thousand_points_outlive_four_workers(tmp_path):
    heights = np.linspace(1.0, 60.0, 10_000).tolist()
    deaths = tuple(heights[2000::2000])
    with on_dask() as pool:
        done = sweep(
            mortal, {"height": heights}, out=tmp_path / "out", executor=pool,
            fixed={"deaths": deaths, "folder": str(tmp_path)},
        )  # fmt: skip
    assert done.complete
    assert len(list(tmp_path.iterdir())) == 1 + len(deaths) == 5
    with open(tmp_path / "out" / "table.csv", encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [int(row["task"]) for row in rows] == list(range(10_000))
    assert {row["status"] for row in rows} == {"CONVERGED"}
    for k in (0, 2000, 9999):
        assert float(rows[k]["cost"]) == planner.solve(mortal(heights[k])).cost


@pytest.mark.parametrize("executor", EXECUTORS)
def test_a_task_that_hangs_is_ended_with_its_worker(executor, tmp_path, monkeypatch):
    monkeypatch.setattr(running, "GRACE", 3.0)
    with executor() as pool:
        sweep(troubled, GRID, out=tmp_path / "out", executor=pool, workers=2, fixed={"how": "hang"}, timeout=2.0)
    bad, rows = statuses(tmp_path / "out")
    assert bad == {3: "TIMEOUT"}
    assert "its worker was ended" in rows[2]["reason"]


@pytest.mark.parametrize("executor", EXECUTORS)
def test_a_task_that_raises_comes_back_with_its_reason(executor, tmp_path):
    with executor() as pool:
        sweep(troubled, GRID, out=tmp_path / "out", executor=pool, workers=2, fixed={"how": "raise"})
    bad, rows = statuses(tmp_path / "out")
    assert bad == {3: "FAILED"}
    assert rows[2]["reason"] == "ZeroDivisionError: no such machine"


@pytest.mark.parametrize("how", ["exit", "interrupt"])
def test_a_task_that_ends_its_process_is_a_row_of_a_whole_sweep(how, tmp_path):
    assert sweep(troubled, GRID, out=tmp_path / "out", workers=2, fixed={"how": how}).complete
    assert statuses(tmp_path / "out")[0] == {3: "FAILED"}


def test_a_thread_that_a_task_leaves_is_said_and_not_waited_for(tmp_path, monkeypatch):
    monkeypatch.setattr(processes, "_GRACE", 1.0)
    began = time.perf_counter()
    assert sweep(troubled, GRID, out=tmp_path / "out", workers=2, fixed={"how": "thread"}).complete
    assert time.perf_counter() - began < 60.0  # of a thread that sleeps for 600 s
    bad, rows = statuses(tmp_path / "out")
    assert (bad, rows[2]["reason"]) == ({}, "It left a thread running: left.")


def test_processes_and_dask_give_the_same_table(tmp_path):
    make = partial(sweep, "hopper", {"height": list(range(1, 21))})
    for workers in (1, 2):
        make(out=tmp_path / str(workers), workers=workers)
    with on_dask() as pool:
        make(out=tmp_path / "dask", executor=pool)
    tables = [statuses(tmp_path / name)[1] for name in ("1", "2", "dask")]
    for rows in tables:
        for row in rows:
            for name in TIMES:
                row.pop(name, None)
    assert tables[0] == tables[1] == tables[2]


def test_an_address_where_nobody_answers_is_a_sentence(tmp_path, monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr("planner.sweeps.processes.CONNECTING", 0.5)
    for address in ("tcp://127.0.0.1:1", "nonsense://"):
        with pytest.raises(planner.PlannerError, match=f"no Dask scheduler answers at {address}"):
            dask_executor(address).__enter__()


@pytest.mark.parametrize("kill", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_a_sweep_that_is_ended_goes_on_with_resume(kill, tmp_path):
    command = [sys.executable, "-m", "planner", "sweep", "hopper", "--set", "height=1:60:150", "--workers", "2",
               "--out", "out"]  # fmt: skip
    running = subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE, text=True, start_new_session=True)
    rows = tmp_path / "out/rows.jsonl"
    for _ in range(600):
        if rows.exists() and rows.stat().st_size > 2_000:
            break
        time.sleep(0.05)
    if kill == signal.SIGINT:  # a terminal sends it to all
        os.killpg(running.pid, kill)
    else:
        running.send_signal(kill)
    said = running.communicate(timeout=60)[1]
    assert running.returncode in (130, 128 + kill, -kill)
    if kill == signal.SIGINT:
        assert "--resume goes on with them" in said
    assert "Traceback" not in said
    before = rows.read_bytes().splitlines()
    assert 0 < len(before) < 150
    subprocess.run([*command, "--resume", "--quiet"], cwd=tmp_path, check=False, capture_output=True, timeout=120)
    after = rows.read_bytes().splitlines()
    assert len(after) == 150
    whole = len(before) if kill != signal.SIGKILL else len(before) - 1
    assert after[:whole] == before[:whole]
    assert planner.load_plan(tmp_path / "out" / plan_place(149)).parameters["height"] == 60.0


def test_tasks_that_take_long_are_still_shared(tmp_path):
    began = time.perf_counter()
    sweep(slow, GRID, out=tmp_path / "out", workers=2)
    assert statuses(tmp_path / "out")[0] == {}
    assert time.perf_counter() - began < 30.0
