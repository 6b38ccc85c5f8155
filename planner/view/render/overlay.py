"""The words on a picture: title, readouts, legend, speed, and labels at points of the scene."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from planner.problem.appearance import Appearance
from planner.view.render.film import Caption
from planner.view.render.marks import GOAL, PATH, ghost_paint
from planner.view.render.scene import FORCE, Label

_Part = tuple[str, ImageFont.FreeTypeFont, tuple[int, ...]]
_Placed = tuple[Image.Image, tuple[int, int]]  # a panel, and its upper left corner

_INK = (28, 32, 40)
_QUIET = (92, 99, 112)
_PAPER = (255, 255, 255)
_PAPER_ALPHA = 205
_SOLID = (24, 84, 176)
_GOOD, _BAD = (20, 113, 58), (179, 38, 30)
_MINUS = "\N{MINUS SIGN}"
_LONG = 1e7
_BAND = 40.0  # height of a caption, in units
_WIDEST = "  000.0 mm"


class Mark(NamedTuple):
    """Words beside a point."""

    at: tuple[float, float]  # column and row
    words: str
    anchor: str = "lm"  # Pillow's
    ink: tuple[int, int, int] = _INK
    large: bool = False


def beside(label: Label) -> Mark:
    """The number of a goal, to the right of it and above."""
    return Mark(label.at, f" {label.words}", "ls", _mixed(_INK, 0.4) if label.faint else _INK, large=True)


@dataclass(frozen=True)
class Words:
    """Everything written on a film."""

    largest: np.ndarray  # (R,) largest magnitude of each readout: it decides the decimals
    numbers: bool = True  # title, time and readouts
    legend: bool = True  # which machine is solid and which is a ghost
    speed: float | None = None  # playback speed; None writes none
    caption: Caption | None = None  # at the bottom
    difference: bool = False  # the distance of the machine from its ghost, at the bottom
    unstable: float = math.inf  # s, when the simulation ran away: a warning from then on
    label: str = ""  # the camera's name, in the upper right corner


class Overlay:
    """Writes on the frames of one film. Sizes follow the picture's height: 320x180 looks like 1920x1080."""

    def __init__(self, appearance: Appearance, width: int, height: int, words: Words) -> None:
        """Lay out the panels, once for all frames of width x height pixels."""
        self._appearance, self._numbers, largest = appearance, words.numbers, words.largest
        self._width, self._height = width, height
        self._unit = unit = min(height / 720, width / 900)
        self._text = _font("DejaVuSans.ttf", 18 * unit)
        self._title = _font("DejaVuSans-Bold.ttf", 21 * unit)
        self._small = _font("DejaVuSans.ttf", 15 * unit)
        # Numbers with the same unit are compared by eye: they get the same decimals.
        scales: dict[str, float] = {}
        for readout, value in zip(appearance.readouts, largest, strict=True):
            scales[readout.unit] = max(scales.get(readout.unit, 0.0), value)
        self._decimals = [decimals(scales[readout.unit]) for readout in appearance.readouts]
        self._margin, self._padding, self._line = 22 * unit, 13 * unit, 27 * unit
        self._columns = self._lay_out_columns(largest)
        self._panels = [*([self._readout_panel()] if words.numbers else []), *self._legend_panels(words)]
        if words.label:
            self._panels.append(self._right_panel(words.label, round(self._margin)))
        self._unstable, self._captioned = words.unstable, words.caption is not None or words.difference
        warning = [(f"unstable at t = {words.unstable:.2f} s", self._title, _BAD)]
        self._warning = self._bottom_panel(warning, 2.3 if self._captioned else 1.0)
        self._difference_at: tuple[float, float] | None = None  # right end and line of the distance to the ghost
        if self._captioned:
            self._panels.append(self._caption_panel(words))

    def write(
        self, picture: np.ndarray, t: float, readings: np.ndarray, marks: Sequence[Mark], difference: float = 0.0
    ) -> np.ndarray:
        """A copy of the picture (height, width, 3), uint8, at time t, s, with everything written on it.

        `readings` (R, 2) are the readouts in the simulation and in the plan, `difference` the distance between the two
        machines, in the model's unit of length.
        """
        image = Image.fromarray(picture)
        draw = ImageDraw.Draw(image)
        for mark in marks:
            (x, y), font = mark.at, self._text if mark.large else self._small
            inmost = self._width - self._margin - font.getlength(mark.words)
            if mark.anchor[0] == "l" and x > inmost:  # a label at the edge moves in, above what it names
                x, y = inmost, y - 0.6 * self._line
            _write_mark(draw, mark._replace(at=(x, y)), font, self._unit)
        for panel, corner in [*self._panels, *([self._warning] if t >= self._unstable else [])]:
            image.paste(panel, corner, panel)
        if self._difference_at is not None:
            away = "ran away" if t >= self._unstable else distance_words(difference, self._appearance.length_unit)
            draw.text(self._difference_at, away, _INK, self._text, anchor="rs")
        if not self._numbers:
            return np.asarray(image)
        x, y = self._margin + self._padding, self._margin + self._padding
        if self._appearance.title:
            y += self._line * 1.15
        sim, plan, _ = self._columns
        y += self._line * 0.8
        draw.text((x, y), f"time {t:.2f} s", _INK, self._text, anchor="ls")
        for (value, planned), places in zip(readings, self._decimals, strict=True):
            y += self._line
            draw.text((sim, y), number(value, places), _INK, self._text, anchor="rs")
            draw.text((plan, y), number(planned, places), _QUIET, self._text, anchor="rs")
        return np.asarray(image)

    def _lay_out_columns(self, largest: np.ndarray) -> tuple[float, float, float]:
        """Right ends of the two columns of numbers, and the left end of the units."""
        labels = [readout.label for readout in self._appearance.readouts]
        left = max([self._text.getlength(words) for words in [*labels, "time 00.00 s"]])
        numbers = [number(-value, places) for value, places in zip(largest, self._decimals, strict=True)]
        wide = max([self._text.getlength(words) for words in [*numbers, "MuJoCo"]]) + 16 * self._unit
        sim = self._margin + self._padding + left + wide
        return sim, sim + wide, sim + wide + 8 * self._unit

    def _readout_panel(self) -> _Placed:
        """Title, column heads, labels and units, which stay the same from frame to frame."""
        appearance, m, p = self._appearance, self._margin, self._padding
        sim, plan, units = self._columns
        unit_width = max([self._text.getlength(readout.unit) for readout in appearance.readouts], default=0.0)
        right = units + unit_width if appearance.readouts else m + p + self._text.getlength("time 00.00 s")
        right = max(right, m + p + self._title.getlength(appearance.title))
        lines = (1.15 if appearance.title else 0.0) + 1.0 + len(appearance.readouts)
        panel, draw = _panel(right + p - m, 2 * p + lines * self._line, 8 * self._unit)
        y = p
        if appearance.title:
            draw.text((p, y + 0.8 * self._line), appearance.title, _INK, self._title, anchor="ls")
            y += self._line * 1.15
        y += self._line * 0.8
        if appearance.readouts:
            draw.text((sim - m, y), "MuJoCo", _INK, self._small, anchor="rs")
            draw.text((plan - m, y), "plan", _QUIET, self._small, anchor="rs")
        for readout in appearance.readouts:
            y += self._line
            draw.text((p, y), readout.label, _INK, self._text, anchor="ls")
            draw.text((units - m, y), readout.unit, _QUIET, self._text, anchor="ls")
        return panel, (round(m), round(m))

    def _caption_panel(self, words: Words) -> _Placed:
        """Mode and verdict, and room for the distance to the ghost, which differs from frame to frame."""
        parts: list[_Part] = []
        if words.caption is not None:
            parts.append((f"{words.caption.mode}  ", self._title, _INK))
            if words.caption.verdict:
                ink = _GOOD if words.caption.verdict == "PASS" else _BAD
                parts.append((f"{words.caption.verdict}  ", self._title, ink))
            if words.caption.why:
                parts.append((f"({words.caption.why})  ", self._text, _INK))
        if words.difference:
            parts.append((f"from the {self._ghost_name()}", self._text, _QUIET))
        panel, (left, top) = self._bottom_panel(parts, 1.0, self._text.getlength(_WIDEST) if words.difference else 0.0)
        if words.difference:
            self._difference_at = (left + panel.width - self._padding, top + 0.67 * _BAND * self._unit)
        return panel, (left, top)

    def _ghost_name(self) -> str:
        return "plan" if self._appearance.ghost is None else self._appearance.ghost.label

    def _bottom_panel(self, parts: Sequence[_Part], above: float, free: float = 0.0) -> _Placed:
        """Words in a row in the middle, so many lines above the legend, with so many pixels free behind them."""
        p, height = self._padding, _BAND * self._unit
        panel, draw = _panel(
            2 * p + sum(font.getlength(words) for words, font, _ in parts) + free, height, 8 * self._unit
        )
        x = p
        for words, font, ink in parts:
            draw.text((x, 0.67 * height), words, ink, font, anchor="ls")
            x += font.getlength(words)
        y = self._height - self._margin - 34 * self._unit - above * (height + 8 * self._unit)
        return panel, (round((self._width - panel.width) / 2), round(y))

    def _legend_panels(self, words: Words) -> list[_Placed]:
        """Legend of solid and ghost, bottom left; playback speed, bottom right."""
        ghost = self._ghost_name()
        paint = _bytes(ghost_paint(self._appearance))
        entries: list[tuple[str, tuple[int, ...]]] = [("solid: MuJoCo", _SOLID), (f"ghost: {ghost}", paint)]
        if self._appearance.force_scale > 0:
            entries.append(("contact force", _bytes(FORCE)))
        if self._appearance.goals:
            entries.append(("goal", _bytes(GOAL)))
        if self._appearance.paths:
            entries.append(("path to follow", _bytes(PATH)))
        p, box, height = self._padding, 13 * self._unit, 34 * self._unit
        gaps = [self._small.getlength(entry) + 1.6 * box for entry, _ in entries]
        panel, draw = _panel(2 * p + sum(gaps) + 1.6 * box * (len(entries) - 1), height, 8 * self._unit)
        x = p
        for (entry, colour), gap in zip(entries, gaps, strict=True):
            top = (height - box) / 2
            draw.rectangle((x, top, x + box, top + box), fill=colour, outline=colour[:3])
            draw.text((x + 1.6 * box, height / 2), entry, _INK, self._small, anchor="lm")
            x += gap + 1.6 * box
        bottom = round(self._height - self._margin - height)
        panels = [(panel, (round(self._margin), bottom))] if words.legend else []
        if words.speed is not None:
            panels.append(self._right_panel(speed_words(words.speed), bottom))
        return panels

    def _right_panel(self, words: str, y: int) -> _Placed:
        p, height = self._padding, 34 * self._unit
        panel, draw = _panel(2 * p + self._small.getlength(words), height, 8 * self._unit)
        draw.text((p, height / 2), words, _INK, self._small, anchor="lm")
        return panel, (round(self._width - self._margin - panel.width), y)


def decimals(largest: float) -> int:
    """Number of decimals, at most four, that give about four digits to a number as large as `largest`."""
    return 4 if largest == 0 else int(np.clip(3 - math.floor(math.log10(largest)), 0, 4))


def number(value: float, places: int) -> str:
    """A number with a true minus sign and no negative zero; one that ran away in few digits."""
    if abs(value) >= _LONG:
        return f"{value:.0e}".replace("e+", "e").replace("-", _MINUS)
    words = f"{value + 0.0:.{places}f}"
    return words.lstrip("-") if float(words) == 0 else words.replace("-", _MINUS)


def speed_words(speed: float) -> str:
    """A playback speed in words, e.g. "1/4 speed"."""
    if speed == 1:
        return "real time"
    ratio = Fraction(speed).limit_denominator(100)
    if ratio.numerator == 1 and math.isclose(ratio, speed):
        return f"1/{ratio.denominator} speed"
    return f"{speed:.3g}\N{MULTIPLICATION SIGN} speed"


def distance_words(distance: float, unit: str) -> str:
    """A distance in the model's unit; metres as millimetres or centimetres where they are few, to three digits."""
    if unit != "m":
        return f"{distance:.3f} {unit}"
    if distance < 0.1:
        return f"{1e3 * distance:.2f} mm" if distance < 0.01 else f"{1e3 * distance:.1f} mm"
    return f"{1e2 * distance:.1f} cm" if distance < 1.0 else f"{distance:.2f} m"


def time_words(t: float, *, unstable: bool) -> str:
    """The time under a pose."""
    return f"{t:.2f} s, unstable" if unstable else f"{t:.2f} s"


def write_below(
    picture: np.ndarray, words: str, band: int, unit: float, marks: Sequence[Mark] = (), *, bad: bool = False
) -> np.ndarray:
    """A pose of a strip with marks in it and words in a band under it: (height + band, width, channels)."""
    height, width, channels = picture.shape
    blank = (*_INK, 0) if channels == 4 else _PAPER  # ink's own colour, or the edges of letters would be another
    image = Image.new("RGBA" if channels == 4 else "RGB", (width, height + band), blank)
    image.paste(Image.fromarray(picture), (0, 0))
    for mark in marks:
        _write_mark(ImageDraw.Draw(image), mark, _font("DejaVuSans.ttf", 13 * unit), unit)
    font = _font("DejaVuSans.ttf", 18 * unit)
    if font.getlength(words) > 0.96 * width:
        font = _font("DejaVuSans.ttf", 18 * unit * 0.96 * width / font.getlength(words))
    ink = _BAD if bad else _INK
    ImageDraw.Draw(image).text((width / 2, height + band / 2), words, ink, font, anchor="mm")
    return np.asarray(image)


def _write_mark(draw: ImageDraw.ImageDraw, mark: Mark, font: ImageFont.FreeTypeFont, unit: float) -> None:
    draw.text(
        mark.at, mark.words, mark.ink, font, anchor=mark.anchor, stroke_width=max(1, round(2 * unit)),
        stroke_fill=(240, 243, 247),
    )  # fmt: skip


def _mixed(ink: tuple[int, int, int], part: float) -> tuple[int, int, int]:
    """An ink with a part of the paper's."""
    r, g, b = (round((1.0 - part) * one + part * other) for one, other in zip(ink, _PAPER, strict=True))
    return r, g, b


def _panel(width: float, height: float, radius: float) -> tuple[Image.Image, ImageDraw.ImageDraw]:
    """A translucent sheet with round corners to write on. The corners are smooth: drawn large, then shrunk."""
    size = (max(1, math.ceil(width)), max(1, math.ceil(height)))
    large = Image.new("L", (4 * size[0], 4 * size[1]), 0)
    corners = (0, 0, large.width - 1, large.height - 1)
    ImageDraw.Draw(large).rounded_rectangle(corners, 4 * radius, fill=_PAPER_ALPHA)
    panel = Image.new("RGBA", size, (*_PAPER, 0))
    panel.putalpha(large.resize(size, Image.Resampling.LANCZOS))
    return panel, ImageDraw.Draw(panel)


def _bytes(rgba: tuple[float, ...]) -> tuple[int, ...]:
    return tuple(round(255 * value) for value in rgba)


@cache
def _font(name: str, size: float) -> ImageFont.FreeTypeFont:
    """A font that matplotlib brings, so that pictures look the same on every machine."""
    found = find_spec("matplotlib")  # its import takes a fifth of a second
    data = Path(next(iter(found.submodule_search_locations or ()), "") if found else "") / "mpl-data"
    if not data.is_dir():  # where a distribution keeps it elsewhere
        import matplotlib

        data = Path(matplotlib.get_data_path())
    return ImageFont.truetype(str(data / "fonts" / "ttf" / name), max(6, round(size)))
