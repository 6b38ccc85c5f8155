"""The page of a plan: whole, in order, and escaped."""

import base64
import math
import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from fake_plans import make_plan, make_proof, proof_of
from pages import Page, page_of
from PIL import Image

from planner import cases
from planner.base.errors import FileError
from planner.base.measured import Measurement, Section
from planner.cases.problem_file import load
from planner.model.capabilities import Capabilities
from planner.model.mechanism import Mechanism
from planner.problem.appearance import Appearance
from planner.problem.plan import Start, Status
from planner.problem.problem_parts import Recipe
from planner.proof.diagnostics.suggested_fix import SuggestedFix
from planner.proof.repair.refinement import Refinement
from planner.view.report.markup import split_after_word
from planner.view.report.page import command, problem_text, write_report


@pytest.fixture
def plan():
    return make_plan()


def test_the_verdict_comes_first_then_pictures_figures_parameters(plan, tmp_path):
    Image.new("RGB", (4, 4)).save(tmp_path / "strip.png")
    Image.new("RGB", (4, 5)).save(tmp_path / "proof.png")
    text = page_of(plan, proof_of(), tmp_path, "Not asked for.").text
    expected = (
        "PASS", "(open-loop); feasible, optimal, robust with its gains", "Poses over the motion. Not asked for.",
        "Within every bound.", "What the verdict does not cover: without friction loss.",
        "Not checked: whether the model",
        "same step (Contact <is> solved otherwise)", "Pictures", "Proof", "Code verification",
        "Mass matrix", "3e-14", "≤ 1e-10", "pass", "Contact <is> solved otherwise.", "Solution verification",
        "0.002 in", "1.5 1/s", "shown", "Validation", "No experiment was made", "Solver",
        Status.CONVERGED.value, "Parameters of the case spring", "height", "20", "rk4", "0.1.0",
        "<mujoco model='a & b'>",
    )  # fmt: skip
    place = text.index("PASS", text.index("A mass on a spring"))
    for words in expected:
        place = text.index(words, place)
    assert "FAIL" not in text


def test_the_first_screen_has_verdict_and_film_and_the_rest_is_folded(plan, tmp_path):
    text = write_report(plan, proof_of(), tmp_path).read_text(encoding="utf-8")
    first, _, _ = text[text.index("<body>") :].partition('<details class="part"')
    assert all(words in first for words in ("PASS", "robust with its gains", "Not checked", "No video was made"))
    assert not any(words in first for words in ("<svg", "<table"))
    folded = re.findall(r'class="part"><summary>([^<]*)', text)
    assert folded == ["Curves", "Proof", "How it was made"]


def test_a_picture_takes_the_place_of_a_film_that_was_not_made(plan, tmp_path):
    """The panel was empty but for a sentence where a browser has no 3-D view."""
    Image.new("RGB", (4, 4)).save(tmp_path / "plots.png")
    text = write_report(plan, proof_of(), tmp_path, "Not asked for.").read_text(encoding="utf-8")
    motion, _, _ = text[text.index('<div class="motion">') :].partition('<div class="notes">')
    assert motion.count("<img src=") == text.count("<img src=") == 1  # and nowhere twice
    assert "the convergence of the solver. Not asked for.</figcaption>" in motion


def test_a_yes_or_no_is_answered_and_has_no_bound(plan, tmp_path):
    """Not converged: 0, at most 0, pass, was read as a failure."""
    ended = Measurement("not_converged", 0.0, "", 0.0, "done", holds="converged")
    text = page_of(plan, proof_of(optimality=Section("optimal", (ended,))), tmp_path).text
    assert re.search(r"Converged\s*done\s*yes\s*pass", text)
    assert Section("optimal", (ended,)).rows() == [("optimal", "converged", "yes", "", "ok")]
    failed = replace(ended, value=1.0)
    assert Section("optimal", (failed,)).rows() == [("optimal", "converged", "no", "", "FAIL")]


def test_a_model_without_a_name_is_called_as_its_file(plan, tmp_path):
    recipe, twin = Recipe("problem-file", {}), replace(plan.twin, origin={"path": "a/Arm 7.xml"})
    made = replace(plan, problem=None, recipe=recipe, twin=twin)
    assert made.name == "Arm 7"
    assert "<h1>Arm 7</h1>" in write_report(made, None, tmp_path).read_text(encoding="utf-8")
    assert replace(made, twin=None).name == ""


def test_the_page_names_every_section_that_was_not_run_and_says_nothing_twice(plan, tmp_path):
    asked, late = "it was not asked for", "the solve did not succeed."
    proof = proof_of(
        perturbed=Section("robustness", not_applicable=late), hold=Section("hold", not_applicable=asked),
        another_ground=Section("contact sensitivity", not_applicable=late),
    )  # fmt: skip
    proof.remarks = ("without a thing of the file",)
    first = page_of(plan, proof, tmp_path).text.split("Code verification")[0]
    assert "; robustness, contact sensitivity (the solve did not succeed); hold (it was not asked for)." in first
    assert first.count("without a thing of the file") == first.count("Within every bound.") == 1


def test_a_finding_stands_in_the_place_of_the_solvers_own_words(plan, tmp_path):
    """Which may contradict it: no duration helps, and give it more time."""
    failed = replace(plan, status=Status.INFEASIBLE)
    change = SuggestedFix("slow", {}, key="duration", value=2.0, written="duration = 2.0")
    cause = SuggestedFix("no duration", {})
    sentences = {"slow": "it needs 2 s", "no duration": "No duration helps."}
    for fixes, expected in (([change, cause], "To pass: duration = 2.0: it needs 2 s No"), ([cause], "bound. No")):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(SuggestedFix, "text", lambda own, _: sentences[own.code])
            page = Page(write_report(failed, proof_of("FAIL"), tmp_path, fixes=fixes).read_text(encoding="utf-8"))
        assert expected in page.text
        first = page.text.split("Code verification")[0]
        assert failed.message not in first
        assert failed.message in page.text  # under how it was made
    assert f"The solver did not converge: {failed.message}" in page_of(failed, proof_of("FAIL"), tmp_path).text


@pytest.mark.parametrize(
    ("text", "parts"),
    [("short", ("short", "")), ("one two", ("one", " two")), ("unbroken", ("unbro", "ken")),
     ("a `b c`", ("a ", "`b c`")), ("`unbroken code`", ("`unbr", "oken code`")), ("`a bc d`", ("`a", " bc d`")),
     ("a ` b c d", ("a `", " b c d")), ("a unbroken", ("a unb", "roken"))],
)  # fmt: skip
def test_what_is_long_is_folded_after_a_word(text, parts):
    assert split_after_word(text, 5) == parts


def test_a_figure_beyond_its_bound_is_marked_by_word_and_colour(plan, tmp_path):
    section = Section(
        "goal", (Measurement("height_error", math.inf, "%", 0.2), Measurement("speed", math.nan, "", 1.0))
    )
    page = write_report(plan, proof_of("FAIL", None, goal=section), tmp_path).read_text(encoding="utf-8")
    assert page.count('<span class="word fail">FAIL</span>') == 3  # the section and both measured
    assert '<div class="verdict fail"' in page
    assert "∞\N{NO-BREAK SPACE}%" in page
    assert "undefined" in page


def test_a_plan_without_a_proof_fails_and_says_why(plan, tmp_path):
    broken = replace(plan, status=Status.NOT_FINITE, cost=math.nan, gradient_norm=math.inf, history=())
    text = page_of(broken, None, tmp_path).text
    assert "FAIL" in text
    assert "PASS" not in text
    assert Status.NOT_FINITE.value in text
    assert "nothing is proven" in page_of(plan, None, tmp_path).text


def test_a_proof_of_a_plan_that_did_not_converge_says_both(plan, tmp_path):
    text = page_of(replace(plan, status=Status.MAX_ITERATIONS), proof_of(), tmp_path).text
    assert f"The solver did not converge: {Status.MAX_ITERATIONS.value}" in text


def test_pictures_and_video_are_embedded_byte_for_byte(plan, tmp_path):
    data = {"video.mp4": bytes(range(256)), "strip.png": b"strip", "plots.png": b"plots", "proof.png": b"proof"}
    for name, content in data.items():
        (tmp_path / name).write_bytes(content)
    page = page_of(plan, make_proof(plan), tmp_path, note="never shown")
    embedded = [source.partition(";base64,") for source in page.sources]
    assert [kind for kind, _, _ in embedded] == ["data:video/mp4"] + ["data:image/png"] * 2
    shown = [data[name] for name in ("video.mp4", "strip.png", "proof.png")]  # the page draws the curves of plots.png
    assert [base64.b64decode(text) for _, _, text in embedded] == shown
    assert "never shown" not in page.text
    assert "link" not in page.tags


def test_all_text_is_escaped(plan, tmp_path):
    evil = '<script>alert("1")</script>&amp;'
    section = Section(evil, (Measurement(evil, 1.0, evil, 2.0, evil),))
    proof = proof_of("PASS", evil, goal=section, same_step=Section(evil, not_applicable=evil))
    proof.reason = evil
    marked = replace(
        plan, recipe=Recipe(evil, {evil: evil, "list": [evil]}), made_with={evil: evil},
        problem=SimpleNamespace(
            appearance=Appearance(evil), bounds=None, trajectory_constraints=None, ranges=None, limits=None,
            periodic=None, requirements=None, goal_specs=(), stances=(), tolerance=None, x0=np.zeros(3),
            dynamics=SimpleNamespace(nx=3, coordinates=((evil, "m"), ("b", evil), ("c", "m"))),
        ),
        twin=replace(plan.twin, mjcf=evil),
    )  # fmt: skip
    page = page_of(marked, proof, tmp_path, evil)
    assert page.tags.count("script") == 2  # the numbers of the curves, and ours
    assert page.text.count(evil) >= 12


def test_a_plan_read_without_its_problem(plan, tmp_path):
    bare = replace(plan, problem=None, recipe=None, twin=None)
    text = page_of(bare, proof_of(), tmp_path).text
    assert "Parameters" not in text
    assert "MJCF" not in text


def test_a_name_that_is_no_unicode(plan, tmp_path):
    assert page_of(replace(plan, recipe=Recipe("spring", {"file": "a\udcffb"})), None, tmp_path)


def test_a_missing_folder_is_one_sentence(plan, tmp_path):
    with pytest.raises(FileError, match="missing' does not exist"):
        write_report(plan, proof_of(), tmp_path / "missing")


def test_the_proof_is_told_in_the_three_parts_of_an_assessment(plan, tmp_path):
    """Every figure is in one part, and each part says what was done, what it does not cover and what it is for."""
    measured = (Measurement("observed_order", 4.0), Measurement("cost_change", 0.1, "%", 1.0))
    order = Section("step convergence, open loop", measured)
    given = Section("your file", (Measurement("unknown_contacts", 0.0, "", 0.0),))
    proof = proof_of(order=order, your_file=given, drake=Section("drake", (Measurement("acceleration_error", 1e-9),)))
    text = page_of(plan, proof, tmp_path).text
    code, rest = text.split("Code verification")[1].split("Solution verification")
    solution, rest = rest.split("Validation", 1)
    validation = rest.split("Solver")[0]
    for part, figures in (
        (code, ("Mass matrix", "Observed order", "Acceleration error")),
        (solution, ("End state", "Growth rate", "Cost change", "Height error")),
        (validation, ("Unknown contacts",)),
    ):
        assert all(words in part for words in figures)
        assert part.count("Done.") == part.count("Not covered.") == part.count("Use.") == 1
        assert sum(text.count(words) for words in figures) == len(figures)


def test_the_page_says_what_is_independent_of_mujoco_and_what_is_not(plan, tmp_path):
    """MuJoCo's compiler reads the file of a mechanism for both sides; other machines' equations are not of a file."""
    written = "they are written without the file that MuJoCo reads"
    assert written in page_of(plan, proof_of(), tmp_path).text
    mechanism = Mechanism.from_mjcf(MODEL)
    plan.problem.dynamics.capabilities = Capabilities(mechanism=mechanism)
    text = page_of(plan, proof_of(), tmp_path).text
    assert "Not independent is the reading of the file" in text
    assert written not in text


# How to make it again


def of_case(plan, case, **parameters):
    return replace(plan, recipe=cases.build(case, **parameters).recipe)


@pytest.mark.parametrize(
    ("case", "parameters", "line"),
    [
        ("acrobot", {}, "planner run acrobot"),
        (
            "acrobot", {"horizon": 150, "integrator": "semi-implicit-euler"},
            "planner run acrobot --horizon 150 --integrator semi-implicit-euler",
        ),
        ("acrobot", {"start": "hanging", "mass1": 0.1 + 0.2},
         "planner run acrobot --start hanging --mass1 0.30000000000000004"),
        ("two-link", {"duration": 1.5}, "planner run two-link --duration 1.5"),
    ],
)  # fmt: skip
def test_the_command_names_what_differs_from_the_defaults(plan, case, parameters, line):
    assert command(of_case(plan, case, **parameters)) == line


def test_the_command_makes_the_same_problem_again(plan):
    from planner.cli.parser import parse

    made = of_case(plan, "acrobot", start="hanging", horizon=123, position_weight=1 / 3)
    arguments = parse(command(made).split()[1:])
    given = {name[5:]: value for name, value in vars(arguments).items() if name.startswith("case_")}
    assert cases.build(arguments.case, **given).parameters == made.parameters


def test_the_command_names_starts_and_the_options_that_were_given(plan):
    starts = tuple(Start(k, Status.CONVERGED, 5.0 - k, 10, 5.0 - k) for k in range(4))
    made = replace(of_case(plan, "acrobot"), starts=starts)
    assert command(made) == "planner run acrobot --starts 4"
    options = {"update": "open-loop", "seed": 3, "no_refine": True, "line_search": None}
    assert command(made, (), options) == "planner run acrobot --update open-loop --seed 3 --no-refine --starts 4"


def test_the_command_of_a_stored_plan_names_the_settings_that_made_it(plan):
    made = replace(of_case(plan, "acrobot"), options={"update": "open-loop", "hessian": "gauss-newton", "seed": 0})
    assert command(made) == "planner run acrobot --update open-loop"


def test_the_command_of_a_refined_plan_makes_the_plan_that_it_began_with(plan):
    refined = of_case(plan, "acrobot", horizon=300)
    first = of_case(plan, "acrobot", horizon=150, integrator="semi-implicit-euler")
    path = [
        Refinement("semi-implicit-euler", 0.02, 150, 9, 5.0, Status.CONVERGED, "FAIL", None, 6.2, math.nan),
        Refinement("rk4", 0.01, 300, 4, 5.0, Status.CONVERGED, "PASS", "feedback", 1e-3, 2.0),
    ]
    assert command(refined, path) == command(first)
    assert command(refined, path[1:]) == command(refined)


def test_the_path_of_a_refinement_is_shown(plan, tmp_path):
    path = [
        Refinement("euler", 0.02, 150, 9, 5.0, Status.CONVERGED, "FAIL", None, 6.2, math.nan),
        Refinement("rk4", 0.02, 150, 4, 4.0, Status.CONVERGED, "PASS", "feedback", 1e-3, 2.0),
    ]
    page = Page(write_report(plan, proof_of(), tmp_path, path=path).read_text(encoding="utf-8"))
    for line in (Refinement.header(), *map(str, path)):
        assert " ".join(line.split()) in page.text
    assert "Refinement" not in page_of(plan, proof_of(), tmp_path).text


MODEL = """<mujoco><worldbody><body><joint name="hinge 1" axis="0 1 0"/><geom size="0.1" pos="0 0 -1"/></body>
</worldbody><actuator><motor joint="hinge 1"/></actuator></mujoco>"""


def test_a_problem_file_is_shown_as_it_can_be_run_again(plan, tmp_path):
    (tmp_path / "model.xml").write_text(MODEL)
    written = """model = "model.xml"\nstart = [0.0]\ngoal = { "hinge 1" = 1.5 }\nduration = 2.0\nstarts = 3\n"""
    (tmp_path / "mine.toml").write_text(written + "[weights]\neffort = 0.25\n")
    problem = load(tmp_path / "mine.toml").problem
    made = replace(plan, recipe=problem.recipe)
    assert command(made) == "planner run problem.toml"
    (tmp_path / "problem.toml").write_text(problem_text(made))
    assert load(tmp_path / "problem.toml").problem.parameters == problem.parameters
    text = page_of(made, proof_of(), tmp_path).text
    assert "planner run problem.toml" in text
    assert 'goal = { "hinge 1" = 1.5 }' in text


def test_a_plan_of_a_program_says_so(plan, tmp_path):
    text = page_of(replace(plan, recipe=None), proof_of(), tmp_path).text
    assert "planner run" not in text
    assert "A program made the plan, not the command line." in text


def test_seeds_are_named(plan, tmp_path):
    text = page_of(plan, make_proof(plan), tmp_path).text
    assert "Rollouts 40 in each mode; varied: mass 5 %" in text
    assert "Seed of the rollouts 7" in text
