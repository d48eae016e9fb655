"""Arbitrary bytes on every topic: nothing raises, the peer still answers."""

from __future__ import annotations

import base64
import gc
import json
import random
import sys
import time
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from fixtures.mesh_robots import Arm, World
from fixtures.waiting import eventually
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.mesh.peers import Fleet

from strands_robots.mesh import session, topics, wire
from strands_robots.mesh.input import InputReceiver
from strands_robots.mesh.security import ValidationError, validate_command, validate_input_frame
from strands_robots.mesh.transport import config
from strands_robots.mesh.transport.bridge import SeenCommands
from strands_robots.mesh.wire_identity import Identity, IdentityError, Signer, Verifier

LIMIT = 16 * 1024

scalars = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=40)
values = st.recursive(
    scalars,
    lambda inner: st.lists(inner, max_size=5) | st.dictionaries(st.text(max_size=12), inner, max_size=5),
    max_leaves=12,
)
FIELDS = [
    "robot_id", "robot_type", "hostname", "timestamp", "sender_id", "turn_id", "command", "type", "responder_id",
    "result", "error", "peer_id", "t", "estop_id", "source_zid", "assertion", "action", "seq", "sig", "duration",
    "policy_provider", "policy_host", "target_pose", "robot_name", "steps", "instruction",
]  # fmt: skip
bodies = st.dictionaries(st.sampled_from(FIELDS) | st.text(max_size=8), values, max_size=10)


@given(st.binary(max_size=200) | st.text(max_size=100).map(str.encode))
@settings(max_examples=500)
def test_any_bytes_are_an_object_or_a_wire_error(data: bytes) -> None:
    try:
        assert isinstance(wire.decode(data, LIMIT), dict)
    except wire.WireError:
        return


@given(bodies)
@settings(max_examples=120)
def test_any_object_is_a_message_or_a_wire_error(body: dict[str, Any]) -> None:
    relayed = partial(wire.relay_of, session=body.get("source_zid"))
    for parse in (wire.Presence.of, wire.Request.of, wire.Reply.of, wire.issuer_of, relayed):
        try:
            parse(body)
        except wire.WireError:
            continue


@given(values)
@settings(max_examples=500)
def test_any_command_is_clean_or_refused_by_name(command: Any) -> None:
    for candidate in (
        command,
        {"action": command},
        {"action": "start", "policy_provider": "mock", "duration": command},
    ):
        try:
            clean = validate_command(candidate)
        except ValidationError as exc:
            assert str(exc)
        else:
            json.dumps(clean, allow_nan=False)


@given(values)
@settings(max_examples=500)
def test_any_input_action_is_finite_or_refused(action: Any) -> None:
    try:
        checked = validate_input_frame(action)
    except ValidationError:
        return
    assert all(abs(value) <= 720 for value in checked.values())
    assert len(checked) <= 64


@pytest.mark.parametrize("key", ["../x", "é", "..", "a..b", "a/b", "a b", "", "x" * 65, "pan.pos\n", "a\x00"])
def test_key_of_an_input_that_is_no_joints_is_refused(key: str) -> None:
    with pytest.raises(ValidationError, match="the keys of action must be"):
        validate_input_frame({"pan.pos": 0.0, key: 1.0})


@pytest.mark.parametrize("key", ["shoulder_pan.pos", "x.vel", "Joint-1", "x" * 64])
def test_key_of_an_input_that_may_be_a_joints_is_taken(key: str) -> None:
    assert validate_input_frame({key: 1.0}) == {key: 1.0}


@pytest.mark.parametrize(
    "data",
    [
        b"[" * 100_000,
        b'{"a":' * 100_000,
        b'{"t":NaN}',
        b'{"t":1e999}',
        b'{"t":' + b"9" * 10_000 + b"}",
        b"\xff\xfe",
        b"",
    ],
)
def test_bytes_that_break_parsers_are_a_wire_error(data: bytes) -> None:
    try:
        body = wire.decode(data, 1 << 20)
    except wire.WireError:
        return
    with pytest.raises(wire.WireError):
        wire.issuer_of({"peer_id": "x", **body})


def test_a_message_too_large_is_an_error_to_its_sender() -> None:
    with pytest.raises(wire.TooLargeError):
        wire.encode({"data": "x" * LIMIT}, LIMIT)
    with pytest.raises(wire.WireError):
        wire.encode({"data": object()}, LIMIT)
    assert json.loads(wire.encode({"a": float("nan"), "b": [float("inf"), 1]}, LIMIT)) == {"a": None, "b": [None, 1]}


signatures = st.fixed_dictionaries(
    {
        "v": st.just(1) | scalars,
        "alg": st.sampled_from(["rsa-pss-sha256", "ecdsa-sha256", "ed25519"]) | scalars,
        "cert": st.binary(max_size=60).map(lambda data: base64.b64encode(data).decode()) | values,
        "t": st.floats(allow_nan=True) | st.just(1.0) | scalars,
        "nonce": st.text(max_size=10) | scalars,
        "sig": st.text("AZaz09-_=", max_size=20) | values,
    }
)


@given(bodies, signatures | values)
@settings(max_examples=120)
def test_any_signature_is_verified_or_refused(certified: Path, body: dict[str, Any], signature: Any) -> None:
    verifier = Verifier((certified / "ca.pem").read_bytes(), lambda: 1.0, lambda: 1.0)
    with pytest.raises(IdentityError):
        verifier.verify({**body, "sig": signature})


@given(st.binary(max_size=100) | bodies.map(lambda body: json.dumps(body).encode()))
@settings(max_examples=120)
def test_any_bytes_can_be_checked_for_a_seen_command(data: bytes) -> None:
    seen = SeenCommands()
    assert seen.first(data) is True
    assert isinstance(seen.first(data), bool)


@given(st.text(max_size=60) | st.text("abc/*$#?", max_size=20).map("strands/{}".format))
@settings(max_examples=120)
def test_any_key_falls_under_a_topic(key: str) -> None:
    topics.topic_of(key)
    topics.matches("strands/*/response/**", key)
    assert topics.matches("**", key)


def seeds(peers: Fleet, signer: Signer) -> dict[str, dict[str, Any]]:
    """A valid message of each topic, to mutate; signed where that is due."""
    now = peers.clock()
    assertion = {"v": 1, "epoch": "0" * 32, "targets": ["arm-1"], "t": now, "nonce": "1" * 32, "sig": "x"}
    common = {"peer_id": "lead", "t": now, "x": 1.0}
    sensors = ("state", "stream", "pose", "imu", "odom", "health", "lidar/summary", "lidar/state", "map/info")
    return {
        "strands/arm-9/presence": signer.sign({"robot_id": "arm-9", "robot_type": "robot", "timestamp": now}),
        "strands/arm-8/presence": {"robot_id": "arm-8", "robot_type": "robot", "hostname": "h", "timestamp": now},
        "strands/arm-1/cmd": {"sender_id": "x", "turn_id": "t", "command": {"action": "status"}, "timestamp": now},
        "strands/broadcast": {"sender_id": "x", "turn_id": "t", "command": {"action": "ping"}, "timestamp": now},
        "strands/arm-1/response/x/t": {"type": "response", "responder_id": "x", "turn_id": "t", "result": {}},
        "strands/safety/estop": {"peer_id": 5, "t": now, "estop_id": "a" * 32, "source_zid": "ff"},
        "strands/safety/resume": {"peer_id": "x", "t": now, "assertion": assertion, "source_zid": "ff"},
        "strands/console/checkin": {"peer_id": "console", "t": now, "nonce": "1" * 32},
        "strands/arm-9/checkin/answer": {
            "device_id": "arm-9",
            "estop_id": "1" * 32,
            "audit": {"log": "a" * 32, "count": 1, "last": "b" * 64},
        },
        "strands/arm-9/missed/roster": {
            "estop_id": "1" * 32,
            "missing": [{"name": "arm-1", "how": "heard", "cell": ""}],
            "more": 0,
        },
        "strands/arm-9/missed/ask": {"nonce": "1" * 32, "devices": ["arm-9"], "t": now},
        "strands/arm-9/missed/answer": {
            "nonce": "1" * 32,
            "stops": [{"source": "console", "event": "e30", "age_s": 1.0}],
            "more": 0,
        },
        "strands/lead/safety/event": {**common, "event": "emergency_stop"},
        "strands/lead/input/leader": {**common, "seq": 1, "action": {"j": 1.0}},
        "strands/lead/camera/front": {**common, "encoding": "jpeg", "data": "AAAA"},
        "strands/lead/hand/left/state": common,
        "strands/lead/turn": {**common, "state": "led", "leader": "hand", "why": ""},
        **{f"strands/lead/{name}": common for name in sensors},
    }


@pytest.fixture(scope="module")
def certified(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A fleet's authority and the certificate of arm-9."""
    folder = tmp_path_factory.mktemp("keys")
    config.make_authority(folder)
    config.issue_certificate(folder, "arm-9")
    return folder


def mutated(chance: random.Random, seed: dict[str, Any]) -> bytes:
    data = bytearray(json.dumps(seed).encode())
    for _ in range(chance.randrange(1, 6)):
        at = chance.randrange(len(data))
        match chance.randrange(4):
            case 0:
                data[at] = chance.randrange(256)
            case 1:
                del data[at : at + chance.randrange(1, 8)]
            case 2:
                data[at:at] = bytes(chance.choices(b'{}[]",:0e-\\u', k=3))
            case _:
                data[at:at] = data[: chance.randrange(1, 20)]
        if not data:
            data = bytearray(b"0")
    return bytes(data)


def test_a_hundred_thousand_mutated_messages_leave_nothing_behind(peers: Fleet, certified: Path) -> None:
    checking = Identity(None, Verifier((certified / "ca.pem").read_bytes(), peers.clock, peers.clock), required=True)
    arm = World("left")
    mesh = peers.join(arm, "arm-1", "sim", identity=checking)
    console = peers.join(None, "console")
    stranger, chance = peers.stranger(), random.Random(5)
    stranger.put("strands/lead/presence", {"robot_id": "lead", "robot_type": "robot", "timestamp": peers.clock()})
    follower = InputReceiver(console, arm, "lead", apply_fn=lambda body, action: None)
    follower.start()
    assert follower.start_refusal is None
    messages = list(seeds(peers, Signer(certified / "arm-9.pem", certified / "arm-9.key", peers.clock)).items())
    assert {topics.topic_of(key).name for key, _ in messages} == set(topics.BY_NAME)
    assert mesh.subscribe("strands/**", lambda key, data: None)

    def pour(count: int) -> None:
        for number in range(count):
            key, seed = messages[number % len(messages)]
            stranger.put(key, mutated(chance, seed))
        eventually(lambda: console.ping("arm-1", timeout=2)["status"] == "ok")

    pour(10_000)
    peers.audit.clear()
    gc.collect()
    before = sys.getallocatedblocks()
    pour(90_000)
    assert follower.stop()["rejected_invalid"] > 1000
    peers.audit.clear()
    gc.collect()
    assert sys.getallocatedblocks() - before < 60_000
    assert console.send("arm-1", {"action": "status"}, timeout=20)["type"] == "response"


def test_flood_of_refusals_is_audited_as_a_count(peers: Fleet) -> None:
    peers.join(Arm(), "arm-1")
    stranger, began = peers.stranger(), time.monotonic()
    for _ in range(1000):
        stranger.put("strands/arm-1/cmd", {"sender_id": "*", "turn_id": "t", "command": {"action": "stop"}})
    seconds = int(time.monotonic() - began) + 1
    assert len(peers.events("command_rejected")) <= 5 * seconds
    peers.meshes[0].stop()
    common = peers.events("command_rejected")
    counted = sum(event.get("left_out", 0) + event.get("left_out_before", 0) for event in common)
    assert counted + sum("left_out" not in event for event in common) == 1000


def test_invented_peers_do_not_fill_the_registry_beyond_its_bound(
    peers: Fleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    console = peers.join(None, "console")
    stranger = peers.stranger()
    for number in range(1500):
        stranger.put(f"strands/p{number}/presence", {"robot_id": f"p{number}", "timestamp": peers.clock()})
    assert len(console.peers) == session.SESSION_PEERS_MAX
    assert console.get_peer("p0") is not None
    assert console.get_peer("p1499") is None


@pytest.mark.parametrize(
    ("pattern", "key", "fits"),
    [
        ("strands/*/presence", "strands/a/presence", True),
        ("strands/*/presence", "strands/a/b/presence", False),
        ("strands/**", "strands/a/b", True),
        ("strands/*/response/**", "strands/a/response", True),
        ("**", "x", True),
        ("**/a/**/b", "x/a/y/z/b", True),
        ("**/a/**/b", "x/a/y/z", False),
    ],
)
def test_key_expressions_match_like_zenohs(pattern: str, key: str, fits: bool) -> None:
    assert topics.matches(pattern, key) is fits


def test_a_hostile_pattern_costs_no_exponential_time() -> None:
    assert not topics.matches("/".join(["**", "a"] * 40 + ["b"]), "/".join(["a"] * 200))
