"""How many files of `planner/` a reader passes through: those whose functions are entered on four trips of a small arm.

`python benchmarks/trips.py [--files] [--rollouts N]`:

    run      all of `planner run reach.toml --no-video` for an arm of two joints
    prove    prove() of a plan that is solved already
    read     Mechanism.from_mjcf and RigidBodyDynamics
    solve    solve() of the loaded problem

Each trip has a process of its own and counts what its imports run, too. Kernels run compiled and are not counted.
`--sizes` counts the whole tree instead.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import inspect
import io
import multiprocessing
import sys
import tempfile
import threading
import tokenize
from concurrent.futures import ProcessPoolExecutor
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from types import CodeType, FrameType

PACKAGE = Path(str(find_spec("planner").origin)).parent  # found, not imported: a trip does that
TESTS = Path(__file__).parent.parent / "tests"
TARGETS = {"run": "110", "prove": "55", "read": "30", "solve": ""}  # files
NO_CODE = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER}
ARM = """<mujoco><worldbody><body pos="0 0 1">
  <joint name="shoulder" axis="0 -1 0" damping="0.1"/><geom type="capsule" fromto="0 0 0 0.4 0 0" size="0.03" mass="1"/>
  <body pos="0.4 0 0">
    <joint name="elbow" axis="0 -1 0" damping="0.1"/><geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02" mass="1"/>
  </body></body></worldbody>
  <actuator><motor joint="shoulder" ctrlrange="-30 30"/><motor joint="elbow" ctrlrange="-15 15"/></actuator>
  <keyframe><key name="home" qpos="0 0"/></keyframe></mujoco>"""
REACH = 'model = "arm.xml"\nstart = "home"\ngoal = { elbow = 1.0 }\nduration = 1.5\n'


def watch() -> dict[int, CodeType]:
    """The code that is entered from now on, in all threads, until the process ends."""
    entered: dict[int, CodeType] = {}
    if sys.version_info >= (3, 12):
        watching, start = sys.monitoring, sys.monitoring.events.PY_START

        def begin(code: CodeType, _: int) -> object:
            entered[id(code)] = code
            return watching.DISABLE  # once is enough

        watching.use_tool_id(watching.PROFILER_ID, "trips")
        watching.register_callback(watching.PROFILER_ID, start, begin)
        watching.set_events(watching.PROFILER_ID, start)
    else:

        def call(frame: FrameType, event: str, _: object) -> None:
            if event == "call":
                entered[id(frame.f_code)] = frame.f_code

        threading.setprofile(call)
        sys.setprofile(call)
    return entered


def travel(trip: str, rollouts: int = 0) -> dict[str, int]:
    """The files that a trip enters, and of each how many functions, without lambdas and comprehensions."""
    with tempfile.TemporaryDirectory() as place, contextlib.redirect_stdout(io.StringIO()) as said:
        arm, reach = Path(place, "arm.xml"), Path(place, "reach.toml")
        arm.write_text(ARM, encoding="utf-8")
        reach.write_text(REACH, encoding="utf-8")
        with contextlib.redirect_stderr(said):
            import planner

            problem = planner.load_problem(reach) if trip in ("prove", "solve") else None
            plan, prove = (planner.solve(problem), planner.prove) if trip == "prove" else (None, None)
            entered = watch()
            if trip == "run":
                words = ["run", str(reach), "--no-video", "--rollouts", str(rollouts), "--out", f"{place}/out"]
                result = import_module("planner.__main__").main(words)
            elif trip == "read":
                result = planner.dynamics.RigidBodyDynamics(planner.Mechanism.from_mjcf(arm), dt=0.01)
            else:
                result = planner.solve(problem) if plan is None else prove(plan, rollouts=rollouts)
            codes = list(entered.values())
    if (trip == "run" and result != 0) or (trip == "prove" and not result.passed):
        raise RuntimeError(f"the trip {trip} went wrong:\n{said.getvalue()}")
    files: dict[str, set[tuple[str, int]]] = {}
    for code in codes:
        if PACKAGE in Path(code.co_filename).parents and code.co_flags & inspect.CO_OPTIMIZED:  # no module, no class
            name = code.co_qualname, code.co_firstlineno
            files.setdefault(code.co_filename, set()).update([] if code.co_name[0] == "<" else [name])
    return {file: len(functions) for file, functions in sorted(files.items())}


def code_lines(text: str) -> int:
    """Lines with more than a comment or a docstring (any string that is a statement)."""
    strings = [node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Expr)]
    strings = [node for node in strings if isinstance(getattr(node.value, "value", None), str)]
    tokens = [one for one in tokenize.generate_tokens(io.StringIO(text).readline) if one.type not in NO_CODE]
    lines = {line for token in tokens for line in range(token.start[0], token.end[0] + 1)}
    return len(lines.difference(*(range(node.lineno, node.end_lineno + 1) for node in strings)))


def described(node: ast.AST, found: dict[str, list[bool]]) -> None:
    """Note of a module, and of its public classes, functions and methods, whether they have a docstring."""
    kind = {ast.Module: "modules", ast.ClassDef: "classes"}.get(type(node), "functions")
    found.setdefault(kind, []).append(bool(ast.get_docstring(node)))
    for child in node.body if kind != "functions" else []:
        if not getattr(child, "name", "_").startswith("_"):
            described(child, found)


def show_sizes() -> None:
    """Print files, lines and code of each folder, and how much of what is public has a docstring."""
    print(f"{'':<12}{'files':>8}{'lines':>8}{'code':>8}   (code: lines without comments and docstrings)")
    for folder in [PACKAGE, *sorted({path.parent for path in PACKAGE.glob("*/*.py")}), TESTS]:
        texts = [path.read_text(encoding="utf-8") for path in folder.rglob("*.py")]
        lines, code = sum(len(text.splitlines()) for text in texts), sum(map(code_lines, texts))
        print(f"{'  ' * (folder.parent == PACKAGE) + folder.name:<12}{len(texts):8}{lines:8}{code:8}")
    found: dict[str, list[bool]] = {}
    for path in PACKAGE.rglob("*.py"):
        described(ast.parse(path.read_text(encoding="utf-8")), found)
    shares = [f"{kind} {100 * sum(has) / len(has):.1f} % of {len(has)}" for kind, has in sorted(found.items())]
    print(f"Docstrings of what is public: {', '.join(shares)}.")


def main() -> None:
    """Make the trips and print them, or the sizes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--files", action="store_true", help="name the files")
    parser.add_argument("--rollouts", type=int, default=0, help="perturbed simulations of run and prove, 0 by default")
    parser.add_argument("--sizes", action="store_true", help="files and lines of the tree instead")
    asked = parser.parse_args()
    if asked.sizes:
        return show_sizes()
    fresh = ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), max_tasks_per_child=1)
    fresh.submit(travel, "prove").result()  # compiles what there is to compile, and is not counted
    trips = {trip: fresh.submit(travel, trip, asked.rollouts) for trip in TARGETS}
    print(f"{'':<12}{'files':>8}{'target':>8}{'lines':>8}{'functions':>11}")
    for trip, future in trips.items():
        files = future.result()
        lines = sum(len(Path(file).read_text(encoding="utf-8").splitlines()) for file in files)
        print(f"{trip:<12}{len(files):8}{TARGETS[trip]:>8}{lines:8}{sum(files.values()):11}", flush=True)
        for file in files if asked.files else []:
            print(f"    {Path(file).relative_to(PACKAGE)}")
    return None


if __name__ == "__main__":
    main()
