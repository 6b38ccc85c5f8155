"""Problems, plans and proofs are pickled and copied, so that a pool of processes can solve them."""

import copy
import multiprocessing
import pickle
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from carts import CART

import planner
from planner import cases
from planner.costs import EnergyCost, FrameCost, Height, JerkCost, PenaltyCost, Point, TrackingCost, with_objective
from planner.proof.replays.compiled_twin import CompiledTwin
from planner.proof.robustness.perturbed import replay_rollout

WAYS = {"pickle": lambda thing: pickle.loads(pickle.dumps(thing)), "deepcopy": copy.deepcopy, "copy": copy.copy}


def pendulum(x, u):
    """A user's own model."""
    return np.stack([x[..., 1], np.sin(x[..., 0]) + u[..., 0]], axis=-1)


def same_bits(a, b):
    return all(getattr(a, part).tobytes() == getattr(b, part).tobytes() for part in ("xs", "us", "K")) and (
        a.cost == b.cost
    )


def arm(**changes):
    """The two-link arm by the general rules of a proof."""
    return replace(cases.two_link(duration=0.4, horizon=20), requirements=None, **changes)


@cache
def solved(name):
    problem = cases.build(name)
    return problem, planner.solve(problem, max_iterations=1)


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("name", cases.CASES)
def test_every_case_solves_to_the_same_bits_when_it_was_copied(name, way):
    problem, plan = solved(name)
    assert same_bits(plan, planner.solve(WAYS[way](problem), max_iterations=1))


def test_the_machine_of_a_copy_is_read_only_and_one():
    problem = WAYS["pickle"](cases.puma())
    mechanism = problem.dynamics.mechanism
    assert not mechanism.mass.flags.writeable
    assert not mechanism.actuators.gain.flags.writeable
    tip = FrameCost(problem.dynamics, "tip", position=(0.0, 0.0, 1.0), position_weight=1.0)
    first = replace(problem, cost=problem.cost + tip)
    second = WAYS["pickle"](first)
    assert second.cost.costs[1].mechanism is second.dynamics.mechanism  # compiled engines are chosen by that


def test_a_user_s_own_function_is_copied_with_its_problem():
    dynamics = planner.FunctionDynamics(pendulum, nx=2, nu=1, dt=0.05)
    cost = TrackingCost.reach([np.pi, 0.0], 20, final=10.0, effort=0.1, dt=0.05)
    problem = planner.Problem(dynamics, cost, x0=[0.0, 0.0])
    plan = planner.solve(problem)
    for copied in (way((problem, plan)) for way in WAYS.values()):
        assert same_bits(planner.solve(copied[0]), plan)
        assert same_bits(copied[1], plan)


@pytest.mark.parametrize("way", WAYS)
def test_costs_of_every_kind_are_copied(way):
    problem = arm()
    dynamics, N, xs = problem.dynamics, problem.N, np.linspace(0.0, 1.0, 4 * (problem.N + 1)).reshape(-1, 4)
    costs = (
        problem.cost, EnergyCost(dynamics, 1.0), JerkCost(dynamics, N, 1e-3), with_objective(problem, "jerk").cost,
        FrameCost(dynamics, "tip", position=(0.0, 0.0, 1.0), position_weight=1.0),
        PenaltyCost(dynamics, N, [Height(Point("tip"), lower=2.0, tolerance=0.01)]),
    )  # fmt: skip
    for cost in costs:
        assert WAYS[way](cost).value(xs, problem.us) == cost.value(xs, problem.us)


@pytest.fixture(scope="module")
def proved():
    """A plan, its proof and one of the proof's perturbed rollouts."""
    plan = planner.solve(arm())
    proof = planner.prove(plan, rollouts=4)
    return plan, proof, replay_rollout(proof.replay.plan, proof.replay.compiled, 1)


@pytest.mark.parametrize("way", WAYS)
def test_plan_proof_and_replays_are_copied(proved, way):
    plan, proof, run = proved
    copied_plan, copied = WAYS[way]((plan, proof))
    assert same_bits(plan, copied_plan)
    assert copied.to_dict() == proof.to_dict()
    assert copied.parity == proof.parity
    if way == "pickle":  # what goes to another process; the perturbed rollouts take most of a proof
        assert planner.prove(copied.replay.plan, rollouts=4).to_dict() == proof.to_dict()
    other = replay_rollout(copied.replay.plan, copied.replay.compiled, 1)
    assert run.xs.tobytes() == other.xs.tobytes()


@pytest.mark.parametrize("way", WAYS)
def test_a_twin_whose_model_was_changed_is_copied_with_the_change(way):
    """Its text knows nothing of it, so a copy must not compile the text again."""

    def heavier(model):
        model.body_mass[1] += 1.0

    changed = CompiledTwin(cases.two_link().twin).changed(heavier)
    assert WAYS[way](changed).model.body_mass[1] == changed.model.body_mass[1]


def test_another_process_solves_a_problem_to_the_same_bits():
    user = planner.Mechanism.from_mjcf(CART)
    dynamics = planner.RigidBodyDynamics(user, 0.05)
    cost = TrackingCost.reach(np.r_[1.0, np.zeros(user.space.nx - 1)], 20, final=10.0, effort=0.1, nu=dynamics.nu)
    problems = [arm(), planner.Problem(dynamics, cost, x0=np.zeros(user.space.nx))]
    spawn = multiprocessing.get_context("spawn")  # shares nothing with this process but the file system
    with ProcessPoolExecutor(1, mp_context=spawn) as pool:
        for problem, plan in zip(problems, pool.map(planner.solve, problems), strict=True):
            assert same_bits(plan, planner.solve(problem))
            assert planner.prove(plan, rollouts=0).verdict == planner.prove(planner.solve(problem), rollouts=0).verdict
