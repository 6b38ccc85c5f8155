"""How often MuJoCo compiles a model: reading and proving look at one compiled model, each text is compiled once."""

from collections import deque
from dataclasses import replace

import mujoco
import numpy as np
import pytest

import planner
from planner import Mechanism, RigidBodyDynamics, TrackingCost
from planner.contact import ContactLaw
from planner.model.mjcf import model_index
from planner.model.mjcf.read import read
from planner.model.mjcf.text import edited
from planner.proof.prove_plan import prove
from planner.proof.replays.replaying import reached_by_plan

ARM = """
<mujoco><option gravity="0 0 -9.81"/><worldbody>
  <body><joint name="hinge" axis="0 -1 0" damping="0.05"{friction}/>
    <geom type="capsule" fromto="0 0 0 .5 0 0" size=".02"/>
    <body pos=".5 0 0"><joint name="wrist" axis="0 -1 0"/><geom type="sphere" size=".05" pos=".1 0 0"/></body></body>
  {floor}</worldbody><actuator><motor name="motor" joint="hinge"/><motor joint="wrist"/></actuator></mujoco>
"""
PLAIN = ARM.format(friction="", floor="")
RUBBING = ARM.format(friction=' frictionloss="0.1"', floor="")
ON_FLOOR = ARM.format(friction="", floor='<geom name="floor" type="plane" pos="0 0 -1" size="1 1 1"/>')


@pytest.fixture
def texts(monkeypatch):
    """The texts that MuJoCo has compiled, in order."""
    Mechanism.from_mjcf(ON_FLOOR, contacts=ContactLaw.resting(1.0))  # asks once a process how margins add up
    seen, compiled = [], model_index.compile_in_subprocess

    def counted(text, *rest):
        seen.append(text)
        return compiled(text, *rest)

    monkeypatch.setattr(model_index, "compile_in_subprocess", counted)
    monkeypatch.setattr(model_index, "RECENT", deque(maxlen=8))
    return seen


def task(mechanism, **options):
    dynamics = RigidBodyDynamics(mechanism, dt=0.01, **options)
    goal = mechanism.home.copy()
    goal[0] = 0.2
    return planner.Problem(
        dynamics, TrackingCost.joints(dynamics, goal, 20, effort=0.1, final_position=10.0), mechanism.home
    )


def test_a_model_that_is_read_as_it_is_compiles_once(texts):
    Mechanism.from_mjcf(PLAIN)
    assert len(texts) == 1


@pytest.mark.parametrize(
    ("text", "options"),
    [
        (RUBBING, {"ignore": ("frictionloss",)}),
        (ON_FLOOR, {"contacts": "off"}),
        (ON_FLOOR, {"contacts": ContactLaw.resting(1.0)}),
        (ON_FLOOR.replace("damping", 'frictionloss="0.1" damping'),
         {"contacts": ContactLaw.resting(1.0), "ignore": ("frictionloss",)}),
    ],
    ids=["what is ignored", "no contacts", "a law", "a law and what is ignored"],
)  # fmt: skip
def test_a_model_that_is_edited_compiles_twice(texts, text, options):
    """First to know what the edit must change, then to read what it has become."""
    Mechanism.from_mjcf(text, **options)
    assert len(texts) == len(set(texts)) == 2


def test_a_model_with_coarser_meshes_is_not_compiled_once_more_for_other_edits(texts):
    """The same two times, though both the mesh and the contacts are edited."""
    n = 1000  # a fan of triangles, whose file is too large for what is only seen
    rim = [f"v {np.cos(a):.60f} {np.sin(a):.60f} 0" for a in np.linspace(0.0, 1.0, n)]
    fan = "\n".join(["v 0 0 0", *rim, *(f"f 1 {i} {i + 1}" for i in range(2, n + 1))]).encode()
    assets = '<asset><mesh name="fan" file="fan.obj" inertia="shell"/></asset>'
    look = '<geom type="mesh" mesh="fan" contype="0" conaffinity="0"/>'
    text = ON_FLOOR.replace("<worldbody>", f"{assets}<worldbody>{look}")
    mechanism = read(text, assets={"fan.obj": fan}, contacts="off")
    assert list(mechanism.assets) == ["fan.coarse.obj"]
    assert texts[1:] == [mechanism.mjcf]
    assert mechanism.mjcf != mechanism.original


def test_a_proof_compiles_what_was_read_no_more(texts):
    plan = planner.solve(task(Mechanism.from_mjcf(PLAIN)))
    assert plan.twin is not None
    assert texts == [plan.twin.mjcf]
    proof = prove(plan, rollouts=2, hold_seconds=0.1)
    reached_by_plan(replace(proof.replay, reached=("something",)))
    assert len(texts) == 1


def test_reading_and_proving_an_edited_file_compile_each_text_once(texts):
    plan = planner.solve(task(Mechanism.from_mjcf(RUBBING, ignore=("frictionloss",))))
    prove(plan, rollouts=0)
    assert plan.twin is not None
    assert sorted(texts) == sorted([plan.twin.original, plan.twin.mjcf])


def test_a_proof_in_another_model_compiles_that_model_and_what_is_replayed(texts):
    """The other model as given, and without the friction that the plan leaves out, as its own two texts tell."""
    plan = planner.solve(task(Mechanism.from_mjcf(RUBBING, ignore=("frictionloss",))))
    texts.clear()
    prove(plan, mjcf=edited(RUBBING, {".//joint[@name='hinge']": {"damping": "0.06"}}), rollouts=0)
    assert len(texts) == len(set(texts)) == 2


def test_driving_joints_compiles_the_model_once_more(texts):
    """With the joints heavy, to know how soft contacts become; where there are none, that is what is proved, too."""
    mechanism = Mechanism.from_mjcf(PLAIN)
    texts.clear()
    plan = planner.solve(task(mechanism, prescribed=("wrist",)))
    prove(plan, rollouts=0)
    assert plan.twin is not None
    assert texts == [plan.twin.mjcf]


def test_nobody_changes_a_model_that_others_are_given_too(texts):
    """Everything of a proof that changes a compiled model does so in a copy of its own."""
    mechanism = Mechanism.from_mjcf(PLAIN)
    model = model_index.compile_model(mechanism.mjcf, mechanism.assets)
    before = np.empty(mujoco.mj_sizeModel(model), dtype=np.uint8)
    after = before.copy()
    mujoco.mj_saveModel(model, None, before)
    prove(planner.solve(task(mechanism)), rollouts=8, hold_seconds=0.1)
    assert model_index.compile_model(mechanism.mjcf, mechanism.assets) is model
    mujoco.mj_saveModel(model, None, after)
    np.testing.assert_array_equal(after, before)


def test_large_models_are_not_kept(texts, monkeypatch):
    monkeypatch.setattr(model_index, "MAX_KEPT", 0)
    for text in (PLAIN, RUBBING, PLAIN):
        model_index.compile_model(text)
    assert len(texts) == 3
    assert len(model_index.RECENT) == 1
