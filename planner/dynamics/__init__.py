"""What the solver sees of a machine: x(n+1) = f(x(n), u(n)) (Eq. 10) and its Jacobians A, B (Eq. 35)."""

from planner.dynamics.function import FunctionDynamics
from planner.dynamics.hopper import HopperDynamics
from planner.dynamics.protocol import INTEGRATORS, CompiledDynamics, Dynamics, PenalisedDynamics
from planner.dynamics.rigid_body import RigidBodyDynamics

__all__ = [
    "INTEGRATORS",
    "CompiledDynamics",
    "Dynamics",
    "FunctionDynamics",
    "HopperDynamics",
    "PenalisedDynamics",
    "RigidBodyDynamics",
]
