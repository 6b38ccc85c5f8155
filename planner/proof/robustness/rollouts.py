"""Many perturbed simulations of one plan at once, by mujoco.rollout on all cores: open loop and with the plan's gains.

The gains act at control steps, the integer fraction of a stage closest to 500 Hz. The simulator takes the same step, by
RK4, or a finer one where the plan's own is; half of it moved what succeeds by at most 2e-4 of its range, on three
machines. Where contacts are possible it takes the model's timestep, by semi-implicit Euler in place of RK4 (a quarter
of the work, and RK4 has no order across an impact) if the unperturbed trajectory is then the same.

A rollout is the same to the last bit in any batch and on any number of threads: every segment starts from the physical
state alone (no warm start), and what NumPy does here for many rollouts it does elementwise, since a matrix product
may round differently in other company.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any

import numpy as np

from planner.base.arguments import number
from planner.base.environment import processors
from planner.base.errors import PlannerError
from planner.base.gl import load_mujoco, load_rollout
from planner.dynamics.assembly import tangent_basis
from planner.model.capabilities import capabilities_of
from planner.problem.goals import stages_asked
from planner.problem.plan import Plan
from planner.problem.touch_downs import StageRule, TouchDown, feet_of, near_touch_downs, reference
from planner.proof.replays.compiled_twin import CompiledTwin
from planner.proof.replays.contact_history import may_touch
from planner.proof.replays.passive_torque_callback import curves_acting
from planner.proof.replays.replaying import problem_of
from planner.proof.replays.sampled_gains import FootLoads
from planner.proof.replays.simulation import MAX_STEPS, NATIVE_IMPLICIT, RUNAWAY, damping_of
from planner.proof.robustness.perturbation import Nominal, Perturbation, PerturbationSample, draw
from planner.proof.robustness.success import ranges_of_motion

MODES = ("open-loop", "feedback")
CLOCK = "clock"  # feedback whose stage is the clock's at touch-downs too, beside the plan's rule
CONTROL_RATE = 500.0  # Hz, of a controller
AGREES = 0.01  # of each coordinate's range of motion: largest difference of Euler from RK4
MAX_KNOTS = 200  # maximum number of stored knots
_SEGMENT = 16384  # numbers per rollout that MuJoCo returns at a time
_WORTH_THREADS = 6e-4  # s of simulation in a call: below, waking threads takes longer than they save
_MEMORY = 256e6  # upper limit of a batch's models and states, bytes


class OutOfTime(Exception):
    """The deadline has passed; the batch is not finished."""


@dataclass(frozen=True, eq=False)
class RolloutBatch:
    """Perturbed machines, ready to run."""

    models: list[Any]  # K of MuJoCo's
    start: np.ndarray  # (K, nw) simulator states
    noise: np.ndarray  # (K, N, nu) added to the controls
    delay: np.ndarray  # (K,) steps of the simulator
    stiffness: np.ndarray  # (K, curves) factors of the twin's exponential torques


class Rollouts:
    """The simulations of one plan. A context manager: it owns threads."""

    def __init__(self, plan: Plan, compiled: CompiledTwin, threads: int | None = None) -> None:
        self._problem = problem_of(plan)
        compiled.check(plan.us.shape[1])
        mujoco, model, twin = load_mujoco(), compiled.model, compiled.twin
        self.plan, self.twin, self.compiled = plan, twin, compiled
        self.control_steps = max(1, round(self._problem.dynamics.dt * CONTROL_RATE))  # per stage
        self.control_step = self._problem.dynamics.dt / self.control_steps  # s
        own = number("the model's timestep", model.opt.timestep, greater_than=0.0)
        finest = max(1, math.ceil(min(self.control_step / own, 1e12) - 1e-9))
        # Simulator steps per control step. Only contacts, and parts that the plan does not know of, ask for the model's
        # own step.
        stiff = may_touch(model) or twin.to_x.shape != (plan.xs.shape[1],) * 2
        # A plan's own step is stable; half of it is for machines whose errors make them stiffer.
        stable = math.ceil(2.0 * getattr(self._problem.dynamics, "substeps", 1) / self.control_steps)
        self.substeps = max(finest if stiff else 1, stable)
        if self.steps > MAX_STEPS:
            raise PlannerError(f"a rollout would take {self.steps} steps, expected at most {MAX_STEPS}.")
        implicit = damping_of(self._problem.dynamics) is not None
        model = compiled.stepping(self.step, NATIVE_IMPLICIT if implicit else "RK4")
        self.nominal = Nominal.of(model, plan, twin)
        # (T,) the stages at whose start (or end, the last) states are stored
        spread = np.linspace(0, plan.N, min(plan.N, MAX_KNOTS) + 1).round().astype(int)
        self.knots = np.union1d(spread, stages_asked(self._problem))
        self._plan_xs = plan.between_knots(self.control_steps)
        used = [np.flatnonzero(gains.any(axis=0)) for gains in plan.K]
        # by stage the states that have gains, and these gains, (n, 1, nu)
        self._gains = [(one, gains.T[one, None]) for one, gains in zip(used, plan.K, strict=True)]
        self.x_of = _affine(twin.to_x, twin.to_x_offset)  # simulator states (..., nw) as plan states (..., nx)
        self._scratch = mujoco.MjData(model)
        self._full = mujoco.mjtState.mjSTATE_FULLPHYSICS
        self._row = np.empty(mujoco.mj_stateSize(model, self._full))
        mujoco.mj_getState(model, self._scratch, self._row, self._full)
        threads = processors() if threads is None else threads
        self._data = [mujoco.MjData(model) for _ in range(threads)]
        self.sensing = self._data[0]  # for the loads of feet between two calls
        self._pool = load_rollout().Rollout(nthread=threads if threads > 1 else 0)
        self._alone = load_rollout().Rollout(nthread=0)
        self.integrator = "RK4"  # until it is known
        self.integrator = NATIVE_IMPLICIT if implicit else "EULER" if stiff and self._euler_agrees() else "RK4"

    def __enter__(self) -> Rollouts:
        return self

    def __exit__(self, *_: object) -> None:
        self._pool.close()

    def _euler_agrees(self) -> bool:
        """Whether Euler gives RK4's unperturbed trajectory with gains; Euler then stays set in the model."""
        kinds, options = load_mujoco().mjtIntegrator, self.nominal.model.opt
        none = Perturbation(**dict.fromkeys(Perturbation().to_dict(), 0.0))
        moved = []
        for kind in (kinds.mjINT_RK4, kinds.mjINT_EULER):
            options.integrator = kind
            moved.append(self.run(self.batch([draw(none, 0, 0, self.nominal.sizes)]), "feedback")[0])
        with np.errstate(all="ignore"):  # of a diverging one
            apart = np.abs(self.plan.space.difference(*moved)) / ranges_of_motion(self.plan)
        agrees = bool(np.all(apart <= AGREES))
        options.integrator = kinds.mjINT_EULER if agrees else kinds.mjINT_RK4
        return agrees

    @property
    def step(self) -> float:
        """The simulator's step, s."""
        return self.control_step / self.substeps

    @property
    def steps(self) -> int:
        """Number of simulator steps of a rollout."""
        return self.plan.N * self.control_steps * self.substeps

    @property
    def _segment(self) -> int:
        """Number of open-loop steps between checks of the states: whole stages."""
        per_stage = self.control_steps * self.substeps
        return per_stage * max(1, min(2000, _SEGMENT // len(self._row)) // per_stage)

    @property
    def seconds(self) -> float:
        """Estimated duration of a rollout in one mode, s, from the sizes alone."""
        return self._seconds(self.steps)

    def _seconds(self, steps: int) -> float:
        evaluations = 4 if self.integrator == "RK4" else 1
        own = 0.125 * (5e-6 + 2.5e-6 * self.nominal.model.nv)
        return evaluations * steps * own

    @property
    def batch_size(self) -> int:
        """Number of rollouts per batch, limited by duration and memory."""
        model = self.nominal.model
        own = model.nbuffer + 8 * (self.plan.N * model.nu + len(self.knots) * self.plan.space.ndx)
        return int(max(1, min(_MEMORY / own, np.clip(3.0 / self.seconds, 32, 512))))

    def batch(self, draws: Sequence[PerturbationSample]) -> RolloutBatch:
        """The machines with these errors."""
        plan = self.plan
        joints = self.nominal.model.dof_jntid[[curve.dof for curve in self.twin.curves]]
        x0, mechanism = self._problem.x0, capabilities_of(self._problem.dynamics).mechanism
        starts = [errors.start for errors in draws]
        if mechanism is not None:
            T, places = tangent_basis(mechanism, x0)
            starts = [T @ start[places] for start in starts]
        return RolloutBatch(
            models=[self.nominal.with_errors(errors, self._scratch) for errors in draws],
            start=np.array([self.twin.sim_of(plan.space.integrate(x0, start)) for start in starts]),
            noise=np.array([errors.noise * self.nominal.control for errors in draws]),
            delay=np.array([round(min(errors.delay / self.step, self.steps)) for errors in draws]),
            stiffness=np.array([errors.stiffness[joints] for errors in draws]),
        )

    def curves(self, batch: RolloutBatch, data: Sequence[Any]) -> AbstractContextManager[None]:
        """Context in which the twin's exponential torques, with the batch's stiffness factors, act in these data."""
        return curves_acting(self.twin, *batch.models, factors=batch.stiffness, data=data)

    def run(self, batch: RolloutBatch, mode: str, deadline: float = math.inf) -> np.ndarray:
        """The states (K, T, nx) of a batch at self.knots; NaN from the segment on in which a rollout diverges."""
        K, nw = batch.start.shape
        n, commands = self.pieces(batch, mode)
        at = self.knots * self.control_steps * self.substeps  # the step before which each is stored
        ends = np.searchsorted(at, np.arange(1, self.steps + n + 1, n)).tolist()  # those of a call, and of the next
        first = np.tile(self._row, (K, 1))
        first[:, 1 : 1 + nw] = batch.start
        row, sound, warm = first.copy(), np.ones(K, dtype=bool), np.zeros((K, self.nominal.model.nv))
        xs = np.empty((K, len(at), self.plan.xs.shape[1]))
        xs[:, 0] = self.x_of(batch.start)
        states = np.empty((K, n, len(self._row)))
        together = self._seconds(K * n) > _WORTH_THREADS
        pool, data = (self._pool, self._data) if together else (self._alone, self._data[:1])
        with self.curves(batch, self._data), np.errstate(all="ignore"):  # of a diverging one
            for call, i in enumerate(range(0, self.steps, n)):
                if time.monotonic() > deadline:
                    raise OutOfTime
                if self.steps - i < n:
                    n = self.steps - i
                    states = np.empty((K, n, len(self._row)))
                ctrl = commands(i, n, row[:, 1 : 1 + nw])
                pool.rollout(
                    batch.models, data, row, ctrl, nstep=n, initial_warmstart=warm, state=states, skip_checks=True
                )
                row[:] = states[:, -1]
                sound &= (np.abs(row) < RUNAWAY).all(axis=1) & self.in_time(row[:, 0], i + n)
                sound &= (np.abs(ctrl) < RUNAWAY).all(axis=(1, 2))  # larger ones MuJoCo leaves out
                here = slice(ends[call], ends[call + 1])
                if here.start < here.stop:
                    xs[:, here] = self.x_of(states[:, at[here] - i - 1, 1 : 1 + nw])
                if not sound.all():
                    row[~sound], xs[~sound, here.start :] = first[~sound], np.nan
        return xs

    def in_time(self, time: Any, steps: int) -> Any:
        """Whether the time is that after so many steps; MuJoCo stops a diverging simulation, and its time with it."""
        return abs(time - steps * self.step) < 0.5 * self.step

    def pieces(self, batch: RolloutBatch, mode: str) -> tuple[int, Callable[[int, int, np.ndarray], np.ndarray]]:
        """Steps per call, and the function (step i, n, w (K, nw)) -> controls (K, n, nu)."""
        if mode == "open-loop":
            return self._segment, lambda i, n, w: self._held(batch, i, n)
        return self.substeps, _Feedback(self, batch, () if mode == CLOCK else self.plan.touch_downs)

    def control(self, w: np.ndarray, control_step: int, waits: TouchDown | None = None) -> np.ndarray:
        """Controls with gains (K, nu), within bounds, at simulator states (K, nw) at a control step."""
        x, x_ref, plan = self.x_of(w), self._plan_xs[control_step], self.plan
        stage = control_step // self.control_steps
        if waits is not None:
            since = self.control_step * (control_step - self.control_steps * waits.stage)
            stage, x_ref = waits.stage, reference(self._problem.dynamics, plan.xs[waits.stage], since)
        # NumPy may take another sine for a single number than for several, with another last bit.
        dx = plan.space.difference(x if len(x) > 1 else np.repeat(x, 2, axis=0), x_ref)[: len(x)]
        used, gains = self._gains[stage]
        terms = np.empty((1 + len(used), len(w), plan.us.shape[1]))
        terms[0] = plan.us[stage]
        np.multiply(dx.T[used, :, None], gains, out=terms[1:])
        return plan.within_bounds(stage, np.add.accumulate(terms)[-1])  # one by one: sum() may order them otherwise

    def _held(self, batch: RolloutBatch, i: int, n: int) -> np.ndarray:
        """The plan's controls over n steps, delayed and noisy."""
        steps, per_stage = np.arange(i, i + n), self.control_steps * self.substeps
        late = np.maximum(steps - batch.delay[:, None], 0) // per_stage
        return self.plan.us[late] + batch.noise[:, steps // per_stage]


class _Feedback:
    """u = us[n] + K[n] difference(x, x_plan(t)) of every rollout, once per control step; delayed and noisy.

    Around touch-downs the stage of each rollout waits for its own feet.
    """

    def __init__(self, rollouts: Rollouts, batch: RolloutBatch, touch_downs: Sequence[TouchDown]) -> None:
        K, c = len(batch.models), rollouts.substeps
        self._rollouts, self._noise = rollouts, batch.noise
        self._past = (np.arange(c) - batch.delay[:, None]) // c  # (K, c) the control step that acts, from this one
        self._commands = np.empty((1 - int(self._past.min(initial=0)), K, batch.noise.shape[2]))  # the last ones
        self._each = np.arange(K)[:, None]
        self._models, self._loads = batch.models, FootLoads(batch.models[0], feet_of(touch_downs))
        touch_downs = [one for one in touch_downs if self._loads.known(one.feet)]
        self._rules = [StageRule(touch_downs) for _ in batch.models]
        self._near = near_touch_downs(touch_downs, rollouts.plan.N)
        self._applied = np.zeros((K, batch.models[0].nu))

    def __call__(self, i: int, n: int, w: np.ndarray) -> np.ndarray:
        rollouts, past = self._rollouts, self._commands
        j = i // rollouts.substeps
        stage = j // rollouts.control_steps
        u = rollouts.control(w, j)
        if self._near[stage]:
            self._wait(u, j, w)
        if j == 0:
            past[:] = u  # applied before the first instant
        past[j % len(past)] = u
        commands = past[(j + self._past) % len(past), self._each] + self._noise[:, stage, None]
        self._applied[:] = commands[:, -1]
        return commands

    def _wait(self, u: np.ndarray, j: int, w: np.ndarray) -> None:
        """Replace the controls (K, nu) of rollouts whose stage at control step j is that of a touch-down."""
        rollouts, waiting = self._rollouts, dict[TouchDown, list[int]]()
        for k, (rule, model) in enumerate(zip(self._rules, self._models, strict=True)):
            if not np.isfinite(w[k]).all():
                continue
            bears = self._loads.sensed(model, rollouts.sensing, w[k], self._applied[k].copy)
            if (one := rule(j / rollouts.control_steps, bears)) is not None:
                waiting.setdefault(one, []).append(k)
        for one, rows in waiting.items():
            u[rows] = rollouts.control(w[rows], j, one)


def _affine(matrix: np.ndarray, offset: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """A function of v (..., n): matrix @ v + offset (..., m), rounded alike for any number of them."""
    entries = [np.flatnonzero(row) for row in matrix]
    if all(len(found) == 1 and row[found[0]] == 1.0 for row, found in zip(matrix, entries, strict=True)):
        which = np.concatenate(entries)
        return lambda v: v[..., which] + offset

    def general(v: np.ndarray) -> np.ndarray:
        result = np.zeros((*v.shape[:-1], len(matrix)))
        for column in np.flatnonzero(matrix.any(axis=0)):
            result += v[..., column, None] * matrix[:, column]
        return result + offset

    return general
