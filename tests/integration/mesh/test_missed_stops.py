"""Arms that were frozen or cut off while a stop came, on a real mesh: they ask, and are locked by the original."""

from __future__ import annotations

import contextlib
import json
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import zenoh
from fixtures.mesh_peer import MeshPeer
from fixtures.roster_robots import RosterRobots
from fixtures.tcp_proxy import TcpProxy
from fixtures.waiting import eventually, free_port
from tests.integration.mesh.conftest import Join

from strands_robots.mesh.transport.config import Posture
from strands_robots.mesh.transport.zenoh import ZenohTransport

LEASE_S = 4.0
STRANGERS = 10_000

Serve = Callable[..., RosterRobots]


@pytest.fixture
def serve(port: int, tmp_path: Path) -> Iterator[Serve]:
    """Serve an arm that moves in a process and a state directory of its own."""
    with contextlib.ExitStack() as stack:

        def start(name: str, *, moves: bool = True, **settings: str) -> RosterRobots:
            state = tmp_path / name
            state.mkdir(mode=0o700, exist_ok=True)
            base = {"STRANDS_MESH": "true", "STRANDS_MESH_PORT": str(port), "STRANDS_STATE_DIR": str(state)}
            robot = RosterRobots(None, tmp_path, [name], {**base, **settings})
            stack.callback(robot.close)
            if moves:
                robot.ask("move")
            return robot

        yield start


def meet(console: MeshPeer, *robots: RosterRobots) -> None:
    names = [robot.ids[0] for robot in robots]
    console.sees(*names)
    for robot in robots:
        others = {"console", *names} - {robot.ids[0]}
        eventually(lambda robot=robot, others=others: others <= set(robot.ask("reachable")), what="all see all")


def stop_and_leave(console: MeshPeer, witness: RosterRobots) -> str:
    """Stop everything in reach, and end the console; return the stop's id."""
    console.ask("estop")
    epoch = str(console.ask("epoch"))
    eventually(lambda: witness.ask("epochs")[witness.ids[0]] == [epoch], what="the witness is locked")
    console.kill()
    return epoch


def locked_and_still(robot: RosterRobots, epoch: str, since: float) -> None:
    """Wait for the lock, and require that no write came after it."""
    name = robot.ids[0]
    eventually(lambda: robot.ask("epochs")[name] == [epoch], what=f"{name} is locked by the stop that it missed")
    # It is noted on a thread of its own, which may have read its clock before the process was frozen.
    locked = max(since, eventually(lambda: robot.locked_at(name), what="the note of the lock"))
    time.sleep(0.5)
    # A write may be in flight, and a busy machine gives the processor to others first.
    assert robot.writes(name, locked + 0.2) == []
    assert robot.ask("moving") == []


@pytest.mark.parametrize("frozen_s", [0.8, LEASE_S + 2.0], ids=["within its lease", "beyond its lease"])
def test_frozen_robot_is_locked_when_it_wakes_and_the_console_is_gone(
    join: Join, serve: Serve, frozen_s: float
) -> None:
    console, witness, robot = join("console", "none"), serve("arm-0"), serve("arm-1")
    meet(console, witness, robot)
    robot.freeze()
    began = time.monotonic()
    epoch = stop_and_leave(console, witness)
    time.sleep(max(0.0, began + frozen_s - time.monotonic()))
    locked_and_still(robot, epoch, robot.wake())


def test_robot_behind_a_cut_link_is_locked_when_the_link_is_back(join: Join, serve: Serve, port: int) -> None:
    with TcpProxy(port) as proxy:
        # The first process is the hub. Gossip gives a client of it no other way around the proxy.
        witness, console = serve("arm-0"), join("console", "none")
        robot = serve("arm-1", STRANDS_MESH_PORT=str(proxy.port))
        meet(console, witness, robot)
        proxy.state = "refusing"
        eventually(lambda: "console" not in robot.ask("reachable"), within=30, what="the robot is cut off")
        since = time.monotonic()
        epoch = stop_and_leave(console, witness)
        assert robot.ask("epochs")["arm-1"] == []
        # The loss of its link may hold the motions for a moment.
        eventually(lambda: robot.writes("arm-1", since), what="nothing stops a robot that is cut off")
        proxy.state = "passing"
        locked_and_still(robot, epoch, since)


def test_robot_that_redials_all_the_time_is_locked_once_it_is_subscribed(join: Join, serve: Serve, port: int) -> None:
    with TcpProxy(port) as proxy:
        witness, console = serve("arm-0"), join("console", "none")
        robot = serve("arm-1", STRANDS_MESH_PORT=str(proxy.port))
        meet(console, witness, robot)
        over = threading.Event()

        def redial() -> None:
            while not over.wait(0.7):
                proxy.state = "refusing" if proxy.state == "passing" else "passing"

        flapping = threading.Thread(target=redial, name="redial", daemon=True)
        proxy.state = "refusing"
        eventually(lambda: "console" not in robot.ask("reachable"), within=30, what="the robot is cut off")
        epoch = stop_and_leave(console, witness)
        since = time.monotonic()
        flapping.start()
        time.sleep(4.0)
        over.set()
        flapping.join(20)
        proxy.state = "passing"
        locked_and_still(robot, epoch, since)


def test_robot_that_was_killed_asks_when_it_is_served_again(join: Join, serve: Serve, tmp_path: Path) -> None:
    console, witness, robot = join("console", "none"), serve("arm-0"), serve("arm-1")
    meet(console, witness, robot)
    eventually((tmp_path / "arm-1" / "sightings.db").exists, what="the record that the robot was here")
    time.sleep(2.0)
    robot.kill()
    epoch = stop_and_leave(console, witness)
    again = serve("arm-1", moves=False)
    eventually(lambda: again.ask("epochs")["arm-1"] == [epoch], what="the lock of the robot that is back")


def test_answers_of_strangers_hide_no_stop_and_lock_nothing_of_their_own(join: Join, serve: Serve, port: int) -> None:
    # The first process is the hub, which stays.
    witness, robot, console = serve("arm-0"), serve("arm-1"), join("console", "none")
    meet(console, witness, robot)
    config = {"mode": "client", "namespace": "strands", "connect": {"endpoints": [f"tcp/127.0.0.1:{port}"]}}
    asked: list[float] = []
    floods: list[threading.Thread] = []
    with zenoh.open(zenoh.Config.from_json5(json.dumps(config))) as stranger:

        def answer(question: Any) -> None:
            asked.append(time.monotonic())
            floods.append(threading.Thread(target=flood, name="flood", daemon=True))
            floods[-1].start()

        def flood() -> None:
            none = json.dumps({"nonce": "1" * 32, "stops": [], "more": 0}).encode()
            for number in range(STRANGERS):
                garbage = none if number % 3 else b"\xff" * 200 if number % 2 else b"[" * 5000
                with contextlib.suppress(zenoh.ZError):
                    stranger.put(f"strands/stranger-{number}/missed/answer", garbage)

        subscriber = stranger.declare_subscriber("strands/arm-1/missed/ask", answer)
        robot.freeze()
        epoch = stop_and_leave(console, witness)
        # Beyond the lease of its link, so that nothing waits in the buffers of the hub.
        time.sleep(LEASE_S + 2.0)
        locked_and_still(robot, epoch, robot.wake())
        eventually(lambda: asked, what="the question")
        assert robot.ask("epochs")["arm-1"] == [epoch]
        subscriber.undeclare()
        # Zenoh's session cannot be closed while a thread publishes.
        for each in floods:
            each.join(60)


def test_session_tells_the_return_of_its_only_link_from_that_of_one_of_several() -> None:
    listen = f"tcp/127.0.0.1:{free_port()}"
    own = ZenohTransport(Posture("strands", (), (listen,), None, None, None, False, 16))
    # Callers, because two that relay as well reach each other, and drop and renew their links for it.
    others = [ZenohTransport(Posture("strands", (), (), listen, None, None, False, 16)) for _ in range(2)]
    for each in others:
        each.dials_only = True
    try:
        own.connect()
        for each in others:
            each.connect()
        eventually(lambda: own.links_up == 2)
        others[0].close()
        eventually(lambda: own.links_up == 1)
        others[0].connect()
        eventually(lambda: own.links_back() == 1, what="one of two links is back")
        assert own.rejoined() == 0
        for each in others:
            each.close()
        eventually(lambda: own.links_up == 0)
        others[0].connect()
        eventually(lambda: own.rejoined() == 1, what="the first of no links is back")
    finally:
        for each in (own, *others):
            each.close()
