"""A residual of one's own: as a cost, as a constraint, in the loop, in a plan's file and on the command line."""

import textwrap
import warnings
from dataclasses import dataclass, replace

import arms
import numpy as np
import pytest
from commands import refused, run
from gradients import assert_gradients

import planner
from planner import Constraint, Residual
from planner.base.errors import FileError, PlannerError
from planner.constraints import FramePosition
from planner.costs import LeastSquares
from planner.dynamics import frame_pose, jacobian

N, DT = 30, 0.02
GOAL = np.array([-0.5, 0.4, 0.0, 0.0])


@dataclass(frozen=True)
class SlopeOfHand(Residual):
    """The toy: the squared height of a frame over its distance in x from a wall at -`wall`, m."""

    frame: str
    wall: float = 2.0
    unit = "m"

    def value(self, dynamics, xs, us):
        """(K,) m."""
        p = frame_pose(dynamics.mechanism, xs[:, :2], dynamics.mechanism.frame(self.frame))[:, :3, 3]
        return p[:, 2] ** 2 / (p[:, 0] + self.wall)


class ExactSlope(SlopeOfHand):
    """The same with its derivative by hand."""

    def jacobian(self, dynamics, xs, us):
        """(K, 1, 4)."""
        frame = dynamics.mechanism.frame(self.frame)
        p = frame_pose(dynamics.mechanism, xs[:, :2], frame)[:, :3, 3]
        J, x = jacobian(dynamics.mechanism, xs[:, :2], frame), p[:, 0] + self.wall
        by_q = (2 * p[:, 2] / x)[:, None] * J[:, 2] - (p[:, 2] ** 2 / x**2)[:, None] * J[:, 0]
        return np.concatenate([by_q, np.zeros_like(by_q)], axis=1)[:, None]


class DrivePower(Residual):
    """Of states and controls, two components, not a dataclass."""

    dim, unit, of_controls, name = 2, "W", True, "power of the drives"

    def __init__(self, scale):
        self.scale = scale

    def value(self, dynamics, xs, us):
        """(K, 2) W."""
        return self.scale * us * xs[:, 2:4]


@pytest.fixture(scope="module")
def machine():
    return planner.RigidBodyDynamics(arms.mechanism(), DT)


def problem_of(machine, *costs, **parts):
    tracking = planner.TrackingCost.joints(machine, GOAL, N, effort=0.01, final_position=100.0, final_velocity=1.0)
    cost = sum(costs, tracking) if costs else tracking
    return planner.Problem(machine, cost, np.array([0.5, -1.0, 0.0, 0.0]), **parts)


def trajectory(seed=0):
    rng = np.random.default_rng(seed)
    return rng.normal(size=(N + 1, 4)), rng.normal(size=(N, 2))


@pytest.mark.parametrize(
    ("residual", "bounds"),
    [
        (SlopeOfHand("hand"), {"target": 0.1}),
        (ExactSlope("hand"), {"target": 0.1, "final_weight": 3.0}),
        (ExactSlope("hand"), {"lower": 0.03, "upper": 0.1}),
        (DrivePower(0.5), {"upper": [0.2, 0.5]}),
        (DrivePower(0.5), {}),
        (FramePosition("hand"), {"target": [0.1, 0.0, -0.3]}),
    ],
)
def test_the_gradient_is_that_of_the_value(machine, residual, bounds):
    """A kink of a bound has probability zero at random states."""
    cost, (xs, us) = LeastSquares(machine, N, residual, weight=2.0, **bounds), trajectory()
    assert_gradients(cost, machine.space, xs, us)


def test_the_jacobian_by_hand_and_differences_agree(machine):
    """Central differences of a smooth function are off by the step squared, 4e-11."""
    own, exact = (kind("hand").residual_function(machine, N) for kind in (SlopeOfHand, ExactSlope))
    xs, us = trajectory()
    n = np.zeros(N, dtype=int)
    for one, other in zip(own.derivatives(xs[1:], us, n), exact.derivatives(xs[1:], us, n), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-8)


def test_it_is_a_cost_and_a_goal_that_the_proof_judges_by_name_and_unit(machine):
    slope = SlopeOfHand("hand")
    cost = LeastSquares(machine, N, slope, weight=1.0, target=0.05, final_weight=1e3)
    plan = planner.solve(problem_of(machine, cost))
    assert plan.converged
    found = {one.name: one.unit for one in cost.goal_specs(())}
    assert found == {"SlopeOfHand": "m"}
    sections = planner.prove(plan, rollouts=0).sections.values()
    judged = [
        one
        for section in sections
        for one in section.measured
        if "SlopeOfHand" in one.note and one.name.endswith("_miss")
    ]
    assert judged
    assert {one.unit for one in judged} == {"m"}


def test_it_is_a_constraint_kept_to_its_tolerance(machine):
    slope = ExactSlope("hand")
    free = planner.solve(problem_of(machine))
    values = slope.value(machine, free.xs, free.us)
    bound = 0.5 * (values[[0, -1]].max() + values.max()) if values.max() > values[[0, -1]].max() else values.max()
    lower = 0.5 * (values[[0, -1]].min() + values.min())
    kept = planner.solve(problem_of(machine, constraints=[Constraint(slope, lower=lower, upper=bound, tolerance=1e-4)]))
    assert kept.converged
    assert slope.value(machine, kept.xs, kept.us).max() <= bound + 1e-4
    assert slope.value(machine, kept.xs, kept.us).min() >= lower - 1e-4


def test_the_controller_has_it_in_its_window(machine):
    """On its own plan's states the loop follows the plan; the residual's cost is that of the window's stages."""
    weights = np.linspace(1.0, 2.0, N + 1)[:, None]
    cost = LeastSquares(machine, N, ExactSlope("hand"), weight=weights, target=0.05, final_weight=30.0)
    problem = problem_of(machine, cost)
    controller = planner.Controller(problem, horizon=10)
    x = problem.x0
    for n in range(N + 5):
        x = machine.step(x[None], controller(n * DT, x)[None])[0]
    assert controller.failures == 0
    window = controller._window.cost_at(N - 10).costs[-1]
    np.testing.assert_array_equal(window.weight, np.concatenate([DT * weights[N - 10 : N], [[30.0]]]))
    resting = controller._window.cost_at(N).costs[-1]  # where the tables end
    np.testing.assert_allclose(resting.weight[1:-1, 0], DT * (weights[N - 1, 0] + 30.0))


def test_a_file_stores_it_by_name_and_parameters(machine, tmp_path):
    cost = LeastSquares(machine, N, SlopeOfHand("hand", wall=1.5), weight=1.0, lower=0.03, upper=0.1)
    limits = [Constraint(DrivePower(0.5), upper=50.0, when=(0.1, 0.4)), Constraint(FramePosition("hand"), upper=2.0)]
    plan = planner.solve(problem_of(machine, cost, constraints=limits))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        path = plan.save(tmp_path / "plan.npz")
    with pytest.raises(FileError, match="residual 'SlopeOfHand' of its maker's own, expected its class"):
        planner.load_plan(path)
    again = planner.load_plan(path, residuals={"SlopeOfHand": SlopeOfHand, "DrivePower": DrivePower})
    assert again.problem.cost.value(plan.xs, plan.us) == plan.problem.cost.value(plan.xs, plan.us)
    assert [str(one) for one in again.problem.constraints] == [str(one) for one in limits]
    assert again.problem.constraints[0].when == (0.1, 0.4)
    solved = planner.solve(again.problem)
    np.testing.assert_array_equal(solved.us, plan.us)
    assert again.to_bytes() == plan.to_bytes()


def test_a_class_of_ones_own_may_have_the_name_of_a_library_residual(machine, tmp_path):
    """A file took it for the library's: it was damaged, or with the same arguments another problem."""
    own = type("FramePosition", (SlopeOfHand,), {})
    plan = planner.solve(problem_of(machine, LeastSquares(machine, N, own("hand"), weight=1.0)))
    path = plan.save(tmp_path / "plan.npz")
    with pytest.raises(FileError, match="residual 'FramePosition' of its maker's own, expected its class"):
        planner.load_plan(path)
    again = planner.load_plan(path, residuals={"FramePosition": own})
    assert again.problem.cost.value(plan.xs, plan.us) == plan.problem.cost.value(plan.xs, plan.us)


def test_a_library_residual_is_not_replaced_by_a_class_of_its_name(machine, tmp_path):
    plan = planner.solve(problem_of(machine, constraints=[Constraint(FramePosition("hand"), upper=2.0)]))
    own = type("FramePosition", (SlopeOfHand,), {})
    again = planner.load_plan(plan.save(tmp_path / "plan.npz"), residuals={"FramePosition": own})
    assert type(again.problem.constraints[0].of) is FramePosition


def test_two_classes_of_one_name_are_not_stored(machine, tmp_path):
    """By their name alone both would be built by the one class that load_plan is given."""
    cost = LeastSquares(machine, N, type("Slope", (SlopeOfHand,), {})("hand"), weight=1.0)
    cost += LeastSquares(machine, N, type("Slope", (SlopeOfHand,), {})("hand"), weight=1.0)
    with pytest.warns(UserWarning, match="cannot hold its residuals, two classes of which are called Slope"):
        planner.solve(problem_of(machine, cost)).save(tmp_path / "plan.npz")


def test_a_residual_without_json_parameters_is_not_stored(machine, tmp_path):
    plan = planner.solve(
        problem_of(machine, LeastSquares(machine, N, SlopeOfHand("hand", np.float64(2.0)), weight=1.0))
    )
    assert plan.save(tmp_path / "plan.npz").exists()  # a number of NumPy is one
    odd = SlopeOfHand("hand", 2.0)
    object.__setattr__(odd, "wall", 2.0 + 0j)
    other = replace(plan.problem, cost=LeastSquares(machine, N, odd, weight=1.0) + plan.problem.cost.costs[0])
    with pytest.warns(UserWarning, match="cannot hold"):
        replace(plan, problem=other).save(tmp_path / "other.npz")


def test_commands_import_only_what_is_allowed(machine, tmp_path):
    source = """
        import planner

        class Elbow(planner.Residual):
            unit = "rad"

            def value(self, dynamics, xs, us):
                return xs[:, 1]
    """
    (tmp_path / "own_residuals.py").write_text(textwrap.dedent(source), encoding="utf-8")
    scope = {}
    exec(textwrap.dedent(source), scope)
    planner.solve(problem_of(machine, LeastSquares(machine, N, scope["Elbow"](), weight=1.0))).save(
        tmp_path / "plan.npz"
    )
    command = ("export", "plan.npz", "--to", "csv")
    refused(run(*command, cwd=tmp_path), "'Elbow'", "--allow-import MODULE")
    refused(run(*command, "--allow-import", "nowhere_at_all", cwd=tmp_path), "cannot be imported")
    refused(run(*command, "--allow-import", "json", cwd=tmp_path), "has no residual")
    assert run(*command, "--allow-import", "own_residuals.py", cwd=tmp_path).returncode == 0


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda m: LeastSquares(m, N, lambda xs: xs, weight=1.0), "expected a planner.Residual"),
        (lambda m: LeastSquares(m, N, SlopeOfHand("hand")), "expected one above 0"),
        (lambda m: LeastSquares(m, N, SlopeOfHand("hand"), weight=1.0, target=0.0, lower=0.0), "target and a bound"),
        (lambda m: LeastSquares(m, N, DrivePower(1.0), weight=1.0, final_weight=1.0), "no value at the end"),
        (lambda m: LeastSquares(m, N, DrivePower(1.0), weight=[1.0, 2.0, 3.0]), "has the shape"),
    ],
)
def test_wrong_arguments_are_named(machine, make, said):
    with pytest.raises(PlannerError, match=said):
        make(machine)


def test_a_target_of_a_wrong_shape_is_called_target():
    problem = planner.cases.two_link(horizon=5)
    height = planner.constraints.FramePositionAlong("tip")
    with pytest.raises(planner.PlannerError, match=r"^the target of place of tip has the shape \(2,\)"):
        planner.costs.LeastSquares(problem.dynamics, 5, height, weight=1.0, target=[1.0, 2.0])
    above = planner.costs.LeastSquares(problem.dynamics, 5, height, weight=1.0, lower=0.3)
    assert (above.lower == 0.3).all()
    assert (above.upper == np.inf).all()
