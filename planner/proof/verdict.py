"""Proof: the measurements and verdict on a plan, and its headline.

The headline states three results and the elements not tested:

    PASS (open-loop), planned without contacts of 1 pair (tested in your file); feasible, optimal, robust with its gains

feasible: MuJoCo reproduces the plan and ends at its goal, in the mode in brackets. optimal: the solve converged, and no
direction lowers the cost; "for its duration" where the objective has time, and no other duration was tried. Then what
the plan may be used for:

    robust with its gains                           run it with its gains on the machine
    robust at its goals                             its gains bring it there; on the way it leaves its path's bound
    fragile with its gains: 50 % succeed            with its gains so many machines with small errors still succeed
    open loop only: with its gains ...              its gains lead astray: apply its controls alone
    robustness: undecided                           too few rollouts to tell
    robustness: pending                             not measured yet: of a run that is going on

"planned without ..." lists elements of the user's file that the plan's model lacks; step 6 replayed the plan with them.
"though half as long stages ..." of a solve that ended UNRESOLVED: MuJoCo's finer steps repeat its plan all the same.
What only concerns a simulation at the file's own step, which is not the one of the proof, is in `own_step`.
"without ..." lists elements of no replay: pairs that overlap at the start, or all if the file was not replayed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from planner.base.gl import load_mujoco
from planner.base.late_imports import Renderable
from planner.base.measured import Measurement, Section, aligned, dicts_of, rows_of
from planner.problem.objective import seeks_duration
from planner.problem.progress import Status
from planner.problem.rediscretize import step_error
from planner.proof.consistency import STEP_ERROR
from planner.proof.error_propagation import FACTOR, SMALL, ErrorPropagation
from planner.proof.error_scales import SMOOTHED, has_contacts, is_path_judged, worst_by_unit
from planner.proof.goal_regulator import RegulatedRun
from planner.proof.replays.replaying import Replay
from planner.proof.robustness.perturbation import Perturbation
from planner.proof.robustness.perturbed import JUDGED, RobustnessResult
from planner.proof.stationarity import curvature_unknown
from planner.proof.step_convergence import NAME as OWN_STEP
from planner.proof.step_convergence import StepConvergence

TESTED = "tested in your file"
OPEN_LOOP_ONLY, AT_GOALS = "open loop only", "robust at its goals"
MOST = 1000.0  # %, of a predicted error of the steps; what is above it has no meaning as a number
PATH_WITH_GAINS = "path_with_gains_over_its_bound"  # of the section of the user's file


@dataclass(frozen=True, eq=False)
class Proof(Renderable):
    """The measurements and verdict on a plan, step by step.

    Attributes:
        verdict: "PASS" or "FAIL".
        mode: "open-loop" or "feedback", the mode that passed; None when neither did.
        reason: The verdict in a sentence.
        sections: The steps by name, in order (docs/proof.md). Each is an attribute too: `proof.parity`,
            `proof.refined_open_loop`. `goal` is of the mode that passed, else of the one with the smaller error.
        replay: The replay in the mode that passed, else in the one with the smaller error.
        replays: Mode -> replay.
        errors: The growth of errors behind `growth`.
        convergence: The replays at halved steps behind `order`.
        held: The simulation behind `hold`, or None.
        monte_carlo: The rollouts behind `perturbed`, or None.
        asked: The arguments of prove() that reproduce this proof, without another model.
        planned_without: Elements of the user's file that the plan's model lacks and the replay of step 6 had.
            A phrase each.
        not_checked: Elements of the user's file that no replay had, and goals not judged; a phrase each.
        lost_with_gains: What fails in the replay with gains of a plan that passed open loop.
        lost_in_file: Whether that is in the user's file alone.
    """

    verdict: str
    mode: str | None
    reason: str
    sections: dict[str, Section]
    replay: Replay
    replays: dict[str, Replay]
    errors: ErrorPropagation
    convergence: StepConvergence
    held: RegulatedRun | None = None
    monte_carlo: RobustnessResult | None = None
    asked: dict[str, Any] = field(default_factory=dict)
    planned_without: tuple[str, ...] = ()
    not_checked: tuple[str, ...] = ()
    lost_with_gains: tuple[Measurement, ...] = ()
    lost_in_file: bool = False

    @property
    def feasible(self) -> bool:
        """Whether MuJoCo reproduces the plan, satisfies its limits and ends at its goal, in one of the modes."""
        return self.mode is not None

    @property
    def optimal(self) -> bool:
        """Whether the solve converged."""
        return self.sections["optimality"].passed

    @property
    def robustness(self) -> str:
        """The grade: "open loop only", "robust", "fragile", "robustness: undecided", "robustness: pending" or ""."""
        return self._graded("", "")

    @property
    def misleads(self) -> bool:
        """Whether it passed, though the plan is fragile or for open loop only: a PASS with a warning."""
        fragile = self.monte_carlo is not None and self.monte_carlo.robustness == "fragile"
        return self.passed and (fragile or bool(self.lost_with_gains))

    @property
    def leaves_path(self) -> bool:
        """Whether the path with the plan's gains leaves its bound in the user's file."""
        return any(one.name == PATH_WITH_GAINS and one.value > 1.0 for one in self.sections["your_file"].measured)

    def _graded(self, judged: str, share: str) -> str:
        """The grade; of rollouts followed by the judged mode, and if fragile by the share of successes."""
        if self.lost_with_gains:
            return OPEN_LOOP_ONLY
        if self.monte_carlo is None:
            return "robustness: pending" if self.asked.get("rollouts") else ""
        word, drawn = self.monte_carlo.robustness, self.monte_carlo.perturbation
        other = "" if drawn == Perturbation.usual(self.replay.plan.problem) else " at other than the standard errors"
        if word == "robust" and self.leaves_path:
            word, judged = AT_GOALS, ""
        share = share if word == "fragile" else ""
        return f"robustness: {word}{other}" if word == "undecided" else f"{word}{judged}{other}{share}"

    @property
    def _grade_words(self) -> str:
        """The grade as the headline has it, with its number."""
        if self.lost_with_gains:
            worst = max(self.lost_with_gains, key=lambda one: one.over)
            counted = self.lost_in_file and worst.bound == 0.0  # its note says what was counted, in sentences
            what = worst.note.removesuffix(".") if counted else worst.excess_text
            return f"{OPEN_LOOP_ONLY}: {'in your file ' if self.lost_in_file else ''}with its gains {what}"
        share = (
            "" if self.monte_carlo is None else f": {100.0 * self.monte_carlo.rates['feedback'].value:.0f} % succeed"
        )
        return self._graded(JUDGED, share)

    @property
    def results(self) -> str:
        """Whether the plan is feasible, optimal and robust, in words."""
        unknown = " (curvature not checked)" if curvature_unknown(self.sections["optimality"].measured) else ""
        plan = self.replay.plan
        of_one = plan.problem is not None and seeks_duration(plan.problem) and "tried" not in plan.options
        words = [
            "feasible" if self.feasible else "not feasible",
            f"optimal{' for its duration' if of_one else ''}{unknown}" if self.optimal else "not optimal",
        ]
        if "cut" in (options := plan.options):
            words.append(f"cut by its {options['cut']}")
        return ", ".join([*words, *filter(None, [self._grade_words])])

    @property
    def remarks(self) -> tuple[str, ...]:
        """What the verdict does not cover, a phrase each: elements not planned with or not tested, goals not judged.

        And of a plan that passes although it is UNRESOLVED, by how much halving its stages is predicted to move it.
        """
        tested = f"planned without {' and '.join(self.planned_without)} ({TESTED})" if self.planned_without else ""
        return tuple(filter(None, (tested, self._step_error, *self.not_checked)))

    @property
    def own_step(self) -> str:
        """A sentence where the file's own step and integrator simulate the plan otherwise than it was judged; or ""."""
        given = self.sections["your_file"]
        note = next((one.note for one in given.measured if one.name == OWN_STEP and one.value > 0.0), "")
        return f"{note[0].upper()}{note[1:]}." if note and given.passed else ""

    @property
    def _step_error(self) -> str:
        if not self.passed or self.replay.plan.status is not Status.UNRESOLVED:
            return ""
        error = next((one.value for one in self.sections["optimality"].measured if one.name == STEP_ERROR), math.nan)
        share = f"{error:.2g} %" if error < MOST else f"more than {MOST:g} %"
        return f"though half as long stages are predicted to move the motion by {share} of its range"

    @property
    def headline(self) -> str:
        """The verdict, the remarks, and whether the plan is feasible, optimal and robust."""
        mode = f" ({self.mode})" if self.passed and self.mode else ""
        return f"{', '.join([self.verdict + mode, *self.remarks])}; {self.results}"

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
        return f"Proof({self.headline}: {self.reason})"

    __repr__ = __str__

    def rows(self) -> list[tuple[str, str, str, str, str]]:
        """Every measured value as step, name, value, bound and "ok" or "FAIL"."""
        return rows_of(self.sections)

    def table(self) -> str:
        """All measurements with their bounds, one line each, then the verdict."""
        lines = aligned([("step", "measured", "value", "bound", ""), *self.rows()])
        more = [] if self.monte_carlo is None else self.monte_carlo.lines()
        return "\n".join([*lines, *more, str(self), *filter(None, [self.own_step])])

    def to_dict(self) -> dict[str, Any]:
        """The proof as JSON values: proof.json."""
        run = self.replay
        simulator = {
            "engine": "MuJoCo", "version": load_mujoco().__version__, "integrator": run.integrator,
            "timestep": run.timestep, "steps_per_stage": run.substeps, "warnings": list(run.warnings),
        }  # fmt: skip
        found = None if self.monte_carlo is None else self.monte_carlo.to_dict()
        head = {
            "verdict": self.verdict, "mode": self.mode, "headline": self.headline, "feasible": self.feasible,
            "optimal": self.optimal, "robustness": self.robustness,
            "planned_without": list(self.planned_without), "not_checked": list(self.not_checked),
            "own_step": self.own_step, "reason": self.reason,
        }  # fmt: skip
        return {**head, **dicts_of(self.sections), "asked": self.asked, "monte_carlo": found, "simulator": simulator}


FALLEN = 100.0  # bounds: a machine that has fallen open loop says nothing of its gains


class ContactError(NamedTuple):
    """The largest error of the path with gains, and what the step makes of it, both in bounds of the path."""

    off: float
    by_step: float


def contact_error(proof: Proof) -> ContactError | None:
    """How far contacts put a replay off, where no finer step helps; None without them, or if small or the step's."""
    run = proof.replays["feedback"]
    if not has_contacts(run.plan):
        return None
    off = max(one.share for one in worst_by_unit(run.plan, run.error) if is_path_judged(run.plan, one.unit))
    by_step = step_error(run.plan) / SMOOTHED
    small = not (SMALL < off < FALLEN and off > FACTOR * by_step)  # another plan may bring it within its bound
    return None if small else ContactError(off, by_step)
