"""CenterOfMassCost: where the centre of mass of a machine is asked to be."""

from __future__ import annotations

from typing import Any

from planner.base.errors import PlannerError
from planner.kernels.tree.residuals.table import MASS_CENTRE
from planner.problem.costs.residuals.arrays import ResidualList
from planner.problem.costs.residuals.cost import GoalRows, ResidualCost
from planner.problem.costs.residuals.per_stage import StageData
from planner.problem.costs.tracking import mechanism_and_step


class CenterOfMassCost(ResidualCost):
    """1/2 w |c(q) - position|^2 summed over the stages, c the centre of mass: Gauss-Newton; one term of a cost.

    With RigidBodyDynamics it is part of the compiled solver.

    Args:
        machine: RigidBodyDynamics or a Mechanism; what is fixed to the world is not part of its mass.
        position: (3,) or (N+1, 3) m, in the world.
        position_weight: On the way, per m^2 and s: a number, one per axis (3,), or one per stage and axis (N+1, 3).
        final_position_weight: At the end, a number or (3,); by default that of the way, times dt.
        dt: s; that of the dynamics by default.

    Raises:
        PlannerError: A wrong shape, a negative weight, no weight at all, or a machine without mass.
    """

    def __init__(
        self, machine: Any, position: Any, *, position_weight: Any = 0.0, final_position_weight: Any = None,
        dt: float | None = None,
    ) -> None:  # fmt: skip
        mechanism, dt = mechanism_and_step(machine, dt)
        if not mechanism.mass.sum() > 0.0:
            raise PlannerError("the mechanism has no mass, expected at least one link that has.")
        stages = StageData(dt)
        asked = stages.asked("position", position, position_weight, final_position_weight, 3)
        if asked is None:
            raise PlannerError("position is None, expected where the centre of mass is to be.")
        measures = ResidualList(stages.horizon)
        measures.add(MASS_CENTRE, [], asked.weight, bound=stages.rows(asked.target).T)
        goals = [GoalRows("position of the centre of mass", "m", 0)] if asked.final else []
        super().__init__(mechanism, measures.arrays(), stages.N, goals)
