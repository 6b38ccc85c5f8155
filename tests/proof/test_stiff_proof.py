"""Plans of a machine with a fast joint, in stages that one step of RK4 does not follow: the proof's steps do."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fingers import FAST

import planner
from planner import Mechanism, RigidBodyDynamics
from planner.dynamics.stiffness import fastest, substeps_for
from planner.problem.discretisation import finer, substeps_reason
from planner.proof.order import order
from planner.proof.replays.compiled_twin import CompiledTwin
from planner.proof.replays.replaying import replay_in
from planner.proof.robustness.rollouts import Rollouts
from planner.proof.same_step import same_step

DT, N = 0.02, 30
LEAST_RATE = 2.78 / DT  # 1/s, above which one step a stage is unstable


@pytest.fixture(scope="module")
def plan():
    m = Mechanism.from_mjcf(FAST)
    assert fastest(m, m.home).rate > 3.0 * LEAST_RATE
    dynamics = RigidBodyDynamics(m, DT, substeps=substeps_for(m, DT, m.home))
    goal = np.array([0.8, 0.4, 0.0, 0.0])
    cost = planner.TrackingCost.joints(dynamics, goal, N, effort=0.01, final_position=1e3, final_velocity=1e3)
    plan = planner.solve(planner.Problem(dynamics, cost, np.zeros(4)))
    assert plan.success
    return plan


def test_the_proof_passes(plan):
    assert planner.prove(plan, rollouts=0).passed


def test_at_the_plans_own_steps_mujoco_repeats_it_to_rounding(plan):
    section = same_step(plan, plan.problem, CompiledTwin(plan.twin))
    assert section.passed
    assert {measured.name for measured in section.measured} == {"state_error", "stage_error"}


def test_the_refined_replay_is_finer_than_the_substeps(plan):
    run = replay_in(CompiledTwin(plan.twin), plan)
    assert run.substeps >= 5 * plan.problem.dynamics.substeps
    assert not run.warnings
    longer = replay_in(CompiledTwin(plan.twin), plan, substeps=2)  # as the plan would be without substeps
    assert longer.warnings
    found = order(plan.problem, run)
    assert found.steps[0] == pytest.approx(DT / plan.problem.dynamics.substeps)
    assert np.isfinite(found.ends).all()
    assert found.section.passed


def test_perturbed_machines_take_at_most_half_a_substep(plan):
    with Rollouts(plan, CompiledTwin(plan.twin), threads=1) as rollouts:
        assert rollouts.step <= 0.5 * DT / plan.problem.dynamics.substeps * (1.0 + 1e-9)


def test_a_plan_of_shorter_stages_has_fewer_substeps(plan):
    problem = replace(plan.problem, us=plan.us)
    assert finer(problem).dynamics.substeps == -(-problem.dynamics.substeps // 2)
    assert substeps_reason(problem).startswith(f"{problem.dynamics.substeps} substeps a stage, because finger has")
    assert substeps_reason(planner.cases.hopper(horizon=20)) == ""
