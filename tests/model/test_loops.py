"""Closed chains as they are read, against MuJoCo's own rows; what stays refused."""

import numpy as np
import pytest

from planner import Mechanism, PlannerError
from planner.base.gl import load_mujoco
from planner.dynamics import assembled, loops

mujoco = load_mujoco()

BODIES = """
<mujoco><option jacobian="dense"/><worldbody>
  <body name="a" pos=".1 0 .2"><joint name="a1" axis="1 .2 0"/><joint name="a2" axis="0 1 .3"/>
    <geom size=".05"/><site name="s" pos=".2 .1 0" euler="20 10 0"/>
    <body name="b" pos=".3 0 0"><joint name="b1" type="ball"/><geom size=".05" pos=".1 0 0"/></body></body>
  <body name="c" pos="0 .4 .1"><freejoint name="free"/><geom size=".05"/><site name="t" pos="0 .1 .1" euler="0 40 5"/>
  </body>
</worldbody><equality>{}</equality></mujoco>
"""
EQUALITIES = {
    "by an anchor": '<connect body1="b" body2="c" anchor=".2 .1 0"/>',
    "to the world": '<connect body1="b" anchor=".2 .1 0"/>',
    "by sites": '<connect site1="s" site2="t"/>',
    "a weld": '<weld body1="b" body2="c" anchor="0 .1 0" relpose=".1 .2 0 .9 .1 .3 0"/>',
    "a weld as it stands": '<weld body1="b" body2="c"/>',
    "a weld of sites": '<weld site1="s" site2="t" torquescale=".7"/>',
    "a weld of places": '<weld body1="b" body2="c" anchor="0 .1 0" torquescale="0"/>',
}


@pytest.mark.parametrize("kind", EQUALITIES)
def test_rows_are_those_of_mujoco(kind):
    """Where the chain is closed the rows span the same space; near it what is missed is the same."""
    m, rng = Mechanism.from_mjcf(BODIES.format(EQUALITIES[kind])), np.random.default_rng(0)
    closed = assembled(m, m.space.integrate(m.home, 0.3 * rng.normal(size=m.space.ndx)))
    ours, theirs, _ = rows(m, closed)
    both = np.linalg.matrix_rank(np.vstack([ours, theirs]), tol=1e-8)
    assert both == np.linalg.matrix_rank(ours, tol=1e-8) == np.linalg.matrix_rank(theirs, tol=1e-8)
    near = m.space.integrate(closed, 1e-4 * rng.normal(size=m.space.ndx))
    _, theirs, missed = rows(m, near)
    own = loops.misses(m, near[: m.nq])
    np.testing.assert_allclose(own[:3], missed[:3], rtol=0.0, atol=1e-12)
    if m.loops[0].rigid:  # MuJoCo has torquescale times half of small angles, in other axes
        scale = 0.7 if kind == "a weld of sites" else 1.0
        assert np.linalg.norm(missed[3:]) / scale == pytest.approx(0.5 * np.linalg.norm(own[3:]), rel=1e-6)


def rows(m, x):
    """J of ours, MuJoCo's efc_J of equalities, and its efc_pos."""
    model = mujoco.MjModel.from_xml_string(m.mjcf)
    data = mujoco.MjData(model)
    data.qpos[:] = x[: m.nq]
    mujoco.mj_forward(model, data)
    of_equalities = data.efc_type == int(mujoco.mjtConstraint.mjCNSTR_EQUALITY)
    J = np.reshape(data.efc_J, (-1, model.nv))
    return loops.jacobian(m, x[: m.nq]), J[of_equalities], data.efc_pos[of_equalities]


def test_flexible_bodies_stay_refused():
    """A cable or cloth is no rigid body: one sentence says so."""
    flex = """<mujoco><worldbody><body name="arm"><joint name="arm" axis="0 1 0"/><geom size=".1"/></body>
    <flexcomp name="cloth" type="grid" count="3 3 1" spacing=".1 .1 .1" mass="1" dim="2" radius=".01" pos="0 0 1">
    <edge equality="true"/></flexcomp></worldbody></mujoco>"""
    with pytest.raises(PlannerError, match="flex"):
        Mechanism.from_mjcf(flex)
