"""Figures 1 to 4: the machines, inverse dynamics, closed chains, and the motions of both arms.

The paper draws its arms as frames at equal intervals of time (Fig. 3, Fig. 4); so are ours. For Fig. 3 it gives the
efforts 73.6 and 9.9 and no masses: arms that have both, by the paper's own method, are in masses.py.

Closed chains (section 1.2) are compared with a closed form. Two equal cranks and a coupler that does not rotate are a
parallelogram, whose one coordinate, the angle q of its cranks from upright, has

    (2 (I + m c^2) + M l^2) qdd = tau + (2 m c + M l) g sin q

with the cranks' mass m, inertia I, length l and distance c of their centres of mass, and the coupler's mass M. The
paper names the constraints and gives no example.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from planner import cases
from planner.dynamics import RigidBodyDynamics, product_of_exponentials
from planner.dynamics import algorithms as rigid_body
from planner.dynamics.loops import misses
from planner.model.mechanism import Mechanism
from planner.paper.studies.step_run import FRAMES as POINTS
from planner.paper.studies.study import Row, Study, plan_record, table, timed
from planner.solvers.slq import solve
from planner.view.plots.case_pictures import frame_points
from planner.view.plots.style import INK, SOFT, grid_of, save

FRAMES = 14  # as many as Fig. 3 has
STATES = 50  # random ones per arm, for Fig. 2
STARTS = 8  # first guesses of the better local minimum
LIMIT = 300  # iterations of each; those that need more end higher


def _run() -> dict[str, Any]:
    for case in ("two-link", "acrobot"):
        solve(cases.build(case), max_iterations=1)  # so that nothing is compiled on the clock
    return {
        "machines": [_machine(name) for name in cases.CASES],
        "walker": _walker(),
        "inverse_dynamics_error": max(inverse_dynamics_error(case) for case in ("two-link", "acrobot")),
        "closed_form_error": closed_form_error(),
        "drift": drift(),
        "motions": [
            _motion("Fig. 3: two-link, from the paper's first guess", "two-link", 1),
            _motion(f"Fig. 3: two-link, best of {STARTS} first guesses", "two-link", STARTS),
            _motion("Fig. 4: acrobot, from the paper's first guess", "acrobot", 1),
        ],
    }


def _machine(name: str) -> dict[str, Any]:
    problem = cases.build(name)
    return {"case": name, "states": problem.dynamics.nx, "controls": problem.dynamics.nu, "t_f": problem.duration}


def _walker() -> list[list[float]]:
    """Hips, knees, ankles, heels and toes of the human step at its start, from the side, m."""
    problem = cases.build("human-step")
    points = frame_points(problem.dynamics.mechanism, problem.x0[None], POINTS)[0]  # type: ignore[attr-defined]
    return np.round(points[:, [0, 2]], 4).tolist()


def inverse_dynamics_error(case: str, states: int = STATES) -> float:
    """The largest relative difference of the compiled inverse dynamics to Fig. 2, line by line, at random states."""
    mechanism, rng = cases.build(case).dynamics.mechanism, np.random.default_rng(0)  # type: ignore[attr-defined]
    q, qd, qdd = rng.normal(size=(3, states, mechanism.nv))
    fast = rigid_body.rnea(mechanism, q, qd, qdd)
    plain = np.array([product_of_exponentials.rnea(mechanism, *one) for one in zip(q, qd, qdd, strict=True)])
    return float(np.abs(fast - plain).max() / np.abs(plain).max())


def _motion(title: str, case: str, starts: int) -> dict[str, Any]:
    problem = cases.build(case)
    first = problem.dynamics.dt * 0.5 * float(np.sum(problem.first_guess**2))
    plan, seconds = timed(lambda: solve(problem, starts=starts, max_iterations=LIMIT))
    return {
        "title": title, "case": case, **plan_record(plan), "first_effort": first,
        "effort": problem.dynamics.dt * 0.5 * float(np.sum(plan.us**2)),
        "seconds": seconds, "miss": float(np.abs(plan.xs[-1] - [0.5 * np.pi, 0.0, 0.0, 0.0]).max()),
        **drawn(plan.t, plan.xs[:, :2], plan.xs[:, 2], [float(plan.parameters[f"length{i}"]) for i in (1, 2)]),
    }  # fmt: skip


def drawn(t: np.ndarray, q: np.ndarray, rate: np.ndarray, lengths: list[float]) -> dict[str, Any]:
    """Measures and frames of a motion q (K, 2) at t (K,), with the upper arm's rate (K,) and both lengths."""
    chosen = np.linspace(0, len(t) - 1, FRAMES).round().astype(int)
    joints = [q[:, 0], q[:, 0] + q[:, 1]]
    hand = [sum(a * turn(angle) for a, angle in zip(lengths, joints, strict=True)) for turn in (np.cos, np.sin)]
    return {
        "lowest_q1": float(q[:, 0].min()), "at": float(t[q[:, 0].argmin()]),
        "folds": [float(q[:, 1].min()), float(q[:, 1].max())], "swings": _swings(rate),
        "t_s": t[chosen].tolist(), "frames": q[chosen].tolist(), "lengths": lengths,
        "path": np.stack(hand, axis=1).tolist(),
    }  # fmt: skip


def _swings(rate: np.ndarray) -> int:
    """How often the upper arm turns back."""
    signs = np.sign(rate[np.abs(rate) > 1e-3])  # rad/s; slower is rest
    return int(np.sum(signs[1:] != signs[:-1]))


def _page(results: dict[str, Any]) -> list[str]:
    return [
        "# The machines and their motions (Fig. 1 to 4)", "",
        "![the four systems of Fig. 1](machines.png)", "",
        "![frames of the arms at equal intervals](motions.png)", "",
        *table({
            "motion": "{title}", "status": "{status}", "iterations": "{iterations}", "s": "{seconds:.3g}",
            "effort of the guess": "{first_effort:.1f}", "effort": "{effort:.2f}", "cost": "{cost:.2f}",
            "lowest q1": "{lowest_q1:.2f} rad at {at:.2f} s", "q2 between": "{folds[0]:.2f} and {folds[1]:.2f} rad",
            "turns of q1": "{swings}", "miss": "{miss:.3f}",
        }, results["motions"]), "",
        *table(
            {"machine": "{case}", "states": "{states}", "controls": "{controls}", "t_f, s": "{t_f:g}"},
            results["machines"],
        ), "",
        f"Fig. 2, inverse dynamics line by line, against the compiled code at random states of the arms: relative "
        f"difference {results['inverse_dynamics_error']:.1e}.",
    ]  # fmt: skip


def _rows(results: dict[str, Any]) -> list[Row]:
    paper, best, acrobot = results["motions"]
    machines = ", ".join(m["case"] for m in results["machines"])

    def described(m: dict[str, Any]) -> str:
        return (
            f"effort {m['effort']:.1f}, lowest q1 {m['lowest_q1']:.2f} rad, q2 from {m['folds'][0]:.2f} to "
            f"{m['folds'][1]:.2f} rad, {m['status']} after {m['iterations']} iterations, {m['seconds']:.2g} s"
        )

    return [
        Row("1, Fig. 1", "Four systems: 2R arm, the same without the base motor, human step, hopper", machines,
            "the paper's four, and two more: an arm for its reference [20], a diver for [16]. Its arm without a base "
            "motor is the acrobot"),
        Row("1.2, Fig. 2", "Recursive inverse dynamics by matrix exponentials",
            f"as printed in product_of_exponentials.py: relative difference {results['inverse_dynamics_error']:.1e}",
            "it does not differ; gravity enters as acceleration of the base, which the figure leaves out"),
        Row("1.2", "The kinematics of closed chains by a set of algebraic constraints (no example)",
            f"a parallelogram against its closed form: relative difference {results['closed_form_error']:.1e}; open by "
            f"at most {results['drift']:.1e} m while it swings for {SECONDS:g} s",
            "it does not differ; the paper gives no example"),
        Row("2.1, Fig. 3", "The same by the new algorithm: not in the paper",
            f"our own rods (0.5 kg, 1 m) need {paper['first_effort']:.1f} on the first guess; by SLQ from there: "
            f"{described(paper)}; best of {STARTS} guesses: {described(best)}",
            "another arm, another method and other local minima: from the paper's guess it does not swing down"),
        Row("2.2, Fig. 4", "From q1 = -1.0 the elbow pumps energy until the arm stands upright",
            f"{described(acrobot)}; q1 turns back {acrobot['swings']} times",
            "the paper gives neither masses nor t_f, so only the kind of motion can be compared"),
    ]  # fmt: skip


def _draw(results: dict[str, Any], path: Path) -> None:
    draw_frames(results["motions"], path)


def draw_frames(motions: list[dict[str, Any]], path: Path) -> None:
    """Frames at equal intervals, one row per motion."""
    figure, grid = grid_of(len(motions), 1, 14.0, 1.75 * len(motions))
    for axes, motion in zip(grid[:, 0], motions, strict=True):
        a, b = motion["lengths"]
        reach = 1.05 * (a + b)
        for frame, ((q1, q2), t) in enumerate(zip(motion["frames"], motion["t_s"], strict=True)):
            place = 2.1 * reach * frame
            x = place + np.cumsum([0.0, a * np.cos(q1), b * np.cos(q1 + q2)])
            y = np.cumsum([0.0, a * np.sin(q1), b * np.sin(q1 + q2)])
            hand = np.array(motion["path"])
            axes.plot(place + hand[:, 0], hand[:, 1], color="#d9d9d9", lw=0.8)
            axes.plot(x[:2], y[:2], color="#08306b", lw=3.0, solid_capstyle="round")
            axes.plot(x[1:], y[1:], color="#c1570a", lw=3.0, solid_capstyle="round")
            axes.plot(x[:2], y[:2], ".", color=INK, ms=4)
            axes.text(place, -1.3 * reach, f"{t:.2f} s", ha="center", fontsize=7.5, color=SOFT)
        axes.set(xlim=(-1.1 * reach, 2.1 * reach * FRAMES - reach), ylim=(-1.4 * reach, 1.1 * reach), aspect="equal")
        axes.set_axis_off()
        axes.set_title(f"{motion['title']}: effort {motion['effort']:.2f}", fontsize=9.5, loc="left", color=INK)
    save(figure, path)


def _draw_machines(results: dict[str, Any], path: Path) -> None:
    """The four systems of Fig. 1; filled joints have a motor, open ones none, arrows are what else is driven."""
    figure, grid = grid_of(1, 4, 13.0, 3.2)
    arm, acrobot, step, hop = grid[0]
    for axes, title, motors in ((arm, "Case 1", (INK, INK)), (acrobot, "Case 2", ("white", INK))):
        x, y = np.cumsum([0.0, np.cos(0.9), np.cos(0.2)]), np.cumsum([0.0, np.sin(0.9), np.sin(0.2)])
        axes.plot([-0.3, 0.3], [0.0, 0.0], color=SOFT, lw=4)
        axes.plot(x, y, color="#08306b", lw=4, zorder=1, solid_capstyle="round")
        axes.scatter(x[:2], y[:2], s=130, c=motors, edgecolors=INK, zorder=2)
        axes.set_title(f"{title}: 2R arm, {'two motors' if motors[0] == INK else 'elbow motor alone'}", fontsize=9.5)
    points = np.array(results["walker"]).reshape(2, -1, 2)  # (side, point, 2)
    for leg, colour in zip(points, ("#c1570a", SOFT), strict=True):
        step.plot(*leg[[0, 1, 2, 3, 4, 2]].T, color=colour, lw=3)
        step.scatter(*leg[:3].T, s=60, c="white", edgecolors=INK, zorder=2)
    hip = points[:, 0].mean(axis=0)
    step.plot([hip[0], hip[0]], [hip[1], hip[1] + 0.5], color=INK, lw=6, solid_capstyle="round")
    step.axhline(0.0, color=SOFT, lw=4)
    step.annotate(
        "robot", hip + np.array([0.0, 0.1]), hip + np.array([0.55, 0.1]), arrowprops={"arrowstyle": "->"}, va="center"
    )
    step.set_title("Case 3: pelvis driven, legs passive", fontsize=9.5)
    coils = np.linspace(0.1, 0.9, 9)
    hop.axhline(0.0, color=SOFT, lw=4)
    hop.plot(0.12 * (-1.0) ** np.arange(9) * (np.arange(9) % 8 > 0), coils, color="#08306b", lw=2)
    hop.plot([-0.15, 0.15], [0.1, 0.1], color=INK, lw=3)  # the foot
    hop.fill_between([-0.35, 0.35], 0.95, 1.4, color="#c1570a")
    for label, place in (("mass m, height y", 1.17), ("spring k, piston $y_p$, flow u", 0.5)):
        hop.annotate(label, (0.4, place), fontsize=9, va="center")
    hop.set_title("Case 4: hopper", fontsize=9.5)
    limits = {arm: (-0.6, 2.0, -0.3, 1.6), acrobot: (-0.6, 2.0, -0.3, 1.6), hop: (-0.7, 1.9, -0.3, 1.6),
              step: (hip[0] - 0.9, hip[0] + 1.1, -0.1, hip[1] + 0.6)}  # fmt: skip
    for axes, (left, right, low, high) in limits.items():
        axes.set(xlim=(left, right), ylim=(low, high), aspect="equal")
        axes.set_axis_off()
    save(figure, path)


STUDY = Study("motions", "the machines, inverse dynamics and the motions of the arms (Fig. 1 to 4)",
              _run, _page, _rows, {"machines.png": _draw_machines, "motions.png": _draw})  # fmt: skip


CRANK, INERTIA, COUPLER, CRANK_LENGTH, CENTRE = 1.0, 0.01, 2.0, 0.4, 0.2  # kg, kg m^2, kg, m, m
SECONDS = 10.0  # how long a chain swings
CHAIN_STATES = 50

_CRANK = f'<inertial pos="0 0 {CENTRE}" mass="{CRANK}" diaginertia="{INERTIA} {INERTIA} {INERTIA}"/>'
PARALLELOGRAM = f"""
<mujoco><worldbody>
  <body name="left"><joint name="left" axis="0 1 0"/>{_CRANK}
    <body name="coupler" pos="0 0 {CRANK_LENGTH}"><joint name="coupler" axis="0 1 0"/>
      <inertial pos=".3 0 0" mass="{COUPLER}" diaginertia=".05 .05 .05"/></body></body>
  <body name="right" pos=".6 0 0"><joint name="right" axis="0 1 0"/>{_CRANK}</body>
</worldbody><equality><connect body1="coupler" body2="right" anchor=".6 0 0"/></equality>
<actuator><motor joint="left"/></actuator></mujoco>
"""


def closed_form_error() -> float:
    """The largest relative difference of accelerations from the closed form, at random states."""
    m, rng = Mechanism.from_mjcf(PARALLELOGRAM), np.random.default_rng(0)
    q, qd, tau = rng.uniform(-1.4, 1.4, CHAIN_STATES), rng.normal(size=CHAIN_STATES), rng.normal(size=CHAIN_STATES)
    signs = np.array([1.0, -1.0, 1.0])
    xs = np.hstack([q[:, None] * signs, qd[:, None] * signs])
    found = RigidBodyDynamics(m, 0.01).rates(xs, tau[:, None])[:, 3:6]
    inertia = 2.0 * (INERTIA + CRANK * CENTRE**2) + COUPLER * CRANK_LENGTH**2
    qdd = (tau + (2.0 * CRANK * CENTRE + COUPLER * CRANK_LENGTH) * 9.81 * np.sin(q)) / inertia
    return float(np.abs(found - qdd[:, None] * signs).max() / np.abs(qdd).max())


def drift() -> float:
    """How far the pin opens, m, while the parallelogram swings for SECONDS, by RK4 at 2 ms."""
    m = Mechanism.from_mjcf(PARALLELOGRAM)
    dynamics, x, most = RigidBodyDynamics(m, 0.002), np.array([2.2, -2.2, 2.2, 0.0, 0.0, 0.0]), 0.0
    for _ in range(round(SECONDS / dynamics.dt)):
        x = dynamics.step(x[None], np.zeros((1, 1)))[0]
        most = max(most, float(np.abs(misses(m, x[:3])).max()))
    return most
