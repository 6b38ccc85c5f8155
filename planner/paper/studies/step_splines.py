"""The human step by the paper's own method (section 2.3), and how it suffers from stiff penalties.

The legs are passive and the pelvis is given: its six accelerations are B-splines, about the paper's 32 parameters. J is
integrated by an adaptive rule with the penalties on the way, its gradient is Eq. 7, and BFGS moves the amplitudes. The
paper: "not numerically stable", and the penalties "exacerbated the problem since they effectively created a stiff
system". So the weights of the penalties are multiplied and their ramps shortened. Beside it stand the same splines with
the exact gradient of the sum over stages (Eq. 16-19), and SLQ.

The cost changes on the way. With time a state, z = (x, t), the methods of adjoint.py need no more. The costs of stages,
which hold the factor dt, are divided by it and interpolated between knots:

    L(x, u, t) = ((1 - s) l_n(x, u) + s l_n+1(x, u)) / dt        n + s = t / dt

No control moves time, so the costate of time adds nothing to the gradient: it is left zero.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from planner.base.errors import PlannerError
from planner.cases.human_step.case import human_step
from planner.control.window_parts import at_stages, parts_of
from planner.kernels.numba.lanes import padded
from planner.paper.methods.adjoint import AdjointCost, ContinuousDynamics, Integration, Partials
from planner.paper.methods.spline_inputs import SplineCost, solve_by_splines
from planner.paper.methods.splines import SplineSpace, bfgs, nearest_amplitudes
from planner.paper.studies.study import Row, Study, draw_errors, errors_at, errors_table, plan_record, table
from planner.problem.costs.least_squares import ResidualCost
from planner.problem.costs.terms import SumCost
from planner.problem.costs.tracking import TrackingCost
from planner.problem.problem import Problem
from planner.solvers.engine import acquire_engine
from planner.solvers.engine.compiled import CompiledEngine
from planner.solvers.slq import solve
from planner.view.plots.style import HUES, dress, panels_of, save


class TimedProblem:
    """A System (see adjoint.py) of a Problem with a TrackingCost and compiled residuals, which may change on the way.

    Raises:
        PlannerError: Terms of another kind, or states with quaternions.
    """

    orders = 1  # the control alone is the input, without derivatives

    def __init__(self, problem: Problem) -> None:
        self.f, self._dt, self._N = ContinuousDynamics(problem.dynamics), problem.dynamics.dt, problem.N
        self.nx, self.inputs = self.f.nx, self.f.nu
        self.nz, self.z0 = self.nx + 1, np.append(problem.x0, 0.0)
        self._engines = [_engine(problem, n) for n in range(problem.N)]
        zero = np.zeros((1, self.inputs, self.nx))  # no gains: a start that checks nothing, which thousands are
        self._held = np.zeros((2, self.nx)), np.zeros((1, self.inputs)), zero
        self._end = _one_stage(problem, problem.N - 1, at_end=True)

    def _costs(self, z: np.ndarray, u: np.ndarray) -> list[tuple[CompiledEngine, float, float]]:
        """The engines of both stages about a time, with their shares over dt and their costs at x, u."""
        at = min(z[-1] / self._dt, self._N - 1.0)
        n = min(int(at), self._N - 2) if self._N > 1 else 0
        found = []
        for engine, share in ((self._engines[n], n + 1.0 - at), (self._engines[min(n + 1, self._N - 1)], at - n)):
            self._held[1][0] = u
            found.append((engine, share / self._dt, engine.start_from_trajectory(z[:-1], self._held)))
        return found

    def rates(self, z: np.ndarray, w: np.ndarray) -> tuple[np.ndarray, float]:
        """dz/dt (nz,) and L."""
        return np.append(self.f(z[:-1], w), 1.0), sum(share * cost for _, share, cost in self._costs(z, w))

    def partials(self, z: np.ndarray, w: np.ndarray) -> Partials:
        """Derivatives of both, those by time left zero."""
        L_z, L_w = np.zeros(self.nz), np.zeros(self.inputs)
        f_z, f_w = np.zeros((self.nz, self.nz)), np.zeros((self.nz, self.inputs))
        first = padded(self.inputs)
        f_z[:-1, :-1], f_w[:-1] = self.f.partials(z[:-1], w)
        for engine, share, _ in self._costs(z, w):
            engine.compute_direction(0.0, relinearize=True)
            by = engine.cost_arrays()["l"]  # (L_u | L_x), each padded, then those of the end
            L_w += share * by[: self.inputs]
            L_z[:-1] += share * by[first : first + self.nx]
        return Partials(f_z, f_w, L_z, L_w)

    def final(self, z: np.ndarray, w: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        """Phi, and its derivatives by z (nz,) and by u, which are zero."""
        xs, us = np.stack([z[:-1], z[:-1]]), np.zeros((1, self.inputs))
        phi_z = sum(term.quadratize(xs, us).q[1] for term in self._end)
        return sum(term.final_cost(z[:-1]) for term in self._end), np.append(phi_z, 0.0), np.zeros(len(w))


def _engine(problem: Problem, n: int) -> CompiledEngine:
    """An engine of stage n alone, whose end costs nothing."""
    cost, us = SumCost(*_one_stage(problem, n, at_end=False)), np.zeros((1, problem.dynamics.nu))
    engine = acquire_engine(Problem(problem.dynamics, cost, problem.x0, us))
    if not isinstance(engine, CompiledEngine):
        raise PlannerError(f"the dynamics is a {type(problem.dynamics).__name__}, expected compiled ones.")
    if n == 0:
        engine.start_from_controls(problem.x0, us)  # which compiles what is not
    return engine


def _one_stage(problem: Problem, n: int, at_end: bool) -> list[TrackingCost | ResidualCost]:
    """The cost of stage n without that of the next knot, or the other way round."""
    tracking, residuals, python = parts_of(problem)
    if python:
        raise PlannerError(f"the cost has a {type(python[0]).__name__}, expected a TrackingCost and compiled terms.")
    keep = np.array([not at_end, at_end], dtype=float)
    alone = TrackingCost(
        keep[:, None, None] * tracking.Q[n : n + 2], tracking.R[n : n + 1],
        tracking.x_ref[n : n + 2], tracking.u_ref[n : n + 1],
    )  # fmt: skip
    parts: list[TrackingCost | ResidualCost] = [alone]
    for term in residuals:
        arrays = at_stages(term.residual_arrays_for(problem.N), slice(n, n + 2))
        parts.append(ResidualCost(term.mechanism, replace(arrays, weight=keep * arrays.weight), 1))
    return parts


COEFFICIENTS, DEGREE = 5, 3  # of each of six accelerations: 30 parameters; the paper has 32 of other controls
WEIGHTS = (1.0, 100.0, 1e4)  # of the penalties, times those of the case
DESCENT = 1e-4  # tolerance of the integrations in BFGS
TOLERANCES, REFERENCE = (1e-3, 1e-4, 1e-5, 1e-6), 1e-8
SHORT = {"weights": WEIGHTS[::2], "tolerances": TOLERANCES[:2], "reference": 1e-6, "iterations": 5, "exact": 50}


def stiffened(problem: Problem, factor: float) -> Problem:
    """The problem with the weights of its penalties multiplied, and their ramps divided by the root of that."""
    tracking, penalties, _ = parts_of(problem)
    harder = [
        ResidualCost(
            one.mechanism, replace(arrays, weight=factor * arrays.weight, ramp=arrays.ramp / factor**0.5), problem.N
        )
        for one in penalties for arrays in [one.residual_arrays_for(problem.N)]
    ]  # fmt: skip
    return Problem(problem.dynamics, SumCost(tracking, *harder), problem.x0, problem.first_guess)


def _at(factor: float, tolerances: tuple[float, ...], reference: float, iterations: int, most: int) -> dict[str, Any]:
    problem = stiffened(human_step(phase="swing", cost="study"), factor)
    plan = solve(problem)
    exact = solve_by_splines(
        problem, coefficients=COEFFICIENTS, degree=DEGREE, gradient_tolerance=1e-6, max_iterations=most
    )
    basis, system = SplineSpace(COEFFICIENTS - DEGREE, DEGREE).basis(problem.duration), TimedProblem(problem)
    by_tolerance = {
        tolerance: AdjointCost(system, basis, system.z0, Integration(tolerance))
        for tolerance in (*tolerances, reference, DESCENT)
    }
    shape = (COEFFICIENTS, problem.dynamics.nu)
    middle = problem.dynamics.dt * (np.arange(problem.N) + 0.5)
    first = nearest_amplitudes(basis(middle), problem.first_guess, np.zeros(shape), slice(None)).reshape(shape)
    cost = by_tolerance[DESCENT]
    free, facts = bfgs(cost, first.ravel(), 1e-6, iterations, scale=abs(cost(first)[0]))
    whole = SplineCost(problem, basis)
    points = [
        errors_at(f"x {factor:g}, {name}", by_tolerance[reference](P), [by_tolerance[t](P) for t in tolerances])
        for name, P in (("first guess", first), ("end", exact.spline.c))
    ]  # fmt: skip
    found = {
        "weight": factor, "parameters": first.size, "points": points,
        "steps": len(by_tolerance[tolerances[-1]].forward(exact.spline.c).t) - 1,
        "costs": facts["costs"].tolist(), "sum": whole(free)[0], "success": facts["success"],
        "message": facts["message"], "iterations": len(facts["costs"]) - 1, "evaluations": facts["evaluations"],
        "exact": exact.discrete_cost, "exact_iterations": exact.iterations,
        "exact_success": exact.success, "exact_costs": exact.costs.tolist(),
        "slq": {**plan_record(plan), "costs": [line.cost for line in plan.history]},
    }  # fmt: skip
    whole.close()
    return found


def _run(
    weights: tuple[float, ...] = WEIGHTS, tolerances: tuple[float, ...] = TOLERANCES, reference: float = REFERENCE,
    iterations: int = 60, exact: int = 1000,
) -> dict[str, Any]:  # fmt: skip
    solve(human_step(phase="swing", cost="study"), max_iterations=1)  # compiled
    found = [_at(weight, tolerances, reference, iterations, exact) for weight in weights]
    return {"found": found, "tolerances": list(tolerances), "reference": reference, "limit": iterations, "exact": exact}


def _page(results: dict[str, Any]) -> list[str]:
    found = results["found"]
    return [
        "## The human step by splines and Eq. 7 (section 2.3)", "",
        f"{found[0]['parameters']} parameters: accelerations of the pelvis as cubic B-splines; passive legs; the swing",
        "of `cost=\"study\"` with the weights of its penalties (foot off the ground, legs apart, reach) multiplied,",
        "their ramps divided by the root of that. The cost between knots is interpolated. BFGS has J and its gradient",
        f"by Eq. 7 at a tolerance of {DESCENT:g}, at most {results['limit']} iterations; beside it the exact gradient",
        f"of the sum (at most {results['exact']}), and SLQ, which moves the control of every stage. J is the sum.", "",
        "![error of the gradient, and J by iteration](step_splines.png)", "",
        *table({
            "penalties": "x {weight:g}", f"steps at {results['tolerances'][-1]:g}": "{steps}", "Eq. 7: J": "{sum:.1f}",
            "iterations": "{iterations}", "evaluations": "{evaluations}", "BFGS says": "{message}",
            "exact gradient: J": "{exact:.1f}", "its iterations": "{exact_iterations}",
            "SLQ: J": "{slq[cost]:.1f}", "SLQ's iterations": "{slq[iterations]}",
        }, found), "",
        f"Relative error of the gradient of Eq. 7 against one at {results['reference']:g}, at the first guess and",
        "where the exact gradient ended:", "",
        *errors_table([point for one in found for point in one["points"]], results["tolerances"]),
    ]  # fmt: skip


def _rows(results: dict[str, Any]) -> list[Row]:
    found, loosest = results["found"], results["tolerances"][0]
    soft, hard = found[0], found[-1]

    def errors(point: int) -> str:
        return ", ".join(f"{one['points'][point]['relative_errors'][0]:.0e} (x {one['weight']:g})" for one in found)

    return [
        Row("2.3, Eq. 7", "Stepping by splines and Eq. 7 is not numerically stable; penalties make it stiff, and worse",
            f"error of the gradient at tolerance {loosest:g}, by the weight of the penalties: {errors(0)} at the first "
            f"guess, {errors(1)} where the exact gradient ends. With x {hard['weight']:g} BFGS ends at J "
            f"{hard['sum']:.3g} after {hard['iterations']} iterations ({hard['message'].rstrip('.')}); by the exact "
            f"gradient at {hard['exact']:.3g}, SLQ at {hard['slq']['cost']:.3g} in {hard['slq']['iterations']}. With x "
            f"{soft['weight']:g}: {soft['sum']:.3g}, {soft['exact']:.3g}, {soft['slq']['cost']:.3g}",
            "truncation, not round-off: the error is that of the integration's tolerance while the gradient shrinks. "
            "The gradient of the sum has none; BFGS is slow with it, too. Person, weights and splines are ours"),
    ]  # fmt: skip


def _draw(results: dict[str, Any], path: Path) -> None:
    """Error of the gradient against tolerance, and J over SLQ's by iteration, for every weight."""
    figure, (errors, costs) = panels_of(2)
    points = [point for one in results["found"] for point in one["points"]]
    draw_errors(errors, "Gradient of Eq. 7 with penalties on the way", points, results["tolerances"])
    errors.legend(frameon=False, fontsize=6.5, loc="upper right", ncols=2)
    errors.set_ylim(top=100.0)  # room for the names
    dress(costs, "BFGS: Eq. 7 solid, exact gradient dashed; SLQ dotted", "J over SLQ's", "iteration, counted from 1")
    for hue, one in zip(HUES, results["found"], strict=False):
        least = one["slq"]["cost"]
        for values, line in ((one["costs"], "-"), (one["exact_costs"], "--"), (one["slq"]["costs"], ":")):
            label = f"penalties x {one['weight']:g}" if line == "-" else None
            costs.loglog(1 + np.arange(len(values)), np.array(values) / least, line, color=hue[1], label=label)
    costs.legend(frameon=False, fontsize=8)
    save(figure, path)


STUDY = Study("step-splines", "the human step by splines and Eq. 7 (2.3)", partial(_run, **SHORT), _page, _rows,
              {"step_splines.png": _draw}, seconds=15, full=_run)  # fmt: skip
