"""A gait in one line: which feet swing when, as a reference of the weights and the first guess; and what it refuses."""

import numpy as np
import pytest
from places import ROOT

import planner
from planner.cases.problem_file import load
from planner.dynamics.contacts import contact_forces
from planner.dynamics.kinematics import points_of
from planner.problem.costs.tracking import tracking_of
from planner.problem.default_weights import MOVING_SHARE, straight_reference
from planner.problem.tasks.gait import TURNS, Gait, gait_of

SCENE = ROOT / "mjcf" / "quadruped" / "scene.xml"
FEET = ("front_left", "front_right", "rear_left", "rear_right")
WALKING = f'model = "{SCENE}"\nstart = "stand"\ngoal = {{ root = [0.25, 0, 0.326, 1, 0, 0, 0] }}\nduration = 1.0\n'


def loaded(tmp_path, text):
    (tmp_path / "gait.toml").write_text(text)
    return load(tmp_path / "gait.toml").problem


@pytest.fixture(scope="module")
def straight():
    """The quadruped's mechanism, states of a trunk that goes 0.4 m forwards in 1.5 s with its feet dragged, and dt."""
    mechanism = planner.Mechanism.from_mjcf(SCENE, contacts="ground")
    dynamics = planner.RigidBodyDynamics(mechanism, dt=0.01)
    x0 = planner.dynamics.static_equilibrium(mechanism, mechanism.keyframe("stand"))
    goal = x0.copy()
    goal[0] += 0.4
    return mechanism, straight_reference(dynamics, x0, goal, 150), dynamics.dt


def feet_of(mechanism, xs):
    """(N+1, 4, 3) m: the centres of the feet, in the order of FEET."""
    links = np.array([one.link for one in mechanism.contacts])
    return points_of(mechanism, xs[:, : mechanism.nq], links, np.array([one.centre for one in mechanism.contacts]))[0]


@pytest.mark.parametrize("kind", TURNS)
def test_feet_stand_and_swing_in_turn(straight, kind):
    mechanism, rows, dt = straight
    xs, said = Gait(kind).motion(mechanism, rows, dt, np.tile([-np.inf, np.inf], (mechanism.nv, 1)))
    places = feet_of(mechanism, xs)
    height = places[:, :, 2] - places[0, :, 2]
    swings = height > 1e-4  # the inverse kinematics resolves 1e-5 m
    begins = np.sum(swings[1:] & ~swings[:-1], axis=0)
    assert begins.min() == begins.max() == int(said.split()[1])  # "Gait: 3 cycles of ..."
    np.testing.assert_allclose(xs[[0, -1]], rows[[0, -1]], atol=1e-5)
    np.testing.assert_allclose(xs[:, :7], rows[:, :7])  # the trunk goes its way
    assert height.min() > -1e-4
    assert height.max() == pytest.approx(0.055, abs=0.01)  # a fifth of the height of the centre of mass
    moved = np.linalg.norm(np.diff(places, axis=0)[:, :, :2], axis=2)
    assert moved[~(swings[1:] | swings[:-1])].max() < 2e-3  # within the slow ends of a swing, below 1e-4 m
    fl, fr, rl, rr = swings.T
    together = {"trot": [(fl, rr), (fr, rl)], "bound": [(fl, fr), (rl, rr)], "pace": [(fl, rl), (fr, rr)], "walk": []}
    for one, other in together[kind]:
        np.testing.assert_array_equal(one, other)
    most = 1 if kind == "walk" else 2
    assert swings.sum(axis=1).max() == most
    assert not swings[int(MOVING_SHARE * 150) + 2 :].any()


def test_the_body_passes_over_a_standing_foot_symmetrically(straight):
    """At a constant speed: hips are ahead of a foot at its lift-off by what they are behind at its landing."""
    mechanism, rows, dt = straight
    rows = rows.copy()
    rows[:, 0] = rows[0, 0] + np.linspace(0.0, 0.4, len(rows))
    places = feet_of(mechanism, Gait("trot").motion(mechanism, rows, dt, np.tile([-9.0, 9.0], (mechanism.nv, 1)))[0])
    dragged = feet_of(mechanism, rows)
    ahead, stands = (dragged - places)[:, 0, 0], places[:, 0, 2] < places[0, 0, 2] + 1e-5
    edges = np.flatnonzero(np.diff(stands.astype(int)))  # lift-off, landing, lift-off, ...
    landing, leaving = edges[1] + 1, edges[2]
    assert ahead[landing] == pytest.approx(-ahead[leaving], abs=0.4 / 150)  # the motion of a stage


def test_a_quadruped_trots_from_a_line(tmp_path):
    problem = loaded(tmp_path, WALKING + 'gait = "trot"\n')
    weights = problem.parameters["resolved"]["weights"]
    assert "rest" not in weights
    assert np.all(np.array(weights["position"]) > 0.0)
    plan = planner.solve(problem)
    assert plan.converged, plan
    assert plan.nit < 60  # without softer ground; it takes about 20
    mechanism, nq = problem.dynamics.mechanism, problem.dynamics.mechanism.nq
    loads = contact_forces(mechanism, plan.xs[:, :nq], plan.xs[:, nq:]).forces[:, :, 2] > 0.0
    fl, fr, rl, rr = loads.T
    assert np.sum(fl & rr & ~fr & ~rl) > 10  # stages on one diagonal; a pair swings for 0.13 s or more, twice
    assert np.sum(fr & rl & ~fl & ~rr) > 10
    again = problem.recipe.rebuilt()
    np.testing.assert_array_equal(again.first_guess, problem.first_guess)


@pytest.mark.slow
def test_trotting_half_a_metre_passes():
    plan = planner.solve(planner.load_problem(ROOT / "benchmarks" / "moving" / "quadruped-trot.toml"))
    proof = planner.prove(plan, rollouts=0)
    assert proof.passed, proof
    assert "slides" not in proof.headline


def test_turns_of_feet_are_the_gait_of_that_name(straight):
    mechanism, rows, dt = straight
    feet = {f"{name}_shank": 0.5 * (name in ("front_right", "rear_left")) for name in FEET}
    ranges = np.tile([-np.inf, np.inf], (mechanism.nv, 1))
    named, listed = (gait_of(one).motion(mechanism, rows, dt, ranges)[0] for one in ("trot", {"feet": feet}))
    np.testing.assert_array_equal(named, listed)


def test_goals_of_frames_have_a_gait_too(tmp_path):
    goal = '[[goal]]\nframe = "trunk"\nposition = [0.25, 0, 0.326]\norientation = [1, 0, 0, 0]\n'
    problem = loaded(tmp_path, WALKING.replace("goal", "#") + 'gait = "trot"\n' + goal)
    weights = problem.parameters["resolved"]["weights"]
    assert "rest" not in weights
    assert weights["hold"] > 0.0
    swings = feet_of(problem.dynamics.mechanism, tracking_of(problem.cost).x_ref)[:, :, 2] > 0.05
    assert np.all(swings.any(axis=0))  # of 0.055 m, at the middle of each swing


@pytest.mark.parametrize(
    ("gait", "message"),
    [
        ('"canter"', "gait is 'canter', expected one of: trot, walk"),
        ("3", "gait is 3, expected one of trot"),
        ('{ kind = "trot", legs = 4 }', "a key of gait is 'legs'"),
        ('{ kind = "trot", feet = { trunk = 0.0 } }', "kind and feet, or neither"),
        ('{ kind = "trot", duty = 1.0 }', "duty of gait is 1.0"),
        ("{ feet = { front_left_shenk = 0.0 } }", "Did you mean 'front_left_shank'"),
        ("{ feet = { front_left_shank = 0.0 } }", "no turn of 'front_right_shank'"),
        ("{ feet = { front_left_shank = 2.0 } }", "the turn of front_left_shank is 2.0"),
        ('{ kind = "trot", stride = 2.0 }', "further than its leg reaches"),
    ],
)
def test_a_gait_that_cannot_be_meant_is_refused(tmp_path, gait, message):
    far = WALKING.replace("0.25", "0.9")
    with pytest.raises(planner.PlannerError, match=message):
        loaded(tmp_path, far + f"gait = {gait}\n")


def test_a_machine_in_the_air_has_no_gait(straight):
    mechanism, rows, dt = straight
    lifted = rows.copy()
    lifted[:, 2] += 1.0
    with pytest.raises(planner.PlannerError, match=r"stands on no foot"):
        gait_of("trot").motion(mechanism, lifted, dt, np.tile([-9.0, 9.0], (mechanism.nv, 1)))
