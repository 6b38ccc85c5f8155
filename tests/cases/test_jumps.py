"""The first guess of a jump: crouch, push, parabola and landing, where a goal is in the air."""

from pathlib import Path

import numpy as np
import pytest

import planner
from planner.cases.problem_file import load, tasks
from planner.dynamics.contacts import contact_forces
from planner.dynamics.kinematics import center_of_mass
from planner.dynamics.protocol import rollout_states
from planner.problem.tasks.flight import _at_speed, flights_of, height_above_legs, jumping, phases_of_jumps
from planner.problem.tasks.gait import gait_of
from planner.problem.tasks.legs import points_of_feet, standing_feet

# A trunk of 3 kg on a vertical rail, and a leg of two links of 0.25 m, of which motors drive both hinges.
LEG = """<mujoco><compiler angle="radian"/><worldbody><geom type="plane" size="0 0 1"/>
  <body name="trunk" pos="0 0 0.44"><joint name="z" type="slide" axis="0 0 1"/>
    <geom type="box" size=".1 .06 .05" mass="3" contype="0" conaffinity="0"/>
    <body name="thigh"><joint name="hip" axis="0 1 0" range="-1.6 1.6"/>
      <geom type="capsule" fromto="0 0 0 0 0 -.25" size=".02" mass=".4" contype="0" conaffinity="0"/>
      <body name="shank" pos="0 0 -.25"><joint name="knee" axis="0 1 0" range="-2.4 0"/>
        <geom type="capsule" fromto="0 0 0 0 0 -.25" size=".015" mass=".2" contype="0" conaffinity="0"/>
        <geom name="foot" size=".03" pos="0 0 -.25" mass=".05"/></body></body></body></worldbody>
  <actuator><motor joint="hip" gear="30" ctrlrange="-1 1"/><motor joint="knee" gear="30" ctrlrange="-1 1"/></actuator>
  </mujoco>"""
START = 'model = "leg.xml"\nstart = { hip = 0.6, knee = -1.2 }\nduration = 1.2\n'
GOAL = "[[goal]]\njoints = { hip = 0.6, knee = -1.2 }\n"
THROUGH = '[[goal]]\nframe = "trunk"\nposition = [0, 0, 0.7]\ntime = 0.6\nthrough = true\n'
REACH = 0.53  # m, of the straight leg with its foot's radius


QUADRUPED = Path(__file__).parents[2] / "mjcf/quadruped/scene.xml"


def problem_of(tmp_path, text):
    (tmp_path / "leg.xml").write_text(LEG)
    (tmp_path / "p.toml").write_text(START + text)
    return load(tmp_path / "p.toml").problem


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The problem of a jump, the phases that were found for it, and how often its poses were sought."""
    phases, calls = [], []

    def kept(*arguments):
        phases.append(phases_of_jumps(*arguments))
        return phases[-1]

    with pytest.MonkeyPatch.context() as patch:
        original = tasks.poses_of
        patch.setattr(tasks, "poses_of", lambda *args, **named: calls.append(1) or original(*args, **named))
        patch.setattr(tasks, "phases_of_jumps", kept)
        return problem_of(tmp_path_factory.mktemp("jump"), THROUGH + GOAL), phases, len(calls)


@pytest.fixture(scope="module")
def jump(made):
    return made[0]


def test_flights_begin_and_end_on_the_ground():
    stands = np.array([1, 1, 0, 0, 1, 0, 1, 0], dtype=bool)[:, None]
    assert flights_of(stands) == [(1, 4), (4, 6)]  # the last one does not land
    assert flights_of(stands[2:]) == [(2, 4)]  # the first one did not start


def test_the_height_above_the_legs_is_that_above_the_straight_leg(jump):
    m, q = jump.dynamics.mechanism, jump.x0[:3].copy()
    feet, highest = standing_feet(m, q), 0.7 - 0.44  # of the trunk
    q[0] = 0.7 - 0.44  # of the slide: the file draws the trunk 0.44 m high
    found = height_above_legs(m, q, jump.x0[:3], feet, m.joint_range, highest)
    # Bisected to 1/64 of it; a foot that is 5 mm off is there.
    assert found == pytest.approx(0.7 - REACH, abs=highest / 64 + 6e-3)
    q[0] = 0.5 - 0.44
    assert height_above_legs(m, q, jump.x0[:3], feet, m.joint_range, 0.06) == 0.0


def test_a_jump_falls_freely_between_a_push_and_a_landing(jump):
    m, dt, N = jump.dynamics.mechanism, 0.01, 120
    feet = standing_feet(m, jump.x0[:3])
    q = np.tile(jump.x0[:3], (N + 1, 1))
    apex = 0.7 - 0.44
    q[:, 0] += (apex - q[0, 0]) * np.sin(np.pi * np.linspace(0.0, 1.0, N + 1)) ** 2
    places = np.tile(points_of_feet(m, q[:1], feet)[0], (N + 1, 1, 1))
    flights = [(40, 80)]  # 0.4 s: 9.81 0.4^2 / 8 = 0.196 m
    found = jumping(m, q, feet, places, flights, m.joint_range, dt)
    assert found is not None
    z = center_of_mass(m, found)[:, 2]
    np.testing.assert_allclose(np.diff(z, 2)[41:78] / dt**2, -9.81, rtol=1e-6)
    np.testing.assert_allclose(z[[0, -1]], center_of_mass(m, jump.x0[None, :3])[0, 2], atol=1e-3)
    assert z.max() == pytest.approx(center_of_mass(m, q)[60, 2], abs=2e-3)
    assert z[:40].min() < z[0] - 0.02  # it crouches
    # No speed jumps at the take-off: over a knot it changes by less than 3 g dt.
    assert np.abs(np.diff(z, 2)).max() / dt < 3.0 * 9.81 * dt
    on_ground = [*range(41), *range(80, N + 1)]
    away = points_of_feet(m, found[on_ground], feet)[0] - places[on_ground]
    assert np.linalg.norm(away, axis=2).max() < 6e-3
    # A flight of a second is 1.2 m high: the motion is not, and stays as it is.
    assert jumping(m, q, feet, places, [(10, 110)], m.joint_range, dt) is None


def test_a_flight_in_place_is_raised_to_a_parabola_from_where_the_machine_stands(jump):
    m, dt, N = jump.dynamics.mechanism, 0.01, 120
    feet = standing_feet(m, jump.x0[:3])
    q = np.tile(jump.x0[:3], (N + 1, 1))
    places = np.tile(points_of_feet(m, q[:1], feet)[0], (N + 1, 1, 1))
    given = (m, q, feet, places, [(40, 70)], m.joint_range, dt)
    assert jumping(*given) is None
    found = jumping(*given, lifted=True)
    assert found is not None
    z = center_of_mass(m, found)[:, 2]
    np.testing.assert_allclose(np.diff(z, 2)[41:68] / dt**2, -9.81, rtol=1e-6)
    np.testing.assert_allclose(z[[40, 70]], z[[0, -1]], atol=1e-3)
    assert z.max() - z[0] == pytest.approx(9.81 * 0.3**2 / 8, abs=1e-3)
    assert z[:40].min() < z[0] - 0.02  # it crouches


def test_a_jump_that_is_higher_than_its_legs_are_long_crouches_as_far_as_they_bend(jump):
    m, dt, N = jump.dynamics.mechanism, 0.02, 90
    feet, flight = standing_feet(m, jump.x0[:3]), (20, 70)
    q = np.tile(jump.x0[:3], (N + 1, 1))
    # 1 s: 9.81 / 8 = 1.23 m, two thirds of which are more than the leg's 0.53 m; it takes off 5 cm above the crouch.
    q[:, 0] += (9.81 / 8 + 0.05) * np.sin(np.pi * np.linspace(0.0, 1.0, N + 1)) ** 2
    places = np.tile(points_of_feet(m, q[:1], feet)[0], (N + 1, 1, 1))
    found = jumping(m, q, feet, places, [flight], m.joint_range, dt)
    assert found is not None
    z = center_of_mass(m, found)[:, 2]
    np.testing.assert_allclose(np.diff(z, 2)[21:68] / dt**2, -9.81, rtol=1e-6)
    on_ground = [*range(21), *range(70, N + 1)]
    away = points_of_feet(m, found[on_ground], feet)[0] - places[on_ground]
    assert np.linalg.norm(away, axis=2).max() < 6e-3


@pytest.fixture(scope="module")
def standing():
    """The quadruped and the state in which it stands."""
    mechanism = planner.Mechanism.from_mjcf(QUADRUPED, contacts="ground")
    return mechanism, planner.dynamics.static_equilibrium(mechanism, mechanism.keyframe("stand"))


def leap(m, x0, apex, N=120):
    """A trunk that goes 0.3 m ahead, in even steps to an apex knot and from it, and 0.15 m up there."""
    q = np.tile(x0[: m.nq], (N + 1, 1))
    s = np.interp(np.arange(N + 1), [0, apex, N], [0.0, 0.5, 1.0])
    q[:, 0] += 0.3 * s
    q[:, 2] += 0.15 * np.sin(np.pi * s) ** 2
    return q


def test_a_flight_that_is_not_in_the_middle_has_its_apex_where_the_motion_has_it(standing):
    (m, x0), dt, (a, b) = standing, 0.01, (30, 60)
    q, feet = leap(m, x0, 45), standing_feet(m, x0)
    paced = _at_speed(m, q, (a, b), [12, 20])
    np.testing.assert_allclose(paced[[0, 45, -1]], q[[0, 45, -1]], atol=1e-12)
    for knots in (slice(a, 46), slice(45, b + 1)):  # at one speed on its way up and at one on its way down
        speeds = np.linalg.norm(np.diff(paced[knots, :3], axis=0), axis=1)
        np.testing.assert_allclose(speeds, speeds.mean(), rtol=0.02)  # chords over corners of its way are shorter
    assert (
        np.ptp(paced[: a - 12, 0]) == np.ptp(paced[b + 20 :, 0]) == 0.0
    )  # it goes ahead when it is pushed, not before
    places = np.tile(points_of_feet(m, q[:1], feet)[0], (len(q), 1, 1))
    places[b:, :, 0] += 0.3
    found = jumping(m, q, feet, places, [(a, b)], m.joint_range, dt)
    assert found is not None
    assert found[45, 0] == pytest.approx(q[45, 0], abs=1e-12)


def test_a_machine_that_steps_before_it_jumps_goes_with_its_feet(standing):
    (m, x0), dt, (a, b) = standing, 0.01, (70, 100)
    q, feet = leap(m, x0, 85), standing_feet(m, x0)
    places = np.tile(points_of_feet(m, q[:1], feet)[0], (len(q), 1, 1))
    places[:, :, 0] += (q[:, 0] - q[0, 0])[:, None]
    places[a:, :, 0] = places[a, :, 0]
    places[b:, :, 0] += q[-1, 0] - q[a, 0]
    found = jumping(m, q, feet, places, [(a, b)], m.joint_range, dt)
    assert found is not None
    np.testing.assert_allclose(found[:, 0], q[:, 0], atol=1e-12)


def test_phases_are_those_of_a_parabola_to_the_goal(made):
    _, seen, _ = made
    first, flight, last = seen[0]
    assert first["stand"] == last["stand"] == ["shank"]
    assert flight["stand"] == []
    assert first["until"] + flight["until"] == pytest.approx(2 * 0.6)  # the goal's time is in the middle
    # 9.81 T^2 / 8 above the straight leg, and a twentieth of the height of the centre of mass (0.35 to 0.45 m) more.
    T = flight["until"] - first["until"]
    assert 0.7 - REACH + 0.01 < 9.81 * T**2 / 8 < 0.7 - REACH + 0.04
    assert len(gait_of(seen[0]).phases) == 3


def test_a_leg_of_two_hinges_jumps(jump):
    """From a guess that holds it the solve stays at 0.56 m and fails; a leg that reaches 0.53 m flies to 0.7 m."""
    plan = planner.solve(jump)
    assert plan.converged
    assert plan.total_iterations < 150  # 50 of them
    z = 0.44 + plan.xs[:, 0]
    assert z[60] == pytest.approx(0.7, abs=5e-3)
    depths = contact_forces(jump.dynamics.mechanism, plan.xs[:, :3], plan.xs[:, 3:]).depths.max(axis=1)
    assert np.count_nonzero(depths < 0.0) * jump.dynamics.dt > 0.2  # s, in the air


@pytest.mark.slow
def test_a_quadruped_jumps_from_its_guess(tmp_path):
    """Shooting that ends with the first rollout that closes the defects leaves it where it stands, at 0.32 m."""
    text = f'model = "{QUADRUPED}"\nstart = "stand"\nduration = 1.2\n'
    text += '[[goal]]\nframe = "trunk"\nposition = [0, 0, 0.45]\ntime = 0.6\nthrough = true\n'
    (tmp_path / "p.toml").write_text(text + '[[goal]]\njoints = "stand"\n')
    quadruped = load(tmp_path / "p.toml").problem
    xs = rollout_states(quadruped.dynamics, quadruped.x0, quadruped.us)
    assert xs[60, 2] == pytest.approx(0.45, abs=0.02)
    assert xs[-1, 2] == pytest.approx(xs[0, 2], abs=0.05)  # it lands
    depths = contact_forces(quadruped.dynamics.mechanism, xs[:, :19], xs[:, 19:]).depths.max(axis=1)
    assert np.count_nonzero(depths < 0.0) * quadruped.dynamics.dt > 0.15  # s, in the air
    plan = planner.solve(quadruped)
    assert plan.converged
    assert plan.total_iterations < 120  # 47 of them; 163 in four solves with softer ground


@pytest.mark.slow
def test_a_leap_goes_most_of_its_way_in_the_air(tmp_path):
    """Legs that stand until the trunk is nearly above its apex do not reach: it is to fly from where they do."""
    text = f'model = "{QUADRUPED}"\nstart = "stand"\nduration = 1.2\n'
    text += '[[goal]]\nframe = "trunk"\nposition = [0.15, 0, 0.45]\ntime = 0.6\nthrough = true\n'
    (tmp_path / "p.toml").write_text(text + '[[goal]]\nframe = "trunk"\nposition = [0.3, 0, 0.32]\n')
    problem = load(tmp_path / "p.toml").problem
    assert problem.us is not None
    xs = rollout_states(problem.dynamics, problem.x0, problem.us)
    depths = contact_forces(problem.dynamics.mechanism, xs[:, :19], xs[:, 19:]).depths.max(axis=1)
    air = np.flatnonzero(depths < 0.0)
    assert xs[60, :3] == pytest.approx([0.15, 0.0, 0.45], abs=0.04)
    assert xs[air[-1], 0] - xs[air[0], 0] > 0.12  # m, of 0.3; two thirds of the reference
    assert planner.solve(problem).converged


def test_the_poses_of_a_jump_are_sought_once(made):
    problem, _, times = made
    assert problem.us is not None
    assert times == 1


def test_who_says_how_to_begin_gets_it(tmp_path):
    held = problem_of(tmp_path, 'guess = "hold"\n' + THROUGH + GOAL)
    assert held.us is not None
    assert np.ptp(held.us, axis=0).max() == 0.0
