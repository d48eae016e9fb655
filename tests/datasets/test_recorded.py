"""Recordings as episodes: on the grid, with the age of each reading, and with the stops."""

from __future__ import annotations

import io
import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import Result
from PIL import Image
from typer.testing import CliRunner

from strands_robots.cli.app import build
from strands_robots.datasets import Dataset, tables
from strands_robots.datasets.layout import data_file, episodes_file, read_info
from strands_robots.datasets.recorded import (
    ACTORS,
    LED_BY_RECORDING,
    attempts_in,
    attempts_of,
    info_of,
    save_attempt,
)
from strands_robots.recording.file import Recorder
from strands_robots.utils import ValidationError

BEGAN = 1_000.0
HZ = 20.0


def picture(shade: int) -> bytes:
    file = io.BytesIO()
    Image.fromarray(np.full((48, 64, 3), shade, dtype=np.uint8)).save(file, "JPEG")
    return file.getvalue()


def recorded(path: Path, *, tasks: int = 2, state: str = "completed", cameras: bool = True) -> Path:
    """Write tasks of 20 steps at 20 Hz, a picture each tenth step."""
    with Recorder(path) as recorder:
        for task in range(tasks):
            at = BEGAN + 10 * task
            recorder.take("arm-1", "taskStarted", {"instruction": "wave"}, at - 0.01)
            for step in range(20):
                moment = at + step / HZ
                observation = {"pan": float(step), "lift": 1.0}
                action = {"pan": step + 1.0} if step else {"pan": 1.0, "lift": 2.0}
                recorder.take("arm-1", "streamStep", {"observation": observation, "action": action}, moment)
                if cameras and step % 10 == 0:
                    recorder.take_picture("arm-1", "top", picture(step), moment)
            end = {"instruction": "wave", "state": state}
            recorder.take("arm-1", "taskComplete", end, at + 1.0)
    return path


def run(*arguments: str) -> Result:
    return CliRunner().invoke(build("dataset"), ["dataset", *arguments])


def frames_of(folder: Path, episode: int = 0) -> dict[str, np.ndarray]:
    return tables.read_frames(folder / data_file(episode))


def test_each_task_is_an_episode_on_the_grid_with_its_ages(tmp_path: Path) -> None:
    file, out = recorded(tmp_path / "a.mcap"), tmp_path / "set"
    made = run("from-mcap", str(file), "--out", str(out), "--fps", "40", "--success")
    assert made.exit_code == 0, made.output
    info, frames = read_info(out), frames_of(out)
    assert (info.episodes, info.fps, info.features["observation.state"].names) == (2, 40, ("pan", "lift"))
    assert len(frames["index"]) == 39
    assert frames["observation.state"][:6, 0].tolist() == [0, 0, 1, 1, 2, 2]
    assert frames["observation.age_ms.state"][:4] == pytest.approx([0, 25, 0, 25], abs=0.1)
    assert frames["action"][4].tolist() == [3.0, 2.0], "lift keeps what it was told"
    assert frames["observation.age_ms.top"][19] == pytest.approx(475, abs=0.1)
    assert frames["same.top"].tolist() == [number not in (0, 20) for number in range(39)]
    assert frames["next.success"].tolist() == [False] * 38 + [True]
    assert tables.read_tasks(out / "meta/tasks.parquet") == ["wave"]
    assert run("check", str(out)).exit_code == 0


def test_stop_is_marked_in_its_frame(tmp_path: Path) -> None:
    file, out = recorded(tmp_path / "a.mcap", tasks=1, state="stopped", cameras=False), tmp_path / "set"
    run("from-mcap", str(file), "--out", str(out), "--fps", "20")
    assert frames_of(out)["stop"].tolist() == [0] * 19 + [1]


def test_cut_recording_gives_what_it_still_has(tmp_path: Path) -> None:
    file = recorded(tmp_path / "a.mcap", tasks=12, cameras=False)
    whole = [len(attempt.steps) for attempt in attempts_of(file)]
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    left = [len(attempt.steps) for attempt in attempts_of(file)]
    assert 0 < sum(left) < sum(whole)
    assert left[:-1] == whole[: len(left) - 1], "those before the cut are whole"


def test_recording_of_others_is_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(ValidationError, match=r"robot must be one of those that were recorded \(arm-1\), not 'arm-2'"):
        attempts_of(recorded(tmp_path / "a.mcap"), "arm-2")
    with Recorder(tmp_path / "b.mcap") as recorder:
        recorder.take("arm-1", "taskStarted", {"instruction": "wave"})
    refused = run("from-mcap", str(tmp_path / "b.mcap"), "--out", str(tmp_path / "set"))
    assert refused.exit_code != 0
    assert "has no steps of a task" in refused.output
    assert not (tmp_path / "set").exists()


def test_index_of_the_dataset_is_what_lerobot_states(tmp_path: Path) -> None:
    file, out = recorded(tmp_path / "a.mcap", tasks=1), tmp_path / "set"
    run("from-mcap", str(file), "--out", str(out), "--robot-type", "so101")
    stated = json.loads((out / "meta/info.json").read_text())
    assert (stated["codebase_version"], stated["robot_type"], stated["splits"]) == ("v3.0", "so101", {"train": "0:1"})
    assert stated["features"]["observation.images.top"]["shape"] == [48, 64, 3]


def acted(path: Path) -> Path:
    """Write an attempt: a policy's steps, a leader's, a planned motion's, an emergency stop, and a refused motion."""
    with Recorder(path) as recorder:
        recorder.take("arm-1", "jointUnits", {"units": {"pan": "degrees"}}, BEGAN - 1)
        for start, policy, led_by in ((0, "mock", ""), (10, "", "hand"), (20, "motion", "")):
            if policy:
                recorder.take("arm-1", "taskStarted", {"policy_provider": policy}, BEGAN + start / HZ)
            for step in range(start, start + 10):
                row = {"observation": {"pan": 1.0, "lift": 1.0}, "action": {"pan": 1.0}, "led_by": led_by}
                recorder.take("arm-1", "streamStep", row, BEGAN + step / HZ)
        recorder.take("arm-1", "taskComplete", {"state": "stopped"}, BEGAN + 1.46)
        recorder.take("arm-1", "locked", {}, BEGAN + 1.47)
        recorder.take("arm-1", "motionRefused", {"verb": "execute"}, BEGAN + 1.80)
        recorder.take("arm-1", "motionRefused", {"verb": "execute"}, BEGAN + 60.0)
        recorder.take("arm-1", "taskStarted", {"policy_provider": "pi"}, BEGAN + 100)
        for step in range(5):
            row = {"observation": {"pan": 1.0, "lift": 1.0}, "action": {"pan": 1.0}}
            recorder.take("arm-1", "streamStep", row, BEGAN + 100 + step / HZ)
    return path


def test_frames_say_who_acted_and_what_was_refused(tmp_path: Path) -> None:
    file, out = acted(tmp_path / "a.mcap"), tmp_path / "set"
    (attempt,) = attempts_in(file, whole=True)[:1]
    attempt.steps, attempt.led, attempt.actors = attempt.steps[:30], attempt.led[:30], attempt.actors[:30]
    info = info_of([attempt], 20, "so100")
    with Dataset(out, info) as dataset:
        save_attempt(dataset, attempt, "wave", success=False)
    frames = frames_of(out)
    assert len(frames["index"]) == 37, "the frames go on to the motion that was refused"
    assert [ACTORS[code] for code in frames["actor"][[0, 9, 10, 19, 20, 29]]] == [
        *("policy", "policy", "leader", "leader", "motion", "motion")
    ]
    assert frames["intervention"].tolist() == [False] * 10 + [True] * 10 + [False] * 17
    assert {index: int(code) for index, code in enumerate(frames["stop"]) if code} == {30: 2, 36: 3}
    assert frames["observation.age_ms.state"][-1] == pytest.approx(350, abs=1), "and say how old their state is"
    again = read_info(out)
    assert again.features["action"].units == ("degrees",)
    assert again.features["observation.state"].units == ("degrees", "")
    assert again.features["actor"].about == {"codes": list(ACTORS)}
    assert tables.read_row(out / episodes_file(0))["policy"] == "mock, pi"


def test_lockout_is_of_the_task_that_it_ended_not_of_the_next_one(tmp_path: Path) -> None:
    stopped, after = attempts_in(acted(tmp_path / "a.mcap"))[-2:]
    assert [code for _, code in stopped.stops] == [1, 2, 3]
    assert (after.stops, after.actors) == ([], [1] * 5)


def test_recording_that_leads_is_told_from_a_person(tmp_path: Path) -> None:
    with Recorder(tmp_path / "a.mcap") as recorder:
        recorder.take("arm-1", LED_BY_RECORDING, {}, BEGAN)
        recorder.take("arm-1", "taskStarted", {"policy_provider": "teleoperation"}, BEGAN)
        recorder.take("arm-1", "streamStep", {"observation": {"pan": 1.0}, "action": {"pan": 1.0}}, BEGAN)
    (attempt,) = attempts_in(tmp_path / "a.mcap")
    assert (ACTORS[attempt.actors[0]], attempt.led) == ("recording", [False])


@pytest.mark.parametrize("part", ["", "so100"], ids=["arm", "only robot of a world on the mesh"])
def test_frames_of_a_hold_are_nobodys(tmp_path: Path, part: str) -> None:
    file = tmp_path / "a.mcap"
    turns = (("policy", ""), ("led", "hand"), ("held", ""), ("led", "hand"), ("policy", ""))
    with Recorder(file) as recorder:
        recorder.take("arm-1", "taskStarted", {"policy_provider": "mock"}, BEGAN - 0.01)
        for turn, (state, led_by) in enumerate(turns):
            recorder.take("arm-1", "turnChanged", {"state": state, "robot_name": part}, BEGAN + turn)
            for step in range(2):
                row = {"observation": {"pan": 1.0}, "action": {"pan": 1.0}, "led_by": led_by}
                recorder.take("arm-1", "streamStep", row, BEGAN + turn + step / HZ)
    (attempt,) = attempts_in(file, whole=True)
    assert [ACTORS[code] for code in attempt.actors[::2]] == ["policy", "leader", "unknown", "leader", "policy"]
    assert attempt.led[::2] == [False, True, False, True, False]
