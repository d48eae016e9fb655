"""Client of a fleet: find devices, call and stop them, follow their events.

The command line and the agent tools use it. Its name (``source``) is self-declared, like that of every caller on
Device Connect.
"""

from __future__ import annotations

import asyncio
import atexit
import contextlib
import json
import queue
import threading
import time
import uuid
from collections.abc import Callable, Collection, Coroutine, Generator, Mapping
from concurrent.futures import CancelledError, Future
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Self, TypeVar

from device_connect_edge.messaging.exceptions import MessagingError, NotConnectedError, RequestTimeoutError

from strands_robots import settings
from strands_robots.bounded_json import LONG_MAX, json_object
from strands_robots.device_connect.backends import LinkConfig, open_client
from strands_robots.device_connect.backends.base import NoResponderError, ResponderLostError
from strands_robots.device_connect.backends.config import network_of, usual_link
from strands_robots.device_connect.discovery import DESCRIBE_S, HEARTBEATS_S, Discovery, Peer, parts
from strands_robots.envelope import Envelope, error
from strands_robots.errors import StrandsRobotsError
from strands_robots.safety.sightings import sightings
from strands_robots.safety.statements import Purpose
from strands_robots.safety.stopping import Outcome, explain, grade
from strands_robots.threads import LOOP_JOIN_TIMEOUT_S, LoopThread
from strands_robots.utils import ValidationError, device_id, finite, json_value, shown, text

if TYPE_CHECKING:
    from strands_robots.serving.advertised import AdvertisedVerb

T = TypeVar("T")

STOPPING = frozenset({"stop", "stopMotion", "emergencyStop", "releaseTorque"})
"""Functions that take energy away."""

COLLECT_MARGIN_S = 3.0
"""Seconds that a discovery may last beyond its own deadline, on a loaded machine."""

CONNECT_MARGIN_S = 3.0
"""Seconds beyond a link's own deadline, in which it finds out why nobody answered."""

PURPOSES = {"getStatus": Purpose.LOCKOUT_STATE, "resume": Purpose.RESUME_ANSWER}
"""Functions whose answer has a signed part, with its purpose."""

CLOSED = "the client was closed before there was an answer"
NOT_CONNECTED = "the client is not connected; use it as a context manager"

IN_FLIGHT = 64
"""Calls of :meth:`FleetClient.call_each` that wait for an answer at a time."""

EVENTS_MAX = 10_000
"""Events that wait for a slow reader; a further one displaces the oldest."""


class NoSuchDeviceError(StrandsRobotsError, LookupError):
    """No device on this network has that id."""


class DeviceTimeoutError(StrandsRobotsError, TimeoutError):
    """The device got the call and did not answer in time, or left the network before."""


class ClientClosedError(StrandsRobotsError, TimeoutError):
    """The client was closed before or while the answer was awaited."""


class CallRefusedError(StrandsRobotsError, RuntimeError):
    """The device answered with a JSON-RPC error; ``code`` is the protocol's."""

    def __init__(self, message: str, code: int = 0) -> None:
        super().__init__(message)
        self.code = code


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
        self._loop: LoopThread | None = None
        self._messaging: Any = None
        self._discovery: Discovery | None = None
        self._network = network_of(link)
        self._lock = threading.Lock()
        self._pending: set[Future[Any]] = set()
        self._closed = False

    def __enter__(self) -> Self:
        self._loop = LoopThread("fleet-client")
        try:
            self._messaging = self.run(open_client(self.link), self.link.connect_timeout_s + CONNECT_MARGIN_S)
            self._discovery = Discovery(self._messaging)
            self.run(self._discovery.start(), 5.0)
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(self, *_exception: object) -> None:
        self.close()

    def close(self) -> None:
        """Leave the network; waiting calls get :class:`ClientClosedError`."""
        with self._lock:
            self._closed, pending = True, tuple(self._pending)
        loop, self._loop = self._loop, None
        if loop is None:
            return
        for each in pending:
            each.cancel()
        messaging, self._messaging = self._messaging, None
        try:
            if messaging is not None:
                loop.submit(messaging.close()).result(LOOP_JOIN_TIMEOUT_S)
        finally:
            loop.close(LOOP_JOIN_TIMEOUT_S)

    def peers(self, timeout: float = 2.0, *, thorough: bool = False) -> list[Peer]:
        """Return the devices of the tenant, sorted by id.

        Args:
            timeout: seconds at most, but :data:`~discovery.HEARTBEATS_S` where the registry is expected and gives no
                list; :attr:`stale` says so then. The collection ends early once no more devices come.
            thorough: wait longer for a further device.
        """
        return self.run(
            self._connected.collect(timeout, thorough=thorough), max(timeout, HEARTBEATS_S) + COLLECT_MARGIN_S
        )

    @property
    def stale(self) -> str:
        """Empty, or the reason why the last discovery may be incomplete."""
        return self._connected.stale

    def known(self) -> tuple[str, ...]:
        """Return the ids of live devices announced since the last :meth:`peers`."""
        return self._connected.known

    def announces(self, device: str, function: str, argument: str) -> bool:
        """Return True where the last :meth:`peers` found the device with this argument."""
        return self._connected.announces(device, function, argument)

    def last_heartbeat(self, device: str) -> float | None:
        """Return the monotonic time of a device's last heartbeat; None before the first.

        The beat of its process counts as one.
        """
        return self._connected.last_heartbeat(device)

    def beats_every(self, device: str) -> float:
        """Return the seconds between two heartbeats, or beats, of a device."""
        return self._connected.beats_every(device)

    def call(
        self, device: str, function: str, params: Mapping[str, Any] | None = None, timeout: float = 10.0
    ) -> Envelope:
        """Call a function of a device; return its answer.

        Raises:
            ValidationError: ``params`` holds NaN or infinity, at any depth, or what JSON cannot carry.
            NoSuchDeviceError: no device has the id ``device``.
            DeviceTimeoutError: it did not answer within ``timeout`` seconds, or left after the call had reached it.
            CallRefusedError: it refused the call as such: an unknown function, a malformed message.
            MessagingError: the network cannot carry the call.
        """
        return self.run(self._call(device, function, dict(params or {}), timeout), timeout + 3.0)

    def describe(self, device: str, timeout: float = DESCRIBE_S) -> Peer:
        """Have a device describe itself; raises as :meth:`call`."""
        described = self.call(device, "requestRegistration", {}, timeout)
        return replace(Peer.of(described), heard_at=time.monotonic())

    def verb(self, device: str, name: str) -> AdvertisedVerb | None:
        """Return a verb as its device describes it, None where it does not do so in time.

        What stops a robot is not asked about, so that it waits for no description.

        Raises:
            NoSuchDeviceError: no device has the id ``device``.
        """
        from strands_robots.serving.advertised import find_verb  # noqa: PLC0415 - loaded when it is used

        if name in STOPPING:
            return None
        try:
            return find_verb(self.describe(device).functions, name)
        except (TimeoutError, RuntimeError):
            return None

    def call_each(
        self, calls: Mapping[str, Mapping[str, Any]], function: str, timeout: float = 10.0
    ) -> dict[str, tuple[Envelope | Exception, float]]:
        """Call a function of many devices at once; return answers or errors, and seconds.

        No thread is started, and at most :data:`IN_FLIGHT` calls wait at a time: the next one leaves when an answer
        has come.

        Args:
            calls: the arguments for each device.
            function: its name.
            timeout: seconds in which a device has to answer.
        """
        answers: dict[str, tuple[Envelope | Exception, float]] = {}
        waiting = iter(calls.items())

        async def work() -> None:
            for device, params in waiting:
                began = time.monotonic()
                answer: Envelope | Exception
                try:
                    answer = await self._call(device, function, dict(params), timeout)
                except (LookupError, TimeoutError, RuntimeError, MessagingError, ValidationError) as exc:
                    answer = exc
                answers[device] = answer, time.monotonic() - began

        async def all_of_them() -> None:
            await asyncio.gather(*(work() for _ in range(min(IN_FLIGHT, len(calls)))))

        turns = -(-len(calls) // IN_FLIGHT)
        self.run(all_of_them(), turns * timeout + 3.0)
        return {device: answers[device] for device in calls}

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

    def stop(self, device: str, timeout: float = 5.0, robot_name: str = "") -> Envelope:
        """Stop a device by ``stop``, else ``stopMotion``; return its envelope.

        ``stopped`` is true only for an affirmative answer, and ``in_reach`` is false where no device took the stop.
        ``robot_name`` stops one robot of a world alone.
        """
        return self.run(self._stop(device, timeout, robot_name), 2 * timeout + 4.0)

    async def call_async(
        self, device: str, function: str, params: Mapping[str, Any] | None = None, within: float = 10.0
    ) -> Envelope:
        """Do as :meth:`call`, on the event loop of the caller."""
        return await self._awaited(self._call(device, function, dict(params or {}), within))

    async def stop_async(self, device: str, within: float = 5.0, robot_name: str = "") -> Envelope:
        """Do as :meth:`stop`, on the event loop of the caller."""
        return await self._awaited(self._stop(device, within, robot_name))

    def stop_all(self, timeout: float = 5.0) -> dict[str, Envelope]:
        """Stop each device when it is found; return the answers by id.

        :attr:`stale` says when devices may have been missed.
        """

        async def all_of_them() -> dict[str, Envelope]:
            stops: dict[str, asyncio.Task[Envelope]] = {}

            def stop(peer: Peer) -> None:
                if peer.stop_verb:
                    stops[peer.id] = asyncio.create_task(self._stop_named(peer.id, timeout))

            await self._connected.collect(2.0, stop, thorough=True)
            return {name: await stops[name] for name in sorted(stops)}

        return self.run(all_of_them(), HEARTBEATS_S + COLLECT_MARGIN_S + 2 * timeout)

    def stop_each(self, devices: Collection[str], timeout: float = 5.0) -> dict[str, Envelope]:
        """Stop these devices at once; return the answers by id."""

        async def all_of_them() -> dict[str, Envelope]:
            answers = await asyncio.gather(*(self._stop_named(each, timeout) for each in devices))
            return dict(zip(devices, answers, strict=True))

        return self.run(all_of_them(), 2 * timeout + 4.0)

    def run(self, work: Coroutine[Any, Any, T], within: float) -> T:
        """Run a coroutine on the client's loop and wait for it.

        Raises:
            ClientClosedError: the client is closed before it is done.
        """
        done = self._submitted(work)
        try:
            return done.result(within)
        except CancelledError:
            raise ClientClosedError(CLOSED) from None
        except BaseException:
            done.cancel()
            raise

    async def _awaited(self, work: Coroutine[Any, Any, T]) -> T:
        done = self._submitted(work)
        try:
            return await asyncio.wrap_future(done)
        except asyncio.CancelledError:
            # Of the client that is closed, not of the task that waits.
            task = asyncio.current_task()
            if task is not None and task.cancelling():
                raise
            raise ClientClosedError(CLOSED) from None

    def _submitted(self, work: Coroutine[Any, Any, T]) -> Future[T]:
        with self._lock:
            if self._closed or self._loop is None:
                work.close()
                raise ClientClosedError(CLOSED) if self._closed else RuntimeError(NOT_CONNECTED)
            done = self._loop.submit(work)
            self._pending.add(done)
        done.add_done_callback(self._pending.discard)
        return done

    @property
    def _connected(self) -> Discovery:
        if self._discovery is None:
            raise RuntimeError(NOT_CONNECTED)
        return self._discovery

    def _subject(self, rest: str) -> str:
        return f"device-connect.{self.link.tenant}.{rest}"

    async def _subscribe(self, rest: str, callback: Callable[[bytes, str, str | None], Any]) -> Any:
        return await self._messaging.subscribe_with_subject(self._subject(rest), callback, subscribe_only=True)

    async def _call(self, device: str, function: str, params: dict[str, Any], within: float) -> Envelope:
        name, verb = device_id("device", device), text("function", function, longest=100)
        for each, value in params.items():
            finite(each, value)
        request = {
            "jsonrpc": "2.0",
            "id": uuid.uuid4().hex,
            "method": verb,
            "params": {**params, "_dc_meta": {"source_device": self.source, "source_type": "client"}},
        }
        try:
            encoded = json.dumps(request, allow_nan=False, default=json_value).encode()
        except (TypeError, ValueError, RecursionError) as exc:
            raise ValidationError(f"params must be values that JSON can carry: {exc}.") from exc
        try:
            data = await self._messaging.request(self._subject(f"{name}.cmd"), encoded, timeout=within)
        except MessagingError as exc:
            raise self._unanswered(name, within, exc) from exc
        answer = _answer(name, verb, data)
        self._remember(name, verb, params, answer)
        return answer

    def _remember(self, device: str, verb: str, params: Mapping[str, Any], answer: Envelope) -> None:
        """Have this machine remember who answered."""
        purpose = PURPOSES.get(verb)
        if purpose is None:
            sightings().note(self._network, device)
            return
        request = params.get("assertion") if verb == "resume" else params
        nonce = request.get("nonce") if isinstance(request, Mapping) else None
        expected = {"nonce": nonce} if nonce else {}
        sightings().note_answer(self._network, device, purpose, answer.get("statement"), expected)

    def _unanswered(self, device: str, within: float, exc: Exception) -> Exception:
        """Return the error for an unanswered call."""
        if isinstance(exc, ResponderLostError):
            return DeviceTimeoutError(f"{device} got the call and gave no answer: it may have left the network.")
        if isinstance(exc, NoResponderError):
            return NoSuchDeviceError(f"No device {device!r} in tenant {self.link.tenant!r}.")
        if isinstance(exc, RequestTimeoutError):
            return DeviceTimeoutError(f"{device} is on the network and did not answer within {within:g} s ({exc}).")
        return exc

    async def _stop_named(self, device: str, within: float) -> Envelope:
        """Stop one of several; a bad id is an answer, too."""
        try:
            return await self._stop(device, within)
        except ValidationError as exc:
            return error(str(exc), stopped=None)

    async def _stop(self, device: str, within: float, robot_name: str = "") -> Envelope:
        params = {"robot_name": robot_name} if robot_name else {}
        try:
            answer = await self._call(device, "stop", params, within)
        except CallRefusedError as exc:
            if robot_name or exc.code != -32601:
                return error(str(exc), stopped=None)
            try:
                answer = await self._call(device, "stopMotion", {}, within)
            except (LookupError, TimeoutError, RuntimeError, MessagingError) as other:
                return error(str(other), stopped=None)
        except (LookupError, NotConnectedError) as exc:
            return error(str(exc), stopped=None, in_reach=False)
        except (TimeoutError, MessagingError) as exc:
            return error(str(exc), stopped=None)
        if grade(answer) is Outcome.STOPPED:
            return answer
        return answer if answer.get("status") == "error" else error(explain(answer), stopped=None, answer=answer)


def connect_agent(**options: Any) -> None:
    """Connect the framework's ``discover`` and ``invoke`` to our robots.

    Where the environment names no network, they are those of this machine. The end of the process disconnects: the
    framework's own thread, which the interpreter would end inside Zenoh, could abort the process.

    Args:
        options: of ``device_connect_agent_tools.connect``, such as ``request_timeout``.
    """
    from device_connect_agent_tools import connect, disconnect  # noqa: PLC0415 - loaded when an agent connects

    link = usual_link()
    if link.meeting_point:
        settings.put("ZENOH_CONNECT", link.meeting_point)
        if not settings.is_set("DEVICE_CONNECT_DISCOVERY_MODE"):
            settings.put("DEVICE_CONNECT_DISCOVERY_MODE", "d2d")
    atexit.unregister(disconnect)
    atexit.register(disconnect)
    connect(**options)


class EventSubscription:
    """Events of a device, until closed; a context manager."""

    def __init__(self, client: FleetClient, handle: Any) -> None:
        self._client, self._handle = client, handle

    def close(self) -> None:
        """Receive no more events."""
        handle, self._handle = self._handle, None
        if handle is not None:
            with contextlib.suppress(ClientClosedError):
                self._client.run(handle.unsubscribe(), 5.0)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_exception: object) -> None:
        self.close()


def _event(data: bytes, subject: str) -> DeviceEvent | None:
    tokens = parts(subject)
    notification = json_object(data)
    if not notification:
        return None
    payload = notification.get("params")
    return DeviceEvent(tokens[2], tokens[-1], payload if isinstance(payload, Mapping) else {})


def _push(arrived: queue.Queue[DeviceEvent], event: DeviceEvent) -> None:
    while True:
        try:
            arrived.put_nowait(event)
        except queue.Full:
            arrived.get_nowait()
        else:
            return


def _answer(device: str, function: str, data: bytes) -> Envelope:
    reply = json_object(data, LONG_MAX)
    if not reply:
        raise CallRefusedError(f"{device} answered {function} with {shown(data)}, which is no JSON-RPC.")
    problem = reply.get("error")
    if problem is not None:
        fields = problem if isinstance(problem, Mapping) else {"message": problem}
        code = fields.get("code")
        raise CallRefusedError(str(fields.get("message", "")), code if isinstance(code, int) else 0)
    result = reply.get("result")
    return dict(result) if isinstance(result, Mapping) else {"result": result}
