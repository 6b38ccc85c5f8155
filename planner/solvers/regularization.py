"""Regularization: what a solve adds to its LQ problems so that sweeps are definite and searches find a step.

Gauss-Newton from controls adds mu to R + B'PB, and only after a failure. A solve with exact Hessians, from states, or
with bounds of controls weighs changes of the states instead (Engine.state_regularization), and more as soon as steps
are short: its
gains then keep the rollout near the trajectory, which a weight on the controls' steps gives up (Tassa, Erez and Todorov
2012). Where controls are at their bounds a direction may be far too long, and hold for hundreds of iterations.
"""

from __future__ import annotations

from planner.kernels.lq.workspace import CONVERGED
from planner.solvers.engine import Engine, IterationResult

# Of mu, relative to the largest entry of R: raised and lowered tenfold, zero below its least value.
LEAST, MOST, FACTOR = 1e-6, 1e10, 10.0
# Of the weight that holds the states, and the step below which it is raised. Failures raise it by the factor's square.
MAX_STATE_WEIGHT, STATE_WEIGHT_FACTOR = 1e12, 5.0
SHORT = 0.2


class Regularization:
    """The weight mu on the controls' steps, or the one that holds the states.

    A sweep or search that fails raises it, a full step lowers it; what holds states is raised by short steps too. Where
    exact Hessians make a sweep indefinite, that iteration is Gauss and Newton's, with the same weight.

    Args:
        engine: Of the solve, after its start.
        exact: Whether its Hessians are exact.
        holds: Whether states are held where steps are short.
        bounded: Whether they are where steps are short and controls are at their bounds. Not for machines with
            contacts, whose kinks make short steps: a hop then takes 1,200 iterations instead of 320.

    Attributes:
        mu: In the units of R; zero for the plain model of Eq. 31, and where states are held.
        shown: The weight that lines of the solve show: mu, or Engine.state_regularization.
    """

    def __init__(self, engine: Engine, exact: bool, holds: bool = False, bounded: bool = False) -> None:
        self._most = MAX_STATE_WEIGHT if holds or bounded else MOST
        self._engine, self._exact, self._holds, self._always = engine, exact, holds or bounded, holds
        self._relative, self._tried_plain, self._second_order = 0.0, False, exact
        self._given_up = 0.0  # the weight that a kink set to zero

    @property
    def mu(self) -> float:  # noqa: D102
        return 0.0 if self._holds else self._relative * self._engine.largest_control_weight

    @property
    def shown(self) -> float:  # noqa: D102
        return self._relative if self._holds else self.mu

    @property
    def exhausted(self) -> bool:
        """Whether the weight has been raised beyond what can help."""
        return self._relative > self._most

    @property
    def unregularized(self) -> bool:
        """Whether the model is not regularized."""
        return self._relative == 0.0

    def drop_second_order(self) -> bool:
        """Leave out the second-order terms until the weight is set again; False where there are none."""
        left, self._second_order = self._second_order, False
        self._engine.use_second_order(False)
        return left

    def increase(self) -> None:
        """After a sweep or search that failed."""
        self._set(max(LEAST, (STATE_WEIGHT_FACTOR**2 if self._holds else FACTOR) * self._relative, self._given_up))
        self._given_up = 0.0

    def decrease(self, step: float, at_kink: bool) -> None:
        """After a step of this length; at a kink of bounds or penalties full steps may never come."""
        if step >= 1.0:
            factor = STATE_WEIGHT_FACTOR if self._holds else FACTOR
            self._set(self._relative / factor if self._relative > LEAST else 0.0)
        elif at_kink:
            self._given_up = self._relative  # if the plain model fails there is no need to climb up again
            self._set(0.0)
        elif self._holds:
            more = step < SHORT and (self._always or self._engine.has_active_bounds)
            self._set(max(LEAST, STATE_WEIGHT_FACTOR * self._relative) if more else self._relative)

    def try_unregularized(self, accepted: bool, flat: bool) -> bool:
        """Drop the weight once where the model promises next to nothing (`flat`): Newton steps outrun it.

        `accepted` says whether the last iteration took a step. Only where states are held.
        """
        if accepted and not flat:
            self._tried_plain = False
        if not (self._holds and flat and not self.unregularized and not self._tried_plain):
            return False
        self._set(0.0)
        self._tried_plain = True
        return True

    def _set(self, relative: float) -> None:
        self._relative = relative
        if self._holds:
            self._engine.state_regularization = relative
        if self._exact and not self._second_order:
            self._second_order = True
            self._engine.use_second_order(True)


def plain_sweep(engine: Engine) -> IterationResult:
    """Linearize and sweep by Gauss-Newton, without a search, with the least regularization that makes it definite."""
    engine.use_second_order(False)  # Gauss-Newton's gains are stabilizing also away from a minimum
    engine.state_regularization = 0.0
    regularization, fresh = Regularization(engine, False), True
    while True:
        done = engine.sweep(regularization.mu, fresh)
        if done.kind == CONVERGED or regularization.exhausted:
            return done
        regularization.increase()
        fresh = False
