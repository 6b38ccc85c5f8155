"""Loops in MuJoCo: latency, pushes, masses, sensors; their verdicts; the command."""

import copy
import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from commands import refused, run
from places import ROOT

import planner
from planner.base.errors import PlannerError
from planner.cli.driving import _advice, latency_of
from planner.control.judging import CallTimes, judge, passes_disturbed
from planner.control.loop_margins import fitting_rate, margins
from planner.model.mjcf.model_index import compile_model
from planner.proof.robustness.perturbation import Push, pushed_step

N = 40  # of conftest.py


def test_a_loop_arrives_and_stays_and_is_the_same_again(controller):
    loop = planner.simulate(controller, latency=0.004)
    verdict = judge(loop)
    assert verdict.passed, verdict.rows()
    assert verdict.headline.startswith("PASS (loop); arrives, stays")
    assert loop.t[-1] == pytest.approx(4.0)  # the task of 2 s, one to be late and one to stay
    assert len(loop.call_seconds) == 80
    again = planner.simulate(controller, latency=0.004)
    np.testing.assert_array_equal(loop.xs, again.xs)
    np.testing.assert_array_equal(loop.ctrl, again.ctrl)
    assert loop.plan.N == 80
    assert np.isfinite(loop.cost)
    assert json.dumps(verdict.to_dict())
    assert "PASS" in loop._repr_html_()


def test_a_control_acts_when_it_is_ready(controller):
    at_once, late = planner.simulate(controller, latency=0.0), planner.simulate(controller, latency=0.02)
    step = late.timestep
    k = round(0.02 / step)
    assert late.late == pytest.approx(0.02)
    np.testing.assert_array_equal(late.ctrl[:k], np.tile(late.ctrl[0], (k, 1)))  # the first stage's, known beforehand
    n = late.substeps
    held = late.ctrl[n : n + k]  # the last control is held while the second plan is made
    np.testing.assert_array_equal(held, np.tile(late.ctrl[n - 1], (k, 1)))
    assert not np.array_equal(late.ctrl[n + k], held[-1])
    assert not np.array_equal(at_once.ctrl[n], at_once.ctrl[n - 1])


def test_measured_latency_is_what_the_calls_took(controller):
    loop = planner.simulate(controller, duration=0.5)
    assert loop.call_seconds.max() <= loop.late <= loop.call_seconds.max() + loop.timestep
    assert loop.errors["latency"] is None
    assert (loop.call_seconds > 0.0).all()


def test_a_push_is_a_force_at_the_body_for_its_time(problem):
    model = copy.copy(compile_model(problem.twin.mjcf))
    model.opt.timestep, seen = 0.001, []
    step = pushed_step(model, [Push("forearm", [1.0, 2.0, 3.0], 0.01, 0.004)], seen.append)

    class Data:
        time, xfrc_applied = 0.0, np.zeros((model.nbody, 6))

    acting = []
    for k in range(20):
        Data.time = 0.001 * k
        step(Data)
        acting.append(Data.xfrc_applied[model.body("forearm").id, :3].copy())
    assert [k for k, force in enumerate(acting) if force.any()] == [10, 11, 12, 13]
    np.testing.assert_array_equal(acting[10], [1.0, 2.0, 3.0])
    assert len(seen) == 20
    assert pushed_step(model, []) is None
    with pytest.raises(PlannerError, match=r"begins at 0.5 s, and the run ends at 0.5 s"):
        pushed_step(model, [Push("forearm", 1.0, 0.5)], until=0.5)


def test_errors_change_the_motion_and_seeds_the_noise(controller):
    plain = planner.simulate(controller, latency=0.0, duration=1.0)
    for errors in (
        {"pushes": [Push("forearm", 5.0, 0.5)]}, {"mass": 0.2}, {"mass": {"forearm": 0.2}}, {"friction": 0.05},
        {"noise": 1e-3}, {"encoders": True},
    ):  # fmt: skip
        other = planner.simulate(controller, latency=0.0, duration=1.0, **errors)
        assert other.perturbed
        assert np.isfinite(other.xs).all()
        assert not np.array_equal(other.xs, plain.xs), errors
    assert not plain.perturbed
    first, same, another = (
        planner.simulate(controller, latency=0.0, duration=0.5, noise=1e-3, seed=seed) for seed in (0, 0, 1)
    )
    np.testing.assert_array_equal(first.xs, same.xs)
    assert not np.array_equal(first.xs, another.xs)


def test_the_loop_stands_a_push_and_says_so_and_a_hopeless_one_fails(controller):
    assert judge(planner.simulate(controller, latency=0.004, pushes=[Push("forearm", 10.0, 1.0)])).passed
    hopeless = planner.simulate(controller, latency=0.004, pushes=[Push("forearm", 300.0, 2.5, 0.5)])
    assert not judge(hopeless).passed
    assert not passes_disturbed(hopeless)


def test_a_plan_with_its_gains_alone_holds_its_goal(controller):
    loop = planner.simulate(controller.plan)
    assert judge(loop).passed
    assert len(loop.call_seconds) == 0


def test_a_moving_goal_is_followed(controller):
    def goal(t):
        return [1.2 + 0.1 * np.sin(t), 0.3, 0.1 * np.cos(t), 0.0]

    moving = planner.Controller(controller.problem)
    verdict = judge(planner.simulate(moving, latency=0.0, duration=5.0, goal=goal))
    assert verdict.sections["follows"].measured[0].value < 0.1


def test_a_joint_that_moves_is_followed(controller):
    moving = planner.Controller(controller.problem)
    goal = lambda t: {"elbow": 0.3 + 0.1 * np.sin(t)}  # noqa: E731
    verdict = judge(planner.simulate(moving, latency=0.0, duration=5.0, goal=goal))
    assert verdict.sections["follows"].measured[0].value < 0.1


@pytest.mark.slow
def test_a_goal_that_is_known_ahead_is_followed_more_closely(controller):
    dt = controller.problem.dynamics.dt

    def states(t):
        return np.stack([1.2 + 0.4 * np.sin(t), 0.3 + 0 * t, 0.4 * np.cos(t), 0 * t], axis=-1)

    off = {}
    for name, stages in (("now", 1), ("ahead", 41)):
        moving = planner.Controller(controller.problem, horizon=40)
        goals = lambda t, n=stages: states(t + dt * np.arange(n)) if n > 1 else states(np.asarray(t))  # noqa: E731
        verdict = judge(planner.simulate(moving, latency=0.0, duration=5.0, goal=goals))
        off[name] = verdict.sections["follows"].measured[0].value
    assert off["ahead"] < 0.6 * off["now"]
    with pytest.raises(PlannerError, match="goal has shape"):
        moving.goal = states(dt * np.arange(7))


def test_bounds_of_a_state_stay_where_the_goal_moves_ahead(problem):
    limited = replace(problem, limits=planner.Limits(position={"elbow": (-9.0, 9.0)}))
    moving = planner.Controller(limited, horizon=30)
    ahead = np.stack([0.8 + 0.01 * np.arange(31), 0.02 * np.arange(31) - 0.3, np.zeros(31), np.zeros(31)], axis=1)
    moving.goal = ahead
    moving.reset()
    moving(0.0, limited.x0)
    window = moving._window
    lower, upper = (side[: len(window.x_ref)] + window.x_ref[:, 1:2] for side in window._hinges[:2])
    np.testing.assert_allclose(upper[1:], 9.0, atol=1e-12)  # of the elbow itself; no multiplier moves them
    np.testing.assert_allclose(lower[1:], -9.0, atol=1e-12)


def test_another_start(controller):
    own = planner.Controller(controller.problem)
    loop = planner.simulate(own, latency=0.0, start=[0.5, 0.5, 0.0, 0.0])
    np.testing.assert_allclose(loop.xs[0], [0.5, 0.5, 0.0, 0.0])
    assert passes_disturbed(loop)


@pytest.mark.slow
def test_margins_beside_the_gains_alone(controller):
    section, maps, times = margins(controller, "forearm", times=1)
    names = {one.name: one.value for one in section.measured}
    assert set(maps) == {"loop", "gains"}
    assert len(times) == 1
    assert names["loop_mass_margin"] > 0.0
    assert names["loop_latency_margin"] > 0.0
    assert maps["loop"][0] > 0.0


@pytest.mark.parametrize("text", ["", "torso", "torso=50", "torso=x@1s", "torso=1,2N@1s", "torso=5N@-1s", "t=5N@1s/0s"])
def test_a_push_that_is_none_is_refused(text):
    with pytest.raises(planner.PlannerError, match="push"):
        Push.parse(text)


def test_pushes_are_parsed_and_written():
    push = Push.parse("torso=50N@1.0s")
    assert (push.body, push.force.tolist(), push.time, push.duration) == ("torso", [50.0, 0.0, 0.0], 1.0, 0.1)
    push = Push.parse("torso=1,-2,3@1.5/0.2s")
    assert (push.force.tolist(), push.time, push.duration) == ([1.0, -2.0, 3.0], 1.5, 0.2)
    assert Push.parse(str(push)).to_dict() == push.to_dict()


def test_bodies_that_are_not_there_are_refused(controller):
    with pytest.raises(planner.PlannerError, match="no body 'torso' to push, expected one of: upper_arm, forearm"):
        planner.simulate(controller, pushes=[Push("torso", 1.0, 0.0)])
    with pytest.raises(planner.PlannerError, match="mass names the body 'torso', expected one of"):
        planner.simulate(controller, mass={"torso": 0.1})
    for given, words in (
        ({"goal": 3}, "expected a function of time"),
        ({"pushes": 3}, "expected a list of planner.Push"),
    ):
        with pytest.raises(planner.PlannerError, match=words):
            planner.simulate(controller, **given)


def test_the_command_writes_its_files_and_refuses_in_one_sentence(tmp_path):
    done = run(
        "drive", "two-link", "--horizon", N, "--latency", "4ms", "--push", "forearm=10N@1s", "--no-video", "--out", "o",
        cwd=tmp_path,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "PASS (loop); arrives, stays" in done.stdout
    assert sorted(path.name for path in (tmp_path / "o").iterdir()) == [
        "drive.json", "loop.png", "plan.npz", "report.html",
    ]  # fmt: skip
    written = json.loads((tmp_path / "o" / "drive.json").read_text())
    assert written["verdict"] == "PASS"
    assert written["asked"]["pushes"][0]["body"] == "forearm"
    assert 0.0 < written["measured"]["median"] <= written["measured"]["percentile_99"]
    assert {"median_call", "longest_call", "overruns", "overrun_share"} <= written["calls"]["figures"].keys()
    for words, fragments in (
        (("--rate", "500"), ("rate is 500 Hz", "stages of")),
        (("--push", "trunk=10N@1s"), ("no body 'trunk'", "upper_arm, forearm")),
        (("--push", "trunk"), ("push is 'trunk'", "BODY=FORCE@TIME")),
        (("--latency", "soon"), ("latency is 'soon'", "4ms")),
        (("--robustness-map", "trunk"), ("no body 'trunk'",)),
    ):
        refused(run("drive", "two-link", *words, "--out", "p", cwd=tmp_path), *fragments)
        assert not (tmp_path / "p").exists()
    fine = ("--horizon", 2000, "--rate", 1000)
    for words, fragment in ((("--latency", "1us"), "write --latency"), (fine, "write --rate")):
        done = run("drive", "two-link", *words, "--out", "p", cwd=tmp_path)
        assert (done.returncode, (tmp_path / "p").exists()) == (2, False)
        last = done.stderr.strip().splitlines()[-1]  # after the lines of the solver
        assert "ms of processor time (median of" in last
        assert fragment in last


@pytest.mark.parametrize(
    ("passes", "advice"),
    [
        (lambda c: c.latency == 0.0, "a faster computer"),
        (lambda c: c.latency < 0.5, "write --latency 2ms"),
        (lambda c: c.latency == 0.0 or c.horizon < N, f"write --stages {N // 2}"),
        (lambda c: False, ""),
    ],
)
def test_a_loop_that_fails_by_its_latency_alone_ends_with_the_flag_to_write(problem, controller, passes, advice):
    late = controller.with_timing(1.0, 1.0)
    calls = CallTimes(0.001, 0.0015, 0.002, 100)
    assert calls.latency == pytest.approx(0.002)
    found = _advice(late, calls, lambda c: SimpleNamespace(passed=passes(c)))
    assert found.endswith(f"{advice}.") or (f"{advice}, or" in found if advice else found == "")
    assert (fitting_rate(controller, 0.12), late.threaded) == (pytest.approx(1.0 / 0.15), True)  # stages of 0.05 s
    with pytest.raises(PlannerError, match="a call takes 3e"):
        fitting_rate(controller, 3.0)


def test_goals_at_times_have_a_latency_of_whole_stages(problem):
    dt = problem.dynamics.dt
    assert latency_of(problem, 0.3 * dt) == 0.3 * dt
    window = planner.load_problem("quadrotor")  # which it passes at a time
    stage = window.dynamics.dt
    np.testing.assert_allclose(
        [latency_of(window, share * stage) for share in (0.3, 1.0, 1.2)], [stage, stage, 2 * stage]
    )


def test_the_section_of_calls_counts_those_over_their_period(controller):
    loop = planner.simulate(controller, latency=0.0, duration=0.5)
    seconds = np.full(10, 0.01)
    seconds[:2] = 0.06, 0.2  # of a period of 0.05 s
    section = judge(replace(loop, call_seconds=seconds, call_processor_seconds=0.1 * seconds)).sections["calls"]
    names = {one.name: one.value for one in section.measured}
    assert (names["overruns"], names["overrun_share"], names["period"]) == (2, 0.2, pytest.approx(0.05))
    assert (names["median_call"], names["longest_call"], names["processor_time"]) == (0.01, 0.2, pytest.approx(0.001))
    assert section.passed  # wall time of a computer with other work is no verdict


def test_a_controller_that_knows_its_latency_expects_what_comes(problem):
    """Without errors the plan is made for the state in which its control acts: only the simulator's step differs."""
    late, misses = problem.dynamics.dt, []
    for known in (late, 0.0):
        loop = planner.simulate(planner.Controller(problem, latency=known), latency=late, duration=1.0)
        misses.append(np.abs(loop.xs[:: loop.substeps][2:] - loop.plan.xs[2:]).max())
    assert misses[0] < 0.02 * misses[1]


FILTERED = """
<mujoco><worldbody><body><joint name="hinge" axis="0 -1 0" damping="0.1"/>
  <geom type="capsule" fromto="0 0 0 0.5 0 0" size="0.02" mass="1"/></body></worldbody>
  <actuator><general joint="hinge" dyntype="filterexact" dynprm="0.05" ctrlrange="-20 20"/></actuator></mujoco>"""


def test_a_motor_behind_a_filter_and_a_latency_is_driven_as_the_model_has_them():
    """The filter is a state, predicted over the latency as the others; without it the torque is 0.05 s late."""
    arm = planner.Mechanism.from_mjcf(FILTERED)
    assert arm.na == 1
    problem = planner.task(arm, start=arm.home, goals=planner.Goal(joints={"hinge": 1.0}), duration=1.0)
    late = problem.dynamics.dt
    loop = planner.simulate(planner.Controller(problem, latency=late), latency=late)
    assert judge(loop).passed
    act = loop.act[:, 0]
    assert np.abs(np.diff(act)).max() < np.abs(np.diff(loop.ctrl[:, 0])).max()  # it lags the control
    first = loop.xs[:: loop.substeps][2:] - loop.plan.xs[2:]
    assert np.abs(first).max() < 0.02  # rad, rad/s, N m of motions of several: only the simulator's step differs


@pytest.mark.slow
def test_the_hopper_arrives_though_nothing_keeps_it_there():
    controller = planner.Controller(planner.cases.hopper())
    assert not controller.keeps_goal
    verdict = judge(planner.simulate(controller, latency=0.0))
    assert verdict.passed
    assert verdict.sections["stays"].not_applicable


@pytest.mark.slow
@pytest.mark.parametrize("name", ["reach", "around_a_post", "reach_within_limits"])
def test_tasks_with_frames_limits_and_things_in_the_way(name):
    controller = planner.Controller(planner.load_problem(ROOT / "examples" / "tasks" / f"{name}.toml"))
    loop = planner.simulate(controller, latency=0.0)
    assert judge(loop).passed, judge(loop).rows()
    limits = controller.problem.bounds
    if limits is not None:
        assert (loop.ctrl <= limits.upper[0] + 1e-9).all()


@pytest.mark.slow
@pytest.mark.render
def test_a_loop_is_filmed(controller, tmp_path):
    loop = planner.simulate(controller, latency=0.0, duration=0.5)
    film = planner.render_video(loop, tmp_path / "loop.mp4", width=320, height=180, fps=10)
    assert film.stat().st_size > 1000


@pytest.mark.slow
@pytest.mark.render
def test_a_push_is_an_arrow_in_the_film_while_it_acts(controller):
    push = [Push("forearm", [0.0, 50.0, 0.0], 0.2)]
    loops = [planner.simulate(controller, latency=0.0, duration=0.5, pushes=one) for one in (push, [])]
    yellow = []
    for loop in loops:
        for t in (0.1, 0.25, 0.4):
            picture = planner.render_frame(loop, t, width=320, height=180).astype(float)
            r, g, b = np.moveaxis(picture, -1, 0)
            yellow.append(int(np.sum((r > 150.0) & (g > 0.75 * r) & (b < 0.5 * g))))
    assert yellow[1] > 20
    assert max(yellow[0], yellow[2], *yellow[3:]) == 0


@pytest.mark.slow
def test_a_controller_that_knows_its_latency_does_not_tremble_at_rest():
    """Its gains are stiff: a control that comes a stage late shakes the arm, one for the state to come does not."""
    problem = planner.load_problem(ROOT / "examples" / "tasks" / "reach.toml")
    plan, speeds = planner.solve(problem), {}
    for known in (0.01, 0.0):
        loop = planner.simulate(planner.Controller(problem, plan=plan, latency=known), latency=0.01)
        speeds[known] = np.abs(loop.xs[loop.t > loop.t[-1] - 0.5, problem.dynamics.mechanism.nq :]).max()
    assert speeds[0.01] < 1e-3  # rad/s
    assert speeds[0.0] > 0.1


CRANE = """
<mujoco><worldbody><body name="trolley">
  <joint name="rail" type="slide" axis="1 0 0" range="-0.5 2.5" damping="1"/>
  <geom type="box" size="0.15 0.08 0.06" mass="5" contype="0" conaffinity="0"/>
  <body name="load"><joint name="swing" axis="0 -1 0" damping="0.01"/>
    <geom type="sphere" pos="0 0 -1" size="0.1" mass="2" contype="0" conaffinity="0"/></body>
</body></worldbody><actuator><motor name="drive" joint="rail" ctrlrange="-40 40"/></actuator></mujoco>"""
SWING = """
model = "crane.xml"
start = { rail = 0.0 }
goal = { rail = 2.0 }
duration = 3.0
limits = { position = { swing = [-0.15, 0.15] } }
"""


@pytest.fixture(scope="module")
def crane(tmp_path_factory):
    folder = tmp_path_factory.mktemp("crane")
    (folder / "crane.xml").write_text(CRANE, encoding="utf-8")
    (folder / "crane.toml").write_text(SWING, encoding="utf-8")
    return planner.Controller(planner.load_problem(folder / "crane.toml"), latency=0.004)


@pytest.mark.slow
@pytest.mark.parametrize("force", [10.0, 30.0])
def test_a_push_beyond_a_range_is_got_over(crane, force):
    """Multipliers of plans that are far from a minimum would drive the trolley to and fro for ever."""
    loop = planner.simulate(crane, latency=0.004, pushes=[planner.Push("load", force=force, time=1.0)])
    verdict = planner.judge(loop)
    assert verdict.passed, verdict.reason
    last = loop.ctrl[loop.t[:-1] > loop.t[-1] - 0.5]
    assert np.abs(last).max() < 2.0  # N, of 40 that it has
    beyond = {one.name: one.value for one in verdict.sections["kept"].measured}["angle_beyond_its_range"]
    assert (beyond > 0.01) == (force > 10.0)  # rad: no control keeps the range under the larger pushes
    assert ("beyond a range" in verdict.headline) == (beyond > crane.problem.limits.tolerance)
    assert "PASS" in loop._repr_html_()


ARM = """
<mujoco><compiler angle="radian"/><worldbody><body name="arm">
  <joint name="hinge" axis="0 0 1" range="-1.2 1.2" damping="0.2"/>
  <geom type="capsule" fromto="0 0 0 0.5 0 0" size="0.02" mass="1" contype="0" conaffinity="0"/>
</body></worldbody><actuator><motor joint="hinge" ctrlrange="-5 5"/></actuator></mujoco>"""


def test_a_push_that_drives_a_joint_through_its_stop_fails_though_the_arm_comes_back():
    arm = planner.Mechanism.from_mjcf(ARM)
    goal = planner.Goal(joints={"hinge": 1.0})
    problem = planner.task(arm, start=[0.0], goals=goal, duration=1.0, dt=0.02)
    controller, found = planner.Controller(problem, latency=0.0), {}
    for force in (50.0, 400.0):  # N: by the first the arm stays within its range
        loop = planner.simulate(controller, latency=0.0, pushes=planner.Push("arm", (0.0, force, 0.0), 1.2))
        found[force] = verdict = judge(loop)
        assert verdict.sections["arrives"].passed
        assert verdict.sections["stays"].passed
        stop = next(one for one in verdict.sections["kept"].measured if one.name == "beyond_its_stop")
        assert stop.value == pytest.approx(max(loop.xs[:, 0].max() - 1.2, 0.0), abs=1e-8)
        assert stop.passed == verdict.passed == passes_disturbed(loop) == (force < 100.0)
    assert "beyond a stop" in found[400.0].headline
    assert "beyond" not in found[50.0].headline


def test_only_a_loop_is_judged(problem):
    with pytest.raises(planner.PlannerError, match=r"expected what planner\.simulate returns"):
        planner.judge(problem)
