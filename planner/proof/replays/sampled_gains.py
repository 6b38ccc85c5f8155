"""Sampled feedback with a plan's gains: constant between samples, with delay, from encoder measurements.

At the instants t_k = k * period the correction K[n] (x(t_k) - x_plan(t_k)) is computed, n being the stage at t_k. It
acts from t_k + delay * period until the next one does. The plan's own control us[n] is feedforward: it acts without
delay, over its own stage. Bounds of the problem act on the sum. Before the first correction it is zero.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Collection
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np

from planner.base.arguments import count, number
from planner.base.errors import PlannerError
from planner.base.gl import load_mujoco
from planner.model.mjcf.model_index import names_of
from planner.problem.plan import Plan
from planner.problem.touch_downs import BEARS, StageRule, feet_of, reference
from planner.proof.replays.compiled_twin import CompiledTwin
from planner.proof.replays.simulation import set_state


class FootLoads:
    """The feet of some names in a MuJoCo model, and in others with the same bodies."""

    def __init__(self, model: Any, feet: Collection[str]) -> None:
        self._feet: dict[str, int] = {}  # by name the last degree of freedom that moves it
        if not feet:
            return
        self._links, roots = _links(model), np.arange(model.nv)
        for dof, parent in enumerate(model.dof_parentid):
            roots[dof] = roots[parent] if parent >= 0 else dof
        # As contact_edits names them in the twin's text; the user's own file has no names there.
        bodies = {name or f"body number {k}": k for k, name in enumerate(names_of(model, "body", model.nbody))}
        self._feet = {name: link for name in feet if name in bodies and (link := int(self._links[bodies[name]])) >= 0}
        tree_of = np.append(roots, -1)[self._links]  # (nbody,) the root of each body's tree
        self._trees = {name: tree_of == roots[link] for name, link in self._feet.items()}
        self._wrench = np.zeros(6)

    def known(self, feet: Collection[str]) -> bool:
        """Whether the model has all of these."""
        return all(name in self._feet for name in feet)

    def sensed(self, model: Any, data: Any, w: np.ndarray, ctrl: Callable[[], np.ndarray]) -> Callable[[str], bool]:
        """Whether a foot bears load, by its name; arguments as of at(), which the first question calls."""
        found: list[frozenset[str]] = []

        def bears(foot: str) -> bool:
            if not found:
                found.append(self.at(model, data, w, ctrl()))
            return foot in found[0]

        return bears

    def at(self, model: Any, data: Any, w: np.ndarray, ctrl: np.ndarray) -> frozenset[str]:
        """Names of the feet that bear load at a state w (nw,) under controls (model.nu,); `data` is overwritten."""
        mujoco = load_mujoco()
        set_state(model, data, w)
        data.ctrl[:], data.qacc_warmstart[:] = ctrl, 0.0  # so that a run does not depend on those before it
        mujoco.mj_forward(model, data)
        forces = np.zeros(model.nv)  # by the link that bears it
        for k, (one, other) in enumerate(data.contact.geom[: data.ncon].tolist()):
            if min(one, other) < 0:
                continue  # of a flex
            links = self._links[model.geom_bodyid[one]], self._links[model.geom_bodyid[other]]
            if min(links) < 0 <= max(links):
                mujoco.mj_contactForce(model, data, k, self._wrench)
                forces[max(links)] += self._wrench[0]
        least = BEARS * float(np.linalg.norm(model.opt.gravity))
        return frozenset(
            name for name, link in self._feet.items() if forces[link] > least * model.body_mass[self._trees[name]].sum()
        )


def _links(model: Any) -> np.ndarray:
    """(nbody,) the last degree of freedom that moves each body, -1 for those of the world."""
    links = np.full(model.nbody, -1)
    for body in range(1, model.nbody):
        moves = model.body_dofnum[body]
        links[body] = model.body_dofadr[body] + moves - 1 if moves else links[model.body_parentid[body]]
    return links


PERIOD = 2e-3  # s: 500 Hz
HINGE = 2.0 * math.pi / 2**17  # rad, resolution of an encoder of 17 bits
SLIDE = 1e-6  # resolution, in units of length of the model
_FINEST = 1000  # maximum denominator of the period in stages
_ROUNDING = 1e-9  # relative


@dataclass(frozen=True)
class Sampling:
    """Sampling period, delay and measurement of feedback.

    Attributes:
        period: s from one instant to the next: parts of a stage, stages, or both.
        delay: Periods from an instant until its correction acts.
        encoders: Whether positions of hinge and slide joints are quantized by encoders and their velocities are
            differences of these; else the state is exact.

    Raises:
        PlannerError: The period is not above zero, or the delay is not a non-negative integer.
    """

    period: float
    delay: int = 1
    encoders: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "period", number("Sampling: period", self.period, greater_than=0.0))
        object.__setattr__(self, "delay", count("Sampling: delay", self.delay, minimum=0))

    @property
    def rate(self) -> float:
        """Instants per second, Hz."""
        return 1.0 / self.period

    def in_stages(self, dt: float) -> Fraction:
        """The period in stages of dt s.

        Raises:
            PlannerError: It is neither a whole part of a stage nor a fraction whose denominator is at most 1000.
        """
        share = min(max(self.period / dt, _ROUNDING), 1.0 / _ROUNDING)
        stages = Fraction(1, max(round(1.0 / share), 1))
        if abs(stages * dt - self.period) > _ROUNDING * self.period:
            stages = Fraction(share).limit_denominator(_FINEST)
        if abs(stages * dt - self.period) > _ROUNDING * self.period:
            raise PlannerError(
                f"the sampling period is {self.period:.6g} s and a stage {dt:.6g} s, expected a whole fraction of a "
                f"stage or a whole number of them, {sampling_in(dt).period:.6g} s for example."
            )
        return stages


def sampling_of(plan: Plan) -> Sampling:
    """Feedback sampling of a plan in its proof: 500 Hz or the nearest rate that fits its stages, one period late."""
    return sampling_in(plan.dt if plan.problem is None else plan.problem.dynamics.dt)


def sampling_in(dt: float) -> Sampling:
    """Sampling at 500 Hz in stages of dt s: the nearest rate of whole parts or whole stages, the slower of two."""
    if dt >= PERIOD:
        return Sampling(dt / max(math.ceil(dt / PERIOD - 0.5 - _ROUNDING), 1))
    return Sampling(dt * math.floor(PERIOD / dt + 0.5 + _ROUNDING))


class Gains:
    """The controls of a plan with its gains, as a function of successive states; around touch-downs they wait."""

    def __init__(
        self, plan: Plan, compiled: CompiledTwin, model: Any, plan_xs: np.ndarray, substeps: int,
        sampling: Sampling | None,
    ) -> None:  # fmt: skip
        """For states of MuJoCo's model and the plan (M+1, nx) at its steps; ideal gains at each step for None."""
        assert plan.problem is not None  # its dynamics give the stage length
        dt = plan.problem.dynamics.dt
        self.held = 1 if sampling is None else int(sampling.in_stages(dt) * substeps)  # steps per sampling period
        self._plan, self._twin, self._plan_xs, self._space = plan, compiled.twin, plan_xs, plan.space
        self._stage, self._dynamics = np.repeat(np.arange(plan.N), substeps), plan.problem.dynamics
        self._compiled, self._model, self._substeps = compiled, model, substeps
        self._data = load_mujoco().MjData(model) if plan.touch_downs else None
        self._loads = FootLoads(model, feet_of(plan.touch_downs))
        self._rule = StageRule([one for one in plan.touch_downs if self._loads.known(one.feet)])
        self._u = plan.us[0]
        self._late = deque([np.zeros(plan.us.shape[1])] * (0 if sampling is None else sampling.delay))
        self._encoders = Encoders(model, sampling.period) if sampling is not None and sampling.encoders else None

    def __call__(self, i: int, w: np.ndarray) -> np.ndarray:
        """The controls (held, nu) from step i on, whose state is w (nw,)."""
        bears = self._loads.sensed(self._model, self._data, w, lambda: self._compiled.commands(self._u))
        waits = self._rule(i / self._substeps, bears)
        x = self._twin.x_of(w if self._encoders is None else self._encoders(w))
        stages, x_ref = self._stage[i : i + self.held], self._plan_xs[i]
        if waits is not None:
            since = self._dynamics.dt * (i / self._substeps - waits.stage)
            x_ref = reference(self._dynamics, self._plan.xs[waits.stage], since)
            stages = np.full_like(stages, waits.stage)
        self._late.append(self._plan.K[stages[0]] @ self._space.single_difference(x, x_ref))
        controls = self._plan.within_bounds(stages, self._plan.us[stages] + self._late.popleft())
        self._u = controls[-1]
        return controls


class Encoders:
    """Encoder measurements of a model's states.

    Positions of hinge and slide joints are integer multiples of the encoder resolution; their velocities are backward
    differences over the period, exact at the first instant. Free and ball joints and activations are exact.
    """

    def __init__(self, model: Any, period: float) -> None:
        """For instants that are `period` s apart."""
        kinds = load_mujoco().mjtJoint
        hinges, slides = (model.jnt_type == int(kind) for kind in (kinds.mjJNT_HINGE, kinds.mjJNT_SLIDE))
        single = np.flatnonzero(hinges | slides)
        self._position, self._speed = model.jnt_qposadr[single], model.nq + model.jnt_dofadr[single]
        self._size = np.where(hinges[single], HINGE, SLIDE)
        self._period, self._before = period, np.zeros(0)

    def __call__(self, w: np.ndarray) -> np.ndarray:
        """The measured state (nw,) at a state w (nw,), one period after the last."""
        w, steps = w.copy(), np.round(w[self._position] / self._size)
        w[self._position] = steps * self._size
        if len(self._before):
            w[self._speed] = (steps - self._before) * self._size / self._period
        self._before = steps
        return w
