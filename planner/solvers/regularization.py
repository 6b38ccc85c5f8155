"""Regularization: weights that make the LQ problems positive definite and line searches succeed.

Gauss-Newton from controls adds mu to R + B'PB, only after a failure. A solve with exact Hessians, from states, with
bounds of controls, or after many short steps regularizes changes of the states instead (Engine.state_regularization),
more after short steps: the higher gains limit the rollout's deviation from the trajectory, which a weight on the
controls' steps does not (Tassa, Erez and Todorov 2012). With controls at their bounds step lengths may be small for
hundreds of iterations.
"""

from __future__ import annotations

import math

from planner.kernels.lq.workspace import CONVERGED
from planner.solvers.engine import Engine, IterationResult
from planner.solvers.options import DEFAULT, SolverOptions

RETRY_SHARE = 0.1  # of the expected reduction at which a weight was set to zero in vain, before the next try


class Regularization:
    """The weight mu on the controls' steps, or that on changes of the states.

    A failed sweep or line search increases it, a full step decreases it; short steps also increase that on states.
    If exact Hessians make a sweep indefinite, that iteration uses Gauss-Newton Hessians with the same weight.

    Args:
        engine: Of the solve, after its start.
        exact: Whether its Hessians are exact.
        regularize_states: Whether short steps increase the weight on changes of the states.
        at_bounds: Whether they do so while controls are at their bounds. False for contacts, whose nonsmoothness
            causes short steps: a hop then takes 1,200 iterations instead of 320.
        smooth: Whether max_short_steps short steps in a row begin to do so: a model that is wrong beyond a small part
            of its step stays so, in free flight for hundreds of iterations.
        options: Limits and factors of the weights.

    Attributes:
        of_states: Whether the weight is that on changes of the states.
        mu: Weight on the controls' steps, in the units of R; zero where states are regularized.
        weight: The weight that the solve's history records: mu, or Engine.state_regularization.
    """

    def __init__(
        self, engine: Engine, exact: bool, regularize_states: bool = False, at_bounds: bool = False,
        smooth: bool = False, options: SolverOptions = DEFAULT,
    ) -> None:  # fmt: skip
        self._engine, self._exact, self._options = engine, exact, options
        self._smooth, self._short_steps = smooth, 0
        self._min, self._factor = options.min_regularization, options.regularization_factor
        self._max, self._failed_factor = options.max_regularization, self._factor
        self.of_states, self._always = False, regularize_states
        self._too_large = False  # the steps of the model, for max_short_steps in a row
        if regularize_states or at_bounds:
            self._regularize_states()
        self._relative, self._tried_unregularized, self._second_order = 0.0, False, exact
        self._tried_at, self._retry = math.inf, math.inf  # expected reductions: at the last try, and for the next
        self._dropped = 0.0  # weight before decrease() set it to zero at a nonsmooth point

    def _regularize_states(self) -> None:
        """Have the weight on changes of the states from now on."""
        self.of_states, self._relative = True, 0.0
        self._factor, self._max = self._options.state_regularization_factor, self._options.max_state_regularization
        self._failed_factor = self._factor**2

    @property
    def mu(self) -> float:  # noqa: D102
        return 0.0 if self.of_states else self._relative * self._engine.largest_control_weight

    @property
    def weight(self) -> float:  # noqa: D102
        return self._relative if self.of_states else self.mu

    @property
    def exhausted(self) -> bool:
        """Whether the weight exceeds its maximum."""
        return self._relative > self._max

    @property
    def unregularized(self) -> bool:
        """Whether the weight is zero."""
        return self._relative == 0.0

    def drop_second_order(self) -> bool:
        """Disable the second-order terms until the weight changes; whether they were enabled."""
        had, self._second_order = self._second_order, False
        self._engine.use_second_order(False)
        return had

    def increase(self) -> None:
        """After a sweep or line search that failed."""
        self._set(max(self._min, self._failed_factor * self._relative, self._dropped))
        self._dropped = 0.0

    def decrease(self, step: float, nonsmooth: bool) -> None:
        """After a step length `step`; with `nonsmooth` bounds or penalties a step below 1 sets the weight to zero."""
        self._short_steps = self._short_steps + 1 if step < self._options.short_step else 0
        if self._smooth and not self._always and self._short_steps >= self._options.max_short_steps:
            self._always = self._too_large = True
            self._regularize_states()
        if step >= 1.0:
            self._set(self._relative / self._factor if self._relative > self._min else 0.0)
        elif nonsmooth and not self._too_large:
            self._dropped = self._relative  # increase() returns to it at once
            self._set(0.0)
        elif self.of_states:
            short = step < self._options.short_step and (self._always or self._engine.has_active_bounds)
            self._set(max(self._min, self._factor * self._relative) if short else self._relative)

    def try_unregularized(self, accepted: bool, reduction: float, small: float) -> bool:
        """Set a weight on the states to zero if the expected reduction is small, for fast final convergence.

        The weight itself makes it small: where without it the reduction is not, the next try waits until it has fallen
        by RETRY_SHARE.

        Args:
            accepted: Whether the last iteration took a step.
            reduction: What its LQ problem expects of a full step.
            small: What is small.

        Returns:
            Whether the weight was set to zero.
        """
        if accepted and reduction > small:
            if self._tried_unregularized and self.unregularized:
                self._retry = RETRY_SHARE * self._tried_at
            self._tried_unregularized = False
        if self._tried_unregularized or self.unregularized or not self.of_states or reduction > min(small, self._retry):
            return False
        self._set(0.0)
        self._tried_unregularized, self._tried_at = True, reduction
        return True

    def _set(self, relative: float) -> None:
        self._relative = relative
        if self.of_states:
            self._engine.state_regularization = relative
        if self._exact and not self._second_order:
            self._second_order = True
            self._engine.use_second_order(True)


def unregularized_sweep(engine: Engine, options: SolverOptions = DEFAULT) -> IterationResult:
    """Linearize and sweep with Gauss-Newton Hessians and the smallest tried mu that makes it definite."""
    engine.use_second_order(False)  # Gauss-Newton gains stabilize also before convergence
    engine.state_regularization = 0.0
    regularization, relinearize = Regularization(engine, False, options=options), True
    while True:
        result = engine.sweep(regularization.mu, relinearize)
        if result.kind == CONVERGED or regularization.exhausted:
            return result
        regularization.increase()
        relinearize = False
