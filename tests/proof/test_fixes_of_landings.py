"""suggested_fixes(): a machine that flies is to land by contacts of its file, and no ground is taken away from it."""

import pytest

import planner
from planner.proof.diagnostics import suggested_fixes

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
    "goal", ["goal = { x = 0.3, z = -0.71, tilt = 0 }", '[[goal]]\nframe = "craft"\nposition = [0.3, 0, 0.29]']
)
def test_a_craft_that_lands_on_its_thrusters_is_offered_the_files_contacts(tmp_path, goal):
    """0.29 m is its height where both legs lie flush with the floor: no clearance leads there, and no exclusion."""
    proof, found = fixes(tmp_path, "start = { x = -0.3 }", goal)
    assert not proof.your_file.passed
    assert found == [("contacts", "file", "lands")]
    proof, _ = fixes(tmp_path, "start = { x = -0.3 }", 'contacts = "file"', goal)
    assert proof.passed
