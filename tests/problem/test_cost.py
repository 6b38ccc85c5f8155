"""Costs: gradients against differences of the value on the group, Hessians against Gauss and Newton, and their sums."""

import numpy as np
import pytest
from gradients import assert_gradients, hessian, spd
from hypothesis import given, settings
from hypothesis import strategies as st
from solves import Plain, swing

import planner
from planner import Mechanism, PlannerError, Problem, RigidBodyDynamics, TrackingCost
from planner.model.space import StateSpace
from planner.problem.costs.terms import Quadratic, SumCost

seeds = st.integers(0, 2**32 - 1)
FLAT, BODY = StateSpace(4, 4), StateSpace(12, 10, ((1, 1), (6, 5)))
spaces = pytest.mark.parametrize("space", [FLAT, BODY], ids=["vectors", "quaternions"])


def states(rng, space, count):
    x = rng.normal(size=(count, space.nx))
    for i, _ in space.quaternions:
        x[:, i : i + 4] /= np.linalg.norm(x[:, i : i + 4], axis=1, keepdims=True)
    return x


def random_cost(rng, space, N=3, nu=2):
    Q, R = [spd(rng, space.ndx) for _ in range(N + 1)], [spd(rng, nu) for _ in range(N)]
    return TrackingCost(Q, R, states(rng, space, N + 1), rng.normal(size=(N, nu)), space)


def near(rng, cost, size=0.7):
    """A trajectory whose rotations are away from the references, yet not half a turn."""
    dx = rng.uniform(-size, size, (cost.N + 1, cost.ndx))
    return cost.space.integrate(cost.x_ref, dx), rng.normal(size=(cost.N, cost.nu))


@spaces
@settings(max_examples=10, deadline=None)
@given(seed=seeds)
def test_tracking_gradients_are_differences_of_the_value(space, seed):
    rng = np.random.default_rng(seed)
    cost = random_cost(rng, space)
    model = assert_gradients(cost, space, *near(rng, cost))
    for H in (*model.Q, *model.R):
        np.testing.assert_allclose(H, H.T, rtol=0, atol=1e-12 * np.abs(H).max())
        assert np.linalg.eigvalsh(H).min() > -1e-12 * np.abs(H).max()


@spaces
def test_the_final_cost_is_what_the_end_state_adds(space):
    """By two trajectories that differ at the end alone."""
    rng = np.random.default_rng(0)
    cost = random_cost(rng, space)
    xs, us = near(rng, cost)
    other = np.vstack([xs[:-1], near(rng, cost)[0][-1:]])
    added = cost.final_cost(other[-1]) - cost.final_cost(xs[-1])
    assert cost.value(other, us) - cost.value(xs, us) == pytest.approx(added, rel=1e-9)


@settings(max_examples=10, deadline=None)
@given(seed=seeds)
def test_vectors_have_the_weights_themselves(seed):
    """Where nothing turns the model is exact: the value is its own expansion, and no product touches the weights."""
    rng = np.random.default_rng(seed)
    cost = random_cost(rng, FLAT)
    assert TrackingCost(cost.Q, cost.R, cost.x_ref, cost.u_ref).space == FLAT
    (xs, us), (ys, vs) = near(rng, cost), near(rng, cost)
    model, dx, du = cost.quadratize(xs, us), ys - xs, vs - us
    assert model.Q is cost.Q
    assert model.R is cost.R
    np.testing.assert_array_equal(model.q, np.einsum("nij,nj->ni", cost.Q, xs - cost.x_ref))
    expansion = cost.value(xs, us) + np.sum(model.q * dx) + np.sum(model.r * du)
    expansion += 0.5 * np.einsum("ni,nij,nj", dx, model.Q, dx) + 0.5 * np.einsum("ni,nij,nj", du, model.R, du)
    assert cost.value(ys, vs) == pytest.approx(expansion, rel=1e-11)


def test_at_the_reference_gauss_newton_is_exact():
    rng = np.random.default_rng(0)
    cost = random_cost(rng, BODY)
    xs, us = near(rng, cost)
    xs[1] = cost.x_ref[1]
    model = cost.quadratize(xs, us)
    np.testing.assert_allclose(model.Q[1], cost.Q[1], rtol=0, atol=1e-12 * np.abs(cost.Q).max())
    np.testing.assert_allclose(model.Q[1], hessian(cost, BODY, xs, us, 1), rtol=0, atol=1e-5 * np.abs(cost.Q).max())
    # Away from it, vectors have no curvature that it does not know; rotations have.
    vectors = np.setdiff1d(np.arange(10), [1, 2, 3, 5, 6, 7])
    exact, block = hessian(cost, BODY, xs, us, 0), np.ix_(vectors, vectors)
    np.testing.assert_allclose(model.Q[0][block], exact[block], rtol=0, atol=1e-5 * np.abs(cost.Q).max())
    assert np.abs(model.Q[0] - exact).max() > 0.01


def test_a_turn_about_one_axis_costs_its_angle():
    space = StateSpace(4, 3, ((0, 0),))
    cost = TrackingCost.reach([1.0, 0.0, 0.0, 0.0], 1, final=2.0, effort=1.0, space=space)
    for angle in (0.1, 1.5, 3.1, -3.1, 3.3):
        xs = np.array([[1.0, 0.0, 0.0, 0.0], [np.cos(angle / 2), 0.0, np.sin(angle / 2), 0.0]])
        short = (angle + np.pi) % (2 * np.pi) - np.pi  # the shorter way round
        assert cost.value(xs, np.zeros((1, 1))) == pytest.approx(short**2, rel=1e-12)


@pytest.mark.parametrize(
    ("make", "expected"),
    [
        (lambda: TrackingCost(np.eye(4)[None].repeat(2, 0), [[[1.0]]], 0.0, 0.0, StateSpace(4, 3, ((0, 0),))),
         "Q has shape (2, 4, 4), expected (2, 3, 3)."),
        (lambda: TrackingCost(np.eye(3)[None].repeat(2, 0), [[[1.0]]], 0.0, 0.0, StateSpace(4, 3, ((0, 0),))),
         "x_ref has a quaternion of length zero at 0 to 3, expected e.g. 1, 0, 0, 0."),
        (lambda: TrackingCost.reach([1.0, 0.0], 2, final=1.0, effort=1.0, space=BODY),
         "goal is [1.0, 0.0], expected 12 numbers."),
        (lambda: TrackingCost.reach([1.0, 0.0], 2, final="much", effort=1.0), "final is 'much', expected numbers."),
    ],
)  # fmt: skip
def test_wrong_tracking_costs_are_refused_in_one_sentence(make, expected):
    with pytest.raises(PlannerError) as error:
        make()
    assert str(error.value) == expected


# Sums


def test_the_value_and_model_of_a_sum_are_the_sums():
    rng = np.random.default_rng(1)
    a, b = random_cost(rng, BODY), random_cost(rng, BODY)
    xs, us = near(rng, a, 0.3)
    own = Plain(b)
    for total in (a + b, SumCost(a, b), a + own, own + a, SumCost(a) + own):
        assert isinstance(total, SumCost)
        assert len(total.costs) == 2
        assert (total.N, total.nx, total.ndx, total.nu, total.space) == (3, 12, 10, 2, BODY)
        assert total.value(xs, us) == pytest.approx(a.value(xs, us) + b.value(xs, us), rel=1e-14)
        parts = (cost.quadratize(xs, us) for cost in (total, a, b))
        for name, ours, one, two in zip(Quadratic._fields, *parts, strict=True):
            if name == "S":  # of which neither has one
                assert ours is None
                continue
            np.testing.assert_allclose(ours, one + two, rtol=1e-14)
    assert_gradients(a + own, BODY, xs, us)
    np.testing.assert_array_equal(a.quadratize(xs, us).R, a.R)  # adding changes no term


def test_two_halves_are_solved_as_the_whole():
    whole = swing()
    half = TrackingCost(0.5 * whole.cost.Q, 0.5 * whole.cost.R, whole.cost.x_ref, whole.cost.u_ref)
    ours, theirs = planner.solve(Problem(whole.dynamics, half + half, whole.x0)), planner.solve(whole)
    assert ours.nit == theirs.nit
    np.testing.assert_allclose(ours.us, theirs.us, rtol=0, atol=1e-9 * np.abs(theirs.us).max())


class Narrow(Plain):
    """A user's cost with a gradient that would broadcast."""

    def quadratize(self, xs, us):
        model = self._cost.quadratize(xs, us)
        return model._replace(q=model.q[:1])


def test_sums_of_costs_that_do_not_fit_are_refused_in_one_sentence():
    rng = np.random.default_rng(2)
    a = random_cost(rng, BODY)
    for make, expected in [
        (lambda: a + 3.0, "a term of a cost is 3.0, expected a cost with value() and quadratize()."),
        (lambda: SumCost(), "the sum has no costs, expected at least one."),
        (lambda: a + random_cost(rng, BODY, N=5), "the costs of a sum are made for N = 3 and 5: expected one."),
        (lambda: a + random_cost(rng, FLAT), "the costs of a sum are made for nx = 12 and 4: expected one."),
        (lambda: (a + Narrow(a)).quadratize(*near(rng, a)),
         "cost 1 of a sum gives q of shape (1, 10), cost 0 of (4, 10): expected the same."),
    ]:  # fmt: skip
        with pytest.raises(PlannerError) as error:
            make()
        assert str(error.value) == expected


# Machines: weights by name

MACHINE = """
<mujoco>
  <option><flag contact="disable"/></option>
  <worldbody>
    <body name="trunk">
      <freejoint name="root"/>
      <inertial pos="0 0 0" mass="3" diaginertia="0.1 0.2 0.3"/>
      <body name="arm" pos="0.1 0.2 0">
        <joint name="shoulder" axis="0 1 0"/>
        <inertial pos="0.2 0 0" mass="1" diaginertia="0.01 0.02 0.03"/>
        <body name="hand" pos="0.4 0 0">
          <joint name="wrist" type="ball"/>
          <inertial pos="0.05 0 0" mass="0.2" diaginertia="0.001 0.002 0.003"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="motor" joint="shoulder"/>
    <general name="muscle" joint="shoulder" dyntype="integrator" gainprm="2"/>
    <motor joint="wrist" gear="1 0 0"/>
  </actuator>
  <keyframe><key name="wave" qpos="1 2 3 1 0 0 0 0.5 1 0 0 0" act="0.25"/></keyframe>
</mujoco>
"""
# qpos: root 0-6, shoulder 7, wrist 8-11; nv = 10: root 0-5, shoulder 6, wrist 7-9; act: muscle
NV, NX, NDX = 10, 23, 21


@pytest.fixture(scope="module")
def machine():
    return Mechanism.from_mjcf(MACHINE)


def test_weights_go_where_the_names_are(machine):
    cost = TrackingCost.joints(
        machine, "wave", 4, dt=0.5, position={"shoulder": 2.0, "wrist": [3.0, 4.0, 5.0]}, velocity=0.1,
        activation={"muscle": 6.0}, final_position={"root": 7.0}, final_velocity=np.arange(10.0),
        final_activation=8.0, effort=[1.0, 2.0, 3.0],
    )  # fmt: skip
    running = np.concatenate([np.zeros(6), [2.0, 3.0, 4.0, 5.0], np.full(NV, 0.1), [6.0]])
    final = np.concatenate([np.full(6, 7.0), np.zeros(4), np.arange(10.0), [8.0]])
    for n in range(4):
        np.testing.assert_array_equal(cost.Q[n], 0.5 * np.diag(running))
        np.testing.assert_array_equal(cost.R[n], 0.5 * np.diag([1.0, 2.0, 3.0]))
    np.testing.assert_array_equal(cost.Q[4], np.diag(final))
    np.testing.assert_array_equal(cost.x_ref, np.tile(machine.keyframe("wave"), (5, 1)))
    assert cost.space == machine.space
    assert (cost.nx, cost.ndx, cost.nu, cost.N) == (NX, NDX, 3, 4)


def test_the_dynamics_tell_the_stage_and_prescribed_joints(machine):
    """Prescribed joints are inputs in the order of qvel, whatever order they are named in."""
    dynamics = RigidBodyDynamics(machine, 0.25, prescribed=("wrist", "shoulder"))
    assert dynamics.nu == 7
    effort = {"wrist": [4.0, 5.0, 6.0], "motor": 1.0, "muscle": 2.0, "shoulder": 3.0}
    with pytest.raises(PlannerError, match="effort of control 2 is 0, expected a weight above 0"):  # it has no name
        TrackingCost.joints(dynamics, "wave", 2, effort=effort)
    named = Mechanism.from_mjcf(MACHINE.replace('<motor joint="wrist"', '<motor name="twist" joint="wrist"'))
    dynamics = RigidBodyDynamics(named, 0.25, prescribed=("wrist", "shoulder"))
    cost = TrackingCost.joints(dynamics, "wave", 2, effort=effort | {"twist": 9.0}, control=np.arange(7.0))
    np.testing.assert_array_equal(cost.R[0], 0.25 * np.diag([1.0, 2.0, 9.0, 3.0, 4.0, 5.0, 6.0]))
    np.testing.assert_array_equal(cost.u_ref, np.tile(np.arange(7.0), (2, 1)))


def test_references_on_the_way_and_the_goal_at_the_end(machine):
    rng = np.random.default_rng(3)
    reference, goal = states(rng, machine.space, 4), states(rng, machine.space, 1)[0]
    given = reference.copy()
    along = TrackingCost.joints(machine, None, 3, effort=1.0, dt=0.1, reference=3.0 * reference)
    for i, _ in machine.space.quaternions:  # normalized, the rest as given
        np.testing.assert_allclose(along.x_ref[:, i : i + 4], reference[:, i : i + 4], rtol=1e-14)
    ends = TrackingCost.joints(machine, goal, 3, effort=1.0, dt=0.1, reference=reference)
    np.testing.assert_allclose(ends.x_ref, [*reference[:3], goal], rtol=1e-14)
    np.testing.assert_array_equal(reference, given)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"position": {"sholder": 1.0}},
         "the joint in position is 'sholder', expected one of: root, shoulder, wrist. Did you mean 'shoulder'?"),
        ({"activation": {"motor": 1.0}}, "the actuator in activation is 'motor', expected one of: muscle."),
        ({"effort": {"arm": 1.0}}, "the control in effort is 'arm', expected one of: motor, muscle."),
        ({"effort": {"muscle": 1.0}}, "effort of control 0 'motor' is 0, expected a weight above 0."),
        ({"effort": 0.0}, "effort of control 0 'motor' is 0, expected a weight above 0."),
        ({"velocity": -1.0}, "velocity has the weight -1, expected weights of at least 0."),
        ({"final_velocity": {"wrist": [1.0, 2.0]}}, "final_velocity['wrist'] has shape (2,), expected (3,)."),
        ({"position": [1.0, 2.0]}, "position has shape (2,), expected (10,)."),
        ({"position": np.nan}, "position[0] is nan, expected finite numbers."),
        ({"position": "much"}, "position is 'much', expected numbers."),
        ({"position": {"wrist": {"x": 1.0}}}, "position['wrist'] is {'x': 1.0}, expected numbers."),
        ({"goal": "bow"}, "keyframe is 'bow', expected one of: wave."),
        ({"goal": np.ones(3)}, "goal has shape (3,), expected (23,)."),
        ({"goal": np.zeros(NX)}, "goal has a quaternion of length zero at 3 to 6, expected e.g. 1, 0, 0, 0."),
        ({"goal": None}, "goal is None and there is no reference, expected one of the two."),
        ({"reference": np.ones((3, NX))}, "reference has shape (3, 23), expected (5, 23)."),
        ({"control": [1.0, 2.0]}, "control has shape (2,), expected (3,)."),
        ({"dt": None}, "dt is None, expected the length of a stage in s, since a Mechanism has none."),
        ({"dt": -1.0}, "dt is -1.0, expected a finite number greater than 0."),
        ({"machine": "robot"}, "the machine is 'robot', expected RigidBodyDynamics or a Mechanism."),
    ],
)  # fmt: skip
def test_wrong_joint_weights_are_refused_in_one_sentence(machine, changes, expected):
    arguments = {"machine": machine, "goal": "wave", "horizon": 4, "effort": 1.0, "dt": 0.1, **changes}
    with pytest.raises(PlannerError) as error:
        TrackingCost.joints(arguments.pop("machine"), arguments.pop("goal"), arguments.pop("horizon"), **arguments)
    assert str(error.value) == expected


def test_machines_whose_joints_have_no_names():
    text = '<mujoco><worldbody><body><joint/><geom size="1"/></body></worldbody></mujoco>'
    nameless = Mechanism.from_mjcf(text)
    with pytest.raises(PlannerError) as error:
        TrackingCost.joints(nameless, np.zeros(2), 4, effort=1.0, dt=0.1, position={"j": 1.0})
    assert str(error.value) == "position names the joint 'j', but no joint has a name: expected a number."
