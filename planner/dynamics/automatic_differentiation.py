"""Functions written for JAX or CasADi as NumPy functions of many states, with exact Jacobians.

Both have values and jacobian as FunctionDynamics takes f and its jacobian: of x (..., nx) and u (..., nu), these are
(..., nx), and (..., nx, nx) and (..., nx, nu). They can be pickled where f can be; what is compiled is made anew in
each process. Their packages are extras, imported here alone.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property, lru_cache
from importlib import import_module
from typing import Any

import numpy as np

from planner.base.arguments import short_repr
from planner.base.errors import PlannerError

_SIZES_KEPT = 64  # of batches, each with a function of its own


class JaxRates:
    """A JAX function of one state, x (nx,) and u (nu,)."""

    def __init__(self, f: Callable[[Any, Any], Any], nx: int, nu: int) -> None:
        jax = _jax_of_64_bits()
        if not callable(f):
            raise PlannerError(f"f is {short_repr(f)}, expected a function f(x, u) written with jax.numpy.")
        self.f, self.nx, self.nu = f, nx, nu
        try:
            found = jax.eval_shape(self._rates, np.zeros(nx), np.zeros(nu))
        except jax.errors.JAXTypeError:
            raise PlannerError(
                "f cannot be traced by JAX, expected jax.numpy in place of numpy, and jax.numpy.where in place of if."
            ) from None
        if found.shape != (nx,):
            raise PlannerError(
                f"f(x, u) has shape {found.shape}, expected ({nx},): JAX takes f of one state, x ({nx},)."
            )
        if found.dtype != np.float64:
            raise PlannerError(f"f(x, u) is of {found.dtype}, expected float64: convert nothing in f to other types.")

    def __getstate__(self) -> dict[str, Any]:
        return {"f": self.f, "nx": self.nx, "nu": self.nu}

    def _rates(self, x: Any, u: Any) -> Any:
        return _package("jax").numpy.asarray(self.f(x, u))

    @cached_property
    def _compiled(self) -> tuple[Callable[..., Any], Callable[..., Any]]:
        """Of many states, f and its Jacobians."""
        jax = _jax_of_64_bits()
        return jax.jit(jax.vmap(self._rates)), jax.jit(jax.vmap(jax.jacfwd(self._rates, argnums=(0, 1))))

    def values(self, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        """dx/dt (..., nx)."""
        return np.asarray(self._compiled[0](x.reshape(-1, self.nx), u.reshape(-1, self.nu))).reshape(x.shape)

    def jacobian(self, x: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Its Jacobians, (..., nx, nx) and (..., nx, nu)."""
        fx, fu = self._compiled[1](x.reshape(-1, self.nx), u.reshape(-1, self.nu))
        return np.asarray(fx).reshape(*x.shape, self.nx), np.asarray(fu).reshape(*x.shape, self.nu)


class CasadiRates:
    """A casadi.Function F(x, u) of columns x (nx, 1) and u (nu, 1)."""

    def __init__(self, F: Any) -> None:
        casadi = _package("casadi")
        if not isinstance(F, casadi.Function):
            raise PlannerError(f"F is {short_repr(F)}, expected a casadi.Function('f', [x, u], [rates]).")
        if (F.n_in(), F.n_out()) != (2, 1):
            raise PlannerError(
                f"F has {F.n_in()} inputs and {F.n_out()} outputs, expected the inputs x and u and the output dx/dt."
            )
        shapes, nx, nu = (F.size_in(0), F.size_in(1), F.size_out(0)), F.size1_in(0), F.size1_in(1)
        if shapes != ((nx, 1), (nu, 1), (nx, 1)):
            raise PlannerError(
                f"F has x, u and dx/dt of the shapes {shapes}, expected columns: (nx, 1), (nu, 1), (nx, 1)."
            )
        self.F, self.nx, self.nu = F, nx, nu

    def __getstate__(self) -> dict[str, Any]:
        return {"F": self.F, "nx": self.nx, "nu": self.nu}

    @cached_property
    def _mapped(self) -> Callable[[int, bool], Any]:
        """Of a number of states, F or its Jacobians of so many."""
        casadi, F = _package("casadi"), self.F
        x, u = casadi.MX.sym("x", self.nx), casadi.MX.sym("u", self.nu)
        slopes = casadi.Function("slopes", [x, u], [casadi.jacobian(F(x, u), x), casadi.jacobian(F(x, u), u)])

        @lru_cache(_SIZES_KEPT)
        def mapped(K: int, differentiated: bool) -> Any:
            return (slopes if differentiated else F).map(K)

        return mapped

    def _rows(self, x: np.ndarray, u: np.ndarray, differentiated: bool) -> list[np.ndarray]:
        """Each output by state: the map has them beside each other, (nx, K n)."""
        K = x.size // self.nx
        found = self._mapped(K, differentiated)(x.reshape(K, self.nx).T, u.reshape(K, self.nu).T)
        parts = found if isinstance(found, (list, tuple)) else [found]
        return [part.full().reshape(self.nx, K, -1).swapaxes(0, 1) for part in parts]

    def values(self, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        """dx/dt (..., nx)."""
        return self._rows(x, u, False)[0].reshape(x.shape)

    def jacobian(self, x: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Its Jacobians, (..., nx, nx) and (..., nx, nu)."""
        fx, fu = self._rows(x, u, True)
        return fx.reshape(*x.shape, self.nx), fu.reshape(*x.shape, self.nu)


def _jax_of_64_bits() -> Any:
    jax = _package("jax")
    if not jax.config.jax_enable_x64:
        raise PlannerError(
            "JAX computes with 32 bits, expected 64: write jax.config.update('jax_enable_x64', True) after import jax "
            "in the file that defines f. It holds for all of JAX in this process."
        )
    return jax


def _package(name: str) -> Any:
    try:
        return import_module(name)
    except ImportError:
        raise PlannerError(
            f"{name} is not installed, expected it for FunctionDynamics.from_{name}: pip install slq-planner[{name}]."
        ) from None
