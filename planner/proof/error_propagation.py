"""Predict how errors grow along a plan, open loop and with its gains, and thus the errors of its replays.

To first order a deviation obeys  dx(n+1) = A(n) dx(n) + d(n),  with the gains  (A(n) + B(n) K(n)) dx(n) + d(n):

    Phi(n) = A(n-1) ... A(0)    the state transition; its norm is what an error of size 1 at the start becomes
    d(n)                        error of stage n: the plan's own integrator at a refined step, minus one stage, and
                                the acceleration error of the motors of prescribed joints

so the replay error of a plan with a correct model is predicted without MuJoCo. A replay with much larger errors than
predicted differs in the model, not in the step. Errors of angles, lengths and velocities are relative to their bounds
(planner.proof.error_scales.path_error_bounds): 1 is the bound.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from planner.base.measured import Measurement, Section
from planner.dynamics import RigidBodyDynamics
from planner.model.mjcf.prescribed_joints import PRESCRIBED_ARMATURE
from planner.problem.plan import Plan
from planner.problem.problem import Problem
from planner.proof.compare.model_parity import forces_of_prescribed
from planner.proof.error_scales import path_error_bounds, shares_of_bounds
from planner.proof.replays.replaying import REFINEMENT, Replay

SMALL = 3.0  # bounds, 3 % of a range of motion: upper limit of a valid linear prediction
FACTOR = 10.0  # largest ratio of predicted and measured error that agrees
_ROUNDING = 1e-8  # bounds, 1e-10 of a range of motion: smaller errors are rounding


@dataclass(frozen=True, eq=False)
class ErrorPropagation:
    """Growth of errors along a plan. Modes are "open-loop" and "feedback"."""

    t: np.ndarray  # (N+1,) s
    transition: dict[str, np.ndarray]  # Mode -> (N+1,) log10 of the norm of the state transition from the start
    predicted: dict[str, np.ndarray]  # Mode -> (N+1,) predicted replay error, the largest relative to its bound
    measured: dict[str, np.ndarray]  # Mode -> (N+1,) measured replay error at the knots, likewise
    switches: bool  # Whether a contact opened or closed during the replay

    def rate(self, mode: str) -> float:
        """Growth rate of the transition's norm over the whole plan, 1/s."""
        return float(self.transition[mode][-1] * np.log(10.0) / self.t[-1])

    def ratio(self, mode: str) -> float | None:
        """Measured over predicted error, the largest of each over the path; None where the prediction is not valid."""
        measured, predicted = float(self.measured[mode].max()), float(self.predicted[mode].max())
        if self.switches or not (np.isfinite(measured) and np.isfinite(predicted) and measured < SMALL):
            return None
        return float(max(measured, _ROUNDING) / max(predicted, _ROUNDING))

    @property
    def section(self) -> Section:
        """Predicted and measured values; shown, not judged."""
        measured = []
        for mode, words in (("open-loop", "open_loop"), ("feedback", "feedback")):
            how = "open loop" if mode == "open-loop" else "with the gains"
            norm = self.transition[mode][-1]
            note = f"an error at the start becomes up to 10^{norm:.1f} times as large by the end, {how}"
            measured.append(Measurement(f"growth_rate_{words}", self.rate(mode), "1/s", None, note))
            note = f"largest over the path, by the linearized plan {how}; measured {self.measured[mode].max():.2e}"
            largest = float(self.predicted[mode].max())
            measured.append(Measurement(f"predicted_over_bound_{words}", largest, "", None, note))
            ratio = self.ratio(mode)
            if ratio is not None:
                note = f"a factor of {FACTOR:g} either way is the same error; more is another model"
                measured.append(Measurement(f"measured_over_predicted_{words}", ratio, "", None, note))
        return Section("error propagation", tuple(measured))


def propagate_errors(plan: Plan, problem: Problem, runs: dict[str, Replay]) -> ErrorPropagation:
    """Predict the replay errors of a plan, and compare with those of its replays by mode."""
    with np.errstate(all="ignore"):
        A, B = problem.dynamics.linearize(plan.xs, plan.us)
        defects = _defects(plan, problem) + _left_by_motors(plan, problem, B)
        stages = {"open-loop": A, "feedback": A + B @ plan.K}
        bounds = path_error_bounds(plan)
        found = {mode: _propagated(F * bounds / bounds[:, None], defects / bounds) for mode, F in stages.items()}
        measured = {mode: shares_of_bounds(plan, run.error[:: run.substeps]) for mode, run in runs.items()}
    forces = [run.contact_force > 0.0 for run in runs.values()]
    transition, predicted = ({mode: pair[k] for mode, pair in found.items()} for k in (0, 1))
    switches = any(bool(np.any(touching != touching[0])) for touching in forces)
    return ErrorPropagation(plan.t, transition, predicted, measured, switches)


def _defects(plan: Plan, problem: Problem) -> np.ndarray:
    """Integration errors d (N, ndx) of the stages: their ends in REFINEMENT steps minus those of the plan."""
    part = np.full(plan.N, problem.dynamics.dt / REFINEMENT)
    xs = plan.xs[:-1]
    for _ in range(REFINEMENT):
        xs = problem.dynamics.step(xs, plan.us, part)
    return plan.space.difference(xs, plan.xs[1:])


def _left_by_motors(plan: Plan, problem: Problem, B: np.ndarray) -> np.ndarray | float:
    """(N, ndx) stage errors from the acceleration error tau / PRESCRIBED_ARMATURE of motors of prescribed joints."""
    dynamics = problem.dynamics
    if not (isinstance(dynamics, RigidBodyDynamics) and dynamics.prescribed):
        return 0.0
    m, xs = dynamics.mechanism, plan.xs[:-1]
    qdd = dynamics.rates(xs, plan.us)[:, m.nv : 2 * m.nv]
    short = forces_of_prescribed(m, dynamics.prescribed, xs, qdd) / PRESCRIBED_ARMATURE
    return -np.einsum("nij,nj->ni", B[:, :, m.nu :], short)


def _propagated(F: np.ndarray, defects: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """log10 |Phi(n)| and the largest component of the error (N+1,), for stage matrices F (N, ndx, ndx)."""
    N, ndx = defects.shape
    norms, errors = np.zeros(N + 1), np.zeros(N + 1)
    phi, scale, error = np.eye(ndx), 0.0, np.zeros(ndx)
    for n in range(N):
        phi, error = F[n] @ phi, F[n] @ error + defects[n]
        size = float(np.linalg.norm(phi))
        if not np.isfinite(size) or size == 0.0:
            norms[n + 1 :], errors[n + 1 :] = np.nan if size else -np.inf, np.abs(error).max()
            return norms, errors
        phi, scale = phi / size, scale + np.log10(size)
        norms[n + 1] = scale + np.log10(np.linalg.norm(phi, 2))
        errors[n + 1] = np.abs(error).max()
    return norms, errors
