"""Step: a walker, the normal gait on him, and which part of a cycle is planned, as data.

Time is told in fractions of a cycle from right heel strike to right heel strike. The right leg swings from SWING[0] to
SWING[1], the left leg half a cycle later. A swing is planned on one leg: the other one stands, its ankle and foot move
as in the normal gait, and it is only as long as it is. A cycle has both legs and the belt.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from planner.cases.human_step.gait import COLUMNS, SINK, SWAY, Gait, Motion, Reference, reference
from planner.cases.human_step.walker import PELVIS, SIDES, Walker
from planner.dynamics.algorithms import frame_pose
from planner.model.mechanism import Mechanism

SWING = (0.62, 1.0)  # of the cycle, from toe-off to heel strike
FEET = tuple(f"{side}_{point}" for side in SIDES for point in ("ankle_centre", "heel_point", "toe_point"))
"""Sites, in the order that gait.reference asks for."""


@dataclass(frozen=True)
class Step:
    """Who walks, how fast, and for how long.

    Attributes:
        walker: The person, with what of him is modelled.
        gait: The normal one.
        duration: Of a cycle, s.
        begin: Fraction of a cycle.
        N: Stages.
        dt: s.
    """

    walker: Walker
    gait: Gait
    duration: float
    begin: float
    N: int
    dt: float

    @property
    def t(self) -> np.ndarray:
        """(N+1,) fractions of a cycle."""
        return self.begin + np.arange(self.N + 1) * self.dt / self.duration

    @cached_property
    def whole(self) -> Mechanism:
        """The person with both legs, whatever of him is planned: belt, pelvis, right leg, left leg."""
        return whole_body(self.walker.mass, self.walker.height)

    @cached_property
    def normal(self) -> Reference:
        """The normal gait on this body."""
        scale = self.walker.scale
        return reference(self.gait, self.feet, self.duration, sway=scale * SWAY, sink=scale * SINK)

    def feet(self, q: np.ndarray) -> np.ndarray:
        """(K, 6, 3) m, the points FEET of normal columns q (K, 16)."""
        q = np.hstack([np.zeros((len(q), 1)), q])
        return np.stack([frame_pose(self.whole, q, name)[:, :3, 3] for name in FEET], axis=1)

    @cached_property
    def motion(self) -> Motion:
        """The normal gait at the knots, (N+1, 16) each."""
        return self.normal.at(self.t)

    @cached_property
    def states(self) -> np.ndarray:
        """(N+1, nx) the normal gait in the plan's coordinates."""
        q, qd = self.motion.q[:, self.columns], self.motion.qd[:, self.columns]
        accelerations = self.accelerations if self.walker.jerked else q[:, :0]
        if not self.walker.belt:
            return np.hstack([q, qd, accelerations])
        ran = -self.normal.belt_speed * self.dt * np.arange(self.N + 1)
        speed = np.full((self.N + 1, 1), -self.normal.belt_speed)
        return np.hstack([ran[:, None], q, speed, qd, accelerations])

    @property
    def accelerations(self) -> np.ndarray:
        """(N+1, 6) of the pelvis in the normal gait, m/s^2 and rad/s^2."""
        return self.motion.qdd[:, : len(PELVIS)]

    @property
    def columns(self) -> list[int]:
        """Of the normal gait, those that the plan has."""
        absent = [side for side in SIDES if side not in self.walker.legs]
        return [i for i, name in enumerate(COLUMNS) if not name.startswith(tuple(absent))]

    def swing(self, side: str) -> np.ndarray:
        """(N+1,) where in its swing a leg is, from 0 to 1; NaN in its stance."""
        part = (self.leg_time(side) - SWING[0]) / (SWING[1] - SWING[0])
        return np.where((part > 0.0) & (part < 1.0), part, np.nan)

    def leg_time(self, side: str) -> np.ndarray:
        """(N+1,) fractions since the heel strike of a leg, 0 to 1."""
        return (self.t + (0.0 if side == "right" else 0.5)) % 1.0


@lru_cache(maxsize=8)
def whole_body(mass: float, height: float) -> Mechanism:
    """A person's lengths, for kinematics."""
    return Walker(mass, height).mechanism
