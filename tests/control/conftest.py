"""The problem and the controller that the tests of the loop share."""

import pytest

import planner


@pytest.fixture(scope="module")
def problem():
    return planner.cases.two_link(horizon=40)


@pytest.fixture(scope="module")
def controller(problem):
    return planner.Controller(problem)
