"""prove(): what an independent engine says of a plan, step by step, with every figure beside its bound.

    1. parity       the plan's dynamics and MuJoCo's, at random states where the two models are the same
    2. same step    MuJoCo with the plan's own integrator and step: proves the transcription, nothing else
    3. refined      MuJoCo at a refined step, open loop and with the plan's gains
    4. goal         whether the replay gets where the cost wanted it

PASS needs parity, step 3 in one of its modes, and step 4 in the same mode. Open loop is tried first.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from planner.errors import PlannerError
from planner.figures import Figure, Section
from planner.gl import load_mujoco
from planner.mjcf import model_text
from planner.plan import Plan
from planner.problem import Problem, Requirements
from planner.replay import Replay, matching_model, replay
from planner.twin import Twin

PARITY_STATES = 256
PARITY_BOUND = 1e-10  # relative; the study of open chains found 3e-14
STATE_BOUND = 1e-2  # end state, in rad, m, rad/s, m/s: what the general rules ask
COST_BOUND = 1.0  # %


@dataclass(frozen=True, eq=False)
class Proof:
    """What the simulator says of a plan.

    Attributes:
        verdict: "PASS" or "FAIL".
        mode: "open-loop" or "feedback", the mode that passed; None when neither did.
        reason: The verdict in a sentence.
        parity: Step 1.
        same_step: Step 2.
        refined_open_loop: Step 3 without gains.
        refined_feedback: Step 3 with gains.
        goal: Step 4, in the mode that passed, else open loop.
        replay: The replay in that mode.
    """

    verdict: str
    mode: str | None
    reason: str
    parity: Section
    same_step: Section
    refined_open_loop: Section
    refined_feedback: Section
    goal: Section
    replay: Replay

    @property
    def passed(self) -> bool:
        """Whether the verdict is PASS."""
        return self.verdict == "PASS"

    @property
    def sections(self) -> dict[str, Section]:
        """The steps in order."""
        names = ("parity", "same_step", "refined_open_loop", "refined_feedback", "goal")
        return {name: getattr(self, name) for name in names}

    def __str__(self) -> str:
        mode = f" ({self.mode})" if self.mode else ""
        return f"Proof({self.verdict}{mode}: {self.reason})"

    __repr__ = __str__

    def to_dict(self) -> dict[str, Any]:
        """The proof as JSON values: proof.json."""
        return {
            "verdict": self.verdict,
            "mode": self.mode,
            "reason": self.reason,
            **{name: section.to_dict() for name, section in self.sections.items()},
            "simulator": {
                "engine": "MuJoCo",
                "version": load_mujoco().__version__,
                "integrator": self.replay.integrator,
                "timestep": self.replay.timestep,
                "steps_per_stage": self.replay.substeps,
                "warnings": list(self.replay.warnings),
            },
        }


def prove(plan: Plan, *, mjcf: str | Path | None = None, twin: Twin | None = None, seed: int = 0) -> Proof:
    """Replay a plan in MuJoCo at a refined step, open loop and with its gains, and judge it.

    Args:
        plan: A plan of a problem with a twin.
        mjcf: Another MJCF, a path or the XML text, in place of the plan's own; it must have the same states.
        twin: Another model and other maps in place of the plan's own.
        seed: Of the random states of parity.

    Raises:
        PlannerError: The plan cannot be replayed at all; a plan that replays badly gets FAIL.
    """
    if plan.problem is None:
        raise PlannerError("the plan comes without its problem, expected a plan of planner.cases or one just solved.")
    twin = twin or plan.twin
    if twin is not None and mjcf is not None:
        text = mjcf if isinstance(mjcf, str) and mjcf.lstrip().startswith("<") else model_text(mjcf)
        twin = replace(twin, mjcf=text)
    requirements = plan.problem.requirements
    open_loop = replay(plan, twin=twin)
    feedback = replay(plan, twin=twin, feedback=True)
    assert twin is not None  # replay has checked
    first = parity(plan.problem, twin, seed)
    steps = {"open-loop": (open_loop, *_judge(open_loop, requirements)),
             "feedback": (feedback, *_judge(feedback, requirements))}  # fmt: skip
    mode = next((m for m, (_, track, goal) in steps.items() if first.passed and track.passed and goal.passed), None)
    shown, tracking, goal = steps[mode or "open-loop"]
    return Proof(
        verdict="FAIL" if mode is None else "PASS",
        mode=mode,
        reason=_reason(mode, first, tracking, goal, shown),
        parity=first,
        same_step=_same_step(requirements),
        refined_open_loop=steps["open-loop"][1],
        refined_feedback=steps["feedback"][1],
        goal=goal,
        replay=shown,
    )


def parity(problem: Problem, twin: Twin | None = None, seed: int = 0) -> Section:
    """Compare dx/dt of the plan's dynamics with MuJoCo's at random states where the two models are the same."""
    requirements = problem.requirements
    if requirements is None or requirements.smooth is None:
        return Section("parity", not_applicable="the case names no states at which the two models are the same")
    mujoco = load_mujoco()
    twin = twin or problem.twin
    if twin is None:
        raise PlannerError("the problem has no MuJoCo model to be compared with, expected a twin.")
    model = matching_model(twin, problem.dynamics.nu)
    data = mujoco.MjData(model)
    nq, nv = model.nq, model.nv
    rng = np.random.default_rng(seed)
    xs = requirements.smooth(rng, PARITY_STATES)
    us = rng.normal(size=(PARITY_STATES, problem.dynamics.nu))
    ours = requirements.rates(xs, us)
    theirs = np.empty_like(ours)
    for i, w in enumerate(twin.sim_of(xs)):
        data.qpos[:], data.qvel[:], data.act[:] = np.split(w, [nq, nq + nv])
        data.ctrl[:] = us[i]
        mujoco.mj_forward(model, data)
        theirs[i] = twin.to_x @ np.concatenate([data.qvel, data.qacc, data.act_dot])
    error = np.abs(theirs - ours).max(axis=0) / np.maximum(np.abs(ours).max(axis=0), 1e-300)
    note = f"largest over {PARITY_STATES} random states (seed {seed}), relative to the largest rate"
    figures = [Figure("rate_error", float(error.max()), "", PARITY_BOUND, note)]
    if requirements.start:
        figures.append(_start(problem, twin, model, requirements.start))
    return Section("parity", tuple(figures))


def _start(problem: Problem, twin: Twin, model: Any, name: str) -> Figure:
    """Whether a keyframe of the model is the plan's own start."""
    note = f"keyframe {name!r} of the model against the plan's start, largest component"
    key = next((k for k in range(model.nkey) if model.key(k).name == name), None)
    if key is None:
        return Figure("start_error", np.inf, "", PARITY_BOUND, note)
    w = np.concatenate([model.key_qpos[key], model.key_qvel[key], model.key_act[key]])
    error = float(np.max(np.abs(w - twin.sim_of(problem.x0))))
    return Figure("start_error", error, "", PARITY_BOUND, note)


def _judge(run: Replay, requirements: Requirements | None) -> tuple[Section, Section]:
    """Step 3 and step 4 of one replay."""
    if requirements is not None:
        return requirements.tracking(run), requirements.goal(run)
    which = "feedback" if run.feedback else "open loop"
    end = float(np.max(np.abs(run.xs[-1] - run.plan.xs[-1])))
    cost = 100.0 * abs(run.cost - run.plan.cost) / max(abs(run.plan.cost), 1e-12)
    tracking = Section(
        f"refined, {which}",
        (
            Figure("end_state_error", end, "", STATE_BOUND, "largest component, MuJoCo against the plan"),
            Figure("cost_error", cost, "%", COST_BOUND, "cost reached in MuJoCo against the plan's"),
        ),
    )
    return tracking, Section("goal", not_applicable="the problem states no goal apart from its cost")


def _same_step(requirements: Requirements | None) -> Section:
    why = requirements.same_step if requirements is not None else "the problem states no rates to compare"
    return Section("same step", not_applicable=why)


def _reason(mode: str | None, first: Section, tracking: Section, goal: Section, run: Replay) -> str:
    """The verdict in a sentence: what held, or what broke and by how much."""
    if mode is not None:
        worst = max(
            (f for f in (*tracking.figures, *goal.figures) if f.bound),
            key=lambda f: f.value / (f.bound or 1.0),
        )
        how = "with the plan's gains" if mode == "feedback" else "open loop"
        return f"MuJoCo repeats the plan {how} at a step of {run.timestep:.3g} s; nearest to its bound: {worst}."
    for section in (first, tracking, goal):
        if section.failures:
            return f"{section.title}: {'; '.join(str(f) for f in section.failures)}."
    return "the plan does not pass with its gains either."
