"""Plan a hop, prove it in MuJoCo, film it: the script to copy.

python plan_then_simulate.py [--no-video]
"""

import sys

import planner


def main() -> int:
    problem = planner.cases.hopper(height=20.0)  # inch and second, as in the paper
    plan = planner.solve(problem, callback=print)
    print(plan)
    print(plan.message)

    # MuJoCo, at a refined step, open loop and with the plan's gains; 512 perturbed rollouts by default
    proof = planner.prove(plan, rollouts=16)
    print(proof)
    for name, section in proof.sections.items():
        for measured in section.measured:
            print(f"  {name}: {measured}")

    plan.save("hopper.npz")
    if "--no-video" not in sys.argv:
        planner.render_video(proof.replay, "hopper.mp4")  # the simulated machine solid, the plan as a ghost
    return 0 if plan.success and proof.passed else 1


if __name__ == "__main__":
    sys.exit(main())
