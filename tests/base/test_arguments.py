"""Checks of what a caller hands in: numbers are taken as they are, what is no number is refused in one sentence."""

import datetime
from collections import deque
from fractions import Fraction

import numpy as np
import pytest

from planner import PlannerError
from planner.base.arguments import array, choice, count, number, numbers, short_repr

NO_NUMBERS = [
    True, np.True_, np.array(True), "1", np.str_("1"), b"1", None, 1j, np.complex128(1.0), 10**400, 10**5000,
    {"a": 1.0}, [[1.0], [1.0, 2.0]],
]  # fmt: skip
NO_ARRAYS = [
    [True, False], [1.0, True], (1.0, np.False_), deque([True, 1.0]), np.array([True, False]),
    np.array([True, 1.0], dtype=object), [np.array(True), 1.0], ["1", "2"], [1.0, "2"], b"12",
    bytearray(b"12"), np.array(["1", "2"]), np.array([b"1", b"2"]), np.array([1.0, 2.0j]),
    np.array([datetime.date(2020, 1, 1)] * 2, dtype="datetime64[D]"), [10**400, 1], [10**5000, 1],
]  # fmt: skip


def refused(check, *given, **options):
    with pytest.raises(PlannerError) as caught:
        check("x", *given, **options)
    message = str(caught.value)
    assert message.startswith("x is ")
    assert "\n" not in message
    assert len(message) < 400
    return message


@pytest.mark.parametrize("value", [*NO_NUMBERS, np.nan, np.inf, [1.0], np.ones((30, 30))], ids=short_repr)
def test_values_that_are_no_numbers_are_refused(value):
    assert "expected a finite number" in refused(number, value)


@pytest.mark.parametrize("value", [*NO_NUMBERS, 1.0, -1, [1], np.array([1, 2]), 2**63], ids=short_repr)
def test_values_that_are_no_counts_are_refused(value):
    assert "expected a whole number of at least 0" in refused(count, value, minimum=0)


@pytest.mark.parametrize("value", NO_ARRAYS, ids=short_repr)
def test_values_that_are_no_arrays_are_refused(value):
    assert refused(array, value, (2,)) == "x is not an array of numbers, expected shape (2,)."
    assert "expected numbers" in refused(numbers, value)


def test_a_table_of_booleans_is_no_matrix():
    for value in (np.eye(2, dtype=bool), [[1.0, 0.0], [False, True]], [np.ones(2), np.ones(2, dtype=bool)]):
        assert "is not an array" in refused(array, value, (2, 2))


@pytest.mark.parametrize("value", [3, 3.0, np.int64(3), np.float32(3.0), np.array(3.0), Fraction(3)], ids=repr)
def test_numbers_are_read(value):
    assert number("x", value) == 3.0
    np.testing.assert_array_equal(numbers("x", value), 3.0)
    np.testing.assert_array_equal(array("x", [value, 1], (2,)), [3.0, 1.0])


ARRAYS = [
    [3, 1], (3.0, 1.0), range(3, 0, -2), deque([3, 1]), np.array([3, 1], dtype=np.uint8),
    np.array([3, 1], dtype=object), [np.array(3.0), np.float32(1.0)], memoryview(np.array([3.0, 1.0])),
]  # fmt: skip


@pytest.mark.parametrize("value", ARRAYS, ids=lambda value: type(value).__name__)
def test_arrays_are_read(value):
    result = array("x", value, ("n",))
    assert result.dtype == np.float64
    np.testing.assert_array_equal(result, [3.0, 1.0])


def test_arrays_are_copies():
    given = np.ones(2)
    array("x", given, (2,))[:] = 5.0
    numbers("x", given)[:] = 5.0
    np.testing.assert_array_equal(given, 1.0)


def test_counts_are_read():
    assert count("x", 3) == count("x", np.int32(3)) == count("x", 3, maximum=3) == 3
    assert count("x", 2**63 - 1) == 2**63 - 1
    assert refused(count, 4, maximum=3) == "x is 4, expected a whole number of at least 1 and at most 3."
    assert refused(count, 0) == "x is 0, expected a whole number of at least 1."


def test_long_values_are_cut():
    assert short_repr(np.ones((3, 3))) == "array([[1., 1., 1.], [1., 1., 1.], [1., 1., 1.]])"
    assert len(short_repr("x" * 1000)) == 100
    assert len(refused(choice, "x" * 1000, ("a", "b"))) < 300
