"""Least energy: the work that SciPy finds on a line, whatever the power, and that of an arm around a post."""

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import minimize

import planner
from planner.cases.problem_file import load
from planner.costs import EnergyCost

WAY = """<mujoco><option gravity="0 0 0"><flag contact="disable"/></option><worldbody><body>
<joint name="x" type="slide" axis="1 0 0" damping="{0}"/><geom size="0.05" mass="{1}"/></body></worldbody>
<actuator><motor joint="x" ctrlrange="-{2} {2}"/></actuator></mujoco>"""


@pytest.fixture(scope="module")
def least_work():
    """J, by SLSQP: the least that held forces of up to 3 N do on 2 kg and 1 N s/m, a metre from rest to rest in 3 s."""
    N, dt = 30, 0.1
    A, B = np.array([[0.0, 1.0], [0.0, -0.5]]), np.array([[0.0], [0.5]])
    stage = expm(dt * np.block([[A, B], [np.zeros((1, 3))]]))[:2]
    ends = np.zeros((N + 1, 2, N))  # of the stages, by the forces
    for n in range(N):
        ends[n + 1] = stage[:, :2] @ ends[n]
        ends[n + 1, :, n] += stage[:, 2]
    ways, us = np.diff(ends[:, 0], axis=0), np.linspace(1.5, -0.5, N)

    def smoothed(us, s):
        work = us * (ways @ us)
        size = np.sqrt(work**2 + s**2)
        return np.sum(size - s), work / size * (ways @ us) + (work / size * us) @ ways

    there = {"type": "eq", "fun": lambda us: ends[-1] @ us - [1.0, 0.0], "jac": lambda us: ends[-1]}
    for s in 0.1 ** np.arange(1.0, 6.0):  # J in a stage
        us = minimize(smoothed, us, (s,), "SLSQP", True, bounds=[(-3.0, 3.0)] * N, constraints=there).x
    return np.abs(us * (ways @ us)).sum()


@pytest.mark.parametrize("size", [0.1, 1.0, 1e4])
def test_least_energy_is_scipys_whatever_the_power(tmp_path, least_work, size):
    """Peaks of 0.1 W, 1 W and 10 kW: mass, damping and forces times the size, and so the work."""
    (tmp_path / "way.xml").write_text(WAY.format(size, 2.0 * size, 3.0 * size))
    lines = ['model = "way.xml"', "start = [0.0]", "goal = [1.0]", "duration = 3.0", "dt = 0.1", 'objective = "energy"']
    (tmp_path / "problem.toml").write_text("\n".join([*lines, "[limits]", 'final = "exact"', ""]))
    file = load(tmp_path / "problem.toml")
    plan = planner.solve_for(file.problem, file.objective)
    work = EnergyCost(plan.problem.dynamics).work(plan.xs, plan.us)
    assert plan.success
    assert 0.999 * least_work < work / size < 1.01 * least_work  # 0.1 %: of SLSQP
    assert 0.0 < plan.problem.objective.smoothing < 0.01 * size  # W
    back = planner.load_plan(plan.save(tmp_path / "plan.npz"))
    assert back.problem.objective.smoothing == plan.problem.objective.smoothing
    assert not back.changed
    assert np.array_equal(planner.solve_for(file.problem, file.objective).us, plan.us)


POST = """
<mujoco>
  <compiler angle="radian"/>
  <worldbody>
    <geom name="post" type="cylinder" size="0.04 0.4" pos="0.68 0.1 0.3"/>
    <body pos="0 0 0.3">
      <joint name="j1" axis="0 0 1" range="-3 3"/>
      <geom name="one" type="capsule" fromto="0 0 0 0.3 0 0" size="0.03" mass="2"/>
      <body pos="0.3 0 0">
        <joint name="j2" axis="0 0 1" range="-2.6 2.6"/>
        <geom name="two" type="capsule" fromto="0.03 0 0 0.3 0 0" size="0.03" mass="1"/>
        <body pos="0.3 0 0">
          <joint name="j3" axis="0 1 0" range="-2 2"/>
          <geom name="three" type="capsule" fromto="0.03 0 0 0.15 0 0" size="0.02" mass="0.5"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor joint="j1" ctrlrange="-40 40"/><motor joint="j2" ctrlrange="-20 20"/><motor joint="j3" ctrlrange="-10 10"/>
  </actuator>
</mujoco>
"""


@pytest.mark.parametrize("objective", ["effort", pytest.param("energy", marks=pytest.mark.slow)])
def test_around_a_post_an_objective_starts_from_the_default_plan(tmp_path, objective):
    """Without a weight of velocities j3, which costs nearly nothing, swings at 12 rad/s for a way of 0.3 rad."""
    (tmp_path / "arm.xml").write_text(POST)
    poses = ["start = { j1 = -0.5, j2 = 0.3 }", "goal = { j1 = 0.7, j2 = 0.2, j3 = 0.3 }"]
    lines = ['model = "arm.xml"', *poses, "duration = 1.5", "dt = 0.02", f'objective = "{objective}"', "[avoid]", ""]
    (tmp_path / "problem.toml").write_text("\n".join(lines))
    file = load(tmp_path / "problem.toml")
    default = file.problem.recipe.rebuilt(objective=None, resolved=None)
    usual, plan = planner.solve(default), planner.solve_for(file.problem, file.objective)
    assert usual.success
    assert plan.success
    if objective == "effort":
        speed, most = (np.abs(one.xs[:, 3:]).max(axis=0) for one in (plan, usual))
        assert np.all(speed < 4.0 * most)
    else:  # the light third joint may swing: what counts is the work, which falls to a ninth
        usual_cost, cost = (plan.problem.cost.value(one.xs, one.us) for one in (usual, plan))
        assert cost < 0.2 * usual_cost
