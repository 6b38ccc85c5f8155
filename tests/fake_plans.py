"""Plans, replays and proofs that nobody computed, for tests of plots, pages and files."""

from types import SimpleNamespace

import numpy as np

from planner.base.measured import Measurement, Section
from planner.model.twin import Twin
from planner.problem.appearance import Appearance, Panel
from planner.problem.plan import Iteration, Plan, Status
from planner.problem.problem_parts import Recipe
from planner.proof.error_propagation import ErrorPropagation
from planner.proof.replays.compiled_twin import CompiledTwin
from planner.proof.replays.replaying import Replay
from planner.proof.robustness.perturbation import Perturbation
from planner.proof.robustness.perturbed import RobustnessResult
from planner.proof.step_convergence import StepConvergence

MODES = ("open-loop", "feedback")
APPEARANCE = Appearance(
    "A mass on a spring",
    plots=(
        Panel("Height", "height (in)", states=((0, "height"),), difference=True),
        Panel("Piston", "piston (in)", states=((2, "piston"),), controls=((0, "flow (in/s)"),)),
    ),
)
COORDINATES = (("height", "in"), ("velocity of height", "in/s"), ("piston", "in"))
N, SUBSTEPS, DT = 20, 5, 0.1
MODEL = """<mujoco model='a & b'><worldbody><body><joint type="slide"/><geom size=".1"/>
  <body><joint type="slide"/><geom size=".1"/></body></body></worldbody></mujoco>"""


def states(t):
    """Three made-up states: height, its rate, piston."""
    return np.stack([np.sin(3 * t), 3 * np.cos(3 * t), 0.2 * t], axis=-1)


def make_plan():
    """Twenty stages of what nobody solved."""
    t = np.linspace(0.0, N * DT, N + 1)
    problem = SimpleNamespace(
        appearance=APPEARANCE, dynamics=SimpleNamespace(nx=3, coordinates=COORDINATES), bounds=None, ranges=None,
        limits=None, trajectory_constraints=None, periodic=None, requirements=None, goal_specs=(), stances=(),
        tolerance=None, x0=np.zeros(3),
    )  # fmt: skip
    history = [Iteration(n, 5.0 + 10.0 ** (2 - n), 10.0 ** (1 - n), 1.0, 1.0, 1.0, 0.0) for n in range(6)]
    history.append(Iteration(6, 5.0, 1e-6, 0.0, 0.0, 0.0, 0.0))
    twin = Twin(MODEL, np.eye(3), np.zeros(3), np.eye(3)[None], np.zeros((1, 3)))
    return Plan(
        t, states(t), np.linspace(0.2, 1.0, N)[:, None], np.zeros((N, 1, 3)), 5.0, 1e-6,
        Status.CONVERGED, tuple(history), problem=problem, twin=twin,
        recipe=Recipe("spring", {"height": 20.0, "horizon": 200, "integrator": "rk4"}),
        made_with={"planner": "0.1.0"},
    )  # fmt: skip


def make_replay(plan, feedback=False, error=1e-3):
    """A replay that drifts from the plan at a constant rate."""
    t = np.linspace(0.0, N * DT, N * SUBSTEPS + 1)
    xs = states(t)
    xs[:, 0] += error * t
    force = np.maximum(0.0, -xs[:, 0])
    return Replay(
        plan, CompiledTwin(plan.twin), feedback, "RK4", t, xs[:, :2], xs[:, :2], xs[:, 2:],
        np.repeat(plan.us, SUBSTEPS, axis=0), xs, states(t), force, np.full((len(t), 3), np.nan), SUBSTEPS,
    )  # fmt: skip


def make_perturbed(N_=N, done=40, errors=(0.5, 0.01)):
    """Rollouts of which those without gains end far off."""
    t = np.linspace(0.0, N_ * DT, N_ + 1)
    spread = np.array([-2.0, -1.0, 0.0, 1.0, 2.0])[:, None, None] * t[:, None] * np.array([1.0, 0.1, 0.01])
    end_error = {mode: e * np.linspace(0.1, 2.0, done) for mode, e in zip(MODES, errors, strict=True)}
    return RobustnessResult(
        perturbation=Perturbation(), seed=7, asked=done, done=done, step=0.01, control_step=0.02, tolerance=0.1,
        end_error=end_error, success={mode: values <= 0.1 for mode, values in end_error.items()},
        margin=dict.fromkeys(MODES, 0.01), per_level=5, t=t,
        fans={mode: e * spread for mode, e in zip(MODES, errors, strict=True)},
    )  # fmt: skip


def make_proof(plan, open_error=1e-3, gains_error=1e-4):
    """What plots and films ask of a proof."""
    replays = {"open-loop": make_replay(plan, False, open_error), "feedback": make_replay(plan, True, gains_error)}
    measured = {mode: np.abs(run.error[::SUBSTEPS]).max(axis=1) for mode, run in replays.items()}
    zeros = dict.fromkeys(MODES, np.zeros(N + 1))
    errors = ErrorPropagation(plan.t, zeros, {mode: 1.1 * values for mode, values in measured.items()}, measured, False)
    steps = DT / 2.0 ** np.arange(5)
    order = StepConvergence(
        steps, np.zeros((5, 3)), np.full(5, 5.0), steps[:-1] ** 4, 100.0 * steps[:-1] ** 4, 4.0, 4.01, "", 5.0123, 1e-6,
        1e-7, 5.0, 5.0, True,
    )  # fmt: skip
    proof = proof_of()
    vars(proof).update({
        "replay": replays["open-loop"], "replays": replays, "errors": errors, "convergence": order,
        "monte_carlo": make_perturbed(), "held": None,
    })  # fmt: skip
    return proof


def proof_of(verdict="PASS", mode="open-loop", **sections):
    every = {
        "parity": Section("parity", (Measurement("mass_matrix", 3e-14, "", 1e-10, "256 states"),)),
        "same_step": Section("same step", not_applicable="Contact <is> solved otherwise."),
        "refined_open_loop": Section("refined, open loop", (Measurement("end_state", 2e-3, "in", 1e-2),)),
        "refined_feedback": Section("refined, with feedback", (Measurement("growth_rate", 1.5, "1/s"),)),
        "goal": Section("goal", (Measurement("height_error", 0.1, "%", 0.2),)),
    } | sections
    results, remarks = "feasible, optimal, robust with its gains", ("without friction loss",)
    return SimpleNamespace(
        verdict=verdict, passed=verdict == "PASS", mode=mode, reason="Within every bound.", sections=every, replay=None,
        headline=f"{verdict} ({mode}), {remarks[0]}; {results}", results=results, remarks=remarks,
        planned_without=(), misleads=False, not_checked=remarks, monte_carlo=None, held=None, replays={},
        lost_with_gains=(), own_step="",
    )  # fmt: skip
