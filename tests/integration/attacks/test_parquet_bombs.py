"""Parquet files of a few kilobytes that unpack to gigabytes, refused before they do."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from strands_robots import teleoperators
from strands_robots.utils import ValidationError


@pytest.fixture
def dataset(tmp_path: Path) -> Path:
    """Place of a data file in a dataset whose actions are named."""
    (tmp_path / "meta").mkdir()
    info = {"features": {"action": {"names": ["pan.pos"]}}}
    (tmp_path / "meta" / "info.json").write_text(json.dumps(info))
    (tmp_path / "data").mkdir()
    return tmp_path / "data" / "file-000.parquet"


def table(rows: int, values: int = 1) -> Any:
    zeros = pa.array([0.0] * values, pa.float32())
    lists = pa.ListArray.from_arrays(
        pa.array(range(0, (rows + 1) * values, values), pa.int32()), pa.concat_arrays([zeros] * rows)
    )
    columns = {"action": lists, "timestamp": pa.array([0.0] * rows), "episode_index": pa.array([0] * rows)}
    return pa.table(columns)


def refused(path: Path, monkeypatch: pytest.MonkeyPatch, why: str) -> None:
    monkeypatch.setattr(pq.ParquetFile, "iter_batches", lambda *a, **k: pytest.fail("it was unpacked"))
    began = time.process_time()
    with pytest.raises(ValidationError, match=why):
        teleoperators.read_episode(path)
    assert time.process_time() - began < 5.0


def test_rows_by_the_million_are_refused_before_they_are_unpacked(
    dataset: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    part = table(200_000)
    with pq.ParquetWriter(dataset, part.schema, compression="zstd") as writer:
        for _ in range(50):
            writer.write_table(part)
    assert dataset.stat().st_size < 500_000
    refused(dataset, monkeypatch, "the recording has 10,000,000 rows, and may have 1,000,000 at most")


def test_lists_of_a_million_values_are_refused_before_they_are_unpacked(
    dataset: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    part = table(2, 1_000_000)
    with pq.ParquetWriter(dataset, part.schema, compression="zstd") as writer:
        for _ in range(35):
            writer.write_table(part)
    assert dataset.stat().st_size < 500_000
    refused(dataset, monkeypatch, "the recording has 70,000,1[0-9]{2} values, and may have 64,000,000 at most")


def test_values_are_counted_as_they_are_unpacked(dataset: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A file may state less of itself than it holds."""
    pq.write_table(table(4000), dataset)
    assert len(teleoperators.read_episode(dataset, "0")) == 4000
    counted: list[tuple[str, int]] = []
    monkeypatch.setattr(teleoperators, "_within", lambda what, count, most: counted.append((what, count)))
    teleoperators.read_episode(dataset)
    assert [count for what, count in counted if what == "rows"] == [4000, 1024, 2048, 3072, 4000]


@pytest.mark.parametrize("cut", [4, 100, 1000])
def test_file_that_was_cut_or_changed_is_refused(dataset: Path, cut: int) -> None:
    pq.write_table(table(4000), dataset)
    data = dataset.read_bytes()
    for broken in (data[:-cut], data[: len(data) - cut] + b"\xff" * cut):
        dataset.write_bytes(broken)
        with pytest.raises(ValidationError, match=r"file-000\.parquet"):
            teleoperators.read_episode(dataset)
