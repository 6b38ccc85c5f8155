"""Contact laws and states on both sides of each of their corners."""

import numpy as np
import pytest
from trees import CHAINS, Body, tree_xml

from planner.model.contact.laws import ContactLaw

# The step study's recommended contact (its section 1), and the unsmoothed one with MuJoCo's projection.
SOFT = ContactLaw(stiffness=5e3, damping=60.0, ramp=5e-3, force_ramp=5.0, slip_damping=150.0, friction=0.6)


SHARP = ContactLaw.exact(5e3, 60.0, 150.0, 0.6, impratio=10.0)


BELT = [Body(-1, ("slide",)), Body(-1, ("free",)), Body(1, ("hinge", "ball"))]


MACHINES = {**CHAINS, "body over a belt": tree_xml(BELT, np.random.default_rng(5))}


each_touch = pytest.mark.parametrize("touch", [SOFT, SHARP], ids=["smooth", "sharp"])


def law_states(touch, rng):
    """Penetrations and velocities on both sides of each end of the ramps, opening, closing, sticking and slipping."""
    a = touch.ramp or 5e-3
    depths = a * np.array([-0.5, -0.01, 0.01, 0.1, 0.5, 0.99, 1.01, 2.0, 10.0])
    openings = [-0.3, 0.0, 0.02, 2.0]
    slides = [(0.0, 0.0), (1e-4, 2e-4), (0.05, -0.02), (3.0, 1.0)]
    e, v = [], []
    for depth in depths:
        for opening in openings:
            for x, y in slides:
                e.append(depth)
                v.append([x, y, opening])
    return np.array(e), np.array(v) + rng.normal(size=(len(v), 3)) * 1e-6


def moved(m, q, direction):
    """q moved along the group by direction (nv,)."""
    x = np.concatenate([q, np.zeros(m.nv + m.na)])
    return m.space.integrate(x[None], np.concatenate([direction, np.zeros(m.nv + m.na)])[None])[0, : m.nq]
