"""The planar arm of two links of cases 1 and 2: its model, its cost (Eq. 5), its pictures and the check of its goal.

    number                value             from
    masses, lengths       0.5 kg, 1 m       ours: uniform rods
    inertia along a rod   0.001 of across   ours: MuJoCo refuses a body without thickness; planar motion ignores it
    goal                  (pi/2, 0)         paper, Eq. 5

The paper states no masses and an effort of 73.6 along its first guess; these rods need 72.6.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from planner.base.arguments import choice, number
from planner.base.measured import Measurement
from planner.cases.horizon import LARGEST
from planner.dynamics import INTEGRATORS, RigidBodyDynamics
from planner.model.mechanism import Mechanism
from planner.model.mjcf.text import edited, model_path, model_text, written
from planner.problem.appearance import Appearance, Panel, Readout
from planner.problem.costs.tracking import TrackingCost

if TYPE_CHECKING:
    from planner.proof.replays.replaying import Replay

LIGHTEST, HEAVIEST = 1e-3, 1e3  # kg and m, of a link
UPRIGHT = np.array([0.5 * np.pi, 0.0])  # q_d of Eq. 5, rad

_THIN = 1e-3  # inertia of a rod along itself over that across


@dataclass(frozen=True)
class Links:
    """Two uniform rods, upper arm and forearm, in gravity, with checked values."""

    mass1: float  # kg
    mass2: float  # kg
    length1: float  # m
    length2: float  # m
    gravity: float  # m/s^2, downward; 0 for an arm on a table

    def __post_init__(self) -> None:
        for name, value in vars(self).copy().items():
            least = 0.0 if name == "gravity" else LIGHTEST
            object.__setattr__(self, name, number(name, value, minimum=least, maximum=HEAVIEST))

    @property
    def scale(self) -> float:
        """Reach over that of the model file: factor of all shapes that are only drawn."""
        return 0.5 * (self.length1 + self.length2)


def arm_text(model: str, links: Links) -> str:
    """The MJCF text of the model "two_link" or "acrobot" with these links; drawn shapes are scaled with the arm."""
    s, l1, l2 = links.scale, links.length1, links.length2
    hub = "shoulder_motor" if model == "two_link" else "shoulder_pin"
    edits = {
        "option": {"gravity": f"0 0 {written(-links.gravity)}"},
        "worldbody/body/inertial": _rod(links.mass1, l1),
        "worldbody/body/body": {"pos": written(l1, 0, 0)},
        "worldbody/body/body/inertial": _rod(links.mass2, l2),
        ".//site[@name='tip']": {"pos": written(l2, 0, 0), "size": written(0.01 * s)},
        ".//site[@name='target']": {"pos": written(0, 0, l1 + l2), "size": written(0.085 * s)},
        ".//geom[@name='upper_arm']": {"fromto": written(0, 0.1 * s, 0, l1, 0.1 * s, 0), "size": written(0.055 * s)},
        f".//geom[@name='{hub}']": {"fromto": written(0, 0.21 * s, 0, 0, 0.04 * s, 0), "size": written(0.085 * s)},
        ".//geom[@name='elbow_motor']":
            {"fromto": written(l1, 0.165 * s, 0, l1, 0.04 * s, 0), "size": written(0.075 * s)},
        ".//geom[@name='forearm']": {"fromto": written(0, 0, 0, l2, 0, 0), "size": written(0.045 * s)},
        ".//geom[@name='elbow_cap']": {"fromto": written(0, 0.04 * s, 0, 0, -0.055 * s, 0), "size": written(0.065 * s)},
        ".//geom[@name='hand']": {"pos": written(l2, 0, 0), "size": written(0.06 * s)},
        ".//geom[@name='floor']": {"pos": written(0, 0, -2.2 * s)},
        ".//geom[@name='column']": {"pos": written(0, 0.32 * s, -1.05 * s), "size": _sized(s, 0.075, 0.075, 1.15)},
        ".//geom[@name='column_foot']": {"pos": written(0, 0.32 * s, -2.17 * s), "size": _sized(s, 0.3, 0.3, 0.03)},
        ".//geom[@name='bearing']": {"fromto": written(0, 0.4 * s, 0, 0, 0.21 * s, 0), "size": written(0.11 * s)},
        ".//light[@name='key']": {"pos": written(-2.8 * s, -3.2 * s, 7.8 * s)},
        "statistic": {"center": written(0, 0, -0.2 * s), "extent": written(6.0 * s)},
    }  # fmt: skip
    return edited(model_text(model_path(model) / "scene.xml"), edits)


def _rod(mass: float, length: float) -> dict[str, str]:
    across = mass * length**2 / 12.0
    inertia = written(_THIN * across, across, across)
    return {"pos": written(0.5 * length, 0, 0), "mass": written(mass), "diaginertia": inertia}


def _sized(scale: float, *values: float) -> str:
    return written(*(scale * value for value in values))


def arm_dynamics(model: str, links: Links, dt: float, integrator: str) -> RigidBodyDynamics:
    """The discretized arm, read from the same text that the replay uses."""
    choice("integrator", integrator, INTEGRATORS)
    return RigidBodyDynamics(Mechanism.from_mjcf(arm_text(model, links)), dt, integrator)


def arm_cost(
    dynamics: RigidBodyDynamics, horizon: int, position_weight: float, velocity_weight: float, effort_weight: float
) -> TrackingCost:
    """The cost of Eq. 5 with a factor 1/2 on every term, so that the final weights are twice the paper's c1 and c2."""
    return TrackingCost.joints(
        dynamics, np.concatenate([UPRIGHT, np.zeros(2)]), horizon,
        final_position=number("position_weight", position_weight, minimum=0.0, maximum=LARGEST),
        final_velocity=number("velocity_weight", velocity_weight, minimum=0.0, maximum=LARGEST),
        effort=number("effort_weight", effort_weight, greater_than=0.0, maximum=LARGEST),
    )  # fmt: skip


def arm_appearance(title: str, links: Links, controls: tuple[str, ...], speed: float) -> Appearance:
    """Plan and replay side by side, the path of the tip, and a line at the goal of the tip."""
    s, top = links.scale, links.length1 + links.length2
    return Appearance(
        title=title,
        readouts=(Readout("shoulder", 0, "rad"), Readout("elbow", 1, "rad")),
        ghost_offset=(-3.6 * s, 0.0, 0.0),  # to the left, so that the numbers do not cover machine and goal
        goal_line=((-0.4 * s, 0.0, top), (0.4 * s, 0.0, top)), goal_label="goal", trail="tip",
        azimuth=90.0, elevation=-5.0, speed=speed,
        plots=(
            Panel("Joint angles", "angle, rad", states=((0, "shoulder"), (1, "elbow"))),
            Panel("Joint rates", "rate, rad/s", states=((2, "shoulder"), (3, "elbow"))),
            Panel("Motors", "torque, N m", controls=tuple(enumerate(controls))),
        ),
    )  # fmt: skip


def ends_of(replay: Replay) -> dict[str, np.ndarray]:
    """The last states (nx,) of the plan and of its replay."""
    return {"planned": replay.plan.xs[-1], "replayed": replay.xs[-1]}


def end_misses(who: str, x: np.ndarray, goal: np.ndarray, tolerance: float, why: str) -> list[Measurement]:
    """Distances of an end x (2 n,), "planned" or "replayed", from a goal (2 n,) at rest; n angles, then n rates."""
    whose = "the plan's end" if who == "planned" else "MuJoCo's end"
    angle, rate = np.abs(x - goal).reshape(2, -1).max(axis=1).tolist()
    return [
        Measurement(f"{who}_angle_miss", angle, "rad", tolerance, f"{whose} from the goal, largest joint; {why}"),
        Measurement(f"{who}_rate_miss", rate, "rad/s", tolerance, f"{whose} from rest, largest joint"),
    ]
