"""What solve() and Problem are told and say: callbacks, names, shapes."""

import re
from dataclasses import fields

import numpy as np
import pytest
from solves import each_engine, engines, flight, hopper, linear, same_bits, swing

import planner
from planner import PlannerError, Problem
from planner.kernels.lq import line_search
from planner.problem.plan import Iteration
from planner.solvers.options import LINE_SEARCHES, SolverOptions

# What is asked and told


@each_engine
def test_callback_gets_the_lines_of_the_history(engine):
    lines = []
    plan = planner.solve(engines()[engine], callback=lines.append)
    assert all(isinstance(line, Iteration) for line in lines)
    assert tuple(lines) == plan.history


@pytest.mark.parametrize("problem", [hopper("default"), hopper("paper 50"), swing()], ids=["hopper", "paper", "swing"])
def test_lines_stand_under_their_header(problem):
    """Every column of every line ends where its heading ends."""

    def ends(text):
        return [i + 1 for i, c in enumerate(text) if c != " " and (i + 1 == len(text) or text[i + 1] == " ")]

    header = Iteration.header()
    assert len(ends(header)) == len(Iteration._fields)
    lines = [*planner.solve(problem).history, Iteration(99999, -1.2345678e-100, 1e100, 1e-7, 1e100, -1e10, 1e10)]
    lines.append(lines[-1]._replace(expected=np.nan))  # of a step that closes defects: no model expects it
    assert " - " in str(lines[-1])
    for line in lines:
        assert ends(str(line).splitlines()[-1]) == ends(header)


def test_a_table_that_print_makes_has_its_heading_once(capsys):
    planner.solve(swing(), callback=print)
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == Iteration.header()
    assert sum("cost" in line for line in lines) == 1
    assert lines[1].split()[0] == "0"


def sentence(error):
    text = str(error.value)
    assert "\n" not in text
    assert text.endswith(("?", "."))
    return text


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ({"update": "closed-loop"}, "update is 'closed-loop', expected one of: feedback, open-loop."),
        ({"options": {}}, "options is {}, expected a SolverOptions or None."),
        ({"line_search": "wolf"}, "line_search is 'wolf', expected one of: armijo, exact, wolfe, goldstein."),
        ({"line_search": 0}, "line_search is 0, expected one of: armijo, exact, wolfe, goldstein."),
        ({"max_iterations": 0}, "max_iterations is 0, expected a whole number of at least 1."),
        ({"max_iterations": 10.0}, "max_iterations is 10.0, expected a whole number of at least 1."),
        ({"gradient_tolerance": -1e-9}, "gradient_tolerance is -1e-09, expected a finite number of at least 0."),
        (
            {"expected_reduction_tolerance": np.inf},
            "expected_reduction_tolerance is inf, expected a finite number of at least 0.",
        ),
        ({"starts": 10_001}, "starts is 10001, expected a whole number of at least 1 and at most 10000."),
        ({"starts": True}, "starts is True, expected a whole number of at least 1."),
        ({"max_iterations": True}, "max_iterations is True, expected a whole number of at least 1."),
        ({"seed": 10**30}, f"seed is {10**30}, expected a whole number of at least 0 and at most {2**63 - 1}."),
        ({"spread": "1"}, "spread is '1', expected a finite number greater than 0."),
        ({"callback": 3}, "callback is 3, expected a function"),
        ({"gradient_tolerance": "small"}, "gradient_tolerance is 'small', expected a finite number of at least 0."),
    ],
)
def test_wrong_options_of_solve_are_refused_in_one_sentence(arguments, expected):
    with pytest.raises(PlannerError) as error:
        planner.solve(hopper(), **arguments)
    assert sentence(error).startswith(expected)


def test_options_are_overridden_by_keywords_and_recorded():
    options = SolverOptions(max_iterations=3, update="open-loop", regularization_factor=4.0)
    plan = planner.solve(hopper(), options, update="feedback")
    recorded = {name: plan.options[name] for name in ("max_iterations", "update", "regularization_factor")}
    assert recorded == {"max_iterations": 3, "update": "feedback", "regularization_factor": 4.0}
    assert plan.nit == 3
    assert "penalty_growth" not in plan.options  # a default


def test_a_plan_with_options_is_that_of_the_same_keywords():
    same_bits(
        planner.solve(hopper(), SolverOptions(hessian="exact", line_search="exact")),
        planner.solve(hopper(), hessian="exact", line_search="exact"),
    )


@pytest.mark.parametrize("name", [field.name for field in fields(SolverOptions)])
def test_every_option_is_checked_and_told(name):
    for wrong in (-1, "no", float("nan")):
        with pytest.raises(PlannerError, match=f"^{name} is "):
            SolverOptions(**{name: wrong})
    assert re.search(rf"^        {name}: ", SolverOptions.__doc__, re.M)


@pytest.mark.parametrize("change", [
    {"min_regularization": 1e-2}, {"acceleration_steps": 1}, {"acceleration_max_reduction": 1e-9},
    {"short_step": 0.9, "state_regularization_factor": 2.0},
])  # fmt: skip
def test_constants_of_the_parts_change_the_solve_and_not_the_minimum(change):
    problem = planner.cases.two_link(horizon=40)
    usual, changed = (planner.solve(problem, SolverOptions(**more), hessian="exact") for more in ({}, change))
    assert changed.success
    assert [line.cost for line in usual.history] != [line.cost for line in changed.history]
    assert changed.cost == pytest.approx(usual.cost, rel=1e-6)


def problem_with(**changes):
    honest = swing()
    fields = {"dynamics": honest.dynamics, "cost": honest.cost, "x0": honest.x0, **changes}
    return Problem(**fields)


HORIZONS = "expected a whole number of at least 1 and at most 1000000."


class NoHorizon:
    """A user's cost that says nothing of its size."""

    def value(self, xs, us):
        return 0.0

    def quadratize(self, xs, us):
        raise AssertionError("a problem without a horizon is refused before its cost is asked")


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"x0": [0.0, 0.0, 0.0]}, "x0 is [0.0, 0.0, 0.0], expected 2 numbers, e.g. [0.0, 0.0]."),
        ({"x0": 0.0}, "x0 has shape (), expected (2,)."),
        ({"x0": [0.0, np.nan]}, "x0[1] is nan, expected finite numbers."),
        ({"x0": [-np.inf, 0.0]}, "x0[0] is -inf, expected finite numbers."),
        ({"x0": "rest"}, "x0 is not an array of numbers, expected shape (2,)."),
        ({"us": np.zeros((19, 1))}, "us has shape (19, 1), expected (20, 1)."),
        ({"us": np.zeros(20)}, "us has shape (20,), expected (N, 1)."),
        ({"us": np.full((20, 1), np.inf)}, "us[0, 0] is inf, expected finite numbers."),
        ({"horizon": 19}, "the cost is made for N = 20, expected horizon = 19."),
        ({"horizon": 0}, "horizon is 0, expected a whole number of at least 1."),
        ({"cost": NoHorizon(), "horizon": 10**15}, f"horizon is {10**15}, {HORIZONS}"),
        ({"cost": NoHorizon(), "horizon": 10**400}, f"horizon is {str(10**400)[:97]}..., {HORIZONS}"),
        ({"cost": NoHorizon(), "horizon": True}, "horizon is True, expected a whole number of at least 1."),
        ({"x0": [True, False]}, "x0 is not an array of numbers, expected shape (2,)."),
        ({"us": np.zeros((20, 1), dtype=bool)}, "us is not an array of numbers, expected shape (N, 1)."),
        ({"dynamics": None}, "dynamics is None, expected dynamics with nx, nu, dt, step and linearize (no nx there)."),
        ({"cost": None}, "cost is None, expected a cost with value() and quadratize()."),
        ({"twin": "model.xml"}, "twin is 'model.xml', expected Twin or None."),
        ({"appearance": 3}, "appearance is 3, expected Appearance or None."),
        ({"requirements": {}}, "requirements is {}, expected Requirements or None."),
        ({"cost": flight(0).cost}, "the cost is made for nx = 3, expected dynamics.nx = 2."),
        ({"cost": linear(0, nx=2, nu=2).cost}, "the cost is made for nu = 2, expected dynamics.nu = 1."),
        (
            {"dynamics": linear(0, nx=2, nu=2).dynamics, "us": None, "cost": linear(0, nx=2, nu=1).cost},
            "the cost is made for nu = 1, expected dynamics.nu = 2; make it with nu=2, or with an effort of 2 numbers.",
        ),
        ({"cost": NoHorizon()}, "the problem has no horizon, expected horizon=N or first controls us (N, nu)."),
    ],
)
def test_parts_that_do_not_fit_together_are_refused_in_one_sentence(changes, expected):
    with pytest.raises(PlannerError) as error:
        problem_with(**changes)
    assert sentence(error) == expected


@pytest.mark.parametrize("problem", [None, "hopper", swing], ids=["nothing", "a name", "a function"])
def test_arguments_that_are_no_problem_are_refused_in_one_sentence(problem):
    with pytest.raises(PlannerError) as error:
        planner.solve(problem)
    assert sentence(error).startswith("problem is ")
    assert "expected a Problem" in sentence(error)


def test_first_controls_of_no_shape_are_one_sentence():
    """Without a horizon the controls are asked for their length, which a number has not."""
    with pytest.raises(PlannerError) as error:
        problem_with(cost=NoHorizon(), us=3.0)
    sentence(error)


def test_the_horizon_comes_from_the_first_controls():
    problem = problem_with(cost=NoHorizon(), us=np.ones((7, 1)))
    assert problem.N == 7
    assert problem.duration == pytest.approx(7 * 0.075)
    assert problem_with(cost=NoHorizon(), horizon=9).first_guess.shape == (9, 1)


def test_a_problem_keeps_its_own_arrays():
    """Changing what was handed in, or what came out, changes no later solve."""
    x0, us = np.array([0.0, 0.0]), np.zeros((20, 1))
    problem = problem_with(x0=x0, us=us)
    first = planner.solve(problem)
    copies = first.xs.copy(), first.us.copy(), first.K.copy()
    x0[:], us[:] = 5.0, 5.0
    second = planner.solve(problem)
    same_bits(first, second)
    second.xs[:], second.us[:], second.K[:] = 0.0, 0.0, 0.0
    for ours, copy in zip((first.xs, first.us, first.K), copies, strict=True):
        np.testing.assert_array_equal(ours, copy)


def test_rules_are_named_in_the_order_of_the_kernels():
    """solve() finds a rule's number by its place in LINE_SEARCHES."""
    assert [getattr(line_search, name.upper()) for name in LINE_SEARCHES] == list(range(len(LINE_SEARCHES)))
