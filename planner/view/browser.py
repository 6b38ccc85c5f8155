"""Look at a plan in a browser, drag its goal, and see plan and verdict come again; drawn by viser, an extra."""

from __future__ import annotations

import copy
import io
import threading
import time
from collections.abc import Callable
from contextlib import redirect_stdout
from importlib import import_module
from itertools import pairwise
from typing import Any

import numpy as np

from planner.base.errors import PlannerError
from planner.base.gl import load_mujoco
from planner.cases.problem_file.states import state_of
from planner.dynamics import RigidBodyDynamics
from planner.problem.plan import Plan
from planner.problem.problem_parts import PROBLEM_FILE
from planner.proof import prove
from planner.proof.replays.compiled_twin import CompiledTwin
from planner.proof.replays.replaying import replay_in
from planner.solvers.slq import solve
from planner.view.render.camera import directions, whole_motion
from planner.view.render.environment import unobstructed, visible_model
from planner.view.render.film import Film
from planner.view.render.marks import ghost_paint
from planner.view.report.view_3d import body_poses, drawn_shapes, mesh_of, place_in_world, simplified
from planner.view.viewer import Player

_RATE = 30.0  # poses a second
_SAMPLES = 400  # poses of a motion
_TRIANGLES = 6000  # of a mesh
_HANDLE = 0.15  # size of a goal's arrows, in distances of the camera


class Replanner:
    """Plans for the newest goals from the plan before, and proves that plan if no newer ones were given meanwhile.

    Attributes:
        goals: What can be changed, by name: positions (3,) of frames, m, joints, rad or m, or numbers of a case.
        replay: Of the newest plan.
        words: What is known of it, or why there is none for these goals.
    """

    def __init__(self, plan: Plan) -> None:
        """Take a plan, whose problem has a twin; without a recipe nothing can be changed."""
        self._plan, self._took, self._ended = plan, "", False
        self._asked = _changeable(plan)
        self._planned = copy.deepcopy(self._asked)
        self._slots = _slots(self._asked.get("goal", self._asked))
        self.goals: dict[str, Any] = {name: table[key] for name, (table, key) in self._slots.items()}
        self._changed = threading.Event()
        self._changed.set()  # the first plan is to be proved
        self._show()

    def move(self, name: str, value: Any) -> None:
        """Ask for another value of a goal; takes no time."""
        table, key = self._slots[name]
        self.goals[name] = table[key] = value
        self._changed.set()

    def work(self) -> None:
        """Plan and prove until end() is called."""
        while self._changed.wait() and not self._ended:
            self._changed.clear()
            try:
                self.step()
            except PlannerError as error:  # a goal that no problem can have
                self.words = str(error)

    def end(self) -> None:
        """Let work() return."""
        self._ended = True
        self._changed.set()

    def step(self) -> None:
        """Plan for the goals as they are now, unless the plan is, then prove it."""
        began, asked = time.monotonic(), copy.deepcopy(self._asked)
        if asked != self._planned:
            assert self._plan.recipe is not None
            plan = solve(self._plan.recipe.rebuilt(**asked), warm_start=self._plan)
            if not np.isfinite(plan.xs).all():
                raise PlannerError(plan.message)
            self._plan, self._planned = plan, asked
            self._took = f" Planned in {1e3 * (time.monotonic() - began):.0f} ms."
            self._show()
        if not self._changed.is_set():
            proof = prove(self._plan, rollouts=0)
            self.replay, self.words = proof.replay, f"**{proof.headline}**. {proof.own_step}{self._took}"

    def _show(self) -> None:
        assert self._plan.twin is not None
        self.replay = replay_in(CompiledTwin(self._plan.twin), self._plan, feedback=True)
        self.words = f"{self._plan.status.name}, not proved yet.{self._took}"


def _changeable(plan: Plan) -> dict[str, Any]:
    """Parameters of a plan's recipe that may change: a problem file's goal, where it has one; the numbers of a case."""
    if plan.recipe is None or plan.problem is None:
        return {}
    given = plan.parameters
    if plan.recipe.name != PROBLEM_FILE:
        return {name: value for name, value in given.items() if isinstance(value, float)}
    if "goal" not in given:
        return {}
    goal = copy.deepcopy(given["goal"])
    if isinstance(goal, str) or (goal and isinstance(goal, list) and not isinstance(goal[0], dict)):  # a whole pose
        assert isinstance(plan.problem.dynamics, RigidBodyDynamics)  # as of every problem file
        mechanism = plan.problem.dynamics.mechanism
        x = state_of("goal", goal, mechanism, plan.problem.x0)
        if all(mechanism.joint_names):
            ends = np.append([mechanism.q_address[links.start] for links in mechanism.joint_links], mechanism.nq)
            values = [x[first:last].tolist() for first, last in pairwise(ends)]
            pairs = zip(mechanism.joint_names, values, strict=True)
            goal = {name: value[0] if len(value) == 1 else value for name, value in pairs}
    return {"goal": goal}


def _slots(goal: Any, prefix: str = "") -> dict[str, tuple[dict[str, Any], str]]:
    """Tables and keys of the places and joints in a `goal`, by name: a table of joints, or a list of [[goal]]."""
    if isinstance(goal, dict):
        return {prefix + joint: (goal, joint) for joint, value in goal.items() if isinstance(value, (int, float))}
    found = {}
    for i, one in enumerate(goal if isinstance(goal, list) else (), 1):
        if isinstance(one, dict) and "position" in one:
            found[f"goal {i}: {one['frame']}"] = (one, "position")
        elif isinstance(one, dict):
            found |= _slots(one.get("joints"), f"goal {i}: ")
    return found


class Stage:
    """Machine, ghost and floor in viser's scene."""

    def __init__(self, scene: Any, film: Film) -> None:
        """Add the shapes of a film's model."""
        mujoco = load_mujoco()
        self._model = model = visible_model([film])
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        shapes, paint = drawn_shapes(model, data), ghost_paint(film.appearance)
        self._bodies = sorted({int(body) for body, *_ in shapes if model.body_weldid[body]})
        self.ghost = scene.add_frame("/ghost", show_axes=False)
        self._frames = [[scene.add_frame(f"/{part}/{body}", show_axes=False) for body in self._bodies]
                        for part in ("machine", "ghost")]  # fmt: skip
        for i, (body, kind, size, place, colour, mesh) in enumerate(shapes):
            if kind == "plane":
                scene.add_grid(f"/floor/{i}", infinite_grid=True, position=(0.0, 0.0, place[2]))
                continue
            at = place if body in self._bodies else place_in_world(data.xpos[body], data.xquat[body], place)
            vertices, faces = _shape(model, kind, size, mesh)
            copies = {"machine": colour, "ghost": paint} if body in self._bodies else {"world": colour}
            for part, rgba in copies.items():
                scene.add_mesh_simple(
                    f"/{part}/{body}/{i}", vertices, faces, color=tuple(map(float, rgba[:3])), position=at[:3],
                    wxyz=at[3:], opacity=float(rgba[3]) if rgba[3] < 1.0 else None, cast_shadow=part != "ghost",
                )  # fmt: skip
        self.seen = unobstructed(film, model)
        self.look_at, self.distance = whole_motion([film], model, self.seen, 1.6, True)

    def set_motion(self, film: Film) -> None:
        """Take the poses (F, B, 7) of a film."""
        self._motion = [body_poses(self._model, qpos, self._bodies) for qpos in (film.qpos, film.ghost_qpos)]

    def pose(self, part: float) -> None:
        """Put machine and ghost where they are at a part of the motion, 0 to 1."""
        for frames, motion in zip(self._frames, self._motion, strict=True):
            for frame, place in zip(frames, motion[round(part * (len(motion) - 1))], strict=True):
                frame.position, frame.wxyz = place[:3], place[3:]


def _shape(model: Any, kind: str, size: np.ndarray, mesh: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) about its middle and triangles (T, 3) of a shape; `size` are MuJoCo's half lengths."""
    if kind == "mesh":
        return simplified(*mesh_of(model, mesh), _TRIANGLES)
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
        why = "viser is not installed, expected it for --browser: pip install slq-planner[view]."
        raise PlannerError(why) from None
    replanner = Replanner(plan)
    with redirect_stdout(io.StringIO()):  # it prints its address whatever it is told
        server = viser.ViserServer(host="127.0.0.1", port=port, verbose=False)
    try:
        film = _film(replanner)
        stage = Stage(server.scene, film)
        server.initial_camera.look_at = stage.look_at
        ahead = directions(stage.seen.azimuth, stage.seen.elevation)[0]
        server.initial_camera.position = stage.look_at - stage.distance * ahead
        threading.Thread(target=replanner.work, daemon=True).start()
        if ready is not None:
            ready(f"http://127.0.0.1:{server.get_port()}")
        player = Player(float(film.t[-1] - film.t[0]), film.appearance.speed if speed is None else speed)
        words = server.gui.add_markdown("")
        _add_goals(server, replanner, _HANDLE * stage.distance)
        plays, ghost = server.gui.add_checkbox("play", True), server.gui.add_checkbox("ghost: the plan", True)
        at = server.gui.add_slider("time, s", 0.0, player.end, player.end / _SAMPLES, 0.0)
        replay, before = None, time.monotonic()
        while not (each is not None and each(player, replanner)):
            words.content = replanner.words
            if replay is not replanner.replay:
                replay, film = replanner.replay, _film(replanner)
                stage.set_motion(film)
                player.end = at.max = float(film.t[-1] - film.t[0])  # an objective with time may choose another
            now = time.monotonic()
            player.playing, stage.ghost.visible = plays.value, ghost.value
            player.advance(now - before)
            before = now
            with server.atomic():
                if player.playing:
                    at.value = player.t
                player.t = min(at.value, player.end)
                stage.pose(player.t / player.end)
            time.sleep(max(0.0, 1.0 / _RATE - (time.monotonic() - now)))
    except KeyboardInterrupt:
        pass
    finally:
        replanner.end()
        with redirect_stdout(io.StringIO()):
            server.stop()


def _film(replanner: Replanner) -> Film:
    replay = replanner.replay
    return Film.of(replay, np.linspace(replay.t[0], replay.t[-1], _SAMPLES))


def _add_goals(server: Any, replanner: Replanner, size: float) -> None:
    """Arrows at the places to drag, numbers of the joints to type."""
    for i, (name, value) in enumerate(replanner.goals.items()):
        if np.ndim(value):
            place = np.asarray(value, dtype=float)
            arrows = server.scene.add_transform_controls(f"/goals/{i}", size, disable_rotations=True, position=place)
            server.scene.add_label(f"/goals/{i}/name", name)
            arrows.on_update(lambda event, name=name: replanner.move(name, event.target.position.tolist()))
        else:
            field = server.gui.add_number(name, float(value), step=0.05)
            field.on_update(lambda event, name=name: replanner.move(name, float(event.target.value)))
