"""Plan: what solve() returns and what plan.npz holds.

Everywhere, files included, the control of a plan is

    u = us[n] + K[n] @ (x - xs[n]),     held over stage n.

plan.npz is read with numpy alone: arrays t (N+1,), xs (N+1, nx), us (N, nu), K (N, nu, nx), history (one row
per iteration, columns as in Iteration) and meta, one JSON string. No pickle.
"""

from __future__ import annotations

import functools
import json
import math
import platform
import zipfile
import zlib
from dataclasses import dataclass, field, replace
from enum import StrEnum
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from planner.errors import FileError, PlannerError
from planner.files import write_atomically
from planner.twin import Twin

if TYPE_CHECKING:
    from planner.problem import Problem

FORMAT_VERSION = 1


class Status(StrEnum):
    """How a solve ended. The value is a sentence; for everything but CONVERGED it says what to do next."""

    CONVERGED = "The gradient or the predicted decrease fell below its tolerance."
    MAX_ITERATIONS = "The iteration limit was reached; raise max_iterations, or start from this plan's controls."
    NO_DESCENT = (
        "No step length lowered the cost, even strongly regularised; check the derivatives, "
        "smooth the dynamics or start from another guess."
    )
    NOT_FINITE = (
        "The first guess rolls out to infinite or undefined states; start from a smaller control or a shorter stage."
    )
    INTERRUPTED = "Interrupted; this is the best plan so far, and a new solve can start from its controls."


class Iteration(NamedTuple):
    """One line of the iteration table. Costs and gradients are those before the step.

    Attributes:
        iteration: Counted from 0.
        cost: J of Eq. 9.
        gradient_norm: Euclidean norm of the gradient of J with respect to all controls (Eq. 19).
        step: Step length taken (Eq. 36); 0 when none was (converged, or regularisation was raised).
        expected: Decrease that the LQ model promised for that step.
        actual: Decrease that came.
        regularisation: What was added to the diagonal of R + B'PB.
    """

    iteration: int
    cost: float
    gradient_norm: float
    step: float
    expected: float
    actual: float
    regularisation: float

    def __str__(self) -> str:
        return (
            f"{self.iteration:5d}  {self.cost:15.8g}  {self.gradient_norm:9.2e}  {self.step:9.3g}  "
            f"{self.expected:9.2e}  {self.actual:9.2e}  {self.regularisation:9.2e}"
        )

    @staticmethod
    def header() -> str:
        """The heading over the lines that str() makes."""
        return f"{'iter':>5}  {'cost':>15}  {'|grad|':>9}  {'step':>9}  {'expected':>9}  {'actual':>9}  {'regular.':>9}"


@dataclass(frozen=True, eq=False)
class Plan:
    """An optimized motion with the gains that hold it.

    Attributes:
        t: (N+1,) s, the knots.
        xs: (N+1, nx) states.
        us: (N, nu) controls, each held over its stage.
        K: (N, nu, nx) gains of the last Riccati sweep.
        cost: J of Eq. 9.
        gradient_norm: Norm of Eq. 19 at the plan: check optimality from the file.
        status: How the solve ended.
        history: One Iteration per iteration; the last line is the plan itself.
        problem: What was solved; None for a file whose problem is a user's own Python.
        case: Name of the case in planner.cases, or None.
        parameters: Every argument of the case by name.
        twin: The MuJoCo model it is replayed in, or None.
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
    case: str | None = None
    parameters: dict[str, Any] = field(default_factory=dict)
    twin: Twin | None = None
    made_with: dict[str, str] | None = None

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
    def success(self) -> bool:
        """Whether the solve converged (as in SciPy)."""
        return self.status is Status.CONVERGED

    @property
    def message(self) -> str:
        """The status in a sentence (as in SciPy)."""
        return self.status.value

    @property
    def versions(self) -> dict[str, str]:
        """Versions of the software that made the plan."""
        return installed_versions() if self.made_with is None else self.made_with

    def __str__(self) -> str:
        name = f"{self.case}: " if self.case else ""
        return f"Plan({self.status.name}: {name}{self.nit} iterations, cost {self.cost:.6g}, N = {self.N})"

    __repr__ = __str__

    def save(self, path: str | Path) -> Path:
        """Write the plan as .npz, atomically and without pickle.

        Raises:
            FileError: The file cannot be written.
        """
        path = plan_name(path)
        meta = {
            "format_version": FORMAT_VERSION,
            "case": self.case,
            "parameters": self.parameters,
            "status": self.status.name,
            "cost": _json_number(self.cost),
            "gradient_norm": _json_number(self.gradient_norm),
            "iterations": self.nit,
            "versions": self.versions,
            "twin": None if self.twin is None else self.twin.to_dict(),
            "mjcf": None if self.twin is None else self.twin.mjcf,
        }
        history = np.array(self.history, dtype=float).reshape(-1, len(Iteration._fields))
        text = np.array(json.dumps(meta, allow_nan=False))
        with write_atomically(path) as unfinished, open(unfinished, "wb") as file:
            np.savez(file, t=self.t, xs=self.xs, us=self.us, K=self.K, history=history, meta=text)
        return path

    @classmethod
    def load(cls, path: str | Path) -> Plan:
        """Read a plan.npz. The problem is rebuilt when it is one of planner.cases.

        Raises:
            FileError: No such file, not a plan, damaged, or written by a newer version.
        """
        arrays, meta = _read(Path(path))
        t, xs, us, K, history = (arrays[name] for name in ("t", "xs", "us", "K", "history"))
        twin = meta["twin"]
        plan = cls(
            t, xs, us, K,
            cost=math.nan if meta["cost"] is None else float(meta["cost"]),
            gradient_norm=math.nan if meta["gradient_norm"] is None else float(meta["gradient_norm"]),
            status=Status[meta["status"]],
            history=tuple(Iteration(int(row[0]), *map(float, row[1:])) for row in history),
            case=meta["case"], parameters=meta["parameters"],
            twin=None if twin is None else Twin(mjcf=meta["mjcf"], **twin),
            made_with=meta["versions"],
        )  # fmt: skip
        if plan.case is None:
            return plan
        from planner import cases  # a case builds on everything above it; only a file's name leads back here

        try:
            problem = cases.build(plan.case, **plan.parameters)
        except PlannerError as error:
            raise FileError(f"{path} holds a plan of a case that cannot be rebuilt: {error}") from None
        if xs.shape[1:] != (problem.dynamics.nx,) or us.shape != (problem.N, problem.dynamics.nu):
            raise FileError(f"{path} is damaged: its arrays do not fit its case {plan.case!r}.")
        return replace(plan, problem=problem)


def plan_name(path: str | Path) -> Path:
    """A name that a plan can be saved under.

    Raises:
        FileError: It does not end in .npz.
    """
    if Path(path).suffix != ".npz":
        raise FileError(f"cannot save a plan as {path}: expected a name ending in .npz.")
    return Path(path)


def _json_number(value: float) -> float | None:
    """JSON has no NaN and no infinity: null."""
    return float(value) if math.isfinite(value) else None


def _read(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Arrays and meta of a plan file, checked against each other."""
    if not path.is_file():
        raise FileError(f"{path} is not a file, expected a plan.npz.")
    foreign = FileError(f"{path} is not a plan: expected an .npz with t, xs, us, K, history and meta.")
    try:
        # Our own handle: np.load leaks its file when the archive is broken.
        with open(path, "rb") as handle, np.load(handle, allow_pickle=False) as file:
            arrays = {name: np.asarray(file[name]) for name in ("t", "xs", "us", "K", "history", "meta")}
    except OSError as error:
        if error.errno is not None:
            raise FileError(f"cannot read {path}: {error.strerror}.") from None
        raise foreign from None
    except (ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error, NotImplementedError, TypeError):
        raise foreign from None
    try:
        meta = json.loads(str(arrays.pop("meta")))
        version = int(meta["format_version"])
    except (ValueError, KeyError, TypeError):
        raise foreign from None
    if version > FORMAT_VERSION:
        made = meta.get("versions", {}).get("planner", "a newer version")
        raise FileError(
            f"{path} has format {version}, written by planner {made}; this planner reads up to {FORMAT_VERSION}."
        )
    N, nx, nu = len(arrays["us"]), arrays["xs"].shape[-1], arrays["us"].shape[-1]
    shapes = {
        "t": (N + 1,), "xs": (N + 1, nx), "us": (N, nu), "K": (N, nu, nx),
        "history": (len(arrays["history"]), len(Iteration._fields)),
    }  # fmt: skip
    for name, shape in shapes.items():
        if arrays[name].shape != shape or arrays[name].dtype != np.float64:
            raise FileError(
                f"{path} is damaged: {name} is {arrays[name].dtype} {arrays[name].shape}, expected float64 {shape}."
            )
    expected = {
        "case": (str, type(None)), "parameters": dict, "status": str, "cost": (int, float, type(None)),
        "gradient_norm": (int, float, type(None)), "versions": dict, "twin": (dict, type(None)),
        "mjcf": (str, type(None)),
    }  # fmt: skip
    for name, kind in expected.items():
        if name not in meta or not isinstance(meta[name], kind):
            raise FileError(f"{path} is damaged: its meta has no usable {name!r}.")
    if meta["status"] not in Status.__members__:
        raise FileError(f"{path} is damaged: {meta['status']!r} is no status.")
    return arrays, meta


@functools.cache
def installed_versions() -> dict[str, str]:
    """Versions of this package and of what its numbers depend on."""
    names = {
        "planner": "slq-planner",
        "mujoco": "mujoco",
        "numpy": "numpy",
        "numba": "numba",
        "scipy": "scipy",
    }
    versions = {"python": platform.python_version()}
    for name, distribution in names.items():
        try:
            versions[name] = metadata.version(distribution)
        except metadata.PackageNotFoundError:
            versions[name] = "not installed"
    return versions
