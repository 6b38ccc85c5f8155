"""TrackingCost: the paper's quadratic cost, weights by names of joints, and checks of states and machines."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from planner.base.arguments import LONGEST_HORIZON, array, choice, count, number, numbers, short_repr
from planner.base.errors import PlannerError
from planner.model.capabilities import capabilities_of
from planner.model.coordinates import Coordinate
from planner.model.mechanism import Mechanism
from planner.model.space import StateSpace, euclidean, origin_of
from planner.problem.costs.terms import Cost, GoalSpec, Quadratic, Term, per_stage

_ROUNDING = 1e-20  # of the largest weight: what is left of none after the steps of a Riccati equation
_RANK_TOLERANCE = 1e-9  # of a weight relative to the diagonal of its components


def matrices(name: str, value: Any, stages: int, size: int) -> np.ndarray:
    """(stages, size, size) from a number, a diagonal (size,), a matrix, or one of these per stage."""
    given = numbers(name, value)
    if given.ndim == 0:
        given = np.full(size, given)
    if given.ndim == 1:
        given = np.diag(array(name, given, (size,)))
    if given.ndim == 2 and given.shape == (stages, size) and stages != size:
        given = np.einsum("ni,ij->nij", given, np.eye(size))
    if given.ndim == 2:
        given = np.broadcast_to(given, (stages, *given.shape))
    return array(name, given, (stages, size, size))


class NoTracking:
    """A TrackingCost of weight zero."""

    def __init__(self, N: int, space: StateSpace, nu: int) -> None:
        self.Q, self.R = np.zeros((N + 1, space.ndx, space.ndx)), np.zeros((N, nu, nu))
        self.x_ref, self.u_ref = np.tile(origin_of(space), (N + 1, 1)), np.zeros((N, nu))


def one_each(name: str, value: Any, size: int) -> np.ndarray:
    """(size,) from a number or an array."""
    given = numbers(name, value)
    return array(name, np.full(size, given) if given.ndim == 0 else given, (size,))


def diagonal(name: str, value: Any, size: int, kind: str, places: Mapping[str, slice]) -> np.ndarray:
    """(size,) from a number, an array (size,), or a dict of these by the names of `places`, the others zero.

    Messages use `name` for the weight and `kind`, e.g. "joint", for its keys.
    """
    if not isinstance(value, Mapping):
        weights = one_each(name, value, size)
    else:
        weights = np.zeros(size)
        for key, part in value.items():
            if not places:
                raise PlannerError(f"{name} names the {kind} {key!r}, but no {kind} has a name: expected a number.")
            place = places[choice(f"the {kind} in {name}", key, places)]
            label = f"{name}[{key!r}]"
            weights[place] = diagonal(label, numbers(label, part), place.stop - place.start, kind, places)
    if weights.min(initial=0.0) < 0.0:
        raise PlannerError(f"{name} has the weight {weights.min():g}, expected weights of at least 0.")
    return weights


def places(
    mechanism: Mechanism, prescribed: tuple[str, ...]
) -> tuple[dict[str, slice], dict[str, slice], dict[str, slice]]:
    """Slices of named weights: joints in (nv,), actuators and prescribed joints in (nu,), actuators in (na,)."""
    joints = {name: s for name, s in zip(mechanism.joint_names, mechanism.joint_links, strict=True) if name}
    names = mechanism.actuators.names
    inputs = {name: slice(i, i + 1) for i, name in enumerate(names) if name}
    at = len(names)
    for name in sorted(prescribed, key=lambda name: joints[name].start):  # in the order of qvel
        inputs[name] = slice(at, at + joints[name].stop - joints[name].start)
        at = inputs[name].stop
    indices = mechanism.actuators.activation.tolist()
    activations = {name: slice(i, i + 1) for name, i in zip(names, indices, strict=True) if name and i >= 0}
    return joints, inputs, activations


def _distinct(weights: np.ndarray) -> np.ndarray:
    """The matrices (stages, size, size) that differ from that of the stage before: checks of them are dear."""
    return weights[np.append(True, (weights[1:] != weights[:-1]).any(axis=(1, 2)))]


class TrackingCost(Term):
    """The paper's quadratic cost (Eq. 11, 12): 1/2 |x - x_ref|^2_Q + 1/2 |u - u_ref|^2_R, summed over the stages.

    Weights are per stage; to approximate an integral they must include the factor dt. With quaternions the difference
    is that of the space, x (-) x_ref, with a Gauss-Newton Hessian.

    Args:
        Q: (N+1, ndx, ndx) state weights, symmetric positive semidefinite; the last is the final one.
        R: (N, nu, nu) control weights, symmetric positive definite.
        x_ref: (N+1, nx), (nx,) or a number. Quaternions are normalized.
        u_ref: (N, nu), (nu,) or a number.
        space: Of the states; plain vectors by default.

    Raises:
        PlannerError: A wrong shape, or a weight that is not symmetric or not (semi)definite.
    """

    def __init__(self, Q: Any, R: Any, x_ref: Any = 0.0, u_ref: Any = 0.0, space: StateSpace | None = None) -> None:
        self.Q, self.R = array("Q", Q, ("N+1", "ndx", "ndx")), array("R", R, ("N", "nu", "nu"))
        self.N, self.nu = count("N, the number of stages in R", len(self.R)), self.R.shape[1]
        self.space = euclidean(self.Q.shape[1]) if space is None else _space(space)
        self.nx, self.ndx = self.space.nx, self.space.ndx
        array("Q", self.Q, (self.N + 1, self.ndx, self.ndx))
        array("R", self.R, (self.N, self.nu, self.nu))
        self.x_ref = states("x_ref", _references("x_ref", x_ref, self.N + 1, self.nx), self.space)
        self.u_ref = _references("u_ref", u_ref, self.N, self.nu)
        of_states, of_controls = _distinct(self.Q), _distinct(self.R)
        for name, weight in (("Q", of_states), ("R", of_controls)):
            if not np.allclose(weight, np.swapaxes(weight, 1, 2), rtol=1e-12, atol=0.0):
                raise PlannerError(f"{name} is not symmetric, expected symmetric weights.")
        smallest = np.linalg.eigvalsh(of_controls).min()
        if smallest <= 0.0:
            raise PlannerError(f"R has the eigenvalue {smallest:.3g}, expected positive definite control weights.")
        largest = np.abs(of_states).max()
        if np.linalg.eigvalsh(of_states).min() < -1e-10 * largest:
            raise PlannerError("Q has a negative eigenvalue, expected positive semidefinite state weights.")
        for fixed in (self.Q, self.R, self.x_ref, self.u_ref):  # solves keep copies of their own
            fixed.flags.writeable = False

    def __repr__(self) -> str:
        return f"{type(self).__name__}(N = {self.N})"

    @classmethod
    def reach(
        cls, goal: Any, horizon: int, *, final: Any, effort: Any, running: Any = 0.0, dt: float = 1.0,
        nu: int | None = None, space: StateSpace | None = None,
    ) -> TrackingCost:  # fmt: skip
        """A cost for reaching a goal state at the end, with quadratic control effort.

        Args:
            goal: (nx,) the state to reach.
            horizon: N, number of stages.
            final: Weight at the end: a number, a diagonal (ndx,) or a matrix (ndx, ndx).
            effort: Weight of the control: a number, a diagonal (nu,) or a matrix (nu, nu).
            running: Running weight of the difference to the goal; a number, (ndx,) or (ndx, ndx), or per stage.
            dt: s; the running and effort weights are multiplied by it.
            nu: Size of the control; needed when effort is a number and nu is not 1.
            space: Of the states; plain vectors by default.
        """
        N = count("horizon", horizon, maximum=LONGEST_HORIZON)
        x_ref = array("goal", goal, ("nx",) if space is None else (_space(space).nx,))
        number("dt", dt, greater_than=0.0)
        ndx = len(x_ref) if space is None else space.ndx
        size = (numbers("effort", effort).shape or (1,))[0] if nu is None else count("nu", nu)
        Q = dt * matrices("running", running, N + 1, ndx)
        Q[N] = matrices("final", final, 1, ndx)[0]
        return cls(Q, dt * matrices("effort", effort, N, size), x_ref, 0.0, space)

    @classmethod
    def joints(
        cls, machine: Any, goal: Any, horizon: int, *, effort: Any, final_position: Any = 0.0,
        final_velocity: Any = 0.0, final_activation: Any = 0.0, position: Any = 0.0, velocity: Any = 0.0,
        activation: Any = 0.0, reference: Any = None, control: Any = 0.0, dt: float | None = None,
    ) -> TrackingCost:  # fmt: skip
        """A cost for reaching a state or tracking a reference, with weights by the names of joints.

        Every weight is a number, an array, or a dict by name: {"elbow": 3.0} for joints, the names of actuators for
        effort (of joints, where they are prescribed) and activations. A joint with several degrees of freedom takes a
        number or one for each; names that are missing have weight 0. All but the final ones are multiplied by dt.

        Args:
            machine: RigidBodyDynamics or a Mechanism.
            goal: The state (nx,) at the end, or the name of a keyframe; None for the end of the reference.
            horizon: N, number of stages.
            effort: Weight of the controls, or (nu,); every control needs one.
            final_position: Weight of joint positions at the end, or (nv,), per m^2 or rad^2.
            final_velocity: Weight of joint velocities at the end, or (nv,).
            final_activation: Weight of activations at the end, or (na,).
            position: Running weight of joint positions, per second.
            velocity: Running weight of joint velocities.
            activation: Running weight of activations.
            reference: (N+1, nx) reference states of the running weights; the goal by default.
            control: (nu,) or (N, nu) reference of the controls; zero by default.
            dt: s; that of the dynamics by default.

        Raises:
            PlannerError: A name that the machine does not have, a wrong shape, or a weight out of range.
        """
        mechanism, dt = mechanism_and_step(machine, dt)
        N, nu = count("horizon", horizon, maximum=LONGEST_HORIZON), int(machine.nu)
        if goal is None and reference is None:
            raise PlannerError("goal is None and there is no reference, expected one of the two.")
        space = mechanism.space
        if isinstance(goal, str):
            goal = mechanism.keyframe(goal)
        if reference is None:
            x_ref = np.tile(states("goal", goal, space, ()), (N + 1, 1))
        else:
            x_ref = states("reference", reference, space, (N + 1,))
            x_ref[N] = x_ref[N] if goal is None else states("goal", goal, space, ())
        joints, inputs, activations = places(mechanism, getattr(machine, "prescribed", ()))

        def weights(prefix: str, p: Any, v: Any, a: Any) -> np.ndarray:
            of_q = diagonal(f"{prefix}position", p, mechanism.nv, "joint", joints)
            of_v = diagonal(f"{prefix}velocity", v, mechanism.nv, "joint", joints)
            of_a = diagonal(f"{prefix}activation", a, mechanism.na, "actuator", activations)
            return np.concatenate([of_q, of_v, of_a])

        R = diagonal("effort", effort, nu, "control", inputs)
        if R.min(initial=np.inf) <= 0.0:
            cheapest = int(R.argmin())
            names = [repr(name) for name, place in inputs.items() if place.start <= cheapest < place.stop]
            raise PlannerError(
                f"effort of control {' '.join([str(cheapest), *names])} is 0, expected a weight above 0."
            )
        Q = np.tile(np.diag(dt * weights("", position, velocity, activation)), (N + 1, 1, 1))
        Q[N] = np.diag(weights("final_", final_position, final_velocity, final_activation))
        u_ref = _references("control", control, N, nu)
        return cls(Q, np.tile(np.diag(dt * R), (N, 1, 1)), x_ref, u_ref, space)

    def resampled(self, parts: int, ratio: float) -> TrackingCost:
        """The same cost over stages divided into parts, with running weights multiplied by ratio."""
        Q = np.concatenate([np.repeat(ratio * self.Q[:-1], parts, axis=0), self.Q[-1:]])
        R = np.repeat(ratio * self.R, parts, axis=0)
        return self._of_own_kind(Q, R, per_stage(self.x_ref, parts), np.repeat(self.u_ref, parts, axis=0))

    def with_effort(self, weight: float) -> TrackingCost:
        """The same with the weights of the controls multiplied."""
        return self._of_own_kind(self.Q, weight * self.R, self.x_ref, self.u_ref)

    def augmented(self, own: StateSpace, space: StateSpace, weights: np.ndarray | float = 0.0) -> Cost:
        """A TrackingCost on states with appended components, so that limits still find its reference.

        Its weights are added to `weights` (N+1, ndx, ndx).
        """
        if type(self) is not TrackingCost:
            return super().augmented(own, space)
        further = space.nx - own.nx
        Q = np.zeros((self.N + 1, space.ndx, space.ndx)) + weights
        Q[:, : own.ndx, : own.ndx] += self.Q
        return TrackingCost(Q, self.R, np.pad(self.x_ref, ((0, 0), (0, further))), self.u_ref, space)

    def with_goal(self, goal: np.ndarray) -> TrackingCost:
        """The same with another reference (nx,) at the end."""
        return self._of_own_kind(self.Q, self.R, np.concatenate([self.x_ref[:-1], [goal]]), self.u_ref)

    def _of_own_kind(self, Q: np.ndarray, R: np.ndarray, x_ref: np.ndarray, u_ref: np.ndarray) -> TrackingCost:
        if type(self) is not TrackingCost:  # a subclass may compute another value from other arguments
            raise PlannerError(
                f"the cost is of the type {type(self).__name__}, expected a TrackingCost, or a class with its own "
                "resampled(parts, ratio) and with_effort(weight)."
            )
        return TrackingCost(Q, R, x_ref, u_ref, self.space)

    def goal_specs(self, coordinates: Sequence[Coordinate]) -> tuple[GoalSpec, ...]:
        """The reference at the end, in every component that the final weight acts on, or combination of components.

        A final weight of less than full rank asks for combinations alone: 1 on (a + b)^2 for the sum of two angles.
        """
        sizes = np.abs(self.Q[-1]).max(axis=0)
        weighed = np.flatnonzero(sizes > _ROUNDING * sizes.max(initial=0.0))
        rows = _independent_rows(self.Q[-1][np.ix_(weighed, weighed)])
        found = []
        for row in rows:
            parts = {int(weighed[k]): float(row[k]) for k in np.flatnonzero(row)}
            names = [f"{'' if share == 1.0 else f'{share:.3g} '}{coordinates[i].name}" for i, share in parts.items()]
            units = {coordinates[i].unit for i in parts}
            unit = units.pop() if len(units) == 1 else ""
            found.append(GoalSpec(" + ".join(names), unit, partial(self._missed, parts)))
        return tuple(found)

    def _missed(self, parts: dict[int, float], xs: np.ndarray) -> np.ndarray:
        e = self.space.difference(xs, self.x_ref[-1])
        return np.abs(sum(share * e[..., i] for i, share in parts.items()))

    def final_cost(self, x: np.ndarray) -> float:
        """The final cost at the end state x (nx,)."""
        e = self.space.difference(x, self.x_ref[-1])
        return 0.5 * float(e @ self.Q[-1] @ e)

    def value(self, xs: np.ndarray, us: np.ndarray) -> float:
        """J of a trajectory xs (N+1, nx), us (N, nu)."""
        ex, eu = self.space.difference(xs, self.x_ref), us - self.u_ref
        state = np.einsum("ni,nij,nj->", ex, self.Q, ex)
        return 0.5 * float(state + np.einsum("ni,nij,nj->", eu, self.R, eu))

    def quadratize(self, xs: np.ndarray, us: np.ndarray) -> Quadratic:
        """The weights themselves, and q = Q (x - x_ref), r = R (u - u_ref).

        With quaternions q = J'Q dx and the Hessian J'Q J (Gauss-Newton), J the derivative of dx = x (-) x_ref.
        """
        ex = self.space.difference(xs, self.x_ref)
        Q, q = self.Q, np.einsum("nij,nj->ni", self.Q, ex)
        if self.space.quaternions:
            J = self.space.difference_jacobian(ex)
            Jt = np.swapaxes(J, 1, 2)
            Q, q = Jt @ Q @ J, np.einsum("nij,nj->ni", Jt, q)
        return Quadratic(Q, q, self.R, np.einsum("nij,nj->ni", self.R, us - self.u_ref))


def _independent_rows(Q: np.ndarray) -> np.ndarray:
    """(r, n) rows that span the row space of a weight (n, n) in reduced echelon form: the identity for full rank."""
    scale = np.sqrt(np.maximum(np.diag(Q), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(Q / np.outer(scale, scale))
    significant = np.abs(values) > _RANK_TOLERANCE * max(1.0, float(np.abs(values).max(initial=0.0)))
    if np.all(significant):
        return np.eye(len(Q))
    rows, first = vectors[:, significant].T * scale, 0
    for column in range(len(Q)):
        if first == len(rows):
            break
        best = first + int(np.argmax(np.abs(rows[first:, column])))
        if abs(rows[best, column]) <= _RANK_TOLERANCE * np.abs(rows).max():
            continue
        rows[[first, best]] = rows[[best, first]]
        rows[first] /= rows[first, column]
        others = np.arange(len(rows)) != first
        rows[others] -= np.outer(rows[others, column], rows[first])
        first += 1
    return np.where(np.abs(rows) > _RANK_TOLERANCE, np.round(rows, 12), 0.0)


def tracking_of(cost: Any) -> TrackingCost | None:
    """The one TrackingCost with a final weight in a cost or a sum; None for none or several."""
    terms = [term for term in getattr(cost, "costs", (cost,)) if isinstance(term, TrackingCost)]
    if len(terms) > 1:
        terms = [term for term in terms if np.any(term.Q[-1])]
    return terms[0] if len(terms) == 1 else None


def states(name: str, value: Any, space: StateSpace, leading: tuple[int | str, ...] = ("N+1",)) -> np.ndarray:
    """Checked states (*leading, nx): finite, with quaternions normalized."""
    x = array(name, value, (*leading, space.nx))
    for i, _ in space.quaternions:
        length = np.linalg.norm(x[..., i : i + 4], axis=-1, keepdims=True)
        if length.min() < 1e-12:
            raise PlannerError(f"{name} has a quaternion of length zero at {i} to {i + 3}, expected e.g. 1, 0, 0, 0.")
        x[..., i : i + 4] /= length
    return x


def mechanism_and_step(machine: Any, dt: float | None) -> tuple[Mechanism, float]:
    """The mechanism and the length of a stage of RigidBodyDynamics, or of a Mechanism with dt."""
    mechanism = machine if isinstance(machine, Mechanism) else capabilities_of(machine).mechanism
    if mechanism is None:
        raise PlannerError(f"the machine is {short_repr(machine)}, expected RigidBodyDynamics or a Mechanism.")
    dt = getattr(machine, "dt", None) if dt is None else dt
    if dt is None:
        raise PlannerError("dt is None, expected the length of a stage in s, since a Mechanism has none.")
    return mechanism, number("dt", dt, greater_than=0.0)


def _space(value: Any) -> StateSpace:
    if not isinstance(value, StateSpace):
        raise PlannerError(f"space is {short_repr(value)}, expected a StateSpace, e.g. dynamics.space.")
    return value


def _references(name: str, value: Any, stages: int, size: int) -> np.ndarray:
    given = numbers(name, value)
    if given.ndim == 1:
        given = array(name, given, (size,))
    if given.ndim <= 1:
        given = np.broadcast_to(given, (stages, size))
    return array(name, given, (stages, size))
