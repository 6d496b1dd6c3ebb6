"""Tables: records with values under labels as columns of numbers, written to Parquet."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import Any

from symgraph.errors import InputError, MissingExtraError
from symgraph.learned.storage import replace_file

Groups = Mapping[str, Mapping[str, Any]]  # {prefix: {label: number, 1-D array or string}}


def write_table(
    path: str | os.PathLike[str], fixed: Mapping[str, tuple[str, list[Any]]], rows: Sequence[Groups]
) -> None:
    """Write columns to a Parquet file, or replace one once all is written.

    Args:
        path: of the file.
        fixed: {name: (Arrow's name of its type, a cell per row)} of the columns that every table has.
        rows: the values of each row; each element gets a column of its own, null where a row lacks it.

    Raises:
        StorageError: the file cannot be written.
        InputError: two labels lead to one column.
        MissingExtraError: pyarrow is not installed.
    """
    arrow, parquet = _import_arrow()
    columns = {name: arrow.array(cells, type=kind) for name, (kind, cells) in fixed.items()}
    for name, cells in _spread(rows).items():
        columns[name] = arrow.array(cells, type=_kind(cells))
    table = arrow.table(columns)
    replace_file(path, lambda file: parquet.write_table(table, file))


def _spread(rows: Sequence[Groups]) -> dict[str, list[Any]]:
    """Return a column for each element under each label, sorted by prefix in the order of their first appearance."""
    found: dict[str, dict[tuple[str, int | None], list[Any]]] = {}
    for at, groups in enumerate(rows):
        for prefix, values in groups.items():
            columns = found.setdefault(prefix, {})
            for label, value in values.items():
                cells = [(None, value)] if isinstance(value, (float, str)) else enumerate(value.tolist())
                for element, cell in cells:
                    column = columns.get((label, element))
                    if column is None:
                        column = columns[label, element] = [None] * len(rows)
                    column[at] = cell
    spread: dict[str, list[Any]] = {}
    for prefix, columns in found.items():
        for (label, element), column in columns.items():
            name = f"{prefix}.{label}" if element is None else f"{prefix}.{label}[{element}]"
            if name in spread:
                raise InputError(
                    f"two labels lead to the column {name!r}: {label!r} and another that differs by the brackets"
                )
            spread[name] = column
    return spread


def _kind(cells: list[Any]) -> str:
    return "string" if any(isinstance(cell, str) for cell in cells) else "float64"


def _import_arrow() -> tuple[Any, Any]:
    try:
        import pyarrow as pa
        import pyarrow.parquet as parquet
    except ImportError as error:
        raise MissingExtraError("pyarrow", "learned", "exporting a store to Parquet") from error
    return pa, parquet
