"""Step 7 of a proof: the same plan with other contact parameters, reported and never judged.

MuJoCo computes the plan's own contact law, since the model's contact attributes are set so. How much the trajectory
depends on that law is shown by replays in which only the contacts differ:

    default contact      solref, solimp, friction, dimension and cone at MuJoCo's defaults
    half, double         of the stiffness, the damping, or the sliding friction of every contact

each open loop and with the plan's gains. Joint stops stay as they are. MuJoCo's default contact force is proportional
to the mass of the body in contact; where that is much lighter than the load (the hopper's foot), it could not carry the
load: there the step does not apply.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from planner.base.gl import load_mujoco
from planner.base.measured import Measurement, Section
from planner.dynamics import kinematics
from planner.model.capabilities import capabilities_of
from planner.problem.plan import Plan
from planner.proof.error_scales import by_unit
from planner.proof.replays.compiled_twin import CompiledTwin
from planner.proof.replays.replaying import Replay, problem_of, replay_in
from planner.proof.robustness.rollouts import MODES

TITLE = "contact sensitivity"
LIGHT = 0.01  # smallest mass share, in its kinematic tree, of a body that MuJoCo's default contact can support
PLAN = "planned contact"

_KINDS = {"rad": "angle", "m": "distance"}
_LOOKS, _LOOKS_PER_STAGE = 200, 4  # samples of a replay to find bodies in contact, and their positions

# MuJoCo's default contact parameters.
SOLREF, SOLIMP, SLIDING, CONDIM = (0.02, 1.0), (0.9, 0.95, 0.001, 0.5, 2.0), 1.0, 3


@dataclass(frozen=True)
class ContactVariant:
    """Errors of a plan's replay with one set of contact parameters.

    Attributes:
        ground: "planned contact", "default contact", "half stiffness" and so on.
        mode: "open-loop" or "feedback".
        end: Largest error of the end state by unit, against the plan.
        path: The same over the whole path.
        feet: Largest distance of the spheres in contact with planes from their planned positions, m; NaN for none.
        peak_force: Largest sum of normal forces, N.
        warnings: MuJoCo's warnings.
    """

    ground: str
    mode: str
    end: dict[str, float]
    path: dict[str, float]
    feet: float
    peak_force: float
    warnings: tuple[str, ...] = ()


@np.errstate(all="ignore")  # a trajectory may diverge
def contact_sensitivity(
    plan: Plan, compiled: CompiledTwin, runs: Mapping[str, Replay] | None = None,
    replay: Callable[..., Replay] = replay_in,
) -> Section:  # fmt: skip
    """Replay a plan with other contact parameters, open loop and with its gains.

    Args:
        plan: A plan of a problem with a twin.
        compiled: The model with the plan's own contact law.
        runs: Replays in that model by mode, if already computed.
        replay: replay(compiled, plan, feedback=...) in a model.
    """
    runs = _by_mode(plan, compiled, replay) if runs is None else runs
    reason = _reason(compiled.model, runs)
    if reason:
        return Section(TITLE, not_applicable=reason)
    variants = contact_variants(plan, compiled, runs, replay)
    return Section(TITLE, tuple(one for variant in variants for one in _measured(variant)))


def contact_variants(
    plan: Plan, compiled: CompiledTwin, runs: Mapping[str, Replay], replay: Callable[..., Replay] = replay_in
) -> Iterator[ContactVariant]:
    """The errors of a plan's replays by contact parameters and mode; arguments as of contact_sensitivity()."""
    for mode, run in runs.items():
        yield _variant(PLAN, mode, run)
    for name, change in GROUNDS.items():
        for mode, run in _by_mode(plan, compiled.changed(change), replay).items():
            yield _variant(name, mode, run)


def _by_mode(plan: Plan, compiled: CompiledTwin, replay: Callable[..., Replay]) -> dict[str, Replay]:
    return {mode: replay(compiled, plan, feedback=mode == "feedback") for mode in MODES}


def _reason(model: Any, runs: Mapping[str, Replay]) -> str:
    """Reason why other contact parameters are not informative for these replays, or ""."""
    touching = sorted({body for run in runs.values() for body in _touching(model, run)})
    if not touching:
        return "nothing touches"
    for body in touching:
        own = float(model.body_mass[model.body_weldid == body].sum())
        carried = float(model.body_subtreemass[model.body_rootid[body]])
        if own < LIGHT * carried:
            name = model.body(body).name or f"body {body}"
            return (
                f"{name}, which touches, has {100.0 * own / carried:.2g} % of the mass that it carries, and MuJoCo's "
                f"default contact is as weak as the mass of what touches: expected at least {100.0 * LIGHT:g} %"
            )
    return ""


def _touching(model: Any, run: Replay) -> set[int]:
    """The moving bodies in contact in a replay."""
    mujoco, found = load_mujoco(), set()
    data, steps = mujoco.MjData(model), np.flatnonzero(run.contact_force > 0.0)
    for i in steps[:: max(1, len(steps) // _LOOKS)]:
        data.qpos[:] = run.qpos[i]
        mujoco.mj_fwdPosition(model, data)
        found |= {int(model.body_weldid[model.geom_bodyid[geom]]) for geom in np.ravel(data.contact.geom) if geom >= 0}
    return found - {0}


def _variant(ground: str, mode: str, run: Replay) -> ContactVariant:
    error = np.nan_to_num(np.abs(run.error), nan=np.inf)  # infinite after divergence
    which = {unit: components for _, unit, components, _ in by_unit(problem_of(run.plan))}
    return ContactVariant(
        ground, mode, {unit: float(error[-1, own].max()) for unit, own in which.items()},
        {unit: float(error[:, own].max()) for unit, own in which.items()},
        _feet(run), float(np.nanmax(run.contact_force)), run.warnings,
    )  # fmt: skip


def _feet(run: Replay) -> float:
    """Largest distance of the plan's contact spheres from their planned positions, m."""
    mechanism = capabilities_of(problem_of(run.plan).dynamics).mechanism
    if mechanism is None or not mechanism.contacts:
        return np.nan
    if not np.isfinite(run.xs).all():
        return np.inf
    rows = slice(None, None, max(1, run.substeps // _LOOKS_PER_STAGE))
    links = np.array([contact.link for contact in mechanism.contacts])
    centres = np.array([contact.centre for contact in mechanism.contacts])
    own, planned = (
        kinematics.points_of(mechanism, xs[rows, : mechanism.nq], links, centres, moving=False)[0]
        for xs in (run.xs, run.plan_xs)
    )
    return float(np.linalg.norm(own - planned, axis=-1).max())


def _measured(row: ContactVariant) -> Iterator[Measurement]:
    """What is shown of a variant: all but its velocities."""
    note = " ".join((f"{row.ground}, {row.mode}; shown, not judged.", *row.warnings))
    ground, mode = (re.sub(r"\W+", "_", part) for part in (row.ground, row.mode))
    for where, errors in (("end", row.end), ("path", row.path)):
        for unit, value in errors.items():
            if not unit.endswith("/s"):
                kind = f"{_KINDS[unit]}_" if unit in _KINDS else ""
                yield Measurement(f"{ground}_{where}_{kind}error_{mode}", value, unit, None, note)
    if np.isfinite(row.feet) or np.isinf(row.feet):
        yield Measurement(f"{ground}_feet_error_{mode}", row.feet, "m", None, note)
    yield Measurement(f"{ground}_peak_force_{mode}", row.peak_force, "N", None, note)


def _default(model: Any) -> None:
    """Set all contact parameters to MuJoCo's defaults."""
    bits, kinds = load_mujoco().mjtEnableBit, load_mujoco().mjtCone
    for of in ("pair", "geom"):
        getattr(model, f"{of}_solref")[:] = SOLREF
        getattr(model, f"{of}_solimp")[:] = SOLIMP
        getattr(model, f"{of}_margin")[:] = 0.0
        getattr(model, f"{of}_gap")[:] = 0.0
        getattr(model, f"{of}_friction")[:, 0] = SLIDING
    model.pair_friction[:, 1] = SLIDING
    model.pair_solreffriction[:] = 0.0
    model.pair_dim[:] = model.geom_condim[:] = CONDIM
    model.geom_priority[:] = 0
    model.geom_solmix[:] = 1.0
    model.opt.cone, model.opt.impratio = int(kinds.mjCONE_PYRAMIDAL), 1.0
    model.opt.noslip_iterations = 0
    model.opt.enableflags &= ~int(bits.mjENBL_OVERRIDE)
    model.opt.disableflags &= ~int(load_mujoco().mjtDisableBit.mjDSBL_REFSAFE)


def _stiffness(factor: float, model: Any) -> None:
    for solref in (model.pair_solref, model.geom_solref):
        direct = solref[:, 0] <= 0.0
        solref[direct, 0] *= factor
        solref[~direct, 1] /= np.sqrt(factor)  # a damping ratio: constant damping


def _damping(factor: float, model: Any) -> None:
    inherits = ~np.any(model.pair_solreffriction, axis=1)  # sliding friction has its own solref
    model.pair_solreffriction[inherits] = model.pair_solref[inherits]
    for solref in (model.pair_solref, model.geom_solref):
        direct = solref[:, 0] <= 0.0
        solref[direct, 1] *= factor
        solref[~direct] *= (1.0 / factor, factor)  # time constant and damping ratio: constant stiffness


def _friction(factor: float, model: Any) -> None:
    model.pair_friction[:, :2] *= factor
    model.geom_friction[:, 0] *= factor


GROUNDS: dict[str, Callable[[Any], None]] = {"default contact": _default}
for _name, _change in (("stiffness", _stiffness), ("damping", _damping), ("friction", _friction)):
    GROUNDS |= {f"half {_name}": partial(_change, 0.5), f"double {_name}": partial(_change, 2.0)}
