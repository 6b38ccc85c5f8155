"""The example examples/hop_forward.py: models of others with feet hop forward, and MuJoCo repeats it."""

import runpy

import numpy as np
import pytest
from places import PLACES, ROOT

import planner

SCRIPT = runpy.run_path(str(ROOT / "examples" / "hop_forward.py"))
others = pytest.mark.skipif(None in PLACES.values(), reason="no models of others")


@others
@pytest.mark.slow
@pytest.mark.parametrize("name", SCRIPT["HOPPERS"])
def test_a_model_of_others_hops_forward_and_mujoco_repeats_it(name):
    """Not only up: it lands elsewhere, after a time without any force of the ground, and stays there."""
    plan, figures = SCRIPT["hop"](SCRIPT["HOPPERS"][name])
    assert plan.status is planner.Status.CONVERGED
    assert figures["forward_m"] >= 0.1
    assert figures["flight_s"] >= 0.1
    assert figures["end_rate"] <= 0.03  # m/s, rad/s: at rest
    proof = planner.prove(plan, rollouts=0)
    if name == "dm-walker":  # on the contact of its own file, MuJoCo's default, it does not land: the proof says so
        assert proof.refined_feedback.passed
        assert proof.reason.startswith("your file: ")
        return
    assert proof.passed, proof
    assert not proof.replay.reached  # no end of a joint's or a motor's range helped


@others
@pytest.mark.parametrize("name", SCRIPT["HOPPERS"])
def test_the_drawing_flies_on_a_parabola_and_its_feet_land_where_they_were_asked_to(name):
    hopper = SCRIPT["HOPPERS"][name]
    machine = SCRIPT["machine_of"](hopper)
    x0 = SCRIPT["crouched"](hopper, machine)
    up = SCRIPT["STAND"] + hopper.push
    path = SCRIPT["parabola"](hopper, np.linspace(up, up + hopper.flight, 21)[:-1])
    np.testing.assert_allclose(np.diff(path, 2, axis=0) / (hopper.flight / 20) ** 2, [[0.0, -9.81]] * 18, atol=1e-8)
    q = SCRIPT["reference"](hopper, machine, x0)[:, : machine.nq]
    for foot in hopper.feet:
        way = SCRIPT["foot_of"](machine, q, foot) - SCRIPT["foot_of"](machine, q[:1], foot)
        np.testing.assert_allclose(way[-1], [hopper.length, 0.0, 0.0], atol=1e-6)
