"""Step 2 of a proof: MuJoCo with the plan's own integrator and step. Proves the transcription, nothing else.

MuJoCo has the semi-implicit Euler method, and Runge-Kutta's, which is of second order where orientations are
quaternions; a plan's is Munthe-Kaas's of fourth order. If MuJoCo does not have the plan's integrator, that integrator
is applied here to MuJoCo's accelerations, mj_forward at each of its stages.

The same is done where joints are prescribed: their motors have a relative acceleration error of some 1e-7
(model.mjcf.prescribed_joints), which is no transcription error; it is corrected here by a second request. And where
joints are coupled or loops closed: MuJoCo's equalities are soft, so here its accelerations are those of its own M and
forces with exact equalities.

A plan's stage of several substeps is as many steps here. The method that takes damping implicitly is that of
replays.simulation.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from planner.base.gl import load_mujoco
from planner.base.measured import Measurement, Section
from planner.dynamics.protocol import integrator_of
from planner.kernels.integrators import (
    KNOWN_INTEGRATORS,
    LEAPFROG,
    ROSENBROCK,
    RUNGE_KUTTA,
    SEMI_IMPLICIT_EULER,
    Integrator,
)
from planner.model.capabilities import capabilities_of
from planner.model.mechanism import Mechanism
from planner.model.mjcf.prescribed_joints import prescribed_dofs_of
from planner.model.space import StateSpace
from planner.model.twin import Twin
from planner.problem.plan import Plan
from planner.problem.problem import Problem
from planner.proof.compare.constrained import constrained_acceleration, steps_back
from planner.proof.error_scales import reaches_stops
from planner.proof.replays.compiled_twin import CompiledTwin
from planner.proof.replays.passive_torque_callback import curves_acting
from planner.proof.replays.simulation import implicit_step, set_state, stage_damping, state_of

PATH_BOUND = 1e-8  # of the largest state
STAGE_BOUND = 1e-10  # of the largest state: one stage does not amplify errors, rounding is 1e-14
_ROUNDING = 10.0 * np.finfo(float).eps  # of one stage, relative to the largest state

_LIMIT = "MuJoCo's contacts and stops tend to the plan's law but are not the same to rounding"
_FRICTION = "MuJoCo's friction loss tends to the plan's, which bends where MuJoCo's is cut off at once"
ACCELERATIONS = "MuJoCo's accelerations"

Stage = Callable[[np.ndarray, np.ndarray], np.ndarray]
Rates = Callable[[np.ndarray, np.ndarray], np.ndarray]
Integrate = Callable[[np.ndarray, np.ndarray], np.ndarray]  # (x (nx,), dx (ndx,)) -> x (+) dx (nx,)
Advance = Callable[[np.ndarray, np.ndarray, int], Iterator[np.ndarray]]


def same_step(plan: Plan, problem: Problem, compiled: CompiledTwin) -> Section:
    """MuJoCo's states at the plan's own step, along the path and stage by stage, against the plan's."""
    if problem.requirements is not None and problem.requirements.no_same_step:
        return Section("same step", not_applicable=problem.requirements.no_same_step)
    machine = capabilities_of(problem.dynamics)
    if machine.contacts or (machine.mechanism is not None and reaches_stops(machine.mechanism, plan.xs)):
        return Section("same step", not_applicable=_LIMIT)
    if machine.friction_loss:
        return Section("same step", not_applicable=_FRICTION)
    compiled.check(problem.dynamics.nu)
    space, twin, model = plan.space, compiled.twin, compiled.copy()
    # Stops and clamps that the plan lacks are not transcribed. The refined replays and the user's file judge them:
    # a plan satisfies its limits at the ends of stages, and a servo's force may exceed its limit a little in between.
    flags = load_mujoco().mjtDisableBit
    model.opt.disableflags |= flags.mjDSBL_LIMIT | flags.mjDSBL_CLAMPCTRL
    model.actuator_forcelimited[:] = 0
    model.jnt_actfrclimited[:] = 0
    integrator = getattr(problem.dynamics, "integrator", "")
    substeps = getattr(problem.dynamics, "substeps", 1)
    chains = machine.mechanism if machine.loops else None
    closes = integrator_of(problem.dynamics).form == RUNGE_KUTTA
    constrained = chains or (
        machine.mechanism if machine.mechanism is not None and machine.mechanism.couplings else None
    )
    dt, driven = problem.dynamics.dt / substeps, prescribed_dofs_of(problem.dynamics)
    damping = stage_damping(problem.dynamics)
    found = stage_function(integrator, dt, model, twin, space, driven, constrained, damping)
    if found is None:
        return Section("same step", not_applicable="MuJoCo cannot take steps of the plan's integrator")
    how, one = found
    data = load_mujoco().MjData(model)

    def stage(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        for _ in range(substeps):
            x = one(x, u)
        if chains is not None and closes:  # a plan's stages end on the loop closures
            set_state(model, data, twin.sim_of(x))
            steps_back(model, data, chains, driven)
            x = twin.x_of(state_of(data))
        return x

    path = np.empty_like(plan.xs)
    path[0] = problem.x0
    with curves_acting(twin, model):
        for n, u in enumerate(plan.us):
            path[n + 1] = stage(path[n], u)
        ends = np.array([stage(x, u) for x, u in zip(plan.xs[:-1], plan.us, strict=True)])
    largest = max(1.0, float(np.abs(plan.xs).max()))
    errors = [float(np.abs(space.difference(xs, plan.xs[-len(xs) :])).max()) / largest for xs in (path, ends)]
    amplification = rounding_amplification(problem.dynamics.linearize(plan.xs, plan.us)[0])
    bound = max(PATH_BOUND, _ROUNDING * amplification)
    note = f"{how} at the plan's step, largest component over the path, relative to the largest state"
    if bound > PATH_BOUND:
        note += f"; the bound is what rounding becomes, since this path amplifies it {amplification:.1e} times"
    along = Measurement("state_error", errors[0], "", bound, note)
    alone = Measurement("stage_error", errors[1], "", STAGE_BOUND, "the same, each stage begun at the plan's own knot")
    return Section("same step", (along, alone))


def rounding_amplification(A: np.ndarray) -> float:
    """Largest amplification of independent unit errors that every state has after each stage A (N, ndx, ndx)."""
    covariance, largest = np.zeros(A.shape[1:]), 1.0
    for step in A:
        covariance = step @ covariance @ step.T + np.eye(len(step))
        largest = max(largest, float(np.sqrt(covariance.diagonal().max())))
    return largest


def stage_function(
    integrator: str, dt: float, model: Any, twin: Twin, space: StateSpace, driven: Sequence[int] | np.ndarray = (),
    constrained: Mechanism | None = None, damping: np.ndarray | None = None, exact: bool = True,
) -> tuple[str, Stage] | None:  # fmt: skip
    """One stage of dt in MuJoCo: the method's name, and the function (x, u) -> x at its end; None if unsupported.

    The model is changed. Accelerations of prescribed (`driven`) degrees of freedom, the last controls, are met to
    rounding. Equalities of a constrained mechanism are exact, and its other constraints do not act. `damping` (nv,) is
    what stage_damping says. `exact` as of advancing().
    """
    mujoco = load_mujoco()
    data = mujoco.MjData(model)
    model.opt.timestep = dt
    # A plan's Euler method evaluates damping at the stage's start like every other force.
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_EULERDAMP

    def begin(x: np.ndarray, u: np.ndarray) -> None:
        set_state(model, data, twin.sim_of(x))
        data.ctrl[:] = u
        if len(driven):
            mujoco.mj_forward(model, data)
            data.ctrl[-len(driven) :] += u[-len(driven) :] - acceleration()[driven]

    def acceleration() -> np.ndarray:
        return data.qacc if constrained is None else constrained_acceleration(model, data, constrained)

    def step(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        begin(x, u)
        mujoco.mj_step(model, data)
        return twin.x_of(state_of(data))

    def rates(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        begin(x, u)
        mujoco.mj_forward(model, data)
        w = np.concatenate([data.qvel, acceleration(), data.act_dot])
        return w if space.quaternions else twin.to_x @ w

    def on_group(x: np.ndarray, dx: np.ndarray) -> np.ndarray:  # space.integrate in C, ten times faster
        moved = np.empty_like(x)
        moved[: model.nq] = x[: model.nq]
        moved[model.nq :] = x[model.nq :] + dx[model.nv :]
        mujoco.mj_integratePos(model, moved[: model.nq], dx[: model.nv], 1.0)
        return moved

    integrate = on_group if space.quaternions else space.integrate

    def velocity_first(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        dx = dt * rates(x, u)
        dx[: model.nv] += dt * dx[model.nv : 2 * model.nv]
        return integrate(x, dx)

    def middle_first(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        half = 0.5 * dt * rates(x, u)
        half[model.nv : 2 * model.nv] = 0.0
        dx = dt * rates(integrate(x, half), u)
        dx[: model.nv] += 0.5 * dt * dx[model.nv : 2 * model.nv]
        return integrate(x, dx)

    known = KNOWN_INTEGRATORS.get(integrator)
    if known is None:
        return None
    native = known.mujoco if constrained is None else ""
    if (native == "RK4" and space.quaternions and exact) or (native != "EULER" and len(driven)):
        native = ""
    if native == "IMPLICITFAST" and floats_alone(model):
        native = ""
    if damping is not None and known.form != ROSENBROCK and not native:  # MuJoCo's step is of a heavier machine
        delay = 0.5 * dt if known.form == LEAPFROG else dt
        model.dof_armature[:] += delay * damping
        model.dof_M0[:] += delay * damping
    if known.form == ROSENBROCK and damping is not None and not len(driven):
        own = None if constrained is None else functools.partial(constrained_acceleration, mechanism=constrained)
        move = implicit_step(model, dt, damping, acceleration=own)

        def implicit(x: np.ndarray, u: np.ndarray) -> np.ndarray:
            begin(x, u)
            move(data)
            return twin.x_of(state_of(data))

        return ACCELERATIONS, implicit
    if native:
        model.opt.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{native}")
        return f"MuJoCo's {native}", step
    if known.form == ROSENBROCK:
        return None
    if known.form == SEMI_IMPLICIT_EULER:
        return ACCELERATIONS, velocity_first
    if known.form == LEAPFROG:
        return ACCELERATIONS, middle_first
    return ACCELERATIONS, lambda x, u: munthe_kaas(rates, space, x, u, dt, integrate, known)


def floats_alone(model: Any) -> bool:
    """Whether a body with a free joint carries no other joint: MuJoCo takes its gyroscopic forces implicitly, too."""
    free = model.jnt_type == load_mujoco().mjtJoint.mjJNT_FREE
    trees = model.dof_treeid[model.jnt_dofadr[free]]
    return bool(np.any(np.bincount(model.dof_treeid)[trees] == 6))


def advancing(
    integrator: str, step: float, model: Any, twin: Twin, space: StateSpace, damping: np.ndarray | None = None,
    exact: bool = True,
) -> Advance | None:  # fmt: skip
    """Many steps in MuJoCo: the function (x0, us, steps per control) -> the state after each control, or None.

    MuJoCo's own integrators run without reset: the simulator may have more states than the plan. Without `exact` they
    are also taken where they are of lower order than the plan's, on rotations.
    """
    found = stage_function(integrator, step, model, twin, space, damping=damping, exact=exact)
    if found is None:
        return None
    mujoco, (how, stage) = load_mujoco(), found

    def own(x: np.ndarray, us: np.ndarray, steps: int) -> Iterator[np.ndarray]:
        for u in us:
            for _ in range(steps):
                x = stage(x, u)
            yield x

    def native(x: np.ndarray, us: np.ndarray, steps: int) -> Iterator[np.ndarray]:
        data = mujoco.MjData(model)
        set_state(model, data, twin.sim_of(x))
        for u in us:
            data.ctrl[:] = u
            mujoco.mj_step(model, data, steps)
            yield twin.x_of(state_of(data))

    return own if how == ACCELERATIONS else native


def munthe_kaas(
    rates: Rates, space: StateSpace, x: np.ndarray, u: np.ndarray, dt: float, integrate: Integrate | None = None,
    method: Integrator = KNOWN_INTEGRATORS["rk4"],
) -> np.ndarray:  # fmt: skip
    """One stage of an explicit Runge-Kutta method, in Munthe-Kaas's form where states hold quaternions.

    Rotation vectors do not add: the increments of a quaternion are corrected by the cross products of the body's
    rotation increments, so that RK4 is of fourth order on rotations too. `integrate` is the space's by default.
    """
    integrate = integrate or space.integrate

    def product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        result = np.zeros_like(a)
        for _, j in space.quaternions:
            (ax, ay, az), (bx, by, bz) = a[j : j + 3].tolist(), b[j : j + 3].tolist()  # cross() is slower
            result[j : j + 3] = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        return result

    ks = [dt * rates(x, u)]
    for length in method.lengths:
        moved = length * ks[-1] + (method.turned[0] * product(ks[0], ks[1]) if len(ks) == 2 else 0.0)
        ks.append(dt * rates(integrate(x, moved), u))
    return integrate(x, np.array(method.weights) @ ks + method.turned[1] * product(ks[0], ks[-1]))
