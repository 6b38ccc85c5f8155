"""Look at a plan in a browser, drag its goal, and see plan and verdict come again; drawn by viser, an extra."""

from __future__ import annotations

import io
import threading
import time
from collections.abc import Callable
from contextlib import redirect_stdout
from importlib import import_module
from typing import Any

import numpy as np

from planner.base.errors import PlannerError
from planner.base.gl import load_mujoco
from planner.problem.plan import Plan
from planner.proof.replays.compiled_twin import CompiledTwin
from planner.proof.replays.replaying import replay_in
from planner.view.render.camera import directions, whole_motion
from planner.view.render.environment import visible_model
from planner.view.render.film import Film
from planner.view.render.ghost import ghost_paint
from planner.view.replanner import Outcome, Replanner
from planner.view.report.view_3d import body_poses, drawn_shapes, mesh_of, place_in_world
from planner.view.viewer import Player

_RATE = 30.0  # poses a second
_SAMPLES = 400  # poses of a motion
_TRIANGLES = 6000  # of a mesh
_HANDLE = 0.15  # size of a goal's arrows, in distances of the camera


class Stage:
    """Machine, ghost and floor in viser's scene."""

    def __init__(self, scene: Any, film: Film) -> None:
        """Add the shapes of a film's model."""
        mujoco = load_mujoco()
        self._model = model = visible_model([film])
        data = mujoco.MjData(model)
        data.qpos[:] = film.qpos[0]
        mujoco.mj_forward(model, data)
        shapes, paint = drawn_shapes(model, data), ghost_paint(film.appearance)
        self._bodies = sorted({int(body) for body, *_ in shapes if model.body_weldid[body]})
        self.root = scene.add_frame("/ghost", show_axes=False)
        self._frames = {
            kind: [scene.add_frame(f"/{kind}/{body}", show_axes=False) for body in self._bodies]
            for kind in ("machine", "ghost")
        }
        for i, (body, kind, size, place, colour, mesh) in enumerate(shapes):
            if kind == "plane":
                scene.add_grid(f"/floor/{i}", infinite_grid=True, position=(0.0, 0.0, place[2]))
                continue
            at = place if body in self._bodies else place_in_world(data.xpos[body], data.xquat[body], place)
            vertices, faces = _shape(model, kind, size, mesh)
            copies = {"machine": colour, "ghost": paint} if body in self._bodies else {"world": colour}
            for part, rgba in copies.items():
                red, green, blue, opacity = (float(value) for value in rgba)
                scene.add_mesh_simple(
                    f"/{part}/{body}/{i}", vertices, faces, color=(red, green, blue), position=at[:3], wxyz=at[3:],
                    opacity=opacity if opacity < 1.0 else None, cast_shadow=part != "ghost",
                )  # fmt: skip
        self.look_at, self.distance = whole_motion([film], model, film.appearance, 1.6, True)

    def motion(self, shown: Outcome) -> dict[str, np.ndarray]:
        """Poses (F, B, 7) of machine and ghost at equal times; without a proof the plan is both."""
        plan, proof = shown.plan, shown.proof
        assert plan.twin is not None
        t = np.linspace(plan.t[0], plan.t[-1], _SAMPLES)
        if proof is None:
            xs = np.stack([np.interp(t, plan.t, column) for column in plan.xs.T], axis=1)
            return dict.fromkeys(self._frames, self._poses(plan.twin.sim_of(xs)[:, : self._model.nq]))
        film = Film.of(proof.replay, t)
        return {"machine": self._poses(film.qpos), "ghost": self._poses(film.ghost_qpos)}

    def _poses(self, qpos: np.ndarray) -> np.ndarray:
        return body_poses(self._model, qpos, self._bodies)

    def pose(self, motion: dict[str, np.ndarray], part: float) -> None:
        """Put machine and ghost where they are at a part of the motion, 0 to 1."""
        for kind, frames in self._frames.items():
            for frame, place in zip(frames, motion[kind][round(part * (_SAMPLES - 1))], strict=True):
                frame.position, frame.wxyz = place[:3], place[3:]


def _shape(model: Any, kind: str, size: np.ndarray, mesh: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) about its middle and triangles (T, 3) of a shape; `size` are MuJoCo's half lengths."""
    if kind == "mesh":
        return mesh_of(model, mesh, _TRIANGLES)
    make = import_module("trimesh.creation")  # viser brings it
    if kind in ("cylinder", "capsule"):
        found = getattr(make, kind)(radius=size[0], height=2.0 * size[2])
        return np.array(found.vertices) - found.bounds.mean(axis=0), np.array(found.faces)
    found = make.box((2.0, 2.0, 2.0)) if kind == "box" else make.icosphere(subdivisions=3)
    return np.array(found.vertices) * size, np.array(found.faces)


def browse(plan: Plan, *, port: int = 8080, speed: float | None = None, ready: Callable[[str], object] | None = None,
           each: Callable[[Player, Replanner], object] | None = None) -> None:  # fmt: skip
    """Serve a page that plays a plan to this machine's browser, until Ctrl-C.

    Args:
        plan: The plan; its problem has a twin.
        port: Of the server, which other machines do not reach.
        speed: Of playback; None takes the appearance's.
        ready: Called with the page's address.
        each: Called before each pose; returns True to end.

    Raises:
        PlannerError: viser is not installed.
    """
    try:
        viser = import_module("viser")
    except ImportError:
        raise PlannerError(
            "viser is not installed, expected it for --browser: pip install slq-planner[view]."
        ) from None
    assert plan.twin is not None
    replay = replay_in(CompiledTwin(plan.twin), plan, feedback=True)
    film = Film.of(replay, np.linspace(plan.t[0], plan.t[-1], _SAMPLES))
    seen, replanner = film.appearance, Replanner(plan)
    with redirect_stdout(io.StringIO()):  # it prints its address whatever it is told
        server = viser.ViserServer(host="127.0.0.1", port=port, verbose=False)
    try:
        stage = Stage(server.scene, film)
        server.scene.set_up_direction("+z")
        server.initial_camera.look_at = stage.look_at
        ahead = directions(seen.azimuth, seen.elevation)[0]
        server.initial_camera.position = stage.look_at - stage.distance * ahead
        _add_goals(server, replanner, _HANDLE * stage.distance)
        threading.Thread(target=replanner.work, daemon=True).start()
        if ready is not None:
            ready(f"http://127.0.0.1:{server.get_port()}")
        player = Player(float(plan.t[-1] - plan.t[0]), seen.speed if speed is None else speed)
        _play(server, player, replanner, stage, each)
    except KeyboardInterrupt:
        pass
    finally:
        replanner.end()
        with redirect_stdout(io.StringIO()):
            server.stop()


def _add_goals(server: Any, replanner: Replanner, size: float) -> None:
    """Arrows at the places to drag, numbers of the joints to type."""
    for i, (name, value) in enumerate(replanner.goals.items()):
        if np.ndim(value):
            handle = server.scene.add_transform_controls(f"/goals/{i}", scale=size, disable_rotations=True,
                                                         position=np.asarray(value, dtype=float))  # fmt: skip
            server.scene.add_label(f"/goals/{i}/name", name)
            handle.on_update(lambda event, name=name: replanner.move(name, event.target.position.tolist()))
        else:
            field = server.gui.add_number(name, float(value), step=0.05)
            field.on_update(lambda event, name=name: replanner.move(name, float(event.target.value)))


def _play(server: Any, player: Player, replanner: Replanner, stage: Stage,
          each: Callable[[Player, Replanner], object] | None) -> None:  # fmt: skip
    """Pose the machine at the player's time, and show what the replanner has."""
    words = server.gui.add_markdown("")
    plays, ghost = server.gui.add_checkbox("play", True), server.gui.add_checkbox("ghost: the plan", True)
    speed = server.gui.add_slider("speed", 0.05, 2.0, 0.05, min(2.0, max(0.05, player.speed)))
    at = server.gui.add_slider("time, s", 0.0, player.end, player.end / _SAMPLES, 0.0)
    shown, motion, before = None, {}, time.monotonic()
    while not (each is not None and each(player, replanner)):
        if shown is not replanner.shown:
            shown = replanner.shown
            words.content, motion = str(shown), stage.motion(shown)
            player.end = at.max = float(shown.plan.t[-1] - shown.plan.t[0])  # an objective with time may choose another
        now = time.monotonic()
        player.playing, player.speed, stage.root.visible = plays.value, speed.value, ghost.value
        player.advance(now - before)
        before = now
        with server.atomic():
            if player.playing:
                at.value = player.t
            else:
                player.t = at.value
            stage.pose(motion, player.t / player.end)
        time.sleep(max(0.0, 1.0 / _RATE - (time.monotonic() - now)))
