"""Names of the cases: a folder and the function of its case share a name, and the name is always the function."""

import subprocess
import sys

import pytest

PARTS = {
    "high_dive": ("case", "flight"),
    "human_step": ("case", "gait"),
}


@pytest.mark.parametrize("case", [pytest.param("high_dive", marks=pytest.mark.slow), "human_step"])
def test_a_case_is_a_function_whichever_part_of_its_folder_is_imported_first(case):
    code = f"""
import importlib, sys
for part in {PARTS[case]}:
    for name in [name for name in sys.modules if name.split(".")[0] == "planner"]:
        del sys.modules[name]
    module = importlib.import_module(f"planner.cases.{case}.{{part}}")
    import planner
    function = planner.cases.{case}
    assert callable(function) and function is planner.cases.CASES["{case.replace("_", "-")}"], part
    importlib.import_module("planner.cases.{case}")
    from planner.cases import {case}
    assert {case} is planner.cases.{case} is function, part
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
