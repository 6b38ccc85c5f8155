"""The human step (section 2.3) on the page: pictures of swing and cycle, a section of text, rows of the table."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from planner.cases.human_step.walker import SIDES, SWING
from planner.paper.studies.step_run import (
    COEFFICIENTS,
    CYCLE_TIME,
    DEGREE,
    FRAMES,
    LIMITS,
    SHORT,
    WITHIN,
    first_within,
    step_results,
)
from planner.paper.studies.study import Row, Study, row_of, table
from planner.problem.appearance import PoseSequence, Stick, StickFigures
from planner.view.plots.case_pictures import draw_stick_figures
from planner.view.plots.style import DASHED, HUES, SOFT, dress, panels_of, save

PAPERS = 32  # parameters


def _rows(results: dict[str, Any]) -> list[Row]:
    swing, cycle, lowest = results["updates"]["swing"], results["updates"]["cycle"], results["without_clearance"]
    few, many = results["splines"]
    shown, both, drawn = results["swing"], results["cycle"], results["default"]
    lift = 1e3 * shown["hip_lift"]["right"]
    slq, eq36, alone = (cycle[update] for update in LIMITS)
    return [
        Row("2.3", f"Human step: {PAPERS} B-spline parameters for the swing hip",
            "; ".join(
                f"{s['parameters']} parameters: J {s['cost']:.4g}, {_ended(s)} after {s['iterations']} "
                f"iterations, {s['seconds']:.0f} s" for s in (few, many)
            )
            + f"; SLQ on the same problem: J {swing['feedback']['cost']:.4g}, "
            f"{swing['feedback']['iterations']} iterations, {swing['feedback']['seconds']:.2g} s",
            "the gradient is the exact one of the discretized J (Eq. 16-19 times the basis) in place of Eq. 7, "
            "so BFGS does converge. Our splines are six accelerations of the pelvis; the paper does not say which "
            "motions of the hip were its splines"),
        Row("2.3, Fig. 5",
            "The pelvis alone moves a paralysed leg through a step near the recorded gait: hip lifted, pelvis "
            "twisted",
            f"hip lifted by {lift:.0f} mm ({1e3 * lowest['hip_lift']['right']:.0f} mm if the foot need not be "
            f"clear), the foot at least {1e3 * shown['clearance']['right']:.0f} mm up in the middle of the "
            f"swing; from the normal gait, RMS: {_rms(shown, ('right',))}; at the end hip and knee are "
            f"{abs(shown['end_deg'][0]):.1f} and {abs(shown['end_deg'][1]):.1f} deg off, the heel is "
            f"{-1e3 * shown['end_heel_m'][0]:.0f} mm behind; MuJoCo is "
            f"{shown['replay_deg']['open-loop']:.2g} deg RMS from it",
            "the paper gives no numbers, nor the size of the person; we take them from a table. The knee is passive "
            "and bends less than a walker's. The pelvis is listed more than it is twisted. At the end it is tilted, "
            "which shortens the step: the cost asks for angles, not for the place where the foot lands"),
        Row("2.3", "Approximately 4 hours to converge (no computer named)",
            f"swing {swing['feedback']['seconds']:.2g} s, stance and swing of both legs {slq['seconds']:.2g} s",
            "today's processor is some tens of times as fast: hours become minutes. The rest comes from exact "
            f"derivatives, and from {swing['feedback']['iterations']} iterations in place of hundreds: BFGS with "
            f"{few['parameters']} parameters takes {few['seconds']:.0f} s here"),
        Row("2.3", "Stance and swing together were unstable and did not converge",
            f"{slq['status'].lower()} in {slq['iterations']} iterations from J {slq['costs'][0]:.0f} to "
            f"{slq['cost']:.2f} (within 5 % after {first_within(slq['costs'], 0.05)}); the paper's update "
            f"(Eq. 36) {eq36['cost']:.2f} after {eq36['iterations']}; without Eq. 30, U + alpha k, it is still "
            f"at {alone['cost']:.0f} after {alone['iterations']}",
            "four things help: smooth contact, a cost for a standing foot that is off the belt, accelerations of the "
            "pelvis as controls, and rollouts with the gains. Eq. 36 converges too, more slowly and to a slightly "
            "higher minimum. Without the states of the LQ problem it fails"),
        Row("2.3",
            'Believed possible: "in just a few minutes" by the new algorithm, stance and swing together',
            f"{slq['seconds']:.2g} s for a cycle, {results['cycles']['seconds']:.2g} s for "
            f"{results['cycles']['cycles']} at once (the default cost: {drawn['cycle']['seconds']:.2g} s for a "
            f"cycle); MuJoCo is {both['replay_deg']['open-loop']:.2g} deg RMS from the plan without feedback, "
            f"{both['replay_deg']['feedback']:.2g} deg with the gains",
            "it does not differ: it takes even less"),
    ]  # fmt: skip


def _ended(splines: dict[str, Any]) -> str:
    return "converged" if splines["success"] else "not converged"


def _rms(motion: dict[str, Any], sides: tuple[str, ...]) -> str:
    """Hip, knee and ankle, the worse of the sides."""
    named = (("hip", "hip_flexion"), ("knee", "knee"), ("ankle", "ankle"))
    return ", ".join(f"{word} {max(motion['rms'][f'{s}_{joint}'] for s in sides):.1f} deg" for word, joint in named)


def _page(results: dict[str, Any]) -> list[str]:
    swing, cycle, drawn, more = results["swing"], results["cycle"], results["default"], results["cycles"]
    slq = results["updates"]["swing"]["feedback"]["cost"]
    within = {f"to {100.0 * share:g} %": f"{{within[{i}]}}" for i, share in enumerate(WITHIN)}
    solves = [
        _shares({"phase": phase, "update": name, **one})
        for phase, updates in results["updates"].items() for name, one in updates.items()
    ]  # fmt: skip
    solves.append(_shares({"phase": f"{more['cycles']} cycles", "update": "feedback", **more}))
    splines = [_shares({"ended": _ended(one), "slq": slq, **one}) for one in results["splines"]]
    return [
        "## The human step (section 2.3)", "",
        "A robot moves the pelvis of a person whose legs are passive, over a treadmill. What the model and the cost",
        "are, and what not to conclude from it: `docs/human-step.md`.", "",
        "![the swing, optimized solid and normal dashed](step_fig5.png)", "",
        "![joint angles, pelvis, foot forces, robot, of a cycle](step_cycle.png)", "",
        "The pictures are of the default cost. All that follows is one problem for every method, `cost=\"study\"`,",
        "from the normal motion of the pelvis.", "",
        "![J by iteration](step_methods.png)", "",
        *table({
            "phase": "{phase}", "update": "{update}", "status": "{status}", "iterations": "{iterations}", **within,
            "J": "{cost:.4f}", "s": "{seconds:.2f}",
        }, solves),
        "", "Open-loop is the paper's Eq. 36: the direction dU holds the states of the LQ problem (Eq. 25, 30).",
        "Feedforward alone is U + alpha k, what is left when they are forgotten: no direction of the paper's, and the",
        "one that crawls on the swing and gets stuck on the cycle. It is counted in NumPy, so its seconds are not the",
        f"others'; limits {', '.join(f'{limit} ({name})' for name, limit in results['limits'].items())}.", "",
        f"The swing by B-splines: six accelerations of the pelvis of degree {DEGREE}, BFGS, exact gradient by the",
        f"costate. {COEFFICIENTS[0]} coefficients each are nearly the paper's {PAPERS} parameters:", "",
        *table({
            "parameters": "{parameters}", "BFGS": "{ended}", "iterations": "{iterations}",
            "evaluations": "{evaluations}", **within, "J": "{cost:.3f}", "J of SLQ": "{slq:.3f}", "s": "{seconds:.1f}",
        }, splines), "",
        "| motion | hip, knee, ankle from the normal gait, deg RMS | least clearance, mm | hip lift, mm "
        "| on the belt in stance, % | in swing, % | in MuJoCo, without and with gains, deg RMS |",
        "|---|---|---|---|---|---|---|",
        *(_line(name, motion, sides) for name, motion, sides in (
            ("swing", swing, ("right",)), ("swing, foot need not be clear", results["without_clearance"], ("right",)),
            ("cycle", cycle, ("right", "left")),
        )), "",
        "Legs carried by the normal motion of the pelvis, for comparison: "
        + ", ".join(f"{joint} {max(cycle['carried_rms'][f'{s}_{joint}'] for s in ('right', 'left')):.0f} deg"
                    for joint in ("hip_flexion", "knee", "ankle")).replace("hip_flexion", "hip") + ".",
        "", f"With the default cost, which wants more clearance: swing {drawn['swing']['iterations']} iterations, "
        f"cycle {drawn['cycle']['iterations']}, least clearance "
        f"{1e3 * min(drawn['cycle']['clearance'].values()):.0f} mm.",
    ]  # fmt: skip


def _shares(record: dict[str, Any]) -> dict[str, Any]:
    """The record with the iterations after which J is within each share of its end."""
    return record | {"within": [first_within(record["costs"], share) for share in WITHIN]}


def _line(name: str, motion: dict[str, Any], sides: tuple[str, ...]) -> str:
    def both(key: str, scale: float, form: str) -> str:
        return " / ".join(format(scale * motion[key][side], form) for side in sides)

    errors, stance, swing = motion["replay_deg"], "no belt", ""
    if motion["largest_force"] > 0.0:
        stance, swing = both("in_stance", 100.0, ".0f"), both("in_swing", 100.0, ".0f")
    return row_of([
        name, _rms(motion, sides), both("clearance", 1e3, ".1f"), both("hip_lift", 1e3, ".0f"), stance, swing,
        f"{errors['open-loop']:.2g}, {errors['feedback']:.2g}",
    ])  # fmt: skip


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


STUDY = Study("step", "the human step (2.3)", partial(step_results, **SHORT), _page, _rows, {
    "step_fig5.png": draw_step, "step_cycle.png": draw_step_cycle, "step_methods.png": draw_step_methods,
}, seconds=18, full=step_results)  # fmt: skip
