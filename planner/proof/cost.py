"""The cost that a plan reaches in MuJoCo: it ranks plans whose own coarse steps make them look too cheap."""

from __future__ import annotations

import math

import numpy as np

from planner.problem.plan import Plan
from planner.proof.replaying import replay


def proven_cost(plan: Plan) -> float:
    """The cost that MuJoCo reaches at the refined step, with the plan's gains or open loop, whichever is less.

    Plans are run with their gains; where these do worse than none, the plan is run without. Several threads may ask
    at once. For solve(..., rank=proven_cost).

    Args:
        plan: A plan of a problem with a twin.

    Returns:
        The cost; infinite where the plan is not finite, or neither replay stays so without MuJoCo's complaints.

    Raises:
        PlannerError: No plan of this problem can be replayed: it has no twin, or too many steps.
    """
    if not all(np.isfinite(part).all() for part in (plan.xs, plan.us, plan.K)):
        return math.inf
    with np.errstate(all="ignore"):  # of a replay that runs away
        runs = [replay(plan, feedback=feedback) for feedback in (True, False)]
        costs = [run.cost for run in runs if not run.warnings]
    return min((cost for cost in costs if math.isfinite(cost)), default=math.inf)
