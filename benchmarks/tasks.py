"""Goals of hands and of the centre of mass beside Crocoddyl: `python benchmarks/tasks.py --crocoddyl ITS_PYTHON`.

    python benchmarks/tasks.py --crocoddyl peer/bin/python --robots SITE_PACKAGES [--only NAME ...] [--json]

Single iterations from the same trajectory, and whole solves from the same guess to the same cost. Both sides read the
same URDF (of example-robot-data, which SITE_PACKAGES holds), with what only one of them knows taken out: shapes,
friction of joints, ranges. Poses are compared by the logarithm of SE(3), as Crocoddyl's ResidualModelFramePlacement
has it. The centre of mass is asked of the end alone. Before a task is timed accelerations (gravity at rest first),
costs and the cost after one iteration are compared. Each side is a process of one thread; they take turns. Times are of
the processor, since a machine with neighbours takes an iteration of milliseconds apart; ratios are of minima.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
from problems import SINGLE_THREAD
from rigid_body import AGREES, BURST, PINS, TURN, apart
from serving import Answer, Worker

FOLDER = "cmeel.prefix/share/example-robot-data/robots"
PANDA, HUMANOID = "panda_description/urdf/panda.urdf", "talos_data/robots/talos_reduced.urdf"
HOME = {
    f"panda_joint{i}": q for i, q in enumerate((0.0, -np.pi / 4, 0.0, -3 * np.pi / 4, 0.0, np.pi / 2, np.pi / 4), 1)
}
HANDS = {"talos": ("gripper_left_base_link", "gripper_right_base_link"), "panda": ("panda_hand",)}
SHIFT = np.array([0.1, -0.25, 0.15])  # m, from where a hand is to where it is to be
TURN_BY = (np.cos(0.3), 0.0, np.sin(0.3), 0.0)  # quaternion of its turn, in its own axes
ENOUGH = 1e-4  # share of the best cost above it that is the same cost
# Name: robot, integrator, torque limits as a share of the URDF's, and how many times faster an iteration is to be.
TASKS: dict[str, tuple[str, str, float | None, float]] = {
    "reach": ("panda", "semi-implicit-euler", None, 5.0),
    "reach with limits": ("panda", "semi-implicit-euler", 0.5, 5.0),
    "reach, rk4": ("panda", "rk4", None, 8.0),
    "humanoid reach": ("talos", "semi-implicit-euler", None, 4.0),
}
OWN = 1.3  # times an iteration in joint space that one to a pose may take


def common(text: str) -> tuple[str, dict[str, float]]:
    """The URDF as both sides understand it alike, and the effort limits of its joints."""
    for element in ("visual", "collision", "transmission", "gazebo"):
        text = re.sub(rf"<{element}\b[^>]*?/>", "", text)
        text = re.sub(rf"<{element}\b.*?</{element}>", "", text, flags=re.S)
    text = re.sub(r"<(dynamics|safety_controller|mimic)\b[^>]*?/>", "", text)
    text = text.replace('type="prismatic"', 'type="fixed"')
    efforts = {}
    for name, body in re.findall(r'<joint name="([^"]+)" type="revolute">(.*?)</joint>', text, flags=re.S):
        effort = re.search(r'effort="([^"]+)"', body)
        efforts[name] = float(effort.group(1)) if effort else 0.0
    return re.sub(r"<limit\b[^>]*?/>", '<limit lower="-50" upper="50" effort="1000" velocity="100"/>', text), efforts


def quaternion_product(a: Any, b: Any) -> np.ndarray:
    """The quaternion of a rotation after another, w first."""
    w, v = a[0] * b[0] - np.dot(a[1:], b[1:]), a[0] * np.array(b[1:]) + b[0] * np.array(a[1:]) + np.cross(a[1:], b[1:])
    return np.array([w, *v])


def quaternion_of(R: np.ndarray) -> np.ndarray:
    """A quaternion of a rotation, w first."""
    vectors = np.linalg.eigh(np.array([
        [R[0, 0] + R[1, 1] + R[2, 2], R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]],
        [0, R[0, 0] - R[1, 1] - R[2, 2], R[0, 1] + R[1, 0], R[0, 2] + R[2, 0]],
        [0, 0, R[1, 1] - R[0, 0] - R[2, 2], R[1, 2] + R[2, 1]],
        [0, 0, 0, R[2, 2] - R[0, 0] - R[1, 1]],
    ]), UPLO="U")[1]  # fmt: skip
    return vectors[:, -1]


def task_of(name: str, robots: Path, ours: Worker) -> dict[str, Any]:
    """A task as JSON; where its goals are is asked of our side."""
    robot, integrator, share, _ = TASKS[name]
    free = robot == "talos"
    text, efforts = common((robots / (HUMANOID if free else PANDA)).read_text())
    N, home = 100, {} if free else HOME
    task: dict[str, Any] = {
        "urdf": text, "free": free, "N": N, "dt": 0.005 if free else 0.01, "integrator": integrator, "q0": home,
        "frames": {}, "centre": None, "running": 1.0, "final": 1000.0, "posture": 0.01, "velocity": 0.1,
        "final_velocity": 10.0, "effort": 1e-3, "bounds": None, "us": N * [{}], "stop": 1e-9, "joint_goal": False,
    }  # fmt: skip
    if integrator == "rk4":  # Crocoddyl integrates what it weighs on the way by RK4, too
        task |= {"running": 0.0, "posture": 0.0, "velocity": 0.0}
    failed = ours.ask("load", task=task).get("failed")
    if failed:
        sys.exit(f"{name}: {failed}")
    at = ours.ask("probe", qs=[home], vs=[{}], us=[{}])
    if not free:
        task["us"] = N * at["holding"]
    for hand, side in zip(HANDS[robot], (1.0, -1.0), strict=False):
        T = np.array(at["poses"][hand])
        way = SHIFT * (0.5 if free else 1.0) * np.array([1.0, side, 1.0])
        turned = quaternion_product(quaternion_of(T[:3, :3]), TURN_BY)
        task["frames"][hand] = [*(T[:3, 3] + way).tolist(), *turned.tolist()]
    if free:
        task["centre"] = at["centre"]
    if share is not None:
        task["bounds"] = {joint: share * effort for joint, effort in efforts.items()}
    return task


def checked(task: dict[str, Any], workers: dict[str, Worker]) -> Answer:
    """Give the task to both; how far apart they are on it."""
    answers = {name: worker.ask("load", task=task) for name, worker in workers.items()}
    for name, answer in answers.items():
        if "failed" in answer:
            return {"agrees": False, "failed": f"{name}: {answer['failed']}"}
    rng, joints = np.random.default_rng(0), answers["ours"]["joints"]
    numbers = rng.normal(size=(3, 4, len(joints))).tolist()
    qs, vs, us = ([{}, *(dict(zip(joints, row, strict=True)) for row in rows)] for rows in numbers)
    found = {name: worker.ask("probe", qs=qs, vs=vs, us=us)["accelerations"] for name, worker in workers.items()}
    if "crocoddyl" not in found:
        return {"agrees": True, "cost": answers["ours"]["cost"]}
    a, b = ([[row[joint] for joint in joints] for row in found[name]] for name in ("ours", "crocoddyl"))
    line: Answer = {
        # in free fall the joints of a floating machine have none at rest
        "at_rest": float(np.abs(np.subtract(a[0], b[0])).max()), "accelerations": apart(a, b),
        "cost": apart(*(answers[name]["cost"] for name in ("ours", "crocoddyl"))),
    }  # fmt: skip
    if answers["ours"]["step"] == answers["crocoddyl"]["step"] == 1.0:
        line["stepped_cost"] = apart(*(answers[name]["stepped_cost"] for name in ("ours", "crocoddyl")))
    return {**line, "agrees": max(line["at_rest"], line["accelerations"], line["cost"]) <= AGREES}


def in_turns(asked: dict[str, Worker], do: str, repeats: int, seconds: float) -> dict[str, Answer]:
    """Per worker its last answer with the times of all its turns, the first turn not counted."""
    rows: dict[str, Answer] = {name: worker.ask(do, repeats=1, seconds=TURN) for name, worker in asked.items()}
    times: dict[str, list[float]] = {name: [] for name in asked}
    while any(len(t) < repeats and sum(t) < seconds for t in times.values()):
        for name, worker in asked.items():
            if len(times[name]) < repeats and sum(times[name]) < seconds:
                rows[name] = worker.ask(do, repeats=BURST, seconds=TURN)
                if "failed" in rows[name]:
                    sys.exit(f"{name}, {do}: {rows[name]['failed']}")
                times[name] += rows[name]["times"]
    return {name: {**rows[name], "times": times[name]} for name in asked}


def measured(name: str, arguments: argparse.Namespace, workers: dict[str, Worker]) -> Answer:
    """One row: checks, iterations, solves."""
    task = task_of(name, Path(arguments.robots) / FOLDER, workers["ours"])
    line: Answer = {"task": name, **checked(task, workers)}
    if "failed" in line:
        return line
    asked = dict(workers)
    if TASKS[name][0] == "panda" and arguments.part != "solves":  # our own iteration in joint space, in the same turns
        joints = asked["joints"] = Worker(sys.executable, "tasks_worker.py", SINGLE_THREAD, "joint space")
        joints.ask("load", task={**task, "joint_goal": True})
    if arguments.part != "solves":
        for who, row in in_turns(asked, "iterate", arguments.repeats, arguments.seconds).items():
            line[f"{who}_us"] = 1e6 * min(row["times"])
        if "crocoddyl" in asked:
            line |= {"ratio": line["crocoddyl_us"] / line["ours_us"], "target": TASKS[name][3]}
        if "joints" in asked:
            line |= {"beside_joints": line["ours_us"] / line["joints_us"], "joints_target": OWN}
            asked.pop("joints").close()
    if arguments.part != "iterations":
        ends = {who: worker.ask("until", enough=None) for who, worker in asked.items()}
        costs = [end["cost"] for end in ends.values()]
        enough = (1.0 + ENOUGH) * min(costs)
        for who, worker in asked.items():
            line |= {f"{who}_cost": ends[who]["cost"], f"{who}_iterations": ends[who]["iterations"]}
            if max(costs) > enough:  # one of them stops early or late: to the same cost, then
                line[f"{who}_to_same_cost"] = worker.ask("until", enough=enough)["reached_after"]
        for who, row in in_turns(asked, "solve", arguments.repeats, arguments.seconds).items():
            line[f"{who}_solve_ms"] = 1e3 * min(row["times"])
        if "crocoddyl" in asked:
            line["solve_ratio"] = line["crocoddyl_solve_ms"] / line["ours_solve_ms"]
    return line


def main() -> None:
    """Run, print, and exit with 1 where the sides do not solve the same task."""
    parser = argparse.ArgumentParser(description="Goals of frames: single iterations and whole solves.")
    parser.add_argument("--crocoddyl", metavar="PYTHON", default=os.environ.get("CROCODDYL_PYTHON"), help=PINS)
    parser.add_argument("--robots", metavar="SITE_PACKAGES", required=True, help="folder that has example-robot-data")
    parser.add_argument("--only", nargs="+", choices=list(TASKS), help="only these tasks")
    parser.add_argument("--part", choices=("iterations", "solves"), help="only this part")
    parser.add_argument("--repeats", type=int, default=60, help="repetitions per row and side (60)")
    parser.add_argument("--seconds", type=float, default=20.0, help="longest time per row and side (20)")
    arguments = parser.parse_args()
    workers = {"ours": Worker(sys.executable, "tasks_worker.py", SINGLE_THREAD, "planner")}
    if arguments.crocoddyl:
        workers["crocoddyl"] = Worker(arguments.crocoddyl, "tasks_worker.py", SINGLE_THREAD, "Crocoddyl")
    for name, worker in workers.items():
        if "version" not in worker.hello:
            sys.exit(f"{name}: {worker.hello}")
    print(json.dumps({name: worker.hello["version"] for name, worker in workers.items()}), flush=True)
    agree = True
    for name in arguments.only or TASKS:
        line = measured(name, arguments, workers)
        agree &= line["agrees"]
        print(json.dumps(line), flush=True)
    for worker in workers.values():
        worker.close()
    sys.exit(0 if agree else 1)


if __name__ == "__main__":
    main()
