"""The paper's own methods on its own problems: the parts that a study stands on, and whole studies."""

import numpy as np
import pytest

from planner.cases import acrobot
from planner.dynamics.algorithms import bias, mass_matrix
from planner.paper.methods.adjoint import Integration
from planner.paper.studies import elbow as elbow_study
from planner.paper.studies import masses as masses_study


def test_points_at_the_tips_are_points_at_the_tips():
    """M of the stretched arm: the sum of m r^2 about each joint."""
    arm = masses_study.Arm("points at the tips", 0.4, 0.3, 1.1, 0.7)
    shoulder = 0.4 * 1.1**2 + 0.3 * 1.8**2
    elbow, both = 0.3 * 0.7**2, 0.3 * 0.7 * 1.8
    assert np.allclose(
        mass_matrix(masses_study.arm_mechanism(arm), [0.0, 0.0]), [[shoulder, both], [both, elbow]], rtol=1e-5
    )


@pytest.mark.parametrize("kind", masses_study.KINDS)
def test_masses_that_are_not_compiled_give_the_same_arm(kind):
    arm, q = masses_study.Arm(kind, 0.4, 0.3, 1.1, 0.7), [0.3, -0.8]
    by_file, quick = masses_study.arm_mechanism(arm), masses_study._quick_mechanism(arm)
    assert np.allclose(mass_matrix(quick, q), mass_matrix(by_file, q), rtol=1e-12)
    assert np.allclose(bias(quick, q, [1.0, 2.0]), bias(by_file, q, [1.0, 2.0]), rtol=1e-12)


@pytest.mark.parametrize("kind", masses_study.KINDS)
def test_the_scale_of_the_masses_gives_the_papers_first_effort(kind):
    arm = masses_study.with_first_effort(kind, 0.6, 0.8, 0.9)
    assert masses_study.by_splines(masses_study.arm_mechanism(arm)).first_cost == pytest.approx(
        masses_study.FIRST, abs=0.01
    )


@pytest.mark.parametrize(
    ("kind", "masses", "lengths"),
    [
        ("rods", (0.0531, 0.3586), (1.4476, 1.6696)),  # found by others, from these two numbers alone
        ("points halfway", (1.1385, 0.9945), (0.3341, 0.9909)),
    ],
)
def test_arms_of_other_kinds_have_both_of_the_papers_efforts(kind, masses, lengths):
    """Section 2.1: 73.6 and 9.9."""
    motion = masses_study.by_splines(masses_study.arm_mechanism(masses_study.Arm(kind, *masses, *lengths)))
    assert motion.success
    assert (round(motion.first_cost, 1), round(motion.cost, 1)) == (masses_study.FIRST, masses_study.LAST)


def test_the_search_finds_an_arm_between_its_grid_s_ratios():
    """Two equal points at the tips of links of 1.078 m have both efforts."""
    ratios = np.array([0.9, 1.2])
    (arm,) = masses_study.arms_with_both("points at the tips", np.array([1.078]), ratios)
    assert arm["last"] == pytest.approx(masses_study.LAST, abs=masses_study.ENOUGH)
    assert ratios[0] < arm["mass2"] / arm["mass1"] < ratios[1]
    assert arm["swings"] == 1


def test_the_discrete_gradient_is_exact_at_any_step():
    for horizon in (50, 300):
        problem = acrobot(horizon=horizon)
        assert elbow_study.discrete_error(problem, problem.first_guess)["relative_error"] < 1e-8


def test_the_gradient_of_the_integral_is_not():
    """Loose tolerances spoil it: by the paper's own account, and here by more than SLQ's at every step."""
    exact, loose = (elbow_study.problem_at(Integration(tolerance)) for tolerance in (1e-8, 1e-3))
    reference, spoiled = exact(exact.first)[1], loose(exact.first)[1]
    assert np.linalg.norm(spoiled - reference) > 1e-4 * np.linalg.norm(reference)
