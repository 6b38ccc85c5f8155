"""Simulate a plan in another engine: the text for its parser, forces that it does not read, SciPy's DOP853 by stages.

The forces of actuators, springs, dampers, tendons and exponential torques are those of the mechanism from MuJoCo's
compiler for the same text. Controls are constant over a stage, so each stage is integrated separately: within it the
equation is smooth.

Names map the joints of two engines. No dynamics are changed; all changes of the text are reported.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np

from planner.base.errors import ModelError
from planner.dynamics.joint_forces import actuator_forces, actuator_moments
from planner.model.actuators import DIRECT, INTEGRATOR
from planner.model.mechanism import SCREW, Mechanism
from planner.model.mjcf.contact_edits import joints_of
from planner.model.mjcf.text import parsed
from planner.model.passive_forces import exponential_joint_torques, tendon_forces
from planner.model.space import conjugate, log_quaternion, product, unit
from planner.model.twin import Twin
from planner.problem.plan import Plan

PARTS = 4  # samples per stage at which trajectories are compared
RELATIVE, ABSOLUTE = 1e-10, 1e-12  # tolerances of the integrator
RUNAWAY = 1e10  # divergence threshold, as in MuJoCo
_MAX_EVALUATIONS = 500  # average limit of evaluations per stage; a stage of 0.01 s takes about twenty

Rates = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""(qvel, qacc, d act/dt), (2 nv + na,), at one state x (nx,) with the controls u (nu,)."""


class _RanAway(Exception):
    """The trajectory has diverged."""


def motion(plan: Plan, mechanism: Mechanism, x0: np.ndarray, rates: Rates, feedback: bool) -> np.ndarray:
    """States (N * PARTS + 1, nx) from x0 under a plan's controls; NaN after divergence.

    With `feedback` the plan's gains act at every evaluation, on the deviation from the plan at that instant, between
    knots too.
    """
    from scipy.integrate import solve_ivp

    assert plan.problem is not None  # its dynamics are needed
    dynamics, space, evaluations = plan.problem.dynamics, plan.space, 0
    bounds = plan.problem.bounds
    xs = np.full((plan.N * PARTS + 1, len(x0)), np.nan)
    xs[0] = x = x0
    dt = float(dynamics.dt)
    times = dt / PARTS * np.arange(1, PARTS + 1)

    def rate(t: float, x: np.ndarray, n: int) -> np.ndarray:
        nonlocal evaluations
        evaluations += 1
        if evaluations > _MAX_EVALUATIONS * plan.N or not np.all(np.abs(x) < RUNAWAY):
            raise _RanAway
        x, u = normalized(mechanism, x), plan.us[n]
        if feedback:
            wanted = dynamics.step(plan.xs[n : n + 1], plan.us[n : n + 1], np.array([t]))[0]
            u = plan.within_bounds(n, u + plan.K[n] @ space.difference(x, wanted))
            u = u if bounds is None else bounds.clamped(n, u, x)
        return _lifted(mechanism, x, rates(x, u))

    for n in range(plan.N):
        try:
            found = solve_ivp(
                rate, (0.0, dt), x, method="DOP853", t_eval=times, args=(n,), rtol=RELATIVE, atol=ABSOLUTE
            )
        except _RanAway:
            break
        if not found.success or found.y.shape[1] != PARTS:
            break
        rows = normalized(mechanism, found.y.T)
        xs[n * PARTS + 1 : (n + 1) * PARTS + 1], x = rows, rows[-1]
    return xs


def normalized(mechanism: Mechanism, x: np.ndarray) -> np.ndarray:
    """States (..., nx) with quaternions of length one."""
    if not mechanism.quaternions:
        return x
    x = np.array(x)
    for address, _ in mechanism.quaternions:
        x[..., address : address + 4] = unit(x[..., address : address + 4])
    return x


def _lifted(mechanism: Mechanism, x: np.ndarray, rates: np.ndarray) -> np.ndarray:
    """dx/dt (nx,) from rates (2 nv + na,): quaternion derivatives from angular velocities in the body frame."""
    nq, nv = mechanism.nq, mechanism.nv
    result = np.empty(len(x))
    result[nq:] = rates[nv:]
    screws = mechanism.kind == SCREW
    result[mechanism.q_address[screws]] = rates[:nv][screws]
    for address, dof in mechanism.quaternions:
        turning = np.concatenate([[0.0], rates[dof : dof + 3]])
        result[address : address + 4] = 0.5 * product(x[address : address + 4], turning)
    return result


class Applied:
    """The forces tau(q, v, act, u) on the joints of a mechanism, and the rates of its activations."""

    def __init__(self, mechanism: Mechanism, damping: np.ndarray) -> None:
        """For an engine with the mechanism's inertia and gravity; `damping` (nv,) is the damping that it lacks."""
        self._mechanism, self._damping = mechanism, damping
        self._screws = mechanism.kind == SCREW
        actuators = mechanism.actuators
        self._states = np.flatnonzero(actuators.dynamics != DIRECT)
        self._places = actuators.activation[self._states]
        self._integrates = actuators.dynamics[self._states] == INTEGRATOR

    def __call__(self, q: np.ndarray, v: np.ndarray, act: np.ndarray, u: np.ndarray) -> np.ndarray:
        """The forces tau (nv,) at one state with the controls u (nu,)."""
        m, actuators = self._mechanism, self._mechanism.actuators
        place = np.where(self._screws, q[m.q_address], 0.0)
        given = np.array(u, dtype=float)
        given[self._states] = act[self._places]
        force = actuator_forces(actuators, given, actuators.moment @ place, actuators.moment @ v)
        tau = actuator_moments(m, q).T @ force
        tau -= self._damping * v + m.stiffness * (place - np.where(self._screws, m.spring_rest, 0.0))
        for (address, dof), stiffness, rest in zip(m.quaternions, m.ball_stiffness, m.ball_rest, strict=True):
            turned = log_quaternion(product(conjugate(rest), q[address : address + 4]))
            tau[dof : dof + 3] -= stiffness * turned
        tau = tau + tendon_forces(m, q, v) if m.tendons else tau
        return tau + exponential_joint_torques(m, q) if m.curves else tau

    def activation_rates(self, act: np.ndarray, u: np.ndarray) -> np.ndarray:
        """The rates (na,) of the activations."""
        rates, given = np.zeros(len(act)), u[self._states]
        constant = self._mechanism.actuators.time_constant[self._states]
        rates[self._places] = np.where(self._integrates, given, (given - act[self._places]) / constant)
        return rates

    def phrases(self) -> list[str]:
        """The added forces, a phrase for each kind."""
        m = self._mechanism
        springs = m.stiffness != 0.0
        for (_, dof), stiffness in zip(m.quaternions, m.ball_stiffness, strict=True):
            springs[dof : dof + 3] = stiffness != 0.0
        curved = np.isin(np.arange(m.nv), [curve.dof for curve in m.curves])
        pulled = np.isin(np.arange(m.nv), [dof for tendon in m.tendons if tendon.acts for dof in tendon.dofs])
        kinds = {
            "springs": springs, "damping": self._damping != 0.0, "tendons": pulled, "exponential torques": curved,
        }  # fmt: skip
        found = [f"{kind} of {joints_with(m, on)}" for kind, on in kinds.items() if np.any(on)]
        names = [name or f"actuator {i}" for i, name in enumerate(m.actuators.names)]
        return [f"forces of the actuators {', '.join(names)}", *found] if names else found


def joints_with(mechanism: Mechanism, dofs: np.ndarray) -> str:
    """Names of the joints of selected degrees of freedom, (nv,) bool."""
    pairs = zip(mechanism.joint_names, mechanism.joint_links, strict=True)
    return ", ".join(name or f"joint {j}" for j, (name, own) in enumerate(pairs) if np.any(dofs[own]))


_POSE = ("pos", "quat", "axisangle", "xyaxes", "zaxis", "euler")


class Prepared(NamedTuple):
    """A model's text, prepared for another parser."""

    path: Path
    joints: tuple[str, ...]  # Names, in MuJoCo's order
    bodies: tuple[str, ...]  # The body of each joint
    changes: tuple[str, ...]  # Changes of the text, a phrase each


def prepared(twin: Twin, model: Any, folder: Path) -> Prepared:
    """Write a twin's text, which compiles to `model`, and its files into a folder.

    A body with several joints becomes a chain of bodies with one joint each: Drake places the first of them at the
    parent, and Pinocchio ignores their `ref`. Several worldbodies are merged, since Pinocchio reads only the first.

    Raises:
        ModelError: The text lacks joints of the model, or names files that the twin lacks.
    """
    root = parsed(twin.mjcf, "the model")
    root.attrib.setdefault("model", "model")  # Drake requires a name
    worlds, changes = root.findall("worldbody"), []
    for other in worlds[1:]:  # Pinocchio would read all of them once per section
        worlds[0].extend(other)
        root.remove(other)
    if worlds[1:]:
        changes.append(f"its {len(worlds)} worldbody sections are one")
    for keyframes in root.findall("keyframe"):
        root.remove(keyframes)
        changes.append("its keyframes are left out")
    if root.find("worldbody//frame") is not None:
        raise ModelError("the file has a <frame>, which this parser does not read")
    joints = joints_of(root, model)
    parents = {child: parent for parent in root.iter() for child in parent}
    named = _name(joints, "joint") + _name(list(root.iterfind("worldbody//body")), "body")
    if named:
        changes.append(f"{named} joints and bodies without a name have one")
    bodies = tuple(parents[joint].attrib["name"] for joint in joints)
    several = [body for body in parents if body.tag == "body" and len(_joints(body)) > 1]
    for body in several:
        _split(body, parents[body], root)
    if several:
        changes.append(f"{len(several)} bodies with several joints are chains of bodies with one joint")
    tops = worlds[0].findall("body")
    if len(tops) > 1:
        changes.append(f"its {len(tops)} bodies in the world hang on one body without mass, fixed to the world")
        base = ElementTree.SubElement(worlds[0], "body", name=_unused("base", root))
        for body in tops:
            worlds[0].remove(body)
            base.append(body)
    _write(root, twin.assets, folder)
    return Prepared(
        folder / "model.xml", tuple(joint.attrib["name"] for joint in joints), bodies, tuple(changes)
    )  # fmt: skip


def _joints(body: ElementTree.Element) -> list[ElementTree.Element]:
    return [child for child in body if child.tag in ("joint", "freejoint")]


def _split(body: ElementTree.Element, parent: ElementTree.Element, root: ElementTree.Element) -> None:
    """Make a chain of a body with several joints; all links share its frame, only the last has its mass."""
    place = list(parent).index(body)
    parent.remove(body)
    for joint in _joints(body)[:-1]:
        link = ElementTree.Element("body", name=_unused(f"{body.get('name')}_{joint.get('name')}", root))
        link.attrib.update({key: body.attrib.pop(key) for key in _POSE if key in body.attrib})
        if "childclass" in body.attrib:
            link.set("childclass", body.attrib["childclass"])
        body.remove(joint)
        link.append(joint)
        parent.insert(place, link)
        parent, place = link, len(link)
    parent.append(body)


def _name(elements: list[ElementTree.Element], kind: str) -> int:
    """Name the unnamed elements; returns how many."""
    taken, named = {element.get("name") for element in elements}, 0
    for i, element in enumerate(elements):
        if not element.get("name"):
            name = f"{kind}_{i}"
            while name in taken:
                name += "_"
            element.set("name", name)
            taken.add(name)
            named += 1
    return named


def _unused(name: str, root: ElementTree.Element) -> str:
    taken = {element.get("name") for element in root.iter()}
    while name in taken:
        name += "_"
    return name


def _write(root: ElementTree.Element, assets: dict[str, bytes], folder: Path) -> None:
    """Write the text as model.xml, and the files that it references in the same folder."""
    for element in root.iterfind("asset/*"):
        file = element.get("file")
        if file is not None and element.tag != "texture":
            if file not in assets or Path(file).name != file:  # no access outside of the folder
                raise ModelError(f"the text names the file {file!r}, which the plan does not hold")
            (folder / file).write_bytes(assets[file])
    ElementTree.ElementTree(root).write(folder / "model.xml", encoding="utf-8")
