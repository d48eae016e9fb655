"""Hostile sessions on a real mesh: bare Zenoh, every message made by hand.

On the open mesh of one machine the attacker is any process; under mutual TLS it holds a valid certificate of its own.
"""

from __future__ import annotations

import json
import threading
import time
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest
import zenoh
from fixtures.mesh_peer import MeshPeer
from fixtures.waiting import eventually
from tests.integration.mesh.networks import Network, OverZenoh, network

from strands_robots.mesh import topics
from strands_robots.mesh.transport import config

WAVE = {"action": "start", "instruction": "wave", "policy_provider": "mock", "duration": 60}
APPROVED = "start@arm-1,teleop_receive@arm-1"
FLOOD = 600
"""Messages of one flood, at a thousand a second."""


class Attacker:
    """A bare session; it may put any source on its messages that it has seen."""

    def __init__(self, net: OverZenoh) -> None:
        stated: dict[str, Any] = {"mode": "client", "namespace": "strands"}
        stated["connect"] = {"endpoints": [f"tcp/127.0.0.1:{net.port}"]}
        if net.kind == "zenoh-tls":
            own = config.issue_certificate(net.folder / "keys", f"mallory-{uuid.uuid4().hex[:6]}")
            stated["connect"] = {"endpoints": [f"tls/127.0.0.1:{net.port}"]}
            tls = {
                "root_ca_certificate": str(own.ca),
                "connect_certificate": str(own.cert),
                "connect_private_key": str(own.key),
                "enable_mtls": True,
            }
            stated["transport"] = {"link": {"tls": tls}}
        self.session = zenoh.open(zenoh.Config.from_json5(json.dumps(stated)))

    def put(self, key: str, body: object, source: Any = None) -> None:
        data = body if isinstance(body, bytes) else json.dumps(body).encode()
        own = zenoh.SourceInfo(self.session.id, 0)
        self.session.put(key, data, source_info=source if source is not None else own)

    def hear(self, key: str) -> list[Any]:
        """Every sample on ``key`` from now on."""
        messages: list[Any] = []
        self.session.declare_subscriber(key, messages.append)
        return messages

    @property
    def zid(self) -> str:
        return str(self.session.id.zid)


@pytest.fixture(scope="module", params=["zenoh", "zenoh-tls"])
def net(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[OverZenoh]:
    with network(request.param, tmp_path_factory.mktemp("hostile"), {"STRANDS_ROBOT_COMMAND_ALLOW": APPROVED}) as made:
        assert isinstance(made, OverZenoh)
        names = {"console": "none", "sim-1": "world", "arm-1": "arm"}
        for peer_id, robot in names.items():
            made.join(peer_id, robot)
        for peer_id, peer in made.peers.items():
            peer.sees(*(other for other in names if other != peer_id))
        yield made


@pytest.fixture
def attacker(net: OverZenoh) -> Iterator[Attacker]:
    made = Attacker(net)
    yield made
    made.session.close()
    for peer in net.peers.values():
        peer.ask("clear")
    net.peers["arm-1"].ask("send", "sim-1", {"action": "stop"}, 20)
    net.peers["sim-1"].ask("send", "arm-1", {"action": "stop"}, 20)


def presence(peer_id: str, **fields: Any) -> dict[str, Any]:
    return {"robot_id": peer_id, "robot_type": "impostor", "hostname": "h", "timestamp": time.time(), **fields}


def request(sender: str, command: object, **fields: Any) -> dict[str, Any]:
    return {"sender_id": sender, "turn_id": uuid.uuid4().hex, "command": command, "timestamp": time.time(), **fields}


def stolen_source(attacker: Attacker, victim: str) -> Any:
    """The source that the victim puts on its own messages."""
    received = attacker.hear(f"strands/{victim}/presence")
    return eventually(lambda: received and received[0].source_info, what=f"a heartbeat of {victim}")


def audited(net: Network, peer: str, event: str) -> None:
    eventually(lambda: event in net.peers[peer].ask("audited"), what=f"{peer} audits {event}")


def test_a_forged_presence_binds_nobody_anew_and_is_audited(net: OverZenoh, attacker: Attacker) -> None:
    sim = net.peers["sim-1"]
    bound = sim.ask("zid", "arm-1"), sim.ask("cert", "arm-1")
    for _ in range(20):
        attacker.put("strands/arm-1/presence", presence("arm-1"))
    audited(net, "sim-1", "presence_identity_conflict")
    assert (sim.ask("zid", "arm-1"), sim.ask("cert", "arm-1")) == bound
    assert next(row for row in sim.ask("peers") if row["peer_id"] == "arm-1")["type"] == "robot"


@pytest.mark.parametrize("shift", [-61.0, 60.0, 1e12])
def test_presence_with_a_wrong_time_is_dropped(net: OverZenoh, attacker: Attacker, shift: float) -> None:
    name = f"ghost-{abs(int(shift)) % 1000}"
    attacker.put(f"strands/{name}/presence", presence(name, timestamp=time.time() + shift))
    after = f"after-{name}"
    attacker.put(f"strands/{after}/presence", presence(after))
    eventually(lambda: after in net.peers["sim-1"].ask("reachable"))
    assert name not in net.peers["sim-1"].ask("reachable")


@pytest.mark.parametrize("stolen", [False, True], ids=["own source", "stolen source"])
def test_a_hijacked_reply_does_not_count(net: OverZenoh, attacker: Attacker, stolen: bool) -> None:
    if stolen and net.kind == "zenoh":
        pytest.skip("without certificates a source is a hint that any process of this machine can copy")
    console = net.peers["console"]
    source = stolen_source(attacker, "arm-1") if stolen else None
    forged: list[str] = []

    def answer(sample: Any) -> None:
        turn = json.loads(sample.payload.to_bytes())["turn_id"]
        body = {"type": "response", "responder_id": "arm-1", "turn_id": turn, "result": {"forged": True}}
        attacker.put(f"strands/console/response/arm-1/{turn}", {**body, "timestamp": time.time()}, source)
        forged.append(turn)

    def enough() -> bool:
        assert "forged" not in console.ask("send", "arm-1", {"action": "status"}, 20)["result"]
        # A new subscription takes a moment to reach all peers, and a forgery that comes after the answer is ignored.
        return len(forged) >= 5 and "response_hijack_rejected" in console.ask("audited")

    received = attacker.session.declare_subscriber("strands/arm-1/cmd", answer)
    eventually(enough, what="five forged answers, one of them before the arm's own")
    received.undeclare()


def test_a_recorded_command_moves_nothing_when_it_is_played_back(net: OverZenoh, attacker: Attacker) -> None:
    console, sim, arm = (net.peers[name] for name in ("console", "sim-1", "arm-1"))
    received = attacker.hear("strands/*/cmd")
    # A new subscription takes a moment to reach all peers.
    eventually(lambda: console.ask("ping", "sim-1") and received)
    received.clear()
    step = {"action": "step", "steps": 2}
    assert console.ask("send", "sim-1", step, 20)["result"]["status"] == "success"
    assert console.ask("send", "arm-1", WAVE, 20)["result"]["status"] == "success"
    assert console.ask("send", "arm-1", {"action": "stop"}, 20)["result"]["ok"] is True

    def recorded() -> dict[str, Any] | None:
        messages = {json.loads(sample.payload.to_bytes())["command"]["action"]: sample for sample in list(received)}
        return messages if {"step", "start"} <= set(messages) else None

    tapes = eventually(recorded) or {}
    steps = sim.ask("steps")
    for tape in (tapes["step"], tapes["start"]):
        for stolen in (None, tape.source_info):
            attacker.put(str(tape.key_expr), tape.payload.to_bytes(), stolen)
    audited(net, "sim-1", "command_refused")
    assert console.ask("send", "arm-1", {"action": "status"}, 20)["type"] == "response"
    assert sim.ask("steps") == steps
    assert arm.ask("moving") is False


def test_a_command_in_a_stolen_name_does_not_move_the_arm(net: OverZenoh, attacker: Attacker) -> None:
    source = stolen_source(attacker, "console") if net.kind == "zenoh-tls" else None
    attacker.put("strands/arm-1/cmd", request("console", WAVE), source)
    audited(net, "arm-1", "wire_motion_refused")
    assert net.peers["arm-1"].ask("moving") is False


@pytest.mark.parametrize("sender", ["*", "**", "a/*", "$*", "", "a/b", None, 7, "x" * 129])
def test_a_sender_that_is_no_identifier_gets_no_reply(net: OverZenoh, attacker: Attacker, sender: object) -> None:
    received = attacker.hear("strands/**")
    eventually(lambda: any(str(sample.key_expr) == "strands/sim-1/presence" for sample in received))
    attacker.put("strands/sim-1/cmd", {**request("x", {"action": "ping"}), "sender_id": sender})
    attacker.put("strands/sim-1/cmd", request("probe", {"action": "ping"}))
    eventually(lambda: any("/response/" in str(sample.key_expr) for sample in received))
    replies = [str(sample.key_expr) for sample in received if "/response/" in str(sample.key_expr)]
    assert all(key.startswith("strands/probe/response/sim-1/") for key in replies)
    audited(net, "sim-1", "command_rejected")


def test_message_above_its_topics_size_is_dropped(net: OverZenoh, attacker: Attacker) -> None:
    sim, pad = net.peers["sim-1"], {"pad": "x" * 16_384}
    steps = sim.ask("steps")
    attacker.put("strands/sim-1/cmd", {**request("mallory", {"action": "step"}), **pad})
    attacker.put("strands/large/presence", presence("large", pad="x" * 65_536))
    large = {"peer_id": "mallory", "t": time.time(), "estop_id": uuid.uuid4().hex, "source_zid": attacker.zid}
    attacker.put("strands/safety/estop", {**large, **pad})
    attacker.put("strands/console/response/sim-1/x", b"x" * (2 << 20))

    def small_is_heard() -> bool:
        # What is sent behind two megabytes may be dropped on the way.
        attacker.put("strands/small/presence", presence("small"))
        return "small" in sim.ask("reachable")

    eventually(small_is_heard)
    assert "large" not in sim.ask("reachable")
    assert (sim.ask("steps"), sim.ask("epoch")) == (steps, None)


# A thousand messages a second on each topic.


def floods(attacker: Attacker) -> dict[str, Callable[[int], tuple[str, object]]]:
    """The worst messages for each topic that pass its decoder."""
    zid, now, assertion = attacker.zid, time.time(), {"v": 1, "epoch": "0" * 32, "targets": ["sim-1"], "nonce": "n"}
    frame = {"peer_id": "console", "device": "leader", "method": "arm", "t": now, "action": {"j": 1.0}}
    telemetry = ("pose", "imu", "odom", "health", "lidar_summary", "lidar_state", "map_info", "state", "stream", "turn")
    sensors = {name: name.replace("_", "/") for name in telemetry}
    made: dict[str, Callable[[int], tuple[str, object]]] = {
        "input": lambda n: ("strands/console/input/leader", {**frame, "seq": n}),
        "broadcast": lambda n: ("strands/broadcast", request("mallory", {"action": "status"})),
        "cmd": lambda n: ("strands/sim-1/cmd", request("mallory", {"action": ("status", "stop", "reset")[n % 3]})),
        "response": lambda n: (f"strands/console/response/sim-1/{n}",
                               {"type": "response", "responder_id": "sim-1", "turn_id": f"{n}", "result": {}}),
        "presence": lambda n: (f"strands/invented-{n}/presence", presence(f"invented-{n}")),
        "safety_event": lambda n: ("strands/m/safety/event", {"peer_id": "m", "t": now, "n": n}),
        "camera": lambda n: ("strands/m/camera/front", b"\xff" * 4096),
        "hand": lambda n: ("strands/m/hand/left/state", {"peer_id": "m", "t": now}),
        "resume": lambda n: ("strands/safety/resume",
                             {"peer_id": "m", "t": now, "assertion": assertion, "source_zid": zid}),
        "checkin": lambda n: ("strands/m/checkin", {"peer_id": "m", "t": now, "n": n}),
        "checkin_answer": lambda n: ("strands/m/checkin/answer", {"peer_id": "m", "t": now, "n": n}),
        "missed_ask": lambda n: ("strands/m/missed/ask", {"nonce": f"{n:032x}", "devices": ["m"], "t": now}),
        "missed_answer": lambda n: ("strands/m/missed/answer", {"nonce": f"{n:032x}", "stops": [], "more": 0}),
        "missed_roster": lambda n: ("strands/m/missed/roster", {"estop_id": f"{n:032x}", "missing": [], "more": n}),
        "other": lambda n: ("strands/m/anything/else", b"{" * 100),
    }  # fmt: skip
    for name, leaf in sensors.items():
        made[name] = lambda n, leaf=leaf: (f"strands/m/{leaf}", {"peer_id": "m", "t": now, "n": n})  # type: ignore[misc]
    # Last, because it locks every peer.
    made["estop"] = lambda n: (
        "strands/safety/estop",
        {"peer_id": "m", "t": now, "estop_id": f"{n:032x}", "source_zid": "0" if n % 2 else zid},
    )
    return made


def pour(attacker: Attacker, make: Callable[[int], tuple[str, object]]) -> None:
    started = time.monotonic()
    for number in range(FLOOD):
        attacker.put(*make(number))
        ahead = number / 1000 - (time.monotonic() - started)
        if ahead > 0:
            time.sleep(ahead)


def stopped_by(console: Any, target: str) -> bool:
    return console.ask("send", target, {"action": "stop"}, 20).get("result", {}).get("ok") is True


def resident(peer: MeshPeer) -> float:
    """MiB of memory that a peer's process holds."""
    return psutil.Process(peer.pid).memory_info().rss / 2**20


@pytest.fixture
def flooded(tmp_path: Path) -> Iterator[OverZenoh]:
    with network("zenoh", tmp_path, {"STRANDS_ROBOT_COMMAND_ALLOW": APPROVED}) as made:
        assert isinstance(made, OverZenoh)
        for peer_id, robot in {"console": "none", "sim-1": "world", "arm-1": "arm"}.items():
            made.join(peer_id, robot)
        made.peers["console"].sees("sim-1", "arm-1")
        made.peers["arm-1"].sees("console")
        yield made


def test_a_flood_on_any_topic_leaves_pings_and_stops_answered_and_nothing_behind(flooded: OverZenoh) -> None:
    attacker = Attacker(flooded)
    console, sim, arm = (flooded.peers[name] for name in ("console", "sim-1", "arm-1"))
    peers = [peer for peer in flooded.peers.values() if isinstance(peer, MeshPeer)]
    console.ask("hear", "strands/*/**", None, "everything")
    poured = floods(attacker)
    assert set(poured) == {*topics.BY_NAME, "other"}
    assert arm.ask("follow", "console") is None
    # Once there and back: the console knows by then who has subscribed to its frames.
    assert console.ask("ping", "arm-1")["status"] == "ok"
    console.ask("lead")

    def led() -> bool:
        pour(attacker, poured["input"])
        return bool(arm.ask("followed")["frames_received"] >= 25)

    eventually(led, what="the leader's frames, beside the flood")
    sent = console.ask("rest")["frames"]

    def taken() -> int:
        # Frames of the leader that a busy machine delayed and delivered together may be dropped, others may not.
        stats = arm.ask("followed")
        count: int = stats["frames_received"] + stats["rate_dropped"]
        return count

    eventually(lambda: taken() >= 0.95 * sent, what="all the leader's frames")
    received = arm.ask("followed")["frames_received"]
    sizes: list[list[float]] = []
    for name, make in poured.items():
        sim.ask("clear")
        sim.ask("start", "wave")
        flood = threading.Thread(target=pour, args=(attacker, make), name=f"flood-{name}")
        flood.start()
        for _ in range(3):
            assert console.ask("ping", "sim-1")["status"] == "ok", name
        # As a console does: what a link that cannot keep up dropped is sent again.
        eventually(lambda: stopped_by(console, "sim-1"), within=40, what=f"the stop beside {name}")
        assert sim.ask("moving") == [], name
        flood.join()
        # The queues are empty again: an ordinary command is served, not refused as busy.
        eventually(lambda: console.ask("send", "sim-1", {"action": "status"}, 3).get("type") == "response", what=name)
        sizes.append([resident(peer) for peer in peers])
    followed = arm.ask("unfollow")
    assert received <= followed["frames_received"] <= sent
    assert followed["rejected_source"] > FLOOD
    assert len(console.ask("received", "everything")) == 256
    assert arm.ask("epoch") == f"{0:032x}"
    console.ask("deaf", "everything")
    *others, _ = sizes
    grown = [last - first for first, last in zip(others[0], others[-1], strict=True)]
    assert max(grown) < 30, sizes
    # The first stops load what signs answers, and fill what is kept of the latest of them; more add nothing.
    for later in (1, 2):
        pour(attacker, lambda n, later=later: poured["estop"](n + later * FLOOD))  # type: ignore[misc]
        eventually(lambda: console.ask("send", "sim-1", {"action": "status"}, 3).get("type") == "response", what="idle")
        sizes.append([resident(peer) for peer in peers])
    grown = [last - first for first, last in zip(sizes[-2], sizes[-1], strict=True)]
    assert max(grown) < 10, sizes[-3:]
    assert len(console.ask("peers")) <= 1024
    assert len(sim.ask("threads")) <= 20
    attacker.session.close()
