"""The arrays of kernels.tree.mechanism_table for actuators."""

from __future__ import annotations

from typing import Any

import numpy as np

from planner.kernels.force_laws import LAW_SIZE, LAWS

MOTOR_SIZE = 4 + LAW_SIZE  # numbers of an actuator: gain, bias (3), those of its force law
WRENCH_SIZE = 11  # numbers of an actuator's wrench: place (3), force (3), torque (3), gain, constant force


def actuator_arrays(mechanism: Any, prescribed: np.ndarray, actuated: bool) -> dict[str, np.ndarray]:
    """Applied forces as sums of terms: constant, by input (u, then act), by position and by velocity.

    Actuators with wrenches have their activations here, and their forces in wrench_arrays.
    """
    a, nv = mechanism.actuators, mechanism.nv
    nu = (mechanism.nu if actuated else 0) + int(prescribed.sum())
    constant, inputs = np.zeros(nv), np.zeros((nv, nu + (mechanism.na if actuated else 0)))
    by_position, by_velocity = np.zeros((nv, nv)), np.zeros((nv, nv))
    states = {"input": [], "gain": [], "rate": []}
    if actuated:
        moment = np.where(prescribed[None, :], 0.0, a.moment)  # a prescribed joint feels no force
        for k in range(mechanism.nu):
            constant += moment[k] * a.bias[k, 0]
            by_position += np.outer(moment[k], a.moment[k]) * a.bias[k, 1]
            by_velocity += np.outer(moment[k], a.moment[k]) * a.bias[k, 2]
            state = a.activation[k]
            inputs[:, k if state < 0 else nu + state] += moment[k] * a.gain[k]
        order = np.argsort(a.activation[a.activation >= 0])
        for k in np.flatnonzero(a.activation >= 0)[order]:
            filtering = a.dynamics[k] == 2
            states["input"].append(k)
            states["gain"].append(1.0 / a.time_constant[k] if filtering else 1.0)
            states["rate"].append(-1.0 / a.time_constant[k] if filtering else 0.0)
    which = np.full(nv, -1)
    which[prescribed] = (mechanism.nu if actuated else 0) + np.arange(int(prescribed.sum()))
    dof, index = np.nonzero(inputs)
    row, column = np.nonzero(by_position)
    vrow, vcolumn = np.nonzero(by_velocity)
    return {
        "constant": constant, "input_dof": dof, "input_index": index, "input_value": inputs[dof, index],
        "position_row": row, "position_column": column, "position_value": by_position[row, column],
        "velocity_row": vrow, "velocity_column": vcolumn, "velocity_value": by_velocity[vrow, vcolumn],
        "activation_input": np.array(states["input"], dtype=np.int64),
        "activation_gain": np.array(states["gain"], dtype=float),
        "activation_rate": np.array(states["rate"], dtype=float), "prescribed": which,
    }  # fmt: skip


def motor_arrays(mechanism: Any, ball_v: np.ndarray, nu: int) -> dict[str, np.ndarray]:
    """Per actuator: its input (of nu controls, then act), numbers, force law or -1, and from motor_start on its moment.

    That is by degree of freedom: the factor, and the ball that it is of, or -1; ball_v has the first of each ball.
    """
    a = mechanism.actuators
    row, dof = np.nonzero(a.moment)
    values, laws = np.zeros((a.nu, MOTOR_SIZE)), np.full(a.nu, -1)
    values[:, 0], values[:, 1:4] = a.gain, a.bias
    for law in a.laws:
        laws[law.actuator] = list(LAWS).index(law.kind)
        values[law.actuator, 4 : 4 + len(law.numbers)] = law.numbers
    ball = np.full(mechanism.nv + 3, -1)
    for number, first in enumerate(ball_v):
        ball[first : first + 3] = number
    return {
        "motor_input": np.where(a.activation < 0, np.arange(a.nu), nu + a.activation), "motor_value": values,
        "motor_law": laws, "motor_start": np.searchsorted(row, np.arange(a.nu + 1)), "motor_dof": dof,
        "motor_factor": a.moment[row, dof], "motor_ball": ball[dof],
    }  # fmt: skip


def wrench_arrays(mechanism: Any, wrenches: Any, frames: np.ndarray, nu: int) -> dict[str, np.ndarray]:
    """Per wrench of an actuator: where it acts, its input, its degrees of freedom and those of its frame.

    Place, force and torque are in the kernels' frames (nv, 4, 4) of their links; inputs are the nu controls, then act.
    """
    a, poses = mechanism.actuators, np.concatenate([frames, np.eye(4)[None]])  # the last, -1, is the world's
    values, inputs = np.zeros((len(wrenches), WRENCH_SIZE)), []
    for row, one in zip(values, wrenches, strict=True):
        at, R, k = poses[one.link], poses[one.frame, :3, :3], one.actuator
        row[:3], row[3:6], row[6:9] = at[:3, :3].T @ (one.place - at[:3, 3]), R.T @ one.force, R.T @ one.torque
        row[9:] = a.gain[k], a.bias[k, 0]
        inputs.append(k if a.activation[k] < 0 else nu + a.activation[k])
    return {
        "wrench_link": np.array([one.link for one in wrenches], dtype=np.int64),
        "wrench_frame": np.array([one.frame for one in wrenches], dtype=np.int64),
        "wrench_input": np.array(inputs, dtype=np.int64),
        "wrench_start": np.cumsum([0, *(len(one.dofs) for one in wrenches)]),
        "wrench_dof": np.array([i for one in wrenches for i in one.dofs], dtype=np.int64),
        "wrench_frame_start": np.cumsum([0, *(len(one.frame_dofs) for one in wrenches)]),
        "wrench_frame_dof": np.array([i for one in wrenches for i in one.frame_dofs], dtype=np.int64),
        "wrench_value": values,
    }


def law_arrays(mechanism: Any, laws: Any, prescribed: np.ndarray, nu: int) -> dict[str, np.ndarray]:
    """Per force law: its kind, input and numbers, and its actuator's moment (`factor`) from law_start on.

    `push` is the moment without prescribed joints, which feel no force; inputs are the nu controls, then act.
    """
    a, values = mechanism.actuators, np.zeros((len(laws), LAW_SIZE))
    for row, law in zip(values, laws, strict=True):
        row[: len(law.numbers)] = law.numbers
    which = np.array([law.actuator for law in laws], dtype=np.int64)
    row, dof = np.nonzero(a.moment[which])
    factor, state = a.moment[which][row, dof], a.activation[which]
    return {
        "law_kind": np.array([list(LAWS).index(law.kind) for law in laws], dtype=np.int64),
        "law_input": np.where(state < 0, which, nu + state), "law_value": values,
        "law_start": np.searchsorted(row, np.arange(len(laws) + 1)), "law_dof": dof,
        "law_factor": factor, "law_push": np.where(prescribed[dof], 0.0, factor),
    }  # fmt: skip
