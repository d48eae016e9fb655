"""LeRobot's own loader on a dataset that is written here. Run by `make lerobot`."""

from __future__ import annotations

import importlib.util
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest
from fixtures.episodes import CAMERA, FPS, HEIGHT, INFO, JOINTS, WIDTH, episode

from strands_robots.datasets import Dataset, DatasetEpisode, Feature
from strands_robots.datasets.recorded import ACTOR, ACTORS
from strands_robots.datasets.video import Video, VideoWriter, about_video, copy_pictures

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
    features["action"] = replace(features["action"], units=("degrees", "degrees", ""))
    features[ACTOR] = Feature("int64", about={"codes": list(ACTORS)})
    with Dataset(folder, replace(INFO, features=features)) as dataset:
        for number in range(EPISODES):
            made = episode(dataset, FRAMES, f"task {number % 2}")
            policy = "mock" if number else ""
            columns = {**made.columns, ACTOR: np.full(FRAMES, number)}
            dataset.save(DatasetEpisode(made.task, columns, policy=policy))
    return folder


@pytest.fixture
def copied_from_live(tmp_path: Path) -> Path:
    """A dataset whose video was written live, and copied from its fifth picture on."""
    folder = tmp_path / "live"
    with Dataset(folder, INFO) as dataset:
        made = episode(dataset, FRAMES)
        live, copy = tmp_path / "live.mp4", dataset.running / "copy.mp4"
        with VideoWriter(live, FPS, WIDTH, HEIGHT, live=True) as video:
            for number in range(FRAMES + 9):
                video.write(np.full((HEIGHT, WIDTH, 3), max(0, number - 4) * 5, dtype=np.uint8))
            statistics = video.finish().statistics
        copy_pictures(live, copy, 4, FRAMES, FPS)
        top = Video(copy, FRAMES, statistics, about_video(WIDTH, HEIGHT, FPS))
        dataset.save(DatasetEpisode(made.task, made.columns, {CAMERA: top}))
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
    assert int(frame["actor"]) == 1
    assert dataset.meta.episodes[1]["policy"] == "mock"
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


def requires_decoder() -> None:
    if version("lerobot").startswith("0.4.") and importlib.util.find_spec("torchcodec") is None:
        pytest.skip("LeRobot 0.4 decodes videos by torchcodec alone, which is not installed; 0.6.1 decodes by PyAV")


def test_lerobot_decodes_the_picture_of_each_frame(with_videos: Path) -> None:
    requires_decoder()
    dataset = LeRobotDataset("local/pictures", root=with_videos)
    for number in (0, 7, FRAMES + 11, EPISODES * FRAMES - 1):
        shade = float(dataset[number][CAMERA].mean()) * 255
        assert shade == pytest.approx((number % FRAMES) * 5, abs=4), number


def test_lerobot_decodes_pictures_that_were_copied_from_a_live_video(copied_from_live: Path) -> None:
    requires_decoder()
    dataset = LeRobotDataset("local/live", root=copied_from_live, delta_timestamps={CAMERA: [0.0, 1 / FPS]})
    for number in range(FRAMES - 1):
        shades = (dataset[number][CAMERA].mean(dim=(1, 2, 3)) * 255).tolist()
        assert shades == pytest.approx([number * 5, number * 5 + 5], abs=4), number
