"""Step 8 of a proof: the same controls in another engine, with its own parser and dynamics, and SciPy's integrator.

The plan uses MuJoCo's compiler too, so a parsing error would affect both alike. Another engine parses the text itself
and has its own tree, inertias and recursion; SciPy's DOP853 integrates. Elements that it does not read (docs/proof.md)
are applied as forces and reported. The step is shown, it is no part of the verdict.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np

from planner.base.arguments import choice, short_repr
from planner.base.errors import ModelError, PlannerError
from planner.base.measured import Measurement, Section
from planner.dynamics import algorithms as rigid_body
from planner.model.capabilities import capabilities_of
from planner.model.mechanism import Mechanism
from planner.model.mjcf.read import mechanism_of_model
from planner.model.mjcf.unsupported import unsupported_elements
from planner.model.twin import Twin
from planner.problem.plan import Plan
from planner.proof.compare.rigid_parity import random_states, rounded
from planner.proof.engines import ENGINES, drake, pinocchio
from planner.proof.engines.motion import PARTS, Applied, Prepared, Rates, joints_with, motion, prepared
from planner.proof.error_scales import by_unit
from planner.proof.replays.compiled_twin import CompiledTwin
from planner.proof.replays.contact_history import may_touch
from planner.proof.replays.replaying import problem_of

NOTES = ("acceleration_difference", "forces_and_numbers_added", "changes_of_the_text")  # their notes must be read too
STATES = 64  # number of states at which accelerations are compared
_OTHER = 0.5  # relative acceleration error above which the engine has another inertia; smaller errors are compared
_STILL = 1e-9  # of our own acceleration at rest: a smaller one shows missing gravity


class PhysicsEngine(Protocol):
    """A mechanism in another engine, in MuJoCo's coordinates."""

    version: str
    lacks_damping: np.ndarray  # (nv,) damping that its dynamics lack
    settings: list[str]  # parameters set by number, which its parser does not read

    def acceleration(self, q: np.ndarray, v: np.ndarray, tau: np.ndarray) -> np.ndarray:
        """Accelerations qacc (nv,) at qpos, qvel with the applied forces tau."""
        ...


class _Kind(NamedTuple):
    """Constructor, availability check and requirement of an engine."""

    make: Callable[[Prepared, Mechanism], PhysicsEngine]
    load: Callable[[], Any]
    needs: str


_KINDS = {
    "pinocchio": _Kind(pinocchio.Pinocchio, pinocchio.load, pinocchio.NEEDS),
    "drake": _Kind(drake.Drake, drake.load, drake.NEEDS),
}


def require(name: str) -> None:
    """Raise a PlannerError unless an engine is installed."""
    kind = _KINDS[choice("engine", name, ENGINES)]
    try:
        kind.load()
    except ImportError as error:
        raise PlannerError(
            f"the engine {name} is not installed ({error}), expected: pip install {kind.needs}."
        ) from None


def another_engine(plan: Plan, name: str, *, twin: Twin | None = None, seed: int = 0) -> Section:
    """Repeat a plan in another engine, open loop and with its gains, and compare it with the plan.

    Args:
        plan: A plan of a mechanism with hinge, slide, ball and free joints, and smooth dynamics.
        name: "pinocchio" or "drake".
        twin: Another model instead of the plan's own.
        seed: Seed of the random states at which accelerations are compared.

    Returns:
        Errors by kind of coordinate, over the path and at the end; or why the engine cannot simulate this machine.

    Raises:
        PlannerError: The engine is not installed, or computes without gravity; the plan cannot be replayed at all.
        ModelError: MuJoCo rejects the model, or it does not fit the plan.
    """
    if not isinstance(plan, Plan):
        raise PlannerError(f"plan is {short_repr(plan)}, expected a Plan.")
    dynamics: Any = problem_of(plan).dynamics
    twin = twin or plan.twin
    require(name)
    if twin is None:
        raise PlannerError("the plan has no model for another engine, expected a Problem with a twin.")
    compiled = CompiledTwin(twin)
    compiled.check(plan.us.shape[1])
    if reason := _reason(dynamics, compiled.model):
        return Section(name, not_applicable=reason)
    mechanism = mechanism_of_model(compiled.model).with_curves(twin.curves)
    if (mechanism.nq, mechanism.nv) != (dynamics.mechanism.nq, dynamics.mechanism.nv):
        raise ModelError("the model has other joints than the plan's: it is another machine.")
    try:
        with tempfile.TemporaryDirectory() as folder:
            text = prepared(twin, compiled.model, Path(folder))
            engine = _KINDS[name].make(text, mechanism)
    except ModelError as error:
        return Section(name, not_applicable=str(error).rstrip("."))
    if reason := _at_rest(name, engine, mechanism, seed):
        return Section(name, not_applicable=reason)
    applied = Applied(mechanism, engine.lacks_damping)

    def theirs(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        q, v, act = np.split(x, [mechanism.nq, mechanism.nq + mechanism.nv])
        return np.concatenate([v, engine.acceleration(q, v, applied(q, v, act, u)), applied.activation_rates(act, u)])

    added = [*applied.phrases(), *engine.settings]
    notes = (
        Measurement("forces_and_numbers_added", float(len(added)), "", None, "; ".join(added)),
        Measurement("changes_of_the_text", float(len(text.changes)), "", None, "; ".join(text.changes)),
    )
    return Section(name, (_parity(name, engine, dynamics, theirs, seed), *_errors(plan, theirs), *notes))


def _reason(dynamics: Any, model: Any) -> str:
    """Reason why another engine cannot simulate a machine, or ""."""
    mechanism = capabilities_of(dynamics).mechanism
    if mechanism is None:
        return "the plan's dynamics are not those of a mechanism"
    if getattr(dynamics, "prescribed", ()):
        return (
            f"the accelerations of {', '.join(dynamics.prescribed)} are prescribed, the other engines are given forces"
        )
    if mechanism.couplings:
        return (
            f"the joints are coupled by {mechanism.couplings[0].name}, and the other engines are given the tree alone"
        )
    contacts = len(mechanism.contacts) + len(mechanism.body_contacts)
    if contacts or may_touch(model):
        n = f"{contacts} contacts" if contacts > 1 else "contacts"
        return f"the model has {n}, and each engine has a law of contact of its own"
    if mechanism.stops:
        stopped = joints_with(mechanism, np.isin(np.arange(mechanism.nv), [stop.dof for stop in mechanism.stops]))
        return f"the ends of range of {stopped} push back, and each engine has a law of its own"
    if np.any(mechanism.gravcomp_mass) or np.any(mechanism.gravcomp_first_moment):
        return "the model has gravity compensation, which the other engines are not given"
    if mechanism.drags:
        return "the model has a fluid, which the other engines are not given"
    if np.any(mechanism.friction_loss):
        return "the model has friction loss, which depends on accelerations, and the other engines are given forces"
    extra = ", ".join(one.phrase for one in unsupported_elements(model))
    return f"the model has what the other engines are not given: {extra}" if extra else ""


def _at_rest(name: str, engine: PhysicsEngine, mechanism: Mechanism, seed: int) -> str:
    """Reason why the engine read another inertia, or ""; small errors are left to the comparison of accelerations.

    Raises if the engine computes without gravity, as some releases of Pinocchio do without a message.
    """
    x = random_states(mechanism, np.random.default_rng(seed), 1)[0]
    q, still = x[: mechanism.nq], np.zeros(mechanism.nv)
    falling = engine.acceleration(q, still, still)
    pushed = engine.acceleration(q, still, rigid_body.mass_matrix(mechanism, q) @ np.ones(mechanism.nv)) - falling
    wrong = ~(np.abs(pushed - 1.0) < _OTHER)
    if wrong.any():
        return (
            f"its parser reads another inertia at {joints_with(mechanism, wrong)}: pushed as hard as gives 1 rad/s^2 "
            f"or m/s^2, it answers {pushed[wrong][0]:.3g}"
        )
    loose = replace(mechanism, stiffness=0.0 * still, ball_stiffness=0.0 * mechanism.ball_stiffness, tendons=())
    ours = rigid_body.forward_dynamics(loose, q, still, still)
    if np.abs(falling).max() < _STILL * np.abs(ours).max():
        raise PlannerError(
            f"{name} {engine.version} computes without gravity here, expected: pip install {_KINDS[name].needs}."
        )
    return ""


def _parity(name: str, engine: PhysicsEngine, dynamics: Any, theirs: Rates, seed: int) -> Measurement:
    """Largest difference of accelerations at random states, relative to the size of the terms they result from."""
    mechanism, rng = dynamics.mechanism, np.random.default_rng(seed)
    xs = random_states(mechanism, rng, STATES)
    us = rng.normal(size=(STATES, mechanism.nu))
    q, v, _ = np.split(xs, [mechanism.nq, mechanism.nq + mechanism.nv], axis=1)
    ours = dynamics.rates(xs, us)[:, mechanism.nv : 2 * mechanism.nv]
    made_of = rounded(rigid_body.mass_matrix(mechanism, q), rigid_body.bias(mechanism, q, v), ours)
    scale = np.maximum(made_of, np.square(v).max(axis=1))
    accelerations = slice(mechanism.nv, 2 * mechanism.nv)
    found = np.array([theirs(x, u)[accelerations] for x, u in zip(xs, us, strict=True)])
    relative = np.abs(found - ours) / scale[:, None]
    dof = int(relative.max(axis=0).argmax())
    on = joints_with(mechanism, np.arange(mechanism.nv) == dof)
    note = f"{name} {engine.version} at {STATES} random states (seed {seed}), relative to what they are made of"
    return Measurement("acceleration_difference", float(relative.max()), "", None, f"{note}; largest at {on}")


def _errors(plan: Plan, theirs: Rates) -> Iterator[Measurement]:
    """Errors of the trajectory against the plan and against the plan's own dynamics, by kind of coordinate."""
    assert plan.problem is not None  # checked by problem_of()
    dynamics: Any = plan.problem.dynamics
    start, planned = plan.problem.x0, plan.between_knots(PARTS)
    kinds = [(word if unit else "activation", unit, which) for word, unit, which, _ in by_unit(plan.problem)]

    def ours(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        return dynamics.rates(x[None], u[None])[0]

    own = motion(plan, dynamics.mechanism, start, ours, feedback=False)
    for mode, how in (("open_loop", "open loop"), ("feedback", "with ideal gains, at every evaluation")):
        found = motion(plan, dynamics.mechanism, start, theirs, feedback=mode == "feedback")
        error = _deviation(plan, found, planned)
        ran = np.isnan(found).any(axis=1)
        away = f"; ran away at t = {plan.dt / PARTS * ran.argmax():.4g} s" if ran.any() else ""
        for kind, unit, which in kinds:
            path, end = error[:, which].max(), error[-1, which].max()
            note = f"{how}, against the plan's own motion, largest"
            yield Measurement(f"{mode}_end_{kind}_error", float(end), unit, None, f"{note} at the end{away}")
            yield Measurement(f"{mode}_path_{kind}_error", float(path), unit, None, f"{note} over the path{away}")
        if mode == "open_loop":
            apart = _deviation(plan, found, own)
            for kind, unit, which in kinds:
                note = "open loop over the path, against the plan's own dynamics by the same integrator"
                yield Measurement(f"{kind}_between_engines", float(apart[:, which].max()), unit, None, note)


def _deviation(plan: Plan, xs: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Magnitudes (M+1, ndx) of a trajectory's deviation; infinite after divergence."""
    with np.errstate(invalid="ignore"):
        return np.nan_to_num(np.abs(plan.space.difference(xs, reference)), nan=np.inf)
