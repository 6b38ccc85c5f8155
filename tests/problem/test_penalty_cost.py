"""PenaltyCost: distances against brute force, gradients against differences, and a machine that keeps its hand up."""

import numpy as np
import pytest
from contact_machines import leg, standing
from gradients import assert_gradients
from hypothesis import given, settings
from hypothesis import strategies as st
from machines import HAND_ARM, HAND_MACHINE, random_states

import planner
from planner import Mechanism, PenaltyCost, PlannerError, Problem, RigidBodyDynamics, TrackingCost
from planner.costs import Distance, Gap, Height, Point, Segment, Velocity
from planner.dynamics.contacts import contact_forces
from planner.problem.costs.residual_functions import nearest_on_segments

seeds = st.integers(0, 2**32 - 1)


@pytest.fixture(scope="module")
def machine():
    """A free body, a hinge and a ball."""
    return Mechanism.from_mjcf(HAND_MACHINE)


# --------------------------------------------------------------------------------------------------- distances


def length(a0, a1, b0, b1):
    d, s, u = nearest_on_segments(*(np.array(point, dtype=float) for point in (a0, a1, b0, b1)))
    assert 0.0 <= s <= 1.0
    assert 0.0 <= u <= 1.0
    np.testing.assert_allclose(d, a0 + s * np.subtract(a1, a0) - (b0 + u * np.subtract(b1, b0)), rtol=0, atol=1e-12)
    return float(np.linalg.norm(d))


@pytest.mark.parametrize(
    ("lines", "expected"),
    [
        (([0, 0, 0], [1, 0, 0], [0.5, -1, 2], [0.5, 1, 2]), 2.0),  # crossing, seen from above
        (([0, 0, 0], [1, 0, 0], [0.5, -1, 0], [0.5, 1, 0]), 0.0),  # crossing
        (([0, 0, 0], [1, 0, 0], [0, 0.3, 0], [1, 0.3, 0]), 0.3),  # parallel, side by side
        (([0, 0, 0], [1, 0, 0], [1, 0.3, 0], [0, 0.3, 0]), 0.3),  # the other way round
        (([0, 0, 0], [1, 0, 0], [4, 4, 0], [9, 4, 0]), 5.0),  # parallel, end to end
        (([0, 0, 0], [1, 0, 0], [9, 4, 0], [4, 4, 0]), 5.0),
        (([0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0]), 1.0),  # on one line
        (([0, 0, 0], [1, 0, 0], [0.5, 0, 0], [3, 0, 0]), 0.0),
        (([0, 0, 0], [1, 0, 0], [0.2, 3, 4], [0.2, 3, 4]), 5.0),  # one is a point
        (([0.2, 3, 4], [0.2, 3, 4], [0, 0, 0], [1, 0, 0]), 5.0),
        (([1, 2, 3], [1, 2, 3], [1, 2, 5], [1, 2, 5]), 2.0),  # both are
        (([1, 2, 3], [1, 2, 3], [1, 2, 3], [1, 2, 3]), 0.0),
        (([0, 0, 0], [1, 0, 0], [3, 1, 1], [3, 1, -1]), np.sqrt(5.0)),  # from an end to the middle of the other
    ],
)
def test_distances_of_lines(lines, expected):
    a0, a1, b0, b1 = lines
    for turned in ((a0, a1, b0, b1), (a1, a0, b0, b1), (b0, b1, a0, a1), (b1, b0, a1, a0)):
        assert length(*turned) == pytest.approx(expected, abs=1e-11)


def to_line(p, b0, b1):
    """From a point to a line."""
    u = np.clip((p - b0) @ (b1 - b0) / ((b1 - b0) @ (b1 - b0)), 0.0, 1.0)
    return np.linalg.norm(p - b0 - u * (b1 - b0))


@settings(max_examples=100, deadline=None)
@given(seed=seeds, flat=st.booleans())
def test_distances_are_the_least_of_many(seed, flat):
    """Either an end is nearest or both lines are at an inner point; and no other pair of points is nearer."""
    rng = np.random.default_rng(seed)
    a0, a1, b0, b1 = rng.normal(size=(4, 3)) * ([1.0, 1.0, 0.0] if flat else 1.0)  # in a plane lines often cross
    found = length(a0, a1, b0, b1)
    candidates = [to_line(a0, b0, b1), to_line(a1, b0, b1), to_line(b0, a0, a1), to_line(b1, a0, a1)]
    lines = np.stack([a1 - a0, b0 - b1], axis=1)
    inner = np.linalg.lstsq(lines, b0 - a0, rcond=None)[0]
    if np.all((inner >= 0.0) & (inner <= 1.0)):
        candidates.append(np.linalg.norm(lines @ inner - (b0 - a0)))
    assert found == pytest.approx(min(candidates), abs=1e-9)
    s, u = rng.uniform(size=(2, 1000, 1))
    assert found <= np.linalg.norm(a0 + s * (a1 - a0) - b0 - u * (b1 - b0), axis=1).min() + 1e-9


@given(seed=seeds)
def test_nearly_parallel_lines(seed):
    """The pull to their middles must not be seen in the distance."""
    rng = np.random.default_rng(seed)
    a0, v, b0 = rng.normal(size=(3, 3))
    exact = 10.0 ** rng.uniform(-12, -3)
    b1 = b0 + v * rng.uniform(0.5, 1.5) + exact * rng.normal(size=3)
    ends = min(length(a0, a0 + v, b, b) for b in (b0, b1)), min(length(a, a, b0, b1) for a in (a0, a0 + v))
    # of lines that are all but parallel the least distance is from one of the ends, but for a part of second order
    assert length(a0, a0 + v, b0, b1) == pytest.approx(min(ends), abs=10.0 * exact**2 / min(ends) + 1e-9)


# ------------------------------------------------------------------------------------------------------ values


def test_values_are_what_mujoco_places(machine):
    rng = np.random.default_rng(0)
    xs = random_states(machine, rng, 5)
    hand = np.array([planner.dynamics.frame_pose(machine, x[: machine.nq], "hand") for x in xs])
    trunk = np.array([planner.dynamics.frame_pose(machine, x[: machine.nq], "trunk") for x in xs])
    moving = rng.normal(size=(5, 3))
    cost = PenaltyCost(
        machine, 4,
        [
            Height(Point("hand"), lower=0.0, tolerance=1.0),
            Height(Point("hand", (0.1, 0.2, 0.3), 0.5, moving), normal=(3.0, 0.0, 4.0), upper=0.0, tolerance=1.0),
            Distance(Point("hand"), Point("trunk"), lower=1.0, tolerance=1.0),
            Distance(Point("fixed"), Segment(Point(world=(1.0, 0.0, 3.0)), Point(world=(1.0, 1.0, 3.0)), 0.25),
                     lower=1.0, tolerance=1.0),
        ],
        dt=0.1,
    )  # fmt: skip
    point = 0.5 * (hand[:, :3, 3] + hand[:, :3, :3] @ [0.1, 0.2, 0.3]) + moving
    values = cost.values(xs)
    assert values.shape == (5, 4)
    np.testing.assert_allclose(values[:, 0], hand[:, 2, 3], rtol=0, atol=1e-12)
    np.testing.assert_allclose(values[:, 1], point @ [0.6, 0.0, 0.8], rtol=0, atol=1e-12)
    np.testing.assert_allclose(values[:, 2], np.linalg.norm((hand - trunk)[:, :3, 3], axis=1), rtol=0, atol=1e-12)
    np.testing.assert_allclose(values[:, 3], 0.75, rtol=0, atol=1e-12)  # fixed is at 1 2 3
    assert cost.names == ("height of hand", "height of hand", "distance of hand and trunk",
                          "distance of fixed and a point - a point")  # fmt: skip


def test_velocities_are_differences_of_places(machine):
    """Along the motion of one state, by central differences; and of a body that carries the other point."""
    rng, h = np.random.default_rng(1), 1e-6
    xs, space, nq, nv = random_states(machine, rng, 5), machine.space, machine.nq, machine.nv
    rates = np.hstack([xs[:, nq : nq + nv], np.zeros((5, nv))])

    def places(names, to):
        moved = space.integrate(xs, to * rates)[:, :nq]
        return [planner.dynamics.frame_pose(machine, moved, name)[:, :3, 3] for name in names]

    after, before = places(("hand", "arm"), h), places(("hand", "arm"), -h)
    hand, arm = ((a - b) / (2.0 * h) for a, b in zip(after, before, strict=True))
    d = np.array([0.6, 0.0, 0.8])
    cost = PenaltyCost(
        machine, 4,
        [Velocity(Point("hand"), d, target=0.0, tolerance=1.0),
         Velocity(Point("hand"), 2.0 * d, Point("arm"), target=0.0, tolerance=1.0)],
        dt=0.1,
    )  # fmt: skip
    np.testing.assert_allclose(cost.values(xs), np.stack([hand @ d, (hand - arm) @ d], axis=1), rtol=0, atol=1e-7)
    assert cost.names == ("velocity of hand", "velocity of hand")


@pytest.mark.parametrize("tilt", [0.0, 0.2])
def test_gaps_are_the_depths_of_contacts(tilt):
    m = Mechanism.from_mjcf(leg(impratio=1000.0, ramp=5e-3, tilt=tilt))
    rng = np.random.default_rng(0)
    xs = standing(m) + 0.1 * rng.normal(size=(6, m.space.nx))
    for name in ("foot", m.contacts[0].name):
        cost = PenaltyCost(m, 5, [Gap(name, lower=0.0, tolerance=0.01)], dt=0.1)
        depths = contact_forces(m, xs[:, : m.nq], xs[:, m.nq :]).depths
        np.testing.assert_allclose(cost.values(xs), -depths, rtol=0, atol=1e-12)


def test_the_ramp_weights_and_the_end():
    """One height that is the state itself, by hand."""
    m = Mechanism.from_mjcf(
        HAND_ARM.replace('<joint name="a" axis="0 1 0"', '<joint name="a" type="slide" axis="0 0 1"')
    )
    xs, us = np.zeros((5, 4)), np.zeros((4, 2))
    xs[:, 0] = [0.5, -0.01, -0.04, -0.3, -0.2]  # the tip is at the slide less 2
    term = {"lower": -2.0, "tolerance": 0.1, "ramp": 0.02}
    cost = PenaltyCost(m, 4, [Height(Point("tip"), **term, weight=3.0)], dt=0.5)
    r = np.array([0.0, 0.01**2 / 0.04, 0.04 - 0.01, 0.3 - 0.01, 0.2 - 0.01]) / 0.1
    assert cost.value(xs, us) == pytest.approx(0.5 * 0.5 * 3.0 * float(np.sum(r**2)), rel=1e-12)
    cost = PenaltyCost(m, 4, [Height(Point("tip"), **term, weight=[3.0, 3.0, 0.0, 1.0, 9.0], final_weight=7.0)], dt=0.5)
    expected = 0.25 * (3.0 * (r[0] ** 2 + r[1] ** 2) + r[3] ** 2) + 3.5 * r[4] ** 2
    assert cost.value(xs, us) == pytest.approx(float(expected), rel=1e-12)
    off = Height(Point("tip"), target=[np.nan, np.nan, -2.0, -2.0, np.nan], tolerance=0.1)
    cost = PenaltyCost(m, 4, [off], dt=0.5)
    assert cost.value(xs, us) == pytest.approx(0.25 * (0.4**2 + 3.0**2), rel=1e-12)
    model = cost.quadratize(xs, us)
    np.testing.assert_allclose(model.q[:, 0], 0.5 * np.array([0.0, 0.0, -0.04, -0.3, 0.0]) / 0.1**2, atol=1e-12)
    assert not model.Q[[0, 1, 4]].any()


# --------------------------------------------------------------------------------------------------- gradients

POINT = Point("hand", (0.1, -0.2, 0.3), share=0.7, world=(0.2, 0.1, -0.3))
FOREARM = Segment(Point("arm"), Point("hand"), 0.05)
FLOOR = Segment(Point(world=(-3.0, 0.1, -0.2)), Point(world=(3.0, -0.2, -0.4)), 0.1)
TERMS = {
    "height, target": Height(POINT, normal=(1.0, -2.0, 0.5), target=0.1, tolerance=0.5, weight=2.0),
    "height, lower": Height(POINT, lower=[1.0, 0.5, 2.0, 0.0], tolerance=0.5, ramp=0.4),
    "height, upper": Height(POINT, upper=-1.0, tolerance=0.5, ramp=3.0),
    "points": Distance(POINT, Point("trunk"), lower=2.0, tolerance=0.3, final_weight=2.0),
    "point and line": Distance(POINT, FLOOR, target=[0.3, np.nan, 0.2, 0.1], tolerance=0.3),
    "line and point": Distance(FLOOR, Point("palm"), upper=0.1, tolerance=0.3),
    "lines": Distance(FOREARM, FLOOR, lower=2.0, tolerance=0.3, ramp=0.5),
    "lines, the other way round": Distance(FLOOR, FOREARM, lower=2.0, tolerance=0.3, ramp=0.5),
    "moving lines": Distance(Segment(Point("trunk"), Point("palm", share=0.5)), FOREARM, target=0.0, tolerance=0.3),
    "ends of lines": Distance(FOREARM, Segment(Point("fixed"), Point(world=(2.0, 2.0, 4.0))), upper=0.1, tolerance=0.3),
    "velocity": Velocity(POINT, (1.0, -2.0, 0.5), target=0.3, tolerance=0.5),
    "velocity, lower": Velocity(POINT, (0.0, 1.0, 0.3), Point("arm"), lower=[3.0, 1.0, 2.0, 4.0], tolerance=0.5),
    "fixed": Distance(Point("fixed"), FLOOR, upper=0.1, tolerance=0.3),
}


@pytest.mark.parametrize("name", TERMS)
def test_gradients_are_differences_of_the_value(machine, name):
    rng = np.random.default_rng(3)
    xs, us = random_states(machine, rng, 4), rng.normal(size=(3, 3))
    cost = PenaltyCost(machine, 3, [TERMS[name]], dt=0.5)
    model = assert_gradients(cost, machine.space, xs, us)
    assert (np.abs(model.q).max() > 0.01) == (name != "fixed")
    assert not model.R.any()
    for n, (H, g) in enumerate(zip(model.Q, model.q, strict=True)):
        value = float(cost.values(xs)[n, 0])
        assert np.linalg.eigvalsh(H).min() > -1e-12 * max(1.0, np.abs(H).max())
        # one residual: J'J r^2 = (J'r)(J'r)'
        residual = {"target": 1.0}.get(TERMS[name].side)
        if residual and g.any():
            e = value - np.broadcast_to(TERMS[name].target, 4)[n]
            np.testing.assert_allclose(H * e**2 * cost.residual_arrays.weight[0, n], np.outer(g, g), atol=1e-10)


def test_all_terms_are_the_sum(machine):
    rng = np.random.default_rng(4)
    xs, us = random_states(machine, rng, 4), rng.normal(size=(3, 3))
    together = PenaltyCost(machine, 3, list(TERMS.values()), dt=0.5)
    apart = [PenaltyCost(machine, 3, [term], dt=0.5) for term in TERMS.values()]
    assert together.value(xs, us) == pytest.approx(sum(cost.value(xs, us) for cost in apart), rel=1e-12)
    model, models = together.quadratize(xs, us), [cost.quadratize(xs, us) for cost in apart]
    np.testing.assert_allclose(model.Q, sum(one.Q for one in models), rtol=0, atol=1e-10 * np.abs(model.Q).max())
    np.testing.assert_allclose(model.q, sum(one.q for one in models), rtol=0, atol=1e-10 * np.abs(model.q).max())


@pytest.mark.parametrize("tilt", [0.0, 0.2])
def test_gradients_of_gaps(tilt):
    m = Mechanism.from_mjcf(leg(impratio=1000.0, ramp=5e-3, tilt=tilt))
    rng = np.random.default_rng(0)
    xs, us = standing(m) + 0.1 * rng.normal(size=(4, m.space.nx)), np.zeros((3, 2))
    cost = PenaltyCost(m, 3, [Gap("foot", upper=-0.2, tolerance=0.05), Gap("foot", target=0.1, tolerance=0.5)], dt=0.1)
    model = assert_gradients(cost, m.space, xs, us)
    assert np.abs(model.q).max() > 0.01


def test_nothing_apart_has_no_direction(machine):
    """The cost of what has no gradient is a number, and so are its derivatives."""
    touching = [
        Distance(Point("hand"), Point("hand"), lower=0.1, tolerance=0.1),
        Distance(FOREARM, Segment(Point("hand"), Point("arm")), lower=0.1, tolerance=0.1),
        Distance(Segment(Point("hand"), Point("hand")), FOREARM, lower=0.1, tolerance=0.1),
    ]
    xs = random_states(machine, np.random.default_rng(5), 3)
    cost = PenaltyCost(machine, 2, touching, dt=0.1)
    np.testing.assert_allclose(cost.values(xs), np.tile([0.0, -0.05, -0.05], (3, 1)), rtol=0, atol=1e-7)
    model = cost.quadratize(xs, np.zeros((2, 1)))
    assert model.finite


def test_a_candidate_that_ran_away_costs_infinitely(machine):
    cost = PenaltyCost(machine, 3, [TERMS["lines"]], dt=0.5)
    xs = random_states(machine, np.random.default_rng(2), 4)
    xs[3, 0] = np.nan
    assert cost.value(xs, np.zeros((3, 1))) == np.inf


# ------------------------------------------------------------------------------------------------------- solves


def test_an_arm_keeps_its_tip_up_or_goes_around_a_post():
    """A swing from side to side; where its tip would be lowest is too low, or a post stands there."""
    dynamics = RigidBodyDynamics(Mechanism.from_mjcf(HAND_ARM), 0.0125)
    start, goal = np.array([-1.0, 0.0, 0.0, 0.0]), np.array([1.0, 0.0, 0.0, 0.0])
    swing = TrackingCost.joints(dynamics, goal, 80, effort=0.01, final_position=1e3, final_velocity=1e2)
    free = planner.solve(Problem(dynamics, swing, start))
    places = planner.dynamics.frame_pose(dynamics.mechanism, free.xs[:, :2], "tip")[:, :3, 3]
    place = places[places[:, 2].argmin()]
    post = Segment(Point(world=place - np.eye(3)[1]), Point(world=place + np.eye(3)[1]), 0.1)
    forearm = Segment(Point("tip", (0.0, 0.0, 1.0)), Point("tip"), 0.05)
    for term in (
        Height(Point("tip"), lower=place[2] + 0.1, tolerance=0.005),
        Distance(forearm, post, lower=0.0, tolerance=0.005),
    ):
        penalties = PenaltyCost(dynamics, 80, [term])
        kept = planner.solve(Problem(dynamics, swing + penalties, start))
        assert kept.success
        wanted = float(np.max(term.lower))
        assert penalties.values(free.xs).min() < wanted - 0.05
        assert penalties.values(kept.xs).min() > wanted - 0.01  # two tolerances
        assert np.abs(kept.xs[-1] - goal).max() < 0.01
        assert planner.prove(kept, rollouts=0).passed


# ------------------------------------------------------------------------------------------------------ mistakes

UP = {"lower": 0.1, "tolerance": 0.01}


@pytest.mark.parametrize(
    ("make", "expected"),
    [
        (lambda m: [Height(Point("hnad"), **UP)],
         "terms[0]'s frame is 'hnad', expected one of: fixed, hand, world, trunk, arm, palm. Did you mean 'hand'?"),
        (lambda m: [Height(Point(3), **UP)], "frame is 3, expected a Frame, the name of a site or body, or None."),
        (lambda m: [Height("hand", **UP)], "point is 'hand', expected a Point."),
        (lambda m: [Height(Point(offset=(1.0, 2.0)), **UP)], "offset is (1.0, 2.0), expected 3 numbers"),
        (lambda m: [Height(Point(world=np.ones((3, 2))), **UP)], "world has shape (3, 2), expected (N+1, 3)."),
        (lambda m: [Height(Point(world=np.ones((3, 3))), **UP)], "terms[0]'s world has 3 rows, expected N+1 = 4."),
        (lambda m: [Height(Point(share="all"), **UP)], "share is 'all', expected a finite number."),
        (lambda m: [Height(Point(), normal=(0, 0, 0), **UP)], "normal is (0, 0, 0), expected a direction."),
        (lambda m: [Height(Point(), tolerance=1.0)], "none of lower, upper, target given, expected just one."),
        (lambda m: [Height(Point(), upper=1.0, **UP)], "lower and upper of lower, upper, target given, expected"),
        (lambda m: [Height(Point(), lower=0.1, tolerance=0.0)], "tolerance is 0.0, expected a finite number greater"),
        (lambda m: [Height(Point(), lower=0.1, tolerance=-1.0)], "tolerance is -1.0, expected a finite number greater"),
        (lambda m: [Height(Point(), ramp=0.0, **UP)], "ramp is 0.0, expected a finite number greater than 0."),
        (lambda m: [Height(Point(), weight=-1.0, **UP)], "weight is -1.0, expected finite weights of at least 0."),
        (lambda m: [Height(Point(), weight=[1.0, np.nan], **UP)], "weight is [1.0, nan], expected finite weights"),
        (lambda m: [Height(Point(), weight=[1.0, 2.0], **UP)], "terms[0].weight has 2 rows, expected N+1 = 4."),
        (lambda m: [Height(Point(), final_weight=-1.0, **UP)], "final_weight is -1.0, expected a finite number of at"),
        (lambda m: [Height(Point(), lower=[1.0, 2.0], tolerance=1.0)], "terms[0].lower has 2 rows, expected N+1 = 4."),
        (lambda m: [Height(Point(), lower=np.inf, tolerance=1.0)], "lower is infinite at a stage, expected finite"),
        (lambda m: [Height(Point(), lower="low", tolerance=1.0)], "lower is 'low', expected numbers."),
        (lambda m: [Distance(Point(), "hand", **UP)], "b is 'hand', expected a Point or a Segment."),
        (lambda m: [Distance(Segment(Point(), Point(), -1.0), Point(), **UP)], "radius is -1.0, expected a finite"),
        (lambda m: [Distance(Segment(Point(), "hand"), Point(), **UP)], "end is 'hand', expected a Point."),
        (lambda m: [Velocity(Point(), (0, 0, 0), **UP)], "direction is (0, 0, 0), expected a direction."),
        (lambda m: [Velocity(Point(), (0, 0, 1), "hand", **UP)], "relative is 'hand', expected a Point."),
        (lambda m: [Gap("toe", **UP)], "terms[0]'s contact is 'toe', but the mechanism has no contacts."),
        (lambda m: [3], "terms[0] is 3, expected a Height, Distance, Gap, Velocity or Clearance."),
        (lambda m: Height(Point(), **UP), "terms is Height("),
    ],
)  # fmt: skip
def test_mistakes_are_one_sentence(machine, make, expected):
    with pytest.raises(PlannerError) as error:
        PenaltyCost(machine, 3, make(machine), dt=0.1)
    assert str(error.value).startswith(expected)
    assert "\n" not in str(error.value)


def test_contacts_are_named():
    with pytest.raises(PlannerError, match=r"terms\[0\]'s contact is 'fot', expected one of: geom 'foot', foot\."):
        PenaltyCost(Mechanism.from_mjcf(leg()), 3, [Gap("fot", **UP)], dt=0.1)


def test_a_mechanism_needs_dt(machine):
    with pytest.raises(PlannerError, match="dt is None, expected the length of a stage"):
        PenaltyCost(machine, 3, [])
