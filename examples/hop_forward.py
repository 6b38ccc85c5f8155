"""Hop forward with a machine of someone else's making, as it is, and prove it.

python hop_forward.py [gymnasium|dm-hopper|dm-walker] [--no-video]
                                        (pip install --no-deps gymnasium==1.4.0 dm-control==1.0.50)

A plan that leaves the ground has to be shown where: a reference moves the centre of mass along a parabola and the feet
to where they land, and poses of all joints follow by inverse kinematics. It is a drawing, not a motion: no force was
asked for. The solver makes a motion of it with the help of a hand that holds the machine at its root, and whose effort
costs ten times more each time; what it does for 1e5 the machine can do alone.
"""

import argparse
import sys
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from scipy.interpolate import BPoly

import planner
from planner.dynamics.quasi_static import quasi_static_controls

G = 9.81
STAND, REST = 0.2, 1.0  # s: before the centre of mass moves, and after
HAND = ("hand x", "hand z", "hand pitch")
FADE = (1.0, 10.0, 100.0, 1e3, 1e4, 1e5)  # of its effort; that of the motors is 3
EARLY, LATE = 1e-4, 1e-6  # of the cost: what two iterations in a row have to gain, with the hand and without


@dataclass(frozen=True)
class Hopper:
    """A machine, and the hop that is drawn for it. It has slides rootx and rootz and a hinge rooty.

    Attributes:
        package, file: The MJCF.
        crouch: rad by joint, where it begins and ends, at rest; where the ground is, is found.
        feet: Bodies that stand on the ground.
        kept: Joints that the drawing leaves where they are; with the places of the feet and of the centre of mass
            they say where all joints are.
        dt: s.
        push, flight, land: s that the centre of mass moves: on the ground, in the air, on the ground.
        length, clearance, rise: m, of the hop; of the feet in mid-flight; of the centre of mass before it.
        sink, ramp, friction, slip: Of the ground (ContactLaw.resting); ramp as a share of the sink.
        pitch, joints: Weights of the trunk's pitch and of the other joints, per rad^2 and second; of the root's place
            1000 per m^2.
    """

    package: str
    file: str
    crouch: dict[str, float]
    feet: tuple[str, ...]
    kept: tuple[str, ...] = ("rooty",)
    dt: float = 5e-3
    push: float = 0.35
    flight: float = 0.25
    land: float = 0.35
    length: float = 0.2
    clearance: float = 0.08
    rise: float = 0.06
    sink: float = 0.02
    ramp: float = 0.2
    friction: float = 1.0
    slip: float = 0.5
    pitch: float = 10.0
    joints: float = 100.0


LEG = {"hip": 0.5, "knee": -1.0, "ankle": 0.5}
HOPPERS = {
    "gymnasium": Hopper(
        "gymnasium", "envs/mujoco/assets/hopper.xml",
        {"rooty": -0.65, "thigh_joint": -0.45, "leg_joint": -0.75, "foot_joint": 0.55}, ("foot",),
        push=0.2, flight=0.24, land=0.2, length=0.22, rise=0.02, friction=1.5, slip=0.2,
    ),
    "dm-hopper": Hopper(
        "dm_control", "suite/hopper.xml",
        {"waist": 0.2, "hip": -0.9, "knee": 1.2, "ankle": -0.5}, ("foot",), ("rooty", "waist"), dt=2.5e-3, sink=0.01,
    ),
    "dm-walker": Hopper(
        "dm_control", "suite/walker.xml",
        {f"{side}_{joint}": angle for side in ("right", "left") for joint, angle in LEG.items()},
        ("right_foot", "left_foot"), dt=2.5e-3, flight=0.2, length=0.15, clearance=0.06, rise=0.05,
        ramp=0.4, pitch=300.0, joints=300.0,
    ),
}  # fmt: skip


def machine_of(hopper: Hopper) -> planner.Mechanism:
    """The machine on its ground."""
    spec = find_spec(hopper.package)
    if spec is None or not spec.submodule_search_locations:
        sys.exit(f"no {hopper.package}: pip install --no-deps gymnasium==1.4.0 dm-control==1.0.50")
    file = Path(spec.submodule_search_locations[0]) / hopper.file
    ground = planner.contact.ContactLaw.resting(
        planner.Mechanism.from_mjcf(file, contacts="off").mass.sum(), sink=hopper.sink, ramp=hopper.ramp * hopper.sink,
        damping_ratio=0.4, slip=hopper.slip, friction=hopper.friction,
    )  # fmt: skip
    return planner.Mechanism.from_mjcf(file, contacts=ground)


def crouched(hopper: Hopper, machine: planner.Mechanism) -> np.ndarray:
    """The state (nx,) at rest on the ground."""
    q = machine.home[: machine.nq].copy()
    for joint, angle in hopper.crouch.items():
        q[machine.joint_names.index(joint)] = angle
    return planner.dynamics.static_equilibrium(machine, q)


def parabola(hopper: Hopper, t: np.ndarray) -> np.ndarray:
    """Where the centre of mass is from where it began, (N+1, 2) m: at rest, thrown, caught, at rest."""
    up, g = STAND + hopper.push, np.array([0.0, G])
    down = up + hopper.flight
    # Thrown so that it is back at the same height after the flight.
    v = np.array([hopper.length / (hopper.flight + 0.5 * (hopper.push + hopper.land)), 0.5 * g[1] * hopper.flight])
    left = np.array([0.5 * hopper.push * v[0], hopper.rise])
    thrown = left + v * (t[:, None] - up) - 0.5 * g * (t[:, None] - up) ** 2
    landed, end = left + np.array([v[0] * hopper.flight, 0.0]), [hopper.length, 0.0]
    path = np.empty((len(t), 2))
    for i in range(2):  # quintics meet the parabola in place, speed and acceleration
        before = BPoly.from_derivatives([STAND, up], [[0.0, 0.0, 0.0], [left[i], v[i], -g[i]]])
        fall = v[i] - g[i] * hopper.flight
        after = BPoly.from_derivatives([down, down + hopper.land], [[landed[i], fall, -g[i]], [end[i], 0.0, 0.0]])
        path[:, i] = np.where(t < up, before(np.clip(t, STAND, up)), after(np.clip(t, down, down + hopper.land)))
    return np.where(((t >= up) & (t < down))[:, None], thrown, path)


def foot_of(machine: planner.Mechanism, q: np.ndarray, foot: str) -> np.ndarray:
    """Where the foot's frame is and how it tilts, (..., 3)."""
    T = planner.dynamics.frame_pose(machine, q, foot)
    return np.stack([T[..., 0, 3], T[..., 2, 3], np.arctan2(T[..., 0, 2], T[..., 0, 0])], axis=-1)


def posed(
    hopper: Hopper, machine: planner.Mechanism, q: np.ndarray, com: np.ndarray, feet: list[np.ndarray]
) -> np.ndarray:
    """Poses (N+1, nq) with the centre of mass at com (N+1, 2), each foot at its place (N+1, 3), kept joints those of q.

    As many equations as joints, by Newton's method.
    """
    kept = [machine.joint_names.index(joint) for joint in hopper.kept]
    root = [machine.joint_names.index(joint) for joint in ("rootx", "rootz")]
    there = q[:, kept]
    # What moves the slides of the root moves the whole mass: their rows of M are the momentum.
    for _ in range(12):
        centre = planner.dynamics.center_of_mass(machine, q)[:, [0, 2]]
        missed = [centre - com, q[:, kept] - there]
        missed += [foot_of(machine, q, foot) - place for foot, place in zip(hopper.feet, feet, strict=True)]
        J = [planner.dynamics.mass_matrix(machine, q)[:, root] / machine.mass.sum()]
        J += [np.broadcast_to(np.eye(machine.nv)[kept], (len(q), len(kept), machine.nv))]
        J += [planner.dynamics.jacobian(machine, q, foot)[:, [0, 2, 4]] for foot in hopper.feet]
        inverse = np.linalg.pinv(np.concatenate(J, axis=1), rcond=1e-2)  # what a straight leg cannot is left
        q = q - np.einsum("kij,kj->ki", inverse, np.hstack(missed))
    return q


def reference(hopper: Hopper, machine: planner.Mechanism, x0: np.ndarray) -> np.ndarray:
    """The hop as drawn, (N+1, nx)."""
    t = np.arange(round((STAND + hopper.push + hopper.flight + hopper.land + REST) / hopper.dt) + 1) * hopper.dt
    q0 = x0[: machine.nq]
    drawn = parabola(hopper, t)
    s = np.clip((t - STAND - hopper.push) / hopper.flight, 0.0, 1.0)
    way = np.zeros((len(t), 3))
    way[:, 0] = hopper.length * s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
    way[:, 1] = hopper.clearance * 4.0 * s * (1.0 - s)
    first = np.tile(q0, (len(t), 1))
    first[:, [machine.joint_names.index(joint) for joint in ("rootx", "rootz")]] += drawn
    feet = [foot_of(machine, q0, foot) + way for foot in hopper.feet]
    q = posed(hopper, machine, first, planner.dynamics.center_of_mass(machine, q0)[[0, 2]] + drawn, feet)
    xs = np.hstack([q, np.gradient(q, hopper.dt, axis=0)])
    xs[-1, machine.nq :] = 0.0
    return xs


def held(machine: planner.Mechanism) -> planner.Mechanism:
    """The machine with a hand at its root: three actuators more, their controls in weights and weights times metres."""
    root = [machine.joint_names.index(joint) for joint in ("rootx", "rootz", "rooty")]
    own = machine.actuators

    def more(values: np.ndarray, one: float | list[float]) -> np.ndarray:
        return np.concatenate([values, np.broadcast_to(one, (3, *values.shape[1:])).astype(values.dtype)])

    rows, unbounded = G * machine.mass.sum() * np.eye(machine.nv)[root], [-np.inf, np.inf]
    actuators = replace(
        own, names=(*own.names, *HAND), moment=np.vstack([own.moment, rows]),
        gain=more(own.gain, 1.0), bias=more(own.bias, 0.0), dynamics=more(own.dynamics, 0),
        activation=more(own.activation, -1), time_constant=more(own.time_constant, 1.0),
        control_range=more(own.control_range, unbounded), force_range=more(own.force_range, unbounded),
        activation_range=more(own.activation_range, unbounded),
    )  # fmt: skip
    return replace(machine, actuators=actuators)


def problem(
    hopper: Hopper, machine: planner.Mechanism, drawn: np.ndarray, us: np.ndarray, hand: float | None = None
) -> planner.Problem:
    """Follow the drawing; hand is what its effort weighs, None where there is none."""
    dynamics = planner.RigidBodyDynamics(machine, hopper.dt)
    effort = np.full(machine.nu, 3.0)
    if hand is not None:
        effort[-len(HAND) :] = hand
    position = {"rootx": 1000.0, "rootz": 1000.0, "rooty": hopper.pitch}
    cost = planner.TrackingCost.joints(
        dynamics, None, len(drawn) - 1, reference=drawn, effort=effort,
        # Rest costs nothing, and the end asks for no place that feet on the ground cannot reach: a plan that is pulled
        # to one throws itself there in its last moments, where no gain is left to repeat that in the simulator.
        control=quasi_static_controls(machine, drawn[0]),
        final_position={j: 100.0 for j in machine.joint_names if j != "rootx"}, final_velocity=30.0,
        position={j: position.get(j, hopper.joints) for j in machine.joint_names},
        velocity={j: 10.0 if j in ("rootx", "rootz") else 2.0 for j in machine.joint_names},
    )  # fmt: skip
    return planner.Problem(
        dynamics, cost, drawn[0], us=us, twin=planner.Twin.of(machine), limits=planner.Limits(control="model"),
        actual_reduction_tolerance=LATE if hand is None else EARLY,
        tolerance={"position": 0.1, "velocity": 0.3},  # to land and to stand, also on the file's own contact
    )  # fmt: skip


def followed(plan: planner.Plan, machine: planner.Mechanism) -> np.ndarray:
    """Controls (N, nu) of a machine without a hand that follows a plan of the one with it, with the plan's gains."""
    dynamics, x, us = planner.RigidBodyDynamics(machine, plan.t[1]), plan.xs[0], plan.us[:, : machine.nu].copy()
    lower, upper = machine.actuators.control_range.T
    for n in range(len(us)):
        us[n] = np.clip(us[n] + plan.K[n, : machine.nu] @ (x - plan.xs[n]), lower, upper)
        x = dynamics.step(x[None], us[n : n + 1])[0]
    return us


def hop(hopper: Hopper, report: bool = False) -> tuple[planner.Plan, dict[str, float]]:
    """The plan, and what it does (see measured)."""
    machine = machine_of(hopper)
    x0 = crouched(hopper, machine)
    drawn = reference(hopper, machine, x0)
    callback = print if report else None
    helped = held(machine)
    us, helped_ones = np.tile(quasi_static_controls(helped, x0), (len(drawn) - 1, 1)), []
    for hand in FADE:
        eased = planner.solve(problem(hopper, helped, drawn, us, hand), max_iterations=200, callback=callback)
        helped_ones.append(eased)
        us = eased.us
    alone = problem(hopper, machine, drawn, followed(helped_ones[-1], machine))
    plan = planner.solve(alone, max_iterations=400, callback=callback)
    return plan, {"iterations": sum(each.nit for each in (*helped_ones, plan))} | measured(plan, machine)


def measured(plan: planner.Plan, machine: planner.Mechanism) -> dict[str, float]:
    """Metres forward, seconds without any force of the ground, metres of clearance, the largest rate at the end."""
    q, qd = np.split(plan.xs, [machine.nq], axis=1)
    lowest = -planner.dynamics.contact_forces(machine, q, qd).depths.max(axis=1)
    aloft = np.flatnonzero(lowest > 0.0)
    runs = np.split(aloft, np.flatnonzero(np.diff(aloft) > 1) + 1)
    x = machine.joint_names.index("rootx")
    return {
        "forward_m": q[-1, x] - q[0, x],
        "flight_s": plan.t[1] * (max(len(run) for run in runs) - 1),  # from knot to knot, both of them in the air
        "clearance_m": lowest.max(),
        "end_rate": np.abs(qd[-1]).max(),
    }


def main() -> int:
    """Plan, prove, film."""
    parser = argparse.ArgumentParser(description="Hop forward with a machine of someone else's making.")
    parser.add_argument("machine", nargs="?", choices=tuple(HOPPERS), default="gymnasium")
    parser.add_argument("--no-video", action="store_true")
    given = parser.parse_args()
    name = given.machine
    plan, figures = hop(HOPPERS[name], report=True)
    proof = planner.prove(plan, rollouts=16)
    print(plan, proof, ", ".join(f"{key} {value:.3g}" for key, value in figures.items()), sep="\n")
    plan.save(f"hop_forward_{name}.npz")
    if not given.no_video:
        planner.render_video(proof.replay, f"hop_forward_{name}.mp4")
    return 0 if plan.success and proof.passed else 1


if __name__ == "__main__":
    sys.exit(main())
