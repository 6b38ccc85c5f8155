"""Shapes that touch in the user's file and not in the plan: at the goal, on the ground, or on the way."""

from __future__ import annotations

from typing import Any

import numpy as np

from planner.base.errors import PlannerError
from planner.base.gl import load_mujoco
from planner.model.mechanism import Mechanism
from planner.model.mjcf.initial_overlaps import can_separate
from planner.model.mjcf.model_index import ModelIndex, named
from planner.model.mjcf.unmodelled_features import names_of
from planner.problem.costs.tracking import tracking_of
from planner.problem.plan import Plan
from planner.problem.problem import Problem
from planner.proof.cures.cure import FILE, Cure, cure, no_cure
from planner.proof.cures.velocity_weight import straightened
from planner.proof.original_model import PENETRATION_TOLERANCE, as_given
from planner.proof.replays.compiled_twin import unmodelled_of
from planner.proof.verdict import Proof

CLEAR = 5e-3  # m between shapes that are moved apart (of a machine of 1 m or more)
_STEPS = 30  # to move them apart
_LONGEST = 0.1  # rad or m, of a step
_MAX_GOAL_SHIFT = 0.5  # rad or m: a goal that must move so far is another goal
_ALONG = 40  # poses on the straight way
_SLIGHT = 1e-5  # rad or m, of differences


def avoid_contact(plan: Plan, problem: Problem, proof: Proof | None) -> list[Cure]:
    """A law for the ground, a goal that is free, or a straight way to it."""
    if proof is None or not any(one.name == "unknown_contacts" for one in proof.your_file.failures):
        return []
    mechanism, twin, cost = getattr(problem.dynamics, "mechanism", None), plan.twin, tracking_of(problem.cost)
    if twin is None or cost is None or not isinstance(mechanism, Mechanism):
        return []
    try:
        shapes = _Shapes(problem, as_given(problem, twin).model)
    except PlannerError:  # a file that is driven
        return []
    start, goal = (twin.sim_of(x)[: mechanism.nq] for x in (problem.x0, cost.x_ref[-1]))
    began = shapes.depths(start)
    shapes.at_start = set(began)
    met = {pair: None for q in (start, *_knots(plan, mechanism)) for pair in shapes.touching(q)}
    floor = [pair for pair in met if shapes.is_ground(pair)]
    if floor and problem.case == FILE and problem.parameters.get("contacts") == "off" and shapes.floats:
        why = f'{shapes.names(floor[0])} touch, and contacts = "off" takes the ground away'
        return [cure(problem, "contacts", "ground", why)]
    survey = ModelIndex(shapes.model)
    if inside := {pair: depth for pair, depth in began.items() if can_separate(survey, pair, start, CLEAR)}:
        pair = max(inside, key=lambda pair: inside[pair])
        why = f"at the start {shapes.names(pair)} are {inside[pair]:.2g} m in each other"
        return [no_cure("start", f"Another `start` is needed, or a model that leaves the pair out: {why}.")]
    at_goal = shapes.depths(goal)
    if at_goal:
        pair = max(at_goal, key=lambda pair: at_goal[pair])
        why = f"in the goal itself {shapes.names(pair)} are {at_goal[pair]:.2g} m in each other"
        if problem.case == FILE and problem.goal_specs is not None and "avoid" not in problem.parameters:
            return [cure(problem, "avoid", {}, f"{why}; with it another pose of the goal is sought")]
        free = shapes.freed(goal, mechanism)
        if free is None or problem.case != FILE:
            return [no_cure("goal", f"Another `goal` is needed: {why}.")]
        return [cure(problem, "goal", _as_given(problem, mechanism, goal, free), why)]
    touching = {pair: None for q in _knots(plan, mechanism) for pair in shapes.depths(q)}
    if not touching:
        return []  # what overlaps at the start
    on_the_way = f"{shapes.names(next(iter(touching)))} touch on the way"
    if not any(shapes.depths(q) for q in shapes.straight(start, goal)):
        why = f"{on_the_way}, start and goal are free and so is the straight way between them"
        if found := straightened(problem, why):
            return found
    if problem.case == FILE and "avoid" not in problem.parameters:
        return [cure(problem, "avoid", {}, f"{on_the_way}, the straight one too; with it the way goes around")]
    return [no_cure("goal", f"{on_the_way}, the straight one too: plan to a `goal` in between, and on from there.")]


def _knots(plan: Plan, mechanism: Mechanism) -> list[np.ndarray]:
    """Some of a plan's poses, the last one among them."""
    assert plan.twin is not None  # avoid_contact() asked
    knots = plan.twin.sim_of(plan.xs)[:: -max(1, plan.N // _ALONG), : mechanism.nq]
    return [q for q in knots[::-1] if np.isfinite(q).all()]


def _as_given(problem: Problem, mechanism: Mechanism, goal: np.ndarray, free: np.ndarray) -> Any:
    """The goal in the form in which the file has it."""
    given = problem.parameters["goal"]
    if isinstance(given, dict):
        changed = {}
        for name, links in zip(mechanism.joint_names, mechanism.joint_links, strict=True):
            i = int(mechanism.q_address[links.start])
            if name and links.stop - links.start == 1 and free[i] != goal[i]:
                changed[name] = round(float(free[i]), 6) + 0.0
        return given | changed
    return [round(float(value), 6) + 0.0 for value in free]


class _Shapes:
    """The shapes of the user's file in a pose, as far as the plan does not know that they touch."""

    def __init__(self, problem: Problem, model: Any) -> None:
        self._mujoco, self.model = load_mujoco(), model
        self._data = self._mujoco.MjData(model)
        self._known = unmodelled_of(problem).known
        self._scale = min(1.0, float(model.stat.extent))
        self.at_start: set[tuple[int, int]] = set()
        moment = self._moment()
        self._driven = np.flatnonzero(moment.any(axis=0))
        self.floats = len(self._driven) < model.nv

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

    def is_ground(self, pair: tuple[int, int]) -> bool:
        """Whether one of the two does not move."""
        return any(self.model.body_weldid[self.model.geom_bodyid[geom]] == 0 for geom in pair)

    def touching(self, q: np.ndarray) -> dict[tuple[int, int], float]:
        """Pairs that the plan does not know, and their depths, m."""
        self._data.qpos[:] = q
        self._mujoco.mj_fwdPosition(self.model, self._data)
        found: dict[tuple[int, int], float] = {}
        for contact in self._data.contact:
            pair = (int(min(contact.geom)), int(max(contact.geom)))
            if -contact.dist > PENETRATION_TOLERANCE * self._scale and names_of(self.model, pair) not in self._known:
                found[pair] = max(found.get(pair, 0.0), -float(contact.dist))
        return found

    def depths(self, q: np.ndarray) -> dict[tuple[int, int], float]:
        """The same without pairs that touch at the start."""
        return {pair: depth for pair, depth in self.touching(q).items() if pair not in self.at_start}

    def straight(self, start: np.ndarray, goal: np.ndarray) -> list[np.ndarray]:
        """Poses on the straight way of all joints."""
        way, poses = np.empty(self.model.nv), []
        self._mujoco.mj_differentiatePos(self.model, way, 1.0, start, goal)
        for part in np.linspace(0.0, 1.0, _ALONG + 1):
            pose = start.copy()
            self._mujoco.mj_integratePos(self.model, pose, way, part)
            poses.append(pose)
        return poses

    def freed(self, goal: np.ndarray, mechanism: Mechanism) -> np.ndarray | None:
        """A pose near the goal in which nothing touches: driven joints moved as little as they must; None for none."""
        q, clear = goal.copy(), CLEAR * self._scale
        pairs: set[tuple[int, int]] = set()
        for _ in range(_STEPS):
            pairs |= set(self.depths(q))
            distances = np.array([self._distance(q, pair) for pair in pairs])
            short = clear - distances
            if np.all(short <= 0.1 * clear):
                return q if not self.depths(q) and np.abs(q - goal).max() < _MAX_GOAL_SHIFT else None
            rows = np.zeros((len(pairs), self.model.nv))
            for i in self._driven.tolist():
                rows[:, i] = [
                    (self._distance(self._moved(q, i), pair) - distance) / _SLIGHT
                    for pair, distance in zip(pairs, distances, strict=True)
                ]
            step = np.linalg.lstsq(rows[short > 0.0], short[short > 0.0], rcond=1e-6)[0]
            step *= min(1.0, _LONGEST / max(float(np.abs(step).max()), 1e-12))
            self._mujoco.mj_integratePos(self.model, q, step, 1.0)
            self._within_ranges(q)
        return None

    def _moved(self, q: np.ndarray, dof: int) -> np.ndarray:
        moved, way = q.copy(), np.zeros(self.model.nv)
        way[dof] = _SLIGHT
        self._mujoco.mj_integratePos(self.model, moved, way, 1.0)
        return moved

    def _distance(self, q: np.ndarray, pair: tuple[int, int]) -> float:
        self._data.qpos[:] = q
        self._mujoco.mj_kinematics(self.model, self._data)
        return float(self._mujoco.mj_geomDistance(self.model, self._data, *pair, 1.0, None))

    def _within_ranges(self, q: np.ndarray) -> None:
        for joint in np.flatnonzero(self.model.jnt_limited & (self.model.jnt_type >= 2)):
            address = self.model.jnt_qposadr[joint]
            q[address] = np.clip(q[address], *self.model.jnt_range[joint])
