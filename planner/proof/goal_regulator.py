"""Feedback beyond the plan: an infinite-horizon LQR that keeps its goal, simulated, and the slowest rate of its gains.

A plan ends at its horizon, and most goals are not stable without control. Close to an equilibrium, x_g = f(x_g, u_g),
the deviation e = x (-) x_g obeys e+ = A e + B (u - u_g), and

    u = u_g + K e,    K = -(R + B'P B)^-1 B'P A,    P = Q + A'P A - A'P B (R + B'P B)^-1 B'P A

minimizes the sum of e'Q e + (u - u_g)'R (u - u_g) over infinite time. The weights are those of the cost's last stage,
and its final weight per second: no new parameters.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from planner.base.arguments import number
from planner.base.errors import PlannerError
from planner.base.measured import Measurement, Section
from planner.dynamics.protocol import Dynamics
from planner.dynamics.quasi_static import equilibrium, state_directions
from planner.model.coordinates import coordinates_of
from planner.model.space import StateSpace, space_of
from planner.problem.goals import MIN_TOLERANCES
from planner.problem.plan import Plan
from planner.problem.problem import Problem
from planner.proof.error_scales import worst_by_unit
from planner.proof.replay_errors import costs_with_goals
from planner.proof.replays.compiled_twin import CompiledTwin
from planner.proof.replays.passive_torque_callback import curves_acting
from planner.proof.replays.replaying import Replay, problem_of, replay_in
from planner.proof.replays.sampled_gains import Sampling, sampling_of
from planner.proof.replays.simulation import MAX_STEPS, simulate
from planner.solvers.gains import regulator_gains

EQUILIBRIUM = 0.05  # of the smallest goal tolerance of a unit: largest distance from the goal to an equilibrium
_UNKNOWN = 0.02  # that tolerance, for units without a goal
_WEAKEST = 1e-6  # weight of components without a cost, relative to the largest: they are regulated too, slowly


@dataclass(frozen=True, eq=False)
class GoalRegulator:
    """The regulator u = u_goal + K difference(x, x_goal)."""

    x_goal: np.ndarray  # (nx,) the regulated equilibrium: the goal where the cost's final weight acts
    u_goal: np.ndarray  # (nu,) the equilibrium control
    K: np.ndarray  # (nu, ndx)
    space: StateSpace  # State space of x

    def control(self, x: np.ndarray) -> np.ndarray:
        """The control (nu,) at a state (nx,)."""
        return self.u_goal + self.K @ self.space.difference(x, self.x_goal)


def hold_gain(problem: Problem) -> GoalRegulator:
    """The regulator at the goal of a problem.

    Args:
        problem: With a TrackingCost, alone or in a sum, that has a final weight.

    Raises:
        PlannerError: The cost has no goal state, or the goal is no equilibrium, or cannot be stabilized.
    """
    costs = costs_with_goals(problem)
    if len(costs) != 1:
        has = f"the cost has {len(costs)} terms with a goal state"
        raise PlannerError(f"{has}, expected one TrackingCost with a final weight.")
    free = ~np.any(costs[0].Q[-1], axis=0)  # (ndx,) components without a final cost
    x, u = equilibrium(problem.dynamics, costs[0].x_ref[-1].copy(), np.zeros(problem.dynamics.nu), free)
    T, places = state_directions(problem.dynamics, x)
    A, B, drift = _about(problem, x, u)
    _check_equilibrium(A, B, drift, problem.dynamics)
    Q, R = _weights(problem, x, u)
    A, B, Q = (A @ T)[places], B[places], T.T @ Q @ T
    K = regulator_gains(A, B, Q, R)
    if K is None:
        raise PlannerError(
            "the goal cannot be held: no gains make the dynamics stable there, expected controls that reach every "
            "motion that does not die out by itself."
        )
    gains = np.zeros((len(K), len(T)))
    gains[:, places] = K
    return GoalRegulator(x, u, gains, space_of(problem.dynamics))


def _check_equilibrium(A: np.ndarray, B: np.ndarray, drift: np.ndarray, dynamics: Dynamics) -> None:
    """Raise unless an equilibrium exists close to the goal: drift + (A - 1) dx + B du = 0 with a small dx."""
    J = np.concatenate([A - np.eye(len(A)), B], axis=1)
    z = np.linalg.lstsq(J, -drift, rcond=1e-10)[0]
    stands = np.abs(drift + J @ z).max() <= 1e-6 * np.abs(drift).max()
    coordinates = coordinates_of(dynamics)
    near = EQUILIBRIUM * np.array([MIN_TOLERANCES.get(one.unit, _UNKNOWN) for one in coordinates])
    if not (stands and np.all(np.abs(z[: len(A)]) <= near)):
        worst = int(np.argmax(np.abs(drift) / near))
        rate = f"{drift[worst] / dynamics.dt:.3g} {coordinates[worst].unit}".rstrip()
        raise PlannerError(
            f"the goal is no equilibrium: with the best control, {coordinates[worst].name} changes by {rate} per "
            "second there, expected a goal that some control keeps."
        )


def _about(problem: Problem, x: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A (ndx, ndx), B (ndx, nu) and the drift f(x, u) (-) x (ndx,) at one state and control."""
    A, B = problem.dynamics.linearize(np.stack([x, x]), u[None])
    drift = space_of(problem.dynamics).difference(problem.dynamics.step(x[None], u[None])[0], x)
    return A[0], B[0], drift


def _weights(problem: Problem, x: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Q (ndx, ndx) and R (nu, nu) of one stage of the regulator."""
    N = problem.N
    model = problem.cost.quadratize(np.tile(x, (N + 1, 1)), np.tile(u, (N, 1)))
    Q = problem.dynamics.dt * model.Q[N] + (model.Q[N - 1] if N > 1 else 0.0)
    return Q + _WEAKEST * np.abs(Q).max() * np.eye(len(Q)), model.R[N - 1]


@dataclass(frozen=True, eq=False)
class RegulatedRun:
    """A MuJoCo simulation after a replay, with a regulator acting at every step."""

    plan: Plan  # The plan of the replay
    hold: GoalRegulator  # The regulator
    t: np.ndarray  # (M+1,) s; continues the replay's time
    qpos: np.ndarray  # (M+1, nq)
    qvel: np.ndarray  # (M+1, nv)
    act: np.ndarray  # (M+1, na)
    ctrl: np.ndarray  # (M, nu) applied controls
    # (M+1, nx) the states in the plan's coordinates; the first is the replay's last. NaN after divergence.
    xs: np.ndarray
    warnings: tuple[str, ...]  # MuJoCo's warnings, one sentence each

    @property
    def deviation(self) -> np.ndarray:
        """(M+1, ndx) from the goal."""
        return self.hold.space.difference(self.xs, self.hold.x_goal)


def simulate_regulator(replay: Replay, hold: GoalRegulator, seconds: float = 10.0) -> RegulatedRun:
    """Simulate the regulator in MuJoCo from the end of a replay, with the replay's step and integrator."""
    steps = number("seconds", seconds, greater_than=0.0) / replay.timestep
    if not 0.5 < steps < MAX_STEPS + 0.5:  # may be infinite
        raise PlannerError(f"{seconds:g} s are {steps:.3g} steps of the replay, expected 1 to {MAX_STEPS}.")
    if hold.K.shape != (replay.ctrl.shape[1], replay.plan.space.ndx):
        raise PlannerError(f"the gains have shape {hold.K.shape}, expected those of the plan's machine.")
    steps = round(steps)
    twin, model = replay.twin, replay.compiled.stepping(replay.timestep, replay.integrator)
    t, ctrl = replay.t[-1] + replay.timestep * np.arange(steps + 1), np.zeros((steps, model.nu))
    arrived = np.concatenate([replay.qpos[-1], replay.qvel[-1], replay.act[-1]])
    with curves_acting(twin, model):
        w, warnings = simulate(model, arrived, ctrl, control=lambda _, w: hold.control(twin.x_of(w)), start=float(t[0]))
    qpos, qvel, act = np.split(w, [model.nq, model.nq + model.nv], axis=1)
    return RegulatedRun(replay.plan, hold, t, qpos, qvel, act, ctrl, twin.x_of(w), warnings)


def hold_section(held: RegulatedRun) -> Section:
    """Whether the goal was regulated: largest deviations over the last second by unit, with the path error bounds."""
    last = held.t >= held.t[-1] - 1.0
    lasting = f"over the last second of {held.t[-1] - held.t[0]:.4g} s"
    parts = (
        ("held", held.deviation[last], f"{lasting}; the bound is that of its path"),
        ("final_held", held.deviation[-1:], "at the end"), ("largest_held", held.deviation, "on the way"),
    )  # fmt: skip
    measured = [
        Measurement(
            f"{part}_{one.word}_deviation", one.value, one.unit, one.bound if part == "held" else None,
            f"of {one.name} from the goal, {words}",
        )
        for part, deviation, words in parts for one in worst_by_unit(held.plan, deviation)
    ]  # fmt: skip
    warned = Measurement("simulator_warnings", float(len(held.warnings)), "", 0.0, " ".join(held.warnings))
    return Section("hold", (*measured, warned))


_LEVELS = 10  # 500 Hz to 1 Hz


@dataclass(frozen=True, eq=False)
class FeedbackRateTrial:
    """A replay with the gains at one rate."""

    sampling: Sampling  # When the gains were applied
    passed: bool  # Whether the replay passed


@dataclass(frozen=True, eq=False)
class FeedbackRates:
    """Trials at decreasing feedback rates, each half of the previous one, and at one update per stage."""

    tried: tuple[FeedbackRateTrial, ...]  # Only the last one may have failed
    once_a_stage: FeedbackRateTrial

    @property
    def slowest(self) -> Sampling | None:
        """The lowest of the consecutive rates in `tried` that pass; None where the first fails."""
        passed = [one.sampling for one in self.tried if one.passed]
        return passed[-1] if passed else None


def controller_section(rates: FeedbackRates, encoded: Replay) -> Section:
    """The rates that pass and the errors with encoders; shown, not judged."""
    slowest = rates.slowest
    tried = ", ".join(f"{one.sampling.rate:.4g} Hz {'passes' if one.passed else 'fails'}" for one in rates.tried)
    measured = [
        Measurement("slowest_rate", slowest.rate if slowest else math.inf, "Hz", None, f"one period late; {tried}"),
        Measurement(
            f"once_a_stage_{'passes' if rates.once_a_stage.passed else 'fails'}", rates.once_a_stage.sampling.rate,
            "Hz", None, "gains once a stage, one stage late",
        ),
    ]  # fmt: skip
    for part, along in (("end", encoded.error[-1:]), ("path", encoded.error)):
        for one in worst_by_unit(encoded.plan, along):
            note = f"of {one.name}, with encoders of 17 bits and 1 um, velocities by difference, not filtered"
            measured.append(Measurement(f"encoders_{part}_{one.word}_error", one.value, one.unit, None, note))
    return Section("feedback rate", tuple(measured))


def slowest_rate(
    plan: Plan, compiled: CompiledTwin, passes: Callable[[Replay], bool], planned: np.ndarray | None = None
) -> FeedbackRates:
    """Replay a plan at half the feedback rate again and again, from a proof's rate on, until a replay fails.

    Ends after ten rates, or where the period would exceed half of the duration. `passes` judges a replay, which has no
    contacts; `planned` is as of replay_in().

    Raises:
        PlannerError: The plan cannot be simulated.
    """
    problem, sampling = problem_of(plan), sampling_of(plan)

    def at(sampling: Sampling) -> FeedbackRateTrial:
        run = replay_in(compiled, plan, feedback=True, sampling=sampling, planned=planned, contacts=False)
        return FeedbackRateTrial(sampling, bool(passes(run)))

    tried = [at(sampling)]
    while tried[-1].passed and len(tried) < _LEVELS and 4.0 * sampling.period <= problem.duration:
        sampling = replace(sampling, period=2.0 * sampling.period)
        tried.append(at(sampling))
    known = [one for one in tried if np.isclose(one.sampling.period, problem.dynamics.dt, rtol=1e-9)]
    return FeedbackRates(tuple(tried), known[0] if known else at(Sampling(problem.dynamics.dt)))
