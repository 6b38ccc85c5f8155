"""suggested_fixes(): a machine that flies is to land by contacts of its file, and no ground is taken away from it."""

from dataclasses import replace
from types import SimpleNamespace

import pytest

import planner
from planner.proof.diagnostics import suggested_fixes
from planner.proof.diagnostics.avoid_contact import avoid_contact

LEGS = "".join(f'<geom name="leg{s}" type="sphere" pos="{s}0.25 0 -0.25" size="0.04" mass="0.2"/>' for s in "-+")
CRAFT = f"""<mujoco><worldbody><geom name="floor" type="plane" size="5 5 .1"/><body name="craft" pos="0 0 1">
  <joint name="x" type="slide" axis="1 0 0"/><joint name="z" type="slide" axis="0 0 1"/>
  <joint name="tilt" axis="0 1 0"/><geom type="box" size="0.25 0.2 0.08" mass="4"/>{LEGS}
  <site name="left" pos="-0.2 0 0"/><site name="right" pos="0.2 0 0"/></body></worldbody><actuator>
  <motor site="left" gear="0 0 1 0 0 0" ctrlrange="0 40"/><motor site="right" gear="0 0 1 0 0 0" ctrlrange="0 40"/>
  </actuator></mujoco>"""


def fixes(tmp_path, *lines):
    (tmp_path / "craft.xml").write_text(CRAFT)
    (tmp_path / "problem.toml").write_text("\n".join(['model = "craft.xml"', "duration = 1.5", *lines]))
    plan = planner.solve(planner.load_problem(tmp_path / "problem.toml"))
    proof = planner.prove(plan, rollouts=0)
    return proof, [(one.key, one.value, one.code) for one in suggested_fixes(plan, proof)]


@pytest.mark.parametrize(
    "goal", [
        "goal = { x = 0.3, z = -0.71, tilt = 0 }",
        pytest.param('[[goal]]\nframe = "craft"\nposition = [0.3, 0, 0.29]', marks=pytest.mark.slow),
    ],
)  # fmt: skip
def test_a_craft_that_lands_on_its_thrusters_is_offered_the_files_contacts(tmp_path, goal):
    """0.29 m is its height where both legs lie flush with the floor: no clearance leads there, and no exclusion."""
    proof, found = fixes(tmp_path, "start = { x = -0.3 }", 'contacts = "avoid"', goal)
    assert not proof.your_file.passed
    assert found == [("contacts", "file", "lands")]


@pytest.mark.slow
def test_by_default_it_has_them_and_lands(tmp_path):
    proof, _ = fixes(tmp_path, "start = { x = -0.3 }", "goal = { x = 0.3, z = -0.71, tilt = 0 }")
    assert proof.passed


@pytest.mark.parametrize(("goal", "key"), [(-0.6, "avoid"), (-0.705, "contacts")])
def test_a_craft_that_ends_too_low_is_to_stand_only_where_its_goal_is_on_the_ground(tmp_path, goal, key):
    """Its legs touch the floor at z = -0.71 m: 0.11 m below the one goal, and within LANDED of the other."""
    (tmp_path / "craft.xml").write_text(CRAFT)
    text = f'model = "craft.xml"\nduration = 1.5\ngoal = {{ x = 0.3, z = {goal}, tilt = 0 }}\n'
    (tmp_path / "problem.toml").write_text(text)
    plan = planner.solve(planner.load_problem(tmp_path / "problem.toml"))
    low = plan.xs.copy()
    low[-1, 1] = -0.714
    failed = SimpleNamespace(your_file=SimpleNamespace(failures=[SimpleNamespace(name="unknown_contacts")]))
    (found,) = avoid_contact(replace(plan, xs=low), plan.problem, failed)
    assert found.key == key
