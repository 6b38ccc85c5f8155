"""The gradient of a plan that leans on its ranges is that of the penalties that are active along it."""

import numpy as np
import pytest

import planner
from planner.proof.consistency import recomputed

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
