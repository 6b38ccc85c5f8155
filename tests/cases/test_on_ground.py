"""Start and goal of a problem file at rest are put on the ground, unless the file says settle = false."""

import numpy as np
import pytest

import planner
from planner.cases.plan_file import load_plan
from planner.cases.problem_file import load
from planner.cases.problem_file.states import STANCE_RAMP
from planner.dynamics.contacts import contact_forces
from planner.dynamics.kinematics import center_of_mass
from planner.dynamics.statics import clearance
from planner.model.mjcf.file_law import FILE_SMOOTHING
from planner.problem.costs.tracking import tracking_of
from planner.problem.goals import static_error
from planner.proof.diagnostics.goals import standing_goal

# A sled of 2 kg on four balls, with a mast that a motor turns; the file lets it fall from 0.3 m above the floor.
SLED = """<mujoco><worldbody><geom name="floor" type="plane" size="0 0 1" pos="0 0 -1"/>
  <body name="sled" pos="0 0 -.65"><freejoint name="root"/><inertial pos="0 0 0" mass="1.5" diaginertia=".1 .1 .1"/>
    <geom size=".05" pos=".3 .2 0"/><geom size=".05" pos="-.3 .2 0"/>
    <geom size=".05" pos=".3 -.2 0"/><geom size=".05" pos="-.3 -.2 0"/>
    <body name="mast"><joint name="mast" axis="0 1 0" damping=".1"/>
      <inertial pos="0 0 .2" mass=".5" diaginertia=".01 .01 .01"/>
    </body></body></worldbody><actuator><motor joint="mast"/></actuator></mujoco>"""
DOWN = "{} is put on the ground, 0.3 m or rad from what was asked; settle = false leaves it there."
BOTH = f"{DOWN.format('start')} {DOWN.format('goal')}"
# Nobody looks at its first guess.
TABLE = 'model = "sled.xml"\nstart = {start}\ngoal = {goal}\nduration = 0.5\ndt = 0.01\nguess = "hold"\n{more}\n'


def loaded(tmp_path, start="{}", goal="{ mast = 0.1 }", more=""):
    (tmp_path / "sled.xml").write_text(SLED)
    (tmp_path / "p.toml").write_text(TABLE.format(start=start, goal=goal, more=more))
    return load(tmp_path / "p.toml")


def test_start_and_goal_are_put_down(tmp_path):
    file = loaded(tmp_path)
    m = file.problem.dynamics.mechanism
    for x, mast in ((file.problem.x0, 0.0), (file.problem.cost.x_ref[-1], 0.1)):
        forces = contact_forces(m, x[: m.nq], np.zeros(m.nv)).forces
        assert forces[:, 2].sum() == pytest.approx(2.0 * 9.81, rel=1e-7)  # carried: its weight
        assert forces[:, 2].min() > 0.0
        assert x[7] == mast
    rates = file.problem.dynamics.rates(file.problem.x0[None], file.problem.first_guess[:1])
    np.testing.assert_allclose(rates, 0.0, atol=1e-6)
    assert file.notes[0].startswith("contacts of 4 pairs with planes are planned with the file's own law")
    assert file.notes[1] == BOTH
    assert file.problem.parameters["contacts"] == "file"


@pytest.mark.parametrize(
    ("start", "more", "height", "note"),
    [
        ("[0, 0, -0.65, 1, 0, 0, 0, 0]", "", 0.0, BOTH),
        ("{ root = [0, 0, -0.65, 1, 0, 0, 0] }", "", 0.0, BOTH),
        ("{ root = [0, 0, -0.93, 1, 0, 0, 0] }", "", 0.0, ""),  # 2 cm above it: nothing to say
        ("[0, 0, -0.65, 1, 0, 0, 0, 0]", "settle = true", 0.0, ""),
        ("{}", "settle = false", 0.3, ""),
        ("[0, 0, -0.65, 1, 0, 0, 0, 0]", "settle = false", 0.3, ""),
        (
            "[0, 0, -0.65, 1, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0]",
            "",
            0.3,
            f"start is not put on the ground, since it moves. {DOWN.format('goal')}",
        ),
    ],
)
def test_what_rests_is_put_down_from_any_height_unless_the_file_says_no(tmp_path, start, more, height, note):
    file = loaded(tmp_path, start, more=more)
    # sinks by a quarter of 5 mm
    assert clearance(file.problem.dynamics.mechanism, file.problem.x0) == pytest.approx(height, abs=2.5e-3)
    assert [one for one in file.notes if one.startswith("start")] == ([note] if note else [])


def test_feet_that_stay_stand_on_ground_that_is_hardly_smoothed(tmp_path):
    usual = FILE_SMOOTHING[0]
    file = loaded(tmp_path)
    (law,) = {one.law for one in file.problem.dynamics.mechanism.contacts}
    assert law.ramp == STANCE_RAMP
    plan = planner.solve(file.problem, max_iterations=1)
    plan.save(tmp_path / "p.npz")
    assert load_plan(tmp_path / "p.npz").problem.dynamics.mechanism.contacts[0].law == law
    parameters = file.problem.parameters
    older = {name: value for name, value in parameters["resolved"].items() if name != "ramp"}
    before = file.problem.recipe.build(**parameters | {"resolved": older})  # a plan that was made before there was one
    away = loaded(tmp_path, goal="{ root = [0.2, 0, -0.95, 1, 0, 0, 0] }")  # the balls have to go by 20 cm
    for problem in (before, away.problem):
        assert problem.dynamics.mechanism.contacts[0].law.ramp == pytest.approx(usual, rel=1e-12)


HOPPER = """<mujoco><worldbody><geom name="floor" type="plane" size="0 0 1"/><body name="trunk" pos="0 0 1">
  <joint name="x" type="slide" axis="1 0 0"/><joint name="z" type="slide" axis="0 0 1"/>
  <joint name="tilt" axis="0 1 0"/><inertial pos="0 0 0" mass="5" diaginertia=".1 .1 .1"/>
  <body name="leg"><joint name="hip" axis="0 1 0"/>
    <inertial pos="0 0 -.3" mass=".5" diaginertia=".01 .01 .01"/>
    <body name="foot" pos="0 0 -.6"><joint name="ankle" axis="0 1 0"/>
      <geom size=".03" pos=".15 0 0"/><geom size=".03" pos="-.15 0 0"/></body></body></body></worldbody>
  <actuator><motor joint="hip"/><motor joint="ankle"/></actuator></mujoco>"""


@pytest.mark.parametrize(("x", "kept"), [("", False), ("x = 0.0, ", True), ("x = 0.001, ", True)])
def test_a_coordinate_that_the_goal_names_is_kept_where_it_is_at_its_start_value(tmp_path, x, kept):
    """Feet that do not slide would carry the trunk forwards by some centimetres."""
    (tmp_path / "sled.xml").write_text(HOPPER)
    goal = f"{{ {x}hip = 0.1, ankle = -0.1 }}"
    (tmp_path / "p.toml").write_text(TABLE.format(start="{}", goal=goal, more='contacts = "file"'))
    file = load(tmp_path / "p.toml")
    end = tracking_of(file.problem.cost).x_ref[-1]
    asked = 0.001 if "001" in x else 0.0
    assert end[0] == pytest.approx(asked, abs=1e-12) if kept else abs(end[0]) > 0.04


def test_a_goal_that_settles_to_the_start_is_the_start(tmp_path):
    """Asked to stand 1 cm lower than it can: then to stay is the task, and not a motion of 1e-10 m."""
    file = loaded(tmp_path, "{ root = [0, 0, -0.95, 1, 0, 0, 0] }", "{ root = [0, 0, -0.96, 1, 0, 0, 0] }")
    np.testing.assert_array_equal(file.problem.cost.x_ref[-1], file.problem.x0)


@pytest.mark.parametrize(("more", "off"), [("", 0.0), ("settle = false", 0.3)])
def test_a_goal_table_with_a_whole_pose_is_put_down_as_a_plain_goal_is(tmp_path, more, off):
    pose = "[0, 0, -0.65, 1, 0, 0, 0, 0.1]"
    stands = loaded(tmp_path, goal=pose).problem.cost.x_ref[-1]
    task = loaded(tmp_path, goal=f"[{{ joints = {pose} }}]", more=more).problem
    errors = {one.name: static_error(one, stands) for one in task.goal_specs or ()}
    assert errors.pop("position of sled") == pytest.approx(off, abs=2.5e-3 if off else 2e-4)  # by the long ramp
    assert max(errors.values()) < 1e-4  # rad: the end of a plain goal also has feet that do not slip


def test_what_does_not_balance_is_put_down_as_it_is(tmp_path):
    """The mast is as heavy as the sled, and points far beyond its balls."""
    text = SLED.replace('pos="0 0 .2" mass=".5"', 'pos="0 0 2" mass="1.5"')
    (tmp_path / "sled.xml").write_text(text)
    (tmp_path / "p.toml").write_text(TABLE.format(start="{ mast = 1.5 }", goal="{ mast = 1.4 }", more=""))
    file = load(tmp_path / "p.toml")
    assert "start is put on the ground, where it does not balance by itself: the pose does not stay" in file.notes[1]
    x = file.problem.x0
    m = file.problem.dynamics.mechanism
    assert clearance(m, x) == pytest.approx(-m.contacts[0].law.rest_depth(3.0 * 9.81), abs=1e-6)  # on one ball
    np.testing.assert_allclose(x[3:7], [1, 0, 0, 0], atol=1e-12)
    (why,) = standing_goal(planner.Plan, file.problem, None)
    assert why.value is None
    assert "the pose does not stay on the ground: its centre" in why.sentence


@pytest.mark.slow
def test_a_plan_of_it_passes_and_is_stored(tmp_path):
    """In the user's file, whose ground is MuJoCo's own."""
    weights = "[weights]\neffort = 0.1\nposition = 1.0\nvelocity = 1.0\nfinal_position = 1e4"
    plan = planner.solve(loaded(tmp_path, more=weights).problem)
    proof = planner.prove(plan, rollouts=0)
    assert proof.passed, proof
    again = load_plan(plan.save(tmp_path / "plan.npz"))
    np.testing.assert_allclose(again.problem.x0, plan.problem.x0, atol=1e-10)
    np.testing.assert_allclose(again.problem.cost.x_ref[-1], plan.problem.cost.x_ref[-1], atol=1e-10)
    assert len(again.problem.dynamics.mechanism.contacts) == 4


@pytest.mark.slow
def test_who_tilts_what_balances_upright_gets_it_tilted(tmp_path):
    """A start of driven joints is put where the machine balances; one that is tilted on purpose is to be caught."""
    (tmp_path / "pole.xml").write_text(
        """<mujoco><worldbody><geom name="floor" type="plane" size="0 0 1"/><body name="trunk" pos="0 0 .63">
        <joint name="x" type="slide" axis="1 0 0"/><joint name="z" type="slide" axis="0 0 1"/>
        <joint name="tilt" axis="0 1 0"/><inertial pos="0 0 .1" mass="6" diaginertia=".2 .2 .2"/>
        <body name="leg"><joint name="hip" axis="0 1 0"/><geom size=".03" pos="0 0 -.6" mass="1"/></body></body>
        </worldbody><actuator><motor joint="hip"/></actuator></mujoco>"""
    )
    table = 'model = "pole.xml"\nduration = 0.5\ndt = 0.01\nstart = {}\ngoal = {}\n'
    for start, goal, tilts in (
        ("{ hip = 0.2 }", "{ hip = 0.1 }", None),
        ("{ hip = 0.2, tilt = -0.02 }", "{ hip = 0.1, tilt = -0.02 }", -0.02),
    ):
        (tmp_path / "p.toml").write_text(table.replace("start = {}", f"start = {start}").replace("{}", goal))
        file = load(tmp_path / "p.toml")
        for x in (file.problem.x0, file.problem.cost.x_ref[-1]):
            m = file.problem.dynamics.mechanism
            away = contact_forces(m, x[:4], np.zeros(4)).points[0, 0] - center_of_mass(m, x[:4])[0]
            assert x[2] == pytest.approx(-0.02, abs=5e-3) if tilts else abs(away) < 1e-8
            assert tilts is None or abs(away) > 5e-3
        assert any("does not balance by itself" in one for one in file.notes) == (tilts is not None)


SHIP = """<mujoco><worldbody><geom name="floor" type="plane" size="0 0 1"/><body name="ship" pos="0 0 2">
  <freejoint name="ship"/><inertial pos="0 0 .2" mass="9" diaginertia="1 1 1"/>
  <geom size=".1" pos=".5 .4 -.2" mass=".2"/><geom size=".1" pos="-.5 .4 -.2" mass=".2"/>
  <geom size=".1" pos=".5 -.4 -.2" mass=".2"/><geom size=".1" pos="-.5 -.4 -.2" mass=".2"/>
  <site name="main"/></body></worldbody><actuator><motor site="main" gear="0 0 1 0 0 0"/></actuator></mujoco>"""


def test_a_lander_stays_in_the_air_and_lands_on_the_ground(tmp_path):
    """Its engines carry it where it starts, 2 m above; where it is to land the ground does."""
    (tmp_path / "sled.xml").write_text(SHIP)
    goal = "{ ship = [0.5, 0, 0.304, 1, 0, 0, 0] }"
    (tmp_path / "p.toml").write_text(TABLE.format(start="{}", goal=goal, more=""))
    file = load(tmp_path / "p.toml")
    m = file.problem.dynamics.mechanism
    assert m.contacts_mode == "file"  # chosen by itself: its feet end 4 mm above the ground
    np.testing.assert_array_equal(file.problem.x0, m.home)
    assert "start is not put on the ground, since thrusters carry it in the air." in file.notes
    cost = tracking_of(file.problem.cost)
    x = cost.x_ref[-1]
    assert contact_forces(m, x[:7], np.zeros(6)).forces[:, 2].sum() == pytest.approx(9.0 * 9.81, rel=1e-6)
    assert x[0] == 0.5
    # no straight line down: it is there in the last quarter
    assert not cost.Q[:37, :6, :6].any()
    assert np.diagonal(cost.Q[38:, :6, :6], axis1=1, axis2=2).all()
    goal = "{ ship = [0.5, 0, 1.5, 1, 0, 0, 0] }"  # and in the air it is no machine that stands
    (tmp_path / "p.toml").write_text(TABLE.format(start="{}", goal=goal, more='contacts = "file"'))
    weights = load(tmp_path / "p.toml").problem.parameters["resolved"]["weights"]
    assert not np.any(weights["position"])
    assert np.all(weights["final_position"])
    (tmp_path / "p.toml").write_text(TABLE.format(start="{}", goal=goal, more=""))
    assert load(tmp_path / "p.toml").problem.dynamics.mechanism.contacts_mode == "avoid"


def test_what_thrusters_carry_over_the_ground_is_no_jump(tmp_path):
    """Legs could not push it there: it has none."""
    (tmp_path / "sled.xml").write_text(SHIP.replace('pos="0 0 2"', 'pos="0 0 0.3"'))
    goals = [f'[[goal]]\nframe = "ship"\nposition = {one}\n' for one in ("[0.5, 0, 1.0]\ntime = 0.3", "[1.0, 0, 0.3]")]
    (tmp_path / "p.toml").write_text('model = "sled.xml"\nduration = 0.5\nstart = {}\n' + "".join(goals))
    problem = load(tmp_path / "p.toml").problem
    assert problem.dynamics.mechanism.contacts_mode == "file"
    assert problem.goal_specs


def test_what_lies_on_the_ground_does_not_make_a_drone_land(tmp_path):
    """The goal is in the air; a box that nothing drives lies 2 m away."""
    box = '<body name="box" pos="2 0 0.1"><freejoint/><geom type="box" size=".1 .1 .1" mass="1"/></body></worldbody>'
    (tmp_path / "sled.xml").write_text(SHIP.replace("</worldbody>", box))
    (tmp_path / "p.toml").write_text(
        'model = "sled.xml"\nduration = 0.5\nstart = {}\n[[goal]]\nframe = "ship"\nposition = [0.5, 0, 1.5]\n'
    )
    problem = load(tmp_path / "p.toml").problem
    assert problem.dynamics.mechanism.contacts_mode == "avoid"
    np.testing.assert_array_equal(problem.x0, problem.dynamics.mechanism.home)
