"""Models that ask for more than a machine has, or that are no ordinary files, are one sentence and no wait."""

import os

import pytest
from machines import OBJ, plain

from planner.base.errors import ModelError
from planner.model.mechanism import Mechanism
from planner.model.mjcf.text import (
    MAX_COPIES,
    MAX_ELEMENTS,
    MAX_FILES,
    MAX_LEVELS,
    check_stored,
    model_text,
    model_tree,
)

WORLD = "<mujoco><worldbody>%s</worldbody></mujoco>"
GEOM = '<geom size="0.1"/>'


def refused(model, words):
    with pytest.raises(ModelError, match=words) as error:
        model_tree(model)
    text = str(error.value)
    assert text.endswith(".")
    assert "\n" not in text


pipes = pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes with names here")


@pytest.fixture
def pipe(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    return tmp_path / "pipe"


@pytest.mark.skipif(not os.path.exists("/dev/zero"), reason="no such device here")
@pytest.mark.parametrize(
    "text",
    [
        None,
        '<mujoco><include file="{}"/></mujoco>',
        '<mujoco><asset><mesh name="m" file="{}"/></asset></mujoco>',
        '<mujoco><asset><texture type="cube" fileup="{}"/></asset></mujoco>',
        '<mujoco><asset><model name="m" file="{}"/></asset></mujoco>',
    ],
)
@pipes
def test_pipes_devices_and_folders_are_not_read(pipe, tmp_path, text):
    for place, words in ((pipe, "a device or pipe"), ("/dev/zero", "a device or pipe"), (tmp_path, "Is a directory")):
        model = place
        if text is not None:
            model = tmp_path / "main.xml"
            model.write_text(text.format(place))
        refused(model, f"cannot read .*: (it is )?{words}")


def test_large_files_are_not_read(tmp_path):
    with open(tmp_path / "large.xml", "wb") as file:
        file.truncate(64 * 2**20 + 1)  # no block of it is written
    with open(tmp_path / "large.obj", "wb") as file:
        file.truncate(512 * 2**20 + 1)
    refused(tmp_path / "large.xml", "it is larger than 64 MB")
    (tmp_path / "main.xml").write_text('<mujoco><asset><mesh name="m" file="large.obj"/></asset></mujoco>')
    refused(tmp_path / "main.xml", "'large.obj' that the model names at .* larger than 512 MB")


def test_names_with_odd_characters_are_escaped():
    refused("two\nlines.xml", r"cannot read the model 'two\\nlines\.xml'")


def replicas(*counts):
    text = GEOM
    for count in counts:
        text = f'<replicate count="{count}" offset="1 0 0">{text}</replicate>'
    return WORLD % text


@pytest.mark.parametrize(
    "text",
    [
        replicas(100_000_000),
        replicas(" +100000000 "),
        replicas(10**400),
        replicas(1000, 1000),
        replicas(*[10] * 400),
        WORLD % '<body><composite type="cable" count="1000 100 1"><geom type="capsule"/></composite></body>',
        WORLD % '<body><flexcomp type="grid" count="100 100 100"/></body>',
    ],
    ids=["many", "signed", "endless", "nested", "deeply nested", "composite", "flexcomp"],
)
def test_too_many_replicas_are_refused_before_they_are_made(text):
    refused(text, f"replicas and attached models make more than {MAX_COPIES} elements")


def test_some_replicas_and_what_mujoco_says_of_their_number():
    model_tree(replicas(MAX_COPIES - 1))
    machine = plain().replace("<worldbody>", '<option><flag contact="disable"/></option><worldbody>')
    two = '<replicate count="%s" offset="1 0 0"><geom size="0.1"/></replicate></worldbody>'
    assert "replicate" in Mechanism.from_mjcf(machine.replace("</worldbody>", two % 100)).mjcf
    for count in ("many", "1e2", ""):
        with pytest.raises(ModelError, match="MuJoCo refuses"):
            Mechanism.from_mjcf(machine.replace("</worldbody>", two % count))


def test_models_that_attach_models_without_end(tmp_path):
    part = (
        '<mujoco><asset><model name="m" file="{0}"/></asset><worldbody><body name="one">{1}</body></worldbody></mujoco>'
    )
    attach = '<attach model="m" body="one" prefix="{}"/>'
    twice = "".join(attach.format(prefix) for prefix in "ab")
    for number in range(15):
        (tmp_path / f"{number}.xml").write_text(part.format(f"{number + 1}.xml", twice))
    (tmp_path / "15.xml").write_text(plain())
    model_tree(tmp_path / "10.xml")
    refused(tmp_path / "0.xml", "replicas and attached models make more than")

    (tmp_path / "own.xml").write_text(part.format("own.xml", attach.format("a")))
    refused(tmp_path / "own.xml", "own.xml includes itself")
    own = part.format("own.xml", attach.format("a"))
    with pytest.raises(ModelError, match=r"'own\.xml' attaches itself"):  # MuJoCo would end the process
        model_tree(own, {"own.xml": own.encode()})
    with pytest.raises(ModelError, match=r"'own\.xml' is not text"):
        model_tree(own, {"own.xml": b"\xff\xfe"})


def test_includes_of_includes_are_bounded(tmp_path):
    """Each file includes the next one twice: nobody could read them to the end."""
    include = '<include file="{}.xml"/>'
    for number in range(40):
        (tmp_path / f"{number}.xml").write_text(f"<mujoco>{include.format(number + 1) * 2}</mujoco>")
    (tmp_path / "40.xml").write_text("<mujoco/>")
    refused(tmp_path / "0.xml", f"reads more than {MAX_FILES} files")
    with pytest.raises(ModelError, match="reads more than"):
        model_text(tmp_path / "0.xml")
    (tmp_path / "0.xml").write_text('<mujoco><asset><model file="1.xml"/></asset></mujoco>')
    refused(tmp_path / "0.xml", "reads more than")

    (tmp_path / "large.xml").write_text(f"<mujoco>{'<a/>' * (MAX_ELEMENTS // 10)}</mujoco>")
    (tmp_path / "main.xml").write_text(f"<mujoco>{include.format('large') * 12}</mujoco>")
    refused(tmp_path / "main.xml", f"more than {MAX_ELEMENTS} elements")

    for number in range(150):
        (tmp_path / f"{number}.xml").write_text(f'<mujoco><include file="{number + 1}.xml"/></mujoco>')
    refused(tmp_path / "0.xml", "nested too deeply, expected at most 100 files in files")


def test_elements_and_levels_are_bounded():
    refused(WORLD % (GEOM * MAX_ELEMENTS), f"more than {MAX_ELEMENTS} elements")
    refused(WORLD % ("<body>" * MAX_LEVELS + "</body>" * MAX_LEVELS), "nested too deeply")
    model_tree(WORLD % ("<body>" * (MAX_LEVELS - 50) + "</body>" * (MAX_LEVELS - 50)))


MESH = '<mujoco><asset><mesh name="m" file="{}"/></asset></mujoco>'


@pytest.mark.parametrize(
    "text",
    [
        '<mujoco><include file="/etc/passwd"/></mujoco>',
        '<mujoco><include file="wedge.obj"/></mujoco>',
        MESH.format("/etc/passwd"),
        MESH.format("wedge.stl"),
        '<mujoco><asset><texture type="cube" fileback="/etc/passwd"/></asset></mujoco>',
        '<mujoco><asset><model name="m" file="/etc/passwd"/></asset></mujoco>',
        '<mujoco><asset><model name="m" file="part.xml"/></asset></mujoco>',
        '<mujoco><worldbody><flexcomp name="f" type="mesh" file="/etc/passwd"/></worldbody></mujoco>',
    ],
)
def test_a_stored_model_names_only_what_it_carries(text):
    files = {"wedge.obj": OBJ.format(1).encode(), "part.xml": MESH.format("/etc/passwd").encode()}
    with pytest.raises(ModelError, match=r"its model names the file '.*' that the plan does not carry\."):
        check_stored(text, files)


def test_a_stored_model_may_name_what_it_carries():
    """By any case and folder, as MuJoCo finds it; also through models that it attaches."""
    files = {"wedge.obj": b"", "Part.xml": MESH.format("wedge.obj").encode()}
    check_stored(MESH.format("wedge.obj"), files)
    check_stored(MESH.format("shapes/WEDGE.obj"), files)
    check_stored('<mujoco><asset><model name="m" file="part.xml"/></asset></mujoco>', files)
    with pytest.raises(ModelError, match="not well-formed XML"):
        check_stored("/etc/passwd", files)


def test_a_text_that_includes_what_is_no_model(tmp_path):
    """A text given in Python may name files, from the working directory; what they are is still checked."""
    (tmp_path / "secret").write_text("root:x:0:0")
    refused(f'<mujoco><include file="{tmp_path / "secret"}"/></mujoco>', "secret is not well-formed XML")
