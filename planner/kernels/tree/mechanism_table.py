"""A mechanism as kernels read it: one int64 table of sizes and addresses, and the arrays behind it.

Every screw is a turn about an axis and a shift along it (Chasles). Each link gets a frame of its own whose z axis is
its screw's, so that revolute, prismatic and helical joints are one formula with two constants, turn and shift:

    T = H Rot_z(turn q) Trans_z(shift q),   S = (turn z, shift z) at the frame's origin,

with H constant and q_home taken out. A ball's links share a frame at the anchor, with axes x, y, z. Each tree is
described about an origin of its own, the first joint's place at home or, for a floating tree, wherever it is:
dynamics do not depend on where a tree stands, but rounding does.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from planner.base.errors import PlannerError
from planner.kernels.numba.lanes import WIDTH
from planner.kernels.numba.layout import Layout
from planner.kernels.tree.actuator_arrays import actuator_arrays, law_arrays, motor_arrays, wrench_arrays
from planner.kernels.tree.contact_tables import contact_arrays, pair_arrays, soft_arrays, stop_arrays
from planner.kernels.tree.loop_arrays import loop_arrays, triples_of
from planner.kernels.tree.passive_force_arrays import drag_arrays, gravcomp_arrays, joint_row_arrays, tendon_arrays
from planner.model.contact.body_contact import common_carrier
from planner.model.passive_forces import acting_tendons, implicit_damping

HOME_SIZE = 15  # of a link's constants: H by rows (9) and its place (3), turn, shift, and shift of the place
INERTIA_SIZE = 11  # its mass, its centre of mass (3), its inertia about that in seven numbers (see _inertias)
SCREW, BALL, BALL_NEXT, FLOATING = 0, 1, 2, 3  # as in planner.model.mechanism, and a slide that moves a whole tree

TREE = Layout(
    "nv nq nballs nu na inputs position_terms velocity_terms contacts stops pairs curves tendons gravcomp drags losses "
    "rows dependents loops polynomial_couplings loop_rows triples wrenches laws softs",
    "parent base kind first q_address home inertia subtree_mass armature base_acceleration damping stiffness rest "
    "ball_q ball_v ball_stiffness ball_rest constant input_dof input_index input_value position_row position_column "
    "position_value velocity_row velocity_column velocity_value activation_input activation_gain activation_rate "
    "prescribed related_start related_rows contact_link contact_address contact_slide contact_value stop_dof "
    "stop_value pair_links pair_value curve_dof curve_value curve_start curve_slope_dof curve_slope "
    "tendon_start tendon_dof tendon_factor tendon_value gravcomp_value gravcomp_mass drag_link drag_value row_dof "
    "row_value dependent_dof dependent_start dependent_column dependent_value joined_link joined_address joined_value "
    "loop_rigid loop_rate coupling_dof coupling_value triple_kind moved_start moved_dof reach_start reach_dof "
    "shared_start shared_dof bound_start bound_rows block_start block_stop implicit_damping "
    "wrench_link wrench_frame wrench_input wrench_start wrench_dof wrench_frame_start wrench_frame_dof wrench_value "
    "law_kind law_input law_value law_start law_dof law_factor law_push soft_link soft_address soft_value "
    "motor_start motor_dof motor_factor motor_ball motor_input motor_law motor_value",
)


class Model:
    """The arrays of a mechanism and the table of their addresses.

    Args:
        mechanism: A planner.Mechanism.
        prescribed: (nv,) True where the acceleration is an input instead of the force.
        actuated: Whether actuators, contacts, stops, curves and friction loss act; the public dynamics functions take
            applied forces instead. Tendons, gravity compensation and drag are the mechanism's own, as springs are.
        implicit: Whether steps take damping implicitly (kernels.tree.rosenbrock).

    Attributes:
        table: The argument of kernels.
        external: True where contacts, stops, curves, tendons, gravity compensation, drag, friction loss, couplings or
            wrenches or force laws of actuators act, or damping is implicit, else None. Kernels take it beside the
            table: Numba compiles them once for each type and leaves out, for None, what stands under
            `if external is not None`.
    """

    def __init__(
        self, mechanism: Any, prescribed: np.ndarray | None = None, actuated: bool = True, implicit: bool = False
    ) -> None:  # fmt: skip
        nv = mechanism.nv
        prescribed = np.zeros(nv, dtype=bool) if prescribed is None else prescribed
        arrays: dict[str, np.ndarray] = {**_tree(mechanism), **actuator_arrays(mechanism, prescribed, actuated)}
        self.nv, self.nq = nv, mechanism.nq
        self.nu = (mechanism.nu if actuated else 0) + int(prescribed.sum())
        self.na = mechanism.na if actuated else 0
        coupled = np.zeros((nv, nv), dtype=bool)
        for name in ("position", "velocity"):
            coupled[arrays[f"{name}_row"], arrays[f"{name}_column"]] = True
        contacts, stops = (mechanism.contacts, mechanism.stops) if actuated else ((), ())
        pairs = mechanism.body_contacts if actuated else ()
        curves = mechanism.curves if actuated else ()
        tendons, losses = acting_tendons(mechanism), mechanism.friction_loss * actuated
        gravcomp = bool(np.any(mechanism.gravcomp_mass) or np.any(mechanism.gravcomp_first_moment))
        reduction = mechanism.reduction if actuated else None
        self.coupled = reduction is not None
        wrenches = mechanism.actuators.wrenches if actuated else ()
        laws = mechanism.actuators.laws if actuated else ()
        loops, polynomial_couplings = (mechanism.loops, mechanism.polynomial_couplings) if actuated else ((), ())
        self.loop_rows = 3 * triples_of(loops, polynomial_couplings)
        soft, contacts = _by_lead(contacts)
        met, stops = _by_lead(stops)
        self.softs = len(soft)
        for contact in (*(one for one in soft if one.plane.slide >= 0), *(one for one in pairs if one.law.lead > 0.0)):
            raise PlannerError(f"{contact.name} has a law with a lead, expected a sphere and a plane at rest.")
        acts = (
            contacts
            or soft
            or stops
            or met
            or pairs
            or curves
            or tendons
            or gravcomp
            or mechanism.drags
            or np.any(losses)
        )
        acts = acts or self.coupled or implicit or self.loop_rows or wrenches or laws
        self.external = True if acts else None
        for tendon in tendons:
            coupled[np.ix_(tendon.dofs, tendon.dofs)] = True
        for law in laws:
            coupled[np.ix_(*2 * [np.flatnonzero(mechanism.actuators.moment[law.actuator])])] = True
        for curve in curves:
            for j, _ in curve.slopes:
                coupled[curve.dof, j] = True
        for contact in contacts:
            i = contact.link
            while i >= 0 and contact.plane.slide >= 0:  # a belt feels what touches it
                coupled[i, contact.plane.slide] = coupled[contact.plane.slide, i] = True
                i = mechanism.parent[i]
        for pair in pairs:
            common = common_carrier(mechanism.parent, pair)
            chains = [chain_of(mechanism.parent, part.link, common) for part in (pair.first, pair.second)]
            coupled[np.ix_(chains[0], chains[1])] = coupled[np.ix_(chains[1], chains[0])] = True
        for coupling in polynomial_couplings:
            coupled[coupling.leader, coupling.leader] = True
        for wrench in wrenches:
            coupled[np.ix_(wrench.dofs, wrench.frame_dofs)] = True
        arrays["related_start"], arrays["related_rows"] = _related(mechanism.parent, coupled)
        arrays |= (
            contact_arrays(contacts, mechanism, arrays)
            | soft_arrays(soft, arrays)
            | stop_arrays(stops)
            | pair_arrays(pairs, mechanism.parent, arrays)
        )
        arrays |= _curves(curves) | tendon_arrays(tendons) | gravcomp_arrays(mechanism, arrays["frames"])
        arrays |= drag_arrays(mechanism.drags, arrays["frames"]) | motor_arrays(mechanism, arrays["ball_v"], self.nu)
        arrays |= joint_row_arrays(mechanism, losses, met) | _dependents(reduction)
        chains = [{i for link in loop.links for i in chain_of(mechanism.parent, link)} for loop in loops]
        arrays |= loop_arrays(loops, polynomial_couplings, chains, mechanism, arrays)
        arrays["implicit_damping"] = implicit_damping(mechanism)
        arrays |= wrench_arrays(mechanism, wrenches, arrays["frames"], self.nu)
        arrays |= law_arrays(mechanism, laws, prescribed, self.nu)
        sizes = {
            "nv": nv, "nq": mechanism.nq, "nballs": len(mechanism.quaternions), "nu": self.nu, "na": self.na,
            "inputs": len(arrays["input_dof"]), "position_terms": len(arrays["position_row"]),
            "velocity_terms": len(arrays["velocity_row"]), "contacts": len(contacts), "stops": len(stops),
            "pairs": len(pairs), "curves": len(curves), "tendons": len(tendons), "gravcomp": int(gravcomp),
            "drags": len(mechanism.drags), "losses": int(np.count_nonzero(losses)), "rows": len(arrays["row_dof"]),
            "dependents": len(arrays["dependent_dof"]),
            "loops": len(loops), "polynomial_couplings": len(polynomial_couplings),
            "loop_rows": self.loop_rows, "triples": self.loop_rows // 3, "wrenches": len(wrenches), "laws": len(laws),
            "softs": len(soft),
        }  # fmt: skip
        self.arrays = {name: _plain(arrays[name]) for name in TREE.arrays}  # keeps the addresses alive
        self.table = TREE.table(sizes, self.arrays)
        self.own_frames = arrays["frames"]  # (nv, 4, 4) the kernels' frames in the mechanism's
        self.origin = arrays["origin"]  # (nv, 3) what world positions are relative to, but for floating trees
        self.floating = arrays["kind"] == FLOATING
        self.floating_address = arrays["floating_address"]  # (nv,) where qpos holds a floating tree's place, or -1


def _by_lead(parts: Any) -> tuple[list[Any], list[Any]]:
    """Contacts or stops whose law has a lead, and the others."""
    return [one for one in parts if one.law.lead > 0.0], [one for one in parts if one.law.lead == 0.0]


def chain_of(parent: np.ndarray, link: int, end: int = -1) -> list[int]:
    """A link and what carries it, up to the end, which is left out."""
    chain = []
    while link != end:
        chain.append(int(link))
        link = int(parent[link])
    return chain


def _plain(array: np.ndarray) -> np.ndarray:
    kind = np.float64 if array.dtype.kind == "f" else np.int64
    result = np.array(array, dtype=kind, order="C").reshape(-1)
    return result if result.size else np.zeros(1, dtype=kind)


def _tree(mechanism: Any) -> dict[str, np.ndarray]:
    nv = mechanism.nv
    kind = np.array(mechanism.kind)
    first = np.arange(nv)
    for i in range(nv):
        if kind[i] == BALL_NEXT:
            first[i] = first[i - 1]
    for links in mechanism.joint_links:
        if links.stop - links.start == 6:  # a free joint
            kind[links.start : links.start + 3] = FLOATING
    roots = np.arange(nv)
    for i in range(nv):
        if mechanism.parent[i] >= 0:
            roots[i] = roots[mechanism.parent[i]]
    frames = np.array([_own_frame(mechanism.S[i], kind[i]) for i in range(nv)]).reshape(nv, 4, 4)
    for _, i in mechanism.quaternions:
        S = mechanism.S[i : i + 3]  # (e_k, anchor x e_k)
        frames[i : i + 3, :3, 3] = [S[1, 5], S[2, 3], S[0, 4]]
    home, origin = np.zeros((nv, HOME_SIZE)), np.zeros((nv, 3))
    for i in range(nv):
        carrier = mechanism.parent[i]
        before = np.eye(4) if carrier < 0 else np.linalg.inv(frames[carrier])
        turn, shift = _turn_and_shift(mechanism.S[i], kind[i])
        T = before @ mechanism.T_home[i] @ frames[i] @ _screw_motion(-mechanism.q_home[i], turn, shift)
        if kind[i] == FLOATING:
            T[:3, 3] = 0.0
        elif carrier < 0:
            origin[i], T[:3, 3] = T[:3, 3], 0.0
        else:
            origin[i] = origin[roots[i]]
        moved = 0.0 if kind[i] == FLOATING else shift  # its own place is the origin
        home[i, :9], home[i, 9:12], home[i, 12:] = T[:3, :3].ravel(), T[:3, 3], [turn, shift, moved]
    subtree_mass = mechanism.mass.copy()
    for i in reversed(range(nv)):
        if mechanism.parent[i] >= 0:
            subtree_mass[mechanism.parent[i]] += subtree_mass[i]
    floating = np.where(kind[roots] == FLOATING, mechanism.q_address[roots], -1)
    balls = np.array(mechanism.quaternions, dtype=np.int64).reshape(-1, 2)
    return {
        "parent": mechanism.parent, "base": mechanism.base, "kind": kind, "first": first,
        "q_address": mechanism.q_address, "home": home, "inertia": _inertias(mechanism, frames),
        "subtree_mass": subtree_mass, "armature": mechanism.armature, "base_acceleration": -mechanism.gravity,
        "damping": mechanism.damping, "stiffness": mechanism.stiffness, "rest": mechanism.spring_rest,
        "ball_q": balls[:, 0], "ball_v": balls[:, 1], "ball_stiffness": mechanism.ball_stiffness,
        "ball_rest": mechanism.ball_rest, "origin": origin, "frames": frames, "floating_address": floating,
    }  # fmt: skip


def _turn_and_shift(S: np.ndarray, kind: int) -> tuple[float, float]:
    """How much a screw turns and shifts per unit of q."""
    if kind in (BALL, BALL_NEXT):
        return 1.0, 0.0
    w, v = S[:3], S[3:]
    return (1.0, float(w @ v)) if np.any(w) else (0.0, 1.0)


def _screw_motion(q: float, turn: float, shift: float) -> np.ndarray:
    c, s = np.cos(turn * q), np.sin(turn * q)
    return np.array([[c, -s, 0.0, 0.0], [s, c, 0.0, 0.0], [0.0, 0.0, 1.0, shift * q], [0.0, 0.0, 0.0, 1.0]])


def _own_frame(S: np.ndarray, kind: int) -> np.ndarray:
    """Where the kernels' frame of a link is, in the link's own (4, 4)."""
    G = np.eye(4)
    if kind in (BALL, BALL_NEXT):
        return G
    w, v = S[:3], S[3:]
    axis = w if np.any(w) else v
    other = np.eye(3)[np.argmin(np.abs(axis))]
    x = np.cross(other, axis)
    x /= np.linalg.norm(x)
    G[:3, 0], G[:3, 1], G[:3, 2] = x, np.cross(axis, x), axis
    G[:3, 3] = np.cross(w, v)  # the point of the axis that is nearest to the link's origin
    return G


def _inertias(mechanism: Any, frames: np.ndarray) -> np.ndarray:
    """(nv, 11) in each link's frame: m, c (3), j, a (3), b (3), with j 1 - a a' - b b' the inertia about c."""
    R = frames[:, :3, :3]
    c = np.einsum("nji,nj->ni", R, mechanism.com - frames[:, :3, 3])
    moments, axes = np.linalg.eigh(mechanism.inertia)
    lengths = np.sqrt(moments[:, 2:] - moments[:, :2])
    vectors = lengths[:, :, None] * np.einsum("nji,njk->nki", R, axes)[:, :2]
    return np.concatenate([mechanism.mass[:, None], c, moments[:, 2:], vectors.reshape(-1, 6)], axis=1)


def _related(parent: np.ndarray, coupled: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """For each block of four columns, the rows of dtau/dq that are not zero: relatives, and what actuators couple."""
    n = len(parent)
    related = coupled | np.eye(n, dtype=bool)
    for i in range(n):
        j = parent[i]
        while j >= 0:
            related[i, j] = related[j, i] = True
            j = parent[j]
    blocks = [np.flatnonzero(related[:, j : j + WIDTH].any(axis=1)) for j in range(0, n, WIDTH)]
    return np.cumsum([0, *(len(rows) for rows in blocks)]), np.concatenate(blocks)


def _curves(curves: Any) -> dict[str, np.ndarray]:
    """Per curve: where it acts, its amplitude and constant, and its slopes from curve_start on."""
    slopes = [pair for curve in curves for pair in curve.slopes]
    return {
        "curve_dof": np.array([curve.dof for curve in curves], dtype=np.int64),
        "curve_value": np.array([(curve.amplitude, curve.constant) for curve in curves], dtype=float),
        "curve_start": np.cumsum([0, *(len(curve.slopes) for curve in curves)]),
        "curve_slope_dof": np.array([j for j, _ in slopes], dtype=np.int64),
        "curve_slope": np.array([slope for _, slope in slopes], dtype=float),
    }


def _dependents(reduction: Any) -> dict[str, np.ndarray]:
    """Per dependent coordinate: which it is, and the independent ones that it follows from dependent_start on."""
    dofs = np.zeros(0, dtype=np.int64) if reduction is None else reduction.dependent
    rows = np.zeros((0, 0)) if reduction is None else reduction.G[dofs]
    row, column = np.nonzero(rows)
    return {
        "dependent_dof": dofs, "dependent_start": np.searchsorted(row, np.arange(len(dofs) + 1)),
        "dependent_column": column if reduction is None else reduction.independent[column],
        "dependent_value": rows[row, column],
    }  # fmt: skip
