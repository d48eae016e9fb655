"""Link to a ROS 2 graph over bare DDS, without ROS 2 on this side."""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from importlib import import_module
from types import ModuleType
from typing import Any, get_args, get_type_hints

from strands_robots import settings
from strands_robots.ros.dds_security import checked_credentials, presenting
from strands_robots.ros.link import Message, OnMessage, RosError, Unwatch, next_message
from strands_robots.ros.names import absolute, bare_kind, domain, is_latched
from strands_robots.utils import missing_extra, number, shown

logger = logging.getLogger(__name__)

DEPTH = 10
_SLICE_MS = 100
_POLL_S = 0.02

LOOPBACK_ONLY = """<CycloneDDS><Domain Id="any"><General>
<Interfaces><NetworkInterface name="lo" multicast="false"/></Interfaces><AllowMulticast>false</AllowMulticast></General>
<Discovery><ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>30</MaxAutoParticipantIndex>
<SPDPInterval>2s</SPDPInterval><Peers><Peer address="127.0.0.1"/></Peers></Discovery></Domain></CycloneDDS>"""
"""Cyclone DDS on this machine alone, without multicast; for Linux, whose loopback interface is ``lo``.

A participant announces itself every 2 s, because a lost announcement is not repeated sooner (RTPS 2.5, 8.5.3).
"""

_domains: dict[int, Any] = {}
_domains_lock = threading.Lock()


class DdsLink:
    """A :class:`~strands_robots.ros.link.RosLink` of topics, opened by first use.

    A published message needs a subscription: while no subscription matches, a publish waits ``match_s`` and fails.

    Args:
        domain_id: 0 to 232; ``ROS_DOMAIN_ID`` by default.
        match_s: how long a publish waits for a first subscription, and a read without a type for a publisher.
        dds_security_config: credentials of :func:`~strands_robots.ros.dds_security.checked_credentials`; the
            participant then presents them or does not come up. Without, the participant proves nothing.

    Raises:
        ValidationError: an argument outside its domain, or credentials that the installed library cannot honour.
        MissingExtraError: credentials are given and the [ros2] extra is not installed.
    """

    def __init__(
        self,
        domain_id: int | None = None,
        *,
        match_s: float = 0.5,
        dds_security_config: Mapping[str, str] | None = None,
    ) -> None:
        self.domain_id = domain(domain_id)
        self._match_s = number("match_s", match_s, low=0, high=60)
        self._credentials = checked_credentials(dds_security_config)
        self._security = [] if self._credentials is None else self._credentials.policies(_dds("qos"))
        self._lock = threading.RLock()
        self._participant: Any = None
        self._writers: dict[tuple[str, str], Any] = {}
        self._unwatch: list[Unwatch] = []

    def open(self) -> Any:
        """Join the domain now, rather than at the first use; return the participant."""
        with self._lock:
            if self._participant is None:
                with presenting(self.domain_id, self._credentials):
                    self._participant = self._joined()
            return self._participant

    def advertise(self, topic: str, kind: str) -> None:
        """Appear on the graph as a publisher of ``topic`` before the first message."""
        self._writer(topic, kind)

    def publish(self, topic: str, kind: str, fields: Message) -> None:
        message = filled(_struct(kind), fields)
        writer = self._writer(topic, kind)
        deadline = time.monotonic() + self._match_s
        subscribed = import_module("strands_robots.ros._compat").subscribed
        while not subscribed(writer):
            if time.monotonic() >= deadline:
                raise RosError(f"No subscription to {topic} as {bare_kind(kind)} in domain {self.domain_id}.")
            time.sleep(0.002)
        _write(writer, message, topic, kind)

    def broadcast(self, topic: str, kind: str, fields: Message) -> None:
        """Publish, such as telemetry, whether or not there is a subscription."""
        message = filled(_struct(kind), fields)
        _write(self._writer(topic, kind), message, topic, kind)

    def read(self, topic: str, kind: str | None, within_s: float) -> dict[str, Any]:
        return next_message(self.watch, topic, kind, within_s)

    def call(self, service: str, kind: str, fields: Message, within_s: float) -> dict[str, Any]:
        """Refuse: bare DDS carries topics only."""
        del kind, fields, within_s
        raise RosError(f"{service} is a service, and bare DDS carries topics only; use rclpy or rosbridge.")

    def watch(self, topic: str, kind: str | None, on_message: OnMessage) -> Unwatch:
        sub, qos, core = _dds("sub"), _dds("qos"), _dds("core")
        struct = _struct(kind or self._kind_of(topic))
        # Best effort takes what a sensor sends so as well as what is sent reliably; what is latched is sent so.
        policies = [qos.Policy.Reliability.BestEffort, qos.Policy.History.KeepLast(DEPTH)]
        if is_latched(topic):
            reliable = qos.Policy.Reliability.Reliable(max_blocking_time=_SLICE_MS * 1_000_000)
            policies = [reliable, qos.Policy.Durability.TransientLocal, *policies[1:]]
        quality = qos.Qos(*policies)
        with self._lock:
            participant = self.open()
            try:
                reader = sub.DataReader(participant, self._topic(topic, struct), qos=quality)
                waitset = core.WaitSet(participant)
            except core.DDSException as exc:
                raise RosError(f"{topic} cannot be read in domain {self.domain_id}: {exc}") from exc
        anything = core.SampleState.Any | core.ViewState.Any | core.InstanceState.Any
        waitset.attach(core.ReadCondition(reader, anything))
        done = threading.Event()

        def run() -> None:
            slice_ns = _SLICE_MS * 1_000_000
            while not done.is_set():
                if waitset.wait(slice_ns):
                    for message in _arrived(reader, topic, core.DDSException, done):
                        _deliver(on_message, message, topic)

        thread = threading.Thread(target=run, name=f"dds-{topic.strip('/')}", daemon=True)

        def unwatch() -> None:
            done.set()
            with contextlib.suppress(ValueError):  # a second call has nothing left to take out
                self._unwatch.remove(unwatch)
            if thread is not threading.current_thread():
                thread.join(10 * _SLICE_MS / 1000)

        thread.start()
        self._unwatch.append(unwatch)
        return unwatch

    def endpoints(self) -> list[dict[str, str]]:
        """Return ``topic``, ``type`` and ``role`` of each endpoint discovered so far."""
        builtin, core = _dds("builtin"), _dds("core")
        sources = {
            "publisher": builtin.BuiltinTopicDcpsPublication,
            "subscription": builtin.BuiltinTopicDcpsSubscription,
        }
        alive = core.SampleState.Any | core.ViewState.Any | core.InstanceState.Alive
        found = []
        # Not under the lock, which a command's first message needs.
        participant = self.open()
        for role, source in sources.items():
            try:
                reader = builtin.BuiltinDataReader(participant, source)
                seen = reader.read(N=10_000, condition=core.ReadCondition(reader, alive))
            except core.DDSException as exc:
                raise RosError(f"DDS domain {self.domain_id} does not tell its endpoints: {exc}") from exc
            for each in seen:
                if each.sample_info.valid_data and each.topic_name.startswith("rt/"):
                    kind = each.type_name.replace("::msg::dds_::", "/msg/").removesuffix("_")
                    found.append({"topic": each.topic_name[2:], "type": kind, "role": role})
        return found

    def topics(self) -> list[dict[str, Any]]:
        """Return ``topic``, ``type``, ``publishers`` and ``subscriptions`` of each topic.

        A domain that was joined just now has ``match_s`` to be discovered.
        """
        deadline = time.monotonic() + self._match_s
        while not (seen := self.endpoints()) and time.monotonic() < deadline:
            time.sleep(_POLL_S)
        found: dict[tuple[str, str], dict[str, Any]] = {}
        for each in seen:
            row = {"topic": each["topic"], "type": each["type"], "publishers": 0, "subscriptions": 0}
            found.setdefault((each["topic"], each["type"]), row)[f"{each['role']}s"] += 1
        return [found[key] for key in sorted(found)]

    def nodes(self) -> list[str]:
        """Refuse: bare DDS has no nodes."""
        raise RosError("Bare DDS does not tell of nodes; use rclpy or rosbridge.")

    def services(self) -> list[str]:
        """Refuse: bare DDS carries topics only."""
        raise RosError("Bare DDS carries topics only; use rclpy or rosbridge for services.")

    def actions(self) -> list[str]:
        """Refuse: bare DDS carries topics only."""
        raise RosError("Bare DDS carries topics only; use rclpy or rosbridge for actions.")

    def close(self) -> None:
        # The watchers end first: what they wait on goes with the participant.
        for each in list(self._unwatch):
            each()
        with self._lock:
            self._writers.clear()
            self._participant = None

    def _joined(self) -> Any:
        module = _dds("domain")
        try:
            confine(module, self.domain_id)
            joined = module.DomainParticipant(self.domain_id, qos=_dds("qos").Qos(*self._security))
        except _dds("core").DDSException as exc:
            secured = " with these credentials" if self._security else ""
            raise RosError(f"DDS domain {self.domain_id} could not be joined{secured}: {exc}") from exc
        # A library that took the credentials and forgot them would leave the graph open.
        if not all(each in joined.get_qos().policies for each in self._security):
            raise RosError(f"DDS domain {self.domain_id} was not joined: the library dropped the credentials.")
        return joined

    def _topic(self, topic: str, struct: type[Any]) -> Any:
        return _dds("topic").Topic(self.open(), f"rt/{topic.lstrip('/')}", struct)

    def _writer(self, topic: str, kind: str) -> Any:
        key = (topic, bare_kind(kind))
        with self._lock:
            if key not in self._writers:
                qos = _dds("qos")
                reliable = qos.Policy.Reliability.Reliable(max_blocking_time=_SLICE_MS * 1_000_000)
                quality = qos.Qos(reliable, qos.Policy.History.KeepLast(DEPTH))
                struct = _struct(kind)
                try:
                    made = _dds("pub").DataWriter(self.open(), self._topic(topic, struct), qos=quality)
                except _dds("core").DDSException as exc:
                    raise RosError(f"{topic} cannot be published as {bare_kind(kind)}: {exc}") from exc
                self._writers[key] = made
            return self._writers[key]

    def _kind_of(self, topic: str) -> str:
        wanted = absolute(topic)
        deadline = time.monotonic() + self._match_s
        while True:
            for each in self.endpoints():
                if each["topic"] == wanted and each["role"] == "publisher":
                    return each["type"]
            if time.monotonic() >= deadline:
                raise RosError(f"No publisher of {topic} in domain {self.domain_id}, so its type is not known.")
            time.sleep(_POLL_S)


def _write(writer: Any, message: Any, topic: str, kind: str) -> None:
    try:
        writer.write(message)
    except Exception as exc:
        raise RosError(f"{topic} did not take a {bare_kind(kind)}: {exc}") from exc


def confine(module: ModuleType, domain_id: int) -> None:
    """Confine the domain to loopback where ``ROS_LOCALHOST_ONLY`` is set."""
    if settings.is_set("CYCLONEDDS_URI") or not settings.boolean("ROS_LOCALHOST_ONLY", safe=True):
        return
    with _domains_lock:
        if domain_id not in _domains:
            _domains[domain_id] = module.Domain(domain_id, LOOPBACK_ONLY)


def _struct(kind: str) -> type[Any]:
    _dds("core")
    kinds: dict[str, type[Any]] = import_module("strands_robots.ros.dds_types").KINDS
    found = kinds.get(bare_kind(kind))
    if found is None:
        raise RosError(f"{kind} is not among the types that bare DDS carries here: {', '.join(sorted(kinds))}.")
    return found


def _dds(module: str) -> ModuleType:
    try:
        return import_module(f"cyclonedds.{module}")
    except ModuleNotFoundError as exc:
        if (exc.name or "").partition(".")[0] != "cyclonedds":
            raise
        raise missing_extra("Bare DDS", "ros2") from exc


def _arrived(reader: Any, topic: str, lost: type[Exception], done: threading.Event) -> Iterator[dict[str, Any]]:
    """Yield the messages that have arrived, and log those that are unreadable."""
    level = logging.WARNING
    while not done.is_set():
        try:
            samples = reader.take(N=1)
        except lost:
            raise
        except Exception as exc:  # noqa: BLE001 - the library's decoder raises whatever a peer's bytes provoke
            logger.log(level, "A message of %s cannot be read: %s", topic, exc)
            # A flood of them must not become a flood of warnings.
            level = logging.DEBUG
            continue
        if not samples:
            return
        # A writer that leaves delivers one sample without data.
        if samples[0].sample_info.valid_data:
            yield plain(samples[0])


def _deliver(on_message: OnMessage, message: dict[str, Any], topic: str) -> None:
    try:
        on_message(message)
    except Exception:
        logger.exception("A watcher of %s failed.", topic)


def filled(struct: type[Any], fields: Mapping[str, Any], place: str = "") -> Any:
    """Return a struct with these fields, else zeros; a wrong one is a RosError."""
    hints = get_type_hints(struct, include_extras=True)
    message = struct()
    for name, value in fields.items():
        if name not in hints:
            raise RosError(f"{struct.__name__} has no field {place}{name}; it has {', '.join(hints)}.")
        setattr(message, name, _value(hints[name], getattr(message, name), value, f"{place}{name}"))
    return message


def plain(message: Any) -> dict[str, Any]:
    """Return the fields of a message as numbers, text, bytes, lists and dictionaries."""
    return {each.name: _plain(getattr(message, each.name)) for each in dataclasses.fields(message)}


def _value(hint: Any, zero: Any, value: Any, place: str) -> Any:
    if dataclasses.is_dataclass(zero):
        if not isinstance(value, Mapping):
            raise RosError(f"{place} must be an object of fields, not {shown(value)}.")
        return filled(type(zero), value, f"{place}.")
    if isinstance(zero, bytes):
        return _bytes(value, place)
    if isinstance(zero, list):
        return _items(hint, zero, value, place)
    if isinstance(zero, bool) or isinstance(value, bool):
        fits = isinstance(zero, bool) and isinstance(value, bool)
    elif isinstance(zero, float):
        fits = isinstance(value, int | float)
        value = float(value) if fits else value
    else:
        fits = isinstance(value, type(zero))
    if not fits:
        raise RosError(f"{place} must be a {type(zero).__name__}, not {shown(value)}.")
    return value


def _items(hint: Any, zero: list[Any], value: Any, place: str) -> list[Any]:
    listed = value.tolist() if callable(getattr(value, "tolist", None)) else value
    if not isinstance(listed, Sequence) or isinstance(listed, str | bytes):
        raise RosError(f"{place} must be a list, not {shown(value)}.")
    if zero and len(listed) != len(zero):
        raise RosError(f"{place} must have {len(zero)} items, not {len(listed)}.")
    kind = _item_type(hint)
    return [_value(kind, kind(), each, f"{place}[{n}]") for n, each in enumerate(listed)]


def _item_type(hint: Any) -> Any:
    inner = get_args(get_args(hint)[0])[0]
    # A number's type is Annotated[float, "float64"]; that of text and structs is itself.
    parts = get_args(inner)
    return parts[0] if parts else inner


def _bytes(value: Any, place: str) -> bytes:
    if isinstance(value, bytes | bytearray):
        return bytes(value)
    tobytes = getattr(value, "tobytes", None)
    if callable(tobytes):
        return bytes(tobytes())
    try:
        return bytes(value) if isinstance(value, list) else bytes([-1])
    except (TypeError, ValueError):
        raise RosError(f"{place} must be bytes or a list of them, not {shown(value)}.") from None


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value):
        return plain(value)
    if not isinstance(value, list | tuple):
        return value
    # A sequence has one type, and a scan or a map has many values.
    return list(value) if value and isinstance(value[0], int | float | str) else [_plain(each) for each in value]
