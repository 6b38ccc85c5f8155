"""Crocoddyl on the quadruped of contact_sequence.py, served from an environment of its own."""

from __future__ import annotations

from typing import Any

import numpy as np
from crocoddyl_iteration import Iteration
from serving import Answer, serve

_known: dict[str, Any] = {}


def hello() -> Answer:
    """What is installed."""
    import crocoddyl
    import pinocchio

    return {"version": f"{crocoddyl.__version__} (pinocchio {pinocchio.__version__})"}


def load(
    model: str, x0: list[float], dt: float, feet: dict[str, list[float]], N: int, stands: dict[str, list[bool]],
    running: list[float], final: list[float], effort: list[float],
) -> Answer:  # fmt: skip
    """Build the problem: feet of some bodies, at points of them, that stand in some stages."""
    import crocoddyl
    import pinocchio as pin

    machine = pin.buildModelFromMJCF(model)
    frames = {}
    for name, point in feet.items():
        body = machine.frames[machine.getFrameId(name)]
        place = body.placement * pin.SE3(np.eye(3), np.array(point))
        frame = pin.Frame(f"{name} point", body.parentJoint, place, pin.FrameType.OP_FRAME)
        frames[name] = machine.addFrame(frame)
    state = crocoddyl.StateMultibody(machine)
    actuation = crocoddyl.ActuationModelFloatingBase(state)
    w, x, y, z = x0[3:7]
    start = np.array([*x0[:3], x, y, z, w, *x0[7:]])  # at rest, so rates have no frame
    us = np.zeros(actuation.nu)

    def stage(weights: list[float], standing: list[str], of_controls: list[float] | None) -> Any:
        contacts = crocoddyl.ContactModelMultiple(state, actuation.nu)
        for name in standing:
            still = crocoddyl.ContactModel3D(
                state, frames[name], np.zeros(3), pin.ReferenceFrame.LOCAL_WORLD_ALIGNED, actuation.nu,
                np.array([0.0, 50.0]),
            )  # fmt: skip
            contacts.addContact(name, still)
        costs = crocoddyl.CostModelSum(state, actuation.nu)
        activation = crocoddyl.ActivationModelWeightedQuad(np.array(weights))
        residual = crocoddyl.ResidualModelState(state, start, actuation.nu)
        costs.addCost("state", crocoddyl.CostModelResidual(state, activation, residual), 1.0)
        if of_controls is not None:
            activation = crocoddyl.ActivationModelWeightedQuad(np.array(of_controls))
            residual = crocoddyl.ResidualModelControl(state, actuation.nu)
            costs.addCost("effort", crocoddyl.CostModelResidual(state, activation, residual), 1.0)
        differential = crocoddyl.DifferentialActionModelContactFwdDynamics(
            state, actuation, contacts, costs, 0.0, True
        )  # fmt: skip
        return crocoddyl.IntegratedActionModelEuler(differential, dt if of_controls is not None else 0.0)

    scaled = [[one / dt for one in weights] for weights in (running, effort)]
    stages = [stage(scaled[0], [name for name in feet if stands[name][n]], scaled[1]) for n in range(N)]
    shooting = crocoddyl.ShootingProblem(start, stages, stage(final, list(feet), None))
    solver = crocoddyl.SolverFDDP(shooting)
    _known["iteration"] = Iteration(shooting, solver, [start] * (N + 1), [us] * N, False)
    return {"nv": machine.nv, "nu": actuation.nu}


def iterate(repeats: int, seconds: float) -> Answer:
    """Times of single iterations from the first trajectory."""
    return _known["iteration"].times(repeats, seconds)


if __name__ == "__main__":
    serve(hello, {"load": load, "iterate": iterate})
