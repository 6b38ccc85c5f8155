"""A URDF is read as MuJoCo's own reader reads its numbers, with what that reader drops."""

import mujoco
import numpy as np
import pytest
from urdfs import ARM, BALL, UNCLEAR, inertial, joint, link, robot, shape

from planner import Mechanism, PlannerError
from planner.dynamics import bias, mass_matrix
from planner.model.mjcf.model_index import compile_model, contact_pairs
from planner.model.mjcf.read import read
from planner.model.urdf.parse import robot_of
from planner.model.urdf.shapes import packages_of
from planner.model.urdf.write import mjcf_of

RNG = np.random.default_rng(16)


def text_of(urdf, **options):
    return mjcf_of(robot_of(urdf, "the model"), packages_of(None, (), ""), "the model", **options)[0]


def compiled(urdf, **options):
    return compile_model(text_of(urdf, **options))


def of_mujoco(urdf):
    """MuJoCo's own reading, an independent one: it makes bodies and joints without MJCF."""
    unmerged = '<mujoco><compiler fusestatic="false"/></mujoco></robot>'
    return mujoco.MjModel.from_xml_string(urdf.replace("</robot>", unmerged))


def test_mass_matrix_and_bias_are_those_of_mujocos_reader():
    """Up to rounding: both have the same numbers, ours by way of MJCF with all digits."""
    ours, theirs = Mechanism.from_urdf(ARM), of_mujoco(ARM)
    data = mujoco.MjData(theirs)
    assert ours.joint_names == ("shoulder", "elbow", "slide")
    for _ in range(5):
        data.qpos[:], data.qvel[:] = RNG.uniform(-1, 1, 3), RNG.uniform(-1, 1, 3)
        mujoco.mj_forward(theirs, data)
        M = np.empty((3, 3))
        for i in range(3):
            mujoco.mj_mulM(theirs, data, M[i], np.eye(3)[i])
        h = data.qfrc_bias + theirs.dof_damping * data.qvel
        np.testing.assert_allclose(mass_matrix(ours, data.qpos), M, rtol=0, atol=1e-12)
        np.testing.assert_allclose(bias(ours, data.qpos, data.qvel), h, rtol=0, atol=1e-11)


def test_a_free_base_keeps_its_inertia():
    """What MuJoCo's reader drops: compare with the sum of all links by the file's numbers."""
    fixed, free = Mechanism.from_urdf(ARM), Mechanism.from_urdf(ARM, base="free")
    assert (fixed.nv, free.nv) == (3, 9)
    assert free.joint_names[0] == "floating_base"
    assert free.mass.sum() == pytest.approx(7.5, rel=1e-14)  # 3 + 2 + 1.5 + 0.7 + 0.3 kg
    assert fixed.mass.sum() == pytest.approx(4.5, rel=1e-14)
    six = np.array([[0.02, 0.001, -0.002], [0.001, 0.03, 0.003], [-0.002, 0.003, 0.04]])
    root = free.joint("floating_base").stop - 1
    np.testing.assert_allclose(free.inertia[root], six, atol=1e-15)
    np.testing.assert_allclose(free.com[root], [0.0, 0.0, 0.1], atol=1e-15)


def test_a_robot_has_its_own_name_or_that_of_its_root():
    arm = robot(link("base"), link("arm", inertial()), joint("turn", "base", "arm", "revolute"))
    start = arm[arm.index("<robot") : arm.index(">", arm.index("<robot"))]
    named, nameless = (arm.replace(start, words, 1) for words in ('<robot name="picker"', "<robot"))
    assert 'model="picker"' in text_of(named)
    assert 'model="base"' in text_of(nameless)


def test_the_base_is_what_the_file_or_the_user_says():
    floating = robot(
        link("world"), link("map"), link("body", inertial()),
        joint("place", "world", "map", "fixed", xyz="1 0 0", rpy="0 0 1.5707963267948966", more=""),
        joint("free", "map", "body", "floating", xyz="0 2 0", more=""),
    )  # fmt: skip
    for base, nq in ((None, 7), ("free", 7)):
        model = compiled(floating, base=base)
        assert model.nq == nq
        np.testing.assert_allclose(model.qpos0[:3], [-1.0, 0.0, 0.0], atol=1e-15)  # a quarter turn takes y to -x
    with pytest.raises(PlannerError, match="no joints that move"):
        compiled(floating, base="fixed")
    welded = robot(link("world"), link("body", inertial()), joint("weld", "world", "body", "fixed", more=""))
    assert compiled(welded, base="free").nq == 7  # what hangs on "world" floats, not the world
    with pytest.raises(PlannerError, match='no joints that move, expected at least one: base = "free"'):
        compiled(welded)
    with pytest.raises(PlannerError, match="base is 'loose', expected one of: fixed, free"):
        Mechanism.from_urdf(ARM, base="loose")


def test_fixed_links_stay_frames():
    ours, theirs = Mechanism.from_urdf(ARM), of_mujoco(ARM)
    tool, slider = ours.frame("tool"), ours.frame("slider")
    assert tool.link == slider.link
    data = mujoco.MjData(theirs)
    mujoco.mj_kinematics(theirs, data)
    R = data.body("slider").xmat.reshape(3, 3)
    between = R.T @ (data.body("tool").xpos - data.body("slider").xpos)
    np.testing.assert_allclose(tool.T[:3, 3] - slider.T[:3, 3], between, atol=1e-14)
    np.testing.assert_allclose(between, [0.0, 0.02, 0.15], atol=1e-14)


def test_limits_become_ranges_motors_and_velocity_limits_and_stay_in_the_text():
    ours = Mechanism.from_urdf(ARM)
    again = read(ours.mjcf, assets=ours.assets)
    for m in (ours, again):
        np.testing.assert_array_equal(m.velocity_limit, [3.0, np.inf, 0.5])  # a velocity of 0 is no limit
        np.testing.assert_array_equal(m.joint_range, [[-1, 2], [-np.inf, np.inf], [-0.1, 0.2]])
        np.testing.assert_array_equal(m.damping, [0.0, 0.0, 0.4])
        assert m.actuators.names == ("shoulder", "elbow", "slide")
        np.testing.assert_array_equal(m.actuators.control_range, [[-30, 30], [-np.inf, np.inf], [-50, 50]])
        np.testing.assert_array_equal(m.actuators.moment, np.eye(3))
        assert m.ignored == UNCLEAR


def test_continuous_joints_have_no_range_and_friction_is_kept():
    more = '<limit lower="-1" upper="1" effort="5" velocity="1"/><dynamics damping="0.1" friction="0.2"/>'
    model = compiled(robot(link("a"), link("b", inertial()), joint("j", "a", "b", "continuous", more=more)))
    assert not model.jnt_limited[0]
    assert (model.dof_damping[0], model.dof_frictionloss[0]) == (0.1, 0.2)


def test_mimic_joints_become_equalities_without_motors():
    mimic = '<mimic joint="left" multiplier="-2" offset="0.1"/>'
    model = compiled(
        robot(link("hand"), link("l", inertial()), link("r", inertial()),
              joint("right", "hand", "r", more=mimic), joint("left", "hand", "l"))
    )  # fmt: skip
    assert model.nu == 1
    assert model.eq_type[0] == mujoco.mjtEq.mjEQ_JOINT
    right, left = model.joint("right").id, model.joint("left").id
    assert (model.eq_obj1id[0], model.eq_obj2id[0]) == (right, left)
    np.testing.assert_array_equal(model.eq_data[0, :5], [0.1, -2, 0, 0, 0])  # right = 0.1 - 2 left
    assert model.eq_solref[0, 0] < 1e-3  # s: rigid; MuJoCo's default gives way with 0.02 s


def test_planar_spherical_and_inner_floating_joints():
    def chain(kind, axis="0 0 1"):
        return compiled(
            robot(link("a"), link("b", inertial()), link("c", inertial()),
                  joint("first", "a", "b"), joint("second", "b", "c", kind, axis=axis, more=""))
        )  # fmt: skip

    planar = chain("planar", axis="0 3 4")
    assert planar.nv == 4
    x, y, turn = planar.jnt_axis[1:]
    np.testing.assert_allclose(turn, [0, 0.6, 0.8], atol=1e-15)
    np.testing.assert_allclose(np.cross(x, y), turn, atol=1e-15)
    assert chain("spherical").nq == 1 + 4
    assert (chain("floating").nq, chain("floating").nu) == (1 + 3 + 4, 1)


def test_neighbours_do_not_touch_and_others_do():
    """MuJoCo leaves out parents and children, but for those of the world, to which a fixed base belongs."""
    ball = shape("collision", BALL)
    parts = [
        link("world"), link("base", ball), link("mount", ball), link("upper", inertial(), ball),
        link("pad", ball), link("fore", inertial(), ball),
        joint("0", "world", "base", "fixed", more=""), joint("1", "base", "mount", "fixed", more=""),
        joint("2", "mount", "upper"), joint("3", "upper", "pad", "fixed", more=""), joint("4", "pad", "fore"),
    ]  # fmt: skip
    for base in ("fixed", "free"):
        model = compiled(robot(*parts), base=base)
        pairs = {frozenset(model.geom(geom).name for geom in pair) for pair in contact_pairs(model)}
        assert pairs == {frozenset({"base", "fore"}), frozenset({"mount", "fore"})}


@pytest.mark.parametrize(("apart", "touch"), [(0.0, False), (0.098, False), (0.0995, True), (0.2, True)])
def test_links_that_overlap_at_zero_do_not_touch_and_the_model_says_so(apart, touch):
    """Two balls of 5 cm radius on links with one between them; 0.5 mm of overlap is how shapes were rounded."""
    parts = [
        link("base"), link("upper", inertial(), shape("collision", BALL)), link("middle", inertial()),
        link("fore", inertial(), shape("collision", BALL, xyz=f"0 0 {apart - 0.6}")),
        joint("1", "base", "upper"), joint("2", "upper", "middle"), joint("3", "middle", "fore"),
    ]  # fmt: skip
    told = "contact of upper and fore, whose shapes overlap with all joints at zero"
    assert (told in text_of(robot(*parts))) is not touch
    assert len(contact_pairs(compiled(robot(*parts)))) == touch


def test_what_rests_is_left_out_near_the_base_alone():
    """A ball on the base overlaps with all links: the third one passes through it, the fourth meets it as a table."""
    ball = shape("collision", BALL)
    parts = [link("world", ball), link("base", ball), joint("0", "world", "base", "fixed", more="")]
    for k, parent in enumerate(("base", "a", "b", "c"), 1):
        child = "abcd"[k - 1]
        parts += [
            link(child, inertial(), *([ball] if child in "cd" else [])),
            joint(str(k), parent, child, xyz="0 0 0"),
        ]
    model = compiled(robot(*parts))
    pairs = {frozenset(model.geom(geom).name for geom in pair) for pair in contact_pairs(model)}
    assert frozenset({"base", "c"}) not in pairs
    assert frozenset({"base", "d"}) in pairs
    assert frozenset({"world", "c"}) in pairs  # of MuJoCo's own body, which carries floors and obstacles, too


def test_a_floor_is_added_on_request():
    floor = compiled(ARM, floor=True).geom("floor")
    assert floor.type == mujoco.mjtGeom.mjGEOM_PLANE
    assert compiled(ARM).ngeom == 0


@pytest.mark.parametrize(
    "form",
    ['<sphere radius="0.1"/>', '<box size="0.1 0.3 0.2"/>', '<cylinder radius="0.1" length="0.4"/>',
     '<capsule radius="0.1" length="0.4"/>'],
)  # fmt: skip
def test_a_free_base_starts_on_the_floor(form):
    """MuJoCo's own distance from the floor is 0 at the start, whatever is lowest and however it is turned."""
    foot = '<collision><origin xyz="0.1 0 -0.2" rpy="0.4 0.3 0.2"/><geometry>' + form + "</geometry></collision>"
    parts = link("a", inertial()), link("b", inertial(), foot), joint("j", "a", "b", xyz="0 0 -0.5", rpy="1 2 0.5")
    model = compiled(robot(*parts), base="free", floor=True)
    data = mujoco.MjData(model)
    model.geom_margin[:] = 0.01
    mujoco.mj_forward(model, data)
    assert data.contact.dist.min() == pytest.approx(0.0, abs=1e-9)
    assert compiled(robot(*parts), base="free").qpos0[2] == 0.0


def test_a_free_base_that_hangs_over_the_floor_stays_there():
    parts = (
        link("world"),
        link("b", inertial(), shape("collision", BALL)),
        joint("j", "world", "b", "floating", xyz="0 0 2", more=""),
    )
    assert compiled(robot(*parts), floor=True).qpos0[2] == 2.0


def test_mjcf_gets_no_keys_of_urdfs():
    from planner.model.urdf.read import read_model

    with pytest.raises(PlannerError, match="floor is given for an MJCF model"):
        read_model("<mujoco/>", floor=True)
    with pytest.raises(PlannerError, match=r"root element <robot>.*Mechanism\.from_urdf"):
        Mechanism.from_mjcf(ARM)
