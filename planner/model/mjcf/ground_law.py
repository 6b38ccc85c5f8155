"""The contact law of the ground under a robot: for its mass, as soft as the file's contact, slow enough to integrate.

A robot of mass m penetrates the ground by REST_PENETRATION on one contact and does not bounce: ContactLaw.resting.
Its coefficient of friction is the file's, at most MAX_FRICTION.
Where the file's own contact is softer under a foot's LOAD, its slope there is the stiffness, and spheres begin to press
as much later (`contact_offset`) as gives the file's depth: rubber feet, whose solimp begins near zero. A foot that is
light beside the robot feels the damping B of the whole robot and the friction before it slips c as

    rates = eigenvalues of sum_k J_k M^-1 J_k' C,   C = B n n' + c (1 - n n'),

J_k of the points that it stands on together, M the mass matrix, in the file's own pose, its keyframes or midway between
the ends of ranges: a straight leg gives way less than a bent one. An integrator follows these rates step by step, so
where the largest is above FASTEST the damping is reduced in proportion, and so is c for the rates of friction. The
depth at rest does not change. MuJoCo's default contact yields to light bodies by itself.

How MuJoCo's soft contact gives way at rest, with the impedance of its depth, is said in file_law.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from planner.base.gl import load_mujoco
from planner.model.contact.laws import ContactLaw
from planner.model.mjcf.contact_shapes import meets_plane, plane_of, point_radius, points_of, spheres_of
from planner.model.mjcf.file_law import coefficients
from planner.model.mjcf.model_index import ModelIndex, Pair

DEEPEST = 0.1  # m: what sinks in further does not stand
_HALVINGS = 50


def rest_penetration(model: Any, pair: Pair, load: float) -> tuple[float, float]:
    """How deep a pair's shapes sink into each other when they press with a load, N, and how stiff they are there.

    Returns:
        m, at most DEEPEST, and N/m.
    """
    low, high = 0.0, DEEPEST
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if _force(model, pair, middle) > load else (middle, high)
    step = 1e-4 * high
    return high, (_force(model, pair, high + step) - _force(model, pair, high - step)) / (2.0 * step)


def _force(model: Any, pair: Pair, r: float) -> float:
    """The normal force, N, at rest at a depth r, m."""
    return r * coefficients(model, pair, r)[0]


REST_PENETRATION = (
    3e-3  # m, of the whole machine on one contact: MuJoCo's default ground is stiffer still, but kinks want a ramp
)
LOAD = 0.25  # of the weight, on one foot
DAMPING = 1.0  # of critical, for that ground creeps back where it was pressed
SLIP = 0.2  # m/s at which viscous friction is all there is: on MuJoCo's default contact feet creep more slowly still
MAX_FRICTION = 1.0  # where the file has more, the plan keeps the rest as a margin
FASTEST = 2000.0  # 1/s: what 16 substeps of a stage of 10 ms follow, and some to spare for other poses
UNCERTAINTY = 4.0  # how many times softer a foot may find the file's contact; with 3 to 6 replays end nearly alike
MAX_KEYFRAMES = 10
TOGETHER = 0.1  # of a foot's size: points that are no higher above its lowest one stand together


class Ground(NamedTuple):
    """The law of a pair of a plane and what stands on it."""

    law: ContactLaw
    contact_offset: float  # m, how much deeper than the shapes touch it begins


def laws_of_ground(survey: ModelIndex, pairs: Iterable[Pair]) -> dict[tuple[int, int], Ground]:
    """The law of each pair of a plane and what stands on it, by the pair's geoms."""
    laws, of_body = {}, dict[int, list[Pair]]()
    for pair in pairs:
        laws[pair.geoms] = _for_mass(survey, pair)
        of_body.setdefault(_body_of(survey, pair), []).append(pair)
    poses = _poses(survey)
    for body, own in of_body.items():
        slip = max(laws[pair.geoms].law.slip_damping for pair in own)
        damping = max(laws[pair.geoms].law.damping for pair in own)
        along, across = (
            max(pose.fastest(body, own, *dampings) for pose in poses) for dampings in ((0.0, slip), (damping, 0.0))
        )
        less = [min(1.0, FASTEST / max(rate, 1e-300)) for rate in (along, across)]
        for pair in own:
            law, recess = laws[pair.geoms]
            law = replace(law, slip_damping=less[0] * law.slip_damping, damping=less[1] * law.damping)
            laws[pair.geoms] = Ground(law, recess)
    return laws


def _for_mass(survey: ModelIndex, pair: Pair) -> Ground:
    """The law for the mass on a pair, as if its feet were not light."""
    model, mass, gravity = survey.model, mass_of(survey, pair), float(np.linalg.norm(survey.model.opt.gravity))
    weight = mass * gravity
    depth, slope = rest_penetration(model, pair, LOAD * weight)
    own = {"damping_ratio": DAMPING, "slip": SLIP, "friction": friction_of(pair)}
    usual = ContactLaw.resting(mass, gravity=gravity, sink=REST_PENETRATION, **own)
    usual = replace(usual, uncertainty=UNCERTAINTY)
    if slope >= usual.stiffness:
        return Ground(usual, 0.0)
    recess, match = depth - LOAD * weight / slope, meets_plane(survey, pair.geoms)
    spheres = spheres_of(model, match[1]) if match else []
    if not (spheres and spheres[0].radius > recess > 0.0):
        recess, slope = 0.0, min(LOAD * weight / depth, usual.stiffness)
    law = ContactLaw.resting(mass, gravity=gravity, sink=weight / slope, ramp=usual.ramp, **own)
    return Ground(replace(law, uncertainty=UNCERTAINTY), recess)


def friction_of(pair: Pair) -> float:
    """The plan's coefficient of friction: the file's, at most MAX_FRICTION; 0 of a contact without friction."""
    return min(float(pair.friction[0]), MAX_FRICTION) if pair.condim > 1 else 0.0


def _body_of(survey: ModelIndex, pair: Pair) -> int:
    """The body that stands, with what is welded to it; planes at rest are welded to body 0."""
    return int(survey.model.body_weldid[survey.model.geom_bodyid[list(pair.geoms)]].max())


def mass_of(survey: ModelIndex, pair: Pair) -> float:
    """Of all that hangs together with the body that is not at rest, kg."""
    model = survey.model
    bodies = [int(model.geom_bodyid[geom]) for geom in pair.geoms]
    return float(max(model.body_subtreemass[model.body_rootid[body]] for body in bodies if model.body_weldid[body]))


def _poses(survey: ModelIndex) -> list[_Pose]:
    """The file's own pose, its keyframes, and joints midway between the ends of their ranges."""
    model = survey.model
    middle = np.array(survey.home.qpos)
    hinges = np.flatnonzero((model.jnt_limited == 1) & (model.jnt_type >= int(load_mujoco().mjtJoint.mjJNT_SLIDE)))
    middle[model.jnt_qposadr[hinges]] = model.jnt_range[hinges].mean(axis=1)
    return [_Pose(survey, qpos) for qpos in (survey.home.qpos, middle, *model.key_qpos[:MAX_KEYFRAMES])]


class _Pose:
    """A pose of the file in MuJoCo: what is read here is its mass matrix and where its points are."""

    def __init__(self, survey: ModelIndex, qpos: np.ndarray) -> None:
        mujoco = load_mujoco()
        self._survey, self._model, self._data = survey, survey.model, mujoco.MjData(survey.model)
        self._data.qpos[:] = qpos
        mujoco.mj_fwdPosition(self._model, self._data)

    def fastest(self, body: int, pairs: Iterable[Pair], damping: float, slip: float) -> float:
        """The fastest rate, 1/s, at which a body that stands on a plane with these dampings comes to rest."""
        J, n = self._footing(body, pairs)
        return self._rate(J, n, damping, slip)

    def _footing(self, body: int, pairs: Iterable[Pair]) -> tuple[np.ndarray, np.ndarray]:
        """Jacobians (P, 3, nv) of the points of a body that stand on the plane together, and its normal (3,)."""
        points, normal = [], np.array([0.0, 0.0, 1.0])
        for pair in pairs:
            match = meets_plane(self._survey, pair.geoms)
            if match is None:
                continue
            flat, other = match
            plane = plane_of(self._survey, flat)
            normal = normal if plane is None else plane.normal
            radius = point_radius(self._model, other)
            R = self._data.geom_xmat[other].reshape(3, 3)
            points.append(points_of(self._model, other) @ R.T + self._data.geom_xpos[other] - radius * normal)
        every = np.concatenate(points) if points else np.zeros((0, 3))
        heights = every @ normal
        size = float(np.ptp(every, axis=0).max()) if len(every) else 0.0
        low = every[heights <= heights.min(initial=np.inf) + TOGETHER * size]
        return np.array([self._jacobian(body, p) for p in low]).reshape(-1, 3, self._model.nv), normal

    def _jacobian(self, body: int, point: np.ndarray) -> np.ndarray:
        J = np.zeros((3, self._model.nv))
        load_mujoco().mj_jac(self._model, self._data, J, None, np.ascontiguousarray(point), body)
        return J

    def _rate(self, J: np.ndarray, n: np.ndarray, damping: float, slip: float) -> float:
        """The fastest rate, 1/s, at which points (P, 3, nv) with these dampings come to rest; 0 for none."""
        if not len(J):
            return 0.0
        root: Any = np.sqrt(damping) * np.outer(n, n) + np.sqrt(slip) * (np.eye(3) - np.outer(n, n))
        rows = np.ascontiguousarray((root @ J).reshape(-1, self._model.nv))
        solved = np.zeros_like(rows)
        load_mujoco().mj_solveM(self._model, self._data, solved, rows)
        return float(np.linalg.eigvalsh(rows @ solved.T).max())
