"""The verdict of a closed loop: does it arrive and stay? Its robustness margins are in planner.control.loop_margins.

    arrives    every goal within its tolerance in time; paths and waypoints at their times
    stays      every final goal within its tolerance over the last second

A perturbed robot (model error, push) passes within five times the tolerances: the rule of the proof's perturbed
rollouts. A built-in problem's own success rule, as for the path of a step or the apex of a hop, takes precedence.
A stop that the plan does not model is not to be run into, whatever pushes.

Results are Sections of Measurements, as in a proof.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from planner.base.arguments import short_repr
from planner.base.errors import PlannerError
from planner.base.measured import Measurement, Section, dicts_of, rows_of
from planner.control.simulating import LATE, STAYS, ClosedLoopRun
from planner.control.window_parts import goal_states, is_of_frames
from planner.dynamics.kinematics import frame_pose
from planner.model.coordinates import coordinates_of
from planner.problem.goals import MIN_TOLERANCES, GoalCheck, goals_of
from planner.proof.reached_limits import stop_excess
from planner.proof.replay_errors import misses, word_of, worst_of
from planner.proof.robustness.success import GOAL_TOLERANCES, OF_RANGE, SuccessRule, rule_of

BEYOND_STOP, BEYOND_RANGE, VIOLATED = "beyond_its_stop", "beyond_its_range", "constraint_violation"


@dataclass(frozen=True, eq=False)
class LoopVerdict:
    """The verdict of a closed loop.

    Attributes:
        sections: By name: arrives and stays, or follows for a moving goal; kept, simulator, calls; survives after
            with_margins().
        loop: The judged run.
        robustness_maps: By "loop" or "gains" (the plan's feedback alone): largest survived push (times,), N.
        times: Start of these pushes, s.
    """

    sections: dict[str, Section]
    loop: ClosedLoopRun
    robustness_maps: dict[str, np.ndarray] = field(default_factory=dict)
    times: np.ndarray = field(default_factory=lambda: np.zeros(0))

    @property
    def passed(self) -> bool:
        """Whether every bounded measurement is within its bound."""
        return all(section.passed for section in self.sections.values())

    @property
    def verdict(self) -> str:
        """The word PASS or FAIL."""
        return "PASS" if self.passed else "FAIL"

    @property
    def headline(self) -> str:
        """The verdict, with the sections arrives, stays and follows, and the number of events."""
        words = []
        for name, section in self.sections.items():
            if name in ("arrives", "stays", "follows") and not section.not_applicable:
                words.append(name if section.passed else f"does not {name.removesuffix('s')}")
        words += self._violations()
        if self.loop.events:
            words.append(f"{len(self.loop.events)} events")
        return f"{self.verdict} (loop); {', '.join(words) or 'nothing was asked of it'}"

    def _violations(self) -> list[str]:
        """What the machine did not keep, by how much: a push may make it unavoidable, and it is to be known."""
        limits, found = self.loop.controller.problem.limits, list[str]()
        tolerance = 0.0 if limits is None else limits.tolerance
        for one in self.sections["kept"].measured:
            if one.name == BEYOND_STOP and not one.passed:
                found.append(f"{one.value:.2g} {one.unit}".rstrip() + " beyond a stop")
            elif one.name.endswith(BEYOND_RANGE) and one.value > tolerance:
                found.append(f"{one.value:.2g} {one.unit} beyond a range")
        return found

    @property
    def reason(self) -> str:
        """The failed measurements as text; "" for a PASS."""
        return "; ".join(str(one) for section in self.sections.values() for one in section.failures)

    def with_margins(self, section: Section, maps: dict[str, np.ndarray], times: np.ndarray) -> LoopVerdict:
        """A copy with the result of margins(), which does not change the verdict."""
        return replace(self, sections=self.sections | {"survives": section}, robustness_maps=maps, times=times)

    def __str__(self) -> str:
        return f"LoopVerdict({self.headline})"

    __repr__ = __str__

    def rows(self) -> list[tuple[str, str, str, str, str]]:
        """Every measured value as step, name, value, bound and "ok" or "FAIL"."""
        return rows_of(self.sections)

    def to_dict(self) -> dict[str, Any]:
        """As JSON values."""
        run = self.loop
        return {
            "verdict": self.verdict, "headline": self.headline,
            **dicts_of(self.sections),
            "asked": run.errors, "events": [one.to_dict() for one in run.events],
            "map": {"times": self.times.tolist(), **{who: values.tolist() for who, values in
            self.robustness_maps.items()}},
        }  # fmt: skip


def judge(loop: ClosedLoopRun) -> LoopVerdict:
    """Whether a loop arrived and stayed, or followed its moving goal, by the rules of this module.

    A joint driven beyond its stop fails, by more than a hundredth of its range; five with pushes or errors. Violations
    of ranges and constraints that are not the model's are measured without a bound: a push may make them unavoidable.

    Raises:
        PlannerError: `loop` is no ClosedLoopRun of simulate().
    """
    if not isinstance(loop, ClosedLoopRun):
        raise PlannerError(f"loop is {short_repr(loop)}, expected what planner.simulate returns.")
    goals = () if loop.goal is not None else _goals(loop)
    warned = Measurement("simulator_warnings", float(len(loop.warnings)), "", 0.0, " ".join(loop.warnings))
    sections = {"arrives": _arrives(loop, goals), "stays": _stays(loop, goals)}
    if loop.goal is not None:
        sections = {"follows": _follows(loop)}
    sections |= {"kept": _constraints(loop), "simulator": Section("simulator", (warned,)), "calls": _calls(loop)}
    return LoopVerdict(sections, loop)


def _goals(loop: ClosedLoopRun) -> tuple[GoalCheck, ...]:
    """The goals of the task; five times their tolerance in a perturbed run."""
    goals = goals_of(loop.controller.problem, loop.controller.plan.xs)
    wider = GOAL_TOLERANCES if loop.perturbed else 1.0
    return tuple(replace(one, tolerance=wider * one.tolerance) for one in goals)


def _arrives(loop: ClosedLoopRun, goals: Sequence[GoalCheck]) -> Section:
    """First time at which all final goals are within tolerance, s, and the errors of goals with their own times."""
    rule = _own_rule(loop)
    if rule is not None:
        late = not loop.t[-1] >= loop.controller.problem.duration - 1e-9
        if late:
            return Section("arrives", not_applicable="the loop ends before the task does")
        missed = Measurement("missed", float(not _won(loop, rule)), "", 0.0, f"{rule.words}: 0 where it does")
        return Section("arrives", (missed,))
    if not goals:
        return Section("arrives", not_applicable="no goal was asked for")
    end, T = [one for one in goals if one.times is None], loop.controller.problem.duration
    timed = tuple(one for one in goals if one.times is not None and one.times[-1] <= loop.t[-1] + 1e-9)
    found = misses("replayed", loop.t, loop.xs, timed)
    if end:
        near = _near(loop, end)
        first = float(loop.t[np.argmax(near)]) if near.any() else np.inf
        note = (
            f"when every goal of the end is within its tolerance first; the task ends at {T:.4g} s, and one second more"
        )
        found.append(Measurement("arrived_at", first, "s", T + LATE, note))
    return Section("arrives", tuple(found))


def _near(loop: ClosedLoopRun, goals: Sequence[GoalCheck]) -> np.ndarray:
    """(M+1,) whether every goal is within its tolerance at each simulator step."""
    with np.errstate(invalid="ignore"):
        return np.all([one.error(loop.xs) <= one.tolerance for one in goals], axis=0)


def _stays(loop: ClosedLoopRun, goals: Sequence[GoalCheck]) -> Section:
    """Largest errors of the final goals over the last second, one per unit."""
    end = [one for one in goals if one.times is None and np.isfinite(one.tolerance)]
    if not end:
        return Section("stays", not_applicable="no goal of the end was asked for")
    if _own_rule(loop) is not None:
        return Section("stays", not_applicable="the case's own rule is of the task, not of what comes after it")
    if not getattr(loop.controller, "keeps_goal", True):
        return Section("stays", not_applicable="no control keeps the goal, which is met at the end of the task alone")
    last, found = loop.t >= loop.t[-1] - STAYS, []
    for unit in dict.fromkeys(one.unit for one in end):
        of_unit = [one for one in end if one.unit == unit]
        value, worst = worst_of(of_unit, [float(np.max(one.error(loop.xs[last]))) for one in of_unit])
        note = f"largest over the last {STAYS:g} s, {worst.name}"
        found.append(Measurement(f"stayed_{word_of(unit)}_miss", value, unit, worst.tolerance, note))
    return Section("stays", tuple(found))


def _follows(loop: ClosedLoopRun) -> Section:
    """Distance from a moving goal over the second half of the run.

    Bound: OF_RANGE of the range of the goal's motion, as for perturbed rollouts, but at least five times the minimum
    tolerance of the unit.
    """
    assert loop.goal is not None
    half = np.flatnonzero(loop.t >= 0.5 * loop.t[-1])[:: max(loop.substeps // 4, 1)]
    problem, found = loop.controller.problem, []
    first = loop.goal(0.0)
    if is_of_frames(problem, first):
        m = problem.dynamics.mechanism
        q = loop.xs[half, : m.nq]
        for frame in first:
            there = np.array([np.atleast_2d(loop.goal(float(t))[frame])[0] for t in loop.t[half]])
            finite = np.isfinite(q).all()
            off = np.linalg.norm(frame_pose(m, q, frame)[:, :3, 3] - there, axis=1) if finite else np.array([np.inf])
            bound = _near_moving(float(np.linalg.norm(np.ptp(there, axis=0))), "m")
            note = "largest over the second half; bound: a tenth of the goal's own way"
            found += [
                Measurement(f"{frame}_from_its_goal", float(off.max()), "m", bound, note),
                Measurement(f"{frame}_from_its_goal_on_average", float(off.mean()), "m", None, "over the second half"),
            ]
        return Section("follows", tuple(found))
    H = loop.controller.horizon
    there = np.array([np.atleast_2d(goal_states(problem, loop.goal(float(t)), H))[0] for t in loop.t[half]])
    off = np.abs(loop.plan.space.difference(loop.xs[half], there))
    coordinates = coordinates_of(problem.dynamics)
    for unit in dict.fromkeys(one.unit for one in coordinates if not one.is_rate):
        columns = [i for i, one in enumerate(coordinates) if one.unit == unit]
        way = loop.plan.space.difference(there, there[:1])[:, columns]
        bound = _near_moving(float(np.ptp(way, axis=0).max()), unit)
        note = "largest over the second half; bound: a tenth of the goal's own range"
        found.append(Measurement(f"{word_of(unit)}_from_its_goal", float(off[:, columns].max()), unit, bound, note))
    return Section("follows", tuple(found))


def _near_moving(way: float, unit: str) -> float:
    """Upper limit of the distance from a goal that moves over a range `way`, in its unit."""
    return max(OF_RANGE * way, GOAL_TOLERANCES * MIN_TOLERANCES.get(unit, 0.0))


def _constraints(loop: ClosedLoopRun) -> Section:
    """Stops that joints are driven beyond, and largest violations of ranges and constraints in the task, unbounded."""
    problem = loop.controller.problem
    M, found = problem.N * loop.substeps, _stop(loop, GOAL_TOLERANCES if loop.perturbed else 1.0)
    constraints = problem.trajectory_constraints
    if constraints is None or len(loop.xs) <= M or not np.isfinite(loop.xs).all():
        why = "no stops, no ranges and no constraints, or no whole task"
        return Section("constraints", tuple(found), "" if found else why)
    xs, us = loop.xs[: M + 1], loop.ctrl[:M]
    if problem.ranges is not None:
        beyond = problem.ranges.violation(xs).max(axis=0)
        on_way = problem.ranges.coordinates[: len(beyond) - problem.ranges.at_end]
        for unit in dict.fromkeys(one.unit for one in on_way):
            value, name = max((float(b), one.name) for b, one in zip(beyond, on_way, strict=False) if one.unit == unit)
            found.append(Measurement(f"{word_of(unit)}_{BEYOND_RANGE}", value, unit, None, f"largest, of {name}"))
    if constraints.rows is not None and us.shape[1] == problem.dynamics.nu:
        for one in constraints.rows.violations(xs, us):
            note = f"{one.constraint.name}: largest at any step of the task"
            found.append(Measurement(VIOLATED, one.value, one.constraint.unit, None, note))
    return Section("constraints", tuple(found))


def _stop(loop: ClosedLoopRun, wider: float) -> list[Measurement]:
    """How far a joint is driven beyond a stop that the plan lacks, in the whole run: a machine breaks there."""
    worst = stop_excess(loop, wider)
    if worst is None:
        return []
    one, bound = worst
    beyond = float(one.beyond.max(initial=0.0))
    since = f", from t = {loop.t[np.argmax(one.beyond > bound)]:.4g} s" if beyond > bound else ""
    return [Measurement(BEYOND_STOP, beyond, one.unit, bound, f"farthest of all, of {one.name}{since}")]


_ROUND = (1.0, 2.0, 5.0, 10.0)  # latencies are rounded up to these numbers, so that most runs on a computer are equal


class CallTimes(NamedTuple):
    """Times of planning calls, s."""

    median: float
    percentile_99: float
    maximum: float
    calls: int

    @property
    def latency(self) -> float:
        """The 99th percentile, rounded up to 1, 2 or 5 times a power of ten, s."""
        scale = 10.0 ** math.floor(math.log10(self.percentile_99))
        return next(one * scale for one in _ROUND if one * scale >= self.percentile_99)


def times_of(seconds: np.ndarray) -> CallTimes:
    """The times of calls (M,), M > 0."""
    return CallTimes(float(np.median(seconds)), float(np.percentile(seconds, 99.0)), float(seconds.max()), len(seconds))


def _calls(loop: ClosedLoopRun) -> Section:
    """Wall and processor time of the planning calls on this computer, s, and the latency, which is simulated time."""
    controller, seconds = loop.controller, loop.call_seconds
    if not len(seconds):
        return Section("calls", not_applicable="nothing was planned again")
    latency, times, period = loop.errors["latency"], times_of(seconds), 1.0 / controller.rate
    worked, over = times_of(loop.call_processor_seconds), int(np.sum(seconds > period))
    how = f"simulated time; {'stated' if latency is not None else 'the wall time of each call'}"
    wall = "wall time from a state to a plan, on this computer"
    return Section("calls", (
        Measurement("plans", float(len(seconds)), "", None, "solves on the way"),
        Measurement("failed", float(controller.failures), "", None, "the plan before went on"),
        Measurement("median_call", times.median, "s", None, wall),
        Measurement("call_99_percentile", times.percentile_99, "s", None, "likewise"),
        Measurement("longest_call", times.maximum, "s", None, "likewise"),
        Measurement("processor_time", worked.median, "s", None, "median of a call; without what else ran meanwhile"),
        Measurement("processor_time_99_percentile", worked.percentile_99, "s", None, "likewise"),
        Measurement("period", period, "s", None, f"from plan to plan, at {controller.rate:.4g} Hz"),
        Measurement("overruns", float(over), "", None, "calls whose wall time is above the period"),
        Measurement("overrun_share", over / len(seconds), "", None, "of the calls"),
        Measurement("latency", times.median if latency is None else latency, "s", None, f"{how}; it acted"),
    ))  # fmt: skip


def passes_disturbed(loop: ClosedLoopRun) -> bool:
    """Whether a loop succeeds by the rule of a proof's perturbed rollouts, or its own, and keeps its stops."""
    kept = all(one.passed for one in _stop(loop, GOAL_TOLERANCES))
    return kept and _won(loop, rule_of(loop.controller.plan))


def _own_rule(loop: ClosedLoopRun) -> SuccessRule | None:
    """The built-in problem's own success rule for perturbed rollouts, or None."""
    own = loop.controller.problem.requirements
    return None if own is None or (own.success is None and own.follows is None) else rule_of(loop.controller.plan)


def _won(loop: ClosedLoopRun, rule: SuccessRule) -> bool:
    """Whether a loop succeeds by a rule, which checks the states at the knots of the task or the last state.

    The last state is that of the run if the goal remains after the task, else that of the task.
    """
    plan = loop.controller.plan
    stages = np.arange(min(plan.N, (len(loop.t) - 1) // loop.substeps) + 1)
    way = loop.xs[stages * loop.substeps]
    if not np.isfinite(loop.xs).all():
        return False
    if rule.follows is not None:
        return bool(rule.followed(way[None], plan.xs[stages], stages)[0])
    stays = _own_rule(loop) is None and getattr(loop.controller, "keeps_goal", True)
    return bool(rule.succeeded(loop.xs[-1:] if stays else way[-1:])[0])
