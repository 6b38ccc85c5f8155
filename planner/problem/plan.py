"""Plan: the result of solve(), and its file plan.npz.

Everywhere, files included, the control of a plan is

    u = us[n] + K[n] @ (x - xs[n]),     constant over stage n,

clipped to the problem's control bounds, if any (within_bounds). x - xs[n] is the deviation space.difference(x, xs[n]),
for plain vectors their difference.

plan.npz is read with numpy alone: arrays t (N+1,), xs (N+1, nx), us (N, nu), K (N, nu, ndx), history (one row
per iteration, columns as in Iteration) and meta, one JSON string; its `space` lists the quaternions of xs, its
`digests` detect later changes. The file has the model and the recipe of the problem too, so it is proved from the file
alone (planner.load_plan); a problem of user-defined Python must be passed. No pickle.
"""

from __future__ import annotations

import io
import warnings
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from planner.base.environment import installed_versions
from planner.base.files import printable
from planner.base.late_imports import Plottable
from planner.model.space import StateSpace, euclidean, space_of
from planner.model.twin import Twin
from planner.problem.archive import FILE, HINGES, PART, digest_of, pack, plan_name, write_archive
from planner.problem.constraints.clearance import states_between_knots
from planner.problem.constraints.trajectory_constraints import BoundPenalties
from planner.problem.costs.terms import stored_tolerance
from planner.problem.export import Samples, frame_of, joint_trajectory, sampled, write_csv, write_keyframes
from planner.problem.goals import missed_goal_message, unreturned_message
from planner.problem.initial_guess import Trajectory, rates_of, scaled_multipliers
from planner.problem.objective import base_problem
from planner.problem.problem import Problem
from planner.problem.problem_parts import PROBLEM_FILE, Built, Recipe
from planner.problem.progress import (
    Iteration,
    Start,
    Status,
    constraints_broken,
    control_at_bound,
    infeasible_message,
    sentence_of,
    stalled,
    state_outside,
)
from planner.problem.stored_problem import to_arrays, unstorable_part
from planner.problem.touch_downs import TouchDown, touch_downs_of

JUDGED_PARTS = 20  # of a stage, between whose ends a plan's states are interpolated linearly to judge its goals


@dataclass(frozen=True, eq=False)
class Plan(Built, Plottable):
    """An optimized trajectory with feedback gains.

    Attributes:
        t: (N+1,) s, the knots.
        xs: (N+1, nx) states.
        us: (N, nu) controls, constant over each stage.
        K: (N, nu, ndx) gains of the last Riccati sweep.
        cost: J of Eq. 9.
        gradient_norm: Norm of Eq. 19 at the plan: check optimality from the file.
        status: Outcome of the solve.
        history: One Iteration per iteration; the last one is the plan itself.
        problem: The solved problem; None for a file whose problem is user-defined Python.
        recipe: Recipe to rebuild the problem; None if it was assembled from parts.
        twin: The MuJoCo model for replays, or None.
        starts: Result of each start of a solve with several; empty for a single one.
        options: The arguments of solve(), including the seed.
        changed: Parts of the plan's file that were changed after it was written; empty for none, or without a file.
        penalties: Penalty terms of state bounds and constraints in the last round of the augmented Lagrangian. The
            gradient, its norm and the gains include them. None without penalties.
        space: State space.
        versions: Of the software that made the plan.
    """

    t: np.ndarray
    xs: np.ndarray
    us: np.ndarray
    K: np.ndarray
    cost: float
    gradient_norm: float
    status: Status
    history: tuple[Iteration, ...]
    problem: Problem | None = None
    recipe: Recipe | None = None
    twin: Twin | None = None
    made_with: dict[str, str] | None = None
    starts: tuple[Start, ...] = ()
    stored_space: StateSpace | None = None
    options: dict[str, Any] = field(default_factory=dict)
    changed: tuple[str, ...] = ()
    bound_penalties: BoundPenalties | None = None
    stored_touch_downs: tuple[TouchDown, ...] = ()

    @property
    def N(self) -> int:
        """Number of stages."""
        return len(self.us)

    @property
    def dt(self) -> float:
        """Length of a stage, s."""
        return float(self.t[-1]) / self.N

    @property
    def nit(self) -> int:
        """Number of iterations (as in SciPy)."""
        return max(len(self.history) - 1, 0)

    @property
    def total_iterations(self) -> int:
        """Number of iterations of all starts, of all solves of a relaxation, or of all passes of a periodic motion."""
        if "phase_times" in self.options:
            return sum(row[-1] for row in self.options["phase_times"]) + self.options.get("unrolled", 0)
        if "passes" in self.options:
            return sum(row[3] for row in self.options["tried"])
        relaxed = sum(step[4] for step in self.options.get("relaxation", {}).get("steps", ()))
        return sum(start.iterations for start in self.starts) + relaxed or self.nit

    @property
    def success(self) -> bool:
        """Whether the solve converged to a motion that its steps resolve and that meets its goals."""
        return self.status is Status.CONVERGED

    @property
    def converged(self) -> bool:
        """Whether the solve converged, whatever its plan misses: CONVERGED, GOAL_MISSED or UNRESOLVED."""
        return self.status.converged

    @property
    def message(self) -> str:
        """The status as a sentence (as in SciPy), with violated or active limits and missed goals."""
        if self.problem is not None and self.status is not Status.UNRESOLVED and self.missed_goals:
            return f"{Status.CONVERGED.value[:-1]}, but {self.missed_goals}."
        if self.status is Status.NOT_PERIODIC and self.problem is not None:
            told = unreturned_message(self.problem, self.xs)
            return f"{self.status.value[:-1]}: {told}." if told else self.status.value
        if self.status is Status.INFEASIBLE:
            return infeasible_message(self.status.value, self.options.get("relaxation", {}))
        if self.problem is None or not (self.status.cut or self.status in (Status.NO_DESCENT, Status.OUTSIDE_LIMITS)):
            return self.status.value
        outside = sentence_of(state_outside(self.problem, self.xs, self.t))
        held = sentence_of(control_at_bound(self.problem, self.xs, self.us))
        broken = ", ".join(map(sentence_of, constraints_broken(self.problem, self.xs, self.us, self.t)))
        if self.status is Status.OUTSIDE_LIMITS:
            found = ", and ".join(filter(None, (outside, broken, held)))
            return f"{self.status.value[:-1]}: {found}." if found else self.status.value
        if broken:
            return f"{self.status.value[:-1]}: {broken}; where that does not change, no motion keeps them."
        if not held or (self.status.cut and not stalled(self.history, self.cost)):
            return self.status.value
        return f"The solve stalls between bounds: {held}; give the motion more time or wider limits."

    @property
    def missed_goals(self) -> str:
        """Message about missed goals of a converged plan; "" for none, and for a plan without its problem."""
        if self.problem is None or not self.converged:
            return ""
        return missed_goal_message(self.problem, *self.judged_motion)

    @property
    def judged_motion(self) -> tuple[np.ndarray, np.ndarray]:
        """Times (M,) and states (M, nx) by which goals are judged: between knots too, where one is at a time."""
        problem = self.problem
        goals = () if problem is None else problem.goal_specs or ()
        if problem is None or all(one.times is None for one in goals):
            return self.t, self.xs
        t = np.linspace(0.0, self.t[-1], JUDGED_PARTS * self.N + 1)
        return t, self.between_knots(JUDGED_PARTS)

    @property
    def space(self) -> StateSpace:
        """The space of the states: of the problem's dynamics, or from the file."""
        if self.problem is not None:
            return space_of(self.problem.dynamics)
        return euclidean(self.xs.shape[1]) if self.stored_space is None else self.stored_space

    @property
    def touch_downs(self) -> tuple[TouchDown, ...]:
        """When feet begin to bear load, for which the gains wait (problem.touch_downs); without problem its file's."""
        return self._touch_downs

    @cached_property
    def _touch_downs(self) -> tuple[TouchDown, ...]:
        return self.stored_touch_downs if self.problem is None else touch_downs_of(self.problem.dynamics, self.xs)

    @property
    def start(self) -> int:
        """Number of the start that gave this plan; 0 is the problem's own first guess."""
        return min(self.starts, key=lambda start: start.rank).number if self.starts else 0

    @property
    def name(self) -> str:
        """Name of the built-in problem; of others the title of the problem file, the model's name, or its file's."""
        if self.case not in (None, PROBLEM_FILE):
            return str(self.case)
        appearance = None if self.problem is None else self.problem.appearance
        origin = {} if self.twin is None else self.twin.origin
        return (appearance.title if appearance is not None else "") or Path(origin.get("path", "")).stem

    @property
    def versions(self) -> dict[str, str]:
        """Versions of the software that made the plan."""
        return installed_versions() if self.made_with is None else self.made_with

    def within_bounds(self, n: int | np.ndarray, u: np.ndarray) -> np.ndarray:
        """Controls u (..., nu) of stage n, or (K, nu) of stages n (K,), clipped to the problem's constant bounds.

        The force of a servo is limited by the servo itself: commands beyond that are no violation. To clip them to the
        bounds at a state would have the set-point follow the joint, which takes away the servo's stiffness.
        """
        bounds = None if self.problem is None else self.problem.bounds
        return u if bounds is None else bounds.clip(n, u, None)

    def between_knots(self, parts: int) -> np.ndarray:
        """States (N * parts + 1, nx) at equal parts of each stage, integrated from each knot by the plan's dynamics."""
        assert self.problem is not None  # for its dynamics
        return states_between_knots(self.problem.dynamics, self.xs, self.us, parts)

    @property
    def motion(self) -> Trajectory:
        """The plan's trajectory, without its problem."""
        problem = self.problem
        rates = rates_of(None if problem is None else problem.dynamics)
        constraints = None if problem is None else problem.trajectory_constraints
        pulls = scaled_multipliers(constraints, self.bound_penalties)
        return Trajectory(self.t, self.xs, self.us, self.K, self.space, rates, pulls)

    def shifted(self, seconds: float) -> Trajectory:
        """A first guess for the same task `seconds` later: solve(..., warm_start=plan.shifted(0.1)). See Trajectory.

        Raises:
            PlannerError: seconds is no finite number.
        """
        return self.motion.shifted(seconds)

    def stretched(self, duration: float) -> Trajectory:
        """A first guess for the same task in another duration (s): solve(..., warm_start=plan.stretched(2.0)).

        Raises:
            PlannerError: duration is not above 0.
        """
        return self.motion.stretched(duration)

    @property
    def summary(self) -> str:
        """Name, iterations, cost and number of stages as a phrase."""
        name = f"{self.name}: " if self.name else ""
        return f"{name}{self.nit} iterations, cost {self.cost:.6g}, N = {self.N}"

    def __str__(self) -> str:
        return f"Plan({self.status.name}: {self.summary})"

    __repr__ = __str__

    def save(self, path: str | Path) -> Path:
        """Write the plan as .npz, atomically and without pickle.

        A problem with user-defined Python, e.g. a cost or a constraint, is not stored in the file, with a warning.
        load_plan(path, problem=problem) joins the two again.

        Raises:
            FileError: The file cannot be written.
        """
        arrays, meta = self._contents(plan_name(path).parent)
        write_archive(plan_name(path), arrays, meta)
        if meta["recipe"] is None and self.problem is not None:
            warnings.warn(
                f"{printable(path)} has the plan without its problem: a file cannot hold "
                f"{unstorable_part(base_problem(self.problem))}. load_plan(path, problem=problem) puts them together.",
                stacklevel=2,
            )
        return Path(path)

    def to_bytes(self) -> bytes:
        """The content of the file that save() writes."""
        file = io.BytesIO()
        pack(file, *self._contents())
        return file.getvalue()

    def _contents(self, folder: Path | None = None) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """The arrays and the JSON metadata of the plan's file, the model's path relative to its folder, if any."""
        recipe, parts = self.recipe, {}
        if recipe is None and self.problem is not None:
            recipe, parts = to_arrays(base_problem(self.problem)) or (None, {})
        elif recipe is not None and self.problem is not None and self.case == PROBLEM_FILE:
            parts = {"us": self.problem.first_guess, **recipe.found}
        objective = None if self.problem is None else self.problem.objective
        files = {} if self.twin is None else self.twin.assets
        names = {name: digest_of(content) for name, content in files.items()}
        meta = {
            "recipe": None if recipe is None else {"name": recipe.name, "parameters": recipe.parameters},
            "status": self.status.name, "cost": float(self.cost), "gradient_norm": float(self.gradient_norm),
            "iterations": self.nit, "versions": self.versions,
            "twin": None if self.twin is None else self.twin.to_dict(folder),
            "mjcf": None if self.twin is None else self.twin.mjcf, "files": names, "space": self.space.to_dict(),
            "starts": [(s.number, s.status.name, float(s.cost), s.iterations, float(s.score)) for s in self.starts],
            "options": self.options, "objective": None if objective is None else objective.stored,
            "limits": None if self.problem is None or self.problem.limits is None else self.problem.limits.to_dict(),
            "tolerance": None if self.problem is None else stored_tolerance(self.problem.tolerance),
            "touch_downs": [one.to_dict() for one in self.touch_downs],
        }  # fmt: skip
        history = np.array(self.history, dtype=float).reshape(-1, len(Iteration._fields))
        arrays = {"t": self.t, "xs": self.xs, "us": self.us, "K": self.K, "history": history}
        if self.bound_penalties is not None:
            arrays |= dict(zip(HINGES, self.bound_penalties, strict=True))
        for name, content in files.items():
            arrays[FILE + names[name]] = np.frombuffer(content, np.uint8)
        for name, part in parts.items():
            arrays[PART + name] = part
        return arrays, meta

    def sampled(self, rate: float | None = None) -> Samples:
        """Times, states, controls and stages at the knots, or at `rate` Hz and at the end: see Samples."""
        return sampled(self, rate)

    def to_csv(self, path: str | Path, rate: float | None = None, only: str | None = None) -> Path:
        """Write time, states and controls (or `only` "states" or "controls") as CSV: see export.write_csv."""
        return write_csv(self, path, rate, only)

    def to_pandas(self, rate: float | None = None, only: str | None = None) -> Any:
        """The table of to_csv as a pandas DataFrame, indexed by time: see export.frame_of."""
        return frame_of(self, rate, only)

    def to_joint_trajectory(self, path: str | Path | None = None, rate: float | None = None) -> dict[str, Any]:
        """ROS 2's JointTrajectory, also written as .yaml or .json: see problem.export."""
        return joint_trajectory(self, path, rate)

    def to_keyframes(self, path: str | Path, rate: float | None = None) -> Path:
        """Write an MJCF of keyframes that a model can include: see export.write_keyframes."""
        return write_keyframes(self, path, rate)
