"""FootLoads: which feet bear load in MuJoCo, as the switches under the feet of a machine tell it."""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import Any

import numpy as np

from planner.base.gl import load_mujoco
from planner.model.mjcf.model_index import names_of
from planner.problem.touch_downs import BEARS
from planner.proof.replays.simulation import set_state


class FootLoads:
    """The feet of some names in a MuJoCo model, and in others with the same bodies."""

    def __init__(self, model: Any, feet: Collection[str]) -> None:
        self._feet: dict[str, int] = {}  # by name the last degree of freedom that moves it
        if not feet:
            return
        self._links, roots = _links(model), np.arange(model.nv)
        for dof, parent in enumerate(model.dof_parentid):
            roots[dof] = roots[parent] if parent >= 0 else dof
        # As contact_edits names them in the twin's text; the user's own file has no names there.
        bodies = {name or f"body number {k}": k for k, name in enumerate(names_of(model, "body", model.nbody))}
        self._feet = {name: link for name in feet if name in bodies and (link := int(self._links[bodies[name]])) >= 0}
        tree_of = np.append(roots, -1)[self._links]  # (nbody,) the root of each body's tree
        self._trees = {name: tree_of == roots[link] for name, link in self._feet.items()}
        self._wrench = np.zeros(6)

    def known(self, feet: Collection[str]) -> bool:
        """Whether the model has all of these."""
        return all(name in self._feet for name in feet)

    def sensed(self, model: Any, data: Any, w: np.ndarray, ctrl: Callable[[], np.ndarray]) -> Callable[[str], bool]:
        """Whether a foot bears load, by its name; arguments as of at(), which the first question calls."""
        found: list[frozenset[str]] = []

        def bears(foot: str) -> bool:
            if not found:
                found.append(self.at(model, data, w, ctrl()))
            return foot in found[0]

        return bears

    def at(self, model: Any, data: Any, w: np.ndarray, ctrl: np.ndarray) -> frozenset[str]:
        """Names of the feet that bear load at a state w (nw,) under controls (model.nu,); `data` is overwritten."""
        mujoco = load_mujoco()
        set_state(model, data, w)
        data.ctrl[:], data.qacc_warmstart[:] = ctrl, 0.0  # so that a run does not depend on those before it
        mujoco.mj_forward(model, data)
        forces = np.zeros(model.nv)  # by the link that bears it
        for k, (one, other) in enumerate(data.contact.geom[: data.ncon].tolist()):
            if min(one, other) < 0:
                continue  # of a flex
            links = self._links[model.geom_bodyid[one]], self._links[model.geom_bodyid[other]]
            if min(links) < 0 <= max(links):
                mujoco.mj_contactForce(model, data, k, self._wrench)
                forces[max(links)] += self._wrench[0]
        least = BEARS * float(np.linalg.norm(model.opt.gravity))
        return frozenset(
            name for name, link in self._feet.items() if forces[link] > least * model.body_mass[self._trees[name]].sum()
        )


def _links(model: Any) -> np.ndarray:
    """(nbody,) the last degree of freedom that moves each body, -1 for those of the world."""
    links = np.full(model.nbody, -1)
    for body in range(1, model.nbody):
        moves = model.body_dofnum[body]
        links[body] = model.body_dofadr[body] + moves - 1 if moves else links[model.body_parentid[body]]
    return links
