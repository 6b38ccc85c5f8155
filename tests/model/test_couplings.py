"""Equalities of joints, tendons and closed chains: how they are read, solved, hardened and closed; their ranges."""

import numpy as np
import pytest

from planner import Limits, Mechanism, ModelError, PlannerError, Problem, RigidBodyDynamics, TrackingCost, costs
from planner.base.gl import load_mujoco
from planner.cases.problem_file.states import state_of
from planner.dynamics import assembled, loops
from planner.model.couplings import Coupling, contradiction, narrowed, reduce
from planner.model.mjcf.model_file import open_model_file
from planner.problem.description import describe

mujoco = load_mujoco()

SLIDES = "abcd"
TEXT = """
<mujoco><option><flag contact="disable" {flag}/></option><worldbody>{bodies}</worldbody>
<tendon>{tendon}</tendon><equality>{equality}</equality><actuator>{motors}</actuator>{more}</mujoco>
"""


def text(equality, motors="a", refs=(0.0, 0.0, 0.0, 0.0), **parts):
    bodies = "".join(
        f'<body name="{name}"><joint name="{name}" type="slide" ref="{ref}"/><geom size=".1"/></body>'
        for name, ref in zip(SLIDES, refs, strict=True)
    )
    driven = "".join(f'<motor joint="{name}"/>' for name in motors)
    parts = {"flag": "", "tendon": "", "more": ""} | parts
    return TEXT.format(bodies=bodies, equality=equality, motors=driven, **parts)


def read(equality, **parts):
    return Mechanism.from_mjcf(text(equality, **parts))


def closes(m, dq):
    """q (nq,) on the couplings with these deviations of the independent coordinates from where the file puts them."""
    q = m.qpos0.copy()
    q[m.reduction.independent] += dq
    return m.reduction.closed(q, np.zeros(m.nv), m.q_address)[0]


def violation(m, q):
    """MuJoCo's own: the largest of its equality constraints at q."""
    model = mujoco.MjModel.from_xml_string(m.mjcf)
    data = mujoco.MjData(model)
    data.qpos = q
    mujoco.mj_forward(model, data)
    equalities = data.efc_type == int(mujoco.mjtConstraint.mjCNSTR_EQUALITY)
    assert equalities.sum() == len(m.couplings)
    return np.abs(data.efc_pos[equalities]).max()


TENDONS = """<fixed name="s"><joint joint="a" coef="2"/><joint joint="b" coef="-.5"/></fixed>
<fixed name="t"><joint joint="c" coef="1"/><joint joint="b" coef=".3"/></fixed>"""


@pytest.mark.parametrize(
    ("equality", "free"),
    [
        ('<joint joint1="b" joint2="a" polycoef=".1 -.7"/>', 3),
        ('<joint joint1="b" polycoef=".2"/>', 3),
        ('<joint joint1="b" polycoef=".2 5 5 5 5"/>', 3),  # without a second joint only the constant counts
        ('<joint joint1="b" joint2="a" polycoef=".3 0"/>', 3),
        ('<tendon tendon1="s" polycoef=".1"/>', 3),
        ('<tendon tendon1="s" tendon2="t" polycoef=".1 .8"/><joint joint1="d" joint2="c"/>', 2),
        ('<joint joint1="b" joint2="a"/><joint joint1="c" joint2="b"/><joint joint1="d" joint2="c"/>', 1),
    ],
)
def test_a_closed_state_is_one_to_mujoco(equality, free):
    """Its residuals, with references of the joints that are not 0, are ours; so are the signs and constants."""
    m = read(equality, tendon=TENDONS, refs=(0.1, -0.2, 0.3, 0.4))
    assert m.reduction.G.shape == (4, free)
    q = closes(m, np.random.default_rng(0).normal(size=free))
    assert violation(m, q) < 1e-14
    q[m.reduction.dependent[0]] += 0.01  # and what is not closed is seen
    assert violation(m, q) > 1e-3


def test_driven_joints_stay_independent():
    assert read('<joint joint1="b" joint2="a"/>', motors="a").reduction.dependent == [1]
    assert read('<joint joint1="b" joint2="a"/>', motors="b").reduction.dependent == [0]
    assert read('<joint joint1="b" joint2="a"/>', motors="c").reduction.dependent == [1]  # the follower, as written
    assert read('<joint joint1="b" joint2="a"/>', motors="ab").reduction.dependent == [1]


def test_a_redundant_equality_falls_out():
    ring = '<joint joint1="b" joint2="a"/><joint joint1="c" joint2="b"/><joint joint1="a" joint2="c"/>'
    m = read(ring)
    assert len(m.couplings) == 3
    np.testing.assert_array_equal(m.reduction.G, [[1, 0], [1, 0], [1, 0], [0, 1]])


def test_random_couplings_leave_the_null_space():
    """J G = 0 and rank G = nv - rank J, with redundant rows among them, to rounding of rows of size 1."""
    for seed in range(20):
        rng = np.random.default_rng(seed)
        nv, rank = 12, int(rng.integers(1, 8))
        J = rng.normal(size=(rank, nv)) * (rng.random((rank, nv)) < 0.4)
        J[np.arange(rank), rng.permutation(nv)[:rank]] += 1.0
        J = np.vstack([J, rng.normal(size=(2, rank)) @ J])
        c = J @ rng.normal(size=nv)
        found = reduce([_coupling(row, x) for row, x in zip(J, c, strict=True)], nv, rng.random(nv) < 0.3)
        assert found.G.shape[1] == nv - np.linalg.matrix_rank(J)
        size = np.abs(found.G).max()
        assert np.abs(J @ found.G).max() < 1e-11 * size
        q = found.closed(rng.normal(size=nv), np.zeros(nv), np.arange(nv))[0]
        np.testing.assert_allclose(J @ q, c, atol=1e-11 * size)


def _coupling(row, constant):
    dofs = np.flatnonzero(row)
    return Coupling("equality 'x'", tuple(map(int, dofs)), tuple(row[dofs]), float(constant))


@pytest.mark.parametrize(
    ("equality", "words"),
    [
        ('<joint joint1="a"/><joint name="x" joint1="a" polycoef=".2"/>', "equality 'x' contradicts .* by 0.2"),
        ("".join(f'<joint joint1="{name}"/>' for name in SLIDES), "lock every joint"),
    ],
)
def test_what_cannot_be_kept_is_one_sentence(equality, words):
    with pytest.raises(ModelError, match=words) as error:
        read(equality)
    assert "\n" not in str(error.value)


def test_what_does_not_act_couples_nothing():
    assert read('<joint joint1="b" joint2="a" active="false"/>').couplings == ()
    assert read('<joint joint1="b" joint2="a"/>', flag='equality="disable"').couplings == ()
    assert read('<joint joint1="b" joint2="a"/>', flag='constraint="disable"').couplings == ()


def test_what_is_ignored_takes_nothing_linear_along():
    mixed = text('<joint joint1="b" joint2="a"/><connect body1="c" anchor="0 0 0"/><joint joint1="d" joint2="a"/>')
    m = Mechanism.from_mjcf(mixed, ignore=("equality",))
    assert list(m.reduction.dependent) == [1, 3]
    assert m.ignored == ("equality number 1 (connect)",)
    model = mujoco.MjModel.from_xml_string(m.mjcf)
    assert list(model.eq_active0) == [1, 0, 1]


def test_the_replayed_text_is_hard_and_the_users_own_is_not():
    soft = text('<joint joint1="b" joint2="a" solref=".5 1"/>')
    m = Mechanism.from_mjcf(soft)
    assert 'solref=".5 1"' in m.original
    model = mujoco.MjModel.from_xml_string(m.mjcf)
    assert model.eq_solimp[0, 0] == 0.9999
    again = Mechanism.from_mjcf(m.mjcf)
    assert (again.mjcf, again.original) == (m.mjcf, "")  # a stored plan reads it as it was


TABLES = read(
    '<joint joint1="b" joint2="a" polycoef="0 .5"/><joint joint1="d" polycoef="0"/>',
    more='<keyframe><key name="near" qpos="1 .5002 0 0"/><key name="far" qpos="1 .6 0 0"/></keyframe>',
)


@pytest.mark.parametrize(
    ("value", "q"),
    [({"a": 1.0}, [1, 0.5, 0, 0]), ({"b": 1.0}, [2, 1, 0, 0]), ({"b": 1.0, "a": 2.0, "c": 3.0}, [2, 1, 3, 0]),
     ([1, 0.5, 3, 0], [1, 0.5, 3, 0]), ("near", [1, 0.5, 0, 0])],
)  # fmt: skip
def test_starts_close_what_they_do_not_name(value, q):
    np.testing.assert_array_equal(state_of("start", value, TABLES, TABLES.home)[:4], q)


@pytest.mark.parametrize(
    ("value", "words"),
    [
        ({"a": 1.0, "b": 1.0}, r"position 1 m of joint 'b', which follows joint 'a': expected 0.5, 0.5 m away"),
        ([1.0, 1.0, 0.0, 0.0], r"position 1 m of joint 'b', which follows joint 'a': expected 0.5"),
        ([1.0, 0.5, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0], r"velocity 0 m/s of joint 'b', .* expected 0.5"),
        ({"d": 0.1}, "position 0.1 m of joint 'd', which is locked: expected 0,"),
        ("far", "position 0.6 m of joint 'b'"),
    ],
)
def test_starts_that_break_a_coupling_are_told_the_value(value, words):
    with pytest.raises(PlannerError, match=words):
        state_of("start", value, TABLES, TABLES.home)


def test_a_problem_begins_on_its_couplings():
    dynamics = RigidBodyDynamics(TABLES, 0.01)
    x0 = np.array([1.0, 0.5 + 2e-6, *np.zeros(6)])
    cost = TrackingCost.joints(dynamics, TABLES.home, 5, effort=1.0)
    with pytest.raises(PlannerError, match=r"x0 has the position .* of joint 'b'"):
        Problem(dynamics, cost, x0)
    x0[1] = 0.5
    assert Problem(dynamics, cost, x0).N == 5


# Ranges that equalities leave of each other, and files that contradict themselves

TWO = """
<mujoco><compiler angle="radian"/><worldbody>
  <body><joint name="a" axis="0 1 0" range="{a}" limited="true"/><geom size=".1" pos=".2 0 0"/></body>
  <body pos="0 1 0"><joint name="b" axis="0 1 0" range="{b}" limited="true"/><geom size=".1" pos=".2 0 0"/></body>
</worldbody>
<equality><joint name="tie" joint1="a" joint2="b" polycoef="{c} {k} 0 0 0"/></equality>
<actuator><motor joint="b"/></actuator></mujoco>
"""


def two(a: str, b: str, c: float, k: float) -> str:
    return TWO.format(a=a, b=b, c=c, k=k)


def test_ranges_are_narrowed_to_what_the_other_joint_allows():
    machine = Mechanism.from_mjcf(two("-1 0.5", "0 2", 0.1, 0.5))
    left = narrowed(machine, machine.joint_range)[0]
    np.testing.assert_allclose(left, [[0.1, 0.5], [0.0, 0.8]], atol=1e-12)
    assert contradiction(machine, machine.joint_range) is None


def test_a_file_without_a_pose_is_refused_with_the_range_that_would_do():
    machine = Mechanism.from_mjcf(two("0 1", "0 1", 1.5, 0.5))
    dynamics = RigidBodyDynamics(machine, dt=0.01)
    start = np.array([1.5, 0.0, 0.0, 0.0])
    cost = costs.default_cost(dynamics, start, start, 10)
    with pytest.raises(PlannerError, match=r"equality 'tie' asks .* write range=\"1.5 2\" for joint 'a'"):
        Problem(dynamics, cost, start, limits=Limits.of_model())


def test_joints_that_are_held_at_one_place_are_told():
    known = describe(open_model_file(two("0 1", "0 1", 0.0, -1.0)))
    assert any("hold joint 'a', joint 'b' at one place" in one.problem for one in known.troubles)


# Closed chains

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
