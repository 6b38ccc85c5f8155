"""Read the transmissions of actuators at sites, as MuJoCo's mj_transmission has them.

The gear is a force at the site and a torque, along the site's axes. With a refsite both are along the refsite's axes
and act between the two: opposite on what carries the refsite, and on nothing that carries both.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from planner.base.gl import load_mujoco
from planner.model.actuators import SiteWrench
from planner.model.mjcf.model_index import gear_of, pose


def is_at_site(model: Any, actuator: int) -> bool:
    """Whether an actuator acts at a site."""
    return bool(model.actuator_trntype[actuator] == int(load_mujoco().mjtTrn.mjTRN_SITE))


def site_wrenches(model: Any, actuator: int, links: np.ndarray, poses: np.ndarray) -> list[SiteWrench]:
    """The wrenches of an actuator at a site; bodies are at `poses` (nbody, 4, 4) in the frames of `links` (nbody,)."""
    gear, (site, refsite) = gear_of(model, actuator), map(int, model.actuator_trnid[actuator])
    at, its_chain = _place(model, site, links, poses), _chain(model, links, site)
    if refsite < 0:
        R = at[1][:3, :3]
        none = np.zeros(0, dtype=np.int64)
        return [_wrench(actuator, at, at[0], R @ gear[:3], R @ gear[3:], its_chain, none)]
    origin, other_chain = _place(model, refsite, links, poses), _chain(model, links, refsite)
    own, other = np.setdiff1d(its_chain, other_chain), np.setdiff1d(other_chain, its_chain)
    R = origin[1][:3, :3]
    force, torque, none = R @ gear[:3], R @ gear[3:], other[:0]
    found = [_wrench(actuator, at, origin[0], force, torque, own, other)] if len(own) else []
    return found + ([_wrench(actuator, origin, origin[0], -force, -torque, other, none)] if len(other) else [])


def _wrench(
    actuator: int, at: tuple[int, np.ndarray], frame: int, force: np.ndarray, torque: np.ndarray, dofs: np.ndarray,
    frame_dofs: np.ndarray,
) -> SiteWrench:  # fmt: skip
    link, T = at
    return SiteWrench(actuator, link, T[:3, 3].copy(), frame, force, torque, dofs, frame_dofs)


def _place(model: Any, site: int, links: np.ndarray, poses: np.ndarray) -> tuple[int, np.ndarray]:
    """The link that carries a site, -1 for the world, and its pose (4, 4) there."""
    body = int(model.site_bodyid[site])
    return int(links[body]), poses[body] @ pose(model.site_pos[site], model.site_quat[site])


def _chain(model: Any, links: np.ndarray, site: int) -> np.ndarray:
    """The degrees of freedom that move a site, ascending."""
    dof, found = int(links[model.site_bodyid[site]]), []
    while dof >= 0:
        found.append(dof)
        dof = int(model.dof_parentid[dof])
    return np.array(found[::-1], dtype=np.int64)
