"""MQTT's answers are read, with a client that stands in for AWS's. The broker is a script here, not a network."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from fixtures.mesh_robots import Arm
from fixtures.waiting import eventually
from tests.mesh.peers import Fleet

from strands_robots.mesh import core, topics, wire
from strands_robots.mesh.core import Mesh
from strands_robots.mesh.transport import TransportError, iot
from strands_robots.mesh.transport.iot import Account, IotMqttTransport

NOT_AUTHORIZED = 0x87


class Broker:
    """A broker that refuses what a test says, in the place of AWS's client."""

    def __init__(self) -> None:
        self.refused: set[str] = set()
        self.subscribed: list[str] = []
        self.published: list[Any] = []
        self.puback = 0
        self.up = True
        self.failure: Any = None
        self.clients: list[Client] = []

    def drop(self) -> None:
        for each in self.clients:
            each.hooks["on_lifecycle_disconnection"](None)

    def accept(self) -> None:
        for each in self.clients:
            each.hooks["on_lifecycle_connection_success"](SimpleNamespace(negotiated_settings=None))


class Client:
    def __init__(self, broker: Broker, **hooks: Any) -> None:
        self.broker, self.hooks = broker, hooks

    def start(self) -> None:
        self.broker.clients.append(self)
        if self.broker.up:
            self.broker.accept()
        else:
            self.hooks["on_lifecycle_connection_failure"](SimpleNamespace(exception=self.broker.failure))

    def stop(self) -> None:
        self.broker.clients.remove(self)

    def subscribe(self, packet: Any) -> Future[Any]:
        [wanted] = packet.subscriptions
        self.broker.subscribed.append(wanted.topic_filter)
        code = NOT_AUTHORIZED if wanted.topic_filter in self.broker.refused else 1
        return done(SimpleNamespace(reason_codes=[code]))

    def unsubscribe(self, packet: Any) -> Future[Any]:
        return done(None)

    def publish(self, packet: Any) -> Future[Any]:
        self.broker.published.append(packet)
        acknowledged = SimpleNamespace(reason_code=self.broker.puback) if packet.qos else None
        return done(SimpleNamespace(puback=acknowledged))


class Failure(Exception):
    def __init__(self, name: str) -> None:
        super().__init__(name)
        self.name = name


def done(value: Any) -> Future[Any]:
    future: Future[Any] = Future()
    future.set_result(value)
    return future


@pytest.fixture
def broker(monkeypatch: pytest.MonkeyPatch) -> Broker:
    awsiot = pytest.importorskip("awsiot.mqtt5_client_builder")
    made = Broker()
    monkeypatch.setattr(iot, "CONNECT_S", 0.05)
    monkeypatch.setattr(awsiot, "mtls_from_path", lambda **options: Client(made, **options))
    return made


@pytest.fixture
def transport(broker: Broker) -> Iterator[IotMqttTransport]:
    made = IotMqttTransport(Account("iot.example", 8883, "arm-1", Path("cert"), Path("key"), None))
    yield made
    made.close()


Join = Callable[[Any], Mesh]


@pytest.fixture
def join(peers: Fleet, transport: IotMqttTransport, monkeypatch: pytest.MonkeyPatch) -> Join:
    monkeypatch.setattr(core, "HEARING_HZ", 20.0)

    def acquire() -> IotMqttTransport:
        transport.connect()
        return transport

    def start(robot: Any) -> Mesh:
        parts = peers.parts("arm-1")
        parts.acquire, parts.release = acquire, transport.close
        mesh = Mesh(robot, "arm-1", parts=parts)
        peers.meshes.append(mesh)
        mesh.start()
        return mesh

    return start


def heartbeats(broker: Broker) -> list[dict[str, Any]]:
    found = [each for each in broker.published if each.topic == "strands/arm-1/presence"]
    return [wire.decode(bytes(each.payload), 65536) for each in found]


def test_peer_that_may_not_receive_stops_is_up_refuses_motion_and_says_so(
    join: Join, broker: Broker, peers: Fleet, caplog: pytest.LogCaptureFixture
) -> None:
    broker.refused.add("strands/safety/estop")
    arm = Arm()
    mesh = join(arm)
    assert mesh.alive
    refused = arm.start_task("wave")
    assert "cannot receive emergency stops" in refused["reason"] and "0x87" in refused["reason"]
    assert arm.started == []
    beat = eventually(lambda: next((each for each in heartbeats(broker) if "estop_unheard" in each), None))
    assert "0x87" in beat["estop_unheard"]
    assert any(each.levelno == logging.CRITICAL and "CANNOT RECEIVE" in each.getMessage() for each in caplog.records)
    assert peers.events("estop_unheard")
    broker.refused.clear()
    eventually(lambda: arm.start_task("wave")["status"] == "success", what="the subscription is tried again")


def test_refusal_after_a_reconnect_halts_the_robot(join: Join, broker: Broker) -> None:
    arm = Arm()
    join(arm)
    assert arm.start_task("wave", duration=60)["status"] == "success"
    broker.drop()
    broker.refused.add("strands/safety/estop")
    broker.accept()
    eventually(lambda: arm.halts)
    assert arm.start_task("wave")["status"] == "error"


def test_refused_subscription_of_a_user_is_no_success(join: Join, broker: Broker) -> None:
    mesh = join(None)
    broker.refused.add("strands/+/state")
    assert mesh.subscribe("strands/*/state") is None
    assert mesh.subscribe("strands/*/pose") == "strands/*/pose"


def test_every_subscription_is_made_again_after_a_reconnect(join: Join, broker: Broker) -> None:
    join(Arm())
    first = set(broker.subscribed)
    broker.subscribed.clear()
    broker.drop()
    broker.accept()
    assert set(broker.subscribed) == first


def test_refused_publication_is_named_once_for_each_topic(
    transport: IotMqttTransport, broker: Broker, caplog: pytest.LogCaptureFixture
) -> None:
    transport.connect()
    broker.puback = NOT_AUTHORIZED
    for _ in range(3):
        transport.put(topics.estop(), {"peer_id": "arm-1"})
    named = [each for each in caplog.records if "refused the message, reason 0x87" in each.getMessage()]
    assert [each.levelno for each in named] == [logging.CRITICAL]


@pytest.mark.parametrize("name", ["AWS_IO_SOCKET_CONNECTION_REFUSED", "AWS_IO_DNS_QUERY_FAILED"])
def test_broker_that_is_down_at_the_start_is_connected_when_it_is_there(join: Join, broker: Broker, name: str) -> None:
    broker.up, broker.failure = False, Failure(name)
    mesh = join(Arm())
    assert (mesh.alive, broker.subscribed) == (False, [])
    assert heartbeats(broker) == []
    broker.accept()
    eventually(lambda: mesh.alive and heartbeats(broker))
    assert "strands/safety/estop" in broker.subscribed


def test_broker_that_refuses_the_certificate_is_an_error(transport: IotMqttTransport, broker: Broker) -> None:
    broker.up, broker.failure = False, Failure("AWS_IO_TLS_ERROR_NEGOTIATION_FAILURE")
    with pytest.raises(TransportError, match="no MQTT connection"):
        transport.connect()


def test_quotas_of_the_broker_are_kept(
    transport: IotMqttTransport, broker: Broker, monkeypatch: pytest.MonkeyPatch
) -> None:
    transport.connect()
    with pytest.raises(wire.TooLargeError, match="131072"):
        transport.put("strands/console/response/arm-1/t", b"x" * (128 * 1024 + 1))
    for _ in range(3):
        transport.put(topics.presence("arm-1"), {"robot_id": "arm-1"})
        transport.put(topics.presence("arm-1__left"), {"robot_id": "arm-1__left"})
    assert [each.retain for each in broker.published] == [True, True, False, False, False, False]


def test_stored_stop_is_cleared_by_an_empty_message(transport: IotMqttTransport, broker: Broker) -> None:
    transport.connect()
    transport.put(topics.estop(), {"peer_id": "arm-1"})
    assert transport.clear_retained(topics.estop())
    assert (broker.published[-1].topic, broker.published[-1].payload) == (topics.estop(), b"")
    assert broker.published[-1].retain
