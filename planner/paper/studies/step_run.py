"""The human step (section 2.3): the swing by splines and by SLQ, stance and swing together, and the updates beside.

The paper moves the swing hip by 32 B-spline parameters, with BFGS and the gradient of Eq. 7, in four hours; stance and
swing together did not converge. Here the cost is the same for all methods (cost="study", see cases.human_step.cost),
and so is the first guess, the normal motion of the pelvis. Three updates of the controls are compared:

    feedback             u = us + alpha k + K (x - xs)
    open-loop            U + alpha dU, the paper's Eq. 36; dU = k + K dx along the LQ problem's own states, Eq. 25, 30
    feedforward alone    U + alpha k, which is no direction of the paper's: it forgets that dx is not 0

The last is what remains of Eq. 36 when Eq. 30 is left out, an easy mistake.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np

from planner.cases.human_step.case import human_step
from planner.cases.human_step.gait import NORMAL_GAIT
from planner.cases.human_step.measures import Measures, measures, normal_height, robot_wrench, vertical_force
from planner.cases.human_step.measures import height as height_of
from planner.cases.human_step.walker import PELVIS, SWING, GaitPhase, Walker
from planner.dynamics.protocol import rollout_states
from planner.paper.methods.spline_inputs import solve_by_splines
from planner.paper.studies.study import descent_record, plan_record, timed
from planner.problem.plan import Plan
from planner.problem.problem import Problem
from planner.proof.replays.replaying import replay
from planner.solvers import lq
from planner.solvers.engine import acquire_engine, release_engine
from planner.solvers.slq import solve
from planner.view.plots.case_pictures import frame_points

CYCLE_TIME = 1.2  # s, of the case's default cadence
DEGREE = 3  # of the splines: with quintics 32 parameters for 6 controls are too few
COEFFICIENTS = (5, 32)  # of each of 6 controls: 30 parameters, about the paper's 32; and 32 for each
MAX_BFGS_ITERATIONS = (1000, 100)  # iterations of BFGS: the second is to be seen beside the first, not to converge
GRADIENT = 1e-6  # where BFGS ends, relative to J of the guess
LIMITS = {"feedback": 100, "open-loop": 100, "feedforward alone": 40}
SHORT: dict[str, Any] = {"most": (150, 20), "limits": {**LIMITS, "feedforward alone": 15}}  # not for the documents
WITHIN = (0.05, 0.01, 0.001)  # of the end, whose first iteration is told
POSES = 41  # of the swing, to draw some of
CYCLES = 3

FRAMES = tuple(f"{side}_{point}" for side in ("right", "left")
               for point in ("hip", "knee_centre", "ankle_centre", "heel_point", "toe_point"))  # fmt: skip


def step_of(problem: Problem) -> GaitPhase:
    """The step of a problem of the default person and cadence."""
    swings = problem.parameters["phase"] == "swing"
    walker = Walker(legs=("right",), belt=False) if swings else Walker()
    return GaitPhase(walker, NORMAL_GAIT, CYCLE_TIME, SWING[0] if swings else 0.0, problem.N, problem.dynamics.dt)


def feedforward_alone(problem: Problem, iterations: int) -> list[float]:
    """J after every iteration of U + alpha k: Armijo's rule, and more regularization where no alpha is good enough."""
    engine, us = acquire_engine(problem), problem.first_guess.copy()
    costs, more = [engine.start_from_controls(problem.x0, us)], 0.0
    for _ in range(iterations):
        engine.start_from_controls(problem.x0, us)
        xs = engine.trajectory()[0].copy()
        A, B = problem.dynamics.linearize(xs, us)
        model = problem.cost.quadratize(xs, us)
        gradient, alpha = lq.gradient(A, B, model), 0.0
        for _ in range(8):
            sweep = lq.riccati(A, B, model._replace(R=(1.0 + more) * model.R))
            assert sweep is not None  # R is positive definite
            k, slope = sweep.k, float(np.sum(gradient * sweep.k))
            tried = (
                (a, engine.start_from_controls(problem.x0, us + a * k)) for a in 0.5 ** np.arange(9.0) if slope < 0.0
            )
            good = next(((a, J) for a, J in tried if costs[-1] + 1e-4 * a * slope >= J), None)
            if good is not None:
                alpha, cost = good
                us = us + alpha * k
                costs.append(cost)
                break
            more = max(10.0 * more, 1e-2)
        if alpha == 0.0:
            break
        if alpha == 1.0:
            more = more / 5.0 if more > 1e-4 else 0.0
    release_engine(problem, engine)
    return costs


def step_results(most: tuple[int, int] = MAX_BFGS_ITERATIONS, limits: Mapping[str, int] = LIMITS) -> dict[str, Any]:
    """Splines, updates, stance and swing, replays, and the default motions in the pictures, as JSON values."""
    problems = {name: human_step(phase=name, cost="study") for name in ("swing", "cycle")}
    for problem in problems.values():
        solve(problem, max_iterations=1)  # so that nothing is compiled on the clock
    plans, updates = {}, {}
    for name, problem in problems.items():
        plans[name], updates[name] = _updates(problem, limits)
    lowest = human_step(phase="swing", cost="study", clearance=0.0)
    long = human_step(cost="study", cycles=CYCLES)
    return {
        "updates": updates,
        "limits": dict(limits),
        "splines": [_splines(problems["swing"], n, few) for n, few in zip(COEFFICIENTS, most, strict=True)],
        "swing": _motion(plans["swing"]),
        "cycle": _motion(plans["cycle"]),
        "cycles": {"cycles": CYCLES, **_solved(long)[1]},
        "without_clearance": _motion(solve(lowest)),
        "default": {name: _drawn(human_step(phase=name)) for name in ("swing", "cycle")},
    }


def _solved(problem: Problem, **options: Any) -> tuple[Plan, dict[str, Any]]:
    plan, seconds = timed(lambda: solve(problem, **options))
    return plan, {**plan_record(plan), "seconds": seconds, "costs": [line.cost for line in plan.history]}


def _updates(problem: Problem, limits: Mapping[str, int]) -> tuple[Plan, dict[str, Any]]:
    """The plan, and the three updates on one problem."""
    found = {}
    plan, found["feedback"] = _solved(problem, max_iterations=limits["feedback"])
    _, found["open-loop"] = _solved(problem, update="open-loop", max_iterations=limits["open-loop"])
    most = limits["feedforward alone"]
    costs, seconds = timed(lambda: feedforward_alone(problem, most))
    found["feedforward alone"] = {
        "status": "MAX_ITERATIONS" if len(costs) > most else "NO_DESCENT", "iterations": len(costs) - 1,
        "seconds": seconds, "cost": costs[-1], "costs": costs,
    }  # fmt: skip
    return plan, found


def first_within(costs: Any, share: float) -> int:
    """The first iteration after which J is within a share of the last."""
    return int(np.argmax(np.asarray(costs) <= (1.0 + share) * costs[-1]))


def _splines(problem: Problem, coefficients: int, most: int) -> dict[str, Any]:
    found, seconds = timed(lambda: solve_by_splines(
        problem, coefficients=coefficients, degree=DEGREE, gradient_tolerance=GRADIENT, max_iterations=most
    ))  # fmt: skip
    return {
        "coefficients": coefficients, "parameters": found.spline.c.size, **descent_record(found),
        "costs": found.costs.tolist(), "seconds": seconds,
    }  # fmt: skip


def _motion(plan: Plan) -> dict[str, Any]:
    """Measures of a motion, and its replays' errors in deg RMS over the joints of the legs."""
    assert plan.problem is not None
    assert plan.problem.requirements is not None  # a case's, just solved
    step = step_of(plan.problem)
    found, normal = measures(step, plan.xs), measures(step, carried(plan.problem))
    judge = plan.problem.requirements.tracking
    assert judge is not None
    errors = {}
    for mode in ("open-loop", "feedback"):
        section = judge(replay(plan, feedback=mode == "feedback"))
        errors[mode] = next(figure.value for figure in section.measured if figure.name == "joint_error")
    m = plan.problem.dynamics.mechanism  # type: ignore[attr-defined]
    end = np.degrees(plan.xs[-1] - step.states[-1])
    joints = [m.joint(f"right_{name}").start for name in ("hip_flexion", "knee", "ankle")]
    heel, normal_heel = frame_points(m, np.stack([plan.xs[-1], step.states[-1]]), ("right_heel_point",))[:, 0]
    return {
        **plan_record(plan), **_summary(found), "carried_rms": normal.rms,
        "end_deg": end[joints].tolist(), "end_heel_m": (heel - normal_heel).tolist(),
        "replay_deg": errors,
    }  # fmt: skip


def carried(problem: Problem) -> np.ndarray:
    """States (N+1, nx) of the first guess: the normal motion of the pelvis carries the passive legs."""
    return rollout_states(problem.dynamics, problem.x0, problem.first_guess)


def _summary(found: Measures) -> dict[str, Any]:
    return asdict(found) | {"pelvis": found.pelvis.tolist()}


def _drawn(problem: Problem) -> dict[str, Any]:
    """The motion with the default cost, for the pictures."""
    plan, record = _solved(problem)
    step, m = step_of(problem), problem.dynamics.mechanism  # type: ignore[attr-defined]
    sides = step.walker.legs
    moving = [m.joint(name).start for name in PELVIS]
    names = [f"{side}_{joint}" for side in sides for joint in ("hip_flexion", "knee", "ankle")]
    angles = {name: m.joint(name).start for name in names}
    q, qd = plan.xs[:, : m.nq], plan.xs[:, m.nq :]
    lifts = {side: height_of(step, q, f"{side}_hip") - normal_height(step, f"{side}_hip") for side in sides}
    result: dict[str, Any] = {
        **record, **_summary(measures(step, plan.xs)), "t_s": _listed(plan.t),
        "angles_deg": {name: _listed(np.degrees(q[:, i])) for name, i in angles.items()},
        "normal_deg": {name: _listed(np.degrees(step.states[:, i])) for name, i in angles.items()},
        "pelvis": {"planned": _listed(q[:, moving]), "normal": _listed(step.states[:, moving])},
        "hip_lift_m": {side: _listed(lift) for side, lift in lifts.items()},
        "wrench": _listed(robot_wrench(problem.dynamics, plan.xs, plan.us)),  # type: ignore[arg-type]
    }  # fmt: skip
    if step.walker.belt:
        return {**result, "forces_N": {side: _listed(vertical_force(step, q, qd, side)) for side in sides}}
    chosen = np.linspace(0, plan.N, POSES).round().astype(int)
    frames = tuple(name for name in FRAMES if name.startswith(sides) or name.endswith("_hip"))
    motions = {"planned": plan.xs, "normal": step.states}
    return {
        **result, "frames": list(frames),
        "points": {name: _listed(frame_points(m, xs[chosen], frames)) for name, xs in motions.items()},
        "standing": _listed(step.feet(step.motion.q)[chosen, 3:]),  # the other leg's foot, as in the normal gait
    }  # fmt: skip


def _listed(values: np.ndarray) -> list[Any]:
    """Rounded to the accuracy of a picture."""
    return np.round(values, 5).tolist()
