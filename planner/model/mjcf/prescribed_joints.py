"""Make the twin of a machine some of whose joints are given their acceleration (the paper's Cases 2 and 3).

MuJoCo knows forces alone. So the joints that a plan prescribes are made heavy, and a motor pushes them as hard:

    (H + M_pp) a_p + M_pf a_f + h_p = H u     ->     a_p = u - tau_p / H

with H the armature of each degree of freedom and the gear of its motor, and tau_p the force that the plan's motion asks
of them. MuJoCo's ctrl is then the plan's u: the actuators, then the prescribed accelerations in the order of qvel. What
acts on such a joint alone does nothing in the plan, so it is taken out here: springs, dampers, curves, ranges and
actuators.

MuJoCo's contacts and stops are as hard as the inertias behind them, and these are others now: the force of every
contact and stop is kept by scaling its numbers (see planner.model.mjcf.contacts). A contact that pushes prescribed
joints alone moves nothing, and MuJoCo could not compute its force: it is left out.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from typing import Any
from weakref import WeakKeyDictionary
from xml.etree import ElementTree

import numpy as np

from planner.base.errors import ModelError
from planner.base.gl import load_mujoco
from planner.model.actuators import DIRECT, Actuators
from planner.model.mechanism import BALL, Mechanism
from planner.model.mjcf.contact_edits import joints_of, keep_law
from planner.model.mjcf.model_index import ModelIndex, compile_model, disabled
from planner.model.mjcf.text import parsed, written
from planner.model.mjcf.unsupported import actuators_of
from planner.model.passive_forces import ExponentialTorque
from planner.model.twin import Twin

# kg or kg m^2. A machine that pushes with 1000 N is felt as 1e-5 m/s^2. From about 1e11 on MuJoCo's solver, whose
# tolerance is relative to all inertias together, stops before the contacts of the rest are right.
PRESCRIBED_ARMATURE = 1e8

_twins: WeakKeyDictionary[Mechanism, dict[tuple[str, ...], Twin]] = WeakKeyDictionary()


def twin_of(mechanism: Mechanism, prescribed: Collection[str] = ()) -> Twin:
    """The model that a mechanism was read from, with the prescribed joints driven; the plan's state is MuJoCo's own."""
    if not prescribed:
        return Twin.of(mechanism)
    names = in_order(mechanism, prescribed)
    known = _twins.setdefault(mechanism, {})
    if names not in known:
        text = prescribe_joints(
            mechanism.mjcf, mechanism.assets, compile_model(mechanism.mjcf, mechanism.assets), names
        )
        curves = _felt(mechanism, prescribed_dofs(mechanism, names))
        known[names] = replace(Twin.of(mechanism), mjcf=text, source=mechanism.mjcf, curves=curves)
    return known[names]


def _felt(mechanism: Mechanism, dofs: np.ndarray) -> tuple[ExponentialTorque, ...]:
    """The curves of a mechanism that act on none of these degrees of freedom."""
    return tuple(curve for curve in mechanism.curves if curve.dof not in dofs)


def prescribed_twin(twin: Twin, model: Any, mechanism: Mechanism, prescribed: Collection[str]) -> Twin:
    """A twin whose text compiles to `model`, with its prescribed joints driven, unless they are already."""
    if not prescribed or model.nu != mechanism.nu:
        return twin
    return replace(twin, mjcf=prescribe_joints(twin.mjcf, twin.assets, model, in_order(mechanism, prescribed)))


def in_order(mechanism: Mechanism, prescribed: Collection[str]) -> tuple[str, ...]:
    """The names of joints in the order of qvel, each once."""
    return tuple(sorted(dict.fromkeys(prescribed), key=lambda name: mechanism.joint(name).start))


def heavy_joints(mechanism: Mechanism) -> list[str]:
    """Names of the joints that are made heavy already, their motion given by motors (planner.costs.driven_by_jerk)."""
    pairs = zip(mechanism.joint_names, mechanism.joint_links, strict=True)
    return [name for name, dofs in pairs if np.any(mechanism.armature[dofs] >= PRESCRIBED_ARMATURE)]


def prescribed_dofs(mechanism: Mechanism, prescribed: Collection[str]) -> np.ndarray:
    """(n,) the degrees of freedom of these joints, in order."""
    every = np.arange(mechanism.nv)
    dofs = [every[mechanism.joint(name)] for name in in_order(mechanism, prescribed)]
    return np.concatenate([every[:0], *dofs])


def prescribed_dofs_of(dynamics: Any) -> np.ndarray:
    """(n,) the degrees of freedom that dynamics of any kind prescribe; none where they have no `prescribed`."""
    prescribed = getattr(dynamics, "prescribed", ())
    return prescribed_dofs(dynamics.mechanism, prescribed) if prescribed else np.zeros(0, dtype=int)


def prescribe_joints(mjcf: str, assets: dict[str, bytes], model: Any, prescribed: Collection[str]) -> str:
    """An MJCF text that compiles to `model`, with some of its joints, in the order of qvel, driven by accelerations."""
    root, survey = parsed(mjcf, "the model"), ModelIndex(model)
    known = [model.joint(j).name for j in range(model.njnt)]
    for name in prescribed:
        if name not in known:
            raise ModelError(f"the model has no joint {name!r}, expected one of: {', '.join(filter(None, known))}.")
    if disabled(model, "actuation"):
        raise ModelError("the model's actuators are switched off, expected actuation: its prescribed joints need it.")
    joints = [int(model.joint(name).id) for name in prescribed]
    elements = joints_of(root, model)
    for j in joints:
        _release(elements[j], model, j)
    silent = _silent(model, joints)  # they keep their controls and activations
    own = actuators_of(root, model, "no joint is driven") if silent else []
    for i in silent:
        own[i].set("gear", "0")
    _add_motors(root, model, joints)
    # The same file, but for inertias and what does not move them: it says how soft the contacts have become.
    heavy = compile_model(root, assets, "the model with its prescribed joints driven")
    _keep_stops(elements, model, heavy)
    if survey.pairs:
        keep_law(root, survey, heavy.body_invweight0[:, 0], _still(model, joints))
    return ElementTree.tostring(root, encoding="unicode")


def _release(element: ElementTree.Element, model: Any, joint: int) -> None:
    """Take out what acts on a joint and make it heavy."""
    if element.tag == "freejoint":  # which takes no armature
        if "align" in element.attrib:
            raise ModelError(
                f"joint {element.get('name')!r} is a freejoint with align, expected one without: it is prescribed."
            )
        element.tag = "joint"
        element.set("type", "free")
    element.attrib.update(
        armature=written(PRESCRIBED_ARMATURE),
        damping="0",
        stiffness="0",
        springdamper="0 0",
        frictionloss="0",
        limited="false",
    )
    if model.jnt_actfrclimited[joint]:
        element.set("actuatorfrclimited", "false")


def _silent(model: Any, joints: list[int]) -> list[int]:
    """The actuators that act on nothing but these joints."""
    kinds = load_mujoco().mjtTrn
    found = []
    for i, (kind, target) in enumerate(zip(model.actuator_trntype, model.actuator_trnid[:, 0], strict=True)):
        moved = [int(target)]
        if kind == int(kinds.mjTRN_TENDON):
            wraps = slice(model.tendon_adr[target], model.tendon_adr[target] + model.tendon_num[target])
            moved = [int(joint) for joint in model.wrap_objid[wraps]]
        elif kind not in (int(kinds.mjTRN_JOINT), int(kinds.mjTRN_JOINTINPARENT)):
            continue
        if set(moved) <= set(joints):
            found.append(i)
    return found


def _add_motors(root: ElementTree.Element, model: Any, joints: list[int]) -> None:
    """One motor per degree of freedom of these joints, and a zero for each in every keyframe."""
    section, taken = ElementTree.SubElement(root, "actuator"), {model.actuator(i).name for i in range(model.nu)}
    group = next(g for g in range(32) if not model.opt.disableactuator & (1 << g))
    motors = 0
    for j in joints:
        dofs = int(np.count_nonzero(model.dof_jntid == j))
        for axis in range(dofs):
            gear = [PRESCRIBED_ARMATURE if k == axis else 0.0 for k in range(dofs)]
            name = _motor(model.joint(j).name, axis, dofs)
            while name in taken:
                name += "'"
            taken.add(name)
            own = {"name": name, "joint": model.joint(j).name, "gear": written(*gear), "group": str(group)}
            ElementTree.SubElement(section, "motor", own, ctrllimited="false", forcelimited="false")
            motors += 1
    for key in root.iterfind("keyframe/key"):
        if "ctrl" in key.attrib:
            key.set("ctrl", " ".join([key.attrib["ctrl"], *["0"] * motors]))


def _motor(joint: str, axis: int, dofs: int) -> str:
    """Name of the motor in MuJoCo's warnings and in reports of parity."""
    return f"acceleration of {joint}" + (f" {axis + 1}" if dofs > 1 else "")


def _keep_stops(elements: list[ElementTree.Element], model: Any, heavy: Any) -> None:
    """Rescale the stops whose numbers are relative to the inertia behind them, so that their force stays."""
    for j in map(int, np.flatnonzero(heavy.jnt_limited)):
        if heavy.jnt_solref[j, 0] >= 0.0:  # see Mechanism.without_lead_stops
            continue
        dof = int(model.jnt_dofadr[j])
        ratio = float(heavy.dof_invweight0[dof] / model.dof_invweight0[dof])
        elements[j].set("solreflimit", written(*ratio * model.jnt_solref[j]))


def _still(model: Any, joints: list[int]) -> np.ndarray:
    """(nbody,) bodies that no joints but these move."""
    still = np.ones(model.nbody, dtype=bool)
    for body in range(1, model.nbody):
        own = np.flatnonzero(model.jnt_bodyid == body)
        still[body] = still[model.body_parentid[body]] and bool(np.isin(own, joints).all())
    return still


def with_force_inputs(mechanism: Mechanism, prescribed: Collection[str]) -> Mechanism:
    """The mechanism of a driven twin but for its armature: the other half of a parity.

    Without armature, springs, dampers, friction, curves and actuators of the prescribed joints, and with a motor of
    gear HEAVY for each of their degrees of freedom; without contacts and stops.
    """
    dofs = prescribed_dofs(mechanism, prescribed)
    given = np.zeros(mechanism.nv, dtype=bool)
    given[dofs] = True
    a, n = mechanism.actuators, len(dofs)
    silent = ~np.any(a.acts_on[:, ~given], axis=1)  # acts on nothing else
    moment, free = np.where(silent[:, None], 0.0, a.moment), np.tile([-np.inf, np.inf], (n, 1))
    links = {name: mechanism.joint(name) for name in in_order(mechanism, prescribed)}
    sizes = {name: part.stop - part.start for name, part in links.items()}
    motors = {
        "moment": PRESCRIBED_ARMATURE * np.eye(mechanism.nv)[dofs], "gain": np.ones(n), "bias": np.zeros((n, 3)),
        "dynamics": np.full(n, DIRECT), "activation": np.full(n, -1), "time_constant": np.ones(n),
        "control_range": free, "force_range": free, "activation_range": free,
    }  # fmt: skip
    own = vars(a) | {"moment": moment}
    actuators = Actuators(
        names=(*a.names, *(_motor(name, axis, size) for name, size in sizes.items() for axis in range(size))),
        **{name: np.concatenate([own[name], more]) for name, more in motors.items()},
        wrenches=tuple(one for one in a.wrenches if not silent[one.actuator]),
        laws=tuple(one for one in a.laws if not silent[one.actuator]),
    )
    balls = given[mechanism.kind == BALL]
    return replace(
        mechanism, armature=np.where(given, 0.0, mechanism.armature), damping=np.where(given, 0.0, mechanism.damping),
        stiffness=np.where(given, 0.0, mechanism.stiffness),
        friction_loss=np.where(given, 0.0, mechanism.friction_loss),
        ball_stiffness=np.where(balls, 0.0, mechanism.ball_stiffness), actuators=actuators, contacts=(), stops=(),
        curves=_felt(mechanism, dofs),
    )  # fmt: skip
