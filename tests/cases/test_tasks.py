"""Goals, waypoints and paths: what a file says becomes the cost, the plan meets it, and the proof judges each."""

import itertools
import pickle
from dataclasses import replace

import numpy as np
import pytest
from arms import ARM, START, hand, mechanism, write
from gradients import assert_gradients
from places import ROOT

import planner
from planner.base.gl import load_mujoco
from planner.cases.problem_file import load
from planner.dynamics.protocol import rollout_states
from planner.problem.goals import GoalCheck as Judged
from planner.problem.goals import between, goals_of, static_error
from planner.problem.rediscretize import finer
from planner.problem.tasks.poses import poses_of
from planner.problem.tasks.reference_motion import controls
from planner.problem.tasks.timed_task import task_of
from planner.proof.diagnostics import suggested_fixes
from planner.proof.replay_errors import misses
from planner.proof.replays.compiled_twin import CompiledTwin
from planner.proof.robustness.rollouts import Rollouts
from planner.proof.robustness.success import rule_of

mujoco = load_mujoco()

WAYPOINT, END = (0.2, 0.0, 0.1), (0.4, 0.0, 0.2)
MIDDLE = (float(hand(-2.0, -0.8)[0]), 0.0, float(hand(-2.0, -0.8)[1]))
WAY = (float(np.sin(-2.8)), 0.0, float(np.cos(-2.8)))  # the z axis of the hand there
GOALS = f"""
[[goal]]
frame = "hand"
position = {list(WAYPOINT)}
time = 0.4
through = true

[[goal]]
frame = "hand"
position = {list(MIDDLE)}
pointing = {{ axis = "z", to = {list(WAY)} }}
time = 0.7
tolerance = {{ position = 0.004, pointing = 0.05, velocity = 0.02 }}

[[goal]]
frame = "hand"
position = {list(END)}
tolerance = 0.001
"""


@pytest.fixture(scope="module")
def solved(tmp_path_factory):
    problem = load(write(tmp_path_factory.mktemp("task"), GOALS)).problem
    plan = planner.solve(problem)
    return plan, planner.prove(plan, rollouts=0)


def mujocos(plan, stage, frame="hand"):
    """Where MuJoCo has a site at a stage: place, the world's axes of the frame, speed."""
    model = mujoco.MjModel.from_xml_string(plan.twin.mjcf)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = np.split(plan.xs[stage], [model.nq])
    mujoco.mj_forward(model, data)
    velocity = np.empty(6)
    site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, frame)
    mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_SITE, site, velocity, 0)
    return data.site_xpos[site].copy(), data.site_xmat[site].reshape(3, 3).copy(), float(np.linalg.norm(velocity[3:]))


def test_the_plan_meets_every_goal_and_the_proof_says_so_by_name(solved):
    plan, proof = solved
    assert plan.success
    assert proof.passed, proof.reason
    goals = {one.name: one for one in goals_of(plan.problem, plan.xs) if one.alone}
    assert [(name, one.unit, one.tolerance) for name, one in goals.items()] == [
        ("position of hand at 0.4 s", "m", 0.005),
        ("position of hand at 0.7 s", "m", 0.004),
        ("pointing of hand at 0.7 s", "rad", 0.05),
        ("speed of hand at 0.7 s", "m/s", 0.02),
        ("position of hand", "m", 0.001),
    ]
    for section in (proof.goal, proof.your_file):
        rows = {one.name: one for one in section.measured}
        for name in goals:
            row = rows[f"replayed_{name.replace(' ', '_')}_miss"]
            assert row.passed
            assert row.unit == goals[name].unit
            assert row.bound == goals[name].tolerance
    assert "planned_angular_velocity_miss" in {one.name for one in proof.goal.measured}  # rest at the end
    assert "replayed_position_of_hand_at_0.4_s_miss" in str(proof.to_dict()["goal"])  # proof.json


def test_a_stop_is_weighed_as_its_goal_is_and_by_its_own_tolerance(tmp_path):
    """So that weights.goal, which a miss suggests, slows the frame down: by 1 / tolerance^2, as of all goals."""
    plain = GOALS.replace(", velocity = 0.02", "")  # 0.05 m/s

    def weight(goals, more=""):
        cost = load(write(tmp_path, goals + more)).problem.cost.costs[0]
        return cost.Q[35, 2:, 2:].diagonal() - cost.Q[34, 2:, 2:].diagonal()

    np.testing.assert_allclose(weight(plain, "[weights]\ngoal = 40.0\n"), 10.0 * weight(plain))
    np.testing.assert_allclose(weight(GOALS), (0.05 / 0.02) ** 2 * weight(plain))


def test_what_is_judged_is_what_mujoco_measures(solved):
    plan, _ = solved
    goals = {one.name: one for one in goals_of(plan.problem, plan.xs)}
    place, _, speed = mujocos(plan, 20)
    assert goals["position of hand at 0.4 s"].miss(plan.t, plan.xs) == pytest.approx(
        np.linalg.norm(place - WAYPOINT), abs=1e-12
    )
    assert speed > 0.2  # it is passed
    place, R, speed = mujocos(plan, 35)
    angle = np.arccos(R[:, 2] @ WAY)
    assert goals["pointing of hand at 0.7 s"].miss(plan.t, plan.xs) == pytest.approx(angle, abs=1e-9)
    assert goals["speed of hand at 0.7 s"].miss(plan.t, plan.xs) == pytest.approx(speed, abs=1e-12)
    assert goals["position of hand"].miss(plan.t, plan.xs) == pytest.approx(
        np.linalg.norm(mujocos(plan, 50)[0] - END), abs=1e-12
    )


def test_a_plan_that_misses_a_waypoint_fails_though_its_end_is_right(solved):
    plan, _ = solved
    problem = plan.problem
    moved = problem.parameters["goal"][0] | {"position": [0.2, 0.0, 0.12]}
    other = problem.recipe.rebuilt(goal=[moved, *problem.parameters["goal"][1:]])
    goals = goals_of(other, plan.xs)
    judged = {one.name: one for one in misses("planned", plan.t, plan.xs, goals)}
    assert not judged["planned_position_of_hand_at_0.4_s_miss"].passed
    assert judged["planned_position_of_hand_at_0.4_s_miss"].value == pytest.approx(0.02, abs=1e-3)
    assert judged["planned_position_of_hand_miss"].passed


def test_the_gradient_is_the_difference_of_the_value(solved):
    plan, _ = solved
    rng = np.random.default_rng(0)
    stages = slice(None, None, 5)
    problem = load_with(plan, dt=0.1)
    xs = plan.xs[stages] + rng.normal(scale=0.05, size=plan.xs[stages].shape)
    assert_gradients(problem.cost, problem.dynamics.space, xs, plan.us[stages])


def load_with(plan, **changes):
    resolved = plan.problem.parameters["resolved"]
    return plan.problem.recipe.rebuilt(**changes, resolved=resolved)


def test_the_cost_is_what_the_goals_ask_for_and_no_more(solved):
    """The value again, by hand: effort, speed, the goals at their stages, rest at the second goal and at the end."""
    plan, _ = solved
    problem, table = plan.problem, plan.problem.parameters
    weights = {name: np.array(value) for name, value in table["resolved"]["weights"].items()}
    total = 0.5 * 0.02 * np.sum(weights["effort"] * plan.us**2)
    total += 0.5 * 0.02 * np.sum(weights["velocity"] * plan.xs[:-1, 2:] ** 2)
    total += 0.5 * np.sum(weights["final_velocity"] * plan.xs[-1, 2:] ** 2)
    total += 0.5 * np.sum(10.0 / 0.1**2 * plan.xs[35, 2:] ** 2)
    place, R, _ = mujocos(plan, 35)
    total += 0.5 * 4.0 / 0.004**2 * np.sum((place - MIDDLE) ** 2)
    total += 0.5 * 4.0 / 0.05**2 * np.sum((R[:, 2] - WAY) ** 2)
    total += 0.5 * 4.0 / 0.005**2 * np.sum((mujocos(plan, 20)[0] - WAYPOINT) ** 2)
    total += 0.5 * 4.0 / 0.001**2 * np.sum((mujocos(plan, 50)[0] - END) ** 2)
    assert problem.cost.value(plan.xs, plan.us) == pytest.approx(total, rel=1e-9)


def test_a_stored_plan_is_the_same_task(solved, tmp_path):
    plan, proof = solved
    plan.save(tmp_path / "plan.npz")
    stored = planner.load_plan(tmp_path / "plan.npz")
    told = [[one[:2] + one[3:] for one in problem.goal_specs] for problem in (stored.problem, plan.problem)]
    assert told[0] == told[1]
    np.testing.assert_array_equal(stored.problem.first_guess, plan.problem.first_guess)
    assert stored.problem.cost.value(plan.xs, plan.us) == plan.problem.cost.value(plan.xs, plan.us)
    assert planner.prove(stored, rollouts=0).to_dict()["goal"] == proof.to_dict()["goal"]


def test_at_a_finer_step_goals_are_at_the_same_times(solved):
    plan, _ = solved
    problem = finer(plan.problem)
    assert problem.N == 100
    assert [one.times for one in problem.goal_specs] == [one.times for one in plan.problem.goal_specs]


def test_a_task_is_pickled_for_several_starts(solved):
    plan, _ = solved
    copy = pickle.loads(pickle.dumps(plan.problem))
    for one, other in zip(goals_of(copy, plan.xs), goals_of(plan.problem, plan.xs), strict=True):
        assert one.miss(plan.t, plan.xs) == other.miss(plan.t, plan.xs)


def test_python_says_the_same_as_a_file(solved):
    plan, _ = solved
    goals = [
        planner.Goal(frame="hand", position=WAYPOINT, time=0.4, through=True),
        planner.Goal(
            frame="hand", position=np.array(MIDDLE), pointing={"to": WAY}, time=0.7,
            tolerance={"position": 0.004, "pointing": 0.05, "velocity": 0.02},
        ),
        planner.Goal(frame="hand", position=END, tolerance=0.001),
    ]  # fmt: skip
    problem = planner.task(mechanism(), np.array([0.5, -1.0]), goals, duration=1.0, dt=0.02)
    np.testing.assert_array_equal(problem.first_guess, plan.problem.first_guess)
    np.testing.assert_array_equal(planner.solve(problem).us, plan.us)
    one = planner.task(mechanism(), START, goals[2], duration=1.0, dt=0.02, limits="off")
    assert one.limits is None or one.bounds is None
    for wrong, fragments in (({"goal": []}, "goal is a key of a file"), ({"goals": 3}, "goals is 3")):
        with pytest.raises(planner.PlannerError, match=fragments):
            planner.task(mechanism(), START, **({"goals": goals} | wrong), duration=1.0)


def test_joints_at_times_and_a_goal_passed_at_the_end(tmp_path):
    text = """
[[goal]]
joints = { elbow = 0.5 }
time = 0.5
through = true
[[goal]]
joints = "bent"
time = 0.8
[[goal]]
frame = "hand"
position = [0.4, 0, 0.2]
through = true
"""
    problem = load(write(tmp_path, text)).problem
    plan = planner.solve(problem)
    proof = planner.prove(plan, rollouts=0)
    assert proof.passed, proof.reason
    assert [one.name for one in goals_of(problem)] == [
        "elbow at 0.5 s", "shoulder at 0.8 s", "elbow at 0.8 s", "position of hand"
    ]  # fmt: skip
    np.testing.assert_allclose(plan.xs[40], [0.5, -1.0, 0.0, 0.0], atol=5e-3)
    assert mujocos(plan, 50)[2] > 0.5  # it does not stop at the end


def test_a_path_of_the_hand_is_followed_all_along(tmp_path):
    rows = [[0.4 + 0.006 * k, 0.25, 0.0, -0.1 + 0.003 * k] for k in range(101)]
    (tmp_path / "line.csv").write_text(
        "t,x,y,z\n" + "\n".join(",".join(map(str, row)) for row in rows), encoding="utf-8"
    )
    text = '[follow]\nframe = "hand"\nfile = "line.csv"\ntolerance = 0.004'
    problem = load(write(tmp_path, text)).problem
    (tmp_path / "line.csv").unlink()  # the plan holds the points
    plan = planner.solve(problem)
    proof = planner.prove(plan, rollouts=0)
    assert proof.passed, proof.reason
    (path,) = [one for one in goals_of(problem, plan.xs) if one.alone]
    assert (path.name, path.unit, path.tolerance) == ("path of hand", "m", 0.004)
    away = [np.linalg.norm(mujocos(plan, n)[0] - [0.25, 0.0, -0.1 + 0.003 * (n - 20) / 0.3]) for n in range(20, 51)]
    assert max(away) - 1e-12 <= path.miss(*plan.judged_motion) < 0.004  # between the stages too
    off = plan.xs.copy()
    off[33, 0] += 0.05
    assert path.miss(plan.t, off) > 0.01  # one stage is enough


def test_a_motion_of_joints_is_followed(tmp_path):
    t = np.linspace(0.0, 1.0, 26)
    s = 10 * t**3 - 15 * t**4 + 6 * t**5
    rows = "\n".join(f"{a:.6f},{0.5 + b:.9f},{-1.0 + 0.5 * b:.9f}" for a, b in zip(t, s, strict=True))
    (tmp_path / "motion.csv").write_text(f"t,shoulder,elbow\n{rows}\n", encoding="utf-8")
    problem = load(write(tmp_path, '[follow]\nfile = "motion.csv"\ntolerance = 0.01')).problem
    plan = planner.solve(problem)
    at = np.interp(plan.t, t, s)
    assert np.abs(plan.xs[:, :2] - np.stack([0.5 + at, -1.0 + 0.5 * at], axis=1)).max() < 0.01
    paths = [one for one in goals_of(problem, plan.xs) if one.alone]
    assert [(path.name, path.unit) for path in paths] == [("path of shoulder", "rad"), ("path of elbow", "rad")]
    proof = planner.prove(plan, rollouts=0)
    assert proof.passed
    measured = {one.name: one.value for one in proof.goal.measured}
    for k, path in enumerate(paths):  # each joint's own largest error, in the plan and in MuJoCo
        off = np.abs(plan.xs[:, k] - np.stack([0.5 + at, -1.0 + 0.5 * at])[k]).max()
        assert measured[f"planned_{path.name.replace(' ', '_')}_miss"] == pytest.approx(off, abs=2e-3)


def test_a_recording_to_follow_has_its_own_duration(tmp_path):
    (tmp_path / "motion.csv").write_text("t,shoulder,elbow\n0,0.5,-1\n0.7,0.8,-0.9\n1.3,0.9,-0.8\n", encoding="utf-8")
    path = write(tmp_path, '[follow]\nfile = "motion.csv"', duration=1.4)
    asked = path.read_text(encoding="utf-8")
    assert load(path).problem.duration == pytest.approx(1.4)  # as the file says
    without = [line for line in asked.splitlines() if not line.startswith(("duration", "dt"))]
    path.write_text("\n".join(without), encoding="utf-8")
    assert load(path).problem.duration == pytest.approx(1.3)


def test_points_without_times_are_spread_over_the_duration_slow_at_both_ends():
    here = hand(0.5, -1.0)
    points = [[here[0] + 0.1 * k / 4, 0.0, here[1]] for k in range(5)]
    problem = planner.task(
        mechanism(), START, follow=planner.Follow(frame="hand", points=points), duration=1.0, dt=0.02
    )
    plan = planner.solve(problem)
    assert planner.prove(plan, rollouts=0).passed
    np.testing.assert_allclose(mujocos(plan, 25)[0][0], here[0] + 0.05, atol=1e-3)
    assert mujocos(plan, 50)[2] < 0.05


def test_a_crane_is_led_to_its_hook_and_swings_no_more_than_it_must(tmp_path):
    """No motor drives the swing: the pose has it hanging, and the first guess is led."""
    text = f'model = "{ROOT / "examples" / "crane.xml"}"\ncontacts = "off"\nstart = {{}}\nduration = 4.0\ndt = 0.02\n'
    text += '[[goal]]\nframe = "hook"\nposition = [1.5, 0, 0.85]\n'
    (tmp_path / "crane.toml").write_text(text, encoding="utf-8")
    plan = planner.solve(load(tmp_path / "crane.toml").problem)
    proof = planner.prove(plan, rollouts=0)
    assert proof.passed, proof.reason
    np.testing.assert_allclose(plan.xs[-1], [1.5, 0.0, 0.0, 0.0], atol=0.02)


def test_two_hands_meet(tmp_path):
    two = ARM.replace('<body name="upper">', '<body name="upper" pos="-0.3 0 0">')
    body = two[two.index("<body") : two.index("  </worldbody>")]
    other = body.replace("-0.3 0 0", "0.3 0 0", 1)
    for name in ("upper", "lower", "shoulder", "elbow", "hand"):
        other = other.replace(f'"{name}"', f'"other_{name}"')
    motors = "".join(f'<motor joint="other_{name}" ctrlrange="-30 30"/>' for name in ("shoulder", "elbow"))
    two = two.replace(body, body + other).replace("</actuator>", motors + "</actuator>")
    two = two[: two.index("<keyframe>")] + "</mujoco>"
    goals = [planner.Goal(frame=name, position=(0.0, 0.0, -0.3)) for name in ("hand", "other_hand")]
    start = {"shoulder": -0.5, "elbow": 1.0, "other_shoulder": 0.5, "other_elbow": -1.0}
    problem = planner.task(planner.Mechanism.from_mjcf(two), start, goals, duration=1.0, dt=0.02)
    plan = planner.solve(problem)
    assert planner.prove(plan, rollouts=0).passed
    meet = [mujocos(plan, 50, name)[0] for name in ("hand", "other_hand")]
    np.testing.assert_allclose(meet[0], meet[1], atol=1e-3)


def test_a_guess_through_poses_stays_on_its_way_where_the_machine_is_unstable(tmp_path):
    up = "[[goal]]\njoints = { shoulder = 2.9, elbow = 0.0 }\ntime = 0.8\n"
    up += "[[goal]]\njoints = { shoulder = 2.8, elbow = 0.5 }\n"
    long = load(write(tmp_path, up, duration=6.0, start="[2.5, 0.5]")).problem
    falls, stays = (rollout_states(long.dynamics, long.x0, us) for us in (line_of(long), long.first_guess))
    assert np.abs(falls[-1, :2] - [2.8, 0.5]).max() > 0.5
    assert np.abs(stays[-1, :2] - [2.8, 0.5]).max() < 0.1


def line_of(problem):
    """The controls of inverse dynamics alone."""
    goals = [planner.Goal(**one) for one in problem.parameters["goal"]]
    dynamics = problem.dynamics
    task = task_of(dynamics.mechanism, goals, [], problem.N, dynamics.dt)
    return controls(task, poses_of(task, dynamics, problem.x0, dynamics.mechanism.joint_range), dynamics, problem.x0)


def test_a_weight_that_is_too_small_is_raised_by_its_cure(tmp_path):
    text = f'[[goal]]\nframe = "hand"\nposition = {list(END)}\n[weights]\ngoal = 1e-4\n'
    plan = planner.solve(load(write(tmp_path, text)).problem)
    proof = planner.prove(plan, rollouts=0)
    assert not proof.passed
    found = next(one for one in suggested_fixes(plan, proof) if one.key == "weights.goal")
    table = {name: value for name, value in plan.problem.parameters.items() if name != "resolved"}
    again = planner.solve(plan.problem.recipe.build(**found.applied(table)))
    assert goals_of(again.problem)[0].miss(again.t, again.xs) < 0.005


def test_rest_at_the_end_has_a_cure_of_its_own(tmp_path):
    text = f'[[goal]]\nframe = "hand"\nposition = {list(END)}\n[weights]\nfinal_velocity = 1e-4\n'
    plan = planner.solve(load(write(tmp_path, text)).problem)
    keys = [one.key for one in suggested_fixes(plan, planner.prove(plan, rollouts=0))]
    assert "weights.final_velocity" in keys
    assert "weights.goal" not in keys


def test_perturbed_rollouts_succeed_by_every_goal_at_its_time(solved):
    plan, _ = solved
    rule, stages = rule_of(plan), np.union1d(np.arange(0, 51, 2), 35)
    assert rule.follows is not None
    assert "every goal at its time" in rule.words
    good = np.tile(plan.xs[stages], (3, 1, 1))
    good[1, 10, 0] += 0.5  # at 0.4 s, the waypoint
    good[2, -1, 0] += 0.5  # the end
    model = CompiledTwin(plan.twin)
    assert {20, 35} <= set(Rollouts(replace(plan, problem=plan.problem), model).knots)
    assert rule.follows(good, plan.xs[stages], stages).tolist() == [True, False, False]


def test_states_between_are_on_lines_and_at_knots_the_knots():
    t, xs = 0.1 * np.arange(5), np.arange(10.0).reshape(5, 2) ** 2
    np.testing.assert_array_equal(between(t, xs, t), xs)
    np.testing.assert_allclose(between(t, xs, np.array([0.25])), 0.5 * (xs[2:3] + xs[3:4]))
    many = np.stack([xs, 2.0 * xs])
    np.testing.assert_allclose(
        between(t, many, np.array([0.0, 0.33])), [between(t, x, np.array([0.0, 0.33])) for x in many]
    )


def test_a_goal_over_times_counts_its_largest_miss():
    goal = Judged("path", "m", 1.0, lambda xs: np.abs(xs[:, 0] - [1.0, 2.0]), (0.1, 0.2))
    assert goal.miss(np.array([0.0, 0.1, 0.2]), np.array([[0.0], [1.5], [2.1]])) == pytest.approx(0.5)
    assert static_error(goal, np.array([0.0])) == 2.0


def test_orientations_are_given_by_quaternions_or_in_degrees():
    turned = planner.Goal(frame="hand", orientation={"roll": 180, "yaw": 90}).quaternion
    x, y, z = (planner.problem.costs.residual_functions.rotation_of(turned) @ e for e in np.eye(3))
    np.testing.assert_allclose([x, y, z], [[0, 1, 0], [1, 0, 0], [0, 0, -1]], atol=1e-15)
    for given, one in itertools.product(([0, 1, 1, 0], [0, 2, 2, 0]), (turned,)):
        own = planner.Goal(frame="hand", orientation=given).quaternion
        np.testing.assert_allclose(abs(own @ one), 1.0)
