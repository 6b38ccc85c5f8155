"""One of the solvers of hard.py, served to it: this package, or a peer where its interpreter runs this."""

from __future__ import annotations

import contextlib
import sys
import time
from typing import Any

import hard_problems
import numpy as np
from serving import Answer, serve

CHUNK = 5  # iterations that tell a peer's time per iteration
_cases: dict[str, Any] = {}


class Ours:
    """This package with its defaults."""

    def __init__(self, stated: dict[str, Any] | None, name: str) -> None:
        import planner

        self.stated = stated
        self.problem = hard_problems.OWN[name]() if stated is None else _posed(stated)
        planner.solve(self.problem, max_iterations=1)  # compiled

    def solve(self, us: np.ndarray | None, seed: list[int], limit: float) -> Answer:
        """A solve from the controls (N, nu), or from the problem's own with a random change."""
        from dataclasses import replace

        import planner
        from planner.solvers.multistart import smooth

        if us is None:
            guess = self.problem.first_guess
            us = guess + hard_problems.OWN_CHANGE * _sizes(self.problem) * smooth(
                np.random.default_rng(seed), guess.shape
            )
        else:
            us = us[:, _driven(self.stated)]
        options: Any = {} if self.stated is None else {"expected_reduction_tolerance": hard_problems.STOP}
        began = time.process_time()
        plan = planner.solve(replace(self.problem, us=us), **options)
        seconds = time.process_time() - began
        found = {"seconds": seconds, "iterations": plan.nit, "ended": plan.status.name, "cost": float(plan.cost)}
        if self.stated is None:
            return {**found, "solved": bool(plan.success)}
        controls = np.zeros((len(plan.us), len(self.stated["motors"])))
        controls[:, _driven(self.stated)] = plan.us
        return {**found, "us": controls.tolist()}

    def judge(self, us: np.ndarray) -> Answer:
        """Whether anybody's controls, within their bounds, end at the goal and stay within the bounds of the states."""
        from planner.dynamics.kinematics import frame_pose
        from planner.dynamics.protocol import rollout_states

        stated, dynamics = self.stated, self.problem.dynamics
        assert stated is not None
        limits = np.array(stated["limits"])
        xs = rollout_states(dynamics, self.problem.x0, np.clip(us, -limits, limits)[:, _driven(stated)])
        if not np.isfinite(xs).all():
            return {"solved": False}
        error = np.abs(dynamics.mechanism.space.difference(np.array(stated["x_ref"]), xs[-1]))
        good = bool(np.all(error <= np.array(stated["tolerances"])))
        if stated["place"] is not None:
            place = frame_pose(dynamics.mechanism, xs[-1][: dynamics.mechanism.nq], stated["motors"][-1])[:3, 3]
            good &= bool(np.abs(place - stated["place"]).max() <= stated["tolerance"])
        if stated["states"] is not None:
            good &= bool(np.all(np.abs(xs) <= 1.01 * np.array(stated["states"])))
        return {"solved": good}


class Theirs:
    """Crocoddyl's SolverBoxFDDP (FDDP where no control has a bound), or the SolverCSQP of mim_solvers."""

    def __init__(self, stated: dict[str, Any], solver: str) -> None:
        import crocoddyl
        import crocoddyl_worker
        import pinocchio as pin

        limits, motors = np.array(stated["limits"]), stated["motors"]
        self.stated, self.solver, self.csqp = stated, solver, solver == "csqp"
        free = stated["chain"]["joints"][0]["type"] == "FF"
        joints = list(stated["chain"]["joints"])
        if free:
            joints[0] = {**joints[0], "name": "root_joint"}
        self.model = crocoddyl_worker.model_of({**stated["chain"], "joints": joints})
        state = crocoddyl.StateMultibody(self.model)
        actuation = (crocoddyl.ActuationModelFloatingBase if free else crocoddyl.ActuationModelFull)(state)
        nu = len(motors)
        convert = crocoddyl_worker.Case.converted
        self.free = free
        x_ref = convert(self, np.array(stated["x_ref"]))

        def stage(weights: list[float], effort: Any, hand: float, bounded: bool) -> Any:
            costs = crocoddyl.CostModelSum(state, nu)
            if any(weights):
                activation = crocoddyl.ActivationModelWeightedQuad(np.array(weights))
                residual = crocoddyl.ResidualModelState(state, x_ref, nu)
                costs.addCost("state", crocoddyl.CostModelResidual(state, activation, residual), 1.0)
            if effort is not None:
                activation = crocoddyl.ActivationModelWeightedQuad(np.array(effort))
                residual = crocoddyl.ResidualModelControl(state, nu)
                costs.addCost("effort", crocoddyl.CostModelResidual(state, activation, residual), 1.0)
            if hand:
                frame = self.model.addFrame(
                    pin.Frame("hand", self.model.njoints - 1, pin.SE3.Identity(), pin.FrameType.OP_FRAME)
                )
                residual = crocoddyl.ResidualModelFrameTranslation(state, frame, np.array(stated["place"]), nu)
                costs.addCost("hand", crocoddyl.CostModelResidual(state, residual), hand)
            constraints, within = crocoddyl.ConstraintModelManager(state, nu), crocoddyl.ConstraintModelResidual
            if self.csqp and bounded:
                if np.isfinite(limits).any() and effort is not None:
                    residual = crocoddyl.ResidualModelControl(state, nu)
                    constraints.addConstraint(
                        "limits", crocoddyl.ConstraintModelResidual(state, residual, -limits, limits)
                    )
                if stated["states"] is not None:
                    most = np.array(stated["states"])
                    residual = crocoddyl.ResidualModelState(state, np.zeros(len(most)), nu)
                    constraints.addConstraint("states", within(state, residual, -most, most))
            return crocoddyl.DifferentialActionModelFreeFwdDynamics(state, actuation, costs, constraints)

        place = stated["hand"] if stated["place"] is not None else 0.0
        dt, N = stated["dt"], stated["N"]
        last = crocoddyl.IntegratedActionModelEuler(stage(stated["final"], None, place, True), 0.0)

        def running(bounded: bool) -> Any:
            model = crocoddyl.IntegratedActionModelEuler(stage([], stated["effort"], 0.0, bounded), dt)
            if not self.csqp and np.isfinite(limits).any():
                model.u_lb, model.u_ub = -limits, limits
            return model

        # The first stage has no bound of its states, which are given.
        models = [running(stated["states"] is None), *[running(True)] * (N - 1)]
        self.x0 = convert(self, np.array(stated["x0"]))
        self.shooting = crocoddyl.ShootingProblem(self.x0, models, last)
        if self.shooting.nthreads != 1:
            self.shooting.nthreads = 1

    @staticmethod
    def rotation(q: np.ndarray) -> np.ndarray:
        """Of a free base's q with the quaternion's w last."""
        import crocoddyl_worker

        return crocoddyl_worker.Case.rotation(q)

    def _new(self) -> Any:
        import crocoddyl

        if not self.csqp:
            bounded = np.isfinite(self.stated["limits"]).any()
            solver = (crocoddyl.SolverBoxFDDP if bounded else crocoddyl.SolverFDDP)(self.shooting)
            solver.th_stop = hard_problems.STOP
            return solver
        import mim_solvers

        solver = mim_solvers.SolverCSQP(self.shooting)
        solver.termination_tolerance = hard_problems.CSQP_TOLERANCE
        solver.use_filter_line_search = True
        solver.max_qp_iters = 1000
        solver.eps_abs = solver.eps_rel = 1e-6
        return solver

    def solve(self, us: np.ndarray, seed: list[int], limit: float) -> Answer:
        """A solve from the rollout of the controls (N, nu), of as many iterations as the limit (s) has time for."""
        limits = np.array(self.stated["limits"])
        guess = list(np.clip(us, -limits, limits))
        xs = list(self.shooting.rollout(guess))
        if not np.isfinite(np.array(xs)).all():
            xs = [self.x0] * (len(guess) + 1)
        began = time.process_time()
        trial = self._new()
        arguments = () if self.csqp else (True,)
        with contextlib.suppress(Exception):
            trial.solve(xs, guess, CHUNK, *arguments)
        each = (time.process_time() - began) / CHUNK
        most = max(CHUNK, int(limit / each))
        began = time.process_time()
        solver = self._new()
        try:
            converged = solver.solve(xs, guess, most, *arguments)
        except Exception:  # CSQP's "step_error"; what it has by then may be good
            converged = False
        seconds = time.process_time() - began
        return {
            "seconds": seconds, "iterations": int(solver.iter) + 1, "cost": float(solver.cost),
            "ended": "CONVERGED" if converged else "not converged",
            "us": np.clip(np.array(solver.us), -limits, limits).tolist(),
        }  # fmt: skip


def _posed(stated: dict[str, Any]) -> Any:
    """A planner.Problem of a stated one."""
    import planner

    driven = _driven(stated)
    motors = [name for name, one in zip(stated["motors"], driven, strict=True) if one]
    mechanism = planner.Mechanism.from_mjcf(hard_problems.mechanisms.mjcf(stated["chain"], motors))
    N, dt = stated["N"], stated["dt"]
    Q = np.zeros((N + 1, *np.diag(stated["final"]).shape))
    Q[N] = np.diag(stated["final"])
    R = np.repeat(dt * np.diag(np.array(stated["effort"])[driven])[None], N, axis=0)
    dynamics = planner.RigidBodyDynamics(mechanism, dt, "semi-implicit-euler")
    cost: Any = planner.TrackingCost(Q, R, stated["x_ref"], 0.0, space=mechanism.space)
    if stated["place"] is not None:
        hand = stated["motors"][-1]
        cost = cost + planner.FrameCost(dynamics, hand, position=stated["place"], final_position_weight=stated["hand"])
    limits = np.array(stated["limits"])[driven]
    ranges: dict[str, Any] = {}
    if stated["states"] is not None:
        most = np.array(stated["states"])
        ranges = {"state": {i: (-one, one) for i, one in enumerate(most) if np.isfinite(one)}}
    bounded = planner.Limits(control=(-limits, limits), **ranges) if ranges or np.isfinite(limits).any() else None
    us = np.array(stated["us"])[:, driven]
    return planner.Problem(dynamics, cost, stated["x0"], us, limits=bounded, tolerance=stated["tolerance"])


def _driven(stated: dict[str, Any] | None) -> np.ndarray:
    assert stated is not None
    return np.array(stated["limits"]) > 0.0


def _sizes(problem: Any) -> np.ndarray:
    """Size (N, nu) of the random changes: half widths of the bounds, else the largest control of the first guess."""
    us = problem.first_guess
    sizes = np.broadcast_to(np.maximum(np.abs(us).max(axis=0), 1e-3), us.shape)
    if problem.bounds is None:
        return sizes
    half = 0.5 * (problem.bounds.upper - problem.bounds.lower)
    return np.where(np.isfinite(half), half, sizes)


def hello() -> Answer:
    """What is installed."""
    if sys.argv[1] == "ours":
        return {"version": __import__("planner").__version__}
    import crocoddyl  # before mim_solvers, which finds its libraries

    if sys.argv[1] == "csqp":
        import mim_solvers  # noqa: F401
    return {"version": crocoddyl.__version__}


def load(stated: dict[str, Any] | None, name: str) -> Answer:
    """Build a problem."""
    _cases.clear()  # a problem that fails must not leave the last one
    _cases["now"] = Ours(stated, name) if sys.argv[1] == "ours" else Theirs(stated or {}, sys.argv[1])
    return {}


def solve(us: list[list[float]] | None, seed: list[int], limit: float) -> Answer:
    """One solve."""
    return _cases["now"].solve(None if us is None else np.array(us), seed, limit)


def judge(us: list[list[float]]) -> Answer:
    """Of controls."""
    return _cases["now"].judge(np.array(us))


if __name__ == "__main__":
    serve(hello, {"load": load, "solve": solve, "judge": judge})
