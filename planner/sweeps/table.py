"""The table of a sweep: table.csv, and table.parquet where pyarrow is installed, a row a task, by its number.

Columns: task, the parameters, then status, cost and so on, the figures of a proof as STEP.NAME by the alphabet, and
last the times. But for the times the table depends on nothing but the sweep: not on the number of workers, nor on which
of them was killed. Rows pass through one at a time.
"""

from __future__ import annotations

import csv
import importlib
import importlib.util
from collections.abc import Iterable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any

from planner.base.files import write_atomically
from planner.sweeps.store import TIMES, Store

CSV, PARQUET = "table.csv", "table.parquet"
_FIRST = ("status", "cost", "iterations", "gradient_norm", "guess", "start")
_PROOF = ("verdict", "mode", "feasible", "optimal", "robustness")
_LAST = ("reason", "proof_reason", "plan")
_HIDDEN = {"print"}
_ROWS = 10_000  # of a part of the Parquet file


def columns_of(store: Store, parameters: Iterable[str]) -> list[str]:
    """The names of all columns, in order."""
    first = ["task", *parameters, *_FIRST]
    here = [name for name in _PROOF if name in store.kinds]
    last = [*(name for name in _LAST if name in store.kinds or name != "proof_reason"), *TIMES[: 1 + bool(here)]]
    figures = sorted(set(store.kinds) - set(first) - set(_PROOF) - set(_LAST) - set(TIMES) - _HIDDEN)
    return [*first, *here, *figures, *last]


def write_tables(store: Store, parameters: Iterable[str]) -> list[Path]:
    """Write the tables of what is finished; the files written.

    Raises:
        FileError: One cannot be written.
    """
    columns = columns_of(store, parameters)
    paths = [store.folder / CSV]
    with write_atomically(paths[0]) as hidden, open(hidden, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows([_text(row.get(name)) for name in columns] for row in store.rows())
    if has_parquet():
        paths.append(store.folder / PARQUET)
        with write_atomically(paths[1]) as hidden:
            _write_parquet(hidden, store, columns)
    return paths


def has_parquet() -> bool:
    """Whether pyarrow is installed."""
    return importlib.util.find_spec("pyarrow") is not None


def _text(value: Any) -> Any:
    """A value of the CSV: numbers with all their digits."""
    return repr(value) if isinstance(value, float) else "" if value is None else value


def _write_parquet(path: Path, store: Store, columns: list[str]) -> None:
    arrow: Any = importlib.import_module("pyarrow")
    parquet: Any = importlib.import_module("pyarrow.parquet")
    types = {"bool": arrow.bool_(), "int": arrow.int64(), "float": arrow.float64()}
    kinds = {name: _kind(store.kinds.get(name, {"str"})) for name in columns}
    schema = arrow.schema([(name, types.get(kind, arrow.string())) for name, kind in kinds.items()])
    with parquet.ParquetWriter(path, schema) as writer:
        for rows in _parts(store.rows()):
            cast = [{name: _cast(row.get(name), kind) for name, kind in kinds.items()} for row in rows]
            writer.write_table(arrow.Table.from_pylist(cast, schema=schema))


def _kind(names: set[str]) -> str:
    """The one type that holds values of some."""
    names = names - {"NoneType"}
    if len(names) == 1:
        return next(iter(names))
    return "float" if names == {"int", "float"} else "str"


def _cast(value: Any, kind: str) -> Any:
    return None if value is None else float(value) if kind == "float" else str(value) if kind == "str" else value


def _parts(rows: Iterator[dict[str, Any]]) -> Iterator[list[dict[str, Any]]]:
    while part := list(islice(rows, _ROWS)):
        yield part
