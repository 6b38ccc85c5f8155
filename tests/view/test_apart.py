"""A ghost that coincides with its machine does not flicker, and what two films share is drawn once."""

from dataclasses import replace

import numpy as np
import pytest
from films import APPEARANCE, changed, make_replay

from planner.base.errors import RenderingUnavailable
from planner.view.render import drawing
from planner.view.render.drawing import Job, carry_out, draw_frames, drawn_by_children
from planner.view.render.film import Film
from planner.view.render.marks import SAME_PICTURE_PIXELS, depth_offset, screen_difference, visibility
from planner.view.render.overlay import distance_words
from planner.view.render.scene import Scene

IN_PLACE = replace(APPEARANCE, ghost_offset=(0.0, 0.0, 0.0))


def film_of(offset=0.0, appearance=IN_PLACE, times=(0.1,)):
    return Film.of(make_replay(appearance, plan_offset=offset), np.array(times))


def test_distances_are_those_of_the_farthest_point():
    one = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    assert screen_difference(one, one + np.array([0.0, 0.3, 0.4])) == pytest.approx(0.5)
    assert screen_difference(one, one * [3.0, 1.0, 1.0]) == pytest.approx(2.0)
    assert screen_difference(np.empty((0, 3)), np.empty((0, 3))) == 0.0


def test_a_ghost_shows_the_more_the_farther_it_is():
    seen = [visibility(pixels) for pixels in np.linspace(0.0, 6.0, 61)]
    assert seen[:11] == [0.0] * 11
    assert seen[40:] == [1.0] * 21
    assert np.all(np.diff(seen) >= 0.0)
    assert np.max(np.diff(seen)) < 0.06  # it does not appear at once


def test_a_ghost_is_farther_behind_than_it_differs_while_the_two_overlap():
    for part in np.geomspace(1e-5, 1e-2, 10):
        assert depth_offset(part, 1.0) > part
    assert depth_offset(0.0, 1.0) == depth_offset(0.5, 1.0) < 0.003  # where they are wide apart its size is its own


def test_distances_are_written_short():
    words = [distance_words(value, "m") for value in (0.0, 1.5e-4, 0.0234, 0.5, 12.3)]
    assert words == ["0.00 mm", "0.15 mm", "23.4 mm", "50.0 cm", "12.30 m"]
    assert distance_words(0.05, "in") == "0.050 in"


@pytest.mark.render
def test_a_ghost_in_the_same_place_changes_no_pixel():
    """Before, its surfaces and the machine's came forward in turn."""
    for offset in (0.0, 6.0):
        film = film_of(offset)
        with Scene(film, 160, 90) as both, Scene(film, 160, 90, ghost=False) as alone:
            differs = changed(both.draw(0), alone.draw(0))
            assert differs == 0 if offset == 0.0 else differs > 12
            assert both.difference == pytest.approx(offset)


@pytest.mark.render
def test_a_scene_takes_the_picture_of_another_only_where_it_would_be_its_own():
    """The picture that was taken is the one that would have been drawn, but for less than half a pixel."""
    with Scene(film_of(), 160, 90) as one:
        first = one.draw(0)
        for pixels, taken in ((0.8 * SAME_PICTURE_PIXELS, True), (1.2 * SAME_PICTURE_PIXELS, False)):
            replay = make_replay(IN_PLACE)
            replay.qpos[:, 0] += pixels * one._pixel
            with Scene(Film.of(replay, np.array([0.1])), 160, 90) as other:
                own = other.draw(0)
                assert (other.draw(0, one) is first) == taken
                if taken:
                    assert changed(first, own) < 300
                assert other.project(np.zeros(3)) == pytest.approx(one.project(np.zeros(3)))


@pytest.mark.render
@pytest.mark.parametrize("what", ["forces", "size"])
def test_other_forces_and_other_sizes_are_drawn_anew(what):
    film = film_of(times=(0.0,))
    other = replace(film, forces=0.5 * film.forces) if what == "forces" else film
    with Scene(film, 160, 90) as one, Scene(other, 160, 90 + 2 * (what == "size")) as two:
        first = one.draw(0)
        assert two.draw(0, one) is not first


@pytest.mark.render
def test_several_processes_draw_the_frames_in_their_order():
    """The slow twin: all in this process."""
    films = [film_of(3.0, times=np.linspace(0.0, 0.2, 3))]
    job = Job("video", 160, 90, 30.0, 1.0)
    here = list(draw_frames(films, job))
    there = list(drawn_by_children(films, job, 2))
    assert len(here) == len(there) == 3
    for one, other in zip(here, there, strict=True):
        np.testing.assert_allclose(one, other, rtol=0.0, atol=2)  # Mesa rounds by how many threads it has


@pytest.mark.render
def test_a_child_that_dies_is_one_sentence(monkeypatch):
    monkeypatch.setattr(drawing, "_DRAWING", "planner.view.render.nothing")
    with pytest.raises(RenderingUnavailable, match=r"^The process that draws failed: .*nothing"):
        next(drawn_by_children([film_of()], Job("frame", 64, 36), 1))


@pytest.mark.render
def test_one_film_of_several_cameras_is_drawn_from_each():
    """No picture of one camera stands for another's."""
    from planner.problem.appearance import View

    seen = replace(IN_PLACE, views=(View(90.0), View(10.0)))
    picture = carry_out([film_of(appearance=seen)], Job("frame", 320, 120))
    assert changed(picture[30:100, :150], picture[30:100, 170:]) > 100
