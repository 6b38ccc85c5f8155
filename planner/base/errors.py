"""Exceptions. Each message is one sentence: cause, expected value, valid choices."""

from __future__ import annotations


class PlannerError(ValueError):
    """Wrong input; the command line prints the message and exits with code 2."""


class FileError(PlannerError):
    """A file that cannot be read, written or parsed."""


class ModelError(PlannerError):
    """A model (MJCF text) that cannot be used."""


class RenderingUnavailable(PlannerError):
    """No headless OpenGL library was found; the message says what to install."""
