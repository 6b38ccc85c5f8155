"""prove(): what an independent engine says of a plan, step by step, with every figure beside its bound.

    0. plan         the file's numbers agree with each other: start, states, cost, gradient, times
    1. parity       the plan's dynamics and MuJoCo's, at random states where the two models are the same
    2. same step    MuJoCo with the plan's own integrator and step: proves the transcription, nothing else
    3. refined      MuJoCo at a refined step, open loop and with the plan's gains
    4. goal         whether the replay gets where the cost wanted it

PASS needs 0, 1 and 2 (where they apply), and steps 3 and 4 in the same mode. Open loop is tried first.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from planner import lq
from planner.cost import TrackingCost
from planner.errors import PlannerError
from planner.figures import Figure, Section
from planner.gl import load_mujoco
from planner.mechanism import Mechanism
from planner.parity import parity
from planner.plan import Plan
from planner.problem import Problem
from planner.replay import Replay, replay, with_model
from planner.same_step import same_step
from planner.twin import Twin

CONSISTENCY_BOUND = 1e-9  # relative; a plan and its file agree to rounding
STATE_BOUND = 1e-2  # end state, in rad, m, rad/s, m/s: what the general rules ask
COST_BOUND = 1.0  # %


@dataclass(frozen=True, eq=False)
class Proof:
    """What the simulator says of a plan.

    Attributes:
        verdict: "PASS" or "FAIL".
        mode: "open-loop" or "feedback", the mode that passed; None when neither did.
        reason: The verdict in a sentence.
        plan: Step 0.
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
    plan: Section
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
        names = ("plan", "parity", "same_step", "refined_open_loop", "refined_feedback", "goal")
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
    if twin is None:
        raise PlannerError("the plan has no MuJoCo model to be replayed in, expected a Problem with a twin.")
    twin = with_model(twin, mjcf)
    runs = {"open-loop": replay(plan, twin=twin), "feedback": replay(plan, twin=twin, feedback=True)}
    first = (
        consistency(plan, plan.problem),
        parity(plan.problem, twin=twin, seed=seed),
        same_step(plan, plan.problem, twin),
    )
    judged = {mode: (_tracking(run, plan.problem), _goal(run, plan.problem)) for mode, run in runs.items()}
    sound = all(section.passed for section in first)
    mode = next((m for m, steps in judged.items() if sound and all(step.passed for step in steps)), None)
    shown = mode or "open-loop"
    return Proof(
        verdict="FAIL" if mode is None else "PASS",
        mode=mode,
        reason=_reason(mode, (*first, *judged[shown]), runs[shown]),
        plan=first[0],
        parity=first[1],
        same_step=first[2],
        refined_open_loop=judged["open-loop"][0],
        refined_feedback=judged["feedback"][0],
        goal=judged[shown][1],
        replay=runs[shown],
    )


def consistency(plan: Plan, problem: Problem) -> Section:
    """Step 0: whether a plan is what it says it is, by the plan's own dynamics and cost."""
    dynamics, cost = problem.dynamics, problem.cost
    ends = dynamics.step(plan.xs[:-1], plan.us)
    A, B = dynamics.linearize(plan.xs, plan.us)
    norm = float(np.linalg.norm(lq.gradient(A, B, cost.quadratize(plan.xs, plan.us))))
    scale = max(1.0, abs(plan.cost))
    largest = max(1.0, float(np.abs(plan.xs).max()))
    t = dynamics.dt * np.arange(plan.N + 1)
    errors = {
        "start_state_error": (np.abs(plan.xs[0] - problem.x0).max() / largest, "first state against the problem's x0"),
        "stage_error": (
            np.abs(plan.space.difference(ends, plan.xs[1:])).max() / largest,
            "each state against one stage from the last",
        ),
        "cost_error": (abs(cost.value(plan.xs, plan.us) - plan.cost) / scale, "the cost recomputed"),
        "gradient_error": (abs(norm - plan.gradient_norm) / scale, "the norm of Eq. 19 recomputed"),
        "time_error": (np.abs(plan.t - t).max() / problem.duration, "the knots against n dt"),
    }
    return Section(
        "plan",
        tuple(Figure(n, float(e), "", CONSISTENCY_BOUND, f"{note}, relative") for n, (e, note) in errors.items()),
    )


def _tracking(run: Replay, problem: Problem) -> Section:
    """Step 3 of one replay: by the machine's own rules, or the end and the cost by the general ones."""
    common = (
        Figure("simulator_warnings", float(len(run.warnings)), "", 0.0, " ".join(run.warnings)),
        Figure(
            "ranges_reached", float(len(run.reached)), "", None,
            " ".join(run.reached) or "of joints, controls and forces: a plan knows none, MuJoCo holds them",
        ),
    )  # fmt: skip
    if problem.requirements is not None and problem.requirements.tracking is not None:
        section = problem.requirements.tracking(run)
        return replace(section, figures=(*section.figures, *common))
    error = np.abs(run.error)
    cost = 100.0 * abs(run.cost - run.plan.cost) / max(abs(run.plan.cost), 1e-12)
    return Section(
        run.title,
        (
            Figure("end_state_error", float(error[-1].max()), "", STATE_BOUND, "largest component, rad, m, rad/s, m/s"),
            Figure("cost_error", cost, "%", COST_BOUND, "cost reached in MuJoCo against the plan's"),
            *common,
            *_along_the_path(error, problem),
            *(() if run.feedback else (_growth(run.plan, problem),)),
        ),
    )


def _along_the_path(error: np.ndarray, problem: Problem) -> tuple[Figure, ...]:
    """The largest errors over the whole replay, by kind where the plan's states are a mechanism's."""
    mechanism = getattr(problem.dynamics, "mechanism", None)
    if not isinstance(mechanism, Mechanism):
        return (Figure("largest_state_error", float(error.max()), "", None, "over the path, largest component"),)
    turns, nv = np.any(mechanism.S[:, :3] != 0.0, axis=1), mechanism.nv
    kinds = {
        "largest_angle_error": (error[:, :nv][:, turns], "rad"),
        "largest_distance_error": (error[:, :nv][:, ~turns], "m"),
        "largest_angular_velocity_error": (error[:, nv : 2 * nv][:, turns], "rad/s"),
        "largest_velocity_error": (error[:, nv : 2 * nv][:, ~turns], "m/s"),
    }
    return tuple(
        Figure(name, float(values.max()), unit, None, "over the path") for name, (values, unit) in kinds.items()
        if values.size
    )  # fmt: skip


def _growth(plan: Plan, problem: Problem) -> Figure:
    """How fast an error at the start grows along the plan without feedback: log ||dx(T)/dx(0)|| / T."""
    phi, log = np.eye(plan.space.ndx), 0.0
    for A in problem.dynamics.linearize(plan.xs, plan.us)[0]:
        phi = A @ phi
        size = float(np.linalg.norm(phi))
        phi, log = phi / size, log + float(np.log(size))
    log += float(np.log(np.linalg.norm(phi, 2)))
    note = f"an error at the start becomes up to {np.exp(min(log, 700.0)):.1e} times as large by the end, open loop"
    return Figure("error_growth_rate", log / problem.duration, "1/s", None, note)


def _goal(run: Replay, problem: Problem) -> Section:
    """Step 4 of one replay: the machine's own judgement, or how far from its cost's final state it ends."""
    if problem.requirements is not None and problem.requirements.goal is not None:
        return problem.requirements.goal(run)
    costs = getattr(problem.cost, "costs", (problem.cost,))
    wanted = [cost for cost in costs if isinstance(cost, TrackingCost) and np.any(cost.Q[-1])]
    if not wanted:
        return Section("goal", not_applicable="the problem states no goal apart from its cost")

    def distance(x: np.ndarray) -> float:
        errors = (np.abs(run.plan.space.difference(x, c.x_ref[-1]))[np.any(c.Q[-1], axis=0)].max() for c in wanted)
        return float(max(errors))

    note = "largest component that the cost's final weight acts on, against its reference; shown, not judged"
    return Section(
        "goal",
        (
            Figure("planned_goal_error", distance(run.plan.xs[-1]), "", None, note),
            Figure("replayed_goal_error", distance(run.xs[-1]), "", None, note),
        ),
    )


def _reason(mode: str | None, steps: tuple[Section, ...], run: Replay) -> str:
    """The verdict in a sentence: what held, or what broke and by how much."""
    if mode is None:
        broken = next(section for section in steps if section.failures)
        if broken.title == "parity":  # the first term that differs makes the later ones differ
            return f"{broken.title}: {broken.failures[0]}, {broken.failures[0].note}."
        reached = f" {' '.join(run.reached)}" if run.reached else ""
        return f"{broken.title}: {'; '.join(map(str, broken.failures))}.{reached}"
    judged = [figure for section in steps[-2:] for figure in section.figures if figure.bound]
    worst = max(judged, key=lambda figure: figure.value / (figure.bound or 1.0))
    how = "with the plan's gains" if mode == "feedback" else "open loop"
    return f"MuJoCo repeats the plan {how} at a step of {run.timestep:.3g} s; nearest to its bound: {worst}."
