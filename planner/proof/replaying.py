"""Run a plan in MuJoCo. Nothing here plans: MuJoCo computes every state of a replay from the MJCF text alone.

The simulator's step is refined: the smaller of dt/20 and the model's own timestep, and a whole fraction of the
plan's stage. A replay at the plan's own step agrees to rounding and proves nothing, since it repeats the plan's
integration error.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from planner.base.arguments import count, number, shown
from planner.base.errors import ModelError, PlannerError
from planner.base.gl import load_mujoco
from planner.model.mjcf.refuse import named
from planner.model.mjcf.text import is_text, model_tree
from planner.model.twin import Twin
from planner.problem.plan import Plan
from planner.proof.contact_history import ContactHistory, ContactRecorder
from planner.proof.curve_callback import curves_acting
from planner.proof.ranges import ranges_reached

REFINEMENT = 20  # simulator steps per stage, at least
MOST_STEPS = 5_000_000  # some minutes and 1 GB
RUNAWAY = 1e10  # what MuJoCo takes for an unstable simulation


@dataclass(frozen=True, eq=False)
class Replay:
    """What MuJoCo did with a plan's controls, sampled at every simulator step.

    Attributes:
        plan: The plan that was replayed.
        twin: The model it was replayed in.
        feedback: Whether the plan's gains acted.
        integrator: MuJoCo's integrator.
        t: (M+1,) s; M = N * substeps.
        qpos: (M+1, nq).
        qvel: (M+1, nv).
        act: (M+1, na).
        ctrl: (M, nu) what was applied.
        xs: (M+1, nx) the simulated state in the plan's coordinates.
        plan_xs: (M+1, nx) the plan at the same instants (between knots: its integrator over a part of the stage).
        contact_force: (M+1,) sum of the normal contact forces.
        contact_point: (M+1, 3) where it acts; NaN without contact.
        substeps: Simulator steps per stage of the plan.
        warnings: What MuJoCo complained of, one sentence each.
        reached: Ranges of joints and actuators that the motion reached, one sentence each.
        contacts: The force of each contact.
    """

    plan: Plan
    twin: Twin
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

    @property
    def timestep(self) -> float:
        """The simulator's step, s."""
        return float(self.t[1])

    @property
    def title(self) -> str:
        """What a section about this replay is called."""
        return "refined, feedback" if self.feedback else "refined, open loop"

    @property
    def error(self) -> np.ndarray:
        """(M+1, ndx) the deviation of the simulated state from the planned one."""
        return self.plan.space.difference(self.xs, self.plan_xs)

    @property
    def cost(self) -> float:
        """J of the simulated trajectory at the knots, with each stage's mean control; NaN without a problem."""
        if self.plan.problem is None:
            return math.nan
        us = self.ctrl.reshape(self.plan.N, self.substeps, -1).mean(axis=1)
        return self.plan.problem.cost.value(self.xs[:: self.substeps], us)


def compile_model(mjcf: str, assets: dict[str, bytes] | None = None) -> Any:
    """MuJoCo's model of an MJCF text and the files that it names.

    Raises:
        ModelError: MuJoCo refuses it; the message is MuJoCo's own, in one line.
    """
    mujoco = load_mujoco()
    try:
        return mujoco.MjModel.from_xml_string(mjcf, assets or {})
    except (ValueError, RuntimeError, mujoco.FatalError) as error:
        reason = " ".join(str(error).split()) or "it does not say why"
        stop = "" if reason.endswith((".", "!", "?")) else "."
        raise ModelError(f"MuJoCo refuses the model: {reason}{stop}") from None


def matching_model(twin: Twin, nu: int) -> Any:
    """The twin's MuJoCo model, when it fits its maps and a control of size nu.

    Raises:
        ModelError: The model has other joints, activations or controls than the twin maps.
    """
    model = compile_model(twin.mjcf, twin.assets)
    nw = twin.to_x.shape[1]
    have = (model.nq + model.nv + model.na, model.nu)
    if have != (nw, nu):
        raise ModelError(
            f"the model has nq + nv + na = {have[0]} states and {have[1]} controls, expected {nw} and {nu}: "
            "it is not the machine that the plan was made for."
        )
    kinds = load_mujoco().mjtDyn  # the same equation, which MuJoCo's RK4 integrates wrongly when asked for exactly
    model.actuator_dyntype[model.actuator_dyntype == int(kinds.mjDYN_FILTEREXACT)] = int(kinds.mjDYN_FILTER)
    return model


def with_model(twin: Twin, mjcf: str | Path | None) -> Twin:
    """A twin with another MJCF, a path or the XML text, in place of its own; with its own for None."""
    if mjcf is None:
        return twin
    root, files = model_tree(mjcf, twin.assets if is_text(mjcf) else None)  # a path brings its own meshes
    return replace(twin, mjcf=ElementTree.tostring(root, encoding="unicode"), assets=files)


@np.errstate(all="ignore")  # a motion may run away, and then it says so
def replay(
    plan: Plan,
    *,
    feedback: bool = False,
    twin: Twin | None = None,
    substeps: int | None = None,
    integrator: str = "RK4",
) -> Replay:
    """Replay a plan in MuJoCo at a refined step.

    Args:
        plan: What to replay.
        feedback: Apply u = us[n] + K[n] @ difference(x, x_plan(t)) at every simulator step instead of us[n].
        twin: Another model in place of the plan's own.
        substeps: Simulator steps per stage; by default so that the step is the smaller of dt/20 and the model's.
        integrator: MuJoCo's, "RK4" or "EULER", whatever the file says.

    Raises:
        PlannerError: The plan has no twin or is not finite, or feedback without the problem to interpolate it.
        ModelError: MuJoCo refuses the model, or it does not fit the plan.
    """
    if not isinstance(plan, Plan):
        raise PlannerError(f"plan is {shown(plan)}, expected a Plan.")
    twin = twin or plan.twin
    if twin is None:
        raise PlannerError("the plan has no MuJoCo model to be replayed in, expected a Problem with a twin.")
    if plan.problem is None:
        raise PlannerError("the plan comes without its problem, expected a plan of planner.cases or one just solved.")
    for name, values in (("states xs", plan.xs), ("controls us", plan.us), ("gains K", plan.K)):
        if not np.isfinite(values).all():
            raise PlannerError(f"the plan has {name} that are not finite, expected finite numbers.")
    model = matching_model(twin, plan.us.shape[1])
    dt = plan.problem.dynamics.dt
    if substeps is None:
        step = number("the model's timestep", model.opt.timestep, above=0.0)
        substeps = max(REFINEMENT, math.ceil(min(dt / step, 1e12) - 1e-9))
    n = count("substeps", substeps)
    if n * plan.N > MOST_STEPS:
        raise PlannerError(
            f"the replay would take {n * plan.N} steps of {dt / n:.3g} s, expected at most {MOST_STEPS}."
        )
    model.opt.timestep = dt / n
    model.opt.integrator = getattr(load_mujoco().mjtIntegrator, f"mjINT_{integrator}")
    with curves_acting(twin, model):
        return _run(plan, twin, model, feedback, n)


def _run(plan: Plan, twin: Twin, model: Any, feedback: bool, substeps: int) -> Replay:
    mujoco = load_mujoco()
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET  # a state that runs away is not to begin anew
    data = mujoco.MjData(model)
    nq, nv, M = model.nq, model.nv, plan.N * substeps
    plan_xs = plan.between_knots(substeps)
    w = np.full((M + 1, nq + nv + model.na), np.nan)
    ctrl = np.repeat(plan.us, substeps, axis=0)
    recorder = ContactRecorder(model, M)
    assert plan.problem is not None  # replay has checked
    w[0] = twin.sim_of(plan.problem.x0)  # the problem's start, not what the plan says of it
    data.qpos[:], data.qvel[:], data.act[:] = np.split(w[0], [nq, nq + nv])
    for i in range(M):
        if feedback:
            asked = ctrl[i] + plan.K[i // substeps] @ plan.space.difference(twin.x_of(w[i]), plan_xs[i])
            ctrl[i] = plan.within_bounds(i // substeps, asked)
        data.ctrl[:] = ctrl[i]
        recorder.look(i, data)
        mujoco.mj_step(model, data)
        w[i + 1, :nq], w[i + 1, nq : nq + nv], w[i + 1, nq + nv :] = data.qpos, data.qvel, data.act
        if i % substeps == 0 and not np.all(np.abs(w[i + 1]) < RUNAWAY):
            break
    unstable = unstable_at(model, w)
    if not unstable:
        recorder.look(M, data)
    t = model.opt.timestep * np.arange(M + 1)
    reached = ranges_reached(model, t, w, ctrl, stopped_dofs(plan))
    surprise = "" if knows_contacts(plan) else recorder.sentence(model.opt.timestep)
    return Replay(
        plan=plan, twin=twin, feedback=feedback, integrator=mujoco.mjtIntegrator(model.opt.integrator).name[6:],
        t=t, qpos=w[:, :nq], qvel=w[:, nq : nq + nv], act=w[:, nq + nv :], ctrl=ctrl, xs=twin.x_of(w),
        plan_xs=plan_xs, contact_force=recorder.force, contact_point=recorder.point, substeps=substeps,
        warnings=(*unstable, *warnings_of(mujoco, data)), reached=(*reached, *([surprise] if surprise else [])),
        contacts=recorder.history(t),
    )  # fmt: skip


def unstable_at(model: Any, w: np.ndarray, start: float = 0.0) -> tuple[str, ...]:
    """Where and when the states w (M+1, nq + nv + na) ran away, in a sentence, and NaN from there; else nothing."""
    with np.errstate(invalid="ignore"):
        bad = ~(np.abs(w) < RUNAWAY)
    if not bad.any():
        return ()
    first = int(np.argmax(bad.any(axis=1)))
    w[first:] = np.nan
    dofs = np.flatnonzero(bad[first, model.nq : model.nq + model.nv])
    where = f" at {named(model, 'joint', int(model.dof_jntid[dofs[0]]))}" if len(dofs) else ""
    return (f"MuJoCo's simulation became unstable{where} at t = {start + first * model.opt.timestep:.4g} s.",)


def knows_contacts(plan: Plan) -> bool:
    """Whether a plan's dynamics may have contacts; a mechanism's are all that its model has, or none."""
    mechanism = getattr(getattr(plan.problem, "dynamics", None), "mechanism", None)
    return mechanism is None or bool(mechanism.contacts or mechanism.body_contacts)


def stopped_dofs(plan: Plan) -> frozenset[int]:
    """The degrees of freedom whose ends of range are part of a plan's dynamics."""
    mechanism = getattr(getattr(plan.problem, "dynamics", None), "mechanism", None)
    return frozenset(stop.dof for stop in mechanism.stops) if mechanism is not None else frozenset()


def warnings_of(mujoco: Any, data: Any) -> tuple[str, ...]:
    """MuJoCo's own warnings, e.g. about an unstable simulation."""
    kinds = mujoco.mjtWarning
    names = [kinds(k).name[7:].lower() for k in range(int(kinds.mjNWARNING))]
    return tuple(
        f"MuJoCo warned of {name} {data.warning[k].number} times." for k, name in enumerate(names)
        if data.warning[k].number
    )  # fmt: skip
