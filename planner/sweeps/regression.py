"""check(): prove stored plans again and compare with the stored numbers, a regression test of the user's plans.

The numbers of plan.npz are in proof.json, those of any other NAME.npz in NAME.proof.json. That file also holds seed,
rollouts and perturbation of the proof, so that the same is measured again, and the digest of the plan's file: numbers
of another plan are not compared.

    regressed   the verdict or mode got worse, a plan is no longer feasible, optimal or robust, less was checked, a
                number fails the bound that it passed, or is judged by a wider one, or got worse by more than the
                tolerance
    moved       any other number changed by more than the tolerance
    not compared  the plan or its stored numbers cannot be read, or lack steps of the proof

The model that a plan was made from is read again, and what changed in it is named (sweeps.stored_model).
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from planner.base.arguments import count, number
from planner.base.data_files import write_json
from planner.base.errors import FileError, PlannerError
from planner.base.executors import checked_executor, ordered_map
from planner.base.files import PLANS, check_exists, read_text
from planner.cases.plan_file import load_plan
from planner.problem.archive import plan_digest
from planner.problem.plan import Plan
from planner.problem.residual import Residual
from planner.proof import Proof, prove
from planner.proof.robustness.perturbation import Perturbation
from planner.sweeps.stored_model import ModelState, StoredModel, stated, stated_tolerances, stored_model

TOLERANCE = 0.05  # relative: another release of MuJoCo or another processor changes less
_ROUNDING = 1e-9  # smaller changes of a number without a bound are rounding
_TWO_DIGITS = 0.1  # relative: what rounding to two digits, as in phrases, may change
_UNIT = r" ?%| (?:rad|deg|degrees|m|cm|mm|s|ms|kg|N|J|W|Hz|1/s)(?!\w)"
_VALUE = re.compile(rf"(?<![\w.])(?:\d+\.\d+(?:e[-+]?\d+)?|\d+e[-+]?\d+|\d+(?={_UNIT}))(?!\.?\d)")
"""A value in a phrase: with a point or a power of ten, or before a unit; other whole numbers may be of names."""
_OF_BOUND = 1e-3  # smaller changes relative to the bound do not count
MAX_ROLLOUTS = 1_000_000
_RANK = {("PASS", "open-loop"): 2, ("PASS", "feedback"): 1}


class NumberChange(NamedTuple):
    """A number that differs from the stored one.

    Attributes:
        step: Step of the proof, e.g. "refined_feedback"; "verdict" and "headline" for the words of its first line.
        name: Of the number.
        stored: Value in the file, or None.
        now: Value in the new proof, or None.
        bound: Largest value that passes, or None.
        regressed: Whether it is worse.
    """

    step: str
    name: str
    stored: float | str | None
    now: float | str | None
    bound: float | None
    regressed: bool

    def __str__(self) -> str:
        before, now = ("nothing" if one is None else one if isinstance(one, str) else f"{one:.5g}" for one in self[2:4])
        return f"{self.step} {self.name} {self.word} from {before} to {now}"

    @property
    def word(self) -> str:
        """The kind of change: "regressed" or "moved"."""
        return "regressed" if self.regressed else "moved"


@dataclass(frozen=True, eq=False)
class PlanComparison:
    """One stored plan proved again.

    Attributes:
        plan: The file.
        changes: The numbers that differ.
        problem: Why nothing could be compared, or "".
        proof: The new proof, or None.
        updated: Whether the new numbers were stored.
        model: The plan's model against the one on disk; None where the plan cannot be read.
        stated: What the plan's file asks for, a phrase each.
        tolerances: The largest of those that it asks for, by unit.
    """

    plan: Path
    changes: tuple[NumberChange, ...] = ()
    problem: str = ""
    proof: Proof | None = None
    updated: bool = False
    model: StoredModel | None = None
    stated: tuple[str, ...] = ()
    tolerances: Mapping[str, float] = field(default_factory=dict)

    @property
    def passed(self) -> bool:
        """Whether nothing regressed and the model is not known to have changed, or the new state was stored."""
        return self.word not in ("not compared", "regressed", "model changed")

    @property
    def word(self) -> str:
        """The outcome in a word or two."""
        if self.problem:
            return "not compared"
        if self.updated:
            return "updated"
        if any(change.regressed for change in self.changes):
            return "regressed"
        if self.model is not None and self.model.state is ModelState.CHANGED:
            return "model changed"
        return "moved" if self.changes else "as stored"

    @property
    def line(self) -> str:
        """The outcome, the model, the proof's first line and what the file asks for; without the numbers."""
        model = "" if self.model is None else str(self.model)
        verdict = "" if self.proof is None else self.proof.headline
        states = f"as the file states: {', '.join(self.stated)}" if self.stated else ""
        return f"{self.plan}: {'. '.join(filter(None, [self.word, self.problem.rstrip('.'), model, verdict, states]))}"

    def __str__(self) -> str:
        return "; ".join([self.line, *map(str, self.changes)])


def check(
    *paths: str | Path, tolerance: float = TOLERANCE, update: bool = False, model: str | Path | None = None,
    callback: Callable[[PlanComparison], object] | None = None, executor: Executor | None = None,
    residuals: Mapping[str, type[Residual]] | None = None,
) -> list[PlanComparison]:  # fmt: skip
    """Prove stored plans again and compare.

    Args:
        paths: Folders, searched with all below them, or plan files.
        tolerance: Relative change that counts.
        update: Store the new numbers where they differ, and accept a changed model.
        model: An MJCF or URDF file to compare the plans' models with; by default the one that each was read from, if it
            is in the plan's folder.
        callback: Called with each PlanComparison.
        executor: Where plans are proved, any concurrent.futures.Executor; by default this process.
        residuals: Classes of your own residuals by name, as of load_plan.

    Returns:
        One PlanComparison per plan, in the order of their names.

    Raises:
        PlannerError: A path does not exist, or holds no plan.
    """
    number("tolerance", tolerance, greater_than=0.0)
    done = []
    work = partial(_checked, tolerance=tolerance, update=update, model=model, residuals=residuals)
    for one in ordered_map(checked_executor(executor), work, _plans(paths)):
        done.append(one)
        if callback is not None:
            callback(done[-1])
    return done


def stored_proof(plan: Path) -> Path:
    """The file with the numbers of a plan file."""
    return plan.with_name("proof.json" if plan.name == "plan.npz" else f"{plan.stem}.proof.json")


def _plans(paths: tuple[str | Path, ...]) -> list[Path]:
    plans: dict[Path, None] = {}
    if not paths:
        raise PlannerError("check was given nothing, expected folders of plans or plan files.")
    for given in map(Path, paths):
        check_exists(given, PLANS)
        if not given.is_dir() and given.suffix != ".npz":
            raise FileError(f"{given} is not a plan, expected {PLANS}.")
        inside = sorted(given.rglob("*.npz")) if given.is_dir() else [given]
        own = [path for path in inside if not any(part.startswith(".") for part in path.relative_to(given).parts)]
        if not own:
            raise FileError(f"{given} holds no plans, expected *.npz files as planner run and solve write them.")
        plans.update(dict.fromkeys(own))
    return list(plans)


def _checked(
    path: Path, tolerance: float, update: bool, model: str | Path | None, residuals: Mapping[str, type[Residual]] | None
) -> PlanComparison:
    file, compared, states = stored_proof(path), None, ()
    try:
        plan = load_plan(path, residuals=residuals)
        digest = plan_digest(path)
        stored = _read(file) if file.exists() else None
        foreign = stored is not None and stored.get("plan_digest", digest) != digest
        if foreign and not update:
            fix = f"expected that of this {path.name}; --update replaces it"
            raise FileError(f"{file.name} is the proof of another plan file, {fix}.")
        accepted = str((stored or {}).get("model_digest", ""))
        compared, states = stored_model(plan, path.parent, model, accepted), stated(plan)
        proof = _proved_as(plan, stored)
    except PlannerError as error:
        return PlanComparison(path, problem=str(error), model=compared, stated=states)
    now = proof.to_dict() | {"plan_digest": digest}
    if compared.state in (ModelState.CHANGED, ModelState.ACCEPTED):
        now["model_digest"] = compared.digest
    done = PlanComparison(path, proof=proof, model=compared, stated=states, tolerances=stated_tolerances(plan))
    lacking = () if stored is None or foreign else _lacking(stored, now)
    if (stored is None or foreign or lacking) and not update:
        wants = f"has no {', '.join(lacking)}" if lacking else "is not there"
        problem = f"its {file.name} {wants}, expected the numbers of its proof; --update writes them."
        return replace(done, problem=problem)
    changes = () if stored is None or foreign else tuple(_changes(stored, now, tolerance))
    new = stored is None or foreign or lacking or changes or compared.state is ModelState.CHANGED
    if update and new:
        write_json(file, now | {key: part for key, part in (stored or {}).items() if key == "refinement"})
    return replace(done, changes=changes, updated=update and bool(new))


def _lacking(stored: dict[str, Any], now: dict[str, Any]) -> tuple[str, ...]:
    """Words of the first line, and steps of which a judged number is missing, that a stored proof does not have."""
    found = [word for word in ("feasible", "optimal", "not_checked") if word not in stored]
    for step, section in now.items():
        own = section.get("figures", {}) if isinstance(section, dict) else {}
        judged = {name for name, one in own.items() if one.get("bound") is not None}
        before = stored.get(step)
        if judged - set(_numbers(before.get("figures")) if isinstance(before, dict) else ()):
            found.append(step)
    return tuple(one.replace("_", " ") for one in found)


def _read(file: Path) -> dict[str, Any]:
    try:
        stored = json.loads(read_text(file, "the proof"))
    except (ValueError, RecursionError):
        stored = None
    if not isinstance(stored, dict) or not isinstance(stored.get("verdict"), str):
        raise FileError(f"{file} is not a proof: expected the JSON of planner prove or planner run.")
    return stored


def _proved_as(plan: Plan, stored: dict[str, Any] | None) -> Proof:
    """Prove a plan with the seed, rollouts and perturbation of its stored proof."""
    asked = (stored or {}).get("asked", {})
    try:
        if asked.get("another_model"):
            raise FileError("its numbers are of another model (prove --model), expected those of its own model.")
        perturbation = Perturbation(**asked["perturbation"]) if asked.get("perturbation") else None
        options = {name: asked[name] for name in ("seed", "rollouts", "hold_seconds") if name in asked}
        options |= {"optimal": False} if asked.get("optimal") is False else {}
        count("the rollouts of its proof", options.get("rollouts", 0), minimum=0, maximum=MAX_ROLLOUTS)
    except (TypeError, AttributeError):
        raise FileError("its proof has no usable 'asked', expected what planner prove wrote.") from None
    return prove(plan, perturbation=perturbation, **options)


def _changes(stored: dict[str, Any], now: dict[str, Any], tolerance: float) -> Iterator[NumberChange]:
    verdicts = [f"{one['verdict']} ({one.get('mode')})" for one in (stored, now)]
    ranks = [_RANK.get((one["verdict"], str(one.get("mode"))), 0) for one in (stored, now)]
    if verdicts[0] != verdicts[1]:
        yield NumberChange("verdict", "", verdicts[0], verdicts[1], None, ranks[1] < ranks[0])
    yield from _words(stored, now, tolerance)
    for step, section in now.items():
        before = stored.get(step)
        if not (isinstance(section, dict) and "applicable" in section and isinstance(before, dict)):
            continue
        new, old = section.get("figures", {}), _numbers(before.get("figures"))
        for name in {**old, **new}:
            yield from _change(step, name, old.get(name), new.get(name), tolerance)


def _words(stored: dict[str, Any], now: dict[str, Any], tolerance: float) -> Iterator[NumberChange]:
    """Changes of feasible, optimal, robustness, the file's own step and not checked."""
    for word in ("feasible", "optimal"):
        if isinstance(was := stored.get(word), bool) and was is not now[word]:
            yield NumberChange("headline", word, _yes(was), _yes(now[word]), None, was)
    was, robustness = stored.get("robustness"), now["robustness"]
    if isinstance(was, str) and was != robustness:
        yield NumberChange("headline", "robustness", was, robustness, None, was == "robust")
    # "" of a FAIL is no promise: where the file fails, nothing is said of its step.
    if stored["verdict"] == "PASS" and stored.get("own_step") == "" and now.get("own_step"):
        yield NumberChange("headline", "own step", None, now["own_step"], None, True)
    if not isinstance(unchecked := stored.get("not_checked"), list):
        return
    phrases = list(map(str, unchecked)), list(now["not_checked"])
    gone, new = ([one for one in own if not any(_same_phrase(one, other, tolerance) for other in others)]
                 for own, others in (phrases, phrases[::-1]))  # fmt: skip
    if gone or new:
        before, after = ("; ".join(one) or None for one in phrases)
        yield NumberChange("headline", "not checked", before, after, None, bool(new))


def _same_phrase(one: str, other: str, tolerance: float) -> bool:
    """Whether two phrases have the same words, and values that are equal but for a tolerance and rounding."""
    (words, numbers), (others, values) = ((_VALUE.split(text), _VALUE.findall(text)) for text in (one, other))
    pairs = zip(map(float, numbers), map(float, values), strict=False)
    return words == others and all(math.isclose(a, b, rel_tol=max(tolerance, _TWO_DIGITS)) for a, b in pairs)


def _yes(value: bool) -> str:
    return "yes" if value else "no"


def _numbers(figures: Any) -> dict[str, dict[str, Any]]:
    """The measured values of a stored section; malformed entries are ignored."""
    rows = figures.items() if isinstance(figures, dict) else ()
    kinds = (int, float, type(None))
    return {name: row for name, row in rows if isinstance(row, dict) and isinstance(row.get("value"), kinds)}


def _change(step: str, name: str, old: Any, new: Any, tolerance: float) -> Iterator[NumberChange]:
    """The change of one number, if it counts. A value that is not finite is stored as null."""
    if not isinstance(old, dict) or not isinstance(new, dict):
        before, now = (one.get("value") if isinstance(one, dict) else None for one in (old, new))
        yield NumberChange(step, name, before, now, None, regressed=not isinstance(new, dict))
        return
    bound, before = new.get("bound"), old.get("bound")
    if isinstance(before, (int, float)) and (bound is None or bound > before * (1.0 + tolerance)):
        yield NumberChange(step, f"bound of {name}", before, bound, None, regressed=True)
    a, b = (math.inf if one.get("value") is None else float(one["value"]) for one in (old, new))
    if a == b:
        return
    least = _ROUNDING if bound is None else _OF_BOUND * bound
    failed = bool(old.get("passed")) and not new.get("passed")
    if not failed and abs(b - a) <= max(tolerance * abs(a), least):
        return
    worse = b < a if any(word in name for word in ("success", "margin")) else b > a and bound is not None
    yield NumberChange(step, name, old.get("value"), new.get("value"), bound, failed or worse)
