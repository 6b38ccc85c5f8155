"""`planner drive` with nothing stated passes, whatever the machine's calls take here; stiff servos in the window."""

import json
import re

import numpy as np
import pytest
from commands import run
from places import ROOT

import planner
from planner.control.window_parts import WINDOW_ERROR, window_dynamics
from planner.dynamics import RigidBodyDynamics
from planner.dynamics.step_stability import implicit_error

ARM = (ROOT / "examples" / "tasks" / "arm.xml").read_text(encoding="utf-8")
SERVO = '<position name="{0}" joint="{0}" kp="{1:.0f}" kv="{2:.0f}" ctrlrange="-3 3" forcerange="-{3} {3}"/>'


def arm_file(folder, servos, dt):
    """A problem file of seven joints with motors, or with servos of 50 N m/rad and 2.5 N m s/rad per N m of torque."""
    text = ARM
    if servos:
        text = re.sub(
            r'<motor name="(\w+)" joint="\w+" ctrlrange="-\d+ (\d+)"/>',
            lambda m: SERVO.format(m[1], 50.0 * float(m[2]), 2.5 * float(m[2]), m[2]), ARM,
        )  # fmt: skip
    (folder / "arm.xml").write_text(text, encoding="utf-8")
    words = f'model = "arm.xml"\nstart = "home"\ngoal = {{ waist = 0.8, elbow = 1.0 }}\nduration = 1.0\n{dt}'
    (folder / "arm.toml").write_text(words, encoding="utf-8")
    return folder / "arm.toml"


@pytest.mark.slow
@pytest.mark.parametrize("machine", ["two-link", "acrobot", "cart_pole", "motors", "servos"])
def test_drive_with_defaults_passes(machine, tmp_path):
    files = {
        "cart_pole": lambda: ROOT / "examples" / "loop" / "cart_pole.toml",
        "motors": lambda: arm_file(tmp_path, False, "dt = 0.002\n"), "servos": lambda: arm_file(tmp_path, True, ""),
    }  # fmt: skip
    case = str(files[machine]()) if machine in files else machine
    done = run("drive", case, "--no-video", "--out", "o", cwd=tmp_path)
    assert done.returncode == 0, done.stdout
    calls = json.loads((tmp_path / "o" / "drive.json").read_text())["calls"]["figures"]
    # What drive chose before the run is kept in it: by the processor's clock, which other programs do not advance.
    assert calls["processor_time"]["value"] <= calls["latency"]["value"] <= calls["period"]["value"] * (1.0 + 1e-9)


@pytest.fixture(scope="module")
def servos(tmp_path_factory):
    return planner.load_problem(arm_file(tmp_path_factory.mktemp("servos"), True, ""))


def test_windows_of_stiff_servos_take_few_implicit_substeps(servos):
    own, states = servos.dynamics, np.stack([servos.x0, servos.x0 + 0.1])
    coarse = window_dynamics(servos, states)
    assert coarse.integrator == "rosenbrock"
    assert 1 < coarse.substeps < own.substeps
    m, k = own.mechanism, coarse.substeps
    errors = [implicit_error(m, own.dt, states, (), number) for number in (k, k // 2)]
    assert errors[0] <= WINDOW_ERROR < errors[1]  # the fewest that do
    fine = RigidBodyDynamics(own.mechanism, own.dt / 16, "rosenbrock", (), 16)
    us = np.tile(servos.us[0], (2, 1))
    exact = states
    for _ in range(16):
        exact = fine.step(exact, us)
    nv = own.mechanism.nv
    scale = np.concatenate([np.ones(nv), np.full(nv, own.dt)])  # speeds count over a stage, as in implicit_error
    off = np.abs(scale * (coarse.step(states, us) - exact)).max()
    assert off < WINDOW_ERROR  # rad: the Jacobian's error times deviations from rest, which are below 1 rad


def test_windows_of_machines_without_stiff_damping_are_the_problems_own(problem):
    assert window_dynamics(problem, problem.x0[None]) is problem.dynamics
