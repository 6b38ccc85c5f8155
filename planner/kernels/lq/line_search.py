"""Line search on several step lengths at once. One code for the compiled engine and for NumPy's.

`ladder` gives the first candidates, `choose` the index of the one taken (or -1), `refine` the next candidates. The
lane order is the order of preference and the first lane that satisfies the rule wins, so the result does not
depend on which lanes are computed together. J0 and S0 are the cost and its slope at step length 0 (S0 < 0).

    armijo     J(a) <= J0 + c1 a S0                                  halving from 1; where that gains far less than
                                                                     promised, on as long as J falls
    goldstein  J0 + (1 - c) a S0 <= J(a) <= J0 + c a S0              bracketing
    wolfe      armijo, and |J'(a)| <= c2 |S0|                        bracketing
    exact      argmin J(a) over a > 0 (Theorem 2)                    bracketing, to a relative width of 1e-6
"""

from __future__ import annotations

import numpy as np

from planner.kernels.numba.jit import jit, part

ARMIJO, EXACT, WOLFE, GOLDSTEIN = 0, 1, 2, 3
EVALUATE_ONLY = -2  # no search either: candidates of the lengths that are there, none of which is taken
DEFECT_STEP = 4  # Armijo's rule with one batch: where defects are open, a short step closes them with no gain
INITIAL_ROLLOUT = -1  # no search: one rollout at step length 0, which is taken as it is
ARMIJO_C1 = 1e-4  # c1 of Armijo and Wolfe (Nocedal & Wright, section 3.1)
WOLFE_C2 = 0.9  # c2 of Wolfe for Newton-like directions (same)
GOLDSTEIN_C = 0.25  # below 1/2, so that the full step of a quadratic passes (same)
SMALL_REDUCTION = 0.2  # of the expected reduction, by the parabola of J0, S0 and J(1) = J0 + S0 / 2
EXACT_WIDTH = 1e-6  # J is flat to rounding within about 1e-8 of its minimum
ARMIJO_BATCHES, BRACKET_BATCHES = 6, 32  # of candidates, before the search gives up


@jit
def first_step_lengths(rule, alpha, bracket):
    """The first candidates; bracket (3,) = (longest step known too short, shortest known too long, best)."""
    bracket[0], bracket[1], bracket[2] = 0.0, np.inf, 0.0
    for i in range(alpha.shape[0]):
        if rule == INITIAL_ROLLOUT:
            alpha[i] = 0.0
        elif rule == EVALUATE_ONLY:
            continue
        elif rule in (ARMIJO, DEFECT_STEP):
            alpha[i] = 0.5**i
        elif i % 2 == 1:  # the bracketing rules may also lengthen the step: 1, 1/2, 2, 1/4, 4, ...
            alpha[i] = 0.5 ** ((i + 1) // 2)
        else:
            alpha[i] = 2.0 ** (i // 2)


@jit
def batches(rule):
    """How many batches of candidates a rule may ask for."""
    if rule in (EVALUATE_ONLY, DEFECT_STEP):
        return 1
    return ARMIJO_BATCHES if rule == ARMIJO else BRACKET_BATCHES


@part
def _too_long(rule, alpha, J, S, J0, S0):
    """Whether the rule's steps lie before this one. A step must lower the cost, to a finite one."""
    c = GOLDSTEIN_C if rule == GOLDSTEIN else ARMIJO_C1
    if not (J0 + c * alpha * S0 >= J and -np.inf < J < J0):  # also when J is NaN
        return True
    return rule == WOLFE and not S <= -WOLFE_C2 * S0


@part
def _too_short(rule, alpha, J, S, J0, S0):
    """Whether the rule's steps lie beyond this one, which is not too long."""
    if rule == GOLDSTEIN:
        return J0 + (1.0 - GOLDSTEIN_C) * alpha * S0 > J
    return rule == WOLFE and S < WOLFE_C2 * S0


@part
def _choose_exact(alpha, J, J0, bracket):
    best = -1
    for i in range(alpha.shape[0]):
        if -np.inf < J[i] < J0 and (best < 0 or J[i] < J[best]):
            best = i
    if best < 0:
        for i in range(alpha.shape[0]):
            bracket[1] = min(bracket[1], alpha[i])
        return -1
    for i in range(alpha.shape[0]):
        if alpha[i] < alpha[best]:
            bracket[0] = max(bracket[0], alpha[i])
        elif alpha[i] > alpha[best]:
            bracket[1] = min(bracket[1], alpha[i])
    bracket[2] = alpha[best]
    return best if bracket[1] - bracket[0] <= EXACT_WIDTH * alpha[best] else -1


@part
def _gains_enough(rule, alpha, J, J0, S0):
    """Whether to take this step, which passes, with no look at shorter ones."""
    return rule == DEFECT_STEP or (rule == ARMIJO and -SMALL_REDUCTION * alpha * (1.0 - 0.5 * alpha) * S0 <= J0 - J)


@part
def _lowest_from(rule, alpha, J, J0, S0, first, known):
    """From a lane that passes on to the last of the known ones up to which J falls."""
    best = first
    if not _gains_enough(rule, alpha[first], J[first], J0, S0):
        while best + 1 < known and J[best + 1] < J[best]:
            best += 1
    return best


@jit
def decided(rule, alpha, J, J0, S0, known):
    """Whether the first `known` lanes tell which one `choose` takes, for callers that try one after the other."""
    if rule in (ARMIJO, DEFECT_STEP):
        for i in range(known):
            if not _too_long(rule, alpha[i], J[i], 0.0, J0, S0):
                enough = _gains_enough(rule, alpha[i], J[i], J0, S0)
                return enough or _lowest_from(rule, alpha, J, J0, S0, i, known) + 1 < known
    return known == alpha.shape[0]


@jit
def choose(rule, alpha, J, S, J0, S0, bracket):
    """The lane to take, or -1; narrows the bracket."""
    if rule == INITIAL_ROLLOUT:
        return 0
    if rule == EVALUATE_ONLY:
        return -1
    if rule == EXACT:
        return _choose_exact(alpha, J, J0, bracket)
    for i in range(alpha.shape[0]):
        if _too_long(rule, alpha[i], J[i], S[i], J0, S0):
            bracket[1] = min(bracket[1], alpha[i])
        elif not _too_short(rule, alpha[i], J[i], S[i], J0, S0):
            if rule in (ARMIJO, DEFECT_STEP):
                return _lowest_from(rule, alpha, J, J0, S0, i, alpha.shape[0])
            return i
    for i in range(alpha.shape[0]):  # what is too short beyond a hill does not count
        if alpha[i] < bracket[1]:
            bracket[0] = max(bracket[0], alpha[i])
    return -1


@jit
def refine(rule, alpha, bracket):
    """The next candidates: shorter by powers of two (armijo), else inside the bracket or beyond its open end."""
    if rule == EVALUATE_ONLY:
        return
    lanes = alpha.shape[0]
    low, high, best = bracket[0], bracket[1], bracket[2]
    before = lanes // 2  # of the exact rule's candidates, so many between low and best
    for i in range(lanes):
        if rule == ARMIJO:
            alpha[i] *= 0.5**lanes
        elif high == np.inf:
            alpha[i] = max(low, best) * 2.0 ** (i if rule == EXACT else i + 1)
        elif low == 0.0 and best == 0.0:
            alpha[i] = high * 0.5 ** (i + 1)
        elif rule != EXACT:
            alpha[i] = low + (high - low) * (i + 1) / (lanes + 1)
        elif i <= before:  # from the best so far, which is carried along, down to low
            alpha[i] = best - (best - low) * i / (before + 1)
        else:
            alpha[i] = best + (high - best) * (i - before) / (lanes - before)
