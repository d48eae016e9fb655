"""``dataset record`` of a robot that another process serves."""

from __future__ import annotations

import json
import os
import signal
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from unittest import mock

import pytest
from fixtures.command_line import COMMAND
from fixtures.leaders import write_csv
from fixtures.terminal import Terminal
from fixtures.waiting import eventually, free_port
from typer.testing import CliRunner

from strands_robots.cli.app import build
from strands_robots.cli.dataset import served_robot
from strands_robots.cli.network import Network
from strands_robots.cli.output import Screen
from strands_robots.datasets import tables
from strands_robots.datasets.check import check_dataset
from strands_robots.datasets.layout import data_file
from strands_robots.errors import RefusalError
from strands_robots.fleet import Fleet
from strands_robots.fleet.remote_robot import RemoteRobot
from strands_robots.recording.file import Recorder, read_events


@pytest.fixture(autouse=True)
def environment() -> Iterator[None]:
    """The settings of before: the commands that run here put theirs into this process."""
    with mock.patch.dict(os.environ):
        yield


@contextmanager
def arm(*network: str) -> Iterator[None]:
    """An SO-100 of another process as ``arm-1``."""
    child = subprocess.Popen(
        [*COMMAND, "serve", "so100", "--peer-id", "arm-1", "--json", *network], stdout=subprocess.PIPE
    )
    try:
        eventually(lambda: on("peers", *network, code=None)[0] == 0, within=60)
        yield
    finally:
        child.kill()
        child.communicate()


def on(command: str, *words: str, code: int | None = 0) -> tuple[int, list[dict[str, object]]]:
    """Run a command here; return its exit code, and what it told."""
    done = CliRunner().invoke(build(command), [command, *words, "--json"])
    assert code in (None, done.exit_code), done.output
    lines = [line for line in done.output.splitlines() if line.startswith("{")]
    return done.exit_code, [json.loads(line) for line in lines]


def recording(folder: Path, *more: str) -> subprocess.Popen[str]:
    line = ["dataset", "record", str(folder), "--robot", "arm-1", "--task", "wave", "--json", *more]
    return subprocess.Popen([*COMMAND, *line], stdout=subprocess.PIPE, text=True)


def told(child: subprocess.Popen[str]) -> list[dict[str, object]]:
    output, _ = child.communicate(timeout=60)
    return [json.loads(line) for line in output.splitlines()]


def running(folder: Path) -> None:
    attempt = folder / ".running" / "attempt-000000.mcap"
    eventually(lambda: attempt.exists() and attempt.stat().st_size > 2000, within=60)


@pytest.mark.parametrize("network", [(), ("--mesh",)], ids=["device_connect", "mesh"])
def test_policy_that_a_served_robot_runs_is_recorded_attempt_by_attempt(
    tmp_path: Path, network: tuple[str, ...]
) -> None:
    folder, at = tmp_path / "set", ("--port", str(free_port()), *network)
    with arm(*at):
        line = ("--policy", "mock", "--cameras", "none", "--episodes", "2", "--episode-s", "1", "--pause-s", "0")
        rows = told(recording(folder, *line, *at))
    assert [each["event"] for each in rows] == ["saved", "saved", "dataset"]
    info, found = check_dataset(folder)
    assert (info.episodes, [each for each in found if each.wrong]) == (2, [])
    for number in range(2):
        frames = tables.read_frames(folder / data_file(number))
        assert len(frames["index"]) > 3
        assert set(frames["stop"].tolist()) == {0}, "the end of an attempt is no stop"
        assert frames["action"].std(axis=0).max() > 0, "it moves"


@pytest.mark.parametrize("network", [(), ("--mesh",)], ids=["device_connect", "mesh"])
def test_leader_here_leads_a_served_robot_and_takes_over_from_its_policy(
    tmp_path: Path, network: tuple[str, ...]
) -> None:
    folder, at = tmp_path / "set", ("--port", str(free_port()), *network)
    leader = tmp_path / "lead.csv"
    still = [(step / 50, {"shoulder_pan": 0.0}) for step in range(50)]
    write_csv(leader, [*still, *((1 + step / 50, {"shoulder_pan": step / 50}) for step in range(50))])
    words = ("--leader", str(leader), "--cameras", "none", "--episodes", "1", "--episode-s", "20", "--success")
    with arm(*at):
        rows = told(recording(folder, *words, *at))
        assert [each["event"] for each in rows if each["event"] not in ("turn", "progress")] == ["saved", "dataset"]
        rows = told(recording(folder, *words, "--policy", "mock", *at))
        # A busy machine may hold the robot between two of them.
        drivers = (each["state"] for each in rows if each["event"] == "turn")
        assert all(state in drivers for state in ("policy", "led"))
    info, found = check_dataset(folder)
    assert (info.episodes, [each for each in found if each.wrong]) == (2, [])
    led, turns = (tables.read_frames(folder / data_file(number)) for number in range(2))
    assert led["observation.state"][-1][0] > 0.4
    assert led["next.success"][-1]
    assert not led["intervention"].any(), "a recording is no person"
    began = int(turns["intervention"].argmax())
    assert 0 < began < len(turns["intervention"]) - 5
    assert turns["intervention"][began:].mean() > 0.5, (
        "the leader leads from there, but for the holds of a busy machine"
    )
    moved = turns["action"][began][0] - turns["observation.state"][began][0]
    assert abs(moved) < 0.2


@pytest.mark.system
def test_pictures_of_a_served_robot_are_recorded_with_their_ages(tmp_path: Path) -> None:
    folder, at = tmp_path / "set", ("--port", str(free_port()))
    with arm(*at):
        told(recording(folder, "--policy", "mock", "--episodes", "1", "--episode-s", "2", *at))
    info, found = check_dataset(folder)
    assert ([name.rpartition(".")[2] for name in info.videos], [each for each in found if each.wrong]) == (
        ["wrist"],
        [],
    )
    ages = next(values for name, values in tables.read_frames(folder / data_file(0)).items() if "age_ms.so100" in name)
    assert ages.min() >= 0


def test_what_others_have_it_do_is_one_episode_and_a_stop_is_in_it(tmp_path: Path) -> None:
    folder, at = tmp_path / "set", ("--port", str(free_port()))
    with arm(*at):
        child = recording(folder, "--leader", "page", "--cameras", "none", "--episode-s", "60", *at)
        try:
            running_dir = folder / ".running"
            eventually(lambda: any(running_dir.glob("*.mcap")), within=60)
            for way in ("dx=0.02", "dz=-0.02"):
                on("call", "arm-1", "moveBy", way, *at)
            running(folder)
            on("call", "arm-1", "execute", "instruction=wave", "policy_provider=mock", "duration=30", *at)
            size = (running_dir / "attempt-000000.mcap").stat().st_size
            eventually(lambda: (running_dir / "attempt-000000.mcap").stat().st_size > size + 4000, within=30)
            # The recorder answers as well, before it goes.
            on("estop", *at)
            rows = told(child)
        finally:
            child.kill()
            child.communicate()
        assert [each.get("event", each.get("status")) for each in rows] == ["saved", "held", "error"]
        assert "locked by an emergency stop" in str(rows[1]["stopped_by"])
        refused = told(recording(folder, "--policy", "mock", "--cameras", "none", "--episode-s", "1", *at))
        assert "locked" in str(refused[-1]["reason"])
    frames = tables.read_frames(folder / data_file(0))
    assert frames["stop"][-1] == 2
    assert not frames["next.success"].any()


@pytest.mark.parametrize("mesh", [False, True], ids=["device_connect", "mesh"])
def test_motion_that_a_locked_robot_refuses_is_told_to_the_recorder(tmp_path: Path, mesh: bool) -> None:
    port = free_port()
    at = ("--port", str(port), *(["--mesh"] if mesh else []))
    file = tmp_path / "a.mcap"
    with (
        arm(*at),
        served_robot(Screen(), Network(port=port, mesh=mesh), "arm-1", "", "", ["none"], None) as far,
        Recorder(file, joints_of_events=False) as recorder,
        far.recorded(recorder, 30, None),
    ):
        on("estop", *at, code=None)
        on("call", "arm-1", "execute", "instruction=wave", "policy_provider=mock", "duration=3", *at, code=None)
        eventually(lambda: recorder.counts["/arm-1/motionRefused"] > 0, within=10)
    told = {each.event: each.payload for each in read_events(file)}
    assert told["motionRefused"]["verb"] == "execute"
    assert told["jointUnits"]["units"]["shoulder_pan"] == "radians"


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (("--episode-s", "1"), "give --leader, --policy, or both"),
        (("--policy", "mock", "--leader", "page", "--episode-s", "1"), "not with page"),
        (("--robot", "so100", "--policy", "mock", "--no-network"), "--episode-s is needed without a terminal"),
        (("--policy", "mock", "--episode-s", "1", "--peer-id", "x"), "the id of a served robot, without options"),
        (("--leader", "gamepad", "--episode-s", "1", "--no-network"), "is led by its id, over a network"),
        (("--leader", "mesh:lead-1", "--episode-s", "1"), "--leader must be of this machine"),
        (("--policy", "mock", "--leader-id", "x", "--episode-s", "1"), "go with a leader arm"),
    ],
)
def test_what_a_served_robot_cannot_be_recorded_with_is_refused(
    tmp_path: Path, words: tuple[str, ...], why: str
) -> None:
    line = ["dataset", "record", str(tmp_path / "set"), "--robot", "arm-1", "--task", "wave", "--json", *words]
    done = CliRunner().invoke(build("dataset"), line)
    assert done.exit_code != 0
    assert why in done.output
    assert not (tmp_path / "set").exists()


def test_robot_of_a_world_is_halted_when_the_recorder_of_its_policy_is_killed(tmp_path: Path) -> None:
    folder, at = tmp_path / "set", ("--port", str(free_port()))
    with arm(*at):
        line = ("--policy", "mock", "--cameras", "none", "--episode-s", "60", *at)
        child = recording(folder, *line)
        try:
            running(folder)
        finally:
            child.kill()
            child.communicate()
        eventually(lambda: not on("call", "arm-1", "getStatus", *at)[1][-1]["running_policies"], within=10)
        rows = told(
            recording(folder, "--policy", "mock", "--cameras", "none", "--episodes", "1", "--episode-s", "1", *at)
        )
        other = told(recording(folder, "--robot", "arm-1/left", "--policy", "mock", "--episode-s", "1", *at))
    assert [each["event"] for each in rows] == ["saved", "dataset"]
    assert check_dataset(folder)[0].episodes == 2, "what was running when it was killed is the first"
    assert "--robot must be one of arm-1/so100, not 'arm-1/left'" in str(other[-1]["reason"])


def test_operator_who_was_cut_off_grips_again_and_the_attempt_is_one_episode(tmp_path: Path) -> None:
    folder, at = tmp_path / "set", ("--port", str(free_port()))
    with arm(*at):
        words = ("--robot", "arm-1", "--policy", "mock", "--leader", "keyboard", "--task", "wave", "--episodes", "1")
        seat = Terminal("dataset", "record", str(folder), *words, "--cameras", "none", *at)
        try:
            seat.shows("Enter begins")
            seat.press("\n")
            seat.shows("The policy drives.")
            running(folder)
            seat.press_until("qq", "The leader leads.")
            seat.child.send_signal(signal.SIGSTOP)
            rests(at)
            seat.child.send_signal(signal.SIGCONT)
            seat.shows("Held: no fresh command of keyboard has come")
            seat.press_until("v", "The leader leads.")
            seat.press("qq")
            seat.press_until("v", "The policy drives.")
            seat.press("\n")
            seat.shows("a success")
            assert seat.child.wait(30) == 0
        finally:
            seat.close()
    info, found = check_dataset(folder)
    assert (info.episodes, [each for each in found if each.wrong]) == (1, [])
    frames = tables.read_frames(folder / data_file(0))
    assert frames["intervention"].any()
    assert not frames["intervention"].all()
    assert (set(frames["stop"].tolist()), bool(frames["next.success"][-1])) == ({0}, True), "a hold is no stop"


def rests(at: tuple[str, ...]) -> None:
    """Wait until the arm has not moved between two looks."""
    seen: list[object] = []

    def still() -> bool:
        # A busy machine may not find it at once.
        code, answers = on("call", "arm-1", "getPose", *at, code=None)
        if code == 0:
            seen.append(answers[-1]["joints"])
        return len(seen) > 1 and seen[-1] == pytest.approx(seen[-2], abs=0.05)

    eventually(still, within=40)


def say(recorder: RemoteRobot, state: str, verb: str, **arguments: object) -> None:
    """Say a word once the recording is in a state; an attempt has some frames by then."""

    def ready() -> bool:
        told = recorder.call("getRecording")
        return told["state"] == state and (state == "waiting" or told["frames"] > 5)

    eventually(ready, within=60, what=state)
    recorder.call(verb, **arguments)


@pytest.mark.parametrize("mesh", [False, True], ids=["device_connect", "mesh"])
def test_page_begins_and_judges_the_attempts_of_a_recording_without_a_terminal(tmp_path: Path, mesh: bool) -> None:
    folder, port = tmp_path / "set", free_port()
    at = ("--port", str(port), *(["--mesh"] if mesh else []))
    # Of another process, and of the recording's own.
    words = ("--robot", "so100", "--peer-id", "arm-1") if mesh else ()
    with ExitStack() as stack:
        if not mesh:
            stack.enter_context(arm(*at))
        child = recording(folder, *words, "--policy", "mock", "--cameras", "none", *at)
        stack.callback(child.communicate)
        stack.callback(child.kill)
        eventually(lambda: "recorder-arm-1" in str(on("peers", *at, code=None)[1]), within=60)
        refused = on("call", "recorder-arm-1", "beginEpisode", *at, code=1)[1][-1]
        assert ("needs operator approval" if mesh else "no entry of DEVICE_CONNECT_RPC_ALLOW") in str(refused["reason"])
        there = stack.enter_context(Network(port=port, mesh=mesh).joined(source="dashboard"))
        recorder = Fleet(there)["recorder-arm-1"]
        say(recorder, "waiting", "beginEpisode")
        with pytest.raises(RefusalError, match="beginEpisode is refused"):
            recorder.call("beginEpisode")
        say(recorder, "recording", "redoEpisode")
        for success in (True, False):
            say(recorder, "waiting", "beginEpisode")
            say(recorder, "recording", "keepEpisode", success=success)
        if not mesh:
            refused = on("call", "recorder-arm-1", "endRecording", *at, code=1)[1][-1]
            assert "no entry of DEVICE_CONNECT_RPC_ALLOW fits it" in str(refused["reason"])
        say(recorder, "waiting", "endRecording")
        rows = told(child)
    assert [each["event"] for each in rows if each["event"] != "progress"] == ["saved", "saved", "dataset"]
    info, found = check_dataset(folder)
    assert (info.episodes, [each for each in found if each.wrong]) == (2, [])
    worth = [bool(tables.read_frames(folder / data_file(number))["next.success"][-1]) for number in range(2)]
    assert worth == [True, False]
