"""Another ground: what is changed of a model's contacts, and what of a plan's replay is shown."""

import re

import numpy as np
import pytest
from contact_machines import leg, standing
from rolled_out_plans import acrobot, problem_of, rolled_out

import planner
from planner.model.mechanism import Mechanism
from planner.proof import contact_sensitivity as sensitivity
from planner.proof.compare.contact_parity import contact_parity
from planner.proof.contact_sensitivity import GROUNDS, PLAN, contact_sensitivity, contact_variants
from planner.proof.replays.compiled_twin import CompiledTwin, with_model
from planner.proof.replays.replaying import replay_in
from planner.proof.robustness.rollouts import MODES


@pytest.fixture(scope="module")
def landing():
    """A leg that falls on its foot while it slides, 0.2 s without torque."""
    m = Mechanism.from_mjcf(leg(1000.0, ramp=2e-3))
    return rolled_out(problem_of(m, 0.005, 40, x0=standing(m), us=np.zeros((40, 2))))


@pytest.fixture(scope="module")
def runs(landing):
    return {mode: replay_in(CompiledTwin(landing.twin), landing, feedback=mode == "feedback") for mode in MODES}


@pytest.fixture(scope="module")
def table(landing, runs):
    return list(contact_variants(landing, CompiledTwin(landing.twin), runs))


def row(table, ground, mode="open-loop"):
    return next(one for one in table if (one.ground, one.mode) == (ground, mode))


def test_every_ground_has_a_row_for_each_mode(table):
    assert {(one.ground, one.mode) for one in table} == {(g, mode) for g in (PLAN, *GROUNDS) for mode in MODES}
    for one in table:
        assert set(one.end) == set(one.path) == {"rad", "m", "rad/s", "m/s"}
        assert all(one.end[unit] <= one.path[unit] for unit in one.end)
        assert one.peak_force > 0.0


def test_another_ground_makes_another_motion(table):
    """The plan's own contact is followed to its smoothing; a surface twice as stiff pushes harder."""
    own = row(table, PLAN)
    for ground in GROUNDS:
        assert row(table, ground).path["rad"] > own.path["rad"], ground
    assert row(table, "half stiffness").peak_force < own.peak_force < row(table, "double stiffness").peak_force
    assert own.feet < row(table, "half friction").feet


def test_it_is_shown_and_not_judged(landing, runs, table, monkeypatch):
    monkeypatch.setattr(sensitivity, "contact_variants", lambda *_: table)
    section = contact_sensitivity(landing, CompiledTwin(landing.twin), runs)
    assert section.title == "contact sensitivity"
    assert section.passed
    assert {one.bound for one in section.measured} == {None}
    units = {one.name: one.unit for one in section.measured}
    assert len(units) == len(section.measured)
    assert units["default_contact_end_angle_error_feedback"] == "rad"
    assert units["double_friction_path_distance_error_open_loop"] == "m"
    assert units["half_damping_feet_error_open_loop"] == "m"
    assert units["planned_contact_peak_force_feedback"] == "N"


COEFFICIENTS = {
    "stiffness": "contact_stiffness_error",
    "damping": "contact_damping_error",
    "friction": "friction_error",
}


@pytest.mark.parametrize("ramp", [None, 2e-3])
@pytest.mark.parametrize("ground", [name for name in GROUNDS if "default" not in name])
def test_one_coefficient_is_changed_and_no_other(ground, ramp):
    """Measured by MuJoCo's own forces; a surface is where the force begins, and so a matter of stiffness."""
    m = Mechanism.from_mjcf(leg(1000.0, ramp=ramp))
    own = problem_of(m, 0.005, 5, x0=standing(m))
    compiled = CompiledTwin(own.twin)
    before = compiled.model.pair_solref.copy()
    measured = {one.name: one for one in contact_parity(own, compiled.changed(GROUNDS[ground]))}
    how, which = ground.split()
    assert measured.pop(COEFFICIENTS[which]).value == pytest.approx({"half": 50.0, "double": 100.0}[how])
    assert all(one.value < 0.1 for one in measured.values())
    np.testing.assert_array_equal(compiled.model.pair_solref, before)
    assert compiled.changed(GROUNDS[ground]).twin is own.twin


def test_a_time_constant_is_scaled_as_a_stiffness_and_a_damping():
    """Of a model with MuJoCo's usual format: K = 1 / (d t r)^2 and B = 2 / (d t)."""
    m = Mechanism.from_mjcf(leg(1000.0))
    compiled = CompiledTwin(problem_of(m, 0.005, 5, x0=standing(m)).twin).changed(GROUNDS["default contact"])

    def coefficients(model):
        t, r = model.pair_solref[0]
        return np.array([1.0 / (t * r) ** 2, 2.0 / t])

    own = coefficients(compiled.model)
    for ground, factors in (("half stiffness", (0.5, 1.0)), ("double damping", (1.0, 2.0))):
        np.testing.assert_allclose(coefficients(compiled.changed(GROUNDS[ground]).model), own * factors, rtol=1e-12)


def test_default_contact_is_that_of_a_plain_file(landing):
    """To the last bit, of a file in which nothing is said of contacts."""
    text = re.sub(r'(<pair geom1="floor" geom2="foot")[^/]*/>', r"\1/>", landing.twin.mjcf)
    text = re.sub(r' (cone|impratio)="[^"]*"', "", text)
    text = re.sub(r'<flag refsafe="disable" ?/>', "", text)
    assert not re.search("solref|cone|impratio|refsafe", text)
    compiled = CompiledTwin(landing.twin)
    ours = replay_in(compiled.changed(GROUNDS["default contact"]), landing)
    theirs = replay_in(CompiledTwin(with_model(landing.twin, text)), landing)
    assert theirs.contact_force.max() > 0.0
    np.testing.assert_array_equal(ours.xs, theirs.xs)
    np.testing.assert_array_equal(ours.contact_force, theirs.contact_force)


def test_given_replays_and_another_way_to_replay(landing, runs):
    """Runs that there are already are not run again; gains at another rate are a `replay` of the caller's."""
    compiled, asked = CompiledTwin(landing.twin), []

    def counted(changed, plan, *, feedback):
        asked.append((changed is compiled, feedback))
        return replay_in(changed, plan, feedback=feedback, substeps=20)

    contact_sensitivity(landing, compiled, runs, counted)
    assert len(asked) == 2 * len(GROUNDS)
    assert not any(own for own, _ in asked)


def test_nothing_touches():
    plan = rolled_out(problem_of(acrobot(), 0.02, 10))
    assert contact_sensitivity(plan, CompiledTwin(plan.twin)).not_applicable == "nothing touches"


def test_a_light_foot_does_not_stand_on_default_contact():
    plan = planner.solve(planner.cases.hopper(height=5.0, duration=0.3))
    section = contact_sensitivity(plan, CompiledTwin(plan.twin))
    assert section.not_applicable.startswith("foot, which touches, has 0.001 % of the mass that it carries")
    assert section.measured == ()


def test_a_motion_that_runs_away_is_infinitely_wrong(landing, runs, monkeypatch):
    def explosive(model):
        model.pair_solref[:] = -1e14, 0.0

    monkeypatch.setattr("planner.proof.contact_sensitivity.GROUNDS", {"default contact": explosive})
    one = row(contact_variants(landing, CompiledTwin(landing.twin), runs), "default contact")
    assert one.end["rad"] == np.inf
    assert one.feet == np.inf
    assert any("unstable" in sentence for sentence in one.warnings)
