"""The proof of any mechanism: the general rules, ranges, orientation in quaternions, and pictures of trees."""

from dataclasses import replace

import numpy as np
import pytest
from rolled_out_plans import LIMITED, TREE, acrobot, problem_of, rolled_out, swing_up, tree_plan

import planner
from planner.cases.plan_file import load_plan
from planner.dynamics.rigid_body import RigidBodyDynamics
from planner.model.mechanism import Mechanism
from planner.model.mjcf.model_index import compile_model
from planner.model.mjcf.text import edited
from planner.model.space import exp_quaternion
from planner.problem.problem import Problem, Requirements
from planner.proof.replays.compiled_twin import CompiledTwin
from planner.proof.replays.contact_history import may_touch
from planner.proof.same_step import munthe_kaas, rounding_amplification, same_step
from planner.view.render.film import Film


def values(section):
    return {figure.name: figure.value for figure in section.measured}


# The general rules.


@pytest.mark.slow
def test_a_runge_kutta_plan_of_the_acrobot_passes():
    plan = swing_up("rk4", 0.005)  # at 0.01 the error of the integrator grows to 0.28 rad without gains
    proof = planner.prove(plan, rollouts=0)
    assert (proof.verdict, proof.mode) == ("PASS", "open-loop"), proof.reason
    assert proof.parity.passed
    assert not proof.parity.not_applicable
    assert values(proof.same_step)["state_error"] <= 1e-10
    open_loop, feedback = values(proof.refined_open_loop), values(proof.refined_feedback)
    assert feedback["end_angle_error"] < 0.01 * open_loop["end_angle_error"]
    assert feedback["path_angle_error"] < 0.1 * open_loop["path_angle_error"]
    assert 0.5 < values(proof.growth)["growth_rate_open_loop"] < 6.0  # a rod of 2 m upright: 2.7 / s
    assert values(proof.growth)["growth_rate_feedback"] < 0.0
    assert values(proof.goal)["replayed_angle_miss"] == pytest.approx(
        values(proof.goal)["planned_angle_miss"], abs=1e-2
    )


def test_a_plan_of_coarse_semi_implicit_steps_fails():
    proof = planner.prove(swing_up("semi-implicit-euler", 0.02), rollouts=0)
    assert (proof.verdict, proof.mode) == ("FAIL", None)
    assert proof.reason.startswith("refined, open loop: end angle error ")
    assert proof.plan.passed
    assert proof.parity.passed
    assert values(proof.same_step)["state_error"] <= 1e-8  # the transcription is right, the integrator is not
    assert not values(proof.refined_feedback)["end_angle_error"] <= 0.1  # off, or not a number: run away


def test_the_growth_rate_is_the_pendulums_own():
    """Upright, l qdd = g q: an error grows by the matrix of cosh and sinh."""

    def falling(x, u):
        return np.stack([x[..., 1], 9.81 * x[..., 0] + u[..., 0]], axis=-1)

    text = edited(LIMITED.replace('range="-1 1"', ""), {"option": {"gravity": "0 0 0"}})
    twin = planner.Twin(text, np.eye(2), np.zeros(2), np.eye(2)[None], np.zeros((1, 2)))
    dynamics, T, w = planner.FunctionDynamics(falling, 2, 1, 0.01), 3.0, np.sqrt(9.81)
    cost = planner.TrackingCost.reach([0.0, 0.0], 300, final=1.0, effort=1.0, dt=0.01)
    proof = planner.prove(planner.solve(Problem(dynamics, cost, [0.0, 0.0], twin=twin)), rollouts=0)
    phi = np.array([[np.cosh(w * T), np.sinh(w * T) / w], [w * np.sinh(w * T), np.cosh(w * T)]])
    assert values(proof.growth)["growth_rate_open_loop"] == pytest.approx(np.log(np.linalg.norm(phi, 2)) / T, rel=1e-4)


def test_a_case_can_give_a_goal_alone():
    """Requirements are optional one by one; the others stay the general rules."""

    def unreachable(run):
        return planner.base.measured.Section("goal", (planner.base.measured.Measurement("distance", 1.0, "m", 0.5),))

    problem = problem_of(Mechanism.from_mjcf(LIMITED), 0.01, 10, requirements=Requirements(goal=unreachable))
    proof = planner.prove(rolled_out(problem), rollouts=0)
    assert (proof.verdict, proof.goal.failures[0].name) == ("FAIL", "distance")
    assert proof.parity.passed
    assert "end_angle_error" in values(proof.refined_feedback)


def test_feedback_is_in_the_difference_of_the_space():
    """A body that spins through more than a turn: q and -q are one orientation, and gains must see it so."""
    plan = tree_plan("rk4")
    K = np.zeros_like(plan.K)
    K[:, 0, 3:6] = 100.0
    flipped = plan.xs.copy()
    for address, _ in plan.problem.dynamics.space.quaternions:
        flipped[:, address : address + 4] *= -1.0
    run = planner.replay(replace(plan, K=K, xs=flipped), feedback=True)
    assert np.abs(run.error).max() < 1e-2
    assert np.abs(run.ctrl - np.repeat(plan.us, run.substeps, axis=0)).max() < 1.0
    assert run.error.shape == (len(run.t), plan.problem.dynamics.ndx)


# The plan's own step.


def test_the_method_is_of_fourth_order_on_rotations():
    """A free body tumbling without moments: against itself at fine steps, the error falls 16 times a halving."""
    inertia, tree = np.array([1.0, 2.0, 3.5]), Mechanism.from_mjcf(TREE).space
    space = type(tree)(7, 6, ((0, 0),))

    def rates(x, u):
        w = x[4:]
        return np.concatenate([w, np.cross(inertia * w, w) / inertia])

    def end(steps):
        x = np.concatenate([exp_quaternion(np.array([0.3, -0.5, 0.2])), [2.0, 0.3, -1.5]])
        for _ in range(steps):
            x = munthe_kaas(rates, space, x, np.zeros(0), 1.0 / steps)
        return x

    fine = end(640)
    errors = [np.abs(space.difference(end(steps), fine)).max() for steps in (10, 20, 40)]
    assert errors[0] / errors[1] == pytest.approx(16.0, rel=0.25)
    assert errors[1] / errors[2] == pytest.approx(16.0, rel=0.15)


@pytest.mark.parametrize("integrator", ["euler", "semi-implicit-euler", "rk4"])
def test_mujoco_repeats_a_tree_at_the_plans_own_step(integrator):
    plan = tree_plan(integrator)
    section = same_step(plan, plan.problem, CompiledTwin(plan.twin))
    assert section.passed, section
    assert values(section)["state_error"] < 1e-9
    other = replace(plan.problem, dynamics=RigidBodyDynamics(plan.problem.dynamics.mechanism, 0.005, "euler"))
    if integrator != "euler":
        assert not same_step(plan, other, CompiledTwin(plan.twin)).passed


def test_damping_of_euler_is_explicit_in_both():
    mechanism = Mechanism.from_mjcf(LIMITED.replace('range="-1 1"', "").replace('damping="0.1"', 'damping="3"'))
    x0 = np.array([0.3, 2.0])
    plan = rolled_out(problem_of(mechanism, 0.02, 50, integrator="semi-implicit-euler", x0=x0))
    assert values(same_step(plan, plan.problem, CompiledTwin(plan.twin)))["stage_error"] < 1e-13


def test_amplified_rounding():
    """x+ = a x + 1 in the mean square: the sum of a geometric series."""
    a, N = 1.5, 40
    total = np.sqrt(sum(a ** (2 * k) for k in range(N)))
    assert rounding_amplification(np.full((N, 1, 1), a)) == pytest.approx(total)
    assert rounding_amplification(np.zeros((5, 3, 3))) == 1.0


# Ranges.


def held(text, torque, *, N=100):
    """A plan of the model without ranges, replayed in the one with them."""
    plain = LIMITED.replace('range="-1 1"', "")
    plan = rolled_out(problem_of(Mechanism.from_mjcf(plain), 0.01, N, us=np.full((N, 1), torque)))
    return planner.replay(plan, twin=replace(plan.twin, mjcf=text))


def test_a_replay_says_which_range_it_reached():
    free = held(LIMITED.replace('range="-1 1"', ""), 0.0)
    assert free.reached == ()
    limited = held(LIMITED, 0.0)
    first = free.t[np.argmax(np.abs(free.qpos[:, 0]) > 1.0)]
    (sentence,) = limited.reached
    assert sentence.startswith(f"joint 'hinge' is outside its range from t = {first:.4g} s, by up to ")
    assert sentence.endswith(" rad.")
    most = float(sentence.split("by up to ")[1].split()[0])
    assert most == pytest.approx(np.abs(limited.qpos[:, 0]).max() - 1.0, rel=1e-2)


@pytest.mark.parametrize(
    ("where", "attribute", "words"),
    [
        ("motor", "ctrlrange", "actuator 'motor' is asked for more than its ctrlrange from t = 0 s, by up to 2."),
        ("motor", "forcerange", "actuator 'motor' is asked for more than its forcerange from t = 0 s, by up to 2."),
        (
            "joint",
            "actuatorfrcrange",
            "joint 'hinge' is asked for more than its actuatorfrcrange from t = 0 s, by up to 2.",
        ),
    ],
)
def test_clamps_are_said_with_how_much_they_took(where, attribute, words):
    text = edited(LIMITED.replace('range="-1 1"', ""), {f".//{where}": {attribute: "-7 7"}})
    assert held(text, 9.0, N=20).reached == (words,)
    assert held(text, 6.0, N=20).reached == ()


def test_ranges_stand_in_the_proof():
    plan = rolled_out(problem_of(Mechanism.from_mjcf(LIMITED), 0.01, 100))
    proof = planner.prove(plan, rollouts=0)
    assert proof.verdict == "FAIL"
    figure = next(f for f in proof.refined_open_loop.measured if f.name == "ranges_reached")
    assert (figure.value, figure.bound) == (1.0, None)
    assert "joint 'hinge'" in figure.note


def test_only_models_that_can_touch_are_probed():
    geoms = '<body><freejoint/><geom size="1"/></body><body pos="0 0 3"><freejoint/><geom size="1" {}/></body>'
    scene = f"<mujoco><option>{{}}</option><worldbody>{geoms}</worldbody></mujoco>"

    def touching(flag, bits):
        return may_touch(compile_model(scene.format(flag, bits)))

    assert touching("", "")
    assert touching("", 'contype="0"')  # the other's type still meets its affinity
    assert not touching("", 'contype="0" conaffinity="0"')
    assert not touching('<flag contact="disable"/>', "")
    assert not may_touch(compile_model(acrobot().mjcf))


# Files.


def test_meshes_travel_with_the_plan(tmp_path):
    cube = "\n".join(f"v {x} {y} {z}" for x in (0, 1) for y in (0, 1) for z in (0, 1))
    cube += (
        "\nf 1 2 4\nf 1 4 3\nf 5 7 8\nf 5 8 6\nf 1 5 6\nf 1 6 2\nf 3 4 8\nf 3 8 7\nf 1 3 7\nf 1 7 5\nf 2 6 8\nf 2 8 4\n"
    )
    geom = '<geom type="capsule" fromto="0 0 0 1 0 0" size="0.05"'
    text = edited(LIMITED.replace(geom, '<geom type="mesh" mesh="cube"'), {})
    text = text.replace("<worldbody>", '<asset><mesh name="cube" file="cube.obj"/></asset><worldbody>')
    plan = rolled_out(problem_of(Mechanism.from_mjcf(LIMITED), 0.01, 10))
    plan = replace(plan, twin=replace(plan.twin, mjcf=text, assets={"cube.obj": cube.encode()}))
    again = load_plan(plan.save(tmp_path / "plan.npz"))
    assert again.twin.assets == plan.twin.assets
    assert compile_model(again.twin.mjcf, again.twin.assets).nmesh == 1
    with pytest.raises(planner.ModelError, match="MuJoCo refuses"):
        compile_model(again.twin.mjcf)
    film = Film.of(planner.replay(plan), np.array([0.0]))
    assert film.assets == plan.twin.assets
