"""The cost of staying at the goal is that of a longer horizon there."""

import numpy as np
import pytest

import planner
from planner.base.errors import PlannerError
from planner.problem.costs.tracking import TrackingCost
from planner.problem.reaching_cost import terminal_holding_cost
from planner.solvers.slq import solve

# A pendulum that stands on its head: unstable, so its end needs gains.
MAST = """<mujoco><worldbody><body><joint name="foot" axis="0 1 0" damping=".2"/>
  <geom type="capsule" fromto="0 0 0 0 0 1" size=".03" mass="2"/></body></worldbody>
  <actuator><motor joint="foot"/></actuator></mujoco>"""


@pytest.fixture(scope="module")
def dynamics():
    return planner.RigidBodyDynamics(planner.Mechanism.from_mjcf(MAST, contacts="off"), 0.01)


LAST = {"final_position": 0.04, "final_velocity": 0.005}  # of a stage: those on the way times dt


def cost_of(dynamics, N, **more):
    weights = {"effort": 0.01, "position": 4.0, "velocity": 0.5, **more}
    return TrackingCost.joints(dynamics, [0.0, 0.0], N, **weights)


def test_it_is_the_value_of_the_stages_that_follow(dynamics):
    """Half a second to the goal and half a second of staying: the first controls are those of one second."""
    x0 = np.array([1e-4, 0.0])  # where the dynamics are their linearization at the goal
    problem, longer = (
        planner.Problem(dynamics, cost, x0)
        for cost in (terminal_holding_cost(dynamics, cost_of(dynamics, 50), 0.5), cost_of(dynamics, 100, **LAST))
    )
    short, long = solve(problem), solve(longer)
    # The longer one ends with the weights of a stage, as staying begins with them.
    assert np.abs(short.K - long.K[:50]).max() < 1e-3 * np.abs(long.K[:50]).max()


def test_its_weights_are_added_to_the_final_ones(dynamics):
    plain, kept = cost_of(dynamics, 20), cost_of(dynamics, 20, final_position=100.0)
    P = terminal_holding_cost(dynamics, plain, 1.0).Q[-1]
    np.testing.assert_array_equal(terminal_holding_cost(dynamics, kept, 1.0).Q[-1], P + np.diag([100.0, 0.0]))
    assert np.linalg.eigvalsh(P).min() > 0.0
    assert terminal_holding_cost(dynamics, plain, 0.0) is plain


def test_it_is_a_number_of_seconds(dynamics):
    with pytest.raises(PlannerError, match="hold is -1, expected a finite number of at least 0"):
        terminal_holding_cost(dynamics, cost_of(dynamics, 20), -1)
    with pytest.raises(PlannerError, match="hold is 'long', expected a finite number"):
        terminal_holding_cost(dynamics, cost_of(dynamics, 20), "long")
