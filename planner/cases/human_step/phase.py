"""Step: a walker, his normal gait, and the planned part of a cycle.

Time is a fraction of a cycle from right heel strike to right heel strike. The right leg swings from SWING[0] to
SWING[1], the left leg half a cycle later. A swing is planned with one leg; ankle and foot of the other one move
as in the normal gait. A cycle has both legs and the belt.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from planner.cases.human_step.gait import COLUMNS, SINK, SWAY, Gait, GaitSamples, Reference, reference
from planner.cases.human_step.walker import PELVIS, SIDES, Walker
from planner.dynamics.kinematics import frame_pose
from planner.model.mechanism import Mechanism

SWING = (0.62, 1.0)  # of the cycle, from toe-off to heel strike
FEET = tuple(f"{side}_{point}" for side in SIDES for point in ("ankle_centre", "heel_point", "toe_point"))
"""Sites, in the order of gait.reference."""


@dataclass(frozen=True)
class GaitPhase:
    """A walker, a gait, and the planned part of its cycles."""

    walker: Walker
    gait: Gait  # the normal gait
    duration: float  # s, of a cycle
    begin: float  # fraction of a cycle
    N: int  # stages
    dt: float  # s

    @property
    def t(self) -> np.ndarray:
        """Times (N+1,), fractions of a cycle."""
        return self.begin + np.arange(self.N + 1) * self.dt / self.duration

    @cached_property
    def whole(self) -> Mechanism:
        """The person with belt, pelvis, right leg and left leg, also where one leg alone is planned."""
        return whole_body(self.walker.mass, self.walker.height)

    @cached_property
    def normal(self) -> Reference:
        """The normal gait on this body."""
        scale = self.walker.scale
        return reference(self.gait, self.feet, self.duration, sway=scale * SWAY, sink=scale * SINK)

    def feet(self, q: np.ndarray) -> np.ndarray:
        """Places (K, 6, 3) of the points FEET, m, of q (K, 16) with the columns of the normal gait."""
        q = np.hstack([np.zeros((len(q), 1)), q])
        return np.stack([frame_pose(self.whole, q, name)[:, :3, 3] for name in FEET], axis=1)

    @cached_property
    def motion(self) -> GaitSamples:
        """The normal gait at the knots: q, qd, qdd, (N+1, 16) each."""
        return self.normal.at(self.t)

    @cached_property
    def states(self) -> np.ndarray:
        """The normal gait as states (N+1, nx) of the plan."""
        q, qd = self.motion.q[:, self.columns], self.motion.qd[:, self.columns]
        accelerations = self.accelerations if self.walker.jerked else q[:, :0]
        if not self.walker.belt:
            return np.hstack([q, qd, accelerations])
        ran = -self.normal.belt_speed * self.dt * np.arange(self.N + 1)
        speed = np.full((self.N + 1, 1), -self.normal.belt_speed)
        return np.hstack([ran[:, None], q, speed, qd, accelerations])

    @property
    def accelerations(self) -> np.ndarray:
        """Accelerations (N+1, 6) of the pelvis in the normal gait, m/s^2 and rad/s^2."""
        return self.motion.qdd[:, : len(PELVIS)]

    @property
    def columns(self) -> list[int]:
        """Columns of the normal gait that the plan has."""
        absent = [side for side in SIDES if side not in self.walker.legs]
        return [i for i, name in enumerate(COLUMNS) if not name.startswith(tuple(absent))]

    def leg_time(self, side: str) -> np.ndarray:
        """Times (N+1,) since the heel strike of a leg, fractions of a cycle from 0 to 1."""
        return (self.t + (0.0 if side == "right" else 0.5)) % 1.0


@lru_cache(maxsize=8)
def whole_body(mass: float, height: float) -> Mechanism:
    """A person with both legs, for kinematics."""
    return Walker(mass, height).mechanism
