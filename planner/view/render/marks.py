"""What is drawn beside the machine: the ghost of the plan, trails and axes of frames, goals and paths, pushes.

Two machines in almost the same place flicker, because MuJoCo draws now this surface in front and now that one. So a
ghost less than a pixel from its machine is not drawn; one a few pixels away is faint and moved away from the camera.

A goal is a ball, with short thick axes where its orientation is asked for, or an arrow where a direction is. The frame
itself has longer, thinner axes, so that both can be told where they coincide. Sizes are parts of the machine's own.
Goals that are passed are faint. A push is an arrow at its body while it acts; the strongest is the longest.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from planner.base.errors import PlannerError
from planner.base.gl import load_mujoco
from planner.problem.appearance import Appearance, GoalMark
from planner.view.render.camera import scenery_of, swept_box
from planner.view.render.film import Film, interpolate
from planner.view.render.shapes import BoxCorners, LinkCapsules, Paint, Rod, SceneGeoms, drawn, moving, without_shadow

GHOST = (0.05, 0.62, 0.48)
_ASIDE = 0.34  # opacity of a ghost beside the machine
_IN_PLACE = 0.16  # opacity of a ghost in the machine, which must be seen through it
SAME_PICTURE_PIXELS = 0.5  # two pictures whose machines differ by less are drawn once
_FADE = (1.0, 4.0)  # pixels of difference at which a ghost is invisible, and fully visible
_MIN_OFFSET = 2e-3  # of its distance from the camera, by which a ghost is at least moved away from it
_OFFSET_RATIO, _MAX_OFFSET = 1.5, 0.03  # the same over the difference, and its maximum


class Outline:
    """Points of the machine of a model by which two of its poses are compared: corners of its shapes' boxes."""

    def __init__(self, model: Any, scenery: np.ndarray, sticks: LinkCapsules) -> None:
        """Take the shapes that move and are seen, without the bodies (nbody,) of the scenery."""
        self._link_capsules = sticks
        self._corners = BoxCorners(model, np.flatnonzero(moving(model) & drawn(model) & ~scenery[model.geom_bodyid]))
        self._bodies = np.flatnonzero(~scenery)[1:]

    def points(self, data: Any) -> np.ndarray:
        """(C, 3) where the points are in MuJoCo's data."""
        return np.concatenate([self._corners.at(data), data.xpos[self._bodies], self._link_capsules.ends(data)])


def screen_difference(one: np.ndarray, other: np.ndarray) -> float:
    """The largest distance between points (C, 3) of two poses, in the model's unit of length."""
    return float(np.sqrt(np.max(np.sum((one - other) ** 2, axis=1), initial=0.0)))


def visibility(pixels: float) -> float:
    """Share 0..1 of its opacity with which a ghost is drawn that is so many pixels from its machine."""
    part = float(np.clip((pixels - _FADE[0]) / (_FADE[1] - _FADE[0]), 0.0, 1.0))
    return part * part * (3.0 - 2.0 * part)


def depth_offset(difference: float, distance: float) -> float:
    """By how much a ghost is moved away from the camera, as a share of its distance from the camera.

    Corresponding surfaces then do not intersect; where they differ a lot, hardly any offset is needed.
    """
    part = _OFFSET_RATIO * max(difference / distance, 1e-12)
    return max(_MIN_OFFSET, min(part, _MAX_OFFSET**2 / part))


def ghost_paint(appearance: Appearance) -> Paint:
    """Colour and opacity of the ghost."""
    opacity = _ASIDE if any(appearance.ghost_offset) else _IN_PLACE
    if appearance.ghost is None:
        return (*GHOST, opacity)
    return (*appearance.ghost.colour, opacity if appearance.ghost.opacity is None else appearance.ghost.opacity)


class GhostDrawer:
    """Adds copies of a model in other poses to MuJoCo's scenes, each in one colour and without shadows."""

    def __init__(self, model: Any, link_capsules: LinkCapsules) -> None:
        """Take the model whose moving shapes are drawn, and the capsules of its links without a shape."""
        mujoco = load_mujoco()
        self._model, self._link_capsules = model, link_capsules
        self._option, self._perturb = mujoco.MjvOption(), mujoco.MjvPerturb()

    def add(
        self, scene: Any, data: Any, paint: Paint, offset: np.ndarray, difference: float, pixel: float,
        eye: np.ndarray, distance: float,
    ) -> None:  # fmt: skip
        """Add the pose of MuJoCo's `data`, displaced by `offset` (3,), m.

        Without an offset it is the fainter the smaller its `difference` from the machine, m; `pixel` is the size of a
        pixel in space, m, `eye` (3,) the camera's position and `distance` that from the camera to the machine, m.
        """
        mujoco, first, back = load_mujoco(), scene.ngeom, 0.0
        if not np.any(offset):
            back, paint = depth_offset(difference, distance), (*paint[:3], paint[3] * visibility(difference / pixel))
        if paint[3] == 0.0:
            return
        kind = mujoco.mjtCatBit.mjCAT_DYNAMIC
        mujoco.mjv_addGeoms(self._model, data, self._option, self._perturb, kind, scene)
        self._link_capsules.add(data, scene)
        for geom in scene.geoms[first : scene.ngeom]:
            geom.pos[:] += offset + back * (geom.pos - eye)
            geom.matid, geom.rgba[:] = -1, paint if geom.rgba[3] > 0.0 else 0.0  # MuJoCo adds invisible tendons too
            geom.specular, geom.shininess, geom.reflectance, geom.emission = 0.0, 0.0, 0.0, 0.25
            without_shadow(geom)


PUSH = (0.98, 0.85, 0.10, 1.0)
TRAIL = (0.80, 0.25, 0.10, 1.0)
GOAL = (0.84, 0.06, 0.50, 1.0)
PATH = (0.16, 0.17, 0.20, 1.0)
_GHOST_TRAIL = 0.8  # opacity
_THINNER = 0.7  # a ghost's trail, so that it shows only where the two part
_BEHIND = 2e-3  # of its distance from the camera: how far a ghost's trail is drawn behind, or the two would flicker
_PATH_LINE = 0.5  # thickness of a path that is to be followed, of a trail's
_PASSED = 0.28  # opacity of a goal that was passed

# In parts of the machine's size.
_BALL = 0.015
_ARROW = 0.12
_GOAL_AXES = Rod(0.08, 0.0055)
_FRAME_AXES = Rod(0.105, 0.0035)
_PUSH = 0.4  # the strongest
_ALIKE = 0.03  # goals that are nearer to each other than that share a label


class _Place(NamedTuple):
    """A goal, and where it is."""

    mark: GoalMark
    position: np.ndarray  # (3,)


class _Trail(NamedTuple):
    """The path of a frame behind it."""

    t: np.ndarray  # (P,) s
    path: np.ndarray  # (P, 3)
    paint: Paint
    part: float  # of a trail's thickness
    behind: float  # of its distance from the camera

    def until(self, t: float) -> np.ndarray:
        """(K, 3) its points until time t, s."""
        return np.concatenate([self.path[self.t < t], interpolate(np.array([t]), self.t, self.path)])


class Marks:
    """Trails, axes, goals and paths of a film."""

    def __init__(self, film: Film, model: Any, ghost: Paint | None) -> None:
        """Find them in a model; `ghost` paints the trails of the ghost, None for a picture without it.

        Raises:
            PlannerError: The appearance names a site or body that the model does not have.
        """
        seen, self._appearance = film.appearance, film.appearance
        trails = (seen.trail,) if isinstance(seen.trail, str) else seen.trail
        named = {name: _found(model, "trail", name) for name in trails if name}
        named |= {name: _found(model, "frame", name) for name in (*seen.frames, *(one.frame for one in seen.goals))}
        self._frames = [named[name] for name in seen.frames]
        self._model, self._film = model, film
        self._trails = self._of_trails([named[name] for name in trails if name], ghost)
        self._goals = [_Place(one, self._place(one, named[one.frame])) for one in seen.goals]
        self._size = 0.0
        self._pushes = [(model.body(one.body).id, one.force, one.time, one.time + one.duration) for one in film.pushes]
        self._strongest = max((float(np.linalg.norm(force)) for _, force, *_ in self._pushes), default=0.0) or 1.0
        if self._frames or self._goals or self._pushes:
            box = swept_box(model, film.path_qpos[:1], scenery_of(model, seen)[0])
            self._size = float(np.max(box.high - box.low))

    def add(self, shapes: SceneGeoms, data: Any, t: float) -> None:
        """Draw them at time t, s, where MuJoCo's data puts the machine."""
        for path in self._appearance.paths:
            shapes.trail(path, PATH, _PATH_LINE)
        for trail in self._trails:
            shapes.trail(trail.until(t), trail.paint, trail.part, trail.behind)
        for frame in self._frames:
            shapes.axes(*_pose(data, frame), _FRAME_AXES.of(self._size))
        for mark, position in self._goals:
            opacity = _PASSED if self.passed(mark, t) else 1.0
            if mark.orientation is not None:
                shapes.axes(position, mark.orientation, _GOAL_AXES.of(self._size), opacity)
            shapes.ball(position, _BALL * self._size, (*GOAL[:3], opacity))
            if mark.direction is not None:
                shapes.arrow(position, _ARROW * self._size * np.asarray(mark.direction), (*GOAL[:3], opacity))

        for body, force, begins, ends in self._pushes:
            if begins <= t < ends:
                vector = _PUSH * self._size / self._strongest * force
                shapes.arrow(data.xipos[body] - vector, vector, PUSH)

    @property
    def lines(self) -> list[tuple[np.ndarray, Paint]]:
        """Points (P, 3) and colours of whole trails, and of paths that are to be followed."""
        paths = [(np.asarray(path), PATH) for path in self._appearance.paths]
        return paths + [(trail.path, trail.paint) for trail in self._trails]

    @property
    def goals(self) -> list[np.ndarray]:
        """Places (3,) of the goals."""
        return [position for _, position in self._goals]

    @property
    def size(self) -> float:
        """The machine's largest side, m; 0 where no mark needs it."""
        return self._size

    @property
    def reach(self) -> float:
        """How far axes and arrows may be from the machine and the goals, m."""
        return self._size * (_PUSH if self._pushes else _ARROW)

    def difference(self, other: Marks, t: float) -> float:
        """The largest distance between the trails of two films of one plan at time t, s, in the model's unit."""
        return max(
            (screen_difference(a.until(t), b.until(t)) for a, b in zip(self._trails, other._trails, strict=True)),
            default=0.0,
        )

    def passed(self, mark: GoalMark, t: float) -> bool:
        """Whether a goal on the way is behind; one at the end never is."""
        return mark.time < min(t, float(self._film.path_t[-1]) - 1e-9)

    def labels(self, t: float) -> list[tuple[np.ndarray, str, bool]]:
        """Places (3,), the numbers of the goals there, and whether all of these are passed."""
        found: list[tuple[np.ndarray, list[GoalMark]]] = []
        for mark, position in self._goals:
            near = [one for one in found if np.linalg.norm(one[0] - position) < _ALIKE * self._size]
            if near and mark.number:
                near[0][1].append(mark)
            elif mark.number:
                found.append((position, [mark]))
        return [
            (position, ", ".join(dict.fromkeys(one.number for one in marks)), all(self.passed(one, t) for one in marks))
            for position, marks in found
        ]

    def _of_trails(self, frames: list[tuple[str, int]], ghost: Paint | None) -> list[_Trail]:
        """Of each frame in the simulation and in the ghost.

        Several trails, and paths beside them, share the pieces that one would have.
        """
        if not frames:
            return []
        film, offset = self._film, np.asarray(self._appearance.ghost_offset)
        few = slice(None, None, len(frames) + len(self._appearance.paths))
        t = np.append(film.path_t[few], film.path_t[-1])
        kinds = [(film.path_qpos, TRAIL, 1.0, np.zeros(3), 0.0)]
        if ghost is not None:
            kinds.append((film.path_ghost_qpos, (*ghost[:3], _GHOST_TRAIL), _THINNER, offset, _BEHIND))
        trails = []
        for poses, paint, part, aside, behind in kinds:
            points = self._points(np.concatenate([poses[few], poses[-1:]]), frames) + aside
            trails += [_Trail(t, points[:, k], paint, part, behind) for k in range(len(frames))]
        return trails

    def _place(self, mark: GoalMark, frame: tuple[str, int]) -> np.ndarray:
        """(3,) where a goal is; one without a position where the frame is planned to be then."""
        if mark.position is not None:
            return np.asarray(mark.position)
        nearest = int(np.argmin(np.abs(self._film.path_t - mark.time)))
        return self._points(self._film.path_ghost_qpos[[nearest]], [frame])[0, 0]

    def _points(self, poses: np.ndarray, frames: list[tuple[str, int]]) -> np.ndarray:
        """(P, F, 3) where frames are in poses (P, nq)."""
        mujoco = load_mujoco()
        data, points = mujoco.MjData(self._model), np.empty((len(poses), len(frames), 3))
        for here, qpos in zip(points, poses, strict=True):
            data.qpos[:] = qpos
            mujoco.mj_kinematics(self._model, data)
            here[:] = [_pose(data, frame)[0] for frame in frames]
        return points


def _found(model: Any, what: str, name: str) -> tuple[str, int]:
    """The kind and the number of a site or body."""
    mujoco = load_mujoco()
    for kind in ("site", "body"):
        number = mujoco.mj_name2id(model, getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}"), name)
        if number >= 0:
            return kind, number
    known = [model.site(i).name for i in range(model.nsite)] + [model.body(i).name for i in range(1, model.nbody)]
    listed = ", ".join(filter(None, known)) or "none"
    raise PlannerError(f"the appearance's {what} is {name!r}, expected a site or body of the model: {listed}.")


def _pose(data: Any, frame: tuple[str, int]) -> tuple[np.ndarray, np.ndarray]:
    """Place (3,) and axes (3, 3), as columns, of a site or body."""
    kind, number = frame
    if kind == "site":
        return data.site_xpos[number], data.site_xmat[number].reshape(3, 3)
    return data.xpos[number], data.xmat[number].reshape(3, 3)
