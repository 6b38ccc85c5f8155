"""[[constraint]] of a problem.toml: what it makes, how a run with it ends, and what is written wrongly."""

from pathlib import Path

import numpy as np
import pytest
from commands import refused, run

import planner
from planner import PlannerError, load_plan, load_problem
from planner.cases.problem_file.constraints import constraints_of

CUP = Path(__file__).parents[2] / "examples" / "tasks" / "reach_upright_cup.toml"
CRANE = Path(__file__).parents[2] / "examples" / "crane.toml"


def crane(folder, tables):
    """The crane of the examples with more tables."""
    text = CRANE.read_text().replace('"crane.xml"', f'"{CRANE.with_name("crane.xml").as_posix()}"')
    file = folder / "crane.toml"
    file.write_text(text + tables)
    return file


def test_a_cup_stays_upright():
    problem = load_problem(CUP)
    plan = planner.solve(problem)
    assert plan.success, plan.message
    rows = problem.trajectory_constraints.rows
    (upright,) = rows.violations(plan.xs, plan.us)
    assert upright.constraint.name == "cup upright"
    assert upright.value <= 1e-4
    straight = np.linspace(plan.xs[0], plan.xs[-1], problem.N + 1)
    assert rows.violations(straight, plan.us)[0].value > 0.2  # rad, in joint space on a line


def test_a_run_keeps_a_corridor_and_its_plan_knows_it(tmp_path):
    corridor = '\n[[constraint]]\nframe = "load"\nalong = "x"\nupper = 1.9\nwhen = [0.0, 2.0]\nname = "corridor"\n'
    corridor += '[[constraint]]\npower = "drive"\nupper = 500.0\n'
    file = crane(tmp_path, corridor)
    names = [one.name for one in load_problem(file).constraints]
    assert names == ["corridor", "power of drive"]
    done = run("solve", file, "--out", tmp_path / "plan.npz", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    plan = load_plan(tmp_path / "plan.npz")
    assert [one.name for one in plan.problem.constraints] == names
    assert planner.prove(plan, rollouts=0).passed


def test_what_cannot_be_kept_ends_with_1_and_a_plan(tmp_path):
    wall = '\n[[constraint]]\nframe = "load"\nalong = "x"\nupper = 0.5\nname = "wall"\n'
    there = '[[constraint]]\nframe = "load"\nposition = [2.0, 0.0, 1.0]\nname = "there"\n'
    file = crane(tmp_path, wall + there.replace("name", "tolerance = 1e-3\nname"))
    done = run("solve", file, "--out", tmp_path / "plan.npz", "--max-iterations", 60, cwd=tmp_path)
    assert done.returncode == 1, done.stderr
    assert "the constraint 'wall' is broken by" in done.stderr + done.stdout
    assert (tmp_path / "plan.npz").exists()


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ({}, "has no keys, expected frame with one of"),
        ({"frame": "a"}, "expected frame with one of"),
        ({"frame": "a", "power": "b"}, "expected frame with one of"),
        ({"frame": "a", "positon": [0, 0, 0]}, "Did you mean 'position'"),
        ({"frame": "a", "position": [0, 0]}, "expected 3 numbers"),
        ({"frame": "a", "pointing": "up", "within": 0.1}, "expected one of: x, y, z"),
        ({"frame": "a", "pointing": "z"}, "no key 'within'"),
        ({"frame": "a", "pointing": "z", "within": 0}, "greater than 0"),
        ({"frame": "a", "along": "z"}, "expected lower or upper"),
        ({"frame": "a", "along": "z", "within": 0.1, "upper": 1}, "has 'within' beside 'along'"),
        ({"frame": 1, "along": "z", "upper": 1}, "expected the name of a site or body"),
        ({"power": "a", "upper": 1.0, "when": "soon"}, "has when = 'soon'"),
    ],
)
def test_what_is_written_wrongly_is_one_sentence(table, words):
    with pytest.raises(PlannerError, match=words):
        constraints_of([table])


def test_unknown_names_list_those_that_exist(tmp_path):
    for table, words in (('frame = "hok"\nalong = "z"', "expected one of"), ('power = "motor"', "expected one of")):
        file = crane(tmp_path, f"\n[[constraint]]\n{table}\nupper = 1.0\n")
        refused(run("solve", file, "--out", tmp_path / "plan.npz", cwd=tmp_path), words)
    file = crane(tmp_path, '\n[constraint]\npower = "drive"\nupper = 1.0\n')
    refused(run("solve", file, "--out", tmp_path / "plan.npz", cwd=tmp_path), "expected tables [[constraint]]")
