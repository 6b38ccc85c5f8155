"""Diagnose geoms that collide: in the user's file alone, at the goal, on the ground, along the path, on every way."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from planner.base.errors import PlannerError
from planner.base.gl import load_mujoco
from planner.base.measured import Quantity
from planner.model.capabilities import capabilities_of, flies, floating_dofs, thrusters
from planner.model.mechanism import Mechanism
from planner.model.mjcf.contact_mode import file_pairs
from planner.model.mjcf.initial_overlaps import TOUCH_ROUNDING, can_separate
from planner.model.mjcf.model_index import ModelIndex, named
from planner.model.mjcf.unmodelled_features import names_of
from planner.problem.collision_free_path import MORE_SAMPLES, CollisionChecker, has_path_search
from planner.problem.constraints.clearance import pair_clearance_of
from planner.problem.costs.tracking import tracking_of
from planner.problem.plan import Plan
from planner.problem.problem import Problem
from planner.proof.diagnostics.suggested_fix import SuggestedFix, fix, no_fix, of_file
from planner.proof.original_model import as_given, bodies_at_rest, goes_deeper
from planner.proof.replays.compiled_twin import unmodelled_of
from planner.proof.verdict import Proof

CLEARANCE = 5e-3  # m, smallest clearance of a pair that counts as separable
LANDED = 0.01  # m, the clearance that `avoid` asks for: what is to end nearer to the ground is to stand on it
_POSES = 40  # number of a plan's poses, at most


def avoid_contact(plan: Plan, problem: Problem, proof: Proof | None) -> list[SuggestedFix]:
    """A contact law for the ground, or a collision-free path."""
    if proof is None or not any(one.name == "unknown_contacts" for one in proof.your_file.failures):
        return []
    mechanism, twin, cost = capabilities_of(problem.dynamics).mechanism, plan.twin, tracking_of(problem.cost)
    if twin is None or cost is None or mechanism is None:
        return []
    try:
        shapes = _Shapes(problem, as_given(problem, twin).model)
    except PlannerError:  # a file with prescribed joints
        return []
    start, goal = (twin.sim_of(x)[: mechanism.nq] for x in (problem.x0, cost.x_ref[-1]))
    began = shapes.depths(start)
    shapes.at_start = set(began)
    knots = _knots(plan, mechanism)
    floor = [pair for q in (start, *knots) for pair in shapes.touching(q) if shapes.is_ground(pair)]
    thrusting = bool(np.any(thrusters(mechanism))) or flies(mechanism)
    flying, off = thrusting or bool(np.any(floating_dofs(mechanism))), problem.parameters.get("contacts") == "off"
    if floor and of_file(problem) and off and shapes.unactuated and not thrusting:
        return [fix(problem, "contacts", "ground", "ground_removed", pair=shapes.names(floor[0]))]
    index = ModelIndex(shapes.model)
    may_avoid = of_file(problem) and "avoid" not in problem.parameters
    if inside := {pair: depth for pair, depth in began.items() if can_separate(index, pair, start, CLEARANCE)}:
        return [no_fix("start", "start_collides", **shapes.deepest(inside))]
    if flying and (landing := shapes.landing(index, start, goal, knots)) and _may_land(problem):
        return [fix(problem, "contacts", "file", "lands", pair=shapes.names(landing))]
    if at_goal := shapes.depths(goal):
        worst = shapes.deepest(at_goal)
        if may_avoid and problem.goal_specs is not None:
            return [fix(problem, "avoid", {}, "goal_collides", **worst)]
        return [no_fix("goal", "goal_collides_anyhow", **worst)]
    first = next((pair for q in knots for pair in shapes.depths(q)), None)
    if first is None:  # pairs that lie flush or overlap at the start, and are pressed, else those that hardly touch
        if (flush := shapes.to_exclude(start, knots, flying)) or not may_avoid:
            return flush
        met = (pair for q in knots for pair in shapes.touching(q, 0.0) if pair not in shapes.at_start)
        first = next((pair for pair in met if not shapes.is_flush(start, pair)), None)
        if first is None:
            return []
    pair = shapes.names(first)
    if may_avoid:
        return [fix(problem, "avoid", {}, "path_collides", pair=pair)]
    return [no_fix("goal", "path_collides_anyhow", pair=pair)]


def no_way_around(plan: Plan, problem: Problem, proof: Proof | None) -> list[SuggestedFix]:
    """That no path to the pose of the goal keeps the clearance, as far as random poses tell."""
    mechanism, cost = capabilities_of(problem.dynamics).mechanism, tracking_of(problem.cost)
    apart = pair_clearance_of(problem.constraints)
    if plan.converged or mechanism is None or cost is None or apart is None or not has_path_search(mechanism):
        return []
    nq, weights = mechanism.nq, np.diagonal(cost.Q[-1])[: mechanism.nv]
    if mechanism.has_closed_chains or not (of_file(problem) or np.all(weights > 0.0)):  # no whole pose is meant
        return []
    checker = CollisionChecker(apart, mechanism).without_extra
    goal = cost.x_ref[-1, :nq]
    if checker.seek_path(problem.x0[:nq], goal) is not None:
        return []
    return [no_fix("goal", "no_way_around", samples=MORE_SAMPLES)]


def _may_land(problem: Problem) -> bool:
    """Whether the file leaves out contacts that it may have the plan know."""
    return of_file(problem) and problem.parameters.get("contacts") in ("auto", "avoid", "off")


def _knots(plan: Plan, mechanism: Mechanism) -> list[np.ndarray]:
    """Some of a plan's poses, the last one among them."""
    assert plan.twin is not None  # checked by avoid_contact()
    knots = plan.twin.sim_of(plan.xs)[:: -max(1, plan.N // _POSES), : mechanism.nq]
    return [q for q in knots[::-1] if np.isfinite(q).all()]


class _Shapes:
    """The geoms of the user's file at a pose, without pairs whose contact the plan models."""

    def __init__(self, problem: Problem, model: Any) -> None:
        self._mujoco, self.model = load_mujoco(), model
        self._data = self._mujoco.MjData(model)
        self._known = unmodelled_of(problem).known
        self._at_rest = bodies_at_rest(problem, model)[model.geom_bodyid]
        self._scale = min(1.0, float(model.stat.extent))
        self.at_start: set[tuple[int, int]] = set()
        self._free = ~self._moment().any(axis=0)  # (nv,) degrees of freedom without an actuator
        self.unactuated = bool(self._free.any())

    def _moment(self) -> np.ndarray:
        mujoco, model, data = self._mujoco, self.model, self._data
        mujoco.mj_forward(model, data)
        moment = np.zeros((model.nu, model.nv))
        mujoco.mju_sparse2dense(moment, data.actuator_moment, data.moment_rownnz, data.moment_rowadr,
                                data.moment_colind)  # fmt: skip
        return moment

    def names(self, pair: tuple[int, int]) -> str:
        """Both names, for a sentence."""
        return " and ".join(named(self.model, "geom", geom) for geom in pair)

    def deepest(self, depths: dict[tuple[int, int], float]) -> dict[str, Any]:
        """The pair that overlaps most and by how much, as values of a finding."""
        pair = max(depths, key=lambda pair: depths[pair])
        return {"pair": self.names(pair), "depth": Quantity(depths[pair], "m")}

    def landing(
        self, index: ModelIndex, start: np.ndarray, goal: np.ndarray, poses: list[np.ndarray]
    ) -> tuple[int, int] | None:
        """A pair with the ground in contact at some poses, that stands on it at the start or is to at the goal."""
        may_stand = {tuple(sorted(pair.geoms)) for pair in file_pairs(index)}
        for pair in (pair for q in (*poses, goal) for pair in self.touching(q, 0.0)):
            if pair in may_stand and (self._gap(start, pair) <= 0.0 or self._gap(goal, pair) < LANDED):
                return pair
        return None

    def is_flush(self, q: np.ndarray, pair: tuple[int, int]) -> bool:
        """Whether two geoms touch at a pose, to rounding."""
        return self._gap(q, pair) <= 0.0

    def _gap(self, q: np.ndarray, pair: tuple[int, int]) -> float:
        """Distance of two geoms at a pose, m, LANDED at most; 0 of those that lie flush to rounding."""
        self._data.qpos[:] = q
        self._mujoco.mj_fwdPosition(self.model, self._data)
        gap = self._mujoco.mj_geomDistance(self.model, self._data, *pair, LANDED, None)
        return 0.0 if abs(gap) <= TOUCH_ROUNDING * self._scale else float(gap)

    def to_exclude(self, start: np.ndarray, poses: list[np.ndarray], flying: bool) -> list[SuggestedFix]:
        """The pairs that go deeper than at the start, else those that lie flush, to be excluded.

        Not those that are apart at the start, nor the ground of a machine that may stand on it.
        """
        began, deeper = self.touching(start, 0.0), dict[tuple[int, int], float]()
        for q in poses:
            for pair, depth in self.touching(q, 0.0).items():
                deeper[pair] = max(deeper.get(pair, -np.inf), depth - began.get(pair, 0.0))
        pairs = [pair for pair in deeper if pair in self.at_start or self._gap(start, pair) <= 0.0]
        pairs = [pair for pair in pairs if not (self.is_ground(pair) and (flying or self._stands(pair)))]
        worse = [pair for pair in pairs if goes_deeper(began.get(pair, 0.0), deeper[pair], self._scale)]
        pairs = worse or [pair for pair in pairs if pair not in self.at_start]
        if not pairs:
            return []
        names = {tuple(self.model.body(int(self.model.geom_bodyid[geom])).name for geom in pair) for pair in pairs}
        if not all(map(all, names)):  # MuJoCo excludes bodies by their names
            return [no_fix("exclude", "overlap_deepens_unnamed", pair=self.names(pairs[0]))]
        values = {"pair": self.names(pairs[0]), "bodies": json.dumps(sorted(names), ensure_ascii=False)}
        return [no_fix("exclude", "overlap_deepens", **values)]

    def _stands(self, pair: tuple[int, int]) -> bool:
        """Whether something moves in a tree of the two that no actuator moves."""
        model, free = self.model, self._free
        trees = model.body_rootid[model.geom_bodyid[list(pair)]]
        return bool(np.any(free & np.isin(model.body_rootid[model.dof_bodyid], trees)))

    def is_ground(self, pair: tuple[int, int]) -> bool:
        """Whether one of the two geoms is fixed."""
        return any(self.model.body_weldid[self.model.geom_bodyid[geom]] == 0 for geom in pair)

    def touching(self, q: np.ndarray, rounding: float = TOUCH_ROUNDING) -> dict[tuple[int, int], float]:
        """Unmodelled pairs in contact, and their depths, m."""
        self._data.qpos[:] = q
        self._mujoco.mj_fwdPosition(self.model, self._data)
        found: dict[tuple[int, int], float] = {}
        for contact in self._data.contact:
            pair = (int(min(contact.geom)), int(max(contact.geom)))
            if np.all(self._at_rest[list(pair)]):
                continue
            if -contact.dist >= rounding * self._scale and names_of(self.model, pair) not in self._known:
                found[pair] = max(found.get(pair, 0.0), -float(contact.dist))
        return found

    def depths(self, q: np.ndarray) -> dict[tuple[int, int], float]:
        """The same without pairs in contact at the start."""
        return {pair: depth for pair, depth in self.touching(q).items() if pair not in self.at_start}
