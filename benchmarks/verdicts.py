"""Judge prove() by a corpus of right and wrong plans: none right may FAIL, none wrong may PASS.

    python benchmarks/verdicts.py [--seed 0] [--anew N] [--fast] [--part 1/4] [--only WORDS]

Every other member has a seed that is drawn anew at each run, and printed: --anew repeats it. Parts of a run with the
same seeds add up to it. The plans are made by seed
(tests/corpus): right ones are those that SciPy's DOP853 repeats at 1e-10 on the readable twin, with gains at 500 Hz
where they need them, and that end at their goals; wrong ones have a fault that was planted. A right plan that DOP853
does not confirm counts as neither, and is shown. A wrong plan may be refused, too.
"""

import argparse
import os
import secrets
import sys
import time
from pathlib import Path

sys.path[:0] = [str(Path(__file__).resolve().parents[1] / "tests"), str(Path(__file__).resolve().parents[1])]

import numpy as np  # noqa: E402 (the corpus is with the tests)
from corpus import decide, right, wrong  # noqa: E402

import planner  # noqa: E402

FAST = 6  # every so many members


def said_of(plan: planner.Plan, options: dict) -> tuple[bool, str]:
    """Whether prove() says PASS, and its headline and reason."""
    proof = planner.prove(plan, rollouts=0, **options)
    return proof.passed, f"{proof.headline}: {proof.reason}"


def judge_right(name: str, seed: int) -> tuple[bool | None, str]:
    """Whether prove() agrees that a plan is right; None where DOP853 does not say that it is."""
    with np.errstate(all="ignore"):
        plan = right.plan_of(name, seed)
        why = decide.why_wrong(plan)
    if why:
        return None, why
    try:
        return said_of(plan, {})
    except planner.PlannerError as error:
        return False, f"refused: {error}"


def judge_wrong(name: str, seed: int) -> tuple[bool, str]:
    """Whether prove() agrees that a plan is wrong."""
    try:
        with np.errstate(all="ignore"):
            plan, options = wrong.attempt_of(name, seed)
            passed, said = said_of(plan, options)
    except planner.PlannerError as error:
        return True, f"refused: {error}"
    return not passed, said


def main(arguments: list[str] | None = None) -> int:
    """Count, and print every disagreement."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=0, help="of the machines and motions (default 0)")
    parser.add_argument("--anew", type=int, help="seed of every other member (default: drawn at each run)")
    parser.add_argument("--fast", action="store_true", help=f"one in {FAST} of the members")
    parser.add_argument("--part", default="1/1", help="e.g. 2/4: every fourth member, from the second on")
    parser.add_argument("--only", default="", help="members whose names have these words")
    parser.add_argument("--verbose", action="store_true", help="print what is said of every member")
    given = parser.parse_args(arguments)
    anew = secrets.randbelow(2**31) if given.anew is None else given.anew
    part, parts = map(int, given.part.split("/"))
    print(f"seeds {given.seed} and {anew}, part {given.part}", flush=True)
    began, counts, undecided = time.perf_counter(), [], 0
    for corpus, judge, wrongly in ((right, judge_right, "FAIL"), (wrong, judge_wrong, "PASS")):
        names = [name for name in corpus.MEMBERS if given.only in name][:: FAST if given.fast else 1]
        drawn = [(name, anew if number % 2 else given.seed) for number, name in enumerate(names)]
        judged = disagreements = 0
        kind = corpus.__name__.rpartition(".")[2]
        for name, seed in drawn[part - 1 :: parts]:
            agrees, said = judge(name, seed)
            judged += agrees is not None
            undecided += agrees is None
            disagreements += agrees is False
            if given.verbose or not agrees:
                mark = {True: "agrees", False: "DISAGREES", None: "not decided"}[agrees]
                print(f"{kind}, {mark}: {name} (seed {seed}): {said}", flush=True)
        counts.append((disagreements, f"{kind}: {disagreements} of {judged} {wrongly}"))
    print(f"{'; '.join(text for _, text in counts)} (seeds {given.seed} and {anew}, {undecided} not decided, "
          f"{time.perf_counter() - began:.0f} s)")  # fmt: skip
    return int(any(number for number, _ in counts))


if __name__ == "__main__":
    os.environ.setdefault("PYTHONWARNINGS", "ignore")
    raise SystemExit(main())
