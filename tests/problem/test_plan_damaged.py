"""Whatever stands in the meta of a plan file, reading it ends with a plan or with one sentence."""

import math
import os
import zipfile
from itertools import islice

import pytest
from places import ROOT
from plan_files import contents, written

import planner
from planner.base.errors import FileError, ModelError
from planner.cases import problem_file
from planner.cases.plan_file import load_plan
from planner.model.mjcf.model_index import compile_model

CRANE = ROOT / "examples" / "crane.toml"

NESTED: list = []
for _ in range(300):
    NESTED = [NESTED]
VALUES = [
    None, True, -1, 1.5, 10**400, math.nan, math.inf, "x", "two\nlines", "\ud800", [], [[1, "a"]], {}, {"a": {"b": []}},
    NESTED,
]  # fmt: skip


@pytest.fixture(scope="module")
def stored(tmp_path_factory):
    """Arrays and meta of a plan of a case and of one of a problem file."""
    folder = tmp_path_factory.mktemp("plans")
    problems = {
        "case": planner.cases.hopper(height=7.5, horizon=40, smoothing=0.2),
        "file": problem_file.load(CRANE).problem,
    }
    result = {}
    for name, problem in problems.items():
        result[name] = contents(planner.solve(problem, max_iterations=1).save(folder / f"{name}.npz"))
    return result


def changes(meta, values=VALUES):
    """The meta with every entry, and every entry of its tables, missing or something else."""
    for key in meta:
        yield {name: value for name, value in meta.items() if name != key}
        for value in values:
            yield meta | {key: value}
        if isinstance(meta[key], dict):
            yield from (meta | {key: table} for table in changes(meta[key], VALUES[::3]))
            yield meta | {key: meta[key] | {"unknown": 1}}


@pytest.mark.parametrize(
    ("name", "step"),
    [("case", 3), ("file", 83), *(pytest.param(name, 1, marks=pytest.mark.slow) for name in ("case", "file"))],
)
def test_every_damage_to_the_meta_is_one_sentence(stored, tmp_path, name, step):
    """The fast tests make every third damage of a case, and fewer of a file, whose model is compiled each time."""
    arrays, meta = stored[name]
    count = 0
    for changed in islice(changes(meta), 0, None, step):
        path = written(tmp_path / "plan.npz", arrays, changed)
        count += 1
        try:
            plan = load_plan(path)
        except FileError as error:
            text = str(error)
            assert "\n" not in text
            assert text.endswith((".", "?")), text
            assert "Error" not in text, text  # nor the name of an exception of Python's
        else:
            assert str(plan)
    assert count > 300 // step


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"status": "GOOD"}, "status is 'GOOD', expected one of: CONVERGED"),
        ({"cost": 10**400}, "no usable 'cost'"),
        ({"versions": {"planner": 3}}, "no usable 'versions'"),
        ({"starts": [[0, "CONVERGED", 1.0]]}, "no usable 'starts'"),
        ({"starts": [[0, "CONVERGED", 10**400, 1]]}, "no usable 'starts'"),
        ({"starts": [[0, "GOOD", 1.0, 1, 1.0]]}, "status is 'GOOD', expected one of: CONVERGED"),
        ({"mjcf": "/etc/passwd"}, "its model is not well-formed XML"),
        ({"mjcf": '<mujoco><include file="/etc/passwd"/></mujoco>'}, "names the file '/etc/passwd' that the plan does"),
        ({"mjcf": '<mujoco><asset><mesh file="/a.stl"/></asset></mujoco>'}, "names the file '/a.stl' that"),
    ],
)  # fmt: skip
@pytest.mark.parametrize("name", ["case", "file"])
def test_damage_is_named(stored, tmp_path, name, changed, words):
    arrays, meta = stored[name]
    with pytest.raises(FileError, match=f"is damaged.*{words}"):
        load_plan(written(tmp_path / "plan.npz", arrays, meta | changed))


def test_nothing_is_read_from_the_disk_for_a_stored_model(stored, tmp_path, monkeypatch):
    """Even where the file that it includes is there and would do."""
    arrays, meta = stored["file"]
    monkeypatch.chdir(tmp_path)
    (tmp_path / "more.xml").write_text("<mujoco/>")
    mjcf = meta["mjcf"].replace("<worldbody>", '<include file="more.xml"/><worldbody>')
    with pytest.raises(FileError, match=r"is damaged: its model names the file 'more\.xml'"):
        load_plan(written(tmp_path / "plan.npz", arrays, meta | {"mjcf": mjcf}))


def test_a_twin_of_other_states_is_refused(stored, tmp_path):
    arrays, meta = stored["case"]
    twin = {"to_x": [[1.0]], "to_x_offset": [0.0], "to_sim": [[[1.0]]], "to_sim_offset": [[0.0]]}
    with pytest.raises(FileError, match="its twin is of 1 states, expected 3"):
        load_plan(written(tmp_path / "plan.npz", arrays, meta | {"twin": twin}))


@pytest.mark.parametrize("path", [None, 5, b"plan.npz", ["plan.npz"]])
def test_arguments_that_are_no_path_are_refused(stored, tmp_path, path):
    with pytest.raises(FileError, match=r"expected the path of a plan\.npz\."):
        load_plan(path)
    arrays, meta = stored["case"]
    plan = load_plan(written(tmp_path / "plan.npz", arrays, meta))
    with pytest.raises(FileError, match=r"expected a name ending in \.npz\."):
        plan.save(path)


def test_a_plan_is_an_ordinary_file(tmp_path):
    os.mkfifo(tmp_path / "plan.npz")
    missing = tmp_path / ("n" * 300), "null\0byte", "two\nlines"
    for path in (tmp_path / "plan.npz", "/dev/zero", tmp_path, *missing):
        words = "does not exist" if path in missing else "is not a file"
        with pytest.raises(FileError, match=rf"{words}, expected a plan\.npz\.") as error:
            load_plan(path)
        assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "header",
    [b"(", b"'''", b" a\n  b\n c", b"{'descr': '<f8', 'fortran_order': False, 'shape': (%d,), }" % 10**15,
     b"{'descr': '<f8', 'fortran_order': False, 'shape': (%d,), }" % 10**30],
)  # fmt: skip
def test_headers_of_arrays_that_python_cannot_read(stored, tmp_path, header):
    with zipfile.ZipFile(written(tmp_path / "good.npz", *stored["case"])) as good:
        contents = {name: good.read(name) for name in good.namelist()}
    contents["xs.npy"] = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header
    with zipfile.ZipFile(tmp_path / "plan.npz", "w") as file:
        for name, content in contents.items():
            file.writestr(name, content)
    with pytest.raises(FileError, match="is not a plan"):
        load_plan(tmp_path / "plan.npz")


def test_messages_of_mujoco_end_as_a_sentence():
    for text in (
        "<mujoco><worldbody><body colour='red'/></worldbody></mujoco>",
        "<mujoco>",
        "",
        "<mujoco><joint/></mujoco>",
    ):
        with pytest.raises(ModelError, match=r"MuJoCo refuses the model: .*[^.]\.$"):
            compile_model(text)
