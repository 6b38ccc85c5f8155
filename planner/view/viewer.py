"""Look at a plan in MuJoCo's own viewer: its replays, the ghost of the plan, and perturbed simulations.

The window is MuJoCo's passive one (mujoco.viewer.launch_passive), with its own camera, menus and keys. The motion is
put into it pose by pose; nothing is simulated but the perturbed motions, when they are first asked for. A Player holds
what the keys change and knows no window.
"""

from __future__ import annotations

import importlib
import os
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from planner.base.errors import RenderingUnavailable
from planner.base.gl import load_mujoco
from planner.problem.default_appearance import appearance_of
from planner.problem.plan import Plan
from planner.proof.replays.compiled_twin import CompiledTwin
from planner.proof.replays.replaying import replay_in
from planner.proof.robustness.perturbed import replay_rollout
from planner.view.render.camera import directions, scenery_of, whole_motion
from planner.view.render.environment import unobstructed, visible_model
from planner.view.render.film import Film, interpolate
from planner.view.render.marks import GhostDrawer, Marks, Outline, ghost_paint, screen_difference
from planner.view.render.shapes import LinkCapsules, Paint, SceneGeoms

SPACE, RIGHT, LEFT, DOWN, UP, HOME, END = 32, 262, 263, 264, 265, 268, 269  # GLFW's numbers of keys
KEYS = (
    ("space", "pause or go on"), ("left, right", "back or on by a hundredth; pauses"), ("home, end", "start or end"),
    ("up, down", "faster or slower"), ("6", "ghost of the plan on or off"), ("7", "perturbed simulations on or off"),
    ("8", "open loop or with gains"),
)  # fmt: skip
"""Keys and what they do; digits from 6 on have no meaning of their own in MuJoCo's viewer."""

_STEP = 0.01  # of the whole motion: one press of an arrow
_FASTER = 2.0 ** (1 / 2)
_SLOWEST, _FASTEST = 1 / 64, 8.0
_REST = 1.0  # s that the end stays before the motion begins again


@dataclass
class Player:
    """What the viewer shows now."""

    end: float  # s, of the motion, which begins at 0
    speed: float  # of playback
    t: float = 0.0  # s, of the motion
    playing: bool = True
    ghost: bool = True
    rollouts: bool = False
    gains: bool = True  # the replay with gains, in place of the one without
    rested: float = 0.0  # s that the end has been shown

    def press(self, key: int) -> None:
        """Obey a key, by GLFW's number; other keys are MuJoCo's own."""
        step = _STEP * self.end
        if key == SPACE:
            self.playing = not self.playing
        elif key in (LEFT, RIGHT, HOME, END):
            places = {LEFT: self.t - step, RIGHT: self.t + step, HOME: 0.0, END: self.end}
            self.t, self.playing = min(max(places[key], 0.0), self.end), False
        elif key in (UP, DOWN):
            speed = self.speed * (_FASTER if key == UP else 1.0 / _FASTER)
            self.speed = min(max(speed, _SLOWEST), _FASTEST)
        elif key == ord("6"):
            self.ghost = not self.ghost
        elif key == ord("7"):
            self.rollouts = not self.rollouts
        elif key == ord("8"):
            self.gains = not self.gains
        self.rested = 0.0

    def advance(self, seconds: float) -> None:
        """Let so much time of the watcher pass, s. The motion begins again a second after its end."""
        if not self.playing:
            return
        left = (self.end - self.t) / self.speed
        self.t = min(self.t + seconds * self.speed, self.end)
        self.rested += max(0.0, seconds - left)
        if self.rested > _REST:
            self.t, self.rested = 0.0, 0.0

    def words(self) -> tuple[str, str]:
        """The state of the player, as two columns of lines."""
        rows = {
            "time": f"{self.t:.3f} of {self.end:.3f} s" + ("" if self.playing else ", paused"),
            "speed": f"{self.speed:.3g}", "replay (8)": "with gains" if self.gains else "open loop",
            "ghost (6)": "on" if self.ghost else "off", "rollouts (7)": "on" if self.rollouts else "off",
        }  # fmt: skip
        return "\n".join(rows), "\n".join(rows.values())


ROLLOUTS = 8
_RATE = 60.0  # pictures a second
_SAMPLES = 1000  # poses of a motion at most
_ROLLOUT: Paint = (0.80, 0.20, 0.15, 0.13)
_ASPECT = 1.6  # of the window, about
_PATIENCE = 10.0  # s that MuJoCo's thread has to take its window down
_CURE = "film it with: planner render PLAN --out film.mp4"


def view(plan: Plan, *, rollouts: int = ROLLOUTS, speed: float | None = None,
         each: Callable[[Player], object] | None = None) -> None:  # fmt: skip
    """Open a window that plays a plan's replays, until it is closed.

    Args:
        plan: The plan; its problem has a twin.
        rollouts: How many perturbed simulations key 7 shows.
        speed: Of playback, 0.25 is four times slow motion; None takes the appearance's.
        each: Called with the player before each picture; returns True to close the window.

    Raises:
        RenderingUnavailable: There is no display, or no window can be opened on it.
    """
    require_display()
    assert plan.twin is not None
    compiled = CompiledTwin(plan.twin)
    replays = [replay_in(compiled, plan, feedback=feedback) for feedback in (False, True)]
    start, end = float(plan.t[0]), float(plan.t[-1])
    t = np.linspace(start, end, min(_SAMPLES, max(2, len(replays[0].t))))
    shown = ViewerScene([Film.of(replay, t) for replay in replays], _perturbed(plan, compiled, t, rollouts))
    player = Player(end - start, appearance_of(plan.problem).speed if speed is None else speed)
    viewer, others = importlib.import_module("mujoco.viewer"), set(threading.enumerate())
    try:
        window = viewer.launch_passive(
            shown.model, shown.data, key_callback=player.press, show_left_ui=False, show_right_ui=False
        )
    except RuntimeError as error:  # on macOS the window must belong to the first thread
        raise RenderingUnavailable(f"MuJoCo opens no window here ({error}); {_CURE}.") from error
    with window:
        with window.lock():
            shown.place(window.cam)
        before = time.monotonic()
        while window.is_running() and not (each is not None and each(player)):
            now = time.monotonic()
            player.advance(now - before)
            before = now
            with window.lock():
                shown.draw(window.user_scn, window.cam, player)
            if hasattr(window, "set_texts"):  # since MuJoCo 3.3.1
                window.set_texts((None, None, *player.words()))
            window.sync()
            time.sleep(max(0.0, 1.0 / _RATE - (time.monotonic() - now)))
    for thread in set(threading.enumerate()) - others:  # a program that ends before its window is gone crashes
        thread.join(_PATIENCE)


def require_display() -> None:
    """Check that a window can be opened.

    Raises:
        RenderingUnavailable: It cannot; the message says what to do.
    """
    linux = sys.platform.startswith("linux")
    if linux and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise RenderingUnavailable(
            f"planner view needs a display and DISPLAY is not set; run it on a desktop or by ssh -X, or {_CURE}."
        )
    glfw: Any = importlib.import_module("glfw")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what is wrong is said in one sentence
        if not glfw.init():  # MuJoCo's own attempt would wait for ever
            where = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY") or "this machine's"
            raise RenderingUnavailable(f"planner view cannot open a window on the display {where}; {_CURE}.")


class ViewerScene:
    """Replays, ghost and perturbed simulations as MuJoCo draws them at a time."""

    def __init__(self, films: Sequence[Film], perturbed: Iterator[np.ndarray]) -> None:
        """Take the films of the replays without and with gains; `perturbed` makes poses (F, nq) one by one."""
        mujoco = load_mujoco()
        self._films, self._perturbed, self._rollouts = films, perturbed, list[np.ndarray]()
        self.model = visible_model(films)
        self.data, self._other = mujoco.MjData(self.model), mujoco.MjData(self.model)
        self._seen = seen = unobstructed(films[0], self.model)
        self._paint = ghost_paint(seen)
        self._link_capsules = LinkCapsules(self.model)
        self._ghost_drawer = GhostDrawer(self.model, self._link_capsules)
        self._outline = Outline(self.model, scenery_of(self.model, seen)[0], self._link_capsules)
        self._marks = [Marks(film, self.model, None) for film in films]
        self._look_at, self._distance = whole_motion(films, self.model, seen, _ASPECT, True)
        self._pixel = 2.0 * self._distance * np.tan(0.5 * np.radians(self.model.vis.global_.fovy)) / 720.0

    def place(self, camera: Any) -> None:
        """Put the camera where it sees the whole motion; from then on it is the user's."""
        camera.lookat[:], camera.distance = self._look_at, self._distance
        camera.azimuth, camera.elevation = self._seen.azimuth, self._seen.elevation

    def draw(self, scene: Any, camera: Any, player: Player) -> None:
        """Pose the machine at the player's time, and fill the window's own `scene` with all that is beside it."""
        mujoco, film, marks = load_mujoco(), self._films[player.gains], self._marks[player.gains]
        t = film.t[0] + player.t
        self._pose(self.data, interpolate(t, film.t, film.qpos))
        scene.ngeom = 0
        self._link_capsules.add(self.data, scene)
        eye = camera.lookat - camera.distance * directions(camera.azimuth, camera.elevation)[0]
        if player.ghost:
            offset = np.asarray(film.appearance.ghost_offset)
            self._add(scene, eye, interpolate(t, film.t, film.ghost_qpos), self._paint, offset)
        if player.rollouts:
            self._rollouts += [poses for poses in [next(self._perturbed, None)] if poses is not None]  # one a picture
            for poses in self._rollouts:
                self._add(scene, eye, interpolate(t, film.t, poses), _ROLLOUT, np.zeros(3))
        marks.add(SceneGeoms(scene, eye, self._distance, self._pixel), self.data, float(t))
        mujoco.mj_comPos(self.model, self.data)

    def _pose(self, data: Any, qpos: np.ndarray) -> None:
        mujoco = load_mujoco()
        data.qpos[:] = qpos
        mujoco.mj_kinematics(self.model, data)
        mujoco.mj_camlight(self.model, data)
        mujoco.mj_tendon(self.model, data)

    def _add(self, scene: Any, eye: np.ndarray, qpos: np.ndarray, paint: Paint, offset: np.ndarray) -> None:
        """Add the moving shapes in a pose, in one colour; as in films, none where they would flicker."""
        mujoco, first = load_mujoco(), scene.ngeom
        if not np.all(np.isfinite(qpos)):  # a simulation that exploded
            return
        self._pose(self._other, qpos)
        away = screen_difference(self._outline.points(self.data), self._outline.points(self._other))
        self._ghost_drawer.add(scene, self._other, paint, offset, away, self._pixel, eye, self._distance)
        for geom in scene.geoms[first : scene.ngeom]:
            geom.category = mujoco.mjtCatBit.mjCAT_DECOR


def _perturbed(plan: Plan, compiled: CompiledTwin, t: np.ndarray, number: int) -> Iterator[np.ndarray]:
    """Poses (F, nq) of perturbed simulations with gains, at times t (F,), s, each computed when it is asked for."""
    for k in range(number):
        run = replay_rollout(plan, compiled, k)
        yield interpolate(t, run.t, run.qpos)
