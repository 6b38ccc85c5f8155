"""Run a plan in MuJoCo. Nothing here plans: MuJoCo computes every state of a replay from the MJCF text alone.

The simulator's step is refined: the smallest of dt/20, a fifth of a plan's substep and the model's own timestep, and a
whole fraction of the plan's stage. A replay at the plan's own step agrees to rounding and proves nothing, since it
repeats the plan's integration error.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from planner.base.arguments import count, number, short_repr
from planner.base.errors import PlannerError
from planner.base.gl import load_mujoco
from planner.base.late_imports import Renderable
from planner.model.mjcf.model_index import contact_pairs, named
from planner.model.twin import Twin
from planner.problem.plan import Plan
from planner.problem.problem import Problem
from planner.proof.replays.compiled_twin import CompiledTwin
from planner.proof.replays.contact_history import ContactHistory, ContactRecorder, Touch
from planner.proof.replays.passive_torque_callback import curves_acting
from planner.proof.replays.ranges import ranges_reached
from planner.proof.replays.sampled_gains import Gains, Sampling
from planner.proof.replays.simulation import MAX_STEPS, ROSENBROCK, Step, damping_of, implicit_step, simulate

REFINEMENT = 20  # minimum number of simulator steps per stage
PARTS = 8  # of a step with implicit damping: the error after a control jump is then at most 1e-3 of it, for any damping
SUBSTEP_REFINEMENT = 5  # minimum simulator steps per substep, for RK4's stability in the plan's fastest mode


@dataclass(frozen=True, eq=False)
class Replay(Renderable):
    """MuJoCo's trajectory under a plan's controls, sampled at every simulator step.

    Attributes:
        plan: The plan that was replayed.
        compiled: The model it was replayed in.
        feedback: Whether the plan's gains acted.
        integrator: MuJoCo's, or "rosenbrock".
        t: (M+1,) s; M = N * substeps.
        qpos: (M+1, nq).
        qvel: (M+1, nv).
        act: (M+1, na).
        ctrl: (M, nu) applied controls.
        xs: (M+1, nx) the simulated state in the plan's coordinates.
        plan_xs: (M+1, nx) the plan at the same instants (between knots: its integrator over a part of the stage).
        contact_force: (M+1,) sum of the normal contact forces.
        contact_point: (M+1, 3) application point of that force; NaN without contact.
        substeps: Simulator steps per stage of the plan.
        warnings: MuJoCo's warnings, one sentence each.
        reached: Ranges of joints and actuators that the trajectory reached, one sentence each.
        contacts: The force of each contact.
        sampling: When the gains acted; None for ideal gains, at every simulator step.
        touches: Pairs of geoms in contact, onset and depth.
    """

    plan: Plan
    compiled: CompiledTwin
    feedback: bool
    integrator: str
    t: np.ndarray
    qpos: np.ndarray
    qvel: np.ndarray
    act: np.ndarray
    ctrl: np.ndarray
    xs: np.ndarray
    plan_xs: np.ndarray
    contact_force: np.ndarray
    contact_point: np.ndarray
    substeps: int
    warnings: tuple[str, ...] = ()
    reached: tuple[str, ...] = ()
    contacts: ContactHistory = field(default_factory=ContactHistory.none)
    sampling: Sampling | None = None
    contact_extremes: tuple[Touch, ...] = ()

    def __repr__(self) -> str:
        mode = "feedback" if self.feedback else "open loop"
        return f"Replay({mode}, {len(self.ctrl)} steps of {self.timestep:.4g} s)"

    @property
    def twin(self) -> Twin:
        """The text of the model, and the maps between its state and the plan's."""
        return self.compiled.twin

    @property
    def timestep(self) -> float:
        """The simulator's step, s."""
        return float(self.t[1])

    @property
    def title(self) -> str:
        """Title of the proof's section about this replay."""
        return "refined, feedback" if self.feedback else "refined, open loop"

    @property
    def pushes(self) -> tuple[Any, ...]:
        """The proof.robustness.perturbation.Push that acted; none on a replay of a plan."""
        return ()

    @property
    def error(self) -> np.ndarray:
        """(M+1, ndx) the deviation of the simulated state from the planned one."""
        return self.plan.space.difference(self.xs, self.plan_xs)

    @property
    def stage_controls(self) -> np.ndarray:
        """(N, nu) the mean control of each stage."""
        return self.ctrl.reshape(self.plan.N, self.substeps, -1).mean(axis=1)

    @property
    def cost(self) -> float:
        """J of the simulated trajectory at the knots, with each stage's mean control; NaN without a problem."""
        if self.plan.problem is None:
            return math.nan
        return self.plan.problem.cost.value(self.xs[:: self.substeps], self.stage_controls)


def replay(
    plan: Plan, *, feedback: bool = False, twin: Twin | None = None, substeps: int | None = None,
    integrator: str | None = None, sampling: Sampling | None = None,
) -> Replay:  # fmt: skip
    """Replay a plan in MuJoCo at a refined step.

    Args:
        plan: The plan to replay.
        feedback: Apply u = us[n] + K[n] @ difference(x, x_plan(t)) at every simulator step instead of us[n].
        twin: Another model in place of the plan's own.
        substeps: Simulator steps per stage; by default so that the step is the smallest of dt/20, a fifth of a
            substep and the model's.
        integrator: MuJoCo's, "RK4" or "EULER", whatever the file says. None is RK4 or, where the plan takes damping
            implicitly, its own method with MuJoCo's accelerations.
        sampling: Sampled feedback, as of a controller, instead of feedback at every simulator step.

    Raises:
        PlannerError: The plan has no twin or is not finite, feedback without the problem to interpolate it, or a
            sampling whose instants fall between the simulator's steps.
        ModelError: MuJoCo refuses the model, or it does not fit the plan.
    """
    if not isinstance(plan, Plan):
        raise PlannerError(f"plan is {short_repr(plan)}, expected a Plan.")
    compiled = CompiledTwin(twin or twin_of(plan))
    return replay_in(compiled, plan, feedback=feedback, substeps=substeps, integrator=integrator, sampling=sampling)


@np.errstate(all="ignore")  # a trajectory may diverge, which is reported
def replay_in(
    compiled: CompiledTwin, plan: Plan, *, feedback: bool = False, substeps: int | None = None,
    integrator: str | None = None, sampling: Sampling | None = None, planned: np.ndarray | None = None,
    contacts: bool = True,
) -> Replay:  # fmt: skip
    """replay() in a compiled model; `planned` is plan_xs of another replay, reused if its shape fits.

    Without `contacts` those that the plan knows of act but are not recorded, which is several times faster.
    """
    problem = problem_of(plan)
    compiled.check(plan.us.shape[1])
    dt, explicit = problem.dynamics.dt, damping_of(problem.dynamics) is None
    integrator = integrator or ("RK4" if explicit else ROSENBROCK)
    sampling = sampling if feedback else None
    parts = 1 if sampling is None else sampling.in_stages(dt).denominator  # steps per stage are a multiple
    if substeps is None:
        step = number("the model's timestep", compiled.model.opt.timestep, greater_than=0.0)
        own = int(getattr(problem.dynamics, "substeps", 1)) if explicit else 1
        least = max(REFINEMENT, SUBSTEP_REFINEMENT * own)
        substeps = max(least, math.ceil(min(dt / step, 1e12) - 1e-9))
        substeps += -substeps % parts
    n = count("substeps", substeps)
    if n % parts:
        raise PlannerError(f"substeps is {n}, expected a multiple of {parts}: instants fall on ends of steps.")
    M = n * plan.N
    if M > MAX_STEPS:
        raise PlannerError(f"the replay would take {M} steps of {dt / n:.3g} s, expected at most {MAX_STEPS}.")
    twin, model = compiled.twin, compiled.stepping(dt / n, integrator)
    plan_xs = planned if planned is not None and len(planned) == M + 1 else plan.between_knots(n)
    recorder = ContactRecorder(model, M, records=None if contacts or not knows_contacts(plan) else False)
    ctrl = compiled.commands(np.repeat(plan.us, n, axis=0))

    gains = Gains(plan, compiled, model, plan_xs, n, sampling) if feedback else None

    def with_gains(i: int, w: np.ndarray) -> np.ndarray:
        assert gains is not None
        return compiled.commands(gains(i, w))

    start = twin.sim_of(problem.x0)  # from the problem, not from the plan
    with curves_acting(twin, model):
        w, warnings = simulate(
            model, start, ctrl, control=with_gains if gains else None, held=gains.held if gains else 1,
            recorder=recorder, every=n, step=step_of(plan, model, integrator),
        )  # fmt: skip
    t = model.opt.timestep * np.arange(M + 1)
    qpos, qvel, act = np.split(w, [model.nq, model.nq + model.nv], axis=1)
    surprise = "" if knows_contacts(plan) else recorder.sentence(model.opt.timestep)
    return Replay(
        plan=plan, compiled=compiled, feedback=feedback, integrator=integrator, t=t, qpos=qpos, qvel=qvel, act=act,
        ctrl=ctrl[:, compiled.controls], xs=twin.x_of(w), plan_xs=plan_xs, contact_force=recorder.force,
        contact_point=recorder.point, substeps=n, warnings=warnings,
        reached=(*ranges_reached(model, t, w, ctrl, stopped_dofs(plan)), *([surprise] if surprise else [])),
        contacts=recorder.history(t), sampling=sampling, contact_extremes=recorder.contact_extremes,
    )  # fmt: skip


def step_of(plan: Plan, model: Any, integrator: str) -> Step | None:
    """A step of a model by the Rosenbrock method, for a plan with implicit damping; None for MuJoCo's own methods."""
    damping = damping_of(problem_of(plan).dynamics)
    if integrator != ROSENBROCK or damping is None:
        return None
    return implicit_step(model, model.opt.timestep, damping, PARTS)


def twin_of(plan: Plan) -> Twin:
    """The twin of a plan; raises if it has none."""
    if plan.twin is None:
        raise PlannerError(
            "the plan has no MuJoCo model to be replayed in, expected a Problem with a twin: of an MJCF file of the "
            "same machine, Problem(..., twin=planner.Twin.of(planner.Mechanism.from_mjcf(path)))."
        )
    return plan.twin


def problem_of(plan: Plan) -> Problem:
    """The problem of a plan; raises if the plan cannot be simulated."""
    if plan.problem is None:
        raise PlannerError("the plan comes without its problem, expected a plan of planner.cases or one just solved.")
    for name, values in (("states xs", plan.xs), ("controls us", plan.us), ("gains K", plan.K)):
        if not np.isfinite(values).all():
            raise PlannerError(f"the plan has {name} that are not finite, expected finite numbers.")
    return plan.problem


def _mechanism(plan: Plan) -> Any:
    return getattr(getattr(plan.problem, "dynamics", None), "mechanism", None)


def knows_contacts(plan: Plan) -> bool:
    """Whether a plan's dynamics model contacts; a mechanism models all contacts of its model, or none."""
    mechanism = _mechanism(plan)
    return mechanism is None or bool(mechanism.contacts or mechanism.body_contacts)


def stopped_dofs(plan: Plan) -> frozenset[int]:
    """The degrees of freedom whose joint stops are part of a plan's dynamics."""
    return frozenset(stop.dof for stop in getattr(_mechanism(plan), "stops", ()))


def reached_by_plan(run: Replay) -> tuple[str, ...]:
    """The sentences of a replay's `reached` that also apply at the plan's own knots.

    A replay that deviates from the plan may reach any range, as an effect of the deviation.
    """
    if not run.reached:
        return ()
    mujoco, plan = load_mujoco(), run.plan
    model, w = run.compiled.model, run.twin.sim_of(plan.xs)
    ranges = ranges_reached(model, plan.t, w, plan.us, stopped_dofs(plan))
    if plan.problem is None or knows_contacts(plan):
        return ranges
    data = mujoco.MjData(model)
    for t, state in zip(plan.t, w, strict=True):
        data.qpos[:] = state[: model.nq]
        mujoco.mj_fwdPosition(model, data)
        if data.ncon:
            return (*ranges, f"shapes touch at t = {t:.4g} s.")
    return ranges


def proven_cost(plan: Plan) -> float:
    """The cost in MuJoCo at the refined step, with the plan's gains or open loop, whichever is lower.

    Plans are run with their gains, or open loop if that costs less. Thread-safe. For solve(..., rank=proven_cost).

    Args:
        plan: A plan of a problem with a twin.

    Returns:
        The cost; infinite if the plan is not finite, or both replays diverge or give MuJoCo warnings.

    Raises:
        PlannerError: No plan of this problem can be replayed: it has no twin, or too many steps.
    """
    if not all(np.isfinite(part).all() for part in (plan.xs, plan.us, plan.K)):
        return math.inf
    with np.errstate(all="ignore"):  # of a diverging replay
        runs = [replay(plan, feedback=feedback) for feedback in (True, False)]
        costs = [run.cost for run in runs if not run.warnings]
    return min((cost for cost in costs if math.isfinite(cost)), default=math.inf)


FASTER = 2.0  # ratio of the largest speed within a stage to the mean one, at most
MAX_PARTS = 200  # of one step
SEEN_DEPTH = 0.5  # of the thinner shape's half thickness: contacts that a step sees are shallower, or last longer


def passages(run: Replay) -> list[str]:
    """A sentence for each pair of geoms that passes through each other between two steps, unseen by MuJoCo's contacts.

    Two shapes whose half thicknesses add up to d overlap over a way of 2 d where one passes through the other. A step
    that moves them further than d relative to each other may jump over that. Such steps are repeated in parts of d / 2
    along the line from one state to the next, with the distances of the shapes. Planes and height fields have no other
    side.
    """
    model, mujoco = run.compiled.model, load_mujoco()
    pairs = np.array(contact_pairs(model), dtype=int).reshape(-1, 2)
    half = _half_thickness(model)
    pairs = pairs[np.isfinite(half[pairs]).all(axis=1)]
    if not len(pairs) or not np.isfinite(run.qpos).all():
        return []
    data, found = mujoco.MjData(model), []
    for pair, stages in _fast_and_near(run, pairs, half):
        thin, at = half[pair].sum(), None
        for i in (step for stage in stages for step in range(stage * run.substeps, (stage + 1) * run.substeps)):
            depths = _depths(model, data, pair, run.qpos[i], run.qpos[i + 1], run.timestep, 0.5 * thin)
            if len(depths) > 2 and max(depths[0], depths[-1]) <= 0.0 and depths.max() > SEEN_DEPTH * half[pair].min():
                at = i if at is None else at
        if at is not None:
            names = " and ".join(named(model, "geom", int(geom)) for geom in pair)
            found.append(f"{names} pass through each other at t = {run.t[at]:.4g} s, between two steps of MuJoCo.")
    return found


def _half_thickness(model: Any) -> np.ndarray:
    """(ngeom,) m, of each shape where it is thinnest; infinite for one without another side."""
    kinds = load_mujoco().mjtGeom
    half = model.geom_aabb[:, 3:].min(axis=1)
    return np.where(np.isin(model.geom_type, [int(kinds.mjGEOM_PLANE), int(kinds.mjGEOM_HFIELD)]), np.inf, half)


def _fast_and_near(run: Replay, pairs: np.ndarray, half: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """The pairs (2,) that may meet on some stages and move further in a step than they are thick, and these stages."""
    model, mujoco = run.compiled.model, load_mujoco()
    data, knots = mujoco.MjData(model), run.qpos[:: run.substeps]
    places, turns = np.empty((len(knots), model.ngeom, 3)), np.empty((len(knots), model.ngeom, 3, 3))
    for n, q in enumerate(knots):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        places[n], turns[n] = data.geom_xpos, data.geom_xmat.reshape(-1, 3, 3)
    chord = np.sqrt(np.maximum(3.0 - np.einsum("ngij,ngij->ng", turns[1:], turns[:-1]), 0.0))  # of the turn
    swing = np.pi / 2.0 * chord * model.geom_rbound
    for pair in pairs:
        apart = places[:, pair[0]] - places[:, pair[1]]
        way = np.linalg.norm(np.diff(apart, axis=0), axis=1) + swing[:, pair].sum(axis=1)
        gap = np.linalg.norm(apart, axis=1) - model.geom_rbound[pair].sum()
        near = np.minimum(gap[:-1], gap[1:]) < FASTER * way
        stages = np.flatnonzero(near & (FASTER * way / run.substeps > half[pair].sum()))
        if len(stages):
            yield pair, stages


def _depths(
    model: Any, data: Any, pair: np.ndarray, q: np.ndarray, after: np.ndarray, h: float, part: float
) -> np.ndarray:
    """Depths, m, of two geoms in each other at equal parts of a step from q to `after` (nq,); the first alone if far.

    A part moves the two at most `part` relative to each other, m.
    """
    mujoco, velocity, between = load_mujoco(), np.empty(model.nv), np.empty(model.nq)
    mujoco.mj_differentiatePos(model, velocity, h, q, after)

    def placed(share: float) -> tuple[np.ndarray, np.ndarray, float]:
        between[:] = q
        mujoco.mj_integratePos(model, between, velocity, share * h)
        data.qpos[:] = between
        mujoco.mj_kinematics(model, data)
        distance = mujoco.mj_geomDistance(model, data, int(pair[0]), int(pair[1]), 10.0, None)
        return data.geom_xpos[pair].copy(), data.geom_xmat[pair].reshape(2, 3, 3).copy(), -float(distance)

    (x, R, first), (y, S, last) = placed(0.0), placed(1.0)
    chord = np.sqrt(np.maximum(3.0 - np.einsum("gij,gij->g", R, S), 0.0))
    way = np.linalg.norm((y[0] - y[1]) - (x[0] - x[1])) + np.pi / 2.0 * float(chord @ model.geom_rbound[pair])
    if min(-first, -last) > way:
        return np.array([first])
    parts = int(np.clip(np.ceil(way / part), 1, MAX_PARTS))
    return np.array([first, *(placed(k / parts)[2] for k in range(1, parts)), last])
