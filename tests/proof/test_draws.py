"""Step 5 of a proof: what is varied, and how a draw changes MuJoCo's model."""

from dataclasses import replace

import numpy as np
import pytest

from planner.base.errors import PlannerError
from planner.base.gl import load_mujoco
from planner.model.mjcf.model_index import compile_model
from planner.proof.robustness.perturbation import Nominal, Perturbation, SampleShape, draw, draw_masses

NONE = Perturbation(**dict.fromkeys(Perturbation().to_dict(), 0.0))


@pytest.mark.parametrize(
    ("name", "value"), [("mass", -0.1), ("inertia", 1.0), ("start", np.nan), ("delay", -1e-3), ("noise", "much")]
)
def test_perturbations_are_checked(name, value):
    with pytest.raises(PlannerError, match=f"Perturbation: {name} is"):
        Perturbation(**{name: value})


def test_nothing_is_called_nothing():
    assert str(NONE) == "nothing"
    assert "mass 5 %" in str(Perturbation())


def test_switching_one_kind_off_leaves_the_others(arm):
    sizes = Nominal.of(compile_model(arm.twin.mjcf), arm, arm.twin).sizes
    all_, fewer = (draw(p, 0, 7, sizes) for p in (Perturbation(), Perturbation(inertia=0.0, friction=0.0)))
    for name, value in vars(fewer).items():
        if name not in ("inertia", "friction"):
            np.testing.assert_array_equal(value, getattr(all_, name))
    np.testing.assert_array_equal(fewer.inertia, 1.0)


def test_a_draw_changes_masses_and_friction_of_the_model(arm):
    model = compile_model(arm.twin.mjcf)
    nominal = Nominal.of(model, arm, arm.twin)
    before = model.body_mass.copy()
    errors = draw(Perturbation(), 0, 0, nominal.sizes)
    other = nominal.with_errors(errors, load_mujoco().MjData(model))
    np.testing.assert_array_equal(model.body_mass, before)
    moves = model.body_weldid != 0
    np.testing.assert_allclose(other.body_mass[moves], (before * errors.mass)[moves])
    np.testing.assert_array_equal(other.body_mass[~moves], before[~moves])
    ratio = other.body_inertia[moves] / model.body_inertia[moves]  # as a whole: still a body's
    np.testing.assert_allclose(ratio, np.broadcast_to(ratio[:, :1], ratio.shape))
    np.testing.assert_allclose(other.dof_damping, model.dof_damping * errors.damping + errors.drag * model.dof_M0)
    assert np.all(other.dof_frictionloss > 0.0)
    assert not np.allclose(other.dof_M0, model.dof_M0)  # mj_setConst has seen the masses
    signs = draw_masses(0.2, 0, 3, 1, nominal.sizes).mass
    np.testing.assert_allclose(np.abs(signs - 1.0), 0.2)


@pytest.mark.parametrize("turn", ["", ' euler="90 0 0"'], ids=["of the world", "of a turned body at rest"])
def test_a_floor_is_higher_where_mujoco_finds_contacts(turn):
    """A plane at the origin is one whose place MuJoCo does not read, unless it is told to."""
    mujoco = load_mujoco()
    upright = ' euler="-90 0 0"' if turn else ""
    floor = f'<body{turn}><geom type="plane" size="0 0 1"{upright}/></body>'
    model = compile_model(
        f'<mujoco><worldbody>{floor}<body pos="0 0 0.09"><joint type="slide" axis="0 0 1"/>'
        '<geom size="0.1"/></body></worldbody></mujoco>'
    )
    nominal = Nominal(model, np.zeros(1), np.zeros(0), SampleShape(model.nbody, 1, 2, 1, 0, 1))
    errors = draw(replace(NONE, floor=0.005), 0, 0, nominal.sizes)
    data = mujoco.MjData(model)
    mujoco.mj_forward(nominal.with_errors(errors, data), data)
    assert 0.0 < abs(errors.floor) <= 0.005
    assert data.contact.dist[0] == pytest.approx(-0.01 - errors.floor, abs=1e-12)  # m: 0.09 less the radius


def test_free_joints_have_no_bearings(tree):
    model = compile_model(tree.twin.mjcf)
    nominal = Nominal.of(model, tree, tree.twin)
    errors = draw(Perturbation(damping=0.0, drag=1.0, friction=1.0), 0, 0, nominal.sizes)
    other = nominal.with_errors(errors, load_mujoco().MjData(model))
    free = model.jnt_type[model.dof_jntid] == load_mujoco().mjtJoint.mjJNT_FREE
    assert free.any()
    np.testing.assert_array_equal(other.dof_frictionloss[free], model.dof_frictionloss[free])
    assert np.all(other.dof_damping[~free] > model.dof_damping[~free])
