"""Wrong plans: goals that are missed, solves that did not end, steps that are too coarse."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

import planner
from corpus import machines
from corpus.asking import placed, reach
from corpus.machines import arm, cart
from corpus.planting import KNOTS_ONLY, Attempt, Rng, honest, member, of, rolled, soft_stopped
from planner import FrameCost, Limits, Mechanism, Plan, Problem, RigidBodyDynamics, Status, TrackingCost, cases
from planner.model.mjcf.text import edited

# Goals that are missed


def missed(name: str, make: Callable[[Rng], Problem]) -> None:
    member(name, lambda rng: planner.solve(make(rng)))


missed("a goal far from reached", lambda rng: reach(arm(rng, 2), [0.8, -0.7], final=0.01, plain=True))


def by_some_per_cent(rng: Rng) -> Problem:
    """With the largest of a series of final weights at which the plan's own end is 3 % of the way from the goal."""
    text, final, miss = arm(rng, 2, gravity="0 0 0"), 300.0, 0.0
    while miss < 0.03 * 0.8:
        final /= 2.0
        problem = reach(text, [0.8, -0.7], final=final)
        miss = np.abs(planner.solve(problem).xs[-1, :2] - [0.8, -0.7]).max()
    return problem


missed("a goal missed by some per cent", by_some_per_cent)
missed("a goal missed by a weak motor", lambda rng: reach(arm(rng, 2), [0.8, -0.7], limits=Limits(control=0.3)))


def out_of_reach(rng: Rng) -> Problem:
    m = Mechanism.from_mjcf(arm(rng, 1, joint=lambda i: 'damping="0.3"'))
    return placed(m, m.home, position=[0.9, 0.0, 0.8])


missed("a place out of reach", out_of_reach)


def other_direction(rng: Rng) -> Problem:
    """A planar arm cannot turn its hand about the world's x."""
    m = Mechanism.from_mjcf(arm(rng, 2, joint=lambda i: 'damping="0.3"'))
    return placed(m, m.home, orientation=[0.9, 0.3, 0.0, 0.0])


missed("a direction that no joint turns to", other_direction)
missed("a place that is asked too little",
       lambda rng: _two_goals(rng))  # fmt: skip


def _two_goals(rng: Rng) -> Problem:
    """The joints get to their goal, and the hand was to be elsewhere."""
    m = Mechanism.from_mjcf(arm(rng, 3, spatial=True))
    dynamics = RigidBodyDynamics(m, 0.01)
    joints = TrackingCost.joints(dynamics, np.concatenate([np.full(3, 0.6), np.zeros(3)]), 100, effort=0.001,
                                 final_position=1e4, final_velocity=1e3)  # fmt: skip
    return Problem(dynamics, joints + FrameCost(dynamics, "hand", position=[0.2, 0.3, 0.4], final_position_weight=1.0),
                   m.home)  # fmt: skip


def _still_moving(rng: Rng) -> Problem:
    problem = reach(arm(rng, 2, gravity="0 0 0"), [0.8, -0.7])
    cost = TrackingCost.joints(problem.dynamics, [0.8, -0.7, 0.0, 0.0], 100, effort=1.0, final_position=1e4,
                               final_velocity=1e-2)  # fmt: skip
    return replace(problem, cost=cost)


missed("at the goal and still moving", _still_moving)
missed("a small arm that misses", lambda rng: reach(arm(rng, 2, length=0.02, mass=0.002), [0.8, -0.7], final=1e-7,
                                                   plain=True, duration=0.2))  # fmt: skip


def _long_way(rng: Rng) -> Problem:
    """1 rad of 2 would be inside a tolerance of absolute size for nobody; the wrong one of two arms is weighed."""
    problem = reach(arm(rng, 2, gravity="0 0 0"), [1.5, 1.5])
    cost = TrackingCost.joints(problem.dynamics, [1.5, 1.5, 0.0, 0.0], 100, effort=1.0,
                               final_position={"j0": 1e4, "j1": 1e-3}, final_velocity=1e2)  # fmt: skip
    return replace(problem, cost=cost)


missed("one joint gets there and the other does not", _long_way)


# Solves that did not end


def stopped(kind: Callable[[], Problem], most: int) -> Callable[[Rng], Plan]:
    return lambda rng: planner.solve(kind(), max_iterations=most)


member("an unconverged acrobot", stopped(cases.acrobot, 4))
member("an unconverged two-link arm", stopped(cases.two_link, 3))
member("an unconverged hopper", stopped(cases.hopper, 2))
member("an unconverged puma", stopped(cases.puma, 5))


member("unconverged, feasible, with a soft goal", soft_stopped)
member("unconverged, its status set to CONVERGED", lambda rng: replace(soft_stopped(rng), status=Status.CONVERGED))
member("unconverged, status and numbers made consistent", lambda rng: honest(soft_stopped(rng)))
member("a first guess that says it converged",
       lambda rng: rolled(soft_stopped(rng), np.zeros((100, 2))))  # fmt: skip
member("a detour that says it converged",
       lambda rng: rolled(p := of("arm")(rng), p.us + 2.0 * np.sin(np.linspace(0.0, 6.28, 100))[:, None]))  # fmt: skip
member("a given plan that says it is given", lambda rng: replace(of("arm")(rng), status=Status.GIVEN))


# Steps that are too coarse, and what happens between the knots


def coarse(name: str, make: Callable[[Rng], Problem]) -> None:
    member(name, lambda rng: planner.solve(make(rng)))


coarse("an acrobot in coarse Euler steps", lambda rng: cases.acrobot(integrator="semi-implicit-euler", horizon=150))
coarse("a swing in coarse Euler steps", lambda rng: _swing("euler", 60))
coarse("a swing in coarse semi-implicit steps", lambda rng: _swing("semi-implicit-euler", 40))
coarse("an arm in coarse Euler steps",
       lambda rng: reach(arm(rng, 2), [0.8, -0.7], N=15, integrator="euler"))  # fmt: skip
coarse("a tiny machine in coarse steps", lambda rng: _tiny(rng, "semi-implicit-euler"))
coarse("a tiny machine in coarse Euler steps", lambda rng: _tiny(rng, "euler"))


def _swing(integrator: str, N: int) -> Problem:
    t = np.linspace(0.0, 1.0, N)[:, None]
    return reach(cart(np.random.default_rng(3)), [0.0, np.pi, 0.0, 0.0], duration=2.0, N=N, guess=2.0 * np.sin(6.0 * t),
                 integrator=integrator)  # fmt: skip


def _tiny(rng: Rng, integrator: str) -> Problem:
    """1 mm on a rail with a spring, whose oscillation has few stages."""
    text = arm(rng, 1, gravity="0 0 0", length=0.05, mass=0.01)
    text = text.replace('axis="0 -1 0"', 'type="slide" axis="1 0 0" stiffness="40"')
    return reach(text, [0.001], duration=0.5, N=40, integrator=integrator)


def bulging(name: str, **limits: Any) -> None:
    """Limits that are kept at a few knots and broken between them."""

    def make(rng: Rng) -> Plan:
        text = arm(rng, 1, gravity="0 0 0").replace('axis="0 -1 0"', 'type="slide" axis="1 0 0"')
        start = [0.0, 4.0]
        problem = reach(text, [0.0, -1.0], start=start, duration=1.0, N=4, limits=Limits(**limits))
        return planner.solve(problem, KNOTS_ONLY)

    member(name, make)


bulging("a range that is broken between the knots", position={"j0": (-1.0, 0.2)})


def fast_between(rng: Rng) -> Plan:
    """A pendulum that falls through its fastest point between two knots."""
    text = arm(rng, 1, mass=1.0)
    low = np.array([-np.pi / 2 - 1.4, 0.0])
    problem = reach(text, [-np.pi / 2 + 1.4, 0.0], start=low, duration=0.9, N=5, effort=1e-3)
    plan = planner.solve(problem)
    most = float(np.abs(plan.xs[:, 1]).max())
    limited = replace(problem, limits=Limits(velocity={"j0": 1.01 * most}), us=plan.us)
    return planner.solve(limited, KNOTS_ONLY)


member("a limit of speed that is broken between the knots", fast_between)


def twitchy(rng: Rng) -> Plan:
    """A loop of 600 rad/s about an unstable pose: it holds at 2 kHz, and 2 to 4 ms late it does not."""
    text = arm(rng, 1, length=0.02, mass=0.01)
    m = Mechanism.from_mjcf(text)
    dynamics = RigidBodyDynamics(m, 5e-4)
    inertia = 0.01 * 0.02**2 / 3
    x = np.array([np.pi / 2, 0.0])
    cost = TrackingCost.joints(dynamics, x, 2400, effort=1.0 / inertia**2, position=600.0**4, velocity=600.0**2,
                               final_position=600.0**3, final_velocity=600.0)  # fmt: skip
    start = x + np.array([0.3, 0.0])
    return planner.solve(Problem(dynamics, cost, start))


member("gains that hold at 2 kHz and not at 500 Hz", twitchy)


def late_explosion(rng: Rng) -> Plan:
    """Beside an arm, a pole stands upright that nothing drives and that leans by a billionth: it falls at the end."""
    inertia = '<inertial pos="0 0 0.4" mass="1" diaginertia=".1 .1 .1"/>'
    pole = f'<body pos="0 1 0"><joint name="pole" axis="0 -1 0"/>{inertia}</body>'
    text = arm(rng, 1, joint=lambda i: 'damping="0.3"', more=pole)
    start, goal = np.array([1e-9, 0.0, 0.0, 0.0]), np.array([0.0, 0.8, 0.0, 0.0])
    m = Mechanism.from_mjcf(text)
    dynamics = RigidBodyDynamics(m, 0.02, "semi-implicit-euler")
    cost = TrackingCost.joints(dynamics, goal, 250, effort=0.1, final_position={"j0": 1e4}, final_velocity={"j0": 1e3})
    return planner.solve(Problem(dynamics, cost, start))


member("a late explosion", late_explosion)


def stiff_end(rng: Rng) -> Attempt:
    """A spring at the end of the way, so stiff that every step of the simulator overshoots."""
    plan = of("arm")(rng)
    q = plan.xs[:, 0]
    limit = machines.number(q.max() - 0.02)
    edits = {
        ".//joint[@name='j0']": {"range": f"-3 {limit}", "solreflimit": "-1e9 0", "solimplimit": "0.99 0.999 1e-4"}
    }
    return plan, {"mjcf": edited(plan.twin.mjcf, edits)}


member("a stiff stop late on the way", stiff_end)
