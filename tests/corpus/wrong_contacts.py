"""Wrong plans: contacts, stops, clamps and whatever else the plan does not know or knows otherwise."""

from collections.abc import Callable
from typing import Any

import numpy as np

import planner
from corpus import machines
from corpus.asking import again, reach
from corpus.machines import arm
from corpus.planting import Attempt, Rng, law_of, member, of
from corpus.right_arms import CAPSULE
from planner import Mechanism, Plan
from planner.contact import ContactLaw
from planner.model.mjcf.text import edited

# Contact


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
        return (again(plan) if stored else plan), {}

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
        '<equality><joint joint1="j0" joint2="j1" polycoef="0 1 0.01 0 0"/></equality>')  # fmt: skip
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
    """The goal itself is 0.05 rad beyond it."""
    plan = of("arm")(rng)
    limit = machines.number(plan.xs[-1, 0] - 0.05)
    return plan, {"mjcf": edited(plan.twin.mjcf, {".//joint[@name='j0']": {"range": f"-3 {limit}"}})}


member("a stop that is met at the end", late_stop)
