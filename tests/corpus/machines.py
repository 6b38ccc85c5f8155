"""Machines of many kinds, drawn by a generator, as MJCF texts."""

from collections.abc import Callable

import numpy as np

SPATIAL = ("0 0 1", "0 1 0", "0 1 0", "1 0 0", "0 1 0", "1 0 0", "0 0 1")  # axes of a spatial arm, base first


def number(value: float) -> str:
    """In an attribute."""
    return f"{value:.9g}"


def between(rng: np.random.Generator, low: float, high: float) -> float:
    """A number whose logarithm is uniform."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def rod(mass: float, length: float) -> str:
    """The inertia of a uniform rod along x, a fiftieth as thick as it is long."""
    across, along = mass * length**2 / 12.0, mass * length**2 / 1250.0
    inertia = " ".join(map(number, (along, across, across)))
    return f'<inertial pos="{number(length / 2)} 0 0" mass="{number(mass)}" diaginertia="{inertia}"/>'


def motor(i: int) -> str:
    """A motor of a joint, without attributes."""
    return f'<motor name="m{i}" joint="j{i}"/>'


def arm(
    rng: np.random.Generator, joints: int, *, length: float = 1.0, mass: float = 1.0, spatial: bool = False,
    joint: Callable[[int], str] = lambda i: "", actuator: Callable[[int], str] = motor, gravity: str = "0 0 -9.81",
    driven: tuple[int, ...] | None = None, more: str = "", head: str = "", shapes: str = "", base: str = "",
) -> str:  # fmt: skip
    """A chain of rods j0, j1, ... in the plane x-z, or about SPATIAL; it lies along x. `hand` is a site at its end."""
    lengths = length * (parts := rng.uniform(0.6, 1.4, joints)) / parts.sum()
    masses = mass * (parts := rng.uniform(0.6, 1.4, joints)) / parts.sum()
    inner = f'<site name="hand" pos="{number(lengths[-1])} 0 0"/>'
    for i in reversed(range(joints)):
        axis = SPATIAL[i % 7] if spatial else "0 -1 0"
        place = f'pos="{number(lengths[i - 1])} 0 0"' if i else ""
        shape = shapes.format(length=number(lengths[i]), size=number(0.02 * length))
        inner = (
            f'<body name="b{i}" {place}><joint name="j{i}" axis="{axis}" {joint(i)}/>{rod(masses[i], lengths[i])}'
            f"{shape}{inner}</body>"
        )
    actuators = "".join(actuator(i) for i in (range(joints) if driven is None else driven))
    contact = "" if shapes else '<flag contact="disable"/>'
    return (
        f'<mujoco><compiler angle="radian" autolimits="true"/>{head}<option gravity="{gravity}">{contact}</option>'
        f"<worldbody>{more}{base.replace('INNER', inner) if base else inner}</worldbody>"
        f"<actuator>{actuators}</actuator></mujoco>"
    )


def cart(rng: np.random.Generator, poles: int = 1, *, scale: float = 1.0, rail: str = "", damping: float = 0.0) -> str:
    """A cart on a rail with a chain of hanging poles; only the cart is driven."""
    inner = ""
    for i in reversed(range(poles)):
        length, mass = scale * rng.uniform(0.4, 0.8), scale**3 * rng.uniform(0.1, 0.3)
        place = f'pos="0 0 {number(-length)}"' if i else ""
        inertia = " ".join(number(mass * length**2 * share) for share in (1 / 12, 1 / 12, 1 / 1200))
        inner = (
            f'<body {place}><joint name="pole{i}" axis="0 1 0" damping="{number(damping)}"/><inertial '
            f'pos="0 0 {number(-length / 2)}" mass="{number(mass)}" diaginertia="{inertia}"/>{inner}</body>'
        )
    return (
        '<mujoco><compiler angle="radian" autolimits="true"/><option gravity="0 0 -9.81"/><worldbody><body>'
        f'<joint name="rail" type="slide" axis="1 0 0" {rail}/><inertial pos="0 0 0" mass="{number(scale**3)}" '
        f'diaginertia="{number(0.1 * scale**5)} {number(0.1 * scale**5)} {number(0.1 * scale**5)}"/>{inner}</body>'
        '</worldbody><actuator><motor name="push" joint="rail"/></actuator></mujoco>'
    )


def gantry(rng: np.random.Generator, *, more: str = "") -> str:
    """Three slides that carry one another, and a swinging load."""
    a, b, c = rng.uniform(0.5, 5.0, 3)
    unit = 'diaginertia="0.1 0.1 0.1"'
    return f"""<mujoco><compiler angle="radian"/><option gravity="0 0 -9.81"/><worldbody>
      <body><joint name="x" type="slide" axis="1 0 0" damping="{number(a)}"/><inertial pos="0 0 0" mass="{a}" {unit}/>
      <body><joint name="y" type="slide" axis="0 1 0" {more}/><inertial pos="0 0 0" mass="{b}" {unit}/>
      <body><joint name="z" type="slide" axis="0 0 1"/><inertial pos="0 0 0" mass="{c}" {unit}/>
      <body><joint name="load" axis="0 1 0" damping="0.3"/><inertial pos="0 0 -0.3" mass="0.4" {unit}/></body>
      </body></body></body></worldbody><actuator><motor name="mx" joint="x"/><motor name="my" joint="y"/>
      <motor name="mz" joint="z"/></actuator></mujoco>"""


def tree(rng: np.random.Generator, *, free: bool = False, balls: bool = False, gravity: str = "0 0 0") -> str:
    """A trunk with two arms of two joints each, fixed at a hinge or floating; shoulders may be balls."""
    size = between(rng, 0.1, 2.0)
    mass = between(rng, 0.1, 20.0)

    def limb(side: int) -> str:
        length, weight = size * rng.uniform(0.3, 0.6), mass * rng.uniform(0.1, 0.3)
        shoulder = (
            f'<joint name="s{side}" type="ball" damping="{number(0.02 * weight * length**2)}"/>' if balls
            else f'<joint name="s{side}" axis="0 1 {0.3 * side}"/>'
        )  # fmt: skip
        return (
            f'<body pos="0 {number(side * size / 3)} 0" euler="0 0 {side * 1.2}">{shoulder}{rod(weight, length)}'
            f'<body pos="{number(length)} 0 0"><joint name="e{side}" axis="0 1 0"/>{rod(weight / 2, length)}</body>'
            "</body>"
        )

    root = '<freejoint name="root"/>' if free else '<joint name="root" axis="0 0 1"/>'
    names = ["s1", "e1", "s-1", "e-1"] if free else ["root", "s1", "e1", "s-1", "e-1"]
    gears = {name: ["1 0 0", "0 1 0", "0 0 1"] if balls and name[0] == "s" else ["1"] for name in names}
    motors = "".join(
        f'<motor name="{name}{k}" joint="{name}" gear="{gear}"/>'
        for name, rows in gears.items() for k, gear in enumerate(rows)
    )  # fmt: skip
    inertia = " ".join(number(mass * size**2 * share) for share in (0.1, 0.12, 0.15))
    return (
        f'<mujoco><compiler angle="radian"/><option gravity="{gravity}"/><worldbody><body name="trunk">{root}'
        f'<inertial pos="0 0 0" mass="{number(mass)}" diaginertia="{inertia}"/>{limb(1)}{limb(-1)}</body></worldbody>'
        f"<actuator>{motors}</actuator></mujoco>"
    )


def ball_on_floor(rng: np.random.Generator, mass: float) -> str:
    """A ball that is pushed along and up above a floor."""
    radius = rng.uniform(0.05, 0.15)
    return f"""<mujoco><option gravity="0 0 -9.81"/><worldbody><geom name="floor" type="plane" size="5 5 1"/>
      <body pos="0 0 {number(radius + 0.3)}"><joint name="x" type="slide" axis="1 0 0"/>
      <joint name="z" type="slide" axis="0 0 1"/><geom name="ball" size="{number(radius)}" mass="{number(mass)}"/>
      </body></worldbody><actuator><motor name="mx" joint="x"/><motor name="mz" joint="z"/></actuator></mujoco>"""


def pusher(rng: np.random.Generator, mass: float) -> str:
    """A driven ball on a rail that pushes another one along the same rail."""
    return f"""<mujoco><option gravity="0 0 0"/><worldbody>
      <body><joint name="hand" type="slide" axis="1 0 0"/><geom name="hand" size="0.1" mass="{number(mass)}"/></body>
      <body pos="0.3 0 0"><joint name="thing" type="slide" axis="1 0 0" damping="{number(mass)}"/>
      <geom name="thing" size="0.1" mass="{number(mass * rng.uniform(0.5, 2.0))}"/></body></worldbody>
      <actuator><motor name="push" joint="hand"/></actuator></mujoco>"""
