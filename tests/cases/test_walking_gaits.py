"""A gait in one line: which feet swing when, as a reference of the weights and the first guess; and what it refuses."""

import re

import numpy as np
import pytest
from places import ROOT

import planner
from planner.cases.problem_file import load
from planner.dynamics.contacts import contact_forces
from planner.dynamics.kinematics import center_of_mass, points_of
from planner.problem.costs.tracking import tracking_of
from planner.problem.default_weights import MOVING_SHARE
from planner.problem.reaching_cost import straight_reference
from planner.problem.tasks.gait import TURNS, Gait, gait_of

SCENE = ROOT / "mjcf" / "quadruped" / "scene.xml"
FEET = ("front_left", "front_right", "rear_left", "rear_right")
WALKING = f'model = "{SCENE}"\nstart = "stand"\ngoal = {{ root = [0.25, 0, 0.326, 1, 0, 0, 0] }}\nduration = 1.0\n'


def loaded(tmp_path, text):
    (tmp_path / "gait.toml").write_text(text)
    return load(tmp_path / "gait.toml").problem


def free(mechanism):
    """(nv, 2) ranges of joints that have none."""
    return np.tile([-np.inf, np.inf], (mechanism.nv, 1))


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
    xs, said, _ = Gait(kind).motion(mechanism, rows, dt, np.tile([-np.inf, np.inf], (mechanism.nv, 1)))
    places = feet_of(mechanism, xs)
    height = places[:, :, 2] - places[0, :, 2]
    swings = height > 1e-4  # the inverse kinematics resolves 1e-5 m
    begins = np.sum(swings[1:] & ~swings[:-1], axis=0)
    assert begins.min() == begins.max() == int(said.split()[1])  # "Gait: 3 cycles of ..."
    np.testing.assert_allclose(xs[[0, -1]], rows[[0, -1]], atol=1e-5)
    np.testing.assert_allclose(xs[:, 2:7], rows[:, 2:7])  # the trunk stays as high and as level
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
    places = feet_of(
        mechanism, Gait("trot").motion(mechanism, rows, dt, np.tile([-9.0, 9.0], (mechanism.nv, 1)), False)[0]
    )
    dragged = feet_of(mechanism, rows)
    ahead, stands = (dragged - places)[:, 0, 0], places[:, 0, 2] < places[0, 0, 2] + 1e-5
    edges = np.flatnonzero(np.diff(stands.astype(int)))  # lift-off, landing, lift-off, ...
    landing, leaving = edges[1] + 1, edges[2]
    assert ahead[landing] == pytest.approx(-ahead[leaving], abs=0.4 / 150)  # the motion of a stage


@pytest.mark.parametrize("kind", TURNS)
def test_strides_are_even(straight, kind):
    mechanism, rows, dt = straight
    feet = feet_of(mechanism, Gait(kind, stride=0.1).motion(mechanism, rows, dt, free(mechanism))[0])
    for k in range(4):
        x = feet[:, k, 0]
        stands = np.flatnonzero(np.abs(np.diff(x)) < 1e-5)  # the knots at which it stands
        holds = x[[part[len(part) // 2] for part in np.split(stands, np.flatnonzero(np.diff(stands) > 3) + 1)]]
        strides = np.diff(holds)
        assert len(strides) == 4  # 0.4 m in cycles of 0.1 m
        assert strides[1:-1] == pytest.approx(strides[1], rel=1e-3)  # the first and the last have a stance at rest


@pytest.mark.parametrize("kind", ["pace", "walk"])
def test_the_zero_moment_point_is_in_the_feet_that_stand(straight, kind):
    """c - h/g c'' of the reference's centre of mass c, by differences, beside the middle of the feet that stand."""
    mechanism, rows, dt = straight
    rows = rows[np.linspace(0.0, 150.0, 601).round().astype(int)]  # in 6 s, so that legs that swing push little
    rows[:, 0] = rows[0, 0] + 0.25 * (rows[:, 0] - rows[0, 0])
    xs = Gait(kind, stride=0.1).motion(mechanism, rows, dt, free(mechanism))[0]
    c, feet = center_of_mass(mechanism, xs[:, : mechanism.nq]), feet_of(mechanism, xs)
    h = c[0, 2] - feet[0, :, 2].mean()
    moment = c[1:-1] - h / 9.81 * np.diff(c, 2, axis=0) / dt**2
    stands = (feet[1:-1, :, 2] - feet[0, :, 2] < 1e-4)[:, :, None]
    some = ~stands.all(axis=(1, 2))
    middle = (stands * feet[1:-1]).sum(axis=1) / stands.sum(axis=1)
    aside = np.abs(moment - middle)[some, 1]
    # The jerk of c has a weight, so that the point rounds its corners, and legs that lean move c by a centimetre.
    # Without the shift the point is 0.1 m off on two feet of one side, and a third of that on three.
    assert np.median(aside) < 0.02
    np.testing.assert_allclose(c[[1, -2]], c[[0, -1]], atol=2e-5)  # at rest at both ends


def test_a_machine_that_hops_on_all_feet_goes_its_way(straight):
    """Nothing carries it while it flies: no zero-moment point says where its trunk is."""
    mechanism, rows, dt = straight
    feet = {f"{name}_shank": 0.0 for name in FEET}
    xs = Gait(feet=feet, stride=0.1).motion(mechanism, rows, dt, free(mechanism))[0]
    np.testing.assert_allclose(xs[:, :7], rows[:, :7])


def test_a_goal_that_is_too_high_for_legs_is_refused(tmp_path):
    high = WALKING.replace("0.326", "0.43") + 'gait = "trot"\nsettle = false\n'
    with pytest.raises(planner.PlannerError, match=r"further than its leg reaches .* a lower trunk at both ends"):
        loaded(tmp_path, high)


def test_a_walk_on_two_feet_may_have_a_stride(tmp_path):
    brisk = (
        STROLL.replace('"walk"', '{ kind = "walk", stride = 0.5 }').replace("3.5", "2.5").replace("0.3, 0,", "0.1, 0,")
    )
    problem = loaded(tmp_path, brisk)
    assert "1 cycles" in problem.parameters["resolved"]["reasons"]["gait"]


def test_a_trunk_is_lowered_where_legs_are_short(straight):
    mechanism, rows, dt = straight
    xs = gait_of({"kind": "trot", "stride": 0.4}).motion(mechanism, rows, dt, free(mechanism))[0]
    level = feet_of(mechanism, xs)[:, :, 2]
    assert level.min() > level[0].min() - 5e-3  # soles stay on the ground
    drop = rows[:, 2] - xs[:, 2]
    assert drop[[0, -1]] == pytest.approx(0.0, abs=1e-12)
    assert 1e-3 < drop.max() < 0.1
    assert np.abs(np.diff(drop, 2)).max() < 0.01 * drop.max()  # smoothly: its jump in speed would be 1/150 of it a knot


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


TURNED = f'''model = "{SCENE}"
start = "stand"
gait = "trot"
duration = 2.0
guess = "hold"
[[goal]]
frame = "trunk"
position = [{{x}}, 0, {{z}}]
orientation = {{{{ yaw = {{yaw}} }}}}
'''


@pytest.mark.parametrize(("x", "yaw"), [pytest.param(0.05, 0.0, marks=pytest.mark.slow), (0.0, 30.0),
                                         pytest.param(0.1, 90.0, marks=pytest.mark.slow)])  # fmt: skip
def test_feet_go_with_the_trunk_to_a_goal_within_their_reach(tmp_path, x, yaw):
    """The stance of the goal is that of the start, moved along the ground by the trunk's displacement and yaw."""
    problem = loaded(tmp_path, TURNED.format(x=x, z=0.31, yaw=yaw))
    mechanism, rows = problem.dynamics.mechanism, tracking_of(problem.cost).x_ref
    first, last = feet_of(mechanism, rows)[[0, -1]]
    c, s = np.cos(np.radians(yaw)), np.sin(np.radians(yaw))
    expected = np.array([x, 0.0]) + (first[:, :2] - rows[0, :2]) @ np.array([[c, s], [-s, c]])
    np.testing.assert_allclose(last[:, :2], expected, atol=5e-3)  # as exactly as a goal
    np.testing.assert_allclose(last[:, 2], first[:, 2], atol=1e-3)
    assert rows[-1, 2] == pytest.approx(0.31, abs=5e-3)  # the legs bend for it
    without = loaded(tmp_path, TURNED.format(x=x, z=0.31, yaw=yaw).replace('gait = "trot"\n', ""))
    if (x, yaw) != (0.1, 90.0):  # which legs do not reach from where they stand
        stays = feet_of(mechanism, tracking_of(without.cost).x_ref)[-1]
        np.testing.assert_allclose(stays, first, atol=2e-3)


def test_a_foot_that_no_phase_lifts_stays(tmp_path):
    lines = [f"[[phase]]\nuntil = {t}\nstand = {list(stand)}\n" for t, stand in ((0.5, LEGS), (1.2, DIAGONAL))]
    lines.append(f"[[phase]]\nstand = {list(LEGS)}\n")
    text = TURNED.format(x=0.05, z=0.32, yaw=0.0).replace('gait = "trot"\n', "")
    problem = loaded(tmp_path, text.replace("[[goal]]", "".join(lines) + "[[goal]]"))
    first, last = feet_of(problem.dynamics.mechanism, tracking_of(problem.cost).x_ref)[[0, -1]]
    moved = (last - first)[:, 0]
    np.testing.assert_allclose(moved, [0.0, 0.05, 0.05, 0.0], atol=5e-3)  # in the order of FEET


@pytest.mark.parametrize(
    ("gait", "message"),
    [
        ('"canter"', "gait is 'canter', expected one of: trot, walk"),
        ("3", "gait is 3, expected one of: trot"),
        ('{ kind = "trot", legs = 4 }', "a key of gait is 'legs'"),
        ('{ kind = "trot", feet = { trunk = 0.0 } }', "kind and feet, or neither"),
        ('{ kind = "trot", duty = 1.0 }', "duty of gait is 1.0"),
        ("{ feet = { front_left_shenk = 0.0 } }", "Did you mean 'front_left_shank'"),
        ("{ feet = { front_left_shank = 0.0 } }", "no turn of 'front_right_shank'"),
        ("{ feet = { front_left_shank = 2.0 } }", "the turn of front_left_shank is 2.0"),
        pytest.param('{ kind = "trot", stride = 2.0 }', "further than its leg reaches", marks=pytest.mark.slow),
    ],
)
def test_a_gait_that_cannot_be_meant_is_refused(tmp_path, gait, message):
    far = WALKING.replace("0.25", "0.9")
    with pytest.raises(planner.PlannerError, match=message):
        loaded(tmp_path, far + f"gait = {gait}\n")


BIPED = ROOT / "examples" / "tasks" / "biped.xml"
BENT = ", ".join(f"{side}_pitch = -0.3, {side}_knee = 0.6, {side}_ankle = -0.3" for side in ("left", "right"))
STROLL = f'''model = "{BIPED}"
start = {{ {BENT} }}
gait = "walk"
duration = 3.5
[[goal]]
frame = "trunk"
position = [0.3, 0, 0.845]
'''


def test_a_biped_shifts_its_weight_before_it_walks(tmp_path):
    problem = loaded(tmp_path, STROLL)
    mechanism, rows = problem.dynamics.mechanism, tracking_of(problem.cost).x_ref
    names = [mechanism.body_names[k] for k, body in enumerate(mechanism.bodies) if "foot" in mechanism.body_names[k]]
    feet = [mechanism.bodies[mechanism.body_names.index(name)].link for name in names]
    height = points_of(mechanism, rows[:, : mechanism.nq], np.array(feet), np.zeros((2, 3)))[0][:, :, 2]
    up = height - height[0] > 1e-3
    assert not np.any(up.all(axis=1))  # one foot at a time
    first = int(np.flatnonzero(up.any(axis=1))[0])
    falling = np.sqrt(center_of_mass(mechanism, rows[:1, : mechanism.nq])[0, 2] / 9.81)
    assert problem.dynamics.dt * first > 2.5 * falling  # SHIFT of 3, whose slow end is below 1 mm
    short = STROLL.replace("3.5", "2.0")
    with pytest.raises(planner.PlannerError, match=r"weight goes to one foot and back: expected more than 2\.\d s"):
        loaded(tmp_path, short)


@pytest.mark.slow
def test_a_biped_walks_from_a_line(tmp_path):
    plan = planner.solve(loaded(tmp_path, STROLL))
    assert plan.converged, plan
    proof = planner.prove(plan, rollouts=0)
    assert proof.passed, proof
    assert "slides" not in proof.headline


def test_a_machine_in_the_air_has_no_gait(straight):
    mechanism, rows, dt = straight
    lifted = rows.copy()
    lifted[:, 2] += 1.0
    with pytest.raises(planner.PlannerError, match=r"stands on no foot"):
        gait_of("trot").motion(mechanism, lifted, dt, np.tile([-9.0, 9.0], (mechanism.nv, 1)))


def test_a_file_without_a_floor_says_what_to_write(tmp_path):
    model = (ROOT / "examples" / "tasks" / "biped.xml").read_text()
    bare = re.sub(r'<geom name="floor"[^>]*>', "", model)
    assert bare != model
    (tmp_path / "biped.xml").write_text(bare)
    with pytest.raises(planner.PlannerError, match=r'no plane, .* expected one on the ground: a <geom type="plane"'):
        loaded(tmp_path, STROLL.replace(str(BIPED), "biped.xml"))


LEGS = tuple(f"{name}_shank" for name in FEET)
DIAGONAL = ("front_left_shank", "rear_right_shank")


def phases(*rows):
    """Lists of tables [[phase]] of (until, stand) rows, None for no end."""
    return [{**({} if t is None else {"until": t}), "stand": list(stand)} for t, stand in rows]


def test_phases_say_who_stands_when(straight):
    mechanism, rows, dt = straight
    ranges = np.tile([-np.inf, np.inf], (mechanism.nv, 1))
    given = phases((0.3, LEGS), (0.7, DIAGONAL), (None, LEGS))
    rows = rows.copy()
    rows[:, 0] = rows[0, 0] + 0.2 * (rows[:, 0] - rows[0, 0])  # 8 cm: what a leg reaches that stands all along
    xs, said, stances = gait_of(given).motion(mechanism, rows, dt, ranges)
    assert said.startswith("Gait: 3 phases")
    asked = [(one.name, one.spans, one.stand, set(one.swing)) for one in stances]
    assert asked == [
        ("phase 1", ((0.0, 0.3),), LEGS, set()),
        ("phase 2", ((0.3, 0.7),), DIAGONAL, set(LEGS) - set(DIAGONAL)),
        ("phase 3", ((0.7, np.inf),), LEGS, set()),
    ]
    places = feet_of(mechanism, xs)
    swings = places[:, :, 2] - places[0, :, 2] > 1e-4
    t = dt * np.arange(len(xs))
    for k, (begin, end) in enumerate([(9.0, 9.0), (0.3, 0.7), (0.3, 0.7), (9.0, 9.0)]):
        inside = (t > begin + 0.05) & (t < end - 0.05)  # 0.05 s from its ends it is 0.2 mm up or more
        np.testing.assert_array_equal(swings[:, k] & (t > begin) & (t < end), swings[:, k])
        assert np.all(swings[inside, k])
    np.testing.assert_allclose(places[-1, 1:3], feet_of(mechanism, rows)[-1, 1:3], atol=1e-4)  # those that stepped
    np.testing.assert_allclose(places[-1, [0, 3]], places[0, [0, 3]], atol=1e-4)


def test_a_foot_that_swings_to_the_end_stays_in_the_air(straight):
    mechanism, rows, dt = straight
    xs, *_ = gait_of(phases((0.3, LEGS), (None, LEGS[1:]))).motion(
        mechanism, lifted_foot(mechanism, rows), dt, np.tile([-np.inf, np.inf], (mechanism.nv, 1))
    )
    height = feet_of(mechanism, xs)[:, 0, 2]
    assert np.all(np.diff(height) > -1e-4)
    assert height[-1] - height[0] > 0.03  # the shank's turn by 0.6 rad lifts it by 0.2 m (cos a - cos(a + 0.6))


def lifted_foot(mechanism, rows):
    """States at which the front left knee bends by 0.6 rad more at the end."""
    bent = np.tile(rows[0], (len(rows), 1))
    knee = 6 + mechanism.joint_names.index("front_left_knee")  # a free joint has 7 positions
    bent[:, knee] -= 0.6 * np.linspace(0.0, 1.0, len(rows))
    return bent


@pytest.mark.slow
def test_a_step_by_phases_passes(tmp_path):
    text = WALKING.replace("0.25", "0.2").replace("1.0\n", "1.6\n")
    for t, stand in ((0.2, LEGS), (0.5, DIAGONAL), (0.6, LEGS), (0.9, LEGS[1:3]), (1.6, LEGS)):
        text += f"[[phase]]\nuntil = {t}\nstand = {list(stand)}\n"
    plan = planner.solve(loaded(tmp_path, text))
    proof = planner.prove(plan, rollouts=0)
    assert proof.passed, proof


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('[[phase]]\nstand = ["shank"]\n', r"a foot that stands in \[\[phase\]\] 1 is 'shank'"),
        ("[[phase]]\nstand = []\n[[phase]]\nstand = []\n", r"\[\[phase\]\] 1 has no `until`"),
        ("[[phase]]\nuntil = 0.5\n", r"stand of \[\[phase\]\] 1 is None"),
        ("[[phase]]\nuntil = 0.5\nstand = []\n", "the phases end at 0.5 s, expected times that grow to the duration"),
        (
            "[[phase]]\nfrom = 0.5\nstand = []\n",
            r"\[\[phase\]\] number 1 of .* has the key 'from', expected some of: until, stand",
        ),
        ('gait = "trot"\n[[phase]]\nstand = []\n', r"gait and \[\[phase\]\], expected one of them"),
    ],
)
def test_phases_that_cannot_be_meant_are_refused(tmp_path, text, message):
    with pytest.raises(planner.PlannerError, match=message):
        loaded(tmp_path, WALKING + text)


def test_a_flight_that_no_work_of_the_legs_pushes_is_refused(straight):
    """Of 15 s: v = g T / 2 = 73.6 m/s."""
    mechanism, rows, dt = straight
    still = np.tile(rows[0], (1501, 1))
    with pytest.raises(planner.PlannerError, match=r"\[\[phase\]\] 1 has no foot on the ground for 15 s.* 73\.6 m/s"):
        gait_of(phases((None, []))).motion(mechanism, still, dt, np.tile([-2.0, 2.0], (mechanism.nv, 1)))
