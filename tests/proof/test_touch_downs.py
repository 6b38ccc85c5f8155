"""Touch-downs: when feet of a plan land, the rule by which the stage waits for them, and who keeps to it."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from places import ROOT
from plan_files import contents, written

import planner
from planner.base.gl import load_mujoco
from planner.control.control_laws import TrackedPlan
from planner.problem.archive import FORMAT_VERSION
from planner.problem.plan import Status
from planner.problem.touch_downs import BEARS, StageRule, TouchDown, reference, standing, touch_downs_of
from planner.proof.replays.compiled_twin import CompiledTwin
from planner.proof.replays.replaying import replay_in
from planner.proof.replays.sampled_gains import FootLoads
from planner.proof.robustness.perturbation import Perturbation
from planner.proof.robustness.perturbed import MonteCarloSettings, perturbed, replay_rollout
from planner.proof.robustness.rollouts import CLOCK, MODES, Rollouts

SCENE = ROOT / "mjcf" / "quadruped" / "scene.xml"
FEET = ("front_left_shank", "front_right_shank", "rear_left_shank", "rear_right_shank")
N, DT, LANDS = 28, 0.01, 20  # it does not bounce yet
EARLY, LATE = LANDS - 10, LANDS + 6  # stages, outside of a window of four
LANDING = TouchDown(LANDS, FEET, LANDS - 4, LANDS + 4)


@pytest.fixture(scope="module")
def dropped():
    """A plan of the quadruped that falls onto its feet, with gains that hold its joints, by its own dynamics."""
    mechanism = planner.Mechanism.from_mjcf(SCENE, contacts="ground")
    dynamics = planner.RigidBodyDynamics(mechanism, dt=DT, substeps=6)
    stands = planner.dynamics.static_equilibrium(mechanism, mechanism.keyframe("stand"))
    x0 = stands.copy()
    x0[2] += 0.5 * 9.81 * (LANDS * DT) ** 2  # m: it falls for 0.2 s
    us = np.tile(planner.dynamics.quasi_static.quasi_static_controls(mechanism, stands), (N, 1))
    gains = np.zeros((dynamics.nu, dynamics.ndx))
    joints = mechanism.nv - dynamics.nu  # the first that an actuator moves
    for k in range(dynamics.nu):
        gains[k, joints + k], gains[k, mechanism.nv + joints + k] = -60.0, -2.0
    xs = np.empty((N + 1, dynamics.nx))
    xs[0] = x0
    for n in range(N):
        us[n] += gains @ dynamics.space.single_difference(xs[n], stands)
        xs[n + 1] = dynamics.step(xs[n : n + 1], us[n : n + 1])[0]
    weights = {"final": 1.0, "effort": 1.0, "dt": DT, "nu": dynamics.nu, "space": dynamics.space}
    cost = planner.TrackingCost.reach(stands, N, **weights)
    problem = planner.Problem(dynamics, cost, x0, us, twin=planner.Twin.of(mechanism))
    return planner.Plan(
        DT * np.arange(N + 1), xs, us, np.tile(gains, (N, 1, 1)), 0.0, 0.0, Status.GIVEN, (), problem, None,
        problem.twin,
    )  # fmt: skip


def test_a_fall_has_one_touch_down_of_all_feet(dropped):
    (only,) = dropped.touch_downs
    assert set(only.feet) == set(FEET)
    assert abs(only.stage - LANDS) <= 1  # the law's surface is soft
    assert only.earliest == only.stage - 4
    assert only.latest == only.stage + 4  # of 0.04 s each


def test_a_foot_stands_where_it_bears_its_share_of_the_weight(dropped):
    mechanism = dropped.problem.dynamics.mechanism
    stands = planner.dynamics.static_equilibrium(mechanism, mechanism.keyframe("stand"))
    up = stands.copy()
    up[2] += 0.05
    for foot, bears in standing(mechanism, np.array([stands, up])).items():
        assert bears.tolist() == [True, False], foot
    assert BEARS < 0.25  # each of four feet bears about as much


def test_machines_without_feet_have_none():
    problem = planner.cases.two_link()
    assert touch_downs_of(problem.dynamics, np.zeros((problem.N + 1, problem.dynamics.nx))) == ()
    assert planner.solve(problem).touch_downs == ()


def stages(touches, feet=FEET):
    """The stage that acts at each clock, if feet bear load from stage `touches` on."""
    rule, acting = StageRule([LANDING]), []
    for clock in range(N):
        one = rule(clock, lambda foot: clock >= touches and foot in feet)  # noqa: B023
        acting.append(clock if one is None else one.stage)
    return np.array(acting)


@pytest.mark.parametrize(
    ("touches", "expected"),
    [
        (LANDS, {}),  # as planned: the clock's
        (LANDS - 1, {}),  # within the stage before it, as in the plan
        (LANDS - 3, {LANDS - 3: LANDS, LANDS - 2: LANDS, LANDS - 1: LANDS}),
        (EARLY, {LANDS - 4: LANDS, LANDS - 3: LANDS, LANDS - 2: LANDS, LANDS - 1: LANDS}),  # not before its window
        (LANDS + 2, {LANDS + 1: LANDS}),
        (LATE, {LANDS + 1: LANDS, LANDS + 2: LANDS, LANDS + 3: LANDS}),  # not after it
    ],
)
def test_the_stage_waits_for_feet(touches, expected):
    clock = np.arange(N)
    for n, stage in expected.items():
        clock[n] = stage
    np.testing.assert_array_equal(stages(touches), clock)


def test_early_is_when_all_feet_stand_late_until_one_does():
    np.testing.assert_array_equal(stages(LANDS - 3, FEET[:1]), np.arange(N))
    assert stages(LANDS + 2, FEET[:1])[LANDS + 2] == LANDS + 2


@given(st.lists(st.lists(st.booleans(), min_size=2, max_size=2), min_size=N, max_size=N))
def test_the_stage_never_goes_back(signals):
    rule = StageRule([TouchDown(7, ("a", "b"), 3, 11), TouchDown(13, ("a",), 9, 17), TouchDown(22, ("b",), 19, 26)])
    before = 0
    for clock, (a, b) in enumerate(signals):
        one = rule(clock, {"a": a, "b": b}.__getitem__)
        stage = clock if one is None else one.stage
        assert stage >= before
        assert abs(stage - clock) <= 4
        before = stage


def test_the_reference_goes_on_at_its_own_velocity(dropped):
    dynamics, x = dropped.problem.dynamics, dropped.xs[LANDS - 2]
    np.testing.assert_array_equal(reference(dynamics, x, 0.0), x)
    rate = dynamics.space.single_difference(reference(dynamics, x, 1e-3), reference(dynamics, x, -1e-3)) / 2e-3
    nv = dynamics.mechanism.nv
    np.testing.assert_allclose(rate[:nv], x[dynamics.mechanism.velocities], atol=1e-9 * np.abs(x).max())
    np.testing.assert_array_equal(rate[nv:], 0.0)


def test_feet_bear_load_in_mujoco_where_they_do_in_the_plan(dropped):
    compiled = CompiledTwin(dropped.twin)
    model, mechanism = compiled.model, dropped.problem.dynamics.mechanism
    data, feet = load_mujoco().MjData(model), FootLoads(model, (*FEET, "no such foot"))
    assert feet.known(FEET)
    assert not feet.known(["no such foot"])
    for n in (0, LANDS - 3, LANDS + 3, N - 1):
        found = feet.at(model, data, dropped.twin.sim_of(dropped.xs[n]), dropped.us[n])
        assert found == {foot for foot, bears in standing(mechanism, dropped.xs[n : n + 1]).items() if bears[0]}


def raised(plan, height):
    """The plan's model with a floor that is higher, m."""

    def lift(model):
        model.geom_pos[model.geom("ground").id, 2] += height
        model.geom_sameframe[model.geom("ground").id] = 0

    return CompiledTwin(plan.twin).changed(lift)


def test_a_replay_with_gains_waits(dropped):
    """Feet that land 2.5 cm early, or late, do so about 6 ms, or one stage, from the plan's instant."""
    for height in (0.03, -0.03):
        compiled = raised(dropped, height)
        waits = replay_in(compiled, dropped, feedback=True)
        by_clock = replay_in(compiled, without_touch_downs(dropped), feedback=True)
        differ = np.flatnonzero(np.abs(waits.ctrl - by_clock.ctrl).max(axis=1) > 0.0)
        first = waits.t[differ[0]] / DT
        assert LANDS - 4 <= first <= LANDS + 1
    same = replay_in(CompiledTwin(dropped.twin), dropped, feedback=True)
    other = replay_in(CompiledTwin(dropped.twin), without_touch_downs(dropped), feedback=True)
    np.testing.assert_array_equal(same.ctrl, other.ctrl)


def without_touch_downs(plan):
    """The same plan, whose stage is the clock's."""
    other = replace(plan)
    other.__dict__["_touch_downs"] = ()
    return other


def test_rollouts_wait_and_are_repeated_to_the_last_bit(dropped):
    compiled, asked = CompiledTwin(dropped.twin), MonteCarloSettings(6, 3, Perturbation(floor=0.05))
    found = perturbed(dropped, compiled, asked, threads=1)
    assert list(found.success) == [*MODES, CLOCK]
    assert len(found.success[CLOCK]) == len(found.success["feedback"])
    assert not np.array_equal(found.end_error[CLOCK], found.end_error["feedback"])
    again = perturbed(dropped, compiled, asked, threads=2)
    np.testing.assert_array_equal(found.end_error["feedback"], again.end_error["feedback"])
    run = replay_rollout(dropped, compiled, 4, seed=3, perturbation=asked.perturbation)
    with Rollouts(dropped, compiled, 1) as rollouts:
        from planner.proof.robustness.perturbation import draw

        batch = rollouts.batch([draw(asked.perturbation, 3, k, rollouts.nominal.sizes) for k in range(6)])
        xs = rollouts.run(batch, "feedback")
    np.testing.assert_array_equal(run.xs[-1], xs[4, -1])


def test_a_plan_alone_takes_what_switches_tell(dropped):
    controller = planner.FixedPlanController(dropped)
    x, K, dynamics = dropped.xs[LANDS - 3], dropped.K[0], dropped.problem.dynamics
    (landing,) = dropped.touch_downs
    t = DT * (landing.stage - 3)
    x = dropped.xs[landing.stage - 3]
    by_clock = dropped.us[landing.stage - 3]  # on the plan
    np.testing.assert_allclose(controller(t, x), by_clock, atol=1e-12)  # its feet are in the air by x
    x_ref = reference(dynamics, dropped.xs[landing.stage], -3.0 * DT)
    early = dropped.us[landing.stage] + K @ dynamics.space.single_difference(x, x_ref)
    controller.reset()
    controller(t - DT, x, standing_feet=())
    np.testing.assert_allclose(controller(t, x, standing_feet=FEET), early, atol=1e-12)
    controller.reset()
    np.testing.assert_allclose(controller(t, x, standing_feet=()), by_clock, atol=1e-12)
    with pytest.raises(planner.PlannerError, match="front_left_shank"):
        controller(t, x, standing_feet=["front_left"])


def test_a_controller_takes_what_switches_tell(dropped):
    """Between two plans, as a plan alone does; one that is made again each stage has nothing to wait for."""
    (landing,) = dropped.touch_downs
    controller = planner.Controller(dropped.problem, horizon=N, rate=4.0, plan=dropped)
    alone = planner.FixedPlanController(dropped)
    told = {}
    for feet in ((), FEET):
        for one in (controller, alone):
            one.reset()
        controller(0.0, dropped.xs[0])  # makes a plan, in whose place the one with a known landing is tracked
        controller._tracked = TrackedPlan(dropped.problem.dynamics, (dropped.xs, dropped.us, dropped.K), 0.0)
        for n in range(1, landing.stage - 2):
            stands = feet if n == landing.stage - 3 else ()
            u = controller(DT * n, dropped.xs[n], standing_feet=stands)
            np.testing.assert_array_equal(u, alone(DT * n, dropped.xs[n], standing_feet=stands))
        told[feet] = u
        np.testing.assert_array_equal(controller.feedback(dropped.xs[n], DT * n, standing_feet=feet), u)
    assert np.abs(told[FEET] - told[()]).max() > 0.1  # N m
    with pytest.raises(planner.PlannerError, match="front_left_shank"):
        controller(DT * n, dropped.xs[n], standing_feet=["front_left"])


def test_the_file_has_the_rule(dropped, tmp_path):
    dropped.save(tmp_path / "plan.npz")
    arrays, meta = contents(tmp_path / "plan.npz")
    assert meta["format_version"] == FORMAT_VERSION
    assert meta["touch_downs"] == [one.to_dict() for one in dropped.touch_downs]
    assert planner.load_plan(tmp_path / "plan.npz").touch_downs == dropped.touch_downs
    meta["touch_downs"][0]["stage"] = "soon"
    written(tmp_path / "damaged.npz", arrays, meta)
    with pytest.raises(planner.PlannerError, match="touch_downs"):
        planner.load_plan(tmp_path / "damaged.npz")


def test_the_table_says_which_feet_stand(dropped, tmp_path):
    dropped.to_csv(tmp_path / "plan.csv")
    header, *rows = (tmp_path / "plan.csv").read_text().splitlines()
    names = header.split(",")
    for foot in FEET:
        column = [float(row.split(",")[names.index(f"stands: {foot}")]) for row in rows]
        assert column[: LANDS - 2] == [0.0] * (LANDS - 2)
        assert column[LANDS + 2] == 1.0
    dropped.to_csv(tmp_path / "controls.csv", only="controls")
    assert "stands" not in (tmp_path / "controls.csv").read_text()


def test_limbs_land_and_neither_shanks_nor_bounces():
    """A leg of a shank and a foot, each of a sphere: the shank rubs while its foot stands, and the foot bounces."""
    text = """<mujoco><option gravity="0 0 -10"/><worldbody><geom name="floor" type="plane" size="1 1 1"/>
      <body name="shank" pos="0 0 0.5"><joint name="up" type="slide" axis="0 0 1"/>
        <geom size=".1" mass="1" pos="1 0 0"/><body name="foot"><joint name="lift" type="slide" axis="0 0 1"/>
          <geom size=".1" mass="1"/></body></body></worldbody>
      <actuator><motor joint="up"/><motor joint="lift"/></actuator></mujoco>"""
    mechanism = planner.Mechanism.from_mjcf(text, contacts="file")
    dynamics = planner.RigidBodyDynamics(mechanism, dt=0.01)
    down, up = 0.09, 0.2  # m, heights of a sphere's centre
    shank, foot = np.full(61, up), np.full(61, up)
    foot[:10], foot[25:27], foot[40:] = down, down, down  # stands, brushes the ground for 0.02 s, lands
    shank[50:56] = down
    xs = np.column_stack([shank - 0.5, foot - shank, np.zeros((61, 2))])
    (only,) = touch_downs_of(dynamics, xs)
    assert (only.stage, only.feet) == (40, ("foot",))
    foot[45:47] = up  # it bounces: back in 0.02 s
    xs[:, 1] = foot - shank
    assert touch_downs_of(dynamics, xs) == (only,)
    foot[45:55] = up  # it leaves the ground, beside the shank, which stands
    shank[44:] = down
    xs[:, 0], xs[:, 1] = shank - 0.5, foot - shank
    assert touch_downs_of(dynamics, xs) == (only,)


def test_a_controllers_look_ahead_does_not_wait_for_the_machines_feet(dropped):
    """A plan that begins later begins where the feedback leads: a prediction, of which switches know nothing."""
    (landing,) = dropped.touch_downs
    tracked = TrackedPlan(dropped.problem.dynamics, (dropped.xs, dropped.us, dropped.K), 0.0)
    n = landing.stage
    for stage in range(n - 5, n + 3):
        tracked.control(DT * stage, dropped.xs[stage])
    late = tracked.waiting_control(DT * (n + 1), dropped.xs[n + 1], standing_feet=())
    x_ref = reference(dropped.problem.dynamics, dropped.xs[n], DT)
    expected = dropped.us[n] + dropped.K[n] @ dropped.space.single_difference(dropped.xs[n + 1], x_ref)
    np.testing.assert_allclose(late, expected, atol=1e-12)
