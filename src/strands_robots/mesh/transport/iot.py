"""MQTT 5 with mutual TLS as a transport, for brokers such as AWS IoT Core.

A key is a topic; ``*`` becomes ``+`` and ``**`` becomes ``#``. MQTT names no sessions: the broker's policy decides
which client may write to which topic, so a reply is as trustworthy as that policy. Quality of service and retention
come from the topic table. Tested against a local broker; not verified against AWS.
"""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from collections.abc import Mapping
from concurrent.futures import Future
from concurrent.futures import TimeoutError as FutureTimeoutError
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from strands_robots import settings
from strands_robots.mesh import topics, wire
from strands_robots.mesh.transport import Callback, Sample, Transport, TransportError
from strands_robots.utils import missing_extra

logger = logging.getLogger(__name__)

CONNECT_S = 15.0
ACKNOWLEDGE_S = 5.0
KEEP_ALIVE_S = 35
DEFAULT_PORT = 8883
NO_SUBSCRIBERS = 16
"""MQTT 5 reason code of a PUBACK: the topic has no subscribers."""

FAILED = 128
"""The lowest MQTT 5 reason code that is a refusal."""

MESSAGE_MAX_BYTES = 128 * topics.KIB
RETAIN_EVERY_S = 1.05
"""AWS takes messages of at most 128 KiB, and one retained message a second on a topic."""

UNREACHABLE = ("AWS_IO_SOCKET", "AWS_IO_DNS")
"""Failures of a broker that is not there yet; a refusal is something else."""

SAFETY = frozenset({"estop", "resume"})

CERT_NAMES = ("cert.pem", "certificate.pem.crt", "{thing}.pem", "{thing}.cert.pem")
KEY_NAMES = ("key.pem", "private.pem.key", "{thing}.key", "{thing}.private.key")


@dataclass(frozen=True, slots=True)
class Account:
    """Endpoint and credentials; ``thing`` is client id, certificate name and peer id."""

    host: str
    port: int
    thing: str
    cert: Path
    key: Path
    ca: Path | None

    @classmethod
    def from_settings(cls) -> Account:
        """The account of the environment. Raises TransportError for what is missing."""
        endpoint, thing = settings.raw("STRANDS_IOT_ENDPOINT"), settings.raw("STRANDS_IOT_THING_NAME")
        folder = settings.raw("STRANDS_IOT_CERT_DIR")
        stated = {
            "STRANDS_IOT_ENDPOINT": endpoint,
            "STRANDS_IOT_THING_NAME": thing,
            "STRANDS_IOT_CERT_DIR": folder,
        }
        absent = [name for name, value in stated.items() if not value]
        if absent:
            raise TransportError(f"the iot backend needs {', '.join(absent)}.")
        host, _, port = endpoint.partition(":")
        if port and not port.isdigit():
            raise TransportError(f"STRANDS_IOT_ENDPOINT must be host or host:port, not {endpoint!r}.")
        ca = settings.raw("STRANDS_IOT_CA_FILE")
        base = Path(folder).expanduser()
        return cls(
            host,
            int(port or DEFAULT_PORT),
            thing,
            _first(base, CERT_NAMES, thing),
            _first(base, KEY_NAMES, thing),
            Path(ca).expanduser() if ca else None,
        )


class _Subscriber:
    def __init__(self, owner: IotMqttTransport, key: str, callback: Callback) -> None:
        self.owner, self.key, self.callback = owner, key, callback

    def undeclare(self) -> None:
        self.owner.leave(self)


class IotMqttTransport(Transport):
    """One MQTT 5 client that reconnects and subscribes anew by itself."""

    confirms = True

    def __init__(self, account: Account | None = None) -> None:
        self._account = account
        self._client: Any = None
        self._crt: Any = None
        self._up = threading.Event()
        self._failed: str = ""
        self._reachable = True
        self._was_up, self._links_back = False, 0
        self._lock = threading.Lock()
        self._subscribers: list[_Subscriber] = []
        self._refusals: dict[str, str] = {}
        self._retained: dict[str, float] = {}
        self._unpublished: dict[str, int] = {}

    @property
    def session_id(self) -> str | None:
        return None

    def connect(self) -> None:
        if self._client is not None:
            return
        try:
            from awscrt import mqtt5  # noqa: PLC0415 - optional, loaded when used
            from awsiot import mqtt5_client_builder  # noqa: PLC0415 - optional, loaded when used
        except ImportError:
            raise missing_extra("The MQTT mesh", "iot") from None
        account = self._account = self._account or Account.from_settings()
        self._crt = mqtt5
        flow = mqtt5.ExtendedValidationAndFlowControlOptions
        local = account.host in ("127.0.0.1", "localhost", "::1")
        self._client = mqtt5_client_builder.mtls_from_path(
            endpoint=account.host,
            port=account.port,
            cert_filepath=str(account.cert),
            pri_key_filepath=str(account.key),
            ca_filepath=str(account.ca) if account.ca else None,
            client_id=account.thing,
            keep_alive_interval_sec=KEEP_ALIVE_S,
            # The limits of AWS's broker are a hundred messages a second; a broker on this machine has none.
            extended_validation_and_flow_control_options=flow.NONE if local else flow.AWS_IOT_CORE_DEFAULTS,
            on_publish_received=self._received,
            on_lifecycle_connection_success=self._connected,
            on_lifecycle_connection_failure=self._refused,
            on_lifecycle_disconnection=self._disconnected,
        )
        self._client.start()
        if self._up.wait(CONNECT_S):
            return
        problem = (
            f"no MQTT connection to {account.host}:{account.port} in {CONNECT_S:g} s: {self._failed or 'no answer'}"
        )
        if self._reachable:
            self.close()
            raise TransportError(problem)
        logger.error("%s. The mesh connects when the broker is there.", problem)

    def close(self) -> None:
        client, self._client = self._client, None
        with self._lock:
            self._subscribers.clear()
            self._refusals.clear()
        self._up.clear()
        if client is not None:
            client.stop()

    def links_back(self) -> int:
        return self._links_back

    def is_alive(self) -> bool:
        return self._client is not None and self._up.is_set()

    def put(self, key: str, payload: bytes | Mapping[str, Any]) -> None:
        self._publish(key, payload)

    def put_confirmed(self, key: str, payload: bytes | Mapping[str, Any], timeout: float) -> bool | None:
        future = self._publish(key, payload)
        if future is None:
            return None
        try:
            acknowledged = future.result(timeout).puback
        except FutureTimeoutError:
            return None
        except Exception as exc:  # noqa: BLE001 - the client raises errors of its own kind
            raise TransportError(f"{key}: {exc}") from None
        code = int(acknowledged.reason_code) if acknowledged is not None else 0
        if code >= FAILED:
            raise TransportError(f"{key}: the broker refused the message, reason {_reason(code)}.")
        return code != NO_SUBSCRIBERS

    def declare_subscriber(self, key: str, callback: Callback) -> _Subscriber:
        """Subscribe; a refusal of the broker is in :meth:`refusals`, and is tried again."""
        subscriber = _Subscriber(self, key, callback)
        with self._lock:
            self._subscribers.append(subscriber)
        if not self._up.is_set() and self._client is not None:
            return subscriber  # subscribed with the others when the broker is there
        try:
            self._note_suback(key, self._subscribe(key).result(ACKNOWLEDGE_S))
        except TransportError:
            self._forget(subscriber)
            raise
        except Exception as exc:  # noqa: BLE001 - the client raises errors of its own kind
            self._forget(subscriber)
            raise TransportError(f"{key}: the broker did not take the subscription: {exc}") from None
        return subscriber

    def refusals(self) -> Mapping[str, str]:
        return dict(self._refusals)

    def subscribe_again(self) -> int:
        keys = self.refusals() if self._up.is_set() else {}
        for key in keys:
            self._subscribe_later(key)
        return len(keys)

    def clear_retained(self, key: str) -> bool:
        packet = self._crt.PublishPacket(topic=key, payload=b"", qos=self._crt.QoS.AT_LEAST_ONCE, retain=True)
        self._watched(key, self._require().publish(packet))
        return True

    def leave(self, subscriber: _Subscriber) -> None:
        """Drop a subscriber, and the subscription with the last one of its topic."""
        last = self._forget(subscriber)
        client = self._client
        if last and client is not None:
            packet = self._crt.UnsubscribePacket(topic_filters=[filter_of(subscriber.key)])
            with contextlib.suppress(Exception):  # a broker that is away has no subscription to drop
                client.unsubscribe(packet)

    def _forget(self, subscriber: _Subscriber) -> bool:
        with self._lock:
            if subscriber not in self._subscribers:
                return False
            self._subscribers.remove(subscriber)
            last = all(each.key != subscriber.key for each in self._subscribers)
            if last:
                self._refusals.pop(subscriber.key, None)
            return last

    def _subscribe(self, key: str) -> Future[Any]:
        client = self._require()
        quality = self._crt.QoS.AT_LEAST_ONCE if (topics.topic_of(key).qos or 0) else self._crt.QoS.AT_MOST_ONCE
        wanted = self._crt.Subscription(topic_filter=filter_of(key), qos=quality)
        answer: Future[Any] = client.subscribe(self._crt.SubscribePacket(subscriptions=[wanted]))
        return answer

    def _subscribe_later(self, key: str) -> None:
        """Subscribe without waiting; the answer is read when it is there."""

        def answered(future: Future[Any]) -> None:
            if future.cancelled():
                return
            failure = future.exception()
            if failure is None:
                self._note_suback(key, future.result())
            elif self._client is not None:
                self._refuse(key, str(failure))

        with contextlib.suppress(TransportError):  # closed meanwhile
            self._subscribe(key).add_done_callback(answered)

    def _note_suback(self, key: str, answer: Any) -> None:
        packet = getattr(answer, "suback", answer)
        refused = [code for code in getattr(packet, "reason_codes", None) or () if int(code) >= FAILED]
        if refused:
            self._refuse(key, f"the broker refused the subscription, reason {_reason(refused[0])}")
        elif self._refusals.pop(key, None) is not None:
            logger.warning("%s: the broker takes the subscription now.", key)

    def _refuse(self, key: str, why: str) -> None:
        with self._lock:
            if all(each.key != key for each in self._subscribers):
                return
            known, self._refusals[key] = self._refusals.get(key), why
        if known != why:
            level = logging.CRITICAL if topics.topic_of(key).name in SAFETY else logging.ERROR
            logger.log(level, "%s: %s; nothing is received there.", key, why)

    def _watched(self, key: str, future: Future[Any]) -> Future[Any]:
        """Read the broker's answer to a message; a refusal is logged once for each topic."""

        def answered(done: Future[Any]) -> None:
            if done.cancelled() or done.exception() is not None:
                return
            code = _puback_code(done.result())
            topic = topics.topic_of(key)
            if code >= FAILED and self._unpublished.get(topic.name) != code:
                self._unpublished[topic.name] = code
                level = logging.CRITICAL if topic.name in SAFETY else logging.ERROR
                logger.log(level, "%s: the broker refused the message, reason %s.", key, _reason(code))
            elif code < FAILED:
                self._unpublished.pop(topic.name, None)

        future.add_done_callback(answered)
        return future

    def _may_retain(self, key: str) -> bool:
        now = time.monotonic()
        if now - self._retained.get(key, -RETAIN_EVERY_S) < RETAIN_EVERY_S:
            return False
        self._retained[key] = now
        return True

    def _publish(self, key: str, payload: bytes | Mapping[str, Any]) -> Future[Any] | None:
        topic = topics.topic_of(key)
        if topic.qos is None:
            return None
        data = payload if isinstance(payload, bytes) else wire.encode(payload, topic.max_bytes)
        most = min(topic.max_bytes, MESSAGE_MAX_BYTES)
        if len(data) > most:
            raise wire.TooLargeError(f"{key}: a message of {len(data)} bytes is above {most}, the most over MQTT.")
        client = self._require()
        if topic.name == "presence" and not self._up.is_set():
            return None  # the client would store every heartbeat of an outage
        # A stop of some robots must not take the place of one of every robot at the broker.
        retain = topic.retain and b'"scope"' not in data and self._may_retain(key)
        packet = self._crt.PublishPacket(topic=key, payload=data, qos=self._crt.QoS(topic.qos), retain=retain)
        try:
            future: Future[Any] = client.publish(packet)
        except Exception as exc:  # noqa: BLE001 - the client raises errors of its own kind
            raise TransportError(f"{key}: {exc}") from None
        return self._watched(key, future) if topic.qos else None

    def _require(self) -> Any:
        client = self._client
        if client is None:
            raise TransportError("the MQTT client is closed.")
        return client

    def _received(self, data: Any) -> None:
        packet = data.publish_packet
        key = packet.topic
        if len(packet.payload or b"") > topics.topic_of(key).max_bytes:
            logger.debug("%s: a message of %d bytes was dropped unread.", key, len(packet.payload))
            return
        sample = Sample(key, bytes(packet.payload or b""), None, sessionless=True, retained=bool(packet.retain))
        with self._lock:
            matching = [each for each in self._subscribers if topics.matches(each.key, key)]
        for each in matching:
            try:
                each.callback(sample)
            except Exception:
                logger.exception("A subscriber of %s failed.", each.key)

    def _connected(self, data: Any) -> None:
        settled = getattr(data, "negotiated_settings", None)
        with self._lock:
            self._up.set()
            self._links_back += self._was_up
            self._was_up = True
            rejoined = getattr(settled, "rejoined_session", False)
            keys = {each.key for each in self._subscribers} if not rejoined else set(self._refusals)
        for key in keys:
            self._subscribe_later(key)
        self._failed = ""

    def _refused(self, data: Any) -> None:
        failure = getattr(data, "exception", "refused")
        self._failed = str(failure)
        self._reachable = not str(getattr(failure, "name", "")).startswith(UNREACHABLE)

    def _disconnected(self, data: Any) -> None:
        self._up.clear()
        self._failed = "disconnected"
        if self._client is not None:
            logger.warning("The MQTT broker is gone; the mesh connects again by itself.")


def _puback_code(completed: Any) -> int:
    acknowledged = getattr(completed, "puback", None)
    return int(acknowledged.reason_code) if acknowledged is not None else 0


def _reason(code: Any) -> str:
    return f"0x{int(code):02x}{f' ({code.name})' if hasattr(code, 'name') else ''}"


def filter_of(key: str) -> str:
    """The MQTT topic filter of a key expression."""
    return "/".join({"*": "+", "**": "#"}.get(part, part) for part in key.split("/"))


def _first(folder: Path, names: tuple[str, ...], thing: str) -> Path:
    for name in names:
        path = folder / name.format(thing=thing)
        if path.is_file():
            return path
    raise TransportError(f"STRANDS_IOT_CERT_DIR: {folder} holds none of {', '.join(names)}.".format(thing=thing))
