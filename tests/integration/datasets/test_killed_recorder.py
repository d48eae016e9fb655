"""A recorder that is killed at any moment costs no episode that it said to be saved."""

from __future__ import annotations

import random
import subprocess
import sys
import time
from pathlib import Path

from fixtures.episodes import INFO

from strands_robots.datasets import Dataset
from strands_robots.datasets.check import check_dataset

KILLS = 12


def test_saved_episodes_outlive_a_recorder_that_is_killed(tmp_path: Path) -> None:
    saved = 0
    moments = random.Random(7)
    for _ in range(KILLS):
        child = subprocess.Popen(
            [sys.executable, "-m", "fixtures.episodes", str(tmp_path)], stdout=subprocess.PIPE, text=True
        )
        assert child.stdout is not None
        assert int(child.stdout.readline().split()[1]) >= saved
        assert child.stdout.readline().startswith("saved ")
        saved += 1
        # Any moment is as good: between two episodes, or in the middle of one.
        time.sleep(moments.uniform(0.0, 0.2))
        child.kill()
        said, _ = child.communicate()
        numbers = [int(line.split()[1]) for line in said.splitlines() if line.count(" ") == 1]
        saved = max([saved, *(number + 1 for number in numbers)])
        with Dataset(tmp_path, INFO) as dataset:
            assert dataset.info.episodes >= saved
            saved = dataset.info.episodes
    info, found = check_dataset(tmp_path)
    assert info.episodes == saved > 0
    assert [each for each in found if each.wrong] == []
