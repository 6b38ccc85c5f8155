"""Parity before planning: a mechanism is its MJCF's, and whatever differs is named by joint and term."""

import numpy as np
import pytest
from rolled_out_plans import TREE

import planner
from planner.dynamics.rigid_body import RigidBodyDynamics
from planner.model.mechanism import Mechanism
from planner.model.mjcf.text import edited, model_path
from planner.proof.compare.model_parity import parity_in
from planner.proof.replays.compiled_twin import CompiledTwin


@pytest.fixture(scope="module")
def tree():
    return Mechanism.from_mjcf(TREE)


def figures(section):
    return {figure.name: figure for figure in section.measured}


def test_a_tree_with_every_kind_of_joint_and_actuator_is_its_mjcfs(tree):
    section = planner.parity(tree)
    assert section.passed, section
    expected = {
        "mass_matrix_error", "bias_force_error", "actuator_force_error", "acceleration_error", "unmodelled_elements",
    }  # fmt: skip
    assert set(figures(section)) == {*expected, "activation_error"}
    assert all(figure.value < 1e-11 for figure in figures(section).values())
    assert all(figures(section)[name].value > 0.0 for name in expected - {"unmodelled_elements"})
    assert planner.parity(tree, seed=1) != section  # other states
    assert planner.parity(tree) == section


@pytest.mark.parametrize(
    ("path", "attributes", "term", "words"),
    [
        ("joint[@name='hip']", {"armature": "0.010001"}, "mass_matrix_error", "armature at joint 'hip'"),
        ("body[@name='shank']/inertial", {"mass": "2.00001"}, "mass_matrix_error", "moves at joint 'knee'"),
        ("body[@name='hand']/inertial", {"pos": "0 0.02 0.10001"}, "mass_matrix_error", "moves at joint 'wrist'"),
        ("body[@name='trunk']/inertial", {"diaginertia": "0.3 0.4001 0.2"}, "mass_matrix_error", "at joint 'root'"),
        ("joint[@name='hip']", {"damping": "0.30001"}, "bias_force_error", "damping at joint 'hip'"),
        ("joint[@name='wrist']", {"damping": "0.05001"}, "bias_force_error", "damping at joint 'wrist'"),
        ("joint[@name='knee']", {"stiffness": "1e-4"}, "bias_force_error", "gravity or spring at joint 'knee'"),
        ("joint[@name='wrist']", {"stiffness": "0.40001"}, "bias_force_error", "gravity or spring at joint 'wrist'"),
        ("joint[@name='hip']", {"springref": "0.1001"}, "bias_force_error", "gravity or spring at joint 'hip'"),
        (None, {"gravity": "0 0 -9.80665"}, "bias_force_error", "gravity or spring at joint 'root'"),
        ("motor", {"gear": "3.0001"}, "actuator_force_error", "actuator 'hip' at joint 'hip'"),
        ("position", {"kp": "40.001"}, "actuator_force_error", "actuator 'boom' and actuator 'spring' at joint 'boom'"),
        ("general[@name='knee']", {"dynprm": "0.050001"}, "activation_error", "activation of actuator 'knee'"),
    ],
)
def test_a_term_that_differs_is_traced_to_its_joint(tree, path, attributes, term, words, monkeypatch):
    """Also where the two models' numbers agree and the dynamics do not, which takes a mistake of ours."""
    monkeypatch.setattr("planner.proof.compare.rigid_parity.differences", lambda *_: "")
    section = planner.parity(tree, edited(tree.mjcf, {"option" if path is None else f".//{path}": attributes}))
    assert not section.passed
    assert section.failures[0].name == term
    assert words in section.failures[0].note


@pytest.mark.parametrize(
    ("path", "attributes", "words"),
    [
        ("joint[@name='hip']", {"armature": "0.02"}, "armature at joint 'hip' is 0.02, the plan has 0.01"),
        ("body[@name='shank']/inertial", {"mass": "2.5"}, "mass at joint 'knee' is 2.5, the plan has 2"),
        ("body[@name='hand']/inertial", {"pos": "0 0.02 0.2"}, "centre of mass at joint 'wrist' (axis 3) is 0.2"),
        ("body[@name='trunk']/inertial", {"diaginertia": "0.3 0.5 0.2"}, "inertia at joint 'root'"),
        ("body[@name='shank']", {"pos": "0 0 -0.7"}, "frame at joint 'knee'"),
        ("joint[@name='knee']", {"axis": "0 1 0.01"}, "frame (axis or anchor) at joint 'knee'"),
        ("joint[@name='hip']", {"damping": "0.4"}, "damping at joint 'hip' is 0.4, the plan has 0.3"),
        ("joint[@name='knee']", {"stiffness": "1"}, "stiffness at joint 'knee' is 1, the plan has 0"),
        ("joint[@name='wrist']", {"stiffness": "0.5"}, "stiffness at joint 'wrist' (axis 1) is 0.5, the plan has 0.4"),
        ("joint[@name='hip']", {"springref": "0.2"}, "spring reference at joint 'hip' is 0.2, the plan has 0.1"),
        (None, {"gravity": "0 0 -9.80665"}, "gravity is (0, 0, -9.80665), the plan has (0, 0, -9.81)"),
        ("motor", {"gear": "-3"}, "gear of actuator 'hip' at joint 'hip' is -3, the plan has 3"),
        ("position", {"kp": "50"}, "gain of actuator 'boom' is 50, the plan has 40; bias of actuator 'boom'"),
        ("general[@name='knee']", {"dynprm": "0.1"}, "time constant of actuator 'knee' is 0.1, the plan has 0.05"),
    ],
)
def test_a_number_that_differs_is_named_with_its_joint(tree, path, attributes, words):
    section = planner.parity(tree, edited(tree.mjcf, {"option" if path is None else f".//{path}": attributes}))
    assert not section.passed
    assert words in section.failures[0].note


def test_elements_that_the_mechanism_lacks_are_named(tree):
    section = planner.parity(tree, edited(tree.mjcf, {"option": {"density": "1.2", "wind": "1 0 0"}}))
    assert "unmodelled_elements" in [figure.name for figure in section.failures]
    assert section.failures[0].note == "fluid wind"


@pytest.mark.parametrize("lossy", ["theirs", "ours", "both"])
def test_friction_loss_that_differs_is_named(tree, lossy):
    """Whether it is the model's alone, the mechanism's alone, or another number in each."""
    rubs = edited(tree.mjcf, {".//joint[@name='hip']": {"frictionloss": "0.2"}})
    other = {"theirs": rubs, "ours": tree.mjcf, "both": rubs.replace('frictionloss="0.2"', 'frictionloss="0.3"')}[lossy]
    ours = tree if lossy == "theirs" else Mechanism.from_mjcf(rubs)
    assert planner.parity(ours).passed
    section = planner.parity(ours, other)
    assert [figure.name for figure in section.failures] == ["friction_loss_error"]
    values = {"theirs": "0.2, the plan has 0", "ours": "0, the plan has 0.2", "both": "0.3, the plan has 0.2"}[lossy]
    assert f"friction loss at joint 'hip' is {values}" in section.failures[0].note


def test_limits_are_no_part_of_the_dynamics(tree):
    edits = {
        ".//joint[@name='knee']": {"range": "-0.1 0.1", "limited": "true", "actuatorfrcrange": "-1 1"},
        ".//motor": {"ctrlrange": "-0.1 0.1", "ctrllimited": "true", "forcerange": "-0.1 0.1", "forcelimited": "true"},
    }
    assert planner.parity(tree, edited(tree.mjcf, edits)).passed


def test_another_number_of_joints_is_one_sentence(tree):
    with pytest.raises(planner.ModelError, match=r"^the model has 2 joints .*, expected 5 joints .*another machine\.$"):
        planner.parity(tree, model_path("acrobot") / "scene.xml")


def test_a_file_with_includes_is_read(tree):
    scene = model_path("acrobot") / "scene.xml"
    acrobot = Mechanism.from_mjcf(scene)
    assert planner.parity(acrobot, scene).passed
    assert not planner.parity(acrobot, edited(acrobot.mjcf, {".//motor": {"gear": "1.001"}})).passed


def test_a_problems_own_accelerations_are_compared(tree):
    """The same mechanism under another mass: the solver's dynamics count, not the file's."""
    dynamics = RigidBodyDynamics(Mechanism.from_mjcf(model_path("acrobot") / "scene.xml"), 0.01)
    cost = planner.TrackingCost.reach(dynamics.mechanism.home, 10, final=1.0, effort=1.0, dt=0.01)
    twin = planner.Twin.of(dynamics.mechanism)
    problem = planner.Problem(dynamics, cost, dynamics.mechanism.home, twin=twin)
    assert planner.parity(problem).passed
    heavy = planner.Twin.of(
        Mechanism.from_mjcf(edited(twin.mjcf, {".//body[@name='forearm']/inertial": {"mass": "0.6"}}))
    )
    assert "joint 'elbow'" in planner.parity(problem, twin=heavy).failures[0].note


def test_states_are_all_over_the_space(tree):
    from planner.proof.compare.rigid_parity import random_states

    xs = random_states(tree, np.random.default_rng(0), 2000)
    for address, _ in tree.quaternions:
        np.testing.assert_allclose(np.linalg.norm(xs[:, address : address + 4], axis=1), 1.0)
    knee = xs[:, tree.q_address[tree.joint("knee").start]]
    assert -np.pi < knee.min() < -3.0
    assert 3.0 < knee.max() < np.pi


def test_what_was_compared_before_planning_is_not_compared_again_and_anything_else_is():
    problem = planner.cases.two_link()
    before = planner.parity(problem)
    assert planner.parity(problem) is before
    compiled = CompiledTwin(problem.twin)
    assert parity_in(compiled, problem) is before
    assert parity_in(compiled, problem, seed=1) != before  # other states
    heavier = compiled.changed(lambda model: model.body_mass.__imul__(1.1))
    assert not parity_in(heavier, problem).passed
    assert planner.parity(problem).passed
    assert planner.parity(problem, problem.twin.mjcf.replace("<body ", "<body gravcomp='1' ", 1)).passed is False
