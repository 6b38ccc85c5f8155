"""Plans that several tests of perturbed rollouts share."""

from dataclasses import replace

import numpy as np
import pytest
from rolled_out_plans import tree_plan

import planner


@pytest.fixture(scope="module")
def arm():
    """Half as long as the case: what rollouts take is theirs, and nothing asserted of them depends on it."""
    return planner.solve(planner.cases.two_link(duration=1.0, horizon=50))


@pytest.fixture(scope="module")
def tree():
    """A tree with quaternions and gains that do something."""
    plan = tree_plan("rk4", N=12)
    K = 0.05 * np.random.default_rng(5).normal(size=plan.K.shape)
    return replace(plan, K=K)
