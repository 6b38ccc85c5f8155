"""docs/fidelity.md does what it says: its commands, its test and the steps of its workflow are run on a repository."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

PAGE = (Path(__file__).parent.parent / "docs" / "fidelity.md").read_text(encoding="utf-8")
ARM = """<mujoco><worldbody><body name="arm"><joint name="hinge" axis="0 0 1" damping="0.1"/>
  <geom type="capsule" fromto=".2 0 0 1 0 0" size=".02" mass="5"/></body></worldbody>
  <actuator><motor joint="hinge"/></actuator></mujoco>"""
PROBLEM = 'model = "arm.xml"\nstart = {}\ngoal = { hinge = 1.0 }\nduration = 1.0\ndt = 0.02\n'


def block(language: str) -> str:
    (found,) = re.findall(rf"```{language}\n(.*?)```", PAGE, re.S)
    return found


@pytest.fixture(scope="module")
def repository(tmp_path_factory):
    """A model, a problem and the page's test, with commands on the path; `pip` installs nothing."""
    root = tmp_path_factory.mktemp("repository")
    (root / "bin").mkdir()
    for name, command in (
        ("planner", "-m planner"),
        ("pytest", "-m pytest -q -p no:cacheprovider -p planner.sweeps.pytest_plugin"),
        ("pip", "-c pass"),
    ):
        (root / "bin" / name).write_text(f'#!/bin/sh\nexec "{sys.executable}" {command} "$@"\n')
        (root / "bin" / name).chmod(0o755)
    (root / "fidelity").mkdir()
    (root / "fidelity" / "arm.xml").write_text(ARM)
    (root / "fidelity" / "problem.toml").write_text(PROBLEM)
    (root / "fidelity" / "test_fidelity.py").write_text(block("python"))
    proof = root / "fidelity" / "proof.json"
    for line in block("sh").splitlines():
        assert run(root, line.replace("--update", "--update --quiet")).returncode == 0
    assert proof.exists()
    return root


def run(root: Path, line: str) -> subprocess.CompletedProcess:
    path = os.pathsep.join([str(Path(__file__).parent.parent), os.environ.get("PYTHONPATH", "")])
    environment = os.environ | {"PATH": f"{root / 'bin'}{os.pathsep}{os.environ['PATH']}", "PYTHONPATH": path}
    return subprocess.run(["sh", "-ec", line], cwd=root, env=environment, capture_output=True, text=True, check=False)


def steps() -> list[str]:
    """The `run:` steps of the workflow."""
    found = re.findall(r"^      - run: (.+)$", block("yaml"), re.M)
    assert len(found) == block("yaml").count("run:")
    return found


@pytest.mark.slow
def test_the_steps_of_the_workflow_pass_and_notice_a_changed_model(repository):
    for line in steps():
        done = run(repository, line)
        assert done.returncode == 0, done.stdout + done.stderr
    (repository / "fidelity" / "arm.xml").write_text(ARM.replace('mass="5"', 'mass="5.05"'))
    for line in steps()[1:]:
        done = run(repository, line)
        assert done.returncode == 1
        assert "mass of body 'arm' is 5.05, was 5 (+1 %)" in done.stdout
