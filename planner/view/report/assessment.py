"""The proof in the three parts of an assessment, in the terms of ASME V&V 10 and V&V 20.

    code verification        the equations are solved rightly
    solution verification    how large the numerical error of this plan is
    validation               how far the model is the machine; without an experiment, what stands in for one

Each part states what was done, the values beside their bounds, what is not covered, and the use of the result.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from planner.base.measured import Section
from planner.model.capabilities import capabilities_of
from planner.problem.plan import Plan
from planner.proof.error_scales import SHARE, SMOOTHED, has_contacts, is_nonsmooth
from planner.view.plots.style import sampling_words

if TYPE_CHECKING:
    from planner.proof import Proof

_CODE = ("parity", "same_step", "order")
_SOLUTION = ("plan", "optimality", "refined_open_loop", "refined_feedback", "growth", "order", "goal")
_VALIDATION = ("your_file", "another_ground", "perturbed", "controller", "hold")
_OF_CODE = ("observed_order", "order_shortfall")  # values of step convergence that concern the code, not this plan


@dataclass(frozen=True)
class Part:
    """One part of an assessment."""

    title: str
    done: str
    steps: tuple[Section, ...]
    uncovered: str
    use: str


def assessment(plan: Plan, proof: Proof) -> Iterator[Part]:
    """The parts of the assessment that a proof is."""
    sections = proof.sections
    others = tuple(name for name in sections if name not in {*_CODE, *_SOLUTION, *_VALIDATION})  # other engines
    yield Part(
        "Code verification",
        "Are the equations solved rightly? The plan's dynamics are compared with MuJoCo's at random states, contact "
        "forces included. Where nothing touches, MuJoCo also repeats the plan at the plan's own step, and its error "
        f"must shrink by the integrator's order as that step is halved. {independence(plan)}",
        tuple(_chosen(sections, (*_CODE, *others), code=True)),
        "An error that both sides share. The states at which the equations are compared are drawn at random: a fault "
        "that shows nowhere among them is not seen.",
        "To trust that the equations of the plan are those of the model.",
    )
    yield Part(
        "Solution verification",
        "How large is the numerical error of this plan? Its numbers are computed again from its states and controls. "
        f"MuJoCo then repeats the controls at a refined step, open loop and with {_gains(proof)}; an error passes up "
        f"to {100.0 * (SMOOTHED if is_nonsmooth(plan) else SHARE):g} % of its coordinate's range of motion. "
        "The growth of errors is predicted from the plan alone, and cost and end are extrapolated to a step of zero.",
        tuple(_chosen(sections, _SOLUTION, code=False)),
        "Other minima: the solver finds a local one, and another may cost less. Errors of the model itself."
        + (" Velocities along the path are shown and not judged, since they jump at contacts."
           if has_contacts(plan) else ""),
        "To trust that this motion is the model's under these controls, within the bounds above.",
    )  # fmt: skip
    yield Part(
        "Validation",
        "Is the model the machine? No experiment was made: nothing measured on a machine stands beside this plan. In "
        "its place stand the model exactly as it was given, other grounds, machines that differ at random, slower "
        "gains and encoders, and the hold of the goal, as far as each applies.",
        tuple(_chosen(sections, _VALIDATION, code=False)),
        _open(proof),
        f"To decide whether an experiment with {_intended(proof)} is worthwhile, on the machine that the model "
        "describes and from the planned start. It does not replace the experiment.",
    )  # fmt: skip


def independence(plan: Plan) -> str:
    """What on the plan's side is independent of MuJoCo."""
    if plan.problem is not None and capabilities_of(plan.problem.dynamics).mechanism is not None:
        return (
            "Independent of MuJoCo are the recursions, their derivatives and the integrator. Not independent is the "
            "reading of the file: MuJoCo's compiler makes tree, masses and inertias of it for both sides. Pinocchio "
            "and Drake read it by parsers of their own (planner prove --engine)."
        )
    return (
        "Independent of MuJoCo are the equations of motion, their derivatives and the integrator: they are written "
        "without the file that MuJoCo reads."
    )


def _chosen(sections: dict[str, Section], names: tuple[str, ...], code: bool) -> Iterator[Section]:
    """The sections by name; of step convergence, the values about the code or those about the solution."""
    for name in names:
        section = sections.get(name)
        if section is not None and name == "order":
            own = tuple(one for one in section.measured if (one.name in _OF_CODE) is code)
            section = replace(section, title=section.title if code else "step of zero, open loop", measured=own)
        if section is not None:
            yield section


def _gains(proof: Proof) -> str:
    """How the gains act in the judged replay."""
    run = proof.replays.get("feedback") if hasattr(proof, "replays") else None
    if run is None or run.sampling is None:
        return "the plan's gains"
    return f"the plan's gains as a controller applies them ({sampling_words(run.sampling)})"


def _intended(proof: Proof) -> str:
    """The controller that the verdict covers."""
    if not proof.mode:
        return "a better plan"
    return "the plan's controls alone" if proof.mode == "open-loop" else f"the plan's controls with {_gains(proof)}"


def _open(proof: Proof) -> str:
    """Open questions."""
    phrases = [f"The verdict does not cover: {'; '.join(proof.not_checked)}." if proof.not_checked else ""]
    found = proof.monte_carlo
    if found is None or not found.done:
        phrases.append("No machine that differs was simulated.")
    else:
        phrases.append(f"The machines differ by what was drawn and by nothing else ({found.perturbation}).")
    phrases.append(
        "Open remains whether masses, friction, contact, motors and sensors are those of the model. What it lacks, "
        "play, bending or wear for example, is in none of these simulations."
    )
    return " ".join(filter(None, phrases))
