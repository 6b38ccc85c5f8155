"""FrameCost, CenterOfMassCost and SlipCost: squared errors of frames and of the centre of mass, and feet that slide."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from planner.base.arguments import array, number, numbers, short_repr
from planner.base.errors import PlannerError
from planner.kernels.tree.residuals import kinds
from planner.kernels.tree.residuals.kinds import SLIP
from planner.model.contact.laws import Contact
from planner.model.mechanism import Frame
from planner.problem.costs.least_squares import GoalRows, ResidualCost
from planner.problem.costs.residual_arrays import ResidualList
from planner.problem.costs.residual_functions import rotation_of
from planner.problem.costs.tracking import mechanism_and_step

_ALL = slice(None)
CLEARANCE = 0.06  # m: default of a foot that is lifted enough; a foot at 5 m/s crosses it in a stage, not unseen


class FrameCost(ResidualCost):
    """Squared residuals of a frame, 1/2 w r^2 each, summed over the stages; Gauss-Newton Hessian.

        position            r = p(q) - position                      3, m, in the world's axes
        orientation         r = log(R_ref' R(q))                     3, rad, in the axes of the reference frame
        pose                r = log(T_ref^-1 T(q)) of SE(3)          6, m and rad, in the same axes
        pointing            r = R(q) axis - direction                3, of length 2 sin(angle / 2), in the world's axes
        velocity            r = v(q, qd) - velocity                  3, m/s, of the frame's origin in the world's axes
        angular_velocity    r = w(q, qd) - angular_velocity          3, rad/s, in the world's axes

    It does not depend on the control, so it is one term of a cost: TrackingCost(...) + FrameCost(...). With
    RigidBodyDynamics it is part of the compiled solver. Each weight is a number, one per residual component, or one
    per stage and component (N+1, rows). Running weights are multiplied by dt, final ones are not; the default final
    weight is dt times the last running one.

    Args:
        machine: RigidBodyDynamics or a Mechanism.
        frame: Name of a site or body, or a Frame.
        position: (3,) or (N+1, 3) m, in the world.
        orientation: (4,) or (N+1, 4) quaternion, w first; normalized.
        pose: (7,) or (N+1, 7) position and quaternion. For large errors its gradient leads along a screw motion;
            separate position and orientation targets lead along a straight line.
        pointing: An axis of the frame (3,) and its target direction (3,) or (N+1, 3) in the world; rotation about it
            is free. The gradient is zero where the axis points exactly opposite.
        velocity: (3,) or (N+1, 3) m/s.
        angular_velocity: (3,) or (N+1, 3) rad/s.
        position_weight: Running weight, per m^2 and s; those below per rad^2, (m/s)^2 or (rad/s)^2, and s.
        final_position_weight: Final weight.
        orientation_weight: Running weight.
        final_orientation_weight: Final weight.
        pose_weight: Running weight; the three of the position first.
        final_pose_weight: Final weight.
        pointing_weight: Running weight.
        final_pointing_weight: Final weight.
        velocity_weight: Running weight.
        final_velocity_weight: Final weight.
        angular_velocity_weight: Running weight.
        final_angular_velocity_weight: Final weight.
        dt: s; that of the dynamics by default.

    Raises:
        PlannerError: No such frame, a wrong shape, a negative weight, a target without weight or a weight without
            target.
    """

    def __init__(
        self, machine: Any, frame: str | Frame, *, position: Any = None, orientation: Any = None, pose: Any = None,
        pointing: Any = None, velocity: Any = None, angular_velocity: Any = None,
        position_weight: Any = 0.0, final_position_weight: Any = None,
        orientation_weight: Any = 0.0, final_orientation_weight: Any = None,
        pose_weight: Any = 0.0, final_pose_weight: Any = None,
        pointing_weight: Any = 0.0, final_pointing_weight: Any = None,
        velocity_weight: Any = 0.0, final_velocity_weight: Any = None,
        angular_velocity_weight: Any = 0.0, final_angular_velocity_weight: Any = None, dt: float | None = None,
    ) -> None:  # fmt: skip
        mechanism, dt = mechanism_and_step(machine, dt)
        if not isinstance(frame, (str, Frame)):
            raise PlannerError(f"frame is {short_repr(frame)}, expected a Frame or the name of a site or body.")
        self.frame = mechanism.frame(frame) if isinstance(frame, str) else frame
        name = frame if isinstance(frame, str) else "the frame"
        if all(one is None for one in (position, orientation, pose, pointing, velocity, angular_velocity)):
            raise PlannerError("position and orientation are None, expected a target for the frame.")
        stages = StageData(dt)
        axis, direction = _pointing(pointing)
        given = {what: stages.asked(what, *asked) for what, asked in {
            "position": (position, position_weight, final_position_weight, 3),
            "orientation": (orientation, orientation_weight, final_orientation_weight, 3, 4),
            "pose": (pose, pose_weight, final_pose_weight, 6, 7),
            "pointing": (direction, pointing_weight, final_pointing_weight, 3),
            "velocity": (velocity, velocity_weight, final_velocity_weight, 3),
            "angular_velocity": (angular_velocity, angular_velocity_weight, final_angular_velocity_weight, 3),
        }.items()}  # fmt: skip
        measures, goals = ResidualList(stages.horizon), []
        point = measures.point(self.frame.link, self.frame.T[:3, 3])
        for what, asked in given.items():
            if asked is None:
                continue
            kind = _KINDS[what]
            term = _term(kind.number, self.frame.T[:3, :3], axis, asked, stages)
            measures.add(kind.number, [point], asked.weight, **term)
            if asked.final:
                number = measures.count - 1
                goals += [GoalRows(f"{word} of {name}", unit, number, rows) for word, unit, rows in kind.goals]
        super().__init__(mechanism, measures.arrays(), stages.N, goals)


class _Kind(NamedTuple):
    """Number of a residual kind, and its goals at the end: name, unit, residual components."""

    number: int
    goals: tuple[tuple[str, str, slice], ...]


_KINDS = {
    "position": _Kind(kinds.POSITION, (("position", "m", _ALL),)),
    "orientation": _Kind(kinds.ORIENTATION, (("orientation", "rad", _ALL),)),
    "pose": _Kind(kinds.POSE, (("position", "m", slice(0, 3)), ("orientation", "rad", slice(3, 6)))),
    "pointing": _Kind(kinds.POINTING, (("direction", "rad", _ALL),)),
    "velocity": _Kind(kinds.LINEAR, (("velocity", "m/s", _ALL),)),
    "angular_velocity": _Kind(kinds.ANGULAR, (("angular velocity", "rad/s", _ALL),)),
}


def _pointing(pointing: Any) -> tuple[np.ndarray, np.ndarray | None]:
    """Unit vectors: the axis (3,) of the frame, and the direction (3,) or (N+1, 3) in the world, None for none."""
    if pointing is None:
        return np.zeros(3), None
    if not isinstance(pointing, (tuple, list)) or len(pointing) != 2:
        raise PlannerError(
            f"pointing is {short_repr(pointing)}, expected the frame's own axis and the direction that it is to have, "
            "e.g. pointing=([0, 0, 1], [0, 0, -1])."
        )
    axis = array("the axis of pointing", pointing[0], (3,))
    direction = numbers("the direction of pointing", pointing[1])
    direction = array("the direction of pointing", direction, ("N+1", 3) if direction.ndim == 2 else (3,))
    for name, one in (("axis", axis), ("direction", direction)):
        if np.linalg.norm(one, axis=-1).min() < 1e-12:
            raise PlannerError(f"the {name} of pointing has length zero, expected e.g. [0, 0, 1].")
    return axis / np.linalg.norm(axis), direction / np.linalg.norm(direction, axis=-1, keepdims=True)


def _term(
    kind: int, rotation: np.ndarray, axis: np.ndarray, asked: WeightedTarget, stages: StageData
) -> dict[str, Any]:
    """Keyword arguments of ResidualList.add for a term, in addition to its weights."""
    target = stages.rows(asked.target)
    if kind not in (kinds.ORIENTATION, kinds.POSE):
        return {"bound": target.T, "constant": rotation @ axis if kind == kinds.POINTING else ()}
    length = np.linalg.norm(target[:, -4:], axis=1, keepdims=True)
    if length.min() < 1e-12:
        name = "orientation" if kind == kinds.ORIENTATION else "pose's quaternion"
        raise PlannerError(f"{name} has length zero, expected a quaternion, e.g. 1, 0, 0, 0.")
    turn = rotation_of(target[:, -4:] / length).reshape(-1, 9)
    return {"constant": rotation, "reference": np.concatenate([turn, target[:, :-4]], axis=1).T}


class CenterOfMassCost(ResidualCost):
    """1/2 w |c(q) - position|^2 summed over the stages, c the centre of mass; Gauss-Newton; one term of a cost.

    With RigidBodyDynamics it is part of the compiled solver.

    Args:
        machine: RigidBodyDynamics or a Mechanism; its mass excludes bodies fixed to the world.
        position: (3,) or (N+1, 3) m, in the world.
        position_weight: Running weight, per m^2 and s: a number, (3,) by axis, or (N+1, 3) by stage and axis.
        final_position_weight: Final weight, a number or (3,); by default dt times the last running weight.
        dt: s; that of the dynamics by default.

    Raises:
        PlannerError: A wrong shape, a negative weight, no weight, or a machine without mass.
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
        residual_arrays = ResidualList(stages.horizon)
        residual_arrays.add(kinds.MASS_CENTRE, [], asked.weight, bound=stages.rows(asked.target).T)
        goals = [GoalRows("position of the centre of mass", "m", 0)] if asked.final else []
        super().__init__(mechanism, residual_arrays.arrays(), stages.N, goals)


@dataclass(frozen=True, eq=False)
class WeightedTarget:
    """A target and its weights."""

    target: np.ndarray  # (1 or N+1, size)
    stage_weight: np.ndarray  # (1 or N+1, rows) running weights, times dt
    end: np.ndarray  # (1, rows) final weights
    final: bool  # whether a final weight was given; a target with a running weight alone is no goal
    stages: StageData

    @property
    def weight(self) -> np.ndarray:
        """(rows, N+1) running weights, the last column the final ones."""
        weight = np.array(self.stages.rows(self.stage_weight))
        weight[-1] = self.end[0]
        return weight.T


class StageData:
    """The common horizon N of arguments per stage, None while there are none.

    Args:
        dt: s, factor of running weights.
    """

    def __init__(self, dt: float) -> None:
        self.N: int | None = None
        self._dt = dt

    @property
    def horizon(self) -> int:
        """Number of stages of the arrays: N, or 1 for any horizon."""
        return 1 if self.N is None else self.N

    def rows(self, given: np.ndarray) -> np.ndarray:
        """(1 or N+1, size) broadcast to (N+1, size)."""
        return np.broadcast_to(given, (self.horizon + 1, given.shape[1]))

    def asked(
        self, name: str, target: Any, way: Any, final: Any, rows: int, size: int | None = None
    ) -> WeightedTarget | None:
        """Checked target of `size` entries (`rows` by default) and its weights; None without both."""
        checked = None if target is None else self._target(name, target, size or rows)
        running, end = self._weights(f"{name}_weight", way, final, rows)
        weighs = bool(running.any() or end.any())
        if weighs and checked is None:
            raise PlannerError(f"{name}_weight has no target, expected {name}=.")
        if checked is None:
            return None
        if not weighs:
            raise PlannerError(f"{name} has no weight, expected {name}_weight or final_{name}_weight above 0.")
        return WeightedTarget(checked, running, end, final is not None, self)

    def _agree(self, name: str, given: np.ndarray) -> None:
        if given.ndim == 2:
            if self.N is not None and len(given) != self.N + 1:
                raise PlannerError(f"{name} has {len(given)} rows, expected N+1 = {self.N + 1} as the others.")
            self.N = len(given) - 1

    def _target(self, name: str, value: Any, size: int) -> np.ndarray:
        given = numbers(name, value)
        given = array(name, given, ("N+1", size) if given.ndim == 2 else (size,))
        self._agree(name, given)
        return np.atleast_2d(given)

    def _weights(self, name: str, way: Any, final: Any, rows: int) -> tuple[np.ndarray, np.ndarray]:
        """(1 or N+1, rows) running weights times dt, and (1, rows) final weights."""
        given = [numbers(name, way), numbers(f"final_{name}", 0.0 if final is None else final)]
        for label, value in zip((name, f"final_{name}"), given, strict=True):
            if value.ndim == 2 and label == name:
                array(label, value, ("N+1", rows))
                self._agree(label, value)
            elif value.ndim:
                array(label, value, (rows,))
            if not (np.isfinite(value).all() and value.min() >= 0.0):
                raise PlannerError(f"{label} is {value.tolist()}, expected finite weights of at least 0.")
        running, end = (np.atleast_2d(np.broadcast_to(v, v.shape if v.ndim else (rows,))) for v in given)
        return self._dt * running, self._dt * running[-1:] if final is None else end


class SlipCost(ResidualCost):
    """Slip of contacts with planes at rest, for any horizon; feet that slide, or swing close to the ground.

        J = sum over stages and contacts of dt w |s(h) v_t|^2 / 2

    with v_t the tangential velocity of a contact's lowest point, h its height and s the share of kernels.tree.residuals
    .foot_slip, 1 on the ground and 0 from the clearance on. A foot may stand, roll, or swing higher than the clearance;
    sliding, landing with tangential speed and shuffling cost. Friction alone does not tell these apart: a foot that is
    dragged with little load loses nothing in the plan, and is elsewhere when another ground has another friction.
    (Kim et al. 2023, "Contact-implicit model predictive control: controlling diverse quadruped motions without
    pre-planned contact modes or trajectories", foot slip and clearance cost.) With RigidBodyDynamics it is part of the
    compiled solver.

    Args:
        machine: RigidBodyDynamics or a Mechanism.
        weight: w, per second and (m/s)^2.
        contacts: By default all of the machine with planes at rest.
        dt: s; that of the dynamics by default.
        clearance: Height from which a foot costs nothing, m.
    """

    def __init__(
        self, machine: Any, weight: float, contacts: Sequence[Contact] | None = None, dt: float | None = None,
        clearance: float = CLEARANCE,
    ) -> None:  # fmt: skip
        mechanism, dt = mechanism_and_step(machine, dt)
        rows, terms = dt * number("weight", weight, minimum=0.0), ResidualList(1)
        for one in mechanism.contacts if contacts is None else contacts:
            if np.any(one.plane.velocity) or one.plane.slide >= 0:
                continue  # a belt, or a box that moves: slip is relative to it
            constant = (*one.plane.normal, one.plane.offset + one.radius + one.law.margin, one.radius, 1.0 / clearance)
            terms.add(SLIP, [terms.point(one.link, one.centre)], (rows, 0.0), constant=constant)
        super().__init__(mechanism, terms.arrays(), None)
