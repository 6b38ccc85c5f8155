"""Right plans of other machines: swings, trees, contacts, coarse and fine steps, other ways of asking."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

import planner
from corpus import machines
from corpus.asking import Rng, member, reach, turned
from corpus.machines import arm, between, cart, gantry
from planner import Limits, Mechanism, Plan, Problem, RigidBodyDynamics, TrackingCost, cases
from planner.contact import ContactLaw
from planner.dynamics.algorithms import mass_matrix

# Swings


@member("a pendulum swung up")
@member("a pendulum swung up by a weak motor", most=0.35)
def pendulum(rng: Rng, most: float | None = None) -> Plan:
    mass, length = between(rng, 0.2, 5.0), between(rng, 0.2, 1.5)
    torque = mass * 9.81 * length / 2
    limits = None if most is None else Limits(control=most * torque)
    duration = (2.0 if most is None else 4.5) * length**0.5
    t = np.linspace(0.0, 1.0, 150)[:, None]
    guess = 0.2 * torque * np.sin(2 * np.pi * duration * 0.6 / length**0.5 * t)
    text = arm(rng, 1, mass=mass, length=length)
    down = np.array([-np.pi / 2, 0.0])
    return planner.solve(
        reach(text, [np.pi / 2, 0.0], start=down, duration=duration, N=150, limits=limits, guess=guess, effort=0.01)
    )


@member("a cart swings its pole up")
@member("a cart swings its pole up on a short rail", limits={"control": 30.0, "position": {"rail": (-1.2, 1.2)}})
@member("a small cart swings its pole up", scale=0.05)
def cart_pole(rng: Rng, limits: dict | None = None, scale: float = 1.0) -> Plan:
    text, duration = cart(rng, scale=scale, damping=0.0), 2.0 * scale**0.5
    t = np.linspace(0.0, 1.0, 120)[:, None]
    guess = 2.0 * scale**3 * np.sin(6.0 * t)
    return planner.solve(
        reach(text, [0.0, np.pi, 0.0, 0.0], duration=duration, N=120, guess=guess, effort=1.0,
              limits=None if limits is None else Limits(**limits))
    )  # fmt: skip


@member("a cart moves its hanging pole")
@member("a cart moves two hanging poles", poles=2)
@member("a cart moves its hanging pole for ten seconds", duration=10.0)
def crane(rng: Rng, poles: int = 1, duration: float = 3.0) -> Plan:
    goal = np.array([1.0, *[0.0] * (2 * poles + 1)])
    return planner.solve(reach(cart(rng, poles, damping=0.01), goal, duration=duration, N=200))


@member("a case: the two-link arm", cases.two_link)
@member("a case: the acrobot", cases.acrobot)
@member("a case: the acrobot from hanging", cases.acrobot, start="hanging")
@member("a case: the puma", cases.puma)
def case(rng: Rng, make: Callable[..., Problem], **options: Any) -> Plan:
    return planner.solve(make(**options))


@member("an acrobot of other masses")
def acrobot(rng: Rng) -> Plan:
    masses = {"mass1": rng.uniform(0.45, 0.55), "mass2": rng.uniform(0.45, 0.55)}
    return planner.solve(cases.acrobot(**masses), max_iterations=3000)


@member("a double pendulum swung about", 3.0)
@member("a double pendulum swung about for ten seconds", 10.0)
def chaotic(rng: Rng, duration: float) -> Plan:
    """Its shoulder follows a swing, its second rod goes where that takes it."""
    m = Mechanism.from_mjcf(arm(rng, 2, driven=(0,), joint=lambda i: 'damping="0.01"'))
    N = round(100 * duration)
    dynamics, t = RigidBodyDynamics(m, 0.01), 0.01 * np.arange(N + 1)
    reference = np.zeros((N + 1, 4))
    reference[:, 0], reference[:, 2] = -np.pi / 2 + np.sin(3.0 * t), 3.0 * np.cos(3.0 * t)
    cost = TrackingCost.joints(dynamics, None, N, reference=reference, position={"j0": 10.0}, velocity={"j0": 1.0},
                               effort=0.1)  # fmt: skip
    return planner.solve(Problem(dynamics, cost, np.array([-np.pi / 2, rng.uniform(0.5, 1.0), 0.0, 0.0])))


# Other trees


@member("a gantry with a load")
@member("a gantry with springs", more='stiffness="20" springref="0.2"')
def gantries(rng: Rng, more: str = "") -> Plan:
    return planner.solve(reach(gantry(rng, more=more), [1.0, -0.7, 0.4, 0.0], duration=2.0))


@member("a branched tree")
@member("a branched tree in gravity", gravity="0 0 -9.81")
@member("a branched tree with balls", balls=True)
@member("a floating tree", free=True)
@member("a floating tree with balls", free=True, balls=True)
def trees(rng: Rng, **options: Any) -> Plan:
    m = Mechanism.from_mjcf(machines.tree(rng, **options))
    goal = 0.6 * rng.uniform(-1.0, 1.0, m.nv)
    tolerance = None
    if options.get("free"):
        goal[:6], tolerance = 0.0, "soft"  # the trunk cannot be moved as one likes
        x = m.space.integrate(m.home, np.concatenate([goal, np.zeros(m.nv)]))
        dynamics = RigidBodyDynamics(m, 0.01)
        inertia = np.diag(mass_matrix(m, m.home[: m.nq])).min()
        p = np.concatenate([np.zeros(6), np.ones(m.nv - 6)])
        cost = TrackingCost.joints(dynamics, x, 100, effort=0.01 / inertia**2, final_position=1e3 * p,
                                   final_velocity=1e2 * p)  # fmt: skip
        return planner.solve(Problem(dynamics, cost, m.home, tolerance=tolerance))
    return planner.solve(reach(m, goal, tolerance=tolerance))


# Steps


@member("semi-implicit Euler in small steps", "semi-implicit-euler", 2000)
@member("Euler in small steps", "euler", 4000)
def eulers(rng: Rng, integrator: str, N: int) -> Plan:
    return planner.solve(reach(arm(rng, 1, joint=lambda i: 'damping="0.3"'), [0.8], N=N, integrator=integrator))


@member("a stiff joint", 10.0)
@member("a very stiff joint", 25.0)
def stiff(rng: Rng, rate: float) -> Plan:
    """A damper at the end of an arm: its rate, 1/s, is that of the last rod alone, of the whole arm it is more."""
    text = arm(rng, 2, gravity="0 0 0", joint=lambda i: f'damping="{machines.number(rate * 0.0417)}"' if i else "")
    return planner.solve(reach(text, turned(rng, 2)))


# Contact


@member("a ball that lands and is pushed along")
@member("a heavy ball that lands and is pushed along", 20.0)
def bounced(rng: Rng, mass: float = 1.0, depth: float = 0.3) -> Plan:
    text = machines.ball_on_floor(rng, mass)
    law = ContactLaw.resting(mass, sink=0.01, friction=0.5)
    m = Mechanism.from_mjcf(text, contacts=law)
    return planner.solve(reach(m, [0.5, -depth], duration=1.0, N=200, tolerance="soft", final=100.0))


@member("a ball that stays above the floor it knows")
def hovering(rng: Rng) -> Plan:
    m = Mechanism.from_mjcf(machines.ball_on_floor(rng, 1.0), contacts=ContactLaw.resting(1.0))
    return planner.solve(reach(m, [0.5, 0.3], duration=1.0))


@member("a ball pushes another")
def pushed(rng: Rng) -> Plan:
    mass = between(rng, 0.2, 5.0)
    m = Mechanism.from_mjcf(machines.pusher(rng, mass), contacts=ContactLaw.resting(mass, sink=0.01, friction=0.0))
    problem = reach(m, [0.5, 0.3, 0.0, 0.0], duration=1.5, N=300, tolerance="soft", final=10.0)
    return planner.solve(replace(problem, us=np.full((300, 1), 0.5 * mass)), actual_reduction_tolerance=1e-6)


# Other ways of asking


@member("the exact Hessian", hessian="exact")
@member("the open-loop update", update="open-loop")
@member("one of three starts", starts=3, seed=4)
def ways(rng: Rng, **options: Any) -> Plan:
    return planner.solve(reach(arm(rng, 2), turned(rng, 2)), **options)


@member("the shortest way in time")
def timed(rng: Rng) -> Plan:
    problem = reach(arm(rng, 1, gravity="0 0 0"), [0.8], N=60, limits=Limits(control=1.0, final="exact"))
    return planner.solve_for(problem, {"time": 1.0, "effort": 0.01}, durations=(0.5, 3.0))


@member("a way of little jerk")
def jerked(rng: Rng) -> Plan:
    problem = reach(arm(rng, 2, gravity="0 0 0"), turned(rng, 2), final=1e7)
    return planner.solve(planner.costs.with_objective(problem, {"jerk": 1.0}))
