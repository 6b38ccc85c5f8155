"""Measure how a plan's replay changes as MuJoCo's step is halved, as in Roache's grid convergence index.

The controls are constant over a stage and MuJoCo integrates with the plan's own method at the steps h, h/2, h/4, ...
(P. J. Roache, "Perspective: a method for uniform reporting of grid refinement studies", J. Fluids Eng. 116, 1994;
ASME V&V 20-2009). With f1, f2, f3 the coarse, middle and fine values,

    observed order     p = log2(|f1 - f2| / |f2 - f3|)
    extrapolated       f = f3 + (f3 - f2) / (2^p - 1)
    uncertainty        1.25 |f3 - f2| / (2^p - 1)

The other replays take RK4 at a refined step, so that they judge the plan and not a simulator's step. `own_step` is the
plan in the user's file at the file's own timestep and integrator, as the user's own simulation would run it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from decimal import ROUND_CEILING, Context

import numpy as np

from planner.base.gl import load_mujoco
from planner.base.measured import Measurement, Section
from planner.dynamics.protocol import integrator_of
from planner.kernels.integrators import KNOWN_INTEGRATORS
from planner.model.capabilities import capabilities_of
from planner.model.passive_forces import slack_tendons
from planner.problem.goals import GoalCheck
from planner.problem.plan import Plan
from planner.problem.problem import Problem
from planner.proof.error_scales import (
    COST_BOUND,
    is_path_judged,
    judged_cost,
    reaches_stops,
    shares_of_bounds,
    worst_by_unit,
)
from planner.proof.replay_errors import misses
from planner.proof.replays.compiled_twin import CompiledTwin
from planner.proof.replays.contact_history import may_touch
from planner.proof.replays.passive_torque_callback import curves_acting
from planner.proof.replays.replaying import Replay
from planner.proof.replays.sampled_gains import PERIOD
from planner.proof.replays.simulation import MAX_STEPS, simulate, stage_damping
from planner.proof.same_step import advancing

ORDER_BOUND = 0.2  # largest amount by which the observed order may be below the nominal one, for a smooth machine
LEVELS = 5  # number of step sizes: a stage, its half, ... a sixteenth
LEVELS_OF_SUBSTEPS = 3  # number of step sizes from a substep on: the minimum that shows an order
MAX_LEVELS = 7  # number of step sizes where the first ones are too coarse to show an order
MAX_STAGE_STEPS = 256  # upper limit of steps per stage
UNCERTAIN = 0.1  # of the cost's bound: smaller uncertainties need no finer level where no order is judged
# Change of the end state above which it is no rounding; and above which it may tell an order, but no shortfall of one.
_SEEN, _MAY_BE_SEEN = 1e-9, 1e-11
_FASTEST = 2.0**6  # ratio of two changes, beyond which one of them is a coincidence
_SAFETY = 1.25  # Roache's factor for three grids and more


@dataclass(frozen=True, eq=False)
class StepConvergence:
    """Replays of one plan at halved steps."""

    steps: np.ndarray  # (L,) s, halved from one to the next
    ends: np.ndarray  # (L, nx) end states
    costs: np.ndarray  # (L,) J reached
    changes: np.ndarray  # (L-1,) Euclidean changes between successive end states, from which the order is observed
    shares: np.ndarray  # (L-1,) the same, the largest component relative to its path error bound
    nominal: float  # Order of the method of these replays
    observed: float | None  # Of the end state, over the last changes above rounding; None if there are none
    judged: str  # Why the order is not judged; "" if it is
    extrapolated_cost: float  # J at a step of zero
    cost_uncertainty: float  # Of the extrapolated cost
    end_uncertainty: float  # Of the end state, the largest component relative to its path error bound
    plan_cost: float  # Of the plan itself
    scale: float  # Reference of relative cost changes
    whole: bool  # Whether the whole cost is judged; False where its final part only penalizes judged goals

    @property
    def section(self) -> Section:
        """The change of the cost, judged; the order, judged for smooth machines only."""
        with np.errstate(all="ignore"):
            change = 100.0 * abs(self.extrapolated_cost - self.plan_cost) / self.scale
        steps = f"{self.steps[0]:.3g} to {self.steps[-1]:.3g} s"
        measured = [
            Measurement(
                "cost_change", change, "%", COST_BOUND if self.whole else None,
                f"plan {self.plan_cost:.6g}, extrapolated to a step of zero {self.extrapolated_cost:.6g} "
                f"+- {self.cost_uncertainty:.1e}",
            ),
            Measurement(
                "end_state_uncertainty", 100.0 * self.end_uncertainty, "%", None,
                f"of what passes of a path, of the extrapolated end, steps {steps}",
            ),
        ]  # fmt: skip
        if self.observed is not None:
            note = f"end state over halvings from {steps}, nominal {self.nominal:g}"
            measured.append(Measurement("observed_order", self.observed, "", None, note))
            bound = None if self.judged else ORDER_BOUND
            note = self.judged or "nominal order less the observed one; a smooth machine shows its integrator's order"
            measured.append(Measurement("order_shortfall", self.nominal - self.observed, "", bound, note))
        else:
            note = f"changes are below {_SEEN:g} at all steps from {steps}: no order can be seen"
            measured.append(Measurement("observed_order", np.nan, "", None, note))
        return Section("step convergence, open loop", tuple(measured))


def step_convergence(problem: Problem, run: Replay) -> StepConvergence:
    """Replay a plan open loop at halved steps, in the model of its refined replay."""
    plan, cost = run.plan, judged_cost(problem)
    integrator = getattr(problem.dynamics, "integrator", "rk4")
    refined_only = problem.requirements is not None and bool(problem.requirements.no_same_step)
    # Where a replay at the plan's own step is not informative, steps are halved from the refined replay's.
    own = getattr(problem.dynamics, "substeps", 1)
    count = LEVELS if own == 1 else LEVELS_OF_SUBSTEPS
    implicit = integrator_of(problem.dynamics).implicit
    if implicit:  # its order is not judged, and 16 substeps suffice
        count = 3
    least, count = (max(run.substeps // 2, 1), 3) if refined_only else (own, count)
    substeps = [least << k for k in range(count)]
    kind = "rk4" if refined_only or integrator not in KNOWN_INTEGRATORS else integrator
    why = _unjudged(run, problem)
    why = why or ("damping is faster than these steps, which hides the order" if implicit else "")
    why = why or ("" if kind == integrator else "the plan's own stage is none of MuJoCo's")
    if why and not implicit:  # MuJoCo's own steps tend to the same end, of lower order on rotations, 20 times faster
        kind = "rk4"
    nominal = float(KNOWN_INTEGRATORS[kind].order or 4)
    with np.errstate(all="ignore"):
        scale = cost.scale(plan, problem)
        enough = UNCERTAIN * COST_BOUND / 100.0 * scale if why else 0.0  # of the cost's uncertainty
        levels = [_level(run, problem, kind, count, exact=not why) for count in substeps]
        changes, observed = _observed_between(plan, levels)
        factor, uncertainty = _uncertainty(levels, nominal, observed)
        most = len(levels) if refined_only or implicit or (why and cost.final) else MAX_LEVELS
        while (
            len(levels) < most and 2 * substeps[-1] <= MAX_STAGE_STEPS
            and observed is not None and observed < nominal - ORDER_BOUND and not uncertainty <= enough
        ):  # fmt: skip
            substeps.append(2 * substeps[-1])
            levels.append(_level(run, problem, kind, substeps[-1], exact=not why))
            changes, observed = _observed_between(plan, levels)
            factor, uncertainty = _uncertainty(levels, nominal, observed)
        ends, costs = np.array([end for end, _ in levels]), np.array([cost for _, cost in levels])
        shares = shares_of_bounds(plan, plan.space.difference(ends[1:], ends[:-1]))
    return StepConvergence(
        steps=problem.dynamics.dt / np.array(substeps), ends=ends, costs=costs, changes=changes, shares=shares,
        nominal=nominal, observed=observed, judged=why,
        extrapolated_cost=float(costs[-1] + (costs[-1] - costs[-2]) / factor),
        cost_uncertainty=uncertainty, end_uncertainty=float(_SAFETY * shares[-1] / factor), plan_cost=plan.cost,
        scale=scale, whole=not cost.final,
    )  # fmt: skip


def _uncertainty(levels: list[tuple[np.ndarray, float]], nominal: float, observed: float | None) -> tuple[float, float]:
    """2^p - 1, and the uncertainty of the extrapolated cost."""
    factor = 2.0 ** (nominal if observed is None else min(max(observed, 0.5), nominal)) - 1.0
    return factor, float(_SAFETY * abs(levels[-1][1] - levels[-2][1]) / factor)


def _unjudged(run: Replay, problem: Problem) -> str:
    """Reason why a machine's trajectory shows no order of convergence, or ""."""
    if may_touch(run.compiled.model):
        return "contacts open and close: the order scatters"
    machine = capabilities_of(problem.dynamics)
    if machine.loops or (machine.mechanism is not None and machine.mechanism.couplings):
        return "MuJoCo's equalities are soft, by the square of its step"
    if machine.friction_loss:
        return "friction loss is cut off: the motion is not smooth"
    if machine.mechanism is not None and any(slack_tendons(machine.mechanism)):
        return "the spring of a tendon goes slack: the motion is not smooth"
    if machine.mechanism is not None and machine.mechanism.drags:
        return "drag is as the square of a speed, whose second derivative jumps where the motion turns"
    stopped = machine.mechanism is not None and reaches_stops(machine.mechanism, run.xs)
    return "a range is reached: the motion is not smooth" if run.reached or stopped else ""


def _observed_between(plan: Plan, levels: list[tuple[np.ndarray, float]]) -> tuple[np.ndarray, float | None]:
    """The changes (L-1,) between end states, and the observed order."""
    ends = np.array([end for end, _ in levels])
    changes = np.linalg.norm(plan.space.difference(ends[1:], ends[:-1]), axis=-1)
    return changes, _observed(changes)


def _observed(changes: np.ndarray) -> float | None:
    """The order over the last two changes that are above rounding; or over those a halving further, where it is higher.

    Coarse steps may not show the order yet, of a machine that swings fast at its end for example.
    """
    seen = np.flatnonzero(changes > _SEEN)
    if len(changes) < 2 or (np.isfinite(changes).all() and (len(seen) == 0 or seen[-1] == 0)):
        return None
    last = int(seen[-1]) if np.isfinite(changes).all() else len(changes) - 1
    observed = float(np.log2(changes[last - 1] / changes[last]))
    if last + 1 < len(changes) and changes[last + 1] > max(_MAY_BE_SEEN, changes[last] / _FASTEST):
        observed = max(observed, float(np.log2(changes[last] / changes[last + 1])))
    return observed if np.isfinite(observed) else 0.0


def _level(run: Replay, problem: Problem, integrator: str, substeps: int, exact: bool) -> tuple[np.ndarray, float]:
    """End state and cost of an open-loop replay with `substeps` steps per stage; `exact` as of advancing()."""
    plan, twin, model = run.plan, run.twin, run.compiled.copy()
    sound = run.integrator == "RK4" and not ((plan.space.quaternions and exact) or run.feedback or run.warnings)
    if integrator == "rk4" and substeps == run.substeps and sound:  # the refined replay itself, to the last bit
        xs = run.xs[::substeps]
        return xs[-1], problem.cost.value(xs, plan.us)
    advance = advancing(integrator, plan.dt / substeps, model, twin, plan.space, stage_damping(problem.dynamics), exact)
    assert advance is not None  # every integrator in KNOWN_INTEGRATORS is supported
    xs = np.empty_like(plan.xs)
    xs[0] = problem.x0
    with curves_acting(twin, model):
        for n, x in enumerate(advance(problem.x0, plan.us, substeps), 1):
            xs[n] = x
    return xs[-1], problem.cost.value(xs, plan.us)


NAME = "own_step_errors"
_ROUNDING = 1e-9  # of a stage or step
_WRITTEN = {"EULER": "Euler", "RK4": "RK4", "IMPLICIT": "implicit", "IMPLICITFAST": "implicitfast"}  # in a file


def own_step(plan: Plan, problem: Problem, run: Replay, goals: Sequence[GoalCheck]) -> list[Measurement]:
    """Errors at the file's own step, open loop and with gains, where that is not the step of a replay `run` in it.

    The first measurement counts the modes in which something is beyond its bound; its note says so, and by which option
    the file repeats the replay `run`. The controls are those of the stage at each time, and the gains act on the exact
    state at 500 Hz, or at every step of a coarser file. Shown, never judged: an error beyond the bounds of the path, or
    an unmet goal, is said in a line below the verdict.
    """
    compiled, dt = run.compiled, problem.dynamics.dt
    h = float(compiled.model.opt.timestep)
    M = math.ceil(plan.N * dt / h - _ROUNDING)
    integrator = load_mujoco().mjtIntegrator(compiled.model.opt.integrator).name.removeprefix("mjINT_")
    step = f"{h:.3g} s {_WRITTEN[integrator]}"
    if integrator == run.integrator and abs(h - run.timestep) <= _ROUNDING * h:
        return [Measurement(NAME, 0.0, "", None, f"none beside the above: your file's own step is {step}, too")]
    if M > MAX_STEPS:
        return [Measurement(NAME, 0.0, "", None, f"not simulated: {M} steps of {step}")]
    t = h * np.arange(M + 1)
    stage = np.minimum(np.floor(t / dt + _ROUNDING).astype(int), plan.N - 1)
    planned = _planned(plan, problem, t, stage)
    with_gains, open_loop = (
        _errors(plan, problem, _states(plan, compiled, integrator, t, stage, planned, gains), planned, t, goals)
        for gains in (True, False)
    )
    how = {"with gains": with_gains, "open loop": open_loop}
    bad = {mode: text for mode, (_, text) in how.items() if text}
    said = " and ".join(f"{mode} {text}" for mode, text in bad.items())
    said += "".join(f", not {mode}" for mode in how if bad and mode not in bad)
    note = (
        f"at your file's own step {step}: {said}; {_judged_by(run)}" if bad else f"none, at your file's own step {step}"
    )
    return [
        Measurement(NAME, float(len(bad)), "", None, note),
        *(
            Measurement(f"own_step_{mode.replace(' ', '_')}_{one.word}_error", one.value, one.unit, None,
                        f"of {one.name} from the plan, at any step of {step}, {mode}")
            for mode, (errors, _) in how.items() for one in errors
        ),
    ]  # fmt: skip


def _judged_by(run: Replay) -> str:
    """How the replay that was judged was simulated; MuJoCo's integrators as the file has them."""
    if run.integrator not in _WRITTEN:
        return f"it was judged at a step of {run.timestep:.3g} s"
    # up: a replay's steps are at most as long as the file's, and a step shorter by a digit would take one step more
    written = float(Context(prec=12, rounding=ROUND_CEILING).create_decimal(f"{run.timestep:.15g}"))
    option = f'`<option timestep="{written:.12g}" integrator="{_WRITTEN[run.integrator]}"/>`'
    return f"your file repeats it with {option}, by which it was judged"


def _planned(plan: Plan, problem: Problem, t: np.ndarray, stage: np.ndarray) -> np.ndarray:
    """(M+1, nx) the plan's states at times t (M+1,), by its own integrator over a part of a stage."""
    dt, end = problem.dynamics.dt, plan.N * problem.dynamics.dt
    knot = np.minimum(np.round(t / dt).astype(int), plan.N)
    at_knot = (np.abs(t - knot * dt) <= _ROUNDING * dt) | (t >= end)
    states = plan.xs[knot].copy()
    if not np.all(at_knot):
        n = stage[~at_knot]
        states[~at_knot] = problem.dynamics.step(plan.xs[n], plan.us[n], t[~at_knot] - n * dt)
    return states


def _states(
    plan: Plan, compiled: CompiledTwin, integrator: str, t: np.ndarray, stage: np.ndarray, planned: np.ndarray,
    gains: bool,
) -> np.ndarray:  # fmt: skip
    """(M+1, nx) simulated states."""
    model, twin = compiled.stepping(float(t[1]), integrator), compiled.twin
    each = max(1, round(PERIOD / float(t[1])))

    def corrected(i: int, w: np.ndarray) -> np.ndarray:
        x, n = twin.x_of(w), stage[i : min(i + each, len(t) - 1)]
        correction = plan.K[n[0]] @ plan.space.single_difference(x, planned[i])
        return compiled.commands(plan.within_bounds(n, plan.us[n] + correction))

    ctrl = compiled.commands(plan.us[stage[:-1]])
    with curves_acting(twin, model):
        w, _ = simulate(
            model, twin.sim_of(planned[0]), ctrl, control=corrected if gains else None, held=each, every=50
        )  # fmt: skip
    return twin.x_of(w)


def _errors(
    plan: Plan, problem: Problem, xs: np.ndarray, planned: np.ndarray, t: np.ndarray, goals: Sequence[GoalCheck]
) -> tuple[list, str]:
    """The largest error of each unit along the path, and a phrase about what is beyond its bound; "" for nothing."""
    errors = list(worst_by_unit(plan, plan.space.difference(xs, planned)))
    if problem.requirements is not None:
        return errors, ""  # a rule of its own judges replays alone
    judged = [one for one in errors if is_path_judged(plan, one.unit)]
    unmet = [one for one in misses("replayed", t, xs, tuple(goals)) if not one.passed]
    worst = max(judged, key=lambda one: one.share)
    if worst.share > 1.0:
        far = np.isfinite(worst.value)
        return errors, f"{worst.value:.2g} {worst.unit or 'in its unit'} off" if far else "the motion runs away"
    return errors, f"{unmet[0].value:.2g} {unmet[0].unit or 'in its unit'} from a goal" if unmet else ""
