"""Inertias of URDFs are taken as they are, or refused with what to write."""

import itertools
import re
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import ConvexHull
from urdfs import BALL, inertial, joint, link, robot, shape

from planner import Mechanism, PlannerError
from planner.dynamics import mass_matrix
from planner.model.urdf.meshes import stl

IMPOSSIBLE = (0.01, 0.02, 0.06, 0.0, 0.0, 0.0)  # 0.06 exceeds 0.01 + 0.02 by 0.03
NEAREST = (0.02, 0.03, 0.05, 0.0, 0.0, 0.0)  # a third of 0.03 each way, which is the orthogonal projection


def pendulum(six, rpy="0 0 0", axis="1 0 0"):
    return robot(link("a"), link("b", inertial(1.0, six, rpy=rpy)), joint("j", "a", "b", axis=axis))


def test_an_impossible_inertia_is_refused_with_the_nearest_one():
    with pytest.raises(PlannerError, match=r"link 'b' .* 0\.01 0\.02 0\.06 kg") as error:
        Mechanism.from_urdf(pendulum(IMPOSSIBLE))
    assert str(error.value).endswith('or write inertia = "nearest" to plan with the nearest.')
    advised = re.findall(r'i..="([^"]+)"', str(error.value))
    np.testing.assert_allclose([float(word) for word in advised], NEAREST, atol=1e-7)
    six = tuple(float(word) for word in advised)
    Mechanism.from_urdf(pendulum(six))  # what it says is taken


@pytest.mark.parametrize("axis", ["1 0 0", "0 1 0", "0 0 1"])
def test_the_nearest_inertia_is_taken_on_request_and_said(axis):
    m = Mechanism.from_urdf(pendulum(IMPOSSIBLE, rpy="0 0 0.3", axis=axis), inertia="nearest")
    expected = Mechanism.from_urdf(pendulum(NEAREST, rpy="0 0 0.3", axis=axis))
    np.testing.assert_allclose(mass_matrix(m, [0.2]), mass_matrix(expected, [0.2]), rtol=1e-9)  # LEAST is in it
    assert m.ignored[0].startswith("the inertia of link 'b' (no body has it; by 27 % another")
    # sqrt(3) 0.01 of sqrt(0.01^2 + 0.02^2 + 0.06^2) = 0.064


def test_an_inertia_that_a_body_nearly_has_is_replaced_and_said():
    """Exports round: 0.062 exceeds 0.02 + 0.04 by so little that the nearest is 1.5 % away."""
    m = Mechanism.from_urdf(pendulum((0.02, 0.04, 0.062, 0.0, 0.0, 0.0)))
    share = 0.002 / 3.0
    np.testing.assert_allclose(np.linalg.eigvalsh(m.inertia[0]), [0.02 + share, 0.04 + share, 0.062 - share], rtol=1e-9)
    assert "by 1.5 % another is the nearest" in m.ignored[0]  # sqrt(3) share of sqrt(0.02^2 + 0.04^2 + 0.062^2)


def test_an_inertia_at_the_edge_is_not_altered():
    """A flat plate has izz = ixx + iyy, which rounding may exceed when it is turned."""
    plate = (0.1, 0.2, 0.1 + 0.2, 0.0, 0.0, 0.0)
    m = Mechanism.from_urdf(pendulum(plate, rpy="0.3 0.4 0.5"))
    np.testing.assert_allclose(np.linalg.eigvalsh(m.inertia[0]), [0.1, 0.2, 0.3], rtol=1e-10)


def test_an_impossible_inertia_of_a_fixed_link_counts_in_the_sum():
    parts = (link("a"), joint("j", "a", "b", axis="1 1 1"), joint("f", "b", "tip", "fixed", xyz="0 0 0.2", more=""))
    body = inertial(2.0, (0.3, 0.3, 0.3, 0.0, 0.0, 0.0), xyz="0 0 0")
    m = Mechanism.from_urdf(robot(*parts, link("b", body), link("tip", inertial(1.0, IMPOSSIBLE, xyz="0.1 0 0"))))
    # by hand: 2 kg at 0 and 1 kg at (0.1, 0, 0.2), about the origin of b
    c = np.array([0.1, 0.0, 0.2])
    about = np.diag([0.3, 0.3, 0.3]) + np.diag(IMPOSSIBLE[:3]) + c @ c * np.eye(3) - np.outer(c, c)
    axis = np.ones(3) / np.sqrt(3)
    assert mass_matrix(m, [0.0])[0, 0] == pytest.approx(axis @ about @ axis, rel=1e-13)
    assert m.ignored == ()
    assert m.frame("tip").link == m.frame("b").link


def test_a_massless_link_carries_others():
    """A universal joint of two hinges with a massless cross: M is that of the link behind it, at any angle."""
    m = Mechanism.from_urdf(
        robot(link("a"), link("cross"), link("b", inertial(2.0, (0.1, 0.2, 0.25, 0, 0, 0), xyz="0 0 0")),
              joint("x", "a", "cross", axis="1 0 0"), joint("y", "cross", "b", axis="0 1 0", xyz="0 0 0"))
    )  # fmt: skip
    q = 0.7
    expected = [[0.1 * np.cos(q) ** 2 + 0.25 * np.sin(q) ** 2, 0.0], [0.0, 0.2]]
    np.testing.assert_allclose(mass_matrix(m, [0.3, q]), expected, rtol=1e-10, atol=1e-12)


def test_a_joint_that_moves_no_mass_is_held_and_said():
    m = Mechanism.from_urdf(
        robot(link("a"), link("b", inertial()), link("led"), joint("j", "a", "b"), joint("led", "b", "led"))
    )
    assert m.joint_names == ("j",)
    assert m.ignored == ("the motion of joint 'led' (no mass hangs on what it moves)",)
    assert m.frame("led").link == 0


def test_a_joint_that_turns_no_inertia_is_refused_with_a_value():
    point = inertial(0.5, (0.0,) * 6, xyz="0 0 0.1")
    with pytest.raises(PlannerError, match=r"no inertia about the joint's axis.*0\.5 kg as a ball of water") as e:
        Mechanism.from_urdf(robot(link("a"), link("b", point), joint("j", "a", "b", axis="0 0 1")))
    # 2/5 m r^2 with 4/3 pi r^3 1000 kg/m^3 = 0.5 kg: r = 0.0492 m
    assert float(re.findall(r'ixx="([^"]+)"', str(e.value))[0]) == pytest.approx(0.4 * 0.5 * 0.04924**2, rel=5e-3)
    m = Mechanism.from_urdf(robot(link("a"), link("b", point), joint("j", "a", "b", axis="1 0 0")))
    assert mass_matrix(m, [0.0])[0, 0] == pytest.approx(0.5 * 0.1**2, rel=1e-9)  # a point on a rod


CORNERS = np.array(list(itertools.product((0.0, 0.1), (0.0, 0.2), (0.0, 0.3))))


@pytest.mark.parametrize(
    ("geometry", "volume", "moments"),  # moments: of the whole over its mass, by textbooks
    [
        ('<box size="0.1 0.2 0.3"/>', 0.006, np.array([0.13, 0.10, 0.05]) / 12),
        ('<sphere radius="0.1"/>', 4 / 3 * np.pi * 1e-3, 0.4 * np.full(3, 0.01)),
        ('<cylinder radius="0.1" length="0.3"/>', np.pi * 3e-3, np.array([0.0075 + 0.0025, 0.0075 + 0.0025, 0.005])),
        ('<mesh filename="box.stl" scale="1 2 0.5"/>', 0.006, np.array([0.16 + 0.0225, 0.0325, 0.17]) / 12),
    ],
    ids=["box", "sphere", "cylinder", "mesh"],
)  # fmt: skip
def test_inertias_from_shapes_are_those_of_their_formulas(geometry, volume, moments, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("box.stl").write_bytes(stl(CORNERS[ConvexHull(CORNERS).simplices]))  # float32
    one = f'<collision><origin xyz="0.1 0.2 -0.1" rpy="0.3 -0.4 1.0"/><geometry>{geometry}</geometry></collision>'
    links = link("a", shape("visual", BALL)), link("b", one, shape("visual", BALL))  # the collision shape counts
    ours = Mechanism.from_urdf(robot(*links, joint("j", "a", "b")), inertia={"density": 500.0}, contacts="off")
    assert ours.mass[0] == pytest.approx(500.0 * volume, rel=1e-6)
    np.testing.assert_allclose(np.linalg.eigvalsh(ours.inertia[0]) / ours.mass[0], np.sort(moments), rtol=1e-5)
    if "mesh" not in geometry:
        np.testing.assert_allclose(ours.com[0], [0.1, 0.2, -0.1], atol=1e-12)
    assert any("the inertia of link 'b' (the file has none" in phrase for phrase in ours.ignored)


def test_limits_that_are_not_as_written_are_said():
    def with_limit(name, limit):
        return joint(name, "a", name, more=limit), link(name, inertial())

    m = Mechanism.from_urdf(robot(
        link("a"), *with_limit("swapped", '<limit lower="2" upper="-1" effort="3" velocity="1"/>'),
        *with_limit("empty", '<limit lower="0" upper="0" effort="3" velocity="1"/>'), *with_limit("none", ""),
    ))  # fmt: skip
    assert sorted(m.joint_range.tolist()) == [[-np.inf, np.inf], [-np.inf, np.inf], [-1.0, 2.0]]
    assert m.ignored == (
        "the range of joint 'swapped' (written as 2 to -1, taken as -1 to 2)",
        "the range of joint 'empty' (both of its ends are 0)",
        "the range of joint 'none' (the file has none)",
        "the effort limit of joint 'none' (the file has none)",
    )


@pytest.mark.parametrize(
    ("inertia", "message"),
    [("from shape", "Did you mean 'from shapes'"), ({"densty": 1.0}, "Did you mean 'density'"),
     ({"density": -1.0}, "density of inertia is -1.0")],
)  # fmt: skip
def test_wrong_words_for_inertias_are_refused(inertia, message):
    with pytest.raises(PlannerError, match=message):
        Mechanism.from_urdf(robot(link("a"), link("b", inertial()), joint("j", "a", "b")), inertia=inertia)
