"""Largest eigenvalue of a machine's linearized dynamics, and the number of RK4 substeps that it requires.

Rates are the moduli of the eigenvalues of d(dx/dt)/dx at a state, 1/s, with all forces: dampers, servos, springs,
friction, contacts, stops. RK4 is stable for lambda in the left half plane where

    |1 + z + z^2/2 + z^3/6 + z^4/24| <= 1,   z = lambda h:   |z| <= 2.78 on the real axis, 2.61 in every direction.

Faster damping is integrated implicitly (kernels.tree.rosenbrock), if implicit_error of a stage is at most IMPLICIT,
else by "implicitfast", of first order, if nothing but damping of single joints is faster than a stage.

A rate is attributed to the joint with the largest participation factor, the product of its entries in the right and
left eigenvectors, which has no unit (Perez-Arriaga, Verghese and Schweppe, IEEE Trans. Power App. Syst. 101, 1982).
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from planner.base.errors import PlannerError
from planner.dynamics.contacts import stop_depth
from planner.dynamics.quasi_static import quasi_static_controls
from planner.dynamics.rigid_body import MAX_SUBSTEPS, RigidBodyDynamics
from planner.model.contact.laws import Contact, Stop
from planner.model.coordinates import coordinates_of_mechanism
from planner.model.mechanism import Mechanism
from planner.model.passive_forces import damped_implicitly

# Target |lambda| h of a substep: RK4 then reproduces the decay exp(-0.7) to 0.3 %, so that a replay at finer steps
# differs by a fraction of the tolerance. At 1 the error is 2 %; at 2 the decay is 0.33 instead of 0.14.
TARGET_RATE_STEP = 0.7
# The target of a mode that only decays, where a stage is so long that 2 % of it are left: its decay may then be 2 %
# wrong. Slower ones are part of the motion. With a target of 1.4 the decay was 13 % wrong, and costs of arms with tasks
# were off by 1.3 %. Machines with contacts keep TARGET_RATE_STEP: with fewer substeps a Segway's wheel slipped more.
DECAYING, GONE, DECAY_RATE_STEP = 0.9, 4.0, 1.0  # the damping ratio and |lambda| dt from which on, and the target
# Largest |lambda| h of a substep, allowed only with 16 substeps. It leaves a margin of a quarter to the 2.61 above for
# states of the trajectory with higher rates than the given ones.
MAX_RATE_STEP = 2.0
# Of the lead of a contact or a stop: a substep. Contacts begin and slip abruptly, so that steps as short as their rate
# alone asks for, a third of this number, leave replays at finer steps centimetres off; shorter ones change little.
LEAD_SHARE = 0.2
NEAR = 0.05  # of a range: a joint that starts or ends as close to a stop is likely to meet it
IMPLICIT = 1e-3
"""Largest implicit_error for which damping is integrated implicitly, no unit: a tenth of the path tolerance."""
LASTING = 0.2  # damping ratio: an oscillation that keeps a quarter of its amplitude, exp(-2 pi 0.2), after a turn
_PROBE_STEP = 1e-6  # s, of the Euler step h whose (A - 1) / h approximates d(dx/dt)/dx, also with quaternions
_EIGENVALUE_TOLERANCE = 1e-6  # relative, between eigenvalues counted as equal
_ROUNDING = 1e-9  # relative tolerance of rounding


class FastestMode(NamedTuple):
    """The largest eigenvalue modulus of a machine and its coordinate, and what of it steps have to follow."""

    rate: float  # 1/s
    joint: str  # name of the coordinate or activation with the largest participation
    rate_to_resolve: float  # 1/s, the largest rate of what swings, touches or is near a stop
    swing: float = 0.0  # rad/s, of oscillations with a damping ratio below LASTING; 0 without any
    lead: float = 0.0  # s, of the contact that asks for the shortest steps; 0: something else does
    own_rate: float = 0.0  # 1/s, the largest eigenvalue: without what leads ask for


def fastest_mode(
    mechanism: Mechanism, states: np.ndarray | Iterable[np.ndarray], prescribed: Collection[str] = ()
) -> FastestMode:
    """The largest rate, 1/s, of a machine at states (K, nx) or (nx,), its joint, and its fastest lasting oscillation.

    Friction loss acts on a sticking joint like an armature; a slipping light joint is faster, so both are evaluated. A
    contact with a lead counts with the rate that substeps of LEAD_SHARE of it follow. So does a stop with a lead that a
    joint is near, and off in one of the states.

    Args:
        mechanism: A mechanism with actuators.
        states: (K, nx) or (nx,), e.g. the start, the goal and home.
        prescribed: Names of joints whose accelerations are inputs.

    Raises:
        PlannerError: The mechanism has no control, or a prescribed joint is unknown.
    """
    xs, found = _rows(states), FastestMode(0.0, "", 0.0)
    touches = bool(mechanism.contacts or mechanism.body_contacts)  # then friction and impacts are among what decays
    for one in _held_and_slipping(mechanism):
        dynamics = RigidBodyDynamics(one, _PROBE_STEP, "euler", prescribed)
        A, _ = dynamics.linearize(np.vstack([xs, xs[-1:]]), np.zeros((len(xs), dynamics.nu)))
        for slopes in (A - np.eye(dynamics.ndx)) / _PROBE_STEP:
            if not np.isfinite(slopes).all():
                continue
            values, right = np.linalg.eig(slopes)
            k = int(np.argmax(np.abs(values)))
            rate = float(abs(values[k]))
            swings = np.abs(values)[touches | (np.real(values) >= -DECAYING * np.abs(values))]
            found = found._replace(rate_to_resolve=max(found.rate_to_resolve, float(swings.max(initial=0.0))))
            if rate > found.rate:
                found = found._replace(rate=rate, joint=_joint(mechanism, slopes, values[k], right[:, k]))
        found = found._replace(swing=max(found.swing, _lasting_swing(dynamics, xs)))
    found = found._replace(own_rate=found.rate)
    met = [stop for stop in mechanism.stops if _is_near(mechanism, stop, xs)]
    for one in (*mechanism.contacts, *met):
        rate = TARGET_RATE_STEP / (LEAD_SHARE * one.law.lead) if one.law.lead > 0.0 else 0.0
        if rate > found.rate:
            name = one.name if isinstance(one, Contact) else mechanism.joint_of(one.dof)
            found = found._replace(rate=rate, joint=name, lead=one.law.lead if isinstance(one, Contact) else 0.0)
        found = found._replace(rate_to_resolve=max(found.rate_to_resolve, rate))
    return found


def _is_near(mechanism: Mechanism, stop: Stop, xs: np.ndarray) -> bool:
    """Whether a joint is near a stop in one of the states (K, nx), and off it in one of them."""
    depth = stop_depth(mechanism, stop, xs)
    return bool(depth.max() >= -NEAR * np.ptp(mechanism.joint_range[stop.dof]) and depth.min() < 0.0)


def _lasting_swing(dynamics: RigidBodyDynamics, xs: np.ndarray) -> float:
    """The fastest oscillation of little damping, rad/s, at states (K, nx) that the controls hold; 0 for none.

    A servo that is told to be elsewhere presses, and what it presses swings as if it were stiffer.
    """
    us = np.array([quasi_static_controls(dynamics, x, contacts=False) for x in xs])
    A, _ = dynamics.linearize(np.vstack([xs, xs[-1:]]), us)
    slopes = (A - np.eye(dynamics.ndx)) / _PROBE_STEP
    values = np.linalg.eigvals(slopes[np.isfinite(slopes).all(axis=(1, 2))])
    swings = np.abs(np.imag(values))[np.abs(np.real(values)) < LASTING * np.abs(values)]
    return float(swings.max(initial=0.0))


def _rows(states: np.ndarray | Iterable[np.ndarray]) -> np.ndarray:
    return np.atleast_2d(np.array(states if isinstance(states, np.ndarray) else list(states), dtype=float))


def _held_and_slipping(mechanism: Mechanism) -> tuple[Mechanism, ...]:
    """The machine and, if it has friction loss, a copy without it."""
    if not np.any(mechanism.friction_loss):
        return (mechanism,)
    return mechanism, replace(mechanism, friction_loss=np.zeros(mechanism.nv))


def _joint(mechanism: Mechanism, slopes: np.ndarray, value: complex, right: np.ndarray) -> str:
    """Name of the coordinate with the largest participation in an eigenvalue with right eigenvector (ndx,)."""
    values, left = np.linalg.eig(slopes.T)
    same = np.abs(values - value) <= max(_EIGENVALUE_TOLERANCE * abs(value), np.abs(values - value).min())
    share = np.abs(right) * np.abs(left[:, same]).sum(axis=1)
    nv = mechanism.nv
    joint = np.concatenate([share[:nv] + share[nv : 2 * nv], share[2 * nv :]])
    k = int(np.argmax(joint))
    return coordinates_of_mechanism(mechanism)[k if k < nv else k + nv].name


def substeps_of(found: FastestMode, dt: float) -> int:
    """Number of RK4 substeps, 1 to 16, that a stage of dt s needs for a largest rate.

    Substeps meet TARGET_RATE_STEP, or DECAY_RATE_STEP for what is gone after a stage, or are 16 if these meet
    MAX_RATE_STEP.

    Raises:
        PlannerError: It needs more than 16; the message has the joint, its rate and the required stage.
    """
    if found.rate * dt > MAX_SUBSTEPS * MAX_RATE_STEP * (1.0 + _ROUNDING):
        substeps = math.ceil(found.rate * dt / MAX_RATE_STEP)
        longest = MAX_SUBSTEPS * MAX_RATE_STEP / found.rate
        raise PlannerError(
            f"{found.joint} has a rate of {found.rate:.4g} per s, which takes {substeps} substeps in a stage of "
            f"{dt:g} s and {MAX_SUBSTEPS} are the most, expected dt = {_round_down(longest):g}, or less damping or "
            "gain there."
        )
    decay, swing = found.rate * dt, found.rate_to_resolve * dt / TARGET_RATE_STEP
    needed = max(swing, min(decay / TARGET_RATE_STEP, max(GONE / TARGET_RATE_STEP, decay / DECAY_RATE_STEP)))
    return min(max(math.ceil(needed - _ROUNDING), 1), MAX_SUBSTEPS)


def leaps_of(found: FastestMode, dt: float) -> int:
    """Number of "leapfrog" substeps, 1 to 16, of a stage of dt s of a machine as leaping() has it.

    Where a contact with a lead asks for the shortest steps these are LEAD_SHARE of it, or as short as the largest
    eigenvalue asks for.

    Raises:
        PlannerError: As of substeps_of.
    """
    if found.lead == 0.0:
        return substeps_of(found, dt)
    needed = math.ceil(max(dt / (LEAD_SHARE * found.lead), found.own_rate * dt / TARGET_RATE_STEP) - _ROUNDING)
    return max(needed, 1) if needed <= MAX_SUBSTEPS else substeps_of(found, dt)


def leaping(mechanism: Mechanism, dt: float) -> Mechanism:
    """The mechanism whose rates "leapfrog" steps of a stage of dt s have to follow: joints' damping never is too fast.

    Of one step in the stage D / (M + dt/2 D) is at most 2 / dt; contacts keep their leads, by which steps are chosen.

    Raises:
        PlannerError: Damping that couples joints, or depends on the state.
    """
    return damped_implicitly(mechanism, 0.5 * dt)


def implicit_error(
    mechanism: Mechanism, dt: float, states: np.ndarray | Iterable[np.ndarray], prescribed: Collection[str] = (),
    substeps: int = MAX_SUBSTEPS,
) -> float:  # fmt: skip
    """Largest change of the state Jacobian A of a stage of dt s when it is split in two, by the Rosenbrock method.

    The controls are those that hold a state: a servo that is told to be elsewhere would leave it at once. Both use as
    many substeps per stage, by default 16. Velocities are multiplied by dt, so the change of positions and velocities
    is comparable. States (K, nx) as in fastest_mode. Infinite if a stage diverges.
    """
    xs, change = _rows(states), 0.0
    for one in _held_and_slipping(mechanism):
        whole, half = (RigidBodyDynamics(one, step, "rosenbrock", prescribed, substeps) for step in (dt, 0.5 * dt))
        us = np.array([quasi_static_controls(whole, x, contacts=False) for x in xs])
        scale = np.ones(whole.ndx)
        scale[mechanism.nv : 2 * mechanism.nv] = dt
        with np.errstate(all="ignore"):
            middle = half.step(xs, us)
            first, second = (half.linearize(np.vstack([x, x[-1:]]), us)[0] for x in (xs, middle))
            A, _ = whole.linearize(np.vstack([xs, xs[-1:]]), us)
            apart = float(np.abs(scale[:, None] * (second @ first - A) / scale).max())
        change = max(change, apart if np.isfinite(apart) else math.inf)
    return change


def follows_all_but_damping(
    mechanism: Mechanism, dt: float, states: np.ndarray | Iterable[np.ndarray], prescribed: Collection[str] = ()
) -> bool:
    """Whether one step of dt s of "implicitfast" is stable: what it takes implicitly is damping of single joints."""
    try:
        machine = damped_implicitly(mechanism, dt)
    except PlannerError:
        return False
    return fastest_mode(machine, states, prescribed).rate * dt <= MAX_RATE_STEP


def reason(found: FastestMode, substeps: int) -> str:
    """Message that explains a number of substeps."""
    steps = "1 step a stage is enough:" if substeps == 1 else f"{substeps} substeps a stage, because"
    return f"{steps} {found.joint} has the highest rate, {found.rate:.4g} per s."


def _round_down(value: float) -> float:
    """The next lower of 1, 2, 5, 10, ..., which divide most durations."""
    power = 10.0 ** math.floor(math.log10(value))
    return max(step for step in (1.0, 2.0, 5.0) if step * power <= value * (1.0 + _ROUNDING)) * power
