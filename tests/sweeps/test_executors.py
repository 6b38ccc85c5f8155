"""Several starts, perturbed rollouts and stored plans on an executor: the same bits, and what goes wrong."""

import csv
import json
import os
import signal
import threading
import time
from concurrent.futures import BrokenExecutor, Executor, Future, ThreadPoolExecutor
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from troubled_problems import troubled

import planner
from planner.base.executors import ordered_map
from planner.proof.replays.compiled_twin import CompiledTwin
from planner.proof.robustness import monte_carlo
from planner.proof.robustness.perturbed import MonteCarloSettings, perturbed
from planner.sweeps.processes import LocalProcesses, executor_of
from planner.sweeps.regression import check, stored_proof
from planner.sweeps.sweeping import sweep


@pytest.fixture(scope="module")
def processes():
    with LocalProcesses(2) as executor:
        yield executor


@pytest.fixture(scope="module")
def plan():
    return planner.solve(planner.cases.hopper(height=5.0, duration=0.25, horizon=50))


def square(value):
    time.sleep(0.001 * (value % 3))
    return value * value


def killed(value, bad, once=None):
    """A value; at the bad one the process is killed, with a file `once` only the first time."""
    if value == bad and not (once and Path(once).exists()):
        if once:
            Path(once).touch()
        time.sleep(0.2)  # until another call stands behind it
        os.kill(os.getpid(), signal.SIGKILL)
    return value


def test_results_come_in_the_order_of_the_items(processes):
    assert list(ordered_map(processes, square, range(50))) == [value * value for value in range(50)]
    assert list(ordered_map(None, square, range(3))) == [0, 1, 4]


def test_few_calls_are_on_their_way_at_a_time():
    taken = []
    with ThreadPoolExecutor(2) as executor:
        for value in ordered_map(executor, square, (taken.append(k) or k for k in range(100))):
            assert len(taken) <= value**0.5 + 9


def test_a_call_whose_process_is_killed_is_made_once_more(processes, tmp_path):
    work = partial(killed, bad=7, once=str(tmp_path / "killed"))
    assert list(ordered_map(processes, work, range(20))) == list(range(20))
    assert (tmp_path / "killed").exists()


def test_a_call_that_always_kills_is_a_sentence_and_costs_no_other(processes):
    futures = [processes.submit(killed, value, 3) for value in range(12)]
    found = [None if isinstance(future.exception(), BrokenExecutor) else future.result() for future in futures]
    assert found == [0, 1, 2, None, *range(4, 12)]
    with pytest.raises(planner.PlannerError, match="ended twice in the middle of the same work"):
        list(ordered_map(processes, partial(killed, bad=1), range(4)))


def large(_):
    return bytes(3_000_000)


def test_a_process_that_is_ended_while_it_answers_is_not_waited_for(processes):
    """Python's pool would read the rest of a half-written answer for ever."""
    for _ in range(2):
        futures = [processes.submit(large, k) for k in range(4)]
        while not any(future.running() for future in futures):
            time.sleep(1e-4)
        for future in futures:
            if not future.cancel() and not future.done():
                processes.end(future)
        for future in futures:
            assert future.cancelled() or isinstance(future.exception(timeout=20.0), BrokenExecutor | None)


def test_what_cannot_be_sent_is_a_sentence(processes):
    with pytest.raises(planner.PlannerError, match="cannot be sent to processes"):
        list(ordered_map(processes, lambda value: value, range(3)))


def test_a_context_left_by_an_error_ends_its_processes_at_once():
    began = time.monotonic()
    executor = LocalProcesses(1)
    futures = [executor.submit(time.sleep, 60.0) for _ in range(3)]
    executor.__exit__(ZeroDivisionError)
    assert time.monotonic() - began < 30.0
    assert all(future.done() for future in futures)


def test_several_starts_are_the_same_to_the_last_bit(processes):
    problem = planner.cases.build("two-link", horizon=30)
    here = planner.solve(problem, starts=3, seed=2)
    there = planner.solve(problem, starts=3, seed=2, executor=processes)
    assert np.array_equal(here.us, there.us)
    assert here.starts == there.starts
    assert there.problem is problem


def test_ctrl_c_between_starts_keeps_the_best_so_far(processes):
    seen = []

    def interrupt(start):
        seen.append(start)
        raise KeyboardInterrupt

    plan = planner.solve(planner.cases.build("two-link", horizon=30), starts=12, executor=processes, callback=interrupt)
    assert plan.status is planner.Status.INTERRUPTED
    assert len(seen) == 1
    assert np.isfinite(plan.cost)
    assert list(ordered_map(processes, square, range(3))) == [0, 1, 4]  # the executor goes on


def test_rollouts_are_the_same_to_the_last_bit(processes, plan, monkeypatch):
    """Whatever the batches and the workers; threads of one process have a simulator each."""
    trials, compiled = MonteCarloSettings(8), CompiledTwin(plan.twin)
    here = perturbed(plan, compiled, trials)
    monkeypatch.setattr(monte_carlo, "_FEWEST", 2)
    with ThreadPoolExecutor(3) as threads:
        for executor in (processes, threads):
            there = perturbed(plan, compiled, trials, executor=executor)
            assert there.to_dict() == here.to_dict()
            for mode, fan in here.fans.items():
                assert np.array_equal(fan, there.fans[mode], equal_nan=True)


def test_rollouts_stop_after_their_budget(processes, plan):
    found = perturbed(plan, CompiledTwin(plan.twin), budget=1e-6, executor=processes)
    assert found.done == 0
    assert "Stopped after" in found.notes[0]


@pytest.mark.slow
def test_plans_are_checked_as_in_one_process(processes, plan, tmp_path):
    proof = json.dumps(planner.prove(plan, rollouts=0).to_dict())
    for name, text in (("a", proof), ("b", "[]")):
        stored_proof(plan.save(tmp_path / f"{name}.npz")).write_text(text)
    here, there = check(tmp_path), check(tmp_path, executor=processes)
    assert [str(one) for one in here] == [str(one) for one in there]
    assert [one.passed for one in there] == [True, False]


def test_an_executor_is_asked_for_by_workers_or_by_an_address():
    with executor_of(None, None) as executor:
        assert executor is None
    for workers, scheduler, words in ((2, "local", "expected one of them"), (0, None, "workers is 0")):
        with pytest.raises(planner.PlannerError, match=words):
            executor_of(workers, scheduler).__enter__()
    for wrong in (planner.solve, planner.prove):
        with pytest.raises(planner.PlannerError, match=r"executor is 3, expected a concurrent\.futures\.Executor"):
            wrong(planner.cases.hopper(horizon=20) if wrong is planner.solve else planner.solve(
                planner.cases.hopper(horizon=20)), executor=3)  # fmt: skip


class OneWorker(Executor):
    """All that waits is on one worker, which ends so many times when the task that ends workers is there."""

    width = 2

    def __init__(self, bad, times=float("inf")):
        self._bad, self._left, self._waiting, self._lock = bad, times, [], threading.Lock()

    def submit(self, fn, /, *args, **kwargs):
        future = Future()
        with self._lock:
            self._waiting.append((future, fn, args))
        threading.Timer(0.05, self._work).start()
        return future

    def end(self, future):
        """It never hangs."""

    def _work(self):
        with self._lock:
            waiting, self._waiting = self._waiting, []
        ends = self._left > 0 and any(self._bad in args[1] for _, _, args in waiting)
        self._left -= ends
        for future, fn, args in waiting:
            if ends:
                future.set_exception(BrokenExecutor("killed"))
            else:
                future.set_result(fn(*args))


@pytest.mark.parametrize(("times", "lost"), [(2, set()), (3, {3})])
def test_what_was_lost_beside_the_task_that_ends_workers_is_not_blamed(times, lost, tmp_path):
    """A task is blamed when its worker ends twice while no other batch is on it; the first end may be another's."""
    sweep(troubled, {"height": [1, 2, 3, 4, 5, 6]}, out=tmp_path, executor=OneWorker(2, times))
    with open(tmp_path / "table.csv", encoding="utf-8", newline="") as file:
        found = {float(row["height"]): row["status"] for row in csv.DictReader(file)}
    assert {height for height, status in found.items() if status == "WORKER_LOST"} == lost
    assert set(found) == {1, 2, 3, 4, 5, 6}
