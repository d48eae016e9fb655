"""Peers in real processes over real Zenoh on loopback."""

from __future__ import annotations

import signal
import time
from pathlib import Path

from fixtures.waiting import accepts, eventually
from tests.integration.mesh.conftest import Join

from strands_robots.mesh.resume_authority import keygen
from strands_robots.mesh.session import PEER_TIMEOUT
from strands_robots.safety.persistence import LockoutStore


def test_two_processes_without_configuration_see_and_command_each_other(join: Join) -> None:
    arm, sim = join("arm-1", "arm"), join("sim-1")
    arm.sees("sim-1")
    sim.sees("arm-1")
    assert arm.ask("ping", "sim-1")["status"] == "ok"
    command = {"action": "start", "instruction": "wave", "policy_provider": "mock"}
    assert arm.ask("send", "sim-1", command, 20)["result"]["status"] == "success"
    assert sim.ask("moving") == ["left"]
    refused = sim.ask("send", "arm-1", command, 20)
    assert "operator approval" in refused["error"]
    assert arm.ask("zid", "sim-1") != sim.ask("zid", "arm-1")


def test_killed_peer_is_gone_long_before_its_heartbeat_is_missed_and_may_return(join: Join) -> None:
    hub, child = join("hub", "none"), join("child")
    hub.sees("child")
    child.kill()
    rows = eventually(lambda: [row for row in hub.ask("peers") if not row["reachable"]], what="it is seen gone")
    assert [row["peer_id"] for row in rows] == ["child"]
    assert rows[0]["age"] < PEER_TIMEOUT
    again = join("child")
    hub.sees("child")
    assert hub.ask("ping", "child")["status"] == "ok"
    again.sees("hub")


def test_the_children_of_a_dead_hub_find_each_other_again(join: Join, port: int) -> None:
    hub = join("hub", "none")
    children = [join(f"child-{number}") for number in range(3)]
    for child in children:
        child.sees(*(other.peer_id for other in children if other is not child))
    hub.kill()
    eventually(lambda: accepts(port), what="a survivor takes the port")
    eventually(lambda: children[0].ask("ping", "child-1", 0.5)["status"] == "ok")
    eventually(lambda: children[1].ask("ping", "child-2", 0.5)["status"] == "ok")
    # A process that comes later, the old hub's included, finds the survivor.
    late = join("hub", "none")
    late.sees("child-0", "child-1", "child-2")
    eventually(lambda: late.ask("ping", "child-2", 0.5)["status"] == "ok")


def test_suspended_peer_is_out_of_reach_until_it_continues(join: Join) -> None:
    hub, child = join("hub", "none"), join("child")
    hub.sees("child")
    child.signal(signal.SIGSTOP)
    eventually(lambda: "child" not in hub.ask("reachable"))
    child.signal(signal.SIGCONT)
    hub.sees("child")


def test_an_emergency_stop_halts_and_locks_every_process_until_the_signed_resume(join: Join, tmp_path: object) -> None:
    key, passphrase = f"{tmp_path}/operator.pem", "Correct-Horse-7-Battery"
    trusted = {"STRANDS_MESH_RESUME_PUBLIC_KEY": keygen(key, passphrase)}
    console = join("console", "none", **trusted)
    robots = [join(f"arm-{number}", "arm", **trusted) for number in range(4)]
    console.sees(*(robot.peer_id for robot in robots))
    for robot in robots:
        robot.ask("start", "wave")
    issued, answers = console.ask("estop")
    assert sorted(answer["responder_id"] for answer in answers) == [robot.peer_id for robot in robots]
    epoch = console.ask("epoch")
    for robot in robots:
        assert robot.ask("epoch") == epoch
        assert robot.ask("moving") is False
        assert robot.ask("halts")[1] >= issued
    refused = console.ask("send", "arm-0", {"action": "start", "policy_provider": "mock"}, 20)
    assert refused["error"] == "command rejected"
    assert console.ask("send", "arm-0", {"action": "status"}, 20)["type"] == "response"
    assert console.ask("resume", key, passphrase) == {"status": "ok"}
    for robot in robots:
        eventually(lambda robot=robot: robot.ask("epoch") is None, what=f"{robot.peer_id} is free")
    assert console.ask("epoch") is None


def test_a_fleet_stops_right_after_its_hub_died(join: Join) -> None:
    hub, console = join("hub", "none"), join("console", "none")
    robots = [join(f"arm-{number}", "arm") for number in range(2)]
    console.sees("arm-0", "arm-1")
    hub.kill()
    killed = time.time()
    eventually(lambda: console.ask("ping", "arm-0", 0.3)["status"] == "ok")
    console.ask("estop")
    for robot in robots:
        eventually(lambda robot=robot: robot.ask("epoch"))
        eventually(lambda robot=robot: robot.ask("halts")[1] >= killed)


def test_a_locked_robot_comes_back_locked_from_a_restart(join: Join, tmp_path: Path) -> None:
    console, robot = join("console", "none"), join("arm-1", "arm")
    console.sees("arm-1")
    console.ask("estop")
    eventually(lambda: robot.ask("epoch"))
    epoch = robot.ask("epoch")
    # It is locked at once and stored a moment later, because no disk may delay a halt.
    stored = LockoutStore(tmp_path / "arm-1")
    eventually(lambda: [each.state.epochs for each in stored.load_all().values()] == [(epoch,)])
    robot.kill()
    assert join("arm-1", "arm").ask("epoch") == epoch


def test_leaving_and_joining_again_leaves_no_thread(join: Join) -> None:
    peer = join("sim-1")
    # Some threads begin with the first thing that they have to do.
    assert peer.ask("restart") is True
    before = peer.ask("threads")
    for _ in range(3):
        assert peer.ask("restart") is True
    eventually(lambda: len(peer.ask("threads")) <= len(before))
    mine = [name for name in before if "sim-1" in name or name.startswith("mesh")]
    assert len(mine) <= 6


def test_a_leader_in_another_process_moves_the_follower_until_it_is_stopped(join: Join) -> None:
    follower = join("arm-1", "arm", STRANDS_ROBOT_COMMAND_ALLOW="teleop_receive@arm-1")
    leader = join("leader-1", "none")
    leader.sees("arm-1")
    follower.sees("leader-1")
    receive = {"action": "teleop_receive", "source_peer_id": "leader-1"}
    assert leader.ask("send", "arm-1", receive, 20)["result"]["status"] == "success"

    def lead(first: int, count: int) -> None:
        for number in range(first, first + count):
            frame = {"peer_id": "leader-1", "device": "leader", "method": "arm", "t": time.time(), "seq": number}
            leader.ask("frame", "strands/leader-1/input/leader", {**frame, "action": {"j": number / 10}})
            time.sleep(0.02)

    # One after another: delayed frames that arrive together may be dropped.
    for number in range(20):
        lead(number, 1)
        eventually(lambda number=number: len(follower.ask("actions")) == number + 1)
    assert leader.ask("send", "arm-1", {"action": "stop"}, 20)["result"]["ok"] is True
    lead(20, 5)
    assert len(follower.ask("actions")) == 20
