"""FrameCost and CenterOfMassCost: squared errors of a frame (a hand, a foot, a trunk) and of the centre of mass."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from planner.base.arguments import array, numbers, short_repr
from planner.base.errors import PlannerError
from planner.kernels.tree.residuals import kinds
from planner.model.mechanism import Frame
from planner.problem.costs.residuals.arrays import ResidualList, StageData, WeightedTarget
from planner.problem.costs.residuals.cost import GoalRows, ResidualCost
from planner.problem.costs.residuals.functions import rotation_of
from planner.problem.costs.tracking import mechanism_and_step


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
        given = {
            "position": stages.asked("position", position, position_weight, final_position_weight, 3),
            "orientation": stages.asked("orientation", orientation, orientation_weight, final_orientation_weight, 3, 4),
            "pose": stages.asked("pose", pose, pose_weight, final_pose_weight, 6, 7),
            "pointing": stages.asked("pointing", direction, pointing_weight, final_pointing_weight, 3),
            "velocity": stages.asked("velocity", velocity, velocity_weight, final_velocity_weight, 3),
            "angular_velocity": stages.asked(
                "angular_velocity", angular_velocity, angular_velocity_weight, final_angular_velocity_weight, 3
            ),
        }  # fmt: skip
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


_ALL = slice(None)
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
