"""Step 5 of a proof: the same rollouts in any company, honest rates, nothing lost when interrupted."""

from dataclasses import replace

import numpy as np
import pytest
from rolled_out_plans import LIMITED, coarse, ends, problem_of, rolled_out

import planner
from planner.base.errors import PlannerError
from planner.base.gl import load_mujoco
from planner.base.measured import Measurement
from planner.model.mechanism import Mechanism
from planner.problem.goals import GoalCheck
from planner.problem.problem import Requirements
from planner.proof.replays.compiled_twin import CompiledTwin
from planner.proof.replays.replaying import replay
from planner.proof.robustness.monte_carlo import LEVELS, MonteCarlo
from planner.proof.robustness.perturbation import Perturbation, draw
from planner.proof.robustness.perturbed import MonteCarloSettings, perturbed, replay_rollout
from planner.proof.robustness.rollouts import MODES, Rollouts
from planner.proof.robustness.success import end_errors, ranges_of_motion, rule_of, within_goals
from planner.proof.verdict import PATH_WITH_GAINS

NOTHING = dict.fromkeys(Perturbation().to_dict(), 0.0)
NONE = Perturbation(**NOTHING)
CONTROL_STEPS = 10  # a stage of 0.02 s at 500 Hz
SLIGHT = Perturbation(mass=0.01, inertia=0.01)


@pytest.fixture(scope="module")
def calm():
    """The arm in half more than its time, in which no standard error matters with gains."""
    return planner.solve(planner.cases.two_link(duration=1.5, horizon=75))


@pytest.fixture(scope="module")
def robust(calm):
    """64 rollouts of it at most, with the standard errors."""
    return perturbed(calm, coarse(calm), MonteCarloSettings(64))


def run(plan, twin, draws, threads=None):
    with Rollouts(plan, twin, threads) as rollouts:
        batch = rollouts.batch(draws(rollouts.nominal.sizes))
        return {mode: rollouts.run(batch, mode) for mode in MODES}


def drawn(numbers, perturbation=None, seed=3):
    return lambda sizes: [draw(perturbation or Perturbation(), seed, k, sizes) for k in numbers]


# How many are run.


@pytest.mark.parametrize("top", range(-1, len(LEVELS)))
def test_the_margin_is_the_largest_level_that_is_kept(arm, monkeypatch, top):
    """By bisection, in at most four levels of nine; one failure of twenty is 95 %, and kept."""
    ran = []

    def extend(self, part, mode, wanted, draw_one, to_come):
        level = int(part.split()[1])
        ran.append(level)
        self._store.arrays[f"{part} {mode} won"] = np.arange(wanted) >= (1 if level <= top else 2)

    monkeypatch.setattr(MonteCarlo, "_extend", extend)
    follows = replace(rule_of(arm), follows=lambda xs, plan_xs, knots: np.ones(len(xs), dtype=bool))
    with Rollouts(arm, coarse(arm), 1) as simulator:
        campaign = MonteCarlo(simulator, follows, NONE, 0, 64)
        assert campaign.per_level == 20
        assert campaign._margin("feedback", 0) == (LEVELS[top] if top >= 0 else 0.0)
    assert len(set(ran)) <= 4


@pytest.mark.parametrize(("every", "word", "done"), [(1, "robust", 32), (10, "robust", 96), (4, "fragile", 160)])
def test_rollouts_are_drawn_until_the_rate_with_gains_is_settled(arm, monkeypatch, every, word, done):
    """One failure in `every`; with 1 none. 512 were asked for, open loop takes as many."""

    def run(self, batch, mode, deadline):
        xs = np.repeat(self.plan.xs[None, self.knots], len(batch.models), axis=0)
        self.ran = getattr(self, "ran", 0)
        xs[(self.ran + np.arange(len(xs))) % every == every - 1, -1] += 100.0 * (every > 1)
        self.ran += len(xs)
        return xs

    monkeypatch.setattr(Rollouts, "run", run)
    result = perturbed(arm, coarse(arm), MonteCarloSettings(512))
    assert (result.robustness, result.done, result.asked) == (word, done, 512)
    assert result.rates["open-loop"].of == done
    assert result.to_dict()["robustness"] == word


# What succeeds.


def test_without_goals_each_coordinate_has_a_tenth_of_its_range(arm, monkeypatch):
    monkeypatch.setattr("planner.proof.robustness.success.goals_of", lambda problem, xs: ())
    ranges = ranges_of_motion(arm)
    moved = np.ptp(arm.xs, axis=0)
    floors = np.repeat([0.1 * moved[:2].max(), 0.1 * moved[2:].max()], 2)  # angles, angular velocities
    np.testing.assert_allclose(ranges, np.maximum(moved, floors))
    rule = rule_of(arm)
    ends = arm.xs[-1] + np.vstack([0.099 * np.diag(ranges), 0.101 * np.diag(ranges), np.full((1, 4), np.nan)])
    np.testing.assert_array_equal(rule.succeeded(ends), [True] * 4 + [False] * 5)
    np.testing.assert_allclose(end_errors(arm, ends), [0.099] * 4 + [0.101] * 4 + [np.inf])


def test_with_goals_each_may_be_missed_by_five_tolerances(arm):
    goals = [
        GoalCheck("x", "m", 0.1, lambda xs: np.abs(xs[:, 0])),
        GoalCheck("y", "m", 2.0, lambda xs: np.abs(xs[:, 1])),
    ]
    rule = within_goals(goals)
    ends = np.array([[0.5, 10.0], [0.51, 0.0], [0.0, 10.1], [np.inf, 0.0]])
    np.testing.assert_array_equal(rule.succeeded(ends), [True, False, False, False])
    assert rule_of(arm).words == rule.words


# The same rollouts in any company.


@pytest.mark.parametrize("name", ["arm", "tree"])
def test_rollouts_do_not_depend_on_their_company(name, request):
    plan = request.getfixturevalue(name)
    twin = coarse(plan)
    together = run(plan, twin, drawn(range(9)))
    once_more = run(plan, twin, drawn(range(9)), threads=1)
    parts = [run(plan, twin, drawn(part), threads=3) for part in ([0, 1, 2, 3], [4, 5, 6, 7], [8])]
    for mode in MODES:
        np.testing.assert_array_equal(together[mode], once_more[mode])
        np.testing.assert_array_equal(together[mode], np.concatenate([part[mode] for part in parts]))
    assert not np.array_equal(together["feedback"], together["open-loop"])


@pytest.mark.parametrize("name", ["arm", "tree"])
@pytest.mark.parametrize("mode", MODES)
def test_a_case_in_detail_is_the_rollout(name, mode, request):
    plan = request.getfixturevalue(name)
    twin, feedback = coarse(plan), mode == "feedback"
    xs = run(plan, twin, drawn(range(4)))[mode]
    for k in range(4):
        one = replay_rollout(plan, twin, k, seed=3, feedback=feedback)
        np.testing.assert_array_equal(one.xs[:: one.substeps], xs[k])
        np.testing.assert_array_equal(one.plan_xs[:: one.substeps], plan.xs)


def test_the_hopper_in_detail_is_the_rollout():
    """Contact, and a twin that is not the plan's own state."""
    plan = planner.solve(planner.cases.hopper(duration=0.25, horizon=50, height=5.0))
    assert plan.twin is not None
    twin = CompiledTwin(plan.twin)
    xs = run(plan, twin, drawn([0, 1]))
    for feedback in (False, True):
        one = replay_rollout(plan, twin, 1, seed=3, feedback=feedback)
        np.testing.assert_array_equal(one.xs[:: one.substeps], xs[MODES[feedback]][1])
        assert one.contact_force.max() > 100.0
        assert one.integrator == "EULER"


def test_euler_takes_the_place_of_rk4_only_where_it_agrees(monkeypatch):
    plan = planner.solve(planner.cases.hopper(duration=0.25, horizon=50, height=5.0))
    assert plan.twin is not None
    monkeypatch.setattr("planner.proof.robustness.rollouts.AGREES", 1e-12)
    with Rollouts(plan, CompiledTwin(plan.twin)) as rollouts:
        assert rollouts.integrator == "RK4"
        assert rollouts.nominal.model.opt.integrator == load_mujoco().mjtIntegrator.mjINT_RK4


@pytest.mark.parametrize("mode", MODES)
def test_without_errors_it_is_the_replay(arm, mode):
    """Open loop at any step; with gains where every simulator step is a control step."""
    twin = coarse(arm)
    result = perturbed(arm, twin, MonteCarloSettings(2, perturbation=NONE))
    own = replay(arm, twin=twin.twin, substeps=CONTROL_STEPS, feedback=mode == "feedback")
    assert result.step == pytest.approx(own.timestep)
    np.testing.assert_allclose(result.end_error[mode], end_errors(arm, own.xs[-1:])[0], rtol=1e-6)
    assert result.rates[mode].value == 1.0
    assert result.fans[mode].shape == (5, arm.N + 1, 4)
    np.testing.assert_allclose(result.fans[mode][2, :: arm.N // 4], own.error[:: arm.N // 4 * CONTROL_STEPS], atol=1e-6)


def test_delay_is_a_shift_by_whole_steps(arm):
    twin = coarse(arm)
    late = Perturbation(**{**NOTHING, "delay": 0.05})
    one = replay_rollout(arm, twin, 2, perturbation=late, feedback=False)
    none = replay_rollout(arm, twin, 2, perturbation=NONE, feedback=False)
    with Rollouts(arm, twin) as rollouts:
        steps = round(draw(late, 0, 2, rollouts.nominal.sizes).delay / rollouts.step)
    assert steps > 1
    np.testing.assert_array_equal(one.ctrl[steps:], none.ctrl[:-steps])
    np.testing.assert_array_equal(one.ctrl[:steps], np.broadcast_to(none.ctrl[0], (steps, 2)))
    back = replay_rollout(arm, twin, 2, perturbation=late, feedback=True)  # the first command, held
    np.testing.assert_array_equal(back.ctrl[: steps + 1], np.broadcast_to(back.ctrl[0], (steps + 1, 2)))
    w = np.hstack([back.qpos, back.qvel])
    i = 40
    j = (i - steps) * CONTROL_STEPS // back.substeps  # every step of this simulator is a control step
    assert back.substeps == CONTROL_STEPS
    u = arm.us[j // CONTROL_STEPS] + arm.K[j // CONTROL_STEPS] @ (w[j] - back.plan_xs[j])
    np.testing.assert_allclose(back.ctrl[i], u, rtol=1e-12)


def test_a_delay_beyond_the_end_holds_the_first_control(arm):
    one = replay_rollout(arm, coarse(arm), 0, perturbation=Perturbation(**{**NOTHING, "delay": 10.0}))
    np.testing.assert_array_equal(one.ctrl, np.broadcast_to(one.ctrl[0], one.ctrl.shape))


# What it finds.


def test_rollouts_repeat_by_their_seed(tree):
    twin = coarse(tree)
    first, again = (perturbed(tree, twin, MonteCarloSettings(12, seed=4), threads=threads) for threads in (None, 1))
    np.testing.assert_array_equal(ends(first), ends(again))
    assert first.to_dict() == again.to_dict()
    other = perturbed(tree, twin, MonteCarloSettings(14, seed=5))
    assert not np.array_equal(ends(other)[:, :12], ends(first))


def test_what_is_robust_says_with_what_and_how_many_rollouts_it_took(calm, robust):
    """All succeed with gains: 32 is the first look at which this settles their rate within 7 %."""
    found = robust
    assert found.done == 32
    names = [figure.name for figure in found.section.measured]
    assert "feedback_success_rate" in names
    assert "open_loop_mass_margin" in names
    assert found.section.passed
    worst = found.worst["open-loop"]
    assert len(worst) == 5
    assert found.end_error["open-loop"][worst[0]] == found.end_error["open-loop"].max()
    lines = found.lines()
    assert "robustness: robust with its gains" in lines
    cut = replace(found, success=found.success | {"open-loop": np.zeros(0, dtype=bool)})  # the time was up
    assert "robustness, open loop: not simulated" in cut.lines()
    assert lines[0] == ("robustness: 64 rollouts were asked for, 32 were run: by then the rate with gains is decided.")
    proof = replace(planner.prove(calm, rollouts=0), monte_carlo=found)
    assert proof.headline.endswith("; feasible, optimal, robust with its gains")
    assert proof.robustness == "robust"
    astray = Measurement(PATH_WITH_GAINS, 1.1, "", None)  # of its bound, in the user's file
    strays = {**proof.sections, "your_file": replace(proof.your_file, measured=(astray,))}
    assert replace(proof, sections=strays).headline.endswith("; feasible, optimal, robust at its goals")
    few = perturbed(calm, coarse(calm), MonteCarloSettings(4))
    assert few.notes == ()
    assert "robustness: undecided" in few.lines()


def test_gains_of_the_wrong_sign_fail(calm, robust):
    bad = perturbed(replace(calm, K=-calm.K), coarse(calm), MonteCarloSettings(16))
    assert robust.rates["feedback"].value == 1.0
    assert (robust.robustness, bad.robustness) == ("robust", "fragile")
    assert bad.rates["feedback"].value < 0.2
    assert robust.margin["feedback"] >= 0.05 > bad.margin["feedback"]
    np.testing.assert_array_equal(robust.end_error["open-loop"][:16], bad.end_error["open-loop"])


@pytest.mark.slow
def test_the_acrobot_needs_its_gains():
    acrobot = planner.solve(planner.cases.acrobot())
    result = perturbed(acrobot, coarse(acrobot), MonteCarloSettings(32, perturbation=SLIGHT))
    assert result.rates["feedback"].value > 0.8
    assert result.rates["open-loop"].interval[1] < result.rates["feedback"].interval[0]


def test_a_requirement_may_say_what_success_is(arm):
    own = Requirements(success=lambda xs: np.arange(len(xs)) % 2 == 0)
    problem = planner.cases.two_link(duration=1.0, horizon=50)
    object.__setattr__(problem, "requirements", own)
    result = perturbed(replace(arm, problem=problem), coarse(arm), MonteCarloSettings(4))
    assert result.rates["feedback"].successes == 2


def test_a_model_that_ignores_friction_is_noted(arm):
    twin = coarse(arm)
    text = twin.twin.mjcf.replace('contact="disable"', 'contact="disable" frictionloss="disable"')
    assert text != twin.twin.mjcf
    without = CompiledTwin(replace(twin.twin, mjcf=text))
    one, budget = MonteCarloSettings(1), 1e-6  # s: no rollout is run, which is the last note
    assert len(perturbed(arm, twin, one, budget=budget).notes) == 1
    assert "friction does nothing" in perturbed(arm, without, one, budget=budget).notes[0]
    assert len(perturbed(arm, without, replace(one, perturbation=NONE), budget=budget).notes) == 1


EXPLOSIVE = LIMITED.replace('damping="0.1" range="-1 1"', 'damping="0.1"')


@pytest.fixture(scope="module")
def explosive():
    """A hinge whose gains feed its speed until numbers end."""
    mechanism = Mechanism.from_mjcf(EXPLOSIVE)
    plan = rolled_out(problem_of(mechanism, 0.01, 100, us=np.ones((100, 1))))
    K = np.zeros((100, 1, 2))
    K[50:, :, 1] = 1e5
    return replace(plan, K=K)


def test_rollouts_that_explode_are_failures(explosive):
    result = perturbed(explosive, CompiledTwin(explosive.twin), MonteCarloSettings(8))
    assert result.rates["feedback"].value == 0.0
    assert np.all(np.isinf(result.end_error["feedback"]))
    assert np.all(np.isfinite(result.end_error["open-loop"]))
    assert result.margin["feedback"] == 0.0
    assert result.to_dict()["modes"]["feedback"]["end_error"] == [None] * 8
    assert np.all(np.isfinite(result.fans["feedback"][:, :50]))
    assert np.all(np.isnan(result.fans["feedback"][:, -1]))
    assert result.section.measured
    one = replay_rollout(explosive, CompiledTwin(explosive.twin), 0, feedback=True)
    assert np.isnan(one.error[-1]).all()
    assert np.isfinite(one.error[10]).all()


def test_arguments_are_checked(arm):
    for wrong in (lambda: MonteCarloSettings(0), lambda: MonteCarloSettings(seed=-1)):
        with pytest.raises(PlannerError):
            wrong()
    with pytest.raises(PlannerError):
        perturbed(arm, CompiledTwin(arm.twin), budget=-1.0)
    with pytest.raises(PlannerError, match="not finite"):
        perturbed(replace(arm, us=np.full_like(arm.us, np.nan)), CompiledTwin(arm.twin))
    with pytest.raises(PlannerError, match="without its problem"):
        perturbed(replace(arm, problem=None), CompiledTwin(arm.twin))
