"""The page of a sweep: its maps, what is marked on them, and its links."""

import json
import re
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from commands import run

import planner
from planner.sweeps.grid import grid_of
from planner.view.report.sweep_page import Map, maps_of, mark_jumps, write_sweep_page


def rows_of(costs):
    return [{"task": k, "status": "CONVERGED", "cost": cost, "print": []} for k, cost in enumerate(costs)]


def test_a_jump_to_another_minimum_is_marked_and_a_slope_is_not():
    one = Map("height", "", {}, np.arange(8)[None])
    mark_jumps(one, rows_of([1.0, 1.1, 1.2, 1.3, 9.0, 9.2, 9.4, 9.6]))
    assert one.jumps == [(3, 4)]
    smooth = Map("height", "", {}, np.arange(8)[None])
    mark_jumps(smooth, rows_of([2.0**k for k in range(8)]))
    assert smooth.jumps == []


def test_a_map_is_over_the_two_longest_parameters():
    grid = grid_of({"a": [1, 2], "b": [1, 2, 3], "c": [1, 2, 3, 4]})
    maps = maps_of(grid)
    assert [(one.across, one.up, one.constant) for one in maps] == [("c", "b", {"a": 1}), ("c", "b", {"a": 2})]
    for one in maps:
        for (i, j), task in np.ndenumerate(one.tasks):
            assert grid.point(int(task)) == {**one.constant, "b": grid.values["b"][i], "c": grid.values["c"][j]}


def test_the_page_has_every_task_and_its_plan_can_be_read(tmp_path):
    with ThreadPoolExecutor(1) as executor:
        grid = {"height": [2, 3, 4, 5], "duration": [0.8, 1.0]}
        done = planner.sweep("hopper", grid, out=tmp_path / "out", executor=executor)
    page = write_sweep_page(done).read_text(encoding="utf-8")
    assert page.count("<rect") == 3 * 8
    told = json.loads(re.search(r'id="rows">(.*?)</script>', page, re.S)[1])
    plan = planner.load_plan(tmp_path / "out" / told["7"]["plan"])
    assert plan.cost == told["7"]["cost"]
    assert "http" not in page


@pytest.mark.slow
def test_the_command_writes_table_and_page(tmp_path):
    words = ("--set", "height=2:5:4", "--set", "duration=0.8,1", "--workers", 1, "--quiet", "--json")
    done = run("sweep", "hopper", *words, "--out", "out", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["statuses"] == {"CONVERGED": 8}
    assert (tmp_path / "out/table.csv").exists()
    assert (tmp_path / "out/index.html").exists()
