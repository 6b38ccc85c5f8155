"""The paper's own methods on its own problems: the parts that a study stands on, and whole studies."""

import numpy as np
import pytest

from planner.cases import acrobot
from planner.paper_studies import elbow_gradient, hopper_splines, masses, shooting_sensitivity
from planner.rigid_body import mass_matrix


def test_points_at_the_tips_are_points_at_the_tips():
    """M of the stretched arm: the sum of m r^2 about each joint."""
    arm = masses.Arm("points at the tips", 0.4, 0.3, 1.1, 0.7)
    shoulder = 0.4 * 1.1**2 + 0.3 * 1.8**2
    elbow, both = 0.3 * 0.7**2, 0.3 * 0.7 * 1.8
    assert np.allclose(mass_matrix(masses.mechanism_of(arm), [0.0, 0.0]), [[shoulder, both], [both, elbow]], rtol=1e-5)


@pytest.mark.parametrize("kind", masses.KINDS)
def test_the_scale_of_the_masses_gives_the_papers_first_effort(kind):
    arm = masses.with_first_effort(kind, 0.6, 0.8)
    assert masses.by_splines(masses.mechanism_of(arm)).first_effort == pytest.approx(masses.FIRST, abs=0.01)


def test_a_pair_of_masses_has_both_of_the_papers_efforts():
    """Section 2.1: 73.6 and 9.9. Two equal points at the tips of links of 1.078 m, as masses_results() finds."""
    arm = masses.with_first_effort("points at the tips", 1.0, 1.078)
    motion = masses.by_splines(masses.mechanism_of(arm))
    assert motion.success
    assert (round(motion.first_effort, 1), round(motion.effort, 1)) == (masses.FIRST, masses.LAST)


def test_the_discrete_gradient_is_exact_at_any_step():
    for horizon in (50, 300):
        problem = acrobot(horizon=horizon)
        assert elbow_gradient.discrete_error(problem, problem.first_guess)["relative_error"] < 1e-8


def test_the_gradient_of_the_integral_is_not():
    """Loose tolerances spoil it: by the paper's own account, and here by more than SLQ's at every step."""
    exact, loose = elbow_gradient._problem(1e-8), elbow_gradient._problem(1e-3)
    reference, spoiled = exact(exact.first)[1], loose(exact.first)[1]
    assert np.linalg.norm(spoiled - reference) > 1e-4 * np.linalg.norm(reference)


@pytest.mark.paper
@pytest.mark.parametrize(
    ("study", "stem"),
    [(masses, "masses"), (elbow_gradient, "elbow"), (hopper_splines, "hopper_splines"),
     (shooting_sensitivity, "shooting")],
)  # fmt: skip
def test_a_study_fills_its_section_rows_and_picture(study, stem, tmp_path):
    results = getattr(study, f"{stem}_results")()
    assert getattr(study, f"{stem}_markdown")(results).startswith("## ")
    for row in getattr(study, f"{stem}_rows")(results):
        assert set(row) == {"paper", "where", "says", "ours", "why"}
        assert all(row.values())
    getattr(study, f"draw_{stem}")(results, tmp_path / "picture.png")
    assert (tmp_path / "picture.png").stat().st_size > 10_000
