"""Wrong plans: of another machine than the model, or in another model."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

import planner
from corpus import machines
from corpus.asking import reach
from corpus.machines import arm
from corpus.planting import Attempt, Rng, law_of, member, of
from corpus.right_arms import CAPSULE
from planner import Mechanism, Plan, Problem, RigidBodyDynamics, TrackingCost
from planner.model.mjcf.text import edited

# Another model


def scaled(plan: Plan, path: str, attribute: str, factor: float, which: int | None = None) -> dict[str, dict[str, str]]:
    """Edits that multiply the numbers of an attribute, or one of them."""
    from xml.etree import ElementTree

    element = ElementTree.fromstring(plan.twin.mjcf).find(path)
    assert element is not None, path
    values = [float(value) for value in element.attrib[attribute].split()]
    values = [v * factor if which in (None, k) else v for k, v in enumerate(values)]
    return {path: {attribute: " ".join(map(machines.number, values))}}


def in_another_model(kind: str, path: str, attribute: str, change: float | str, which: int | None = None) -> None:
    """A member whose model differs by a factor, or in an attribute that is set."""

    def make(rng: Rng) -> Attempt:
        plan = of(kind)(rng)
        factor = isinstance(change, float)
        edits = scaled(plan, path, attribute, change, which) if factor else {path: {attribute: change}}
        return plan, {"mjcf": edited(plan.twin.mjcf, edits)}

    how = f"times {change:g}" if isinstance(change, float) else f"is {change}"
    at = "" if which is None else f"[{which}]"
    member(f"{kind} in a model whose {attribute}{at} of {path.removeprefix('.//')} {how}", make)


for _kind in ("arm", "spatial arm", "small arm", "cart", "servo", "springs"):
    in_another_model(_kind, "option", "gravity", 1.01)
for _kind in ("arm", "small arm", "servo"):
    in_another_model(_kind, ".//body[@name='b1']/inertial", "mass", 1.05)
    in_another_model(_kind, ".//body[@name='b1']/inertial", "pos", 1.03)
in_another_model("spatial arm", ".//body[@name='b2']/inertial", "diaginertia", 1.05)
in_another_model("arm", ".//body[@name='b0']/inertial", "diaginertia", 1.05)
in_another_model("arm", ".//body[@name='b1']", "pos", 1.02)
in_another_model("arm", ".//joint[@name='j0']", "damping", 1.05)
in_another_model("small arm", ".//joint[@name='j1']", "damping", 1.05)
in_another_model("arm", ".//joint[@name='j1']", "armature", "0.002")
in_another_model("servo", ".//joint[@name='j1']", "armature", 1.05)
in_another_model("springs", ".//joint[@name='j0']", "stiffness", 1.05)
in_another_model("springs", ".//joint[@name='j0']", "springref", 1.05)
in_another_model("arm", ".//motor[@name='m0']", "gear", "1.05")
in_another_model("arm", ".//motor[@name='m1']", "gear", "-1")
in_another_model("cart", ".//motor[@name='push']", "gear", "0.95")
in_another_model("swing", ".//motor[@name='push']", "gear", "1.01")
in_another_model("spatial arm", ".//joint[@name='j1']", "axis", "0 1 0.02")
in_another_model("servo", ".//general[@name='m0']", "gainprm", 1.05)
in_another_model("servo", ".//general[@name='m1']", "biasprm", 1.05)
in_another_model("filter", ".//general[@name='m1']", "dynprm", 1.05)
in_another_model("filter", ".//general[@name='m0']", "gainprm", 0.95)
in_another_model("tree", ".//body[@name='trunk']/inertial", "diaginertia", 1.05)
in_another_model("tree", ".//joint[@name='s1']", "damping", 1.05)
in_another_model("tree", ".//motor[@name='s10']", "gear", "1 0 0.05")
in_another_model("acrobot", ".//body[@name='forearm']/inertial", "mass", 1.01)
in_another_model("acrobot", ".//joint[@name='elbow']", "damping", "0.01")
in_another_model("acrobot", ".//joint[@name='elbow']", "frictionloss", "0.05")
in_another_model("acrobot", "option", "gravity", "0 0 -9.80665")
in_another_model("hopper", "actuator/general[@name='piston']", "biasprm", "0 -100 10")
in_another_model("hopper", "actuator/general[@name='piston']", "biasprm", "0 1e12 0")
in_another_model("hopper", "actuator/general[@name='piston']", "gainprm", "101")
in_another_model("hopper", "keyframe/key[@name='start']", "act", "0")
in_another_model("arm", ".//joint[@name='j1']", "range", "-0.4 1")
in_another_model("spatial arm", ".//joint[@name='j0']", "range", "-0.1 0.1")
in_another_model("arm", ".//motor[@name='m0']", "ctrlrange", "-3 3")
in_another_model("arm", ".//motor[@name='m0']", "forcerange", "-3 3")
in_another_model("servo", ".//general[@name='m0']", "forcerange", "-4 4")
in_another_model("arm", ".//joint[@name='j0']", "actuatorfrcrange", "-3 3")
in_another_model("arm", ".//joint[@name='j0']", "frictionloss", "1")
in_another_model("small arm", ".//joint[@name='j0']", "frictionloss", "1e-3")


def swapped_motors(rng: Rng) -> Attempt:
    plan = of("arm")(rng)
    edits = {".//motor[@name='m0']": {"joint": "j1"}, ".//motor[@name='m1']": {"joint": "j0"}}
    return plan, {"mjcf": edited(plan.twin.mjcf, edits)}


def flagged(name: str, option: str, kind: str = "springs") -> None:
    """A model in which a switch is set."""

    def make(rng: Rng) -> Attempt:
        plan = of(kind)(rng)
        head, _, tail = plan.twin.mjcf.partition("</mujoco>")
        return plan, {"mjcf": f"{head}{option}</mujoco>{tail}"}

    member(f"{kind} in a model {name}", make)


flagged("without gravity", '<option><flag gravity="disable"/></option>')
flagged("without its motors", '<option><flag actuation="disable"/></option>')
flagged("in air", '<option density="1.2" viscosity="0.01"/>')
flagged("with joints that are coupled", '<equality><joint joint1="j0" joint2="j1"/></equality>')
flagged("with a tendon's spring", '<tendon><fixed stiffness="3"><joint joint="j0" coef="1"/></fixed></tendon>')
flagged("with a tendon's damping", '<tendon><fixed damping="0.1"><joint joint="j1" coef="1"/></fixed></tendon>')
flagged("whose second motor group is switched off", '<option actuatorgroupdisable="0"/>')
flagged("with a motor more", '<actuator><motor joint="j0"/></actuator>')
flagged("whose tree pulls aside", '<option wind="3 0 0" density="1"/>', "tree")


def compensated(rng: Rng) -> Attempt:
    plan = of("arm")(rng)
    return plan, {"mjcf": edited(plan.twin.mjcf, {".//body[@name='b1']": {"gravcomp": "0.05"}})}


member("a body whose weight is compensated in part", compensated)


# Dynamics that are not those of the model


def by_hand(name: str, kind: str, change: Callable[[Mechanism], dict[str, Any]]) -> None:
    """A plan for a mechanism that was changed after it was read, solved and consistent in itself."""

    def make(rng: Rng) -> Plan:
        plan = of(kind)(rng)
        old, m = plan.problem.dynamics, plan.problem.dynamics.mechanism
        dynamics = RigidBodyDynamics(replace(m, **change(m)), old.dt, old.integrator)
        return planner.solve(replace(plan.problem, dynamics=dynamics, twin=plan.twin))

    member(name, make)


by_hand("masses 5 % larger than the model's", "arm", lambda m: {"mass": 1.05 * m.mass})
by_hand("no damping, where the model has some", "arm", lambda m: {"damping": 0.0 * m.damping})
by_hand("gravity turned by a degree", "arm", lambda m: {"gravity": np.array([0.1712, 0.0, -9.8085])})
by_hand("a floor that was taken away by hand", "landing", lambda m: {"contacts": ()})
by_hand("a law of contact that was changed by hand", "ball",
        lambda m: {"contacts": tuple(replace(c, law=law_of(1.0, friction=0.3)) for c in m.contacts)})  # fmt: skip
by_hand("springs that rest elsewhere", "springs", lambda m: {"spring_rest": m.spring_rest + 0.02})
by_hand("motors 1 % stronger than the model's", "arm",
        lambda m: {"actuators": replace(m.actuators, gain=1.01 * m.actuators.gain)})  # fmt: skip


PENDULUM = """<mujoco><worldbody><body><joint name="h" axis="0 -1 0" damping="0.1"/>
  <inertial pos="0 0 -1" mass="1" diaginertia="1e-6 1e-6 1e-6"/></body></worldbody>
  <actuator><motor joint="h"/></actuator></mujoco>"""


def own_python(gravity: float = 9.81, damping: float = 0.1, integrator: str = "rk4", turn: float = 1.0) -> Plan:
    """A pendulum as somebody wrote it, in MuJoCo's."""

    def rate(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        q, v = x[..., 0], x[..., 1]
        return np.stack([turn * v, u[..., 0] - gravity * np.sin(q) - damping * v], axis=-1)

    def map_(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        half = x + 0.01 * rate(x, u)
        return x + 0.02 * rate(half, u)

    discrete = integrator == "discrete"
    dynamics = planner.FunctionDynamics(map_ if discrete else rate, 2, 1, 0.02, integrator)
    cost = TrackingCost.reach([1.5, 0.0], 60, final=1e3, effort=0.1, dt=0.02)
    twin = planner.Twin.of(Mechanism.from_mjcf(PENDULUM))
    return planner.solve(Problem(dynamics, cost, [0.0, 0.0], twin=twin))


member("own Python with another gravity", lambda rng: own_python(gravity=9.7))
member("own Python that forgets the damping", lambda rng: own_python(damping=0.0))
member("own Python with a wrong rate", lambda rng: own_python(turn=1.01))
member("own discrete Python with another gravity", lambda rng: own_python(gravity=9.7, integrator="discrete"))
member("own discrete Python that forgets the damping", lambda rng: own_python(damping=0.0, integrator="discrete"))


def other_machine(rng: Rng) -> Attempt:
    plan = of("acrobot")(rng)
    return plan, {"mjcf": of("swing")(rng).twin.mjcf}


def other_arm(rng: Rng) -> Attempt:
    return of("arm")(rng), {"mjcf": of("small arm")(rng).twin.mjcf}


def joint_more(rng: Rng) -> Attempt:
    plan = of("arm")(rng)
    head, end, tail = plan.twin.mjcf.rpartition("</worldbody>")
    return plan, {"mjcf": f'{head}<body><joint/><geom size="0.1"/></body>{end}{tail}'}


def wall_on(rng: Rng) -> Attempt:
    """A table that both shapes of the arm meet; the plan's own model has none."""
    text = arm(rng, 2, shapes=CAPSULE)
    plan = planner.solve(reach(text, [-0.8, 0.4], contacts="model"))
    head, end, tail = plan.twin.mjcf.rpartition("</worldbody>")
    return plan, {"mjcf": f'{head}<geom name="table" type="box" size="2 2 0.05" pos="0 0 -0.35"/>{end}{tail}'}


def mixed_maps(rng: Rng) -> Attempt:
    plan = of("arm")(rng)
    order = [1, 0, 3, 2]
    return plan, {"twin": replace(plan.twin, to_x=plan.twin.to_x[order], to_sim=plan.twin.to_sim[:, order])}


def shifted_maps(rng: Rng) -> Attempt:
    plan = of("arm")(rng)
    return plan, {"twin": replace(plan.twin, to_x_offset=plan.twin.to_x_offset + 0.05)}


member("two motors swapped", swapped_motors)
member("an acrobot's plan in a cart of as many joints", other_machine)
member("an arm's plan in an arm of another size", other_arm)
member("a model with a joint more", joint_more)
member("a table in another model", wall_on)
member("maps of a twin that swap joints", mixed_maps)
member("maps of a twin with an offset", shifted_maps)
