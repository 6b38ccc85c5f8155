"""Compile an MJCF text, and look up once the facts that readers and editors need of the compiled model.

MuJoCo settles defaults, flags, replicas and contact filters when it compiles, so the compiled model says what would
act. `compile_model` is the only place that calls MuJoCo's compiler; a `ModelIndex` of its result is handed to all that
read, refuse or edit the file.
"""

from __future__ import annotations

from collections import deque
from functools import cached_property
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np

from planner.base.errors import ModelError
from planner.base.gl import load_mujoco
from planner.model.mjcf.compile_subprocess import compile_in_subprocess

MAX_TOUCHING = 5000  # geoms: a table of all pairs of them has some 100 MB
MAX_PAIRS = 100_000
MAX_KEPT = 2**28  # bytes of compiled models
_BALANCED = 1e-6  # of a weight: what forces leave of it that balance it

VELOCITY_LIMIT = "velocity_limit"
"""Tuple of velocity limits: <tuple name="velocity_limit"><element objtype="joint" objname="elbow" prm="3.1"/>."""
LEFT_OUT = "left_out "
"""Begins the name of a custom text on a missing part: <text name="left_out 1" data="the mesh 'hand.ply' of ..."/>."""
NEVER_REPLAYED = "never_replayed "
"""Begins the name of a custom text on what no replay has: <text name="never_replayed 1" data="contacts of tool"/>."""
EDITED = "edited"
"""Name of the custom text of an edited file; its data is what was taken out, a phrase each, "; " between them."""

RECENT: deque[tuple[str, dict[str, bytes], Any]] = deque(maxlen=8)
"""Text, files and model of what was compiled last, the latest at the end."""


def compile_model(
    mjcf: str | ElementTree.Element, assets: dict[str, bytes] | None = None, name: str = "the model"
) -> Any:
    """Compile an MJCF text, or its XML tree, and the files that it names to MuJoCo's MjModel.

    Reading, parity and proof ask for the same texts, so the last ones are not compiled again: whoever changes a model
    does so in a copy.
    """
    text = mjcf if isinstance(mjcf, str) else ElementTree.tostring(mjcf, encoding="unicode")
    files = dict(assets or {})
    for known, its_files, model in RECENT:
        if known == text and its_files == files:
            return model
    model = compile_in_subprocess(text, files, name)
    RECENT.append((text, files, model))
    while len(RECENT) > 1 and sum(load_mujoco().mj_sizeModel(one) for _, _, one in RECENT) > MAX_KEPT:
        RECENT.popleft()
    return model


def named(model: Any, kind: str, index: int) -> str:
    """An element for a sentence: "joint 'hip'"; its place and its body where it has no name."""
    mujoco = load_mujoco()
    name = mujoco.mj_id2name(model, getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}"), index)
    if name:
        return f"{kind} {name!r}"
    owners = {"geom": model.geom_bodyid, "joint": model.jnt_bodyid, "site": model.site_bodyid}
    body = model.body(int(owners[kind][index])).name if kind in owners else ""
    return f"{kind} number {index} of body {body!r}" if body else f"{kind} number {index}"


def body_chain(model: Any, body: int) -> list[int]:
    """A body and those that carry it, the innermost first, without the world."""
    chain = []
    while body > 0:
        chain.append(body)
        body = int(model.body_parentid[body])
    return chain


def gravity_of(model: Any) -> np.ndarray:
    """(3,) m/s^2, 0 where it is switched off."""
    return np.array(model.opt.gravity) * (not disabled(model, "gravity"))


def flag_bit(group: str, prefix: str, name: str) -> int:
    """The bit of a flag; 0 where this release of MuJoCo does not have it."""
    return int(getattr(getattr(load_mujoco(), f"mjt{group}Bit"), f"mj{prefix}_{name.upper()}", 0))


def disabled(model: Any, *names: str) -> bool:
    """Whether the file's <flag> disables any of these."""
    return any(model.opt.disableflags & flag_bit("Disable", "DSBL", name) for name in names)


def field(model: Any, name: str, count: int) -> np.ndarray:
    """A field of the compiled model, zeros where this release of MuJoCo does not have it."""
    return np.asarray(getattr(model, name, np.zeros(count)))


def kind_word(kinds: Any, value: int) -> str:
    """The last word of the name of one of MuJoCo's enumerated values, in lower case: "hinge" of mjJNT_HINGE."""
    return kinds(int(value)).name.split("_")[-1].lower()


def gear_of(model: Any, actuator: int) -> np.ndarray:
    """(6,) of an actuator; MuJoCo 4 keeps it by force rather than by actuator."""
    return model.actuator_gear[model.actuator_outadr[actuator] if hasattr(model, "actuator_outadr") else actuator]


def pose(position: np.ndarray, quaternion: np.ndarray) -> np.ndarray:
    """(4, 4) of a position, m, and a quaternion."""
    T, rotation = np.eye(4), np.empty(9)
    load_mujoco().mju_quat2Mat(rotation, quaternion)
    T[:3, :3], T[:3, 3] = rotation.reshape(3, 3), position
    return T


def mesh_vertices(model: Any, mesh: int) -> np.ndarray:
    """(V, 3) m, vertices of a mesh in the frame of its geoms."""
    first = int(model.mesh_vertadr[mesh])
    return np.array(model.mesh_vert[first : first + int(model.mesh_vertnum[mesh])], dtype=float)


class Pair(NamedTuple):
    """Two geoms that may touch, and the parameters of their contact."""

    geoms: tuple[int, int]
    condim: int
    friction: np.ndarray  # (5,)
    solref: np.ndarray  # (2,)
    solreffriction: np.ndarray  # (2,) zeros where it is solref's
    solimp: np.ndarray  # (5,)
    margin: float


class ModelIndex:
    """A compiled model and what is looked up in it, each part once, when it is first asked for."""

    def __init__(self, model: Any) -> None:
        self.model = model  # MuJoCo's MjModel; not to be changed

    @cached_property
    def home(self) -> Any:
        """MuJoCo's data where the file puts the joints, with all frames computed."""
        home = load_mujoco().MjData(self.model)
        load_mujoco().mj_kinematics(self.model, home)
        return home

    def carried_by_actuators(self, dofs: np.ndarray) -> bool:
        """Whether forces of the actuators, of any size, balance gravity at some degrees of freedom at home."""
        moments, weight = self._statics
        reach = moments[:, dofs].T
        forces = np.linalg.lstsq(reach, weight[dofs], rcond=None)[0]
        left = np.abs(reach @ forces - weight[dofs]).max()
        return bool(reach.any() and left <= _BALANCED * np.abs(weight[dofs]).max())

    @cached_property
    def _statics(self) -> tuple[np.ndarray, np.ndarray]:
        """Moments of the actuators (nu, nv), and the weight (nv,) that they balance at home."""
        mujoco, model = load_mujoco(), self.model
        data, weight = mujoco.MjData(model), np.zeros(model.nv)
        for stage in (mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_tendon, mujoco.mj_transmission):
            stage(model, data)
        mujoco.mj_comVel(model, data)
        mujoco.mj_rne(model, data, 0, weight)
        moments = np.zeros((len(data.moment_rownnz), model.nv))
        rows = data.moment_rownnz, data.moment_rowadr, data.moment_colind
        mujoco.mju_sparse2dense(moments, data.actuator_moment, *rows)
        return moments, weight

    @cached_property
    def carriers(self) -> tuple[np.ndarray, np.ndarray]:
        """Each body's link (nbody,), -1 for the world, and pose (nbody, 4, 4) in that link's frame."""
        model = self.model
        links, poses = np.full(model.nbody, -1, dtype=np.int64), np.tile(np.eye(4), (model.nbody, 1, 1))
        for body in range(1, model.nbody):
            if model.body_dofnum[body]:
                links[body] = model.body_dofadr[body] + model.body_dofnum[body] - 1
            else:
                above = model.body_parentid[body]
                links[body] = links[above]
                poses[body] = poses[above] @ pose(model.body_pos[body], model.body_quat[body])
        return links, poses

    @cached_property
    def geoms(self) -> np.ndarray:
        """Poses (ngeom, 4, 4) of the geoms in the links that carry their bodies."""
        model = self.model
        local = [pose(model.geom_pos[i], model.geom_quat[i]) for i in range(model.ngeom)]
        return self.carriers[1][model.geom_bodyid] @ np.array(local).reshape(-1, 4, 4)

    @cached_property
    def pairs(self) -> tuple[Pair, ...]:
        """Every pair that MuJoCo would test, with its parameters: those of <pair>, or both geoms' combined."""
        model, explicit = self.model, {}
        for k in range(model.npair):
            geoms = (int(model.pair_geom1[k]), int(model.pair_geom2[k]))
            explicit[frozenset(geoms)] = Pair(
                geoms, int(model.pair_dim[k]), model.pair_friction[k], model.pair_solref[k],
                model.pair_solreffriction[k], model.pair_solimp[k], float(model.pair_margin[k] + model.pair_gap[k]),
            )  # fmt: skip
        return tuple(explicit.get(frozenset(geoms)) or _combined(model, *geoms) for geoms in contact_pairs(model))


def contact_pairs(model: Any) -> list[tuple[int, int]]:
    """The pairs of geoms that MuJoCo would test for contact, wherever they are: its own filters, without positions."""
    if disabled(model, "contact", "constraint"):
        return []
    touching = np.flatnonzero((model.geom_contype != 0) | (model.geom_conaffinity != 0))
    if len(touching) > MAX_TOUCHING:
        raise ModelError(
            f"the model has {len(touching)} geoms that may touch, expected at most {MAX_TOUCHING}: "
            "set contype and conaffinity of the others to 0."
        )
    bodies = model.geom_bodyid[touching]
    weld = model.body_weldid[bodies]
    above = model.body_weldid[model.body_parentid[weld]]
    masks, others = model.geom_contype[touching], model.geom_conaffinity[touching]
    may = (masks[:, None] & others) | (others[:, None] & masks) != 0
    may &= weld[:, None] != weld
    if not disabled(model, "filterparent"):
        family = (weld[:, None] == above) | (above[:, None] == weld)
        may &= ~(family & (weld[:, None] != 0) & (weld != 0))
    for signature in model.exclude_signature:
        first = bodies == signature >> 16
        second = bodies == signature & 0xFFFF
        may &= ~(np.outer(first, second) | np.outer(second, first))
    may = np.triu(may, 1)
    if (count := np.count_nonzero(may)) > MAX_PAIRS:
        raise ModelError(f"the model has {count} pairs of geoms that may touch, expected at most {MAX_PAIRS}.")
    pairs = {(int(i), int(j)) for i, j in touching[np.argwhere(may)]}
    rests = model.body_weldid[model.geom_bodyid] == 0
    explicit = zip(model.pair_geom1, model.pair_geom2, strict=True)
    return sorted(pairs | {(int(i), int(j)) for i, j in explicit if not (rests[i] and rests[j])})


def _combined(model: Any, a: int, b: int) -> Pair:
    """MuJoCo's mj_contactParam."""
    margin = float(max(model.geom_margin[a], model.geom_margin[b]) + max(model.geom_gap[a], model.geom_gap[b]))
    higher = np.sign(int(model.geom_priority[a]) - int(model.geom_priority[b]))
    one, other = float(model.geom_solmix[a]), float(model.geom_solmix[b])
    mix = {1: 1.0, -1: 0.0}.get(int(higher), one / (one + other) if one + other > 0.0 else 0.5)
    solref = mix * model.geom_solref[a] + (1.0 - mix) * model.geom_solref[b]
    condim, friction = max(model.geom_condim[a], model.geom_condim[b]), np.maximum(*model.geom_friction[[a, b]])
    if higher:
        first = a if higher > 0 else b
        condim, friction = model.geom_condim[first], model.geom_friction[first]
    elif np.any(model.geom_solref[[a, b], 0] <= 0.0):  # of direct formats the lesser numbers
        solref = np.minimum(*model.geom_solref[[a, b]])
    solimp = mix * model.geom_solimp[a] + (1.0 - mix) * model.geom_solimp[b]
    return Pair((a, b), int(condim), friction[[0, 0, 1, 2, 2]], solref, np.zeros(2), solimp, margin)


def names_of(model: Any, kind: str, count: int) -> tuple[str, ...]:
    """The names of all elements of a kind, empty where one has none."""
    mujoco = load_mujoco()
    objects = getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}")
    return tuple(mujoco.mj_id2name(model, objects, i) or "" for i in range(count))


def ranges_of(limited: np.ndarray, ranges: np.ndarray) -> np.ndarray:
    """(n, 2) ranges, infinite where they do not limit."""
    return np.where(np.asarray(limited, dtype=bool)[:, None], ranges, [-np.inf, np.inf])


def velocity_limits(model: Any) -> np.ndarray:
    """(nv,) of a compiled model, infinite where it has none.

    Raises:
        ModelError: One is not above 0, or not of a hinge or slide.
    """
    mujoco, limits = load_mujoco(), np.full(model.nv, np.inf)
    for i in range(model.ntuple):
        if model.tuple(i).name != VELOCITY_LIMIT:
            continue
        for k in range(model.tuple_adr[i], model.tuple_adr[i] + model.tuple_size[i]):
            joint, limit = int(model.tuple_objid[k]), float(model.tuple_objprm[k])
            if model.tuple_objtype[k] != mujoco.mjtObj.mjOBJ_JOINT or model.jnt_type[joint] < 2:
                raise ModelError(f"the tuple {VELOCITY_LIMIT!r} names other things than hinge and slide joints.")
            if not limit > 0.0:
                raise ModelError(f"{named(model, 'joint', joint)} has the velocity limit {limit:g}, expected above 0.")
            limits[model.jnt_dofadr[joint]] = limit
    return limits


def texts_of(model: Any, prefix: str) -> tuple[str, ...]:
    """The custom texts of a compiled model whose names begin with a prefix."""
    mujoco, found = load_mujoco(), []
    for i in range(model.ntext):
        if (mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_TEXT, i) or "").startswith(prefix):
            at, size = model.text_adr[i], model.text_size[i]
            found.append(bytes(model.text_data[at : at + size]).split(b"\0")[0].decode(errors="replace"))
    return tuple(found)
