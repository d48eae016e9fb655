"""Recording of a served real arm: at rest, in motion, and while its cable is out."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from fixtures.feetech_bus import FeetechBus
from fixtures.waiting import eventually

from strands_robots.recording.file import (
    RecordedEvent,
    RecordedJoints,
    Recorder,
    RobotRecording,
    read_items,
    recorded_actions,
)

pytestmark = pytest.mark.system


def test_arm_is_recorded_at_rest_in_motion_and_after_its_cable_was_out(
    arm: Callable[..., Any], bus: FeetechBus, tmp_path: Path
) -> None:
    robot, path = arm(), tmp_path / "run.mcap"
    with Recorder(path, joints_of_events=False) as recorder, RobotRecording(robot, recorder, "arm-1"):
        eventually(lambda: recorder.counts["/arm-1/joint_states"] >= 20)
        assert robot.start_task("wave", duration=20)["status"] == "success"
        eventually(lambda: recorder.counts["/arm-1/streamStep"] >= 20)
        assert robot.halt("test").stopped
        eventually(lambda: recorder.counts["/arm-1/halted"] >= 1)
        bus.unplug()
        eventually(lambda: recorder.counts["/arm-1/notRecorded"] >= 1)
        bus.plug()
        robot.connect()
        before = recorder.counts["/arm-1/joint_states"]
        eventually(lambda: recorder.counts["/arm-1/joint_states"] > before + 5)
    assert recorder.lost == 0
    items = list(read_items(path))
    assert {len(item.joints) for item in items if isinstance(item, RecordedJoints)} == {6}
    completion = next(item for item in items if isinstance(item, RecordedEvent) and item.event == "taskComplete")
    assert completion.payload["state"] == "stopped"
    assert len(recorded_actions(path)) >= 20
