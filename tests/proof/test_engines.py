"""Step 8: a plan in Pinocchio and in Drake. Without them a stand-in computes by our own dynamics."""

import json
import sys
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rolled_out_plans import LIMITED, acrobot, problem_of, rolled_out, tree_plan

import planner
from planner.__main__ import main
from planner.base.errors import PlannerError
from planner.dynamics import algorithms
from planner.model.mechanism import Mechanism
from planner.proof.engines import ENGINES, another_engine, drake, motion, pinocchio, section

INERTIAL = '<inertial pos="0.1 0.2 0.3" mass="1" diaginertia="0.1 0.12 0.13" quat="1 2 3 4"/>'
# Two machines; a body with two joints, all with what an engine may forget: ref, pos, armature, damping, springref.
ODD = f"""
<mujoco>
  <compiler angle="radian"/>
  <option gravity="1 2 -3"><flag contact="disable"/></option>
  <default><default class="c"><joint armature="0.4" damping="0.2"/></default></default>
  <worldbody><body pos="1 2 3" quat="1 1 0 0" childclass="c">
    <joint name="lift" ref="0.5" pos="0.1 0.2 0.3"/>
    <joint type="slide" axis="1 2 3" ref="0.3" springref="0.1" stiffness="3"/>
    {INERTIAL}
    <body pos="0.3 0.1 0.2" euler="0.1 0.2 0.3">
      <joint type="ball" pos="0.1 0.2 0.1" stiffness="2"/>
      {INERTIAL}
      <body pos="1 0 0"><geom type="capsule" fromto="0 0 0 1 0.1 0" size="0.1"/></body>
    </body>
  </body></worldbody>
  <worldbody><body>
    <joint type="free" armature="0.3" damping="0.1"/>
    <geom type="box" size="0.1 0.2 0.3" euler="0.3 0.2 0.1" density="300"/>
  </body></worldbody>
  <actuator><general joint="lift"/></actuator>
</mujoco>
"""


class StandIn:
    """Our own dynamics without springs, as another engine has them."""

    version = "0"

    def __init__(self, text, mechanism):
        self.mechanism = replace(
            mechanism, stiffness=0.0 * mechanism.stiffness, ball_stiffness=0.0 * mechanism.ball_stiffness,
            damping=0.0 * mechanism.damping,
        )  # fmt: skip
        self.lacks_damping, self.settings, self.factor = mechanism.damping, ["gravity"], 1.0

    def acceleration(self, q, v, tau):
        return self.factor * algorithms.forward_dynamics(self.mechanism, q, v, tau)


class Weightless(StandIn):
    def __init__(self, text, mechanism):
        super().__init__(text, replace(mechanism, gravity=np.zeros(3)))


class Massless(StandIn):
    def acceleration(self, q, v, tau):
        return 0.0 * v


class Wild(StandIn):
    def acceleration(self, q, v, tau):
        if not np.any(v):
            return super().acceleration(q, v, tau)
        return 1e6 * (1.0 + np.square(v))  # ends at infinity before the stage does


def stand_in(monkeypatch, kind=StandIn, name="pinocchio"):
    monkeypatch.setitem(section._KINDS, name, section._Kind(kind, lambda: None, "pin==4.0.0"))


@pytest.fixture(params=ENGINES)
def engine(request):
    pytest.importorskip({"drake": "pydrake"}.get(request.param, request.param))
    return request.param


def values(found):
    assert not found.not_applicable
    return {one.name: one.value for one in found.measured}


def odd_plan(N=3):
    machine, rng = Mechanism.from_mjcf(ODD), np.random.default_rng(1)
    x0 = machine.space.integrate(machine.home, rng.normal(scale=0.5, size=machine.space.ndx))
    return rolled_out(problem_of(machine, 0.01, N, x0=x0, us=rng.normal(size=(N, machine.nu))))


def swinging(N=40):
    """The acrobot from halfway up, its motor pushing."""
    machine = acrobot()
    us = np.sin(np.arange(N))[:, None]
    return rolled_out(problem_of(machine, 0.01, N, x0=np.array([0.3, -0.4, 0.0, 0.0]), us=us))


def lifting(N=40):
    """A plan of the acrobot that is optimal, and brief."""
    machine = acrobot()
    return planner.solve(problem_of(machine, 0.01, N, x0=np.array([0.3, -0.4, 0.0, 0.0])))


def agrees(found):
    """Rounding is 1e-16 of what accelerations are made of, and DOP853's tolerance 1e-10 a step."""
    measured = values(found)
    assert measured["acceleration_difference"] < 1e-12
    between = [value for name, value in measured.items() if name.endswith("between_engines")]
    assert between
    assert max(between) < 1e-8


# The engines themselves.


@pytest.mark.parametrize("make", [swinging, odd_plan, lambda: tree_plan("rk4", N=10)], ids=["acrobot", "odd", "tree"])
def test_another_engine_repeats_a_plan(engine, make):
    agrees(another_engine(make(), engine))


@pytest.mark.parametrize(
    ("before", "after"), [("0 0 -9.81", "0 0 -9.9081"), ('mass="0.5"', 'mass="0.525"')], ids=["gravity", "mass"]
)
def test_a_planted_fault_is_seen(engine, before, after):
    plan = swinging()
    text = plan.twin.mjcf.replace(before, after, 1)
    assert text != plan.twin.mjcf
    right = values(another_engine(plan, engine))
    wrong = values(another_engine(plan, engine, twin=replace(plan.twin, mjcf=text)))
    assert wrong["acceleration_difference"] > 1e-4
    assert wrong["open_loop_end_angle_error"] > 1e-3 > 1e3 * right["open_loop_end_angle_error"]


def test_a_frame_that_a_parser_passes_over_is_said(engine):
    text = ODD.replace("<worldbody><body>", '<worldbody><frame pos="1 0 0"><body>').replace(
        "  </body></worldbody>\n  <actuator>", "  </body></frame></worldbody>\n  <actuator>"
    )
    machine = Mechanism.from_mjcf(text)
    assert "<frame>" in another_engine(rolled_out(problem_of(machine, 0.01, 2)), engine).not_applicable


# What is common, by the stand-in.


@pytest.mark.parametrize("make", [swinging, odd_plan, lambda: tree_plan("rk4", N=10)], ids=["acrobot", "odd", "tree"])
def test_forces_that_are_added_are_those_of_the_plan(monkeypatch, make):
    stand_in(monkeypatch)
    agrees(another_engine(make(), "pinocchio"))


def test_what_is_added_and_changed_is_said(monkeypatch):
    stand_in(monkeypatch)
    notes = {one.name: one.note for one in another_engine(odd_plan(), "pinocchio").measured}
    added = notes["forces_and_numbers_added"]
    assert added == (
        "forces of the actuators actuator 0; springs of joint 1, joint 2; damping of lift, joint 1, joint 2, joint 3; "
        "gravity"
    )
    changes = notes["changes_of_the_text"]
    assert "2 worldbody sections are one" in changes
    assert "1 bodies with several joints" in changes
    assert "2 bodies in the world hang on one body" in changes


def test_gains_hold_a_machine_that_is_a_little_another_one(monkeypatch):
    stand_in(monkeypatch)
    plan = lifting()
    plan = replace(plan, twin=replace(plan.twin, mjcf=plan.twin.mjcf.replace("0 0 -9.81", "0 0 -9.9081")))
    measured = values(another_engine(plan, "pinocchio"))
    assert measured["feedback_end_angle_error"] < 0.9 * measured["open_loop_end_angle_error"]
    assert measured["feedback_path_angle_error"] >= measured["feedback_end_angle_error"]


def test_an_engine_without_gravity_is_refused(monkeypatch):
    stand_in(monkeypatch, Weightless)
    with pytest.raises(PlannerError, match=r"without gravity.*pip install pin==4\.0\.0"):
        another_engine(swinging(2), "pinocchio")


def test_a_parser_that_reads_no_mass_is_said(monkeypatch):
    stand_in(monkeypatch, Massless)  # Pinocchio, of a mesh
    assert "another inertia at shoulder, elbow" in another_engine(swinging(2), "pinocchio").not_applicable


def test_a_motion_that_runs_away_ends(monkeypatch):
    stand_in(monkeypatch, Wild)
    found = another_engine(swinging(3), "pinocchio")
    assert values(found)["open_loop_end_angle_error"] == np.inf
    assert any("ran away" in one.note for one in found.measured)


def test_machines_that_are_not_smooth_are_not_applicable(monkeypatch):
    stand_in(monkeypatch)
    hopper = another_engine(planner.solve(planner.cases.hopper()), "pinocchio")
    assert "not those of a mechanism" in hopper.not_applicable
    touching = LIMITED.replace('<flag contact="disable"/>', "").replace(
        "<worldbody>", '<worldbody><geom type="plane" size="0 0 1" pos="0 0 -9"/>'
    )
    machine = Mechanism.from_mjcf(touching.replace('contype="0" conaffinity="0"', ""), contacts="off")
    plan = rolled_out(problem_of(machine, 0.01, 2))
    assert not another_engine(plan, "pinocchio").not_applicable  # its contacts are taken out of its text
    again = another_engine(plan, "pinocchio", twin=replace(plan.twin, mjcf=machine.original))
    assert "law of contact" in again.not_applicable


def test_no_file_outside_of_the_folder_is_written_or_read(monkeypatch, tmp_path):
    stand_in(monkeypatch)
    plan = swinging(2)
    mesh = '<asset><mesh name="m" file="../m.obj" vertex="0 0 0 1 0 0 0 1 0 0 0 1"/></asset>'
    text = plan.twin.mjcf.replace("<worldbody>", f"{mesh}<worldbody>", 1)
    from planner.proof.engines.motion import prepared

    with pytest.raises(planner.ModelError, match="does not hold"):
        prepared(replace(plan.twin, mjcf=text), section.CompiledTwin(plan.twin).model, tmp_path)
    assert list(tmp_path.parent.glob("*.obj")) == []


def test_controls_are_held_over_a_stage_and_the_motion_is_exact():
    """x'' = u: at the knots x is a sum of parabolas, whatever the integrator."""
    machine = Mechanism.from_mjcf(
        '<mujoco><option gravity="0 0 0"/><worldbody><body><joint name="s" type="slide" axis="1 0 0"/>'
        '<geom size="0.1" mass="1"/></body></worldbody><actuator><motor joint="s"/></actuator></mujoco>'
    )
    us = np.array([[1.0], [-2.0], [3.0]])
    plan = rolled_out(problem_of(machine, 0.1, 3, us=us))
    rates = lambda x, u: np.array([x[1], u[0]])  # noqa: E731
    xs = motion.motion(plan, machine, np.zeros(2), rates, feedback=False)
    speeds = np.cumsum(np.r_[0.0, 0.1 * us[:, 0]])
    np.testing.assert_allclose(xs[:: motion.PARTS, 1], speeds, atol=1e-12)
    places = np.cumsum(np.r_[0.0, 0.1 * speeds[:-1] + 0.005 * us[:, 0]])
    np.testing.assert_allclose(xs[:: motion.PARTS, 0], places, atol=1e-12)


# The command.


@pytest.mark.parametrize(("name", "module", "needs"), [
    ("pinocchio", "pinocchio", pinocchio.NEEDS), ("drake", "pydrake", drake.NEEDS)
])  # fmt: skip
def test_a_missing_engine_is_one_sentence_that_names_the_command(monkeypatch, tmp_path, capsys, name, module, needs):
    monkeypatch.setitem(sys.modules, module, None)
    for part in ("multibody.plant", "multibody.parsing", "multibody", "math"):
        monkeypatch.setitem(sys.modules, f"pydrake.{part}", None)
    path = swinging(2).save(tmp_path / "plan.npz")
    assert main(["prove", str(path), "--engine", name, "--rollouts", "0"]) == 2
    err = capsys.readouterr().err
    assert f"{name} is not installed" in err
    assert f"pip install {needs}." in err
    assert err.count("\n") == 1


def test_another_package_of_that_name_is_not_the_engine(monkeypatch):
    monkeypatch.setitem(sys.modules, "pinocchio", json)  # on PyPI `pinocchio` is a plugin of nose
    with pytest.raises(PlannerError, match="no parser of MJCF"):
        section.require("pinocchio")


def test_extras_name_the_releases_that_the_sentence_names():
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text(encoding="utf-8"))
    extras = project["project"]["optional-dependencies"]
    assert {name: " ".join(extras[name]) for name in ENGINES} == {"pinocchio": pinocchio.NEEDS, "drake": drake.NEEDS}
    assert set(section._KINDS) == set(ENGINES)


def test_the_command_appends_engines_and_leaves_the_verdict(monkeypatch, tmp_path, capsys):
    stand_in(monkeypatch)
    stand_in(monkeypatch, Wild, "drake")
    plan = lifting(5)
    path = replace(plan, problem=replace(plan.problem, tolerance="soft")).save(tmp_path / "plan.npz")
    out = tmp_path / "proof.json"
    flags = ["--engine", "pinocchio", "--engine", "drake", "--rollouts", "0", "--out", str(out)]
    assert main(["prove", str(path), *flags]) == 0
    proof = json.loads(out.read_text())
    assert proof["verdict"] == "PASS"
    assert list(proof["engines"]) == ["pinocchio", "drake"]
    assert proof["engines"]["pinocchio"]["figures"]["acceleration_difference"]["value"] < 1e-12
    assert proof["engines"]["drake"]["figures"]["open_loop_end_angle_error"]["value"] is None  # infinite
    printed = capsys.readouterr().out
    assert "pinocchio, forces and numbers added: forces of the actuators elbow; gravity" in printed
    assert main(["prove", str(path), "--engine", "drake", "--replay-rollout", "0"]) == 2
