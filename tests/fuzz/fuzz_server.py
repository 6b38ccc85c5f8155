"""Run commands on odd inputs, each in a fork of this process with limits of time and memory, and say what broke.

python tests/fuzz/fuzz_server.py --seed 1 --count 1000
python tests/fuzz/fuzz_server.py --seed 1 --only 437 --keep      # the same input again; its folder stays
"""

from __future__ import annotations

import argparse
import contextlib
import os
import re
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
from pathlib import Path

if __name__ == "__main__":
    sys.path[:0] = [str(Path(__file__).parents[2]), str(Path(__file__).parents[1])]

import numpy as np
from fuzz_inputs import Case, case_of
from places import ROOT

from planner.__main__ import main
from planner.cases.human_step.gait import ANGLES, NORMAL_GAIT

SECONDS = 60.0
MEMORY = 5 * 2**30  # bytes beside those of the server: two for a model that is compiled, the others for what follows
_WARNING = re.compile(rb"Traceback|Warning:|Error:.*\n  File|Fatal Python error")


def sound_files(folder: Path) -> dict[str, bytes]:
    """Small plans, a proof and a gait to damage; making them loads every kernel that the children need."""
    words = ["--max-iterations", "2", "--quiet"]
    for name in ("crane.toml", "crane.xml"):
        shutil.copy(ROOT / "examples" / name, folder)
    _quietly(["solve", "two-link", "--horizon", "8", "--out", str(folder / "two-link.npz"), *words])
    _quietly(["solve", str(folder / "crane.toml"), "--out", str(folder / "crane.npz"), *words])
    _quietly(["solve", "hopper", "--horizon", "8", "--out", str(folder / "hopper.npz"), *words])
    _quietly(["prove", str(folder / "two-link.npz"), "--rollouts", "0", "--out", str(folder / "proof.json")])
    (folder / "gait.csv").write_text(_gait())
    _quietly(["solve", "human-step", "--horizon", "60", "--reference", str(folder / "gait.csv"),
              "--out", str(folder / "step.npz"), *words])  # fmt: skip
    names = ("two-link.npz", "crane.npz", "proof.json", "gait.csv")
    return {name: (folder / name).read_bytes() for name in names}


def _gait() -> str:
    """The normal gait as a file of measured angles, degrees."""
    percent = np.arange(0.0, 101.0, 4.0)
    rows = np.column_stack([percent, np.degrees(NORMAL_GAIT.angles(percent / 100.0)[0])])
    header = ",".join(["percent", *(f"{name}_deg" for name in ANGLES)])
    return "\n".join([header, *(",".join(f"{value:.6g}" for value in row) for row in rows)]) + "\n"


def _quietly(words: list[str]) -> None:
    with open(os.devnull, "w") as nowhere, contextlib.redirect_stdout(nowhere), contextlib.redirect_stderr(nowhere):
        code = main(words)
    if code not in (0, 1):
        raise RuntimeError(f"exit code {code} of {words}")


def broken(case: Case, status: int, seconds: float, folder: Path) -> str:
    """In words, how a command broke; "" where it did not. `status` is waitpid's, -1 for a command that hung."""
    errors, output = ((folder / name).read_bytes() for name in (".stderr", ".stdout"))
    if status == -1:
        return f"hangs for more than {seconds:.0f} s"
    if os.WIFSIGNALED(status):
        return f"ended by signal {os.WTERMSIG(status)}"
    code, lines = os.WEXITSTATUS(status), [line for line in errors.decode(errors="replace").splitlines() if line]
    if _WARNING.search(errors) or code not in (0, 1, 2):
        return f"exit code {code}: {' | '.join(lines[-3:])[-600:]}"
    if code == 2 and not (lines and lines[-1].startswith("planner: ") and lines[-1].endswith((".", "?", "!"))):
        return f"exit code 2 without a sentence: {lines[-3:]}"
    if code == 2 and len(lines[-1]) > 1200:
        return f"a sentence of {len(lines[-1])} characters"
    if any(character in errors + output for character in b"\x1b\0"):
        return "a terminal's escape is printed"
    left = [path.name for path in folder.rglob(".planner-*")]
    return f"leaves {left}" if left else ""


def _start(case: Case, folder: Path) -> int:
    """Write the files of a case and run it in a fork; returns the process."""
    for name, content in case.files.items():
        (folder / name).write_bytes(content)
    child = os.fork()
    if child:
        return child
    code = 99
    try:
        os.chdir(folder)
        os.setpgid(0, 0)
        for number, name in ((1, ".stdout"), (2, ".stderr")):
            os.dup2(os.open(name, os.O_CREAT | os.O_WRONLY), number)
        sys.stdout, sys.stderr = open(1, "w", closefd=False), open(2, "w", closefd=False)  # noqa: SIM115
        with open("/proc/self/statm") as sizes:
            now = int(sizes.read().split()[0]) * os.sysconf("SC_PAGE_SIZE")
        resource.setrlimit(resource.RLIMIT_AS, (now + MEMORY, resource.RLIM_INFINITY))
        try:
            code = main(case.words)
        except SystemExit as left:
            code = int(left.code or 0)
        except BaseException:
            traceback.print_exc()
        sys.stdout.flush()
        sys.stderr.flush()
    finally:
        os._exit(code)


def fuzz(seed: int, which: range, place: Path, jobs: int = 2, keep: bool = False) -> list[str]:
    """Run inputs, several at a time; returns a line for each that broke something."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    plans = sound_files(place)
    waiting, running, found = iter(which), {}, []
    spent: dict[str, list[tuple[float, int]]] = {}
    k = next(waiting, None)
    while k is not None or running:
        if k is not None and len(running) < jobs:
            case, folder = case_of(seed, k, plans), place / str(k)
            folder.mkdir()
            running[_start(case, folder)] = (k, case, folder, time.monotonic())
            k = next(waiting, None)
            continue
        time.sleep(0.002)
        for process, (number, case, folder, began) in list(running.items()):
            seconds = time.monotonic() - began
            ended, status = os.waitpid(process, os.WNOHANG)
            if not ended and seconds < SECONDS:
                continue
            if not ended:
                os.kill(process, signal.SIGKILL)
                os.waitpid(process, 0)
                status = -1
            del running[process]
            spent.setdefault(case.kind, []).append((seconds, status))
            how = broken(case, status, seconds, folder)
            if how:
                words = " ".join(word if len(word) < 80 else f"{word[:40]}...({len(word)})" for word in case.words)
                again = f"python tests/fuzz/fuzz_server.py --seed {seed} --only {number} --keep"
                found.append(f"{case.kind} {number}: {words!r} {how}\n    again: {again}")
            if not keep:
                shutil.rmtree(folder, ignore_errors=True)
    for kind, rows in spent.items():
        times, codes = zip(*rows, strict=True)
        ends = ", ".join(f"{codes.count(code << 8)} with {code}" for code in (0, 1, 2))
        print(f"{kind}: {len(rows)} inputs ({ends}), {sum(times):.1f} s, longest {max(times):.1f} s")
    return found


if __name__ == "__main__":
    flags = argparse.ArgumentParser(description=__doc__)
    flags.add_argument("--seed", type=int, default=1)
    flags.add_argument("--count", type=int, default=100)
    flags.add_argument("--jobs", type=int, default=2)
    flags.add_argument("--only", type=int)
    flags.add_argument("--keep", action="store_true")
    asked = flags.parse_args()
    which = range(asked.count) if asked.only is None else range(asked.only, asked.only + 1)
    place = Path(tempfile.mkdtemp(prefix="fuzz-"))
    began = time.monotonic()
    found = fuzz(asked.seed, which, place, asked.jobs, asked.keep)
    print(*found, sep="\n")
    print(f"{len(which)} inputs in {time.monotonic() - began:.0f} s, {len(found)} of them broke something; {place}")
    if not asked.keep:
        shutil.rmtree(place)
    sys.exit(bool(found))
