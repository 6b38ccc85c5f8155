"""Crocoddyl on the pinned arm of closed_chains.py, served from an environment of its own."""

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
    model: str, x0: list[float], u: list[float], probe: list[float], N: int, dt: float, rate: float, place: list[float]
) -> Answer:
    """Build the problem; the accelerations at the start under a probe of controls."""
    import crocoddyl
    import pinocchio as pin

    arm = pin.buildModelFromMJCF(model)
    arm.armature = np.zeros(arm.nv)
    hand = pin.Frame("hand", arm.njoints - 1, pin.SE3(np.eye(3), np.array([0.0, 0.0, 0.1])), pin.FrameType.OP_FRAME)
    frame = arm.addFrame(hand)
    state = crocoddyl.StateMultibody(arm)
    actuation = crocoddyl.ActuationModelFull(state)
    contacts = crocoddyl.ContactModelMultiple(state, actuation.nu)
    gains = np.array([rate**2, 2.0 * rate])
    pin_of_hand = crocoddyl.ContactModel3D(
        state, frame, np.array(place), pin.ReferenceFrame.LOCAL_WORLD_ALIGNED, actuation.nu, gains
    )
    contacts.addContact("hand", pin_of_hand)
    start = np.array(x0)

    def stage(position: float, velocity: float, effort: float) -> Any:
        costs = crocoddyl.CostModelSum(state, actuation.nu)
        activation = crocoddyl.ActivationModelWeightedQuad(np.repeat([position, velocity], arm.nv))
        residual = crocoddyl.ResidualModelState(state, start, actuation.nu)
        costs.addCost("state", crocoddyl.CostModelResidual(state, activation, residual), 1.0)
        if effort:
            residual = crocoddyl.ResidualModelControl(state, actuation.nu)
            costs.addCost("effort", crocoddyl.CostModelResidual(state, residual), effort)
        return crocoddyl.DifferentialActionModelContactFwdDynamics(state, actuation, contacts, costs, 0.0, False)

    differential = stage(1.0, 0.1, 1e-3)
    running = crocoddyl.IntegratedActionModelRK(differential, crocoddyl.RKType.four, dt)
    last = crocoddyl.IntegratedActionModelEuler(stage(10.0, 1.0, 0.0), 0.0)
    shooting = crocoddyl.ShootingProblem(start, [running] * N, last)
    us = [np.array(u)] * N
    _known["iteration"] = Iteration(shooting, crocoddyl.SolverDDP(shooting), list(shooting.rollout(us)), us, True)
    data = differential.createData()
    differential.calc(data, start, np.array(probe))
    return {"acceleration": np.array(data.xout).tolist()}


def iterate(repeats: int, seconds: float) -> Answer:
    """Times of single iterations from the first trajectory."""
    return _known["iteration"].times(repeats, seconds)


if __name__ == "__main__":
    serve(hello, {"load": load, "iterate": iterate})
