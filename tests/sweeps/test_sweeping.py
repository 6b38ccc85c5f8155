"""Sweeps in threads of this process: what comes out, and what goes on after an interruption."""

import csv
import json
import os
import resource
import zipfile
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from commands import refused, run
from troubled_problems import troubled

import planner
from planner.sweeps.grid import Grid
from planner.sweeps.store import TIMES, Shards, plan_place
from planner.sweeps.sweeping import sweep
from planner.sweeps.work import Work, check_buildable, run_batch

GRID = {"height": [1, 2, 3, 4, 5], "horizon": [50, 60]}


def swept(out, grid=GRID, build="hopper", threads=1, **options):
    with ThreadPoolExecutor(threads) as executor:
        return sweep(build, grid, out=out, executor=executor, **options)


def table(folder, times=False):
    with open(folder / "table.csv", encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    return [{name: value for name, value in row.items() if times or name not in TIMES} for row in rows]


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sweep") / "out"
    return swept(folder)


def test_the_table_has_a_row_a_task_in_order(done):
    rows = table(done.folder, times=True)
    assert [int(row["task"]) for row in rows] == list(range(10))
    assert [(int(row["height"]), int(row["horizon"])) for row in rows[:3]] == [(1, 50), (1, 60), (2, 50)]
    plan = planner.solve(planner.cases.hopper(height=2, horizon=60))
    assert float(rows[3]["cost"]) == plan.cost  # to the last bit
    assert int(rows[3]["iterations"]) == plan.nit
    assert all(float(row["solve_seconds"]) > 0.0 for row in rows)
    assert done.complete
    assert done.statuses == {"CONVERGED": 10}


def test_it_has_its_page_and_a_table_in_a_notebook(done):
    assert done.page() == done.folder / "index.html"
    assert "light green: converged and not proven" in done.page().read_text(encoding="utf-8")
    shown = done._repr_html_()
    assert "10 of 10 tasks: CONVERGED 10" in shown
    assert shown.count("<tr>") == 11
    assert "<th>height</th>" in shown


def test_a_plan_is_read_out_of_the_archive(done):
    plan = planner.solve(planner.cases.hopper(height=2, horizon=60))
    for found in (done.plan(3), planner.load_plan(done.folder / "plans/000.zip/000003.npz")):
        assert np.array_equal(found.us, plan.us)
        assert found.parameters["height"] == 2.0
    assert sorted(os.listdir(done.folder / "plans")) == ["000.zip"]
    with pytest.raises(planner.PlannerError, match=r"has no plan 000099\.npz"):
        planner.load_plan(done.folder / plan_place(99))


def test_parquet_has_the_same_table(done):
    parquet = pytest.importorskip("pyarrow.parquet")
    found = parquet.read_table(done.folder / "table.parquet").to_pylist()
    rows = table(done.folder, times=True)
    assert list(found[0]) == list(rows[0])
    assert [row["cost"] for row in found] == [float(row["cost"]) for row in rows]


def test_the_table_does_not_depend_on_the_number_of_workers(done, tmp_path):
    swept(tmp_path / "out", threads=3)
    assert table(tmp_path / "out") == table(done.folder)


def test_a_task_that_raises_is_in_the_table_and_the_rest_goes_on(tmp_path):
    done = swept(tmp_path / "out", {"height": [1, -2, 3, 4]}, troubled, fixed={"how": "raise"})
    rows = table(tmp_path / "out")
    assert [row["status"] for row in rows] == ["CONVERGED", "FAILED", "FAILED", "CONVERGED"]
    assert rows[1]["reason"].startswith("height is -2, expected")
    assert rows[2]["reason"] == "ZeroDivisionError: no such machine"
    with pytest.raises(planner.PlannerError):
        done.plan(2)


def test_a_solve_that_takes_too_long_ends_between_iterations(tmp_path):
    swept(tmp_path / "out", {"height": [1]}, timeout=1e-9)
    (row,) = table(tmp_path / "out")
    assert (row["status"], row["iterations"]) == ("TIMEOUT", "1")


def test_resume_does_what_is_missing_and_nothing_twice(done, tmp_path):
    swept(tmp_path / "out", {"height": GRID["height"], "horizon": [50, 60]})
    lines = (tmp_path / "out/rows.jsonl").read_bytes().splitlines(keepends=True)
    torn = b"".join(lines[:4]) + lines[4][:30]
    (tmp_path / "out/rows.jsonl").write_bytes(torn)
    archive = tmp_path / "out/plans/000.zip"
    archive.write_bytes(archive.read_bytes()[:-500])  # no directory: as a killed process leaves it
    with pytest.raises(planner.PlannerError, match="--resume"):
        swept(tmp_path / "out")
    with pytest.raises(planner.PlannerError, match="another sweep"):
        swept(tmp_path / "out", {"height": [1]}, resume=True)
    again = swept(tmp_path / "out", resume=True)
    assert again.complete
    assert table(tmp_path / "out") == table(done.folder)
    rows = (tmp_path / "out/rows.jsonl").read_bytes().splitlines(keepends=True)
    assert rows[:4] == lines[:4]
    assert len(rows) == 10
    with zipfile.ZipFile(archive) as file:
        assert sorted(file.namelist()) == [f"{k:06d}.npz" for k in range(10)]
    assert planner.load_plan(tmp_path / "out" / plan_place(9)).cost == done.plan(9).cost


def changed_rows(folder, status, tasks):
    """Rows as they are after a worker was lost, or too little time."""
    rows = [json.loads(line) for line in (folder / "rows.jsonl").read_text().splitlines()]
    made = [row | {"status": status, "cost": 1.0} if row["task"] in tasks else row for row in rows]
    (folder / "rows.jsonl").write_text("".join(json.dumps(row) + "\n" for row in made))


def test_resume_does_again_what_was_not_the_problems_fault(done, tmp_path):
    out = tmp_path / "out"
    swept(out)
    changed_rows(out, "WORKER_LOST", {2, 7})
    changed_rows(out, "FAILED", {4})
    again = swept(out, resume=True)
    assert again.statuses == {"CONVERGED": 9, "FAILED": 1}
    now, then = table(out), table(done.folder)
    assert now[:4] + now[5:] == then[:4] + then[5:]
    with zipfile.ZipFile(out / "plans/000.zip") as file:
        assert sorted(file.namelist()) == [f"{k:06d}.npz" for k in range(10)]
    assert len((out / "rows.jsonl").read_bytes().splitlines()) == 10


def test_resume_does_again_what_took_too_long_only_with_a_longer_timeout(done, tmp_path):
    out = tmp_path / "out"
    assert swept(out, timeout=1e-9).statuses == {"TIMEOUT": 10}
    assert swept(out, timeout=1e-9, resume=True).statuses == {"TIMEOUT": 10}
    assert swept(out, timeout=60.0, resume=True).statuses == {"CONVERGED": 10}
    assert table(out) == table(done.folder)
    assert swept(out, timeout=1e-9, resume=True).statuses == {"CONVERGED": 10}


def test_what_continued_from_a_lost_task_is_done_again_with_it(tmp_path):
    whole = swept(tmp_path / "whole", continued="height")
    swept(tmp_path / "out", continued="height")
    changed_rows(tmp_path / "out", "WORKER_LOST", {4})
    swept(tmp_path / "out", continued="height", resume=True)
    assert table(tmp_path / "out") == table(whole.folder)


def test_archives_without_a_directory_keep_their_whole_entries(tmp_path):
    shards = Shards(tmp_path)
    for task in (0, 1, 2):
        shards.add(task, bytes([task]) * 1000)
    shards.flush()
    left = (tmp_path / "000.zip").read_bytes()
    shards.close()
    (tmp_path / "000.zip").write_bytes(left[:-10])
    Shards(tmp_path).retain({0, 1, 2})
    with zipfile.ZipFile(tmp_path / "000.zip") as file:
        assert file.namelist() == ["000000.npz", "000001.npz"]
        assert file.read("000001.npz") == b"\1" * 1000


def test_each_starts_from_its_neighbour_whatever_the_number_of_workers(done, tmp_path):
    for threads in (1, 3):
        swept(tmp_path / str(threads), continued="height", threads=threads)
    rows = table(tmp_path / "1")
    assert rows == table(tmp_path / "3")
    assert [row["guess"] for row in rows] == ["own"] * 2 + ["neighbour"] * 8
    assert sum(int(row["iterations"]) for row in rows) < sum(int(row["iterations"]) for row in table(done.folder))


def test_a_chain_goes_on_where_it_was(tmp_path):
    whole = swept(tmp_path / "whole", continued="height")
    swept(tmp_path / "out", continued="height")
    file = tmp_path / "out/rows.jsonl"
    file.write_bytes(b"".join(file.read_bytes().splitlines(keepends=True)[:5]))
    swept(tmp_path / "out", continued="height", resume=True)
    assert table(tmp_path / "out") == table(whole.folder)


def test_several_starts_are_passed_on(tmp_path):
    done = swept(tmp_path / "out", {"height": [4]}, starts=3, seed=1)
    assert len(done.plan(0).starts) == 3
    with pytest.raises(planner.PlannerError, match="an option is 'start'"):
        swept(tmp_path / "other", start=3)


def test_a_proof_is_in_the_table(tmp_path):
    swept(tmp_path / "out", {"height": [4]}, prove=True)
    (row,) = table(tmp_path / "out")
    assert (row["verdict"], row["feasible"], row["optimal"]) == ("PASS", "True", "True")
    assert float(row["refined_open_loop.rms_height_error"]) < 0.05


def test_keys_of_a_problem_file_are_swept(tmp_path):
    (tmp_path / "cart.toml").write_text('case = "hopper"\nhorizon = 50\n')
    done = swept(tmp_path / "out", {"height": [4, 5]}, tmp_path / "cart.toml")
    assert done.plan(1).parameters["height"] == 5.0
    with pytest.raises(planner.PlannerError, match="hopper has no parameter"):
        swept(tmp_path / "other", {"mass": [4]}, tmp_path / "cart.toml")


def test_ctrl_c_keeps_what_is_finished(tmp_path):
    def interrupt(finished, _):
        raise KeyboardInterrupt

    done = swept(tmp_path / "out", progress=interrupt)
    assert done.interrupted
    assert 0 < done.finished < 10
    assert len(table(tmp_path / "out")) == done.finished
    assert swept(tmp_path / "out", resume=True).complete


def test_a_second_ctrl_c_says_what_is_there(tmp_path, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("planner.sweeps.sweeping.write_tables", interrupted)
    words = ("sweep", "hopper", "--set", "height=4,5", "--set", "horizon=50", "--workers", 1, "--out", "out")
    done = run(*words, cwd=tmp_path)
    assert (done.returncode, done.stdout) == (130, "")
    assert done.stderr.endswith("what is done is in out, and --resume goes on with it and writes its tables.\n")
    monkeypatch.undo()
    assert run(*words, "--resume", cwd=tmp_path).returncode == 0
    assert len(table(tmp_path / "out")) == 2


def test_a_full_disk_keeps_what_is_finished(done, tmp_path, monkeypatch):
    monkeypatch.setattr("sys.dont_write_bytecode", True)  # a module that is cut off there would break the next import
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (60_000, before[1]))  # the archive outgrows it
    try:
        with pytest.raises(planner.PlannerError, match="grew beyond"):
            swept(tmp_path / "out")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    finished = len((tmp_path / "out/rows.jsonl").read_bytes().splitlines())
    assert 0 < finished < 10
    assert swept(tmp_path / "out", resume=True).complete
    assert table(tmp_path / "out") == table(done.folder)


def test_the_command_refuses_what_does_not_exist(tmp_path):
    refused(run("sweep", "hopper", "--set", "heigth=1:2:2", "--out", "out", cwd=tmp_path), "no parameter 'heigth'")
    both = ("--workers", 2, "--scheduler", "tcp://127.0.0.1:1")
    refused(run("sweep", "hopper", "--set", "height=1", *both, cwd=tmp_path), "one of them")
    refused(
        run("sweep", "hopper", "--set", "height=1", "--continuation", "mass", cwd=tmp_path), "expected one of: height"
    )
    refused(
        run("sweep", "hopper", "--set", "height=1", "--starts", 0, cwd=tmp_path), "--starts: '0' is not a whole number"
    )
    refused(run("sweep", "hopper", "--set", "height=1:2", cwd=tmp_path), "START:STOP:COUNT")
    refused(run("sweep", "hopper", "--set", "height=", cwd=tmp_path), "no part of a grid")
    assert list(tmp_path.iterdir()) == []


def test_input_of_which_no_task_can_be_built_is_refused_and_nothing_is_written(tmp_path):
    wrong = run("sweep", "hopper", "--set", "height=-1,-2", "--out", "out", cwd=tmp_path)
    refused(wrong, "height is -1, expected")
    (tmp_path / "reach.toml").write_text('model = "arm.xml"\nduratoin = 1.0\n', encoding="utf-8")
    typo = run("sweep", "reach.toml", "--set", "weights.effort=1,2", "--out", "out", cwd=tmp_path)
    refused(typo, "'duratoin'")
    assert [one.name for one in tmp_path.iterdir()] == ["reach.toml"]


@pytest.mark.parametrize(("right", "most"), [((), 32), ((700,), 32), (range(700, 1000), 23)])
def test_of_a_large_grid_some_tasks_are_built_before_it_is_refused(monkeypatch, right, most):
    """A thousand machines were built one after the other; the first 500 may fail by one value of a parameter."""
    built = []

    def build(_, task):
        built.append(task)
        if task not in right:
            raise planner.PlannerError(f"task {task} is wrong.")

    monkeypatch.setattr(Work, "problem", build)
    work = Work(Grid({"height": tuple(range(1000))}), "hopper")
    if len(right) > 1:
        check_buildable(work)
    else:
        with pytest.raises(planner.PlannerError, match="task 0 is"):
            check_buildable(work)
    assert len(built) == most  # of 0, 32, 64, 96, ..., 999 the 23rd is 708


def test_the_command_says_the_first_reason_of_each_status(tmp_path):
    words = ("--set", "height=-1,1", "--workers", 1, "--out", "out")
    done = run("sweep", "hopper", *words, cwd=tmp_path)
    assert done.returncode == 1
    assert "FAILED     1      height is -1, expected" in done.stdout
    again = run("sweep", "hopper", *words, "--resume", "--json", cwd=tmp_path)  # every row is there
    reasons = json.loads(again.stdout)["reasons"]
    assert reasons["CONVERGED"] == ""
    assert reasons["FAILED"].startswith("height is -1, expected")


@pytest.mark.parametrize(
    ("how", "reason"),
    [
        ("exit", "SystemExit: 5"), ("interrupt", "KeyboardInterrupt:"), ("memory", "MemoryError: 4 GB"),
        ("recursion", "RecursionError: maximum recursion depth exceeded"), ("garbage", "expected a Problem."),
    ],
)  # fmt: skip
def test_what_a_task_does_to_its_process_is_a_row(how, reason):
    """The same call that a worker makes; tests of executors let rows travel."""
    work = Work(Grid({"height": (1, 2, 3, 4, 5, 6)}), troubled, fixed={"how": how})
    rows = [one.row for one in run_batch(work, [1, 2, 3]).done]
    assert [row["status"] for row in rows] == ["CONVERGED", "FAILED", "CONVERGED"]
    assert reason in rows[1]["reason"]
