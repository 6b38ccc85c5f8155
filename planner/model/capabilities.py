"""What a machine has, asked once: a frozen record with defaults for any dynamics."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from planner.model.mechanism import Mechanism


@dataclass(frozen=True, eq=False)
class Capabilities:
    """Facts about dynamics. The defaults hold for dynamics that are no mechanism's, like a user's own function.

    Attributes:
        mechanism: The machine; None where the dynamics have none.
        floating_base: Whether a tree of the machine begins with a free joint.
        actuated: (nv,) bool, the degrees of freedom that an actuator moves, directly or through a coupling.
        contacts: Whether bodies touch a ground or each other in the plan.
        stops: Whether joint limits push back in the plan.
        loops: Whether there are closed chains or polynomial couplings.
        friction_loss: Whether joints have dry friction.
        exact_hessian: Whether the step has second derivatives, for solve(hessian="exact").
    """

    mechanism: Mechanism | None = None
    floating_base: bool = False
    actuated: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=bool))
    contacts: bool = False
    stops: bool = False
    loops: bool = False
    friction_loss: bool = False
    exact_hessian: bool = False

    @property
    def unactuated(self) -> np.ndarray:
        """(nv,) bool, the degrees of freedom that no actuator moves."""
        return ~self.actuated

    @classmethod
    def of_mechanism(
        cls, mechanism: Mechanism, prescribed: np.ndarray | None = None, *, exact_hessian: bool = False
    ) -> Capabilities:
        """The facts of a mechanism; degrees of freedom that are `prescribed` (nv,) bool count as actuated."""
        actuated = np.any(_independent_directions(mechanism, actuated=True) != 0.0, axis=1)
        return cls(
            mechanism=mechanism,
            floating_base=any(dofs.stop - dofs.start == 6 for dofs in mechanism.joint_links),
            actuated=actuated if prescribed is None else actuated | prescribed,
            contacts=bool(mechanism.contacts or mechanism.body_contacts),
            stops=bool(mechanism.stops),
            loops=mechanism.has_closed_chains,
            friction_loss=bool(np.any(mechanism.friction_loss)),
            exact_hessian=exact_hessian,
        )


def unactuated_basis(mechanism: Mechanism) -> np.ndarray:
    """(nv, n) the directions that no actuator moves: one for each independent degree of freedom, with its followers."""
    return _independent_directions(mechanism, actuated=False)


def _independent_directions(mechanism: Mechanism, *, actuated: bool) -> np.ndarray:
    """(nv, n) the directions that couplings leave and that an actuator moves, or that none moves."""
    G = np.eye(mechanism.nv) if mechanism.reduction is None else mechanism.reduction.G
    return G[:, np.any(mechanism.actuators.moment @ G != 0.0, axis=0) == actuated]


def capabilities_of(dynamics: Any) -> Capabilities:
    """The capabilities of any dynamics; the defaults where they do not say."""
    return getattr(dynamics, "capabilities", None) or Capabilities()
