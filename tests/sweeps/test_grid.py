"""A grid is read from words, numbered, and refuses what does not exist."""

import pytest

import planner
from planner.sweeps.grid import grid_of


def test_ranges_and_lists_make_all_combinations():
    grid = grid_of(["height=1:5:3", "duration=0.8,1", "integrator=rk4,euler"])
    assert len(grid) == 12
    assert grid.point(0) == {"height": 1, "duration": 0.8, "integrator": "rk4"}
    assert grid.point(11) == {"height": 5, "duration": 1, "integrator": "euler"}
    assert grid.values["height"] == (1, 3, 5)
    assert all(isinstance(value, int) for value in grid.values["height"])
    assert grid_of(["height=0.5:1:2"]).values["height"] == (0.5, 1.0)


def test_chains_go_along_one_parameter():
    grid = grid_of({"height": [1, 2, 3], "duration": [0.8, 1.0]})
    assert list(grid.chains("height")) == [[0, 2, 4], [1, 3, 5]]
    assert list(grid.chains("duration")) == [[0, 1], [2, 3], [4, 5]]


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (["height"], "no part of a grid"),
        (["height=1:60"], "START:STOP:COUNT"),
        (["height=1:60:0"], "START:STOP:COUNT"),
        (["height=1:a:3"], "START:STOP:COUNT"),
        (["height=1,,2"], "empty value"),
        (["height=1,1"], "twice"),
        (["height=1", "height=2"], "given twice"),
        ([], "empty"),
        ({"height": 3}, "expected a list"),
        ({"height": []}, "0 values"),
        ({"height": [float("nan")]}, "finite"),
        ({"height": [None]}, "numbers, words"),
        ({"a": range(10_000), "b": range(10_000)}, "at most"),
        ("height=1:2:3", "table of values"),
    ],
)
def test_a_wrong_grid_is_refused_in_a_sentence(given, said):
    with pytest.raises(planner.PlannerError, match=said):
        grid_of(given)


def test_an_unknown_parameter_gets_the_names_that_exist(tmp_path):
    with pytest.raises(
        planner.PlannerError, match=r"no parameter 'heigth', .* height, duration.*Did you mean 'height'"
    ):
        planner.sweep("hopper", {"heigth": [1]}, out=tmp_path / "out")
    assert not (tmp_path / "out").exists()
