"""FunctionDynamics: a user's own dx/dt = f(x, u) in plain Python, or written for JAX or CasADi, with exact Jacobians.

Functions of both have values and jacobian as FunctionDynamics takes f and its jacobian: of x (..., nx) and u (..., nu),
these are (..., nx), and (..., nx, nx) and (..., nx, nu). They can be pickled where f can be; what is compiled is made
anew in each process. Their packages are extras, imported here alone.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property, lru_cache
from importlib import import_module
from typing import Any

import numpy as np

from planner.base.arguments import array, choice, count, number, numbers, short_repr
from planner.base.errors import PlannerError
from planner.kernels.integrators import INTEGRATORS

Function = Callable[[np.ndarray, np.ndarray], np.ndarray]
Jacobian = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]

# Step of central differences: the error eps/h + h^2 is minimal near the cube root of the machine epsilon.
_DIFFERENCE = float(np.cbrt(np.finfo(float).eps))
# Step of differences of these, whose error is eps^(2/3): minimizes eps^(2/3)/h + h^2.
_SECOND_DIFFERENCE = _DIFFERENCE ** (2.0 / 3.0)


class FunctionDynamics:
    """Discrete dynamics from a plain Python function.

    The function may take one state, x (nx,) and u (nu,), or a batch, x (K, nx) and u (K, nu), which is much faster; a
    trial call determines which, of `jacobian` too. from_jax() and from_casadi() take functions of these packages.

    Args:
        f: dx/dt = f(x, u), or x(n+1) = f(x, u) with integrator="discrete".
        nx: Size of the state.
        nu: Size of the control.
        dt: Length of a stage, s.
        integrator: "euler", "semi-implicit-euler" (x is positions, then as many velocities), "rk4", "discrete".
        jacobian: (x, u) -> (df/dx (nx, nx), df/du (nx, nu)), of one state or a batch, whatever f is: (K, nx, nx) and
            (K, nx, nu); central differences by default.
        coordinates: (nx,) name and unit of each state component, e.g. ("height", "m"), for reports and tolerances.

    Raises:
        PlannerError: A wrong argument, or an f or jacobian that does not return numbers of the right shape.
    """

    def __init__(
        self,
        f: Function,
        nx: int,
        nu: int,
        dt: float,
        integrator: str = "rk4",
        jacobian: Jacobian | None = None,
        coordinates: Sequence[tuple[str, str]] | None = None,
    ) -> None:
        if not callable(f):
            raise PlannerError(f"f is {f!r}, expected a function f(x, u).")
        self.nx, self.nu = count("nx", nx), count("nu", nu)
        self.dt = number("dt", dt, greater_than=0.0)
        self.integrator = choice("integrator", integrator, (*INTEGRATORS, "discrete"))
        if self.integrator == "semi-implicit-euler" and self.nx % 2:
            raise PlannerError(
                f"nx is {nx}, expected an even number for semi-implicit-euler: positions, then velocities."
            )
        self._f, self._jacobian = f, jacobian
        self.coordinates = None if coordinates is None else tuple((str(name), str(unit)) for name, unit in coordinates)
        if self.coordinates is not None and len(self.coordinates) != self.nx:
            raise PlannerError(f"coordinates has {len(self.coordinates)} entries, expected nx = {self.nx}.")
        self.batched = self._try_out()
        self._jacobian_batched = jacobian is not None and self._takes_batch(jacobian)

    @classmethod
    def from_jax(
        cls, f: Callable[[Any, Any], Any], nx: int, nu: int, dt: float, integrator: str = "rk4",
        coordinates: Sequence[tuple[str, str]] | None = None,
    ) -> FunctionDynamics:  # fmt: skip
        """Dynamics from a function of one state that is written with jax.numpy; Jacobians are exact.

        JAX has to compute with 64 bits, jax.config.update("jax_enable_x64", True), which holds for all of JAX in the
        process. Processes import f: it is to be a function of a module that switches them on, too.

        Args:
            f: dx/dt = f(x, u) of x (nx,) and u (nu,); it is compiled, and taken to many states by jax.vmap.
            nx: Size of the state.
            nu: Size of the control.
            dt: Length of a stage, s.
            integrator: As of FunctionDynamics.
            coordinates: As of FunctionDynamics.

        Raises:
            PlannerError: JAX is not installed or computes with 32 bits, it cannot trace f, f is of other numbers than
                float64, or an argument is wrong.
        """
        rates = JaxRates(f, count("nx", nx), count("nu", nu))
        return cls(rates.values, nx, nu, dt, integrator, rates.jacobian, coordinates)

    @classmethod
    def from_casadi(
        cls, F: Any, dt: float, integrator: str = "rk4", coordinates: Sequence[tuple[str, str]] | None = None
    ) -> FunctionDynamics:
        """Dynamics from a casadi.Function; Jacobians are exact. They can be sent to processes.

        Args:
            F: dx/dt = F(x, u) of columns x (nx, 1) and u (nu, 1); it is taken to many states by its map().
            dt: Length of a stage, s.
            integrator: As of FunctionDynamics.
            coordinates: As of FunctionDynamics.

        Raises:
            PlannerError: CasADi is not installed, or an argument is wrong.
        """
        rates = CasadiRates(F)
        return cls(rates.values, rates.nx, rates.nu, dt, integrator, rates.jacobian, coordinates)

    def __repr__(self) -> str:
        return f"{type(self).__name__}(nx {self.nx}, nu {self.nu}, {self.integrator}, dt {self.dt:g})"

    def _trial_states(self) -> tuple[np.ndarray, np.ndarray]:
        """Three different states: a function of one state cannot return the batched values by coincidence."""
        rng = np.random.default_rng(0)
        return rng.normal(size=(3, self.nx)) * 0.1, rng.normal(size=(3, self.nu)) * 0.1

    def _try_out(self) -> bool:
        xs, us = self._trial_states()
        values = [self._f(x.copy(), u.copy()) for x, u in zip(xs, us, strict=True)]
        single = [array("f(x, u)", value, (self.nx,), any_value=True) for value in values]
        try:
            many = np.asarray(self._f(xs.copy(), us.copy()), dtype=float)
        except Exception:  # a function of one state may raise anything on a batch
            return False
        return many.shape == xs.shape and np.allclose(many, single, rtol=1e-12, atol=1e-12, equal_nan=True)

    def _takes_batch(self, jacobian: Jacobian) -> bool:
        """Whether a jacobian is of a batch; one of neither a batch nor one state is refused, or its error raised."""
        xs, us = self._trial_states()
        many, wrong = None, None
        try:
            many = self._pair(jacobian(xs.copy(), us.copy()), (len(xs),), any_value=True)
        except Exception as error:  # as of f
            wrong = error
        try:
            rows = [self._pair(jacobian(x.copy(), u.copy()), any_value=True) for x, u in zip(xs, us, strict=True)]
        except Exception as error:
            if many is not None:
                return True
            raise (
                wrong if isinstance(wrong, PlannerError) and not isinstance(error, PlannerError) else error
            ) from None
        single = zip(*rows, strict=True)
        return many is not None and all(
            np.allclose(part, one, rtol=1e-9, atol=1e-12, equal_nan=True)
            for part, one in zip(many, single, strict=True)
        )

    def _pair(self, pair: Any, K: tuple[int, ...] = (), any_value: bool = False) -> tuple[np.ndarray, np.ndarray]:
        """df/dx (*K, nx, nx) and df/du (*K, nx, nu); one that is the same for all states may be given once."""
        try:
            fx, fu = pair
        except (TypeError, ValueError):
            raise PlannerError(f"jacobian returns {short_repr(pair)}, expected (df/dx, df/du).") from None
        parts = []
        for name, part, size in (("jacobian's df/dx", fx, self.nx), ("jacobian's df/du", fu, self.nu)):
            given, shape = numbers(name, part), (*K, self.nx, size)
            given = np.broadcast_to(given, shape) if given.shape == shape[len(K) :] else given
            parts.append(array(name, given, shape, any_value=any_value))
        return parts[0], parts[1]

    @property
    def has_own_jacobian(self) -> bool:
        """Whether its derivatives are the user's, not central differences."""
        return self._jacobian is not None

    def with_step(self, dt: float, integrator: str) -> FunctionDynamics:
        """The same dynamics with another length of a stage, s, and integrator.

        Raises:
            PlannerError: The function is a discrete map, which cannot be integrated over another stage.
        """
        if self.integrator == "discrete":
            raise PlannerError("the dynamics are a discrete map, expected rates f(x, u): they fit any stage.")
        return FunctionDynamics(self._f, self.nx, self.nu, dt, integrator, self._jacobian, self.coordinates)

    def _rates(self, xs: np.ndarray, us: np.ndarray) -> np.ndarray:
        if self.batched:
            return np.asarray(self._f(xs, us), dtype=float)
        return np.array([self._f(x, u) for x, u in zip(xs, us, strict=True)], dtype=float)

    def _rate_jacobians(self, xs: np.ndarray, us: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        nx, nu = self.nx, self.nu
        if self._jacobian is not None:
            if self._jacobian_batched:
                return self._pair(self._jacobian(xs, us), (len(xs),))
            pairs = [self._pair(self._jacobian(x, u)) for x, u in zip(xs, us, strict=True)]
            return np.array([fx for fx, _ in pairs]), np.array([fu for _, fu in pairs])
        z = np.concatenate([xs, us], axis=1)
        h = _DIFFERENCE * np.maximum(1.0, np.abs(z))
        perturbed = z[:, None, :] + h[:, None, :] * np.concatenate([np.eye(nx + nu), -np.eye(nx + nu)])
        flat = perturbed.reshape(-1, nx + nu)
        values = self._rates(flat[:, :nx], flat[:, nx:]).reshape(len(xs), 2, nx + nu, nx)
        J = np.swapaxes((values[:, 0] - values[:, 1]) / (2.0 * h[:, :, None]), 1, 2)
        return J[:, :, :nx], J[:, :, nx:]

    def step(self, xs: np.ndarray, us: np.ndarray, dt: np.ndarray | None = None) -> np.ndarray:
        """The states (K, nx) after one stage from xs (K, nx) with us (K, nu); see Dynamics.step."""
        if self.integrator == "discrete":
            if dt is not None and not np.allclose(dt, self.dt):
                raise PlannerError("a discrete map has no parts of a stage: dt must be the stage's.")
            return self._rates(xs, us)
        h = np.full((len(xs), 1), self.dt) if dt is None else np.asarray(dt, dtype=float)[:, None]
        k1 = self._rates(xs, us)
        if self.integrator == "euler":
            return xs + h * k1
        if self.integrator == "semi-implicit-euler":
            half = self.nx // 2
            velocities = xs[:, half:] + h * k1[:, half:]
            return np.concatenate([xs[:, :half] + h * velocities, velocities], axis=1)
        k2 = self._rates(xs + 0.5 * h * k1, us)
        k3 = self._rates(xs + 0.5 * h * k2, us)
        k4 = self._rates(xs + h * k3, us)
        return xs + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)

    def linearize(self, xs: np.ndarray, us: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """A (N, nx, nx) and B (N, nx, nu) along xs (N+1, nx), us (N, nu), by the chain rule through the integrator."""
        x, h, nx = xs[: len(us)], self.dt, self.nx
        fx, fu = self._rate_jacobians(x, us)
        if self.integrator == "discrete":
            return fx, fu
        eye = np.eye(nx)
        if self.integrator == "euler":
            return eye + h * fx, h * fu
        if self.integrator == "semi-implicit-euler":
            half = nx // 2
            A, B = eye + h * fx, h * fu
            A[:, :half], B[:, :half] = eye[:half] + h * A[:, half:], h * B[:, half:]
            return A, B
        # d k_i / d(x, u): each RK stage's Jacobian times the derivative of its argument.
        k1 = self._rates(x, us)
        K1x, K1u = fx, fu
        k2, K2x, K2u = self._stage(x, us, k1, K1x, K1u, 0.5 * h)
        k3, K3x, K3u = self._stage(x, us, k2, K2x, K2u, 0.5 * h)
        _, K4x, K4u = self._stage(x, us, k3, K3x, K3u, h)
        A = eye + h / 6.0 * (K1x + 2.0 * K2x + 2.0 * K3x + K4x)
        return A, h / 6.0 * (K1u + 2.0 * K2u + 2.0 * K3u + K4u)

    def second_order(self, xs: np.ndarray, us: np.ndarray, costates: np.ndarray) -> np.ndarray:
        """T (N, nx+nu, nx+nu) = sum_k costate_k d2 f_k / dz2, z = (x, u), by central differences of the Jacobians.

        Accurate to about ten digits with a user's `jacobian`, to about four without (differences of differences).
        """
        N, nx, nz = len(us), self.nx, self.nx + self.nu
        z, l = np.concatenate([xs[:N], us], axis=1), np.asarray(costates)[1:, :, None]
        step = _DIFFERENCE if self._jacobian is not None else _SECOND_DIFFERENCE
        h = step * np.maximum(1.0, np.abs(z))
        T = np.empty((N, nz, nz))
        for j in range(nz):
            gradients = []
            for sign in (1.0, -1.0):
                perturbed = z.copy()
                perturbed[:, j] += sign * h[:, j]
                A, B = self.linearize(perturbed[:, :nx], perturbed[:, nx:])
                gradients.append(np.sum(l * np.concatenate([A, B], axis=2), axis=1))
            T[:, j] = (gradients[0] - gradients[1]) / (2.0 * h[:, j : j + 1])
        return 0.5 * (T + T.swapaxes(1, 2))

    def _stage(
        self, x: np.ndarray, us: np.ndarray, k: np.ndarray, Kx: np.ndarray, Ku: np.ndarray, h: float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        y = x + h * k
        fx, fu = self._rate_jacobians(y, us)
        return self._rates(y, us), fx @ (np.eye(self.nx) + h * Kx), fx @ (h * Ku) + fu


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
