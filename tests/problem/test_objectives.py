"""Criteria: energy and jerk against differences and what mechanics says of them, objectives in solves and in files."""

from dataclasses import replace

import numpy as np
import pytest
from carts import arm, cart, refuse, write
from engines import assert_same_iterations, both_engines
from gradients import assert_gradients, assert_step_derivatives
from scipy.linalg import block_diag
from solves import rollout
from trees import CHAINS, driven, random_state

import planner
from planner import Limits, PlannerError, RigidBodyDynamics, cases
from planner.cases.problem_file import load
from planner.costs import EnergyCost, JerkCost, TrackingCost
from planner.problem.costs.jerk import JerkDynamics
from planner.problem.initial_guess import inverse_dynamics_controls, minimum_jerk
from planner.problem.objective import (
    EFFORT_SHARE,
    base_problem,
    solver_problem,
    with_objective,
)
from planner.problem.problem import Problem
from planner.problem.problem_parts import durations_or_default, weights_of
from planner.proof.consistency import consistency, recomputed
from planner.solvers import lq

SCALES = [np.pi / 2.0 / 2.0**order for order in range(3)]
"""Of the arm's way to upright in 2 s: rad, rad/s, rad/s^2."""


def walk(dynamics, rng, N, size=0.3):
    """States (N+1, nx), each some way from the last, and controls (N, nu)."""
    xs = [random_state(dynamics.space, rng, unnormalized=False)]
    for _ in range(N):
        xs.append(dynamics.space.integrate(xs[-1], size * rng.normal(size=dynamics.ndx)))
    return np.array(xs), rng.normal(size=(N, dynamics.nu))


@pytest.mark.parametrize("name", CHAINS)
def test_energy_gradients_are_differences_of_the_value(name):
    dynamics, _, _, rng = driven(CHAINS[name], 3, 1, prescribe=False)
    xs, us = walk(dynamics, rng, 3)
    for smoothing in (0.1, 10.0):
        model = assert_gradients(EnergyCost(dynamics, 2.0, smoothing), dynamics.space, xs, us)
        for n in range(3):  # what SLQ minimizes is bounded below
            H = np.block([[model.R[n], model.S[n]], [model.S[n].T, model.Q[n]]])
            assert np.linalg.eigvalsh(H).min() > -1e-10 * max(1.0, np.abs(H).max())


@pytest.mark.parametrize("name", CHAINS)
@pytest.mark.parametrize("prescribe", [False, True])
def test_jerk_gradients_are_differences_of_the_value(name, prescribe):
    dynamics, _, _, rng = driven(CHAINS[name], 4, 1, prescribe=prescribe)
    xs, us = walk(dynamics, rng, 3)
    cost = JerkCost(dynamics, 3, 1e-3, to_rest=False)
    assert_gradients(cost, dynamics.space, xs, us)


def test_an_added_state_is_the_same_cost():
    """Along a rollout the state remembers what the other cost looks up."""
    dynamics, _, _, rng = driven(CHAINS["balls"], 5, 1)
    lifted, us = JerkDynamics(dynamics), rng.normal(size=(6, dynamics.nu))
    appended = np.zeros(2 * dynamics.mechanism.nv)
    ys = [np.concatenate([random_state(dynamics.space, rng, unnormalized=False), appended])]
    for u in us:
        ys.append(lifted.step(ys[-1][None], u[None])[0])
    ys = np.array(ys)
    own = JerkCost(dynamics, 6, 0.5)
    e = lifted.space.difference(ys, ys[0])
    value = 0.5 * np.einsum("ni,nij,nj->", e, own.weights(lifted.space), e)
    assert value == pytest.approx(own.value(ys[:, : dynamics.nx], us))


def test_added_state_jacobians():
    dynamics, _, _, rng = driven(CHAINS["body in space"], 6, 1)
    x, u = random_state(dynamics.space, rng, unnormalized=False), rng.normal(size=dynamics.nu)
    y = np.concatenate([x, rng.normal(size=2 * dynamics.mechanism.nv)])
    assert_step_derivatives(JerkDynamics(dynamics), y, u)


@pytest.mark.parametrize(("name", "integrator"), [
    ("arm", "semi-implicit-euler"), ("balls", "semi-implicit-euler"), ("body in space", "rk4"), ("arm", "rosenbrock"),
])  # fmt: skip
def test_least_jerk_is_compiled_and_does_what_numpy_does(name, integrator):
    dynamics, xs, us, _ = driven(CHAINS[name], 7, 9, integrator, prescribe=False)
    cost = TrackingCost.joints(dynamics, xs[0], 8, effort=1e-2, velocity=0.1, final_position=1.0)
    limits = Limits(control=2.0)
    given = Problem(dynamics, cost, xs[1], us[:8], limits=limits)
    problem = solver_problem(with_objective(given, {"effort": 1.0, "jerk": 1e-4}))
    ours, twin = both_engines(problem)
    assert_same_iterations((ours, twin), problem, [True], within=1e-7)
    ends = [engine.set_trajectory(*twin.trajectory()) for engine in (ours, twin)]  # defects: none along a rollout
    np.testing.assert_allclose(*ends, atol=1e-9 * (1.0 + np.abs(twin.trajectory()[0]).max()))


def test_energy_is_at_least_what_the_motion_gains():
    """Held forces do their work exactly: the arm's motors cannot give it less than the 9.81 J of its new height."""
    problem = arm()
    plan = planner.solve_for(problem, "energy")
    work = EnergyCost(problem.dynamics).work(plan.xs, plan.us)
    assert plan.success
    assert 0.999 * 9.81 < work < 1.05 * 9.81  # 0.5 kg by 0.5 m and 0.5 kg by 1.5 m; 0.1 %: the integrator's


def least_jerk(N, dt):
    """The least of 1/2 sum dt |jerk|^2 of a metre from rest to rest, by one linear solve: a held force is exact."""
    D = np.diff(np.eye(N + 2)[:, 1:-1], axis=0) / dt  # of accelerations with rest before and after
    D[[0, -1]] *= np.sqrt(2.0)  # in half a stage each
    n = np.arange(N)
    C = np.array([dt**2 * (N - n - 0.5), np.full(N, dt)])  # way and speed at the end
    H = dt * D.T @ D
    a = np.linalg.solve(np.block([[H, C.T], [C, np.zeros((2, 2))]]), [*np.zeros(N), 1.0, 0.0])[:N]
    return 0.5 * a @ H @ a


def test_least_jerk():
    """Against the quadratic program, and in the limit the quintic, whose integral is 720 d^2 / T^5, with the 1/2."""
    problem = cart()
    plan = planner.solve_for(problem, "jerk")
    exact = least_jerk(50, 0.08)
    assert JerkCost(problem.dynamics, 50).value(plan.xs, plan.us) == pytest.approx(exact, rel=1e-3)
    errors = [abs(least_jerk(N, 4.0 / N) - 360 / 4.0**5) for N in (50, 100)]
    assert errors[0] == pytest.approx(4.0 * errors[1], rel=0.05)  # of second order in dt


def test_jerk_is_of_second_order_where_gravity_changes_the_acceleration_within_a_stage():
    """Along the quintic of the arm, under the torques of the stages' middles, against its integral 720 d^2 / T^5."""

    def value(N):
        dynamics = arm(N).dynamics
        way = lambda s: (q * [1.0, 0.0] * scale for q, scale in zip(minimum_jerk(s[:, None]), SCALES, strict=True))  # noqa: E731
        us = inverse_dynamics_controls(dynamics.mechanism, *way((np.arange(N) + 0.5) / N))
        q, qd, _ = way(np.arange(N + 1) / N)
        return JerkCost(dynamics, N).value(np.hstack([q, qd]), us)

    errors = [abs(value(N) - 360.0 * (np.pi / 2.0) ** 2 / 2.0**5) for N in (100, 200)]
    assert errors[0] == pytest.approx(4.0 * errors[1], rel=0.1)


def test_each_is_best_at_its_own():
    problem = arm()
    effort = lambda xs, us: 0.5 * problem.dynamics.dt * np.sum(us**2)  # noqa: E731
    measures = {
        "effort": effort,
        "energy": EnergyCost(problem.dynamics).work,
        "jerk": JerkCost(problem.dynamics, problem.N).value,
    }
    plans = {name: planner.solve_for(problem, name) for name in measures}
    for name, measure in measures.items():
        values = {objective: measure(plan.xs, plan.us) for objective, plan in plans.items()}
        assert min(values, key=values.get) == name
    for plan in plans.values():
        assert plan.success
        assert plan.problem.dynamics is problem.dynamics
        section = consistency(plan, plan.problem, recomputed(plan, plan.problem, plan.xs, plan.us))
        assert section.passed, [str(figure) for figure in section.failures]


def test_mixed_term_of_the_sweep():
    """The Riccati sweep with S against one dense solve of the whole quadratic program."""
    rng = np.random.default_rng(0)
    N, nx, nu = 5, 3, 2
    A, B = rng.normal(size=(N, nx, nx)), rng.normal(size=(N, nx, nu))
    roots = rng.normal(size=(N, nx + nu, nx + nu))
    H = roots @ np.swapaxes(roots, 1, 2) + 0.1 * np.eye(nx + nu)  # (u, x) together, positive definite
    q, r = rng.normal(size=(N + 1, nx)), rng.normal(size=(N, nu))
    Q = np.concatenate([H[:, nu:, nu:], np.eye(nx)[None]])
    model = planner.costs.Quadratic(Q, q, H[:, :nu, :nu], r, H[:, :nu, nu:])
    sweep = lq.riccati(A, B, model)
    _, dus = lq.direction(A, B, sweep)
    Phi = np.zeros((N + 1, nx, N * nu))  # dx(n) of all du
    for n in range(N):
        Phi[n + 1] = A[n] @ Phi[n]
        Phi[n + 1][:, n * nu : (n + 1) * nu] += B[n]
    whole = block_diag(*model.R)
    gradient = r.ravel() + sum(Phi[n].T @ q[n] for n in range(N + 1))
    for n in range(N + 1):
        whole = whole + Phi[n].T @ Q[n] @ Phi[n]
        if n < N:
            mixed = np.zeros((N * nu, N * nu))
            mixed[n * nu : (n + 1) * nu] = model.S[n] @ Phi[n]
            whole = whole + mixed + mixed.T
    du = -np.linalg.solve(whole, gradient)
    np.testing.assert_allclose(dus.ravel(), du, rtol=1e-9, atol=1e-9)
    assert 0.5 * sweep.slope == pytest.approx(0.5 * gradient @ du)
    assert not np.allclose(lq.riccati(A, B, model._replace(S=None)).K, sweep.K)


@pytest.mark.parametrize("objective", ["energy", "jerk", {"effort": 1.0, "jerk": 0.01, "time": 3.0}])
def test_files_hold_the_objective(tmp_path, objective):
    plan = planner.solve(with_objective(arm(20), objective), max_iterations=30)
    back = planner.load_plan(plan.save(tmp_path / "plan.npz"))
    assert back.problem.objective.weights == plan.problem.objective.weights
    assert not back.changed
    assert back.problem.cost.value(back.xs, back.us) == pytest.approx(plan.cost, rel=1e-12)
    np.testing.assert_array_equal(base_problem(back.problem).cost.R, base_problem(plan.problem).cost.R)


def test_finer_steps_keep_the_objective():
    from planner.problem.rediscretize import finer

    problem = with_objective(arm(20), {"effort": 1.0, "energy": 0.5})
    twice = finer(problem)
    assert (twice.N, twice.objective.weights) == (40, problem.objective.weights)
    us = np.random.default_rng(1).normal(size=(20, 2))
    held = np.repeat(us, 2, axis=0)
    ends = [p.cost.value(*rollout(p, controls)) for p, controls in ((problem, us), (twice, held))]
    assert ends[0] == pytest.approx(ends[1], rel=1e-2)  # the same integrals, at half the stage


def test_weights_and_shares():
    assert weights_of("jerk") == {"jerk": 1.0}
    assert weights_of({"time": 2, "effort": 0.0, "energy": 1}) == {"energy": 1.0, "time": 2.0}
    problem = arm(20)
    assert with_objective(problem, "effort").cost is problem.cost
    assert with_objective(problem, "jerk").objective.weights == {"effort": EFFORT_SHARE, "jerk": 1.0}
    changed = with_objective(with_objective(problem, "jerk"), {"effort": 2.0})
    np.testing.assert_array_equal(changed.cost.R, 2.0 * problem.cost.R)


def test_time_chooses_around_the_problems_own_duration():
    """From a fifth to twice of it, unless durations are given."""
    problem = replace(cart(20), limits=Limits(control=1.0))
    own = problem.N * problem.dynamics.dt
    plans = [
        planner.solve_for(problem, {"effort": 1.0, "time": 2.0}, durations=between)
        for between in (None, (own / 5, 2 * own))
    ]
    np.testing.assert_array_equal(plans[0].us, plans[1].us)
    assert durations_or_default((1.0, 2.0), {"time": 1.0}, own) == (1.0, 2.0)
    assert durations_or_default(None, {"effort": 1.0}, own) is None


def test_problem_file_has_an_objective(tmp_path):
    file = load(write(tmp_path, objective="{ effort = 1, time = 2 }", durations="[0.5, 2.0]"))
    assert (file.objective, file.durations) == ({"effort": 1.0, "time": 2.0}, [0.5, 2.0])
    assert file.problem.objective.weights == {"effort": 1.0, "time": 2.0}
    refuse(write(tmp_path, objective='"speed"'), "objective is 'speed'", "effort, energy, jerk, time")
    refuse(write(tmp_path, durations="[0.5, 2.0]"), "expected none without time")
    refuse(write(tmp_path, objective='"time"', durations="[2.0, 0.5]"), "shortest before the longest")


@pytest.mark.parametrize(
    ("message", "call"),
    {
        "objective is 'speed', expected one of: effort, energy, jerk, time": lambda p: planner.solve_for(p, "speed"),
        "the weight of jerk is -1.0, expected a finite number": lambda p: planner.solve_for(p, {"jerk": -1.0}),
        "no weight of the objective is above 0": lambda p: planner.solve_for(p, {}),
        "durations is 2.0, expected (shortest, longest) in s": lambda p: planner.solve_for(p, "time", durations=2.0),
        "time alone needs bounds of the controls": lambda p: planner.solve_for(p, "time", durations=(0.5, 2.0)),
        "expected RigidBodyDynamics": lambda p: planner.solve_for(cases.hopper(), "energy"),
        "jerk is that of joints": lambda p: planner.solve_for(cases.hopper(), "jerk"),
        "is prescribed": lambda p: EnergyCost(
            RigidBodyDynamics(p.dynamics.mechanism, 0.1, prescribed=("elbow",))
        ),
        "the energy's smoothing is 0.0, expected a finite number": lambda p: EnergyCost(p.dynamics, smoothing=0.0),
    }.items(),
)  # fmt: skip
def test_wrong_objectives_are_refused(message, call):
    with pytest.raises(PlannerError) as caught:
        call(arm(20))
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.pictures
def test_the_study_says_what_it_found(tmp_path):
    """Its page, rows and picture, of a result made up of three motions."""
    from planner.paper.studies import objective as study

    values = {"effort": 1.0, "energy": 2.0, "jerk": 3.0, "time": 4.0}
    motion = {"status": "CONVERGED", "iterations": 3, "values": values, "t_s": [0.0, 1.0, 2.0],
              "q_rad": [[0.0, 0.0]] * 3, "u_Nm": [[15.0, 0.0], [0.0, 1.0]], "stages_on_a_bound": 0.5}  # fmt: skip
    least = {"machine": "cart", "known_s": None, "known": "", "found_s": 2.0, "stages_on_a_bound": 1.0}
    results = {
        "bound_Nm": 15.0, "units": study.MEASURES, "motions": dict.fromkeys(values, motion),
        "best": {name: name for name in values}, "least_times": [least] * 3, "acrobot_bound_Nm": 5.0,
        "acrobot": motion | {"u_Nm": [[5.0], [0.0]]},
    }  # fmt: skip
    page = study.STUDY.page(results)
    assert "| effort | **1** | 2 | 3 | 4 | 50 % |" in page
    assert [len(row) for row in study.STUDY.rows(results)] == [4] * 3
    study.STUDY.pictures["objectives.png"](results, tmp_path / "objectives.png")
    assert (tmp_path / "objectives.png").stat().st_size > 10_000
