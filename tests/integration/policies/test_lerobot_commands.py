"""LeRobot's own commands on a served robot, and the blocks of docs/lerobot.md. Run by `make lerobot`."""

from __future__ import annotations

import importlib
import importlib.util
import json
import re
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import entry_points, version
from pathlib import Path
from typing import IO, Any

import numpy as np
import pytest
from fixtures.command_line import Machine
from fixtures.feetech_bus import write_calibration
from fixtures.feetech_bus.process import BusProcess
from fixtures.forked import LEROBOT, start
from fixtures.waiting import eventually

if importlib.util.find_spec("torch") is None or importlib.util.find_spec("lerobot_robot_strands") is None:
    pytest.skip("LeRobot with the plug-ins is not installed; `make lerobot` runs this", allow_module_level=True)

from fixtures import lerobot_checkpoints as tiny
from lerobot_robot_strands import StrandsRobot, StrandsRobotConfig
from lerobot_robot_strands.ending import RobotEndedError, at_end
from lerobot_robot_strands.newest import Newest
from lerobot_robot_strands.served import feature
from lerobot_teleoperator_strands import StrandsTeleoperator, StrandsTeleoperatorConfig

ROOT = Path(__file__).parents[3]
PAGE = (ROOT / "docs" / "lerobot.md").read_text("utf-8")
WITHIN_S = 200.0
JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")


def commands(name: str) -> list[str]:
    """Return the page's command of that name, as its module and its words."""
    (line,) = re.findall(rf"^\$ ({name} .*)$", PAGE, re.MULTILINE)
    words = shlex.split(line)
    (script,) = entry_points(group="console_scripts", name=words[0])
    return [sys.executable, "-m", script.module, *words[1:]]


@pytest.fixture(scope="module")
def machine(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Machine]:
    """A machine with the two robots of the page, whose settings this process has as well."""
    with pytest.MonkeyPatch.context() as patch, serving(tmp_path_factory.mktemp("lerobot")) as there:
        join(there, patch)
        yield there


@pytest.fixture(scope="module")
def on_the_mesh(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Machine]:
    """Another machine, whose robots have the same ids on the native mesh."""
    with serving(tmp_path_factory.mktemp("mesh"), "--mesh") as there:
        yield there


@pytest.fixture(params=["device_connect", "mesh"])
def either(request: pytest.FixtureRequest, machine: Machine, monkeypatch: pytest.MonkeyPatch) -> Machine:
    """The machine with the robots of one network, whose settings this process has as well."""
    there: Machine = machine if request.param == "device_connect" else request.getfixturevalue("on_the_mesh")
    join(there, monkeypatch)
    return there


@contextmanager
def serving(folder: Path, *options: str) -> Iterator[Machine]:
    there = Machine(folder / "state", HF_LEROBOT_HOME=str(folder / "home"), HF_HUB_OFFLINE="1")
    with there.serving("arm-1", *options), there.serving("leader-1", *options):
        yield there


def join(there: Machine, patch: pytest.MonkeyPatch) -> None:
    for name in ("STRANDS_STATE_DIR", "STRANDS_DC_PORT", "STRANDS_MESH_PORT"):
        patch.setenv(name, there.environment[name])


@pytest.fixture(scope="module")
def folder(machine: Machine, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which the page's recording has been made."""
    made = tmp_path_factory.mktemp("recorded")
    run(machine, made, commands("lerobot-record"), "--dataset.episode_time_s=2")
    return made


def run(machine: Machine, folder: Path, line: list[str], *more: str) -> None:
    """Run a command to its end; a later option counts."""
    with (folder / "said.txt").open("w") as out:
        done = begin(machine, folder, [*line, *more], out)
    try:
        assert done.wait(WITHIN_S) == 0, (folder / "said.txt").read_text()[-4000:]
    finally:
        done.kill()
        done.wait()


def begin(machine: Machine, folder: Path, line: list[str], out: IO[str]) -> subprocess.Popen[Any]:
    return start(
        line,
        imports=LEROBOT,
        cwd=folder,
        env=machine.environment,
        stdin=subprocess.DEVNULL,
        stdout=out,
        stderr=subprocess.STDOUT,
    )


@contextmanager
def recording(machine: Machine, folder: Path, *more: str) -> Iterator[tuple[subprocess.Popen[Any], Path]]:
    """Run the page's recording in the block, from its second episode on; yield its process and what it says."""
    said = folder / "said.txt"
    times = ["--dataset.num_episodes=30", "--dataset.episode_time_s=1", "--dataset.reset_time_s=0"]
    # The encoder of a busy machine may starve what reads.
    times += ["--robot.max_age_s=5", "--teleop.max_age_s=5"]
    with said.open("w") as out:
        process = begin(machine, folder, [*commands("lerobot-record"), *times, *more], out)
    try:
        eventually(
            lambda: "Recording episode 1" in said.read_text() or process.poll() is not None, within=WITHIN_S, every=0.1
        )
        assert process.poll() is None, said.read_text()[-4000:]
        yield process, said
    finally:
        process.kill()
        process.wait()


def joints(machine: Machine, peer: str) -> dict[str, float]:
    measured: dict[str, float] = machine.json("call", peer, "getStatus")[1]["robots"]["so100"]
    return measured


@contextmanager
def robot(**options: Any) -> Iterator[StrandsRobot]:
    made = StrandsRobot(StrandsRobotConfig(peer_id="arm-1", **options))
    made.connect()
    try:
        yield made
    finally:
        made.disconnect()


def test_two_episodes_are_recorded_from_a_served_leader(folder: Path) -> None:
    info = json.loads((folder / "far" / "meta" / "info.json").read_text())
    assert info["total_episodes"] == 2
    assert info["total_frames"] > 100
    assert info["features"]["action"]["names"] == [f"{joint}.pos" for joint in JOINTS]
    assert info["features"]["observation.images.wrist"]["shape"] == [480, 640, 3]


def test_a_recording_is_replayed_and_a_robot_is_led(machine: Machine, folder: Path) -> None:
    run(machine, folder, commands("lerobot-replay"))
    answer = machine.json("call", "leader-1", "moveJoints", 'joints={"wrist_roll": 40}', "wait=true")[1]
    assert answer["status"] == "success", answer
    run(machine, folder, commands("lerobot-teleoperate"), "--teleop_time_s=2")
    assert joints(machine, "leader-1")["wrist_roll"] > 0.6
    assert joints(machine, "arm-1")["wrist_roll"] == pytest.approx(joints(machine, "leader-1")["wrist_roll"], abs=0.05)


@pytest.mark.skipif(version("lerobot").startswith("0.4."), reason="lerobot-rollout is of LeRobot 0.6.1")
def test_a_policy_drives_a_served_robot(machine: Machine, tmp_path: Path) -> None:
    tiny.act(tmp_path / "checkpoint", images={"observation.images.wrist": (480, 640)}, joints=len(JOINTS))
    before = joints(machine, "arm-1")
    run(machine, tmp_path, [*commands("lerobot-rollout"), "--return_to_initial_position=false"])
    assert joints(machine, "arm-1") != pytest.approx(before, abs=0.01)


@pytest.mark.parametrize(("either", "stop"), [("device_connect", "stop arm-1"), ("mesh", "estop")], indirect=["either"])
def test_a_recording_holds_its_robot_and_ends_at_a_stop_with_one_sentence_and_its_first_episode(
    either: Machine, stop: str, tmp_path: Path
) -> None:
    with recording(either, tmp_path, "--dataset.root=stopped") as (process, said):
        with pytest.raises(RobotEndedError, match=r"strands-robots.* holds control for"), robot():
            pass
        assert either.run(*stop.split()).returncode == 0
        assert process.wait(WITHIN_S) == 1
    if stop == "estop":
        with pytest.raises(RobotEndedError, match="arm-1 is locked by the emergency stop"), robot():
            pass
        assert either.run("resume", "--local").returncode == 0
    # LeRobot 0.4.4 logs one at its start, about a keyboard that is not there.
    assert "Traceback" not in said.read_text().partition("Stop recording")[2]
    assert "strands: arm-1/so100: The lead of lerobot is over: " in said.read_text().splitlines()[-1]
    assert json.loads((tmp_path / "stopped" / "meta" / "info.json").read_text())["total_episodes"] >= 1


@pytest.fixture(scope="module")
def killed(machine: Machine, tmp_path_factory: pytest.TempPathFactory) -> tuple[float, float]:
    """Pan of the robot 0.3 s after the kill of its recording, and when its leader was further on."""
    with recording(machine, tmp_path_factory.mktemp("killed"), "--dataset.root=killed") as (process, _):
        start = joints(machine, "arm-1")["shoulder_pan"]
        begun = machine.json(
            "call", "leader-1", "moveJoints", 'joints={"shoulder_pan": 100}', "speed=0.05", "wait=false"
        )
        assert begun[1]["status"] == "success", begun
        eventually(lambda: abs(joints(machine, "arm-1")["shoulder_pan"] - start) > 0.05, within=30)
        process.send_signal(signal.SIGKILL)
        process.wait()
        time.sleep(0.3)
        here = joints(machine, "arm-1")["shoulder_pan"]
        leader = joints(machine, "leader-1")["shoulder_pan"]
        eventually(lambda: abs(joints(machine, "leader-1")["shoulder_pan"] - leader) > 0.05, within=30)
        later = joints(machine, "arm-1")["shoulder_pan"]
    assert machine.run("stop", "arm-1").returncode == machine.run("stop", "leader-1").returncode == 0
    return here, later


def test_a_killed_recording_leaves_the_arm_still(killed: tuple[float, float]) -> None:
    here, later = killed
    assert later == pytest.approx(here, abs=0.01)


def test_a_real_arm_is_led_once_its_lease_and_its_lead_are_approved(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    there = Machine(tmp_path / "state")
    join(there, monkeypatch)
    calibration = write_calibration(tmp_path / "calibration.json")
    with BusProcess(tmp_path / "ttyACM0") as bus:
        words = ["so101", "--peer-id", "arm-1", "--port", bus.port, "--rpc-allow", "strands-robots", "--json"]
        options = ["--set", f"calibration={calibration}", "--set", f"calibration_dir={tmp_path}"]
        line = [sys.executable, "-m", "fixtures.feetech_bus.patient", "strands_robots.cli", "serve", *words, *options]
        with start(line, imports=LEROBOT, env=there.environment, stdout=subprocess.PIPE, text=True) as served:
            try:
                assert served.stdout is not None
                assert "serving" in served.stdout.readline()
                with pytest.raises(RobotEndedError, match="needs operator approval"), robot():
                    pass
                for verb in ("acquireControl", "lead"):
                    assert there.run("grant", f"{verb}@arm-1").returncode == 0
                with robot() as arm:
                    goal = arm.get_observation()["wrist_roll.pos"] + 5.0

                    def there_now() -> bool:
                        arm.send_action({"wrist_roll.pos": goal})
                        return bool(arm.get_observation()["wrist_roll.pos"] == pytest.approx(goal, abs=1.0))

                    eventually(there_now, within=30, every=0.03)
            finally:
                served.terminate()


@pytest.mark.usefixtures("killed")
def test_the_robot_of_a_killed_recording_is_free_again(machine: Machine) -> None:
    # The tests above leave it the time of its lease.
    eventually(
        lambda: not machine.json("call", "arm-1", "getStatus")[1]["control"]["held"], within=30, what="the lease"
    )


def test_another_holder_is_named_and_its_robot_left_alone(machine: Machine) -> None:
    with robot(camera_names=[]), pytest.raises(RobotEndedError, match=r"strands-robots .* holds control"):
        StrandsRobot(StrandsRobotConfig(peer_id="arm-1", camera_names=[])).connect()


@pytest.mark.usefixtures("either")
def test_an_action_goes_on_after_a_pause_and_returns_what_was_written() -> None:
    with robot(camera_names=["overview", "so100/wrist"], camera_width=320, camera_height=240) as arm:
        assert set(arm.observation_features) == {*(f"{joint}.pos" for joint in JOINTS), "overview", "wrist"}
        seen = arm.get_observation()
        assert seen["wrist"].shape == arm.observation_features["wrist"] == (240, 320, 3)
        assert seen["wrist"].dtype == np.uint8
        start = seen["gripper.pos"]
        for goal in (start + 0.1, start - 0.1):

            def written(goal: float = goal) -> bool:
                sent = arm.send_action({"gripper.pos": goal})["gripper.pos"]
                at = arm.get_observation()["gripper.pos"]
                return sent == pytest.approx(goal) and at == pytest.approx(goal, abs=0.02)

            eventually(written, within=20, every=0.03)
            time.sleep(3 * arm.config.pause_s)
        with pytest.raises(ValueError, match=r"no joint elbow\.pos"):
            arm.send_action({"elbow.pos": 1.0})


def test_an_unknown_camera_and_an_unknown_robot_are_named(machine: Machine) -> None:
    with pytest.raises(RobotEndedError, match=r"camera_names must be of .*so100/wrist.*, not attic"):
        StrandsRobot(StrandsRobotConfig(peer_id="arm-1", camera_names=["attic"])).connect()
    with pytest.raises(RobotEndedError, match="arm-9"):
        StrandsRobot(StrandsRobotConfig(peer_id="arm-9")).connect()
    with pytest.raises(ValueError, match="peer_id must name a robot"):
        StrandsRobot(StrandsRobotConfig(peer_id=""))


@pytest.mark.usefixtures("machine")
def test_a_command_that_has_ended_joins_no_network_again() -> None:
    leader = StrandsTeleoperator(StrandsTeleoperatorConfig(peer_id="leader-1"))
    leader.connect()
    try:
        for leave in tuple(at_end):
            leave()
        with pytest.raises(RobotEndedError, match="the state of leader-1 is"):
            eventually(lambda: not leader.get_action(), every=0.03)
        assert not at_end
    finally:
        leader.disconnect()


def test_what_is_too_old_is_refused_by_name() -> None:
    values = iter([(7, 0.0)])

    def read() -> tuple[int, float]:
        for value in values:
            return value
        raise ValueError("the lens is covered.")

    newest = Newest("the picture of arm-1's camera front", read, 100.0, 0.2)
    try:
        assert newest.first() == 7
        eventually(lambda: newest.age_s > 0.2)
        with pytest.raises(RobotEndedError, match=r"camera front is \d+ ms old and may be 200: the lens is covered\.$"):
            newest.take()
    finally:
        newest.close()


def test_joints_have_lerobots_names() -> None:
    assert [feature(name) for name in ("gripper", "gripper.pos", "x.vel")] == ["gripper.pos", "gripper.pos", "x.vel"]


def test_the_page_names_each_option() -> None:
    own = {name for each in ("robot", "teleoperator") for name in _options(each)}
    assert own == set(re.findall(r"`(\w+)`", PAGE.partition("## Options")[2].partition("- **Names")[0])) - {
        "listCameras",
        "WORLD",
    }


def _options(kind: str) -> list[str]:
    module = importlib.import_module(f"lerobot_{kind}_strands")
    config = getattr(module, "StrandsRobotConfig" if kind == "robot" else "StrandsTeleoperatorConfig")
    return [name for name in config.__dataclass_fields__ if name not in {"id", "calibration_dir"}]
