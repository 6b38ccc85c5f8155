"""Where the feet of a walker are: pelvis and two legs of five joints each, without any dynamics.

x ahead, y left, z up. The pelvis turns by tilt about -y, list about x and rotation about z, in that order; from the
hips a leg turns by flexion (-y), adduction (right x, left -x), rotation (right z, left -z), knee (-y) and ankle (-y).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

_Y, _X, _Z = 1, 0, 2


@dataclass(frozen=True)
class LegChain:
    """Lengths of a walker's legs.

    Attributes:
        hip_half_width: From the middle of the pelvis to a hip, m.
        thigh: From hip to knee, m.
        shank: From knee to ankle, m.
        heel: Ahead of the ankle and above it, m: both negative.
        toe: The same.
    """

    hip_half_width: float
    thigh: float
    shank: float
    heel: tuple[float, float]
    toe: tuple[float, float]

    def foot_points(self, q: np.ndarray) -> np.ndarray:
        """(K, 6, 3) m, of q (K, 16): ankle, heel and toe of the right foot, then of the left."""
        pelvis = _turned(np.eye(3), ((_Y, -q[:, 3]), (_X, q[:, 4]), (_Z, q[:, 5])))
        feet = []
        for side, leg in ((-1.0, q[:, 6:11]), (1.0, q[:, 11:16])):
            hip = q[:, :3] + side * self.hip_half_width * pelvis[:, :, _Y]
            R = _turned(pelvis, ((_Y, -leg[:, 0]), (_X, -side * leg[:, 1]), (_Z, -side * leg[:, 2])))
            knee = hip - self.thigh * R[:, :, _Z]
            R = _turned(R, ((_Y, -leg[:, 3]),))
            ankle = knee - self.shank * R[:, :, _Z]
            R = _turned(R, ((_Y, -leg[:, 4]),))
            feet += [ankle, *(ankle + a * R[:, :, _X] + b * R[:, :, _Z] for a, b in (self.heel, self.toe))]
        return np.stack(feet, axis=1)


def _turned(R: np.ndarray, turns: tuple[tuple[int, np.ndarray], ...]) -> np.ndarray:
    """R (K, 3, 3) after turns about its own axes: number of the axis, angles (K,)."""
    for axis, angle in turns:
        a, b = (axis + 1) % 3, (axis + 2) % 3
        turn = np.zeros((len(angle), 3, 3))
        turn[:, axis, axis] = 1.0
        turn[:, a, a] = turn[:, b, b] = np.cos(angle)
        turn[:, b, a] = np.sin(angle)
        turn[:, a, b] = -turn[:, b, a]
        R = R @ turn
    return R
