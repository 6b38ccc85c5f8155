"""[[constraint]] of a problem.toml: what the plan keeps, of a frame or of an actuator.

[[constraint]]                      # upright: the hand's z axis stays within an angle of a direction
frame = "hand"
pointing = [0, 0, 1]
within = 0.1                        # rad

[[constraint]]                      # a corridor: the hand's height stays between two bounds
frame = "hand"
along = "z"
lower = 0.3                         # m
upper = 0.6

[[constraint]]                      # there exactly, at the end unless it says when
frame = "hand"
position = [0.4, 0.1, 0.5]

[[constraint]]                      # what a motor gives: its force times its speed
power = "shoulder"
upper = 50.0                         # W

[[constraint]]                      # what a pin carries: the force of an equality that closes a chain
chain = "pin"
upper = 100.0                        # N
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from planner.base.arguments import array, choice, number, short_repr
from planner.base.errors import PlannerError
from planner.cases.problem_file.keys import CONSTRAINT
from planner.problem.constraints.constraint import END, Constraint
from planner.problem.constraints.forces import ChainForce, Power
from planner.problem.constraints.quantities import FrameAxisAngle, FrameOrientation, FramePosition, FramePositionAlong

AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
_WHAT = ("position", "orientation", "pointing", "along")  # of a frame, one of them
_WITHOUT_FRAME = ("power", "chain")
_ALL = ("when", "tolerance", "name")


def constraints_of(given: Any) -> list[Constraint]:
    """The constraints of a file's list of tables.

    Raises:
        PlannerError: It is no such list, a key is unknown, missing or wrong.
    """
    if not isinstance(given, list) or not all(isinstance(table, Mapping) for table in given):
        raise PlannerError(f"constraint is {short_repr(given)}, expected tables [[constraint]].")
    return [_constraint(f"[[constraint]] {i}", dict(table)) for i, table in enumerate(given, 1)]


def _constraint(where: str, table: dict[str, Any]) -> Constraint:
    for key in table:
        choice(f"the key in {where}", key, CONSTRAINT)
    kind = _kind(where, table)
    known = {kind, *_ALL, *(() if kind in _WITHOUT_FRAME else ("frame",)), *_KINDS[kind][1]}
    for key in table:
        if key not in known:
            raise PlannerError(f"{where} has {key!r} beside {kind!r}, expected some of: {', '.join(sorted(known))}.")
    more = {key: table[key] for key in ("tolerance", "name") if key in table}
    return Constraint(
        **_KINDS[kind][0](where, table), when=table.get("when", _DEFAULT_WHEN.get(kind, "always")), **more
    )


def _kind(where: str, table: dict[str, Any]) -> str:
    kinds = [key for key in (*_WHAT, *_WITHOUT_FRAME) if key in table]
    if len(kinds) != 1 or ("frame" in table) == (kinds[0] in _WITHOUT_FRAME):
        raise PlannerError(
            f"{where} has {' and '.join(map(repr, table)) or 'no keys'}, expected frame with one of "
            f"{', '.join(_WHAT)}, or power, or chain."
        )
    return kinds[0]


def _position(where: str, table: dict[str, Any]) -> dict[str, Any]:
    return {"of": FramePosition(_frame(where, table)), "equal": array(f"{where}'s position", table["position"], (3,))}


def _orientation(where: str, table: dict[str, Any]) -> dict[str, Any]:
    wanted = array(f"{where}'s orientation", table["orientation"], (4,))
    return {"of": FrameOrientation(_frame(where, table), wanted), "equal": 0.0}


def _pointing(where: str, table: dict[str, Any]) -> dict[str, Any]:
    direction = _direction(f"{where}'s pointing", table["pointing"])
    axis = _direction(f"{where}'s axis", table.get("axis", "z"))
    if "within" not in table:
        raise PlannerError(f"{where} has no key 'within', expected the largest angle in rad, e.g. within = 0.1.")
    within = number(f"{where}'s within", table["within"], greater_than=0.0)
    return {"of": FrameAxisAngle(_frame(where, table), direction, axis), "upper": within}


def _along(where: str, table: dict[str, Any]) -> dict[str, Any]:
    direction = _direction(f"{where}'s along", table["along"])
    return {"of": FramePositionAlong(_frame(where, table), direction), **_between(where, table)}


def _power(where: str, table: dict[str, Any]) -> dict[str, Any]:
    return {"of": Power(_name(where, table, "power", "an actuator")), **_between(where, table)}


def _chain(where: str, table: dict[str, Any]) -> dict[str, Any]:
    return {"of": ChainForce(_name(where, table, "chain", "an equality")), **_between(where, table)}


def _between(where: str, table: dict[str, Any]) -> dict[str, Any]:
    sides = {side: number(f"{where}'s {side}", table[side]) for side in ("lower", "upper") if side in table}
    if not sides:
        raise PlannerError(f"{where} has no bound, expected lower or upper.")
    return sides


def _direction(name: str, value: Any) -> Any:
    return AXES[choice(name, value, AXES)] if isinstance(value, str) else array(name, value, (3,))


def _name(where: str, table: dict[str, Any], key: str, what: str) -> str:
    if not isinstance(table[key], str):
        raise PlannerError(f"{where}'s {key} is {short_repr(table[key])}, expected the name of {what}.")
    return table[key]


_frame = partial(_name, key="frame", what="a site or body")


_KINDS: dict[str, tuple[Callable[[str, dict[str, Any]], dict[str, Any]], tuple[str, ...]]] = {
    "position": (_position, ()),
    "orientation": (_orientation, ()),
    "pointing": (_pointing, ("axis", "within")),
    "along": (_along, ("lower", "upper")),
    "power": (_power, ("lower", "upper")),
    "chain": (_chain, ("lower", "upper")),
}
_DEFAULT_WHEN = {"position": END, "orientation": END}
