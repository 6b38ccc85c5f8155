"""Points in place of cylinders, meshes and ellipsoids: where they are, what is missing, and that MuJoCo agrees."""

from dataclasses import replace

import numpy as np
import pytest
from trees import mujoco

import planner
from planner import Mechanism, Problem, RigidBodyDynamics, TrackingCost
from planner.model.mjcf import contact_shapes
from planner.model.mjcf.contact_shapes import MAX_POINTS, RADIUS, RIM, points_of, shape_of, sphere_of_directions
from planner.proof.compare.contact_parity import contact_parity
from planner.proof.replays.compiled_twin import CompiledTwin, unmodelled_of

SHAPES = {
    "cylinder": 'type="cylinder" size=".1 .05"',
    "ellipsoid": 'type="ellipsoid" size=".1 .06 .03"',
    "mesh": 'type="mesh" mesh="wedge"',
}
# A wedge whose origin is a corner: MuJoCo moves it to its centre of mass, and turns it to its principal axes.
WEDGE = '<asset><mesh name="wedge" vertex="0 0 0 .3 0 0 0 .2 0 .3 .2 0 0 0 .1 0 .2 .1"/></asset>'


def text(shape, more=""):
    return f"""<mujoco>{WEDGE}<worldbody><geom name="floor" type="plane" size="0 0 1"/>
      <body name="foot" pos="0 0 .3"><freejoint/>
        <frame pos=".1 0 0" euler="20 0 0"><geom name="shape" {SHAPES[shape]} mass="2" pos="0 .05 0" {more}/></frame>
        <body pos="0 0 .3"><joint name="hinge" axis="0 1 0"/><geom size=".02" pos=".2 0 0" contype="0" conaffinity="0"/>
        </body></body></worldbody><actuator><motor joint="hinge"/></actuator></mujoco>"""


def shortfall(model, geom):
    """How far the shape reaches beyond its points, in the direction where that is most, m."""
    directions = sphere_of_directions()
    kinds, size = mujoco.mjtGeom, model.geom_size[geom]
    if model.geom_type[geom] == int(kinds.mjGEOM_CYLINDER):
        reach = size[0] * np.hypot(directions[:, 0], directions[:, 1]) + size[1] * np.abs(directions[:, 2])
    else:
        reach = (contact_shapes._surface(model, geom) @ directions.T).max(axis=0)
    return float((reach - (points_of(model, geom) @ directions.T).max(axis=0)).max())


@pytest.mark.parametrize("shape", SHAPES)
def test_points_lie_on_the_shape_and_span_it(shape):
    model = mujoco.MjModel.from_xml_string(text(shape))
    points = points_of(model, model.geom("shape").id)
    if shape == "cylinder":
        assert len(points) == 2 * RIM
        np.testing.assert_allclose(np.hypot(points[:, 0], points[:, 1]), 0.1, rtol=1e-12)
        # an octagon in a circle, from between two corners: 1 - cos(pi / 8) of the radius, to the grid of directions
        assert shortfall(model, model.geom("shape").id) == pytest.approx(0.1 * (1.0 - np.cos(np.pi / 8)), rel=0.05)
    elif shape == "ellipsoid":
        assert len(points) == MAX_POINTS
        np.testing.assert_allclose(np.linalg.norm(points / (0.1, 0.06, 0.03), axis=1), 1.0, rtol=1e-12)
        assert 0.0 < shortfall(model, model.geom("shape").id) < 0.03
    else:
        assert len(points) == 6  # all the corners of a wedge
        assert shortfall(model, model.geom("shape").id) < 1e-9


@pytest.mark.parametrize("shape", SHAPES)
def test_the_plan_has_the_points_of_the_true_shape(shape):
    """The lowest point of the plan's machine is that of MuJoCo's shape, at poses all around."""
    m, model = Mechanism.from_mjcf(text(shape)), mujoco.MjModel.from_xml_string(text(shape))
    assert m.contacts_mode == "file"
    assert {shape_of(contact.name.split("'")[1]) for contact in m.contacts} == {"shape"}
    data, rng, missing = mujoco.MjData(model), np.random.default_rng(0), shortfall(model, model.geom("shape").id)
    for _ in range(20):
        q = np.concatenate([[0.0, 0.0, 1.0], rng.normal(size=4), [0.0]])
        q[3:7] /= np.linalg.norm(q[3:7])
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        true = mujoco.mj_geomDistance(model, data, model.geom("floor").id, model.geom("shape").id, 5.0, None)
        depths = planner.dynamics.contacts.contact_forces(m, q, np.zeros(m.nv)).depths
        # mj_geomDistance itself is exact to some 1e-6; directions are on a grid, so a little more may be missing
        assert true - RADIUS - 1e-5 <= -depths.max() <= true + 1.1 * missing + 1e-5


@pytest.mark.parametrize("shape", SHAPES)
def test_mujoco_computes_the_same_forces_and_nothing_is_left_out(shape):
    m = Mechanism.from_mjcf(text(shape, 'condim="6" margin=".002"'))
    dynamics = RigidBodyDynamics(m, 0.01)
    problem = Problem(dynamics, TrackingCost.joints(dynamics, m.home, 5, effort=1.0), m.home, twin=planner.Twin.of(m))
    assert unmodelled_of(problem).pairs == ()
    measured = {one.name: one for one in contact_parity(problem, CompiledTwin(problem.twin))}
    for name in ("contact_stiffness_error", "contact_surface_error", "friction_error", "contact_turning_error"):
        assert measured[name].value < 1e-6  # %: the same formula on both sides, to rounding over differences


@pytest.mark.parametrize("friction", ["spinning", "rolling"])
def test_another_torque_of_friction_is_seen(friction):
    m = Mechanism.from_mjcf(text("ellipsoid", 'condim="6"'))
    other = tuple(replace(c, law=replace(c.law, **{friction: 1.1 * getattr(c.law, friction)})) for c in m.contacts)
    dynamics = RigidBodyDynamics(replace(m, contacts=other), 0.01)
    problem = Problem(dynamics, TrackingCost.joints(dynamics, m.home, 5, effort=1.0), m.home, twin=planner.Twin.of(m))
    measured = {one.name: one for one in contact_parity(problem, CompiledTwin(problem.twin))}
    assert measured["contact_turning_error"].value > 5.0  # %, of a tenth more
