"""simulate: closed loop of a Controller, or of a plan's fixed gains, with MuJoCo's model and model errors.

The controller is called every `tick`, at 500 Hz or the closest frequency that divides the stages (as in a proof). The
control of a planning call acts after the latency, stated or measured; until then the last control is constant and the
controller is not called. Calls that do not plan act at once.

The simulator's step, integrator and errors are those of a proof (planner.proof.replays, planner.proof.robustness).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from planner.base.arguments import count, number, short_repr
from planner.base.errors import PlannerError
from planner.control.control_laws import FixedPlanController
from planner.control.controller import Controller
from planner.control.controller_states import Event
from planner.control.receding_horizon import RecedingHorizonProblem
from planner.problem.plan import Plan, Status
from planner.problem.problem import Problem
from planner.proof.replays.compiled_twin import CompiledTwin
from planner.proof.replays.contact_history import ContactRecorder
from planner.proof.replays.passive_torque_callback import curves_acting
from planner.proof.replays.replaying import PARTS, REFINEMENT, SUBSTEP_REFINEMENT, Replay
from planner.proof.replays.sampled_gains import Encoders, sampling_in
from planner.proof.replays.simulation import MAX_STEPS, damping_of, implicit_step
from planner.proof.replays.simulation import simulate as run_model
from planner.proof.robustness.perturbation import Mass, Push, pushed_step, with_stated_errors

Goal = Callable[[float], Any]
LATE, STAYS = 1.0, 1.0  # s after the task: allowed delay of arrival, and duration of the check that it stays


@dataclass(frozen=True, eq=False)
class ClosedLoopRun(Replay):
    """A replay of a closed loop: MuJoCo's trajectory and the record of the controller.

    Its `plan` has the states that the controller expected at each knot, and the mean applied controls per stage.

    Attributes:
        controller: The simulated Controller or FixedPlanController.
        errors: Arguments of simulate(), as JSON values.
        call_seconds: Wall time of each planning call, s.
        call_processor_seconds: Processor time of each, s.
        events: Events of the controller.
        goal: Goal as a function of time, or None.
        late: Largest latency that acted, s, in whole simulator steps.
    """

    controller: Any = None
    errors: dict[str, Any] = field(default_factory=dict)
    call_seconds: np.ndarray = field(default_factory=lambda: np.zeros(0))
    call_processor_seconds: np.ndarray = field(default_factory=lambda: np.zeros(0))
    events: tuple[Event, ...] = ()
    goal: Goal | None = None
    late: float = 0.0

    def __repr__(self) -> str:
        return f"Loop({self.t[-1]:.4g} s, {len(self.call_seconds)} plans)"

    @property
    def perturbed(self) -> bool:
        """Whether the run had pushes, errors of mass or friction, measurement noise or encoders."""
        asked = ("pushes", "mass", "friction", "contact_friction", "noise", "encoders")
        return any(bool(self.errors.get(name)) for name in asked)

    @property
    def pushes(self) -> tuple[Push, ...]:
        """The pushes of the run."""
        return tuple(Push(**one) for one in self.errors.get("pushes", ()))

    @property
    def title(self) -> str:
        """Title of its report section."""
        return "loop"


def duration_of_run(problem: Problem, duration: float | None = None) -> float:
    """The length of a run, s: as given, or by default that of the problem plus LATE and STAYS."""
    return problem.duration + LATE + STAYS if duration is None else number("duration", duration, greater_than=0.0)


def simulate(
    controller: Controller | Plan, *, duration: float | None = None, latency: float | None = None,
    pushes: Push | Sequence[Push] = (), mass: Mass = 0.0, friction: float = 0.0,
    contact_friction: float = 0.0, noise: float = 0.0, encoders: bool = False, goal: Goal | None = None,
    start: Any = None, seed: int = 0, compiled: CompiledTwin | None = None,
) -> ClosedLoopRun:  # fmt: skip
    """Run a controller in closed loop with the problem's MuJoCo model, with errors.

    Args:
        controller: A Controller, which is reset; or a Plan, whose feedback acts alone and regulates its goal after its
            end.
        duration: Length of the run, s, rounded up to whole stages; by default that of the problem plus 2 s.
        latency: Time from the start of a planning call until its control acts, s. None measures each call on this
            computer: results then differ between computers; with a number they are the same to the last bit. That of a
            threaded controller is its own, and the feedback of the last plan acts meanwhile.
        pushes: Forces on bodies.
        mass: Relative error of body masses and inertias: 0.2 for 20 % heavier; one for all bodies or a table by name.
        friction: Dry friction of each joint, as a share of its largest planned force.
        contact_friction: Relative error of the friction coefficients: -0.5 halves them.
        noise: Standard deviation of the measured state, in each coordinate's unit.
        encoders: Whether hinge and slide joints are read from 17-bit encoders, and velocities as their differences.
        goal: Function of time, s: its value becomes the controller's goal before each call.
        start: Another initial state (nx,). The controller plans from it before time 0.
        seed: Seed of the noise.
        compiled: The compiled Twin, to be reused for many runs.

    Returns:
        A ClosedLoopRun, which is a Replay.

    Raises:
        PlannerError: A body that does not exist, a number out of range, a problem without a MuJoCo model.
    """
    asked = FixedPlanController(controller) if isinstance(controller, Plan) else controller
    if not isinstance(asked, (Controller, FixedPlanController)):
        raise PlannerError(f"controller is {short_repr(controller)}, expected a planner.Controller or a Plan.")
    problem = asked.problem
    if problem.twin is None:
        raise PlannerError("the problem has no MuJoCo model to be simulated in, expected a Problem with a twin.")
    compiled = compiled or CompiledTwin(problem.twin)
    dt = problem.dynamics.dt
    duration = duration_of_run(problem, duration)
    latency = None if latency is None else number("latency", latency, minimum=0.0)
    if asked.threaded:
        if latency not in (None, asked.latency):
            raise PlannerError(
                f"latency is {latency:g} s and that of the threaded controller {asked.latency:g} s, expected the same."
            )
        latency = asked.latency
    seed = count("seed", seed, minimum=0)
    noise = number("noise", noise, minimum=0.0)
    pushes = (pushes,) if isinstance(pushes, Push) else pushes
    if not isinstance(pushes, Sequence) or not all(isinstance(push, Push) for push in pushes):
        raise PlannerError(f"pushes is {short_repr(pushes)}, expected a list of planner.Push.")
    if goal is not None and not callable(goal):
        raise PlannerError(f"goal is {short_repr(goal)}, expected a function of time, such as lambda t: goal.")
    stages, tick = max(math.ceil(duration / dt - 1e-9), 1), sampling_in(dt)
    n = _substeps(problem, compiled, tick.in_stages(dt).denominator)
    held, M = max(round(tick.in_stages(dt) * n), 1), stages * n
    if M > MAX_STEPS:
        raise PlannerError(f"the loop would take {M} steps of {dt / n:.3g} s, expected at most {MAX_STEPS}.")
    asked.reset(start)
    damping = damping_of(problem.dynamics)
    integrator = "RK4" if damping is None else "rosenbrock"
    compiled.check(asked.plan.us.shape[1])
    model = with_stated_errors(
        compiled, asked.plan, compiled.stepping(dt / n, integrator), mass, friction, contact_friction
    )
    base = None if damping is None else implicit_step(model, dt / n, damping, PARTS)
    step, recorder = pushed_step(model, pushes, base, stages * dt), ContactRecorder(model, M)
    x0 = problem.x0 if start is None else asked.plan.xs[0]
    asking = _Asking(asked, compiled, dt / n, held, latency, noise, seed, goal, tick.period if encoders else None)
    ctrl = np.zeros((M, model.nu))
    asked.simulated = True
    with curves_acting(compiled.twin, model), np.errstate(all="ignore"):  # a diverging run sets its warnings
        w, warnings = run_model(
            model, compiled.twin.sim_of(x0), ctrl, control=asking, held=held, recorder=recorder, every=n, step=step
        )
    t = dt / n * np.arange(M + 1)
    qpos, qvel, act = np.split(w, [model.nq, model.nq + model.nv], axis=1)
    us, expected = ctrl[:, compiled.controls], asking.expected(t)
    events = tuple(getattr(asked, "events", ()))
    errors = {
        "duration": stages * dt, "latency": latency, "pushes": [push.to_dict() for push in pushes],
        "mass": dict(mass) if isinstance(mass, Mapping) else mass, "friction": friction,
        "contact_friction": contact_friction, "noise": noise, "encoders": encoders, "seed": seed,
    }  # fmt: skip
    plan = _executed_plan(asked.plan, expected[::n], us.reshape(stages, n, -1).mean(axis=1))
    return ClosedLoopRun(
        plan=plan, compiled=compiled, feedback=True, integrator=integrator, t=t, qpos=qpos, qvel=qvel, act=act,
        ctrl=us, xs=compiled.twin.x_of(w), plan_xs=expected, contact_force=recorder.force,
        contact_point=recorder.point, substeps=n, warnings=warnings, contacts=recorder.history(t),
        contact_extremes=recorder.contact_extremes, controller=asked, errors=errors,
        call_seconds=np.array(asking.seconds), call_processor_seconds=np.array(asking.worked),
        events=events, goal=goal, late=asking.late,
    )  # fmt: skip


def _substeps(problem: Problem, compiled: CompiledTwin, parts: int) -> int:
    """Simulator steps per stage, as in a replay; a multiple of the ticks per stage, `parts`."""
    dt = problem.dynamics.dt
    step = number("the model's timestep", compiled.model.opt.timestep, greater_than=0.0)
    own = 1 if damping_of(problem.dynamics) is not None else int(getattr(problem.dynamics, "substeps", 1))
    n = max(REFINEMENT, SUBSTEP_REFINEMENT * own, math.ceil(min(dt / step, 1e12) - 1e-9))
    return n + -n % parts


class _Asking:
    """The control callback of the simulator: measurement errors, controller call and latency at each tick."""

    def __init__(
        self, asked: Controller | FixedPlanController, compiled: CompiledTwin, step: float, held: int,
        latency: float | None, noise: float, seed: int, goal: Goal | None, encoders: float | None,
    ) -> None:  # fmt: skip
        self._asked, self._compiled, self._step, self._held = asked, compiled, step, held
        self._latency, self._noise, self._goal = latency, noise, goal
        self._rng = np.random.default_rng(seed)
        self._encoders = None if encoders is None else Encoders(compiled.model, encoders)
        self._u = asked.plan.us[0]
        self._coming: tuple[int, np.ndarray] | None = None  # the step at which a control is ready, and the control
        self._times, self._expected = list[float](), list[np.ndarray]()
        self.seconds, self.worked, self.late = list[float](), list[float](), 0.0

    def __call__(self, i: int, w: np.ndarray) -> np.ndarray:
        """MuJoCo's controls (steps per tick, nu) from simulator step i on, at MuJoCo's state w (nw,)."""
        rows = np.empty((self._held, len(self._u)))
        if not np.isfinite(w).all():
            rows[:] = self._u
            return self._compiled.commands(rows)
        measured = w if self._encoders is None else self._encoders(w)  # at every tick: they have a state
        x = self._compiled.twin.x_of(measured)
        if self._noise:
            x = self._asked.plan.space.integrate(x, self._noise * self._rng.standard_normal(self._asked.plan.space.ndx))
        t = i * self._step
        if self._coming is not None and self._coming[0] <= i:
            self._u, self._coming = self._coming[1], None
        self._times.append(t)
        # What the controller expects before its call; at first the plan's start.
        self._expected.append(self._asked.expected(t) if self._expected else self._asked.plan.xs[0].copy())
        if self._coming is None:
            self._ask(i, t, x)
        rows[:] = self._u
        if self._coming is not None and self._coming[0] < i + self._held:
            rows[max(self._coming[0] - i, 0) :] = self._coming[1]
        return self._compiled.commands(rows)

    def _ask(self, i: int, t: float, x: np.ndarray) -> None:
        if self._goal is not None:
            self._asked.goal = self._goal(t)  # type: ignore[attr-defined]
        u = self._asked(t, x)
        if not self._asked.planned:
            self._u = u
            return
        self.seconds.append(self._asked.seconds)
        self.worked.append(self._asked.processor_seconds)
        if self._asked.threaded:
            self._u, self.late = u, max(self.late, self._asked.latency)
            return
        late = self._asked.seconds if self._latency is None else self._latency
        steps = math.ceil(late / self._step - 1e-9)
        self.late = max(self.late, steps * self._step)
        if steps == 0:
            self._u = u
        else:
            self._coming = i + steps, u

    def expected(self, t: np.ndarray) -> np.ndarray:
        """The states (M+1, nx) that the controller expected at times t (M+1,), s: linear between ticks."""
        times, values = np.array(self._times), np.array(self._expected)
        return np.column_stack([np.interp(t, times, column) for column in values.T])


def _executed_plan(plan: Plan, xs: np.ndarray, us: np.ndarray) -> Plan:
    """A plan with the run's states (N+1, nx) and controls (N, nu), status GIVEN, zero gains.

    Its problem is the task followed by regulation of the goal; the task's own where no problem of that length can be
    made.
    """
    problem, N = plan.problem, len(us)
    assert problem is not None
    longer = problem
    if N != problem.N:
        try:
            longer = replace(RecedingHorizonProblem(problem, N).problem, appearance=problem.appearance)
        except PlannerError:
            longer = problem
    K = np.zeros((*us.shape, plan.space.ndx))
    t = problem.dynamics.dt * np.arange(N + 1)
    return Plan(
        t, xs, us, K, 0.0, 0.0, Status.GIVEN, (), longer, None, plan.twin, options={"loop": True},
    )  # fmt: skip
