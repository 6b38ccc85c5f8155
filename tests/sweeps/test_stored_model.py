"""A stored plan notices that the model it was made from has changed on disk, and says what its file asks for."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

import planner
from planner.__main__ import main
from planner.base.errors import ModelError
from planner.model.mjcf.facts import model_changes
from planner.model.mjcf.text import edited
from planner.problem.archive import FORMAT_VERSION, digests, read_archive, write_archive
from planner.problem.plan import Iteration
from planner.sweeps.regression import check, stored_proof
from planner.sweeps.stored_model import ModelState

ARM = """<mujoco><worldbody><geom name="wall" type="box" size=".05 .05 .2" pos="-.7 .8 0"/>
  <body name="link"><joint name="hinge" axis="0 0 1" damping="0.1"/>
  <geom name="arm" type="capsule" fromto=".2 0 0 1 0 0" size=".02" mass="5"/><site name="tip" pos="1 0 0"/></body>
  </worldbody><actuator><motor name="motor" joint="hinge"/></actuator></mujoco>"""
TABLE = """model = "{}"\nstart = {{}}\ngoal = {{ hinge = 1.0 }}\nduration = 0.5\ndt = 0.02\n{}"""


def stored_in(folder: Path, model: str = "arm.xml", more: str = "") -> Path:
    """A plan of a problem file with its proof; the model lies at a path relative to the folder."""
    folder.mkdir(exist_ok=True)
    (folder / model).write_text(ARM)
    (folder / "problem.toml").write_text(TABLE.format(model, more))
    plan = planner.solve(planner.cases.problem_file.load(folder / "problem.toml").problem)
    return stored_with_proof(plan, folder)


def stored_with_proof(plan: planner.Plan, folder: Path) -> Path:
    """The plan's file, with a proof without rollouts beside it; without one, check() does all that it can."""
    path = plan.save(folder / "plan.npz")
    stored_proof(path).write_text(json.dumps(planner.prove(plan, rollouts=0).to_dict()))
    return path


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return stored_in(tmp_path_factory.mktemp("made")).parent


@pytest.fixture
def folder(made, tmp_path):
    return shutil.copytree(made, tmp_path / "plans")


def one(folder: Path, **more: object) -> planner.sweeps.regression.PlanComparison:
    (found,) = check(folder, **more)
    return found


CHANGES = [
    ({".//geom[@name='arm']": {"mass": "5.05"}}, "mass of body 'link' is 5.05, was 5 (+1 %)"),
    ({".//geom[@name='arm']": {"mass": "6"}}, "mass of body 'link' is 6, was 5 (+20 %)"),
    ({".//joint": {"damping": "0.11"}}, "damping of joint 'hinge' is 0.11, was 0.1 (+10 %)"),
    ({".//joint": {"armature": "0.01"}}, "armature of joint 'hinge' is 0.01, was 0"),
    ({".//joint": {"range": "-90 90"}}, "range of joint 'hinge'[0] is -1.5708, was 0"),
    ({".//geom[@name='wall']": {"pos": "-.7 .9 0"}}, "position of geom 'wall'[1] is 0.9, was 0.8 (+12.5 %)"),
    ({".//geom[@name='wall']": {"name": "post"}}, "geom 'post' is new"),
    ({".//motor": {"gear": "2"}}, "gear of actuator 'motor'[0] is 2, was 1 (+100 %)"),
    ({".//motor": {"joint": "hinge", "ctrlrange": "-1 1"}}, "control range of actuator 'motor'"),
]


@pytest.mark.parametrize(("edits", "words"), CHANGES)
def test_what_changed_is_named_with_its_numbers(edits, words):
    found = model_changes(ARM, edited(ARM, edits), {}, {})
    assert any(sentence.startswith(words) for sentence in found), found


def test_looks_and_comments_are_no_change():
    new = edited(ARM, {".//geom[@name='wall']": {"rgba": "1 0 0 1"}}).replace(
        "<worldbody>", "<!-- a wall --><worldbody>"
    )
    assert model_changes(ARM, new, {}, {}) == ()


def test_a_changed_model_is_named_and_can_be_accepted(folder, capsys):
    assert one(folder).model.state is ModelState.SAME
    assert main(["check", str(folder), "--quiet"]) == 0
    assert "as stored. model same (arm.xml)." in capsys.readouterr().out
    (folder / "arm.xml").write_text(edited(ARM, {".//geom[@name='arm']": {"mass": "5.05"}}))
    assert main(["check", str(folder), "--quiet"]) == 1
    said = capsys.readouterr().out
    assert "model changed (arm.xml): mass of body 'link' is 5.05, was 5 (+1 %)" in said
    assert main(["check", str(folder), "--quiet", "--update"]) == 0
    assert one(folder).model.state is ModelState.ACCEPTED
    assert main(["check", str(folder), "--quiet"]) == 0
    (folder / "arm.xml").write_text(edited(ARM, {".//geom[@name='arm']": {"mass": "6"}}))
    assert one(folder).word == "model changed"  # another one than was accepted


def test_a_model_that_is_gone_is_missed_and_one_outside_is_not_looked_at(folder, tmp_path, capsys):
    (folder / "arm.xml").rename(tmp_path / "arm.xml")
    assert main(["check", str(folder), "--quiet"]) == 1
    said = capsys.readouterr().out
    assert "not compared. its model arm.xml is not there any more, expected it beside the plan, or --model FILE" in said
    assert one(folder, model=tmp_path / "arm.xml").model.state is ModelState.SAME
    (tmp_path / "heavier.xml").write_text(edited(ARM, {".//geom[@name='arm']": {"mass": "6"}}))
    assert main(["check", str(folder), "--quiet", "--model", str(tmp_path / "heavier.xml")]) == 1
    assert "was 5 (+20 %)" in capsys.readouterr().out
    outside = stored_in(tmp_path / "below", "../arm.xml")
    assert "../arm.xml is outside of the plan's folder, expected --model FILE" in str(one(outside).model)
    (folder / "arm.xml").symlink_to(tmp_path / "arm.xml")
    assert one(folder).model.state is ModelState.UNREAD  # a link leads outside
    with pytest.raises(ModelError):
        planner.model.twin.read_again({}, tmp_path / "none.xml")


def test_a_plan_of_a_mechanism_with_a_payload_remembers_how_it_was_read(tmp_path):
    (tmp_path / "arm.xml").write_text(ARM)
    payload = {"frame": "tip", "mass": 0.5, "size": 0.05}
    m = planner.Mechanism.from_mjcf(tmp_path / "arm.xml", attach=payload, contacts="off")
    d = planner.RigidBodyDynamics(m, 0.02)
    cost = planner.TrackingCost.joints(d, np.array([1.0, 0.0]), 50, effort=0.01, final_position=1e3)
    path = stored_with_proof(planner.solve(planner.Problem(d, cost, np.zeros(2))), tmp_path)
    assert read_archive(path, len(Iteration._fields))[1]["twin"]["origin"]["path"] == "arm.xml"
    assert one(path, update=True).model.state is ModelState.SAME
    (tmp_path / "arm.xml").write_text(ARM.replace('damping="0.1"', 'damping="0.2"'))
    assert "damping of joint 'hinge' is 0.2, was 0.1 (+100 %)" in str(one(path).model)


URDF = """<robot name="arm"><link name="base"/><link name="link"><inertial><origin xyz="0.5 0 0"/><mass value="{}"/>
  <inertia ixx="0.01" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="hinge" type="continuous"><parent link="base"/><child link="link"/><axis xyz="0 0 1"/>
  <limit effort="50" velocity="9"/></joint></robot>"""


def test_a_urdf_is_compared_and_proved_in_as_well(tmp_path):
    (tmp_path / "arm.urdf").write_text(URDF.format(5.0))
    (tmp_path / "problem.toml").write_text(TABLE.format("arm.urdf", ""))
    plan = planner.solve(planner.cases.problem_file.load(tmp_path / "problem.toml").problem)
    path = stored_with_proof(plan, tmp_path)
    assert one(path, update=True).model.state is ModelState.SAME
    words = ["prove", str(path), "--rollouts", "0", "--quiet", "--model", str(tmp_path / "arm.urdf")]
    assert main(words) == 0
    (tmp_path / "arm.urdf").write_text(URDF.format(6.0))
    assert "mass of body 'link' is 6, was 5 (+20 %)" in str(one(path).model)
    assert main(words) == 1


def forged(path: Path, **changes: object) -> None:
    """Change a plan's file as somebody would who computes its digests again."""
    arrays, meta = read_archive(path, len(Iteration._fields))
    meta = {name: part for name, part in meta.items() if name not in ("changed", "format_version")}
    meta["space"] = meta["space"].to_dict()
    for name, change in changes.items():
        meta[name] = change(meta[name])
    assert digests(arrays, meta)
    assert FORMAT_VERSION
    write_archive(path, arrays, meta)


def loosened(recipe):
    return recipe | {"parameters": recipe["parameters"] | {"tolerance": 0.9}}


def test_a_forged_file_says_what_it_asks_for(folder, capsys):
    path = folder / "plan.npz"

    forged(path, tolerance=lambda _: 0.9, recipe=loosened)
    found = one(folder)
    assert found.stated == ("tolerance 0.9 rad", "tolerance 0.9 rad/s")
    main(["prove", str(path), "--rollouts", "0", "--quiet"])
    assert "as the plan's file states: tolerance 0.9 rad" in capsys.readouterr().out


def test_a_file_without_its_original_says_so(tmp_path):
    path = stored_in(tmp_path / "plans", more='contacts = "off"\n')
    assert one(path).stated == ()
    forged(path, twin=lambda twin: twin | {"original": ""})
    found = one(path)
    assert "the model that it was made from is not in the file" in found.stated
    assert "of a file that is not in the plan" in found.proof.headline


def edited_proof(folder: Path, change: object) -> None:
    file = stored_proof(folder / "plan.npz")
    content = json.loads(file.read_text())
    for key in ("plan", "goal") if change == "figures" else ("feasible", "optimal"):
        content[key]["figures"].clear() if change == "figures" else content.pop(key)
    file.write_text(json.dumps(content))


@pytest.mark.parametrize(("change", "lacks"), [("figures", "has no plan, goal"), ("words", "has no feasible, optimal")])
def test_numbers_and_words_taken_out_of_a_proof_are_missed(folder, change, lacks):
    edited_proof(folder, change)
    found = one(folder)
    assert not found.passed
    assert lacks in found.problem


def test_a_bound_wider_than_the_stored_one_is_worse(folder):
    forged(folder / "plan.npz", tolerance=lambda _: 0.9, recipe=loosened)
    found = one(folder)
    assert found.word == "regressed"
    assert {change.name for change in found.changes} >= {"bound of planned_angle_miss", "bound of replayed_angle_miss"}


def test_a_path_that_was_led_to_another_file_is_named(folder):
    shutil.copy(folder / "arm.xml", folder / "copy.xml")
    forged(folder / "plan.npz", twin=lambda twin: twin | {"origin": twin["origin"] | {"path": "copy.xml"}})
    assert "model same (copy.xml)" in str(one(folder))
