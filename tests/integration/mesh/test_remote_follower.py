"""A recording leads a follower of another process over the mesh."""

from __future__ import annotations

import json
import signal
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from fixtures.command_line import COMMAND
from fixtures.forked import COMMANDS, start
from fixtures.leaders import write_csv
from fixtures.mesh_peer import MeshPeer, share_console_key
from fixtures.waiting import eventually

Join = Callable[..., MeshPeer]


@pytest.fixture
def wave(tmp_path: Path) -> Path:
    """Twenty seconds of a joint of these followers; it moves for ten of them."""
    frames = [(0.1 * step, {"shoulder.pos": min(0.1 * step, 10.0)}) for step in range(200)]
    write_csv(tmp_path / "wave.csv", frames)
    return tmp_path / "wave.csv"


@pytest.fixture
def replay(port: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.setenv("STRANDS_MESH_PORT", str(port))
    monkeypatch.setenv("STRANDS_STATE_DIR", str(tmp_path))
    share_console_key(tmp_path)

    def replaying(*arguments: str) -> subprocess.Popen[str]:
        pipes: Any = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
        return start([*COMMAND, "replay", *arguments, "--json"], imports=COMMANDS, **pipes)

    return replaying


def ended(replaying: subprocess.Popen[str]) -> tuple[int, list[dict[str, Any]]]:
    out, problems = replaying.communicate(timeout=90)
    assert "Traceback" not in problems, problems
    return replaying.returncode, [json.loads(line) for line in out.splitlines()]


def followed(arm: MeshPeer, least: int) -> None:
    eventually(lambda: len(arm.ask("actions")) >= least, what="the follower is led")


def test_an_approved_arm_is_led_to_the_end_and_stopped(join: Join, replay: Any, wave: Path) -> None:
    arm = join("arm-1", "arm", STRANDS_ROBOT_COMMAND_ALLOW="teleop_receive")
    code, [report] = ended(replay(str(wave), "--to", "mesh:arm-1", "--speed", "10"))
    assert (code, report["stopped"], report["errors"]) == (0, True, 0), report
    actions = [action["shoulder.pos"] for action in arm.ask("actions")]
    assert actions == sorted(actions)
    assert actions[-1] == pytest.approx(10.0)
    assert len(arm.ask("halts")[0]) == 1


def test_without_approval_nothing_moves_and_the_command_that_approves_is_named(
    join: Join, replay: Any, wave: Path
) -> None:
    arm = join("arm-1", "arm")
    code, [report] = ended(replay(str(wave), "--to", "mesh:arm-1"))
    assert code == 1
    assert "teleop_receive" in report["reason"]
    assert "grant" in report["reason"]
    assert arm.ask("actions") == []


def test_an_emergency_stop_ends_the_replay_and_nothing_follows(join: Join, replay: Any, wave: Path) -> None:
    arm = join("arm-1", "arm", STRANDS_ROBOT_COMMAND_ALLOW="teleop_receive")
    console = join("console-1", "none")
    console.sees("arm-1")
    replaying = replay(str(wave), "--to", "mesh:arm-1")
    followed(arm, 10)
    console.ask("estop")
    count = len(arm.ask("actions"))
    code, lines = ended(replaying)
    assert code == 1
    assert "stopped following: it was halted or locked" in lines[-1]["reason"]
    assert lines[0]["stopped"] is True
    assert len(arm.ask("actions")) == count


@pytest.mark.parametrize("end", [signal.SIGINT, signal.SIGTERM])
def test_end_of_the_command_stops_the_follower_first(join: Join, replay: Any, wave: Path, end: signal.Signals) -> None:
    arm = join("arm-1", "arm", STRANDS_ROBOT_COMMAND_ALLOW="teleop_receive")
    replaying = replay(str(wave), "--to", "mesh:arm-1")
    followed(arm, 10)
    replaying.send_signal(end)
    code, [report] = ended(replaying)
    assert (code, report["why"], report["stopped"]) == (0, "Ctrl-C.", True)
    assert len(arm.ask("halts")[0]) == 1


def test_lost_follower_is_reported_as_not_having_answered_the_stop(join: Join, replay: Any, wave: Path) -> None:
    arm = join("arm-1", "arm", STRANDS_ROBOT_COMMAND_ALLOW="teleop_receive")
    replaying = replay(str(wave), "--to", "mesh:arm-1")
    followed(arm, 5)
    arm.kill()
    code, [report] = ended(replaying)
    assert code in (1, 3)
    assert "stop" in report["reason"]
    assert "arm-1" in report["reason"]


def test_absent_follower_is_reported_in_one_sentence(replay: Any, wave: Path) -> None:
    code, [report] = ended(replay(str(wave), "--to", "mesh:absent-1"))
    assert code == 3
    assert "absent-1" in report["reason"]


def test_a_leader_that_is_published_drives_a_robot_of_this_machine(replay: Any, wave: Path, tmp_path: Path) -> None:
    write_csv(tmp_path / "pan.csv", [(0.1 * step, {"shoulder_pan": 0.01 * step}) for step in range(1200)])
    leading = subprocess.Popen(
        [*COMMAND, "teleop", str(tmp_path / "pan.csv"), "so100", "--publish", "lead-1", "--json"],
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        line = ["teleop", "mesh:lead-1", "so100", "--for", "3", "--json"]

        def following() -> list[dict[str, Any]]:
            done = subprocess.run([*COMMAND, *line], stdout=subprocess.PIPE, text=True, check=False, timeout=90)
            return [json.loads(each) for each in done.stdout.splitlines()] if done.returncode == 0 else []

        [report] = eventually(following, what="the leader is on the mesh")
    finally:
        leading.kill()
        leading.communicate()
    assert report["stopped"] is True
    assert report["frames_received"] > 10
    assert (report["errors"], report["rejected"]) == (0, 0)


def test_leader_is_published_without_a_local_follower(replay: Any, wave: Path) -> None:
    line = [*COMMAND, "teleop", str(wave), "none", "--for", "2", "--json"]
    done = subprocess.run([*line, "--publish", "lead-1"], stdout=subprocess.PIPE, text=True, check=True, timeout=90)
    report = json.loads(done.stdout)
    assert report["frames"] > 10
    assert report["errors"] == 0
    refused = subprocess.run(line, stdout=subprocess.PIPE, text=True, check=False, timeout=90)
    assert refused.returncode == 2
    assert "--publish" in json.loads(refused.stdout)["reason"]
