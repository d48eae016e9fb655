"""Emergency stops on a connection and a thread of their own, while the presence session carries nothing."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import zenoh
from fixtures.mesh_peer import MeshPeer
from fixtures.waiting import eventually
from tests.integration.mesh.conftest import Join

HANG_S = 30.0
WITHIN_S = 1.0
"""Seconds from the press to the halt; far above what it takes, and far below what the presence session hangs."""


@contextmanager
def session(port: int) -> Iterator[zenoh.Session]:
    """A bare Zenoh session on the mesh."""
    config = {"mode": "client", "namespace": "strands", "connect": {"endpoints": [f"tcp/127.0.0.1:{port}"]}}
    with zenoh.open(zenoh.Config.from_json5(json.dumps(config))) as opened:
        yield opened


def put(stranger: zenoh.Session, key: str, body: object) -> None:
    data = body if isinstance(body, bytes) else json.dumps(body).encode()
    stranger.put(key, data, source_info=zenoh.SourceInfo(stranger.id, 0))


def ready(arm: MeshPeer, console: MeshPeer) -> None:
    """Have both peers see each other, their connections for stops up, and the arm moving."""
    arm.sees(console.peer_id)
    console.sees(arm.peer_id)
    console.ask("check_in", 0.5)
    eventually(lambda: arm.ask("stops_up") and console.ask("stops_up"), what="the connections for stops")
    assert arm.ask("start", "wave")["status"] == "success"


def stopped_in_time(arm: MeshPeer, console: MeshPeer) -> None:
    """Stop from the console; the arm halts and locks at once."""
    pressed, _ = console.ask("estop")
    eventually(lambda: arm.ask("epoch") is not None, within=5, what="the lockout")
    reasons, halted_at = arm.ask("halts")
    assert reasons and halted_at - pressed < WITHIN_S


@pytest.mark.parametrize("hub", ["arm-1", "console"])
def test_stop_halts_while_a_callback_of_the_presence_session_hangs(join: Join, hub: str) -> None:
    kinds = {"arm-1": "arm", "console": "none"}
    peers = {name: join(name, kinds[name]) for name in sorted(kinds, key=lambda name: name != hub)}
    arm, console = peers["arm-1"], peers["console"]
    ready(arm, console)
    assert arm.ask("block", "strands/console/hang", HANG_S)
    time.sleep(0.5)  # the subscription has to reach the console
    console.ask("publish", "strands/console/hang", {})
    eventually(lambda: arm.ask("blocked"), what="the callback that hangs")
    stopped_in_time(arm, console)


FLOODS: dict[str, Callable[[zenoh.Session, int], None]] = {
    "forged commands": lambda stranger, number: put(
        stranger,
        "strands/arm-1/cmd",
        {"sender_id": "mallory", "turn_id": str(number), "timestamp": time.time(), "command": {"action": "start"}},
    ),
    "largest messages": lambda stranger, number: put(stranger, "strands/arm-1/response/mallory/1", b"x" * 2**20),
}


@pytest.mark.parametrize("flood", FLOODS)
def test_stop_halts_in_a_flood_of_the_presence_session(join: Join, port: int, flood: str) -> None:
    arm, console = join("arm-1", "arm"), join("console", "none")
    ready(arm, console)
    over = threading.Event()

    def flooding() -> None:
        number = 0
        with session(port) as stranger:
            while not over.is_set():
                number += 1
                FLOODS[flood](stranger, number)

    thread = threading.Thread(target=flooding)
    thread.start()
    try:
        time.sleep(1.0)
        stopped_in_time(arm, console)
    finally:
        over.set()
        thread.join()


def test_stop_halts_after_the_hub_was_killed(join: Join) -> None:
    hub, arm, console = join("hub", "none"), join("arm-1", "arm"), join("console", "none")
    hub.sees("arm-1", "console")
    ready(arm, console)
    hub.kill()
    console.ask("estop")
    eventually(lambda: arm.ask("epoch") is not None, within=15, what="the lockout by the next hub")
    eventually(lambda: arm.ask("stops_up"), within=15, what="the connection for stops, by the next hub")


def test_stop_of_a_peer_that_has_one_session_is_received_once(join: Join, port: int) -> None:
    arm = join("arm-1", "arm")
    eventually(lambda: arm.ask("stops_up"))
    with session(port) as stranger:
        body: dict[str, Any] = {"peer_id": "yesterday", "t": time.time(), "estop_id": "a" * 32}
        put(stranger, "strands/safety/estop", {**body, "source_zid": str(stranger.id.zid)})
        eventually(lambda: arm.ask("epoch") == "a" * 32)
    reasons, _ = arm.ask("halts")
    assert len(reasons) == 1
    assert "remote_estop_redundant" not in arm.ask("audited")


def test_stop_on_the_connection_of_its_own_states_the_presence_session(join: Join, port: int) -> None:
    arm, console = join("arm-1", "arm"), join("console", "none")
    ready(arm, console)
    received: list[tuple[str, str]] = []

    def hear(sample: zenoh.Sample) -> None:
        source = sample.source_info
        assert source is not None
        received.append((str(source.source_id.zid), json.loads(sample.payload.to_bytes())["source_zid"]))

    with session(port) as listener:
        listener.declare_subscriber("strands/safety/estop", hear)
        time.sleep(0.5)  # the subscription has to reach the console
        console.ask("estop")
        eventually(lambda: len(received) >= 2, what="the copies of both connections")
    announced = arm.ask("zid", "console")
    assert set(received) == {(announced, announced)}, "a 0.5.3 peer refuses any other"
