"""Calls of the algorithms keep their scratch: neither what a call left in it nor other threads change a result."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from rolled_out_plans import TREE

from planner.dynamics import algorithms, kinematics
from planner.dynamics.batch import _idle, kernel_model
from planner.model.mechanism import Mechanism


@pytest.fixture
def tree():
    return Mechanism.from_mjcf(TREE)


def states(tree, count):
    rng = np.random.default_rng(3)
    q = np.array([tree.space.integrate(tree.home, rng.normal(size=tree.space.ndx))[: tree.nq] for _ in range(count)])
    return q, rng.normal(size=(count, tree.nv))


@pytest.mark.parametrize("name", ["bias", "forward_dynamics", "rnea", "mass_matrix", "forward_dynamics_derivatives"])
def test_a_call_finds_nothing_of_the_last_one(tree, name):
    q, qd = states(tree, 9)
    call = getattr(algorithms, name)
    more = {"bias": (qd,), "mass_matrix": ()}.get(name, (qd, 2.0 * qd))
    first = call(tree, q[:5], *(one[:5] for one in more))
    call(tree, q[5:], *(1e3 * one[5:] for one in more))
    for memories in _idle[kernel_model(tree)].values():
        for scratch in (one for memory in memories for one in memory._arrays.values()):
            scratch[:] = np.nan
    again = call(tree, q[:5], *(one[:5] for one in more))
    assert all(np.array_equal(*pair) for pair in zip(np.atleast_1d(first), np.atleast_1d(again), strict=True))


def test_threads_have_scratch_of_their_own(tree):
    q, _ = states(tree, 40)
    alone = [kinematics.forward_kinematics(tree, one) for one in q]
    with ThreadPoolExecutor(8) as threads:
        together = list(threads.map(lambda one: kinematics.forward_kinematics(tree, one), q))
    assert np.array_equal(alone, together)
