"""The two motions of the human step, without a problem around them."""

from planner.cases.human_step.gait import NORMAL_GAIT
from planner.cases.human_step.walker import GaitPhase, Walker

SWING = GaitPhase(Walker(legs=("right",), belt=False), NORMAL_GAIT, 1.2, 0.62, 114, 0.004)


CYCLE = GaitPhase(Walker(), NORMAL_GAIT, 1.2, 0.0, 240, 0.005)
