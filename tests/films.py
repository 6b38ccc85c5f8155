"""A replay that nobody simulated, for the tests of films and pages, and what is seen in pictures."""

import subprocess
from types import SimpleNamespace

import imageio_ffmpeg
import numpy as np

from planner.base.measured import Measurement, Section
from planner.model.mjcf.text import model_path, model_text
from planner.model.twin import Twin
from planner.problem.appearance import Appearance, Readout
from planner.problem.plan import Plan, Status
from planner.proof.replays.compiled_twin import CompiledTwin
from planner.proof.replays.contact_history import ContactHistory
from planner.proof.replays.replaying import Replay

SMALL = {"width": 320, "height": 180}


APPEARANCE = Appearance(
    title="test", readouts=(Readout("height", 0, "in"),), ghost_offset=(26.0, 0.0, 0.0),
    goal_line=((-16.0, 0.0, 34.0), (42.0, 0.0, 34.0)), goal_label="goal",
    look_at=(13.0, 0.0, 24.0), distance=100.0, azimuth=100.0, elevation=-10.0,
    force_scale=0.05, force_offset=(-12.0, 0.0, 0.0), speed=0.5,
)  # fmt: skip


def make_replay(appearance=APPEARANCE, *, plan_offset=0.0, force=400.0):
    """A hop that nobody simulated: up and down in a fifth of a second, in contact at first."""
    t = np.linspace(0.0, 0.2, 201)
    y = 10.0 * np.sin(np.pi * t / 0.2) - 2.0
    qpos = np.stack([y, np.minimum(y, 0.0)], axis=1)
    to_x, to_sim = np.zeros((1, 5)), np.zeros((1, 5, 1))
    to_x[0, 0] = to_sim[0, 0, 0] = 1.0
    text = model_text(model_path("hopper") / "scene.xml")
    twin = Twin(mjcf=text, to_x=to_x, to_x_offset=[0.0], to_sim=to_sim, to_sim_offset=np.zeros((1, 5)))
    xs, contact = y[:, None], y <= 0.0
    points = np.where(contact[:, None], np.zeros((201, 3)), np.nan)
    forces = np.where(contact, force, 0.0)[:, None] * [0.0, 0.0, 1.0]
    problem = None if appearance is None else SimpleNamespace(appearance=appearance, dynamics=SimpleNamespace(nx=1))
    plan = Plan(
        t=t[::100], xs=xs[::100], us=np.zeros((2, 1)), K=np.zeros((2, 1, 1)), cost=0.0, gradient_norm=0.0,
        status=Status.CONVERGED, history=(), problem=problem, twin=twin,
    )  # fmt: skip
    return Replay(
        plan=plan, compiled=CompiledTwin(twin), feedback=False, integrator="RK4", t=t, qpos=qpos,
        qvel=np.zeros((201, 2)), act=np.zeros((201, 1)), ctrl=np.zeros((200, 1)), xs=xs, plan_xs=xs + plan_offset,
        contact_force=np.where(contact, force, 0.0), contact_point=points, substeps=100,
        contacts=ContactHistory(("foot on floor",), t, forces[:, None], points[:, None]),
    )  # fmt: skip


def changed(a, b):
    """How many pixels differ visibly."""
    return int(np.sum(np.abs(a.astype(int) - b.astype(int)).max(axis=-1) > 8))


def decode(path, width, height):
    """The frames of a video (F, height, width, 3), and what ffmpeg says of it. imageio's reader leaks pipes."""
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-i", str(path), "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    done = subprocess.run(command, capture_output=True, check=True)
    return np.frombuffer(done.stdout, np.uint8).reshape(-1, height, width, 3), done.stderr.decode()


def make_proof(open_loop, gains, mode="feedback", *, passed=True, lost_with_gains=(), **failing):
    """A proof in which a mode passed; sections named in `failing` fail."""
    names = ("refined_open_loop", "refined_feedback", "order", "your_file")
    sections = {name: Section(name, (Measurement("error", float(name in failing), "", 0.5),)) for name in names}
    return SimpleNamespace(
        mode=mode, passed=passed and mode is not None, replay=gains, lost_with_gains=lost_with_gains,
        replays={"open-loop": open_loop, "feedback": gains}, sections=sections,
    )  # fmt: skip
