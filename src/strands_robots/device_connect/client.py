"""Client of a fleet: find devices, call and stop them, follow their events.

The command line and the agent tools use it. Its name (``source``) is self-declared, like that of every caller on
Device Connect.
"""

from __future__ import annotations

import asyncio
import json
import queue
import threading
import uuid
from collections.abc import Callable, Coroutine, Generator, Mapping
from concurrent.futures import Future
from dataclasses import dataclass, field
from typing import Any, Self, TypeVar

from device_connect_edge.messaging import MessagingError

from strands_robots.device_connect.backends import LinkConfig, open_client
from strands_robots.device_connect.shutdown import LOOP_JOIN_TIMEOUT_S
from strands_robots.envelope import Envelope, error
from strands_robots.errors import StrandsRobotsError
from strands_robots.safety.stopping import Outcome, explain, grade
from strands_robots.utils import device_id, shown, text

T = TypeVar("T")

PROBE_EVERY_S = 0.25
"""Seconds between two probes while peers are collected: the first one may leave before every link is up."""

SETTLED_S = 0.5
"""Seconds without a new peer after which a collection ends early, where at least one has answered."""

EVENTS_MAX = 10_000
"""Events that wait for a slow reader; a further one displaces the oldest."""


class NoSuchDeviceError(StrandsRobotsError, LookupError):
    """No device on this network has that id."""


class DeviceTimeoutError(StrandsRobotsError, TimeoutError):
    """The device is announced and did not answer in time."""


class CallRefusedError(StrandsRobotsError, RuntimeError):
    """The device answered with a JSON-RPC error; ``code`` is the protocol's."""

    def __init__(self, message: str, code: int = 0) -> None:
        super().__init__(message)
        self.code = code


@dataclass(frozen=True, slots=True)
class Peer:
    """A device as it announces itself."""

    id: str
    type: str = ""
    model: str = ""
    status: Mapping[str, Any] = field(default_factory=dict)
    functions: tuple[Mapping[str, Any], ...] = ()
    events: tuple[str, ...] = ()
    location: str = ""

    @property
    def stop_verb(self) -> str | None:
        """The function that stops it: ``stop``, else ``stopMotion``, else None."""
        names = {str(each.get("name", "")) for each in self.functions}
        return next((verb for verb in ("stop", "stopMotion") if verb in names), None)

    @classmethod
    def of(cls, presence: Mapping[str, Any]) -> Peer:
        """Read a presence message; a field that it lacks is empty."""
        identity, status = _object(presence, "identity"), _object(presence, "status")
        capabilities = _object(presence, "capabilities")
        functions = [each for each in capabilities.get("functions") or () if isinstance(each, Mapping)]
        events = [each for each in capabilities.get("events") or () if isinstance(each, Mapping)]
        return cls(
            id=str(presence.get("device_id", "")),
            type=str(identity.get("device_type", "")),
            model=str(identity.get("model") or ""),
            status=status,
            functions=tuple(functions),
            events=tuple(str(each.get("name", "")) for each in events),
            location=str(status.get("location") or ""),
        )


@dataclass(frozen=True, slots=True)
class DeviceEvent:
    """An event as it arrived. The device is the one that the topic names."""

    device: str
    name: str
    payload: Mapping[str, Any]


class FleetClient:
    """One connection to one tenant; use it as a context manager.

    Args:
        link: how to reach the fleet; ``loopback_config()`` for this machine, ``link_from_environment()`` else.
        source: the caller's name that goes with every call; letters, digits, ``_`` and ``-``.

    Raises:
        MessagingError: on entering, when the network was not reached within the link's deadline.
    """

    def __init__(self, link: LinkConfig, source: str = "strands-robots") -> None:
        self.link = link
        self.source = device_id("source", source)
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="fleet-client", daemon=True)
        self._messaging: Any = None
        self._seen: dict[str, Peer] = {}

    def __enter__(self) -> Self:
        self._thread.start()
        try:
            self._messaging = self.run(open_client(self.link), self.link.connect_timeout_s + 1.0)
            self.run(self._subscribe("*.presence", self._on_presence), 5.0)
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(self, *_exception: object) -> None:
        self.close()

    def close(self) -> None:
        """Leave the network; the loop and its thread end."""
        if self._loop.is_closed():
            return
        if self._messaging is not None:
            messaging, self._messaging = self._messaging, None
            self.run(messaging.close(), LOOP_JOIN_TIMEOUT_S)
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(LOOP_JOIN_TIMEOUT_S)
        if not self._thread.is_alive():
            self._loop.close()

    def peers(self, timeout: float = 2.0) -> list[Peer]:
        """Return the devices that answer a probe, sorted by id.

        Args:
            timeout: seconds at most; the collection ends half a second after the last new device.
        """
        return self.run(self._collect(timeout), timeout + 1.0)

    def known(self) -> tuple[str, ...]:
        """Return the ids of live devices announced since the last :meth:`peers`."""
        return tuple(sorted(self._seen))

    def call(
        self, device: str, function: str, params: Mapping[str, Any] | None = None, timeout: float = 10.0
    ) -> Envelope:
        """Call a function of a device; return its answer.

        Raises:
            NoSuchDeviceError: no device has the id ``device``.
            DeviceTimeoutError: it is there and did not answer within ``timeout`` seconds.
            CallRefusedError: it refused the call as such: an unknown function, a malformed message.
            MessagingError: the network cannot carry the call.
        """
        return self.run(self._call(device, function, dict(params or {}), timeout), timeout + 3.0)

    def events(
        self, device: str = "*", timeout: float | None = None, ready: threading.Event | None = None
    ) -> Generator[DeviceEvent, None, None]:
        """Yield the events of one device, or of all, as they come.

        Args:
            device: an id, or ``*``.
            timeout: seconds without an event after which the iteration ends; None waits for ever.
            ready: set once events are received.
        """
        arrived: queue.Queue[DeviceEvent] = queue.Queue(EVENTS_MAX)
        with self.subscription(device, lambda event: _push(arrived, event)):
            if ready is not None:
                ready.set()
            while True:
                try:
                    yield arrived.get(timeout=timeout)
                except queue.Empty:
                    return

    def subscription(self, device: str, callback: Callable[[DeviceEvent], None]) -> EventSubscription:
        """Have ``callback`` called with every event until the subscription is closed.

        It runs on the client's own thread: it must return at once and may not raise.
        """
        name = device if device == "*" else device_id("device", device)

        async def arrived(data: bytes, subject: str, reply: str | None) -> None:
            event = _event(data, subject)
            if event is not None:
                callback(event)

        return EventSubscription(self, self.run(self._subscribe(f"{name}.event.*", arrived), 5.0))

    def stop(self, device: str, timeout: float = 5.0) -> Envelope:
        """Stop a device by ``stop``, else ``stopMotion``; return its envelope.

        ``stopped`` is true only for an affirmative answer.
        """
        return self.run(self._stop(device, timeout), 2 * timeout + 4.0)

    def stop_all(self, timeout: float = 5.0) -> dict[str, Envelope]:
        """Stop every device that answers a probe, all at once; return the answers by id."""
        peers = [peer.id for peer in self.peers() if peer.stop_verb]

        async def all_of_them() -> dict[str, Envelope]:
            answers = await asyncio.gather(*(self._stop(peer, timeout) for peer in peers))
            return dict(zip(peers, answers, strict=True))

        return self.run(all_of_them(), 2 * timeout + 4.0)

    def run(self, work: Coroutine[Any, Any, T], within: float) -> T:
        """Run a coroutine on the client's loop and wait for it."""
        done: Future[T] = asyncio.run_coroutine_threadsafe(work, self._loop)
        try:
            return done.result(within)
        except BaseException:
            done.cancel()
            raise

    def _subject(self, rest: str) -> str:
        return f"device-connect.{self.link.tenant}.{rest}"

    async def _subscribe(self, rest: str, callback: Callable[[bytes, str, str | None], Any]) -> Any:
        return await self._messaging.subscribe_with_subject(self._subject(rest), callback, subscribe_only=True)

    async def _on_presence(self, data: bytes, subject: str, reply: str | None) -> None:
        try:
            presence = json.loads(data)
        except ValueError:
            return
        # Access rules guard the topic, so it outranks the id in the message.
        name = _parts(subject)[2]
        if not isinstance(presence, Mapping) or presence.get("device_id") != name:
            return
        if presence.get("departing"):
            self._seen.pop(name, None)
        else:
            self._seen[name] = Peer.of(presence)

    async def _collect(self, within: float) -> list[Peer]:
        loop = asyncio.get_running_loop()
        self._seen.clear()
        began = changed = loop.time()
        count = 0
        while loop.time() < began + within:
            await self._messaging.publish(self._subject("discovery.probe"), b'{"probe": true}')
            await asyncio.sleep(min(PROBE_EVERY_S, within))
            if len(self._seen) != count:
                count, changed = len(self._seen), loop.time()
            elif count and loop.time() - changed >= SETTLED_S:
                break
        return [self._seen[name] for name in sorted(self._seen)]

    async def _call(self, device: str, function: str, params: dict[str, Any], within: float) -> Envelope:
        name, verb = device_id("device", device), text("function", function, longest=100)
        request = {
            "jsonrpc": "2.0",
            "id": uuid.uuid4().hex,
            "method": verb,
            "params": {**params, "_dc_meta": {"source_device": self.source, "source_type": "client"}},
        }
        encoded = json.dumps(request, allow_nan=False).encode()
        try:
            data = await self._messaging.request(self._subject(f"{name}.cmd"), encoded, timeout=within)
        except MessagingError as exc:
            raise await self._unanswered(name, within, exc) from exc
        return _answer(name, verb, data)

    async def _unanswered(self, device: str, within: float, exc: Exception) -> Exception:
        """Return the error for an unanswered call."""
        if not self._messaging.is_connected:
            return exc
        if any(peer.id == device for peer in await self._collect(1.0)):
            return DeviceTimeoutError(f"{device} is announced and did not answer within {within:g} s ({exc}).")
        return NoSuchDeviceError(f"No device {device!r} in tenant {self.link.tenant!r}.")

    async def _stop(self, device: str, within: float) -> Envelope:
        try:
            answer = await self._call(device, "stop", {}, within)
        except CallRefusedError as exc:
            if exc.code != -32601:
                return error(str(exc), stopped=None)
            try:
                answer = await self._call(device, "stopMotion", {}, within)
            except (LookupError, TimeoutError, RuntimeError, MessagingError) as other:
                return error(str(other), stopped=None)
        except (LookupError, TimeoutError, MessagingError) as exc:
            return error(str(exc), stopped=None)
        if grade(answer) is Outcome.STOPPED:
            return answer
        return answer if answer.get("status") == "error" else error(explain(answer), stopped=None, answer=answer)


class EventSubscription:
    """Events of a device, until closed; a context manager."""

    def __init__(self, client: FleetClient, handle: Any) -> None:
        self._client, self._handle = client, handle

    def close(self) -> None:
        """Receive no more events."""
        handle, self._handle = self._handle, None
        if handle is not None:
            self._client.run(handle.unsubscribe(), 5.0)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_exception: object) -> None:
        self.close()


def _object(presence: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    value = presence.get(key)
    return value if isinstance(value, Mapping) else {}


def _parts(subject: str) -> list[str]:
    parts = subject.split("/" if "/" in subject else ".")
    return parts if len(parts) > 3 else ["", "", "", ""]


def _event(data: bytes, subject: str) -> DeviceEvent | None:
    parts = _parts(subject)
    try:
        notification = json.loads(data)
    except ValueError:
        return None
    payload = notification.get("params") if isinstance(notification, Mapping) else None
    return DeviceEvent(parts[2], parts[-1], payload if isinstance(payload, Mapping) else {})


def _push(arrived: queue.Queue[DeviceEvent], event: DeviceEvent) -> None:
    while True:
        try:
            arrived.put_nowait(event)
        except queue.Full:
            arrived.get_nowait()
        else:
            return


def _answer(device: str, function: str, data: bytes) -> Envelope:
    try:
        reply = json.loads(data)
    except ValueError:
        reply = None
    if not isinstance(reply, Mapping):
        raise CallRefusedError(f"{device} answered {function} with {shown(data)}, which is no JSON-RPC.")
    problem = reply.get("error")
    if problem is not None:
        fields = problem if isinstance(problem, Mapping) else {"message": problem}
        code = fields.get("code")
        raise CallRefusedError(str(fields.get("message", "")), code if isinstance(code, int) else 0)
    result = reply.get("result")
    return dict(result) if isinstance(result, Mapping) else {"result": result}
