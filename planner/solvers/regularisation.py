"""Regularisation: what a solve adds to R + B'PB so that sweeps are definite and searches find a step."""

from __future__ import annotations

from planner.kernels.lq.workspace import CONVERGED
from planner.solvers.engine import Engine, Outcome

# Relative to the largest entry of R: raised and lowered tenfold, zero below its least value.
LEAST, MOST, FACTOR = 1e-6, 1e10, 10.0
# With bounds, what they undo of a direction can be all of its decrease, until mu outweighs B'PB and not only R.
MOST_BOUNDED = 1e16
# With exact Hessians an iteration that no regularisation makes definite is Gauss and Newton's; the next begins here.
AGAIN = 1e8


class Regularisation:
    """The weight mu on the controls' steps, and whether sweeps have the second-order terms of the dynamics.

    A sweep or search that fails raises mu, a full step lowers it. With exact Hessians, where even the largest mu does
    not help, one iteration leaves out the second-order terms.

    Args:
        engine: Of the solve, after its start.
        exact: Whether its Hessians are exact.
        bounded: Whether its controls have bounds.

    Attributes:
        mu: In the units of R; zero for the plain model of Eq. 31.
    """

    def __init__(self, engine: Engine, exact: bool, bounded: bool = False) -> None:
        self._most = MOST_BOUNDED if bounded else MOST
        self._engine, self._exact, self._second_order = engine, exact, exact
        self._relative, self._tried_plain = 0.0, False

    @property
    def mu(self) -> float:  # noqa: D102
        return self._relative * self._engine.largest_control_weight

    @property
    def exhausted(self) -> bool:
        """Whether mu has been raised beyond what can help."""
        return self._relative > self._most

    @property
    def plain(self) -> bool:
        """Whether the model is not regularised."""
        return self._relative == 0.0

    def raise_(self) -> None:
        """After a sweep or search that failed."""
        self._relative = max(LEAST, FACTOR * self._relative)
        if self.exhausted and self._second_order:
            self._use_second_order(False, 0.0)

    def lower(self, step: float, at_kink: bool) -> None:
        """After a step of this length; at a kink of bounds or hinges full steps may never come."""
        if self._exact and not self._second_order:
            self._use_second_order(True, AGAIN)
        elif step >= 1.0:
            self._relative = self._relative / FACTOR if self._relative > LEAST else 0.0
        elif at_kink:
            self._relative = 0.0

    def try_plain(self, accepted: bool, flat: bool) -> bool:
        """Drop mu once where the model promises next to nothing (`flat`): Newton steps end before mu is lowered.

        `accepted` says whether the last iteration took a step. Only with exact Hessians.
        """
        if accepted and not flat:
            self._tried_plain = False
        if not (self._exact and flat and not self.plain and not self._tried_plain):
            return False
        self._relative, self._tried_plain = 0.0, True
        return True

    def _use_second_order(self, use: bool, mu: float) -> None:
        self._second_order, self._relative = use, mu
        self._engine.use_second_order(use)


def plain_sweep(engine: Engine) -> Outcome:
    """Linearise and sweep by Gauss-Newton, without a search, with the least regularisation that makes it definite."""
    engine.use_second_order(False)  # Gauss-Newton's gains are stabilising also away from a minimum
    regularisation, fresh = Regularisation(engine, False), True
    while True:
        done = engine.sweep(regularisation.mu, fresh)
        if done.kind == CONVERGED or regularisation.exhausted:
            return done
        regularisation.raise_()
        fresh = False
