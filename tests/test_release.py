"""What a release relies on: one version everywhere, and a workflow that runs what .ci/run runs."""

import os
import re
import tomllib

import pytest
import yaml
from places import ROOT

import planner
from planner.__main__ import main


def test_the_version_is_the_same_everywhere():
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    changes = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    newest, day = re.search(r"^## \[(\d\S*)\] - (\d{4}-\d\d-\d\d)$", changes, re.M).groups()
    assert cited["version"] == newest == planner.__version__
    assert cited["date-released"] == day


def test_the_command_says_the_version_of_the_code(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.startswith(f"planner {planner.__version__} ")


@pytest.fixture
def jobs():
    return yaml.safe_load((ROOT / ".github" / "workflows" / "ci.yml").read_text(encoding="utf-8"))["jobs"]


def test_the_workflow_runs_scripts_that_exist(jobs):
    words = [step["run"].split() for job in jobs.values() for step in job["steps"] if "run" in step]
    scripts = {line[0] for line in words if line[0].startswith(".ci/")}
    assert scripts == {".ci/run", ".ci/distributions"}
    for script in scripts:
        assert os.access(ROOT / script, os.X_OK), script


def test_the_workflow_tries_every_python_from_the_least(jobs):
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    least = re.fullmatch(r">=(3\.\d+)", project["requires-python"])[1]
    tried = jobs["distributions"]["strategy"]["matrix"]["python"]
    assert tried[0] == least
    assert tried == [f"3.{minor}" for minor in range(int(least[2:]), int(least[2:]) + len(tried))]
