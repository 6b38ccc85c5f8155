"""Closed chains: multipliers by a KKT system, complex steps, a closed form, energy and drift."""

import re
from dataclasses import replace

import numpy as np
import pytest
from places import ROOT

from planner import PlannerError, Problem, RigidBodyDynamics
from planner.base.gl import load_mujoco
from planner.costs import default_cost
from planner.dynamics import (
    assembled,
    closed_dynamics,
    constraint_forces,
    constraint_names,
    forward_dynamics,
    loops,
    product_of_exponentials,
)
from planner.dynamics.assembly import check_assembled, feasible_directions, relative_min_singular_value
from planner.dynamics.joint_forces import friction_forces
from planner.model.couplings import BAUMGARTE_RATE, Coupling, closed_state
from planner.model.mechanism import SCREW, Mechanism
from planner.model.mjcf.equalities import set_hard
from planner.proof.compare.rigid_parity import rigid_parity
from tests.closed_chains import PARALLELOGRAM, four_bar, parallelogram_acceleration, random_chain
from tests.trees import machines, random_state, stepped


def split(m, x):
    return np.split(x, [m.nq, m.nq + m.nv])[:2]


def can_be_closed(m, q):
    """Whether the equations are independent: where they contradict each other no accelerations keep them."""
    if not (m.loops or m.polynomial_couplings):
        return False
    J = loops.jacobian(m, q)
    return np.linalg.matrix_rank(J, tol=1e-4 * np.linalg.norm(J)) == len(J)


def rates(m, x, u):
    """Accelerations (nv,) of the compiled dynamics."""
    return RigidBodyDynamics(m, 0.01).rates(x[None], u[None])[0, m.nv : 2 * m.nv]


def bound_of(m, q, J):
    """What rounding does: the condition of the masses times that of the constraints in their metric."""
    M = product_of_exponentials.mass_matrix(m, q)
    values = np.linalg.eigvalsh(J @ np.linalg.solve(M, J.T))
    return 1e-14 * np.linalg.cond(M) * (values.max() / values.min())


@machines(20, max_dofs=18)
def test_accelerations_are_those_of_multipliers(text, seed):
    """At any state: what lacks of the constraints is pulled back, and forces act along J' alone."""
    rng = np.random.default_rng(seed)
    m = random_chain(text, rng)
    x, u = random_state(m.space, rng, unnormalized=False), rng.normal(size=m.nu)
    q, qd = split(m, x)
    if not can_be_closed(m, q):
        return
    tau = product_of_exponentials.rnea(
        m, q, qd, RigidBodyDynamics(without(m), 0.01).rates(x[None], u[None])[0, m.nv : 2 * m.nv]
    )
    J = loops.jacobian(m, q)
    qdd, f = closed_dynamics(m, q, qd, tau)
    left, M = (
        product_of_exponentials.rnea(m, q, qd, qdd) - tau - J.T @ f,
        np.abs(product_of_exponentials.mass_matrix(m, q)),
    )
    scale = np.abs(qdd).max() + 1.0
    assert np.abs(left).max() <= bound_of(m, q, J) * (M.sum(axis=1).max() * scale + np.abs(tau).max())
    assert np.abs(rates(m, x, u) - qdd).max() <= 100.0 * bound_of(m, q, J) * scale


def without(m):
    """Its tree."""
    return replace(m, loops=(), polynomial_couplings=())


@machines(12, max_dofs=16)
def test_what_is_to_be_zero_moves_as_its_jacobian_says(text, seed):
    """Places and cams by a complex step; Jdot qd by a complex step of J qd along qd."""
    rng = np.random.default_rng(seed)
    m = random_chain(text, rng)
    if not (m.loops or m.polynomial_couplings):
        return
    q, qd = split(m, random_state(m.space, rng, unnormalized=False))
    h = 1e-30
    there = stepped(m, q, qd, 1j * h)
    turning = np.concatenate(
        [*(np.arange(loop.rows) >= 3 for loop in m.loops), np.zeros(len(m.polynomial_couplings), dtype=bool)]
    )
    moved, J = loops.misses(m, there).imag / h, loops.jacobian(m, q)
    np.testing.assert_allclose(moved[~turning], (J @ qd)[~turning], rtol=0.0, atol=1e-12 * (1.0 + np.abs(J @ qd).max()))
    drift = (loops.jacobian(m, there) @ qd).imag / h
    np.testing.assert_allclose(loops.closure_bias(m, q, qd), drift, rtol=0.0, atol=1e-11 * (1.0 + np.abs(drift).max()))


@machines(12, max_dofs=14)
def test_derivatives_are_those_of_a_complex_step(text, seed):
    """Along random directions of positions and velocities, of a machine with actuators of all kinds."""
    rng = np.random.default_rng(seed)
    m = random_chain(text, rng)
    x, u = random_state(m.space, rng, unnormalized=False), rng.normal(size=m.nu)
    q, qd = split(m, x)
    if not can_be_closed(m, q):
        return
    dt, h = 1e-3, 1e-30
    dynamics = RigidBodyDynamics(m, dt, "euler")
    A, _ = dynamics.linearize(np.stack([x, x]), u[None])
    dq, dqd = rng.normal(size=(2, m.nv))
    tau, dtau = _forces(m, x, u, dq, dqd)
    moved = closed_dynamics(m, stepped(m, q, dq, 1j * h), qd + 1j * h * dqd, tau + 1j * h * dtau)[0].imag / h
    found = (A[0, m.nv : 2 * m.nv, : 2 * m.nv] @ np.concatenate([dq, dqd]) - dqd) / dt
    bound = 1e4 * bound_of(m, q, loops.jacobian(m, q))
    assert np.abs(found - moved).max() <= bound * (1.0 + np.abs(moved).max())


def _forces(m, x, u, dq, dqd):
    """The applied forces at a state, of actuators and stops, and how they change: of the tree, which has no loops."""
    tree = RigidBodyDynamics(without(m), 1e-3, "euler")
    q, qd = split(m, x)
    qdd = tree.rates(x[None], u[None])[0, m.nv : 2 * m.nv]
    A = tree.linearize(np.stack([x, x]), u[None])[0][0, m.nv : 2 * m.nv, : 2 * m.nv]
    moves = (A @ np.concatenate([dq, dqd]) - dqd) / 1e-3
    h = 1e-30
    tau = product_of_exponentials.rnea(m, stepped(m, q, dq, 1j * h), qd + 1j * h * dqd, qdd + 1j * h * moves)
    return tau.real, tau.imag / h


@pytest.mark.parametrize("q", [-2.0, -0.3, 0.0, 0.7, 3.0])
def test_a_parallelogram_is_a_pendulum(q):
    """Its closed form in one coordinate, at rest and in motion: the coupler does not turn."""
    m = Mechanism.from_mjcf(PARALLELOGRAM)
    for speed in (0.0, 2.0):
        x = np.array([q, -q, q, speed, -speed, speed])
        check_assembled("x", x, m)
        qdd = rates(m, x, np.array([1.5]))
        np.testing.assert_allclose(qdd, parallelogram_acceleration(q, 1.5) * np.array([1.0, -1.0, 1.0]), rtol=1e-9)


@pytest.mark.parametrize(("dt", "speed"), [(0.002, 1.5), (0.01, 1.5), (0.02, 8.0)])
def test_energy_is_kept_and_chains_stay_closed(dt, speed):
    """A four-bar without damping for 4 s at up to 23 rad/s: at 2 ms RK4 keeps energy, per second 15^5 (2e-3)^4."""
    m = four_bar(damping=0.0)
    dynamics = RigidBodyDynamics(m, dt)
    x = assembled(m, np.array([0.3, -0.1, 0.2, speed, 0.0, 0.0]), given=(0,))

    def energy(x):
        q, qd = split(m, x)
        places = [
            T @ np.append(com, 1.0) for T, com in zip(product_of_exponentials.world_poses(m, q), m.com, strict=False)
        ]
        return 0.5 * qd @ product_of_exponentials.mass_matrix(m, q) @ qd + 9.81 * sum(
            w * p[2] for w, p in zip(m.mass, places, strict=True)
        )

    before, most, fastest = energy(x), 0.0, 0.0
    for _ in range(round(4.0 / dt)):
        x = dynamics.step(x[None], np.zeros((1, 1)))[0]
        q, qd = split(m, x)
        most = max(most, np.abs(loops.misses(m, q)).max())
        fastest = max(fastest, np.abs(loops.jacobian(m, q) @ qd).max())
    assert most < 1e-6
    assert fastest < 1e-6
    if dt == 0.002:
        assert abs(energy(x) - before) < 1e-5 * abs(before)


def projected_state(mechanism, q, qd):
    """Positions q (nq,) and velocities (nv,) projected onto the loop closures, as kernels.tree.loop_projection.

    RK4 applies it after each stage: one minimum-norm step to first order, within the couplings.
    """
    G = np.eye(mechanism.nv) if mechanism.reduction is None else mechanism.reduction.G
    J = loops.jacobian(mechanism, q) @ G
    step = -G @ np.linalg.lstsq(J, loops.misses(mechanism, q), rcond=1e-9)[0]
    x = np.concatenate([q, np.zeros(mechanism.space.nx - len(q))])
    q = mechanism.space.integrate(x, np.append(step, np.zeros(mechanism.space.ndx - len(step))))[: len(q)]
    J = loops.jacobian(mechanism, q)
    return q, qd - G @ np.linalg.lstsq(J @ G, J @ qd, rcond=1e-9)[0]


@machines(12, max_dofs=16)
def test_a_stage_ends_where_the_slow_twin_has_it(text, seed):
    """From states off the chain: a stage that takes no time is the step back alone."""
    rng = np.random.default_rng(seed)
    m, _, _ = everything(text, rng)
    x = closed_state(m, random_state(m.space, rng, unnormalized=False))
    q, qd = split(m, x)
    G = np.eye(m.nv) if m.reduction is None else m.reduction.G
    if not well_closed(m, q, G):
        return
    end = RigidBodyDynamics(m, 1e-14).step(x[None], np.zeros((1, m.nu)))[0]
    places, speeds = projected_state(m, q, qd)
    J = loops.jacobian(m, places) @ G
    if np.linalg.cond(J.T) > 1e3:
        return
    scale = 1.0 + np.abs(speeds).max() + np.abs(loops.misses(m, q)).max()
    assert np.abs(split(m, end)[0] - places).max() <= 1e-8 * scale  # cond^2 times rounding, and a moment's motion
    assert np.abs(split(m, end)[1] - speeds).max() <= 1e-8 * scale


def test_redundant_equations_change_nothing():
    """A pin that is said twice, or as a weld that a planar machine keeps anyway, gives the same accelerations."""
    m = four_bar()
    x, u = assembled(m, np.array([0.4, 0.0, 0.0, 1.0, 0.0, 0.0]), given=(0,)), np.array([0.7])
    again = '<connect name="again" body1="coupler" body2="rocker" anchor=".5 0 .1"/></equality>'
    twice = Mechanism.from_mjcf(m.mjcf.replace("</equality>", again))
    np.testing.assert_allclose(rates(twice, x, u), rates(m, x, u), rtol=1e-10)


def test_directions_are_those_that_keep_the_chain_closed():
    m = four_bar()
    q = assembled(m, np.array([0.4, 0.0, 0.0, 0.0, 0.0, 0.0]), given=(0,))[:3]
    Z, leading = feasible_directions(m, q)
    assert leading.tolist() == [0]  # the one with a motor
    assert Z[0, 0] == pytest.approx(1.0, abs=1e-14)
    assert np.abs(loops.jacobian(m, q) @ Z).max() < 1e-12


def test_states_are_put_together_or_refused():
    m = four_bar()
    x = assembled(m, np.array([0.5, 0.3, -0.2, 2.0, 1.0, 0.0]), given=(0,))
    assert x[0] == 0.5
    assert np.abs(loops.misses(m, x[:3])).max() < 1e-12
    assert np.abs(loops.jacobian(m, x[:3]) @ x[3:]).max() < 1e-12
    with pytest.raises(PlannerError, match=r"misses equality 'pin' by 0\.\d+ m, and no motion"):
        assembled(m, np.array([2.8, -2.8, 0.0, 0.0, 0.0, 0.0]), given=(0, 2))
    dynamics = RigidBodyDynamics(m, 0.01)
    with pytest.raises(PlannerError, match=r"x0 misses equality 'pin' by .* planner\.dynamics\.assembled"):
        Problem(dynamics, default_cost(dynamics, x, x, 10), x0=np.array([0.5, 0.0, 0.0, 0.0, 0.0, 0.0]))
    with pytest.raises(PlannerError, match="velocities that open the chains"):
        Problem(dynamics, default_cost(dynamics, x, x, 10), x0=np.append(x[:3], [1.0, 0.0, 0.0]))


def test_the_algorithms_of_trees_refuse_closed_chains():
    m = four_bar()
    with pytest.raises(PlannerError, match=r"equality 'pin', which closes a chain.*closed_dynamics"):
        forward_dynamics(m, m.qpos0, np.zeros(3), np.zeros(3))


def test_a_stage_of_a_tenth_of_a_second_is_stable():
    """RK4 takes rates up to 2.7 / dt; the pull back onto the constraints has two of RATE."""
    assert BAUMGARTE_RATE * 0.1 < 2.7


def everything(text, rng):
    """A random chain with friction loss, couplings and prescribed joints, and the directions Z that couplings leave."""
    rough = re.sub(r'(type="(hinge|slide)")', r'\1 frictionloss="0.4"', text)
    m, screws = random_chain(rough, rng, loops=1), []
    for i in np.flatnonzero(m.kind == SCREW):
        links = m.joint_links[m.joint_names.index(m.joint_of(int(i)).split("'")[1])]
        if links.stop - links.start == 1 and not any(i in cam.dofs for cam in m.polynomial_couplings):
            screws.append(int(i))
    screws = rng.permutation(screws)
    prescribed = [m.joint_of(int(i)).split("'")[1] for i in screws[:1]] if len(screws) > 4 else []
    if len(screws) > 2:
        pair = tuple(int(i) for i in screws[1:3])
        m = replace(m, couplings=(Coupling("equality of two", pair, (1.0, float(rng.normal())), 0.0),))
    G = np.eye(m.nv) if m.reduction is None else m.reduction.G
    given = [dof for name in prescribed for dof in range(m.nv)[m.joint(name)]]
    return m, prescribed, G[:, ~np.any(G[given] != 0.0, axis=0)]


def well_closed(m, q, Z):
    """Whether the equations are independent in the directions Z, far from singular."""
    if not (m.loops or m.polynomial_couplings) or not Z.shape[1]:
        return False
    J = loops.jacobian(m, q) @ Z
    return len(J) <= Z.shape[1] and np.linalg.cond(J.T) < 1e3


@machines(20, max_dofs=18, plain=True)
def test_chains_beside_friction_couplings_and_prescribed_joints(text, seed):
    """The equations of motion with the forces that constraint_forces finds, and the chains' own, at any state."""
    rng = np.random.default_rng(seed)
    m, prescribed, Z = everything(text, rng)
    dynamics = RigidBodyDynamics(m, 0.01, prescribed=prescribed)
    x, u = closed_state(m, random_state(m.space, rng, unnormalized=False)), rng.normal(size=dynamics.nu)
    q, qd = split(m, x)
    if not well_closed(m, q, Z):
        return
    qdd = dynamics.rates(x[None], u[None])[0, m.nv : 2 * m.nv]
    tree = RigidBodyDynamics(replace(without(m), couplings=(), friction_loss=np.zeros(m.nv)), 0.01)
    tau = product_of_exponentials.rnea(m, q, qd, tree.rates(x[None], u[None, : m.nu])[0, m.nv : 2 * m.nv])
    f, J = constraint_forces(dynamics, x[None], u[None])[0], loops.jacobian(m, q)
    scale = (
        np.abs(product_of_exponentials.mass_matrix(m, q)).sum(axis=1).max() * (np.abs(qdd).max() + 1.0)
        + np.abs(tau).max()
    )
    left = product_of_exponentials.rnea(m, q, qd, qdd) - tau - friction_forces(m, qd, qdd)[0] - J.T @ f
    assert np.abs(Z.T @ left).max() <= 1e-9 * scale  # cond(J)^2 times rounding, and some tens of operations
    lacks = (
        J @ qdd
        + loops.closure_bias(m, q, qd)
        + 2.0 * BAUMGARTE_RATE * (J @ qd)
        + BAUMGARTE_RATE**2 * loops.misses(m, q)
    )
    assert np.abs(lacks).max() <= 1e-9 * (np.abs(J).sum(axis=1).max() * np.abs(qdd).max() + BAUMGARTE_RATE**2)


@pytest.mark.parametrize("integrator", ["rk4", "semi-implicit-euler"])
@machines(8, max_dofs=12)
def test_derivatives_of_stages_are_those_of_differences(integrator, text, seed):
    rng = np.random.default_rng(seed)
    m, prescribed, Z = everything(text, rng)
    dynamics, space = RigidBodyDynamics(m, 5e-3, integrator, prescribed), m.space
    x, u = closed_state(m, random_state(m.space, rng, unnormalized=False)), rng.normal(size=dynamics.nu)
    if not well_closed(m, x[: m.nq], Z):
        return
    A, B = (part[0] for part in dynamics.linearize(np.stack([x, x]), u[None]))
    h, dx, du = 1e-5, rng.normal(size=space.ndx), rng.normal(size=dynamics.nu)
    ends = [dynamics.step(space.integrate(x, s * h * dx)[None], (u + s * h * du)[None])[0] for s in (1.0, -1.0)]
    moved = space.difference(ends[0], ends[1]) / (2.0 * h)
    scale = np.abs(A).sum(axis=1).max() + np.abs(B).sum(axis=1).max()
    assert np.abs(A @ dx + B @ du - moved).max() <= 1e-5 * scale  # h^2 times third derivatives, of up to 1e5


def test_forces_of_a_parallelogram_are_those_of_statics():
    """At rest, upright: the coupler's weight rests half on each crank, and nothing pushes sideways."""
    m = Mechanism.from_mjcf(PARALLELOGRAM)
    dynamics = RigidBodyDynamics(m, 0.01)
    f = constraint_forces(dynamics, np.zeros((1, 6)), np.zeros((1, 1)))[0]
    np.testing.assert_allclose(f, [0.0, 0.0, 0.5 * 2.0 * 9.81], atol=1e-9)  # on the coupler, whose mass is 2 kg
    assert [(one.name, one.unit) for one in constraint_names(m)][2] == ("equality 'pin' z", "N")


def test_a_parallelogram_that_folds_flat_goes_through():
    """All of its bars lie in line at a quarter turn, where J loses a rank and the chain could fold two ways."""
    m = Mechanism.from_mjcf(PARALLELOGRAM)
    flat = np.array([0.5 * np.pi, -0.5 * np.pi, 0.5 * np.pi])
    assert np.linalg.matrix_rank(loops.jacobian(m, flat), tol=1e-9) == 1
    dynamics, x = RigidBodyDynamics(m, 0.01), np.array([0.9, -0.9, 0.9, 3.0, -3.0, 3.0])
    for _ in range(60):
        x = dynamics.step(x[None], np.zeros((1, 1)))[0]
    assert x[0] > 2.0  # beyond it
    np.testing.assert_allclose(x[:3], x[0] * np.array([1.0, -1.0, 1.0]), atol=1e-6)
    first, last = relative_min_singular_value(m, np.array([0.5 * flat, flat]))
    assert first > 0.1
    assert last < 1e-9


@pytest.mark.parametrize("angle", [-1e-2, -1e-4, -1e-6, 1e-6, 1e-4, 1e-2, 0.8])
def test_a_planar_chain_on_a_turntable_is_pulled_closed_at_every_angle(angle):
    """Two rows hold it. The third, along its axis, is next to zero and must not stand in for one of them."""
    text = PARALLELOGRAM.replace("0 1 0", "1 0 0").replace(".6 0 0", "0 .6 0").replace(".3 0 0", "0 .3 0")
    head, tail = '<worldbody><body name="table"><joint axis="0 0 1"/><geom size=".1" mass="9"/>', "</body></worldbody>"
    m = Mechanism.from_mjcf(text.replace("<worldbody>", head).replace("</worldbody>", tail))
    dynamics = RigidBodyDynamics(m, 1e-7, "euler")
    x = assembled(m, np.array([angle, 0.3, -0.3, 0.3, 1.0, 0.0, 0.0, 0.0]))
    A, _ = dynamics.linearize(np.array([x, x]), np.zeros((1, 1)))
    rates = np.linalg.eigvals((A[0] - np.eye(8)) / 1e-7).real
    assert rates.max() < 10.0  # 1/s, a falling parallelogram's are 4; two times speed over angle with the third row


@pytest.mark.parametrize("example", ["four_bar", "two_arms", pytest.param("stewart", marks=pytest.mark.slow)])
def test_mujoco_as_hard_as_it_gets_accelerates_alike(example):
    """At random closed states in motion. 3.3.0 has no Jdot qd; 4.0.0 has."""
    if int(load_mujoco().__version__.split(".")[0]) < 4:
        pytest.skip("3.3.0 has no Jdot qd")
    m = Mechanism.from_mjcf((ROOT / "examples" / "closed_chains" / f"{example}.xml").read_text(encoding="utf-8"))
    section = rigid_parity(m, load_mujoco().MjModel.from_xml_string(m.mjcf), None, 40, 1e-10, seed=1)
    found = {one.name: one.value for one in section.measured}
    assert section.passed
    assert found["soft_acceleration_difference"] < 1e-4


@pytest.mark.parametrize("example", ["four_bar", "stewart"])
def test_what_mujoco_gives_way_by_is_the_softness_of_its_equalities(example):
    """With R on the diagonal of J W J', which it prints as efc_R, exact multipliers are MuJoCo's."""
    mujoco = load_mujoco()
    if int(mujoco.__version__.split(".")[0]) < 4:
        pytest.skip("3.3.0 has no Jdot qd")
    m = Mechanism.from_mjcf((ROOT / "examples" / "closed_chains" / f"{example}.xml").read_text(encoding="utf-8"))
    model = mujoco.MjModel.from_xml_string(m.mjcf.replace("<option", '<option jacobian="dense"', 1))
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_LIMIT)
    set_hard(model, model.opt.timestep)
    data, rng, mass = mujoco.MjData(model), np.random.default_rng(2), np.empty((m.nv, m.nv))
    for _ in range(5):
        dx = np.append(0.3 * rng.normal(size=m.nv), 3.0 * rng.normal(size=m.nv))
        x = assembled(m, m.space.integrate(assembled(m, m.home), dx))
        data.qpos[:], data.qvel[:] = split(m, x)
        mujoco.mj_forward(model, data)
        for row, axis in zip(mass, np.eye(m.nv), strict=True):
            mujoco.mj_mulM(model, data, row, axis)
        J, free = np.reshape(data.efc_J, (-1, m.nv)), data.qacc_smooth
        W = np.linalg.inv(mass)
        f = np.linalg.solve(J @ W @ J.T + np.diag(data.efc_R), data.efc_aref - J @ free)
        np.testing.assert_allclose(free + W @ J.T @ f, data.qacc, rtol=0.0, atol=1e-8 * np.abs(data.qacc).max())
