"""The passive elastic moments of hip, knee and ankle of Riener and Edrich (J Biomech 32, 1999, 539-544).

Means of ten healthy subjects, in N m, of angles in degrees: hip flexion h, knee flexion k and plantar flexion a, with
moments in the same directions,

    hip    exp(1.4655 - .0034 k - .0750 h) - exp(1.3403 - .0226 k + .0305 h) + 8.072
    knee   exp(1.800 - .0460 a - .0352 k + .0217 h) - exp(-3.971 - .0004 a + .0495 k - .0128 h) - 4.820
           + exp(2.220 - .150 k)
    ankle  exp(2.1016 - .0843 a - .0176 k) - exp(-7.9763 + .1949 a + .0008 k) - 1.792

    number          from
    all but one     memory, without access to the paper, and the same in a second source: public MATLAB functions
                    (rienerEdrich1999PassiveHipMoment, ...KneeMoment, ...AnkleMoment; "used by Miller et al. 2012")
    .150 k          memory; the second source has 1.50, with which bending a straight knee back by five degrees takes
                    17 kN m instead of 20 N m; nag92/LegMuscleModel has exp(2.5 - .25 k) there, for other subjects

Our signs: a lifted foot and a stretched knee are positive, so k, a and their moments change their signs.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping

import numpy as np

from planner.model.exponential_torques import ExponentialTorque

CURVED = ("hip_flexion", "knee", "ankle")
SIGNS = {"hip_flexion": 1.0, "knee": -1.0, "ankle": -1.0}  # of our angles and moments, relative to the paper's

# Exponentials of each joint: sign, constant, slopes by hip, knee and ankle per degree.
TERMS: dict[str, tuple[tuple[float, float, tuple[float, float, float]], ...]] = {
    "hip_flexion": ((1.0, 1.4655, (-0.0750, -0.0034, 0.0)), (-1.0, 1.3403, (0.0305, -0.0226, 0.0))),
    "knee": (
        (1.0, 1.800, (0.0217, -0.0352, -0.0460)),
        (-1.0, -3.971, (-0.0128, 0.0495, -0.0004)),
        (1.0, 2.220, (0.0, -0.150, 0.0)),
    ),
    "ankle": ((1.0, 2.1016, (0.0, -0.0176, -0.0843)), (-1.0, -7.9763, (0.0, 0.0008, 0.1949))),
}
CONSTANTS = {"hip_flexion": 8.072, "knee": -4.820, "ankle": -1.792}  # N m


def curves(dofs: Mapping[str, int], joints: Collection[str], factor: float = 1.0) -> Iterator[ExponentialTorque]:
    """The moments on some joints of one leg, times a factor; `dofs` are the degrees of freedom of CURVED."""
    for joint in joints:
        turned = factor * SIGNS[joint]
        for sign, constant, slopes in TERMS[joint]:
            own = {
                dofs[other]: SIGNS[other] * float(np.degrees(slope))
                for other, slope in zip(CURVED, slopes, strict=True)
                if slope != 0.0
            }
            yield ExponentialTorque(dofs[joint], turned * sign, constant, tuple(own.items()))
        yield ExponentialTorque(dofs[joint], turned * CONSTANTS[joint])
