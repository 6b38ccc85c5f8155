"""Step 1 of a proof, parity: the plan's dynamics and MuJoCo's, at random states where the two models are the same.

A mechanism is compared term by term (rigid_parity), then its friction loss and its contacts.

Friction loss is the same function of velocity and acceleration in both (planner.dynamics.joint_forces), but the plan's
is smoothed where MuJoCo's saturates. So at MuJoCo's acceleration they agree to rounding in all joints that clearly
stick or slip; in the smoothed range the difference is reported, not judged.

A machine with prescribed joints is compared twice. First with a moderate armature in place of the large armature H
of its prescribed joints (planner.model.mjcf.prescribed_joints), which would hide a wrong mass. Then as in a replay:
motors of its prescribed joints reach

    a_p = u - tau_p / H

for prescribed accelerations u and their joint forces tau_p, so MuJoCo's accelerations equal those of the plan's
dynamics at the controls a_p, to rounding. The difference u - a_p is reported too.
"""

from __future__ import annotations

import copy
from collections.abc import Collection, Iterator
from dataclasses import replace
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from planner.base.arguments import short_repr
from planner.base.errors import ModelError, PlannerError
from planner.base.gl import load_mujoco
from planner.base.measured import Measurement, Section
from planner.dynamics import algorithms as rigid_body
from planner.dynamics.joint_forces import BEND, friction_forces
from planner.dynamics.rigid_body import RigidBodyDynamics
from planner.model.capabilities import capabilities_of
from planner.model.mechanism import Mechanism
from planner.model.mjcf.prescribed_joints import PRESCRIBED_ARMATURE, prescribed_dofs, with_force_inputs
from planner.model.mjcf.read import mechanism_of_model
from planner.model.twin import Twin
from planner.problem.problem import Problem, Requirements
from planner.proof.compare.constrained import constrained_acceleration
from planner.proof.compare.contact_parity import contact_parity
from planner.proof.compare.differences import differences
from planner.proof.compare.rigid_parity import random_states, rigid_parity, rounded, unlimited
from planner.proof.replays.compiled_twin import CompiledTwin, another_model, with_model
from planner.proof.replays.passive_torque_callback import curves_acting
from planner.proof.replays.simulation import set_state

STATES = 256
BOUND = 1e-10  # relative; rounding is 1e-13

# Cache of the last comparison of each problem: twin, seed, result.
_last: WeakKeyDictionary[Problem, tuple[Twin, int, Section]] = WeakKeyDictionary()

_NOTHING = Section("parity", not_applicable="the problem names no states at which the two models are the same")


def parity(machine: Problem | Mechanism, mjcf: Any = None, *, twin: Twin | None = None, seed: int = 0) -> Section:
    """Compare a machine's dynamics with MuJoCo's at random states, before or after planning.

    A mechanism is compared term by term (mass matrix, bias force, actuator force, acceleration), and a term that
    differs names its joint; where joints are prescribed, see driven_parity. Other dynamics are compared by dx/dt where
    the problem's requirements say so.

    Args:
        machine: A mechanism, or a problem.
        mjcf: Compare with this MJCF (a path, the XML text or a mujoco.MjSpec) instead of the machine's own.
        twin: Compare with this model instead of the problem's own.
        seed: Seed of the random states.

    Raises:
        PlannerError: There is no MuJoCo model to compare with.
        ModelError: MuJoCo refuses the model, or it has other joints, actuators or states.
    """
    if isinstance(machine, Mechanism):
        return _of_mechanism(machine, None, CompiledTwin(with_model(twin or Twin.of(machine), mjcf)), seed)
    if not isinstance(machine, Problem):
        raise PlannerError(f"parity() was given {short_repr(machine)}, expected a Mechanism or a Problem.")
    twin = twin or machine.twin
    if twin is None:
        if _nothing_to_compare(machine):
            return _NOTHING
        raise PlannerError("the problem has no MuJoCo model to be compared with, expected a twin.")
    prescribed = getattr(machine.dynamics, "prescribed", ())
    compiled = another_model(machine, twin, mjcf) if prescribed else CompiledTwin(with_model(twin, mjcf))
    return parity_in(compiled, machine, seed)


def parity_in(compiled: CompiledTwin, problem: Problem, seed: int = 0) -> Section:
    """parity() of a problem in a compiled model; the last comparison of each problem is cached.

    `planner run` compares before planning, and the proof requests the same comparison.
    """
    if _nothing_to_compare(problem):
        return _NOTHING
    last = _last.get(problem)
    if last is not None and last[0] is compiled.twin and last[1] == seed and not compiled.is_changed:
        return last[2]
    smooth = _smooth_parity(compiled, problem, seed)
    section = replace(smooth, measured=(*smooth.measured, *contact_parity(problem, compiled, seed)))
    if not compiled.is_changed:
        _last[problem] = compiled.twin, seed, section
    return section


def _smooth_parity(compiled: CompiledTwin, problem: Problem, seed: int) -> Section:
    """Parity of everything but contacts and joint stops."""
    requirements, dynamics = problem.requirements, problem.dynamics
    mechanism, prescribed = capabilities_of(dynamics).mechanism, getattr(dynamics, "prescribed", ())
    if requirements is not None and requirements.rates is not None:
        return _of_rates(problem, requirements, compiled, seed)
    assert mechanism is not None  # the caller has excluded other dynamics
    if not prescribed:
        return _of_mechanism(mechanism, dynamics, compiled, seed)
    model = compiled.copy()
    with curves_acting(compiled.twin, model):
        return driven_parity(mechanism, prescribed, model, STATES, BOUND, seed)


def _nothing_to_compare(problem: Problem) -> bool:
    mechanism, requirements = capabilities_of(problem.dynamics).mechanism, problem.requirements
    return mechanism is None and (requirements is None or requirements.rates is None)


def _of_mechanism(mechanism: Mechanism, dynamics: Any, compiled: CompiledTwin, seed: int) -> Section:
    model = compiled.copy()
    with curves_acting(compiled.twin, model):
        smooth = rigid_parity(mechanism, model, dynamics, STATES, BOUND, seed)
    friction = friction_parity(mechanism, compiled.copy(), STATES, BOUND, seed)
    return replace(smooth, measured=(*smooth.measured, *friction))


def _of_rates(problem: Problem, requirements: Requirements, compiled: CompiledTwin, seed: int) -> Section:
    """Parity of dx/dt at the states in the problem's requirements."""
    mujoco = load_mujoco()
    compiled.check(problem.dynamics.nu)
    twin, model = compiled.twin, compiled.model
    data = mujoco.MjData(model)
    assert requirements.equal_states is not None  # requirements set both or neither
    assert requirements.rates is not None
    rng = np.random.default_rng(seed)
    ws = requirements.equal_states(rng, STATES)
    us = rng.normal(size=(STATES, problem.dynamics.nu))
    ours = requirements.rates(twin.x_of(ws), us)
    theirs = np.empty_like(ours)
    for i, w in enumerate(ws):
        set_state(model, data, w)
        data.ctrl[:] = us[i]
        with curves_acting(twin, model):
            mujoco.mj_forward(model, data)
        theirs[i] = twin.to_x @ np.concatenate([data.qvel, data.qacc, data.act_dot])
    error = np.abs(theirs - ours).max(axis=0) / np.maximum(np.abs(ours).max(axis=0), 1e-300)
    note = f"dx/dt at {STATES} random states (seed {seed}), relative to the largest"
    measured = (Measurement("rate_error", float(error.max()), "", BOUND, note),)
    start = (_start(problem, twin, model, requirements.start),) if requirements.start else ()
    return Section("parity", (*measured, *start))


def _start(problem: Problem, twin: Twin, model: Any, name: str) -> Measurement:
    """Compare a keyframe of the model with the plan's start."""
    note = f"keyframe {name!r} of the model against the plan's start, largest component"
    key = next((k for k in range(model.nkey) if model.key(k).name == name), None)
    if key is None:
        return Measurement("start_error", np.inf, "", BOUND, note)
    w = np.concatenate([model.key_qpos[key], model.key_qvel[key], model.key_act[key]])
    error = float(np.max(np.abs(w - twin.sim_of(problem.x0))))
    return Measurement("start_error", error, "", BOUND, note)


_SPEEDS = np.geomspace(1e-4, 1.0, 8)  # of random velocities and accelerations: some joints stick, some slip


def friction_parity(mechanism: Mechanism, model: Any, states: int, bound: float, seed: int) -> Iterator[Measurement]:
    """Compare friction at random states, `bound` relative to the loss; empty where neither model has friction.

    The model's contacts, ranges and equalities are disabled.
    """
    read = mechanism_of_model(model)
    losses = np.maximum(mechanism.friction_loss, read.friction_loss)
    rubs = np.flatnonzero(losses)
    if not len(rubs):
        return
    mujoco, rng, model = load_mujoco(), np.random.default_rng(seed), copy.copy(model)
    bits = mujoco.mjtDisableBit
    model.opt.disableflags |= bits.mjDSBL_CONTACT | bits.mjDSBL_LIMIT | bits.mjDSBL_EQUALITY
    xs, data = random_states(mechanism, rng, states), mujoco.MjData(model)
    qd, qdd = xs[:, mechanism.nq : mechanism.nq + mechanism.nv], rng.normal(size=(states, mechanism.nv))
    for part in (qd, qdd):
        part *= np.resize(_SPEEDS, states)[:, None]
    theirs = np.zeros((states, mechanism.nv))
    for forces, x, a in zip(theirs, xs, qdd, strict=True):
        set_state(model, data, x)
        data.qacc[:] = a
        mujoco.mj_inverse(model, data)
        which = data.efc_type == mujoco.mjtConstraint.mjCNSTR_FRICTION_DOF
        forces[data.efc_id[which]] = data.efc_force[which]
    loss = losses[rubs]
    x = mechanism.friction_inertia[rubs] * (qdd + mechanism.friction_rate * qd)[:, rubs] / loss
    off, bent = np.abs(friction_forces(mechanism, qd, qdd)[0] - theirs), np.abs(np.abs(x) - 1.0) < BEND
    beside, difference = np.delete(off, rubs, axis=1).max(initial=0.0), off[:, rubs] / loss
    of = f"of {len(rubs)} degrees of freedom at {states} random states (seed {seed}), relative to the loss"
    held, slides = (np.abs(x) < 1.0) & ~bent, (np.abs(x) > 1.0) & ~bent
    note = f"held {held.sum()} times and sliding {slides.sum()} times, {of}"
    error = float(max(difference[~bent].max(initial=0.0), beside))
    if not error <= bound and (named := differences(mechanism, read)):
        note = f"{named}, {note}"
    yield Measurement("friction_loss_error", error, "", bound, note)
    note = f"between, where MuJoCo's is cut off and the plan's bends, {of}"
    yield Measurement("friction_loss_bend", float(difference[bent].max(initial=0.0)), "", None, note)


_ROUNDS = 3  # of the fixed-point iteration of u - tau(u) / H; each reduces the error H times


def driven_parity(
    mechanism: Mechanism, prescribed: Collection[str], model: Any, states: int, bound: float, seed: int
) -> Section:
    """Compare a mechanism with prescribed joints with the MuJoCo model whose motors move them.

    The model's ranges and contacts are disabled; `bound` is the largest relative error that passes.
    """
    dofs, free = prescribed_dofs(mechanism, prescribed), with_force_inputs(mechanism, prescribed)
    inertias = rigid_body.mass_matrix(free, mechanism.qpos0).diagonal()
    armature = free.armature.copy()
    armature[dofs] = inertias.max()  # the inertia at a prescribed joint may be almost zero
    free = replace(free, armature=armature)
    if model.nv != mechanism.nv or not np.all(model.dof_armature[dofs] == PRESCRIBED_ARMATURE):
        raise ModelError(
            f"the model does not drive {', '.join(prescribed)}, expected an armature of {PRESCRIBED_ARMATURE:g} there: "
            "it is another machine."
        )
    _set_armature(model, dofs, armature[dofs])
    losses = tuple(_losses(free, mechanism_of_model(model), bound))  # before its constraints are disabled
    spread = np.where(np.arange(free.nu) < mechanism.nu, 1.0, 1.0 / PRESCRIBED_ARMATURE)  # forces of size one
    section = rigid_parity(free, model, None, states, bound, seed, spread)
    _set_armature(model, dofs, PRESCRIBED_ARMATURE)
    measured = (*section.measured, *_driven(mechanism, prescribed, model, states, bound, seed))
    return replace(section, measured=(*measured, *losses))


def _set_armature(model: Any, dofs: np.ndarray, armature: np.ndarray | float) -> None:
    """Give degrees of freedom an armature; what carries nothing has its mass in a constant (MuJoCo's dof_M0)."""
    model.dof_armature[dofs] = armature
    load_mujoco().mj_setConst(model, load_mujoco().MjData(model))


def _losses(ours: Mechanism, theirs: Mechanism, bound: float) -> Iterator[Measurement]:
    """Compare friction losses only: MuJoCo computes their slopes from the inertia of the model with motors."""
    largest = np.maximum(ours.friction_loss, theirs.friction_loss)
    if np.any(largest):
        off = np.abs(theirs.friction_loss - ours.friction_loss) / np.where(largest > 0.0, largest, 1.0)
        note = "" if off.max() <= bound else f"{differences(ours, theirs)}, "
        yield Measurement("friction_loss_error", float(off.max()), "", bound, f"{note}of the loss, relative to it")


def _driven(
    mechanism: Mechanism, prescribed: Collection[str], model: Any, states: int, bound: float, seed: int
) -> tuple[Measurement, Measurement]:
    """Acceleration error of the MuJoCo model with motors against the plan's dynamics, and the motors' shortfall."""
    smooth = replace(mechanism, contacts=(), stops=(), friction_loss=np.zeros(mechanism.nv))
    dynamics = RigidBodyDynamics(smooth, 1.0, prescribed=prescribed)
    rng = np.random.default_rng(seed)
    xs = random_states(mechanism, rng, states)
    us = rng.normal(size=(states, dynamics.nu))
    accelerations = slice(mechanism.nv, 2 * mechanism.nv)
    asked, left = us.copy(), np.zeros((states, dynamics.nu - mechanism.nu))
    for _ in range(_ROUNDS):
        left = (
            forces_of_prescribed(smooth, prescribed, xs, dynamics.rates(xs, asked)[:, accelerations])
            / PRESCRIBED_ARMATURE
        )
        asked[:, mechanism.nu :] = us[:, mechanism.nu :] - left
    ours = dynamics.rates(xs, asked)[:, accelerations]
    theirs = _accelerations(model, mechanism_of_model(model), xs, us)
    speed2 = np.square(xs[:, mechanism.nq : mechanism.nq + mechanism.nv]).max(axis=1)
    scale = np.maximum(_rounded(smooth, prescribed, xs, theirs), speed2)
    error = float((np.abs(theirs - ours) / scale[:, None]).max())
    note = f"with the joints driven, at {states} random states (seed {seed}), relative to what it is made of at each"
    judged = Measurement("driven_acceleration_error", error, "", bound, note)
    unit = "rad/s^2 or m/s^2"
    note = f"of a prescribed acceleration at these states, {unit}: the force it takes over {PRESCRIBED_ARMATURE:g}"
    return judged, Measurement("left_by_the_motors", float(np.abs(left).max()), "", None, note)


def _rounded(mechanism: Mechanism, prescribed: Collection[str], xs: np.ndarray, qdd: np.ndarray) -> np.ndarray:
    """(K,) condition numbers of that model's accelerations (K, nv): their error per unit of rounding."""
    heavy = with_force_inputs(mechanism, prescribed)
    armature = heavy.armature.copy()
    armature[prescribed_dofs(mechanism, prescribed)] = PRESCRIBED_ARMATURE
    heavy = replace(heavy, armature=armature)
    q, qd, _ = np.split(xs, [mechanism.nq, mechanism.nq + mechanism.nv], axis=1)
    return rounded(rigid_body.mass_matrix(heavy, q), rigid_body.bias(heavy, q, qd), qdd)


def forces_of_prescribed(
    mechanism: Mechanism, prescribed: Collection[str], xs: np.ndarray, qdd: np.ndarray
) -> np.ndarray:
    """Forces (K, n) at prescribed joints, at xs (K, nx) with accelerations qdd (K, nv); without contacts."""
    q, qd, _ = np.split(xs, [mechanism.nq, mechanism.nq + mechanism.nv], axis=1)
    return rigid_body.rnea(with_force_inputs(mechanism, prescribed), q, qd, qdd)[
        :, prescribed_dofs(mechanism, prescribed)
    ]


def _accelerations(model: Any, mechanism: Mechanism, xs: np.ndarray, us: np.ndarray) -> np.ndarray:
    """MuJoCo's accelerations (K, nv), without contacts and ranges."""
    unlimited(model)
    mujoco, result = load_mujoco(), np.empty((len(xs), model.nv))
    data = mujoco.MjData(model)
    for k, (x, u) in enumerate(zip(xs, us, strict=True)):
        set_state(model, data, x)
        data.ctrl[:] = u
        mujoco.mj_forward(model, data)
        result[k] = constrained_acceleration(model, data, mechanism)
    return result
