"""The networks that the behaviour suite runs on, all with the same face."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, Protocol

import pytest
from fixtures.mesh_peer import MeshPeer
from fixtures.mesh_verbs import Streams, robot_of, verbs_of
from fixtures.mqtt_broker import PROGRAM, MqttBroker
from fixtures.waiting import eventually, free_port
from tests.mesh.peers import Fleet, RealClock

from strands_robots.mesh.transport import Transport, config
from strands_robots.mesh.transport.config import Posture
from strands_robots.mesh.transport.iot import Account, IotMqttTransport
from strands_robots.mesh.transport.zenoh import ZenohTransport

CANNOT = {
    ("mqtt", "input"): "input frames are not sent over MQTT",
    ("mqtt", "session"): "MQTT names no sessions",
    ("memory", "confirm"): "only MQTT reports whether a topic has subscribers",
    ("zenoh", "confirm"): "only MQTT reports whether a topic has subscribers",
    ("zenoh-tls", "confirm"): "only MQTT reports whether a topic has subscribers",
    ("bridge", "confirm"): "its Zenoh leg does not report whether a topic has subscribers",
}
"""What a network cannot do by design, and why: a test that needs it is skipped there."""


class Peer(Protocol):
    """A peer of a network, in this process or in one of its own."""

    peer_id: str

    def ask(self, verb: str, *arguments: Any) -> Any: ...

    def sees(self, *others: str, within: float = 20.0) -> None: ...


class Network:
    """A network to join; ``settings`` are those of every peer."""

    kind: str

    def __init__(self, folder: Path, settings: dict[str, str]) -> None:
        self.folder, self.settings = folder, settings
        self.stack = ExitStack()
        self.peers: dict[str, Peer] = {}

    def join(self, peer_id: str, robot: str) -> Peer:
        peer = self.peers[peer_id] = self._join(peer_id, robot)
        return peer

    def stranger(self, name: str = "mallory") -> Transport:
        """A session that the network admits under its own name and that is no peer."""
        transport = self._stranger(name)
        transport.connect()
        self.stack.callback(transport.close)
        return transport

    def needs(self, ability: str) -> None:
        """Skip the test where this network cannot do it by design."""
        why = CANNOT.get((self.kind, ability))
        if why is not None:
            pytest.skip(why)

    def _join(self, peer_id: str, robot: str) -> Peer:
        raise NotImplementedError

    def _stranger(self, name: str) -> Transport:
        raise NotImplementedError

    def _start(self, peer_id: str, robot: str, settings: dict[str, str]) -> MeshPeer:
        state = self.folder / peer_id
        state.mkdir(mode=0o700, exist_ok=True)
        peer = MeshPeer(peer_id, robot, {"STRANDS_STATE_DIR": str(state), **self.settings, **settings})
        self.stack.callback(peer.close)
        return peer


class _Local:
    """A peer of this process with a process's parts of its own."""

    def __init__(self, fleet: Fleet, peer_id: str, robot: str) -> None:
        self.peer_id = peer_id
        body = robot_of(robot, peer_id)
        mesh = fleet.join(body, peer_id, "sim" if robot == "world" else "robot")
        self.streams = Streams(mesh, body)
        self._verbs = verbs_of(mesh, body, self.streams, fleet.planes[peer_id])

    def ask(self, verb: str, *arguments: Any) -> Any:
        try:
            return json.loads(json.dumps(self._verbs[verb](*arguments)))
        except Exception as exc:
            raise RuntimeError(f"{type(exc).__name__}: {exc}") from exc

    def sees(self, *others: str, within: float = 20.0) -> None:
        eventually(lambda: set(others) <= set(self.ask("reachable")), within)


class InMemory(Network):
    kind = "memory"

    def __init__(self, folder: Path, settings: dict[str, str]) -> None:
        super().__init__(folder, settings)
        patch = self.stack.enter_context(pytest.MonkeyPatch.context())
        for name, value in settings.items():
            patch.setenv(name, value)
        self._fleet = Fleet(folder, RealClock())
        self.stack.callback(self._fleet.close)

    def _join(self, peer_id: str, robot: str) -> Peer:
        peer = _Local(self._fleet, peer_id, robot)
        self.stack.callback(peer.streams.close)
        return peer

    def _stranger(self, name: str) -> Transport:
        return self._fleet.stranger()


class OverZenoh(Network):
    kind = "zenoh"

    def __init__(self, folder: Path, settings: dict[str, str]) -> None:
        super().__init__(folder, settings)
        self.port = free_port()

    def _join(self, peer_id: str, robot: str) -> Peer:
        return self._start(peer_id, robot, {"STRANDS_MESH_PORT": str(self.port)})

    def _stranger(self, name: str) -> Transport:
        return ZenohTransport(Posture("strands", (f"tcp/127.0.0.1:{self.port}",), (), None, None, None, False, 16))


class OverTls(OverZenoh):
    kind = "zenoh-tls"

    def __init__(self, folder: Path, settings: dict[str, str]) -> None:
        super().__init__(folder, settings)
        config.make_authority(folder / "keys")

    def _join(self, peer_id: str, robot: str) -> Peer:
        issued = config.issue_certificate(self.folder / "keys", peer_id)
        return self._start(peer_id, robot, {"STRANDS_MESH_PORT": str(self.port), **issued.settings()})

    def _stranger(self, name: str) -> Transport:
        own = config.issue_certificate(self.folder / "keys", name)
        return ZenohTransport(
            Posture(
                "strands", (f"tls/127.0.0.1:{self.port}",), (), None, own, config.certified_peers("strands/"), False, 16
            )
        )


class OverMqtt(Network):
    """Signed messages over a broker that lets each client write under its own name."""

    kind = "mqtt"

    def __init__(self, folder: Path, settings: dict[str, str]) -> None:
        super().__init__(folder, settings)
        if PROGRAM is None:
            reason = "mosquitto is not installed (Debian package mosquitto)"
            (pytest.fail if os.environ.get("CI") else pytest.skip)(reason)
        self._keys = folder / "keys"
        config.make_authority(self._keys)
        own = config.issue_certificate(self._keys, "broker")
        self._broker = self.stack.enter_context(MqttBroker(folder, own.ca, own.cert, own.key))

    def _join(self, peer_id: str, robot: str) -> Peer:
        return self._start(peer_id, robot, self._account(peer_id))

    def _account(self, peer_id: str) -> dict[str, str]:
        return {
            **config.issue_certificate(self._keys, peer_id).settings(),
            "STRANDS_MESH_REQUIRE_SIGNED_IDENTITY": "1",
            "STRANDS_MESH_BACKEND": "iot",
            "STRANDS_IOT_ENDPOINT": f"localhost:{self._broker.port}",
            "STRANDS_IOT_THING_NAME": peer_id,
            "STRANDS_IOT_CERT_DIR": str(self._keys),
            "STRANDS_IOT_CA_FILE": str(self._keys / "ca.pem"),
        }

    def _stranger(self, name: str) -> Transport:
        own = config.issue_certificate(self._keys, name)
        return IotMqttTransport(Account("localhost", self._broker.port, name, own.cert, own.key, own.ca))


class OverBoth(OverMqtt):
    """The bridge: Zenoh with TLS and the broker; the stranger is on Zenoh."""

    kind = "bridge"

    def __init__(self, folder: Path, settings: dict[str, str]) -> None:
        self.port = free_port()
        super().__init__(folder, {**settings, "STRANDS_MESH_PORT": str(self.port)})

    def _account(self, peer_id: str) -> dict[str, str]:
        return {**super()._account(peer_id), "STRANDS_MESH_BACKEND": "bridge"}

    def _stranger(self, name: str) -> Transport:
        own = config.issue_certificate(self._keys, name)
        return ZenohTransport(
            Posture(
                "strands", (f"tls/127.0.0.1:{self.port}",), (), None, own, config.certified_peers("strands/"), False, 16
            )
        )


KINDS: dict[str, type[Network]] = {each.kind: each for each in (InMemory, OverZenoh, OverTls, OverMqtt, OverBoth)}


@contextmanager
def network(kind: str, folder: Path, settings: dict[str, str]) -> Iterator[Network]:
    made = KINDS[kind](folder, settings)
    with made.stack:
        yield made
