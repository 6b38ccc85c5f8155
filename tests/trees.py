"""Random machines as MJCF text, random states of them, and what MuJoCo says about both.

Hypothesis draws the structure, so that a failing tree shrinks to a small one; the numbers come from a generator that
Hypothesis seeds.
"""

import os
import re
from dataclasses import dataclass, replace

import numpy as np
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from planner import Problem, TrackingCost
from planner.base.gl import load_mujoco
from planner.dynamics import RigidBodyDynamics
from planner.model.mechanism import SCREW, Mechanism
from planner.model.space import exp_quaternion, product

mujoco = load_mujoco()

SHARE = float(os.environ.get("PLANNER_MACHINES", "0.5"))
"""Share of its random machines that a test tries; .ci/run tries them all, where it runs the kernels a second time."""

DOFS = {"hinge": 1, "slide": 1, "ball": 3, "free": 6}
# What one body may carry in one row: MuJoCo allows no rotation after a ball and nothing beside a free joint.
ROWS = [
    (),
    ("hinge",),
    ("slide",),
    ("ball",),
    ("hinge", "hinge"),
    ("slide", "hinge"),
    ("hinge", "slide"),
    ("hinge", "ball"),
    ("ball", "slide"),
    ("slide", "slide", "slide", "hinge", "hinge", "hinge"),
]


def text(values):
    """Numbers as an attribute's value, to the last bit."""
    return " ".join(repr(float(value)) for value in np.atleast_1d(values))


@dataclass
class Body:
    """One body of a tree: its parent's index (-1: the world), its joints, and the XML of its own."""

    parent: int
    joints: tuple[str, ...]


@st.composite
def structures(draw, max_dofs=40, max_bodies=12, plain=False):
    """A list of bodies, parents first, with at least one joint and at most max_dofs degrees of freedom.

    Plain ones have hinges and slides only.
    """
    bodies, dofs = [], 0
    several = [row for row in ROWS if not (plain and "ball" in row)]
    for i in range(draw(st.integers(1, max_bodies))):
        parent = draw(st.integers(max(-1, i - 4), i - 1))
        rows = [*several, ("free",), ("free",)] if parent < 0 and not plain else several
        joints = draw(st.sampled_from(rows))
        if dofs + sum(DOFS[kind] for kind in joints) > max_dofs:
            joints = ()
        if i == 0 and not joints:
            joints = ("hinge",)
        dofs += sum(DOFS[kind] for kind in joints)
        bodies.append(Body(parent, joints))
    return bodies


def joint_xml(rng, kind, name, row, axis):
    """A joint with each property present in about half of the cases."""
    attributes = {"name": name, "type": kind}
    if kind in ("hinge", "slide"):
        attributes["axis"] = text(axis)
        if rng.random() < 0.5:
            attributes["ref"] = text(rng.normal())
        if rng.random() < 0.5:
            attributes["springref"] = text(rng.normal())
    # a hinge through the centre of a ball of the same body would add no motion, and M would be singular
    if kind in ("hinge", "ball") and (row == ("hinge", "ball") or rng.random() < 0.7):
        attributes["pos"] = text(rng.normal(size=3) * 0.3)
    for attribute, scale in [("stiffness", 5.0), ("damping", 1.0), ("armature", 0.2)]:
        if rng.random() < 0.5:
            attributes[attribute] = text(rng.random() * scale)
    return "<joint " + " ".join(f'{key}="{value}"' for key, value in attributes.items()) + "/>"


def inertial_xml(rng):
    """A mass whose principal moments come from second moments of a body, so that they obey the triangle inequality."""
    mass = 0.2 + rng.random()
    x, y, z = mass * (0.02 + 0.1 * rng.random(3))
    moments = np.array([y + z, x + z, x + y])
    place = f'<inertial pos="{text(rng.normal(size=3) * 0.2)}" mass="{text(mass)}"'
    if rng.random() < 0.5:
        return f'{place} quat="{text(rng.normal(size=4))}" diaginertia="{text(moments)}"/>'
    basis = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    full = basis @ np.diag(moments) @ basis.T
    return f'{place} fullinertia="{text(full[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]])}"/>'


def body_xml(bodies, i, rng):
    """A body with its sites and children; sometimes in a frame, sometimes its mass on a body welded to it."""
    name, children = f"body{i}", [j for j in range(len(bodies)) if bodies[j].parent == i]
    row = bodies[i].joints
    # axes of one body are skew, yet never so close to one plane that M is nearly singular
    axes = np.tile(np.linalg.qr(rng.normal(size=(3, 3)))[0], (2, 1)) + rng.uniform(-0.2, 0.2, (6, 3))
    joints = "".join(joint_xml(rng, row[k], f"{name}_joint{k}", row, axes[k]) for k in range(len(row)))
    mass = inertial_xml(rng)
    if rng.random() < 0.2:
        mass = f'<body name="{name}_weld" pos="{text(rng.normal(size=3) * 0.2)}">{mass}</body>'
    site = f'<site name="site{i}" pos="{text(rng.normal(size=3))}" quat="{text(rng.normal(size=4))}"/>'
    place = f'pos="{text(rng.normal(size=3) * 0.5)}" quat="{text(rng.normal(size=4))}"'
    inner = "".join(body_xml(bodies, j, rng) for j in children)
    body = f'<body name="{name}" {place}>{joints}{mass}{site}{inner}</body>'
    if "free" not in row and rng.random() < 0.2:
        body = f'<frame pos="{text(rng.normal(size=3))}" euler="{text(rng.normal(size=3))}">{body}</frame>'
    return body


def tree_xml(bodies, rng):
    """The MJCF text of a structure."""
    roots = "".join(body_xml(bodies, i, rng) for i in range(len(bodies)) if bodies[i].parent < 0)
    return (
        '<mujoco><compiler angle="radian"/>'
        f'<option gravity="{text(rng.normal(size=3) * 5.0)}"><flag contact="disable"/></option>'
        f"<worldbody>{roots}</worldbody></mujoco>"
    )


def mechanism_texts(max_dofs=40, max_bodies=12, plain=False):
    """Strategy for MJCF texts of random trees."""
    return st.builds(
        lambda bodies, seed: tree_xml(bodies, np.random.default_rng(seed)),
        structures(max_dofs, max_bodies, plain),
        st.integers(0, 2**32 - 1),
    )


def share_of(examples):
    """How many random machines a test tries of those that it names."""
    return max(4, round(SHARE * examples))


def machines(examples, max_dofs=40, max_bodies=12, plain=False, **more):
    """Decorator: a test of (text, seed, ...) on that many random machines, the same ones in every run."""

    def decorate(test):
        texts = mechanism_texts(max_dofs, max_bodies, plain)
        whole = given(text=texts, seed=st.integers(0, 2**32 - 1), **more)(test)
        checks = [HealthCheck.too_slow, HealthCheck.data_too_large, HealthCheck.large_base_example]
        return settings(max_examples=share_of(examples), deadline=None, derandomize=True, suppress_health_check=checks)(
            whole
        )

    return decorate


ACTUATORS = (
    '<motor joint="{joint}" gear="{gear}"/>',
    '<general joint="{joint}" gear="{gear}" gainprm="{a}" biastype="affine" biasprm="{b} -{a} -{c}"/>',
    '<general joint="{joint}" gear="{gear}" gainprm="{a}" dyntype="integrator"/>',
    '<general joint="{joint}" gear="{gear}" gainprm="{a}" dyntype="filter" dynprm="0.3" biastype="affine"'
    ' biasprm="0 -{b} -{c}"/>',
)


def actuated(mjcf, rng, activations=True):
    """A text of tree_xml with actuators on most joints: motors, on hinges and slides also servos and activations."""
    joints = re.findall(r'<joint name="(\w+)" type="(\w+)"', mjcf)
    kept = [joint for joint in joints if rng.random() < 0.8] or joints[:1]
    elements = ""
    for name, kind in kept:
        single = kind in ("hinge", "slide")
        form = ACTUATORS[rng.integers(4 if activations else 2) if single else 0]
        gear, numbers = rng.normal(size=DOFS[kind]), 0.3 + rng.random(3)
        elements += form.format(joint=name, gear=text(gear), **dict(zip("abc", map(float, numbers), strict=True)))
    return mjcf.replace("</mujoco>", f"<actuator>{elements}</actuator></mujoco>")


def stepped(mechanism, q, direction, step):
    """Complex q: an imaginary step along the group, direction (nv,); Q exp(e) is Q (1, e/2) to first order."""
    result, screws = q.astype(complex), mechanism.kind == SCREW
    result[mechanism.q_address[screws]] += step * direction[screws]
    for a, i in mechanism.quaternions:
        result[a : a + 4] = product(q[a : a + 4], np.array([1.0, *(0.5 * step * direction[i : i + 3])]))
    return result


def random_state(space, rng, unnormalized=None):
    """A state x (nx,) of a mechanism's StateSpace: quaternions all over the group and near home, of length one or not.

    Args:
        space: Of the mechanism.
        rng: A generator.
        unnormalized: Whether quaternions are stretched; None draws it.
    """
    x = rng.normal(size=space.nx)
    for i, _ in space.quaternions:
        size = rng.choice([1e-6, 0.3, 2.0])
        x[i : i + 4] = exp_quaternion(size * rng.normal(size=3))
        if unnormalized or (unnormalized is None and rng.random() < 0.3):
            x[i : i + 4] *= rng.uniform(0.5, 2.0) * rng.choice([-1.0, 1.0])
    return x


def driven(text, seed, K, integrator="rk4", dt=0.02, prescribe=True):
    """Dynamics of a machine with actuators and perhaps prescribed joints, K states and controls, the generator."""
    rng = np.random.default_rng(seed)
    m = Mechanism.from_mjcf(actuated(text, rng))
    prescribed = [name for name in m.joint_names if prescribe and rng.random() < 0.15]
    dynamics = RigidBodyDynamics(m, dt, integrator, prescribed)
    xs = np.array([random_state(m.space, rng) for _ in range(K)])
    return dynamics, xs, rng.normal(size=(K, dynamics.nu)), rng


def damped(text, seed):
    """A drawn machine with dampers of 0.1 to 1e4, a state, a control (1, nu), and its model in MuJoCo."""
    dynamics, _, us, rng = driven(text, seed, K=1, prescribe=False)
    m = replace(dynamics.mechanism, damping=10.0 ** rng.uniform(-1, 4, dynamics.mechanism.nv))
    x = random_state(m.space, rng, unnormalized=False)
    model = mujoco.MjModel.from_xml_string(m.mjcf)
    model.dof_damping[:] = m.damping
    return m, x, us, model


def chain(*rows, seed=0):
    """The text of bodies with these joints, each on the one before, without dampers."""
    text = tree_xml([Body(i - 1, row) for i, row in enumerate(rows)], np.random.default_rng(seed))
    return re.sub(r' damping="\S+"', "", text)


CHAINS = {
    "arm": chain(("hinge",), ("slide", "hinge"), ("hinge",)),
    "balls": chain(("ball",), ("ball",), ("hinge",), seed=1),
    "body in space": chain(("free",), ("hinge", "ball"), seed=2),
    "body in space with a slide": chain(("free",), ("ball", "slide"), seed=3),
}


@dataclass
class Simulated:
    """What MuJoCo says at one state.

    Attributes:
        qacc: (nv,) qacc_smooth, without contacts and limits.
        M: (nv, nv).
        bias: (nv,) qfrc_bias - qfrc_passive.
        poses: (nbody, 4, 4).
    """

    qacc: np.ndarray
    M: np.ndarray
    bias: np.ndarray
    poses: np.ndarray


def data_at(model, qpos, qvel):
    """MjData with a state written into it."""
    data = mujoco.MjData(model)
    data.qpos, data.qvel = qpos, qvel
    return data


def simulated(model, qpos, qvel, tau):
    """MuJoCo's forward dynamics under applied forces tau (nv,)."""
    data = data_at(model, qpos, qvel)
    data.qfrc_applied = tau
    mujoco.mj_forward(model, data)
    M, column = np.empty((model.nv, model.nv)), np.empty(model.nv)
    for i in range(model.nv):  # mj_fullM takes other arguments since 3.10, mj_mulM the same in all versions
        mujoco.mj_mulM(model, data, column, np.eye(model.nv)[i])
        M[:, i] = column
    poses = np.tile(np.eye(4), (model.nbody, 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = data.xmat.reshape(-1, 3, 3), data.xpos
    return Simulated(data.qacc_smooth.copy(), M, data.qfrc_bias - data.qfrc_passive, poses)


def simulated_inverse(model, qpos, qvel, qacc):
    """MuJoCo's own inverse dynamics: the forces (nv,) that cause qacc."""
    data = data_at(model, qpos, qvel)
    data.qacc = qacc
    mujoco.mj_inverse(model, data)
    return data.qfrc_inverse.copy()


def site_jacobian(model, qpos, name):
    """(6, nv) mj_jacSite, rows linear, angular."""
    data = data_at(model, qpos, np.zeros(model.nv))
    mujoco.mj_forward(model, data)
    linear, angular = np.empty((3, model.nv)), np.empty((3, model.nv))
    mujoco.mj_jacSite(model, data, linear, angular, model.site(name).id)
    return np.vstack([linear, angular])


def relative_error(value, reference):
    """Largest deviation beside the largest entry of the reference (or beside 1 if that is more)."""
    return np.max(np.abs(value - reference), initial=0.0) / max(1.0, np.max(np.abs(reference), initial=0.0))


def weights(rng, n, full):
    """(n, n) positive definite: full, or a diagonal."""
    if not full:
        return np.diag(0.1 + rng.random(n))
    root = rng.normal(size=(n, n))
    return root @ root.T + 0.1 * np.eye(n)


def problem(dynamics, rng, N=9, full=True):
    """Weights that change from stage to stage, some of them zero, along a moving reference, from a state in motion."""
    space, nq, nu = dynamics.space, dynamics.mechanism.nq, dynamics.nu
    x0 = random_state(space, rng)
    x0[nq:] *= 0.3
    Q = np.array([weights(rng, space.ndx, full) * (rng.random() < 0.7) for _ in range(N + 1)])
    R = np.array([weights(rng, nu, full) for _ in range(N)])
    x_ref = np.array([space.integrate(x0, 0.3 * rng.normal(size=space.ndx)) for _ in range(N + 1)])
    cost = TrackingCost(Q, R, x_ref, rng.normal(size=(N, nu)), space)
    return Problem(dynamics, cost, x0, 0.1 * rng.normal(size=(N, nu)))


def drawn(text, seed, integrator, full, prescribe=True):
    dynamics, _, _, rng = driven(text, seed, K=1, integrator=integrator, dt=0.01, prescribe=prescribe)
    return problem(dynamics, rng, full=full)
