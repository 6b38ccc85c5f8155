"""Plan again with a larger clearance of geoms that collide in MuJoCo, or a smaller one of conservative fitted shapes.

A mesh or a cylinder is planned with a fitted enclosing shape. Where such fits overlap at the start and the geoms do
not, the overlap is allowed (planner.model.mjcf.collision_pairs), and a plan may violate the clearance. MuJoCo's
collision check finds it; the pair's clearance grows by the depth and half of the clearance. Where no plan separates two
fits whose geoms are separate by MuJoCo's distances, the clearance of the fits shrinks by the difference.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from planner.model.mjcf.initial_overlaps import MAX_MUJOCO_DISTANCE, distances_in
from planner.problem.constraints.clearance import PairClearance, model_index_of, pair_clearance_of
from planner.problem.goals import goals_of
from planner.problem.plan import Plan, Status
from planner.problem.problem import Problem
from planner.proof import Proof
from planner.proof import prove as full_proof
from planner.proof.original_model import your_file
from planner.solvers.gains import warm_start
from planner.solvers.slq import solve
from planner.solvers.work import DEFAULT_WORK, WorkBudget, budget_of

MAX_REFINEMENTS = 3  # times
CLEARANCE_SHARE = 0.5  # of the required clearance, added to the depth


class ClearanceRefinement(NamedTuple):
    """The last plan that was proved, and the changes of clearance of each refinement."""

    plan: Plan
    proof: Proof
    changes: tuple[dict[str, float], ...]  # m by the names of a pair, one dict per refinement

    @property
    def notes(self) -> tuple[str, ...]:
        """A sentence per refinement."""
        return tuple("; ".join(_sentence(names, m) for names, m in one.items()) for one in self.changes)


def refine_clearance(
    plan: Plan, proof: Proof, *, limit: int = MAX_REFINEMENTS, budget: WorkBudget | float | None = None,
    prove: Callable[[Plan], Proof] | None = None, max_iterations: int = 1000, **options: Any,
) -> ClearanceRefinement:  # fmt: skip
    """Solve and prove again with changed clearances of pairs that collide, or whose fits are too conservative.

    Args:
        plan: A plan whose problem has collision avoidance (planner.constraints.Avoid).
        proof: Of the plan.
        limit: Maximum number of refinements.
        budget: The work of the solves and proofs; by default DEFAULT_WORK.
        prove: Judges the plans; by default without perturbed rollouts.
        max_iterations: Of each solve.
        options: Of solve().
    """
    prove, changes = prove or partial(full_proof, rollouts=0), list[dict[str, float]]()
    work = budget_of(budget) or WorkBudget(DEFAULT_WORK)
    while len(changes) < limit and not work.exhausted:
        apart = None if plan.problem is None or proof.passed else pair_clearance_of(plan.problem.constraints)
        if plan.problem is None or apart is None:
            break
        more = _collided(plan, plan.problem, proof, apart) or _far(plan, plan.problem, apart)
        if not more:
            break
        problem = with_clearance(plan.problem, more)
        allowed = work.before_proof(problem)
        better = solve(
            replace(problem, us=warm_start(plan, problem)), max_iterations=max_iterations, budget=allowed, **options
        )  # fmt: skip
        if better.status in (Status.NOT_FINITE, Status.WORK_LIMIT, Status.TIME_LIMIT):
            break
        work.charge_proof(problem)
        changes.append(more)
        plan, proof = better, prove(better)
        if plan.status is Status.INTERRUPTED:
            break
    return ClearanceRefinement(plan, proof, tuple(changes))


def _collided(plan: Plan, problem: Problem, proof: Proof, apart: PairClearance) -> dict[str, float]:
    """Increase of clearance, m, of pairs that collide in the user's file, by their names."""
    if not any(one.name == "unknown_contacts" for one in proof.your_file.failures):
        return {}
    runs = [run for _, run in your_file(plan, problem, goals_of(problem)).values() if run is not None]
    extremes = sorted((one for run in runs for one in run.contact_extremes), key=lambda one: one.deepest)
    depths = {frozenset(touch.geoms): touch.deepest for touch in extremes}  # the deepest of a pair
    found = {}
    for pair in apart.pairs:
        depth = depths.get(frozenset((pair.a.geom, pair.b.geom)), 0.0)
        if depth > 0.0:
            found[pair.names] = max(found.get(pair.names, 0.0), depth + CLEARANCE_SHARE * pair.required_clearance)
    return found


def _far(plan: Plan, problem: Problem, apart: PairClearance) -> dict[str, float]:
    """Change of clearance, m, negative, of fits whose geoms are further apart than required, by the pairs' names."""
    allowed = next(one.allowed() for one in problem.constraints if one.of is apart)
    measure, found = apart.residual_function(problem.dynamics, problem.N), {}
    model = model_index_of(measure.mechanism).model
    short = measure.clearance_violation(problem.dynamics, plan.xs, plan.us)
    for k in np.flatnonzero(short.max(axis=0) > allowed):
        pair, n = apart.pairs[k], np.flatnonzero(short[:, k] > allowed)
        geoms = (pair.a.geom, pair.b.geom)
        xs = plan.xs[np.union1d(n, n + 1)]
        real = np.array([distances_in(model, x[: model.nq], [geoms], MAX_MUJOCO_DISTANCE)[geoms] for x in xs])
        beyond = float(np.min(real - measure.shown(xs, plan.us[:0], n)[:, k]))
        nearer = measure.lower[k] - (pair.required_clearance - beyond)
        if nearer > allowed and real.min() > pair.required_clearance:
            found[pair.names] = -nearer
    return found


def _sentence(names: str, more: float) -> str:
    if more > 0.0:
        return f"{names} touch and are kept {100.0 * more:.2g} cm further apart"
    return f"the fits of {names} may come {-100.0 * more:.2g} cm nearer, since the shapes are that much further apart"


def with_clearance(problem: Problem, more: dict[str, float]) -> Problem:
    """The problem with larger pair clearances, by `more` m by name; that of a file keeps its recipe."""
    if problem.recipe is not None and "avoid" in problem.recipe.parameters:
        table = problem.recipe.parameters["avoid"]
        had = table.get("extra_clearance") or {}
        both = had | {name: had.get(name, 0.0) + m for name, m in more.items()}
        return problem.recipe.rebuilt(avoid=table | {"extra_clearance": both})
    changed = []
    for one in problem.constraints:
        if isinstance(one.of, PairClearance):
            pairs = one.of.pairs
            added = one.of.more + np.array([more.get(pair.names, 0.0) for pair in pairs])
            apart = replace(one.of, more=np.minimum(added, [pair.spare_clearance for pair in pairs]))
            one = replace(one, of=apart, lower=apart.lower)
        changed.append(one)
    return replace(problem, constraints=changed)
