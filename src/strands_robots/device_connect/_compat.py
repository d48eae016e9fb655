"""All uses of the framework's private members, for ``device-connect-edge`` 0.2.5.

``tests/device_connect/test_compat.py`` lists these members and fails when one of them changes.
"""

from __future__ import annotations

import asyncio
import contextlib
import contextvars
import functools
import inspect
import json
import logging
import re
import time
from collections.abc import Awaitable, Callable, Iterable, Iterator
from concurrent.futures import Future
from typing import Any, TypeVar, cast
from weakref import WeakKeyDictionary

from device_connect_edge import device as framework
from device_connect_edge import drivers
from device_connect_edge.device import DeviceRuntime
from device_connect_edge.drivers import DeviceDriver, decorators
from device_connect_edge.messaging.exceptions import AuthenticationError, MessagingError, NotConnectedError

from .. import settings
from ..utils import ValidationError
from .backends import LinkConfig, backend_for, jsonrpc
from .backends.dispatch import Answer, send
from .presence import LivingDevice, PresenceView, encoded_capabilities, lock_stated, presence_builder, process_heartbeat

HOLD_EVENTS_S = 5.0
"""Seconds of a lost link for which events wait; a server that restarts is back sooner, and older events mislead."""

CONNECT_AGAIN_S = 1.0
"""Seconds between two attempts to reach a router or server."""

MAX_REFUSALS = 3
"""Attempts with credentials that the server refuses; then the start ends with its reason."""

_MADE_UP = re.compile("device-[0-9a-f]{8}")

F = TypeVar("F", bound=Callable[..., Any])
Labels = dict[str, str | list[str]]

_log = logging.getLogger(__name__)


def rpc(labels: Labels | None = None) -> Callable[[F], F]:
    """Declare a function for agents; its name, hints and docstring are its schema."""
    return cast(Callable[[F], F], drivers.rpc(labels=labels))


def emit(labels: Labels | None = None) -> Callable[[F], F]:
    """Declare an event: calling the method emits it."""

    def declared(method: F) -> F:
        # The framework asks for the signature at every emission; a stated one costs nothing to find.
        vars(method)["__signature__"] = inspect.signature(method)
        return cast(F, drivers.emit(labels=labels)(method))

    return declared


def on(event_name: str) -> Callable[[F], F]:
    """Declare a handler of an event of every device of the tenant, this one included."""
    return cast(Callable[[F], F], drivers.on(event_name=event_name))


@functools.lru_cache(maxsize=256)
def _marked(driver: Any, mark: str) -> tuple[str, ...]:
    """Return the names of a class's methods that a decorator of the framework marked."""
    found = []
    for name in dir(driver):
        method = inspect.getattr_static(driver, name)
        if getattr(getattr(method, "__func__", method), mark, False):
            found.append(name)
    return tuple(found)


_MARK = contextvars.ContextVar("_MARK", default="")
"""The mark that is looked for on this thread: a device's own stop and its runtime look at the same time."""


class CollectedOnce(DeviceDriver):  # type: ignore[misc]  # the framework has no type information
    """A driver whose decorated methods are found once for its class.

    The framework looks through all attributes of each device, once for each kind of method.
    """

    def __dir__(self) -> Iterable[str]:
        kind: Any = type(self)
        mark = _MARK.get()
        return _marked(kind, mark) if mark else super().__dir__()

    @contextlib.contextmanager
    def _only(self, mark: str) -> Iterator[None]:
        before = _MARK.set(mark)
        try:
            yield
        finally:
            _MARK.reset(before)

    def _collect_internal_handlers(self) -> None:
        with self._only("_is_internal_handler"):
            super()._collect_internal_handlers()

    def _collect_routines(self) -> None:
        with self._only("_is_device_routine"):
            super()._collect_routines()

    def _collect_event_subscriptions(self) -> list[dict[str, Any]]:
        with self._only("_is_event_subscription"):
            return cast(list[dict[str, Any]], super()._collect_event_subscriptions())

    def _get_functions(self) -> dict[str, Callable[..., Any]]:
        with self._only("_is_device_function"):
            return cast(dict[str, Callable[..., Any]], super()._get_functions())


class Runtime(DeviceRuntime):  # type: ignore[misc]  # the framework has no type information
    """The framework's runtime on our backend; reports its readiness and closes all.

    Args:
        driver: what to serve.
        device_id: without dots, because discovery cannot see a dotted one.
        link: how to reach the others.
        allow_insecure: required for a link without authentication.
        discovery: ``d2d`` announces presence; ``registry`` registers with the framework's registry service.
        before_live: awaited with the connected client before the driver is connected and the device can be found or
            called; what it raises ends the start.
        stock: further arguments of ``DeviceRuntime``, such as ``identity``, ``status``, ``ttl``.

    ``status`` is a live dict: presence sends what it holds at that moment.
    """

    def __init__(
        self,
        *,
        driver: DeviceDriver,
        device_id: str,
        link: LinkConfig,
        allow_insecure: bool = False,
        discovery: str = "d2d",
        before_live: Callable[[Any], Awaitable[None]] | None = None,
        **stock: Any,
    ) -> None:
        super().__init__(
            driver=driver,
            device_id=device_id,
            tenant=link.tenant,
            # With the stock name the framework's own branches on it stay as they are.
            messaging_backend=link.transport,
            # Never empty, so that the environment is not asked a second time.
            messaging_urls=list(link.connect) or ["zenoh://"],
            allow_insecure=allow_insecure,
            **stock,
        )
        self._messaging_backend = link.transport
        self._d2d_mode = discovery != "registry"
        if self._d2d_mode:
            self._d2d_collector = PresenceView(link, device_id)
        self.link = link
        self.problem = ""
        """Why the last attempt to connect failed."""
        self._before_live = before_live
        self._started = asyncio.Event()
        self._ready = asyncio.Event()
        self._linked = asyncio.Event()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._running: asyncio.Task[Any] | None = None
        self._lost_at: float | None = None
        self._dropping = False
        self._served: frozenset[str] = frozenset()
        self.lives: Callable[[], bool] = lambda: True
        """Says whether the robot behind the device can be read; the heartbeat leaves it out while it cannot."""

    @property
    def _d2d_announcer(self) -> Any:
        return self._announcer

    @_d2d_announcer.setter
    def _d2d_announcer(self, announcer: Any) -> None:
        # The framework encodes the whole description for each message.
        self._announcer = announcer
        if announcer is not None:
            _ANNOUNCED[self] = encoded_capabilities(self._driver)
            announcer._build_payload = presence_builder(
                announcer._device_id,
                lambda: _ANNOUNCED[self],
                announcer._identity,
                lambda: {**announcer._status, **lock_stated(self._driver)},
            )

    def _build_registration_params(self) -> dict[str, Any]:
        params = cast(dict[str, Any], super()._build_registration_params())
        params["status"] |= lock_stated(self._driver)
        return params

    async def _register(self, force: bool = False) -> None:
        _ANNOUNCED[self] = encoded_capabilities(self._driver)
        await super()._register(force=force)

    def _warn_if_predicate_extra_missing(self) -> None:
        """Log the framework's start-up line about an optional package at DEBUG only."""
        _log.debug("%s: broadcasts with a `where` clause need device-connect-edge[predicate].", self.device_id)

    async def run(self) -> None:
        """Serve until ``shutdown`` or ``stop``; whatever ends it, the link is closed."""
        self._loop = asyncio.get_running_loop()
        self._running = asyncio.current_task()
        self._started.set()
        try:
            await super().run()
        finally:
            self._ready.clear()
            if self.messaging is not None and not self.messaging.is_closed:
                await self.messaging.close()

    async def wait_ready(self, within_s: float) -> None:
        """Return once the device is callable, announced and sending its events.

        Raises:
            TimeoutError: not within ``within_s`` seconds. Call ``shutdown`` then.
            Exception: what ``run`` raised.
        """
        ready = asyncio.ensure_future(self._ready.wait())
        try:
            async with asyncio.timeout(within_s):
                await self._started.wait()
                assert self._running is not None
                await asyncio.wait({ready, self._running}, return_when=asyncio.FIRST_COMPLETED)
        finally:
            ready.cancel()
        if self._running is not None and self._running.done() and not self._ready.is_set():
            await self._running

    async def shutdown(self) -> None:
        """End ``run`` at any stage, announce the departure, wait until all is closed."""
        running = self._running
        if running is None:
            return
        if self._ready.is_set():
            await self.stop()
        else:
            running.cancel()
        await asyncio.wait({running})

    def emit_from_thread(self, event: str, payload: dict[str, Any]) -> Future[None]:
        """Emit from any thread at once; the future tells a bad event name.

        Raises:
            RuntimeError: the runtime is not running.
        """
        if self._loop is None or not self._ready.is_set():
            raise RuntimeError(f"{self.device_id} is not on the network")
        return asyncio.run_coroutine_threadsafe(self.enqueue_event(event, payload), self._loop)

    async def _connect_messaging(self) -> None:
        """Connect, with short pauses; the stock loop waits up to 30 s between attempts."""
        framework.DeviceConnectTelemetry = _telemetry
        self.messaging = backend_for(self.link)
        refusals = 0
        while True:
            try:
                await self.messaging.connect([], reconnect_cb=self._on_link_back, disconnect_cb=self._on_link_lost)
                break
            except MessagingError as error:
                refusals += isinstance(error, AuthenticationError)
                if refusals == MAX_REFUSALS:
                    raise
                self.problem = str(error)
                _log.warning("%s: %s; trying again in %g s", self.device_id, error, CONNECT_AGAIN_S)
            await asyncio.sleep(CONNECT_AGAIN_S)
        await self._notify_conn_state(True)
        if self._before_live is not None and not self._ready.is_set():
            await self._before_live(self.messaging)

    async def _on_link_lost(self) -> None:
        await self._notify_conn_state(False)

    async def _on_link_back(self) -> None:
        if not self._d2d_mode:
            self._track_task(asyncio.create_task(self._register(force=True)))
        self._track_task(asyncio.create_task(self._resubscribe_after_reconnect()))
        await self._notify_conn_state(True)

    async def _notify_conn_state(self, state: bool) -> None:
        if state:
            self._linked.set()
        await super()._notify_conn_state(state)

    def _validate_startup_config(self) -> None:
        # The framework makes its tracer right after this call, and connects right after that.
        if not settings.is_set("OTEL_EXPORTER_OTLP_ENDPOINT"):
            framework.DeviceConnectTelemetry = _NoTelemetry
        if not self.link.authenticated and not self.allow_insecure:
            raise ValueError(
                f"{self.device_id}: this link is not authenticated; give certificates or credentials, "
                "or opt in with allow_insecure=True"
            )

    async def _cmd_subscription(self) -> None:
        if observed():
            await super()._cmd_subscription()
            return
        functions = self._driver._get_functions()
        functions.update({name: _quick(function) for name, function in functions.items()})
        self._served = frozenset(functions)
        await self.messaging.serve(f"device-connect.{self.tenant}.{self.device_id}.cmd", self._serve)

    async def _serve(self, command: jsonrpc.RpcRequest, answer: Answer | None) -> None:
        """Answer a command as the framework does, without its spans."""
        method, params = command.method, command.params
        source = params.pop("_dc_meta", {}).get("source_device")
        if source:
            params["source_device"] = source
        if method == "requestRegistration":
            reply = jsonrpc.result(command.id, self._build_registration_params())
        elif method not in self._served:
            reply = jsonrpc.error(command.id, jsonrpc.METHOD_NOT_FOUND, f"Unknown method: {method}")
        else:
            try:
                reply = jsonrpc.result(command.id, await self._driver.invoke(method, **params))
            except Exception as problem:  # noqa: BLE001 - whatever a driver raises is its answer
                self._logger.warning("Driver function %s failed: %s", method, problem)
                reply = jsonrpc.error(command.id, jsonrpc.FUNCTION_FAILED, str(problem))
        await send(answer, reply)

    async def _heartbeat_loop(self) -> None:
        # The last thing the framework starts: from here on the device is callable and announced.
        self._ready.set()
        heartbeat = process_heartbeat(self.link)
        living = LivingDevice(self.device_id, self.messaging, self.lives, self._heartbeat_provider or dict)
        heartbeat.join(living)
        try:
            await super()._heartbeat_loop()
        finally:
            heartbeat.leave(living)

    async def _event_dispatch_loop(self) -> None:
        """Send events in order; the stock loop repeats a refused event for ever."""
        while True:
            subject, data = await self._event_queue.get()
            await self._send_event(subject, data)
            self._event_queue.task_done()

    async def _send_event(self, subject: str, data: bytes) -> None:
        assert self.messaging is not None
        if not jsonrpc.valid_json(data):
            _log.error("dropped an event on %s: it holds NaN or Infinity, which JSON cannot carry", subject)
            return
        try:
            if self.messaging.is_connected:
                self._lost_at = None
            else:
                await self._wait_for_link()
            await self.messaging.publish(subject, data)
            self._dropping = False
        except NotConnectedError:
            if not self._dropping:
                _log.warning("The link is lost: events of %s are dropped until it is back.", self.device_id)
            self._dropping = True
        except MessagingError as error:
            _log.error("dropped an event: %s", error)

    async def _wait_for_link(self) -> None:
        assert self._loop is not None and self.messaging is not None
        if self._lost_at is None:
            self._lost_at = self._loop.time()
        self._linked.clear()
        left = self._lost_at + HOLD_EVENTS_S - self._loop.time()
        with contextlib.suppress(TimeoutError):  # the caller checks whether the link is back
            await asyncio.wait_for(self._linked.wait(), max(left, 0.0))


_ANNOUNCED: WeakKeyDictionary[Any, str] = WeakKeyDictionary()
"""Description by which each runtime has announced its device."""

_ANNOUNCING: WeakKeyDictionary[Any, asyncio.Task[None]] = WeakKeyDictionary()
"""The announcement of each runtime that is under way; a registry that is down keeps one waiting."""


def describe_anew(runtime: Any, driver: DeviceDriver) -> None:
    """Announce a device again where its description or lock has changed; on its loop."""
    if not isinstance(runtime, DeviceRuntime):
        return
    described, before = encoded_capabilities(driver), _ANNOUNCED.get(runtime)
    announcing, lock = _ANNOUNCING.get(runtime), lock_stated(driver)
    same = described == before and lock.items() <= runtime.status.items()
    if same or (announcing is not None and not announcing.done()):
        return
    _ANNOUNCED[runtime] = described
    runtime.status.update(lock)
    if before is not None:
        _ANNOUNCING[runtime] = asyncio.create_task(_announce(runtime, driver, described != before))
        runtime._track_task(_ANNOUNCING[runtime])


async def _announce(runtime: Any, driver: DeviceDriver, other_description: bool) -> None:
    announcer = runtime._d2d_announcer
    if not runtime._d2d_mode:
        if other_description:
            await runtime._register(force=True)
        if lock := lock_stated(driver):
            # The registry takes what is no standard field of a status from heartbeats alone.
            beat = {"device_id": runtime.device_id, "ts": time.time(), **lock}
            with contextlib.suppress(MessagingError):  # its next regular heartbeat says the same
                subject = f"device-connect.{runtime.tenant}.{runtime.device_id}.heartbeat"
                await runtime.messaging.publish(subject, json.dumps(beat).encode())
    elif announcer is not None:
        # The framework's own announcer repeats what it was made with.
        announcer._capabilities = driver.capabilities.model_dump()
        with contextlib.suppress(MessagingError):  # its next regular message says the same
            await runtime.messaging.publish(announcer.subject, announcer._build_payload())


def link_of(runtime: Any) -> LinkConfig | None:
    """Return the link that a runtime uses, None where we have no such link."""
    stated = getattr(runtime, "link", None) or getattr(runtime.messaging, "link", None)
    if isinstance(stated, LinkConfig):
        return stated
    transport, urls = runtime._messaging_backend, runtime.messaging_urls
    if transport not in ("zenoh", "nats"):
        return None
    # The framework's own peers that scout speak plain TCP, whatever certificates they are given.
    tls = runtime.messaging_tls if urls else None
    listen = settings.items("ZENOH_LISTEN") if transport == "zenoh" and not urls else ()
    try:
        link = LinkConfig(transport, listen=listen, multicast=None if urls else True, tenant=runtime.tenant)
        return link.filled(urls, runtime.messaging_auth, tls)
    except ValidationError as problem:
        _log.warning("%s: its network is none that an e-stop connection can take: %s", runtime.device_id, problem)
        return None


def stated_id(runtime: Any) -> bool:
    """Return False where the framework made the device's id up, anew at each start."""
    return bool(runtime._explicit_device_id) or _MADE_UP.fullmatch(runtime.device_id) is None


class _NoTelemetry:
    """Stand-in for the framework's tracer, whose spans cost as much as a call."""

    def __init__(self, **_names: Any) -> None:
        pass

    def setup_otlp_exporter(self) -> None:
        """Set up nothing."""


_telemetry = framework.DeviceConnectTelemetry


def observed(driver: Any = None) -> bool:
    """Return True when spans, metrics or log lines of a driver are recorded."""
    if driver is not None and (
        callable(getattr(driver, "log_integration", None)) or decorators.logger.isEnabledFor(logging.INFO)
    ):
        return True
    try:
        from opentelemetry import metrics, trace  # noqa: PLC0415 - an optional part of the framework
    except ImportError:
        return False
    # The API package's own providers record nothing; an application replaces them.
    providers = trace.get_tracer_provider(), metrics.get_meter_provider()
    return any(
        not type(each).__module__.startswith(("opentelemetry.trace", "opentelemetry.metrics")) for each in providers
    )


def _quick(function: Callable[..., Awaitable[Any]]) -> Callable[..., Awaitable[Any]]:
    """Return an ``@rpc`` method that logs, traces and counts only when recorded.

    The caller is where ``get_rpc_source_device`` looks for it, and failures are logged, as always.
    """
    original, owner = getattr(function, "_original_func", None), getattr(function, "__self__", None)
    if original is None or owner is None or callable(getattr(owner, "log_integration", None)):
        return function
    name = function._function_name  # type: ignore[attr-defined]  # the decorator sets it

    @functools.wraps(function)
    async def called(*, source_device: str | None = None, **params: Any) -> Any:
        if decorators.logger.isEnabledFor(logging.INFO):
            return await function(source_device=source_device, **params)
        token = decorators._rpc_source_device.set(source_device)
        try:
            answer = await original(owner, **params)
        except Exception as problem:
            decorators.logger.warning("%s of %s failed: %s", name, source_device or "unknown", problem)
            raise
        finally:
            decorators._rpc_source_device.reset(token)
        if isinstance(answer, dict) and answer.get("error"):
            decorators.logger.warning("%s of %s is partial: %s", name, source_device or "unknown", answer["error"])
        return answer

    return called
