"""Models of several files stand alone, and wrong files are one sentence."""

import struct

import numpy as np
import pytest
from machines import MACHINE, OBJ, plain

from planner.base.errors import PlannerError
from planner.base.gl import load_mujoco
from planner.model.mechanism import Mechanism
from planner.model.mjcf.read import read
from planner.model.mjcf.text import model_text

mujoco = load_mujoco()


@pytest.fixture
def folder(tmp_path):
    """A model in several files, two of them with one name, some beside the file that includes the one naming them."""
    for part, height in (("shapes", 1), ("arm", 2), ("arm/deep", 3)):
        (tmp_path / part).mkdir()
        (tmp_path / part / "wedge.obj").write_text(OBJ.format(height))
    heights = np.arange(6, dtype=np.float32)
    (tmp_path / "shapes" / "hill.bin").write_bytes(struct.pack("<ii", 2, 3) + heights.tobytes())
    (tmp_path / "main.xml").write_text("""
      <mujoco><compiler meshdir="shapes"/><option><flag contact="disable"/></option>
        <include file="arm/arm.xml"/>
        <asset><mesh file="wedge.obj"/><hfield name="hill" file="hill.bin" size="1 1 1 1"/></asset>
        <worldbody><geom type="hfield" hfield="hill"/>
          <body><joint/><geom type="mesh" mesh="wedge"/><geom type="mesh" mesh="long"/></body></worldbody></mujoco>""")
    (tmp_path / "arm" / "arm.xml").write_text("""
      <mujocoinclude><include file="deep/more.xml"/>
        <asset><mesh name="other" file="../arm/wedge.obj" scale="2 2 2"/></asset></mujocoinclude>""")
    (tmp_path / "arm" / "deep" / "more.xml").write_text("""
      <mujocoinclude><asset><mesh name="long" file="deep/wedge.obj"/></asset></mujocoinclude>""")
    (tmp_path / "arm" / "deep" / "deep").mkdir()
    (tmp_path / "arm" / "deep" / "deep" / "wedge.obj").write_text(OBJ.format(5))
    return tmp_path


def test_a_model_of_several_files_stands_alone(folder, monkeypatch):
    whole = mujoco.MjModel.from_xml_path(str(folder / "main.xml"))
    m = Mechanism.from_mjcf(folder / "main.xml")
    assert len(m.assets) == 4  # three wedges and a hill
    elsewhere = folder / "elsewhere"
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    alone = mujoco.MjModel.from_xml_string(m.mjcf, m.assets)
    np.testing.assert_array_equal(alone.mesh_vert, whole.mesh_vert)
    np.testing.assert_array_equal(alone.hfield_data, whole.hfield_data)
    np.testing.assert_array_equal(alone.body_mass, whole.body_mass)
    again = read(m.mjcf, assets=m.assets)
    assert again.mjcf == m.mjcf
    assert again.assets == m.assets
    np.testing.assert_array_equal(again.mass, m.mass)


def test_a_missing_file_is_named(folder):
    (folder / "shapes" / "hill.bin").unlink()
    with pytest.raises(PlannerError, match=r"cannot read 'hill.bin' that the model names"):
        Mechanism.from_mjcf(folder / "main.xml")


def test_models_that_attach_models(tmp_path):
    (tmp_path / "part.xml").write_text(plain())
    text = """<mujoco><option><flag contact="disable"/></option><asset><model name="m" file="part.xml"/></asset>
      <worldbody><body name="x" pos="1 0 0"><attach model="m" body="one" prefix="p_"/></body></worldbody></mujoco>"""
    (tmp_path / "main.xml").write_text(text)
    m = Mechanism.from_mjcf(tmp_path / "main.xml")
    assert m.joint_names == ("p_h", "p_s")
    assert read(m.mjcf, assets=m.assets).joint_names == m.joint_names


def test_includes_are_found_as_mujoco_finds_them(folder):
    """Beside the file that includes, or, as the reference says, from the main file's folder."""
    (folder / "arm" / "arm.xml").write_text('<mujocoinclude><include file="arm/deep/more.xml"/></mujocoinclude>')
    assert mujoco.MjModel.from_xml_path(str(folder / "main.xml")).nmesh == 2
    assert 'name="long"' in model_text(folder / "main.xml")


BOMB = '<!DOCTYPE x [<!ENTITY a "b"><!ENTITY c "&a;&a;">]><mujoco>&c;</mujoco>'
WRONG = {
    "": "the model is an empty text",
    "  \n": "the model is an empty text",
    "no/such/file.xml": "cannot read the model no/such/file.xml: No such file",
    "null\0byte": "cannot read the model",
    "<mujoco>": "not well-formed XML",
    "<mujoco>\ud800</mujoco>": "not well-formed XML",
    "<robot/>": "root element <robot>",
    BOMB: "declares XML entities",
    "<mujoco><include/></mujoco>": "an <include> without a file",
    "<mujoco><include file='nowhere.xml'/></mujoco>": "cannot read the model nowhere.xml",
    "<mujoco><asset><mesh file='nowhere.obj'/></asset></mujoco>": "cannot read 'nowhere.obj'",
    "<mujoco><worldbody/></mujoco>": "has no joints",
    "<mujoco><worldbody><body><joint/></body></worldbody></mujoco>": "mass and inertia of moving bodies",
    "<mujoco><worldbody><body colour='red'/></worldbody></mujoco>": "colour",
    "<mujoco>" + "<worldbody>" * 5000 + "</worldbody>" * 5000 + "</mujoco>": "nested too deeply",
}


@pytest.mark.parametrize(("text", "sentence"), WRONG.items(), ids=range(len(WRONG)))
def test_wrong_models_are_refused_in_one_sentence(text, sentence, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(PlannerError) as error:
        Mechanism.from_mjcf(text)
    assert sentence in str(error.value)
    assert str(error.value).endswith(".")
    assert "\n" not in str(error.value)


def test_wrong_paths_and_options_are_refused(tmp_path):
    with pytest.raises(PlannerError, match="Is a directory"):
        Mechanism.from_mjcf(tmp_path)
    (tmp_path / "binary.xml").write_bytes(b"\xff\xfe\x00<")
    with pytest.raises(PlannerError, match="not text"):
        Mechanism.from_mjcf(tmp_path / "binary.xml")
    with pytest.raises(PlannerError, match="the model is a int"):
        Mechanism.from_mjcf(3)  # pyright: ignore[reportArgumentType]
    with pytest.raises(PlannerError, match=r"ignore is 'friction', expected one of: frictionloss, .*'frictionloss'"):
        Mechanism.from_mjcf(MACHINE, ignore=("friction",))
    assert Mechanism.from_mjcf(MACHINE, ignore=("frictionloss",)).ignored == ()


def test_a_file_that_includes_itself(tmp_path):
    (tmp_path / "a.xml").write_text("<mujoco><include file='a.xml'/></mujoco>")
    with pytest.raises(PlannerError, match="includes itself"):
        Mechanism.from_mjcf(tmp_path / "a.xml")
