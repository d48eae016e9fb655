"""Zenoh sessions of every network: configuration, callbacks, links, stops.

Zenoh is imported with the first session. It calls back on its own threads; a sink given here runs there and must only
hand over. Callbacks are direct: the binding would otherwise start one Python thread for each subscriber, queryable and
query, and the interpreter waits for such a thread before it ends.

Zenoh 1.10 sets ``SO_LINGER`` to 10 s on each TCP and TLS link (``TCP_LINGER_TIMEOUT`` of zenoh-link-tcp, fixed when it
is built). Where the other host is gone, Linux then keeps the thread that closes the socket for so long (socket(7)). It
is one of the few threads that all sessions of a process share: with half of a network dead, nothing is received from
the other half for 10 s a link. So closing a socket of Zenoh's waits here for no host that is gone.
"""

from __future__ import annotations

import _thread
import atexit
import base64
import contextlib
import ctypes
import functools
import json
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from ctypes import pythonapi
from pathlib import Path
from typing import Any

from strands_robots.stop_log import stop_logger

logger = stop_logger(__name__)

Sink = Callable[[Any], None]
"""Takes a sample, a query or a reply of Zenoh's, on Zenoh's thread."""

QUEUED_BATCHES = 16
"""Batches of 64 KiB per priority and link: the memory that a peer costs which is stopped in a debugger."""

HANDSHAKE_MS = 2000
"""Time in which a peer that accepted a connection has to answer; a session does not close while it waits for that."""

LEASE_MS = 4000
"""Time after which a silent peer is given up; with a shorter one a lossy link would flap under a stop."""

TRY_MS = 1000
"""Time in which a client's e-stop session tries to open before it checks whether it is still wanted."""

RETRY_S = 0.25
OVERLAP_S = 2.0
"""Time in which a replaced session still carries stops: peers learn of the new one and of one another meanwhile."""

LOST_MAX = 1024
"""Peers remembered that were linked once; one of them that is linked again makes the link up anew."""

CLOSE_S = 10.0
"""Seconds that a close waits for the link's thread."""

RELEASE_S = 0.05
"""Seconds that Zenoh's threads may still need after a close to release callbacks.

A thread that asks for the interpreter while that ends aborts the process, and Zenoh does not report when the last one
has released.
"""

LINGER = struct.Struct("ii")
"""``struct linger``: on or off, and seconds."""

ZENOHS = LINGER.pack(1, 10)
DESCRIPTORS = Path("/dev/fd")

GATHER_S = 0.1
"""Seconds in which further links come up before their sockets are looked for."""

_due = threading.Lock()
"""Held while a search is due that has not begun."""


_of_thread = threading.local()


def transport_config(queues: Iterable[str], wait_before_drop_us: int) -> dict[str, Any]:
    """Return the section ``transport`` of a configuration.

    Args:
        queues: priorities with room for a burst; Zenoh's own queue holds two batches and drops what does not fit.
        wait_before_drop_us: microseconds that a sender waits for room.
    """
    queue = {
        "size": dict.fromkeys(queues, QUEUED_BATCHES),
        "congestion_control": {"drop": {"wait_before_drop": wait_before_drop_us}},
    }
    return {"unicast": {"open_timeout": HANDSHAKE_MS}, "link": {"tx": {"queue": queue}}}


def use_tls(
    config: dict[str, Any], *, ca: str, cert: str = "", key: str = "", verify_name: bool = True
) -> dict[str, Any]:
    """Have a configuration speak TLS alone, and return its section ``tls``.

    Args:
        ca, cert, key: PEM text, or the path of a PEM file; with a certificate both sides show one.
        verify_name: check that the name of the other side is in its certificate.
    """
    tls: dict[str, Any] = {"verify_name_on_connect": verify_name, **_pem_field("root_ca_certificate", ca)}
    if cert:
        tls["enable_mtls"] = True
        for side in ("connect", "listen"):
            tls |= _pem_field(f"{side}_certificate", cert)
            tls |= _pem_field(f"{side}_private_key", key)
    link = config["transport"]["link"]
    # A link with certificates must not fall back to plain TCP.
    link["protocols"], link["tls"] = ["tls"], tls
    return tls


def for_stops(config: dict[str, Any]) -> dict[str, Any]:
    """Make the configuration of a data-plane session that of an e-stop session."""
    config["connect"]["retry"] = {"period_init_ms": 50, "period_max_ms": 250, "period_increase_factor": 2}
    transport = config["transport"]
    transport["link"]["tx"]["lease"] = LEASE_MS
    # Answers of many robots come at once; Zenoh's own queue holds two batches and drops what does not fit.
    transport["link"]["tx"]["queue"] = {"size": dict.fromkeys(("real_time", "interactive_high"), QUEUED_BATCHES)}
    # Zenoh keeps a descriptor of each link that agreed on shared memory; a stop has no use for it.
    transport["shared_memory"] = {"enabled": False}
    if config["mode"] == "client":
        config["connect"]["timeout_ms"] = TRY_MS
    return config


def direct(sink: Sink, drop: Callable[[], None] | None = None) -> Any:
    """Return a handler that calls ``sink`` on Zenoh's receiving thread."""
    import zenoh  # noqa: PLC0415 - an optional package, loaded with the first session

    def on_message(message: Any) -> None:
        if not hasattr(_of_thread, "has_state"):
            _keep_thread_state()
        sink(message)

    return zenoh.handlers.Callback(on_message, drop, indirect=False)


def undeclare(entity: Any) -> None:
    """Undeclare an entity, unless its session was closed meanwhile."""
    import zenoh  # noqa: PLC0415 - as above

    with contextlib.suppress(zenoh.ZError):
        entity.undeclare()


class LinkedSession:
    """An open Zenoh session that knows the ids of the sessions it is linked to.

    Args:
        config: what ``zenoh.open`` takes.
        on_change: called on Zenoh's thread with True when a link came and with False when one went.

    Attributes:
        session: the ``zenoh.Session``.
        remotes: Zenoh ids of the sessions it is linked to.

    Raises:
        zenoh.ZError: the session cannot be opened.
    """

    def __init__(self, config: Mapping[str, Any], on_change: Callable[[bool], None] = lambda up: None) -> None:
        import zenoh  # noqa: PLC0415 - as above

        self.session: Any = zenoh.open(zenoh.Config.from_json5(json.dumps(config)))
        self.remotes: set[str] = set()
        self._on_change = on_change
        self._declared: list[Any] = []
        _OPEN.sessions.add(self)

    def watch_links(self) -> None:
        """Keep ``remotes`` up to date from now on."""
        events = self.session.info.declare_transport_events_listener(direct(self._on_transport), history=True)
        self._declared.append(events)

    def subscribe(self, key: str, sink: Sink) -> Any:
        """Have ``sink(sample)`` called for every sample on ``key`` until the close.

        The result may be undeclared before.
        """
        subscriber = self.session.declare_subscriber(key, direct(sink))
        self._declared.append(subscriber)
        return subscriber

    def close(self) -> None:
        """Undeclare, then close."""
        import zenoh  # noqa: PLC0415 - as above

        # Closing ends links, which Zenoh would report on its own threads after this has returned.
        for declared in self._declared:
            undeclare(declared)
        try:
            self.session.close()
        except zenoh.ZError as problem:
            logger.warning("a Zenoh session did not close in order: %s", problem)
        _OPEN.closed(self)

    def _on_transport(self, event: Any) -> None:
        import zenoh  # noqa: PLC0415 - as above

        up = event.kind == zenoh.SampleKind.PUT
        if up:
            close_in_background()
        change = self.remotes.add if up else self.remotes.discard
        change(str(event.transport.zid))
        self._on_change(up)


class StopSession:
    """Zenoh session of a network's e-stop link, opened and renewed on its own thread.

    Its callbacks run on Zenoh's threads.

    Args:
        config: makes the configuration of a data-plane session, for each session anew.
    """

    def __init__(self, config: Callable[[], dict[str, Any]]) -> None:
        self._config = config
        self._sessions: tuple[LinkedSession, ...] = ()
        self._dropping, self._reporting, self._starting = threading.Lock(), threading.Lock(), threading.Lock()
        self._up = False
        self._on_state: Callable[[bool], None] = lambda up: None
        self._linked: frozenset[tuple[int, str]] = frozenset()
        self._lost: dict[str, None] = {}
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None
        self._subscribed: Mapping[str, Sink] = {}
        self._stop_options: dict[str, Any] = {}
        self._answer_options: dict[str, Any] = {}

    @property
    def up(self) -> bool:
        """True while it is linked to any other session."""
        return self._up

    @property
    def remotes(self) -> set[str]:
        """The Zenoh ids of the sessions it is linked to."""
        return {zid for _, zid in self._links()}

    def start(self, subscribed: Mapping[str, Sink], on_state: Callable[[bool], None]) -> None:
        """Open it in the background, and try again until it is open.

        Args:
            subscribed: sinks by key expression.
            on_state: called when the session is up, up anew after a peer was lost, or down.
        """
        self._subscribed, self._on_state = subscribed, on_state
        with self._starting:
            self._start(self._open)
        _OPEN.stop_sessions.add(self)

    def renew(self) -> None:
        """Open another session, and close the present one after an overlap.

        The work is done on a thread; a call while that thread still works does nothing.
        """
        with self._starting:
            if self._thread is not None and not self._thread.is_alive() and not self._closing.is_set():
                self._start(self._replace)

    def put(self, key: str, payload: bytes, *, answer: bool, source: Any = None) -> bool:
        """Publish; False where no link carries it.

        Args:
            answer: many of its kind may be sent at once, and it stands before no stop.
            source: ``zenoh.SourceInfo`` of another session of this process, whose message it is.
        """
        sent, options = False, self._answer_options if answer else self._stop_options
        options = options if source is None else {**options, "source_info": source}
        for each in self._sessions:
            if not each.remotes:
                continue
            try:
                each.session.put(key, payload, **options)
            except Exception as exc:  # noqa: BLE001 - the binding has one error for a closed session and a bad key
                logger.warning("%s was not sent: %s", key.rpartition("/")[2], exc)
            else:
                sent = True
        return sent

    def close(self) -> None:
        """Close it for good. Blocks for at most ``CLOSE_S`` on its thread."""
        self._closing.set()
        with self._starting:
            thread = self._thread
        if thread is not None:
            thread.join(CLOSE_S)
        for each in self._sessions:
            self._drop(each)
        _OPEN.stop_sessions.discard(self)

    def _start(self, work: Callable[[], None]) -> None:
        self._thread = threading.Thread(target=work, name="stop-link", daemon=True)
        self._thread.start()

    def _replace(self) -> None:
        before = self._sessions
        self._open()
        self._closing.wait(OVERLAP_S)
        for each in before:
            self._drop(each)

    def _drop(self, session: LinkedSession) -> None:
        # A second caller waits too: a thread that is inside Zenoh while the interpreter ends aborts the process.
        with self._dropping:
            if session not in self._sessions:
                return
            self._sessions = tuple(other for other in self._sessions if other is not session)
            session.close()
        self._report()

    def _open(self) -> None:
        import zenoh  # noqa: PLC0415 - as above

        self._stop_options = {
            "priority": zenoh.Priority.REAL_TIME,
            "congestion_control": zenoh.CongestionControl.DROP,
            "express": True,
        }
        # Many robots answer at once: their answers share batches, and stand before no stop.
        self._answer_options = {**self._stop_options, "priority": zenoh.Priority.INTERACTIVE_HIGH, "express": False}
        session = None
        while session is None:
            if self._closing.is_set():
                return
            try:
                session = LinkedSession(for_stops(self._config()), lambda up: self._report())
            except zenoh.ZError as exc:
                logger.debug("the e-stop session does not open yet: %s", exc)
                self._closing.wait(RETRY_S)
        for key, sink in self._subscribed.items():
            session.subscribe(key, sink)
        self._sessions = (*self._sessions, session)
        session.watch_links()

    def _report(self) -> None:
        with self._reporting:
            before, self._linked = self._linked, self._links()
            here = {zid for _, zid in self._linked}
            new_session = bool({each for each, _ in self._linked} - {each for each, _ in before})
            # A peer that is back may have sent a stop meanwhile, though others stayed linked.
            anew = new_session or not here.isdisjoint(self._lost)
            self._lost.update(dict.fromkeys(zid for _, zid in before if zid not in here))
            for zid in (*here, *list(self._lost)[:-LOST_MAX]):
                self._lost.pop(zid, None)
            up = bool(here) and not self._closing.is_set()
            if up != self._up or (up and anew):
                self._up = up
                self._on_state(up)

    def _links(self) -> frozenset[tuple[int, str]]:
        """Return each link as session and peer."""
        return frozenset((id(each), zid) for each in self._sessions for zid in tuple(each.remotes))


def close_in_background() -> None:
    """Have the kernel close Zenoh's links in the background; return at once.

    Call it when a link has come up: Zenoh offers neither an option nor the descriptor of a link. Many links that come
    up together cost one search, on a thread that ends with it.
    """
    if _due.acquire(blocking=False):
        try:
            # Unlike Thread.start, this does not wait for the new thread: it is Zenoh's receiving thread that calls.
            _thread.start_new_thread(_gather, ())
        except RuntimeError:
            # There is no thread to be had now: the next link that comes up tries again. Nothing is logged, because a
            # paused terminal would hold Zenoh's thread.
            _due.release()


def change_links() -> int:
    """Change each link of Zenoh's now; return how many.

    What was sent is still delivered where the other host is there. Only sockets with Zenoh's own ten seconds are
    changed.
    """
    try:
        descriptors = [int(each.name) for each in DESCRIPTORS.iterdir()]
    except OSError:  # no such folder on this system
        return 0
    return sum(map(_in_background, descriptors))


def _gather() -> None:
    time.sleep(GATHER_S)
    _due.release()
    change_links()


def _in_background(descriptor: int) -> bool:
    """Change one descriptor; False where it is no link of Zenoh's, or closed."""
    # A socket object of Python's would change the socket: it applies the process's default timeout to it.
    libc, option = _libc(), (socket.SOL_SOCKET, socket.SO_LINGER)
    value, length = ctypes.create_string_buffer(LINGER.size), ctypes.c_uint32(LINGER.size)
    if libc.getsockopt(descriptor, *option, value, ctypes.byref(length)) or value.raw != ZENOHS:
        return False
    return not libc.setsockopt(descriptor, *option, LINGER.pack(0, 0), LINGER.size)


@functools.cache
def _libc() -> Any:
    return ctypes.CDLL(None)


def _keep_thread_state() -> None:
    """Keep the interpreter's state of this thread until the thread ends.

    Without it CPython makes a state for each callback on a thread that it did not start, and frees it after: two memory
    mappings, a tenth of a call's time. The count that this raises is never lowered; there are as many states as Zenoh
    has threads.
    """
    _of_thread.has_state = True
    pythonapi.PyGILState_Ensure()


def _pem_field(name: str, value: str) -> dict[str, str]:
    if value.lstrip().startswith("-----BEGIN"):
        return {f"{name}_base64": base64.b64encode(value.encode()).decode()}
    return {name: value}


class _Open:
    """Open sessions: with a subscriber, one would hang the interpreter's exit."""

    def __init__(self) -> None:
        self.stop_sessions: set[StopSession] = set()
        self.sessions: set[LinkedSession] = set()
        self._closed_at = -RELEASE_S

    def closed(self, session: LinkedSession) -> None:
        """Note that a session has closed just now."""
        self.sessions.discard(session)
        self._closed_at = time.monotonic()

    def close_all(self) -> None:
        """Close what is open, and wait until Zenoh's threads have released callbacks."""
        for stops in list(self.stop_sessions):
            stops.close()
        for session in list(self.sessions):
            session.close()
        time.sleep(max(0.0, self._closed_at + RELEASE_S - time.monotonic()))


_OPEN = _Open()
atexit.register(_OPEN.close_all)
