"""The register of wrong plans, and the right ones that faults are planted in.

A member is a function of a generator that gives a plan and the arguments of prove(), or is refused with a PlannerError.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np

import planner
from corpus import right_arms, right_machines
from corpus.asking import reach, turned
from corpus.machines import arm
from corpus.right_arms import servo
from planner import Plan, Status, cases
from planner.contact import ContactLaw
from planner.proof.consistency import recomputed

Rng = np.random.Generator
Attempt = tuple[Plan, dict[str, Any]]  # a plan and the arguments of prove()
MEMBERS: dict[str, Callable[[Rng], Attempt]] = {}
KNOTS_ONLY = planner.SolverOptions(max_tightenings=0)  # of solve(), which else keeps ranges between the knots too


def member(name: str, make: Callable[[Rng], Attempt | Plan]) -> None:
    """Add a member."""
    assert name not in MEMBERS, name
    MEMBERS[name] = lambda rng: made if isinstance(made := make(rng), tuple) else (made, {})


def attempt_of(name: str, seed: int) -> Attempt:
    """The plan of a member and the arguments of prove().

    Raises:
        PlannerError: The plan was refused.
    """
    return MEMBERS[name](np.random.default_rng([seed, *name.encode()]))


# Right plans that faults are planted in


def base(seed: int, kind: str) -> Plan:
    """A right plan of some kind of machine."""
    return BASES[kind](np.random.default_rng([seed, *kind.encode()]))


BASES: dict[str, Callable[[Rng], Plan]] = {
    "arm": lambda rng: planner.solve(reach(arm(rng, 2, joint=lambda i: 'damping="0.1"'), [0.8, -0.7])),
    "spatial arm": lambda rng: planner.solve(reach(arm(rng, 3, spatial=True), turned(rng, 3))),
    "small arm": lambda rng: planner.solve(
        reach(arm(rng, 2, length=0.05, mass=0.01, joint=lambda i: 'damping="1e-6"'), [0.8, -0.7], duration=0.3)
    ),
    "servo": lambda rng: planner.solve(
        reach(arm(rng, 2, actuator=servo, joint=lambda i: 'armature="0.05"'), [0.7, 0.6])
    ),
    "filter": lambda rng: right_arms.activated(rng, 'dyntype="filter" dynprm="0.05"'),
    "cart": lambda rng: right_machines.crane(rng),
    "swing": lambda rng: right_machines.cart_pole(rng),
    "springs": lambda rng: planner.solve(
        reach(arm(rng, 2, joint=lambda i: 'stiffness="3" springref="0.3" damping="0.1"'), [0.8, -0.7])
    ),
    "tree": lambda rng: right_machines.trees(rng, balls=True),
    "ball": lambda rng: right_machines.bounced(rng),
    "landing": lambda rng: right_machines.bounced(rng, depth=0.35),
    "acrobot": lambda rng: planner.solve(cases.acrobot()),
    "hopper": lambda rng: planner.solve(cases.hopper()),
    "two-link": lambda rng: planner.solve(cases.two_link()),
    "bounded": lambda rng: right_arms.bounded(rng),
}
_cached = lru_cache(maxsize=64)(base)


def of(kind: str) -> Callable[[Rng], Plan]:
    """The right plan of a kind, the same for all members of one seed."""
    return lambda rng: _cached(int(rng.bit_generator.seed_seq.entropy[0]), kind)  # type: ignore[attr-defined]


def law_of(mass: float, **changes: Any) -> ContactLaw:
    return ContactLaw.resting(mass, **({"sink": 0.01, "friction": 0.5} | changes))


def soft_stopped(rng: Rng) -> Plan:
    """Feasible and without a goal to miss, yet far from optimal."""
    return planner.solve(reach(arm(rng, 2), [0.8, -0.7], tolerance="soft"), max_iterations=1)


def honest(plan: Plan, **changes: Any) -> Plan:
    """A plan whose gains, cost and gradient were computed again from its states and controls, and that lies in them."""
    plan = replace(plan, **changes)
    now = recomputed(plan, plan.problem, plan.xs, plan.us)
    K = plan.K if now.sweep is None else now.sweep.K
    return replace(plan, K=K, cost=now.cost, gradient_norm=now.gradient_norm, status=Status.CONVERGED)


def rolled(plan: Plan, us: np.ndarray) -> Plan:
    """The plan with other controls, its states and all else computed again."""
    dynamics, xs = plan.problem.dynamics, [plan.problem.x0]
    for u in us:
        xs.append(dynamics.step(xs[-1][None], u[None])[0])
    return honest(plan, xs=np.array(xs), us=us)
