"""The command line as a user meets it: exit codes, what is on stdout and what is left on disk.

Commands run in this process; those whose start, end or signals are tested run in one of their own.
"""

import contextlib
import io
import json
import os
import signal
import subprocess
import sys

import numpy as np
import pytest
from places import ROOT

import planner
from planner.__main__ import main
from planner.cli.results import OUTPUTS

EXAMPLES = ROOT / "examples"
PLANNER = [sys.executable, "-m", "planner"]
FILES = {"plan.npz", "proof.json", "plots.png", "proof.png", "report.html"}  # of a run without video


def without_rollouts(words):
    """A command line without the perturbed rollouts (test_run.py has them)."""
    if words and words[0] in ("run", "prove", "report") and "--rollouts" not in words and len(words) > 2:
        words = (*words, "--rollouts", 0)
    return [str(word) for word in words]


def run(*words, cwd):
    """The command in this process."""
    words, out, err = without_rollouts(words), io.StringIO(), io.StringIO()
    with contextlib.chdir(cwd), contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code = main(words)
        except SystemExit as end:  # --help
            code = end.code
    return subprocess.CompletedProcess(words, code, out.getvalue(), err.getvalue())


def launch(*words, cwd, **options):
    """The command in a process of its own."""
    command = [*PLANNER, *without_rollouts(words)]
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True, timeout=300, **options)


def refused(done, *fragments):
    """Exit 2, one sentence, no traceback, nothing on stdout."""
    assert done.returncode == 2, done.stderr
    lines = done.stderr.strip().splitlines()
    assert len(lines) == 1, done.stderr
    assert lines[0].startswith("planner: ")
    assert done.stdout == ""
    for fragment in fragments:
        assert fragment in lines[0], lines[0]


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """One run of the hopper without pictures."""
    folder = tmp_path_factory.mktemp("run")
    done = launch("run", "hopper", "--height", 12, "--no-video", "--out", "out", cwd=folder)
    return folder, done


def test_run_writes_plan_proof_plots_and_report(finished):
    folder, done = finished
    assert done.returncode == 0, done.stderr
    assert "PASS (open-loop)" in done.stdout
    assert "iter" in done.stderr  # the table of work is not a result
    assert {p.name for p in (folder / "out").iterdir()} == {
        "plan.npz",
        "proof.json",
        "plots.png",
        "proof.png",
        "report.html",
    }
    proof = json.loads((folder / "out" / "proof.json").read_text())
    assert (proof["verdict"], proof["mode"]) == ("PASS", "open-loop")
    with np.load(folder / "out" / "plan.npz", allow_pickle=False) as file:
        meta = json.loads(str(file["meta"]))
        assert file["us"].shape == (200, 1)
    assert meta["recipe"]["parameters"]["height"] == 12.0
    page = (folder / "out" / "report.html").read_text()
    assert page.index("PASS") < page.index("<table")
    assert "http" not in page.replace("http://www.w3.org", "")  # self-contained


def test_the_same_command_writes_the_same_bytes_in_another_process(finished, tmp_path):
    folder, _ = finished
    assert run("run", "hopper", "--height", 12, "--no-video", "--out", tmp_path, cwd=tmp_path).returncode == 0
    for name in ("plan.npz", "proof.json"):
        assert (tmp_path / name).read_bytes() == (folder / "out" / name).read_bytes()


def test_with_json_stdout_is_one_document(tmp_path):
    done = run("run", "hopper", "--no-video", "--json", "--no-refine", "--out", "o", cwd=tmp_path)
    document = json.loads(done.stdout)
    assert done.returncode == document["exit_code"] == 0
    assert document["proof"]["verdict"] == "PASS"
    assert document["plan"]["status"] == "CONVERGED"
    assert document["plan"]["parameters"]["integrator"] == "rk4"
    assert "PASS" in done.stderr


@pytest.mark.parametrize(
    "flags",
    [
        ("--integrator", "semi-implicit-euler", "--horizon", 400),
        ("--update", "open-loop"),
        ("--line-search", "exact"),
        ("--line-search", "wolfe"),
        ("--line-search", "goldstein"),
        ("--hessian", "exact"),
        ("--duration", 1.5, "--smoothing", 0.05, "--stiffness", 120, "--gravity", 300),
    ],
    ids=str,
)
def test_flags_reach_the_plan(tmp_path, flags):
    done = run("solve", "hopper", "--height", 8, *flags, "--out", "p.npz", "--json", cwd=tmp_path)
    document = json.loads(done.stdout)
    assert done.returncode == 0, done.stderr
    parameters = planner.load_plan(tmp_path / "p.npz").parameters
    for flag, value in zip(flags[::2], flags[1::2], strict=True):
        if flag[2:] in parameters:
            assert parameters[flag[2:]] == value
    assert document["plan"]["iterations"] > 0


@pytest.mark.parametrize("words", [("two-link",), ("acrobot",), ("acrobot", "--start", "hanging")], ids=" ".join)
def test_the_arms_pass_and_their_stored_plans_prove_the_same(tmp_path, words):
    done = run("run", *words, "--no-video", "--json", "--out", "o", cwd=tmp_path)
    document = json.loads(done.stdout)
    assert done.returncode == 0, done.stderr
    assert (document["plan"]["status"], document["proof"]["verdict"]) == ("CONVERGED", "PASS")
    done = run("prove", tmp_path / "o" / "plan.npz", "--out", "again.json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "again.json").read_bytes() == (tmp_path / "o" / "proof.json").read_bytes()


def test_several_starts_keep_the_cheapest_and_repeat_by_their_seed(tmp_path):
    words = ["solve", "two-link", "--horizon", 40, "--starts", 3, "--seed", 4, "--json"]
    done = run(*words, "--out", "p.npz", cwd=tmp_path)
    document = json.loads(done.stdout)
    plan = planner.load_plan(tmp_path / "p.npz")
    assert [start["number"] for start in document["plan"]["starts"]] == [0, 1, 2]
    assert document["plan"]["start"] == plan.start
    assert plan.cost == min(start.cost for start in plan.starts if start.status is planner.Status.CONVERGED)
    assert "start" in done.stderr  # the table of starts
    assert "of 3 is the best" in done.stderr
    assert run(*words, "--out", "q.npz", cwd=tmp_path).returncode == 0
    assert (tmp_path / "q.npz").read_bytes() == (tmp_path / "p.npz").read_bytes()


def test_a_problem_file_is_run_proved_and_solved_like_a_case(tmp_path):
    done = run("run", EXAMPLES / "crane.toml", "--no-video", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "PASS" in done.stdout
    folder = tmp_path / "renders" / "crane"  # named after the file
    assert {p.name for p in folder.iterdir()} == FILES
    done = run("prove", folder / "plan.npz", "--json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["plan"]["parameters"]["goal"] == {"trolley": 2.0}
    done = run("solve", EXAMPLES / "crane.toml", "--starts", 2, "--seed", 1, "--out", "p.npz", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert planner.load_plan(tmp_path / "p.npz").parameters["starts"] == 2


def test_a_wrong_problem_file_is_refused_in_one_sentence(tmp_path):
    text = (EXAMPLES / "crane.toml").read_text().replace("crane.xml", str(EXAMPLES / "crane.xml"))
    for old, new, fragments in (
        ("trolley = 2.0", "troley = 2.0", ("troley", "Did you mean 'trolley'?")),
        ('contacts = "off"', "", ("crane.xml", "contacts", "contacts='off'")),
        ("dt = 0.02", "dt = -0.02", ("dt is -0.02",)),
        ("duration", "durration", ("durration", "Did you mean 'duration'?")),
    ):
        (tmp_path / "p.toml").write_text(text.replace(old, new))
        refused(run("run", "p.toml", cwd=tmp_path), *fragments)
        assert [p.name for p in tmp_path.iterdir()] == ["p.toml"]


def test_prove_refuses_the_model_of_another_machine(finished, tmp_path):
    folder, _ = finished
    other = planner.cases.acrobot().twin
    assert other is not None
    (tmp_path / "other.xml").write_text(other.mjcf)
    refused(run("prove", folder / "out" / "plan.npz", "--mjcf", "other.xml", cwd=tmp_path), "the plan was made for")
    assert [p.name for p in tmp_path.iterdir()] == ["other.xml"]


def test_a_failing_plan_is_saved_and_exits_1(tmp_path):
    done = launch(
        "run", "hopper", "--integrator", "euler", "--horizon", 50, "--no-video", "--json", "--no-refine", "--out", "o",
        cwd=tmp_path,
    )  # fmt: skip
    assert done.returncode == 1
    document = json.loads(done.stdout)
    assert document["proof"]["verdict"] == "FAIL"
    assert document["proof"]["mode"] is None
    assert (tmp_path / "o" / "plan.npz").is_file()
    assert "FAIL" in (tmp_path / "o" / "report.html").read_text()


def test_a_solve_that_does_not_converge_gives_advice_and_exits_1(tmp_path):
    done = run("solve", "hopper", "--max-iterations", 2, "--out", "p.npz", cwd=tmp_path)
    assert done.returncode == 1
    assert "raise max_iterations" in done.stdout
    assert planner.load_plan(tmp_path / "p.npz").status is planner.Status.MAX_ITERATIONS


def test_a_stored_plan_is_proved_and_reported(finished, tmp_path):
    folder, _ = finished
    plan = folder / "out" / "plan.npz"
    done = run("prove", plan, "--out", "proof.json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "proof.json").read_bytes() == (folder / "out" / "proof.json").read_bytes()
    done = run("report", plan, "--no-video", "--out", "r", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "r" / "report.html").is_file()


def test_prove_with_an_edited_a_broken_and_a_missing_model(finished, tmp_path):
    folder, _ = finished
    plan = planner.load_plan(folder / "out" / "plan.npz")
    other = tmp_path / "other.xml"
    other.write_text(plan.twin.mjcf.replace('gainprm="100"', 'gainprm="90"'))
    assert run("prove", folder / "out" / "plan.npz", "--mjcf", other, cwd=tmp_path).returncode == 1
    other.write_text(plan.twin.mjcf[:1000])
    refused(run("prove", folder / "out" / "plan.npz", "--mjcf", other, cwd=tmp_path), "not well-formed XML")
    refused(run("prove", folder / "out" / "plan.npz", "--mjcf", "no.xml", cwd=tmp_path), "no.xml")


@pytest.mark.parametrize(
    ("words", "fragments"),
    [
        (("run", "hopper", "--height", "-3"), ("height is -3.0", "greater than 0")),
        (("run", "hopper", "--height", "nan"), ("height is nan", "finite")),
        (("run", "hopper", "--height", "inf"), ("height is inf",)),
        (("run", "hopper", "--height", "tall"), ("--height", "'tall' is not a number")),
        (("run", "hopper", "--smoothing", "0"), ("smoothing is 0.0",)),
        (("run", "hopper", "--horizon", "0"), ("horizon is 0", "at least 1")),
        (("run", "hopper", "--horizon", "2.5"), ("'2.5' is not a whole number",)),
        (("run", "hopper", "--duration", "-1"), ("duration is -1.0",)),
        (("run", "hopper", "--horizon", "1000000000"), ("horizon is 1000000000", "at most")),
        (("run", "hopper", "--duration", "1e300"), ("duration is 1e+300", "at most")),
        (("run", "hopper", "--flow-weight", "0"), ("flow_weight is 0.0",)),
        (("run", "hopper", "--integrator", "rk5"), ("rk5", "semi-implicit-euler")),
        (("run", "hopper", "--line-search", "golden"), ("golden", "goldstein")),
        (("run", "hopper", "--max-iterations", "0"), ("max_iterations is 0",)),
        (("run", "hopper", "--hieght", "3"), ("--hieght", "Did you mean --height?")),
        (("run", "hoper"), ("hoper", "hopper")),
        (("run",), ("CASE",)),
        (("run", "acrobot", "--start", "up"), ("--start", "'up'", "hanging")),
        (("run", "acrobot", "--gues", "zero"), ("--gues", "Did you mean --guess?")),
        (("run", "two-link", "--mass1", "0"), ("mass1 is 0.0",)),
        (("run", "two-link", "--starts", "0"), ("starts is 0", "at least 1")),
        (("run", "two-link", "--starts", "2", "--seed", "-1"), ("seed is -1",)),
        (("run", "nowhere.toml"), ("nowhere.toml", "No such file")),
        (("solve", "nowhere.toml", "--height", "3"), ("--height",)),
        (("run", "crane.xml"), ("crane.xml", "two-link", "PROBLEM.toml")),
        (("fly",), ("fly", "run")),
        (("run", "hopper", "extra"), ("'extra'",)),
        (("prove", "nowhere.npz"), ("nowhere.npz", "does not exist")),
        (("render", "nowhere.npz", "--out", "x.gif"), ("x.gif", ".mp4")),
        (("render", "nowhere.npz", "--size", "big"), ("'big' is not a size",)),
        (("paper", "gripper"), ("gripper", "hopper")),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, tuple) else None,
)
def test_wrong_words_are_refused_in_one_sentence(tmp_path, words, fragments):
    refused(run(*words, cwd=tmp_path), *fragments)
    assert list(tmp_path.iterdir()) == []  # nothing half-written


def test_a_refusal_exits_2_with_one_sentence_and_no_traceback(tmp_path):
    refused(launch("run", "hopper", "--height", "-3", cwd=tmp_path), "height is -3.0")
    done = launch("run", "hopper", "--height", "-3", "--json", cwd=tmp_path)
    assert done.returncode == 2
    assert json.loads(done.stdout)["error"].startswith("height is -3.0")


def test_prove_refuses_files_that_are_no_plans(tmp_path):
    (tmp_path / "x.npz").write_bytes(b"PK\x03\x04nonsense")
    refused(run("prove", "x.npz", cwd=tmp_path), "x.npz is not a plan")
    np.savez(tmp_path / "y.npz", a=np.zeros(3))
    refused(run("prove", "y.npz", cwd=tmp_path), "y.npz is not a plan")


def test_folders_that_cannot_be_written_are_refused(tmp_path):
    (tmp_path / "file").write_text("mine")
    refused(run("run", "hopper", "--no-video", "--out", "file/sub", cwd=tmp_path), "file")
    refused(run("run", "hopper", "--no-video", "--out", "file", cwd=tmp_path), "file")
    refused(run("solve", "hopper", "--out", "file/plan.npz", cwd=tmp_path), "file")
    refused(run("run", "hopper", "--no-video", "--out", "/proc/planner", cwd=tmp_path), "/proc/planner")
    refused(run("solve", "hopper", "--out", "p.txt", cwd=tmp_path), ".npz")
    assert [p.name for p in tmp_path.iterdir()] == ["file"]
    assert (tmp_path / "file").read_text() == "mine"


def test_a_failed_run_leaves_older_results_alone(finished, tmp_path):
    folder, _ = finished
    for name in ("plan.npz", "proof.json"):
        (tmp_path / name).write_bytes((folder / "out" / name).read_bytes())
    (tmp_path / "notes.txt").write_text("mine")
    before = {p.name: p.read_bytes() for p in tmp_path.iterdir()}
    refused(run("run", "hopper", "--height", "-1", "--out", tmp_path, cwd=tmp_path), "height")
    # A file-size limit stands in for a full disk: the plan is larger than that.
    code = (
        "import resource, signal, sys; signal.signal(signal.SIGXFSZ, signal.SIG_IGN);"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (12000, 12000));"
        "from planner.__main__ import main; sys.exit(main(sys.argv[1:]))"
    )
    words = ["run", "hopper", "--no-video", "--quiet", "--rollouts", "0", "--out", str(tmp_path)]
    done = subprocess.run([sys.executable, "-c", code, *words], capture_output=True, text=True, timeout=300)
    assert done.returncode == 2, done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
    assert {p.name: p.read_bytes() for p in tmp_path.iterdir()} == before


def test_stale_pictures_do_not_stay_beside_a_new_plan(tmp_path):
    (tmp_path / "video.mp4").write_bytes(b"an older plan's")
    (tmp_path / "mine.mp4").write_bytes(b"not ours")
    assert run("run", "hopper", "--no-video", "--quiet", "--out", tmp_path, cwd=tmp_path).returncode == 0
    assert not (tmp_path / "video.mp4").exists()
    assert (tmp_path / "mine.mp4").exists()
    assert {p.name for p in tmp_path.iterdir()} - {"mine.mp4"} <= set(OUTPUTS)


def test_ctrl_c_keeps_the_best_plan(tmp_path):
    # A problem that needs thousands of iterations, interrupted while it runs.
    words = ["solve", "hopper", "--height", "50", "--smoothing", "1e-4", "--horizon", "4000", "--integrator", "euler",
             "--max-iterations", "1000000", "--out", "p.npz"]  # fmt: skip
    child = subprocess.Popen(
        [*PLANNER, *words], cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert child.stderr is not None
    try:
        for line in child.stderr:
            if line.strip().startswith("9 "):  # the tenth iteration is done
                break
        child.send_signal(signal.SIGINT)
        out, _ = child.communicate(timeout=60)
    finally:
        child.kill()
    assert child.returncode == 1, out
    plan = planner.load_plan(tmp_path / "p.npz")
    assert plan.status is planner.Status.INTERRUPTED
    assert plan.cost < plan.history[0].cost
    assert plan.problem is not None
    assert plan.cost == pytest.approx(plan.problem.cost.value(plan.xs, plan.us), rel=1e-12)


def test_list_shows_every_case_with_its_parameters(tmp_path):
    done = run("list", cwd=tmp_path)
    assert done.returncode == 0
    assert "hopper" in done.stdout
    assert "--flow-weight" in done.stdout
    assert max(map(len, done.stdout.splitlines())) <= 100
    cases = json.loads(run("list", "--json", cwd=tmp_path).stdout)["cases"]
    assert {case["case"]: case["parameters"] for case in cases}["hopper"]["height"] == 20.0
    assert [case["case"] for case in cases] == list(planner.cases.CASES)
    for case in cases:
        hidden = {"ends", "angles"}  # numbers of a plan, nothing to type
        assert set(case["parameters"]) == set(planner.cases.build(case["case"]).parameters) - hidden


def test_help_shows_flags_with_defaults_and_units(tmp_path):
    text = run("run", "hopper", "--help", cwd=tmp_path)
    assert text.returncode == 0
    for word in ("--height", "Default: 20.0", "--no-refine", "--no-video", "--json", "in/s^2"):
        assert word in text.stdout


def test_version_and_no_command_at_all_exit_0(tmp_path):
    assert "planner" in launch("--version", cwd=tmp_path).stdout
    assert run(cwd=tmp_path).returncode == 0


def test_warmup_says_nothing_where_all_is_compiled(tmp_path):
    assert run("warmup", cwd=tmp_path).returncode == 0
    assert launch("warmup", cwd=tmp_path).stdout == ""


def test_a_pipe_that_closes_early_is_no_error(tmp_path):
    code = f"{sys.executable} -m planner list | head -n 1"
    done = subprocess.run(["sh", "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert done.stdout.count("\n") == 1
    assert done.stderr == ""


@pytest.mark.slow
def test_without_a_writable_home_it_compiles_for_itself(tmp_path):
    """Compiles for this process only, and says that it compiles."""
    environment = {k: v for k, v in os.environ.items() if k not in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME")}
    done = launch(
        "solve", "hopper", "--quiet", "--out", "p.npz", cwd=tmp_path, env=environment | {"HOME": "/proc/nowhere"}
    )
    assert done.returncode == 0, done.stderr
    assert "first run only" in done.stderr


def test_a_full_stdout_exits_2_and_keeps_the_files(tmp_path):
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [*PLANNER, "run", "hopper", "--no-video", "--quiet", "--rollouts", "0", "--out", "o"],
            cwd=tmp_path, stdout=full, stderr=subprocess.PIPE, text=True, timeout=300,
        )  # fmt: skip
    assert done.returncode == 2
    assert "could not be printed" in done.stderr
    assert "Traceback" not in done.stderr
    assert (tmp_path / "o" / "report.html").is_file()


def test_prove_does_not_overwrite_a_plan(finished, tmp_path):
    folder, _ = finished
    plan = tmp_path / "p.npz"
    plan.write_bytes((folder / "out" / "plan.npz").read_bytes())
    before = plan.read_bytes()
    refused(run("prove", "p.npz", "--out", "p.npz", cwd=tmp_path), ".json")
    refused(run("prove", "p.npz", "--out", "nowhere/p.json", cwd=tmp_path), "nowhere")
    assert plan.read_bytes() == before
