"""The planar arm of two links that cases 1 and 2 share: its model, its cost (Eq. 5), how it is shown and judged.

The paper gives no numbers for the links. Two uniform rods of 0.5 kg and 1 m need an effort of 72.6 along its first
guess, where it states 73.6; so these are ours. A rod's inertia along itself is a thousandth of that across: MuJoCo
refuses a body without thickness, and motion in a plane never feels it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from planner.base.arguments import choice, count, number
from planner.base.errors import PlannerError
from planner.base.measured import Measured, Section
from planner.dynamics import INTEGRATORS, RigidBodyDynamics
from planner.model.mechanism import Mechanism
from planner.model.mjcf.text import edited, model_path, model_text, written
from planner.problem.appearance import Appearance, Panel, Readout
from planner.problem.costs.tracking import TrackingCost

if TYPE_CHECKING:
    from planner.proof.replaying import Replay

LIGHTEST, HEAVIEST = 1e-3, 1e3  # kg and m, of a link
LARGEST = 1e6  # of weights
MOST_STAGES = 100_000

UPRIGHT = np.array([0.5 * np.pi, 0.0])  # q_d of Eq. 5, rad

_THIN = 1e-3  # inertia of a rod along itself over that across


@dataclass(frozen=True)
class Links:
    """Two uniform rods in gravity: kg, m, m/s^2. Checked.

    Attributes:
        mass1: Of the upper arm.
        mass2: Of the forearm.
        length1: Of the upper arm.
        length2: Of the forearm.
        gravity: Downwards; 0 is an arm on a table.
    """

    mass1: float
    mass2: float
    length1: float
    length2: float
    gravity: float

    def __post_init__(self) -> None:
        for name in ("mass1", "mass2", "length1", "length2"):
            value = number(name, getattr(self, name), least=LIGHTEST, most=HEAVIEST)
            object.__setattr__(self, name, value)
        object.__setattr__(self, "gravity", number("gravity", self.gravity, least=0.0, most=HEAVIEST))

    @property
    def scale(self) -> float:
        """Reach over that of the model's own file: what is only seen is drawn so many times larger."""
        return 0.5 * (self.length1 + self.length2)


def arm_mechanism(model: str, links: Links) -> Mechanism:
    """The model of a case with these links, read from the very text that a replay uses."""
    return Mechanism.from_mjcf(arm_text(model, links))


def arm_text(model: str, links: Links) -> str:
    """The MJCF text of "two_link" or "acrobot" with these links.

    What is seen is drawn larger with the arm; a model of the file's own lengths is the file.
    """
    s, l1, l2 = links.scale, links.length1, links.length2
    hub = "shoulder_motor" if model == "two_link" else "shoulder_pin"
    edits = {
        "option": {"gravity": f"0 0 {written(-links.gravity)}"},
        "worldbody/body/inertial": _rod(links.mass1, l1),
        "worldbody/body/body": {"pos": _text(l1, 0, 0)},
        "worldbody/body/body/inertial": _rod(links.mass2, l2),
        ".//site[@name='tip']": {"pos": _text(l2, 0, 0), "size": _text(0.01 * s)},
        ".//site[@name='target']": {"pos": _text(0, 0, l1 + l2), "size": _text(0.085 * s)},
        ".//geom[@name='upper_arm']": {"fromto": _text(0, 0.1 * s, 0, l1, 0.1 * s, 0), "size": _text(0.055 * s)},
        f".//geom[@name='{hub}']": {"fromto": _text(0, 0.21 * s, 0, 0, 0.04 * s, 0), "size": _text(0.085 * s)},
        ".//geom[@name='elbow_motor']": {"fromto": _text(l1, 0.165 * s, 0, l1, 0.04 * s, 0), "size": _text(0.075 * s)},
        ".//geom[@name='forearm']": {"fromto": _text(0, 0, 0, l2, 0, 0), "size": _text(0.045 * s)},
        ".//geom[@name='elbow_cap']": {"fromto": _text(0, 0.04 * s, 0, 0, -0.055 * s, 0), "size": _text(0.065 * s)},
        ".//geom[@name='hand']": {"pos": _text(l2, 0, 0), "size": _text(0.06 * s)},
        ".//geom[@name='floor']": {"pos": _text(0, 0, -2.2 * s)},
        ".//geom[@name='column']": {"pos": _text(0, 0.32 * s, -1.05 * s), "size": _sized(s, 0.075, 0.075, 1.15)},
        ".//geom[@name='column_foot']": {"pos": _text(0, 0.32 * s, -2.17 * s), "size": _sized(s, 0.3, 0.3, 0.03)},
        ".//geom[@name='bearing']": {"fromto": _text(0, 0.4 * s, 0, 0, 0.21 * s, 0), "size": _text(0.11 * s)},
        ".//light[@name='key']": {"pos": _text(-2.8 * s, -3.2 * s, 7.8 * s)},
        "statistic": {"center": _text(0, 0, -0.2 * s), "extent": _text(6.0 * s)},
    }
    return edited(model_text(model_path(model) / "scene.xml"), edits)


def _rod(mass: float, length: float) -> dict[str, str]:
    across = mass * length**2 / 12.0
    return {
        "pos": _text(0.5 * length, 0, 0),
        "mass": written(mass),
        "diaginertia": _text(_THIN * across, across, across),
    }


def _text(*values: float) -> str:
    return " ".join(written(value) for value in values)


def _sized(scale: float, *values: float) -> str:
    return _text(*(scale * value for value in values))


def stages(duration: float, horizon: int | None) -> tuple[float, int]:
    """The checked duration, s, and the number of stages: 100 a second where none is given."""
    duration = number("duration", duration, above=0.0, most=LARGEST)
    if horizon is None and 100.0 * duration > MOST_STAGES:
        raise PlannerError(f"duration is {duration:g} s, expected at most {MOST_STAGES // 100} s without a horizon.")
    N = max(1, round(100.0 * duration)) if horizon is None else count("horizon", horizon, most=MOST_STAGES)
    return duration, N


def arm_dynamics(model: str, links: Links, dt: float, integrator: str) -> RigidBodyDynamics:
    """The arm, discretised."""
    choice("integrator", integrator, INTEGRATORS)
    return RigidBodyDynamics(arm_mechanism(model, links), dt, integrator)


def arm_cost(
    dynamics: RigidBodyDynamics, horizon: int, position_weight: float, velocity_weight: float, effort_weight: float
) -> TrackingCost:
    """Eq. 5, with a factor 1/2 on every term: our weights of the end are twice the paper's c1 and c2."""
    return TrackingCost.joints(
        dynamics, np.concatenate([UPRIGHT, np.zeros(2)]), horizon,
        final_position=number("position_weight", position_weight, least=0.0, most=LARGEST),
        final_velocity=number("velocity_weight", velocity_weight, least=0.0, most=LARGEST),
        effort=number("effort_weight", effort_weight, above=0.0, most=LARGEST),
    )  # fmt: skip


def arm_appearance(title: str, links: Links, controls: tuple[str, ...], speed: float) -> Appearance:
    """The pair side by side, the path of the tip, and where the tip should come to rest."""
    s, top = links.scale, links.length1 + links.length2
    return Appearance(
        title=title,
        readouts=(Readout("shoulder", 0, "rad"), Readout("elbow", 1, "rad")),
        ghost_offset=(-3.6 * s, 0.0, 0.0),  # to the left, where the numbers stand: machine and goal are in the open
        goal_line=((-0.4 * s, 0.0, top), (0.4 * s, 0.0, top)),
        goal_label="goal",
        azimuth=90.0,
        elevation=-5.0,
        speed=speed,
        plots=(
            Panel("Joint angles", "angle, rad", states=((0, "shoulder"), (1, "elbow"))),
            Panel("Joint rates", "rate, rad/s", states=((2, "shoulder"), (3, "elbow"))),
            Panel("Motors", "torque, N m", controls=tuple(enumerate(controls))),
        ),
        trail="tip",
    )


def judge_upright(replay: Replay, tolerance: float) -> Section:
    """Whether the plan, and MuJoCo with it, come to rest upright, within a tolerance in rad and rad/s."""
    misses = {
        "planned": (replay.plan.xs[-1], "the plan's end"),
        "replayed": (replay.xs[-1], "MuJoCo's end"),
    }
    why = "the final weight w is soft: a plan stops where the effort of the next radian, w times the miss, is worth it"
    measured = []
    for who, (x, whose) in misses.items():
        angle, rate = float(np.abs(x[:2] - UPRIGHT).max()), float(np.abs(x[2:]).max())
        measured += [
            Measured(f"{who}_angle_miss", angle, "rad", tolerance, f"{whose} from upright, larger joint; {why}"),
            Measured(f"{who}_rate_miss", rate, "rad/s", tolerance, f"{whose} from rest, larger joint"),
        ]
    return Section("goal", tuple(measured))
