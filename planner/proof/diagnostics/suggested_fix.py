"""SuggestedFix: a key of the problem, its new value, and the finding behind it, with the text of every code.

SENTENCES is output only; tests compare codes and values. {name} is a value of the finding, with its unit.
"""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass
from typing import Any

from planner.base.arguments import toml_value
from planner.base.data_files import finite
from planner.base.measured import Diagnostic, Quantity
from planner.problem.plan import Plan
from planner.problem.problem import Problem
from planner.problem.problem_parts import PROBLEM_FILE

SENTENCES = {
    # The goal and the ground
    "goal_unbalanced": "No plan stays at the goal, which is put on the ground, where it does not balance: {cause}",
    "jump_not_found": "The solve found no higher jump than this: at {time} {frame} gets to {reached} of {asked}, where "
    "the legs reach {standing} from the ground. Write {advice}, or a lower goal.",
    "falls": "The machine loses its balance: an error grows as exp({rate:.3g} t), t in s, and with the plan's gains it "
    "becomes {share:.3g} times what passes. Begin with a goal nearer to the start, or write a "
    "`start` and a `goal` with the centre of mass over the middle of the feet.",
    "ground_differs": "The plan's gains hold the machine in the plan's own model: an error that grows as "
    "exp({rate:.3g} t), t in s, becomes {share:.3g} times what passes. MuJoCo's contacts act otherwise there: they "
    "slip less and give more (docs/contact.md). Begin with a shorter or slower motion.",
    "contacts_differ": "MuJoCo's contacts put the replay with the plan's gains {off:.3g} times what passes off its "
    "path, the plan's step {by_step:.2g}: a finer one does not help. Begin with a shorter or slower motion, or one "
    "that touches down more softly (docs/contact.md).",
    "gait_needed": "its four feet have to go {distance:.2g}, by a dozen steps that no first guess knows: a gait says "
    "which feet swing when (docs/contact.md)",
    "cycle_unresolved": "stages of {dt:.4g} do not resolve the cycle",
    "cycle_not_found": "No cycle of {travel} in {duration} was found that ends as it begins: write a shorter `travel`, "
    "another `duration`, or a gait whose feet stand longer (`duty`).",
    "cycle_not_followed": "MuJoCo does not follow cycles of {travel} in {duration}: write a shorter `travel`, another "
    "`duration`, or a gait whose feet stand longer (`duty`); with `cycles = 1` one alone is judged.",
    # Shapes
    "ground_removed": '{pair} collide, and contacts = "off" removes the ground',
    "lands": "{pair} touch, and the plan knows nothing of it; with it the machine stands on the ground as in your file",
    "start_collides": "Another `start` is needed, or a model that excludes the pair: at the start {pair} overlap by "
    "{depth:.2g}.",
    "overlap_deepens": "{pair} of the file overlap or lie flush at the start, and the motion presses them together: if "
    "the real ones do not touch, write exclude = {bodies}; else another `start` or `goal` is needed.",
    "overlap_deepens_unnamed": "{pair} of the file overlap or lie flush at the start, and the motion presses them "
    "together: move them apart in the file; or, if the real ones do not touch, give the bodies of both a name there "
    "and write these names as exclude = [[\"one body\", \"the other\"]].",
    "goal_collides": "in the goal itself {pair} overlap by {depth:.2g}; with it another pose of the goal is sought",
    "goal_collides_anyhow": "Another `goal` is needed: in the goal itself {pair} overlap by {depth:.2g}.",
    "no_way_around": "No way without collisions from the start to the pose of the goal was found, with {samples} "
    "random poses for joints within their ranges: another `goal` or `start`, a smaller clearance or less in the way.",
    "path_collides": "{pair} collide on the way; with it a collision-free path is planned",
    "path_collides_anyhow": "{pair} collide on the way: plan to a `goal` in between, and on "
    "from there.",
    # Force and time
    "too_little_force": "in {duration} {actuator} needs {needed} of {limit}",
    "too_little_speed": "in {duration} the {joint} needs {needed} of {limit}",
    "thrust_below_weight": "The thrusters push with at most {thrust} of the {weight} that the machine weighs: it "
    "falls. Stronger ones or less mass are needed.",
    "force_never_enough": "No duration lets the actuators hold the path to the goal: even in {duration} {actuator} "
    "needs {needed} of {limit}.",
    "pose_never_held": "No duration lets the machine stand in the pose at the end: at rest {actuator} needs {needed} "
    "of {limit}. Another `goal` or other feet that stand are needed.",
    "servo_ends": "Even in {duration} {actuator} has {limit} where {needed} is needed: its control range ends before "
    "the pose of the goal. A servo's ctrlrange is in the unit of its joint, times its gear (which classes inherit).",
    "speed_never_enough": "No duration lets the joints follow the path to the goal: even in {duration} the {joint} "
    "needs {needed} of {limit}.",
    "infeasible": "in {duration} the motion is followed from the free one into limits {factor:.4g} times as wide, and "
    "not further",
    "at_bounds": "in {duration} {bounds}",
    # Ranges
    "range_unknown": "the plan does not know that {joint} goes {excess} beyond {limit:.4g} at t = {time}",
    "range_exceeded": "{joint} goes {excess} beyond {limit:.4g} at t = {time}, between the knots or in MuJoCo",
    "range_exceeded_in_file": "a joint goes {excess} beyond its range in your file, and not in the plan's model",
    "clamp_unknown": "{actuator} {what}: {most:.3g} of {lower:.3g} to {upper:.3g}",
    "clamped_in_file": "{what} The plan's own model lets it: plan again with the model that is replayed, or write "
    "narrower `limits = {{ control = ... }}`, or more `duration`.",
    "limit_beyond_model": "{actuator} {what}: {most:.3g} of {lower:.3g} to {upper:.3g}, at which MuJoCo clamps it "
    "whatever `limits` allow: write a wider range in the model, or no wider limit than its own.",
    "fixed_joints": "equalities and ranges of the file together leave {joint}{others} one value, at which they lean on "
    "their stops, which only MuJoCo has: write wider ranges in the file, or another equality.",
    "equality_gives": "The equalities of your file give: they are springs of {rate:.3g} rad/s there, and exact in the "
    'plan. Write solref="{time:.2g} 1" at them, or move more slowly.',
    "equality_gives_too_much": "The equalities of your file give: they are springs of {rate:.3g} rad/s there, and "
    'exact in the plan. At a step of {step:.3g} MuJoCo takes none stiffer than solref="{time:.2g} 1", which still '
    "give more than passes: move more slowly, or write a shorter timestep in the file.",
    # Goals and weights
    "goal_missed": "the plan ends {miss} from the goal of {goal}, and {tolerance} pass",
    "task_missed": "the plan is {miss} from {goal}, and {tolerance} pass",
    "stance_ignored": "{stance} is kept in {share:.3g} % of its time, and {bound:g} % pass, and the motion that the "
    "plan is led along does not keep it either: write a [[goal]] with `through = true` and `time = {time:.3g}` that "
    "has the machine as it is to be then, or give it more time.",
    "stance_outweighed": "{stance} is kept in {share:.3g} % of its time, and {bound:g} % pass: something costs less "
    "than to follow the motion that keeps it; or write a [[goal]] with `through = true` and `time = {time:.3g}`",
    "untouched": "The plan never touches what is to be moved: begin with the machine at it, give the motion more time, "
    "or write a [[goal]] of the hand there at a time before.",
    "not_moved": "The solve found no motion that brings the machine nearer to its goal: write {advice}.",
    "ignored_matters": "the plan leaves out {ignored}, and with it your file has {missed}",
    # The solve
    "rate_too_fast": "the fastest rate of the machine at its start is {rate:.3g} per s, {per_stage:.3g} times in a "
    "stage",
    "guess_runs_away": "the first guess rolls out to infinite states",
    "more_iterations": "after {iterations} iterations the next is still expected to gain {left:.1e} of the cost",
    "stages_cost_too_much": "work of {work:.3g} was enough for {iterations} iterations with {stages} stages of "
    "{substeps} substeps, and far more are needed; or move fewer joints, by less or in less time",
    "search_cut": "the plan is the best of {tried} durations; the search for a better one was cut",
    "stalled": "the cost stays at {cost:.5g} and the norm of its gradient at {gradient:.2g}; other first guesses end "
    "elsewhere",
    "not_a_minimum": "The solve ended, but one more step is expected to take {left:.3g} % off the cost: go on from "
    "this plan by solve(problem, warm_start=plan), or ask `planner prove --feasible`, for which it need not be a "
    "minimum.",
    "saddle": "The solve ended where the gradient vanishes, and in one direction the cost still falls, by a curvature "
    "of {curvature:.3g}: ask `planner prove --feasible`, for which the plan need not be a minimum.",
    "other_model": "The model that is replayed has other numbers than the plan's: plan again with it.",
    "unknown": "No cause of {failed} is known: give the motion more than {duration}, or a goal nearer to its start; "
    "docs/questions.md has what others met.",
    "unknown_of_time": "No cause of {failed} is known: write `durations` that are all longer than {duration}, "
    "or a goal nearer to its start; docs/questions.md has what others met.",
    "unknown_of_recording": "No cause of {failed} is known: is the recording, {duration} long, of this model, from "
    "this start to this goal?",
    # The stage
    "rows_too_sparse": "Record, or export by `--rate`, at {rate} or more: at steps of {dt:.4g} between its rows plan "
    "and MuJoCo differ by {share} what passes, an error that falls with the power {order:.2g} of the step.",
    "first_order": "with {integrator} plan and MuJoCo differ by {share} what passes, an error of first order",
    "stage_too_long": "at {dt:.4g} plan and MuJoCo differ by {share} what passes, an error that falls with the power "
    "{order:.2g} of the stage",
    "clamped_in_stage": "the plan keeps the limits of its actuators at the ends of its stages of {dt:.4g}, and not "
    "within them",
}  # fmt: skip

TRIED = {
    "": "", "passes": " (tried: with it the plan passes)", "fails": " (tried: not enough)",
    "undecided": " (tried: not decided within the work; write it, or more `work`)",
}  # fmt: skip


ITERATIONS = "max_iterations"
TABLES = ("weights", "limits")
FLAGS = (ITERATIONS, "starts", "work")  # of solve() and the command line, for all problems


@dataclass(frozen=True)
class SuggestedFix(Diagnostic):
    """A change of the problem, and its reason.

    Attributes:
        key: As in a problem.toml, with dots for its tables: "limits.margin"; or a whole table of TABLES, with some keys
            to set. "max_iterations" is a flag of the command line and an argument of solve().
        value: The new value, a JSON value; None if no value helps.
        written: The change in the notation of the problem's origin: its file, a command line or Python.
        tried: "passes", "fails" or "undecided" once a repair has tried it, else "".
    """

    key: str = ""
    value: Any = None
    written: str = ""
    tried: str = ""

    @property
    def sentence(self) -> str:
        """The change as text, and its measured reason."""
        text = self.text(SENTENCES)
        return (f"{self.written}: {text}" if self.written else text) + TRIED[self.tried]

    def __str__(self) -> str:
        return self.sentence

    def to_dict(self) -> dict[str, Any]:
        """As JSON values."""
        values = {
            name: {"value": finite(one.value), "unit": one.unit} if isinstance(one, Quantity) else one
            for name, one in self.values.items()
        }
        return {"key": self.key, "value": self.value, "sentence": self.sentence, "code": self.code, "values": values}

    def applied(self, table: dict[str, Any]) -> dict[str, Any]:
        """A problem.toml's table with the fix written into it; the table itself where the fix is no key of it."""
        table = copy.deepcopy(table)
        if self.value is None or self.key == ITERATIONS:
            return table
        inside, (*tables, last) = table, self.key.split(".")
        for name in tables:
            part = inside.get(name)
            inside[name] = part = part if isinstance(part, dict) else {}
            inside = part
        value = copy.deepcopy(self.value)
        inside[last] = {**inside.get(last, {}), **value} if self.key in TABLES else value
        return table


def fix(problem: Problem, key: str, value: Any, code: str, **values: Any) -> SuggestedFix:
    """A value to write under a key of the problem, for the finding `code` with its values."""
    value = {name: _short(part) for name, part in value.items()} if isinstance(value, dict) else _short(value)
    parts = {f"{key}.{name}": part for name, part in value.items()} if key in TABLES else {key: value}
    written = ", ".join(f"`{_written(problem, name, part)}`" for name, part in parts.items())
    return SuggestedFix(code, values, key, value, written)


def no_fix(key: str, code: str, **values: Any) -> SuggestedFix:
    """A finding that no value of the key resolves."""
    return SuggestedFix(code, values, key)


def has_searched_duration(plan: Plan) -> bool:
    """Whether a search over durations, which solves at many, made the plan."""
    return "durations" in plan.options


def of_file(problem: Problem) -> bool:
    """Whether the problem comes from a problem.toml."""
    return problem.case == PROBLEM_FILE


def _short(value: Any) -> Any:
    """A number that is computed, without the digits of rounding."""
    return float(f"{value:.6g}") if isinstance(value, float) else value


def _written(problem: Problem, key: str, value: Any) -> str:
    table, _, name = key.rpartition(".")
    flag = f"--{name.replace('_', '-')} {value}"
    if key in FLAGS and not (of_file(problem) and key != ITERATIONS):
        return f"solve(..., {key}={value})" if problem.case is None else flag
    if key == "durations" and "objective" not in problem.parameters:  # a file has no durations without one
        of_case = f"--durations {','.join(f'{one:g}' for one in value)}"
        return f"solve_for(..., durations={value})" if problem.case is None else of_case
    if of_file(problem):
        return f"{key} = {toml_value(value)}"
    if problem.case is not None and key == "dt" and "horizon" in problem.parameters:
        return f"--horizon {round(problem.duration / value)}"
    if problem.case is not None and name in problem.parameters:
        return flag
    dynamics = type(problem.dynamics).__name__
    if key == "duration":
        return f"{dynamics}(..., dt={value / problem.N:.6g})"
    if key in ("dt", "integrator"):
        return f"{dynamics}(..., {key}={value!r})"
    makers = {"limits": "Limits", "weights": "TrackingCost.joints"}
    return f"{makers[table]}({name}={value!r})" if table in makers else f"{key} = {value!r}"


def rounded_up(value: float, digits: int = 1) -> float:
    """The next larger number with so many digits."""
    if not 0.0 < value < math.inf:
        return value
    step = 10.0 ** (math.floor(math.log10(value)) + 1 - digits)
    return float(f"{math.ceil(value / step - 1e-9) * step:.{digits}g}")
