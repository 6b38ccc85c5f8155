"""Inputs that nobody would write on purpose end in a sentence: no traceback, hang, crash or odd exit code."""

import sys

import pytest
from fuzz_server import fuzz

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the server forks and reads /proc")


def test_a_handful_of_inputs_break_nothing(tmp_path):
    assert fuzz(0, range(8), tmp_path, jobs=1) == []


@pytest.mark.slow
def test_a_thousand_inputs_break_nothing(tmp_path):
    assert fuzz(1, range(1000), tmp_path) == []
