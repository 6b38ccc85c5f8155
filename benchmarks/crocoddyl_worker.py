"""Crocoddyl on the problems of rigid_body_problems.py, served to rigid_body.py from an environment of its own."""

from __future__ import annotations

from typing import Any

import numpy as np
from serving import Answer, serve, timed


def hello() -> Answer:
    """What is installed."""
    import crocoddyl
    import pinocchio

    return {"version": f"{crocoddyl.__version__} (pinocchio {pinocchio.__version__})"}


def model_of(chain: dict[str, Any]) -> Any:
    """The pinocchio model of a chain."""
    import pinocchio as pin

    model = pin.Model()
    model.gravity = pin.Motion(np.array(chain["gravity"]), np.zeros(3))
    armature = []
    for joint in chain["joints"]:
        kind = joint["type"]
        piece = pin.JointModelFreeFlyer() if kind == "FF" else getattr(pin, f"JointModel{kind}")()
        placement = pin.SE3(np.array(joint["R"]), np.array(joint["p"]))
        number = model.addJoint(joint["parent"], piece, placement, joint["name"])
        body = pin.Inertia(joint["mass"], np.array(joint["com"]), np.array(joint["inertia"]))
        model.appendBodyToJoint(number, body, pin.SE3.Identity())
        armature += [joint["armature"]] * piece.nv
    model.armature = np.array(armature)
    return model


class Case:
    """One problem as Crocoddyl has it."""

    def __init__(self, problem: dict[str, Any]) -> None:
        import crocoddyl
        import pinocchio as pin

        chain, motors = dict(problem["chain"]), problem["motors"]
        self.free = chain["joints"][0]["type"] == "FF"
        names = [joint["name"] for joint in chain["joints"]]
        idle = [name for name in names if name not in motors]
        # Crocoddyl's floating-base actuation is the one in C++ that leaves joints idle: the joint named root_joint.
        if idle:
            if idle != names[:1]:
                raise ValueError(f"joints {idle} have no motor, expected at most the first.")
            chain["joints"] = [{**chain["joints"][0], "name": "root_joint"}, *chain["joints"][1:]]
        self.model = model_of(chain)
        self.data = self.model.createData()
        state = crocoddyl.StateMultibody(self.model)
        actuation = (crocoddyl.ActuationModelFloatingBase if idle else crocoddyl.ActuationModelFull)(state)
        if actuation.nu != len(motors):
            raise ValueError(f"Crocoddyl has {actuation.nu} controls, expected {len(motors)}.")
        x_ref = self.converted(np.array(problem["x_ref"]))

        def stage(weights: list[float], effort: float) -> Any:
            costs = crocoddyl.CostModelSum(state, actuation.nu)
            if any(weights):
                activation = crocoddyl.ActivationModelWeightedQuad(np.array(weights))
                residual = crocoddyl.ResidualModelState(state, x_ref, actuation.nu)
                costs.addCost("state", crocoddyl.CostModelResidual(state, activation, residual), 1.0)
            if effort:
                residual = crocoddyl.ResidualModelControl(state, actuation.nu)
                costs.addCost("effort", crocoddyl.CostModelResidual(state, residual), effort)
            return crocoddyl.DifferentialActionModelFreeFwdDynamics(state, actuation, costs)

        # The differential model knows no dt: the integrated one multiplies a running cost by it.
        self.differential = stage(problem["running"], problem["effort"])
        running = (
            crocoddyl.IntegratedActionModelRK(self.differential, crocoddyl.RKType.four, problem["dt"])
            if problem["integrator"] == "rk4"
            else crocoddyl.IntegratedActionModelEuler(self.differential, problem["dt"])
        )
        last = crocoddyl.IntegratedActionModelEuler(stage(problem["final"], 0.0), 0.0)
        x0 = self.converted(np.array(problem["x0"]))
        self.shooting = crocoddyl.ShootingProblem(x0, [running] * problem["N"], last)
        if self.shooting.nthreads != 1:
            self.shooting.nthreads = 1
        self.us = list(np.array(problem["us"]))
        self.xs = list(self.shooting.rollout(self.us))
        self.cost = float(self.shooting.calc(self.xs, self.us))
        self.sample = pin.buildSampleModelHumanoid() if problem["name"] == "humanoid" else None

        # One iteration as SolverDDP.solve does it, from the first trajectory. After its first iteration a solver
        # calls calcDiff only, as the accepted trial has already computed what it needs.
        self.stepper = crocoddyl.SolverDDP(self.shooting)
        self.stepper.solve(self.xs, self.us, 1, True)
        # Its sweeps add 1e-9 to the diagonals, ours nothing: without, a full step ends at the same cost.
        self.stepper.preg = self.stepper.dreg = 0.0
        self.stepped_cost = self.step_once()

        self.solver = crocoddyl.SolverFDDP(self.shooting)
        self.solver.th_stop = problem["stop"]
        self.iterations, self.enough = problem["max_iterations"], problem["enough"]
        if self.enough is not None:
            logger = crocoddyl.CallbackLogger()
            self.solver.setCallbacks([logger])
            self.solver.solve(self.xs, self.us, 200, True)
            self.solver.setCallbacks([])
            reached = np.flatnonzero(np.array(logger.costs) <= self.enough)
            # The logger's line i is written after iteration i + 1.
            self.iterations = int(reached[0]) + 1 if len(reached) else 200

    def converted(self, x: np.ndarray) -> np.ndarray:
        """From MuJoCo's coordinates: the quaternion's w last, the base's linear rate in the body."""
        if not self.free:
            return x
        nq = self.model.nq
        q, v = x[:nq].copy(), x[nq:].copy()
        q[3:7] = x[[4, 5, 6, 3]]
        v[:3] = self.rotation(q).T @ v[:3]
        return np.concatenate([q, v])

    @staticmethod
    def rotation(q: np.ndarray) -> np.ndarray:
        """Of a free base's q with the quaternion's w last."""
        import pinocchio as pin

        return pin.Quaternion(q[3:7]).toRotationMatrix()

    def rewind(self) -> None:
        """Back to the first trajectory, its dynamics computed."""
        self.shooting.calc(self.xs, self.us)
        self.stepper.setCandidate(self.xs, self.us, True)

    def step_once(self) -> float | None:
        """The cost after one iteration; None where the full step runs away."""
        import crocoddyl

        self.rewind()
        try:
            improvement = self.iterate()
        except crocoddyl.Exception:
            return None
        return float(self.stepper.cost - improvement)

    def iterate(self) -> float:
        """Linearize, sweep, try the full step; by how much that lowers the cost."""
        self.stepper.calcDiff()
        self.stepper.backwardPass()
        return self.stepper.tryStep(1.0)


_cases: dict[str, Case] = {}


def load(problem: dict[str, Any], probes: dict[str, Any]) -> Answer:
    """Build a problem; accelerations at the probes by Crocoddyl and by pinocchio itself, and costs."""
    import pinocchio as pin

    _cases.clear()  # a problem that fails must not leave the last one to be timed
    case = Case(problem)
    idle = case.model.nv - len(problem["motors"])
    theirs, own = [], []
    for x, u in zip(np.array(probes["xs"]), np.array(probes["us"]), strict=True):
        y = case.converted(x)
        data = case.differential.createData()
        case.differential.calc(data, y, u)
        q, v = y[: case.model.nq], y[case.model.nq :]
        for found, a in (
            (theirs, np.array(data.xout)),
            (own, pin.aba(case.model, case.data, q, v, np.concatenate([np.zeros(idle), u]))),
        ):
            a = a.copy()
            if case.free:  # the rate of the body's components, to that of the world's
                a[:3] = case.rotation(q) @ (a[:3] + np.cross(v[3:6], v[:3]))
            found.append(a.tolist())
    _cases["now"] = case
    return {
        "accelerations": theirs, "pinocchio": own, "cost": case.cost, "stepped_cost": case.stepped_cost,
        "sample": None if case.sample is None else difference_of_models(case.model, case.sample),
    }  # fmt: skip


def difference_of_models(model: Any, sample: Any) -> float:
    """The largest difference of two models' parents, placements and inertias; infinite if joints differ."""
    same = model.njoints == sample.njoints and list(model.parents) == list(sample.parents)
    if not same or any(a.shortname() != b.shortname() for a, b in zip(model.joints, sample.joints, strict=True)):
        return float("inf")
    worst = 0.0
    for i in range(1, model.njoints):
        worst = max(worst, abs(model.jointPlacements[i].homogeneous - sample.jointPlacements[i].homogeneous).max())
        worst = max(worst, abs(model.inertias[i].matrix() - sample.inertias[i].matrix()).max())
    return float(worst)


def iterate(repeats: int, seconds: float) -> Answer:
    """Times of single iterations from the first trajectory, and of its three parts apart."""
    case = _cases["now"]
    whole = timed(case.iterate, case.rewind, repeats, seconds)
    case.rewind()
    parts = {
        "calcDiff": timed(case.stepper.calcDiff, case.rewind, 3, seconds),
        "backwardPass": timed(case.stepper.backwardPass, lambda: None, 3, seconds),
        "tryStep": timed(lambda: case.stepper.tryStep(1.0), lambda: None, 3, seconds),
    }
    return {"times": whole, "parts": parts}


def solve(repeats: int, seconds: float) -> Answer:
    """Times of whole solves from the first trajectory."""
    case = _cases["now"]
    converged = False

    def whole() -> None:
        nonlocal converged
        converged = case.solver.solve(case.xs, case.us, case.iterations, True)

    times = timed(whole, lambda: None, repeats, seconds)
    cost = float(case.solver.cost)
    return {
        "times": times, "cost": cost, "iterations": int(case.solver.iter) + bool(converged),
        "converged": bool(converged) if case.enough is None else cost <= case.enough,
        "us": np.array(case.solver.us).tolist(),
    }  # fmt: skip


def judge(us: list[list[float]]) -> Answer:
    """The cost of anybody's controls, rolled out here."""
    case = _cases["now"]
    controls = list(np.array(us))
    return {"cost": float(case.shooting.calc(list(case.shooting.rollout(controls)), controls))}


if __name__ == "__main__":
    serve(hello, {"load": load, "iterate": iterate, "solve": solve, "judge": judge})
