"""The mesh over a real MQTT 5 broker with mutual TLS. Not AWS: see docs/mesh.md."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from fixtures.mesh_peer import MeshPeer, share_console_key
from fixtures.mqtt_broker import PROGRAM, MqttBroker
from fixtures.mqtt_retainer import Retainer, command
from fixtures.waiting import eventually, free_port

from strands_robots.mesh.resume_authority import keygen
from strands_robots.mesh.transport import TransportError, config
from strands_robots.mesh.transport.iot import Account, IotMqttTransport, filter_of
from strands_robots.mesh.wire_identity import MOTION, ConsoleSigner

Join = Callable[..., MeshPeer]
PASSPHRASE = "Correct-Horse-7-Battery"


def test_key_expressions_become_topic_filters() -> None:
    assert filter_of("strands/*/presence") == "strands/+/presence"
    assert filter_of("strands/a/response/**") == "strands/a/response/#"


def test_missing_setting_is_named() -> None:
    with pytest.raises(TransportError, match="STRANDS_IOT_ENDPOINT"):
        Account.from_settings()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    if PROGRAM is None:
        reason = "mosquitto is not installed (Debian package mosquitto)"
        (pytest.fail if os.environ.get("CI") else pytest.skip)(reason)
    made = tmp_path / "keys"
    config.make_authority(made)
    config.issue_certificate(made, "broker")
    return made


@pytest.fixture
def broker(folder: Path, tmp_path: Path) -> Iterator[MqttBroker]:
    with MqttBroker(tmp_path, folder / "ca.pem", folder / "broker.pem", folder / "broker.key") as running:
        yield running


@pytest.fixture
def join(broker: MqttBroker, folder: Path, tmp_path: Path) -> Iterator[Join]:
    with ExitStack() as stack:

        def start(peer_id: str, robot: str = "world", **settings: str) -> MeshPeer:
            if not (folder / f"{peer_id}.pem").exists():
                config.issue_certificate(folder, peer_id)
            state = tmp_path / peer_id
            state.mkdir(mode=0o700, exist_ok=True)
            account = {
                "STRANDS_MESH_BACKEND": "iot",
                "STRANDS_IOT_ENDPOINT": f"localhost:{broker.port}",
                "STRANDS_IOT_THING_NAME": peer_id,
                "STRANDS_IOT_CERT_DIR": str(folder),
                "STRANDS_IOT_CA_FILE": str(folder / "ca.pem"),
                "STRANDS_STATE_DIR": str(state),
                "STRANDS_HALT_DEADLINE_S": "20",
            }
            peer = MeshPeer(peer_id, robot, {**account, **settings})
            stack.callback(peer.close)
            return peer

        yield start


@pytest.mark.system
def test_peers_command_each_other_and_report_the_delivery(join: Join) -> None:
    sim, console = join("sim-1"), join("console", "none")
    console.sees("sim-1")
    answer = console.ask("ping", "sim-1")
    assert (answer["status"], answer["via"], answer["confirmed"]) == ("ok", "direct", True)
    start = {"action": "start", "instruction": "wave", "policy_provider": "mock"}
    assert console.ask("send", "sim-1", start, 20)["result"]["status"] == "success"
    assert sim.ask("moving") == ["left"]
    offline = console.ask("ping", "absent")
    assert (offline["status"], offline["reason"], offline["via"]) == ("offline", "offline", "direct")


@pytest.mark.system
def test_real_hardware_cannot_be_moved_by_a_sender_that_no_session_proves(join: Join, tmp_path: Path) -> None:
    join("arm-1", "arm", BYPASS_TOOL_CONSENT="true")
    console = join("console", "none")
    # Another user's console: it makes a key that the arm does not know.
    (tmp_path / "console" / "keys" / "consoles" / "console.key").unlink()
    console.sees("arm-1")
    start = {"action": "start", "instruction": "wave", "policy_provider": "mock"}
    assert "operator approval" in console.ask("send", "arm-1", start, 20)["error"]


@pytest.mark.system
def test_a_signed_command_moves_approved_hardware_over_mqtt(join: Join, folder: Path) -> None:
    def signed(peer_id: str) -> dict[str, str]:
        demanded = {"STRANDS_MESH_REQUIRE_SIGNED_IDENTITY": "1", "BYPASS_TOOL_CONSENT": "true"}
        return {**config.issue_certificate(folder, peer_id).settings(), **demanded}

    arm = join("arm-1", "arm", **signed("arm-1"))
    console = join("console", "none", **signed("console"))
    console.sees("arm-1")
    start = {"action": "start", "instruction": "wave", "policy_provider": "mock", "duration": 60}
    assert console.ask("send", "arm-1", start, 20)["result"]["status"] == "success"
    assert arm.ask("moving") is True


@pytest.mark.system
def test_late_joiner_locks_on_a_retained_stop_unless_it_was_resumed(join: Join, tmp_path: Path) -> None:
    key = str(tmp_path / "operator.pem")
    trusted = {"STRANDS_MESH_RESUME_PUBLIC_KEY": keygen(key, PASSPHRASE)}
    first, console = join("sim-1", **trusted), join("console", "none", **trusted)
    console.sees("sim-1")
    console.ask("estop")
    eventually(lambda: first.ask("epoch"))
    late = join("sim-2", **trusted)
    eventually(lambda: late.ask("epoch") == console.ask("epoch"))
    console.sees("sim-1", "sim-2")
    assert console.ask("resume", key, PASSPHRASE) == {"status": "ok"}
    for peer in (first, late):
        eventually(lambda peer=peer: peer.ask("epoch") is None)
    late.close()
    again = join("sim-2", **trusted)
    again.sees("sim-1")
    assert again.ask("epoch") is None


@pytest.mark.system
def test_resumed_stop_locks_no_newcomer_and_leaves_the_broker(
    join: Join, broker: MqttBroker, folder: Path, tmp_path: Path
) -> None:
    key = str(tmp_path / "operator.pem")
    trusted = {"STRANDS_MESH_RESUME_PUBLIC_KEY": keygen(key, PASSPHRASE)}
    first, console = join("sim-1", **trusted), join("console", "none", **trusted)
    console.sees("sim-1")
    console.ask("estop")
    own = config.issue_certificate(folder, "reader")
    reader = IotMqttTransport(Account("localhost", broker.port, "reader", own.cert, own.key, own.ca))
    reader.connect()
    stored: list[bytes] = []
    reader.declare_subscriber("strands/safety/estop", lambda sample: stored.append(sample.payload))
    eventually(lambda: stored, what="the broker stores the stop")
    assert console.ask("resume", key, PASSPHRASE) == {"status": "ok"}
    eventually(lambda: stored[-1] == b"", what="the broker's copy is cleared")
    reader.close()
    eventually(lambda: first.ask("epoch") is None)
    newcomer = join("sim-3", **trusted)
    newcomer.sees("sim-1")
    assert newcomer.ask("epoch") is None


@pytest.fixture
def retainer(broker: MqttBroker, folder: Path) -> Iterator[Retainer]:
    with Retainer(broker.port, config.issue_certificate(folder, "retainer")) as client:
        yield client


START = {"action": "start", "instruction": "wave", "policy_provider": "mock", "duration": 60}


@pytest.mark.system
@pytest.mark.parametrize("topic", ["strands/sim-1/cmd", "strands/broadcast"])
def test_stored_command_moves_nothing_at_a_join_and_the_same_one_live_does(
    join: Join, retainer: Retainer, topic: str
) -> None:
    retainer.store(topic, command(START))
    sim = join("sim-1")
    eventually(lambda: "command_refused" in sim.ask("audited"), what="the refusal")
    assert sim.ask("moving") == []
    retainer.send(topic, command(START))
    eventually(lambda: sim.ask("moving") == ["left"], what="a live one moves it")


@pytest.mark.system
def test_stored_command_of_an_approved_console_moves_no_hardware(
    join: Join, retainer: Retainer, tmp_path: Path
) -> None:
    folder = tmp_path / "arm-1"
    folder.mkdir(mode=0o700)
    share_console_key(folder)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("STRANDS_STATE_DIR", str(folder))
        signed = ConsoleSigner().sign({**command(START), "target_id": "arm-1"}, MOTION)
    retainer.store("strands/arm-1/cmd", signed)
    arm = join("arm-1", "arm", BYPASS_TOOL_CONSENT="true")
    eventually(lambda: "command_refused" in arm.ask("audited"), what="the refusal")
    assert arm.ask("moving") is False


@pytest.mark.system
def test_peer_that_starts_before_the_broker_joins_when_it_is_there(join: Join, broker: MqttBroker) -> None:
    broker.stop()
    sim = join("sim-1")
    assert sim.ask("alive") is False
    broker.start()
    console = join("console", "none")
    console.sees("sim-1", within=60)
    assert console.ask("ping", "sim-1")["status"] == "ok"


@pytest.mark.system
def test_stop_crosses_the_bridge_in_both_directions(join: Join) -> None:
    local = {"STRANDS_MESH_PORT": str(free_port())}
    bridge = join("bridge", "none", STRANDS_MESH_BACKEND="bridge", **local)
    local_peer, remote_peer = join("sim-1", STRANDS_MESH_BACKEND="zenoh", **local), join("sim-2")
    bridge.sees("sim-1", "sim-2")
    remote_peer.sees("bridge")
    bridge.ask("estop")
    for peer in (local_peer, remote_peer):
        eventually(lambda peer=peer: peer.ask("epoch") == bridge.ask("epoch"))
    for peer in (local_peer, remote_peer, bridge):
        peer.ask("clear")
    remote_peer.ask("estop")
    eventually(lambda: bridge.ask("epoch") == remote_peer.ask("epoch"))


@pytest.mark.system
def test_peers_meet_again_when_the_broker_comes_back(join: Join, broker: MqttBroker) -> None:
    sim, console = join("sim-1"), join("console", "none")
    console.sees("sim-1")
    broker.stop()
    broker.start()
    eventually(lambda: console.ask("ping", "sim-1", 1)["status"] == "ok")
    eventually(lambda: sim.ask("reachable"))


@pytest.mark.system
@pytest.mark.timeout(300)
def test_stop_while_the_broker_is_down_reaches_every_peer_when_it_is_back(join: Join, broker: MqttBroker) -> None:
    sim, arm = join("sim-1"), join("arm-1", "arm")
    arm.sees("sim-1")
    for peer in (sim, arm):
        peer.ask("start", "wave")
    broker.stop()
    eventually(lambda: arm.ask("alive") is False, what="the broker is missed")
    assert arm.ask("estop")[1][0]["result"]["ok"] is True
    assert arm.ask("moving") is False
    assert sim.ask("moving") == ["left"]
    broker.start()
    # The client's pauses between two attempts double while the broker is away.
    eventually(lambda: sim.ask("epoch") == arm.ask("epoch"), within=150)
    eventually(lambda: sim.ask("moving") == [])


@pytest.mark.system
def test_a_certificate_of_another_authority_gets_no_connection(
    broker: MqttBroker, tmp_path: Path, folder: Path
) -> None:
    foreign = tmp_path / "foreign"
    config.make_authority(foreign)
    issued = config.issue_certificate(foreign, "sim-1")
    transport = IotMqttTransport(Account("localhost", broker.port, "sim-1", issued.cert, issued.key, folder / "ca.pem"))
    with pytest.raises(TransportError, match="no MQTT connection"):
        transport.connect()
