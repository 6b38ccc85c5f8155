"""A way that keeps closed chains closed, and the controls along it."""

from dataclasses import replace

import numpy as np
import pytest
from places import ROOT

from planner import Mechanism, Problem, RigidBodyDynamics, TrackingCost
from planner.dynamics import assembled
from planner.dynamics.loops import misses
from planner.dynamics.protocol import rollout_states
from planner.problem.tasks.reference_motion import closed_chain_reference
from planner.solvers.other_guesses import tracking_controls

EXAMPLES = ROOT / "examples" / "closed_chains"
MOVED = {"four_bar": {0: 1.0}, "two_arms": {0: 0.8}, "stewart": {0: 0.05, 2: 0.08}}


def way_of(name, N, duration=2.0, change=None):
    m = Mechanism.from_mjcf(EXAMPLES / f"{name}.xml", contacts="off")
    m = m if change is None else change(m)
    x0, goal = m.home.copy(), m.home.copy()
    x0 = assembled(m, x0)
    for dof, value in MOVED[name].items():
        goal[m.q_address[dof]] += value
    goal = assembled(m, goal, tuple(MOVED[name]))
    poses = np.stack([x0, goal])[:, : m.nq]
    dt = duration / N
    return (
        m,
        RigidBodyDynamics(m, dt),
        closed_chain_reference(m, x0, np.array([0, N]), poses, np.array([True, True]), dt),
        goal,
    )


@pytest.mark.parametrize("name", MOVED)
def test_it_leads_from_rest_to_rest_and_stays_closed(name):
    m, _, way, goal = way_of(name, 100)
    np.testing.assert_allclose(way.states[-1], goal, atol=1e-9)
    assert not np.any(way.states[[0, -1], m.nq :])
    # a spline between poses of at most 0.05 rad: its fourth order leaves 0.05^4 of a length of about 1 m, over 16
    assert max(np.abs(misses(m, x[: m.nq])).max() for x in way.states) < 1e-6


@pytest.mark.parametrize("name", MOVED)
def test_its_controls_move_the_machine_along_it(name):
    gaps = []
    for N in (100, 200):
        m, dynamics, way, _ = way_of(name, N)
        away = m.space.difference(dynamics.step(way.states[:-1], way.controls), way.states[1:])
        gaps.append(np.abs(away).max())
    assert gaps[0] < 0.01
    assert gaps[1] < gaps[0] / 3.0, gaps  # of third order, where the poses of the spline are close enough


def test_gains_along_it_keep_a_platform_that_would_fall_off():
    m, dynamics, way, goal = way_of("stewart", 200, duration=4.0)
    x0 = way.states[0]
    problem = Problem(dynamics, TrackingCost.joints(dynamics, goal, 200, effort=1e-3), x0)

    def strays(us):
        return np.abs(m.space.difference(rollout_states(dynamics, x0, us), way.states))[:, : m.nv].max()

    assert strays(tracking_controls(problem, way.states, way.controls)) < 0.005 < 0.1 < strays(way.controls)


def test_there_are_no_controls_where_actuators_do_not_move_every_way():
    def without_a_leg(m):
        return replace(m, actuators=replace(m.actuators, moment=m.actuators.moment * (np.arange(6) > 0)[:, None]))

    _, _, way, _ = way_of("stewart", 50, change=without_a_leg)
    assert way is not None
    assert way.controls is None
