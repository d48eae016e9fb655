"""Episodes of LeRobot's datasets lead."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from strands_robots.teleoperators.recorded import read_episode
from strands_robots.utils import ValidationError

pyarrow = pytest.importorskip("pyarrow")

NAMES = ["pan.pos", "grip.pos"]


def dataset(folder: Path, names: Any = NAMES, **columns: Any) -> Path:
    """Two episodes of three frames at 10 Hz, laid out as LeRobot lays them out."""
    from pyarrow import parquet  # noqa: PLC0415 - skipped where it is missing

    rows = {
        "action": [[float(step), 50.0 + step] for step in range(6)],
        "observation.state": [[0.0, 0.0]] * 6,
        "timestamp": [0.1 * (step % 3) for step in range(6)],
        "frame_index": [step % 3 for step in range(6)],
        "episode_index": [step // 3 for step in range(6)],
    } | columns
    path = folder / "data" / "chunk-000" / "file-000.parquet"
    path.parent.mkdir(parents=True)
    parquet.write_table(pyarrow.table({name: column for name, column in rows.items() if column is not None}), path)
    (folder / "meta").mkdir()
    told = {"features": {"action": {"dtype": "float32", "shape": [2], "names": names}}}
    (folder / "meta" / "info.json").write_text(json.dumps(told), encoding="utf-8")
    return path


@pytest.mark.parametrize("names", [NAMES, {"motors": NAMES}])
def test_an_episode_leads_with_the_names_of_its_dataset(tmp_path: Path, names: Any) -> None:
    path = dataset(tmp_path, names)
    frames = read_episode(path, "1")
    assert [seconds for seconds, _ in frames] == pytest.approx([0.0, 0.1, 0.2])
    assert frames[0][1] == {"pan.pos": 3.0, "grip.pos": 53.0}


def test_a_file_of_one_episode_needs_no_number(tmp_path: Path) -> None:
    assert len(read_episode(dataset(tmp_path, episode_index=[4] * 6, timestamp=[0.1 * n for n in range(6)]))) == 6


@pytest.mark.parametrize(
    ("columns", "episode", "words"),
    [
        ({}, None, r"0 to 1"),
        ({}, "7", r"0 to 1"),
        ({"action": None}, "1", "no column action"),
        ({"action": [[1.0]] * 6}, "1", "2 numbers"),
        ({"action": [[1.0, float("nan")]] * 6}, "1", "grip.pos in row 0"),
        ({"names": []}, "1", "list of names"),
    ],
)
def test_what_cannot_lead_is_refused_by_name(
    tmp_path: Path, columns: dict[str, Any], episode: str | None, words: str
) -> None:
    with pytest.raises(ValidationError, match=words):
        read_episode(dataset(tmp_path, **columns), episode)


def test_a_file_that_is_none_of_a_dataset_is_one_sentence(tmp_path: Path) -> None:
    text = tmp_path / "text.parquet"
    text.write_text("only words", encoding="utf-8")
    with pytest.raises(ValidationError, match="no data file"):
        read_episode(text)
    with pytest.raises(ValidationError, match="cannot be read"):
        read_episode(tmp_path / "none.parquet")
    path = dataset(tmp_path / "set")
    (tmp_path / "set" / "meta" / "info.json").unlink()
    with pytest.raises(ValidationError, match=r"meta/info\.json"):
        read_episode(path, "1")
