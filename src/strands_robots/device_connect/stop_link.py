"""The e-stop listener's own connections to Device Connect, over Zenoh or NATS.

They take the configuration of a device's link and nothing else of it: no session, loop, queue or lock is shared.
"""

from __future__ import annotations

import asyncio
import atexit
import contextlib
import threading
import weakref
from collections.abc import Callable, Collection
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from device_connect_edge.messaging import MessagingError

from strands_robots.device_connect.backends import LinkConfig
from strands_robots.safety.missed_stops import ANSWER, QUESTION
from strands_robots.safety.orders import PARSED_MAX_BYTES
from strands_robots.safety.roster_report import STOP_ROSTER
from strands_robots.safety.stop_link import CHECK_IN_ANSWER, ESTOP, VERDICT, OnEvent, OnState, StopLink
from strands_robots.stop_log import stop_logger

if TYPE_CHECKING:
    from strands_robots.device_connect.backends.zenoh_session import LinkedSession

logger = stop_logger(__name__)

RETRY_S = 0.25
TRY_MS = 1000
"""Time in which a client's session tries to open before it checks whether it is still wanted."""

LEASE_MS = 4000
"""Time after which a silent peer is given up; with a shorter one a lossy link would flap under a stop."""

OVERLAP_S = 2.0
"""Time in which a replaced session still carries stops: peers learn of the new one and of one another meanwhile."""

ANSWERS = frozenset((VERDICT, CHECK_IN_ANSWER, QUESTION, ANSWER, STOP_ROSTER))
"""Events of which many may be sent at once; any other one is a stop or a check-in, and goes first."""

LOST_MAX = 1024
"""Peers remembered that were linked once; one of them that is linked again makes the link up anew."""

CLOSE_S = 10.0
"""Seconds that a close waits for the link's thread."""


def stop_link(link: LinkConfig) -> StopLink:
    """Return a connection of the e-stop listener's own to where ``link`` leads."""
    return NatsStopLink(link) if link.transport == "nats" else ZenohStopLink(link)


class NoStopLink:
    """Stop link of a device whose network is none of ours; it carries nothing."""

    up = False

    def open(self, events: Collection[str], on_event: OnEvent, on_state: OnState) -> None:
        """Stops come by the device's own runtime."""

    def publish(self, source: str, event: str, payload: bytes) -> bool:
        return False

    def close(self) -> None:
        """Nothing is open."""


def _apart(link: LinkConfig) -> LinkConfig:
    """Return ``link`` without the ports that only one session can listen on.

    The e-stop listener joins the others there and listens on ports of its own, of which they learn by gossip.
    """
    if not link.is_peer or not (link.meeting_point or link.listen):
        return link
    joined = [*link.connect, *(_from_here(endpoint) for endpoint in link.listen)]
    joined += [link.meeting_point] if link.meeting_point else []
    own = tuple(f"{endpoint.rpartition(':')[0]}:0" for endpoint in link.listen)
    multicast = False if link.meeting_point else link.multicast
    return replace(link, mode="peer", meet_port=None, connect=tuple(joined), listen=own, multicast=multicast)


def _from_here(endpoint: str) -> str:
    """Return the endpoint at which this machine dials its own listener."""
    host, _, port = endpoint.rpartition(":")
    scheme, _, name = host.partition("/")
    local = {"0.0.0.0": "127.0.0.1", "[::]": "[::1]"}.get(name, name)
    return f"{scheme}/{local}:{port}" + ("#verify_name_on_connect=false" if scheme == "tls" else "")


class _State:
    """Up or down; reports each change, and again when it is up anew."""

    def __init__(self, on_state: OnState) -> None:
        self.up = False
        self._on_state = on_state

    def set(self, up: bool, *, anew: bool = False) -> None:
        if up != self.up or (up and anew):
            self.up = up
            self._on_state(up)


class ZenohStopLink:
    """Stop link over a Zenoh session; its callbacks run on Zenoh's threads."""

    def __init__(self, link: LinkConfig) -> None:
        self._link = _apart(link)
        self._root = f"device-connect/{link.tenant}"
        self._sessions: tuple[LinkedSession, ...] = ()
        self._dropping, self._reporting, self._starting = threading.Lock(), threading.Lock(), threading.Lock()
        self._state = _State(lambda up: None)
        self._linked: frozenset[tuple[int, str]] = frozenset()
        self._lost: dict[str, None] = {}
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None
        self._subscribed: tuple[Collection[str], OnEvent] = ((), lambda event, source, payload: None)
        self._put_options: dict[str, Any] = {}
        self._answer_options: dict[str, Any] = {}

    @property
    def up(self) -> bool:
        return self._state.up

    @property
    def remotes(self) -> set[str]:
        """The Zenoh ids of the sessions it is linked to."""
        return {zid for _, zid in self._links()}

    def open(self, events: Collection[str], on_event: OnEvent, on_state: OnState) -> None:
        self._state = _State(on_state)
        self._subscribed = (events, on_event)
        with self._starting:
            self._start(self._open)
        _OPEN.add(self)

    def renew(self) -> None:
        """Open another session, and close the present one after an overlap.

        The work is done on a thread; a call while that thread still works does nothing.
        """
        with self._starting:
            if self._thread is not None and not self._thread.is_alive() and not self._closing.is_set():
                self._start(self._replace)

    def publish(self, source: str, event: str, payload: bytes) -> bool:
        sent, options = False, self._answer_options if event in ANSWERS else self._put_options
        for each in self._sessions:
            if not each.remotes:
                continue
            try:
                each.zenoh.put(f"{self._root}/{source}/event/{event}", payload, **options)
            except Exception as exc:  # noqa: BLE001 - the binding has one error for a closed session and a bad key
                logger.warning("%s was not sent: %s", event, exc)
            else:
                sent = True
        return sent

    def close(self) -> None:
        self._closing.set()
        with self._starting:
            thread = self._thread
        if thread is not None:
            thread.join(CLOSE_S)
        for each in self._sessions:
            self._drop(each)
        _OPEN.discard(self)

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
        import zenoh  # noqa: PLC0415 - an optional package, loaded with the first link

        from strands_robots.device_connect.backends.zenoh_session import LinkedSession  # noqa: PLC0415 - as above

        self._put_options = {
            "priority": zenoh.Priority.REAL_TIME,
            "congestion_control": zenoh.CongestionControl.DROP,
            "express": True,
        }
        # Many robots answer at once: their answers share batches, and stand before no stop.
        self._answer_options = {**self._put_options, "priority": zenoh.Priority.INTERACTIVE_HIGH, "express": False}
        events, on_event = self._subscribed
        session = None
        while session is None:
            if self._closing.is_set():
                return
            try:
                session = LinkedSession(self._config(), self._report)
            except zenoh.ZError as exc:
                logger.debug("the e-stop listener's session does not open yet: %s", exc)
                self._closing.wait(RETRY_S)

        def on_sample(sample: Any) -> None:
            parts = str(sample.key_expr).split("/")
            size = len(sample.payload)
            if len(parts) == 5:
                on_event(parts[4], parts[2], size if size > PARSED_MAX_BYTES else sample.payload.to_bytes())

        for event in events:
            session.subscribe(f"{self._root}/*/event/{event}", on_sample)
        self._sessions = (*self._sessions, session)
        session.watch_links()

    def _config(self) -> dict[str, Any]:
        config = self._link.zenoh()
        config["connect"]["retry"] = {"period_init_ms": 50, "period_max_ms": 250, "period_increase_factor": 2}
        config["transport"]["link"]["tx"]["lease"] = LEASE_MS
        # Answers of many robots come at once; Zenoh's own queue holds two batches and drops what does not fit.
        config["transport"]["link"]["tx"]["queue"] = {"size": {"real_time": 16, "interactive_high": 16}}
        # Zenoh keeps a descriptor of each link that agreed on shared memory; a stop has no use for it.
        config["transport"]["shared_memory"] = {"enabled": False}
        if not self._link.is_peer:
            config["connect"]["timeout_ms"] = TRY_MS
        return config

    def _report(self) -> None:
        with self._reporting:
            before, self._linked = self._linked, self._links()
            here = {zid for _, zid in self._linked}
            new_session = bool({each for each, _ in self._linked} - {each for each, _ in before})
            # A peer that is back may have sent a stop meanwhile, though others stayed linked.
            back = new_session or not here.isdisjoint(self._lost)
            self._lost.update(dict.fromkeys(zid for _, zid in before if zid not in here))
            for zid in (*here, *list(self._lost)[:-LOST_MAX]):
                self._lost.pop(zid, None)
            self._state.set(bool(here) and not self._closing.is_set(), anew=back)

    def _links(self) -> frozenset[tuple[int, str]]:
        """Return each link as session and peer."""
        return frozenset((id(each), zid) for each in self._sessions for zid in tuple(each.remotes))


class NatsStopLink:
    """Stop link over a NATS connection, on a thread and an event loop of its own."""

    def __init__(self, link: LinkConfig) -> None:
        self._link = link
        self._root = f"device-connect.{link.tenant}"
        self._loop: asyncio.AbstractEventLoop | None = None
        self._client: Any = None
        self._state = _State(lambda up: None)
        self._started = threading.Event()
        self._sending: set[asyncio.Future[None]] = set()
        self._end: asyncio.Event | None = None
        self._thread: threading.Thread | None = None
        self._stops: set[str] = set()

    @property
    def up(self) -> bool:
        return self._state.up

    @property
    def denied(self) -> str:
        """The server's refusal of a stop of this connection, or ""."""
        client, said = self._client, ""
        for subject in tuple(self._stops):
            said = said or (client.denied(subject) if client is not None else "")
        return said

    def open(self, events: Collection[str], on_event: OnEvent, on_state: OnState) -> None:
        self._state = _State(on_state)
        self._thread = threading.Thread(target=self._run, args=(events, on_event), name="stop-link", daemon=True)
        self._thread.start()
        self._started.wait()
        _OPEN.add(self)

    def publish(self, source: str, event: str, payload: bytes) -> bool:
        loop = self._loop
        if loop is None or loop.is_closed() or not self._state.up:
            return False
        subject = f"{self._root}.{source}.event.{event}"
        if event == ESTOP:
            self._stops.add(subject)
        loop.call_soon_threadsafe(self._send, subject, payload)
        return True

    def close(self) -> None:
        loop, end, thread = self._loop, self._end, self._thread
        if loop is None or end is None or thread is None:
            return
        with contextlib.suppress(RuntimeError):  # the loop has ended already
            loop.call_soon_threadsafe(end.set)
        thread.join(CLOSE_S)
        _OPEN.discard(self)

    def _run(self, events: Collection[str], on_event: OnEvent) -> None:
        try:
            with asyncio.Runner() as runner:
                self._loop, self._end = runner.get_loop(), asyncio.Event()
                self._started.set()
                runner.run(self._serve(events, on_event, self._end))
        except Exception:
            logger.critical("The e-stop listener's NATS link ended.", exc_info=True)
        finally:
            self._started.set()
            self._state.set(False)

    async def _serve(self, events: Collection[str], on_event: OnEvent, end: asyncio.Event) -> None:
        from strands_robots.device_connect.backends.nats import NatsBackend  # noqa: PLC0415 - loaded with the first link

        def on_message(data: bytes | int, subject: str) -> None:
            parts = subject.split(".")
            if len(parts) == 5:
                on_event(parts[4], parts[2], data)

        while not end.is_set():
            client = NatsBackend(self._link)
            if not await self._connected(client, end):
                continue
            try:
                for event in events:
                    await client.listen(f"{self._root}.*.event.{event}", on_message)
                # The server has the subscriptions when it has answered this.
                await client.flush()
                self._client = client
                self._state.set(True)
                await end.wait()
            finally:
                self._client = None
                self._state.set(False)
                await client.close()

    async def _connected(self, client: Any, end: asyncio.Event) -> bool:
        """Try once to connect; False, after a pause, when it failed."""

        async def back() -> None:
            self._state.set(True)

        async def lost() -> None:
            self._state.set(False)

        trying = asyncio.ensure_future(client.connect(servers=[], reconnect_cb=back, disconnect_cb=lost))
        ending = asyncio.ensure_future(end.wait())
        await asyncio.wait({trying, ending}, return_when=asyncio.FIRST_COMPLETED)
        ending.cancel()
        if not trying.done():
            trying.cancel()
        outcome: list[object] = await asyncio.gather(trying, return_exceptions=True)
        problem = outcome[0]
        if isinstance(problem, MessagingError):
            logger.debug("the e-stop listener's connection does not open yet: %s", problem)
            with contextlib.suppress(TimeoutError):  # still wanted: try again
                await asyncio.wait_for(end.wait(), RETRY_S)
        elif isinstance(problem, Exception):
            raise problem
        return problem is None

    def _send(self, subject: str, payload: bytes) -> None:
        task = asyncio.ensure_future(self._publish(subject, payload))
        self._sending.add(task)
        task.add_done_callback(self._sending.discard)

    async def _publish(self, subject: str, payload: bytes) -> None:
        client = self._client
        try:
            if client is not None:
                await client.publish(subject, payload)
        except MessagingError as exc:
            logger.warning("%s was not sent: %s", subject, exc)


_OPEN: weakref.WeakSet[Any] = weakref.WeakSet()


@atexit.register
def _close_all() -> None:
    """A session left open with a subscriber would hang the interpreter's exit."""
    for link in list(_OPEN):
        link.close()
