"""`planner completion`: the script is run by a real bash."""

import shutil
import subprocess

import pytest
from commands import refused, run

import planner
from planner.base.data_files import problem_files

ASK = """
source script.bash
COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1)); COMPREPLY=()
_shtab_planner planner "${COMP_WORDS[COMP_CWORD]}" "${COMP_WORDS[COMP_CWORD - 1]}"
echo "${COMPREPLY[@]}"
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("completion")
    done = run("completion", "bash", cwd=folder)
    assert done.returncode == 0, done.stderr
    (folder / "script.bash").write_text(done.stdout)
    (folder / "ask.bash").write_text(ASK)
    return folder


@pytest.mark.skipif(shutil.which("bash") is None, reason="needs bash")
@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("ex",), "export"),
        (("run", ""), " ".join([*planner.cases.CASES, *problem_files()])),  # and no PROBLEM.toml, which nobody types
        (("run", "hopper", "--flow"), "--flow-weight"),
        (("export", "a.npz", "--to", "k"), "keyframes"),
    ],
)
def test_bash_completes_commands_machines_flags_and_values(folder, words, expected):
    command = ["bash", "ask.bash", "planner", *words]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=30, check=True)
    assert done.stdout.strip() == expected


def test_files_are_completed_where_no_word_fits(folder):
    assert "complete -o default" in (folder / "script.bash").read_text()


@pytest.mark.parametrize("shell", ["zsh", "tcsh"])
def test_other_shells_have_a_script(tmp_path, shell):
    done = run("completion", shell, cwd=tmp_path)
    assert done.returncode == 0
    assert "keyframes" in done.stdout


def test_what_is_wrong_is_one_sentence(tmp_path, monkeypatch):
    refused(run("completion", "fish", cwd=tmp_path), "expected one of: bash, zsh, tcsh")
    monkeypatch.setitem(__import__("sys").modules, "shtab", None)
    refused(run("completion", "bash", cwd=tmp_path), "pip install slq-planner[completion]")
