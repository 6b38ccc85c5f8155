"""What a gait chooses (steps of its integrator, its cycles), and how its feet may be called."""

import math
import re

import numpy as np
import pytest
from test_walking_gaits import FEET, LEGS, SCENE, TURNED, WALKING, free, loaded, phases
from test_walking_gaits import straight as straight  # a fixture

import planner
from planner.problem.costs.tracking import tracking_of
from planner.problem.tasks.gait import STRIDE, TURNS, Gait, _holds, gait_of, with_feet_of
from planner.problem.tasks.legs import height_of, standing_feet


@pytest.mark.parametrize(
    ("gait", "stands"),
    [
        ("trot", True), ("walk", True), ({"kind": "pace", "duty": 0.5}, True), ({"kind": "trot", "duty": 0.4}, False),
        ({"feet": {"a": 0.0, "b": 0.4}}, True), ({"feet": {"a": 0.0, "b": 0.4}, "duty": 0.55}, False),
        ({"feet": {"a": 0.0, "b": 0.0}}, False),
        ([{"until": 0.5, "stand": ["a", "b"]}, {"stand": ["a"]}], True),
        ([{"until": 0.5, "stand": ["a", "b"]}, {"stand": []}], False),
    ],
)  # fmt: skip
def test_whether_a_foot_stands_at_all_times(gait, stands):
    assert gait_of(gait).always_stands is stands


def test_gaits_that_always_stand_take_leapfrog_steps(tmp_path):
    def steps(more):
        dynamics = loaded(tmp_path, WALKING + 'guess = "hold"\n' + more).dynamics
        return dynamics.integrator, dynamics.substeps

    assert steps('gait = "trot"\ndt = 0.005\n') == ("leapfrog", 3)
    assert steps('gait = { kind = "trot", duty = 0.45 }\n') == ("rk4", 6)  # it flies, and lands
    assert steps('gait = "trot"\nintegrator = "rk4"\n') == ("rk4", 6)
    assert steps('gait = "trot"\nsubsteps = 6\n') == ("rk4", 6)
    assert steps("") == ("rk4", 6)
    problem = loaded(tmp_path, WALKING + 'guess = "hold"\ngait = "trot"\n')
    assert (problem.dynamics.integrator, problem.dynamics.substeps) == ("leapfrog", 6)  # as many as by RK4
    back = planner.load_plan(planner.solve(problem, max_iterations=1).save(tmp_path / "plan.npz"))
    assert (back.problem.dynamics.integrator, back.problem.dynamics.substeps) == ("leapfrog", 6)


# m from the centre of mass: two rows of three feet, and two of two
SIX = np.array([[x, y, -0.1] for y in (0.15, -0.15) for x in (0.12, 0.0, -0.12)])
FOUR = SIX[[0, 2, 3, 5]]


@pytest.mark.parametrize(
    ("feet", "turns", "duty", "holds"),
    [
        (SIX, [0.0, 0.5, 0.0, 0.5, 0.0, 0.5], 0.6, True),  # two tripods
        (SIX, [0.0, 0.0, 0.0, 0.5, 0.5, 0.5], 0.6, False),  # one side after the other
        (SIX, [0.0, 1 / 6, 2 / 6, 3 / 6, 4 / 6, 5 / 6], 0.8, False),  # two at a time: three of four are on one side
        (SIX, [0.0, 2 / 6, 4 / 6, 3 / 6, 5 / 6, 1 / 6], 0.85, True),  # one at a time
        (SIX, [0.0, 1 / 6, 2 / 6, 5 / 6, 4 / 6, 3 / 6], 0.5, False),  # three neighbours at a time
        (FOUR, TURNS["trot"], 0.6, False),
        (FOUR, TURNS["walk"], 0.8, False),  # the centre of mass is on the edge of three feet
        (FOUR + np.array([0.3, 0.0, 0.0]), [0.0, 0.25, 0.5, 0.75], 0.8, False),  # behind all of them
    ],
)
def test_three_feet_around_the_centre_of_mass_hold_it(feet, turns, duty, holds):
    assert _holds(feet, np.array(turns), duty, np.array([0.0, 0.0, 1.0])) == holds


def test_a_machine_that_feet_hold_at_all_times_takes_as_few_cycles_as_its_way_needs(straight, monkeypatch):
    """0.4 m by half of the height of the centre of mass a cycle; else a cycle would last twice sqrt(h / g)."""
    mechanism, rows, dt = straight
    fall = Gait("trot").motion(mechanism, rows, dt, free(mechanism))[1]
    monkeypatch.setattr("planner.problem.tasks.gait._holds", lambda *_: True)
    held = Gait("trot").motion(mechanism, rows, dt, free(mechanism))[1]
    h = height_of(mechanism, rows[0], standing_feet(mechanism, rows[0]))
    assert int(held.split()[1]) == min(int(fall.split()[1]), math.ceil(0.4 / (STRIDE * h)))


@pytest.mark.parametrize("what", ["{}_foot", "{}_sole"])
def test_a_foot_may_be_called_as_its_shape_or_as_a_body_fixed_to_its_shank(what):
    """A foot is often a body of its own without a joint, which the planner takes with its shank."""
    text = planner.Mechanism.from_mjcf(SCENE).mjcf
    own, count = re.subn(r'<geom name="(\w+)_foot"[^>]*/>', r'<body name="\1_sole">\g<0></body>', text)
    assert count == 4
    mechanism = planner.Mechanism.from_mjcf(own)
    gait = gait_of(phases((0.5, [what.format(one) for one in FEET]), (None, [what.format(FEET[0])])))
    assert [phase.stand for phase in with_feet_of(gait, mechanism).phases] == [LEGS, LEGS[:1]]
    turns = gait_of({"feet": {what.format(FEET[0]): 0.5, LEGS[1]: 0.0}})
    assert with_feet_of(turns, mechanism).feet == {LEGS[0]: 0.5, LEGS[1]: 0.0}
    both = gait_of({"feet": {what.format(FEET[1]): 0.5, LEGS[1]: 0.0}})
    with pytest.raises(planner.PlannerError, match=f"turns of '{what.format(FEET[1])}' and '{LEGS[1]}'"):
        with_feet_of(both, mechanism)
    other = gait_of(phases((0.5, ["shoe"]), (None, [""])))
    assert with_feet_of(other, mechanism) == other  # to be refused


def test_a_file_calls_feet_as_their_shapes(tmp_path):
    text = TURNED.format(x=0.05, z=0.32, yaw=0.0).replace('gait = "trot"\n', "")
    references = []
    for names in (LEGS, [f"{one}_foot" for one in FEET]):
        lines = f"[[phase]]\nuntil = 0.5\nstand = {list(names)}\n[[phase]]\nstand = {list(names)[::3]}\n"
        problem = loaded(tmp_path, text.replace("[[goal]]", lines + "[[goal]]"))
        references.append(tracking_of(problem.cost).x_ref)
    np.testing.assert_array_equal(*references)
