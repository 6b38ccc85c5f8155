"""The gradient of a plan that leans on its ranges is that of the penalties that are active along it."""

from dataclasses import replace

import numpy as np
import pytest
from carts import cart

import planner
from planner.proof.consistency import GAIN_BOUND, consistency, recomputed

# Anchor in the link before, m, axis, mass, kg, of an arm of seven joints.
LINKS = (
    ((0, 0, 0.33), "0 0 1", 3), ((0, 0, 0), "0 1 0", 3), ((0, 0, 0.32), "0 0 1", 2.5), ((0.08, 0, 0), "0 -1 0", 2.5),
    ((-0.08, 0, 0.38), "0 0 1", 2), ((0, 0, 0), "0 -1 0", 1.5), ((0.09, 0, 0), "0 0 -1", 0.7),
)  # fmt: skip


def arm(lower):
    """Joint 5 starts at 0, beside the lower end of its range, rad."""
    bodies, motors = "", ""
    for i, (place, axis, mass) in enumerate(LINKS):
        (x, _, z), most = LINKS[(i + 1) % 7][0], 80 if i < 5 else 12
        ends = f"{lower} 3.75" if i == 5 else "-2.9 2.9"
        bodies += (
            f'<body pos="{place[0]} {place[1]} {place[2]}"><joint name="j{i}" axis="{axis}" range="{ends}" '
            f'damping="0.1" armature="0.1"/><geom type="capsule" size="0.05" mass="{mass}" '
            f'fromto="0 0 0 {x} 0 {max(z, 0.05)}"/>'
        )
        motors += f'<motor joint="j{i}" ctrlrange="-{most} {most}"/>'
    return (
        '<mujoco><compiler angle="radian"/><default><geom contype="0" conaffinity="0"/></default><worldbody>'
        f"{bodies}{'</body>' * 7}</worldbody><actuator>{motors}</actuator></mujoco>"
    )


@pytest.mark.parametrize("seed", [109, 195, 219, 234])
def test_the_gradient_is_that_of_the_plan(seed):
    """Of these the last sweep before the end had the active penalties of the one before: off by 1e-4 to 1e-2."""
    rng = np.random.default_rng(seed)
    mechanism = planner.Mechanism.from_mjcf(arm(-rng.choice([0.0175, 0.001, 0.05])))
    start = mechanism.home.copy()
    start[3] = -1.0
    goal = planner.Goal(joints={"j0": rng.uniform(-1, 1), "j3": -rng.uniform(1.2, 2.2)})
    problem = planner.task(mechanism, start=start, goals=goal, duration=1.5)
    plan = planner.solve(problem)
    again = recomputed(plan, problem, plan.xs, plan.us)
    assert plan.gradient_norm == pytest.approx(again.gradient_norm, rel=1e-8)  # rounding of sums of 1e-16


@pytest.mark.parametrize(("away", "passes"), [(1e-9, True), (1e-4, False)])
def test_gains_may_count_a_state_on_its_bound_as_beyond_it_or_not(away, passes):
    """Without a force there the plan is the same; the gains differ, by whether the bound would push back."""
    problem = cart(20, position={"rail": (-5.0, 5.0)})
    plan = planner.solve(problem)
    given, k = plan.bound_penalties, 8
    place = problem.ranges.deviations(plan.xs)[k, 0]

    def with_bound(at):
        lower, weight = given.lower.copy(), given.weight.copy()
        lower[k, 0], weight[k, 0] = at, 10.0
        return replace(plan, bound_penalties=given._replace(lower=lower, weight=weight))

    inside, beyond = with_bound(place - away), with_bound(place + away)
    gains = [recomputed(one, problem, one.xs, one.us).gains for one in (inside, beyond)]
    assert np.abs(gains[0] - gains[1]).max() > 100.0 * GAIN_BOUND * np.abs(gains[0]).max()
    section = consistency(replace(inside, K=gains[1]), problem, recomputed(inside, problem, plan.xs, plan.us))
    assert ("gain_error" not in {one.name for one in section.failures}) == passes
