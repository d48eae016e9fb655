"""Link to a ROS 2 graph over bare DDS, without ROS 2 here, and DDS Security."""

from __future__ import annotations

import contextlib
import logging
import os
import ssl
import threading
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from email import message_from_bytes
from fnmatch import fnmatchcase
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any
from xml.etree import ElementTree

from strands_robots import settings
from strands_robots.ros.link import (
    Message,
    OnMessage,
    RosError,
    Unwatch,
    absolute,
    bare_kind,
    deliver,
    domain,
    filled,
    is_latched,
    next_message,
    plain,
)
from strands_robots.utils import ValidationError, number, optional_module

logger = logging.getLogger(__name__)

REQUIRED = ("identity_ca", "certificate", "private_key", "governance", "permissions")
OPTIONAL = ("permissions_ca",)

# The names of the properties are those of the OMG's DDS Security 1.1; the plugins are the ones of Cyclone DDS.
_FILE, _DATA = "file:", "data:,"
_LONGEST = 100_000
_PROPERTIES = {
    "identity_ca": "dds.sec.auth.identity_ca",
    "certificate": "dds.sec.auth.identity_certificate",
    "private_key": "dds.sec.auth.private_key",
    "permissions_ca": "dds.sec.access.permissions_ca",
    "governance": "dds.sec.access.governance",
    "permissions": "dds.sec.access.permissions",
}
_PLUGINS = (
    ("auth", "libdds_security_auth.so", "authentication"),
    ("access", "libdds_security_ac.so", "access_control"),
    ("crypto", "libdds_security_crypto.so", "crypto"),
)

_presented: dict[int, DdsCredentials] = {}
_presenting = threading.Lock()

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


@dataclass(frozen=True, slots=True)
class DdsCredentials:
    """The checked credentials of one participant, as URIs; never printed."""

    uris: Mapping[str, str] = field(repr=False)

    def document(self, name: str) -> bytes:
        """Return the content of one of them, such as the signed ``governance``."""
        uri = self.uris[name]
        return uri.removeprefix(_DATA).encode() if uri.startswith(_DATA) else Path(uri.removeprefix(_FILE)).read_bytes()

    def policies(self, qos: Any) -> list[Any]:
        """Return property policies of a participant for the given ``cyclonedds.qos``.

        Raises:
            ValidationError: the loaded Cyclone DDS has no DDS Security.
        """
        found = {_PROPERTIES[name]: uri for name, uri in self.uris.items()}
        folder = _plugin_folder()
        for role, file, called in _PLUGINS:
            loaded = {"path": str(folder / file), "init": f"init_{called}", "finalize": f"finalize_{called}"}
            found |= {".".join(("dds.sec", role, "library", part)): value for part, value in loaded.items()}
        return [qos.Policy.Property(key, value) for key, value in found.items()]


def checked_credentials(config: object) -> DdsCredentials | None:
    """Check a ``dds_security_config`` and return its credentials; None stays None.

    Values are paths or ``file:`` or ``data:,`` URIs. The permissions CA is the identity CA unless it is given. No
    message shows a value that may be a key.

    Raises:
        ValidationError: a key is missing or unknown, a value names no readable file and is no ``data:,`` URI, or the
            private key is not that of the certificate.
    """
    if config is None:
        return None
    if not isinstance(config, dict):
        raise ValidationError(f"dds_security_config must be an object of paths by name, not {type(config).__name__}.")
    missing = [key for key in REQUIRED if key not in config]
    unknown = sorted(str(key) for key in config if key not in REQUIRED + OPTIONAL)
    if missing or unknown:
        wrong = [f"no {key}" for key in missing] + [f"an unknown {key}" for key in unknown]
        raise ValidationError(
            f"dds_security_config must have {', '.join(REQUIRED)} and may have permissions_ca; it has "
            f"{' and '.join(wrong)}."
        )
    uris = {key: _uri(f"dds_security_config[{key!r}]", value) for key, value in config.items()}
    uris.setdefault("permissions_ca", uris["identity_ca"])
    credentials = DdsCredentials(uris)
    _check_key(credentials)
    return credentials


@contextlib.contextmanager
def presenting(domain_id: int, credentials: DdsCredentials | None) -> Iterator[None]:
    """Join a domain with ``credentials`` inside this context, one thread at a time.

    The access control of Cyclone DDS 0.10 keeps the governance and permissions of the first participant of a domain
    for every later one of the process, so this refuses other credentials, which the library would ignore.

    Raises:
        RosError: this process has presented other credentials in this domain.
    """
    with _presenting:
        if credentials is not None and _presented.get(domain_id, credentials) != credentials:
            raise RosError(
                f"This process has presented other credentials in DDS domain {domain_id}; use another process."
            )
        yield
        if credentials is not None:
            _presented[domain_id] = credentials


def _check_key(credentials: DdsCredentials) -> None:
    # The plugins accept a key that does not fit and then fail with every peer.
    with contextlib.ExitStack() as files:
        names = []
        for name in ("certificate", "private_key"):
            # In memory, because a key given as data has no business on a disk.
            file = files.enter_context(os.fdopen(os.memfd_create(name), "wb"))
            file.write(credentials.document(name))
            file.flush()
            names.append(f"/proc/self/fd/{file.fileno()}")
        try:
            ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT).load_cert_chain(names[0], names[1], password=lambda: "")
        except (ssl.SSLError, ValueError) as exc:
            raise ValidationError(
                "dds_security_config['private_key'] must be the PEM key of dds_security_config['certificate'], without "
                "a passphrase; it is not."
            ) from exc


def _uri(name: str, value: object) -> str:
    domain = f"{name} must be a path, a file: URI or a data:, URI of 1 to {_LONGEST} characters"
    if not isinstance(value, str):
        raise ValidationError(f"{domain}, not {type(value).__name__}.")
    if not value.strip() or len(value) > _LONGEST or "\0" in value:
        raise ValidationError(f"{domain}, not one of {len(value)}.")
    if value.startswith(_DATA) and value != _DATA:
        return value
    path = value.removeprefix(_FILE).removeprefix("//" if value.startswith("file:///") else "")
    if not path.isprintable() or path.startswith(("data:", "pkcs11:", "//")):
        raise ValidationError(f"{domain}; this one has another scheme, a host or control characters.")
    file = Path(path).absolute()
    if not (file.is_file() and os.access(file, os.R_OK)):
        raise ValidationError(f"{name} must name a readable file, not {str(file)!r}.")
    return f"{_FILE}{file}"


def _plugin_folder() -> Path:
    library = _loaded_library()
    if library is not None:
        # Upstream installs the plugins beside the library, Debian in a folder of the library's name.
        for folder in (library.parent, *sorted(library.parent.glob("libddsc*/"))):
            if all((folder / file).is_file() for _, file, _ in _PLUGINS):
                return folder
    raise ValidationError(
        f"dds_security_config cannot be honoured: the Cyclone DDS of this process ({library or 'not found'}) has no "
        "DDS Security plugins, and no wheel of cyclonedds 11 brings them; use cyclonedds 0.10.5 built on Debian's "
        "cyclonedds-dev, which scripts/dds-security.sh of this project does."
    )


def _loaded_library() -> Path | None:
    """Return the file of the loaded Cyclone DDS, on Linux."""
    maps = Path("/proc/self/maps")
    lines = maps.read_text().splitlines() if maps.exists() else []
    paths = (Path(line.split(maxsplit=5)[5]) for line in lines if "/libddsc" in line)
    return next((path for path in paths if path.name.startswith("libddsc")), None)


def governance_gap(document: bytes, domain_id: int, topic: str) -> str | None:
    """Return how a governance document lets a stranger write ``topic``, or None.

    The documents are those of DDS Security 1.1, section 9.4.1.2: XML inside S/MIME. The plugins check the signature.

    Args:
        document: the signed document.
        domain_id: the DDS domain.
        topic: the topic's name on the wire, such as ``rt/cmd_vel``.
    """
    rule = _domain_rule(document, domain_id)
    if rule is None:
        return f"it has no rule for domain {domain_id}"
    if _flag(rule, "allow_unauthenticated_participants"):
        return "it allows unauthenticated participants"
    topics = rule.iterfind("topic_access_rules/topic_rule")
    # The first rule that fits is the one that counts.
    fitting = next((each for each in topics if fnmatchcase(topic, _text(each, "topic_expression"))), None)
    if fitting is None:
        return f"it has no rule for {topic}"
    if not _flag(fitting, "enable_write_access_control"):
        return f"it lets every participant write {topic}"
    kinds = (_text(rule, "rtps_protection_kind"), _text(fitting, "metadata_protection_kind"))
    if all(kind in ("", "NONE") for kind in (*kinds, _text(fitting, "data_protection_kind"))):
        return f"it neither signs nor encrypts {topic}"
    return None


def _domain_rule(document: bytes, domain_id: int) -> ElementTree.Element | None:
    parts = message_from_bytes(document).walk()
    signed = next((part for part in parts if part.get_content_type() == "text/plain"), None)
    content = signed.get_payload(decode=True) if signed is not None else None
    try:
        root = ElementTree.fromstring(content if isinstance(content, bytes) else b"")
    except ElementTree.ParseError:
        return None
    rules = root.iterfind("domain_access_rules/domain_rule")
    return next((each for each in rules if _covers(each.find("domains"), domain_id)), None)


def _covers(domains: ElementTree.Element | None, domain_id: int) -> bool:
    if domains is None:
        return False
    if any((each.text or "").strip() == str(domain_id) for each in domains.iterfind("id")):
        return True
    for span in domains.iterfind("id_range"):
        low, high = _text(span, "min") or "0", _text(span, "max") or str(domain_id)
        if low.isdecimal() and high.isdecimal() and int(low) <= domain_id <= int(high):
            return True
    return False


def _flag(rule: ElementTree.Element, name: str) -> bool:
    return _text(rule, name).lower() in ("true", "1")


def _text(rule: ElementTree.Element, name: str) -> str:
    return (rule.findtext(name) or "").strip()


class DdsLink:
    """A :class:`~strands_robots.ros.link.RosLink` of topics, opened by first use.

    A published message needs a subscription: while no subscription matches, a publish waits ``match_s`` and fails.

    Args:
        domain_id: 0 to 232; ``ROS_DOMAIN_ID`` by default.
        match_s: how long a publish waits for a first subscription, and a read without a type for a publisher.
        dds_security_config: credentials of :func:`~strands_robots.ros.dds.checked_credentials`; the
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
        message = _filled(kind, fields)
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
        message = _filled(kind, fields)
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
                        deliver(on_message, message, topic)

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
                    writer = _dds("pub").DataWriter(self.open(), self._topic(topic, struct), qos=quality)
                except _dds("core").DDSException as exc:
                    raise RosError(f"{topic} cannot be published as {bare_kind(kind)}: {exc}") from exc
                self._writers[key] = writer
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


def _filled(kind: str, fields: Message) -> Any:
    return filled(_struct(kind)(), fields, lambda inner: _struct(inner)())


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


def _dds(module: str) -> Any:
    return optional_module(f"cyclonedds.{module}", what="Bare DDS", extra="ros2")


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
