"""PenaltyCost: least squares of heights, distances, gaps and velocities of a machine over the stages.

    J = sum_n dt weight_n 1/2 r_n^2  over the stages,  + final_weight 1/2 r_N^2 at the end

for each term of problem.costs.penalty_terms, r its residual (see residuals.scalars).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from planner.base.arguments import LONGEST_HORIZON, count, short_repr
from planner.base.errors import PlannerError
from planner.kernels.tree.residuals.table import VELOCITY
from planner.problem.costs.residuals.cost import GoalRows, ResidualCost
from planner.problem.costs.residuals.of_penalties import measures_of
from planner.problem.costs.tracking import mechanism_and_step


class PenaltyCost(ResidualCost):
    """Penalties of heights, distances, gaps and velocities; one term of a cost: TrackingCost(...) + PenaltyCost(...).

    With RigidBodyDynamics it is part of the compiled solver.

    Args:
        machine: RigidBodyDynamics or a Mechanism.
        horizon: N, number of stages.
        terms: Height, Distance, Gap and Velocity.
        dt: s; that of the dynamics by default.

    Attributes:
        names: (T,) of the terms, for a reader.

    Raises:
        PlannerError: No such frame or contact, something per stage of another length than N+1, or what is no term.
    """

    def __init__(self, machine: Any, horizon: int, terms: Sequence[Any], dt: float | None = None) -> None:
        mechanism, dt = mechanism_and_step(machine, dt)
        N = count("horizon", horizon, maximum=LONGEST_HORIZON)
        if not isinstance(terms, Sequence):
            raise PlannerError(f"terms is {short_repr(terms)}, expected a list of Height, Distance, Gap and Velocity.")
        self.names = tuple(str(term) for term in terms)
        measures = measures_of(mechanism, N, terms, dt)
        units = ["m/s" if kind == VELOCITY else "m" for kind in measures.kind]
        # without a final weight of its own a term only goes on until the end
        asked = [t for t, term in enumerate(terms) if getattr(term, "final_weight", None) is not None]
        super().__init__(mechanism, measures, N, [GoalRows(self.names[t], units[t], t) for t in asked])

    def values(self, xs: np.ndarray) -> np.ndarray:
        """(N+1, T) m or m/s, the values of the terms along xs (N+1, nx), also where they are off."""
        return self._values(self.residual_arrays, xs).T
