"""A loop through contacts: they are in the dynamics, so that every plan is made with them and none is scheduled."""

import numpy as np
import pytest
from places import ROOT

import planner

FORWARD = ROOT / "benchmarks" / "moving" / "monopod-forward.toml"  # half a metre


@pytest.fixture(scope="module")
def monopod():
    """A plan every other stage, as late: a control that were constant for so long would throw it off stiff ground."""
    return planner.Controller(planner.load_problem(FORWARD), rate=50.0, latency=0.02)


@pytest.mark.slow
def test_a_monopod_hops_on_from_where_it_landed_in_spite_of_pushes(monopod):
    """The second hop is solved from the first one's plan; solved anew it takes ten times as many iterations here."""
    first, x = monopod.plan, None
    for force in (20.0, -20.0):  # N for 0.1 s: 0.3 m/s of its 6.2 kg, of hops of 0.7 m/s
        loop = planner.simulate(
            monopod, latency=0.02, duration=1.5, start=x, pushes=[planner.Push("trunk", force, 0.4)]
        )
        # At its goal and at rest, within tolerances; for how long before depends on the hop, and so on the processor.
        np.testing.assert_allclose(loop.xs[-1, [0, 2, 3]], [0.5, 0.0, 0.15], atol=0.02)
        np.testing.assert_allclose(loop.xs[-1, 4:], 0.0, atol=0.05)
        assert (monopod.failures, monopod.plans) == (0, 74)  # of 75 begun
        assert loop.contact_force.min() == 0.0 < loop.contact_force.max()  # it leaves the ground
        x = loop.xs[-1] - np.array([0.5, *np.zeros(7)])
    assert len(monopod.plan.history) < len(first.history)


@pytest.mark.slow
def test_the_same_start_again_is_the_same_plan_whatever_was_before(monopod):
    plans = []
    for dx in (0.02, 0.05, 0.02):
        monopod.reset(monopod.problem.x0 + np.array([dx, *np.zeros(7)]))
        plans.append(monopod.plan.us)
    np.testing.assert_array_equal(plans[0], plans[2])
    assert not np.array_equal(plans[0], plans[1])
