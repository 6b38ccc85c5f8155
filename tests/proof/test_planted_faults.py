"""Every fault that is planted, in a model, a plan or its file, is found and named."""

import zipfile
from dataclasses import replace

import numpy as np
import pytest
from plan_files import contents, written

import planner
from planner import cases
from planner.base.errors import PlannerError
from planner.cases.plan_file import load_plan
from planner.model.mjcf.text import edited

FOREARM = ".//body[@name='forearm']"


@pytest.fixture(scope="module")
def plan():
    return planner.solve(cases.acrobot())


@pytest.fixture(scope="module")
def hopper_plan():
    return planner.solve(cases.hopper())


@pytest.fixture(scope="module")
def small():
    """A plan of a few stages, for faults that are the plan's own."""
    return planner.solve(cases.two_link(horizon=50))


def proof_of(plan, **options):
    return planner.prove(plan, rollouts=0, **options)


def failure(plan, **options):
    """The sentence of a FAIL, or of an error."""
    try:
        proof = proof_of(plan, **options)
    except PlannerError as error:
        return str(error)
    assert not proof.passed
    return proof.reason


@pytest.mark.slow
def test_without_a_fault_it_passes(plan, hopper_plan):
    assert proof_of(plan).passed
    assert proof_of(hopper_plan).passed


@pytest.mark.parametrize(
    ("edits", "words"),
    [
        ({f"{FOREARM}/inertial": {"mass": "0.505"}}, "mass at joint 'elbow' is 0.505, the plan has 0.5"),
        ({f"{FOREARM}/inertial": {"diaginertia": "0.0417 0.043 0.0417"}}, "inertia at joint 'elbow'"),
        ({f"{FOREARM}/inertial": {"pos": "0.51 0 0"}}, "centre of mass at joint 'elbow'"),
        ({FOREARM: {"pos": "1.01 0 0"}}, "frame at joint 'elbow'"),
        ({".//joint[@name='elbow']": {"axis": "0 1 0.01"}}, "frame (axis or anchor) at joint 'elbow'"),
        ({".//joint[@name='elbow']": {"damping": "0.01"}}, "damping at joint 'elbow' is 0.01, the plan has 0"),
        ({".//joint[@name='shoulder']": {"armature": "0.001"}}, "armature at joint 'shoulder' is 0.001"),
        ({".//joint[@name='shoulder']": {"stiffness": "0.5"}}, "stiffness at joint 'shoulder' is 0.5"),
        ({"option": {"gravity": "0 0 -9.80665"}}, "gravity is (0, 0, -9.80665)"),
        ({".//motor": {"gear": "-1"}}, "gear of actuator 'elbow' at joint 'elbow' is -1, the plan has 1"),
        ({".//joint[@name='elbow']": {"frictionloss": "0.05"}}, "friction loss at joint 'elbow' is 0.05"),
        ({"option": {"density": "1.2"}}, "the drag of the fluid"),
        ({".//joint[@name='elbow']": {"range": "-1 1", "limited": "true"}}, "joint 'elbow' is outside its range"),
        ({".//motor": {"ctrlrange": "-1 1", "ctrllimited": "true"}}, "is asked for more than its ctrlrange"),
        ({".//motor": {"forcerange": "-1 1", "forcelimited": "true"}}, "is asked for more than its forcerange"),
    ],
)  # fmt: skip
def test_a_fault_in_the_model_alone(plan, edits, words):
    text = edited(plan.twin.mjcf, edits)
    parity = planner.parity(plan.problem, text)
    assert words in (failure(plan, mjcf=text) if parity.passed else parity.failures[0].note)


def test_a_model_that_is_another_one_fails(plan):
    text = edited(plan.twin.mjcf, {".//joint[@name='elbow']": {"damping": "0.001"}})
    reason = failure(plan, mjcf=text)
    assert reason.startswith("parity: bias force error")
    assert "damping at joint 'elbow'" in reason


def test_a_contact_switched_on(plan):
    """A table in the arm's way, where the plan knows of none."""
    head, end, tail = plan.twin.mjcf.rpartition("</worldbody>")
    way = f'{head}<geom name="bar" type="box" size="2 2 0.1" pos="0 0 -0.5"/>{end}{tail}'
    text = edited(way, {f"{FOREARM}/geom": {"contype": "1", "conaffinity": "1"}, "option/flag": {"contact": "enable"}})
    assert "touch from t = " in failure(plan, mjcf=text)


def test_a_model_with_a_joint_more(plan):
    head, end, tail = plan.twin.mjcf.rpartition("</worldbody>")
    more = f'{head}<body><joint/><geom size="0.1"/></body>{end}{tail}'
    assert "it is not the machine that the plan was made for" in failure(plan, mjcf=more)


def test_a_model_that_explodes(hopper_plan):
    """A contact a million times as stiff runs away at any step; that is a FAIL with its time, not a crash."""
    text = edited(hopper_plan.twin.mjcf, {"actuator/general[@name='piston']": {"biasprm": "0 1e12 0"}})
    sentence = failure(hopper_plan, mjcf=text)
    assert "MuJoCo's simulation became unstable at joint " in sentence
    assert " at t = " in sentence


@pytest.mark.parametrize(("key", "value"), [("biasprm", "0 -100 10"), ("gainprm", "101")])
def test_a_fault_in_the_hoppers_piston(hopper_plan, key, value):
    text = edited(hopper_plan.twin.mjcf, {"actuator/general[@name='piston']": {key: value}})
    assert not planner.parity(hopper_plan.problem, text).passed


def test_the_hoppers_start_activation_missing(hopper_plan):
    text = edited(hopper_plan.twin.mjcf, {"keyframe/key[@name='start']": {"act": "0"}})
    assert "start_error" in [one.name for one in planner.parity(hopper_plan.problem, text).failures]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (lambda p: {"us": 1.001 * p.us}, "plan: stage error"),
        (lambda p: {"xs": p.xs + 1e-6}, "plan: start state error"),
        (lambda p: {"cost": 1.001 * p.cost}, "plan: cost error"),
        (lambda p: {"gradient_norm": p.gradient_norm + 1.0}, "plan: gradient error"),
        (lambda p: {"K": 1.001 * p.K}, "plan: gain error"),
        (lambda p: {"K": -p.K}, "plan: gain error"),
        (lambda p: {"K": np.full_like(p.K, 1e308)}, "plan: gain error"),
        (lambda p: {"K": p.K * np.where(p.t[1:] < 0.1, np.nan, 1.0)[:, None, None]}, "plan: its gains are not finite"),
        (lambda p: {"us": np.full_like(p.us, 1e200)}, "plan: stage error"),
        (lambda p: {"t": 1.01 * p.t}, "plan: time error"),
    ],
)  # fmt: skip
def test_a_plan_that_is_not_what_it_says(small, changes, words):
    assert words in failure(replace(small, **changes(small)))


# In the file


@pytest.fixture(scope="module")
def stored(small, tmp_path_factory):
    return small.save(tmp_path_factory.mktemp("plan") / "plan.npz")


def rewritten(stored, tmp_path, arrays=lambda a: None, meta=lambda m: None):
    """The file with arrays and meta changed by hand, as a script or an editor would."""
    content, facts = contents(stored)
    arrays(content)
    meta(facts)
    return written(tmp_path / "plan.npz", content, facts)


def scaled(name, factor):
    def change(content):
        content[name] *= factor

    return change


@pytest.mark.parametrize(
    ("arrays", "words"),
    [
        (scaled("us", 1.0 + 1e-14), "controls us"),
        (scaled("xs", 1.0 + 1e-14), "states xs"),
        (scaled("K", 1.0 + 1e-14), "gains K"),
        (scaled("history", 1.0 + 1e-14), "iterations"),
    ],
)
def test_a_file_changed_by_hand_says_what_was_changed(stored, tmp_path, arrays, words):
    plan = load_plan(rewritten(stored, tmp_path, arrays))
    assert plan.changed == (words,)
    assert failure(plan) == f"plan: changed after the file was written: {words}."


def test_a_model_swapped_in_the_file(stored, tmp_path):
    def swap(meta):
        meta["mjcf"] = edited(meta["mjcf"], {"option": {"gravity": "0 0 -9.8"}})

    plan = load_plan(rewritten(stored, tmp_path, meta=swap))
    assert plan.changed == ("the model",)
    assert "the model" in failure(plan)


def test_parameters_changed_in_the_file(stored, tmp_path):
    plan = load_plan(rewritten(stored, tmp_path, meta=lambda m: m["recipe"]["parameters"].update(mass1=0.6)))
    assert "parameters" in failure(plan)


def test_a_file_of_the_future(stored, tmp_path):
    def later(meta):
        meta.update(format_version=99, versions={**meta["versions"], "planner": "9.0"})

    with pytest.raises(
        planner.base.errors.FileError, match=r"has format 99, written by planner 9\.0; this planner reads format"
    ):
        load_plan(rewritten(stored, tmp_path, meta=later))


def test_a_truncated_file(stored, tmp_path):
    content = stored.read_bytes()
    for part in (0, 10, len(content) // 2, len(content) - 10):
        (tmp_path / "cut.npz").write_bytes(content[:part])
        with pytest.raises(planner.base.errors.FileError, match=r"cut\.npz is not a plan"):
            load_plan(tmp_path / "cut.npz")


def test_an_array_missing_from_the_file(stored, tmp_path):
    with zipfile.ZipFile(stored) as whole, zipfile.ZipFile(tmp_path / "less.npz", "w") as less:
        for name in whole.namelist():
            if name != "K.npy":
                less.writestr(name, whole.read(name))
    with pytest.raises(planner.base.errors.FileError, match=r"is not a plan: expected an \.npz with t, xs, us, K"):
        load_plan(tmp_path / "less.npz")
