"""Hop forward with a machine of someone else's making, gymnasium's Hopper as it is, and prove it.

python hop_forward.py [--no-video]        (pip install --no-deps gymnasium==1.4.0)

A plan that leaves the ground has to be shown where: a reference moves the centre of mass along a parabola and the foot
to where it lands, and poses of all joints follow by inverse kinematics. It is a drawing, not a motion: no force was
asked for. The solver makes a motion of it, first on a ground that gives much, then on that of the proof.
"""

import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from scipy.interpolate import BPoly

import planner
from planner.guess import hold

DT = 5e-3  # s
PUSH, FLIGHT, LAND, REST = 0.4, 0.24, 0.4, 0.8  # s: the centre of mass moves in the last and first half of PUSH, LAND
LENGTH, CLEARANCE, RISE = 0.25, 0.08, 0.02  # m: of the hop; of the foot in mid-flight; of the centre of mass before it
CROUCH = [0.0, 1.25, -0.65, -0.45, -0.75, 0.55]  # x, z, pitch, hip, knee, ankle; where the ground is, is found
SOFT, FIRM, FRICTION = (
    0.05,
    0.02,
    1.5,
)  # m that the machine at rest sinks in: a first, easier ground and that of the proof


def hopper(sink: float) -> planner.Mechanism:
    spec = find_spec("gymnasium")
    if spec is None or spec.origin is None:
        sys.exit("no gymnasium: pip install --no-deps gymnasium==1.4.0")
    file = Path(spec.origin).parent / "envs/mujoco/assets/hopper.xml"
    mass = planner.Mechanism.from_mjcf(file, contacts="off").mass.sum()
    ground = planner.Touch.resting(mass, sink=sink, ramp=0.4 * sink, damping_ratio=0.4, slip=0.2, friction=FRICTION)
    return planner.Mechanism.from_mjcf(file, contacts=ground)


def parabola(t: np.ndarray) -> np.ndarray:
    """Where the centre of mass is from where it began, (N+1, 2) m: at rest, thrown, caught, at rest."""
    up, down = PUSH, PUSH + FLIGHT
    g = np.array([0.0, 9.81])
    v = np.array([LENGTH / (FLIGHT + 0.5 * PUSH), 0.5 * g[1] * FLIGHT])  # thrown: back at the same height after FLIGHT
    left = np.array([0.5 * (LENGTH - v[0] * FLIGHT), RISE])
    thrown = left + v * (t[:, None] - up) - 0.5 * g * (t[:, None] - up) ** 2
    landed, end = left + np.array([v[0] * FLIGHT, 0.0]), [LENGTH, 0.0]
    path = np.empty((len(t), 2))
    for i in range(2):  # quintics meet the parabola in place, speed and acceleration
        before = BPoly.from_derivatives([0.5 * PUSH, up], [[0.0, 0.0, 0.0], [left[i], v[i], -g[i]]])
        fall = v[i] - g[i] * FLIGHT
        after = BPoly.from_derivatives([down, down + 0.5 * LAND], [[landed[i], fall, -g[i]], [end[i], 0.0, 0.0]])
        path[:, i] = np.where(t < up, before(np.clip(t, 0.5 * PUSH, up)), after(np.clip(t, down, down + 0.5 * LAND)))
    return np.where(((t >= up) & (t < down))[:, None], thrown, path)


def foot_of(machine: planner.Mechanism, q: np.ndarray) -> np.ndarray:
    """Where the ankle is and how the foot tilts, (..., 3)."""
    T = planner.frame_pose(machine, q, "foot")
    return np.stack([T[..., 0, 3], T[..., 2, 3], np.arctan2(T[..., 0, 2], T[..., 0, 0])], axis=-1)


def posed(machine: planner.Mechanism, q: np.ndarray, com: np.ndarray, foot: np.ndarray) -> np.ndarray:
    """Poses (N+1, 6) with the centre of mass at com (N+1, 2), the foot at foot (N+1, 3), the trunk's pitch that of q.

    Six equations in six joints, by Newton's method.
    """
    pitch = q[:, 2]
    for _ in range(12):
        centre = planner.center_of_mass(machine, q)[:, [0, 2]]
        missed = np.hstack([centre - com, foot_of(machine, q) - foot, q[:, 2:3] - pitch[:, None]])
        # What moves the slides of the root moves the whole mass: their rows of M are the momentum.
        of_centre = planner.mass_matrix(machine, q)[:, :2] / machine.mass.sum()
        of_foot = planner.jacobian(machine, q, "foot")[:, [0, 2, 4]]
        of_pitch = np.broadcast_to(np.eye(6)[2], (len(q), 1, 6))
        J = np.concatenate([of_centre, of_foot, of_pitch], axis=1)
        q = q - np.einsum("kij,kj->ki", np.linalg.pinv(J, rcond=1e-2), missed)  # what a straight leg cannot is left
    return q


def reference(machine: planner.Mechanism, x0: np.ndarray) -> np.ndarray:
    """The hop as drawn, (N+1, 12)."""
    t = np.arange(round((PUSH + FLIGHT + LAND + REST) / DT) + 1) * DT
    q0 = x0[: machine.nq]
    drawn = parabola(t)
    s = np.clip((t - PUSH) / FLIGHT, 0.0, 1.0)
    foot = np.tile(foot_of(machine, q0), (len(t), 1))
    foot[:, 0] += LENGTH * s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
    foot[:, 1] += CLEARANCE * 4.0 * s * (1.0 - s)
    first = np.tile(q0, (len(t), 1))
    first[:, :2] += drawn
    q = posed(machine, first, planner.center_of_mass(machine, q0)[[0, 2]] + drawn, foot)
    xs = np.hstack([q, np.gradient(q, DT, axis=0)])
    xs[-1, machine.nq :] = 0.0
    return xs


def problem(machine: planner.Mechanism, drawn: np.ndarray, x0: np.ndarray, us: np.ndarray) -> planner.Problem:
    dynamics = planner.RigidBodyDynamics(machine, DT)
    root, pitch = ("rootx", "rootz"), "rooty"
    cost = planner.TrackingCost.joints(
        dynamics, None, len(drawn) - 1, reference=drawn, effort=3.0, final_position=300.0, final_velocity=30.0,
        position={j: 1000.0 if j in root else 10.0 if j == pitch else 100.0 for j in machine.joint_names},
        velocity={j: 10.0 if j in root else 2.0 for j in machine.joint_names},
    )  # fmt: skip
    limits = planner.Limits(control="model")
    return planner.Problem(dynamics, cost, x0, us=us, twin=planner.Twin.of(machine), limits=limits)


def followed(plan: planner.Plan, machine: planner.Mechanism) -> np.ndarray:
    """Controls (N, nu) of a plan that is followed on another ground with its gains."""
    dynamics, x, us = planner.RigidBodyDynamics(machine, DT), plan.xs[0], plan.us.copy()
    for n in range(len(us)):
        us[n] = np.clip(plan.us[n] + plan.K[n] @ (x - plan.xs[n]), -1.0, 1.0)
        x = dynamics.step(x[None], us[n : n + 1])[0]
    return us


def hop(report: bool = False) -> tuple[planner.Plan, dict[str, float]]:
    """The plan, and what it does: metres forward, seconds without any force of the ground, metres of clearance."""
    soft, firm = hopper(SOFT), hopper(FIRM)
    x0 = planner.settled(firm, CROUCH)
    drawn = reference(firm, x0)
    callback = print if report else None
    easier = planner.solve(
        problem(soft, drawn, x0, np.tile(hold(firm, x0), (len(drawn) - 1, 1))), max_iterations=400, callback=callback
    )
    plan = planner.solve(problem(firm, drawn, x0, followed(easier, firm)), max_iterations=400, callback=callback)
    touch = planner.contact_forces(firm, plan.xs[:, : firm.nq], plan.xs[:, firm.nq :])
    lowest = -touch.depths.max(axis=1)
    aloft = np.flatnonzero(lowest > 0.0)
    runs = np.split(aloft, np.flatnonzero(np.diff(aloft) > 1) + 1)
    return plan, {
        "iterations": easier.nit + plan.nit,
        "forward_m": plan.xs[-1, 0] - plan.xs[0, 0],
        "flight_s": DT * (max(len(run) for run in runs) - 1),  # between knots, both of them in the air
        "clearance_m": lowest.max(),
    }


def main() -> int:
    plan, figures = hop(report=True)
    proof = planner.prove(plan, rollouts=16)
    print(plan, proof, ", ".join(f"{name} {value:.3g}" for name, value in figures.items()), sep="\n")
    plan.save("hop_forward.npz")
    if "--no-video" not in sys.argv:
        planner.render_video(proof.replay, "hop_forward.mp4")
    return 0 if plan.success and proof.passed else 1


if __name__ == "__main__":
    sys.exit(main())
