"""Line search on functions of one variable: the step taken satisfies the rule's own inequalities."""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize_scalar

from planner.kernels.lq import line_search
from planner.kernels.lq.line_search import ARMIJO, DEFECT_STEP, EXACT, GOLDSTEIN, WOLFE
from planner.kernels.numba.lanes import WIDTH

RULES = {"armijo": ARMIJO, "exact": EXACT, "wolfe": WOLFE, "goldstein": GOLDSTEIN}
every_rule = pytest.mark.parametrize("rule", RULES.values(), ids=RULES)


def find(rule, f, df, lanes=WIDTH):
    """The step that the rule takes on f, or None; and every step at which f was asked.

    The loop is that of the engines, which may try some lanes first and the others only where they must.
    """
    alpha, bracket = np.empty(WIDTH), np.empty(3)
    line_search.first_step_lengths(rule, alpha, bracket)
    asked = []
    for _ in range(line_search.batches(rule)):
        J, S = np.full(WIDTH, np.nan), np.full(WIDTH, np.nan)
        for first in range(0, WIDTH, lanes):
            some = slice(first, first + lanes)
            asked.extend(alpha[some].tolist())
            J[some], S[some] = [f(a) for a in alpha[some]], [df(a) for a in alpha[some]]
            if line_search.decided(rule, alpha, J, f(0.0), df(0.0), first + lanes):
                break
        taken = line_search.choose(rule, alpha, J, S, f(0.0), df(0.0), bracket)
        if taken >= 0:
            return float(alpha[taken]), asked
        line_search.refine(rule, alpha, bracket)
    return None, asked


def assert_armijo(f, df, a):
    assert a > 0.0
    assert f(a) <= f(0.0) + 1e-4 * a * df(0.0)  # c1 of Nocedal & Wright, section 3.1


def assert_goldstein(f, df, a):
    rounding = 1e-14 * abs(f(0.0))  # a quadratic that is least at 2 lies on the lower line at 1
    assert f(0.0) + 0.75 * a * df(0.0) - rounding <= f(a) <= f(0.0) + 0.25 * a * df(0.0) + rounding  # c = 1/4 < 1/2


def assert_wolfe(f, df, a):
    assert_armijo(f, df, a)
    assert abs(df(a)) <= 0.9 * abs(df(0.0))  # strong Wolfe, c2 for Newton-like directions


ASSERT = {ARMIJO: assert_armijo, GOLDSTEIN: assert_goldstein, WOLFE: assert_wolfe, EXACT: assert_armijo}


# Functions with J(0) > min J and J'(0) < 0, each with its derivative


def quadratic(scale, height):
    """Minimum at `scale`."""
    return lambda a: height * (a / scale - 1.0) ** 2, lambda a: 2.0 * height * (a / scale - 1.0) / scale


def quartic(scale, height):
    return lambda a: height * ((a / scale) ** 4 - a / scale), lambda a: height * (4 * (a / scale) ** 3 - 1) / scale


def barrier(scale, height):
    """Falls to its minimum at `scale`, infinite beyond twice that: a trajectory that runs away."""

    def f(a):
        return -height * np.log(a / scale * (2.0 - a / scale) + 1e-3) if a < 2.0 * scale else np.inf

    def df(a):
        b = a / scale
        return -height * 2.0 * (1.0 - b) / (b * (2.0 - b) + 1e-3) / scale if a < 2.0 * scale else np.inf

    return f, df


def hole(scale, height):
    """A quadratic that is undefined where other step lengths lie."""
    f, df = quadratic(scale, height)
    return lambda a: f(a) if a < 1.7 * scale else np.nan, lambda a: df(a) if a < 1.7 * scale else np.nan


FUNCTIONS = {"quadratic": quadratic, "quartic": quartic, "barrier": barrier, "hole": hole}
every_function = pytest.mark.parametrize("make", FUNCTIONS.values(), ids=FUNCTIONS)
scales, heights = st.floats(1e-4, 1e4), st.floats(1e-6, 1e9)


@every_rule
@every_function
@settings(max_examples=50, deadline=None)
@given(scale=scales, height=heights)
def test_steps_satisfy_their_rule(rule, make, scale, height):
    f, df = make(scale, height)
    a, _ = find(rule, f, df)
    assert a is not None
    assert np.isfinite(f(a))
    ASSERT[rule](f, df, a)


@every_function
@settings(max_examples=50, deadline=None)
@given(scale=scales, height=heights)
def test_exact_is_the_minimum(make, scale, height):
    f, df = make(scale, height)
    a, _ = find(EXACT, f, df)
    inside = (0.0, 1.69 * scale)  # where every one of these functions is finite
    best = minimize_scalar(f, bounds=inside, method="bounded", options={"xatol": 1e-9 * scale})
    # To the search's relative width of 1e-6; below 1e-8 J is flat to rounding.
    assert a == pytest.approx(best.x, rel=3e-6)
    assert f(a) <= best.fun + 1e-10 * height


@every_rule
@pytest.mark.parametrize("lanes", [1, WIDTH])
def test_newton_steps_are_taken_whole(rule, lanes):
    """On a quadratic along a Newton direction every rule takes step 1: SLQ then converges as Newton does."""
    if lanes == 1 and rule != ARMIJO:
        lanes = WIDTH  # the bracketing rules always try eight
    a, _ = find(rule, *quadratic(1.0, 3.0), lanes)
    assert a == pytest.approx(1.0, abs=1e-6) if rule == EXACT else a == 1.0


@every_function
@settings(max_examples=100, deadline=None)
@given(scale=scales, height=heights)
def test_armijo_is_the_first_power_of_a_half_that_passes(make, scale, height):
    """And where it gains far less than promised, a shorter one. Tried one by one or eight at once, it is the same."""
    f, df = make(scale, height)
    expected, asked_of_all = power_of_a_half(f, df)
    eight, asked_of_eight = find(ARMIJO, f, df)
    one, asked_of_one = find(ARMIJO, f, df, lanes=1)
    assert eight == one == expected
    assert asked_of_eight[: len(asked_of_one)] == asked_of_one
    assert len(asked_of_one) == asked_of_all  # alone, no candidate is rolled out that need not be


def promised(df, a):
    """What the parabola with the slope at 0 that is least at 1 falls by."""
    return -a * (1.0 - 0.5 * a) * df(0.0)


def power_of_a_half(f, df):
    """What Armijo takes, word for word: the step, and how many are looked at."""
    i = next(i for i in range(48) if f(0.5**i) <= f(0.0) + 1e-4 * 0.5**i * df(0.0))
    if f(0.0) - f(0.5**i) >= line_search.SMALL_REDUCTION * promised(df, 0.5**i):
        return 0.5**i, i + 1
    while (i + 1) % WIDTH and f(0.5 ** (i + 1)) < f(0.5**i):  # up to the last of a batch
        i += 1
    return 0.5**i, min(i + 2, (i // WIDTH + 1) * WIDTH)


@pytest.mark.parametrize(("beyond", "enough"), [(2e-4, True), (5e-5, False), (-1e-3, False)])
def test_armijo_asks_for_a_share_of_the_promise(beyond, enough):
    """A quadratic whose minimum lies at (1 + e) / 2: step 1 gains 4e of its height h, and c1 = 1e-4 asks for 4e-4 h."""
    f, df = quadratic(0.5 * (1.0 + beyond), 3.0)
    assert (f(1.0) < f(0.0)) is (beyond > 0.0)
    a, _ = find(DEFECT_STEP, f, df)  # of Armijo's rule the one that never looks further
    assert a == (1.0 if enough else 0.5)


@every_rule
@settings(max_examples=30, deadline=None)
@given(slope=st.floats(1e-6, 1e6), curvature=st.floats(0.0, 1e6))
def test_gives_up_uphill(rule, slope, curvature):
    """A direction whose promised slope is a lie: J rises along it, so no rule may take any step."""
    asked = []

    def f(a):
        asked.append(a)
        return 5.0 + slope * a + curvature * a**2

    a, _ = find(rule, f, lambda a: -slope if a == 0.0 else slope + 2 * curvature * a)
    assert a is None
    assert len(asked) < 300  # it does give up


@every_rule
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_steps_to_costs_that_are_not_finite_are_never_taken(rule, bad):
    a, _ = find(rule, lambda a: 0.0 if a == 0.0 else bad, lambda a: -1.0)
    assert a is None


@every_rule
@settings(max_examples=60, deadline=None)
@given(st.sets(st.integers(0, WIDTH - 1)), st.sampled_from([np.nan, np.inf]))
def test_bad_lanes_do_not_hide_good_ones(rule, where, bad):
    """Candidates of the first batch that run away leave the choice to the others, in the order of preference."""
    f, df = quadratic(0.3, 2.0)
    alpha, bracket = np.empty(WIDTH), np.empty(3)
    line_search.first_step_lengths(rule, alpha, bracket)
    J, S = np.array([f(a) for a in alpha]), np.array([df(a) for a in alpha])
    J[list(where)] = bad
    taken = line_search.choose(rule, alpha, J, S, f(0.0), df(0.0), bracket)
    if rule == EXACT:  # narrows around the best finite candidate
        sound = [i for i in range(WIDTH) if i not in where and J[i] < f(0.0)]
        assert taken == -1
        assert bracket[2] == (alpha[min(sound, key=lambda i: J[i])] if sound else 0.0)
        return

    def passes(i):
        try:
            ASSERT[rule](lambda a: f(a) if a == 0.0 else J[i], df, alpha[i])
        except AssertionError:
            return False
        return True

    expected = next((i for i in range(WIDTH) if passes(i)), -1)
    if (
        rule == ARMIJO
        and expected >= 0
        and f(0.0) - J[expected] < line_search.SMALL_REDUCTION * promised(df, alpha[expected])
    ):
        while expected + 1 < WIDTH and J[expected + 1] < J[expected]:
            expected += 1
    assert taken == expected


@settings(max_examples=100, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_exact_never_goes_up_on_a_hilly_function(seed):
    """With many valleys the exact search settles in one of them, at a point where J' = 0 and J < J(0)."""
    rng = np.random.default_rng(seed)
    c, w, p = rng.normal(size=4), rng.uniform(1.0, 12.0, 4), rng.uniform(0.0, 6.0, 4)

    def f(a):
        return float(np.sum(c * np.sin(w * a + p)) + 0.5 * a**2)

    def df(a):
        return float(np.sum(c * w * np.cos(w * a + p)) + a)

    assume(df(0.0) < -0.1)
    a, asked = find(EXACT, f, df)
    assert a is not None
    assert f(a) == min(f(b) for b in asked)
    # J' = 0 up to the bracket's relative width of 1e-6, at a distance of which J' has changed by at most this.
    assert abs(df(a)) <= 1e-5 * a * (1.0 + np.sum(np.abs(c) * w**2))


def dip(a):
    """Falls to a valley near 0.2, climbs a hill at 1, and falls for ever beyond it with the slope it began with."""
    return -a + 3.0 * np.exp(-(((a - 1.0) / 0.3) ** 2)) - 3.0 * np.exp(-((1.0 / 0.3) ** 2))


def dip_slope(a):
    return -1.0 - 6.0 * (a - 1.0) / 0.09 * np.exp(-(((a - 1.0) / 0.3) ** 2))


# The hill is "too long" and what lies beyond it "too short": the steps that pass lie before the hill.
def test_wolfe_finds_the_valley_before_a_hill():
    valley = np.linspace(0.01, 0.6, 1000)
    passes = (dip(valley) <= 1e-4 * valley * dip_slope(0.0)) & (np.abs(dip_slope(valley)) <= 0.9 * abs(dip_slope(0.0)))
    assert passes.sum() > 100  # a tenth of the way to the hill will do
    a, _ = find(WOLFE, dip, dip_slope)
    assert a is not None
    assert_wolfe(dip, dip_slope, a)


# J is finite but its slope is not known: the curvature condition is not satisfied.
def test_wolfe_wants_a_slope():
    f, df = quadratic(1.0, 1.0)
    a, _ = find(WOLFE, f, lambda a: np.nan if a in (1.0, 2.0) else df(a))
    assert a is not None
    assert a not in (1.0, 2.0)


@every_rule
def test_minus_infinity_is_not_finite_either(rule):
    """A cost of -inf is an overflow as +inf is, and no iteration can start from it."""
    f, df = quadratic(0.4, 1.0)
    a, _ = find(rule, lambda a: -np.inf if a >= 1.0 else f(a), df)
    assert a is not None
    assert a < 1.0


@pytest.mark.parametrize("rule", [ARMIJO, EXACT])
def test_a_step_must_lower_the_cost(rule):
    """So flat that J(a) rounds to J(0): taking the step gains nothing, and a solve that does may never end."""
    a, _ = find(rule, lambda a: 1.0, lambda a: -1e-14)
    assert a is None
