"""prove(): an independent engine judges a plan step by step, every number beside its bound.

The steps are in prove(), a line each: those that every plan must pass, then those about its motion in MuJoCo.

PASS needs 0, 1 and 2 (where they apply), and steps 3 and 4 in the same mode. Open loop is tried first, and needs the
order too: a cost that a smaller step changes was never the plan's.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from planner.base.arguments import count, number, shown
from planner.base.errors import PlannerError
from planner.base.gl import load_mujoco
from planner.base.measured import Section
from planner.model.twin import Twin
from planner.problem.plan import Plan
from planner.proof.compiled_twin import another_model
from planner.proof.consistency import consistency
from planner.proof.growth import Growth, growth
from planner.proof.hold import Held, hold_gain, hold_section, replay_hold
from planner.proof.model_parity import parity_in
from planner.proof.order import Order, order
from planner.proof.perturbation import Perturbation
from planner.proof.perturbed import Perturbed, Trials, perturbed
from planner.proof.replaying import Replay, replay_in
from planner.proof.rollouts import MODES
from planner.proof.same_step import same_step
from planner.proof.tracking import goal, tracking

ROLLOUTS = 512


@dataclass(frozen=True, eq=False)
class Proof:
    """The simulator's judgement of a plan, step by step.

    Attributes:
        verdict: "PASS" or "FAIL".
        mode: "open-loop" or "feedback", the mode that passed; None when neither did.
        reason: The verdict in a sentence.
        sections: The steps by name, in order (docs/proof.md). Each is an attribute too: `proof.parity`,
            `proof.refined_open_loop`. `goal` is of the mode that passed, else open loop.
        replay: The replay in the mode that passed, else open loop.
        replays: Mode -> replay.
        errors: The growth of errors behind `growth`.
        convergence: The replays at halved steps behind `order`.
        held: The motion behind `hold`, or None.
        monte_carlo: The rollouts behind `perturbed`, or None.
        asked: The arguments of prove() that prove the same again, without another model.
    """

    verdict: str
    mode: str | None
    reason: str
    sections: dict[str, Section]
    replay: Replay
    replays: dict[str, Replay]
    errors: Growth
    convergence: Order
    held: Held | None = None
    monte_carlo: Perturbed | None = None
    asked: dict[str, Any] = field(default_factory=dict)

    @property
    def passed(self) -> bool:
        """Whether the verdict is PASS."""
        return self.verdict == "PASS"

    def __getattr__(self, name: str) -> Section:
        """A step by its name."""
        try:
            return self.__dict__["sections"][name]
        except KeyError:
            raise AttributeError(f"a Proof has no attribute {name!r}") from None

    def __dir__(self) -> list[str]:
        return [*super().__dir__(), *self.sections]

    def __str__(self) -> str:
        mode = f" ({self.mode})" if self.mode else ""
        return f"Proof({self.verdict}{mode}: {self.reason})"

    __repr__ = __str__

    def rows(self) -> list[tuple[str, str, str, str, str]]:
        """Every measured value as step, name, value, bound and "ok" or "FAIL"."""
        rows = []
        for section in self.sections.values():
            for one in section.measured:
                bound = "" if one.bound is None else f"{one.bound:g}"
                mark = "" if one.bound is None else ("ok" if one.passed else "FAIL")
                value = f"{one.value:.5g} {one.unit}".rstrip()
                rows.append((section.title, one.name.replace("_", " "), value, bound, mark))
        return rows

    def table(self) -> str:
        """All measured beside their bounds, one line each, then the verdict."""
        rows = [("step", "measured", "value", "bound", ""), *self.rows()]
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        lines = ["  ".join(c.ljust(w) for c, w in zip(row, widths, strict=True)).rstrip() for row in rows]
        more = [] if self.monte_carlo is None else self.monte_carlo.lines()
        return "\n".join([*lines, *more, str(self)])

    def to_dict(self) -> dict[str, Any]:
        """The proof as JSON values: proof.json."""
        run = self.replay
        simulator = {
            "engine": "MuJoCo", "version": load_mujoco().__version__, "integrator": run.integrator,
            "timestep": run.timestep, "steps_per_stage": run.substeps, "warnings": list(run.warnings),
        }  # fmt: skip
        sections = {name: section.to_dict() for name, section in self.sections.items()}
        found = None if self.monte_carlo is None else self.monte_carlo.to_dict()
        head = {"verdict": self.verdict, "mode": self.mode, "reason": self.reason}
        return {**head, **sections, "asked": self.asked, "monte_carlo": found, "simulator": simulator}


@np.errstate(all="ignore")  # a motion may run away: a NaN passes no bound
def prove(
    plan: Plan, *, mjcf: str | Path | None = None, twin: Twin | None = None, seed: int = 0, rollouts: int = ROLLOUTS,
    perturbation: Perturbation | None = None, hold_seconds: float = 0.0, budget: float | None = None,
    partial: Path | None = None, progress: Callable[[int, int], object] | None = None,
) -> Proof:  # fmt: skip
    """Replay a plan in MuJoCo at a refined step, open loop and with its gains, and judge it.

    Args:
        plan: A plan of a problem with a twin.
        mjcf: Another MJCF, a path or the XML text, in place of the plan's own; it must have the same states. What the
            plan's mechanism took out of its file is taken out of this one too.
        twin: Another model and other maps in place of the plan's own.
        seed: Of the random states of parity and of the perturbations.
        rollouts: Of step 5; 0 leaves it out.
        perturbation: The errors of step 5; by default Perturbation.usual(plan.problem).
        hold_seconds: How long to hold the goal after arriving, by an infinite-horizon LQR; 0 does not.
        budget: s that step 5 may take, with fewer rollouts where needed; None for all of them.
        partial: A file that keeps finished rollouts, so that an interrupted proof goes on where it was.
        progress: Called with the rollouts done and their number.

    Raises:
        PlannerError: The plan cannot be replayed at all; a plan that replays badly gets FAIL.
    """
    if not isinstance(plan, Plan):
        raise PlannerError(f"plan is {shown(plan)}, expected a Plan.")
    problem = plan.problem
    if problem is None:
        raise PlannerError(
            "the plan comes without its problem, which is its maker's own Python: expected prove() of a plan just "
            "solved, or load_plan(path, problem=...)."
        )
    count("seed", seed, least=0)
    count("rollouts", rollouts, least=0)
    number("hold_seconds", hold_seconds, least=0.0)
    twin = twin or plan.twin
    if twin is None:
        raise PlannerError("the plan has no MuJoCo model to be replayed in, expected a Problem with a twin.")
    compiled = another_model(problem, twin, mjcf)
    runs = {mode: replay_in(compiled, plan, feedback=mode == "feedback") for mode in MODES}
    required = {
        # Step 0: the file's numbers agree with each other: start, states, cost, gradient, gains, times.
        "plan": consistency(plan, problem),
        # Step 1: the plan's dynamics and MuJoCo's, at random states where the two models are the same.
        "parity": parity_in(compiled, problem, seed),
        # Step 2: MuJoCo with the plan's own integrator and step: proves the transcription, nothing else.
        "same_step": same_step(plan, problem, compiled),
    }
    errors = growth(plan, problem, runs)
    convergence = order(problem, runs["open-loop"])
    steps = {mode: [tracking(run, problem), goal(run, problem)] for mode, run in runs.items()}
    judged = {"open-loop": [*steps["open-loop"], convergence.section], "feedback": steps["feedback"]}
    sound = all(section.passed for section in required.values())
    mode = next((m for m in MODES if sound and all(step.passed for step in judged[m])), None)
    seen = mode or "open-loop"
    sections = {
        **required,
        # Step 3: MuJoCo at a refined step, open loop and with the plan's gains; beside it how errors grow along the
        # plan, the replay error that this predicts, what halving MuJoCo's step changes, and the cost at a step of zero.
        "refined_open_loop": steps["open-loop"][0],
        "refined_feedback": steps["feedback"][0],
        "growth": errors.section,
        "order": convergence.section,
        # Step 4: whether the replay gets where the cost wanted it, and whether the machine stays where it is asked to.
        "goal": steps[seen][1],
        "hold": Section("hold", not_applicable="it was not asked for"),
        # Step 5: how often it still arrives with other masses, friction, starts, noise and delay.
        "perturbed": Section("perturbed", not_applicable="no rollouts were asked for"),
    }
    asked = {
        "seed": seed, "rollouts": rollouts, "hold_seconds": hold_seconds, "perturbation": None,
        "another_model": compiled.twin is not plan.twin,
    }  # fmt: skip
    proof = Proof(
        verdict="FAIL" if mode is None else "PASS", mode=mode,
        reason=_reason(mode, (*required.values(), *judged[seen]), steps[seen], runs[seen]),
        sections=sections, replay=runs[seen], replays=runs, errors=errors, convergence=convergence, asked=asked,
    )  # fmt: skip
    if hold_seconds:
        proof = _held(proof, replay_hold(runs["feedback"], hold_gain(problem), hold_seconds))
    if not rollouts:
        return proof
    return with_rollouts(
        proof, rollouts, seed=seed, perturbation=perturbation, budget=budget, partial=partial, progress=progress
    )


def with_rollouts(
    proof: Proof, rollouts: int = ROLLOUTS, *, seed: int = 0, perturbation: Perturbation | None = None,
    budget: float | None = None, partial: Path | None = None, progress: Callable[[int, int], object] | None = None,
) -> Proof:  # fmt: skip
    """A proof with step 5 added; the arguments are those of prove()."""
    run, trials = proof.replay, Trials(rollouts, seed, perturbation)
    found = perturbed(run.plan, run.compiled, trials, budget=budget, partial=partial, progress=progress)
    asked = proof.asked | {"rollouts": found.done, "perturbation": asdict(found.perturbation)}
    return replace(proof, sections=proof.sections | {"perturbed": found.section}, monte_carlo=found, asked=asked)


def _held(proof: Proof, held: Held) -> Proof:
    """The proof with the hold step added: a machine that was to stay at the goal and does not, fails."""
    section = hold_section(held)
    proof = replace(proof, sections=proof.sections | {"hold": section}, held=held)
    if section.passed or not proof.passed:
        return proof
    plan, warned = proof.replay.plan, "".join(f" {sentence}" for sentence in held.warnings)
    miss = float(np.abs(plan.space.difference(proof.replays["feedback"].xs[-1], held.hold.x_goal)).max())
    reason = (
        f"hold: {'; '.join(map(str, section.failures))}.{warned} The replay ends {miss:.2g} from the goal (largest "
        "component), too far for the regulator; larger final weights end nearer."
    )
    return replace(proof, verdict="FAIL", mode=None, reason=reason)


def _reason(mode: str | None, judged: tuple[Section, ...], steps: list[Section], run: Replay) -> str:
    """The verdict in a sentence: how the plan passed, or which step failed and by how much."""
    if mode is None:
        broken = next(section for section in judged if section.failures)
        more = "".join(f" {sentence}" for sentence in (*run.warnings, *run.reached))
        if broken.title == "parity":  # the first term that differs makes the later ones differ
            return f"{broken.title}: {broken.failures[0]}, {broken.failures[0].note}.{more}"
        if broken.title == "plan" and run.plan.changed:
            return f"plan: {broken.failures[-1].note}.{more}"
        failures = "; ".join(map(str, broken.failures))
        if run.reached and broken.title != "plan":  # what was reached is why the rest differs
            return f"{broken.title}:{more} {failures[0].upper()}{failures[1:]}."
        return f"{broken.title}: {failures}.{more}"
    measured = [one for section in steps for one in section.measured if one.bound]
    worst = max(measured, key=lambda one: one.value / (one.bound or 1.0))
    how = "with the plan's gains" if mode == "feedback" else "open loop"
    return f"MuJoCo repeats the plan {how} at a step of {run.timestep:.3g} s; nearest to its bound: {worst}."
