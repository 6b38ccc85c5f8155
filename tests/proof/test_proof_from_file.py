"""A plan proves again from its file alone: in an empty folder, to the last bit, and in an older MuJoCo."""

import functools
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from places import ROOT
from solves import pendulum

import planner
from planner import FunctionDynamics, Mechanism, Problem, RigidBodyDynamics, TrackingCost
from planner.cases.plan_file import load_plan

OLDER = Path(sys.prefix) / "mujoco-3.3"
needs_older = pytest.mark.skipif(not OLDER.is_dir(), reason=f"no MuJoCo 3.3 in {OLDER.name}: .ci/setup test fetches it")

ARM = """
<mujoco><option gravity="0 0 -9.81"><flag contact="disable"/></option><worldbody>
  <body><joint name="hinge" axis="0 -1 0" damping="0.05"/>
    <geom type="capsule" fromto="0 0 0 0.5 0 0" size="0.02" mass="1"/>
    <body pos="0.5 0 0"><joint name="wrist" type="ball"/><geom type="box" size="0.1 0.05 0.02" mass="0.3"/></body>
  </body>
</worldbody><actuator><motor name="motor" joint="hinge"/></actuator></mujoco>
"""


def own_machine():
    """A machine of a user's own, out of our parts."""
    dynamics = RigidBodyDynamics(Mechanism.from_mjcf(ARM), dt=0.01)
    goal = dynamics.mechanism.home.copy()
    goal[0] = 0.5
    cost = TrackingCost.joints(dynamics, goal, 40, effort=0.1, final_position=100.0, final_velocity=10.0)
    return Problem(dynamics, cost, dynamics.mechanism.home)


PROBLEMS = {
    "hopper": lambda: planner.cases.hopper(duration=0.25, horizon=50, height=5.0), "two-link": planner.cases.two_link,
    "acrobot": lambda: planner.cases.acrobot(start="hanging"), "own": own_machine,
}  # fmt: skip
ROLLOUTS = {"hopper": 0, "two-link": 0, "acrobot": 8, "own": 2}  # seconds, where there are any


@pytest.fixture(scope="module")
def stored(tmp_path_factory):
    """A function of a problem's name: its plan file and the figures of its proof."""
    folder = tmp_path_factory.mktemp("plans")

    @functools.cache
    def of(name):
        plan = planner.solve(PROBLEMS[name]())
        return plan.save(folder / f"{name}.npz"), planner.prove(plan, rollouts=ROLLOUTS[name]).to_dict()

    return of


def proved_elsewhere(plan, name, folder, path=()):
    """What `planner prove` finds in a process and folder of its own."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([*map(str, path), str(ROOT)])}
    done = subprocess.run(
        [sys.executable, "-m", "planner", "prove", str(plan), "--rollouts", str(ROLLOUTS[name]), "--json", "--quiet"],
        cwd=folder, env=environment, capture_output=True, text=True, timeout=300,
    )  # fmt: skip
    assert done.returncode in (0, 1), done.stderr
    return json.loads(done.stdout)["proof"]


@pytest.mark.parametrize(
    "name", ["own", *(pytest.param(one, marks=pytest.mark.slow) for one in ("hopper", "two-link", "acrobot"))]
)
def test_a_plan_file_proves_to_the_last_bit_alone_in_a_folder(stored, name, tmp_path):
    file, figures = stored(name)
    assert proved_elsewhere(file, name, tmp_path) == json.loads(json.dumps(figures))


@needs_older
@pytest.mark.slow
@pytest.mark.parametrize("name", PROBLEMS)
def test_an_older_mujoco_finds_the_same_verdict_and_errors(stored, name, tmp_path):
    """Verdict and mode are equal, errors within 1 % or a thousandth of their bound: amplified rounding."""
    file, figures = stored(name)
    older = proved_elsewhere(file, name, tmp_path, [OLDER])
    assert older["simulator"]["version"].startswith("3.3.")
    assert (older["verdict"], older["mode"]) == (figures["verdict"], figures["mode"])
    for step in ("parity", "same_step", "refined_open_loop", "refined_feedback", "goal"):
        for name_, figure in figures[step].get("figures", {}).items():
            value, now = figure["value"], older[step]["figures"][name_]["value"]
            least = 1e-3 * figure["bound"] if figure["bound"] else 1e-6
            assert now == pytest.approx(value, rel=0.01, abs=least), (step, name_)


def test_a_machine_of_our_own_parts_is_rebuilt(stored):
    plan = load_plan(stored("own")[0])
    made = own_machine()
    assert plan.case is None
    assert plan.changed == ()
    for name in ("Q", "R", "x_ref", "u_ref"):
        assert np.array_equal(getattr(plan.problem.cost, name), getattr(made.cost, name))
    assert plan.problem.dynamics.integrator == "rk4"
    assert np.array_equal(plan.problem.x0, made.x0)


def own_python():
    text = ARM.split("<body pos")[0] + "</body></worldbody><actuator><motor joint='hinge'/></actuator></mujoco>"
    same = np.eye(2)
    twin = planner.Twin(text, same, np.zeros(2), same[None], np.zeros((1, 2)))
    dynamics = FunctionDynamics(pendulum, nx=2, nu=1, dt=0.02, integrator="rk4")
    return Problem(dynamics, TrackingCost.reach([1.0, 0.0], 50, final=10.0, effort=1.0, dt=0.02), [0.0, 0.0], twin=twin)


def test_a_plan_of_ones_own_python_says_that_it_needs_it(tmp_path, capsys):
    from planner.__main__ import main

    problem = own_python()
    with pytest.warns(UserWarning, match="has the plan without its problem"):
        file = planner.solve(problem).save(tmp_path / "plan.npz")
    assert main(["prove", str(file)]) == 2
    assert "its maker's own Python" in capsys.readouterr().err
    plan = load_plan(file, problem=problem)
    assert planner.prove(plan, rollouts=0).plan.passed
    with pytest.raises(planner.PlannerError, match="do not fit"):
        load_plan(file, problem=planner.cases.two_link())


def test_how_a_plan_was_solved_is_in_its_file(tmp_path):
    plan = planner.solve(planner.cases.two_link(horizon=20), starts=3, seed=5, max_iterations=30)
    options = load_plan(plan.save(tmp_path / "plan.npz")).options
    assert (options["starts"], options["seed"], options["max_iterations"], options["update"]) == (3, 5, 30, "feedback")
