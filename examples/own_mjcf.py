"""Plan with a machine of someone else's making: any MJCF, here a crane. The script to copy.

python own_mjcf.py [--no-video]
"""

import sys
from pathlib import Path

import numpy as np

import planner

MODEL = Path(__file__).parent / "crane.xml"


def main() -> int:
    crane = planner.Mechanism.from_mjcf(MODEL, contacts="off")  # its shapes may collide; what is left out is said
    print(crane, "without:", *crane.ignored)
    assert planner.parity(crane).passed  # our dynamics and MuJoCo's, term by term, before any planning

    dynamics = planner.RigidBodyDynamics(crane, dt=0.02)
    goal = np.array([2.0, 0.0, 0.0, 0.0])  # trolley m, swing rad, and their rates: MuJoCo's qpos, qvel
    cost = planner.TrackingCost.joints(
        dynamics, goal, horizon=200, effort=1.0,
        final_position={"trolley": 1e5, "swing": 1e5}, final_velocity=1e5,
    )  # fmt: skip
    problem = planner.Problem(dynamics, cost, x0=crane.home, twin=planner.Twin.of(crane))

    plan = planner.solve(problem, callback=print)
    proof = planner.prove(plan, rollouts=64)  # 512 perturbed rollouts by default
    print(plan, proof, f"ends at {proof.replay.xs[-1].round(4)}", sep="\n")

    plan.save("crane.npz")
    if "--no-video" not in sys.argv:
        planner.render_video(proof.replay, "crane.mp4")
    return 0 if plan.success and proof.passed else 1


if __name__ == "__main__":
    sys.exit(main())
