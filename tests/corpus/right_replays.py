"""Right plans beside what they do not meet, and of machines and goals that a proof has to take as they are."""

from collections.abc import Callable
from typing import Any

import numpy as np

from corpus.asking import member
from corpus.machines import number
from corpus.replays import Beside, Plan, Rng, carried, fingers, loaded, lying, reach, siblings, walled

SIBLINGS = 8


def away(kind: Callable[..., Beside], *arguments: Any) -> Callable[[Rng], Plan]:
    """A plan that leaves what is beside the machine."""

    def make(rng: Rng) -> Plan:
        drawn = kind(rng, *arguments)
        return reach(drawn.text, drawn.away, **drawn.options)

    return make


def rods(rng: Rng, lone: str = "", tendon: str = "", first: str = '<motor joint="a"/>') -> str:
    """Two rods, and perhaps a slide that carries nothing and a fixed tendon."""
    length, mass = rng.uniform(0.3, 0.8), rng.uniform(0.5, 2.0)
    shape = 'size=".02" contype="0" conaffinity="0"'
    rod = f'<geom type="capsule" fromto="0 0 0 {number(length)} 0 0" mass="{number(mass)}" {shape}/>'
    return (
        f'<mujoco><worldbody>{lone}<body><joint name="a" axis="0 1 0" damping=".1"/>{rod}'
        f'<body pos="{number(length)} 0 0">'
        f'<joint name="b" axis="0 1 0" damping=".1"/>{rod}</body></body></worldbody>{tendon}<actuator>{first}'
        '<motor joint="b"/></actuator></mujoco>'
    )


def clamped_tendon(rng: Rng) -> Plan:
    """A tendon that bounds the force of its actuator far above what the plan asks for."""
    tendon = (
        '<tendon><fixed name="t" actuatorfrclimited="true" actuatorfrcrange="-90 90"><joint joint="a" coef="1"/>'
        f'<joint joint="b" coef="{number(-rng.uniform(0.2, 0.6))}"/></fixed></tendon>'
    )
    text = rods(rng, tendon=tendon, first=f'<general tendon="t" gainprm="{number(rng.uniform(20.0, 90.0))}"/>')
    return reach(text, rng.uniform(-0.8, 0.8, 2))


def lone_slide(rng: Rng) -> Plan:
    lone = (
        '<body><joint name="s" type="slide" axis="1 0 0"/><geom size=".1" contype="0" conaffinity="0" '
        f'mass="{number(rng.uniform(0.2, 3.0))}"/></body>'
    )
    return reach(rods(rng, lone), rng.uniform(0.3, 0.8, 3), prescribed=("s",))


def sum_of_angles(rng: Rng) -> Plan:
    """The hand's direction is asked for, at rest."""
    final = np.diag([0.0, 0.0, 1e2, 1e2])
    final[:2, :2] = 1e3
    return reach(rods(rng), rng.uniform(0.2, 0.9, 2), final=final)


for _name, _make in {
    "away from a wall": away(walled),
    "off a table that it lies on": away(lying, 0.0, 1e-4),
    "out of a table that it penetrates": away(lying, -9e-4, -1e-5),
    "closed fingers that open": away(fingers),
    "a prescribed cart away from a wall": away(carried),
    "a payload away from a wall": away(loaded),
    "a tendon that bounds its actuator": clamped_tendon,
    "a prescribed slide that carries nothing": lone_slide,
    "a sum of two angles": sum_of_angles,
}.items():
    siblings(lambda name, make: member(name)(make), _name, _make, SIBLINGS)
