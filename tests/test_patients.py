"""The human step for other people, and for people who are not as planned: parity, forces, Monte Carlo, bad input."""

from dataclasses import replace

import numpy as np
import pytest

from planner.cases import human_step
from planner.mjcf import edited, written
from planner.proof.parity import parity

# parity


@pytest.mark.parametrize("body", [(45.0, 1.5), (70.0, 1.75), (110.0, 1.95)], ids=str)
@pytest.mark.parametrize("pelvis", ["motion", "force"])
@pytest.mark.parametrize("phase", ["swing", "cycle"])
def test_anybody_is_the_same_in_mujoco(phase, pelvis, body):
    """At random states hinges of hip and pelvis come to lie along each other, and then accelerations are rounding."""
    mass, height = body
    found = parity(human_step(phase=phase, pelvis=pelvis, mass=mass, height=height), seed=1)
    assert found.passed, found.failures


@pytest.mark.parametrize("pelvis", ["motion", "force"])
def test_a_wrong_foot_is_seen_beside_the_belt(pelvis):
    """One part in a million of 1 kg, where the belt has 1e8 kg."""
    problem = human_step(pelvis=pelvis)
    heavier = written(1.015 * (1.0 + 1e-6))
    text = edited(problem.twin.mjcf, {".//body[@name='right_foot']/inertial": {"mass": heavier}})
    found = parity(problem, twin=replace(problem.twin, mjcf=text))
    assert "mass_matrix_error" in [figure.name for figure in found.failures]
