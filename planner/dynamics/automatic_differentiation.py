"""Functions written for JAX or CasADi as NumPy functions of many states, with exact Jacobians.

Both return (f, jacobian) as FunctionDynamics takes them: of x (..., nx) and u (..., nu), f is (..., nx) and jacobian is
(..., nx, nx) and (..., nx, nu). Their packages are extras, imported here alone.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from importlib import import_module
from typing import Any

import numpy as np

from planner.base.arguments import short_repr
from planner.base.errors import PlannerError

Arrays = Callable[[np.ndarray, np.ndarray], Any]
_SIZES_KEPT = 64  # of batches, each with a function of its own


def jax_functions(f: Callable[[Any, Any], Any], nx: int, nu: int) -> tuple[Arrays, Arrays]:
    """Of a JAX function of one state, x (nx,) and u (nu,)."""
    jax = _package("jax")
    if not callable(f):
        raise PlannerError(f"f is {short_repr(f)}, expected a function f(x, u) written with jax.numpy.")
    if not jax.config.jax_enable_x64:
        raise PlannerError(
            "JAX computes with 32 bits, expected 64: write jax.config.update('jax_enable_x64', True) after import jax."
        )

    def rates(x: Any, u: Any) -> Any:
        return jax.numpy.asarray(f(x, u))

    try:
        found = jax.eval_shape(rates, np.zeros(nx), np.zeros(nu))
    except jax.errors.JAXTypeError:
        raise PlannerError(
            "f cannot be traced by JAX, expected jax.numpy in place of numpy, and jax.numpy.where in place of if."
        ) from None
    if found.shape != (nx,):
        raise PlannerError(f"f(x, u) has shape {found.shape}, expected ({nx},): JAX takes f of one state, x ({nx},).")
    many = jax.jit(jax.vmap(rates))
    slopes = jax.jit(jax.vmap(jax.jacfwd(rates, argnums=(0, 1))))

    def values(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        return np.asarray(many(x.reshape(-1, nx), u.reshape(-1, nu))).reshape(x.shape)

    def jacobian(x: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        fx, fu = slopes(x.reshape(-1, nx), u.reshape(-1, nu))
        return np.asarray(fx).reshape(*x.shape, nx), np.asarray(fu).reshape(*x.shape, nu)

    return values, jacobian


def casadi_functions(F: Any) -> tuple[Arrays, Arrays, int, int]:
    """Of a casadi.Function F(x, u), and nx and nu."""
    casadi = _package("casadi")
    if not isinstance(F, casadi.Function):
        raise PlannerError(f"F is {short_repr(F)}, expected a casadi.Function('f', [x, u], [rates]).")
    if (F.n_in(), F.n_out()) != (2, 1):
        raise PlannerError(
            f"F has {F.n_in()} inputs and {F.n_out()} outputs, expected the inputs x and u and the output dx/dt."
        )
    shapes, nx, nu = (F.size_in(0), F.size_in(1), F.size_out(0)), F.size1_in(0), F.size1_in(1)
    if shapes != ((nx, 1), (nu, 1), (nx, 1)):
        raise PlannerError(f"F has x, u and dx/dt of the shapes {shapes}, expected columns: (nx, 1), (nu, 1), (nx, 1).")
    x, u = casadi.MX.sym("x", nx), casadi.MX.sym("u", nu)
    slopes = casadi.Function("slopes", [x, u], [casadi.jacobian(F(x, u), x), casadi.jacobian(F(x, u), u)])

    @lru_cache(_SIZES_KEPT)
    def mapped(K: int, differentiated: bool) -> Any:
        return (slopes if differentiated else F).map(K)

    def rows(x: np.ndarray, u: np.ndarray, differentiated: bool) -> list[np.ndarray]:
        """Each output by state: the map has them beside each other, (nx, K n)."""
        K = x.size // nx
        found = mapped(K, differentiated)(x.reshape(K, nx).T, u.reshape(K, nu).T)
        parts = found if isinstance(found, (list, tuple)) else [found]
        return [part.full().reshape(nx, K, -1).swapaxes(0, 1) for part in parts]

    def values(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        return rows(x, u, False)[0].reshape(x.shape)

    def jacobian(x: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        fx, fu = rows(x, u, True)
        return fx.reshape(*x.shape, nx), fu.reshape(*x.shape, nu)

    return values, jacobian, nx, nu


def _package(name: str) -> Any:
    try:
        return import_module(name)
    except ImportError:
        raise PlannerError(
            f"{name} is not installed, expected it for FunctionDynamics.from_{name}: pip install slq-planner[{name}]."
        ) from None
