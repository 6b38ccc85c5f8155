"""Names of feet: a foot is called as the body that its joints move, or as a body or shape that is fixed to that one."""

from __future__ import annotations

from dataclasses import replace

from planner.base.errors import PlannerError
from planner.model.mechanism import Mechanism
from planner.problem.constraints.clearance import model_index_of
from planner.problem.tasks.gait import Gait


def with_feet_of(gait: Gait, mechanism: Mechanism) -> Gait:
    """The gait with the names of the bodies that joints move in place of those of what is fixed to them.

    A body comes before a geom of the same name; a name that nothing has stays, to be refused with those of the feet.

    Raises:
        PlannerError: Two names with turns are those of one foot.
    """
    links = {
        name: body.link for name, body in zip(mechanism.body_names, mechanism.bodies, strict=True) if body.link >= 0
    }
    given = {*gait.feet, *(name for phase in gait.phases for name in phase.stand)}
    if given - {*links}:
        index = model_index_of(mechanism)
        shapes = {index.model.geom(g).name: index.carriers[0][body] for g, body in enumerate(index.model.geom_bodyid)}
        links = {name: int(link) for name, link in shapes.items() if name and link >= 0} | links
    names = {name: mechanism.body_of(links[name]) if name in links else name for name in given}
    called: dict[str, str] = {}
    for name in gait.feet:
        if (other := called.setdefault(names[name], name)) != name:
            raise PlannerError(
                f"the gait has turns of {other!r} and {name!r}, which are one foot, expected one of them."
            )
    return replace(
        gait,
        feet={names[name]: turn for name, turn in gait.feet.items()},
        phases=tuple(phase._replace(stand=tuple(names[name] for name in phase.stand)) for phase in gait.phases),
    )
