"""The page of `planner view --browser`: what a dragged goal leads to, where shapes are, and viser's own server."""

import sys
import threading
import time
from dataclasses import replace
from types import SimpleNamespace
from urllib.request import urlopen

import numpy as np
import pytest
from commands import refused, run

import planner
from planner.base.gl import load_mujoco
from planner.proof.replays.compiled_twin import CompiledTwin
from planner.proof.replays.replaying import replay_in
from planner.view.browser import Replanner, Stage, _slots, browse
from planner.view.render.film import Film

ARM = """<mujoco model="arm"><option timestep="0.002"/><worldbody>
  <geom name="stone" type="sphere" pos="0 1 0.1" size="0.1" contype="0" conaffinity="0"/>
  <body name="upper"><joint name="shoulder" axis="0 -1 0" damping="0.5"/>
    <geom type="capsule" fromto="0 0 0 0.4 0 0" size="0.03" mass="1" contype="0" conaffinity="0"/>
    <body name="fore" pos="0.4 0 0"><joint name="elbow" axis="0 -1 0" damping="0.5"/>
      <geom type="box" pos="0.15 0 0" size="0.15 0.02 0.02" mass="1" contype="0" conaffinity="0"/>
      <site name="hand" pos="0.3 0 0"/></body></body></worldbody>
  <actuator><motor name="shoulder" joint="shoulder"/><motor name="elbow" joint="elbow"/></actuator></mujoco>"""
PLACE = "goal 1: hand"


def solved(**task):
    arm = planner.Mechanism.from_mjcf(ARM)
    return planner.solve(planner.task(arm, start={"shoulder": 0.3, "elbow": 0.5}, duration=0.5, dt=0.02, **task))


@pytest.fixture(scope="module")
def plan():
    return solved(goals=planner.Goal(frame="hand", position=(0.4, 0.0, 0.4)))


def hand(plan):
    """(3,) where the plan brings the hand, by MuJoCo."""
    mujoco = load_mujoco()
    model = mujoco.MjModel.from_xml_string(ARM)
    data = mujoco.MjData(model)
    data.qpos[:] = plan.xs[-1, :2]
    mujoco.mj_kinematics(model, data)
    return data.site("hand").xpos.copy()


def until(condition):
    end = time.monotonic() + 30.0
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


def test_a_moved_goal_is_planned_for_and_proved(plan):
    replanner = Replanner(plan)
    assert replanner.goals == {PLACE: [0.4, 0.0, 0.4]}
    worker = threading.Thread(target=replanner.work, daemon=True)
    worker.start()
    assert replanner.replay.plan is plan
    until(lambda: "PASS" in replanner.words)  # it is proved first
    replanner.move(PLACE, [0.3, 0.0, 0.5])
    replanner.move(PLACE, [0.5, 0.0, 0.3])  # the newest counts
    until(lambda: replanner.replay.plan is not plan and "PASS" in replanner.words)
    moved = replanner.replay.plan
    np.testing.assert_allclose(hand(moved), [0.5, 0.0, 0.3], atol=5e-3)  # its tolerance
    assert "Planned in" in replanner.words
    replanner.move(PLACE, [float("nan")] * 3)  # what building the problem refuses
    until(lambda: "position" in replanner.words)
    assert replanner.replay.plan is moved  # which is shown on
    replanner.move(PLACE, [0.5, 0.0, 0.3])
    until(lambda: "PASS" in replanner.words)
    replanner.end()
    worker.join(10.0)
    assert not worker.is_alive()


def test_goals_of_joints_are_numbers_and_a_plan_without_a_goal_has_none():
    replanner = Replanner(solved(goals=planner.Goal(joints={"elbow": 1.0})))
    assert replanner.goals == {"goal 1: elbow": 1.0}
    replanner.move("goal 1: elbow", 1.2)
    replanner.step()
    assert abs(replanner.replay.plan.xs[-1, 1] - 1.2) < 0.02
    assert [*_slots({"elbow": 1.0, "root": [0, 0, 1]})] == ["elbow"]
    assert Replanner(replace(replanner.replay.plan, recipe=None)).goals == {}


def test_a_whole_pose_is_changed_by_its_joints_and_a_case_by_its_numbers(tmp_path):
    (tmp_path / "arm.xml").write_text(ARM, encoding="utf-8")
    (tmp_path / "arm.toml").write_text(
        'model = "arm.xml"\nstart = {}\ngoal = [0.5, 0.2]\nduration = 0.5\ndt = 0.02\n', encoding="utf-8"
    )
    replanner = Replanner(planner.solve(planner.load_problem(tmp_path / "arm.toml")))
    assert replanner.goals == {"shoulder": 0.5, "elbow": 0.2}
    replanner.move("elbow", 0.4)
    replanner.step()
    np.testing.assert_allclose(replanner.replay.plan.xs[-1, :2], [0.5, 0.4], atol=0.02)
    replanner = Replanner(planner.solve(planner.cases.hopper()))
    assert replanner.goals["height"] == 20.0
    replanner.move("height", 18.0)
    replanner.step()
    assert abs(replanner.replay.plan.xs[-1, 0] - 18.0) < 0.1


class Recorded:
    """A scene that remembers the meshes and frames that are added, by name."""

    def __init__(self):
        self.nodes = {}

    def __getattr__(self, name):
        def add(path, *shape, **options):
            self.nodes[path] = SimpleNamespace(**{"shape": shape, "position": np.zeros(3), "wxyz": None} | options)
            return self.nodes[path]

        return add


def test_shapes_are_where_mujoco_has_them(plan):
    """The box's corners and the stone, posed by the frames of their bodies."""
    pytest.importorskip("trimesh")
    mujoco, scene = load_mujoco(), Recorded()
    film = Film.of(replay_in(CompiledTwin(plan.twin), plan, feedback=True), plan.t)
    stage = Stage(scene, film)
    stage.set_motion(film)
    stage.pose(1.0)
    model = mujoco.MjModel.from_xml_string(ARM)
    data = mujoco.MjData(model)
    data.qpos[:] = film.qpos[-1]
    mujoco.mj_kinematics(model, data)
    fore = scene.nodes["/machine/2"]
    np.testing.assert_allclose(fore.position, data.body("fore").xpos, atol=1e-9)
    np.testing.assert_allclose(fore.wxyz, data.body("fore").xquat, atol=1e-9)
    box = next(node for name, node in scene.nodes.items() if name.startswith("/machine/2/"))
    np.testing.assert_allclose(box.shape[0].max(axis=0), [0.15, 0.02, 0.02])
    np.testing.assert_allclose(box.position, [0.15, 0.0, 0.0])
    capsule = next(node for name, node in scene.nodes.items() if name.startswith("/machine/1/"))
    np.testing.assert_allclose(np.ptp(capsule.shape[0], axis=0), [0.06, 0.06, 0.46], atol=1e-3)
    stone = next(node for name, node in scene.nodes.items() if name.startswith("/world/"))
    np.testing.assert_allclose(stone.position, [0.0, 1.0, 0.1])
    assert sum(name.startswith("/ghost/2/") for name in scene.nodes) == 1


def test_the_page_is_served_to_this_machine_and_ends(plan, capsys):
    pytest.importorskip("viser")
    pages, times = [], []

    def each(player, replanner):
        times.append(player.t)
        return len(times) > 5

    browse(plan, port=18412, ready=lambda address: pages.append((address, urlopen(address).read())), each=each)
    (address, page), *_ = pages
    assert address.startswith("http://127.0.0.1:")
    assert b"<html" in page
    assert times[-1] > times[0]
    assert capsys.readouterr().out == ""


def test_without_viser_a_sentence_says_what_to_install(plan, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    plan.save(tmp_path / "plan.npz")
    refused(run("view", "plan.npz", "--browser", cwd=tmp_path), "viser is not installed", "slq-planner[view]")
    refused(run("view", "plan.npz", "--browser", "--port", "70000", cwd=tmp_path), "port", "65535")
