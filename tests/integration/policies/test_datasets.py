"""LeRobot's own loader on a dataset that is written here. Run by `make lerobot`."""

from __future__ import annotations

import importlib.util
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest
from fixtures.episodes import CAMERA, FPS, INFO, JOINTS, episode

from strands_robots.datasets import Dataset, DatasetEpisode

if importlib.util.find_spec("torch") is None or importlib.util.find_spec("lerobot") is None:
    pytest.skip("LeRobot with torch is not installed; `make lerobot` runs this", allow_module_level=True)

from lerobot.datasets.lerobot_dataset import LeRobotDataset
from torch.utils.data import DataLoader

EPISODES, FRAMES = 3, 20


@pytest.fixture
def without_videos(tmp_path: Path) -> Path:
    """A dataset of joints alone, which every LeRobot reads without a decoder."""
    folder = tmp_path / "joints"
    features = {name: each for name, each in INFO.features.items() if name != CAMERA}
    with Dataset(folder, replace(INFO, features=features)) as dataset:
        for number in range(EPISODES):
            made = episode(dataset, FRAMES, f"task {number % 2}")
            dataset.save(DatasetEpisode(made.task, made.columns))
    return folder


@pytest.fixture
def with_videos(tmp_path: Path) -> Path:
    folder = tmp_path / "pictures"
    with Dataset(folder, INFO) as dataset:
        for number in range(EPISODES):
            dataset.save(episode(dataset, FRAMES, f"task {number % 2}"))
    return folder


def test_lerobot_reads_each_frame_with_its_task_and_names(without_videos: Path) -> None:
    dataset = LeRobotDataset("local/joints", root=without_videos)
    assert (dataset.num_episodes, dataset.num_frames, dataset.fps) == (EPISODES, EPISODES * FRAMES, FPS)
    frame = dataset[FRAMES + 3]
    assert frame["observation.state"].tolist() == [3.0, 4.0, 5.0]
    assert (frame["task"], int(frame["episode_index"]), int(frame["frame_index"])) == ("task 1", 1, 3)
    assert bool(dataset[FRAMES - 1]["next.success"]) is True
    assert dataset.meta.features["action"]["names"] == list(JOINTS)
    assert dataset.meta.stats["action"]["count"].tolist() == [EPISODES * FRAMES]


def test_lerobot_reads_ahead_and_shuffles(without_videos: Path) -> None:
    ahead = {"action": [0.0, 1 / FPS, 2 / FPS]}
    dataset = LeRobotDataset("local/joints", root=without_videos, delta_timestamps=ahead)
    seen: list[int] = []
    for batch in DataLoader(dataset, batch_size=7, shuffle=True):
        seen += batch["index"].tolist()
        first, second = batch["action"][:, 0], batch["action"][:, 1]
        inside = ~batch["action_is_pad"][:, 1]
        assert np.allclose((second - first)[inside], 1.0)
    assert sorted(seen) == list(range(EPISODES * FRAMES))


def test_lerobot_decodes_the_picture_of_each_frame(with_videos: Path) -> None:
    dataset = LeRobotDataset("local/pictures", root=with_videos)
    if version("lerobot").startswith("0.4.") and importlib.util.find_spec("torchcodec") is None:
        pytest.skip("LeRobot 0.4 decodes videos by torchcodec alone, which is not installed; 0.6.1 decodes by PyAV")
    for number in (0, 7, FRAMES + 11, EPISODES * FRAMES - 1):
        shade = float(dataset[number][CAMERA].mean()) * 255
        assert shade == pytest.approx((number % FRAMES) * 5, abs=4), number
