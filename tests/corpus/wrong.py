"""Wrong plans: each has a fault that was planted in its model, its numbers, its file or its making.

A member is a function of a generator that gives a plan and the arguments of prove(), or is refused with a PlannerError.
"""

import json
import tempfile
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

import planner
from corpus import machines, right
from corpus.machines import arm, cart
from corpus.right import CAPSULE, reach, servo
from planner import FrameCost, Limits, Mechanism, Plan, Problem, RigidBodyDynamics, Status, TrackingCost, cases
from planner.contact import ContactLaw
from planner.model.mjcf.text import edited
from planner.problem.archive import write_archive
from planner.problem.periodicity import Periodic
from planner.proof.consistency import recomputed

Rng = np.random.Generator
Attempt = tuple[Plan, dict[str, Any]]  # a plan and the arguments of prove()
MEMBERS: dict[str, Callable[[Rng], Attempt]] = {}


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
    "spatial arm": lambda rng: planner.solve(reach(arm(rng, 3, spatial=True), right.turned(rng, 3))),
    "small arm": lambda rng: planner.solve(
        reach(arm(rng, 2, length=0.05, mass=0.01, joint=lambda i: 'damping="1e-6"'), [0.8, -0.7], duration=0.3)
    ),
    "servo": lambda rng: planner.solve(
        reach(arm(rng, 2, actuator=servo, joint=lambda i: 'armature="0.05"'), [0.7, 0.6])
    ),
    "filter": lambda rng: right.activated(rng, 'dyntype="filter" dynprm="0.05"'),
    "cart": lambda rng: right.crane(rng),
    "swing": lambda rng: right.cart_pole(rng),
    "springs": lambda rng: planner.solve(
        reach(arm(rng, 2, joint=lambda i: 'stiffness="3" springref="0.3" damping="0.1"'), [0.8, -0.7])
    ),
    "tree": lambda rng: right.trees(rng, balls=True),
    "ball": lambda rng: right.bounced(rng),
    "landing": lambda rng: right.bounced(rng, depth=0.35),
    "acrobot": lambda rng: planner.solve(cases.acrobot()),
    "hopper": lambda rng: planner.solve(cases.hopper()),
    "two-link": lambda rng: planner.solve(cases.two_link()),
    "bounded": lambda rng: right.bounded(rng),
}
_cached = lru_cache(maxsize=64)(base)


def of(kind: str) -> Callable[[Rng], Plan]:
    """The right plan of a kind, the same for all members of one seed."""
    return lambda rng: _cached(int(rng.bit_generator.seed_seq.entropy[0]), kind)  # type: ignore[attr-defined]


# Another model


def scaled(plan: Plan, path: str, attribute: str, factor: float, which: int | None = None) -> dict[str, dict[str, str]]:
    """Edits that multiply the numbers of an attribute, or one of them."""
    from xml.etree import ElementTree

    element = ElementTree.fromstring(plan.twin.mjcf).find(path)
    assert element is not None, path
    values = [float(value) for value in element.attrib[attribute].split()]
    values = [v * factor if which in (None, k) else v for k, v in enumerate(values)]
    return {path: {attribute: " ".join(map(machines.number, values))}}


def in_another_model(kind: str, path: str, attribute: str, change: float | str, which: int | None = None) -> None:
    """A member whose model differs by a factor, or in an attribute that is set."""

    def make(rng: Rng) -> Attempt:
        plan = of(kind)(rng)
        factor = isinstance(change, float)
        edits = scaled(plan, path, attribute, change, which) if factor else {path: {attribute: change}}
        return plan, {"mjcf": edited(plan.twin.mjcf, edits)}

    how = f"times {change:g}" if isinstance(change, float) else f"is {change}"
    at = "" if which is None else f"[{which}]"
    member(f"{kind} in a model whose {attribute}{at} of {path.removeprefix('.//')} {how}", make)


for _kind in ("arm", "spatial arm", "small arm", "cart", "servo", "springs"):
    in_another_model(_kind, "option", "gravity", 1.01)
for _kind in ("arm", "small arm", "servo"):
    in_another_model(_kind, ".//body[@name='b1']/inertial", "mass", 1.05)
    in_another_model(_kind, ".//body[@name='b1']/inertial", "pos", 1.03)
in_another_model("spatial arm", ".//body[@name='b2']/inertial", "diaginertia", 1.05)
in_another_model("arm", ".//body[@name='b0']/inertial", "diaginertia", 1.05)
in_another_model("arm", ".//body[@name='b1']", "pos", 1.02)
in_another_model("arm", ".//joint[@name='j0']", "damping", 1.05)
in_another_model("small arm", ".//joint[@name='j1']", "damping", 1.05)
in_another_model("arm", ".//joint[@name='j1']", "armature", "0.002")
in_another_model("servo", ".//joint[@name='j1']", "armature", 1.05)
in_another_model("springs", ".//joint[@name='j0']", "stiffness", 1.05)
in_another_model("springs", ".//joint[@name='j0']", "springref", 1.05)
in_another_model("arm", ".//motor[@name='m0']", "gear", "1.05")
in_another_model("arm", ".//motor[@name='m1']", "gear", "-1")
in_another_model("cart", ".//motor[@name='push']", "gear", "0.95")
in_another_model("swing", ".//motor[@name='push']", "gear", "1.01")
in_another_model("spatial arm", ".//joint[@name='j1']", "axis", "0 1 0.02")
in_another_model("servo", ".//general[@name='m0']", "gainprm", 1.05)
in_another_model("servo", ".//general[@name='m1']", "biasprm", 1.05)
in_another_model("filter", ".//general[@name='m1']", "dynprm", 1.05)
in_another_model("filter", ".//general[@name='m0']", "gainprm", 0.95)
in_another_model("tree", ".//body[@name='trunk']/inertial", "diaginertia", 1.05)
in_another_model("tree", ".//joint[@name='s1']", "damping", 1.05)
in_another_model("tree", ".//motor[@name='s10']", "gear", "1 0 0.05")
in_another_model("acrobot", ".//body[@name='forearm']/inertial", "mass", 1.01)
in_another_model("acrobot", ".//joint[@name='elbow']", "damping", "0.01")
in_another_model("acrobot", ".//joint[@name='elbow']", "frictionloss", "0.05")
in_another_model("acrobot", "option", "gravity", "0 0 -9.80665")
in_another_model("hopper", "actuator/general[@name='piston']", "biasprm", "0 -100 10")
in_another_model("hopper", "actuator/general[@name='piston']", "biasprm", "0 1e12 0")
in_another_model("hopper", "actuator/general[@name='piston']", "gainprm", "101")
in_another_model("hopper", "keyframe/key[@name='start']", "act", "0")
in_another_model("arm", ".//joint[@name='j1']", "range", "-0.4 1")
in_another_model("spatial arm", ".//joint[@name='j0']", "range", "-0.1 0.1")
in_another_model("arm", ".//motor[@name='m0']", "ctrlrange", "-3 3")
in_another_model("arm", ".//motor[@name='m0']", "forcerange", "-3 3")
in_another_model("servo", ".//general[@name='m0']", "forcerange", "-4 4")
in_another_model("arm", ".//joint[@name='j0']", "actuatorfrcrange", "-3 3")
in_another_model("arm", ".//joint[@name='j0']", "frictionloss", "1")
in_another_model("small arm", ".//joint[@name='j0']", "frictionloss", "1e-3")


def swapped_motors(rng: Rng) -> Attempt:
    plan = of("arm")(rng)
    edits = {".//motor[@name='m0']": {"joint": "j1"}, ".//motor[@name='m1']": {"joint": "j0"}}
    return plan, {"mjcf": edited(plan.twin.mjcf, edits)}


def flagged(name: str, option: str, kind: str = "springs") -> None:
    """A model in which a switch is set."""

    def make(rng: Rng) -> Attempt:
        plan = of(kind)(rng)
        head, _, tail = plan.twin.mjcf.partition("</mujoco>")
        return plan, {"mjcf": f"{head}{option}</mujoco>{tail}"}

    member(f"{kind} in a model {name}", make)


flagged("without gravity", '<option><flag gravity="disable"/></option>')
flagged("without its motors", '<option><flag actuation="disable"/></option>')
flagged("in air", '<option density="1.2" viscosity="0.01"/>')
flagged("with joints that are coupled", '<equality><joint joint1="j0" joint2="j1"/></equality>')
flagged("with a tendon's spring", '<tendon><fixed stiffness="3"><joint joint="j0" coef="1"/></fixed></tendon>')
flagged("with a tendon's damping", '<tendon><fixed damping="0.1"><joint joint="j1" coef="1"/></fixed></tendon>')
flagged("whose second motor group is switched off", '<option actuatorgroupdisable="0"/>')
flagged("with a motor more", '<actuator><motor joint="j0"/></actuator>')
flagged("whose tree pulls aside", '<option wind="3 0 0" density="1"/>', "tree")


def compensated(rng: Rng) -> Attempt:
    plan = of("arm")(rng)
    return plan, {"mjcf": edited(plan.twin.mjcf, {".//body[@name='b1']": {"gravcomp": "0.05"}})}


member("a body whose weight is compensated in part", compensated)


# Dynamics that are not those of the model


def by_hand(name: str, kind: str, change: Callable[[Mechanism], dict[str, Any]]) -> None:
    """A plan for a mechanism that was changed after it was read, solved and consistent in itself."""

    def make(rng: Rng) -> Plan:
        plan = of(kind)(rng)
        old, m = plan.problem.dynamics, plan.problem.dynamics.mechanism
        dynamics = RigidBodyDynamics(replace(m, **change(m)), old.dt, old.integrator)
        return planner.solve(replace(plan.problem, dynamics=dynamics, twin=plan.twin))

    member(name, make)


by_hand("masses 5 % larger than the model's", "arm", lambda m: {"mass": 1.05 * m.mass})
by_hand("no damping, where the model has some", "arm", lambda m: {"damping": 0.0 * m.damping})
by_hand("gravity turned by a degree", "arm", lambda m: {"gravity": np.array([0.1712, 0.0, -9.8085])})
by_hand("a floor that was taken away by hand", "landing", lambda m: {"contacts": ()})
by_hand("a law of contact that was changed by hand", "ball",
        lambda m: {"contacts": tuple(replace(c, law=law_of(1.0, friction=0.3)) for c in m.contacts)})  # fmt: skip
by_hand("springs that rest elsewhere", "springs", lambda m: {"spring_rest": m.spring_rest + 0.02})
by_hand("motors 1 % stronger than the model's", "arm",
        lambda m: {"actuators": replace(m.actuators, gain=1.01 * m.actuators.gain)})  # fmt: skip


PENDULUM = """<mujoco><worldbody><body><joint name="h" axis="0 -1 0" damping="0.1"/>
  <inertial pos="0 0 -1" mass="1" diaginertia="1e-6 1e-6 1e-6"/></body></worldbody>
  <actuator><motor joint="h"/></actuator></mujoco>"""


def own_python(gravity: float = 9.81, damping: float = 0.1, integrator: str = "rk4", turn: float = 1.0) -> Plan:
    """A pendulum as somebody wrote it, in MuJoCo's."""

    def rate(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        q, v = x[..., 0], x[..., 1]
        return np.stack([turn * v, u[..., 0] - gravity * np.sin(q) - damping * v], axis=-1)

    def map_(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        half = x + 0.01 * rate(x, u)
        return x + 0.02 * rate(half, u)

    discrete = integrator == "discrete"
    dynamics = planner.FunctionDynamics(map_ if discrete else rate, 2, 1, 0.02, integrator)
    cost = TrackingCost.reach([1.5, 0.0], 60, final=1e3, effort=0.1, dt=0.02)
    twin = planner.Twin.of(Mechanism.from_mjcf(PENDULUM))
    return planner.solve(Problem(dynamics, cost, [0.0, 0.0], twin=twin))


member("own Python with another gravity", lambda rng: own_python(gravity=9.7))
member("own Python that forgets the damping", lambda rng: own_python(damping=0.0))
member("own Python with a wrong rate", lambda rng: own_python(turn=1.01))
member("own discrete Python with another gravity", lambda rng: own_python(gravity=9.7, integrator="discrete"))
member("own discrete Python that forgets the damping", lambda rng: own_python(damping=0.0, integrator="discrete"))


def other_machine(rng: Rng) -> Attempt:
    plan = of("acrobot")(rng)
    return plan, {"mjcf": of("swing")(rng).twin.mjcf}


def other_arm(rng: Rng) -> Attempt:
    return of("arm")(rng), {"mjcf": of("small arm")(rng).twin.mjcf}


def joint_more(rng: Rng) -> Attempt:
    plan = of("arm")(rng)
    head, end, tail = plan.twin.mjcf.rpartition("</worldbody>")
    return plan, {"mjcf": f'{head}<body><joint/><geom size="0.1"/></body>{end}{tail}'}


def wall_on(rng: Rng) -> Attempt:
    """A table that both shapes of the arm meet; the plan's own model has none."""
    text = arm(rng, 2, shapes=CAPSULE)
    plan = planner.solve(reach(text, [-0.8, 0.4], contacts="on"))
    head, end, tail = plan.twin.mjcf.rpartition("</worldbody>")
    return plan, {"mjcf": f'{head}<geom name="table" type="box" size="2 2 0.05" pos="0 0 -0.35"/>{end}{tail}'}


def mixed_maps(rng: Rng) -> Attempt:
    plan = of("arm")(rng)
    order = [1, 0, 3, 2]
    return plan, {"twin": replace(plan.twin, to_x=plan.twin.to_x[order], to_sim=plan.twin.to_sim[:, order])}


def shifted_maps(rng: Rng) -> Attempt:
    plan = of("arm")(rng)
    return plan, {"twin": replace(plan.twin, to_x_offset=plan.twin.to_x_offset + 0.05)}


member("two motors swapped", swapped_motors)
member("an acrobot's plan in a cart of as many joints", other_machine)
member("an arm's plan in an arm of another size", other_arm)
member("a model with a joint more", joint_more)
member("a table in another model", wall_on)
member("maps of a twin that swap joints", mixed_maps)
member("maps of a twin with an offset", shifted_maps)


# Contact


def law_of(mass: float, **changes: Any) -> ContactLaw:
    return ContactLaw.resting(mass, **({"sink": 0.01, "friction": 0.5} | changes))


def other_law(**changes: Any) -> Callable[[Rng], Attempt]:
    """The pushed ball in a model whose contact has another law."""

    def make(rng: Rng) -> Attempt:
        plan = of("ball")(rng)
        state = np.random.default_rng([int(rng.bit_generator.seed_seq.entropy[0]), *b"ball"])  # type: ignore[attr-defined]
        other = Mechanism.from_mjcf(machines.ball_on_floor(state, 1.0), contacts=law_of(1.0, **changes))
        return plan, {"twin": planner.Twin.of(other)}

    return make


member("a floor twice as stiff", other_law(sink=0.005))
member("friction of .3 for .5", other_law(friction=0.3))
member("friction 5 % less", other_law(friction=0.475))
member("a floor that damps half as much", other_law(damping_ratio=0.1))
member("a floor that is slippery", other_law(friction=0.0))


def through_wall(shape: str, size: str, contacts: Any, stored: bool = False) -> Callable[[Rng], Attempt]:
    """An arm through what stands in its way, which its plan does not know."""

    def make(rng: Rng) -> Attempt:
        wall = f'<geom name="wall" type="{shape}" size="{size}" pos="0.6 0 0.45"/>'
        if isinstance(contacts, ContactLaw):
            wall += '<geom name="floor" type="plane" size="5 5 1" pos="0 0 -3"/>'
        plan = planner.solve(reach(arm(rng, 1, more=wall, shapes=CAPSULE), [1.3], start=[0.1], contacts=contacts))
        return (right.again(plan) if stored else plan), {}

    return make


member("through a wall, contacts off", through_wall("box", "0.1 0.3 0.05", "off"))
member("through a wall, contacts off, loaded", through_wall("box", "0.1 0.3 0.05", "off", stored=True))
member("through a sphere, contacts off", through_wall("sphere", "0.08", "off"))
member("through a cylinder, with a table of contacts", through_wall("cylinder", "0.08 0.3", ContactLaw.resting(1.0)))


def original_as_other(rng: Rng) -> Attempt:
    plan, _ = through_wall("box", "0.1 0.3 0.05", "off")(rng)
    return plan, {"mjcf": plan.twin.original}


member("through a wall, contacts off, and the original as another model", original_as_other)


# What was taken out of the file, and matters


def without(name: str, joint: str, ignore: str, more: str = "", head: str = "") -> None:
    def make(rng: Rng) -> Plan:
        text = arm(rng, 2, joint=lambda i: joint, head=head).replace("</mujoco>", f"{more}</mujoco>")
        return planner.solve(reach(Mechanism.from_mjcf(text, ignore=(ignore,)), [0.8, -0.7]))

    member(name, make)


without("friction loss left out that matters", 'frictionloss="40"', "frictionloss")
without("an equality left out that matters", "", "equality",
        '<equality><joint joint1="j0" joint2="j1" polycoef="0 1 0 0 0"/></equality>')  # fmt: skip
without("a tendon's spring left out that matters", "", "tendon",
        '<tendon><fixed stiffness="4000"><joint joint="j0" coef="1"/></fixed></tendon>')  # fmt: skip


def own_clamp(attribute: str, width: float) -> Callable[[Rng], Plan]:
    """The user's file has a clamp that the plan goes beyond."""

    def make(rng: Rng) -> Plan:
        motor = f'<motor name="m{{0}}" joint="j{{0}}" {attribute}="-{width} {width}"/>'
        return planner.solve(reach(arm(rng, 2, actuator=motor.format), [0.8, -0.7]))

    return make


member("beyond the ctrlrange of its own file", own_clamp("ctrlrange", 3.0))
member("beyond the forcerange of its own file", own_clamp("forcerange", 3.0))


def own_stop(rng: Rng) -> Plan:
    return planner.solve(reach(arm(rng, 2, joint=lambda i: 'range="-0.4 1.5"'), [0.8, -0.7]))


member("beyond a stop of its own file", own_stop)


def late_clamp(rng: Rng) -> Attempt:
    """All is well until the last tenth, in which the arm brakes hard."""
    plan = of("arm")(rng)
    late = np.abs(plan.us[: int(0.9 * plan.N)]).max(axis=0)
    reached = np.abs(plan.us).max(axis=0)
    which = int(np.argmax(reached / late))
    limit = machines.number(0.5 * (late[which] + reached[which]) if reached[which] > 1.02 * late[which] else 0.2)
    edits = {f".//motor[@name='m{which}']": {"forcerange": f"-{limit} {limit}"}}
    return plan, {"mjcf": edited(plan.twin.mjcf, edits)}


member("a motor too weak for the end", late_clamp)


def late_stop(rng: Rng) -> Attempt:
    plan = of("arm")(rng)
    q = plan.xs[:, 0]
    limit = 0.5 * (q[: int(0.9 * plan.N)].max() + q.max()) if q[: int(0.9 * plan.N)].max() < q.max() - 1e-3 else 0.5
    return plan, {"mjcf": edited(plan.twin.mjcf, {".//joint[@name='j0']": {"range": f"-3 {machines.number(limit)}"}})}


member("a stop that is met at the end", late_stop)


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
    return right.placed(m, m.home, position=[0.9, 0.0, 0.8])


missed("a place out of reach", out_of_reach)


def other_direction(rng: Rng) -> Problem:
    """A planar arm cannot turn its hand about the world's x."""
    m = Mechanism.from_mjcf(arm(rng, 2, joint=lambda i: 'damping="0.3"'))
    return right.placed(m, m.home, orientation=[0.9, 0.3, 0.0, 0.0])


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


member("unconverged, feasible, with a soft goal", soft_stopped)
member("unconverged, its status set to CONVERGED", lambda rng: replace(soft_stopped(rng), status=Status.CONVERGED))
member("unconverged, status and numbers made consistent", lambda rng: honest(soft_stopped(rng)))
member("a first guess that says it converged",
       lambda rng: rolled(soft_stopped(rng), np.zeros((100, 2))))  # fmt: skip
member("a detour that says it converged",
       lambda rng: rolled(p := of("arm")(rng), p.us + 2.0 * np.sin(np.linspace(0.0, 6.28, 100))[:, None]))  # fmt: skip
member("a given plan that says it is given", lambda rng: replace(of("arm")(rng), status=Status.GIVEN))


# Numbers that are not what they say


def changed(name: str, kind: str, change: Callable[[Plan], dict[str, Any]]) -> None:
    member(name, lambda rng: replace(p := of(kind)(rng), **change(p)))


changed("controls 0.1 % larger", "arm", lambda p: {"us": 1.001 * p.us})
changed("controls a stage late", "arm", lambda p: {"us": np.roll(p.us, 1, axis=0)})
changed("controls of a cart a stage late", "swing", lambda p: {"us": np.roll(p.us, 1, axis=0)})
changed("controls swapped between joints", "arm", lambda p: {"us": p.us[:, ::-1].copy()})
changed("controls backwards in time", "arm", lambda p: {"us": p.us[::-1].copy()})
changed("controls of the other sign", "cart", lambda p: {"us": -p.us})
changed("enormous controls", "arm", lambda p: {"us": np.full_like(p.us, 1e200)})
changed("controls that are not numbers", "arm", lambda p: {"us": np.full_like(p.us, np.nan)})
changed("states shifted by 1e-6", "arm", lambda p: {"xs": p.xs + 1e-6})
changed("one state wrong between the ends", "arm",
        lambda p: {"xs": p.xs + 0.02 * (np.arange(101) == 50)[:, None]})  # fmt: skip
changed("a path that is wrong and right again at the end", "swing",
        lambda p: {"xs": p.xs + 0.1 * np.sin(np.pi * np.arange(121) / 120)[:, None] * np.array([1, 0, 0, 0])})  # fmt: skip
changed("states of a small arm shifted by 1e-6", "small arm", lambda p: {"xs": p.xs + 1e-6})
changed("a cost 0.1 % larger", "arm", lambda p: {"cost": 1.001 * p.cost})
changed("a cost that is not a number", "arm", lambda p: {"cost": float("nan")})
changed("a gradient that is not its own", "arm", lambda p: {"gradient_norm": p.gradient_norm + 1.0})
changed("gains 0.1 % larger", "arm", lambda p: {"K": 1.001 * p.K})
changed("half the gains", "arm", lambda p: {"K": 0.5 * p.K})
changed("half the gains of a swing", "swing", lambda p: {"K": 0.5 * p.K})
changed("gains of the other sign", "arm", lambda p: {"K": -p.K})
changed("no gains", "swing", lambda p: {"K": 0.0 * p.K})
changed("gains a stage late", "swing", lambda p: {"K": np.roll(p.K, 1, axis=0)})
changed("gains that are not numbers", "arm", lambda p: {"K": np.full_like(p.K, np.nan)})
changed("some gains that are not numbers", "arm",
        lambda p: {"K": p.K * np.where(p.t[1:] < 0.1, np.nan, 1.0)[:, None, None]})  # fmt: skip
changed("enormous gains", "arm", lambda p: {"K": np.full_like(p.K, 1e308)})
changed("times stretched by 1 %", "arm", lambda p: {"t": 1.01 * p.t})
changed("times shifted", "arm", lambda p: {"t": p.t + 0.01})
changed("a start that was moved", "arm", lambda p: {"problem": replace(p.problem, x0=p.problem.x0 + 0.01)})
changed("a start of a small arm that was moved", "small arm",
        lambda p: {"problem": replace(p.problem, x0=p.problem.x0 + 1e-3)})  # fmt: skip


def mirrored(p: Plan) -> dict[str, Any]:
    cost = p.problem.cost
    return {"problem": replace(p.problem, cost=TrackingCost(cost.Q, cost.R, -cost.x_ref, cost.u_ref, cost.space))}


changed("a goal that was mirrored", "arm", mirrored)
changed("a motion that was to return and does not", "arm",
        lambda p: {"problem": replace(p.problem, periodic=Periodic(1e-3))})  # fmt: skip
member("a goal that was mirrored, and numbers made consistent",
       lambda rng: honest(p := of("arm")(rng), **mirrored(p)))  # fmt: skip


def nudged(p: Plan) -> dict[str, Any]:
    cost = p.problem.cost
    return {"problem": replace(p.problem, cost=TrackingCost(cost.Q, cost.R, cost.x_ref + 0.05, cost.u_ref, cost.space))}


member("a goal that was moved by 0.05, and numbers made consistent",
       lambda rng: honest(p := of("arm")(rng), **nudged(p)))  # fmt: skip
changed("outside its bounds", "bounded", lambda p: {"problem": replace(p.problem, limits=Limits(control=5.0))})
changed("outside a range of its joints", "arm",
        lambda p: {"problem": replace(p.problem, limits=Limits(position={"j0": (-0.1, 0.85), "j1": (-0.75, -0.0)}))}
        if p.xs[:, 1].max() > 1e-3 else
        {"problem": replace(p.problem, limits=Limits(velocity={"j0": 0.5}))})  # fmt: skip
changed("the plan of another machine", "arm", lambda p: {
    "problem": planner.solve(reach(arm(np.random.default_rng(99), 2), [0.8, -0.7])).problem})  # fmt: skip


# In the file


def in_file(name: str, change: Callable[[dict[str, Any], dict[str, Any]], object], kind: str = "arm",
            digests: bool = False) -> None:  # fmt: skip
    """A plan whose file was changed by hand, or by somebody who computed its digests again."""

    def make(rng: Rng) -> Plan:
        with tempfile.TemporaryDirectory() as folder:
            path = FILED[kind](rng).save(Path(folder) / "plan.npz")
            with np.load(path) as file:
                arrays = {entry: file[entry].copy() for entry in file.files}
            meta = json.loads(str(arrays.pop("meta")))
            change(arrays, meta)
            if digests:
                kept = {key: value for key, value in meta.items() if key not in ("digests", "format_version")}
                write_archive(path, arrays, kept)
            else:
                np.savez(path, **arrays, meta=np.array(json.dumps(meta)))
            return planner.load_plan(path)

    member(f"a file: {name}", make)


def times(array: str, factor: float) -> Callable[[dict, dict], object]:
    return lambda arrays, meta: arrays.__setitem__(array, arrays[array] * factor)


def model(**edits: dict[str, str]) -> Callable[[dict, dict], object]:
    return lambda arrays, meta: meta.update(mjcf=edited(meta["mjcf"], {"option": {"gravity": "0 0 -9.7"}}))


FILED: dict[str, Callable[[Rng], Plan]] = {
    "arm": of("arm"), "acrobot": of("acrobot"), "two-link": of("two-link"),
    "missed": lambda rng: planner.solve(reach(arm(rng, 2), [0.8, -0.7], final=0.01, plain=True)),
    "soft": soft_stopped,
    "limits": lambda rng: right.exact_within(rng),
    "broken limits": lambda rng: planner.solve(
        reach(arm(rng, 2), [0.8, -0.7], limits=Limits(velocity=0.4)), max_iterations=40
    ),
}  # fmt: skip
in_file("controls by a bit", times("us", 1.0 + 1e-14))
in_file("states by a bit", times("xs", 1.0 + 1e-14))
in_file("gains by a bit", times("K", 1.0 + 1e-14))
in_file("its iterations", times("history", 1.0 + 1e-14))
in_file("times stretched", times("t", 1.001))
in_file("controls, digests computed again", times("us", 1.0 + 1e-6), digests=True)
in_file("states, digests computed again", times("xs", 1.0 + 1e-6), digests=True)
in_file("gains, digests computed again", times("K", 1.01), digests=True)
in_file("times, digests computed again", times("t", 1.001), digests=True)
in_file("its cost", lambda a, m: m.update(cost=0.5 * m["cost"]))
in_file("its cost, digests computed again", lambda a, m: m.update(cost=0.5 * m["cost"]), digests=True)
in_file("its gradient, digests computed again", lambda a, m: m.update(gradient_norm=1.0), digests=True)
in_file("its model", model())
in_file("its model, digests computed again", model(), "acrobot", digests=True)
in_file("the model of an own machine, digests computed again", model(), digests=True)
in_file("its status", lambda a, m: m.update(status="CONVERGED"), "soft")
in_file("its status, digests computed again", lambda a, m: m.update(status="CONVERGED"), "soft", digests=True)
in_file("a status of no kind", lambda a, m: m.update(status="PERFECT"))
in_file("a loosened tolerance", lambda a, m: m.update(tolerance=3.0), "missed")
in_file("a tolerance made soft", lambda a, m: m.update(tolerance="soft"), "missed")
in_file("a loosened tolerance of the limits", lambda a, m: m["limits"].update(tolerance=10.0), "broken limits")
in_file("limits taken away", lambda a, m: m.update(limits=None), "broken limits")
in_file("limits taken away from a good plan", lambda a, m: m.update(limits=None), "limits")
in_file("its parameters", lambda a, m: m["recipe"]["parameters"].update(mass1=0.6), "acrobot")
in_file("its parameters, digests computed again",
        lambda a, m: m["recipe"]["parameters"].update(mass1=0.6), "acrobot", digests=True)  # fmt: skip
in_file("its maps, digests computed again",
        lambda a, m: m["twin"]["to_x_offset"].__setitem__(0, 0.1), digests=True)  # fmt: skip
in_file("an array less", lambda a, m: a.pop("K"))
in_file("a stage less", lambda a, m: a.update(us=a["us"][:-1]))
in_file("a state that is not a number", lambda a, m: a["xs"].__setitem__((3, 0), np.nan))
in_file("a format of the future", lambda a, m: m.update(format_version=99))
in_file("no digests", lambda a, m: m.update(digests={}))


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
        return planner.solve(reach(text, [0.0, -1.0], start=start, duration=1.0, N=4, limits=Limits(**limits)))

    member(name, make)


bulging("a range that is broken between the knots", position={"j0": (-1.0, 0.2)})


def fast_between(rng: Rng) -> Plan:
    """A pendulum that falls through its fastest point between two knots."""
    text = arm(rng, 1, mass=1.0)
    low = np.array([-np.pi / 2 - 1.4, 0.0])
    problem = reach(text, [-np.pi / 2 + 1.4, 0.0], start=low, duration=0.9, N=5, effort=1e-3)
    plan = planner.solve(problem)
    most = float(np.abs(plan.xs[:, 1]).max())
    return planner.solve(replace(problem, limits=Limits(velocity={"j0": 1.01 * most}), us=plan.us))


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
    pole = '<body pos="0 1 0"><joint name="pole" axis="0 -1 0"/><inertial pos="0 0 0.4" mass="1" diaginertia=".1 .1 .1"/></body>'
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
