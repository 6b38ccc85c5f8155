"""The example examples/hop_forward.py: gymnasium's Hopper hops forward, and MuJoCo repeats it."""

import runpy
from pathlib import Path

import pytest
from test_models_of_others import PLACES

import planner

SCRIPT = Path(__file__).parent.parent / "examples" / "hop_forward.py"


@pytest.mark.skipif(PLACES["gym"] is None, reason="no models of others")
def test_a_model_of_others_hops_forward_and_mujoco_repeats_it():
    """Not only up: it lands elsewhere, after a time without any force of the ground."""
    plan, figures = runpy.run_path(str(SCRIPT))["hop"]()
    assert plan.status is planner.Status.CONVERGED
    assert figures["forward_m"] >= 0.2  # m of the 0.25 asked for: 12 % of its height
    assert figures["flight_s"] >= 0.1
    proof = planner.prove(plan, rollouts=0)
    assert proof.passed, proof
