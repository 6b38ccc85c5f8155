"""Plans and problems pickle, and solves in threads are those made one after the other, to the last bit."""

import copy
import pickle
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import planner

CASES = {"hopper": {"height": 12.0}, "two-link": {"horizon": 100}}


def same(one, other):
    assert (one.status, one.cost, one.nit) == (other.status, other.cost, other.nit)
    assert all(np.array_equal(getattr(one, name), getattr(other, name)) for name in ("t", "xs", "us", "K"))


@pytest.mark.parametrize("case", CASES)
def test_solves_in_two_threads_are_those_made_one_after_the_other(case):
    problems = [planner.cases.build(case, **CASES[case]) for _ in range(4)]
    alone = [planner.solve(problem) for problem in problems]
    with ThreadPoolExecutor(2) as pool:
        for one, other in zip(alone, pool.map(planner.solve, problems), strict=True):
            same(one, other)
        for other in pool.map(planner.solve, [problems[0]] * 4):  # the same problem in several threads
            same(alone[0], other)


@pytest.mark.parametrize("case", CASES)
def test_problems_and_plans_pickle_and_copy(case):
    problem = planner.cases.build(case, **CASES[case])
    plan = planner.solve(problem)
    for made in (pickle.loads(pickle.dumps(problem)), copy.deepcopy(problem), copy.copy(problem)):
        same(plan, planner.solve(made))
    for made in (pickle.loads(pickle.dumps(plan)), copy.deepcopy(plan)):
        same(plan, made)
        assert made.to_bytes() == plan.to_bytes()


def test_a_proof_pickles():
    proof = planner.prove(planner.solve(planner.cases.hopper(height=10.0, duration=0.5, horizon=100)), rollouts=0)
    again = pickle.loads(pickle.dumps(proof))
    assert again.headline == proof.headline
    assert again.rows() == proof.rows()
