"""A plan depends on its problem alone: the same bits again, after other solves, in threads; solves leave no trace."""

import multiprocessing
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cache, partial

import numpy as np
import pytest
from arms import mechanism as hanging_arm
from carts import cart
from closed_chains import four_bar
from contact_machines import leg, standing
from driven import moved_cart
from machines import FRICTION_ARM, gantry
from solves import Plain, each_engine, engines, hopper, swing

import planner
from planner import Constraint, Limits, Mechanism, Problem, RigidBodyDynamics, TrackingCost, solve, solve_for
from planner.constraints import Avoid
from planner.costs import FrameCost, Height, Point
from planner.dynamics.second_thread import Trials
from planner.solvers import multistart
from planner.solvers.engine import CompiledEngine, _idle, acquire_engine, compiled, release_engine

BOTH = {"velocity": 2.0, "control": 20.0}
"""Ranges with an open side, that of the start, and bounds of the controls."""

NOT_SPOILED = compiled._READ_ONLY | {"implicit", "behind", "method"}
"""Arrays that solves only read (of the dynamics, the integrator's numbers), and two that are zero between steps."""


# Problems


def arm(constraints=(), N=40, integrator="rk4", **limits):
    problem = planner.cases.two_link(horizon=N, integrator=integrator)
    return replace(problem, limits=Limits(**limits) if limits else None, constraints=constraints)


def moved(mechanism, x0, by, N=30, dt=0.02, own=False, constraints=(), **limits):
    """A machine some way on from its start, at rest; with `own` half of the cost is one that kernels do not know."""
    dynamics = RigidBodyDynamics(mechanism, dt)
    goal = mechanism.space.integrate(x0, np.r_[by, np.zeros(mechanism.space.ndx - len(by))])
    goal[mechanism.nq :] = 0.0
    cost = TrackingCost.joints(dynamics, goal, N, effort=0.01, position=0.1, final_position=1e3, final_velocity=10.0)
    limits = Limits(**limits) if limits else None
    cost = cost + Plain(cost) if own else cost
    return Problem(dynamics, cost, x0, horizon=N, limits=limits, constraints=constraints)


def reaching(**limits):
    """The hand of an arm to a place, by a cost of terms that kernels know."""
    machine, x0 = hanging_arm(), np.array([0.5, -1.0, 0.0, 0.0])
    dynamics = RigidBodyDynamics(machine, 0.02)
    reach = FrameCost(machine, "hand", position=(0.3, 0.0, -0.2), final_position_weight=1e3, dt=0.02)
    cost = TrackingCost.joints(dynamics, x0, 40, effort=1e-2, velocity=0.1) + reach
    return Problem(dynamics, cost, x0, limits=Limits(**limits))


def beside_a_wall(**limits):
    machine = Mechanism.from_mjcf(gantry(), contacts="avoid")
    apart = Avoid(clearance=0.02).constraint(machine, "left", "right").constraint
    over = moved(machine, machine.keyframe("left"), [1.0, 0.0], dt=0.05, constraints=[apart], **limits)
    return replace(over, us=np.column_stack([np.zeros(30), 4.0 * np.cos(np.linspace(0.0, np.pi, 30))]))


def on_a_foot(**limits):
    machine = Mechanism.from_mjcf(leg())
    return moved(machine, standing(machine), [0.1], dt=0.01, **limits)


def closing(**limits):
    machine = four_bar()
    start = planner.dynamics.assembly.assembled(machine, machine.home)
    return moved(machine, start, [0.3], **limits)


def running_away():
    """A servo too fast for its stages: what a first guess leads to is no number."""
    text = """<mujoco><worldbody><body><joint name="slide" type="slide"/><geom size=".1" mass="1"/></body></worldbody>
      <actuator><general joint="slide" gainprm="1" biastype="affine" biasprm="0 400 0"/></actuator></mujoco>"""
    return moved(Mechanism.from_mjcf(text), np.array([1e-3, 0.0]), [0.0], N=150)


def of(make, how=solve, **options):
    """What solves one problem again and again."""
    return lambda: partial(how, make(), **options)


def again(**limits):
    """From a plan of the same problem, which has multipliers."""
    problem = arm(**limits)
    return partial(solve, problem, warm_start=solve(problem).shifted(0.1))


HIGH = Constraint(Height(Point("forearm"), upper=0.5, tolerance=1e-3))  # of terms that kernels know
SUM = Constraint(lambda xs: xs[:, 0] + xs[:, 1], upper=1.5, name="sum")  # a function of its maker's
BENT = np.array([0.5, -1.0, 0.0, 0.0])

KINDS = {
    "hopper": of(hopper),
    "hopper by the paper's update": of(hopper, update="open-loop", line_search="wolfe"),
    "own dynamics": of(swing),
    "own dynamics, exact": of(swing, hessian="exact"),
    "arm": of(arm),
    "arm, exact": of(arm, hessian="exact"),
    "bounds": of(partial(arm, control=10.0), max_iterations=40),
    "bounds, from a line": of(partial(arm, control=10.0), states="line"),
    "bounds in NumPy": of(lambda: replace(swing(N=10), limits=Limits(control=8.0)), max_iterations=8),
    "goal and bounds in NumPy": of(lambda: replace(swing(N=10), limits=Limits(control=40.0, final=[0]))),
    "ranges": of(partial(arm, velocity=2.0)),
    "ranges and bounds": of(partial(arm, **BOTH)),
    "ranges and bounds, exact": of(partial(arm, **BOTH), hessian="exact"),
    "ranges and bounds, from a line": of(partial(arm, **BOTH), states="line"),
    "ranges and bounds, by accelerations": of(partial(arm, integrator="semi-implicit-euler", **BOTH)),
    "one side and bounds": of(partial(arm, control=20.0, velocity={"shoulder": (None, 2.0)})),
    "goal, ranges and bounds": of(partial(arm, final="exact", **BOTH)),
    "terms, ranges and bounds": of(partial(reaching, velocity=2.5, control=4.0)),
    "own cost": of(lambda: moved(hanging_arm(), BENT, [0.5, 0.5], own=True)),
    "own cost, ranges and bounds": of(
        lambda: moved(hanging_arm(), BENT, [0.5, 0.5], own=True, velocity=1.0, control=6.0)
    ),
    "constraint": of(partial(arm, [HIGH]), max_iterations=40),
    "constraint, ranges and bounds": of(partial(arm, [HIGH], **BOTH)),
    "own constraint, exact": of(partial(arm, [SUM]), hessian="exact"),
    "own constraint, ranges and bounds": of(partial(arm, [SUM], **BOTH)),
    "avoid": of(beside_a_wall, max_iterations=40),
    "avoid, ranges and bounds": of(partial(beside_a_wall, velocity=1.5, control=15.0), max_iterations=40),
    "contact": of(on_a_foot, max_iterations=25),
    "contact, ranges and bounds": of(partial(on_a_foot, velocity=2.0, control=30.0), actual_reduction_tolerance=0.03),
    "closed chain": of(closing),
    "closed chain, ranges and bounds": of(partial(closing, velocity=0.2, control=20.0), max_iterations=40),
    "friction loss": of(lambda: moved(m := Mechanism.from_mjcf(FRICTION_ARM, contacts="off"), m.home, [0.5, 0.3, 0.4])),
    "prescribed": of(partial(moved_cart, 40), max_iterations=40),
    "runs away": of(running_away),
    "jerk": of(partial(arm, N=15), solve_for, objective="jerk"),
    "jerk, ranges and bounds": of(partial(arm, N=15, **BOTH), solve_for, objective="jerk"),
    "energy, ranges and bounds": of(partial(arm, **BOTH), solve_for, objective="energy", max_iterations=40),
    "least time": of(
        partial(cart, 20, control=1.0, velocity=0.8), solve_for, objective="time", durations=(1.0, 4.0), tolerance=0.1
    ),
    "warm start": again,
    "warm start, ranges and bounds": partial(again, **BOTH),
    "starts": of(arm, starts=3),
    "starts, ranges and bounds": of(partial(arm, **BOTH), starts=3),
}


def bits(plan):
    """Of a plan, by their names."""
    parts = {name: getattr(plan, name) for name in ("xs", "us", "K", "cost", "gradient_norm", "nit")}
    parts["history"] = list(plan.history)
    found = {name: np.asarray(part, dtype=float).tobytes() for name, part in parts.items()}
    return found | {"status": plan.status, "starts": plan.starts}


@cache
def first(kind):
    """What solves a problem of this kind, and the bits of its first plan."""
    solve_it = KINDS[kind]()
    return solve_it, bits(solve_it())


def changed(kind, plan):
    """What of a plan is not as in the first one of its kind."""
    now = bits(plan)
    return [name for name, part in first(kind)[1].items() if now[name] != part]


each_kind = pytest.mark.parametrize("kind", KINDS)


@each_kind
def test_again(kind):
    """By the engine that was used for it; a third time is in another order."""
    assert not changed(kind, first(kind)[0]())


def test_in_another_order():
    for kind in np.random.default_rng(7).permutation(list(KINDS)).tolist():
        assert not changed(kind, first(kind)[0]()), kind


@pytest.mark.slow
def test_in_threads():
    """New problems, each in two threads at once, beside others."""
    kinds = [kind for kind in KINDS for _ in range(2)]
    new = {kind: KINDS[kind]() for kind in KINDS}
    with ThreadPoolExecutor(4) as pool:
        for kind, plan in zip(kinds, pool.map(lambda kind: new[kind](), kinds), strict=True):
            assert not changed(kind, plan), kind


IN_HALVES = (
    "arm", "arm, exact", "bounds", "ranges and bounds, from a line", "ranges and bounds, by accelerations", "avoid",
    "contact", "closed chain", "friction loss", "prescribed",
)  # fmt: skip


@pytest.mark.parametrize("kind", IN_HALVES)
def test_a_second_thread_changes_no_bit(kind, monkeypatch):
    tried = []
    monkeypatch.setattr(Trials, "two_are_faster", lambda trials: tried.append(trials) or True)
    assert not changed(kind, KINDS[kind]()())
    assert tried


def solved_in_a_fork(queue):
    """The cost of a solve by two threads in a forked process, of whose parent's threads it has none."""
    queue.put(solve(arm()).cost)


def test_a_forked_process_has_a_second_thread_of_its_own(monkeypatch):
    monkeypatch.setattr(Trials, "two_are_faster", lambda trials: True)
    cost, context = solve(arm()).cost, multiprocessing.get_context("fork")
    queue = context.SimpleQueue()
    child = context.Process(target=solved_in_a_fork, args=(queue,))
    child.start()
    child.join(60.0)
    assert child.exitcode == 0
    assert queue.get() == cost


def test_only_solves_of_the_main_thread_use_a_second_one(monkeypatch):
    tried = []
    monkeypatch.setattr(Trials, "two_are_faster", lambda trials: tried.append(trials))
    problem = arm()
    with ThreadPoolExecutor(1) as pool:
        pool.submit(solve, problem).result()
    engine = acquire_engine(problem)  # as a controller has it
    engine.start_from_controls(problem.x0, problem.first_guess)
    engine.compute_direction(0.0, True)
    assert not tried


def spoil(engine):
    """Fill with nonsense what a solve may leave in an engine."""
    engine.state_regularization = engine.largest_control_weight = np.nan
    engine._exact = engine._second_order_used = engine._has_penalties = True
    if not isinstance(engine, CompiledEngine):
        engine._cost = engine._penalties = engine._sweep = engine._nominal = engine._state_weights = None
        return
    scratch = [part._arrays for part in (engine._memory, engine._second) if part is not None]
    written = [
        array for arrays in (engine._w._arrays, *scratch) for name, array in arrays.items() if name not in NOT_SPOILED
    ]
    for array in (engine._w.search, engine._curvature, *written):
        array.fill(np.nan)


@each_kind
def test_whatever_an_idle_engine_holds(kind):
    solve_it, _ = first(kind)
    for idle in [idle for kept in list(_idle.values()) for idle in kept.values()]:
        for engine in idle:
            spoil(engine)
    assert not changed(kind, solve_it())


@each_engine
def test_an_acquired_engine_has_nothing_of_the_last_solve(engine):
    """Its gains and gradient would be those of a plan whose own sweeps all failed."""
    problem = engines()[engine]
    solve(problem)
    used = acquire_engine(problem)
    assert not used.gains().any()
    assert not used.gradient().any()
    release_engine(problem, used)


def test_the_number_of_threads_does_not_change_the_plan_of_several_starts(monkeypatch):
    plans = []
    for threads in (1, 2, 4):
        monkeypatch.setattr(multistart, "processors", lambda threads=threads: threads)
        plans.append(solve(arm(**BOTH), starts=6, spread=2.0))
    monkeypatch.setattr("planner.solvers.slq.release_engine", lambda *_: None)  # no engine is used again
    plans.append(solve(arm(**BOTH), starts=6, spread=2.0))
    assert len({start.cost for start in plans[0].starts}) > 1
    for plan in plans[1:]:
        assert bits(plan) == bits(plans[0])
