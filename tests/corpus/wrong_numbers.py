"""Wrong plans: numbers and files that are not what they say."""

import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from plan_files import contents, written

import planner
from corpus import right_arms
from corpus.asking import reach
from corpus.machines import arm
from corpus.planting import Rng, honest, member, of, soft_stopped
from planner import Limits, Plan, TrackingCost
from planner.model.mjcf.text import edited
from planner.problem.archive import write_archive
from planner.problem.problem_parts import Periodic

# Numbers that are not what they say


def changed(name: str, kind: str, change: Callable[[Plan], dict[str, Any]]) -> None:
    member(name, lambda rng: replace(p := of(kind)(rng), **change(p)))


changed("controls 0.1 % larger", "arm", lambda p: {"us": 1.001 * p.us})
changed("controls a stage late", "arm", lambda p: {"us": np.roll(p.us, 1, axis=0)})
changed("controls of a cart a stage late", "swing", lambda p: {"us": np.roll(p.us, 1, axis=0)})
changed("controls swapped between joints", "arm", lambda p: {"us": p.us[:, ::-1].copy()})
changed("controls backwards in time", "arm", lambda p: {"us": p.us[::-1].copy()})
changed("controls of the other sign", "cart", lambda p: {"us": -p.us})
changed("enormous controls", "arm", lambda p: {"us": np.full_like(p.us, 1e200)})
changed("controls that are not numbers", "arm", lambda p: {"us": np.full_like(p.us, np.nan)})
changed("states shifted by 1e-6", "arm", lambda p: {"xs": p.xs + 1e-6})
changed("one state wrong between the ends", "arm",
        lambda p: {"xs": p.xs + 0.02 * (np.arange(101) == 50)[:, None]})  # fmt: skip
changed("a path that is wrong and right again at the end", "swing",
        lambda p: {"xs": p.xs + 0.1 * np.sin(np.pi * p.t / p.t[-1])[:, None] * np.array([1, 0, 0, 0])})  # fmt: skip
changed("states of a small arm shifted by 1e-6", "small arm", lambda p: {"xs": p.xs + 1e-6})
changed("a cost 0.1 % larger", "arm", lambda p: {"cost": 1.001 * p.cost})
changed("a cost that is not a number", "arm", lambda p: {"cost": float("nan")})
changed("a gradient that is not its own", "arm", lambda p: {"gradient_norm": p.gradient_norm + 1.0})
changed("gains 0.1 % larger", "arm", lambda p: {"K": 1.001 * p.K})
changed("half the gains", "arm", lambda p: {"K": 0.5 * p.K})
changed("half the gains of a swing", "swing", lambda p: {"K": 0.5 * p.K})
changed("gains of the other sign", "arm", lambda p: {"K": -p.K})
changed("no gains", "swing", lambda p: {"K": 0.0 * p.K})
changed("gains a stage late", "swing", lambda p: {"K": np.roll(p.K, 1, axis=0)})
changed("gains that are not numbers", "arm", lambda p: {"K": np.full_like(p.K, np.nan)})
changed("some gains that are not numbers", "arm",
        lambda p: {"K": p.K * np.where(p.t[1:] < 0.1, np.nan, 1.0)[:, None, None]})  # fmt: skip
changed("enormous gains", "arm", lambda p: {"K": np.full_like(p.K, 1e308)})
changed("times stretched by 1 %", "arm", lambda p: {"t": 1.01 * p.t})
changed("times shifted", "arm", lambda p: {"t": p.t + 0.01})
changed("a start that was moved", "arm", lambda p: {"problem": replace(p.problem, x0=p.problem.x0 + 0.01)})
changed("a start of a small arm that was moved", "small arm",
        lambda p: {"problem": replace(p.problem, x0=p.problem.x0 + 1e-3)})  # fmt: skip


def mirrored(p: Plan) -> dict[str, Any]:
    cost = p.problem.cost
    return {"problem": replace(p.problem, cost=TrackingCost(cost.Q, cost.R, -cost.x_ref, cost.u_ref, cost.space))}


changed("a goal that was mirrored", "arm", mirrored)
changed("a motion that was to return and does not", "arm",
        lambda p: {"problem": replace(p.problem, periodic=Periodic(1e-3))})  # fmt: skip
member("a goal that was mirrored, and numbers made consistent",
       lambda rng: honest(p := of("arm")(rng), **mirrored(p)))  # fmt: skip


def nudged(p: Plan) -> dict[str, Any]:
    cost = p.problem.cost
    return {"problem": replace(p.problem, cost=TrackingCost(cost.Q, cost.R, cost.x_ref + 0.05, cost.u_ref, cost.space))}


member("a goal that was moved by 0.05, and numbers made consistent",
       lambda rng: honest(p := of("arm")(rng), **nudged(p)))  # fmt: skip
changed("outside its bounds", "bounded", lambda p: {"problem": replace(p.problem, limits=Limits(control=5.0))})
changed("outside a range of its joints", "arm",
        lambda p: {"problem": replace(p.problem, limits=Limits(position={"j0": (-0.1, 0.85), "j1": (-0.75, -0.0)}))}
        if p.xs[:, 1].max() > 1e-3 else
        {"problem": replace(p.problem, limits=Limits(velocity={"j0": 0.5}))})  # fmt: skip
changed("the plan of another machine", "arm", lambda p: {
    "problem": planner.solve(reach(arm(np.random.default_rng(99), 2), [0.8, -0.7])).problem})  # fmt: skip


# In the file


def in_file(name: str, change: Callable[[dict[str, Any], dict[str, Any]], object], kind: str = "arm",
            digests: bool = False) -> None:  # fmt: skip
    """A plan whose file was changed by hand, or by somebody who computed its digests again."""

    def make(rng: Rng) -> Plan:
        with tempfile.TemporaryDirectory() as folder:
            path = FILED[kind](rng).save(Path(folder) / "plan.npz")
            arrays, meta = contents(path)
            change(arrays, meta)
            if digests:
                kept = {key: value for key, value in meta.items() if key not in ("digests", "format_version")}
                write_archive(path, arrays, kept)
            else:
                written(path, arrays, meta)
            return planner.load_plan(path)

    member(f"a file: {name}", make)


def times(array: str, factor: float) -> Callable[[dict, dict], object]:
    return lambda arrays, meta: arrays.__setitem__(array, arrays[array] * factor)


def model(**edits: dict[str, str]) -> Callable[[dict, dict], object]:
    return lambda arrays, meta: meta.update(mjcf=edited(meta["mjcf"], {"option": {"gravity": "0 0 -9.7"}}))


FILED: dict[str, Callable[[Rng], Plan]] = {
    "arm": of("arm"), "acrobot": of("acrobot"), "two-link": of("two-link"),
    "missed": lambda rng: planner.solve(reach(arm(rng, 2), [0.8, -0.7], final=0.01, plain=True)),
    "soft": soft_stopped,
    "limits": lambda rng: right_arms.exact_within(rng),
    "broken limits": lambda rng: planner.solve(
        reach(arm(rng, 2), [0.8, -0.7], limits=Limits(velocity=0.4)), max_iterations=40
    ),
}  # fmt: skip
in_file("controls by a bit", times("us", 1.0 + 1e-14))
in_file("states by a bit", times("xs", 1.0 + 1e-14))
in_file("gains by a bit", times("K", 1.0 + 1e-14))
in_file("its iterations", times("history", 1.0 + 1e-14))
in_file("times stretched", times("t", 1.001))
in_file("controls, digests computed again", times("us", 1.0 + 1e-6), digests=True)
in_file("states, digests computed again", times("xs", 1.0 + 1e-6), digests=True)
in_file("gains, digests computed again", times("K", 1.01), digests=True)
in_file("times, digests computed again", times("t", 1.001), digests=True)
in_file("its cost", lambda a, m: m.update(cost=0.5 * m["cost"]))
in_file("its cost, digests computed again", lambda a, m: m.update(cost=0.5 * m["cost"]), digests=True)
in_file("its gradient, digests computed again", lambda a, m: m.update(gradient_norm=1.0), digests=True)
in_file("its model", model())
in_file("its model, digests computed again", model(), "acrobot", digests=True)
in_file("the model of an own machine, digests computed again", model(), digests=True)
in_file("its status", lambda a, m: m.update(status="CONVERGED"), "soft")
in_file("its status, digests computed again", lambda a, m: m.update(status="CONVERGED"), "soft", digests=True)
in_file("a status of no kind", lambda a, m: m.update(status="PERFECT"))
in_file("a loosened tolerance", lambda a, m: m.update(tolerance=3.0), "missed")
in_file("a tolerance made soft", lambda a, m: m.update(tolerance="soft"), "missed")
in_file("a loosened tolerance of the limits", lambda a, m: m["limits"].update(tolerance=10.0), "broken limits")
in_file("limits taken away", lambda a, m: m.update(limits=None), "broken limits")
in_file("limits taken away from a good plan", lambda a, m: m.update(limits=None), "limits")
in_file("its parameters", lambda a, m: m["recipe"]["parameters"].update(mass1=0.6), "acrobot")
in_file("its parameters, digests computed again",
        lambda a, m: m["recipe"]["parameters"].update(mass1=0.6), "acrobot", digests=True)  # fmt: skip
in_file("its maps, digests computed again",
        lambda a, m: m["twin"]["to_x_offset"].__setitem__(0, 0.1), digests=True)  # fmt: skip
in_file("an array less", lambda a, m: a.pop("K"))
in_file("a stage less", lambda a, m: a.update(us=a["us"][:-1]))
in_file("a state that is not a number", lambda a, m: a["xs"].__setitem__((3, 0), np.nan))
in_file("a format of the future", lambda a, m: m.update(format_version=99))
in_file("no digests", lambda a, m: m.update(digests={}))
