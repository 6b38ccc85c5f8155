"""A default camera turns where something at rest stands between it and the motion, and only there."""

from dataclasses import replace

import numpy as np
import pytest

from planner.model.mechanism import Mechanism
from planner.model.mjcf.model_index import compile_model
from planner.problem.appearance import Appearance
from planner.view.render.camera import directions
from planner.view.render.environment import unobstructed
from planner.view.render.film import Film


def _film_beside_a_wall(y, height=2.0):
    """A film of a swinging rod, seen along +y (azimuth 90), and its model; a wall is at a place y, m."""
    mechanism = Mechanism.from_mjcf(f"""<mujoco><worldbody>
    <geom type="box" size="2 0.02 {height}" pos="0 {y} 0"/>
    <body pos="0 0 1"><joint axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0.6 0 0" size="0.03"/></body>
    </worldbody></mujoco>""")
    film = Film.of_poses(mechanism, {"a": np.zeros(1), "b": np.array([1.0])})
    look = Appearance(title="", azimuth=90.0, elevation=-5.0, may_turn=True)
    return replace(film, appearance=look), compile_model(film.mjcf)


def test_a_camera_behind_a_wall_turns_to_the_free_side():
    film, model = _film_beside_a_wall(-0.5)
    seen = unobstructed(film, model)
    assert -directions(seen.azimuth, seen.elevation)[0][1] > 0.0  # its eye is where y is positive
    assert np.all(model.geom_group == 0)  # as before


def test_a_low_wall_does_not_turn_it():
    film, model = _film_beside_a_wall(-0.5, height=0.2)
    assert unobstructed(film, model) is film.appearance


@pytest.mark.parametrize(("y", "may_turn"), [(0.5, True), (-0.5, False)])
def test_a_wall_behind_the_motion_or_a_chosen_direction_leaves_the_camera(y, may_turn):
    film, model = _film_beside_a_wall(y)
    film = replace(film, appearance=replace(film.appearance, may_turn=may_turn))
    assert unobstructed(film, model) is film.appearance
