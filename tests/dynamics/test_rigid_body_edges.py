"""A mechanism in time where numbers end: far away, not finite, and wrong from the start."""

import re

import numpy as np
import pytest
from trees import CHAINS, actuated, driven, machines, random_state, relative_error

from planner.base.errors import PlannerError
from planner.dynamics import RigidBodyDynamics
from planner.kernels.integrators import INTEGRATORS
from planner.model.mechanism import Mechanism


@machines(8, max_dofs=20)
def test_dynamics_are_the_same_a_kilometre_away(text, seed):
    """Of trees on a base and of trees that float: beside them 1 m is lost to no rounding."""
    text = re.sub(r'type="free"( stiffness="\S+")?', 'type="free"', text)  # its springs know where it is
    shift = np.array([1e3, -1e3, 1e3])
    moved = text.replace("<worldbody>", '<worldbody><frame pos="1000 -1000 1000">')
    here, xs, us, _ = driven(text, seed, K=2)
    there, _, _, _ = driven(moved.replace("</worldbody>", "</frame></worldbody>"), seed, K=2)
    m = here.mechanism
    far, roots = xs.copy(), [links for links in m.joint_links if links.stop - links.start == 6]
    for links in roots:
        a = m.q_address[links.start]
        far[:, a : a + 3] += shift
    assert relative_error(there.rates(far, us), here.rates(xs, us)) < 1e-11
    for one, other in zip(there.linearize(far, us), here.linearize(xs, us), strict=True):
        assert relative_error(one, other) < 1e-11


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("name", CHAINS)
def test_numbers_that_are_not_finite_stay_in_their_row(name, integrator):
    m, rng = Mechanism.from_mjcf(actuated(CHAINS[name], np.random.default_rng(0))), np.random.default_rng(0)
    dynamics = RigidBodyDynamics(m, 0.01, integrator)
    xs = np.array([random_state(m.space, rng) for _ in range(5)])
    us = rng.normal(size=(5, dynamics.nu))
    clean = dynamics.step(xs, us), dynamics.linearize(xs, us), dynamics.rates(xs, us)
    for k in range(dynamics.nx + dynamics.nu):
        for bad in (np.nan, np.inf, 1e200):
            x, u = xs.copy(), us.copy()
            (x if k < dynamics.nx else u)[1, k if k < dynamics.nx else k - dynamics.nx] = bad
            ends, jacobians, rates = dynamics.step(x, u), dynamics.linearize(x, u), dynamics.rates(x, u)
            if np.isnan(bad):
                assert np.isnan(ends[1]).any()
            rest = [0, 2, 3, 4]
            np.testing.assert_array_equal(ends[rest], clean[0][rest])
            np.testing.assert_array_equal(jacobians[0][rest], clean[1][0][rest])
            np.testing.assert_array_equal(jacobians[1][rest], clean[1][1][rest])
            np.testing.assert_array_equal(rates[rest], clean[2][rest])


CART = """
<mujoco><worldbody><body><joint name="run" type="slide"/><geom size="1"/></body></worldbody>
  <option><flag contact="disable"/></option>{}</mujoco>
"""
DRIVEN = CART.format('<actuator><motor joint="run"/></actuator>')


def cart(text=DRIVEN, dt=0.1, **options):
    return RigidBodyDynamics(Mechanism.from_mjcf(text), dt, **options)


ONE, TWO = np.zeros((3, 1)), np.zeros((3, 2))
WRONG = {
    "mechanism is 3, expected a Mechanism": lambda: RigidBodyDynamics(3, 0.1),  # pyright: ignore[reportArgumentType]
    "dt is 0.0, expected a finite number greater than 0": lambda: cart(dt=0.0),
    "dt is -0.1, expected": lambda: cart(dt=-0.1),
    "dt is nan, expected": lambda: cart(dt=np.nan),
    "integrator is 'rk5', expected one of: euler, semi-implicit-euler, rk4": lambda: cart(integrator="rk5"),
    "joint is 'walk', expected one of: run": lambda: cart(prescribed=["walk"]),
    "the model has no actuators, expected at least one <actuator> or a prescribed joint": lambda: cart(CART.format("")),
    "us has shape (3, 2), expected (K, 1)": lambda: cart().step(TWO, TWO),
    "xs has shape (3, 1), expected (3, 2)": lambda: cart().step(ONE, ONE),
    "xs has shape (2, 2), expected (3, 2)": lambda: cart().rates(TWO[:2], ONE),
    "dt has shape (2,), expected (3,)": lambda: cart().step(TWO, ONE, np.ones(2)),
    "dt[1] is nan, expected finite numbers": lambda: cart().step(TWO, ONE, np.array([1.0, np.nan, 1.0])),
    "xs has shape (3, 1), expected (3, 2).": lambda: cart().linearize(ONE, ONE),
}


@pytest.mark.parametrize("sentence", WRONG)
def test_wrong_shapes_are_refused_in_one_sentence(sentence):
    with pytest.raises(PlannerError) as error:
        WRONG[sentence]()
    assert str(error.value).startswith(sentence)
    assert "\n" not in str(error.value)


def test_a_prescribed_joint_drives_a_model_without_actuators():
    dynamics = cart(CART.format(""), prescribed="run")
    assert dynamics.nu == 1
    np.testing.assert_allclose(dynamics.step(np.zeros((1, 2)), [[2.0]])[0], [0.01, 0.2], rtol=1e-15)
