"""Joints whose acceleration is given, in MuJoCo: motors move them as planned, and all else feels what it did."""

import json
from dataclasses import replace

import numpy as np
import pytest
from driven import CART, PELVIS, hanging_leg, moved_cart, standing_leg, walking_leg
from machines import MACHINE
from trees import mujoco

import planner
from planner.__main__ import main
from planner.base.errors import ModelError, PlannerError
from planner.cases.problem_file import load
from planner.dynamics.contacts import contact_forces, generalized_forces
from planner.model.mechanism import Mechanism
from planner.model.mjcf import prescribed_joints as driven_twin
from planner.model.mjcf.file_law import watched_pairs
from planner.model.mjcf.model_index import compile_model
from planner.model.mjcf.prescribed_joints import PRESCRIBED_ARMATURE, twin_of
from planner.model.mjcf.text import edited
from planner.model.twin import Twin
from planner.problem.rediscretize import finer
from planner.proof.compare.model_parity import driven_parity
from planner.proof.robustness.perturbation import Nominal, Perturbation, SampleShape, draw


@pytest.fixture(scope="module")
def cart():
    return planner.solve(moved_cart())


@pytest.fixture(scope="module")
def leg():
    """Not optimal, which a proof does not ask for."""
    return planner.solve(walking_leg(), max_iterations=20)


def figure(section, name):
    return next(figure for figure in section.measured if figure.name == name)


def largest_errors(run):
    """Of each degree of freedom over a replay, rad and m."""
    return np.abs(run.error).max(axis=0)[: run.qvel.shape[1]]


def test_a_moved_cart_passes_and_is_held(cart):
    proof = planner.prove(cart, rollouts=2, hold_seconds=2.0)
    assert (proof.verdict, proof.mode) == ("PASS", "open-loop"), proof.reason
    # The cart's errors are what the motors leave: some 3 N m/s^2 over 1e8, twice integrated for 1.2 s.
    assert largest_errors(proof.replays["open-loop"])[0] < 1e-7
    assert proof.replay.reached == ()  # its range, which the plan leaves by 0.4 m, is not held
    assert proof.replay.warnings == ()
    assert figure(proof.same_step, "state_error").value < 1e-12
    assert proof.errors.ratio("open-loop") == pytest.approx(1.0, abs=0.05)
    assert proof.hold.passed
    assert len(proof.hold.measured) > 0


def test_the_motors_fall_short_by_the_force_over_the_armature(cart):
    """And by nothing else: the growth of errors predicts the cart's replay to a few percent."""
    m, twin = cart.problem.dynamics.mechanism, cart.twin
    model = compile_model(twin.mjcf)
    data, x, u = mujoco.MjData(model), cart.xs[30], cart.us[30]
    data.qpos, data.qvel, data.ctrl = x[:3], x[3:], u
    mujoco.mj_forward(model, data)
    short = u[2] - data.qacc[0]
    bare = mujoco.MjModel.from_xml_string(CART.replace('stiffness="40"', "").replace('armature="0.3"', ""))
    inverse = mujoco.MjData(bare)
    inverse.qpos, inverse.qvel = x[:3], x[3:]
    inverse.qacc = cart.problem.dynamics.rates(x[None], u[None])[0, 3:]
    mujoco.mj_inverse(bare, inverse)
    damping = 0.02 * x[3]  # of every joint: the plan's cart has none
    limit = inverse.qfrc_constraint[0]
    assert short * PRESCRIBED_ARMATURE == pytest.approx(inverse.qfrc_inverse[0] + limit - damping, rel=1e-6)
    assert m.stiffness[0] == 40.0


def test_elements_on_a_prescribed_joint_are_taken_out_of_the_replay():
    m = Mechanism.from_mjcf(CART)
    twin = twin_of(m, ("cart",))
    model = compile_model(twin.mjcf)
    assert (model.jnt_stiffness[0], model.dof_damping[0], model.jnt_limited[0]) == (0.0, 0.0, 0)
    assert model.jnt_stiffness[2] == 0.3
    assert model.dof_damping[1] == 0.02
    assert not model.actuator_gear[0].any()
    assert [model.actuator(i).name for i in range(3)] == ["servo", "motor", "acceleration of cart"]
    assert not model.actuator_ctrllimited[2]
    assert (model.actuator_gear[1, 0], model.actuator_gear[2, 0], model.dof_armature[0]) == (
        3.0,
        PRESCRIBED_ARMATURE,
        PRESCRIBED_ARMATURE,
    )
    np.testing.assert_array_equal(model.key_ctrl, [[0.1, 0.2, 0.0]])
    assert twin.source == m.mjcf
    assert twin_of(m, ()).mjcf == m.mjcf
    assert twin_of(m, ["cart"]) is twin  # made once


@pytest.mark.parametrize(
    "prescribed", [("lift",), ("roll", "swing"), ("fly",), ("turn", "wag"), ("fly", "roll", "lift", "slip")]
)
def test_every_kind_of_joint_is_driven(prescribed):
    """Slides, hinges, balls and a free joint, with springs, dampers and armature of their own, in any order."""
    m = Mechanism.from_mjcf(MACHINE)
    section = driven_parity(m, prescribed, compile_model(twin_of(m, prescribed).mjcf), 64, 1e-10, 0)
    assert section.passed, section.failures
    assert 0.0 < figure(section, "left_by_the_motors").value < 1e-4


def test_a_wrong_mass_fails_parity(cart):
    wrong = CART.replace('mass="0.4"', 'mass="0.404"')
    for proof in (
        planner.prove(cart, mjcf=wrong, rollouts=0),  # which has no motors for the cart yet
        planner.prove(cart, twin=twin_of(Mechanism.from_mjcf(wrong), ("cart",)), rollouts=0),
    ):
        assert proof.verdict == "FAIL"
        assert "mass at joint 'knee' is 0.404, the plan has 0.4" in proof.reason
    assert not planner.parity(cart.problem, wrong).passed
    assert planner.parity(cart.problem, CART).passed
    assert planner.parity(cart.problem, cart.twin.mjcf).passed  # motors and all


def test_friction_loss_that_the_plan_lacks_fails_parity(cart):
    rubs = CART.replace('name="hip"', 'name="hip" frictionloss="0.05"')
    section = planner.parity(cart.problem, rubs)
    assert [one.name for one in section.failures] == ["friction_loss_error"]
    assert "friction loss at joint 'hip' is 0.05, the plan has 0" in section.failures[0].note
    m = Mechanism.from_mjcf(rubs)
    assert driven_parity(m, ("cart",), compile_model(twin_of(m, ("cart",)).mjcf), 64, 1e-10, 0).passed


def test_a_wrong_gear_of_the_motors_fails(cart):
    text = edited(cart.twin.mjcf, {"actuator/motor[@joint='cart']": {"gear": repr(1.001 * PRESCRIBED_ARMATURE)}})
    section = planner.parity(cart.problem, text)
    assert not section.passed
    assert not figure(section, "driven_acceleration_error").passed
    light = edited(cart.twin.mjcf, {".//joint[@name='cart']": {"armature": "1e6"}})
    with pytest.raises(ModelError, match="the model does not drive cart, expected an armature of 1e\\+08 there"):
        planner.parity(cart.problem, light)


def sharp_leg():
    """The leg's text without smoothing and of a low impratio: MuJoCo computes the law itself. And its mechanism."""
    text = hanging_leg(10.0).replace('data="0.005 5"', 'data="0 0"').replace('data="0.003 0.1"', 'data="0 0"')
    return text, Mechanism.from_mjcf(text)


def pressed(m, K=100):
    """K states, positions and velocities: the foot on the belt, the knee beyond its stop now and then."""
    rng, (_, x) = np.random.default_rng(3), standing_leg()
    q, qd = np.tile(x[: m.nq], (K, 1)), 0.3 * rng.normal(size=(K, m.nv))
    q[:, 4:7] += 0.1 * rng.normal(size=(K, 3))
    q[:, 8] = rng.uniform(-0.4, 0.15, K)
    q[:, 3] += contact_forces(m, q, qd).depths.max(axis=1) - rng.uniform(0.0, 0.01, K)
    return q, qd


def error_of_forces(text, m, prescribed_accelerations):
    """The 95 % quantile of how far MuJoCo's contacts and stops are from the law, of the force or of 5 N."""
    model, (q, qd) = compile_model(text), pressed(m)
    data, ours, theirs = mujoco.MjData(model), generalized_forces(m, q, qd), np.empty(qd.shape)
    for k in range(len(q)):
        data.qpos, data.qvel = q[k], qd[k]
        data.ctrl[: len(PELVIS)] = prescribed_accelerations[k, : model.nu]
        mujoco.mj_forward(model, data)
        theirs[k] = data.qfrc_constraint
    assert np.mean(np.abs(ours).max(axis=1) > 5.0) > 0.8  # there is contact
    assert np.mean(np.abs(generalized_forces(replace(m, contacts=()), q, qd)[:, 8]) > 5.0) > 0.1  # and the stop
    error = np.linalg.norm(theirs - ours, axis=1) / np.maximum(np.linalg.norm(ours, axis=1), 5.0)
    return float(np.quantile(error, 0.95))


def test_contacts_and_stops_keep_their_force(monkeypatch):
    """The study's bound for the law in MuJoCo: 95 % within 5e-3, as in the file itself."""
    text, m = sharp_leg()
    accelerations = 3.0 * np.random.default_rng(4).normal(size=(100, len(PELVIS)))
    assert error_of_forces(text, m, accelerations) < 5e-3
    assert (
        error_of_forces(driven_twin.prescribe_joints(m.mjcf, {}, compile_model(m.mjcf), PELVIS), m, accelerations)
        < 5e-3
    )
    for part in ("keep_law", "_keep_stops"):  # each is needed
        with monkeypatch.context() as patch:
            patch.setattr(driven_twin, part, lambda *_: None)
            assert (
                error_of_forces(
                    driven_twin.prescribe_joints(m.mjcf, {}, compile_model(m.mjcf), PELVIS), m, accelerations
                )
                > 1e-2
            )


def test_a_leg_on_a_belt_is_repeated(leg):
    soft = replace(leg, problem=replace(leg.problem, tolerance="soft"))
    proof = planner.prove(soft, rollouts=0, optimal=False)
    assert proof.passed, proof.reason
    run = proof.replays["open-loop"]
    assert run.contact_force.max() > 30.0
    errors = largest_errors(run)
    assert errors[:7].max() < 1e-6  # the belt and the pelvis, m and rad
    assert proof.same_step.not_applicable


def test_contacts_that_push_prescribed_joints_alone_are_watched():
    text = hanging_leg()
    m = Mechanism.from_mjcf(text)
    model = compile_model(twin_of(m, ("belt", *PELVIS, "hip", "knee", "ankle")).mjcf)
    assert len(watched_pairs(model)) == model.npair == 2
    assert compile_model(twin_of(m, PELVIS).mjcf).npair == 2


def test_a_plan_is_proved_from_its_file(cart, tmp_path, capsys):
    file = cart.save(tmp_path / "plan.npz")
    plan = planner.load_plan(file)
    assert plan.changed == ()
    assert plan.problem.dynamics.prescribed == ("cart",)
    assert (plan.twin.mjcf, plan.twin.source) == (cart.twin.mjcf, cart.twin.source)
    np.testing.assert_array_equal(plan.problem.dynamics.step(cart.xs[:-1], cart.us), cart.xs[1:])
    assert main(["prove", str(file), "--rollouts", "0", "--json", "--quiet"]) == 0
    proof = json.loads(capsys.readouterr().out)["proof"]
    assert proof == json.loads(json.dumps(planner.prove(cart, rollouts=0).to_dict()))
    assert main(["prove", str(file), "--replay-rollout", "1", "--perturb", "stiffness=0.2", "--quiet"]) in (0, 1)
    other = planner.Problem(cart.problem.dynamics, cart.problem.cost, cart.problem.x0, twin=Twin.of(Mechanism.from_mjcf(
        CART.replace("<actuator>", '<actuator><motor joint="hip"/>')
    )))  # fmt: skip
    again = planner.load_plan(file, problem=other)
    assert again.problem is other


def test_a_problem_file_names_prescribed_joints(tmp_path, capsys):
    (tmp_path / "cart.xml").write_text(CART, encoding="utf-8")
    keys = 'model = "cart.xml"\nstart = [0, 0, 0]\ngoal = { cart = 0.5 }\nduration = 1.2\n'
    path = tmp_path / "cart.toml"
    prescribed = keys + 'prescribed = ["cart"]\n[weights]\neffort = 0.01\n'
    path.write_text(prescribed, encoding="utf-8")
    with pytest.raises(PlannerError, match=r'the goal has cart at 0\.5 m, .* limits\.position = \{ cart = "off" \}'):
        load(path)
    path.write_text(prescribed + '[limits]\nposition = { cart = "off" }\n', encoding="utf-8")
    problem = load(path).problem
    assert problem.dynamics.prescribed == ("cart",)
    assert [label for _, label in problem.appearance.plots[-1].controls] == ["servo", "motor", "acceleration of cart"]
    plan = planner.solve(problem)
    plan = planner.load_plan(plan.save(tmp_path / "plan.npz"))
    assert planner.prove(plan, rollouts=0).passed
    assert finer(plan.problem).dynamics.prescribed == ("cart",)
    for value, words in (('["carts"]', "a joint in prescribed is 'carts', expected one of: cart, hip, knee"),
                         ('"cart"', "prescribed is 'cart', expected a list of some of: cart, hip, knee")):  # fmt: skip
        path.write_text(keys + f"prescribed = {value}\n", encoding="utf-8")
        assert main(["solve", str(path)]) == 2
        assert words in capsys.readouterr().err


def test_prescribed_joints_have_no_drag_and_no_friction(cart):
    model = compile_model(cart.twin.mjcf)
    nominal = Nominal.of(model, cart, cart.twin)
    np.testing.assert_array_equal(nominal.driven, [0])
    errors = draw(Perturbation(drag=1.0, friction=0.1), 0, 1, nominal.sizes)
    other = nominal.with_errors(errors, mujoco.MjData(model))
    assert (other.dof_damping[0], other.dof_frictionloss[0], other.dof_armature[0]) == (0.0, 0.0, PRESCRIBED_ARMATURE)
    assert other.dof_damping[1] > model.dof_damping[1]
    assert other.dof_frictionloss[1] > 0.0


def test_stiffness_varies_and_leaves_the_other_draws_alone(cart):
    sizes = SampleShape(nbody=4, nv=3, ndx=6, N=10, nu=3, njnt=3)
    without, given = (draw(Perturbation(stiffness=value), 5, 2, sizes) for value in (0.0, 0.3))
    for name, value in vars(without).items():
        if name != "stiffness":
            np.testing.assert_array_equal(value, getattr(given, name), err_msg=name)
    np.testing.assert_array_equal(without.stiffness, 1.0)
    assert np.all((np.abs(given.stiffness - 1.0) <= 0.3) & (given.stiffness != 1.0))
    model = compile_model(cart.twin.mjcf)
    other = Nominal.of(model, cart, cart.twin).with_errors(given, mujoco.MjData(model))
    assert other.jnt_stiffness[2] == 0.3 * given.stiffness[2]


REFUSED = {
    "the model's actuators are switched off": CART.replace("<flag", '<flag actuation="disable"'),
    "is a freejoint with align, expected one without": (
        '<mujoco><worldbody><body><freejoint name="cart" align="false"/><geom size=".1"/></body></worldbody></mujoco>'
    ),
    "the file has not all joints of the model": (
        '<mujoco><worldbody><replicate count="2"><body><joint name="cart"/><geom size=".1"/></body></replicate>'
        '<body><joint name="cart" type="slide"/><geom size=".1"/></body></worldbody></mujoco>'
    ),
}  # fmt: skip


@pytest.mark.parametrize("words", REFUSED)
def test_models_that_cannot_be_driven_say_why(words):
    with pytest.raises(PlannerError, match=words) as error:
        twin_of(Mechanism.from_mjcf(REFUSED[words], contacts="off"), ("cart",))
    assert "\n" not in str(error.value)


def test_another_model_without_the_joint_says_so(cart):
    with pytest.raises(ModelError, match="the model has no joint 'cart', expected one of: wagon, hip, knee"):
        planner.prove(cart, mjcf=CART.replace('"cart"', '"wagon"'), rollouts=0)
