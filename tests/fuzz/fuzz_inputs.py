"""Inputs that nobody would write on purpose: command lines, and files with one to four damages, each from its seed."""

from __future__ import annotations

import copy
import io
import json
import random
import re
from collections.abc import Callable
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np
from places import ROOT

from planner.cases import CASES
from planner.cli import parser
from planner.model.mjcf.text import model_text

WORDS = (
    "", "--", "-", "-1", "0", "1", "2", "3", "0.5", "-0.0", "nan", "inf", "-inf", "1e308", "-1e308", "1e-308", "1e200",
    "1e15", "4294967296", "9223372036854775808", "9" * 30, "9" * 400, "9" * 5000, "0x10", "1,2", "1x1", "true", "x",
    "é", "\x1b[2J", "a\nPASS", "../..", "/", "/dev/null", "x" * 5000, "a=1", "effort=1e308", "%s%n", "'", '"', "<a>",
)  # fmt: skip
NUMBERS = ("0", "1", "-1", "0.5", "2", "10", "-0.3", "1e-3", "1e-12", "1000", "1e6", "1e12")
SHORT = {"run": ["--rollouts", "0", "--no-video", "--no-refine"], "prove": ["--rollouts", "2"],
         "report": ["--rollouts", "0", "--no-video"], "render": ["--out", "strip.png", "--size", "160x96"],
         "export": ["--to", "csv"]}  # fmt: skip
STAGES = ["--horizon", "8", "--max-iterations", "2"]
PROBLEM = """model = "model.xml"
start = {}
goal = {}
duration = 0.1
dt = 0.02
contacts = "off"
ignore = ["frictionloss", "equality", "tendon", "fluid", "gravcomp", "actuator"]
"""
MODELS = (*sorted((ROOT / "mjcf").glob("*/*.xml")), *sorted((ROOT / "examples").glob("*.xml")))


class Case(NamedTuple):
    """A command line, and the files that it finds in its folder."""

    kind: str
    words: list[str]
    files: dict[str, bytes]


def case_of(seed: int, k: int, plans: dict[str, bytes]) -> Case:
    """Input k of a seed; `plans` holds the content of sound files: two-link.npz, crane.npz, proof.json, gait.csv."""
    rng = random.Random(f"{seed} {k}")
    kind = list(KINDS)[k % len(KINDS)]
    words, files = KINDS[kind](rng, plans)
    return Case(kind, [word.replace("\0", "") for word in words], files)


def _flags(rng: random.Random, command: str, case: str | None) -> list[str]:
    """Some of a command's flags with odd values."""
    actions = parser.build()._subparsers._group_actions[0].choices[command]  # type: ignore[union-attr]
    if case is not None:
        actions = actions._subparsers._group_actions[0].choices[case]
    known = [flag for action in actions._actions for flag in action.option_strings if flag not in ("-h", "--help")]
    return [
        rng.choice(["{}={}", "{} {}"]).format(rng.choice(known), rng.choice(WORDS)).replace(" ", "\0", 1)
        if rng.random() < 0.9 else rng.choice(known)[: rng.randint(1, 12)]
        for _ in range(rng.randint(1, 3))
    ]  # fmt: skip


def _command_line(rng: random.Random, plans: dict[str, bytes]) -> tuple[list[str], dict[str, bytes]]:
    command = rng.choice(["run", "solve", "solve", "prove", "prove", "render", "report", "check", "export", "list"])
    case = rng.choice(list(CASES)) if command in ("run", "solve") else None
    flags = [part for flag in _flags(rng, command, case) for part in flag.split("\0")]
    if case is not None:
        words = [command, case, *STAGES, *SHORT.get(command, []), *flags]
    else:
        words = [
            command,
            *({"check": ["."], "list": []}.get(command, ["two-link.npz"])),
            *SHORT.get(command, []),
            *flags,
        ]
    if case is None and command != "list" and rng.random() < 0.3:
        words[1] = rng.choice(WORDS)
    if rng.random() < 0.1:
        words.insert(rng.randint(0, len(words)), rng.choice(WORDS))
    if rng.random() < 0.2:
        words.append("--json")
    return words, {"two-link.npz": plans["two-link.npz"]}


def _damaged(rng: random.Random, text: str) -> str:
    """A text with one to four damages: numbers, words and lines replaced, lost, doubled or moved, bytes changed."""
    for _ in range(rng.choice([1, 1, 1, 2, 3, 4])):
        places = list(re.finditer(r"[-+]?\d[\d.]*(?:e[-+]?\d+)?|\w+", text))
        lines = text.splitlines(keepends=True)
        what = rng.randrange(7)
        if what <= 2 and places:
            numbers = [one for one in places if one[0][-1].isdigit()] if what else places
            one = rng.choice(numbers or places)
            text = text[: one.start()] + rng.choice(rng.choice([WORDS, NUMBERS])) + text[one.end() :]
        elif what == 3 and lines:
            lines.pop(rng.randrange(len(lines)))
            text = "".join(lines)
        elif what == 4 and lines:
            lines.insert(rng.randint(0, len(lines)), rng.choice(lines) * rng.choice([1, 1, 2, 50]))
            text = "".join(lines)
        elif what == 5 and len(places) > 1:
            one, other = sorted(rng.sample(places, 2), key=lambda place: place.start())
            text = text[: one.start()] + other[0] + text[one.end() : other.start()] + one[0] + text[other.end() :]
        elif text:
            at = rng.randrange(len(text))
            text = text[:at] + rng.choice(["", "\0", "\x1b", "\n", "<", '"', "[", "}", "é", "."]) + text[at + 1 :]
    return text


def _problem_file(rng: random.Random, plans: dict[str, bytes]) -> tuple[list[str], dict[str, bytes]]:
    folder = ROOT / "examples"
    limits = (
        '\n[limits]\ncontrol = 50\nvelocity = { trolley = 3.0 }\nposition = { trolley = [-1, 3] }\nfinal = "exact"\n'
    )
    text = (folder / "crane.toml").read_text() + rng.choice(["", limits])
    files = {"p.toml": _damaged(rng, text).encode(errors="replace"), "crane.xml": (folder / "crane.xml").read_bytes()}
    return ["solve", "p.toml", "--max-iterations", "2"], files


_COSTLY = (
    '<asset><texture name="t" type="2d" builtin="flat" width="{}" height="{}"/></asset>',
    '<asset><hfield name="h" nrow="{}" ncol="{}" size="1 1 1 1"/></asset>',
    '<asset><mesh name="w" vertex="0 0 0 1 0 0 0 1 0 0 0 {}"/></asset>', '<size nuser_body="{}"/>', '<size nkey="{}"/>',
    '<size memory="{}"/>', '<option timestep="{}" gravity="0 0 {}"/>', '<compiler boundmass="{}"/>',
    '<worldbody><replicate count="{}" offset="1 0 0"><site/></replicate></worldbody>', '<statistic meansize="{}"/>',
)  # fmt: skip
_COUNTS = ("1", "2", "10", "1000", "65536", "100000", "2147483647", "1e308", "-1", "nan")


def _generated(rng: random.Random) -> str:
    """A random tree of joints, some with odd names or sizes, and some of MJCF's more costly elements."""
    names: list[str] = []

    def body(depth: int) -> str:
        joint = rng.choice(["hinge", "hinge", "slide", "ball", *(["free"] if depth == 0 else [])])
        names.append(f"j{len(names)}" + rng.choice([""] * 20 + ["&#10;PASS", "&#155;2J"]))
        name = names[-1]
        below = "".join(body(depth + 1) for _ in range(rng.randint(0, 2))) if depth < 4 else ""
        size, mass = rng.choice([".1"] * 20 + ["1e-9", "1e9", "1e200"]), rng.choice(["1"] * 20 + ["1e-9", "1e308"])
        return (
            f'<body pos="0 0 {rng.uniform(-1, 1):.2f}"><joint name="{name}" type="{joint}"/>'
            f'<geom size="{size}" mass="{mass}"/>{below}</body>'
        )

    tree = body(0)
    some = "".join(re.sub(r"\{\}", lambda _: rng.choice(_COUNTS), one) for one in _COSTLY if rng.random() < 0.06)
    return (
        f"<mujoco>{some}<worldbody>{tree}</worldbody><actuator>"
        f'<motor joint="{rng.choice(names)}" gear="{rng.choice(NUMBERS)}"/></actuator></mujoco>'
    )


def _edited(rng: random.Random, text: str) -> str:
    """A model that is still XML, with one to three numbers, attributes or elements changed."""
    root = ElementTree.fromstring(text)
    for _ in range(rng.randint(1, 3)):
        element = rng.choice(list(root.iter()))
        if element.attrib and rng.random() < 0.8:
            key = rng.choice(list(element.attrib))
            words = element.attrib[key].split()
            if words and rng.random() < 0.9:
                words[rng.randrange(len(words))] = rng.choice(NUMBERS)
            element.set(key, " ".join(words) if words else rng.choice(NUMBERS))
        elif len(element):
            child = rng.choice(list(element))
            if rng.random() < 0.5:
                element.remove(child)
            else:
                rng.choice(list(root.iter())).append(copy.deepcopy(child))
    return ElementTree.tostring(root, encoding="unicode")


def _model(rng: random.Random, plans: dict[str, bytes]) -> tuple[list[str], dict[str, bytes]]:
    way = rng.random()
    text = _generated(rng) if way < 0.35 else model_text(rng.choice(MODELS))
    if way > 0.35:
        text = _edited(rng, text) if way < 0.85 else _damaged(rng, text)
    return ["solve", "p.toml", "--max-iterations", "2"], {
        "p.toml": PROBLEM.encode(),
        "model.xml": text.encode(errors="replace"),
    }


def _replaced(rng: random.Random, value: Any) -> Any:
    """A JSON value with one part replaced by something odd."""
    if isinstance(value, (dict, list)) and value and rng.random() < 0.85:
        key = rng.choice(list(value) if isinstance(value, dict) else range(len(value)))
        changed = dict(value) if isinstance(value, dict) else list(value)
        changed[key] = _replaced(rng, changed[key])
        return changed
    return rng.choice([None, True, [], {}, "", "x", -1, 0, 1, 1e308, 10**400, [1], {"a": 1}, "9" * 3000, "\x1b[2J"])


def _plan_file(rng: random.Random, plans: dict[str, bytes]) -> tuple[list[str], dict[str, bytes]]:
    content = plans[rng.choice(["two-link.npz", "crane.npz"])]
    if rng.random() < 0.3:
        changed = bytearray(content)
        for _ in range(rng.randint(1, 20)):
            changed[rng.randrange(len(changed))] = rng.randrange(256)
        content = bytes(changed[: rng.choice([len(changed), rng.randrange(len(changed))])])
    else:
        with np.load(io.BytesIO(content), allow_pickle=False) as file:
            arrays = {name: np.array(file[name]) for name in file.files}
        if rng.random() < 0.7:
            meta = _replaced(rng, json.loads(str(arrays["meta"])))
            if isinstance(meta, dict) and isinstance(meta.get("mjcf"), str) and rng.random() < 0.4:
                meta["mjcf"] = _damaged(rng, meta["mjcf"]).encode(errors="replace").decode()
            arrays["meta"] = np.array(json.dumps(meta))
        else:
            name = rng.choice([name for name in arrays if name != "meta"])
            values = arrays[name].copy()
            if values.size and values.dtype == np.float64:
                values.flat[rng.randrange(values.size)] = rng.choice([np.nan, np.inf, 1e30, -1e308, 1e-308, 0.0, 1e15])
            arrays[name] = rng.choice([values, values, values.T, values[:-1], values[None]])
        stream = io.BytesIO()
        np.savez_compressed(stream, **arrays)  # type: ignore[arg-type]
        content = stream.getvalue()
    return ["prove", "plan.npz", "--rollouts", "2"], {"plan.npz": content}


def _proof_file(rng: random.Random, plans: dict[str, bytes]) -> tuple[list[str], dict[str, bytes]]:
    text = plans["proof.json"].decode()
    text = json.dumps(_replaced(rng, json.loads(text))) if rng.random() < 0.7 else _damaged(rng, text)
    return ["check", "."], {"plan.npz": plans["two-link.npz"], "proof.json": text.encode(errors="replace")}


def _gait_file(rng: random.Random, plans: dict[str, bytes]) -> tuple[list[str], dict[str, bytes]]:
    text = _damaged(rng, plans["gait.csv"].decode())
    return ["solve", "human-step", "--horizon", "60", "--max-iterations", "1", "--reference", "gait.csv"], {
        "gait.csv": text.encode(errors="replace")
    }


Make = Callable[[random.Random, dict[str, bytes]], tuple[list[str], dict[str, bytes]]]
KINDS: dict[str, Make] = {
    "command line": _command_line, "problem file": _problem_file, "model": _model, "plan file": _plan_file,
    "proof file": _proof_file, "model again": _model, "gait": _gait_file, "command line again": _command_line,
}  # fmt: skip
