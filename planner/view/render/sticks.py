"""Draw links that have no shape as capsules from joint to joint."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from planner.base.gl import load_mujoco
from planner.view.render.shapes import Paint

_PAINT = (0.58, 0.63, 0.70, 1.0)
_RADIUS = 0.018  # of the machine's size
_LIGHT = 1e-4  # of the machine's mass: a link that is lighter is a frame between two joints


class Stick(NamedTuple):
    """A capsule, or a ball where both ends are the same, in the frame of a body."""

    body: int
    start: np.ndarray  # (3,)
    end: np.ndarray  # (3,)


class Sticks:
    """The links of a model without any shape that is drawn."""

    def __init__(self, model: Any) -> None:
        """Find them where the file puts the joints."""
        mujoco = load_mujoco()
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        self._model = model
        self._sticks = tuple(_sticks(model, data))
        self._radius = _RADIUS * float(np.ptp(data.xanchor, axis=0).max(initial=0.0) + _longest(self._sticks))

    def ends(self, data: Any) -> np.ndarray:
        """(2 S, 3) the ends of the sticks where MuJoCo's data puts the bodies."""
        return np.array([
            data.xpos[stick.body] + data.xmat[stick.body].reshape(3, 3) @ end
            for stick in self._sticks for end in (stick.start, stick.end)
        ]).reshape(-1, 3)  # fmt: skip

    def add(self, data: Any, scene: Any, paint: Paint = _PAINT) -> None:
        """Add the sticks to MuJoCo's scene where its data puts the bodies."""
        mujoco = load_mujoco()
        pairs = self.ends(data).reshape(-1, 2, 3)
        for ends in pairs[: max(0, scene.maxgeom - scene.ngeom)]:
            geom = scene.geoms[scene.ngeom]
            rgba, size = np.array(paint, np.float32), np.full(3, self._radius)
            mujoco.mjv_initGeom(geom, mujoco.mjtGeom.mjGEOM_SPHERE, size, ends[0], np.eye(3).ravel(), rgba)
            if np.linalg.norm(ends[1] - ends[0]) > 1e-9:
                mujoco.mjv_connector(geom, mujoco.mjtGeom.mjGEOM_CAPSULE, self._radius, *ends)
            geom.category = mujoco.mjtCatBit.mjCAT_DYNAMIC
            scene.ngeom += 1


def _longest(sticks: tuple[Stick, ...]) -> float:
    return max((float(np.linalg.norm(stick.end - stick.start)) for stick in sticks), default=0.0)


def _sticks(model: Any, data: Any) -> list[Stick]:
    """From each joint of a link without shapes to the joints that it carries, or to its centre of mass."""
    links = model.body_weldid
    shaped = set(map(int, links[model.geom_bodyid]))
    carried: dict[int, list[int]] = {}
    for body in range(1, model.nbody):
        if links[body] == body:
            carried.setdefault(int(links[model.body_parentid[body]]), []).append(body)
    found: list[Stick] = []
    for link in sorted(set(map(int, links)) - shaped - {0}):
        mass = model.body_mass[links == link]
        if mass.sum() <= _LIGHT * model.body_mass.sum():
            continue
        R, p = data.xmat[link].reshape(3, 3), data.xpos[link]
        start = R.T @ (_joint_of(model, data, link) - p)
        ends = [R.T @ (_joint_of(model, data, child) - p) for child in carried.get(link, [])]
        far = [end for end in ends if np.linalg.norm(end - start) > 1e-6]
        if not far:
            centre = mass @ data.xipos[links == link] / mass.sum()
            far = [2.0 * R.T @ (centre - p) - start]  # as long as a rod with this centre
        found += [Stick(link, start, end) for end in far]
    return found


def _joint_of(model: Any, data: Any, body: int) -> np.ndarray:
    """Where the first joint of a body is, (3,)."""
    if not model.body_jntnum[body]:
        return data.xpos[body]
    return data.xanchor[model.body_jntadr[body]]
