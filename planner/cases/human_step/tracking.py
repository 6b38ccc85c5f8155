"""Step 3 of the proof of a step: MuJoCo's legs against the plan's, and how much of the difference smoothing explains.

A plan's contact and stops are smooth (model.contact.laws), MuJoCo's are plain springs and dampers with a cone of
friction. So a replay differs from its plan even where nothing is wrong: a touch-down comes a little earlier, and for a
moment speeds differ by a rad/s. The plan's own recursion says by how much: the same controls under the same law without
its smoothing. That predicts the error of an open-loop replay to a few percent, and with gains it is smaller.
The bound is twice the prediction, RMS over the legs' joints and the path: instants of contact may not be judged one by
one, where a touch-down a millisecond early is an error of a rad/s. What is left between MuJoCo and the predicted motion
is the inertia of MuJoCo's friction (walker.IMPRATIO), and integration.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from planner.base.measured import Measurement, Section
from planner.cases.human_step.measures import places
from planner.cases.human_step.phase import GaitPhase
from planner.cases.human_step.walker import IMPRATIO
from planner.dynamics import RigidBodyDynamics
from planner.model.contact.laws import ContactLaw, Law
from planner.model.mechanism import Mechanism
from planner.problem.initial_guess import rollout_states

if TYPE_CHECKING:
    from planner.problem.plan import Plan
    from planner.proof.replays.replaying import Replay

FACTOR = 2.0  # bound over the predicted error
UNEXPLAINED = 0.02  # deg, RMS, added to the bound for errors without smoothing
MAX_ANGLE_ERROR = 0.5  # deg, RMS over the joints of the legs, whatever is predicted


def unsmoothed(mechanism: Mechanism) -> Mechanism:
    """The mechanism with contacts and stops as MuJoCo has them: no ramps, and friction cut off at its cone."""
    contacts = []
    for contact in mechanism.contacts:
        law = contact.law
        plain = ContactLaw.exact(law.stiffness, law.damping, law.slip_damping, law.friction, IMPRATIO)
        contacts.append(replace(contact, law=plain))
    stops = [replace(stop, law=Law(stop.law.stiffness, stop.law.damping)) for stop in mechanism.stops]
    return replace(mechanism, contacts=tuple(contacts), stops=tuple(stops))


@lru_cache(maxsize=1)  # both replays of a plan are compared with it
def without_smoothing(plan: Plan, parts: int) -> np.ndarray:
    """States (N+1, nx) of a plan's controls, open loop and unsmoothed, with so many steps of RK4 per stage."""
    assert plan.problem is not None
    dynamics: Any = plan.problem.dynamics  # rigid bodies, as every step's are
    plain = RigidBodyDynamics(
        unsmoothed(dynamics.mechanism), dynamics.dt / parts, "rk4", prescribed=dynamics.prescribed
    )  # fmt: skip
    return rollout_states(plain, plan.xs[0], np.repeat(plan.us, parts, axis=0))[::parts]


def judge_tracking(step: GaitPhase, run: Replay) -> Section:
    """Compare MuJoCo's legs with the plan's: RMS over all joints."""
    legs, pelvis = places(step)
    joints = list(legs.values())
    # From the plan alone: a replay of a wrong model must not widen its own bound. Twice the replay's step is 0.5 ms.
    plain = without_smoothing(run.plan, max(run.substeps // 2, 1))
    errors = np.degrees(run.error[:, joints])
    expected = _rms(np.degrees(plain - run.plan.xs)[:, joints])
    place, turn = (float(np.abs(run.error[:, part]).max()) for part in (pelvis[:3], pelvis[3:]))
    bound = min(FACTOR * expected + UNEXPLAINED, MAX_ANGLE_ERROR)
    how = "with the plan's gains" if run.feedback else "without feedback"
    measured = [
        Measurement("joint_error", _rms(errors), "deg", bound, f"RMS over the legs' joints, {how}"),
        Measurement("largest_joint_error", float(np.abs(errors).max()), "deg", None, "over the replay"),
        Measurement("predicted_joint_error", expected, "deg", None,
                 "RMS, open loop, by the plan's own law without its smoothing; the bound is twice this"),
        Measurement("pelvis_error", place, "m", None, "largest, of its place"),
        Measurement("pelvis_turn_error", turn, "rad", None, "largest"),
    ]  # fmt: skip
    if not run.feedback:
        left = _rms(np.degrees(run.xs[:: run.substeps] - plain)[:, joints])
        measured.append(
            Measurement("unexplained_joint_error", left, "deg", None, "RMS, MuJoCo from the predicted motion")
        )
    return Section(run.title, tuple(measured))


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))
