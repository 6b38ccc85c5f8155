"""A machine with errors that somebody states, in place of drawn ones: heavier by so much, with so much friction."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from planner.base.arguments import number
from planner.base.errors import PlannerError
from planner.base.gl import load_mujoco
from planner.problem.plan import Plan
from planner.proof.replays.compiled_twin import CompiledTwin
from planner.proof.robustness.perturbation import Nominal, PerturbationSample
from planner.proof.robustness.pushes import bodies_of

Mass = float | Mapping[str, float]


def with_stated_errors(
    compiled: CompiledTwin, plan: Plan, model: Any, mass: Mass, friction: float, contact_friction: float
) -> Any:
    """MuJoCo's model with errors; the model itself where there are none.

    Args:
        compiled: The twin.
        plan: Whose largest forces are the scale of friction.
        model: Of the twin, at the step that is simulated.
        mass: Relative error of all masses, inertias with them, or of bodies by name.
        friction: Dry friction in every joint, as a share of the largest force that the plan asks of it.
        contact_friction: Relative error of the coefficients of contacts.

    Raises:
        PlannerError: A body that the model does not have, a mass that is not above zero.
    """
    friction = number("friction", friction, minimum=0.0, maximum=1e3)
    change = number("contact_friction", contact_friction, greater_than=-1.0, maximum=1e3)
    factors = np.ones(model.nbody)
    if isinstance(mass, Mapping):
        known = bodies_of(model)
        for body, error in mass.items():
            if body not in known:
                raise PlannerError(f"mass names the body {body!r}, expected one of: {', '.join(known)}.")
            factors[model.body(body).id] += number(f"the mass error of {body}", error, greater_than=-1.0, maximum=1e3)
    else:
        factors += number("mass", mass, greater_than=-1.0, maximum=1e3)
    if np.all(factors == 1.0) and not friction and not change:
        return model
    one = np.ones(model.nv)
    draw = PerturbationSample(
        mass=factors, inertia=np.ones(model.nbody), damping=one, drag=0.0 * one, friction=friction * one,
        contact_friction=1.0 + change, start=np.zeros(plan.space.ndx), noise=np.zeros((0, 0)), delay=0.0,
        stiffness=np.ones(model.njnt),
    )  # fmt: skip
    return Nominal.of(model, plan, compiled.twin).with_errors(draw, load_mujoco().MjData(model))
