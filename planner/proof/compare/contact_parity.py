"""Parity of contacts and joint stops: coefficients of the plan's forces and of MuJoCo's, at states in contact.

The plan's law is linear outside its smoothing (model.contact.laws), so each coefficient is a difference of forces:

    stiffness     (f_n(e_2) - f_n(e_1)) / (e_2 - e_1)     pressed to two depths
    surface       e_1 - f_n(e_1) / stiffness              where the force begins: 0 for the plan
    damping       (f_n(closing) - f_n(at rest)) / speed   pressed to e_1
    friction      f_t / f_n                               sliding at three times the slip speed
    slip damping  f_t / |v_t|                             sliding at a thousandth of that
    turning       torque / f_n                            turning at three times the speed of spinning and rolling

Both models use the same formulas at the same states. MuJoCo's forces are from its inverse dynamics with qacc = 0,
where each contact force is independent of other contacts. Accelerations change a contact force by the share A/R, A the
inverse inertia at the contact and R MuJoCo's regularization: that share is tested too, since the plan's contact force
does not depend on accelerations.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from planner.base.gl import load_mujoco
from planner.base.measured import Measurement
from planner.dynamics.contacts import contact_force, contact_wrench, stop_state, unilateral_force
from planner.dynamics.hopper import HopperDynamics
from planner.model.capabilities import capabilities_of
from planner.model.contact.laws import Contact, Stop
from planner.model.mechanism import Mechanism
from planner.model.mjcf.contact_shapes import shape_of
from planner.model.mjcf.model_index import ModelIndex
from planner.model.mjcf.prescribed_joints import prescribed_dofs_of
from planner.problem.problem import Problem
from planner.proof.compare.coefficients import (
    Coefficient,
    compared,
    hopper_ground,
    measured_of,
    missing,
    surface_difference,
)
from planner.proof.compare.contact_states import (
    AnyContact,
    ContactGeoms,
    ContactStateSampler,
    beyond_ramps,
    contact_name,
    shapes_of,
    wrench_between,
)
from planner.proof.compare.differences import joint_of
from planner.proof.compare.rigid_parity import random_states
from planner.proof.replays.compiled_twin import CompiledTwin
from planner.proof.replays.simulation import set_state

STATES = 3  # per contact
POINTS = 2  # contact points tested per shape with several equal ones
_STATES_NEAR_START = 4  # initial states near the start, and as many at random, before moving to depth
_CLOSING = 0.5  # closing speed: damper force relative to the spring's
_FAST, _SLOW = 3.0, 1e-3  # sliding speeds relative to the speed at which friction saturates
_STUCK = 0.05  # minimum share of the requested sliding velocity that is attainable; below it no friction is tested
_POSITION_TOLERANCE = 1e-9  # m
_REST = 1e-2  # rad or m, depth at which joint stops are tested, unless their smoothing needs more


@np.errstate(all="ignore")  # NaN fails
def contact_parity(problem: Problem, compiled: CompiledTwin, seed: int = 0) -> tuple[Measurement, ...]:
    """Compare the coefficients of a plan's contacts and stops with those of MuJoCo's forces.

    Args:
        problem: The problem of the plan.
        compiled: The MuJoCo model, with the states of the plan's machine.
        seed: Seed of the random states.

    Returns:
        One value per coefficient, the largest difference in %, whose note names the pair; of a stop with a lead also
        the inertia that it adds to its joint's; empty where the plan's
        dynamics have no contacts and joint stops.
    """
    dynamics = problem.dynamics
    if isinstance(dynamics, HopperDynamics):
        return measured_of(list(hopper_ground(dynamics, compiled, seed)), seed)
    machine = capabilities_of(dynamics)
    mechanism = machine.mechanism
    if mechanism is None or not (machine.contacts or machine.stops):
        return ()
    bench = _Bench(mechanism, compiled, prescribed_dofs_of(dynamics))
    found = [*bench.contacts(*_starts(problem, mechanism, seed)), *bench.stops(problem.x0)]
    return measured_of(found, seed, bench.unreached)


def _starts(problem: Problem, mechanism: Mechanism, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Initial states (K, nx) before contacts are moved to depth: the start, states near it, and random states."""
    rng, change = np.random.default_rng(seed), np.zeros((_STATES_NEAR_START, mechanism.space.ndx))
    change[1:, : mechanism.nv] = 0.1 * rng.normal(size=(_STATES_NEAR_START - 1, mechanism.nv))
    near = mechanism.space.integrate(np.tile(problem.x0, (_STATES_NEAR_START, 1)), change)
    return near, random_states(mechanism, rng, _STATES_NEAR_START)


class _Pressed(NamedTuple):
    """A contact at one state."""

    sampler: ContactStateSampler
    shapes: ContactGeoms
    x: np.ndarray  # (nx,)
    place: Any  # kinematics of the contact there

    @classmethod
    def at(cls, sampler: ContactStateSampler, shapes: ContactGeoms, x: np.ndarray) -> _Pressed:
        """The contact at a state x (nx,)."""
        return cls(sampler, shapes, x, sampler.place(x[None]))


class _Bench:
    """A model at rest whose contacts are brought to a given depth one after the other."""

    def __init__(self, mechanism: Mechanism, compiled: CompiledTwin, fixed: np.ndarray) -> None:
        self._mujoco = load_mujoco()
        self._mechanism, self._twin, self._fixed = mechanism, compiled.twin, fixed
        self._model = compiled.copy()
        self._model.opt.enableflags &= ~int(self._mujoco.mjtEnableBit.mjENBL_INVDISCRETE)
        self._survey, self._data = ModelIndex(compiled.model), self._mujoco.MjData(self._model)
        self._points: Counter[tuple] = Counter()  # number of tested points of a shape with the same parameters
        self._seen: dict[tuple[int, int], str] = {}  # per pair of geoms, a contact that was not reached, "" if all were

    @property
    def unreached(self) -> list[str]:
        """The pairs of which no sampled state is in contact."""
        return [name for name in self._seen.values() if name]

    def _hold(self, x: np.ndarray, qacc: np.ndarray | None = None) -> None:
        """MuJoCo's forces at a state (nx,) by inverse dynamics with the acceleration qacc (nv,), 0 by default."""
        set_state(self._model, self._data, self._twin.sim_of(x))
        self._data.qacc[:] = 0.0 if qacc is None else qacc
        self._mujoco.mj_inverse(self._model, self._data)

    def contacts(self, near: np.ndarray, anywhere: np.ndarray) -> Iterator[Coefficient]:
        """Every coefficient of every contact, from states near the start, else from random states."""
        m = self._mechanism
        for contact, shapes in zip((*m.contacts, *m.body_contacts), shapes_of(m, self._survey), strict=True):
            pressing = ContactStateSampler(m, contact)
            if not pressing.matters(anywhere, self._fixed):  # its force does not change the dynamics
                continue
            if shapes is None:
                name = contact_name(contact)
                yield missing(name, f"{name} touches nothing in the model, the plan has a contact")
                continue
            if self._is_like_others(contact, shapes):
                continue
            touching, ought_to = list[_Pressed](), False
            tries: list[tuple[np.ndarray, np.ndarray | None]] = [(near, None), (anywhere, None)]
            middle = self._middle(contact, shapes)
            if middle is not None:  # the plan's plane is unbounded, the box is not
                pressing.lowest_only = True
                tries.append((np.concatenate([near, anywhere]), middle))
            for starts, aim in tries:
                xs, alone = pressing.pressed(starts, pressing.depth, aim)
                ought_to = ought_to or (aim is middle and bool(alone.any()))
                if pressing.lowest_only:
                    xs = xs[alone]
                found = (_Pressed.at(pressing, shapes, x) for x in xs)
                touching += [one for one in found if np.isfinite(self._force(one)).all()]
                if len(touching) >= STATES or (touching and (starts is anywhere or isinstance(contact, Contact))):
                    break
            known = self._seen.get((shapes.own, shapes.other)) == ""  # the other end of a capsule
            found = [one for at in touching[: 1 if known else STATES] for one in self._coefficients(at)]
            if found:
                self._seen[shapes.own, shapes.other] = ""
                yield from found
            elif ought_to and not touching:
                yield missing(shapes.name, f"{shapes.name} does not touch in the model where it does in the plan")
            else:
                self._seen.setdefault((shapes.own, shapes.other), shapes.name)

    def _is_like_others(self, contact: AnyContact, shapes: ContactGeoms) -> bool:
        """Whether the contact is at the plan's position and POINTS like it on the same shape have been tested."""
        model, survey = self._model, self._survey
        shape = shape_of(model.geom(shapes.own).name)
        if shape == model.geom(shapes.own).name or not isinstance(contact, Contact):
            return False
        pair = next(pair for pair in survey.pairs if set(pair.geoms) == {shapes.own, shapes.other})
        numbers = (pair.condim, *pair.friction, *pair.solref, *pair.solreffriction, *pair.solimp, pair.margin)
        self._points[shape, shapes.other, numbers] += 1
        off = np.abs(survey.geoms[shapes.own][:3, 3] - contact.centre).max()
        there = (
            off <= _POSITION_TOLERANCE and abs(model.geom_size[shapes.own, 0] - contact.radius) <= _POSITION_TOLERANCE
        )
        return bool(there) and self._points[shape, shapes.other, numbers] > POINTS

    def _middle(self, contact: AnyContact, shapes: ContactGeoms) -> np.ndarray | None:
        """(3,) position of the box in contact, from the file; None for unbounded shapes."""
        box = self._model.geom_type[shapes.other] == int(self._mujoco.mjtGeom.mjGEOM_BOX)
        return self._survey.home.geom_xpos[shapes.other].copy() if box and isinstance(contact, Contact) else None

    def _force(self, at: _Pressed, qacc: np.ndarray | None = None) -> np.ndarray:
        """MuJoCo's force and torque (6,) on the contact's first or only body."""
        self._hold(at.x, qacc)
        if not isinstance(at.sampler.contact, Contact):
            return wrench_between(self._model, self._data, at.shapes)
        return wrench_between(self._model, self._data, at.shapes, at.place.p[0], 0.25 * at.sampler.spacing)

    def _both(
        self, at: _Pressed, velocity: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
        """The plan's force (3,), MuJoCo's, and the contact velocity (3,), nearest to `velocity`."""
        m, x, v = self._mechanism, at.x, at.place.v[0]
        if velocity is not None:
            x = x.copy()
            x[m.velocities], v = at.sampler.moving(at.place, velocity)
        ours = _planned(at.place, v, x[m.velocities])
        return ours[:3], self._force(at._replace(x=x))[:3], v

    def _coefficients(self, at: _Pressed) -> Iterator[Coefficient]:
        pressing, law, name, depth = at.sampler, at.sampler.contact.law, at.shapes.name, at.sampler.depth
        deeper = pressing.pressed(at.x[None], 2.0 * depth)[0]
        if not len(deeper):
            return
        below = _Pressed.at(pressing, at.shapes, deeper[0])
        n, further = at.place.n[0], float(below.place.e[0] - at.place.e[0])
        rest, more = self._both(at)[:2], self._both(below)[:2]
        K = [(f @ below.place.n[0] - f0 @ n) / further for f0, f in zip(rest, more, strict=True)]
        yield compared("contact_stiffness", name, K[1], K[0], law.stiffness)
        begins = float(rest[0] @ n) / K[0] - float(rest[1] @ n) / K[1]
        yield surface_difference("contact_surface", name, begins, depth, _bluntness(pressing.contact))
        load = float(rest[0] @ n)
        closing = _CLOSING * load / law.damping if law.damping > 0.0 else pressing.speed
        *forces, v = self._both(at, -closing * n)
        if -v @ n > _STUCK * closing:
            B = [float((f - f0) @ n) / float(-v @ n) for f0, f in zip(rest, forces, strict=True)]
            yield compared("contact_damping", name, B[1], B[0], load / closing)
        yield from self._friction(at, rest)
        yield from self._turning(at, load)
        yield self._inertia(at, rest[1])

    def _friction(self, at: _Pressed, rest: tuple[np.ndarray, ...]) -> Iterator[Coefficient]:
        """Friction and slip damping in two tangential directions; nothing where the contact cannot slide."""
        pressing, place, name = at.sampler, at.place, at.shapes.name
        law, n = pressing.contact.law, place.n[0]
        load, across = float(rest[0] @ n), np.eye(3) - np.outer(n, n)
        rubs = law.friction > 0.0 and law.slip_damping > 0.0
        slips = law.friction * load / law.slip_damping if rubs else pressing.speed

        def share(way: np.ndarray) -> float:
            """The attainable share of a requested velocity along the surfaces."""
            return float(np.linalg.norm(across @ pressing.moving(place, slips * way)[1])) / slips

        def rubbed(way: np.ndarray, speed: float) -> tuple[list[float], list[float], float]:
            """Both friction forces, both normal forces, and the sliding speed."""
            *forces, v = self._both(at, speed / share(way) * way)
            size = float(np.linalg.norm(across @ v))
            # Minus the forces at rest: the normals of two capsules may differ a little.
            friction = [float((f0 - f) @ across @ v) / size for f0, f in zip(rest, forces, strict=True)]
            return friction, [f @ n for f in forces], size

        along = max((way / np.linalg.norm(way) for way in across if np.linalg.norm(way) > 0.1), key=share)
        for way in (along, np.cross(n, along)):
            if share(way) < _STUCK:
                continue
            lifts = pressing.moving(place, slips * way)[1] @ n > 0.0
            way = -way if lifts else way
            friction, normal, speed = rubbed(way, _FAST * (1.0 + law.bend) * slips)
            if law.slip_damping * speed >= (1.0 + law.bend) * law.friction * normal[0]:  # else it may not slip
                yield compared("friction", name, friction[1] / normal[1], friction[0] / normal[0], 1.0)
            if rubs:
                friction, _, speed = rubbed(way, _SLOW * slips)
                yield compared("slip_damping", name, friction[1] / speed, friction[0] / speed, law.slip_damping)

    def _turning(self, at: _Pressed, load: float) -> Iterator[Coefficient]:
        """Torques of spinning and rolling friction; nothing where the contact cannot turn."""
        m, law, place, n = self._mechanism, at.sampler.contact.law, at.place, at.place.n[0]
        across = max(np.eye(3) - np.outer(n, n), key=lambda way: float(np.linalg.norm(way)))
        for arm, way in ((law.spinning, n), (law.rolling, across / np.linalg.norm(across))):
            if arm == 0.0:
                continue
            speed = _FAST * (1.0 + law.bend) * law.friction**2 * load / (law.tangential_damping * arm)
            rows = np.vstack([place.J[0], place.turning[0]])
            qd = np.linalg.pinv(rows, rcond=1e-6) @ np.append(np.zeros(3), speed * way)
            w, v = place.turning[0] @ qd, place.J[0] @ qd
            if w @ way < _STUCK * speed:
                continue
            moving = at.x.copy()
            moving[m.velocities] = qd
            ours, theirs = _planned(place, v, qd), self._force(at._replace(x=moving))
            given, planned = (-float(one[3:] @ way) / float(one[:3] @ n) for one in (theirs, ours))
            yield compared("contact_turning", at.shapes.name, given, planned, arm)

    def _inertia(self, at: _Pressed, rest: np.ndarray) -> Coefficient:
        """Share of a force along the normal that MuJoCo's contact force cancels, at the acceleration that it causes."""
        law, place, name = at.sampler.contact.law, at.place, at.shapes.name
        push = 0.1 * float(rest @ place.n[0])
        self._hold(at.x)
        qacc = np.empty((1, self._mechanism.nv))
        self._mujoco.mj_solveM(self._model, self._data, qacc, push * (place.J[0].T @ place.n[0])[None])
        change = rest - self._force(at, qacc[0])[:3]
        share = float(change @ place.n[0]) / push
        ahead = place.v[0] + law.lead * (place.J[0] @ qacc[0])
        forces = [_planned(place, v, qd) for v, qd in ((place.v[0], 0.0 * qacc[0]), (ahead, law.lead * qacc[0]))]
        ours = float((forces[0] - forces[1])[:3] @ place.n[0]) / push
        both = f"{100.0 * share:.3g} % of the force that it gives, the plan's {100.0 * ours:.3g} %"
        difference = abs(share - ours) / max(1.0, abs(ours))
        return Coefficient("contact_inertia", name, share, ours, difference, f"{name} takes up {both}")

    def stops(self, x: np.ndarray) -> Iterator[Coefficient]:
        """Every coefficient of every joint stop, the other joints at their start."""
        for stop in self._mechanism.stops:
            if stop.dof not in self._fixed:
                yield from self._stop(stop, x.copy())

    def _stop(self, stop: Stop, x: np.ndarray) -> Iterator[Coefficient]:
        m, law = self._mechanism, stop.law
        name = f"the stop of {joint_of(m, stop.dof)} at {stop.end:.4g}"
        depth = max(beyond_ramps(law), _REST, law.impedance[2] if law.lead > 0.0 else 0.0)  # K is that beyond the rise

        def both(deep: float, closing: float, speeding: float = 0.0) -> tuple[float, float]:
            x[m.q_address[stop.dof]] = stop.end + stop.side * (deep - law.margin)
            x[m.velocities] = 0.0
            x[m.nq + stop.dof] = stop.side * closing
            qacc = np.zeros(m.nv)
            qacc[stop.dof] = stop.side * speeding
            e, opening = stop_state(m, stop, x[None, : m.nq], x[None, m.velocities])
            ours = unilateral_force(law, e, opening - law.lead * speeding)
            return ours[0], self._limit(x, stop, qacc)

        held, deeper = both(depth, 0.0), both(2.0 * depth, 0.0)
        K = [(two - one) / depth for one, two in zip(held, deeper, strict=True)]
        yield compared("stop_stiffness", name, K[1], K[0], law.stiffness)
        yield surface_difference("stop_end", name, depth - held[1] / K[1], depth)
        closing = _CLOSING * held[0] / law.damping if law.damping > 0.0 else 1.0
        B = [(moved - one) / closing for one, moved in zip(held, both(depth, closing), strict=True)]
        yield compared("stop_damping", name, B[1], B[0], held[0] / closing)
        if law.lead > 0.0:
            speeding = closing / law.lead
            inertia = [(pushed - one) / speeding for one, pushed in zip(held, both(depth, 0.0, speeding), strict=True)]
            yield compared("stop_inertia", name, inertia[1], inertia[0], held[0] / speeding)

    def _limit(self, x: np.ndarray, stop: Stop, qacc: np.ndarray) -> float:
        """MuJoCo's joint-limit force at a state beyond the range and accelerations (nv,)."""
        self._hold(x, qacc)
        data, kind = self._data, int(self._mujoco.mjtConstraint.mjCNSTR_LIMIT_JOINT)
        joint = self._model.dof_jntid[stop.dof]
        rows = (np.asarray(data.efc_type) == kind) & (np.asarray(data.efc_id) == joint)
        return np.asarray(data.efc_force)[rows].sum()  # a NumPy scalar, so that dividing by 0 gives inf


def _planned(place: Any, v: np.ndarray, qd: np.ndarray) -> np.ndarray:
    """The plan's force and torque (6,) at a contact velocity (3,) and joint velocities (nv,)."""
    law = place.contact.law
    if law.condim <= 3:
        return np.append(contact_force(law, place.n, place.e, v[None])[0], np.zeros(3))
    return contact_wrench(law, place.n, place.e, v[None], (place.turning[0] @ qd)[None])[0][0]


def _bluntness(contact: AnyContact) -> float:
    """Upper limit of the error of the plan's closest points of two capsules, m: see contact.between_bodies."""
    if isinstance(contact, Contact) or contact.axis_regularization == 0.0:
        return 0.0
    return 0.5 * contact.law.ramp**2 / (contact.first.radius + contact.second.radius)
