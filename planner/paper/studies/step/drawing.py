"""The pictures of the human step: the swing as in Fig. 5, a cycle in curves, and J by iteration of every method."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from planner.cases.human_step.phase import SWING
from planner.cases.human_step.walker import SIDES
from planner.paper.studies.step.run import CYCLE_TIME, FRAMES
from planner.problem.pictures import PoseSequence, Stick, StickFigures
from planner.view.plots.stick_figures import draw_stick_figures
from planner.view.plots.style import DASHED, HUES, SOFT, dress, panels_of, save

POSES = 8


def draw_step(results: dict[str, Any], path: Path) -> None:
    """The swing from the side and from ahead: optimized solid, normal dashed, as Fig. 5; the other leg stands."""
    drawn = results["default"]["swing"]
    names = list(drawn["frames"])
    standing = np.array(drawn["standing"])
    motions = []
    for label, key in (("optimized", "planned"), ("normal", "normal")):
        points = np.array(drawn["points"][key])
        motions.append(PoseSequence(label, np.concatenate([points, standing], axis=1), dashed=key == "normal"))
    leg = [names.index(name) for name in FRAMES if name.startswith("right") and name in names]
    hip, knee, ankle, heel, toe = leg
    other = names.index("left_hip")
    ankle2, heel2, toe2 = range(len(names), len(names) + 3)
    sticks = [
        Stick((other, ankle2, heel2, toe2, ankle2), "the leg that stands", hue=7),
        Stick((other, hip), "hips", hue=None),
        Stick((hip, knee, ankle, heel, toe, ankle), "the leg that swings", hue=1),
    ]
    times = tuple(f"{share:.0f} %" for share in np.linspace(0.0, 100.0, POSES))
    title = "The swing: passive leg, optimized motion of the pelvis"
    save(draw_stick_figures(StickFigures("", motions, sticks, times, 0.0, title)), path)


def draw_step_cycle(results: dict[str, Any], path: Path) -> None:
    """Joint angles against normal, the pelvis' place, hip lift, foot forces and the robot's wrench, of a cycle."""
    drawn = results["default"]["cycle"]
    figure, axes = panels_of(6)
    percent = 100.0 * np.array(drawn["t_s"]) / CYCLE_TIME
    for on, side in zip(axes[:2], SIDES, strict=True):
        dress(on, f"{side.capitalize()} leg, normal dashed, its swing shaded", "angle, deg")
        begin, end = (100.0 * (s + (0.0 if side == "right" else 0.5)) % 100.0 for s in (SWING[0], SWING[1] - 1e-9))
        on.axvspan(begin, end, color="#ece7dc", lw=0, zorder=0)
        for i, joint in enumerate(("hip_flexion", "knee", "ankle")):
            name = f"{side}_{joint}"
            on.plot(percent, drawn["angles_deg"][name], color=HUES[i][1], lw=1.8, label=joint.replace("_", " "))
            on.plot(percent, drawn["normal_deg"][name], color=HUES[i][1], lw=1.2, ls=DASHED)
    pelvis = {key: np.array(values) for key, values in drawn["pelvis"].items()}
    path_of, forces, push, turn = axes[2:]
    dress(path_of, "Pelvis and hips, from the normal gait", "distance, mm")
    for i, name in enumerate("xyz"):
        away = 1e3 * (pelvis["planned"][:, i] - pelvis["normal"][:, i])
        path_of.plot(percent, away, color=HUES[i][1], lw=1.8, label=name)
    for i, side in enumerate(SIDES):
        lift = 1e3 * np.array(drawn["hip_lift_m"][side])
        path_of.plot(percent, lift, color=HUES[3 + i][1], lw=1.4, ls=":", label=f"{side} hip, lifted by")
    dress(forces, "Belt on the feet, upwards", "force, N")
    for i, side in enumerate(SIDES):
        forces.plot(percent, drawn["forces_N"][side], color=HUES[i][1], lw=1.6, label=side)
    wrench = np.array(drawn["wrench"])
    for on, title, label, first, names in (
        (push, "Robot's force on the pelvis", "force, N", 0, ("ahead", "to the left", "upwards")),
        (turn, "Robot's moment on the pelvis", "moment, N m", 3, ("tilt", "list", "rotation")),
    ):
        dress(on, title, label)
        for i, name in enumerate(names):
            on.plot(percent[:-1], wrench[:, first + i], color=HUES[i][1], lw=1.4, label=name)
    for on in axes:
        on.set_xlim(0.0, percent[-1])
        on.set_xlabel("cycle from right heel strike, %")
        low, high = on.get_ylim()
        on.set_ylim(low, high + 0.22 * (high - low))  # room for the names above what is drawn
        on.legend(frameon=False, fontsize=7.5, ncols=3, loc="upper left")
    save(figure, path)


def draw_step_methods(results: dict[str, Any], path: Path) -> None:
    """J over the least found, by iteration."""
    figure, panels = panels_of(2)
    for phase, axes in zip(("swing", "cycle"), panels, strict=True):
        dress(axes, phase.capitalize(), "cost J", "iteration, counted from 1")
        for i, (name, one) in enumerate(results["updates"][phase].items()):
            axes.loglog(1 + np.arange(len(one["costs"])), one["costs"], color=HUES[i][1], lw=1.8, label=f"SLQ, {name}")
        for i, one in enumerate(results["splines"] if phase == "swing" else ()):
            axes.loglog(1 + np.arange(len(one["costs"])), one["costs"], color=HUES[3 + i][1], lw=1.4,
                        label=f"BFGS, {one['parameters']} B-spline parameters")  # fmt: skip
        axes.axhline(results["updates"][phase]["feedback"]["cost"], color=SOFT, lw=0.8, ls=":")
        for labels in (axes.yaxis.set_major_formatter, axes.yaxis.set_minor_formatter):
            labels("{x:g}")
        axes.tick_params(axis="y", which="both", labelsize=8)
        axes.legend(frameon=False, fontsize=8)
    save(figure, path)
