"""Models that MuJoCo's compiler would take hours or gigabytes for, or that end it, are one sentence."""

import os
import signal
import subprocess
import sys
import threading
import time

import pytest
from machines import OBJ, plain

from planner.base.errors import ModelError
from planner.model.mechanism import Mechanism
from planner.model.mjcf import compile_subprocess
from planner.model.mjcf.model_index import MAX_PAIRS, MAX_TOUCHING, compile_model
from planner.model.mjcf.read import LARGEST, MAX_DOFS, read

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="models are compiled in place here")
WORLD = "<mujoco>{0}<asset>{1}</asset><worldbody>{2}</worldbody></mujoco>"
BODY = '<body><joint/><geom size=".1" mass="{}" contype="0" conaffinity="0"/>{}</body>'
ARM = BODY.format(1, "")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (WORLD.format("", '<texture name="t" type="2d" builtin="flat" width="60000" height="60000"/>', ARM), "2 GB"),
        (WORLD.format("", '<hfield name="h" nrow="40000" ncol="40000" size="1 1 1 1"/>', ARM), "2 GB"),
        (WORLD.format("", '<hfield name="h" nrow="65536" ncol="65536" size="1 1 1 1"/>', ARM), r"breaks down .*signal"),
        (WORLD.format('<size nuser_body="2000000000"/>', "", ARM), "2 GB"),
        (WORLD.format('<size memory="100G"/>', "", ARM), "2 GB"),
        (WORLD.format("", "", BODY.format("1e308", "")), r"1e\+308 in body_mass, expected numbers of at most"),
        (WORLD.format("", "", BODY.format("1", "").replace("<joint/>", '<joint stiffness="1e100"/>')), "jnt_stiffness"),
        (WORLD.format('<option gravity="0 0 -1e300"/>', "", ARM), "gravity"),
        (WORLD.format("", "", ARM * (MAX_DOFS + 1)),
         f"at most {MAX_DOFS}"),
    ],
    ids=["texture", "height field", "overflowing height field", "user data", "arena", "mass", "stiffness", "gravity",
         "joints"],
)  # fmt: skip
def test_models_without_bounds_are_one_sentence(text, words):
    with pytest.raises(ModelError, match=words) as error:
        Mechanism.from_mjcf(text)
    assert str(error.value).endswith(".")


def test_an_interruption_ends_a_compilation():
    began = time.monotonic()
    main = threading.main_thread().ident
    threading.Timer(0.3, lambda: signal.pthread_kill(main, signal.SIGINT)).start()
    with pytest.raises(KeyboardInterrupt):
        compile_model(WORLD.format('<size nkey="200000000"/>', "", ARM))
    assert time.monotonic() - began < compile_subprocess.SECONDS / 2  # far less, but on a machine with other work


def test_shapes_that_may_touch_are_bounded():
    ball = '<geom size=".1" mass="1"/>'
    with pytest.raises(ModelError, match=f"geoms that may touch, expected at most {MAX_TOUCHING}"):
        Mechanism.from_mjcf(WORLD.format("", "", f"<body><joint/>{ball * (MAX_TOUCHING + 1)}</body>"), contacts="off")
    with pytest.raises(ModelError, match=f"pairs of geoms that may touch, expected at most {MAX_PAIRS}"):
        Mechanism.from_mjcf(WORLD.format("", "", f"<body><joint/>{ball * 400}</body>{ball * 400}"), contacts="off")


@pytest.mark.parametrize("name", ["hip&#10;PASS (open-loop)", "&#155;2J", "&#8238;hip"])
def test_names_that_would_forge_a_line_are_refused(name):
    with pytest.raises(ModelError, match="expected a name of printable characters") as error:
        Mechanism.from_mjcf(WORLD.format("", "", ARM.replace("<joint", f'<joint name="{name}"')))
    assert str(error.value).isprintable()


def test_a_stored_model_reads_no_file_of_the_disk(tmp_path):
    """Its text names an absolute path, and a file of that name is stored with it: the stored one is taken."""
    (tmp_path / "wedge.obj").write_text(OBJ.format(7))
    mesh = f'<asset><mesh name="m" file="{tmp_path / "wedge.obj"}"/></asset><worldbody>'
    text = plain().replace("<worldbody>", mesh, 1)
    own = OBJ.format(1).encode()
    assert read(text, assets={"wedge.obj": own}).assets == {"wedge.obj": own}
    with pytest.raises(ModelError, match="expected one that is stored with it"):
        read(text, assets={"other.obj": own})


def test_a_compiled_model_is_the_same_model():
    """What comes back from the child has the bits that MuJoCo's compiler makes in this process."""
    import mujoco
    import numpy as np

    text = plain()
    child, here = compile_model(text), mujoco.MjModel.from_xml_string(text)
    for name in ("body_mass", "body_inertia", "dof_M0", "qpos0", "jnt_axis", "geom_pos"):
        np.testing.assert_array_equal(getattr(child, name), getattr(here, name))
    assert bytes(child.names) == bytes(here.names)


def meshes(*heights):
    """A text with meshes of these heights, and its files."""
    files = {f"{k}.obj": OBJ.format(height).encode() for k, height in enumerate(heights)}
    names = "".join(f'<mesh name="m{k}" file="{name}"/>' for k, name in enumerate(files))
    bodies = "".join(f'<body><joint/><geom type="mesh" mesh="m{k}"/></body>' for k in range(len(heights)))
    return WORLD.format("", names, bodies), files


def test_a_child_that_knows_a_file_compiles_the_next_text_to_the_same_bits():
    import mujoco
    import numpy as np

    text, files = meshes(1, 7)
    compile_subprocess.compile_in_subprocess(text, files, "the model")
    child = compile_subprocess._kept[0]
    text, more = meshes(1, 3)  # a file that it knows, and another one under a name that it knows
    more["0.obj"] = files["0.obj"]
    model, here = (
        compile_subprocess.compile_in_subprocess(text, more, "the model"),
        mujoco.MjModel.from_xml_string(text, more),
    )
    assert compile_subprocess._kept == [child]
    both = [np.empty(mujoco.mj_sizeModel(one), dtype=np.uint8) for one in (model, here)]
    for one, content in zip((model, here), both, strict=True):
        mujoco.mj_saveModel(one, None, content)
    np.testing.assert_array_equal(both[0], both[1])


def test_a_child_that_is_gone_is_replaced():
    text, files = meshes(1)
    compile_subprocess.compile_in_subprocess(text, files, "the model")
    child = compile_subprocess._kept[0]
    os.kill(child._pid, signal.SIGKILL)
    os.waitid(os.P_PID, child._pid, os.WEXITED | os.WNOWAIT)
    assert compile_subprocess.compile_in_subprocess(text, files, "the model").nmesh == 1
    assert compile_subprocess._kept[0]._pid != child._pid


def test_a_child_has_new_limits_for_each_text(monkeypatch):
    """MuJoCo would fill so many keyframes for hours: a compilation is stopped, also after one that did not take long.

    The limit of processor time is a second, the least there is.
    """
    monkeypatch.setattr(compile_subprocess, "SECONDS", 1)
    text, files = meshes(1)
    compile_subprocess.compile_in_subprocess(text, files, "the model")
    with pytest.raises(ModelError, match="takes more than 1 s to compile the model"):
        compile_subprocess.compile_in_subprocess(
            text.replace("<asset>", '<size nkey="200000000"/><asset>'), files, "the model"
        )
    assert not compile_subprocess._kept


def test_a_child_holds_nothing_open_of_its_parent():
    """A lock that the parent gives up, or a pipe that it closes, would stay until the child ends."""
    reader, writer = os.pipe()
    compile_subprocess.compile_in_subprocess(*meshes(1), "the model")
    os.close(writer)
    assert os.read(reader, 1) == b""  # the end, at once
    os.close(reader)


def test_a_child_ends_with_its_parent():
    code = (
        "from planner.model.mjcf import compile_subprocess;"
        f"text, files = {meshes(1)!r};"
        "compile_subprocess.compile_in_subprocess(text, files, 'the model');"
        "print(compile_subprocess._kept[0]._pid)"
    )
    pid = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout
    with pytest.raises(ProcessLookupError):
        os.kill(int(pid), 0)


def test_limits_hold_where_the_process_has_less():
    """A limit that is lower already is kept: nothing is raised."""
    code = (
        "import resource; resource.setrlimit(resource.RLIMIT_CPU, (60, 60));"
        "from planner.model.mjcf.model_index import compile_model;"
        f"print(compile_model({WORLD.format('', '', ARM)!r}).nv)"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout == "1\n"


def test_the_largest_number_is_far_from_overflow():
    assert sys.float_info.max > LARGEST**4
