"""Parity of a mechanism's rigid-body terms with MuJoCo's: inertia, forces and accelerations, at random states.

    mass matrix     M(q), armature included
    bias force      Coriolis + gravity and its compensation + damping + springs and curves: MuJoCo's qfrc_bias -
                    qfrc_passive; without friction loss, see friction_parity
    actuator force  M qacc + bias by ours, MuJoCo's qfrc_actuator
    acceleration    qacc without contacts and joint limits: MuJoCo's qacc_smooth; of coupled joints
                    G (G' M G)^-1 G' tau of MuJoCo's own M, forces tau and equalities (planner.model.couplings)
    activation      d act / dt

Errors are relative, at each state: mass matrix entries to the diagonal, sqrt(M_ii M_jj), so that light bodies count
in addition to heavy ones; forces to the largest force there, including inertia times velocity squared; accelerations to
the size of the terms they are computed from, |M^-1| (|M| |qacc| + |bias|), which is large where revolute axes become
parallel: there rounding alone makes accelerations differ (Skeel). A term that differs is traced to its joint.
"""

from __future__ import annotations

import copy
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from planner.base.errors import ModelError, PlannerError
from planner.base.gl import load_mujoco
from planner.base.measured import Measurement, Section
from planner.dynamics import algorithms as rigid_body
from planner.dynamics.assembly import assembled, feasible_directions
from planner.dynamics.rigid_body import RigidBodyDynamics
from planner.model.mechanism import SCREW, Mechanism
from planner.model.mjcf.equalities import set_hard
from planner.model.mjcf.model_index import field
from planner.model.mjcf.read import mechanism_of_model
from planner.model.mjcf.unsupported import no_compensation, unsupported_elements
from planner.model.passive_forces import exponential_joint_torques, one_torque
from planner.model.space import unit
from planner.proof.compare.constrained import closure_rounding, constrained_acceleration
from planner.proof.compare.differences import actuator_of, differences, joint_of
from planner.proof.replays.simulation import set_state

SPEED = 3.0  # rad/s and m/s, standard deviation of random velocities
HARDER = 1e-3  # compliance of MuJoCo's equalities, relative to the smallest that MJCF can express
LARGE = 10.0  # upper limit of an exponential torque over all other forces
_HALVINGS = 20


class _Terms(NamedTuple):
    """The compared terms, for K states."""

    mass: np.ndarray  # (K, nv, nv)
    rest: np.ndarray  # (K, nv) bias force at zero velocity: gravity and springs
    bias: np.ndarray  # (K, nv)
    back: np.ndarray  # (K, nv) bias force with the velocity reversed
    actuator: np.ndarray  # (K, nv)
    acceleration: np.ndarray  # (K, nv)
    activation: np.ndarray  # (K, na)
    closures: np.ndarray = np.zeros(1)  # (K,) closure_rounding of the accelerations


def rigid_parity(
    mechanism: Mechanism, model: Any, dynamics: RigidBodyDynamics | None, states: int, bound: float, seed: int,
    spread: np.ndarray | float = 1.0,
) -> Section:  # fmt: skip
    """Compare a mechanism with MuJoCo's model at random states, with random controls times `spread` (nu,).

    `dynamics`, by default the mechanism's, gives the accelerations, with nothing prescribed; `bound` is the largest
    relative error that passes.
    """
    _check_sizes(mechanism, model)
    left_out = _unmodelled(mechanism, model)
    read = mechanism_of_model(model)
    named, constrained = differences(mechanism, read), bool(read.couplings or read.loops or read.polynomial_couplings)
    mechanism = replace(mechanism, friction_loss=np.zeros(mechanism.nv))
    rng = np.random.default_rng(seed)
    xs = random_states(mechanism, rng, states)
    if mechanism.loops or mechanism.polynomial_couplings:
        xs = _nearest_assembled(mechanism, xs)
    us = spread * rng.normal(size=(states, mechanism.nu))
    shown = [_soft(mechanism, model, dynamics, xs, us)] if constrained else []
    ours = _ours(mechanism, dynamics, xs, us)
    theirs = _theirs(mechanism, model, read, xs, us)
    if constrained:  # `dynamics` includes the constraint forces
        ours, theirs = (one._replace(actuator=_felt(mechanism, xs, one.actuator)) for one in (ours, theirs))
    speed2 = np.square(xs[:, mechanism.nq : mechanism.nq + mechanism.nv]).max(axis=1)
    mass = _largest_of_each(theirs.mass)
    force = np.max([_largest_of_each(theirs.bias), _largest_of_each(theirs.actuator), mass * speed2], axis=0)
    acceleration = np.max([_rounded(read, theirs, xs), theirs.closures, speed2], axis=0)
    own = np.sqrt(np.einsum("kii->ki", theirs.mass))
    scales = {"mass": own[:, :, None] * own[:, None, :], "bias": force, "actuator": force, "acceleration": acceleration}
    if mechanism.na:
        scales["activation"] = np.maximum(_largest_of_each(theirs.activation), 1.0)
    names = {"mass": "mass_matrix_error", "bias": "bias_force_error", "actuator": "actuator_force_error"}
    measured = []
    for term, scale in scales.items():
        difference = np.abs(getattr(theirs, term) - getattr(ours, term))
        relative = difference / (scale if scale.ndim > 1 else scale.reshape(-1, *[1] * (difference.ndim - 1)))
        value = float(relative.max())
        note = f"at {states} random states (seed {seed}), relative to what it is made of at each"
        if not value <= bound:
            note = f"{named or _cause(term, mechanism, ours, theirs, relative, bound)}, {note}"
        measured.append(Measurement(names.get(term, f"{term}_error"), value, "", bound, note))
    return Section("parity", (*measured, *shown, left_out) if left_out.passed else (left_out, *measured, *shown))


def _unmodelled(mechanism: Mechanism, model: Any) -> Measurement:
    """Elements of the model that the mechanism lacks; contacts aside, which a replay reports."""
    phrases = [one.phrase for one in unsupported_elements(model)]
    note = ", ".join(phrases) or "what changes the motion and is no part of the plan's dynamics"
    if phrases and mechanism.ignored:
        note += f" (the plan was made without {', '.join(mechanism.ignored)})"
    return Measurement("unmodelled_elements", float(len(phrases)), "", 0.0, note)


def random_states(mechanism: Mechanism, rng: np.random.Generator, K: int) -> np.ndarray:
    """K random states (K, nx): angles and orientations uniform, lengths and velocities moderate.

    Joints with exponential torques are limited so that these stay comparable to other forces: a torque of 1e11 N m
    would hide all other errors.
    """
    xs = rng.normal(size=(K, mechanism.space.nx))
    screws = mechanism.kind == SCREW
    reach = np.where(turns(mechanism), np.pi, 1.0)[screws]
    xs[:, mechanism.q_address[screws]] = mechanism.q_home[screws] + rng.uniform(-reach, reach, (K, len(reach)))
    for address, _ in mechanism.quaternions:
        xs[:, address : address + 4] = unit(xs[:, address : address + 4])
    xs[:, mechanism.nq : mechanism.nq + mechanism.nv] *= SPEED
    _approach(mechanism, xs)
    return xs


def _approach(mechanism: Mechanism, xs: np.ndarray) -> None:
    """Halve the displacement from home of joints whose exponential torque exceeds LARGE times the other forces."""
    q, qd, _ = np.split(xs, [mechanism.nq, mechanism.nq + mechanism.nv], axis=1)
    most = LARGE * (float(np.abs(rigid_body.bias(mechanism, q, qd)).max()) or 1.0) if mechanism.curves else 0.0
    for curve in mechanism.curves:
        j = [dof for dof, _ in curve.slopes]
        address, home = mechanism.q_address[j], mechanism.q_home[j]
        for _ in range(_HALVINGS):
            beyond = np.abs(one_torque(curve, mechanism.q_address, q)) > most
            xs[np.ix_(beyond, address)] = home + 0.5 * (xs[np.ix_(beyond, address)] - home)
            q = xs[:, : mechanism.nq]


def turns(mechanism: Mechanism) -> np.ndarray:
    """(nv,) whether a degree of freedom is rotational."""
    return np.any(mechanism.S[:, :3] != 0.0, axis=1)


def _ours(mechanism: Mechanism, dynamics: RigidBodyDynamics | None, xs: np.ndarray, us: np.ndarray) -> _Terms:
    q, qd, _ = np.split(xs, [mechanism.nq, mechanism.nq + mechanism.nv], axis=1)
    mass = rigid_body.mass_matrix(mechanism, q)
    rest, bias, back = (rigid_body.bias(mechanism, q, v) for v in (np.zeros_like(qd), qd, -qd))
    held = exponential_joint_torques(mechanism, q)  # included in the mechanism's bias, not in these functions'
    rest, bias, back = (value - held for value in (rest, bias, back))
    if mechanism.nu:
        dynamics = _smooth(mechanism, dynamics)
        _, acceleration, activation = np.split(dynamics.rates(xs, us), [mechanism.nv, 2 * mechanism.nv], axis=1)
    else:  # no actuators: no dynamics to compare
        acceleration = rigid_body.forward_dynamics(mechanism, q, qd, held)
        activation = np.zeros((len(xs), 0))
    actuator = np.einsum("kij,kj->ki", mass, acceleration) + bias
    return _Terms(mass, rest, bias, back, actuator, acceleration, activation)


def _smooth(mechanism: Mechanism, dynamics: RigidBodyDynamics | None) -> RigidBodyDynamics:
    """Dynamics without contacts, joint stops and friction loss; `dynamics` itself where it has none of them."""
    own = None if dynamics is None else dynamics.mechanism
    if own is None or own.contacts or own.body_contacts or own.stops or np.any(own.friction_loss):
        return RigidBodyDynamics(replace(mechanism, contacts=(), body_contacts=(), stops=()), 0.01)
    assert dynamics is not None
    return dynamics


def _felt(mechanism: Mechanism, xs: np.ndarray, forces: np.ndarray) -> np.ndarray:
    """Generalized forces (K, nv) at xs (K, nx) on the independent coordinates, Z' tau; 0 for the others."""
    felt = np.zeros_like(forces)
    for own, x, tau in zip(felt, xs, forces, strict=True):
        Z, leading = feasible_directions(mechanism, x[: mechanism.nq])
        own[leading] = tau @ Z
    return felt


def _nearest_assembled(mechanism: Mechanism, xs: np.ndarray) -> np.ndarray:
    """States (K, nx) on the constraints nearest to xs, or to poses between them and home from which loops close."""
    start = assembled(mechanism, mechanism.home)

    def nearest(x: np.ndarray) -> np.ndarray:
        for share in (1.0, 0.5, 0.25, 0.125, 0.0):
            between = mechanism.space.integrate(start, share * mechanism.space.difference(x, start))
            try:
                return assembled(mechanism, between)
            except PlannerError:  # loops cannot be closed from there
                continue
        return start

    return np.array([nearest(x) for x in xs])


def _soft(
    mechanism: Mechanism, model: Any, dynamics: RigidBodyDynamics | None, xs: np.ndarray, us: np.ndarray
) -> Measurement:
    """Error of the accelerations against MuJoCo's at states on the couplings, with its hardest possible equalities.

    MuJoCo adds R = (1 - d) / d w to the diagonal of J W J', with the impedance d, 0.9999 at most, and a weight w
    computed from the bodies at home. Away from home w may be fifty times J W J', and accelerations then differ by 5e-3,
    by R alone: the formula with R gives MuJoCo's to 1e-10. So these weights are reduced here.
    """
    mujoco, model = load_mujoco(), copy.copy(model)
    bits = mujoco.mjtDisableBit
    model.opt.disableflags |= bits.mjDSBL_CONTACT | bits.mjDSBL_LIMIT | bits.mjDSBL_FRICTIONLOSS
    unclamped(model)
    set_hard(model, model.opt.timestep)
    for weights in (model.body_invweight0, model.dof_invweight0):
        weights *= HARDER
    xs = _nearest_assembled(mechanism, xs)
    ours = _smooth(mechanism, dynamics).rates(xs, us)[:, mechanism.nv : 2 * mechanism.nv] if mechanism.nu else None
    data, apart = mujoco.MjData(model), 0.0
    for k, (x, u) in enumerate(zip(xs, us, strict=True)):
        set_state(model, data, x)
        data.ctrl[:] = u
        mujoco.mj_forward(model, data)
        exact = constrained_acceleration(model, data, mechanism) if ours is None else ours[k]
        apart = max(apart, float(np.abs(data.qacc - exact).max() / max(np.abs(exact).max(), 1.0)))
    note = f"of MuJoCo's own, whose equalities are soft, at {len(xs)} states that obey them, relative to the largest"
    return Measurement("soft_acceleration_difference", apart, "", None, note)


def _theirs(mechanism: Mechanism, model: Any, read: Mechanism, xs: np.ndarray, us: np.ndarray) -> _Terms:
    mujoco = load_mujoco()
    nv, K = mechanism.nv, len(xs)
    unlimited(model)
    data = mujoco.MjData(model)
    shapes = ((nv, nv), (nv,), (nv,), (nv,), (nv,), (nv,), (mechanism.na,))
    terms = _Terms(*(np.empty((K, *shape)) for shape in shapes), closures=np.empty(K))
    # Gravity compensation that MuJoCo counts as actuator force is part of the mechanism's bias.
    by_actuators = field(model, "jnt_actgravcomp", model.njnt)[model.dof_jntid]
    compensated = bool(np.any(by_actuators)) and not no_compensation(model)
    for k, (x, u) in enumerate(zip(xs, us, strict=True)):
        data.qpos[:], velocity, data.act[:] = np.split(x, [model.nq, model.nq + nv])
        data.ctrl[:] = u
        for speed, biases in ((-1.0, terms.back), (0.0, terms.rest), (1.0, terms.bias)):
            data.qvel[:] = speed * velocity
            mujoco.mj_forward(model, data)
            lifts = data.qfrc_gravcomp * by_actuators if compensated else 0.0
            biases[k] = data.qfrc_bias - data.qfrc_passive - lifts
        for i, axis in enumerate(np.eye(nv)):
            mujoco.mj_mulM(model, data, terms.mass[k, i], axis)
        terms.actuator[k] = data.qfrc_actuator - lifts
        terms.acceleration[k] = constrained_acceleration(model, data, read)
        terms.closures[k] = closure_rounding(model, data, read)
        terms.activation[k] = data.act_dot
    return terms


def unlimited(model: Any) -> None:
    """Disable ranges, clamps and contacts of a model, which are no part of the smooth dynamics."""
    model.opt.disableflags |= load_mujoco().mjtDisableBit.mjDSBL_CONSTRAINT
    unclamped(model)


def unclamped(model: Any) -> None:
    """Disable the clamps of a model's actuators: of controls, and of forces of actuators, joints and tendons."""
    model.opt.disableflags |= load_mujoco().mjtDisableBit.mjDSBL_CLAMPCTRL
    model.actuator_forcelimited[:] = 0
    model.jnt_actfrclimited[:] = 0
    field(model, "tendon_actfrclimited", model.ntendon)[:] = 0  # before release 3.3 tendons have none


def _cause(term: str, mechanism: Mechanism, ours: _Terms, theirs: _Terms, relative: np.ndarray, bound: float) -> str:
    """Name the joint and its term in which two models differ."""
    if not np.isfinite(relative).all():
        return "not a finite number"
    if term == "mass":
        return _mass_cause(mechanism, theirs.mass - ours.mass, relative > bound)
    if term == "bias":
        odd, even = (np.array([0.5 * (t.bias + sign * t.back) for t in (theirs, ours)]) for sign in (-1.0, 1.0))
        parts = {
            "gravity or spring": theirs.rest - ours.rest, "damping": odd[0] - odd[1],
            "Coriolis force": (even[0] - theirs.rest) - (even[1] - ours.rest),
        }  # fmt: skip
        name, difference = max(parts.items(), key=lambda part: float(np.abs(part[1]).max()))
        return f"{name} at {joint_of(mechanism, int(np.abs(difference).max(axis=0).argmax()))}"
    worst = int(relative.max(axis=0).argmax())
    if term == "activation":
        actuator = int(np.flatnonzero(mechanism.actuators.activation == worst)[0])
        return f"activation of {actuator_of(mechanism, actuator)}"
    if term == "actuator":
        acting = np.flatnonzero(mechanism.actuators.acts_on[:, worst])
        which = " and ".join(actuator_of(mechanism, int(a)) for a in acting) or "no actuator of ours"
        return f"gear, gain or bias of {which} at {joint_of(mechanism, worst)}"
    return f"at {joint_of(mechanism, worst)}"


def _mass_cause(mechanism: Mechanism, difference: np.ndarray, wrong: np.ndarray) -> str:
    """Name the outermost joint whose inertia differs, since the difference appears at all its ancestors too."""
    entries = np.any(wrong, axis=0)
    joints = np.flatnonzero(np.diag(entries))
    if not len(joints):
        i, j = np.argwhere(entries)[0]
        return f"coupling of {joint_of(mechanism, int(i))} and {joint_of(mechanism, int(j))}"
    outermost = int(joints[-1])
    own = difference[:, outermost, outermost]
    alone = entries.sum() == 1 and np.ptp(own) <= 1e-3 * np.abs(own).max()
    what = "armature" if alone else "mass, inertia or place of what moves"
    return f"{what} at {joint_of(mechanism, outermost)}"


def rounded(mass: np.ndarray, bias: np.ndarray, acceleration: np.ndarray) -> np.ndarray:
    """(K,) condition numbers of accelerations: their error per unit of rounding in the equation of motion."""
    terms = np.einsum("kij,kj->ki", np.abs(mass), np.abs(acceleration)) + np.abs(bias)
    return _largest_of_each(np.einsum("kij,kj->ki", np.abs(np.linalg.inv(mass)), terms))


def _rounded(mechanism: Mechanism, t: _Terms, xs: np.ndarray) -> np.ndarray:
    """The same of terms at xs (K, nx), in the null space Z of couplings and loop closures: Z (Z'MZ)^-1 Z'."""
    if not (mechanism.couplings or mechanism.loops or mechanism.polynomial_couplings):
        return rounded(t.mass, t.bias, t.acceleration)
    terms = np.einsum("kij,kj->ki", np.abs(t.mass), np.abs(t.acceleration)) + np.abs(t.bias)
    found = np.empty(len(xs))
    for k, x in enumerate(xs):
        Z = feasible_directions(mechanism, x[: mechanism.nq])[0]
        inverse = np.abs(np.linalg.inv(Z.T @ t.mass[k] @ Z))
        found[k] = np.max(np.abs(Z) @ inverse @ np.abs(Z).T @ terms[k])
    return found


def _largest_of_each(values: np.ndarray) -> np.ndarray:
    """(K,) the largest magnitude at each state."""
    return np.abs(values).reshape(len(values), -1).max(axis=1)


def _check_sizes(mechanism: Mechanism, model: Any) -> None:
    have = (model.njnt, model.nv, model.nu, model.na)
    expected = (len(mechanism.joint_names), mechanism.nv, mechanism.nu, mechanism.na)
    if have != expected or model.nq != mechanism.nq:
        words = "{} joints with {} degrees of freedom, {} actuators and {} activations"
        raise ModelError(
            f"the model has {words.format(*have)}, expected {words.format(*expected)}: it is another machine."
        )
