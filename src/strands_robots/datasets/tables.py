"""Arrow tables of a dataset: frames, the row of an episode, tasks."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from strands_robots.datasets.layout import DatasetError, Feature, replaced
from strands_robots.datasets.statistics import Statistics
from strands_robots.utils import optional_module

STATS = "stats"
TASK_COLUMN = "task"

FILE_ROWS_MAX = 10_000_000
"""Most rows of a file that is read."""


def pyarrow() -> Any:
    """Return pyarrow.

    Raises:
        MissingExtraError: the [dataset] extra is not installed.
    """
    optional_module("pyarrow.parquet", what="A dataset", extra="dataset")
    return optional_module("pyarrow", what="A dataset", extra="dataset")


def write_frames(path: Path, features: Mapping[str, Feature], columns: Mapping[str, NDArray[Any]]) -> None:
    """Write the data file of an episode, whole or not at all."""
    pa = pyarrow()
    fields, arrays, stated = [], [], {}
    for name, feature in features.items():
        width = feature.shape[0]
        kind = pa.bool_() if feature.dtype == "bool" else getattr(pa, feature.dtype)()
        value = {"dtype": feature.dtype, "_type": "Value"}
        flat = pa.array(np.asarray(columns[name], dtype=feature.dtype).ravel(), type=kind)
        stated[name] = value if width == 1 else {"feature": value, "length": width, "_type": "List"}
        fields.append(pa.field(name, kind if width == 1 else pa.list_(kind, width)))
        arrays.append(flat if width == 1 else pa.FixedSizeListArray.from_arrays(flat, width))
    about = {"huggingface": json.dumps({"info": {"features": stated}})}
    _write(path, pa.Table.from_arrays(arrays, schema=pa.schema(fields, metadata=about)))


def write_episode(path: Path, row: Mapping[str, Any], statistics: Mapping[str, Statistics]) -> None:
    """Write the row of an episode, with its statistics."""
    pa = pyarrow()
    stats = {f"{STATS}/{key}/{name}": each.tolist() for key, of in statistics.items() for name, each in of.items()}
    _write(path, pa.table({name: [value] for name, value in (*row.items(), *stats.items())}))


def write_tasks(path: Path, tasks: Sequence[str]) -> None:
    """Write the tasks, each with its index, which pandas reads by their text."""
    pa = pyarrow()
    about = {
        "index_columns": [TASK_COLUMN],
        "column_indexes": [],
        "columns": [
            {"name": "task_index", "field_name": "task_index", "pandas_type": "int64", "numpy_type": "int64"},
            {"name": TASK_COLUMN, "field_name": TASK_COLUMN, "pandas_type": "unicode", "numpy_type": "object"},
        ],
        "pandas_version": "2.3.3",
    }
    table = pa.table({"task_index": pa.array(range(len(tasks)), pa.int64()), TASK_COLUMN: pa.array(tasks, pa.string())})
    _write(path, table.replace_schema_metadata({"pandas": json.dumps(about)}))


def read_tasks(path: Path) -> list[str]:
    """Return the tasks in the order of their indices.

    Raises:
        DatasetError: the file cannot be read.
    """
    rows = _read(path)
    if "task_index" not in rows:
        raise DatasetError(f"{path} has no column task_index")
    names = [name for name in rows if name != "task_index"]
    return [str(task) for _, task in sorted(zip(rows["task_index"], rows[names[0]], strict=True))]


def read_row(path: Path) -> dict[str, Any]:
    """Return the row of an episode.

    Raises:
        DatasetError: the file cannot be read, or has several.
    """
    rows = _read(path)
    if any(len(values) != 1 for values in rows.values()):
        raise DatasetError(f"{path} has not one episode")
    return {name: values[0] for name, values in rows.items()}


def statistics_of(row: Mapping[str, Any]) -> dict[str, Statistics]:
    """Return the statistics in the row of an episode."""
    found: dict[str, Statistics] = {}
    for name, value in row.items():
        if name.startswith(f"{STATS}/"):
            key, _, kind = name.removeprefix(f"{STATS}/").rpartition("/")
            found.setdefault(key, {})[kind] = np.asarray(value)
    return found


def read_frames(path: Path) -> dict[str, NDArray[Any]]:
    """Return the columns of a data file, vectors as ``(n, width)``.

    Raises:
        DatasetError: it cannot be read.
    """
    return {name: np.asarray(values) for name, values in _read(path).items()}


def _read(path: Path) -> dict[str, list[Any]]:
    pa = pyarrow()
    try:
        with pa.parquet.ParquetFile(path) as file:
            if file.metadata.num_rows > FILE_ROWS_MAX:
                raise DatasetError(f"{path} has {file.metadata.num_rows:,} rows, more than {FILE_ROWS_MAX:,}")
            rows: dict[str, list[Any]] = file.read().to_pydict()
    except (OSError, pa.ArrowException) as exc:
        raise DatasetError(f"{path} cannot be read: {exc}") from exc
    return rows


def _write(path: Path, table: Any) -> None:
    with replaced(path) as written:
        pyarrow().parquet.write_table(table, written)


def files_in(folder: Path) -> Iterator[Path]:
    """Yield the files below a folder, hidden ones as well."""
    if folder.is_dir():
        yield from (path for path in sorted(folder.rglob("*")) if path.is_file())
