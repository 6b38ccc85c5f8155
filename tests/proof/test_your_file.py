"""The plan in the user's own file: what was left out is named, and it fails where that would have mattered."""

import numpy as np
import pytest

import planner
from planner import Mechanism, Problem, RigidBodyDynamics, TrackingCost
from planner.cases.plan_file import load_plan
from planner.contact import ContactLaw
from planner.model.mjcf.file_law import watched_pairs
from planner.model.mjcf.model_index import contact_pairs
from planner.model.mjcf.text import edited
from planner.problem.goals import GoalCheck
from planner.proof.error_scales import SMOOTHED, judged_cost, path_error_bounds
from planner.proof.original_model import your_file
from planner.proof.replay_errors import cost_error
from planner.proof.replays.compiled_twin import CompiledTwin, left_out, unmodelled_of
from planner.proof.replays.replaying import replay_in
from planner.proof.replays.sampled_gains import sampling_of

# An arm of 1 m on a vertical axis, and a wall that its tip meets at 0.8 rad.
ARM = """
<mujoco><worldbody>
  <geom name="wall" type="{shape}" size="{size}" pos="0.7 0.8 0"/>
  <body><joint name="hinge" axis="0 0 1" damping="0.1"/>
    <geom name="arm" type="capsule" fromto="0.2 0 0 1 0 0" size="0.02" mass="1"/>
  </body>
</worldbody><actuator><motor name="motor" joint="hinge"/></actuator></mujoco>
"""
WALLED = ARM.format(shape="box", size="0.05 0.05 0.2")


PATH = {"largest_angle_error", "largest_angular_velocity_error"}


def end(wanted, tolerance=0.02):
    """The hinge's angle at the end."""
    return GoalCheck("hinge", "rad", tolerance, lambda xs: np.abs(xs[:, 0] - wanted))


def problem(text, goal, **reading):
    """From rest at 0 to rest at `goal`, in 1 s."""
    mechanism = Mechanism.from_mjcf(text, **reading)
    dynamics = RigidBodyDynamics(mechanism, dt=0.02)
    there = np.zeros(dynamics.nx)
    there[0] = goal
    cost = TrackingCost.joints(dynamics, there, 50, effort=0.01, final_position=1e3, final_velocity=1e2)
    return Problem(dynamics, cost, np.zeros(dynamics.nx))


def judged(plan, goal=0.0, **more):
    section, run = your_file(plan, plan.problem, [end(goal)], **more)["feedback"]
    return section, {one.name: one.note for one in section.failures}, run


@pytest.fixture(scope="module")
def through():
    """A plan that goes straight through the wall."""
    return planner.solve(problem(WALLED, 1.6, contacts="off"))


def test_an_arm_through_a_wall_fails_with_names_and_time(through):
    assert planner.prove(through, rollouts=0).refined_open_loop.passed  # the plan's own model has no wall
    section, failed, run = judged(through, 1.6)
    assert {"unknown_contacts", "replayed_angle_miss"} <= set(failed)  # the wall stops it
    assert set(failed) - {"unknown_contacts", "replayed_angle_miss"} <= PATH
    assert "geom 'wall' and geom 'arm' touch from t = 0." in failed["unknown_contacts"]
    assert run.xs[:, 0].max() < 1.0
    assert {one.name: one.value for one in section.measured}["largest_contact_force"] > 0.0


def test_an_arm_that_stays_clear_of_the_wall_passes_and_says_what_it_lacks():
    plan = planner.solve(problem(WALLED, -1.6, contacts="off"))
    section, failed, _ = judged(plan, -1.6)
    assert failed == {}
    assert section.passed
    assert left_out(plan.problem) == ("contacts of 1 pair",)
    assert unmodelled_of(plan.problem).pairs == ("geom 'wall' and geom 'arm'",)
    proof = planner.prove(plan, rollouts=0)
    assert ", planned without contacts of 1 pair (tested in your file)" in proof.headline
    assert not any("contacts" in phrase for phrase in proof.not_checked)  # the wall was there, and was not touched
    assert proof.to_dict()["planned_without"] == ["contacts of 1 pair"]


def test_a_plan_from_its_file_says_the_same(through, tmp_path):
    again = load_plan(through.save(tmp_path / "plan.npz"))
    assert again.twin.original == through.twin.original != ""
    assert left_out(again.problem) == left_out(through.problem) == ("contacts of 1 pair",)
    assert judged(again, 1.6)[0] == judged(through, 1.6)[0]
    other = [planner.prove(plan, mjcf=WALLED, rollouts=0) for plan in (through, again)]
    for proof in other:
        assert proof.refined_open_loop.passed  # without the wall
        assert proof.reason.startswith("your file: geom 'wall' and geom 'arm' touch from t = ")
    assert not judged(again, 1.6, mjcf=WALLED)[0].passed


def test_a_problem_file_keeps_the_users_text(tmp_path):
    (tmp_path / "arm.xml").write_text(WALLED)
    table = 'model = "arm.xml"\nstart = [0.0]\ngoal = [1.6]\nduration = 1.0\ndt = 0.02\ncontacts = "off"\n'
    (tmp_path / "problem.toml").write_text(table)
    plan = planner.solve(planner.cases.problem_file.load(tmp_path / "problem.toml").problem)
    again = load_plan(plan.save(tmp_path / "plan.npz"))
    assert left_out(again.problem) == left_out(plan.problem) == ("contacts of 1 pair",)
    assert judged(again, 1.6)[0] == judged(plan, 1.6)[0]
    assert "unknown_contacts" in judged(again, 1.6)[1]


def test_another_file_is_taken_unedited(through):
    """The plan knows no wall and passes in a file without one; in that of the wall it does not."""
    section, failed, _ = judged(through, 1.6, mjcf=edited(WALLED, {"worldbody/geom": {"pos": "5 5 0"}}))
    assert section.passed, failed
    assert "unknown_contacts" in judged(through, 1.6, mjcf=WALLED)[1]


def test_a_cylinder_beside_contacts_that_are_modelled():
    """A law is given to the floor's contact; nothing is known of capsules that meet cylinders."""
    law = ContactLaw(stiffness=1e3, damping=10.0, ramp=1e-3, force_ramp=1.0)
    text = ARM.format(shape="cylinder", size="0.05 0.2")
    text = text.replace("<worldbody>", '<worldbody><geom name="floor" type="plane" size="2 2 1" pos="0 0 -1"/>')
    plan = planner.solve(problem(text, 1.6, contacts=law))
    assert plan.problem.dynamics.mechanism.contacts
    assert left_out(plan.problem) == ("contacts of 1 pair",)
    assert unmodelled_of(plan.problem).pairs == ("geom 'wall' and geom 'arm'",)
    assert "geom 'wall' and geom 'arm' touch from t = 0." in judged(plan, 1.6)[1]["unknown_contacts"]


def test_friction_loss_that_stops_the_motion_fails_by_the_goal():
    """The gains push against it, so it has to be more than they can do: a hundred times the plan's own torque."""
    text = edited(WALLED, {".//joint": {"frictionloss": "1000"}})
    plan = planner.solve(problem(text, -1.6, contacts="off", ignore=("frictionloss",)))
    assert left_out(plan.problem) == ("contacts of 1 pair", "friction loss of 1 joint")
    assert set(judged(plan, -1.6)[1]) - PATH == {"replayed_angle_miss"}


@pytest.mark.parametrize(
    ("actuator", "words"),
    [
        ('<motor name="motor" joint="hinge" ctrlrange="-1 1"/>', "actuator 'motor' is asked for more than its ctrlr"),
        ('<motor name="motor" joint="hinge" forcerange="-1 1"/>', "actuator 'motor' is asked for more than its forcer"),
        ('<position name="motor" joint="hinge" kp="20" kv="1" forcerange="-1 1"/>', "more than its forcerange"),
    ],
)
def test_a_saturated_actuator_is_named(actuator, words):
    text = WALLED.replace('<motor name="motor" joint="hinge"/>', actuator)
    plan = planner.solve(problem(text, -1.6, contacts="off"))
    assert words in judged(plan, -1.6)[1]["clamped_actuators"]


def test_bounds_of_a_plan_that_are_the_models_own_are_no_saturation():
    text = WALLED.replace('joint="hinge"/>', 'joint="hinge" ctrlrange="-3 3" forcerange="-3 3"/>')
    free = problem(text, -1.6, contacts="off")
    bounded = Problem(free.dynamics, free.cost, free.x0, limits=planner.Limits(control="model"))
    plan = planner.solve(bounded)
    assert np.abs(plan.us).max() == 3.0
    assert "clamped_actuators" not in judged(plan, -1.6)[1]


def test_a_stop_that_the_plan_does_not_know_is_named():
    text = edited(WALLED, {".//joint": {"range": "-57 57", "limited": "true"}})
    plan = planner.solve(problem(text, -1.6, contacts="off"))
    assert "joint 'hinge' is outside its range from t = " in judged(plan, -1.6)[1]["unknown_stops"]


BASE = '<geom name="base" type="cylinder" size="0.25 0.1"/>'


def test_shapes_that_overlap_at_the_start_are_left_out_and_named():
    """A base that the arm is drawn into, as in many models of others: MuJoCo would press the two apart."""
    text = WALLED.replace("<body>", f"{BASE}<body>")
    plan = planner.solve(problem(text, -0.5, contacts="off"))
    section, failed, run = judged(plan, -0.5)
    assert section.passed, failed
    assert left_out(plan.problem)[1] == "contact of base and arm (0.07 m), which overlap at the start"
    model = run.compiled.model
    proof = planner.prove(plan, rollouts=0)  # the arm meets the wall in no replay but that of the file
    assert proof.planned_without == ("contacts of 1 pair",)
    assert proof.not_checked[0] == "without contact of base and arm (0.07 m), which overlap at the start"
    names = {frozenset(model.geom(i).name for i in pair) for pair in contact_pairs(model)}
    assert names == {frozenset(("wall", "arm")), frozenset(("base", "arm"))}
    assert [{model.geom(i).name for i in pair} for pair in watched_pairs(model)] == [{"base", "arm"}]


def test_an_overlap_hides_no_other_touch():
    plan = planner.solve(problem(WALLED.replace("<body>", f"{BASE}<body>"), 1.6, contacts="off"))
    assert "geom 'wall' and geom 'arm' touch from t = 0." in judged(plan, 1.6)[1]["unknown_contacts"]


def test_what_lies_on_something_is_no_overlap():
    """A cube that the plan lets fall: the table that carries it in the file stays, and is named."""
    cube = """<geom name="table" type="box" size=".1 .1 .1" pos="0 -5 0"/>
      <body pos="0 -5 .1499"><joint type="slide" axis="0 0 1"/>
        <geom name="cube" type="box" size=".05 .05 .05"/></body>"""
    plan = planner.solve(problem(WALLED.replace("</worldbody>", f"{cube}</worldbody>"), -0.5, contacts="off"))
    assert all("overlap" not in phrase for phrase in left_out(plan.problem))
    assert "geom 'table' and geom 'cube'" in judged(plan, -0.5)[1]["unknown_contacts"]


def test_actuators_that_were_taken_out_stay_idle():
    text = WALLED.replace("</actuator>", '<muscle name="muscle" joint="hinge" lengthrange="0 1"/></actuator>')
    text = text.replace('<motor name="motor" joint="hinge"/></actuator>', "</actuator>")
    plan = planner.solve(problem(text, -1.6, contacts="off", ignore=("actuator",)))
    assert left_out(plan.problem) == ("contacts of 1 pair", "1 actuator")
    _, _, run = judged(plan, -1.6)
    assert run.act.shape[1] == 1  # the muscle is in the file
    assert run.ctrl.shape[1] == 1  # the plan's controls alone


def test_a_file_that_is_the_plans_own_is_not_compiled_again():
    plan = planner.solve(planner.cases.two_link())
    open_loop = replay_in(CompiledTwin(plan.twin), plan)
    both = your_file(plan, plan.problem, (), runs={"open-loop": open_loop})
    assert both["open-loop"][1] is open_loop  # nor is it simulated again
    assert both["feedback"][1].compiled is open_loop.compiled
    assert both["feedback"][1].sampling == sampling_of(plan)  # as in step 3, and as a controller applies them
    assert all(section.passed for section, _ in both.values())
    assert left_out(plan.problem) == ()


def test_prescribed_joints_are_driven_in_the_file_too():
    """The arm hangs on a rail that the plan prescribes: the wall stops the arm, and the rail stays."""
    text = WALLED.replace("<body>", '<body name="slide"><joint name="rail" type="slide" axis="0 0 1"/>')
    dynamics = RigidBodyDynamics(Mechanism.from_mjcf(text, contacts="off"), dt=0.02, prescribed=("rail",))
    there = np.zeros(dynamics.nx)
    there[1] = 1.6
    cost = TrackingCost.joints(dynamics, there, 50, effort=0.01, final_position=1e3, final_velocity=1e2)
    plan = planner.solve(Problem(dynamics, cost, np.zeros(dynamics.nx)))
    section, run = your_file(plan, plan.problem, ())["feedback"]
    assert left_out(plan.problem) == ("contacts of 1 pair",)
    assert "geom 'wall' and geom 'arm' touch" in section.failures[0].note
    assert np.abs(run.xs[:, 0]).max() < 1e-3  # the rail stays where it is told to
    # The time constant of MuJoCo's default contact is the same whatever inertia is behind it.
    np.testing.assert_array_equal(run.compiled.model.pair_solref, [[0.02, 1.0]])


def test_errors_of_the_files_integrator_are_no_fault_of_the_plan():
    """Euler at the refined step ends 0.025 rad from the acrobot's plan, and a goal may be judged by 0.02 rad."""
    plan = planner.solve(planner.cases.acrobot())
    text = plan.twin.mjcf.replace('integrator="RK4"', 'integrator="Euler"')
    section, run = your_file(plan, plan.problem, [end(float(plan.xs[-1, 0]), tolerance=1e-3)], mjcf=text)["feedback"]
    assert section.passed
    assert run.integrator == "RK4"


def test_a_stiff_file_has_its_own_integrator():
    """A damper of 100 N m s/rad on 1e-4 kg m^2 has a time constant of a thousandth of the step: RK4 runs away."""
    pointer = '<joint name="pointer" axis="0 0 1"/><geom size="0.05" mass="0.1" contype="0" conaffinity="0"/>'
    text = WALLED.replace("</body>", f'<body pos="0.5 0 0">{pointer}</body></body>')
    damper = '<tendon><fixed damping="100"><joint joint="pointer" coef="1"/></fixed></tendon>'
    text = text.replace("<mujoco>", f'<mujoco><option integrator="implicit"/>{damper}')
    plan = planner.solve(problem(text, -1.6, contacts="off", ignore=("tendon",)))
    assert "damping of 1 tendon" in left_out(plan.problem)
    _, failed, run = judged(plan, -1.6)
    assert set(failed) == PATH  # the pointer turns freely in the plan
    assert run.integrator == "IMPLICIT"


@pytest.fixture(scope="module")
def stepping():
    """A plan with contacts, and what its file does with it and its gains."""
    plan = planner.solve(planner.load_problem("quadruped"))
    return plan, *your_file(plan, plan.problem, [])["feedback"]


def test_velocities_of_a_plan_with_contacts_are_shown_and_no_part_of_its_path(stepping):
    plan, section, run = stepping
    found = {one.name: one for one in section.measured}
    shares = np.abs(plan.space.difference(run.xs, run.plan_xs)).max(axis=0) / path_error_bounds(plan)
    nv = plan.problem.dynamics.mechanism.nv
    assert found["path_with_gains_over_its_bound"].value == pytest.approx(shares[:nv].max())
    assert shares[nv:].max() > 2.0 * shares[:nv].max()  # a foot lands a little early
    assert found["largest_velocity_error"].bound is None
    assert found["largest_velocity_error"].value > 0.0


def test_the_cost_of_a_plan_with_contacts_may_differ_by_what_its_path_may(stepping):
    plan, _, run = stepping
    cost = judged_cost(plan.problem)
    by_errors = 100.0 * cost.change_by_errors(plan, plan.problem) / cost.scale(plan, plan.problem)
    assert by_errors > 100.0 * SMOOTHED  # %
    measured = cost_error(run, plan.problem)
    assert measured.bound == by_errors
    assert measured.note.endswith("the bound is what path errors at theirs change")
