"""Datasets: an episode is saved whole or not at all, and what is there is never written over."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fixtures.episodes import CAMERA, FPS, INFO, JOINTS, episode

from strands_robots.datasets import Dataset, DatasetEpisode, DatasetError, DatasetInfo, Feature, tables
from strands_robots.datasets.check import check_dataset
from strands_robots.datasets.fit import RobotJoints, robot_findings
from strands_robots.datasets.layout import STATS, data_file, episodes_file, read_info
from strands_robots.utils import ValidationError


def saved(folder: Path, count: int, **changed: Any) -> None:
    with Dataset(folder, INFO) as dataset:
        for _ in range(count):
            dataset.save(episode(dataset, **changed))


def test_saved_episode_is_counted_and_whole(tmp_path: Path) -> None:
    saved(tmp_path / "set", 2)
    info, found = check_dataset(tmp_path / "set")
    assert (info.episodes, info.frames, info.tasks, info.fps) == (2, 40, 1, FPS)
    assert [each for each in found if each.wrong] == []
    frames = tables.read_frames(tmp_path / "set" / data_file(1))
    assert frames["observation.state"][3].tolist() == [3.0, 4.0, 5.0]
    assert frames["index"].tolist() == list(range(20, 40))
    assert frames["timestamp"][:3] == pytest.approx([0, 1 / FPS, 2 / FPS])
    assert info.features["action"].names == JOINTS
    assert info.features[CAMERA].about["video.codec"] == "h264"


def test_dataset_goes_on_where_it_was_left(tmp_path: Path) -> None:
    saved(tmp_path, 1)
    saved(tmp_path, 1, task="put it back")
    info, found = check_dataset(tmp_path)
    assert (info.episodes, info.tasks, [each for each in found if each.wrong]) == (2, 2, [])
    assert tables.read_tasks(tmp_path / "meta/tasks.parquet") == ["put the cube on the plate", "put it back"]


def test_statistics_are_those_of_all_frames(tmp_path: Path) -> None:
    saved(tmp_path, 1)
    saved(tmp_path, 1, action=np.full((20, 3), 100.0, dtype=np.float32))
    stats = json.loads((tmp_path / STATS).read_text())
    rows = np.concatenate([np.arange(20)[:, None] + np.arange(3) + 1, np.full((20, 3), 100.0)])
    assert stats["action"]["mean"] == pytest.approx(rows.mean(axis=0).tolist())
    assert stats["action"]["std"] == pytest.approx(rows.std(axis=0).tolist())
    assert (stats["action"]["max"], stats["action"]["count"]) == ([100.0] * 3, [40])
    assert np.shape(stats[CAMERA]["q50"]) == (3, 1, 1)


def test_what_was_not_indexed_is_removed_at_the_next_opening(tmp_path: Path) -> None:
    saved(tmp_path, 1)
    for name in (str(data_file(1)), "videos/observation.images.top/chunk-000/file-001.mp4", ".running/top.mp4"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(b"cut off")
    (tmp_path / STATS).write_text("{}")
    with Dataset(tmp_path, INFO) as dataset:
        assert len(dataset.mended) == 4
        assert dataset.save(episode(dataset)) == 1
    assert [each for each in check_dataset(tmp_path)[1] if each.wrong] == []


def test_episode_that_cannot_be_written_leaves_the_dataset_as_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    saved(tmp_path, 1)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    with Dataset(tmp_path, INFO) as dataset:
        full = OSError(28, "No space left on device")
        monkeypatch.setattr(tables, "write_episode", lambda *arguments: (_ for _ in ()).throw(full))
        with pytest.raises(DatasetError, match=r"No space left on device.*The disk is full"):
            dataset.save(episode(dataset))
        monkeypatch.undo()
        assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before
        assert dataset.save(episode(dataset)) == 1


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"action": np.full((20, 3), np.nan, dtype=np.float32)}, "action must be finite; frame 0"),
        ({"action": np.zeros((20, 2), dtype=np.float32)}, r"action must have the shape \(20, 3\)"),
        ({"action": np.zeros((19, 3), dtype=np.float32)}, "must have 20 frames"),
        ({"next.success": np.zeros(20)}, "next.success must be bool"),
        ({"speed": np.zeros(20)}, "speed is missing or too many"),
        ({"task": ""}, "task"),
    ],
)
def test_episode_of_another_kind_is_refused_by_name(tmp_path: Path, changed: dict[str, Any], said: str) -> None:
    with Dataset(tmp_path, INFO) as dataset, pytest.raises(ValidationError, match=said):
        dataset.save(episode(dataset, **changed))


def test_dataset_of_other_names_or_rate_is_refused(tmp_path: Path) -> None:
    saved(tmp_path, 1)
    others = {
        "fps is 30 here, not 15": replace(INFO, fps=15),
        "observation.state is float32 3": replace(
            INFO, features={**INFO.features, "observation.state": Feature("float32", (3,), ("lift", "pan", "grip"))}
        ),
        "stop is not among what is recorded": replace(
            INFO, features={name: each for name, each in INFO.features.items() if name != "stop"}
        ),
    }
    for said, other in others.items():
        with pytest.raises(ValidationError, match=said):
            Dataset(tmp_path, other)
    assert read_info(tmp_path).episodes == 1


def test_dataset_of_other_units_is_refused_and_one_that_states_none_goes_on(tmp_path: Path) -> None:
    saved(tmp_path, 1)

    def told(*units: str) -> DatasetInfo:
        return replace(INFO, features={**INFO.features, "action": Feature("float32", (3,), JOINTS, units=units)})

    assert told("degrees", "degrees", "").differences(INFO) == []
    (said,) = told("degrees", "degrees", "").differences(told("radians", "degrees", ""))
    assert said.startswith(
        "action is float32 3 (pan in degrees, lift in degrees, grip) here, not float32 3 (pan in rad"
    )
    with pytest.raises(ValidationError, match="units must be 3"):
        told("degrees")


def test_folder_of_other_files_is_not_written_into(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("years")
    with pytest.raises(DatasetError, match=r"not empty: it has thesis\.tex"):
        Dataset(tmp_path, INFO)
    with pytest.raises(DatasetError, match="has no dataset"):
        Dataset(tmp_path / "missing")


def test_dataset_that_was_laid_out_otherwise_keeps_its_files(tmp_path: Path) -> None:
    saved(tmp_path, 2)
    (tmp_path / data_file(1)).rename(tmp_path / "data/chunk-000/file-007.parquet")
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(DatasetError, match="states 2 episodes and has no"):
        Dataset(tmp_path, INFO)
    assert sorted(tmp_path.rglob("*")) == before
    stated = json.loads((tmp_path / "meta/info.json").read_text())
    (tmp_path / "meta/info.json").write_text(json.dumps({**stated, "data_path": "data/{episode_index}.parquet"}))
    with pytest.raises(DatasetError, match="data_path is"):
        Dataset(tmp_path, INFO)
    assert sorted(tmp_path.rglob("*")) == before


def test_second_recorder_of_a_dataset_is_refused(tmp_path: Path) -> None:
    saved(tmp_path, 1)
    child = subprocess.Popen(
        [sys.executable, "-m", "fixtures.episodes", str(tmp_path)], stdout=subprocess.PIPE, text=True
    )
    assert child.stdout is not None
    try:
        assert child.stdout.readline() == "open 1\n"
        with pytest.raises(DatasetError, match="recorded into by another process"):
            Dataset(tmp_path, INFO)
    finally:
        child.kill()
        child.communicate()
    with Dataset(tmp_path, INFO) as dataset:
        assert dataset.info.episodes >= 1


@pytest.mark.parametrize(
    "features",
    [{}, {"timestamp": Feature("float32")}, {"../x": Feature("float32")}],
    ids=["none", "counted", "path"],
)
def test_features_outside_their_domain_are_refused(features: dict[str, Feature]) -> None:
    with pytest.raises(ValidationError, match="feature"):
        DatasetInfo(30, features)


def test_check_names_what_a_stranger_broke(tmp_path: Path) -> None:
    saved(tmp_path, 3)
    (tmp_path / data_file(0)).write_bytes(b"PAR1")
    video = tmp_path / "videos/observation.images.top/chunk-000/file-001.mp4"
    video.write_bytes(video.read_bytes()[:-200])
    _, found = check_dataset(tmp_path)
    assert {each.where.partition(",")[0] for each in found if each.wrong} >= {"episode 0", "episode 1"}


def test_check_looks_at_a_robot_of_one_joint(tmp_path: Path) -> None:
    joint = Feature("float32", (1,), ("pan",))
    turn = np.repeat(np.array([0.0, 1.0], dtype=np.float32), 20)
    with Dataset(tmp_path, DatasetInfo(FPS, {"observation.state": joint, "action": joint})) as dataset:
        dataset.save(DatasetEpisode("turn", {"observation.state": turn, "action": turn}))
    info, found = check_dataset(tmp_path)
    assert [each.said for each in found] == [f"pan of {name} jumps by 1 at frame 20" for name in info.features]
    ranges = {"ranges": {"pan": [-0.5, 0.5]}, "observation_features": {"pan": ""}, "action_features": {"pan": ""}}
    outside = robot_findings(tmp_path, info, RobotJoints.of("table", ranges))
    assert [each.wrong for each in outside] == [True, True]


def test_later_row_has_no_column_that_the_first_one_lacks(tmp_path: Path) -> None:
    folder = tmp_path / "set"
    with Dataset(folder, INFO) as dataset:
        dataset.save(replace(episode(dataset), policy="mock"))
    row = tables.read_row(folder / episodes_file(0))
    assert row.pop("policy") == "mock"
    tables.write_episode(folder / episodes_file(0), row, {})
    with Dataset(folder) as dataset:
        dataset.save(replace(episode(dataset), policy="mock"))
    assert "policy" not in tables.read_row(folder / episodes_file(1)), "LeRobot would not load it"
