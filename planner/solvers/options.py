"""SolverOptions: the settings of solve(), each with its meaning, its default and its source."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

from planner.base.arguments import choice, count, number, set_fields, short_repr
from planner.base.errors import PlannerError
from planner.model.capabilities import capabilities_of

if TYPE_CHECKING:
    from planner.problem.problem import Problem

UPDATES = ("feedback", "open-loop")
HESSIANS = ("gauss-newton", "exact")
LINE_SEARCHES = ("armijo", "exact", "wolfe", "goldstein")  # in the order of kernels.lq.line_search
MAX_STARTS = 10_000  # upper limit of starts; each is a whole solve
MULTISTART_ARGUMENTS = ("starts", "rank", "seed", "spread", "executor")
"""Arguments of solve() that only apply to several starts."""

EXPECTED_REDUCTION_TOLERANCE = 1e-10
"""Default of expected_reduction_tolerance if the problem has none, relative to max(1, J)."""


@dataclass(frozen=True, kw_only=True)
class SolverOptions:
    """Settings of solve(): algorithm, stopping criteria and constants.

    A tolerance "of the cost" is relative to max(1, J). N&W is Nocedal and Wright, Numerical Optimization, 2nd edition.

    Attributes:
        update: "feedback" rolls out u = us + alpha k + K (x - xs); "open-loop" is the paper's Eq. 36, us + alpha du.
        line_search: "armijo" (N&W 3.1), "exact", "wolfe" or "goldstein" (the paper's section 3.3).
        hessian: "gauss-newton", the paper's; "exact" adds the second derivatives of the dynamics (DDP): fewer but
            longer iterations, for terminal goals that are hard to reach with a small cost.
        max_iterations: Limit of the iterations of one start, all rounds of the augmented Lagrangian together.
        gradient_tolerance: Converged when the norm of the gradient (Eq. 19) is at most this (Eq. 20).
        expected_reduction_tolerance: Converged when the LQ problem expects a reduction of at most this of the cost.
            None: the problem's, or 1e-10.
        actual_reduction_tolerance: Converged also when iterations in a row each reduce the cost by less than this of
            the cost without regularization. It ends solves at contact nonsmoothness, where the LQ problem
            expects a reduction that no step achieves. None: the problem's, or friction_reduction_tolerance with
            friction loss, or 0 (never).
        max_slow_iterations: Iterations in a row that actual_reduction_tolerance counts.
        friction_reduction_tolerance: Default of actual_reduction_tolerance for machines with friction loss, where
            neither the call nor the problem has one; smaller values only add iterations.
        friction_slow_iterations: max_slow_iterations of that default: reductions pause while joints reverse.

        starts: Number of first guesses, at most 10,000: the problem's own and random changes of it.
        seed: Seed of the random changes.
        spread: Size of the random changes, relative to the controls.
        pilot_iterations: Iterations after which the controls have the size that `spread` scales.

        homotopy: Whether a solve without success begins again from other first guesses; one that ends at limits then
            without limits, which are tightened step by step; one with contacts, without success or slow, with forces at
            a distance or softer contacts, which are then hardened (see solvers.relaxation). Not with a warm start, nor
            with a lower max_iterations than the default.

        min_regularization: Smallest weight mu on the controls' steps, relative to the largest entry of R; below it mu
            is zero (Levenberg and Marquardt; N&W 10.3).
        max_regularization: Largest mu, relative to the same: a solve that needs more ends with NO_DESCENT.
        regularization_factor: mu grows by this after a failed iteration and shrinks by it after a full step.
        max_state_regularization: Largest weight on changes of the states, relative to the cost's own (Tassa, Erez and
            Todorov 2012).
        state_regularization_factor: It grows by this after a short step, by its square after a failed iteration, and
            shrinks by it after a full step.
        short_step: Step length below which the weight on changes of the states grows.
        max_short_steps: After so many short steps in a row changes of the states are regularized, except with contacts,
            stops and friction loss, whose nonsmoothness causes short steps.

        acceleration_steps: Number of last steps in Anderson acceleration (Walker and Ni 2011). 1: none.
        acceleration_max_reduction: Only iterations that reduce the cost by less than this of the cost are accelerated.
        acceleration_model_error: A full step whose reduction is within this share of the expected one is not
            accelerated: it already converges fast.

        max_outer_iterations: Rounds of the augmented Lagrangian: solves, each with new multipliers and penalties.
        required_violation_ratio: A constraint's penalty grows if its violation exceeds this share of the last round's
            (N&W 17.4; Birgin and Martinez 2014).
        penalty_growth: Factor of that growth.
        max_penalty: Upper limit of the penalty weights, above which rounding errors exceed the cost.
        max_scaling_cost: Upper limit of the first guess's cost that scales the initial penalties of clearances.
        state_bound_penalty_factor: First penalty of state bounds relative to that of constraints: the active set
            of the LQ problem predicts which bounds become active.
        max_stalled_rounds: Rounds within which the violation must fall below stall_ratio times its minimum before.
        stall_ratio: See max_stalled_rounds; else the solve ends with OUTSIDE_LIMITS.
        max_tightenings: Maximum number of tightenings of clearances that are violated between knots.
        inner_accuracy: Error of a round that ends early, relative to the violation that it is to reach (inexact
            augmented Lagrangian; Bertsekas 1982, section 2.5).
        first_round_tolerance: Expected reduction, of the cost, below which the first round ends if violations exceed
            exact_rounds_violation tolerances.
        exact_rounds_violation: Rounds are solved exactly once violations are below this multiple of the tolerance.

        max_defect_iterations: Iteration limit of multiple shooting, after which the solve starts from a rollout of the
            first controls or a share of them.
        merit_factor: Weight of the defects in the merit function over their largest multiplier (N&W 18.3).
        max_merit_ratio: The weight is reset if it exceeds this multiple of the largest multiplier.
        closing_share: A rollout that closes the defects ends multiple shooting if it costs less than the states do with
            this share of what their defects weigh.
        max_defect_halvings: Step halvings in multiple shooting before state regularization grows.
        max_defect_regularization: Largest weight on changes of the states, in multiple shooting, relative to the
            cost's own: a larger one prevents defects from closing.
        control_share: If it fails, multiple shooting restarts with the controls multiplied by this factor.
        control_trials: Number of such trials, the first with the full controls, before one with zero controls.

        max_warm_start_cost_ratio: If the tracking rollout costs more than this multiple of the warm start's trajectory,
            the states of the trajectory are the first guess.
    """

    update: str = "feedback"
    line_search: str = "armijo"
    hessian: str = "gauss-newton"
    max_iterations: int = 1000
    gradient_tolerance: float = 1e-8
    expected_reduction_tolerance: float | None = None
    actual_reduction_tolerance: float | None = None
    max_slow_iterations: int = 2
    friction_reduction_tolerance: float = 1e-5
    friction_slow_iterations: int = 8

    starts: int = 1
    seed: int = 0
    spread: float = 1.0
    pilot_iterations: int = 5

    homotopy: bool = True

    min_regularization: float = 1e-6
    max_regularization: float = 1e10
    regularization_factor: float = 10.0
    max_state_regularization: float = 1e12
    state_regularization_factor: float = 5.0
    short_step: float = 0.2
    max_short_steps: int = 8

    acceleration_steps: int = 5
    acceleration_max_reduction: float = 1e-3
    acceleration_model_error: float = 0.1

    max_outer_iterations: int = 30
    required_violation_ratio: float = 0.25
    penalty_growth: float = 10.0
    max_penalty: float = 1e12
    max_scaling_cost: float = 1e6
    state_bound_penalty_factor: float = 100.0
    max_stalled_rounds: int = 6
    stall_ratio: float = 0.5
    max_tightenings: int = 5
    inner_accuracy: float = 0.1
    first_round_tolerance: float = 1e-2
    exact_rounds_violation: float = 10.0

    max_defect_iterations: int = 60
    merit_factor: float = 2.0
    max_merit_ratio: float = 8.0
    closing_share: float = 1.0
    max_defect_halvings: int = 12
    max_defect_regularization: float = 0.01
    control_share: float = 0.25
    control_trials: int = 6

    max_warm_start_cost_ratio: float = 2.0

    def __post_init__(self) -> None:
        set_fields(self, **{name: _checked(name, value) for name, value in vars(self).items()})

    @property
    def feedback(self) -> bool:
        """Whether the update is "feedback"."""
        return self.update == "feedback"

    @property
    def exact_hessian(self) -> bool:
        """Whether Hessians include the second derivatives of the dynamics."""
        return self.hessian == "exact"

    @property
    def rule(self) -> int:
        """Index of the line search in the kernels."""
        return LINE_SEARCHES.index(self.line_search)

    @property
    def accelerated(self) -> bool:
        """Whether slowly converging steps are accelerated: only with the default update and line search."""
        return self.feedback and self.line_search == "armijo"

    def for_problem(self, problem: Problem) -> SolverOptions:
        """A copy whose unset tolerances are those of the problem, or the defaults."""
        expected, actual, slow = self.expected_reduction_tolerance, self.actual_reduction_tolerance, None
        if expected is None:
            expected = problem.expected_reduction_tolerance
            expected = EXPECTED_REDUCTION_TOLERANCE if expected is None else expected
        if actual is None:
            actual = problem.actual_reduction_tolerance
            if not actual:
                slow = self.friction_slow_iterations
                friction = capabilities_of(problem.dynamics).friction_loss
                actual = self.friction_reduction_tolerance if friction else 0.0
        return _with_checked(
            self,
            expected_reduction_tolerance=expected,
            actual_reduction_tolerance=actual,
            max_slow_iterations=slow or self.max_slow_iterations,
        )

    def recorded(self, problem: Problem) -> dict[str, Any]:
        """The settings that a plan stores: the common ones, and others if not default."""
        resolved = self.for_problem(problem)
        common = {name: getattr(resolved, name) for name in _COMMON}
        several = {"seed": self.seed, "spread": self.spread} if self.starts > 1 else {}
        if self is DEFAULT:
            return common
        known = (*_COMMON, "seed", "spread")
        others = {name: value for name, value in vars(self).items() if name not in known and value != _DEFAULTS[name]}
        return common | several | others


_COMMON = (
    "update", "line_search", "hessian", "max_iterations", "gradient_tolerance", "expected_reduction_tolerance",
    "actual_reduction_tolerance", "starts",
)  # fmt: skip
_FACTORS = ("regularization_factor", "state_regularization_factor", "penalty_growth", "merit_factor", "max_merit_ratio")
_CHOICES = {"update": UPDATES, "line_search": LINE_SEARCHES, "hessian": HESSIANS}
_DEFAULTS: dict[str, Any] = {field.name: field.default for field in fields(SolverOptions)}


def _checked(name: str, value: Any) -> Any:
    """The value of a field, as a plain number."""
    default = _DEFAULTS[name]
    if name in _CHOICES:
        return choice(name, value, _CHOICES[name])
    if value is None and default is None:
        return None
    if isinstance(default, bool):
        if not isinstance(value, bool):
            raise PlannerError(f"{name} is {short_repr(value)}, expected True or False.")
        return value
    if isinstance(default, int):
        maximum = MAX_STARTS if name == "starts" else None
        return count(name, value, minimum=0 if name in ("seed", "max_tightenings") else 1, maximum=maximum)
    if name.endswith("_tolerance"):
        return number(name, value, minimum=0.0)
    return number(name, value, greater_than=1.0 if name in _FACTORS else 0.0)


def _with_checked(options: SolverOptions, **changes: Any) -> SolverOptions:
    """A copy with checked values; dataclasses.replace would check all again."""
    copy = SolverOptions.__new__(SolverOptions)
    copy.__dict__.update(vars(options), **changes)
    return copy


def with_overrides(options: SolverOptions | None, **keywords: Any) -> SolverOptions:
    """Options with the keywords that are not None in place of their fields.

    Raises:
        PlannerError: `options` is no SolverOptions, or a value is out of range.
    """
    if options is None:
        options = DEFAULT
    if not isinstance(options, SolverOptions):
        raise PlannerError(f"options is {short_repr(options)}, expected a SolverOptions or None.")
    changes = {name: _checked(name, value) for name, value in keywords.items() if value is not None}
    return _with_checked(options, **changes) if changes else options


DEFAULT = SolverOptions()


def single_start(arguments: dict[str, Any]) -> dict[str, Any]:
    """Arguments of solve() reduced to a single start."""
    single = {name: value for name, value in arguments.items() if name not in MULTISTART_ARGUMENTS}
    if single.get("options") is not None:
        single["options"] = with_overrides(single["options"], starts=1)
    return single
