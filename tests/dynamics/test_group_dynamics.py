"""A user's own dynamics on a group: a torque-driven body in space, written in NumPy, from solve() to file."""

import numpy as np
import pytest

import planner
from planner import PlannerError, Problem, Status, TrackingCost
from planner.cases.plan_file import load_plan
from planner.model.space import StateSpace, exp_quaternion, product
from planner.solvers import lq
from planner.solvers.engine import NumpyEngine, acquire_engine
from planner.solvers.options import UPDATES

INERTIA = np.diag([1.0, 2.0, 3.5])
TURN = exp_quaternion(np.array([0.4, -1.1, 0.3]))


class Spinner:
    """x = (quaternion, rate in the body's axes), J dw/dt = u - w x J w: twice the midpoint rule."""

    nx, nu, dt = 7, 3, 0.1
    space = StateSpace(7, 6, ((0, 0),))

    def _rates(self, xs, us):
        w = xs[:, 4:]
        return np.concatenate([w, np.linalg.solve(INERTIA, (us - np.cross(w, w @ INERTIA)).T).T], axis=1)

    def step(self, xs, us, dt=None):
        h = self.dt if dt is None else dt[:, None]
        # Rates at the middle, twice: second order, on the group by construction.
        middle = self.space.integrate(xs, 0.5 * h * self._rates(xs, us))
        middle = self.space.integrate(xs, 0.5 * h * self._rates(middle, us))
        return self.space.integrate(xs, h * self._rates(middle, us))

    def linearize(self, xs, us):
        h, x = 1e-6, xs[: len(us)]
        A, B = np.empty((len(us), 6, 6)), np.empty((len(us), 6, 3))
        for i, d in enumerate(h * np.eye(6)):
            ends = self.step(self.space.integrate(x, d), us), self.step(self.space.integrate(x, -d), us)
            A[:, :, i] = self.space.difference(*ends) / (2 * h)
        for i, d in enumerate(h * np.eye(3)):
            B[:, :, i] = self.space.difference(self.step(x, us + d), self.step(x, us - d)) / (2 * h)
        return A, B


def turn(N=15, start=(1.0, 0.0, 0.0, 0.0), goal=TURN, **changes):
    """From a spin to rest in another orientation."""
    cost = TrackingCost.reach(
        [*goal, 0.0, 0.0, 0.0], N, final=3000.0, effort=1.0, running=0.1, dt=0.1, nu=3, space=Spinner.space
    )
    return Problem(**{"dynamics": Spinner(), "cost": cost, "x0": [*start, 0.3, 1.0, -0.5], **changes})


def rollout(problem, us, plan=None, x0=None):
    space, x, states, controls = Spinner.space, problem.x0 if x0 is None else x0, [], []
    states.append(x)
    for n in range(problem.N):
        controls.append(us[n] if plan is None else us[n] + plan.K[n] @ space.difference(x, plan.xs[n]))
        x = problem.dynamics.step(x[None], controls[-1][None])[0]
        states.append(x)
    return np.array(states), np.array(controls)


@pytest.mark.parametrize("update", UPDATES)
@pytest.mark.parametrize("line_search", ["armijo", "wolfe", "goldstein", pytest.param("exact", marks=pytest.mark.slow)])
def test_a_body_is_turned_to_its_goal(update, line_search):
    problem = turn()
    assert isinstance(acquire_engine(problem), NumpyEngine)
    plan = planner.solve(problem, update=update, line_search=line_search)
    assert plan.status is Status.CONVERGED
    xs, _ = rollout(problem, plan.us)
    np.testing.assert_allclose(plan.xs, xs, rtol=0, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(plan.xs[:, :4], axis=1), 1.0, rtol=0, atol=1e-12)
    assert plan.cost == pytest.approx(problem.cost.value(xs, plan.us), rel=1e-12)
    assert plan.K.shape == (problem.N, 3, 6)
    assert np.abs(plan.space.difference(plan.xs[-1], problem.cost.x_ref[-1])).max() < 0.05
    A, B = problem.dynamics.linearize(plan.xs, plan.us)
    np.testing.assert_allclose(plan.K, lq.riccati(A, B, problem.cost.quadratize(plan.xs, plan.us)).K, atol=1e-9)
    assert plan.gradient_norm < 1e-3 * plan.history[0].gradient_norm


def test_the_gradient_is_that_of_the_cost():
    """Eq. 16-19 on the group, against differences of J through rollouts; far from the optimum."""
    problem = turn(N=6)
    us = np.random.default_rng(0).normal(size=(6, 3))
    xs, _ = rollout(problem, us)
    A, B = problem.dynamics.linearize(xs, us)
    model, h = problem.cost.quadratize(xs, us), 1e-5
    gradient = lq.gradient(A, B, model)

    def J(us, x0=None):
        return problem.cost.value(rollout(problem, us, x0=x0)[0], us)

    for n, a in np.ndindex(6, 3):
        d = np.zeros((6, 3))
        d[n, a] = h
        assert (J(us + d) - J(us - d)) / (2 * h) == pytest.approx(gradient[n, a], rel=1e-6, abs=1e-6)
    for i, d in enumerate(h * np.eye(6)):
        starts = (Spinner.space.integrate(problem.x0, s * d) for s in (1.0, -1.0))
        plus, minus = (J(us, x0) for x0 in starts)
        assert (plus - minus) / (2 * h) == pytest.approx(lq.costates(A, model)[0, i], rel=1e-6, abs=1e-6)


@pytest.mark.parametrize("feedback", [True, False])
def test_slopes_along_the_search_are_exact(feedback):
    """What Wolfe's rule asks for: dJ/dalpha of the update, also where the candidate is turned away from the nominal."""
    problem = turn(N=8)
    engine = NumpyEngine(problem)
    cost = engine.start_from_controls(problem.x0, np.random.default_rng(1).normal(size=(8, 3)))
    engine.iterate(feedback, 0, 0.0, True, cost, 0.0, 0.0)
    (xs0, us0), sweep = engine.trajectory(), lq.riccati(engine._A, engine._B, engine._model)
    K = sweep.K if feedback else None

    def along(alpha):
        us = us0[:, None, :] + alpha * engine._dus[:, None, :]
        xs, J = engine._rollout(problem.x0, us, K, xs0)
        return xs[:, 0], us[:, 0], J[0]

    h = 1e-5
    assert np.abs(Spinner.space.difference(along(0.7)[0], xs0)[:, :3]).max() > 0.05
    xs, us, _ = along(0.7)
    assert engine._slope(xs, us, K) == pytest.approx((along(0.7 + h)[2] - along(0.7 - h)[2]) / (2 * h), rel=1e-6)


def test_nothing_depends_on_where_north_is():
    """Turned start and goal: the body's own controls and gains are the same."""
    plan = planner.solve(turn())
    north = exp_quaternion(np.array([2.0, 0.5, -1.0]))
    turned = planner.solve(turn(start=product(north, np.eye(4)[0]), goal=product(north, TURN)))
    assert turned.nit == plan.nit
    np.testing.assert_allclose(turned.us, plan.us, atol=1e-6)
    np.testing.assert_allclose(turned.K, plan.K, atol=1e-5)


def test_a_quaternion_and_its_negative_are_one_orientation():
    plan, negative = planner.solve(turn()), planner.solve(turn(start=(-1.0, 0.0, 0.0, 0.0), goal=-TURN))
    np.testing.assert_allclose(negative.us, plan.us, atol=1e-9)
    np.testing.assert_allclose(negative.xs[:, :4], -plan.xs[:, :4], atol=1e-9)


def test_gains_hold_the_plan():
    """From a start a little off, plans held by their gains cost less than those without, by what P promises."""
    problem = turn()
    plan = planner.solve(problem)
    for d in 0.05 * np.eye(6):
        costs = {True: 0.0, False: 0.0}
        for sign in (1.0, -1.0):  # the first order cancels
            x0 = Spinner.space.integrate(problem.x0, sign * d)
            for held in costs:
                costs[held] += problem.cost.value(*rollout(problem, plan.us, plan if held else None, x0))
        assert 2.0 * plan.cost - 1e-3 < costs[True] < costs[False]


def test_the_plan_comes_back_from_its_file(tmp_path):
    plan = planner.solve(turn())
    with pytest.warns(UserWarning, match="cannot hold its dynamics"):
        back = load_plan(plan.save(tmp_path / "turn.npz"))
    assert back.problem is None
    assert back.space == Spinner.space
    np.testing.assert_array_equal(back.K, plan.K)


def test_starts_are_normalized():
    problem = turn(start=(2.0, 0.0, 0.0, 2.0))
    np.testing.assert_allclose(problem.x0[:4], [np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)])


class Wrong(Spinner):
    """Derivatives with respect to the quaternion's numbers, as one easily writes them."""

    def linearize(self, xs, us):
        return np.zeros((len(us), 7, 7)), np.zeros((len(us), 7, 3))


FLAT = TrackingCost.reach(np.ones(7), 15, final=1.0, effort=1.0, nu=3)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"x0": np.zeros(7)}, "x0 has a quaternion of length zero at 0 to 3, expected e.g. 1, 0, 0, 0."),
        ({"x0": np.ones(6)}, "x0 has shape (6,), expected (7,)."),
        ({"x0": [np.nan, *np.ones(6)]}, "x0[0] is nan, expected finite numbers."),
        ({"cost": FLAT}, "the cost is made for ndx = 7, expected the dynamics' ndx = 6; make it with space="),
        (
            {"cost": TrackingCost.reach([0, 1, 1, 1, 1, 1, 1], 15, final=1, effort=1, nu=3,
                                        space=StateSpace(7, 6, ((3, 3),)))},
            "the cost has its quaternions elsewhere, expected it to be made with dynamics.space.",
        ),
    ],
)  # fmt: skip
def test_dynamics_that_do_not_fit_the_space_are_refused_in_one_sentence(changes, expected):
    with pytest.raises(PlannerError) as error:
        turn(**changes)
    assert str(error.value).startswith(expected)


def test_derivatives_of_the_wrong_size_are_one_sentence():
    with pytest.raises(PlannerError, match=r"linearize gives A of shape \(15, 7, 7\), expected \(15, 6, 6\)\."):
        planner.solve(turn(dynamics=Wrong()))
