"""Draw the figures of docs/concepts.md from the machines themselves: `python docs/figures/draw.py [FOLDER]`."""

from __future__ import annotations

import sys
from pathlib import Path

import mujoco
import numpy as np

import planner
from planner.cases.hopper import PAPER
from planner.view.plots.style import DASHED, HUES, INK, RED, SOFT, dress, grid_of, save

PLAN, MUJOCO = HUES[0][0], HUES[1][1]
ITERATIONS = (1, 3, 10, 22)  # of the two-link arm, which ends with the last
SHOWN = 7.2, 2.7  # inches


def slq(folder: Path) -> None:
    """Motions of some iterations, and the cost of each."""
    problem = planner.cases.two_link()
    solves = {n: planner.solve(problem, max_iterations=n) for n in ITERATIONS}
    figure, ((motion, cost),) = grid_of(1, 2, *SHOWN)
    for (n, plan), shade in zip(solves.items(), np.linspace(0.25, 1.0, len(solves)), strict=True):
        last = n == ITERATIONS[-1]
        motion.plot(plan.t, plan.xs[:, 1], color=PLAN, alpha=shade, lw=2.0 if last else 1.2, label=f"{n}")
    dress(motion, "Elbow after some iterations", "angle, rad", "time, s")
    motion.legend(frameon=False, fontsize=8, loc="upper center")
    costs = [line.cost for line in solves[ITERATIONS[-1]].history]
    cost.semilogy(range(len(costs)), costs, color=PLAN, marker=".", ms=4)
    cost.set_yticks([20, 30, 50, 80], ["20", "30", "50", "80"])
    cost.minorticks_off()
    dress(cost, "The cost falls with every iteration", "cost J", "iteration")
    save(figure, folder / "slq.png")


def screws(folder: Path) -> None:
    """A planar arm: its joints turn one after another, the outermost first."""
    links = "".join(
        f'<body pos="{0.0 if k == 0 else 0.5} 0 0"><joint name="q{k + 1}" axis="0 -1 0"/>'
        '<geom type="capsule" fromto="0 0 0 0.5 0 0" size="0.02" mass="1"/>'
        for k in range(3)
    )
    hand = '<site name="hand" pos="0.5 0 0"/>'
    arm = planner.Mechanism.from_mjcf(f"<mujoco><worldbody>{links}{hand}{'</body>' * 3}</worldbody></mujoco>")
    q = np.array([0.3, 0.6, 0.8])
    turns = [f"e^{{[S_{k}]q_{k}}}" for k in (1, 2, 3)]
    words = ["$" + "\\,".join([*turns[3 - turned :], "M"]) + "$" for turned in range(4)]
    figure, (panels,) = grid_of(1, 4, 7.2, 2.3)
    before = None
    for turned, (axes, title) in enumerate(zip(panels, words, strict=True)):
        pose = np.where(np.arange(3) >= 3 - turned, q, 0.0)
        bodies = planner.dynamics.forward_kinematics(arm, pose)[1:, :3, 3]
        points = np.vstack([bodies, planner.dynamics.frame_pose(arm, pose, "hand")[:3, 3]])[:, ::2]
        if before is not None:
            axes.plot(*before.T, color="#cfd4da", lw=3.0, solid_capstyle="round")
        axes.plot(*points.T, color=PLAN, lw=3.0, solid_capstyle="round")
        axes.plot(*points[:3].T, ls="", marker="o", ms=5, color="white", mec=INK)
        if turned:
            axes.plot(*points[3 - turned], ls="", marker="o", ms=7, color=RED)  # the screw that has just turned
        axes.plot(*points[3], ls="", marker="s", ms=5, color=INK)
        axes.set(xlim=(-0.3, 1.7), ylim=(-0.15, 1.45), aspect="equal")
        dress(axes, title, "z, m" if not turned else "", "x, m")
        before = points
    save(figure, folder / "screws.png")


def twin(folder: Path) -> None:
    """Accelerations of both machines at random states, and how much they differ."""
    problem = planner.cases.puma()
    mechanism, rng = problem.dynamics.mechanism, np.random.default_rng(0)
    model = mujoco.MjModel.from_xml_string(problem.twin.mjcf)
    data, ours, theirs = mujoco.MjData(model), [], []
    for _ in range(256):
        q, qd, tau = (scale * rng.normal(size=mechanism.nv) for scale in (1.0, 1.0, 20.0))
        data.qpos[:], data.qvel[:], data.qfrc_applied[:] = q, qd, tau
        mujoco.mj_forward(model, data)
        ours.append(planner.dynamics.forward_dynamics(mechanism, q, qd, tau))
        theirs.append(data.qacc.copy())
    a, b = np.array(ours), np.array(theirs)
    error = np.abs(a - b).max(axis=1) / np.abs(b).max(axis=1)
    figure, ((beside, apart),) = grid_of(1, 2, *SHOWN)
    end = float(np.abs(b).max())
    beside.plot([-end, end], [-end, end], color=SOFT, lw=0.8, ls=DASHED)
    beside.plot(b.ravel(), a.ravel(), ls="", marker=".", ms=3, color=PLAN)
    dress(beside, f"Puma: {b.size} accelerations", "of the plan, rad/s\N{SUPERSCRIPT TWO}",
          "of MuJoCo, rad/s\N{SUPERSCRIPT TWO}")  # fmt: skip
    apart.hist(error, bins=np.geomspace(1e-16, 1e-9, 43), color=PLAN)
    apart.axvline(1e-10, color=RED, lw=1.2)
    apart.text(1e-10, apart.get_ylim()[1], " bound", color=RED, fontsize=8, va="top")
    apart.set_xscale("log")
    dress(apart, "How much they differ", "states", "relative difference")
    save(figure, folder / "twin.png")


def proof(folder: Path) -> None:
    """A plan that MuJoCo repeats, and one that it does not: the paper's own, by Euler with too long a step."""
    figure, (panels,) = grid_of(1, 2, *SHOWN)
    good, rough = (planner.cases.hopper(height=20.0, **changes) for changes in ({}, {**PAPER, "integrator": "euler"}))
    for axes, problem in zip(panels, (good, rough), strict=True):
        plan = planner.solve(problem)
        judged = planner.prove(plan, rollouts=0)
        run = judged.replay
        axes.plot(run.t, run.xs[:, 0], color=MUJOCO, lw=3.0, alpha=0.6, label="MuJoCo, fine step")
        axes.plot(plan.t, plan.xs[:, 0], color=PLAN, lw=1.4, ls=DASHED, label="plan")
        axes.axhline(20.0, color=SOFT, lw=0.8, ls=":")
        method = "RK4" if problem is good else "explicit Euler"
        dress(axes, f"{judged.verdict}: {method}, {plan.N} stages", "height, in", "time, s")
        axes.legend(frameon=False, fontsize=8)
    save(figure, folder / "proof.png")


def main(folder: Path) -> None:
    """All of them, into a folder."""
    for draw in (slq, screws, twin, proof):
        draw(folder)


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent)
