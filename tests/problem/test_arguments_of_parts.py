"""What machines, costs and their functions are handed: what is none of what they take is one sentence."""

from pathlib import Path

import numpy as np
import pytest

import planner
from planner import FrameCost, FunctionDynamics, PlannerError, RigidBodyDynamics, TrackingCost
from planner.cases import two_link
from planner.costs import SumCost
from planner.dynamics.hopper import HopperDynamics

ARM = two_link(horizon=4).dynamics
Q, R = np.zeros((3, 2, 2)), np.ones((2, 1, 1))
STRAIGHT = np.zeros(4)
HORIZONS = "expected a whole number of at least 1 and at most 1000000."


def joints(**changes):
    return TrackingCost.joints(**{"machine": ARM, "goal": STRAIGHT, "horizon": 4, "effort": 1.0, **changes})


def hand(**changes):
    given = {"machine": ARM, "frame": ARM.mechanism.body_names[-1], "position": np.ones(3), "position_weight": 1.0}
    return FrameCost(**{**given, **changes})


WRONG = {
    "Q has shape (), expected (N+1, ndx, ndx).": lambda: TrackingCost(None, None),
    "R is not an array of numbers, expected shape (N, nu, nu).": lambda: TrackingCost(Q, R > 0.0),
    "space is 3, expected a StateSpace": lambda: TrackingCost(Q, R, space=3),
    "x_ref is True, expected numbers.": lambda: TrackingCost(Q, R, True),
    "u_ref is ['0'], expected numbers.": lambda: TrackingCost(Q, R, 0.0, ["0"]),
    "the machine is None, expected RigidBodyDynamics or a Mechanism.": lambda: joints(machine=None),
    "effort is True, expected numbers.": lambda: joints(effort=True),
    "effort is '1', expected numbers.": lambda: joints(effort="1"),
    "effort is ['1', '2'], expected numbers.": lambda: joints(effort=["1", "2"]),
    "final_position is array([ True, True]), expected numbers.": lambda: joints(final_position=np.ones(2, dtype=bool)),
    "velocity['shoulder'] is True, expected numbers.": lambda: joints(velocity={"shoulder": True}),
    "goal is not an array of numbers, expected shape (4,).": lambda: joints(goal=STRAIGHT > 0.0),
    f"horizon is {10**15}, {HORIZONS}": lambda: joints(horizon=10**15),
    f"horizon is {10**16}, {HORIZONS}": lambda: TrackingCost.reach([0.0], 10**16, final=1.0, effort=1.0),
    "effort has 1 entries in row 1 and 2 in row 2, expected rows of one length: write 1 in each.": lambda: (
        TrackingCost.reach([0.0], 2, final=1.0, effort=[[1.0], [1.0, 2.0]])
    ),
    "nu is True, expected a whole number of at least 1.": lambda: TrackingCost.reach(
        [0.0], 2, final=1.0, effort=1.0, nu=True
    ),
    "space is 'flat', expected a StateSpace": lambda: TrackingCost.reach([0.0], 2, final=1.0, effort=1.0, space="flat"),
    "a term of a cost is None, expected a cost with value() and quadratize().": lambda: SumCost(None),
    "frame is None, expected a Frame or the name of a site or body.": lambda: hand(frame=None),
    "position has 1 entries in row 1 and 2 in row 2, expected rows of one length: write 1 in each.": lambda: hand(
        position=[[1.0], [1.0, 2.0]]
    ),
    "position is [True, True, True], expected numbers.": lambda: hand(position=[True] * 3),
    "position_weight is True, expected numbers.": lambda: hand(position_weight=True),
    "mechanism is None, expected a Mechanism.": lambda: RigidBodyDynamics(None, 0.01),
    "dt is True, expected a finite number greater than 0.": lambda: RigidBodyDynamics(ARM.mechanism, True),
    "mechanism is [1], expected a Mechanism.": lambda: planner.dynamics.forward_dynamics([1], *np.zeros((3, 2))),
    "qd has 1 entries in row 1 and 2 in row 2, expected rows of one length: write 1 in each.": lambda: (
        planner.dynamics.bias(ARM.mechanism, np.zeros(2), [[1.0], [1.0, 2.0]])
    ),
    "q is not an array of numbers, expected shape (2,).": lambda: planner.dynamics.mass_matrix(
        ARM.mechanism, [True, False]
    ),
    "frame is ['hand'], expected one of: ": lambda: planner.dynamics.jacobian(ARM.mechanism, np.zeros(2), ["hand"]),
    "the model is a NoneType, expected MJCF text, the path of a file, a mujoco.MjSpec": (
        lambda: planner.Mechanism.from_mjcf(None)
    ),
}


@pytest.mark.parametrize("expected", WRONG)
def test_wrong_parts_are_refused_in_one_sentence(expected):
    with pytest.raises(PlannerError) as error:
        WRONG[expected]()
    assert str(error.value).startswith(expected)
    assert "\n" not in str(error.value)


def test_parts_and_problems_have_a_short_repr():
    crane = planner.load_problem(Path(__file__).parents[2] / "examples" / "crane.toml")
    assert repr(crane) == "Problem(crane: 200 stages of 0.02 s, nx 4, nu 1)"
    assert repr(crane.dynamics) == "RigidBodyDynamics(2 joints, rk4, dt 0.02)"
    assert repr(crane.cost) == "TrackingCost(N = 200)"
    mechanism = "Mechanism(2 degrees of freedom, 1 actuator, 2 bodies, joints: trolley, swing)"
    assert repr(crane.dynamics.mechanism) == mechanism  # type: ignore[attr-defined]
    assert repr(HopperDynamics(0.01)) == "HopperDynamics(rk4, dt 0.01)"
    pendulum = FunctionDynamics(lambda x, u: np.array([x[1], u[0] - x[0]]), 2, 1, 0.02)
    assert repr(pendulum) == "FunctionDynamics(nx 2, nu 1, rk4, dt 0.02)"
    plain = planner.Problem(
        pendulum, planner.costs.TrackingCost.reach([0.0, 0.0], 1, final=1.0, effort=1.0), [1.0, 0.0]
    )
    assert repr(plain) == "Problem(FunctionDynamics: 1 stage of 0.02 s, nx 2, nu 1)"
