"""Figures look alike: colours of their own, names and units on the axes, never Matplotlib's defaults."""

import json
import re
from contextlib import nullcontext

import pytest
from matplotlib import colors
from places import ROOT

from planner.cli.paper import STUDIES
from planner.view.plots import style
from planner.view.plots.style import HUES, dress, panels_of

DEFAULTS = {colors.to_hex(f"C{i}") for i in range(10)}
PRINT = "matplotlib.backends.backend_agg.FigureCanvasAgg.print_png"
PICTURES = [(study, name) for study in STUDIES for name in study.pictures]


def drawn(study, name, monkeypatch, tmp_path):
    """The figure of a study's stored results."""
    figures = []
    monkeypatch.setattr(PRINT, lambda canvas, *_: figures.append(canvas.figure))
    monkeypatch.setattr(style, "write_atomically", lambda path: nullcontext(path))
    results = json.loads((ROOT / "renders" / "gallery" / "paper" / f"{study.name}.json").read_text(encoding="utf-8"))
    study.pictures[name](results, tmp_path / name)
    return figures[0]


@pytest.mark.parametrize(("study", "name"), PICTURES, ids=lambda one: one if isinstance(one, str) else one.name)
def test_a_figure_of_the_paper_is_in_the_style_of_all(study, name, monkeypatch, tmp_path):
    for axes in drawn(study, name, monkeypatch, tmp_path).axes:
        assert DEFAULTS.isdisjoint(colors.to_hex(line.get_color()) for line in axes.get_lines())
        for label in (axes.get_xlabel(), axes.get_ylabel()):
            assert not re.search(r"\((s|rad|deg|m|mm|N|%)\)", label), label  # as everywhere: "time, s"
            assert label not in {"s", "m", "mm", "N", "N m", "rad", "deg", "J", "t, s"}, label  # a name before the unit


def test_curves_without_a_colour_take_the_hues():
    _, (axes, _) = panels_of(2)
    dress(axes, "", "height, m", "time, s")
    assert [axes.plot([0, 1])[0].get_color() for _ in range(2)] == [HUES[0][1], HUES[1][1]]


def test_a_picture_is_drawn_once_and_long_log_axes_have_their_powers_of_ten(monkeypatch, tmp_path):
    """Matplotlib's savefig() draws twice, and minor ticks take half of a figure's time: seconds of every run."""
    figure, (long, short) = panels_of(2)
    long.semilogy([1e-6, 1.0])
    short.semilogy([2.0, 5.0])
    draws = []
    monkeypatch.setattr(type(long), "draw", lambda axes, renderer: draws.append(axes))
    style.save(figure, tmp_path / "picture.png")
    assert draws == [long, short]
    assert len(long.yaxis.get_minorticklocs()) == 0
    assert len(short.yaxis.get_minorticklocs()) > 0
