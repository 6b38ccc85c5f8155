"""Capabilities of a machine, and the stationary objects in its model.

A stationary object is a free body without actuator, contact, tendon or equality, whose weight gravity compensation
cancels: its coordinates are part of the state and do not change. In the user's file a contact supports it.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from planner.model.mechanism import SCREW, Mechanism

ON_AXIS = 0.02  # of its radius: how far the centre of a wheel may be from its axis


@dataclass(frozen=True, eq=False)
class Capabilities:
    """Properties of dynamics. The defaults apply to dynamics without a mechanism, e.g. a user's own function.

    Attributes:
        mechanism: The machine, or None.
        actuated: (nv,) bool, the degrees of freedom that an actuator moves, directly or through a coupling.
        contacts: Whether the plan models contacts of bodies with the ground or each other.
        stops: Whether the plan models joint limits as compliant forces.
        loops: Whether there are loop closures or polynomial couplings.
        friction_loss: Whether joints have dry friction.
        exact_hessian: Whether the step has second derivatives, for solve(hessian="exact").
    """

    mechanism: Mechanism | None = None
    actuated: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=bool))
    contacts: bool = False
    stops: bool = False
    loops: bool = False
    friction_loss: bool = False
    exact_hessian: bool = False

    @property
    def unactuated(self) -> np.ndarray:
        """(nv,) bool, the degrees of freedom that no actuator moves."""
        return ~self.actuated

    @classmethod
    def of_mechanism(
        cls, mechanism: Mechanism, prescribed: np.ndarray | None = None, *, exact_hessian: bool = False
    ) -> Capabilities:
        """Capabilities of a mechanism; `prescribed` (nv,) bool degrees of freedom count as actuated."""
        directions = mechanism.independent_directions[:, _moved_by(mechanism, np.ones(mechanism.nu, dtype=bool))]
        actuated = np.any(directions != 0.0, axis=1)
        return cls(
            mechanism=mechanism,
            actuated=actuated if prescribed is None else actuated | prescribed,
            contacts=bool(mechanism.contacts or mechanism.body_contacts),
            stops=bool(mechanism.stops),
            loops=mechanism.has_closed_chains,
            friction_loss=bool(np.any(mechanism.friction_loss)),
            exact_hessian=exact_hessian,
        )


def unactuated_basis(mechanism: Mechanism) -> np.ndarray:
    """(nv, n) basis of the unactuated velocities: one column per independent degree of freedom, couplings included.

    Thrusters do not count: they push the whole machine from outside, and are off where it rests.
    """
    return mechanism.independent_directions[:, ~_moved_by(mechanism, ~thrusters(mechanism))]


def thrusters(mechanism: Mechanism) -> np.ndarray:
    """(nu,) bool, actuators that push on a machine from outside, along axes that turn with the link they push on."""
    found = mechanism.actuators.by_wrenches
    for one in mechanism.actuators.wrenches:
        outside = np.any(mechanism.parent[one.dofs] < 0)  # a force between two links does not move what carries both
        found[one.actuator] &= one.frame == one.link and outside
    return found


def _moved_by(mechanism: Mechanism, which: np.ndarray) -> np.ndarray:
    """(n,) bool, the columns of G (identity without couplings) that some of the actuators `which` (nu,) bool move."""
    acts = mechanism.actuators
    acts_on = np.where(acts.by_wrenches[:, None], acts.acts_on, acts.moment)[which]
    return np.any(acts_on @ mechanism.independent_directions != 0.0, axis=0)


def capabilities_of(dynamics: Any) -> Capabilities:
    """The `capabilities` of any dynamics; the defaults without that attribute."""
    return getattr(dynamics, "capabilities", None) or Capabilities()


def stationary_object_dofs(mechanism: Mechanism) -> np.ndarray:
    """(nv,) bool, degrees of freedom of the stationary objects, outside loop closures."""
    unreached, root = unreached_dofs(mechanism), roots(mechanism)
    chained = {end for loop in mechanism.loops for end in loop.links}
    chained |= {end for one in mechanism.polynomial_couplings for end in one.dofs}
    lies = np.zeros(mechanism.nv, dtype=bool)
    for first in np.unique(root[unreached]):
        tree = root == first
        mass, lifted = mechanism.mass[tree].sum(), mechanism.gravcomp_mass[tree].sum()
        begins_free = np.count_nonzero(tree) >= 6 and np.all(mechanism.S[first : first + 3, 3:] == np.eye(3))
        lies[tree] = begins_free and 0.0 < mass <= lifted * (1.0 + 1e-9) and chained.isdisjoint(np.flatnonzero(tree))
    return lies


def stands_on_ground(mechanism: Mechanism) -> bool:
    """Whether contacts with planes carry the machine; those of objects beside it do not count.

    Nor do those of an arm that the world holds, whose joints are all driven: it may touch the ground, and stands on its
    own.
    """
    actuated, root = mechanism.directly_actuated, roots(mechanism)
    loose = np.any(unactuated_basis(mechanism) != 0.0, axis=1)
    machine = np.isin(root, root[loose])
    if actuated.any():
        machine &= np.isin(root, root[actuated])
    return any(machine[contact.link] for contact in mechanism.contacts)


def rolling_radii(mechanism: Mechanism) -> np.ndarray:
    """(nv,) m, radius at which each hinge rolls on the ground; 0 of those that do not.

    A wheel: a hinge without a range, and every contact of its link is a sphere whose centre is on its axis.
    """
    radii = np.zeros(mechanism.nv)
    for link in {contact.link for contact in mechanism.contacts if contact.law.friction > 0.0}:
        turn, shift = mechanism.S[link, :3], mechanism.S[link, 3:]
        spheres = [contact for contact in mechanism.contacts if contact.link == link]
        off = max(float(np.linalg.norm(shift + np.cross(turn, one.centre))) for one in spheres)
        radius = min(one.radius for one in spheres)
        turns = mechanism.kind[link] == SCREW and np.any(turn) and np.all(np.isinf(mechanism.joint_range[link]))
        if turns and off <= ON_AXIS * radius:
            radii[link] = radius
    return radii


def flies(mechanism: Mechanism) -> bool:
    """Whether actuators act on a free base: a thruster carries what no ground does."""
    actuated = mechanism.directly_actuated
    bases = [links for links in mechanism.joint_links if links.stop - links.start == 6]
    return any(actuated[links].any() for links in bases) and not stands_on_ground(mechanism)


def ballistic_dofs(mechanism: Mechanism, x0: np.ndarray) -> np.ndarray:
    """(nv,) bool, translations of free bases that no force from outside stops: they fall, or drift as x0 (nx,) does.

    Of trees that begin with a free joint, on which no contact, loop closure, coupling, tendon or actuator acts.
    """
    root, found = roots(mechanism), np.zeros(mechanism.nv, dtype=bool)
    pushed = mechanism.directly_actuated | _acted_on(mechanism)
    for links in mechanism.joint_links:
        if links.stop - links.start < 6 or mechanism.parent[links.start] >= 0 or pushed[links].any():
            continue
        tree = root == links.start
        held = mechanism.gravcomp_mass[tree].sum() >= mechanism.mass[tree].sum() * (1.0 - 1e-9)
        carried_off = (np.any(mechanism.gravity) and not held) or np.any(x0[mechanism.velocities][tree])
        if carried_off:
            found[links.start : links.start + 3] = True
    return found


def floating_dofs(mechanism: Mechanism) -> np.ndarray:
    """(nv,) bool, of bases that nothing holds or drives, and that go where the motion of the joints takes them.

    Slides at the root of a tree with actuators, and the hinge or ball joint behind them: a free joint, or those of a
    planar machine. No actuator, spring, friction, contact, loop closure, coupling or tendon acts on them.
    Gravity turns nothing about a base that falls with it, along its slides, and nothing about an axis along itself.
    """
    root, found = roots(mechanism), np.zeros(mechanism.nv, dtype=bool)
    pushed = mechanism.directly_actuated | (mechanism.stiffness != 0.0) | (mechanism.friction_loss != 0.0)
    pushed |= _acted_on(mechanism)
    for first in np.unique(root):
        tree, i, frame, axes = root == first, first, np.eye(3), []
        if not np.any(mechanism.directly_actuated[tree]):
            continue
        lifted = mechanism.gravcomp_mass[tree].sum() >= mechanism.mass[tree].sum() * (1.0 - 1e-9)
        weight = np.zeros(3) if lifted else mechanism.gravity
        while not pushed[i] and not np.any(mechanism.S[i, :3]):
            found[i] = True
            frame = frame @ mechanism.T_home[i, :3, :3]
            axes.append(frame @ mechanism.S[i, 3:])
            children = np.flatnonzero(mechanism.parent == i)
            if len(children) != 1:
                break
            i = int(children[0])
        turns = slice(i, i + (1 if mechanism.kind[i] == SCREW else 3))
        borne = weight - np.reshape(axes, (-1, 3)).T @ np.linalg.pinv(np.reshape(axes, (-1, 3)).T) @ weight
        if mechanism.kind[i] == SCREW:
            borne = np.cross(frame @ mechanism.T_home[i, :3, :3] @ mechanism.S[i, :3], borne)
        if not np.any(pushed[turns]) and np.allclose(borne, 0.0):
            found[turns] = True
    return found


def _acted_on(mechanism: Mechanism) -> np.ndarray:
    """(nv,) bool, what contacts, loop closures, couplings and tendons act on.

    Within a tree these forces are internal: they act on what is between their ends, and not on the base that carries
    both. The ground, and another tree, act on all of it.
    """
    found = constrained_dofs(mechanism)
    for tendon in mechanism.tendons:
        found[[dof for dof in tendon.dofs if dof >= 0]] = True
    pairs = [(contact.link, -1) for contact in mechanism.contacts]
    pairs += [(pair.first.link, pair.second.link) for pair in mechanism.body_contacts]
    for first, second in pairs:
        found[list(_ancestors(mechanism, first) ^ _ancestors(mechanism, second))] = True
    return found


def unreached_dofs(mechanism: Mechanism, prescribed: Iterable[int] = ()) -> np.ndarray:
    """(nv,) bool, degrees of freedom of trees that no actuator, contact, coupling or tendon acts on.

    A loop closure joins two trees into one; one with the world counts as acting on its tree.

    Args:
        mechanism: The machine.
        prescribed: Indices of degrees of freedom whose accelerations are controls.
    """
    root = roots(mechanism)
    reached = {*map(int, np.flatnonzero(mechanism.directly_actuated)), *map(int, prescribed)}
    reached |= {contact.link for contact in mechanism.contacts}
    reached |= {shape.link for pair in mechanism.body_contacts for shape in (pair.first, pair.second)} - {-1}
    reached |= {dof for one in (*mechanism.couplings, *mechanism.tendons) for dof in one.dofs}
    for first, second in (
        *(loop.links for loop in mechanism.loops), *(one.dofs for one in mechanism.polynomial_couplings),
    ):  # fmt: skip
        if -1 in (first, second):
            reached.add(max(first, second))
        else:
            root[root == root[first]] = root[second]
    return ~np.isin(root, root[sorted(reached)])


def constrained_dofs(mechanism: Mechanism) -> np.ndarray:
    """(nv,) bool, degrees of freedom that couplings or loop closures hold: of a loop, those of both its branches."""
    held = np.zeros(mechanism.nv, dtype=bool)
    for one in (*mechanism.couplings, *mechanism.polynomial_couplings):
        held[[dof for dof in one.dofs if dof >= 0]] = True
    for loop in mechanism.loops:
        branches = [_ancestors(mechanism, link) for link in loop.links]
        held[list(branches[0] ^ branches[1])] = True
    return held


def _ancestors(mechanism: Mechanism, link: int) -> set[int]:
    """The links from the root to one, this one with them; none of the world."""
    found = set()
    while link >= 0:
        found.add(int(link))
        link = int(mechanism.parent[link])
    return found


def roots(mechanism: Mechanism) -> np.ndarray:
    """(nv,) index of the root link of each link's kinematic tree."""
    root = np.arange(mechanism.nv)
    for i, parent in enumerate(mechanism.parent):
        root[i] = i if parent < 0 else root[parent]
    return root


def stationary_object_bodies(mechanism: Mechanism) -> np.ndarray:
    """(nbody,) bool, whether each body belongs to a stationary object."""
    links = np.array([frame.link for frame in mechanism.bodies])
    lies = stationary_object_dofs(mechanism)
    return (links >= 0) & lies[np.maximum(links, 0)] if len(lies) else np.zeros(len(links), dtype=bool)
