"""A cycle of a gait that goes on: its mirror image, its reference, what it refuses, and plans of it."""

import argparse
import json
import re
from dataclasses import replace

import numpy as np
import pytest
from places import ROOT

import planner
from planner.cases.problem_file import load
from planner.cli.running import FLAGS, _identity
from planner.dynamics.quasi_static import quasi_static_controls
from planner.model.space import StateMap, exp_quaternion, product
from planner.problem.costs.tracking import tracking_of
from planner.problem.progress import Status
from planner.problem.tasks.cycle import Cycle, cycle_motion, cycle_of
from planner.problem.tasks.gait import Gait, gait_of
from planner.problem.tasks.mirror import UNLIKE, asymmetry, mirror_of
from planner.proof.diagnostics import suggested_fixes
from planner.proof.diagnostics.solving import cycle_not_found, failing_cycle
from planner.solvers.phase_times import PhaseTimes

SCENE = ROOT / "mjcf" / "quadruped" / "scene.xml"
TROT = f'model = "{SCENE}"\nstart = "stand"\ngait = "trot"\nduration = 0.25\n'
HALF = "periodic = { travel = 0.125, mirror = true }\n"
LEFT = np.array([0.0, 1.0, 0.0])
RANGES = np.tile([-np.inf, np.inf], (18, 1))


def loaded(tmp_path, text):
    (tmp_path / "cycle.toml").write_text(text)
    return load(tmp_path / "cycle.toml")


@pytest.fixture(scope="module")
def quadruped():
    """Dynamics of the quadruped, and the state in which it stands."""
    mechanism = planner.Mechanism.from_mjcf(SCENE, contacts="ground")
    x0 = planner.dynamics.static_equilibrium(mechanism, mechanism.keyframe("stand"))
    return planner.RigidBodyDynamics(mechanism, dt=0.005, substeps=4), x0


def near(dynamics, x0, count=5):
    """States (count, nx) around x0 with velocities, and controls (count, nu)."""
    rng = np.random.default_rng(7)
    xs = dynamics.space.integrate(np.tile(x0, (count, 1)), rng.normal(0.0, 0.1, (count, dynamics.ndx)))
    return xs, rng.normal(0.0, 3.0, (count, dynamics.nu))


def test_the_image_of_the_quadruped_moves_as_it_does(quadruped):
    dynamics, x0 = quadruped
    mirror = mirror_of(dynamics.mechanism, x0, LEFT)
    xs, us = near(dynamics, x0)
    assert asymmetry(dynamics, mirror, xs, us) < 1e-9  # of rounding, through 4 substeps of stiff contacts
    joint = [dynamics.mechanism.joint(f"front_{side}_hip").start for side in ("left", "right")]
    assert mirror.links[joint[0]] == joint[1]
    twice = mirror.image.then(dynamics.space, mirror.image)
    np.testing.assert_allclose(twice.apply(dynamics.space, xs), xs, atol=1e-12)
    np.testing.assert_allclose(
        mirror.image.undo(dynamics.space, mirror.image.apply(dynamics.space, xs)), xs, atol=1e-12
    )


def test_the_matrix_is_the_derivative_of_the_image_everywhere(quadruped):
    dynamics, x0 = quadruped
    space = dynamics.space
    motion = cycle_motion(Gait("trot"), Cycle((0.1, 0.0), 0.4), dynamics, x0, 50, RANGES)
    for image in (mirror_of(dynamics.mechanism, x0, LEFT).image, motion.image):
        x, (dx, _) = near(dynamics, x0, 1)[0][0], np.random.default_rng(1).normal(0.0, 1.0, (2, dynamics.ndx))
        h = 1e-6  # its error is h^2 and rounding 1e-16 / h
        ends = [image.apply(space, space.integrate(x, sign * h * dx)) for sign in (1.0, -1.0)]
        np.testing.assert_allclose(space.difference(*ends) / (2.0 * h), image.matrix @ dx, atol=1e-8)
        np.testing.assert_allclose(image.matrix @ image.matrix.T, np.eye(len(dx)), atol=1e-12)
        again = StateMap.from_dict(image.to_dict())
        np.testing.assert_array_equal(again.apply(space, x), image.apply(space, x))


def test_sides_that_differ_are_told(quadruped):
    dynamics, x0 = quadruped
    mass = dynamics.mechanism.mass.copy()
    mass[dynamics.mechanism.joint("front_left_knee").start] *= 4.0
    heavy = dynamics.with_mechanism(replace(dynamics.mechanism, mass=mass))
    mirror = mirror_of(heavy.mechanism, x0, LEFT)
    assert asymmetry(heavy, mirror, *near(heavy, x0)) > UNLIKE
    said = cycle_motion(Gait("trot"), Cycle((0.1, 0.0), mirror=True), heavy, x0, 50, RANGES).said
    assert "sides differ" in said
    assert "without mirror" in said
    assert "sides" not in cycle_motion(Gait("trot"), Cycle((0.1, 0.0), mirror=True), dynamics, x0, 50, RANGES).said


def test_a_base_that_leans_is_mirrored_upright(quadruped):
    """A mass to one side makes it stand so: by 0.02 rad here, and 1 mm at the hips of a robot."""
    dynamics, x0 = quadruped
    leaning = x0.copy()
    leaning[3:7] = product(exp_quaternion(np.array([0.02, 0.0, 0.0])), x0[3:7])
    mirror, upright = (mirror_of(dynamics.mechanism, x, LEFT) for x in (leaning, x0))
    np.testing.assert_allclose(mirror.image.origin, upright.image.origin, atol=1e-6)
    np.testing.assert_allclose(mirror.image.matrix, upright.image.matrix, atol=1e-6)


PLANAR = """
<mujoco>
  <worldbody>
    <geom type="plane" size="0 0 1"/>
    <body name="trunk" pos="0 0 1">
      <joint name="x" type="slide" axis="1 0 0"/><joint name="z" type="slide" axis="0 0 1"/>
      <joint name="pitch" axis="0 1 0"/>
      <geom type="box" size="0.1 0.1 0.2" mass="5" contype="0" conaffinity="0"/>
      <body name="one" pos="0 0 -0.2"><joint name="one_hip" axis="0 1 0"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.8" size="0.03" mass="1" contype="0" conaffinity="0"/></body>
      <body name="two" pos="0 0 -0.2"><joint name="two_hip" axis="0 1 0"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.8" size="0.03" mass="1" contype="0" conaffinity="0"/></body>
    </body>
  </worldbody>
  <actuator><motor joint="one_hip"/><motor joint="two_hip" gear="-1"/></actuator>
</mujoco>
"""


def test_legs_in_the_plane_of_a_planar_machine_change_places():
    mechanism = planner.Mechanism.from_mjcf(PLANAR)
    mirror = mirror_of(mechanism, mechanism.home, LEFT)
    np.testing.assert_array_equal(mirror.links, [0, 1, 2, 4, 3])
    np.testing.assert_allclose(mirror.image.matrix[:5, :5], np.eye(5)[[0, 1, 2, 4, 3]], atol=1e-12)

    assert mirror.image.controls.tolist() == [[0.0, -1.0], [-1.0, 0.0]]  # by their gears


@pytest.mark.parametrize("second", ["", '<motor joint="two_hip" gear="-2"/>'])
def test_an_actuator_without_an_equal_on_the_other_side_has_no_image(second):
    mechanism = planner.Mechanism.from_mjcf(PLANAR.replace('<motor joint="two_hip" gear="-1"/>', second))
    with pytest.raises(planner.PlannerError, match="actuator 'actuator 0' has no mirror image"):
        mirror_of(mechanism, mechanism.home, LEFT)


def test_an_oblique_joint_alone_has_no_image():
    oblique = PLANAR.replace('name="two_hip" axis="0 1 0"', 'name="two_hip" axis="1 1 0"')
    with pytest.raises(planner.PlannerError, match="joint 'two_hip' has no mirror image in the machine's other half"):
        mirror_of(planner.Mechanism.from_mjcf(oblique), np.zeros(5), LEFT)


def test_two_actuators_on_each_joint_have_images_of_their_own():
    both = '<position joint="HIP" kp="40" dampratio="1"/><velocity joint="HIP" kv="2"/>'
    actuators = "".join(both.replace("HIP", name) for name in ("one_hip", "two_hip"))
    old = '<motor joint="one_hip"/><motor joint="two_hip" gear="-1"/>'
    mechanism = planner.Mechanism.from_mjcf(PLANAR.replace(old, actuators))
    controls = mirror_of(mechanism, mechanism.home, LEFT).image.controls
    np.testing.assert_array_equal(controls, np.eye(4)[[2, 3, 0, 1]])


@pytest.mark.parametrize(
    "attribute", ['gear="1" ctrllimited="true" ctrlrange="-1 2"', 'forcelimited="true" forcerange="-1 1"']
)
def test_an_actuator_with_other_ranges_has_no_image(attribute):
    text = PLANAR.replace('<motor joint="one_hip"/>', f'<motor joint="one_hip" {attribute}/>')
    with pytest.raises(planner.PlannerError, match="has no mirror image"):
        mirror_of(planner.Mechanism.from_mjcf(text), np.zeros(5), LEFT)


@pytest.mark.parametrize(
    ("kind", "cycle"),
    [
        ("trot", Cycle((0.1, 0.0), mirror=True)), ("walk", Cycle((0.1, 0.0), mirror=True)),
        ("bound", Cycle((0.15, 0.0))), ("trot", Cycle((0.0, 0.08))), ("trot", Cycle((0.1, 0.0), turn=0.4)),
    ],
)  # fmt: skip
def test_a_cycle_of_the_reference_ends_at_the_image_of_its_start(quadruped, kind, cycle):
    dynamics, x0 = quadruped
    motion = cycle_motion(gait_of(kind), cycle, dynamics, x0, 60, RANGES)
    gap = dynamics.space.difference(motion.states[-1], motion.image.apply(dynamics.space, motion.states[0]))
    # Of the pendulum, which has nearly forgotten where it was at rest, and of inverse kinematics.
    assert np.abs(gap[:18]).max() < 0.03
    moved = motion.states[-1, :2] - motion.states[0, :2]
    assert np.linalg.norm(moved) == pytest.approx(np.linalg.norm(cycle.travel), abs=0.015)
    whole = motion.repeated(dynamics.space, 3)
    assert len(whole.states) == 181
    np.testing.assert_allclose(
        whole.image.apply(dynamics.space, x0),
        motion.image.apply(dynamics.space, motion.image.apply(dynamics.space, motion.image.apply(dynamics.space, x0))),
        atol=1e-12,
    )


def test_standing_machines_are_their_own_image(quadruped):
    dynamics, x0 = quadruped
    mirror = mirror_of(dynamics.mechanism, x0, LEFT)
    np.testing.assert_allclose(mirror.image.apply(dynamics.space, x0), x0, atol=1e-6)
    u = quasi_static_controls(dynamics, x0)
    np.testing.assert_allclose(mirror.image.images_of_controls(u), u, atol=1e-4)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("periodic = 0.1", "expected a table of some of: travel, turn, mirror, cycles, left_open"),
        ("periodic = { way = 0.1 }", "'way'"),
        ("periodic = { travel = [0.1] }", "travel of periodic"),
        ('periodic = { mirror = "yes" }', "expected true or false"),
        ("periodic = { mirror = true, turn = 0.2 }", "turns the other way"),
        ("periodic = { travel = 0.1, cycles = 0 }", "cycles of periodic"),
        ("periodic = { travel = 0.1 }\ngoal = { root = [0.25, 0, 0.326, 1, 0, 0, 0] }", "expected one of them"),
        ('periodic = { left_open = ["belt"] }', "'belt'"),
        ('periodic = { left_open = ["root x"], cycles = 2 }', "left_open and cycles"),
        ("periodic = { travel = 1e300 }", "at most 1000 m"),
        ("periodic = { travel = 0.1, turn = 7.0 }", "turn of periodic"),
        ("periodic = { travel = 0.1, mirror = true, cycles = 5000 }", "5000 cycles of 25 stages"),
        ('periodic = { travel = 0.1 }\nlimits = { final = "exact" }', "expected no final"),
        ("periodic = { travel = 3.0, mirror = true }", "further than its leg reaches"),
        ("periodic = { travel = 0.1 }\nobjective = \"time\"", "fixed duration"),
    ],
)  # fmt: skip
def test_what_is_no_cycle_is_refused(tmp_path, text, said):
    with pytest.raises(planner.PlannerError, match=re.escape(said)):
        loaded(tmp_path, TROT + text)


@pytest.mark.parametrize(
    ("gait", "said"),
    [
        ("", "expected gait"), ('gait = "bound"\n', "do not swing half a cycle apart"),
        ('gait = { kind = "trot", stride = 0.1 }\n', "stride"),
    ],
)  # fmt: skip
def test_a_cycle_is_of_a_gait_that_fits(tmp_path, gait, said):
    with pytest.raises(planner.PlannerError, match=said):
        loaded(tmp_path, TROT.replace('gait = "trot"\n', gait) + HALF)


@pytest.mark.parametrize("duration", [0.3, 0.6, 0.7])
@pytest.mark.parametrize("until", ["", "until = DURATION\n"])
def test_phases_of_a_cycle_may_end_where_it_ends(tmp_path, duration, until):
    """Ten cycles of 0.6 s end at 6 s, whatever 9 * 0.6 + 0.6 is."""
    monopod = ROOT / "mjcf" / "monopod" / "scene.xml"
    text = f'model = "{monopod}"\nduration = {duration}\nperiodic = {{ travel = 0.1 }}\n'
    text += '[[phase]]\nuntil = 0.2\nstand = ["shank"]\n[[phase]]\n' + until.replace("DURATION", str(duration))
    assert loaded(tmp_path, text + "stand = []\n").problem.duration == pytest.approx(duration)


def test_phases_that_end_before_their_cycle_are_refused_in_its_own_times(tmp_path):
    text = TROT.replace('gait = "trot"\n', "") + HALF + "[[phase]]\nuntil = 0.2\nstand = []\n"
    said = re.escape("end at 0.2 s, expected times that grow to the duration, 0.25 s")
    with pytest.raises(planner.PlannerError, match=said):
        loaded(tmp_path, text)


def test_cycles_that_turn_are_images_of_each_other(tmp_path):
    """Their weights turn with them: the cost of the images is that of the first cycle, but for its last stage."""
    text = TROT.replace("0.25", "0.5") + "periodic = { travel = 0.05, turn = 0.5 }\n"
    one = loaded(tmp_path, text).problem
    three = one.recipe.rebuilt(periodic={"travel": 0.05, "turn": 0.5, "cycles": 3})
    rng, image, N = np.random.default_rng(3), one.periodic.image, one.N
    xs = one.dynamics.space.integrate(np.tile(one.x0, (N, 1)), rng.normal(0.0, 0.02, (N, one.dynamics.ndx)))
    us = rng.normal(0.0, 1.0, (N, one.dynamics.nu))
    parts, states = [], xs
    for k in range(3):
        whole = np.tile(three.x0, (three.N + 1, 1))
        whole[:] = tracking_of(three.cost).x_ref
        controls = tracking_of(three.cost).u_ref.copy()
        base = tracking_of(three.cost).value(whole, controls)
        whole[k * N : (k + 1) * N], controls[k * N : (k + 1) * N] = states, us
        parts.append(tracking_of(three.cost).value(whole, controls) - base)
        states = image.apply(one.dynamics.space, states)
    assert parts == pytest.approx([parts[0]] * 3, rel=1e-9)


@pytest.mark.slow
def test_free_times_end_where_the_plan_costs_least(tmp_path):
    """A hop's stance: the plan of the middle of the range is tried first, and none that was tried costs less."""
    monopod = ROOT / "mjcf" / "monopod" / "scene.xml"
    text = f'model = "{monopod}"\nduration = 0.6\nperiodic = {{ travel = 0.2, cycles = 2 }}\n'
    text += '[[phase]]\nuntil = [0.2, 0.4]\nstand = ["shank"]\n[[phase]]\nstand = []\n'
    asked, lines = loaded(tmp_path, text), []
    assert asked.phase_times == {0: (0.2, 0.4)}
    plan = asked.solved(lines.append)
    times = [line for line in lines if isinstance(line, PhaseTimes)]
    assert times[0].times == pytest.approx((0.3,))
    assert len(times) > 1
    best = min(times, key=lambda line: line.cost)
    assert plan.problem.parameters["phase"][0]["until"] == pytest.approx(best.times[0])
    assert 0.2 <= best.times[0] <= 0.4
    assert plan.N == 2 * asked.problem.N
    assert planner.load_plan(plan.save(tmp_path / "plan.npz")).problem is not None


HOP = (
    f'model = "{ROOT / "mjcf" / "monopod" / "scene.xml"}"\nduration = 0.6\nperiodic = {{ travel = 0.2, cycles = 2 }}\n'
    '[[phase]]\nuntil = UNTIL\nstand = ["shank"]\n[[phase]]\nstand = []\n'
)


def test_a_search_of_times_that_is_interrupted_keeps_the_best_plan(tmp_path):
    asked, lines = loaded(tmp_path, HOP.replace("UNTIL", "[0.2, 0.4]")), []

    def stop(line):
        lines.append(line)
        raise KeyboardInterrupt

    plan = asked.solved(stop)
    assert plan.status is Status.INTERRUPTED
    assert plan.N == asked.problem.N  # of one cycle
    assert len(lines) == 1


def test_limits_that_were_put_in_place_of_the_files_hold_in_every_cycle(tmp_path):
    asked = loaded(tmp_path, HOP.replace("UNTIL", "0.3"))
    limits = replace(asked.problem.limits, control=400.0)
    plan = asked._replace(problem=replace(asked.problem, limits=limits)).solved(lambda _: None)
    assert plan.N == 2 * asked.problem.N
    assert plan.problem.limits.control == 400.0


def test_runs_that_ask_for_other_cycles_or_times_are_others(tmp_path):
    arguments = argparse.Namespace(**dict.fromkeys(FLAGS))
    texts = (HOP, HOP.replace("cycles = 2", "cycles = 3"))
    files = [loaded(tmp_path, text.replace("UNTIL", until)) for text in texts for until in ("0.3", "[0.25, 0.35]")]
    told = [json.dumps(_identity(file, arguments)) for file in files]
    assert len(set(told)) == 4


@pytest.mark.parametrize(
    ("until", "said"),
    [
        ("[0.4, 0.2]", "after the phase before"), ("[0.2]", "until of"), ("[0.2, 1.0]", "before the duration, 0.9 s"),
        ("[0.2, 0.7]", "expected a time after 0.7 s"),
    ],
)  # fmt: skip
def test_times_that_are_no_range_are_refused(tmp_path, until, said):
    monopod = ROOT / "mjcf" / "monopod" / "scene.xml"
    text = f'model = "{monopod}"\nduration = 0.9\nperiodic = {{ travel = 0.2 }}\n'
    text += f'[[phase]]\nuntil = {until}\nstand = ["shank"]\n'
    text += '[[phase]]\nuntil = 0.6\nstand = []\n[[phase]]\nstand = ["shank"]\n'
    with pytest.raises(planner.PlannerError, match=said):
        loaded(tmp_path, text)


def test_a_number_is_the_way_ahead():
    assert cycle_of({"travel": 0.3}) == Cycle((0.3, 0.0))
    assert cycle_of({"travel": [0.3, 0.1], "left_open": ["x"]}) == Cycle((0.3, 0.1), left_open=("x",))


def test_a_trot_returns_to_the_image_of_its_start_and_its_plan_to_its_file(tmp_path):
    asked = loaded(tmp_path, TROT + HALF)
    passes = []
    plan = asked.solved(passes.append)
    assert plan.status is Status.CONVERGED
    periodic = plan.problem.periodic
    start = plan.xs[0]
    image = periodic.image.apply(plan.space, start)
    assert np.all(np.abs(plan.space.difference(plan.xs[-1], image)) <= periodic.tolerance)
    assert plan.xs[-1, 0] - start[0] == pytest.approx(0.125, abs=3e-3)  # half of the least tolerance
    assert len(passes) > 1  # the first one, from the reference, has not returned
    assert passes[0].miss > 1.0
    stored = planner.load_plan(plan.save(tmp_path / "plan.npz"))
    assert stored.problem.cost.value(stored.xs, stored.us) == pytest.approx(plan.cost, rel=1e-12)
    np.testing.assert_array_equal(stored.problem.x0, start)
    assert stored.problem.periodic.miss(plan.space, stored.xs) <= 1.0


def test_a_cut_search_says_what_does_not_return(tmp_path):
    asked = loaded(tmp_path, TROT + HALF)
    short = replace(asked.problem, periodic=replace(asked.problem.periodic, passes=1))
    plan = planner.solve_periodic(short)
    assert plan.status is Status.NOT_PERIODIC
    assert "from where the cycle began" in plan.message
    (found,) = suggested_fixes(plan)
    assert (found.code, found.value) == ("cycle_not_found", None)
    assert cycle_not_found(plan, short, None) == [found]  # before what its plan touches
    assert not cycle_not_found(replace(plan, status=Status.CONVERGED), short, None)
    assert found.values["duration"].value == 0.25  # s, as the file has it
    (finer,) = failing_cycle(replace(plan, status=Status.UNRESOLVED), short, None)
    assert (finer.key, finer.value) == ("dt", 0.5 * short.dynamics.dt)


@pytest.mark.slow
def test_open_coordinates_need_not_return(tmp_path):
    asked = loaded(tmp_path, TROT + 'periodic = { travel = 0.125, mirror = true, left_open = ["root x"] }\n')
    x = next(
        i
        for i, one in enumerate(planner.model.coordinates.coordinates_of(asked.problem.dynamics))
        if one.name == "root x"
    )
    assert np.isinf(asked.problem.periodic.tolerance[x])
    plan = asked.solved(lambda _: None)
    assert plan.success
    assert abs(plan.xs[-1, 0] - plan.xs[0, 0] - 0.125) > 3e-3  # it costs less to be slower


@pytest.mark.slow
def test_cycles_one_after_another_pass_their_proof(tmp_path):
    asked = loaded(tmp_path, TROT + "periodic = { travel = 0.125, mirror = true, cycles = 4 }\n")
    plan = asked.solved(lambda _: None)
    assert plan.N == 4 * asked.problem.N
    assert plan.xs[-1, 0] - plan.xs[0, 0] == pytest.approx(0.5, abs=0.012)
    proof = planner.prove(plan, rollouts=32)
    assert proof.passed, proof.reason
    assert "robust with its gains" in proof.headline
