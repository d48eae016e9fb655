"""A dataset against a robot: names that differ, and values that the robot cannot have, are wrong."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from strands_robots.cli.app import build
from strands_robots.datasets import Dataset, DatasetEpisode, DatasetInfo, Feature
from strands_robots.datasets.fit import RobotJoints, profile_rows, robot_findings
from strands_robots.policies.profiles import CameraMap, Profile
from strands_robots.utils import ValidationError

JOINTS = ("pan", "lift")
ARM: dict[str, Any] = {
    "observation_features": {"pan": "float", "lift": "float", "top": [480, 640, 3]},
    "action_features": {"pan": "float", "lift": "float"},
    "ranges": {"pan": [-1.0, 1.0], "lift": [0.0, 2.0]},
}


def findings(
    folder: Path, features: dict[str, Any], rows: np.ndarray[Any, Any], names: tuple[str, ...] = JOINTS
) -> list[str]:
    info = DatasetInfo(30, {key: Feature("float32", (2,), names) for key in ("observation.state", "action")}, "arm")
    with Dataset(folder, info) as dataset:
        dataset.save(DatasetEpisode("reach", {key: rows.astype(np.float32) for key in info.features}))
        return [each.said for each in robot_findings(folder, dataset.info, RobotJoints.of("arm-1", features))]


def test_dataset_of_the_robot_itself_fits_whatever_the_order_of_its_joints(tmp_path: Path) -> None:
    rows = np.linspace(0, 1, 40).reshape(20, 2)
    assert findings(tmp_path / "one", ARM, rows) == []
    assert findings(tmp_path / "two", ARM, rows, ("lift", "pan")) == []


def test_names_that_differ_are_said_on_both_sides(tmp_path: Path) -> None:
    said = findings(tmp_path, ARM, np.zeros((20, 2)), ("pan", "elbow"))
    assert said == ["it has no lift, which arm-1 has", "arm-1 has no elbow"] * 2


def test_degrees_are_no_radians(tmp_path: Path) -> None:
    (said, _) = findings(tmp_path, ARM, np.array([[0.0, 0.0], [45.0, 1.0]]))
    assert said == "pan is 0 to 45, and arm-1 takes -1 to 1; is it of another unit?"


def test_units_that_are_stated_are_told_and_no_range_is_guessed_by(tmp_path: Path) -> None:
    features = {key: Feature("float32", (2,), JOINTS, units=("degrees", "")) for key in ("observation.state", "action")}
    with Dataset(tmp_path, DatasetInfo(30, features, "arm")) as dataset:
        rows = np.array([[0.0, 0.0], [45.0, 1.0]], dtype=np.float32)
        dataset.save(DatasetEpisode("reach", dict.fromkeys(features, rows)))
        robot = RobotJoints.of("arm-1", {**ARM, "joint_units": {"pan": "radians", "lift": "radians"}})
        said = [each.said for each in robot_findings(tmp_path, dataset.info, robot)]
    assert said == ["pan is in degrees, and of arm-1 in radians"] * 2


def test_robot_of_a_world_is_named_where_there_are_several() -> None:
    part = {
        "joints": {"pan": [-1, 1], "lift": None},
        "actuators": {"pan": [-1, 1]},
        "observation_features": ["pan", "lift"],
        "action_features": ["pan"],
    }
    world = {"robots": {"left": part, "right": part}}
    assert RobotJoints.of("world", world, "left") == RobotJoints(
        "world", ("pan", "lift"), ("pan",), {"pan": (-1.0, 1.0)}
    )
    for named in ("", "middle"):
        with pytest.raises(ValidationError, match="left, right"):
            RobotJoints.of("world", world, named)
    for features in ({}, {"robots": {"left": 3}}, {"observation_features": 3, "action_features": None}):
        with pytest.raises(ValidationError, match="states no joints"):
            RobotJoints.of("arm-1", features)


def profile(**changed: Any) -> Profile:
    keys: dict[str, Any] = {"state": JOINTS, "action": JOINTS, "units": {"": "degrees"}, "rate": 30.0}
    cameras = (CameraMap("arm/top", "observation.images.front", (48, 64)),)
    return Profile("pick", "lerobot_local", **{**keys, "cameras": cameras, **changed})


@pytest.mark.parametrize(
    ("changed", "refused"),
    [
        ({}, []),
        ({"state": ("lift", "pan")}, ["names of observation.state"]),
        ({"action": ("pan",)}, ["names of action"]),
        ({"units": {"": "radians"}}, ["units of observation.state", "units of action"]),
        ({"rate": 50.0}, ["rate of the dataset"]),
        ({"rate": None, "units": {}}, []),
        ({"cameras": (CameraMap("wrist", "observation.images.wrist"),)}, ["pictures of wrist"]),
    ],
)
def test_profile_is_held_against_names_units_rate_and_cameras(changed: dict[str, Any], refused: list[str]) -> None:
    joints = {key: Feature("float32", (2,), JOINTS, units=("degrees",) * 2) for key in ("observation.state", "action")}
    info = DatasetInfo(30, {**joints, "observation.images.arm.top": Feature("video", (48, 64, 3))}, "arm")
    assert [row.question for row in profile_rows(profile(**changed), info) if row.outcome == "refused"] == refused


def test_command_holds_a_profile_against_a_dataset(tmp_path: Path) -> None:
    findings(tmp_path / "set", ARM, np.zeros((20, 2)))
    file = tmp_path / "policies.toml"
    entries = 'provider = "remote"\nurl = "ws://localhost:9"\nstate = ["pan", "lift"]\naction = ["pan", "lift"]\n'
    for rate, code in ((30, 0), (50, 1)):
        file.write_text(f'[pick]\n{entries}units = "radians"\nrate = {rate}\n')
        words = ["policy", "check", "pick", "--policies", str(file), "--dataset", str(tmp_path / "set")]
        done = CliRunner().invoke(build("policy"), words)
        assert done.exit_code == code, done.output
    assert "does not fit" in done.output + done.stderr
    done = CliRunner().invoke(build("policy"), words[:-2])
    assert (done.exit_code, "give --robot, --dataset" in done.output + done.stderr) == (2, True)


def test_command_holds_a_dataset_against_a_simulated_robot(tmp_path: Path) -> None:
    findings(tmp_path / "set", ARM, np.zeros((20, 2)))
    done = CliRunner().invoke(build("dataset"), ["dataset", "check", str(tmp_path / "set"), "--robot", "so100"])
    assert done.exit_code == 1
    assert "so100 has no pan, lift" in done.output
