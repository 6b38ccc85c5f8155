"""Coordinates: name and unit of each component of a machine's state deviation, for messages and reports."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from planner.model.actuators import DIRECT, INTEGRATOR
from planner.model.capabilities import capabilities_of
from planner.model.mechanism import SCREW, Mechanism
from planner.model.space import space_of

ANGLE, LENGTH = "rad", "m"
MOMENT, FORCE = "N m", "N"
RATES = ("rad/s", "m/s")


class Coordinate(NamedTuple):
    """Name and unit of one component of a state deviation dx."""

    name: str  # "elbow", "velocity of elbow", "base x"; "x[3]" if unknown
    unit: str  # "rad", "m", "rad/s", "m/s", a unit declared by the dynamics, or "" if unknown

    @property
    def is_rate(self) -> bool:
        """Whether the coordinate is a velocity."""
        return self.unit.endswith("/s")


def coordinates_of(dynamics: Any) -> tuple[Coordinate, ...]:
    """The coordinates (ndx,) of a dynamics' deviations: its own `coordinates`, else those of its mechanism.

    Components that neither names are called "x[i]", without a unit.
    """
    own = getattr(dynamics, "coordinates", None)
    mechanism = capabilities_of(dynamics).mechanism
    known: tuple[Coordinate, ...] = ()
    if own is not None:
        known = tuple(Coordinate(*one) for one in own)
    elif mechanism is not None:
        known = coordinates_of_mechanism(mechanism)
    return (*known, *(Coordinate(f"x[{i}]", "") for i in range(len(known), space_of(dynamics).ndx)))


def coordinates_of_mechanism(mechanism: Mechanism) -> tuple[Coordinate, ...]:
    """The coordinates (2 nv + na,): positions (nv,), velocities (nv,), then activations (na,)."""
    turns = np.any(mechanism.S[:, :3] != 0.0, axis=1)
    positions = []
    for j, (name, links) in enumerate(zip(mechanism.joint_names, mechanism.joint_links, strict=True)):
        name = name or f"joint {j}"
        for i in range(links.start, links.stop):
            single = mechanism.kind[i] == SCREW and links.stop - links.start == 1
            axis = "" if single else f" {'xyz'[(i - links.start) % 3]}"
            turn = " rotation about" if axis and turns[i] else ""
            positions.append(Coordinate(f"{name}{turn}{axis}", ANGLE if turns[i] else LENGTH))
    rates = [Coordinate(f"velocity of {name}", f"{unit}/s") for name, unit in positions]
    actuators = mechanism.actuators
    active = np.flatnonzero(actuators.dynamics != DIRECT)
    names = [actuators.names[a] or f"actuator {a}" for a in active]
    return (*positions, *rates, *(Coordinate(f"activation of {name}", "") for name in names))


def controls_of_mechanism(mechanism: Mechanism) -> tuple[Coordinate, ...]:
    """Name and unit of each control (nu,).

    A motor with gear 1 on one joint has that joint's force unit, one at a site with a force of gear 1 has N, a
    position servo the joint's coordinate unit; all others "".
    """
    actuators, turns = mechanism.actuators, np.any(mechanism.S[:, :3] != 0.0, axis=1)
    controls = []
    for a, name in enumerate(actuators.names):
        moment, gain, bias = actuators.moment[a], actuators.gain[a], actuators.bias[a]
        joints, unit = np.flatnonzero(moment), ""
        if len(joints) == 1 and actuators.dynamics[a] != INTEGRATOR and not actuators.by_law[a]:
            turn = turns[joints[0]]
            if abs(gain * moment[joints[0]]) == 1.0 and not bias.any():
                unit = MOMENT if turn else FORCE
            elif gain and abs(moment[joints[0]]) == 1.0 and bias[1] == -gain:
                unit = ANGLE if turn else LENGTH
        for one in actuators.wrenches:
            if one.actuator == a and abs(gain) == 1.0 and not bias.any() and actuators.dynamics[a] != INTEGRATOR:
                force, torque = np.linalg.norm(one.force), np.linalg.norm(one.torque)
                unit = FORCE if np.isclose(force, 1.0) else MOMENT if force == 0.0 and np.isclose(torque, 1.0) else ""
        controls.append(Coordinate(name or f"actuator {a}", unit))
    return tuple(controls)
