"""Control of steps: weights that make LQ problems definite and line searches succeed, and acceleration of slow steps.

Gauss-Newton from controls adds mu to R + B'PB, only after a failure. A solve with exact Hessians, from states, with
bounds of controls, or after many short steps regularizes changes of the states instead (Engine.state_regularization),
more after short steps: the higher gains limit the rollout's deviation from the trajectory, which a weight on the
controls' steps does not (Tassa, Erez and Todorov 2012). With controls at their bounds step lengths may be small for
hundreds of iterations.

Anderson acceleration (Walker and Ni 2011): the Gauss-Newton Hessian leaves out the second derivatives of the dynamics,
so its steps d(U) converge only linearly. The columns of Y and S are the changes of d and of the controls over the last
iterations. With c minimizing |d - Y c| the extrapolated point is

    U + d - (S + Y) c,

a multisecant quasi-Newton step. States are extrapolated likewise and tracked with the gains of the last sweep. The
point is accepted, with backtracking, if it costs less than the plain step.
"""

from __future__ import annotations

import contextlib
import math
from collections import deque

import numpy as np

from planner.kernels.lq.workspace import CONVERGED
from planner.model.space import space_of
from planner.problem.problem import Problem
from planner.solvers.engine import Engine, IterationResult
from planner.solvers.engine.protocol import StatesAndControls
from planner.solvers.options import DEFAULT, SolverOptions

RETRY_SHARE = 0.1  # of the expected reduction at which a weight was set to zero in vain, before the next try
RANK_TOLERANCE = 1e-12  # relative to the largest eigenvalue of Y'Y: smaller ones are rounding


class Regularization:
    """The weight mu on the controls' steps, or that on changes of the states.

    A failed sweep or line search increases it, a full step decreases it; short steps also increase that on states.
    If exact Hessians make a sweep indefinite, that iteration uses Gauss-Newton Hessians with the same weight.

    Args:
        engine: Of the solve, after its start.
        exact: Whether its Hessians are exact.
        regularize_states: Whether short steps increase the weight on changes of the states.
        at_bounds: Whether they do so while controls are at their bounds. False for contacts and friction
            loss, whose kinks cause short steps: a hop then takes 1,200 iterations instead of 320.
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


class AndersonAcceleration:
    """Anderson acceleration over the last steps of one solve.

    Args:
        problem: Problem of the engine.
        engine: Started.
        options: The constants of the acceleration.
    """

    def __init__(self, problem: Problem, engine: Engine, options: SolverOptions) -> None:
        self._engine, self._space, self._options = engine, space_of(problem.dynamics), options
        self._begin: StatesAndControls | None = None  # trajectory at the start of the next iteration
        self._before: StatesAndControls | None = None  # and of the one before
        # Changes of controls and states: directions d, and differences between the starts of successive iterations.
        self._directions: deque[np.ndarray] = deque(maxlen=options.acceleration_steps)
        self._differences: deque[np.ndarray] = deque(maxlen=options.acceleration_steps - 1)

    def extrapolate(self, cost: float, after: float, step: float, expected: float) -> float:
        """The cost of the extrapolated point, if the engine accepts it, else `after`.

        Args:
            cost: Cost before the step.
            after: Cost after the step.
            step: Step length.
            expected: Expected reduction of the step.
        """
        reduction = cost - after
        if reduction > self._options.acceleration_max_reduction * max(1.0, abs(after)):
            self._directions.clear()
            self._differences.clear()
            self._begin = self._before = None
            return after
        end = self._engine.trajectory()
        begin, self._begin = self._begin, end
        if begin is None:
            return after
        self._directions.append(self._change(begin, end) / step)
        if self._before is not None:
            self._differences.append(self._change(self._before, begin))
        self._before = begin
        accurate = step == 1.0 and abs(reduction - expected) < self._options.acceleration_model_error * expected
        if accurate or not self._differences:
            return after
        part, extrapolated = self._engine.backtrack_along(*self._point(end[1].shape, step), after)
        if part > 0.0:
            self._begin = self._engine.trajectory()
        return extrapolated

    def _change(self, begin: StatesAndControls, end: StatesAndControls) -> np.ndarray:
        """Change of the controls, then of the states, as one vector (N nu + (N+1) ndx,)."""
        return np.concatenate([(end[1] - begin[1]).ravel(), self._space.difference(end[0], begin[0]).ravel()])

    def _point(self, us: tuple[int, ...], step: float) -> StatesAndControls:
        """Changes of states (N+1, ndx) and controls (N, nu) from the end of the step to the extrapolated point."""
        directions, size = np.stack(self._directions), math.prod(us)
        d, Y, S = directions[-1], np.diff(directions, axis=0), np.stack(self._differences)
        by_controls, c = Y[:, :size], np.zeros(len(Y))
        with contextlib.suppress(np.linalg.LinAlgError):  # before convergence squares may overflow
            c = np.linalg.lstsq(by_controls @ by_controls.T, by_controls @ d[:size], rcond=RANK_TOLERANCE)[0]
        change = (1.0 - step) * d - c @ (S + Y)
        return change[size:].reshape(us[0] + 1, -1), change[:size].reshape(us)
