"""problem.toml: a mistake gets one sentence that names it."""

import pytest
from carts import CART, refuse, write

import planner
from planner import PlannerError
from planner.cases.problem_file import load
from planner.cli.flags import PROBLEM_FILE
from planner.cli.parser import parse
from planner.problem.goals import goals_of


@pytest.mark.parametrize(
    ("keys", "fragments"),
    [
        ({"gaol": "1"}, ("key 'gaol'", "Did you mean 'goal'", "duration")),
        ({"model": None}, ("no key 'model'",)),
        ({"goal": None}, ("no key 'goal'", "2 or 4 numbers")),
        ({"duration": None}, ("no key 'duration'", "seconds")),
        ({"model": '"no.xml"'}, ("no.xml",)),
        ({"model": "3"}, ("model is 3",)),
        ({"start": '"lift"'}, ("start is 'lift'", "left, right", "Did you mean 'left'")),
        ({"start": "[1.0]"}, ("start has 1 numbers", "2 or 4 numbers")),
        ({"start": "[nan, 0.0]"}, ("start[0] is nan", "finite")),
        ({"start": '["a", 0.0]'}, ("start is not an array of numbers",)),
        ({"start": "1.0"}, ("start is 1.0", "table of joints")),
        ({"goal": "{ elbow = 1.0 }"}, ("elbow", "slider, pole")),
        ({"goal": '{ pole = "up" }'}, ("goal of pole",)),
        ({"duration": "-1"}, ("duration is -1",)),
        ({"duration": "1.02"}, ("duration is 1.02", "0.05", "e.g. 1")),
        ({"duration": "1e9"}, ("duration is 1e+09 s and dt", "100000; both are in s")),
        ({"dt": "0.0"}, ("dt is 0.0", "greater than 0")),
        ({"dt": '"fast"'}, ("dt is 'fast'",)),
        ({"integrator": '"rk5"'}, ("rk5", "rk4")),
        ({"guess": '"good"'}, ("guess", "hold, zero")),
        ({"contacts": "false"}, ("contacts is False", "auto, avoid, file, ground")),
        ({"ignore": '"friction"'}, ("ignore is 'friction'", "list")),
        ({"ignore": '["friction"]'}, ("friction", "frictionloss")),
        ({"starts": "0"}, ("starts is 0",)),
        ({"seed": "-1"}, ("seed is -1",)),
        ({"tolerance": "0"}, ("tolerance is 0",)),
        ({"title": "3"}, ("title is 3",)),
        ({"start": "true"}, ("start is True", "2 or 4 numbers")),
        ({"goal": "true"}, ("goal is True", "2 or 4 numbers")),
        ({"goal": "[true, 0.0]"}, ("goal is not an array of numbers",)),
        ({"goal": "{ pole = true }"}, ("goal of pole is True", "a finite number")),
        ({"goal": '["1", "2"]'}, ("goal is not an array of numbers",)),
        ({"goal": "[[1, 2]]"}, ("goal is [[1, 2]]", "2 or 4 numbers", "slider, pole")),
        ({"goal": "[{ pole = 1 }]"}, ("[[goal]] number 1 of", "the key 'pole'", "frame", "joints")),
        ({"goal": "[[1.0, 2.0]]"}, ("goal is [[1.0, 2.0]]", "2 or 4 numbers")),
        ({"duration": "true"}, ("duration is True",)),
        ({"ignore": '"foo"'}, ("ignore is 'foo'", "frictionloss", "equality")),
        ({"ignore": "[1]"}, ("ignore is [1]", "frictionloss")),
        ({"starts": "true"}, ("starts is True",)),
        ({"starts": "10001"}, ("starts is 10001", "at most 10000")),
        ({"seed": "9" * 400}, ("seed is 999", "...")),
        ({"dt": "9" * 5000}, ("thousands of digits",)),
    ],
    ids=lambda given: str(given)[:60],
)
def test_wrong_keys_are_named(tmp_path, keys, fragments):
    refuse(write(tmp_path, **keys), *fragments)


@pytest.mark.parametrize(
    ("weights", "fragments"),
    [
        ("efort = 1.0", ("'efort'", "Did you mean 'effort'")),
        ("effort = 0.0", ("effort", "above 0")),
        ("effort = { pull = 1.0 }", ("pull", "push")),
        ("final_position = { pol = 1.0 }", ("pol", "Did you mean 'pole'")),
        ("final_position = -1.0", ("final_position", "at least 0")),
        ("final_velocity = nan", ("final_velocity", "nan")),
        ('velocity = "some"', ("velocity is 'some'",)),
        ("position = [1.0]", ("position has shape (1,)", "(2,)")),
        ("effort = true", ("effort is True", "expected numbers")),
        ('effort = "1"', ("effort is '1'", "expected numbers")),
        ("final_position = { pole = true }", ("final_position['pole'] is True",)),
        ("final_velocity = [true, 1.0]", ("final_velocity is [True, 1.0]",)),
        ('position = ["1", "2"]', ("position is ['1', '2']",)),
    ],
)
def test_wrong_weights_are_named(tmp_path, weights, fragments):
    refuse(write(tmp_path, f"[weights]\n{weights}\n"), *fragments)


@pytest.mark.parametrize(
    ("below", "fragments"),
    [
        ("[weights]\neffort = 1.0\nduration = 1.0\n", ("duration stands in [weights]", "above the first heading")),
        ("[goal]\npole = 1.0\nduration = 1.0\n", ("duration stands in [goal]",)),
        ('[[goal]]\nframe = "cart"\nduration = 1.0\n', ("duration stands in [[goal]] number 1",)),
        ('[[obstacle]]\nshape = "box"\ncontacts = "off"\n', ("contacts stands in [[obstacle]] number 1",)),
    ],
)
def test_a_key_below_a_heading_belongs_to_its_table(tmp_path, below, fragments):
    gone = {"duration": None} if "duration" in below else {}
    gone |= {"goal": None} if "goal" in below else {}
    refuse(write(tmp_path, below, **gone), *fragments)


def test_what_is_refused_tells_of_ranges_that_may_be_in_radians(tmp_path):
    file = write(tmp_path, goal="{ pole = 0.5 }")
    model = next(tmp_path.glob("*.xml"))
    model.write_text(model.read_text().replace('name="pole"', 'name="pole" range="-1.5 1.5"'))
    refuse(file, "expected -0.0261799 ... 0.0261799 rad", "as if its range in radians", '<compiler angle="radian"/>')


def test_a_speed_limit_that_no_motion_keeps_is_refused_with_a_duration(tmp_path):
    """The slider goes 2 m in 1 s; 0.04 m pass."""
    slow = "[limits]\nvelocity = {{ slider = {} }}\n"
    refuse(write(tmp_path, slow.format(1.9)), "slider 2 m from the start", "1.9 m in 1 s", "duration = 2.1")
    assert load(write(tmp_path, slow.format(1.9), duration="2.1")).problem.N == 42
    assert load(write(tmp_path, slow.format(1.97))).problem.N == 20
    least = load(write(tmp_path, slow.format(1.9), objective='"time"')).problem  # between 0.2 and 2 s
    assert least.recipe is not None
    assert least.recipe.rebuilt(duration=0.5).duration == 0.5  # a search may ask for too little
    aside = slow.format(1.9) + "[weights]\nfinal_position = { pole = 1.0 }\n"
    assert load(write(tmp_path, aside)).problem.N == 20  # nobody asks where the slider ends


def test_least_time_begins_at_the_longest_duration_where_none_is_given(tmp_path):
    path = write(tmp_path, duration=None, objective='"time"', durations="[0.5, 3.0]")
    assert load(path).problem.duration == pytest.approx(3.0)
    refuse(write(tmp_path, duration=None, objective='"time"'), "no key 'duration'")


def test_weights_are_a_table(tmp_path):
    refuse(write(tmp_path, "weights = 3\n"), "weights is 3", "final_position")


@pytest.mark.parametrize(
    ("content", "fragments"),
    [
        (
            CART.replace("<motor", "<!-- <motor").replace('"slider"/></act', '"slider"/> --></act'),
            ("no actuators", 'prescribed = ["slider", "pole"]'),
        ),
        (CART.replace('mass="0.2"', 'mass="0"').replace('diaginertia="0.01 0.01 0.01"', ""), ("mass",)),
        ('<!DOCTYPE m [<!ENTITY a "aaaa">]>' + CART, ("entities",)),
        (CART.replace("<worldbody>", '<include file="gone.xml"/><worldbody>'), ("gone.xml",)),
        (CART.replace("<worldbody>", '<include file="cart.xml"/><worldbody>'), ("includes itself",)),
        (CART.replace("<worldbody>", '<option density="1.2" wind="1 0 0"/><worldbody>'), ("fluid wind",)),
        (CART[:200], ("not well-formed",)),
        ("", ("cart.xml",)),
    ],
    ids=["no actuators", "zero mass", "entities", "missing include", "circle", "fluid", "cut", "empty"],
)
def test_models_that_cannot_be_used_are_named(tmp_path, content, fragments):
    path = write(tmp_path)
    (tmp_path / "cart.xml").write_text(content, encoding="utf-8")
    refuse(path, *fragments)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("goal = .1", "expected a number such as 0.5"),
        ("goal = 1.0\ngoal = 2.0", "the key stands twice: leave one out"),
        ("[weights]\n[weights]", "the table stands twice"),
        ("goal 1.0", "expected KEY = VALUE in a line"),
        ("goal = [1.0", "] after the last"),
        ("goal = { a = 1.0, a = 2.0 }", "the key stands twice between { and }"),
        ("goal = 1.0 start = 2.0", "one KEY = VALUE a line"),
        ('title = "a', "quote that ends the text"),
        ("[weights", "] after the name of a table"),
    ],
)
def test_what_is_not_toml_is_refused_with_what_to_write(tmp_path, text, expected):
    (tmp_path / "a.toml").write_text(text, encoding="utf-8")
    refuse(tmp_path / "a.toml", "a.toml is not TOML", expected)


def test_files_that_are_no_problem(tmp_path):
    refuse(tmp_path / "nowhere.toml", "nowhere.toml", "No such file")
    (tmp_path / "a.toml").write_text("model = ", encoding="utf-8")
    refuse(tmp_path / "a.toml", "a.toml is not TOML")
    (tmp_path / "b.toml").write_bytes(b"\xff\xfe\x00")
    refuse(tmp_path / "b.toml", "b.toml", "not text")
    refuse(tmp_path, "directory")


# To do nothing is no way to reach a goal

STAYING = {"start": "[0.5, 0.2]", "goal": "[0.55, 0.2]"}


def test_a_start_within_tolerance_of_the_goal_is_refused(tmp_path):
    """The message says how near they are, and a tolerance with which the file is a problem."""
    near = {**STAYING, "goal": "[0.504, 0.2]"}  # 4 mm, where 5 mm is the least tolerance of longer ways
    assert goals_of(load(write(tmp_path, **near)).problem)[0].tolerance == pytest.approx(0.0004)
    near["tolerance"] = "0.005"
    refuse(write(tmp_path, **near), "within the tolerance 0.005 m", "largest difference 0.004", "tolerance = 0.0004")
    refuse(write(tmp_path, **STAYING, tolerance="0.051"), "within the tolerance 0.051 m", "at slider")
    assert load(write(tmp_path, **STAYING, tolerance="0.049")).problem.N == 20


def test_only_what_final_weights_act_on_must_be_away_from_the_goal(tmp_path):
    keys = {"start": "[0.0, 0.0]", "goal": "[0.05, 2.0]"}
    assert load(write(tmp_path, **keys)).problem.N == 20
    slider = "[weights]\nfinal_position = { slider = 1e4 }\n"
    refuse(write(tmp_path, slider, **keys, tolerance="0.1"), "within the tolerance 0.1 m", "largest difference 0.05")
    moving = {"start": "[0.0, 0.0, 0.0, 0.0]", "goal": "[0.05, 0.0, 0.0, 0.5]"}
    assert load(write(tmp_path, **moving)).problem.N == 20


def test_to_stay_at_the_goal_is_a_task(tmp_path):
    for goal in ("[0.5, 0.2]", "{ slider = 0.5 }"):
        assert load(write(tmp_path, start="[0.5, 0.2]", goal=goal)).problem.N == 20
    rounded = load(write(tmp_path, start=f"[{0.1 + 0.2!r}, 0.2]", goal="[0.3, 0.2]")).problem  # 6e-17 m away
    assert goals_of(rounded)[0].tolerance == 0.005


def test_a_goal_that_no_weight_asks_for_is_refused(tmp_path):
    """Final weights only where start and goal are the same: nothing would move without weights on the way."""
    keys = {"start": "[0.0, 0.0]", "goal": "[1.0, 0.0]"}
    pole = "[weights]\nfinal_position = { pole = 1e4 }\n"
    refuse(write(tmp_path, pole, **keys), "no weight is above 0 where start and goal differ")
    assert load(write(tmp_path, pole + "position = { slider = 1.0 }\n", **keys)).problem.N == 20
    none = "[weights]\nfinal_position = 0.0\nfinal_velocity = 0.0\n"
    assert load(write(tmp_path, none, **keys)).problem.N == 20  # the proof says that nothing is asked of the goal


# How files are named to the command line


@pytest.mark.parametrize("command", ["run", "solve"])
@pytest.mark.parametrize("name", ["lift.toml", "LIFT.TOML", "a/Lift.Toml"])
def test_problem_files_are_known_by_their_ending(command, name):
    arguments = parse([command, name])
    assert (arguments.case, arguments.problem) == (PROBLEM_FILE, name)


@pytest.mark.parametrize("name", ["model.xml", "Model.XML", "scene.mjcf"])
def test_a_model_is_no_case(name):
    with pytest.raises(PlannerError) as caught:
        parse(["run", name])
    written = f"{name.partition('.')[0]}.toml"
    assert f"{name} is a model" in str(caught.value)
    assert f"`planner model {name} --write {written}` writes one, then `planner run {written}`" in str(caught.value)


CUBE = (
    '<mujoco><worldbody><body><joint name="arm" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 .5 0 0" size=".02"/>'
    '</body><body pos="1 0 .1"><freejoint name="cube"/><geom type="box" size=".02 .02 .02"/></body>{}</worldbody>'
    '<actuator><motor joint="arm" ctrlrange="-9 9"/></actuator></mujoco>'
)


def test_what_falls_whatever_the_arm_does_is_asked_nothing(tmp_path):
    """A cube beside an arm: it falls freely, and no goal of the plan is where it ends, or that it stops."""
    (tmp_path / "cube.xml").write_text(CUBE.format(""))
    text = 'model = "cube.xml"\nstart = { arm = 0 }\ngoal = { arm = 0.5 }\nduration = 0.5\n'
    (tmp_path / "reach.toml").write_text(text)
    problem = load(tmp_path / "reach.toml").problem
    names = {goal.name for goal in goals_of(problem)}
    assert {"arm", "velocity of arm", "cube rotation about x"} <= names
    assert not {name for name in names if name.endswith(("cube x", "cube y", "cube z"))}
    floor = '<geom type="plane" size="1 1 1"/>'
    (tmp_path / "cube.xml").write_text(CUBE.format(floor).replace('"0 0 0 .5 0 0"', '"0 0 1 .5 0 1"'))
    assert load(tmp_path / "reach.toml").problem.N > 0  # it comes to rest on the floor
    (tmp_path / "cube.xml").write_text(CUBE.format("").replace("<worldbody>", '<option gravity="0 0 0"/><worldbody>'))
    assert load(tmp_path / "reach.toml").problem.N > 0  # it stays where it is


ARM = """<mujoco><worldbody><body><joint name="shoulder" axis="0 1 0" range="-180 180"/>
  <geom type="capsule" fromto="0 0 0 0 0 -.4" size=".03"/></body></worldbody>
  <actuator><motor joint="shoulder" ctrlrange="-40 40"/></actuator></mujoco>"""


def of_arm(folder, start, goal, more=""):
    (folder / "arm.xml").write_text(ARM, encoding="utf-8")
    path = folder / "arm.toml"
    path.write_text(f'model = "arm.xml"\nstart = {start}\ngoal = {goal}\nduration = 1.0\n{more}', encoding="utf-8")
    return path


def test_home_is_the_pose_of_a_file_without_keyframes_and_no_other_name_is(tmp_path):
    refuse(of_arm(tmp_path, '"rest"', "{ shoulder = 1.0 }"), "start is 'rest', expected 'home' (as the file")
    assert load(of_arm(tmp_path, '"home"', "{ shoulder = 1.0 }")).problem.x0.tolist() == [0.0, 0.0]


def test_a_start_that_is_missing_is_not_offered_the_pose_that_it_cannot_be(tmp_path):
    path = of_arm(tmp_path, "{}", "{ shoulder = 1.0 }")
    path.write_text(path.read_text().replace("start = {}\n", ""))
    model = tmp_path / "arm.xml"
    outside = ARM.replace('range="-180 180"', 'range="20 180"')
    model.write_text(outside)
    refuse(path, "no key 'start', expected 1 or 2 numbers", "outside of its range")
    model.write_text(outside.replace("</mujoco>", '<keyframe><key name="low" qpos="0.1"/></keyframe></mujoco>'))
    refuse(path, "no key 'start', expected a keyframe (low), 1 or 2 numbers")


def test_degrees_in_place_of_radians_get_the_radians(tmp_path):
    refuse(of_arm(tmp_path, "{}", "{ shoulder = 60.0 }"), "3.14159 rad", "60 deg are 1.0472.")


def test_a_motion_of_least_jerk_meets_its_goal(tmp_path):
    """360 way^2 / T^5 of a radian in half a second are 11,520: by far more than ends weigh beside least effort."""
    path = of_arm(tmp_path, "{}", "{ shoulder = 1.0 }", 'objective = "jerk"\n')
    problem = load(path.rename(tmp_path / "gentle.toml")).problem
    plan = planner.solve(problem)
    assert plan.success
    assert abs(plan.xs[-1, 0] - 1.0) < 0.002
    assert abs(plan.xs[-1, 1]) < 0.02


@pytest.mark.parametrize(
    ("x", "gravity", "told"),
    [(0.0, 9.81, False), (0.05, 9.81, True), (0.05, 0.0, False)],
    ids=["apart", "deep in the ball", "nothing has weight"],
)
def test_a_start_deep_in_another_body_is_told(tmp_path, x, gravity, told):
    """The hand of 3 cm ends at x + 0.03 m, and the ball begins at 0.05 m: 3 cm deep, where 2 mm carry the weight."""
    (tmp_path / "push.xml").write_text(
        f"""<mujoco><option gravity="0 0 {-gravity}"/><worldbody>
        <body name="hand"><joint name="hand" type="slide" axis="1 0 0"/><geom name="hand" size=".03" mass="1"/></body>
        <body name="ball" pos=".1 0 0"><joint name="ball" type="slide" axis="1 0 0"/>
        <geom name="ball" size=".05" mass="1"/></body></worldbody>
        <actuator><motor joint="hand" ctrlrange="-9 9"/></actuator></mujoco>"""
    )
    (tmp_path / "push.toml").write_text(
        f'model = "push.xml"\nstart = {{ hand = {x} }}\ngoal = {{ ball = 0.2 }}\nduration = 1.0\n'
        "contacts = { stiffness = 1e4, damping = 100, ramp = 1e-3, slip_damping = 100, friction = 0.5 }\n"
    )
    notes = load(tmp_path / "push.toml").notes
    assert any("0.03 m deep in each other" in note for note in notes) == told


@pytest.mark.parametrize(
    ("goal", "avoid", "told"),
    [(0.1, "", False), (0.2, "", True), (0.2, "avoid = {}\n", None)],
    ids=["before the post", "in the post", "refused where shapes are kept apart"],
)
def test_a_goal_in_an_obstacle_is_told(tmp_path, goal, avoid, told):
    """The hand of 3 cm ends at its goal + 0.03 m, and the post begins at 0.2 m: 3 cm deep, or 7 cm before it."""
    (tmp_path / "hand.xml").write_text(
        """<mujoco><option gravity="0 0 0"/><worldbody>
        <body name="hand"><joint name="hand" type="slide" axis="1 0 0"/><geom name="hand" size=".03" mass="1"/></body>
        </worldbody><actuator><motor joint="hand" ctrlrange="-9 9"/></actuator></mujoco>"""
    )
    (tmp_path / "hand.toml").write_text(
        f'model = "hand.xml"\ngoal = {{ hand = {goal} }}\nduration = 1.0\n{avoid}'
        '[[obstacle]]\nshape = "box"\nsize = [0.2, 0.2, 0.2]\nposition = [0.3, 0, 0]\nname = "post"\n'
    )
    if told is None:
        with pytest.raises(PlannerError, match="the goal is in collision"):
            load(tmp_path / "hand.toml")
        return
    notes = load(tmp_path / "hand.toml").notes
    assert any(note.startswith("the goal has") and "0.03 m in each other" in note for note in notes) == told
