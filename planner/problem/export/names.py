"""Names and units of the columns of a table: every number of a state, and every control."""

from __future__ import annotations

from planner.model.coordinates import Coordinate, controls_of_mechanism, coordinates_of
from planner.model.mechanism import Mechanism
from planner.model.mjcf.prescribed_joints import in_order
from planner.problem.export.sampled import Motion

POSITION = "position of "  # before a joint's name where an actuator is called the same


def state_names(plan: Motion) -> tuple[Coordinate, ...]:
    """Name and unit of each number of a state, nx of them; a quaternion's are "hip quaternion w" and so on."""
    space = plan.space
    if plan.problem is None:
        known = tuple(Coordinate(f"x[{i}]", "") for i in range(space.ndx))
    else:
        known = coordinates_of(plan.problem.dynamics)
    names, taken = [], {name for name, _ in control_names(plan)}
    first = dict(space.quaternions)  # of each quaternion: its address in the deviation
    address = 0  # in the deviation
    while len(names) < space.nx:
        name, unit = known[address]
        if len(names) in first:
            body = name.removesuffix(" rotation about x")
            names += [Coordinate(f"{body} quaternion {axis}", "") for axis in "wxyz"]
            address += 3
        else:
            names.append(Coordinate(f"{POSITION}{name}" if name in taken else name, unit))
            address += 1
    return tuple(names)


def control_names(plan: Motion) -> tuple[Coordinate, ...]:
    """Name and unit of each control: the actuators', then the joints' whose accelerations are controls."""
    nu = plan.us.shape[1]
    dynamics = getattr(plan.problem, "dynamics", None)
    mechanism = getattr(dynamics, "mechanism", None)
    controls: list[Coordinate] = []
    if isinstance(mechanism, Mechanism):
        controls += controls_of_mechanism(mechanism)
        for joint in in_order(mechanism, getattr(dynamics, "prescribed", ())):
            links = mechanism.joint(joint)
            axes = [""] if links.stop - links.start == 1 else [f" {i}" for i in range(links.stop - links.start)]
            controls += [Coordinate(f"acceleration of {joint}{axis}", "") for axis in axes]
    return tuple(controls) if len(controls) == nu else tuple(Coordinate(f"u[{i}]", "") for i in range(nu))
