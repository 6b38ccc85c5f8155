"""The command `paper`: the paper's numbers beside ours. A FAIL is a result: exit code 0 if all was computed."""

from __future__ import annotations

import argparse
import os
import signal
import tomllib
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

from planner.base.data_files import json_text
from planner.base.environment import processors
from planner.base.errors import PlannerError
from planner.base.files import read_text, staged_folder
from planner.cli.console import Console
from planner.paper.studies.page import STUDIES, Finished, Store, chosen, complete, page, run_studies, table_rows
from planner.paper.studies.proof_table import proofs, proofs_markdown
from planner.paper.studies.study import Study
from planner.sweeps.processes import executor_of

PAGE, NUMBERS = "paper-results.md", "paper-results.json"


def paper(arguments: argparse.Namespace, console: Console) -> int:
    """Compute, draw and write the paper's numbers beside ours."""
    if arguments.proofs and arguments.studies:
        raise PlannerError(f"--proofs is given with {arguments.studies[0]}, expected --proofs or names of studies.")
    with _stoppable():
        if arguments.proofs:
            return _proofs(Path(arguments.out or "renders/paper"), console)
        if arguments.studies:
            few = executor_of(arguments.workers, arguments.scheduler)
            return _some(arguments.studies, Path(arguments.out or "renders/paper"), few, console, arguments.full)
        workers = arguments.workers
        if workers is None and arguments.scheduler is None and processors() > 1:
            workers = processors()
        places = _places(arguments.out, arguments.full)
        return _all(*places, executor_of(workers, arguments.scheduler), console, arguments.full)


def _places(out: str | None, full: bool) -> tuple[Path, Path]:
    """Folders of the page and of its pictures and numbers; the documents have the full ones."""
    if out is None and full and _in_checkout():
        return Path("docs"), Path("renders", "gallery", "paper")
    return Path(out or "paper"), Path(out or "paper")


def _in_checkout() -> bool:
    """Whether the current folder is a checkout of this project."""
    if not (Path("pyproject.toml").is_file() and Path("docs").is_dir() and Path("renders").is_dir()):
        return False
    try:
        project = tomllib.loads(read_text("pyproject.toml", "the project")).get("project", {})
    except (PlannerError, tomllib.TOMLDecodeError):
        return False
    return isinstance(project, dict) and project.get("name") == "slq-planner"


def _all(
    at: Path, pictures: Path, executor: AbstractContextManager[Executor | None], console: Console, full: bool
) -> int:
    """The whole page. If it is stopped, the next one goes on after the studies that were finished."""
    store = Store(pictures / ".unfinished", full)
    files = _files(STUDIES)
    with staged_folder(pictures, [*files, NUMBERS]) as shown, staged_folder(at, [PAGE]) as text:
        with executor as pool:
            done = run_studies(STUDIES, shown, console.write_progress, pool, full=full, store=store)
        rows = table_rows(done)
        way = "" if at == pictures else f"{Path(os.path.relpath(pictures, at)).as_posix()}/"
        (text / PAGE).write_text(page(done, rows, way, full), encoding="utf-8")
        for one in done:
            _write_results(one, shown)
        studies = {one.study.name: {"seconds": one.seconds, "problem": one.problem} for one in done}
        summary = {"rows": [row._asdict() for row in rows], "studies": studies}
        (shown / NUMBERS).write_text(json_text(summary), encoding="utf-8")
    store.drop()
    code = 0 if complete(done, rows) else 1
    console.table(("where", "the paper says", "we get"), [row[:3] for row in rows])
    console.write_result(f"{at / PAGE}: {len(rows)} rows; {pictures}: {', '.join([*files, NUMBERS])}")
    names = [str(at / PAGE), *(str(pictures / name) for name in (*files, NUMBERS))]
    return console.finish("paper", code, **summary, files=names)


def _some(
    names: list[str], folder: Path, executor: AbstractContextManager[Executor | None], console: Console, full: bool
) -> int:  # fmt: skip
    """Some studies, each with a page of its own."""
    studies = chosen(names)
    files = _files(studies)
    with staged_folder(folder, files) as staged:
        with executor as pool:
            done = run_studies(studies, staged, console.write_progress, pool, full=full)
        for one in done:
            _write_results(one, staged)
            if one.results is None:
                raise PlannerError(f"the study {one.study.name} failed: {one.problem}")
            console.write_result(one.study.page(one.results))
    console.write_result(f"{folder}: {', '.join(files)}")
    results: dict[str, Any] = {one.study.name: one.results for one in done}
    alone = (done[0].results or {}) if len(done) == 1 else {}
    rows = table_rows(done)
    document = {**alone, "studies": results, "rows": [row._asdict() for row in rows]}
    document |= {"folder": str(folder), "files": files}
    return console.finish("paper", 0 if complete(done, rows) else 1, **document)


def _files(studies: Sequence[Study]) -> list[str]:
    """What studies write."""
    return [name for study in studies for name in (f"{study.name}.md", f"{study.name}.json", *study.pictures)]


def _write_results(one: Finished, folder: Path) -> None:
    """The results of a study as numbers and as a page of its own."""
    if one.results is not None:
        (folder / f"{one.study.name}.md").write_text(one.study.page(one.results), encoding="utf-8")
        (folder / f"{one.study.name}.json").write_text(json_text(one.results), encoding="utf-8")


class _Stop(BaseException):
    """Ctrl-C during a study: a solve does not catch it, because an interrupted plan would be a wrong number."""


@contextmanager
def _stoppable() -> Iterator[None]:
    """Make Ctrl-C end the command, not only the running solve."""

    def stop(number: int, frame: FrameType | None) -> None:
        raise _Stop

    before = signal.signal(signal.SIGINT, stop)
    try:
        yield
    except _Stop:
        raise KeyboardInterrupt from None
    finally:
        signal.signal(signal.SIGINT, before)


def _proofs(folder: Path, console: Console) -> int:
    """The table of proofs, PASS and FAIL."""
    names = ("proofs.md", "proofs.json")
    with staged_folder(folder, names) as staged:
        rows = proofs(progress=lambda name: console.write_progress(f"planning and proving {name}"))
        text = proofs_markdown(rows)
        (staged / "proofs.md").write_text(text, encoding="utf-8")
        (staged / "proofs.json").write_text(json_text({"proofs": rows}), encoding="utf-8")
    console.write_result(text)
    console.write_result(f"{folder}: {', '.join(names)}")
    return console.finish("paper", 0, proofs=rows, folder=str(folder), files=list(names))
