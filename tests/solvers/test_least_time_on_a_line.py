"""The least time of a seven-joint arm on a line: solve_for beside a linear program that knows the line alone."""

import importlib.util
import re
from pathlib import Path

import numpy as np
import pytest

import planner

ROOT = Path(__file__).parents[2]
TORQUES = np.array([80.0, 80.0, 40.0, 40.0, 12.0, 12.0, 12.0])  # of examples/tasks/arm.xml
M = 200  # parts of the line


@pytest.fixture(scope="module")
def benchmark():
    spec = importlib.util.spec_from_file_location("minimum_time", ROOT / "benchmarks" / "minimum_time.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def least_time(mechanism, start, goal, speeds):
    """Of the path q = start + s (goal - start): x = s'^2 is linear in s'' = u, torques are linear in both.

    max sum x, x(i+1) = x(i) + 2 u(i) / M, |tau| <= TORQUES at the beginning of each part, |q'| sqrt(x) <= speeds: all x
    are largest together (Pham and Pham, A new approach to time-optimal path parameterization, 2018).
    """
    from scipy.optimize import linprog

    way = goal - start
    q, still, along = start + np.linspace(0, 1, M)[:, None] * way, np.zeros((M, 7)), np.tile(way, (M, 1))
    gravity = planner.dynamics.rnea(mechanism, q, still, still)
    by_u = planner.dynamics.rnea(mechanism, q, still, along) - gravity
    by_x = planner.dynamics.rnea(mechanism, q, along, still) - gravity
    x, u, part = np.eye(M, 2 * M + 1), np.eye(M, 2 * M + 1, M + 1), np.eye(M, 2 * M + 1, 1)
    rows = np.einsum("ij,ik->ijk", by_x, x) + np.einsum("ij,ik->ijk", by_u, u)
    upper = np.concatenate([rows.reshape(-1, 2 * M + 1), -rows.reshape(-1, 2 * M + 1)])
    most = np.concatenate([(TORQUES - gravity).ravel(), (TORQUES + gravity).ravel()])
    fastest = float((speeds / np.abs(way)).min()) ** 2
    ends = [(0.0, 0.0 if i in (0, M) else fastest) for i in range(M + 1)]
    cost = np.concatenate([-np.ones(M + 1), np.zeros(M)])
    found = linprog(cost, upper, most, part - x - 2.0 / M * u, np.zeros(M), ends + [(None, None)] * M).x[: M + 1]
    return float(np.sum(2.0 / M / (np.sqrt(found[1:]) + np.sqrt(found[:-1]))))


@pytest.mark.slow
def test_on_a_line_it_is_little_longer_and_free_of_it_shorter_than_the_least(benchmark, tmp_path):
    text = re.sub(r' damping="[\d.]+"', "", benchmark.ARM.read_text(encoding="utf-8"))
    (tmp_path / "arm.xml").write_text(text, encoding="utf-8")
    arm = planner.Mechanism.from_mjcf(tmp_path / "arm.xml")
    least = least_time(arm, np.array(benchmark.START), np.array(benchmark.GOAL), np.array(benchmark.SPEEDS))
    assert least == pytest.approx(0.62034, abs=1e-4)  # toppra 0.6.10 finds 0.620336 s
    free = benchmark.asked(tmp_path, arm)
    line = benchmark.on_the_line(free)
    on_line = planner.solve_for(line, "time", durations=benchmark.BETWEEN)
    assert on_line.converged
    across = line.constraints[-1].of(on_line.xs)
    assert np.abs(across).max() <= benchmark.OFF * (1.0 + 1e-9)
    assert 0.995 * least < on_line.t[-1] < 1.02 * least  # 1 mrad off the line gains less than 0.5 %
    freely = planner.solve_for(free, "time", durations=benchmark.BETWEEN)
    assert freely.success
    assert freely.t[-1] < least
