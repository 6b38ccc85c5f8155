"""A command line is checked before anything slow is imported, with the words of the modules that are not imported."""

import inspect
import json
import subprocess
import sys
from typing import get_type_hints

import pytest

import planner
from planner.cases.problem_file import keys
from planner.cli import case_flags
from planner.cli.commands import check_inputs
from planner.cli.flags import value_of
from planner.cli.parser import parse

SLOW = ("mujoco", "numba", "scipy", "matplotlib")


WRONG = [
    (["runn"], "COMMAND is 'runn'"),
    (["run", "nosuch"], "CASE is 'nosuch'"),
    (["run", "hopper", "--hihgt", "3"], "Did you mean --height?"),
    (["run", "reach.toml", "--goal", "3"], "goal is a key of the file: write it in reach.toml."),
    (["run", "reach.toml"], "cannot read the problem file reach.toml: No such file"),
    (["run", "hopper", "--height", "tall"], "--height"),
    (["model", "arm.xml"], "cannot read the model arm.xml: No such file"),
    (["prove", "plan.npz", "--bad"], "no flag '--bad'"),
    (["prove", "plan.npz"], "plan.npz does not exist, expected a plan.npz"),
    (["view", "plan.npz", "--browser"], "plan.npz does not exist, expected a plan.npz"),
    (["export", "plan.npz"], "arguments are required: --to (one of: csv, json, yaml, keyframes) (see"),
    (["export", "plan.npz", "--only"], "--only (one of: states, controls): expected one argument (see"),
    (["completion"], "arguments are required: SHELL (one of: bash, zsh, tcsh) (see"),
    (["solve"], "arguments are required: CASE (one of: two-link, "),
    (["run", "acrobot", "--hessian"], "--hessian (one of: gauss-newton, exact): expected one argument (see"),
    (["list", "pik"], "the machine is 'pik'"),
    (["run", "late.toml"], "duration stands in [[goal]] number 1 of late.toml"),
    (["solve", "unit.toml"], "line 1 has a unit, s, expected duration = 2:"),
    (["run", "negative.toml"], "duration is -2"),
    (["drive", "word.toml"], "Did you mean 'tolerance'?"),
    (["run", "guess.toml"], "guess is 'lin', expected one of: auto, line, "),
    (["run", "tabled.toml"], "guess is {'a': 1}, expected one of: auto, line, "),
    (["run", "step.toml"], "dt is 'fast', expected a finite number greater than 0, or 'auto'."),
    (["run", "stages.toml"], "duration is 1 s, expected a whole number of stages of 0.03 s, e.g. 0.99."),
    (["run", "long.toml"], "dt is 5 s, longer than the duration of 1 s, expected a part of it."),
    (["run", "absent.toml"], "cannot read the model nowhere.xml: No such file"),
    (["solve", "goal.toml"], "goal 2: position of a goal is [0, 0], expected 3 numbers, e.g. [0.0, 0.0, 0.0]."),
    (["solve", "obstacle.toml"], "shape of an obstacle is 'bx'"),
    (["solve", "soft.toml"], "tolerance is -1, expected a number above 0"),
    (["run", "title.toml"], "title is 3, expected a text."),
    (["run", "apart.toml"], "clearance of avoid is -0.01, expected a finite number greater than 0."),
    (["run", "self.toml"], "self of avoid is 'no', expected true or false."),
    (["run", "avoided.toml"], "avoid is True, expected a table."),
    (["run", "limits.toml"], "limits is 'of', expected one of: off. Did you mean 'off'?"),
    (["run", "torque.toml"], "control of limits is -3, expected a finite number greater than 0."),
    (
        ["run", "speed.toml"],
        "{ elbow = 2.0 }, rad/s or m/s, or 'model' or 'off'. Did you mean 'model'?",
    ),
    (["run", "within.toml"], "[[constraint]] 2's within is 'narrow', expected a finite number greater than 0."),
    (["run", "along.toml"], "[[constraint]] 1's along is 'up', expected one of: x, y, z."),
    (["solve", "right.toml", "--objective", "tme"], "Did you mean 'time'?"),
    (["solve", "right.toml", "--starts", "0"], "--starts: '0' is not a whole number of at least 1"),
    (["run", "acrobot", "--objective", "time", "--durations", "1"], "--durations is '1', expected SHORTEST,LONGEST"),
    (["run", "acrobot", "--rollouts", "-1"], "--rollouts: '-1' is not a whole number of at least 0"),
]
RIGHT = 'model = "here.xml"\nduration = 1\n'
FILES = {
    "late": 'model = "arm.xml"\n[[goal]]\nframe = "hand"\nduration = 2\n',
    "unit": "duration = 2s\n",
    "negative": 'model = "arm.xml"\nduration = -2\n',
    "word": 'model = "arm.xml"\nduration = 2\ntolerence = 1\n',
    "right": RIGHT,
    "guess": f'{RIGHT}guess = "lin"\n',
    "tabled": f"{RIGHT}guess = {{ a = 1 }}\n",
    "step": f'{RIGHT}dt = "fast"\n',
    "stages": f"{RIGHT}dt = 0.03\n",
    "long": f"{RIGHT}dt = 5\n",
    "absent": 'model = "nowhere.xml"\nduration = 1\n',
    "goal": f"{RIGHT}[[goal]]\nframe = 'hand'\nposition = [0, 0, 1]\n[[goal]]\nframe = 'hand'\nposition = [0, 0]\n",
    "obstacle": f"{RIGHT}[[obstacle]]\nshape = 'bx'\n",
    "soft": f"{RIGHT}tolerance = -1\n",
    "title": f"{RIGHT}title = 3\n",
    "apart": f"{RIGHT}[avoid]\nclearance = -0.01\n",
    "self": f"{RIGHT}[avoid]\nself = 'no'\n",
    "avoided": f"{RIGHT}avoid = true\n",
    "limits": f"{RIGHT}limits = 'of'\n",
    "torque": f"{RIGHT}[limits]\ncontrol = -3\n",
    "speed": f"{RIGHT}[limits]\nvelocity = 'modl'\n",
    "within": f"{RIGHT}[[constraint]]\nframe = 'hand'\nposition = [0, 0, 1]\n"
    "[[constraint]]\nframe = 'hand'\npointing = 'z'\nwithin = 'narrow'\n",
    "along": f"{RIGHT}[[constraint]]\nframe = 'hand'\nalong = 'up'\nlower = 0.1\n",
}
EACH = """
import contextlib, io, json, sys
from planner.__main__ import main
for words in json.loads(sys.argv[1]):
    with contextlib.redirect_stdout(io.StringIO()) as text, contextlib.redirect_stderr(text):
        code = main(words)
    print(json.dumps([words, code, text.getvalue(), [m for m in {slow!r} if m in sys.modules]]))
"""


def test_words_that_are_wrong_or_ask_for_keys_are_answered_without_mujoco_or_numba(tmp_path):
    """All in one process, whose start takes longer than an answer."""
    for name, text in FILES.items():
        (tmp_path / f"{name}.toml").write_text(text)
    (tmp_path / "here.xml").write_text("")
    asked = {0: [(["list", "pick.toml"], "goal.tolerance")], 2: WRONG}
    sentences = {tuple(words): (code, sentence) for code, each in asked.items() for words, sentence in each}
    code = [sys.executable, "-c", EACH.format(slow=SLOW), json.dumps(list(sentences))]
    done = subprocess.run(code, cwd=tmp_path, capture_output=True, text=True, timeout=120)
    answers = [json.loads(line) for line in done.stdout.splitlines()]
    assert len(answers) == len(sentences), done.stderr
    for words, code, message, slow in answers:
        expected, sentence = sentences[tuple(words)]
        assert (code, slow) == (expected, []), words
        assert sentence in message


@pytest.mark.parametrize("lines", ["", "durations = [0.5, 3.0]\n"], ids=["none", "given"])
def test_an_objective_with_time_needs_no_durations(tmp_path, lines):
    """By default they are a fifth and twice the problem's own."""
    (tmp_path / "here.xml").write_text("")
    (tmp_path / "time.toml").write_text(f'{RIGHT}objective = "time"\n{lines}')
    check_inputs(parse(["run", str(tmp_path / "time.toml")]))


def test_help_of_a_command_lists_the_flags_of_all_its_cases(capsys):
    from planner.cli.parser import build

    text = build(["run"])._subparsers._group_actions[0].choices["run"].format_help()
    assert "flags of every CASE" in text
    for flag in ("--max-iterations", "--no-video", "--hold", "--json"):
        assert flag in text
    assert "--height" not in text  # of one case
    assert "--package-path" not in text  # of problem files


@pytest.mark.parametrize("name", planner.cases.CASES)
def test_signatures_read_from_the_sources_are_those_of_the_cases(name):
    light, case = case_flags.CASES[name], planner.cases.CASES[name]
    hints = get_type_hints(case)
    hints.pop("return")
    assert inspect.signature(light).parameters == inspect.signature(case).parameters
    assert get_type_hints(light) == hints
    assert inspect.getdoc(light) == inspect.getdoc(case)


def test_constants_read_from_the_sources_are_those_of_the_modules():
    from planner.problem.export import PARTS
    from planner.problem.problem_parts import OBJECTIVES
    from planner.proof.engines import ENGINES
    from planner.solvers import options

    assert list(case_flags.CASES) == list(planner.cases.CASES)
    assert case_flags.INTEGRATORS == planner.dynamics.INTEGRATORS
    assert (case_flags.OBJECTIVES, case_flags.DEFAULTS) == (OBJECTIVES, keys.DEFAULTS)
    for name in ("HESSIANS", "LINE_SEARCHES", "UPDATES"):
        assert getattr(case_flags, name) == getattr(options, name)
    for name in ("KEYS", "VALUES", "WEIGHTS", "GOAL", "FOLLOW", "ATTACH", "OBSTACLE"):
        assert value_of("planner.cases.problem_file.keys", name) == getattr(keys, name)
    assert value_of("planner.proof.engines", "ENGINES") == ENGINES
    assert value_of("planner.problem.export", "PARTS") == PARTS


@pytest.mark.parametrize(
    ("text", "cause"),
    [
        ("model = arm.xml", 'line 1 has a text without quotes, expected model = "arm.xml"'),
        (
            "goal = { elbow = 1 }\n[[goal]]\nframe = 'hand'",
            r"goal is a value in line 1 and a table \[\[goal\]\] in line 2",
        ),
        ("start = [1, 2", "is not TOML: "),
    ],
)
def test_a_file_that_is_not_toml_is_told_what_is_wrong(text, cause, tmp_path):
    (tmp_path / "reach.toml").write_text(text)
    with pytest.raises(planner.PlannerError, match=cause):
        planner.load_problem(tmp_path / "reach.toml")


def test_a_quaternion_of_three_numbers_is_told_its_order():
    with pytest.raises(planner.PlannerError, match="expected the four numbers of a quaternion, w first"):
        planner.Goal(frame="hand", orientation=[0.0, 0.0, 1.0])


def test_a_solve_imports_no_pictures_no_opengl_no_proof_and_no_problem_file(tmp_path):
    """They were a third of its processor time; MuJoCo only reads the model."""
    code = (
        "import sys\nfrom planner.__main__ import main\ncode = main(['solve', 'two-link', '--quiet'])\n"
        "loaded = [m for m in sys.modules if m.split('.')[0] in ('OpenGL', 'PIL', 'matplotlib')]\n"
        "unneeded = ('planner.view.', 'planner.proof.', 'planner.cases.problem_file.build')\n"
        "print(code, [m for m in sys.modules if m.startswith(unneeded)], loaded)"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert done.stdout.splitlines()[-1] == "0 [] []", done.stderr
