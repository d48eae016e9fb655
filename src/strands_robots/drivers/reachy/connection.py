"""Being connected to a daemon that may be away, restart, be updated or fall silent.

One thread asks for the status, opens the link that the daemon speaks, and opens it again whenever joint frames stop
for 1.5 seconds: after a restart an old socket stays open and silent for ever, so the socket's own state proves nothing.
"""

from __future__ import annotations

import logging
import threading
import time
from dataclasses import dataclass, field
from typing import Any

from strands_robots.drivers.reachy.feed import FRESH_S, Feed
from strands_robots.drivers.reachy.links import ZENOH_PORT, Link, PubSub, key_prefix
from strands_robots.drivers.reachy.rest import DaemonError, DaemonUnknown, DaemonUnreachable, RestClient
from strands_robots.drivers.reachy.transport import (
    APP_LOCK_SINCE,
    DEFAULT_PREFIX,
    TRANSPORTS,
    DaemonInfo,
    make_link,
)
from strands_robots.utils import ValidationError, choice, port

logger = logging.getLogger(__name__)

FIRST_DELAY_S, LONGEST_DELAY_S = 0.1, 1.0
WATCH_EVERY_S, POLL_EVERY_S = 0.1, 1.0
STATUS_LAG_S = 1.5
STATUS_PATH, RUNNING_PATH = "/api/daemon/status", "/api/move/running"
LOCK_PATH, APP_PATH = "/api/daemon/robot-app-lock-status", "/api/apps/current-app-status"


@dataclass(frozen=True, slots=True)
class Poll:
    """What the daemon tells only when asked: who holds the robot (empty: nobody) and which REST moves run."""

    holder: str = ""
    moves: frozenset[str] = field(default_factory=frozenset)
    at: float = 0.0


class Connection:
    """The way to one daemon; ``start`` it, then ask :meth:`refusal` before sending.

    Args:
        host: bare hostname or IP literal of the daemon.
        api_port: its TCP port.
        prefix: of the Zenoh keys; the default gives way to the robot's own name.
        transport: ``auto`` for what the daemon speaks, or a link's name.
        session: a pub/sub object for the Zenoh link in place of a session of its own.
        zenoh_port: where a daemon before 1.5 listens for it.
    """

    def __init__(
        self,
        host: str,
        api_port: int = 8000,
        *,
        prefix: str = DEFAULT_PREFIX,
        transport: str = "auto",
        session: PubSub | None = None,
        zenoh_port: int = ZENOH_PORT,
    ) -> None:
        self.rest = RestClient(host, api_port)
        self.stop_rest = RestClient(host, api_port)
        self.hub_rest = RestClient(host, api_port, read_s=10.0)
        self.host, self.port = self.rest.host, self.rest.port
        self._prefix = key_prefix(prefix)
        self._transport = choice("transport", transport, TRANSPORTS)
        self._session, self._zenoh_port = session, port("zenoh_port", zenoh_port)
        self.feed = Feed()
        self.connects = 0
        # Asked over the stop's own connection, which is thereby open and warm when a stop comes.
        self.polled = Poll()
        self._info: DaemonInfo | None = None
        self._link: Link | None = None
        self._why = "not connected"
        self._noted = ("", 0.0)
        self._end = threading.Event()
        self._up = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Begin to connect, in a thread; returns at once."""
        if self._thread is not None:
            return
        self._end.clear()
        self._thread = threading.Thread(target=self._run, name="reachy-watch", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Let go of the robot and end the thread."""
        self._end.set()
        self._up.clear()
        thread, self._thread = self._thread, None
        self._why = "disconnected"
        self._drop()
        if thread is not None and thread is not threading.current_thread():
            thread.join(5.0)
        for client in (self.rest, self.stop_rest, self.hub_rest):
            client.close()

    def wait(self, within_s: float) -> bool:
        """True when the link is up within the time."""
        return self._up.wait(within_s)

    @property
    def info(self) -> DaemonInfo | None:
        """The daemon's newest status: from the stream where that is fresh, else the one of the last connection."""
        streamed = self.feed.status()
        return DaemonInfo.of(streamed) if streamed else self._info

    @property
    def motor_mode(self) -> str:
        """The motors' mode by the newest word of the daemon: its answer to us, or its status, told every second."""
        mode, at = self._noted
        if time.monotonic() - at < STATUS_LAG_S:
            return mode
        info = self.info
        return info.motor_mode if info is not None else ""

    def note_mode(self, mode: str) -> None:
        """Remember what the daemon just answered about its motors."""
        self._noted = (mode, time.monotonic())

    @property
    def link_kind(self) -> str:
        """websocket, zenoh, or empty while there is none."""
        link = self._link
        return link.kind if link is not None else ""

    @property
    def alive(self) -> bool:
        """The link is open and joint frames arrive."""
        link = self._link
        return self._up.is_set() and link is not None and not link.closed and self.feed.alive

    def refusal(self) -> str | None:
        """Why nothing may be sent now, or None."""
        if not self.alive:
            silent = self._up.is_set() and not self.feed.alive
            return f"no joint data for {self.feed.silent_s:.1f} s" if silent else self._why
        if self.polled.holder:
            return f"the robot is held by {self.polled.holder}"
        return None

    def link(self) -> Link:
        """The open link. Raises :class:`DaemonUnreachable`."""
        link = self._link
        if link is None or not self._up.is_set():
            raise DaemonUnreachable(f"Reachy Mini at {self.host}:{self.port} is not connected: {self._why}.")
        return link

    def _run(self) -> None:
        delay = FIRST_DELAY_S
        while not self._end.is_set():
            try:
                self._join()
                self._poll()
            except Exception as exc:
                # The device stays, says why it is unavailable, and tries again, whatever went wrong.
                self._say(str(exc) or type(exc).__name__)
                if not isinstance(exc, DaemonError | ImportError):
                    logger.exception("Reachy Mini at %s:%d: connecting failed.", self.host, self.port)
                self._drop()
                self._end.wait(delay)
                delay = min(2 * delay, LONGEST_DELAY_S)
                continue
            delay = FIRST_DELAY_S
            self._stay()
            self._drop()

    def _join(self) -> None:
        info = self._info = DaemonInfo.of(self.rest.get(STATUS_PATH))
        if info.state not in ("running", ""):
            raise DaemonError(f"the daemon is {info.state}{': ' + info.error if info.error else ''}")
        self.feed.clear()
        link = make_link(
            info,
            self.host,
            self.port,
            prefix=self._prefix,
            transport=self._transport,
            session=self._session,
            zenoh_port=self._zenoh_port,
        )
        self._link = link
        link.open(self.feed.take)
        deadline = time.monotonic() + FRESH_S
        while not self.feed.alive:
            if self._end.is_set() or link.closed or time.monotonic() > deadline:
                raise DaemonUnreachable(f"the {link.kind} link opened but carries no joint data")
            self.feed.wait(0.05)
        if self._end.is_set():
            raise DaemonUnreachable("disconnected")
        self.connects += 1
        self._why = ""
        self._up.set()
        version = ".".join(map(str, info.version)) or "of unknown version"
        logger.info("Reachy Mini at %s:%d: daemon %s over %s.", self.host, self.port, version, link.kind)

    def _stay(self) -> None:
        """Return when the link is dead."""
        polled = time.monotonic()
        while not self._end.wait(WATCH_EVERY_S):
            link = self._link
            if link is None or link.closed:
                self._say("the daemon closed the link")
                return
            if not self.feed.alive:
                self._say(f"no joint data for {FRESH_S:g} s")
                return
            if time.monotonic() - polled >= POLL_EVERY_S:
                try:
                    self._poll()
                except DaemonError as exc:
                    logger.info("Reachy Mini at %s:%d: %s", self.host, self.port, exc)
                polled = time.monotonic()

    def _poll(self) -> None:
        info = self._info
        holder = self._holder(info) if info is not None else ""
        # Asked over the stop's own connection, which is thereby open and warm when a stop comes.
        self.polled = Poll(holder, running_moves(self.stop_rest.get(RUNNING_PATH)), time.monotonic())

    def _holder(self, info: DaemonInfo) -> str:
        """Which application holds the robot: the lock where the daemon has one, and the managed app."""
        if info.since(APP_LOCK_SINCE):
            lock = self.rest.get(LOCK_PATH)
            if isinstance(lock, dict) and lock.get("state") not in ("free", None):
                return str(lock.get("holder_name") or lock["state"])
        try:
            app = self.rest.get(APP_PATH)
        except DaemonUnknown:
            return ""
        if isinstance(app, dict) and app.get("state") in ("starting", "running", "stopping"):
            about = app.get("info")
            return str(about.get("name") if isinstance(about, dict) else "an application")
        return ""

    def _drop(self) -> None:
        self._up.clear()
        link, self._link = self._link, None
        if link is not None:
            link.close()

    def _say(self, why: str) -> None:
        if why != self._why and not self._end.is_set():
            logger.warning("Reachy Mini at %s:%d is unavailable: %s.", self.host, self.port, why.rstrip("."))
            self._why = why.rstrip(".")


def running_moves(answer: Any) -> frozenset[str]:
    """The uuids of ``/api/move/running``. Raises :class:`ValidationError` for another shape."""
    if not isinstance(answer, list) or not all(isinstance(move, dict) and "uuid" in move for move in answer):
        raise ValidationError("the daemon's list of running moves is no list of uuids.")
    return frozenset(str(move["uuid"]) for move in answer)
