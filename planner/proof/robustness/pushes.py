"""Pushes: temporary external forces on bodies, unknown to a plan or controller."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from planner.base.arguments import array, number, short_repr
from planner.base.errors import PlannerError
from planner.base.gl import load_mujoco
from planner.proof.replays.simulation import Step

DURATION = 0.1  # s, default duration of a push
_WORD = re.compile(r"^(?P<body>[^=]+)=(?P<force>[^@]*?)N?@(?P<time>[^@/]+?)s?(?:/(?P<duration>[^@/]+?)s?)?$")


@dataclass(frozen=True, eq=False)
class Push:
    """A force at a body.

    Attributes:
        body: Name of a body of the simulated model.
        force: (3,) N in the world's axes at the body's centre of mass; a number is along x.
        time: s, when it begins.
        duration: s.

    Raises:
        PlannerError: A force that is no number or three, a time below 0, a duration that is not above it.
    """

    body: str
    force: Any
    time: float
    duration: float = DURATION

    def __post_init__(self) -> None:
        force = np.array([self.force, 0.0, 0.0]) if np.ndim(self.force) == 0 else self.force
        object.__setattr__(self, "force", array("the force of a push", force, (3,)))
        object.__setattr__(self, "time", number("the time of a push", self.time, minimum=0.0))
        object.__setattr__(self, "duration", number("the duration of a push", self.duration, greater_than=0.0))

    @classmethod
    def parse(cls, text: str) -> Push:
        """A push from "torso=50N@1.0s" or "torso=0,50,0N@1.0s/0.2s": along x, or along three axes, and how long."""
        found = _WORD.match(text.strip())
        try:
            if found is None:
                raise ValueError
            force = [float(part) for part in found["force"].split(",")]
            duration = DURATION if found["duration"] is None else float(found["duration"])
            time = float(found["time"])
        except ValueError:
            expected = "expected BODY=FORCE@TIME, e.g. torso=50N@1.0s, or torso=0,50,0N@1.0s/0.2s with its duration"
            raise PlannerError(f"the push is {short_repr(text)}, {expected}.") from None
        return cls(found["body"], force[0] if len(force) == 1 else force, time, duration)

    def to_dict(self) -> dict[str, Any]:
        """As JSON values."""
        return {"body": self.body, "force": self.force.tolist(), "time": self.time, "duration": self.duration}

    def __str__(self) -> str:
        force = self.force[0] if not self.force[1:].any() else ",".join(f"{one:g}" for one in self.force)
        force = f"{force:g}" if isinstance(force, float) else force
        return f"{self.body}={force}N@{self.time:g}s/{self.duration:g}s"


def bodies_of(model: Any) -> list[str]:
    """Names of the bodies of MuJoCo's model that can be pushed: those that are not part of the world."""
    return [model.body(i).name for i in range(1, model.nbody) if model.body_weldid[i] and model.body(i).name]


def pushed_step(
    model: Any, pushes: Sequence[Push], step: Step | None = None, until: float = math.inf
) -> Step | None:  # fmt: skip
    """A step function for MuJoCo's data with pushes applied; `step` itself where there are none.

    A push acts over the whole steps that begin within it.

    Raises:
        PlannerError: A body that the model does not have, or a push that begins when the run has ended, `until` s.
    """
    known = bodies_of(model)
    for push in pushes:
        if push.body not in known:
            raise PlannerError(
                f"there is no body {push.body!r} to push, expected one of: {', '.join(known) or 'none has a name'}."
            )
        if push.time >= until:
            raise PlannerError(
                f"the push of {push.body!r} begins at {push.time:g} s, and the run ends at {until:g} s: expected an "
                "earlier time, or a longer run."
            )
    if not pushes:
        return step
    mujoco, half = load_mujoco(), 0.5 * model.opt.timestep
    rows = [(model.body(push.body).id, push.force, push.time, push.time + push.duration) for push in pushes]

    def move(data: Any) -> None:
        data.xfrc_applied[:] = 0.0
        now = data.time + half  # so that rounding does not decide at the ends of steps
        for body, force, begins, ends in rows:
            if begins < now < ends:
                data.xfrc_applied[body, :3] += force
        if step is None:
            mujoco.mj_step(model, data)
        else:
            step(data)

    return move
