"""What a release relies on: versions that agree, and a workflow that runs what .ci/run runs."""

import os
import re
import tomllib

import pytest
import yaml
from places import ROOT

import planner
from planner.__main__ import main


def test_what_is_cited_is_the_last_release_and_the_code_is_it_or_comes_after_it():
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    changes = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    newest, day = re.search(r"^## \[(\d\S*)\] - (\d{4}-\d\d-\d\d)$", changes, re.M).groups()
    assert cited["version"] == newest
    assert cited["date-released"] == day
    coming = re.search(r"^## (\d\S*) \(unreleased\)$", changes, re.M)
    assert planner.__version__ == (f"{coming[1]}.dev0" if coming else newest)


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


def test_the_conda_recipe_asks_for_what_the_project_does():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    recipe = yaml.safe_load((ROOT / "conda" / "recipe.yaml").read_text(encoding="utf-8"))
    names = {"mujoco": "mujoco-python", "matplotlib": "matplotlib-base"}  # of conda-forge
    parts = [re.fullmatch(r"([\w-]+)(.*)", one).groups() for one in project["dependencies"]]
    wanted = [f"python {project['requires-python']}", *(f"{names.get(name, name)} {rest}" for name, rest in parts)]
    assert recipe["requirements"]["run"] == wanted
    assert recipe["context"]["version"] == planner.__version__


def test_containers_draw_without_a_display():
    text = (ROOT / "Dockerfile").read_text(encoding="utf-8")
    container = yaml.safe_load((ROOT / ".devcontainer" / "devcontainer.json").read_text(encoding="utf-8"))
    assert "libosmesa6" in text
    assert "MUJOCO_GL=osmesa" in text
    assert container["containerEnv"]["MUJOCO_GL"] == "osmesa"
    assert f"make {container['postCreateCommand'].split()[1]}" == "make setup-test"
    assert "\nsetup-test:" in (ROOT / "Makefile").read_text(encoding="utf-8")
