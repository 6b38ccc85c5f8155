"""A task of frames, served to tasks.py: Crocoddyl where its interpreter runs this, else ours.

Joints are named, since the two libraries order them differently: what comes and goes by joint is a table by name.
"""

from __future__ import annotations

import importlib.util
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from serving import Answer, serve

THEIRS = importlib.util.find_spec("crocoddyl") is not None
Task = dict[str, Any]


class Ours:
    """This package on a task."""

    def __init__(self, task: Task) -> None:
        import planner
        from planner.costs import CenterOfMassCost
        from planner.solvers.engine import acquire_engine

        base = "free" if task["free"] else "fixed"
        self.mechanism = planner.Mechanism.from_urdf(task["urdf"], base=base)
        dynamics = planner.RigidBodyDynamics(self.mechanism, task["dt"], task["integrator"])
        self.joints = self.mechanism.joint_names[task["free"] :]
        self.motors = self.mechanism.actuators.names  # those of their joints, in the file's order
        x0, us = self.states([task["q0"]], [{}])[0], self.inputs(task["us"])
        N, velocity = task["N"], dict.fromkeys(self.joints, task["velocity"])
        end = dict.fromkeys(self.joints, task["final_velocity"])
        cost = planner.TrackingCost.joints(
            dynamics, x0, N, effort=task["effort"], velocity=velocity, final_velocity=end,
            position=dict.fromkeys(self.joints, task["posture"]),
        )  # fmt: skip
        if task["joint_goal"]:  # the same arm in joint space, for comparison
            cost = planner.TrackingCost.joints(
                dynamics, x0 + np.r_[np.full(7, 0.3), np.zeros(7)], N, effort=task["effort"], velocity=velocity,
                final_velocity=end, position=task["running"], final_position=task["final"],
            )  # fmt: skip
        else:
            for frame, pose in task["frames"].items():
                cost = cost + planner.FrameCost(
                    dynamics, frame, pose=pose, pose_weight=task["running"], final_pose_weight=task["final"]
                )
            if task["centre"] is not None:
                cost = cost + CenterOfMassCost(dynamics, task["centre"], final_position_weight=task["final"])
        limits = None
        if task["bounds"] is not None:
            most = np.array([task["bounds"][name] for name in self.motors])
            limits = planner.Limits(control=(-most, most))
        self.problem = planner.Problem(dynamics, cost, x0, us, limits=limits)
        self.stop, self.iterations = task["stop"], 1000
        self.engine = acquire_engine(self.problem)
        self.rewind()
        self.first = self.cost
        outcome = self.iterate()
        self.stepped, self.step = outcome.cost, outcome.step

    def states(self, qs: list[Any], vs: list[Any]) -> np.ndarray:
        """States of positions and velocities by name; a base stands at the origin, at rest."""
        free = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0] if len(self.joints) < len(self.mechanism.joint_names) else []
        still = len(free[1:]) * [0.0]
        return np.array([
            [*free, *(q.get(n, 0.0) for n in self.joints), *still, *(v.get(n, 0.0) for n in self.joints)]
            for q, v in zip(qs, vs, strict=True)
        ])  # fmt: skip

    def inputs(self, us: list[Any]) -> np.ndarray:
        """Controls by name."""
        return np.array([[u.get(name, 0.0) for name in self.motors] for u in us])

    @staticmethod
    def named(names: Any, rows: np.ndarray) -> list[dict[str, float]]:
        """The reverse, of joints or motors."""
        return [dict(zip(names, row.tolist(), strict=True)) for row in rows]

    def probe(self, qs: list[Any], vs: list[Any], us: list[Any]) -> Answer:
        """Accelerations of the joints at states, by name; and what a task needs of a state."""
        import planner

        nv, first = self.mechanism.nv, self.mechanism.nv - len(self.joints)
        xs = self.states(qs, vs)
        rates = self.problem.dynamics.rates(xs, self.inputs(us))[:, nv + first : 2 * nv]
        q = xs[:, : self.mechanism.nq]
        holding = planner.dynamics.bias(self.mechanism, q, np.zeros((len(q), nv)))[:, first:]
        poses = {
            name: planner.dynamics.frame_pose(self.mechanism, q[0], name).tolist()
            for name in self.mechanism.body_names[1:]
        }
        return {
            "accelerations": self.named(self.joints, rates), "holding": self.named(self.joints, holding),
            "poses": poses, "centre": planner.dynamics.center_of_mass(self.mechanism, q[0]).tolist(),
        }  # fmt: skip

    def rewind(self) -> None:
        """Back to the first trajectory."""
        self.cost = self.engine.start_from_controls(self.problem.x0, self.problem.first_guess)

    def iterate(self) -> Any:
        """Linearize, sweep, search, accept: feedback, Armijo, no regularization, no tolerance that could end it."""
        return self.engine.iterate(True, 0, 0.0, True, self.cost, 0.0, -1.0)

    def until(self, enough: float | None) -> None:
        """Solve once, and limit further solves to the iterations that reach a cost."""
        self.iterations = 1000
        history = self.solve().history
        if enough is not None:
            reached = [i for i, line in enumerate(history) if line.cost <= enough]
            self.iterations = reached[0] if reached else self.iterations

    def solve(self) -> Any:
        """A whole solve as a user calls it."""
        import planner

        self.plan = planner.solve(self.problem, max_iterations=self.iterations, expected_reduction_tolerance=self.stop)
        return self.plan

    def result(self) -> Answer:
        """Of the last solve."""
        return {"cost": self.plan.cost, "iterations": self.plan.nit, "us": self.named(self.motors, self.plan.us)}


class Theirs:
    """Crocoddyl on the same."""

    def __init__(self, task: Task) -> None:
        import crocoddyl
        import pinocchio as pin

        joint = [pin.JointModelFreeFlyer()] if task["free"] else []
        self.model = pin.buildModelFromXML(task["urdf"], *joint)
        self.data = self.model.createData()
        self.free = 1 if task["free"] else 0
        self.joints = list(self.model.names)[1 + self.free :]
        state = crocoddyl.StateMultibody(self.model)
        actuation = (crocoddyl.ActuationModelFloatingBase if self.free else crocoddyl.ActuationModelFull)(state)
        x0 = self.states([task["q0"]], [{}])[0]
        nu, nv, n = actuation.nu, self.model.nv, len(self.joints)

        # The free forward dynamics of 3.2.1 leave pinocchio's centre of mass at zero on the way: the end alone has it.
        def stage(goal: float, posture: float, velocity: float, effort: float) -> Any:
            costs = crocoddyl.CostModelSum(state, nu)
            weights = np.zeros(2 * nv)
            weights[nv - n : nv], weights[2 * nv - n :] = posture, velocity
            if weights.any():
                activation = crocoddyl.ActivationModelWeightedQuad(weights)
                residual = crocoddyl.ResidualModelState(state, x0, nu)
                costs.addCost("state", crocoddyl.CostModelResidual(state, activation, residual), 1.0)
            if effort:
                residual = crocoddyl.ResidualModelControl(state, nu)
                costs.addCost("effort", crocoddyl.CostModelResidual(state, residual), effort)
            for frame, pose in task["frames"].items() if goal else ():
                there = pin.SE3(pin.Quaternion(np.array([*pose[4:], pose[3]])).toRotationMatrix(), np.array(pose[:3]))
                residual = crocoddyl.ResidualModelFramePlacement(state, self.model.getFrameId(frame), there, nu)
                costs.addCost(frame, crocoddyl.CostModelResidual(state, residual), goal)
            if not effort and task["centre"] is not None:
                residual = crocoddyl.ResidualModelCoMPosition(state, np.array(task["centre"]), nu)
                costs.addCost("centre", crocoddyl.CostModelResidual(state, residual), goal)
            return crocoddyl.DifferentialActionModelFreeFwdDynamics(state, actuation, costs)

        self.differential = stage(task["running"], task["posture"], task["velocity"], task["effort"])
        running = (
            crocoddyl.IntegratedActionModelRK(self.differential, crocoddyl.RKType.four, task["dt"])
            if task["integrator"] == "rk4"
            else crocoddyl.IntegratedActionModelEuler(self.differential, task["dt"])
        )
        last = crocoddyl.IntegratedActionModelEuler(stage(task["final"], 0.0, task["final_velocity"], 0.0), 0.0)
        self.shooting = crocoddyl.ShootingProblem(x0, [running] * task["N"], last)
        if self.shooting.nthreads != 1:
            self.shooting.nthreads = 1
        if task["bounds"] is not None:
            most = np.array([task["bounds"][name] for name in self.joints])
            for model in self.shooting.runningModels:
                model.u_lb, model.u_ub = -most, most
        self.us = list(self.inputs(task["us"]))
        if task["bounds"] is not None:
            self.us = [np.clip(u, -most, most) for u in self.us]
        self.xs = list(self.shooting.rollout(self.us))
        self.first = float(self.shooting.calc(self.xs, self.us))
        kinds = crocoddyl.SolverFDDP, crocoddyl.SolverDDP
        if task["bounds"] is not None:
            kinds = crocoddyl.SolverBoxFDDP, crocoddyl.SolverBoxDDP
        self.solver, self.stepper = (kind(self.shooting) for kind in kinds)
        self.solver.th_stop, self.iterations = task["stop"], 1000
        self.stepper.solve(self.xs, self.us, 1, True)
        self.stepper.preg = self.stepper.dreg = 0.0
        self.step = 1.0
        self.stepped = self.step_once()
        while self.stepped is None:  # the longest step that does not run away: one rollout, as few as there can be
            self.step *= 0.5
            self.stepped = self.step_once()

    def states(self, qs: list[Any], vs: list[Any]) -> np.ndarray:
        """States of positions and velocities by name; a base stands at the origin, at rest."""
        free = self.free * [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]
        still = len(free[1:]) * [0.0]
        return np.array([
            [*free, *(q.get(n, 0.0) for n in self.joints), *still, *(v.get(n, 0.0) for n in self.joints)]
            for q, v in zip(qs, vs, strict=True)
        ])  # fmt: skip

    def inputs(self, us: list[Any]) -> np.ndarray:
        """Controls by name."""
        return np.array([[u.get(name, 0.0) for name in self.joints] for u in us])

    def named(self, us: np.ndarray) -> list[dict[str, float]]:
        """The reverse."""
        return [dict(zip(self.joints, u.tolist(), strict=True)) for u in us]

    def probe(self, qs: list[Any], vs: list[Any], us: list[Any]) -> Answer:
        """Accelerations of the joints at states by Crocoddyl, by name."""
        found = []
        for x, u in zip(self.states(qs, vs), self.inputs(us), strict=True):
            data = self.differential.createData()
            self.differential.calc(data, x, u)
            found.append(np.array(data.xout)[self.model.nv - len(self.joints) :])
        return {"accelerations": self.named(np.array(found))}

    def rewind(self) -> None:
        """Back to the first trajectory, its dynamics computed."""
        self.shooting.calc(self.xs, self.us)
        self.stepper.setCandidate(self.xs, self.us, True)

    def step_once(self) -> float | None:
        """The cost after one iteration; None where the step runs away."""
        import crocoddyl

        self.rewind()
        try:
            improvement = self.iterate()
        except crocoddyl.Exception:
            return None
        return float(self.stepper.cost - improvement)

    def iterate(self) -> float:
        """Linearize, sweep, try one step."""
        self.stepper.calcDiff()
        self.stepper.backwardPass()
        return self.stepper.tryStep(self.step)

    def until(self, enough: float | None) -> None:
        """Solve once, and limit further solves to the iterations that reach a cost."""
        import crocoddyl

        logger = crocoddyl.CallbackLogger()
        self.iterations = 1000
        self.solver.setCallbacks([logger])
        self.solve()
        self.solver.setCallbacks([])
        if enough is not None:
            reached = np.flatnonzero(np.array(logger.costs) <= enough)
            # The logger's line i is written after iteration i + 1.
            self.iterations = int(reached[0]) + 1 if len(reached) else 1000

    def solve(self) -> None:
        """A whole solve from the first guess and its rollout."""
        self.solver.solve(self.xs, self.us, self.iterations, True)

    def result(self) -> Answer:
        """Of the last solve; the cost of the rollout of its controls."""
        us = list(self.solver.us)
        cost = float(self.shooting.calc(self.shooting.rollout(us), us))
        return {"cost": cost, "iterations": int(self.solver.iter) + 1, "us": self.named(np.array(us))}


_cases: dict[str, Any] = {}


def timed(call: Callable[[], Any], prepare: Callable[[], Any], repeats: int, seconds: float) -> Answer:
    """Seconds of each call by the clock, and of the processor, which no neighbour on the machine takes part in."""
    wall: list[float] = []
    processor: list[float] = []
    while len(wall) < repeats and sum(wall) < seconds:
        prepare()
        began, spent = time.perf_counter(), time.process_time()
        call()
        wall.append(time.perf_counter() - began)
        processor.append(time.process_time() - spent)
    return {"wall": wall, "times": processor}


def hello() -> Answer:
    """What is installed."""
    if not THEIRS:
        return {"version": importlib.import_module("planner").__version__}
    crocoddyl, pinocchio = (importlib.import_module(name) for name in ("crocoddyl", "pinocchio"))
    return {"version": f"{crocoddyl.__version__} (pinocchio {pinocchio.__version__})"}


def load(task: Task) -> Answer:
    """Build a task; its cost at the first guess and after an iteration."""
    _cases.clear()
    case = _cases["now"] = (Theirs if THEIRS else Ours)(task)
    return {"joints": list(case.joints), "cost": case.first, "stepped_cost": case.stepped, "step": case.step}


def probe(qs: list[Any], vs: list[Any], us: list[Any]) -> Answer:
    """Accelerations at states."""
    return _cases["now"].probe(qs, vs, us)


def iterate(repeats: int, seconds: float) -> Answer:
    """Times of single iterations from the first trajectory."""
    case = _cases["now"]
    return timed(case.iterate, case.rewind, repeats, seconds)


def until(enough: float | None) -> Answer:
    """A solve to the end, and how many iterations reach a cost."""
    case = _cases["now"]
    case.until(enough)
    return {**case.result(), "reached_after": case.iterations}


def solve(repeats: int, seconds: float) -> Answer:
    """Times of whole solves."""
    case = _cases["now"]
    return {**timed(case.solve, lambda: None, repeats, seconds), **case.result()}


if __name__ == "__main__":
    serve(hello, {"load": load, "probe": probe, "iterate": iterate, "until": until, "solve": solve})
