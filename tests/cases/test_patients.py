"""The human step for other people, and for people who are not as planned: parity, forces, Monte Carlo, bad input."""

from dataclasses import replace

import numpy as np
import pytest
from walks import CYCLE, SWING

import planner
from planner.__main__ import main
from planner.cases import human_step
from planner.cases.human_step.gait import ANGLES, NORMAL_GAIT, basis
from planner.cases.human_step.measures import CLEAR, FOLLOWS, PATIENT, follows, measures, robot_wrench
from planner.cases.human_step.walker import Walker
from planner.model.mjcf.text import edited, written
from planner.proof.compare.model_parity import parity
from planner.proof.replays.compiled_twin import CompiledTwin
from planner.proof.replays.replaying import replay
from planner.proof.robustness.perturbation import Perturbation, SampleShape, draw
from planner.proof.robustness.perturbed import MonteCarloSettings, perturbed

NOTHING = dict.fromkeys(Perturbation().to_dict(), 0.0)


@pytest.fixture(scope="module")
def swing():
    return planner.solve(human_step(phase="swing"))


@pytest.fixture(scope="module")
def cycle():
    return planner.solve(human_step())


# parity


@pytest.mark.parametrize("body", [(45.0, 1.5), (110.0, 1.95)], ids=str)
@pytest.mark.parametrize("pelvis", ["motion", "force"])
@pytest.mark.parametrize("phase", ["swing", "cycle"])
def test_anybody_is_the_same_in_mujoco(phase, pelvis, body):
    """At random states hinges of hip and pelvis come to lie along each other, and then accelerations are rounding."""
    mass, height = body
    found = parity(human_step(phase=phase, pelvis=pelvis, mass=mass, height=height), seed=1)
    assert found.passed, found.failures


@pytest.mark.parametrize("pelvis", ["motion", "force"])
def test_a_wrong_foot_is_seen_beside_the_belt(pelvis):
    """One part in a million of 1 kg, where the belt has 1e8 kg."""
    problem = human_step(pelvis=pelvis)
    heavier = written(1.015 * (1.0 + 1e-6))
    text = edited(problem.twin.mjcf, {".//body[@name='right_foot']/inertial": {"mass": heavier}})
    found = parity(problem, twin=replace(problem.twin, mjcf=text))
    assert "mass_matrix_error" in [figure.name for figure in found.failures]


# other patients than the one planned for


def test_legs_of_another_mass():
    one, other = Walker(), Walker(leg_mass=1.1)
    for name, segment in one.segments.items():
        share = 1.0 if name == "pelvis" else 1.1
        np.testing.assert_allclose(other.segments[name].mass, share * segment.mass)
        np.testing.assert_allclose(other.segments[name].inertia, share * np.array(segment.inertia))


@pytest.mark.slow
def test_three_cycles_with_a_stiffer_patient():
    """Section 7 of the study, its cost: 0.4 deg with gains; springs 20 % stiffer 1.3."""
    plan = planner.solve(human_step(cycles=3, cost="study"))
    for patient, most in (({}, 0.4), ({"stiffness": 1.2}, 1.3)):
        twin = human_step(cycles=3, cost="study", **patient).twin
        section = plan.problem.requirements.tracking(replay(plan, twin=twin, feedback=True, substeps=5))
        assert section.measured[0].name == "joint_error"
        assert section.measured[0].value < most, patient


def test_a_patient_is_drawn_as_a_whole():
    """One factor for all bodies, one for all springs; whatever else is drawn stays as it was."""
    sizes = SampleShape(nbody=5, nv=4, ndx=8, N=3, nu=2, njnt=4)
    bare = draw(Perturbation(), 0, 7, sizes)
    both = draw(Perturbation(common_mass=0.1, common_stiffness=0.2), 0, 7, sizes)
    for name in vars(bare):
        if name not in ("mass", "stiffness"):
            np.testing.assert_array_equal(getattr(both, name), getattr(bare, name))
    heavier, stiffer = both.mass / bare.mass, both.stiffness / bare.stiffness
    np.testing.assert_allclose([np.ptp(heavier), np.ptp(stiffer)], 0.0, atol=1e-14)
    factors = np.array([
        [d.mass[0], d.stiffness[0]]
        for d in (draw(Perturbation(**NOTHING | {"common_mass": 0.1, "common_stiffness": 0.2}), 0, k, sizes)
                  for k in range(500))
    ])  # fmt: skip
    np.testing.assert_allclose(factors.min(axis=0), [0.9, 0.8], atol=0.005)
    np.testing.assert_allclose(factors.max(axis=0), [1.1, 1.2], atol=0.005)
    assert abs(np.corrcoef(factors.T)[0, 1]) < 0.2
    with pytest.raises(planner.PlannerError, match=r"common_mass is 1\.0, expected"):
        Perturbation(common_mass=1.0)


def test_a_walk_counts_when_it_stays_near_the_gait(cycle):
    """Near the plan all the way, and no foot on the belt in the middle of a swing."""
    knots = np.arange(CYCLE.N + 1)
    knee, lifted = cycle.xs.copy(), cycle.xs.copy()
    legs = slice(7, 17)
    knee[:, legs] += np.radians(1.01 * FOLLOWS)
    lifted[:, 3] -= 1.01 * max(measures(CYCLE, cycle.xs).clearance.values())
    near = cycle.xs.copy()
    near[:, legs] += np.radians(0.3)
    xs = np.stack([cycle.xs, near, knee, lifted])
    np.testing.assert_array_equal(follows(CYCLE, xs, cycle.xs, knots, clear=True), [True, True, False, False])
    np.testing.assert_array_equal(follows(CYCLE, xs, cycle.xs, knots, clear=False), [True, True, False, True])
    some = knots[::5]
    found = follows(CYCLE, xs[:, some], cycle.xs[some], some, clear=True)
    np.testing.assert_array_equal(found, [True, True, False, False])


def test_monte_carlo_over_patients(swing):
    """What it varies is a patient's; who is far stiffer than planned does not walk as planned without gains."""
    usual = Perturbation.usual(swing.problem)
    assert {name: getattr(usual, name) for name in PATIENT} == PATIENT
    assert usual.mass == Perturbation().mass
    assert Perturbation.usual(swing.problem, common_mass=0.3).common_mass == 0.3
    text = swing.twin.mjcf.replace('timestep="0.0005"', 'timestep="0.001"')
    coarse = CompiledTwin(replace(swing.twin, mjcf=text))
    found = perturbed(swing, coarse, MonteCarloSettings(8), threads=1)
    assert found.perturbation == usual
    assert np.isnan(found.tolerance)
    assert found.rates["feedback"].value == 1.0
    assert found.margin["feedback"] >= 0.1
    stiff = perturbed(
        swing, coarse, MonteCarloSettings(8, perturbation=Perturbation(**NOTHING | {"stiffness": 0.99})), threads=1
    )
    assert stiff.rates["open-loop"].value < 1.0


# forces as controls, and effort


@pytest.mark.parametrize("phase", ["swing", pytest.param("cycle", marks=pytest.mark.slow)])
def test_forces_are_proved(phase):
    plan = planner.solve(human_step(phase=phase, pelvis="force"))
    assert plan.success
    assert plan.nit <= 60
    proof = planner.prove(plan, rollouts=0)
    assert proof.passed, proof.table()
    step = SWING if phase == "swing" else CYCLE
    step = replace(step, walker=replace(step.walker, motors=True))
    assert min(measures(step, plan.xs).clearance.values()) > CLEAR
    found = robot_wrench(plan.problem.dynamics, plan.xs, plan.us)
    np.testing.assert_allclose(found, plan.us, atol=1e-6)  # what drives the pelvis is what was asked for


@pytest.mark.parametrize("pelvis", ["motion", "force"])
def test_effort_makes_a_gentler_robot(swing, pelvis):
    usual = swing if pelvis == "motion" else planner.solve(human_step(phase="swing", pelvis=pelvis))
    gentle = planner.solve(human_step(phase="swing", pelvis=pelvis, effort=10.0))
    assert gentle.success
    offset = usual.problem.cost.costs[0].u_ref  # the weight, which a robot that carries it must hold

    def rms(plan):
        return np.sqrt(np.mean((plan.us - offset) ** 2, axis=0))

    assert np.linalg.norm(rms(gentle) / rms(usual)) < 0.7 * np.sqrt(6.0)
    assert gentle.parameters["effort"] == 10.0


def test_knees_do_not_buckle_in_the_replay():
    """Without the wish for feet not too deep in the belt: 1.3 deg with gains, since a blow bends the knee anyhow."""
    plan = planner.solve(human_step(brace="ankle"))
    section = plan.problem.requirements.tracking(replay(plan, substeps=5))
    assert plan.success
    assert section.measured[0].value < 0.5


# what a user may type


@pytest.fixture(scope="module")
def gaits(tmp_path_factory):
    """Files of gaits: whole, and with what may be wrong."""
    folder = tmp_path_factory.mktemp("gaits")
    percent = np.linspace(0.0, 100.0, 51)
    columns = {name: basis(percent / 100.0)[0] @ np.array(getattr(NORMAL_GAIT, name)) for name in ANGLES}
    columns = {"percent": percent, **columns}

    def write(name, table):
        rows = np.column_stack(list(table.values()))
        text = "\n".join([",".join(table), *(",".join(f"{value:.6f}" for value in row) for row in rows)])
        (folder / name).write_text(text, encoding="utf-8")

    write("whole.csv", columns)
    write("no-knee.csv", {name: values for name, values in columns.items() if name != "knee"})
    write("no-time.csv", {name: values for name, values in columns.items() if name != "percent"})
    write("nan.csv", columns | {"ankle": np.where(percent == 50.0, np.nan, columns["ankle"])})
    write("half.csv", {name: values[:26] for name, values in columns.items()})
    (folder / "empty.csv").write_text("")
    (folder / "binary.csv").write_bytes(bytes(range(256)))
    return folder


def test_a_gait_of_ones_own(gaits):
    problem = human_step(phase="swing", reference=str(gaits / "whole.csv"))
    np.testing.assert_allclose(problem.x0, human_step(phase="swing").x0, atol=1e-4)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("--phase hop", "'hop'"),
        ("--mass -3", "mass is -3.0"),
        ("--mass nan", "mass is nan"),
        ("--mass heavy", "'heavy' is not a number"),
        ("--mass 400", "mass is 400.0, expected a finite number of at least 20 and at most 300"),
        ("--height 17.5", "height is 17.5"),
        ("--mass 45 --height 2.4", "body mass index"),
        ("--leg-mass 0", "leg_mass is 0.0"),
        ("--cadence 0", "cadence is 0.0"),
        ("--cadence inf", "cadence is inf"),
        ("--cadence 1000", "cadence is 1000.0"),
        ("--stiffness -1", "stiffness is -1.0"),
        ("--stiffness 1e9", "stiffness is 1000000000.0"),
        ("--damping nan", "damping is nan"),
        ("--effort 0", "effort is 0.0"),
        ("--brace knee", "'knee'"),
        ("--cost cheap", "'cheap'"),
        ("--cycles 0", "cycles is 0"),
        ("--cycles 2.5", "'2.5' is not a whole number"),
        ("--cycles 1000", "cycles is 1000"),
        ("--phase swing --cycles 3", "cycles is 3, expected 1"),
        ("--clearance -0.01", "clearance is -0.01"),
        ("--apart 3", "apart is 3.0"),
        ("--pelvis free", "'free'"),
        ("--horizon 10", "horizon is 10, expected at least 60"),
        ("--integrator verlet", "'verlet'"),
        ("--reference none.csv", "none.csv"),
        ("--reference no-knee.csv", "no column knee"),
        ("--reference no-time.csv", "no column percent or time"),
        ("--reference nan.csv", "something else in row 26 of ankle"),
        ("--reference half.csv", "goes from 0 to 50 percent"),
        ("--reference empty.csv", "is empty"),
        ("--reference binary.csv", "not text"),
        ("--objective energy", "prescribed"),
        ("--weight 70", "has no flag '--weight'"),
    ],
)
def test_one_sentence_and_exit_2(gaits, monkeypatch, capsys, words, said):
    monkeypatch.chdir(gaits)
    assert main(["run", "human-step", *words.split()]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    lines = err.strip().splitlines()
    assert len(lines) == 1
    assert lines[0].startswith("planner: ")
    assert said in lines[0]
    assert not (gaits / "renders").exists()


def test_a_file_may_name_a_case(gaits, monkeypatch, capsys):
    """Its parameters are those of the command line."""
    monkeypatch.chdir(gaits)
    text = 'case = "human-step"\nphase = "swing"\nmass = 100\nheight = 1.9\ncadence = 80\n'
    (gaits / "person.toml").write_text(text)
    assert main(["solve", "person.toml", "--out", "person.npz", "--quiet"]) == 0
    flags = "--phase swing --mass 100 --height 1.9 --cadence 80"
    assert main(["solve", "human-step", *flags.split(), "--out", "flags.npz", "--quiet"]) == 0
    one, other = (planner.load_plan(gaits / name) for name in ("person.npz", "flags.npz"))
    assert one.parameters == other.parameters
    np.testing.assert_array_equal(one.us, other.us)
    for more, said in (
        ("weight = 3", "human-step has no parameter 'weight'"),
        ('model = "a.xml"', "both a case and a model"),
        ("mass = 5", "not TOML"),  # twice
        ("cycles = 2.5", "cycles is 2.5"),
        ('stiffness = "high"', "stiffness is 'high'"),
    ):
        (gaits / "wrong.toml").write_text(f"{text}{more}\n")
        assert main(["solve", "wrong.toml"]) == 2
        assert said in capsys.readouterr().err
    (gaits / "wrong.toml").write_text('case = "walk"')
    assert main(["solve", "wrong.toml"]) == 2
    assert "case is 'walk', expected one of" in capsys.readouterr().err
