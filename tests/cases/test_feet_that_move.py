"""Machines that have to leave or move their feet: a monopod that goes forward, jumps, and says that it skates."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import planner
from planner.base.errors import PlannerError
from planner.cases.problem_file import load
from planner.dynamics.contacts import contact_forces
from planner.dynamics.statics import STRIDE, contact_stiffness, feet_move
from planner.problem.costs.frame import CLEARANCE, SlipCost
from planner.problem.costs.tracking import tracking_of
from planner.problem.default_weights import GAIN_SHARE, MOVING_SHARE, SLIP_SPEED, STANCE_TOLERANCES, WAY_SHARE
from planner.problem.reaching_cost import with_slip
from planner.proof import diagnostics
from planner.proof.diagnostics import suggested_fixes
from planner.proof.diagnostics.avoid_contact import avoid_contact
from planner.proof.diagnostics.suggested_fix import fix
from planner.proof.skating import foot_penetration, skating
from planner.solvers.options import SolverOptions
from planner.solvers.relaxation import relax

MONOPOD = """<mujoco model="monopod"><option timestep="0.002"/>
<worldbody><geom name="floor" type="plane" size="0 0 1"/>
 <body name="trunk" pos="0 0 0.6"><joint name="x" type="slide" axis="1 0 0"/><joint name="z" type="slide" axis="0 0 1"/>
  <geom type="box" size=".12 .1 .08" mass="5" contype="0" conaffinity="0"/>
  <body name="thigh"><joint name="hip" axis="0 -1 0" range="-60 60" damping=".2"/>
   <geom type="capsule" fromto="0 0 0 0 0 -.25" size=".03" mass=".8" contype="0" conaffinity="0"/>
   <body name="shank"><joint name="leg" type="slide" axis="0 0 1" range="-.05 .3" damping="2"/>
    <geom type="capsule" fromto="0 0 -.25 0 0 -.55" size=".02" mass=".3" contype="0" conaffinity="0"/>
    <geom name="foot" type="sphere" pos="0 0 -.57" size=".03" mass=".1"/></body></body></body></worldbody>
<actuator><motor joint="hip" ctrlrange="-60 60"/><motor joint="leg" ctrlrange="-300 300"/></actuator></mujoco>"""
START = 'model = "monopod.xml"\nstart = { leg = 0.15 }\n'


def problem_of(tmp_path, text):
    (tmp_path / "monopod.xml").write_text(MONOPOD)
    (tmp_path / "problem.toml").write_text(START + text)
    return load(tmp_path / "problem.toml").problem


def weights_of(problem):
    return problem.parameters["resolved"]["weights"]


@pytest.fixture(scope="module")
def forward(tmp_path_factory):
    return problem_of(tmp_path_factory.mktemp("forward"), "goal = { x = 0.5 }\nduration = 1.5\n")


def test_a_monopod_goes_forward_with_four_lines(forward):
    plan = planner.solve(forward)
    assert plan.converged
    assert plan.nit < 100  # it takes 46 or 61: where it ends along the kinks of landing depends on rounding
    proof = planner.prove(plan, rollouts=0)
    assert proof.passed, proof
    assert "slides" not in proof.headline


def test_a_machine_that_stands_keeps_its_balance_at_a_goal_of_its_trunk(tmp_path):
    """A frame's goal alone weighs nothing that keeps a machine upright; the poses through its goals do."""
    problem = problem_of(tmp_path, 'duration = 1.0\n[[goal]]\nframe = "trunk"\nposition = [0, 0, 0.41]\n')
    weights, cost = weights_of(problem), tracking_of(problem.cost)
    assert weights["hold"] > 0.0
    assert "rest" not in weights
    assert min(weights["position"]) > 0.0
    first = problem.N - round((1.0 - MOVING_SHARE) * problem.N)
    np.testing.assert_allclose(cost.x_ref[first:], np.tile(cost.x_ref[-1], (problem.N + 1 - first, 1)), atol=1e-9)
    assert planner.solve(problem).converged


@pytest.mark.slow
def test_a_foot_that_is_dragged_with_little_load_is_named(forward):
    """Without a cost of slip nothing but friction keeps the foot from being dragged."""
    dragged = planner.solve(forward.recipe.rebuilt(weights={"slip": 0.0}, resolved=None))
    assert "foot' slides 0." in planner.prove(dragged, rollouts=0).headline


SMALL = (
    MONOPOD.replace("0 0 0.6", "0 0 0.2").replace("-.25", "-.08").replace("-.55", "-.15").replace("-.57", "-.16")
    .replace('size=".12 .1 .08"', 'size=".04 .03 .03"')
)  # fmt: skip


def phrases(model, moves, dt=0.01):
    """What is said of a machine that stands at first and then moves by (dx, dz), m, in turn, in stages of 0.01 m."""
    mechanism = planner.Mechanism.from_mjcf(model, contacts="ground")
    states = [planner.dynamics.static_equilibrium(mechanism, mechanism.home)]
    for move in moves:
        stages = max(1, round(np.linalg.norm(move) / 0.01))
        for _ in range(stages):
            state = states[-1].copy()
            state[:2] += np.array(move) / stages
            state[mechanism.velocities][:2] = np.array(move) / (stages * dt)
            states.append(state)
    problem = SimpleNamespace(dynamics=planner.RigidBodyDynamics(mechanism, dt=dt))
    return skating(SimpleNamespace(xs=np.array(states)), problem)


def test_slip_is_named_by_the_size_of_the_machine():
    """3 cm: of a centre of mass 0.6 m above the ground less than 5 cm, of one at 0.2 m more than a tenth of it."""
    assert phrases(MONOPOD, [(0.03, 0.0)]) == ()
    assert phrases(SMALL, [(0.01, 0.0)]) == ()
    assert "slides 0.03 m while it goes 0.03 m" in phrases(SMALL, [(0.03, 0.0)])[0]


def test_slip_is_beside_the_way_of_the_foot():
    """A machine that bounces in place gets nowhere by that; one that steps does, by its steps and not by its swings."""
    up, down, step, back = (0.0, 0.4), (0.0, -0.4), (0.4, 0.0), (-0.3, 0.0)
    assert "slides 0.1 m while it goes 0.1 m" in phrases(MONOPOD, [(0.1, 0.0), up, down])[0]
    assert phrases(MONOPOD, [(0.1, 0.0), up, step, down]) == ()
    assert "slides 0.1 m while it goes 0.2 m" in phrases(MONOPOD, [(0.1, 0.0), up, step, back, down])[0]


def test_a_foot_that_sinks_by_more_than_half_of_its_radius_is_named(forward):
    """Of 3 cm: a soft floor gives, and the film shows it."""
    down = forward.x0.copy()
    depth = planner.dynamics.contact_forces(forward.dynamics.mechanism, down[:4], np.zeros(4)).depths[0]
    assert foot_penetration(SimpleNamespace(xs=down[None]), forward) == ()
    down[1] -= 0.014 - depth
    assert foot_penetration(SimpleNamespace(xs=down[None]), forward) == ()
    down[1] -= 0.002
    (said,) = foot_penetration(SimpleNamespace(xs=down[None]), forward)
    assert said.startswith("geom 'foot' sinks 0.016 m into the ground, with a radius of 0.03 m: ")
    assert said.endswith("`solref` lacks a time constant 1.1 times shorter")  # 0.016 m of the 0.015 m that pass


def test_its_foot_is_lifted(forward):
    """The cost of slip is that of speeds along the ground below the clearance, which the test sums by itself."""
    terms = forward.cost.costs
    slip = terms[-1]
    assert isinstance(slip, SlipCost)
    assert weights_of(forward)["slip"] == SLIP_SPEED**-2
    q, v = forward.x0[:4].copy(), np.array([0.3, 0.0, 0.0, 0.0])
    still = planner.dynamics.contact_forces(forward.dynamics.mechanism, q, 0.0 * v).depths[0]
    for height, share in ((0.0, 1.0), (0.5, 0.5), (1.0, 0.0)):  # in clearances; 3 t^2 - 2 t^3 of t = 1/2 is 1/2
        q[1] = forward.x0[1] + still + height * CLEARANCE
        xs = np.tile(np.concatenate([q, v]), (forward.N + 1, 1))
        expected = 0.5 * forward.duration * (share * 0.3 / SLIP_SPEED) ** 2
        assert slip.value(xs, np.zeros((forward.N, 2))) == pytest.approx(expected, rel=1e-2, abs=1e-9)


def test_slip_is_of_the_bodies_that_bear_load(forward):
    """A trunk that may touch the ground, too, is none while a foot stands; in the air every contact is one."""
    mechanism = forward.dynamics.mechanism
    trunk = replace(mechanism.contacts[0], link=2, centre=np.zeros(3), name="trunk")
    dynamics = planner.RigidBodyDynamics(
        replace(mechanism, contacts=(*mechanism.contacts, trunk)), forward.dynamics.dt, forward.dynamics.integrator,
        substeps=forward.dynamics.substeps,
    )  # fmt: skip
    foot, air = len(mechanism.contacts), forward.x0.copy()
    air[1] += 1.0
    for xs, expected in (((forward.x0, air), foot), ((air, forward.x0), foot), ((air, air), foot + 1)):
        slip = with_slip(forward.cost, dynamics, 400.0, np.array(xs)).costs[-1]
        assert isinstance(slip, SlipCost)
        assert len(slip.residual_arrays.kind) == expected


def test_its_weights_leave_the_way_open_and_ask_for_the_goal_in_the_last_quarter(forward):
    cost, N, nv = tracking_of(forward.cost), forward.N, 4
    first = N - round((1.0 - MOVING_SHARE) * N)
    assert weights_of(forward)["rest"] == 1.0 - MOVING_SHARE
    assert not cost.Q[:first, :nv].any()
    assert np.all(np.diagonal(cost.Q[first:N, :nv, :nv], axis1=1, axis2=2) > 0.0)
    speeds = np.diagonal(cost.Q[:, nv:, nv:], axis1=1, axis2=2)
    np.testing.assert_allclose(speeds[0], WAY_SHARE * speeds[first])


def test_what_no_solve_moves_is_shaken_harder_and_no_weight_is_advised(forward):
    """Its contacts bear a small push; what a strong one moves is kept, and where none does that is said."""
    still = planner.solve(forward, SolverOptions(homotopy=False), max_iterations=1)
    xs = np.tile(forward.x0, (forward.N + 1, 1))
    still = replace(still, status=planner.Status.CONVERGED, xs=xs, cost=100.0)
    near = xs + np.linspace(0.0, 0.3, forward.N + 1)[:, None] * np.eye(forward.dynamics.nx)[0]
    for moved_by in (1, 2, 3):  # the number of the solve that moves
        calls = []

        def solve_one(*_, calls=calls, moved_by=moved_by):
            calls.append(0)
            return replace(still, xs=near, cost=50.0) if len(calls) == moved_by else still

        plan, record = relax(forward, still, solve_one, SolverOptions(), None)
        assert [step[0] for step in record["steps"]].count("shaken") == moved_by
        assert np.array_equal(plan.xs, near)
    (said,) = suggested_fixes(still)
    assert (said.code, said.value) == ("not_moved", None)
    assert "not_moved" not in [one.code for one in suggested_fixes(replace(still, xs=near))]


def test_its_gains_stay_below_the_stiffness_of_its_ground(forward):
    """sqrt(Q / R), the stationary stiffness of a position weight Q and an effort R, is a share of the ground's."""
    m = forward.dynamics.mechanism
    ground = contact_stiffness(m, tracking_of(forward.cost).x_ref[-1][: m.nq])[2:]
    assert ground[1] == pytest.approx(m.contacts[0].law.stiffness)  # the leg presses straight on it
    gains = np.sqrt(np.array(weights_of(forward)["position"])[2:] / np.array(weights_of(forward)["effort"]))
    assert np.all(gains <= GAIN_SHARE * ground * (1.0 + 1e-12))
    assert gains[1] == pytest.approx(GAIN_SHARE * ground[1])  # the hip's are lower, by what its range asks for


@pytest.mark.parametrize("beside", [0.0, 1e-3])
def test_a_joint_whose_axis_goes_through_its_contact_has_its_own_effort(tmp_path, beside):
    """Such a contact bears no torque of it, to rounding or to the millimetre: no gain is too large for the ground.

    What it is charged is what corrects an error of a foot of so little inertia: 0.0137 N m, and no 1e-5 or 1e-28.
    """
    slide = '<joint name="leg" type="slide" axis="0 0 1" range="-.05 .3" damping="2"/>'
    spin = f'<joint name="spin" axis="0 0 1" pos="{beside} 0 0" range="-60 60" damping="2"/>'
    motor = '<motor joint="spin" ctrlrange="-60 60"/></actuator>'
    (tmp_path / "monopod.xml").write_text(MONOPOD.replace(slide, slide + spin).replace("</actuator>", motor))
    (tmp_path / "problem.toml").write_text(START + "goal = { x = 0.5 }\nduration = 1.5\n")
    problem = load(tmp_path / "problem.toml").problem
    m = problem.dynamics.mechanism
    assert contact_stiffness(m, tracking_of(problem.cost).x_ref[-1][: m.nq])[4] == 0.0
    assert weights_of(problem)["effort"][2] < 0.01**-2


def test_a_machine_whose_feet_stay_has_the_straight_line(tmp_path):
    problem = problem_of(tmp_path, "goal = { leg = 0.1 }\nduration = 1.0\n")
    assert "rest" not in weights_of(problem)
    assert problem.cost.Q[0, 3, 3] == pytest.approx(problem.dynamics.dt / (STANCE_TOLERANCES * 5e-3) ** 2)


def test_feet_move_by_slip_or_by_height(forward):
    m, q = forward.dynamics.mechanism, forward.x0[:4]
    forwards, up, off = STRIDE * np.eye(4)[0], STRIDE * np.eye(4)[1], np.eye(4)[1]
    assert not feet_move(m, np.array([q, q + 0.5 * forwards]))
    assert feet_move(m, np.array([q, q + 1.1 * forwards]))
    assert not feet_move(m, np.array([q, q + 0.5 * up]))
    assert feet_move(m, np.array([q, q + 1.1 * up, q]))
    assert not feet_move(m, np.array([q + off, q + off + np.eye(4)[0]]))  # in the air there are none
    assert feet_move(m, np.array([q + off, q]))  # it lands


JUMP = """duration = 1.4
substeps = 7
[[goal]]
frame = "trunk"
position = [0, 0, 0.75]
time = 0.6
through = {through}
[[goal]]
joints = {{ x = 0.0, hip = 0.0, leg = 0.15 }}
"""


@pytest.mark.slow
def test_a_jump_needs_no_pose_of_the_whole_machine(tmp_path):
    """The trunk is passed 10 cm above where the leg reaches from the ground; at the end the foot stands again."""
    problem = problem_of(tmp_path, JUMP.format(through="true"))
    m, end = problem.dynamics.mechanism, problem.cost.costs[0].x_ref[-1]
    carried = contact_forces(m, end[:4], np.zeros(4)).forces[0, 2]
    assert carried == pytest.approx(6.2 * 9.81, rel=1e-3)  # kg, m/s^2
    plan = planner.solve(problem)
    assert plan.converged
    depths = contact_forces(m, plan.xs[:, :4], plan.xs[:, 4:]).depths[:, 0]
    assert np.count_nonzero(depths < 0.0) * problem.dynamics.dt > 0.2  # s, in the air
    assert planner.prove(plan, rollouts=0).passed


def test_a_stop_in_the_air_is_refused(tmp_path):
    with pytest.raises(PlannerError, match=r"goal 1 \(trunk at 0.6 s\) is out of reach by 0\.\d+ m"):
        problem_of(tmp_path, JUMP.format(through="false"))


def test_a_place_where_the_foot_must_stand_elsewhere_is_no_refusal(tmp_path):
    problem = problem_of(tmp_path, 'duration = 1.5\n[[goal]]\nframe = "trunk"\nposition = [0.8, 0, 0.44]\n')
    end = tracking_of(problem.cost).x_ref[-1]
    assert end[0] == pytest.approx(0.8, abs=5e-3)
    assert abs(end[3] - 0.15) < 0.02  # the leg's length hardly changes: the foot is elsewhere


HIGHER = """duration = {duration}
[[goal]]
frame = "trunk"
position = [0, 0, {height}]
time = {time}
through = true
[[goal]]
joints = {{ x = 0.0, hip = 0.0, leg = 0.15 }}
"""


@pytest.mark.parametrize(
    ("height", "time", "duration", "fragments"),
    [
        # The leg reaches 0.65 m (0.05 m of slide beyond the straight one at 0.6 m), less the margin and contact. From
        # there 9.81 0.2 (1.4 - 0.2) / 2 = 1.18 m, and sqrt(8 1.36 / 9.81) = 1.05 s.
        (2.0, 0.2, 1.4, ("1.36 m higher", "allows 1.18 m at 0.2 s", "again at 1.4 s", "after 1.1 s or more")),
        # 300 N over 0.35 m and 60 N m over 120 degrees, less margins of 1 % at both ends, are 226 J for 6.2 kg:
        # 8.54 m/s, or 3.7 m. Up to 5.35 m above its reach takes sqrt(2 9.81 5.35) = 10.24 m/s.
        (6.0, 1.5, 3.0, ("leaves the ground at 10.2 m/s", "gives 8.54 m/s at most", "at most 3.7 m above")),
        # In 0.1 s to 1.35 m: 1.35 / 0.1 + 9.81 0.1 / 2 m/s.
        (2.0, 0.1, 30.0, ("leaves the ground at 14 m/s",)),
    ],
)
def test_a_jump_that_cannot_be_is_refused(tmp_path, height, time, duration, fragments):
    with pytest.raises(PlannerError) as error:
        problem_of(tmp_path, HIGHER.format(height=height, time=time, duration=duration))
    for fragment in fragments:
        assert fragment in str(error.value)


def test_a_high_jump_is_not_refused(tmp_path):
    """2.3 of the 2.35 m that gravity allows at 0.6 s of 1.4 s, at 6.7 m/s of the 8.6 m/s above."""
    assert problem_of(tmp_path, HIGHER.format(height=2.94, time=0.6, duration=1.4)).goal_specs


def found_first(plan, problem, proof):
    return [fix(problem, "avoid", {}, "path_collides", pair="two")]


def test_a_jump_that_no_solve_finds_says_how_high_the_plan_gets(tmp_path, monkeypatch):
    """The leg reaches 0.65 m, less the margin of its range: what is lower needs no jump."""
    options, held = planner.SolverOptions(max_iterations=3, homotopy=False), 'guess = "hold"\n' + HIGHER
    plan = planner.solve(problem_of(tmp_path, held.format(height=2.0, time=0.6, duration=1.4)), options)
    (found,) = suggested_fixes(plan)
    assert (found.code, found.value) == ("jump_not_found", None)
    at = {name: one.value for name, one in found.values.items() if name in ("asked", "reached", "standing")}
    assert at["asked"] == 2.0
    assert at["reached"] == pytest.approx(0.6 + plan.xs[60, 1])  # m, of the trunk above its slide z at 0.6 s
    assert at["standing"] == pytest.approx(0.64, abs=0.01)
    assert "gets to" in found.sentence
    assert found.values["advice"] == "`starts = 8` or a start that crouches"
    causes = tuple(found_first if one is avoid_contact else one for one in diagnostics._CAUSES)
    monkeypatch.setattr(diagnostics, "_CAUSES", causes)
    assert [one.code for one in suggested_fixes(plan)] == ["jump_not_found"]  # what it touches is no cause
    cut = replace(plan, status=planner.Status.WORK_LIMIT)
    cut.options["work"] = 1.0
    jump = next(one for one in suggested_fixes(cut) if one.code == "jump_not_found")
    assert jump.values["advice"].endswith("or more `work`")
    upper = plan.problem.bounds.at(slice(None), plan.xs[:-1])[1]
    (weak,) = suggested_fixes(replace(plan, us=upper))
    assert weak.values["advice"].endswith("or stronger actuators")
    plan = planner.solve(problem_of(tmp_path, held.format(height=0.6, time=0.6, duration=1.4)), options)
    assert "jump_not_found" not in [one.code for one in suggested_fixes(plan)]
