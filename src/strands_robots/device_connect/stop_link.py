"""The e-stop listener's own connections to Device Connect, over Zenoh or NATS.

They take the configuration of a device's link and nothing else of it: no session, loop, queue or lock is shared.
"""

from __future__ import annotations

import asyncio
import atexit
import contextlib
import weakref
from collections.abc import Collection
from dataclasses import replace
from typing import Any

from device_connect_edge.messaging import MessagingError

from strands_robots.device_connect.backends import LinkConfig
from strands_robots.safety.orders import PARSED_MAX_BYTES
from strands_robots.safety.stop_link import (
    ANSWER,
    CHECK_IN_ANSWER,
    ESTOP,
    QUESTION,
    STOP_ROSTER,
    VERDICT,
    OnEvent,
    OnState,
    StopLink,
)
from strands_robots.stop_log import stop_logger
from strands_robots.threads import LoopThread
from strands_robots.zenoh_session import StopSession

logger = stop_logger(__name__)

RETRY_S = 0.25
ANSWERS = frozenset((VERDICT, CHECK_IN_ANSWER, QUESTION, ANSWER, STOP_ROSTER))
"""Events of which many may be sent at once; any other one is a stop or a check-in, and goes first."""

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


def _without_shared_ports(link: LinkConfig) -> LinkConfig:
    """Return ``link`` without the ports that only one session can listen on.

    The e-stop listener joins the others there and listens on ports of its own, of which they learn by gossip.
    """
    if not link.is_peer or not (link.meeting_point or link.listen):
        return link
    joined = [*link.connect, *(_from_here(endpoint) for endpoint in link.listen)]
    joined += [link.meeting_point] if link.meeting_point else []
    anywhere = tuple(f"{endpoint.rpartition(':')[0]}:0" for endpoint in link.listen)
    multicast = False if link.meeting_point else link.multicast
    return replace(link, mode="peer", meet_port=None, connect=tuple(joined), listen=anywhere, multicast=multicast)


def _from_here(endpoint: str) -> str:
    """Return the endpoint at which this machine dials its own listener."""
    host, _, port = endpoint.rpartition(":")
    scheme, _, name = host.partition("/")
    local = {"0.0.0.0": "127.0.0.1", "[::]": "[::1]"}.get(name, name)
    return f"{scheme}/{local}:{port}" + ("#verify_name_on_connect=false" if scheme == "tls" else "")


class ZenohStopLink(StopSession):
    """Stop link over a Zenoh session; its callbacks run on Zenoh's threads."""

    def __init__(self, link: LinkConfig) -> None:
        super().__init__(_without_shared_ports(link).zenoh)
        self._root = f"device-connect/{link.tenant}"

    def open(self, events: Collection[str], on_event: OnEvent, on_state: OnState) -> None:
        def on_sample(sample: Any) -> None:
            parts = str(sample.key_expr).split("/")
            size = len(sample.payload)
            if len(parts) == 5:
                on_event(parts[4], parts[2], size if size > PARSED_MAX_BYTES else sample.payload.to_bytes())

        self.start({f"{self._root}/*/event/{event}": on_sample for event in events}, on_state)

    def publish(self, source: str, event: str, payload: bytes) -> bool:
        return self.put(f"{self._root}/{source}/event/{event}", payload, answer=event in ANSWERS)


class NatsStopLink:
    """Stop link over a NATS connection, on a thread and an event loop of its own."""

    def __init__(self, link: LinkConfig) -> None:
        self._link = link
        self._root = f"device-connect.{link.tenant}"
        self._loop: LoopThread | None = None
        self._end = asyncio.Event()
        self._task: asyncio.Task[None] | None = None
        self._client: Any = None
        self._up = False
        self._on_state: OnState = lambda up: None
        self._sending: set[asyncio.Future[None]] = set()
        self._stops: set[str] = set()

    @property
    def up(self) -> bool:
        return self._up

    @property
    def denied(self) -> str:
        """The server's refusal of a stop of this connection, or ""."""
        client, said = self._client, ""
        for subject in tuple(self._stops):
            said = said or (client.denied(subject) if client is not None else "")
        return said

    def open(self, events: Collection[str], on_event: OnEvent, on_state: OnState) -> None:
        self._on_state = on_state
        self._loop = LoopThread("stop-link")
        self._loop.submit(self._serve(events, on_event))
        _OPEN.add(self)

    def publish(self, source: str, event: str, payload: bytes) -> bool:
        loop = self._loop
        if loop is None or not self._up:
            return False
        subject = f"{self._root}.{source}.event.{event}"
        if event == ESTOP:
            self._stops.add(subject)
        try:
            loop.loop.call_soon_threadsafe(self._send, subject, payload)
        except RuntimeError:  # it was closed just now
            return False
        return True

    def close(self) -> None:
        loop, self._loop = self._loop, None
        if loop is not None:
            with contextlib.suppress(TimeoutError):
                loop.submit(self._leave()).result(CLOSE_S)
            loop.close(CLOSE_S)
        _OPEN.discard(self)

    def _set_up(self, up: bool) -> None:
        """Report a change of state."""
        if up != self._up:
            self._up = up
            self._on_state(up)

    async def _serve(self, events: Collection[str], on_event: OnEvent) -> None:
        """Carry events, and connect again after a failure, until the end."""
        from strands_robots.device_connect.backends.nats import NatsBackend  # noqa: PLC0415 - loaded with the first link

        def on_message(data: bytes | int, subject: str) -> None:
            parts = subject.split(".")
            if len(parts) == 5:
                on_event(parts[4], parts[2], data)

        async def back() -> None:
            self._set_up(True)

        async def lost() -> None:
            self._set_up(False)

        self._task = asyncio.current_task()
        ending = asyncio.ensure_future(self._end.wait())
        while not ending.done():
            client = NatsBackend(self._link)
            connecting = asyncio.ensure_future(client.connect(servers=[], reconnect_cb=back, disconnect_cb=lost))
            try:
                await asyncio.wait({connecting, ending}, return_when=asyncio.FIRST_COMPLETED)
                # At the end alone: otherwise it is done.
                connecting.cancel()
                await connecting
                for event in events:
                    await client.listen(f"{self._root}.*.event.{event}", on_message)
                # The server has the subscriptions when it has answered this.
                await client.flush()
                self._client = client
                self._set_up(True)
                await ending
            except MessagingError as exc:
                logger.debug("the e-stop listener's connection does not open yet: %s", exc)
            except Exception:
                logger.critical("The e-stop listener's NATS link ended.", exc_info=True)
                raise
            finally:
                self._client = None
                self._set_up(False)
                await client.close()
            await asyncio.wait({ending}, timeout=RETRY_S)

    async def _leave(self) -> None:
        """Send what was published before, then disconnect."""
        if self._sending:
            await asyncio.wait(self._sending)
        self._end.set()
        if self._task is not None:
            await asyncio.wait({self._task})

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
    """A connection in use while the interpreter ends would log errors of its loop."""
    for link in list(_OPEN):
        link.close()
