"""Command lines and files that nobody would write on purpose: one sentence, and the exit code that says whose fault."""

import json
import os
import signal
import subprocess
import sys
import time

import pytest
from carts import write as write_problem

from planner.__main__ import main
from planner.base.arguments import did_you_mean
from planner.base.data_files import LONGEST, read_table
from planner.base.errors import FileError, PlannerError
from planner.base.gl import load_mujoco
from planner.cases.human_step.gait import LARGEST as MAX_OF_GAIT
from planner.cases.human_step.gait import read_gait
from planner.cli import case_flags, parser
from planner.cli.commands import INTERNAL, TRACEBACK
from planner.cli.console import Console
from planner.problem.limits import Limits
from planner.proof.robustness.perturbation import Perturbation

HUGE = 10**400


def sentence(capsys, *words, code=2):
    assert main(list(words)) == code
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    assert len(lines[0]) < 1200
    assert lines[0].isprintable()
    return lines[0]


@pytest.mark.parametrize("flag", ["--objective", "--out", "--durations", "--guess", "--duration"])
def test_a_flag_whose_value_is_two_dashes(flag, capsys):
    said = sentence(capsys, "solve", "two-link", f"{flag}=--")
    assert flag in said
    assert ": expected another value than '--'" in said


@pytest.mark.parametrize(
    "words",
    [
        ("solve", "two-link", "--duration", "x" * 5000),
        ("solve", "two-link", "--horizon", "9" * 5000),
        ("solve", "two-link", "--objective", f"effort={'9' * 5000}x"),
        ("solve", "two-link", "--durations", "9" * 5000),
        ("check", "a" * 5000),
        ("x" * 5000,),
        ("list", "\x1b[2J\nPASS (open-loop)"),
        ("solve", "two-link", "--guess", "a\nPASS\x9b2J"),
    ],
)
def test_long_and_unprintable_words_are_cut_and_escaped(words, capsys):
    sentence(capsys, *words)


def test_what_a_terminal_obeys_is_escaped_in_results(capsys):
    Console().write_result("hip\x1b[2J\x9bé\ttwo\nlines")
    assert capsys.readouterr().out == "hip\\x1b[2J\\x9bé\ttwo\nlines\n"


def test_an_internal_error_has_an_exit_code_of_its_own(capsys, monkeypatch):
    def fails(*_):
        raise TypeError("unhashable type")

    monkeypatch.setattr("planner.cli.commands._function", lambda name: fails)
    said = sentence(capsys, "list", code=INTERNAL)
    assert "an error of the planner itself (TypeError: 'unhashable type')" in said
    assert TRACEBACK in said
    monkeypatch.setenv(TRACEBACK, "1")
    assert main(["list", "--json"]) == INTERNAL
    printed = capsys.readouterr()
    assert "Traceback (most recent call last)" in printed.err
    assert json.loads(printed.out)["exit_code"] == INTERNAL
    assert case_flags.list_cases is not fails


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (MemoryError(), "not enough memory"),
        (load_mujoco().FatalError("Could not allocate memory"), "Could not allocate memory"),
    ],
)
def test_memory_that_ends_is_a_sentence_also_where_mujoco_asks_for_it(monkeypatch, capsys, error, words):
    def failing(*_):
        raise error

    monkeypatch.setattr("planner.cli.commands._function", lambda name: failing)
    assert words in sentence(capsys, "list", code=2)


@pytest.mark.skipif(not hasattr(os, "setsid"), reason="no signals here")
def test_an_interruption_of_the_imports_is_quiet():
    """An import that never ends stands in for a slow disk."""
    code = (
        "import signal, sys, time\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "class Slow:\n"
        "    def find_spec(self, name, *_):\n"
        "        if name == 'planner.cli.commands':\n"
        "            print('importing', flush=True)\n"
        "            time.sleep(60)\n"
        "sys.meta_path.insert(0, Slow())\n"
        "from planner.__main__ import main\n"
        "sys.exit(main(['list']))\n"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        process.stdout.readline()
        time.sleep(0.1)
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=60)
    assert process.returncode == 130
    assert errors == b"planner: interrupted; nothing was written.\n"


@pytest.mark.parametrize("key", ["control", "velocity", "position", "final", "state"])
@pytest.mark.parametrize("value", [HUGE, [HUGE, HUGE], {"trolley": HUGE}, [-HUGE, HUGE]], ids=repr)
def test_limits_with_integers_of_hundreds_of_digits(key, value, tmp_path, capsys):
    """Through a file as it is written, where Python's numbers have as many digits as they like."""
    text = "{ " + ", ".join(f"{k} = {v}" for k, v in value.items()) + " }" if isinstance(value, dict) else str(value)
    file = write_problem(tmp_path)
    file.write_text(file.read_text() + f"\n[limits]\n{key} = {text}\n")
    assert len(sentence(capsys, "solve", str(file), "--max-iterations", "1")) < 600
    assert Limits(control=HUGE).to_dict()["control"] == HUGE


def test_a_dotted_key_of_many_parts_is_refused_at_once(tmp_path):
    for text in ("a." * 50_000 + "a = 1", "x = { " + "a . " * 50_000 + "a = 1 }", "[" + '"a".' * 50_000 + "a]"):
        (tmp_path / "p.toml").write_text(text)
        began = time.process_time()
        with pytest.raises(FileError, match="has a key of more than"):
            read_table(tmp_path / "p.toml")
        assert time.process_time() - began < 5.0  # tomllib takes a minute
    (tmp_path / "p.toml").write_text("#" * (LONGEST + 1))
    with pytest.raises(FileError, match="characters, expected a table"):
        read_table(tmp_path / "p.toml")
    (tmp_path / "p.toml").write_text('title = "a.b.c.d.e.f.g.h.i.j.k.l.m.n.o.p.q.r.s.t.u.v.w"\nlimits.tolerance = 1.5')
    assert read_table(tmp_path / "p.toml")["limits"] == {"tolerance": 1.5}


@pytest.mark.parametrize("name", ["delay", "noise", "start", "drag", "friction"])
def test_perturbations_are_bounded(name):
    with pytest.raises(PlannerError, match=f"{name} is 1e\\+308, expected a finite number of at least 0 and at most"):
        Perturbation(**{name: 1e308})


def test_a_gait_with_times_beyond_any_clock(tmp_path):
    names = "time,tilt_deg,list_deg,rotation_deg,hip_flexion_deg,hip_adduction_deg,hip_rotation_deg,knee_deg,ankle_deg"
    rows = [f"{-1e308 if i == 0 else i if i < 29 else 1e308},0,0,0,0,0,0,-10,0" for i in range(30)]
    (tmp_path / "gait.csv").write_text("\n".join([names, *rows]))
    with pytest.raises(FileError, match=f"expected a number of at most {MAX_OF_GAIT:g}".replace("+", r"\+")):
        read_gait(tmp_path / "gait.csv")


@pytest.mark.parametrize(
    "change",
    [
        {"verdict": []}, {"verdict": {}}, {"asked": {"hold_seconds": 1e308}}, {"asked": {"rollouts": 10**30}},
        {"asked": []}, {"refined_feedback": {"figures": []}}, {"refined_feedback": {"figures": {"end_error": "x"}}},
        {"refined_feedback": {"figures": {"end_error": {"value": [1]}}}},
    ],
    ids=str,
)  # fmt: skip
def test_a_damaged_proof_is_no_traceback(change, tmp_path, capsys):
    small = ["--horizon", "8", "--max-iterations", "1", "--quiet"]
    main(["solve", "two-link", *small, "--out", str(tmp_path / "plan.npz")])
    sound = {"verdict": "FAIL", "mode": None, "asked": {"rollouts": 0}}
    (tmp_path / "proof.json").write_text(json.dumps(sound | change))
    capsys.readouterr()
    assert main(["check", str(tmp_path)]) in (0, 1)
    assert "planner: " not in capsys.readouterr().err


def test_no_search_for_a_name_near_to_thousands_of_characters():
    began = time.process_time()
    assert did_you_mean("x" * 1_000_000, ["x" * 50]) == ""
    assert time.process_time() - began < 1.0


def test_every_command_of_the_parser_has_its_function():
    from planner.cli.commands import _function
    from planner.cli.parser import COMMANDS

    known = next(action.choices for action in parser.build()._actions if action.dest == "command")
    assert set(COMMANDS) == set(known)
    assert all(callable(_function(name)) for name in COMMANDS)
