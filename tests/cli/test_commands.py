"""The command line as a user meets it: exit codes, what is on stdout and what is left on disk.

Commands run in this process; those whose start or end is tested run in one of their own.
"""

import json

import numpy as np
import pytest
from carts import write
from commands import ARM, launch, refused, run

import planner
from planner.base.data_files import problem_files
from planner.cli.results import OUTPUTS

FILES = {"plan.npz", "proof.json", "plots.png", "proof.png", "report.html"}  # of a run without video


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
        assert file["us"].shape == (30, 2)
    assert meta["recipe"]["parameters"]["mass2"] == 0.3
    page = (folder / "out" / "report.html").read_text()
    assert page.index("PASS") < page.index("<table")
    assert "http" not in page.replace("http://www.w3.org", "")  # self-contained


def test_the_same_command_writes_the_same_bytes_in_another_process(finished, tmp_path):
    folder, _ = finished
    words = ["run", *ARM, "--mass2", 0.3, "--no-video", "--out", tmp_path]
    assert run(*words, cwd=tmp_path).returncode == 0
    for name in ("plan.npz", "proof.json"):
        assert (tmp_path / name).read_bytes() == (folder / "out" / name).read_bytes()


def test_with_json_stdout_is_one_document(tmp_path):
    done = run("run", *ARM, "--no-video", "--json", "--no-refine", "--out", "o", cwd=tmp_path)
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
    file = write(tmp_path)
    done = run("run", file, "--no-video", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "PASS" in done.stdout
    folder = tmp_path / "renders" / file.stem
    assert {p.name for p in folder.iterdir()} == FILES
    assert planner.load_plan(folder / "plan.npz").parameters["goal"] == [1.0, 0.0]
    done = run("solve", file, "--starts", 2, "--seed", 1, "--out", "p.npz", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert planner.load_plan(tmp_path / "p.npz").parameters["starts"] == 2


def test_a_failing_plan_is_saved_and_exits_1(tmp_path):
    done = run(
        "run", *ARM, "--integrator", "euler", "--no-video", "--json", "--no-refine", "--out", "o", cwd=tmp_path
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


def test_what_is_packed_into_a_plan_is_listed_and_nothing_is_written(tmp_path):
    wedge = "v 0 0 0\nv .1 0 0\nv 0 .1 0\nv 0 0 .1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    (tmp_path / "wedge.obj").write_text(wedge)
    model = """<mujoco><asset><mesh name="wedge" file="wedge.obj"/></asset><worldbody><body>
      <joint name="hinge" axis="0 1 0"/><geom type="mesh" mesh="wedge" mass="1"/></body></worldbody>
      <actuator><motor joint="hinge"/></actuator></mujoco>"""
    (tmp_path / "one.xml").write_text(model)
    (tmp_path / "one.toml").write_text('model = "one.xml"\ngoal = { hinge = 0.5 }\nduration = 0.5\n')
    assert run("solve", "one.toml", "--out", "one.npz", "--quiet", cwd=tmp_path).returncode == 0
    before = set(tmp_path.iterdir())
    done = run("report", "one.npz", "--files", "--json", cwd=tmp_path)
    packed = json.loads(done.stdout)["files"]
    assert done.returncode == 0
    assert set(tmp_path.iterdir()) == before
    twin = planner.load_plan(tmp_path / "one.npz").twin
    assert packed["model, as planned"] == len(twin.mjcf)
    assert {name: packed[name] for name in twin.assets} == {name: len(data) for name, data in twin.assets.items()}
    assert any("wedge" in name for name in packed)


def test_prove_with_an_edited_a_broken_and_a_missing_model(finished, tmp_path):
    folder, _ = finished
    plan = planner.load_plan(folder / "out" / "plan.npz")
    other = tmp_path / "other.xml"
    other.write_text(plan.twin.mjcf.replace('mass="0.3"', 'mass="0.4"'))
    assert run("prove", folder / "out" / "plan.npz", "--model", other, cwd=tmp_path).returncode == 1
    other.write_text(plan.twin.mjcf[:1000])
    refused(run("prove", folder / "out" / "plan.npz", "--model", other, cwd=tmp_path), "not well-formed XML")
    refused(run("prove", folder / "out" / "plan.npz", "--model", "no.xml", cwd=tmp_path), "no.xml")


def test_stale_pictures_do_not_stay_beside_a_new_plan(tmp_path):
    (tmp_path / "video.mp4").write_bytes(b"an older plan's")
    (tmp_path / "mine.mp4").write_bytes(b"not ours")
    words = ["run", *ARM, "--no-video", "--quiet", "--out", tmp_path]
    assert run(*words, cwd=tmp_path).returncode == 0
    assert not (tmp_path / "video.mp4").exists()
    assert (tmp_path / "mine.mp4").exists()
    assert {p.name for p in tmp_path.iterdir()} - {"mine.mp4"} <= set(OUTPUTS)


def test_list_shows_a_line_for_each_machine(tmp_path):
    done = run("list", cwd=tmp_path)
    lines = done.stdout.splitlines()
    assert done.returncode == 0
    machines = [*planner.cases.CASES, *problem_files()]
    assert [line.split()[0] for line in lines[: len(machines)]] == machines
    assert len(lines) <= len(machines) + 3
    assert max(map(len, lines)) <= 100
    cases = json.loads(run("list", "--json", cwd=tmp_path).stdout)["cases"]
    assert {case["case"]: case["parameters"] for case in cases}["hopper"]["height"] == 20.0
    assert [case["case"] for case in cases] == list(planner.cases.CASES)


@pytest.mark.slow
def test_list_has_the_parameters_that_each_machine_is_built_with(tmp_path):
    for case in json.loads(run("list", "--json", cwd=tmp_path).stdout)["cases"]:
        hidden = {"ends", "angles"}  # numbers of a plan, nothing to type
        assert set(case["parameters"]) == set(planner.cases.build(case["case"]).parameters) - hidden


def test_list_of_a_machine_shows_its_flags_and_of_a_problem_file_its_keys(tmp_path):
    done = run("list", "hopper", cwd=tmp_path)
    assert "--flow-weight" in done.stdout
    assert "--flow-weight" not in run("list", "two-link", cwd=tmp_path).stdout
    assert "final_position" in run("list", "PROBLEM.toml", cwd=tmp_path).stdout
    assert max(map(len, done.stdout.splitlines())) <= 100
    refused(run("list", "hoper", cwd=tmp_path), "the machine is 'hoper'", "Did you mean 'hopper'?")


@pytest.mark.parametrize(("form", "ending"), [("csv", ".csv"), ("json", ".json"), ("yaml", ".yaml"),
                                              ("keyframes", ".keys.xml")])  # fmt: skip
def test_export_writes_beside_the_plan(tmp_path, form, ending):
    planner.solve(planner.cases.two_link(), max_iterations=1).save(tmp_path / "a.npz")
    done = run("export", "a.npz", "--to", form, "--rate", 20, "--json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    document = json.loads(done.stdout)
    assert (document["file"], document["samples"]) == (f"a{ending}", 41)
    assert (tmp_path / f"a{ending}").stat().st_size > 1000


def test_export_refuses_in_a_sentence(tmp_path):
    planner.solve(planner.cases.hopper(), max_iterations=1).save(tmp_path / "a.npz")
    refused(run("export", "a.npz", "--to", "yaml", cwd=tmp_path), "write a CSV")
    refused(run("export", "a.npz", "--to", "yaml", "--out", "a.json", cwd=tmp_path), "expected a name ending in .yaml")
    refused(run("export", "a.npz", "--to", "csv", "--rate", -1, cwd=tmp_path), "rate is -1.0")
    refused(run("export", "a.npz", "--to", "json", "--only", "states", cwd=tmp_path), "--only is for --to csv")
    refused(run("export", "", "--to", "csv", cwd=tmp_path), "expected a plan.npz")
    refused(run("export", "b.npz", "--to", "csv", cwd=tmp_path), "does not exist")
    assert [path.name for path in tmp_path.iterdir()] == ["a.npz"]


def test_help_shows_flags_with_defaults_and_units(tmp_path):
    text = run("run", "hopper", "--help", cwd=tmp_path)
    assert text.returncode == 0
    for word in ("--height", "Default: 20.0", "--no-refine", "--no-video", "--json", "in/s^2"):
        assert word in text.stdout


def test_version_and_no_command_at_all_exit_0(tmp_path):
    assert launch("--version", cwd=tmp_path).stdout.startswith(f"planner {planner.__version__}  ")
    assert run(cwd=tmp_path).returncode == 0


def test_warmup_says_nothing_where_all_is_compiled(tmp_path):
    assert run("warmup", cwd=tmp_path).returncode == 0
    assert launch("warmup", cwd=tmp_path).stdout == ""
