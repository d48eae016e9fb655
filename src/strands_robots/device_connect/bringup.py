"""Bring-up of a robot on Device Connect, and its end."""

from __future__ import annotations

import asyncio
import atexit
import contextlib
import json
import logging
import re
import secrets
import sys
import threading
import time
from collections import Counter
from collections.abc import Collection
from concurrent.futures import Future
from dataclasses import dataclass, field
from typing import Any, Self

from device_connect_edge.drivers import DeviceDriver
from device_connect_edge.messaging import MessagingError

from strands_robots import settings
from strands_robots.adapted import behind_contract, simulated
from strands_robots.contract import body_of, holds_robots, stated_name
from strands_robots.device_connect._compat import Runtime
from strands_robots.device_connect.backends import LinkConfig
from strands_robots.device_connect.backends.base import NoResponderError
from strands_robots.device_connect.backends.config import insecure_opt_in, link_for
from strands_robots.device_connect.base_driver import RobotDriver
from strands_robots.device_connect.device_stops import (
    LEAVE_TIMEOUT_S,
    REGISTRATIONS,
    SafetyRegistration,
    cell_of,
    register_safety,
)
from strands_robots.device_connect.presence import encoded_capabilities
from strands_robots.device_connect.robot_driver import (
    MobileBaseDeviceDriver,
    NavigatingBaseDeviceDriver,
    RobotDeviceDriver,
)
from strands_robots.device_connect.simulation_driver import SimulationDeviceDriver
from strands_robots.safety.sightings import DuplicateDeviceError
from strands_robots.serving.workers import called
from strands_robots.tags import tags_of
from strands_robots.threads import LOOP_JOIN_TIMEOUT_S, LoopThread
from strands_robots.utils import ValidationError, choice, own_device_id, redacted

logger = logging.getLogger(__name__)

BRINGUP_TIMEOUT_S = 20.0
"""Seconds in which a device has to be callable and announced; a broker that is starting has time to come up."""

PROBE_TIMEOUT_S = 1.0
"""Seconds in which a device that already has the wanted id has to answer."""

PROBES, PROBE_EVERY_S = 3, 0.05
"""Number of times that a peer asks for its own id before the id counts as free, and the seconds between them."""

ALL_LINKED_S = 1.0
"""Seconds after which a session at a meeting point is linked to every peer that was there before it."""

PRESENCE_WAIT_S = 0.25
"""Seconds in which a live device has announced itself after a probe, where access rules forbid to call it."""

EXIT_TIMEOUT_S = 3.0
"""Seconds that the interpreter's end waits for the devices to announce their departure."""


RUNTIME_LOGGER = "device_connect_edge.device."
"""Prefix of the name of the framework's logger of a device."""


@dataclass(slots=True)
class Host:
    """Loop and task of a running device.

    Attributes:
        home: the loop that this module started for it; None on a loop of the caller's.
        end: set to end it.
        ended: set when it has ended.
    """

    loop: asyncio.AbstractEventLoop
    task: asyncio.Task[None]
    home: DeviceLoop | None = None
    end: asyncio.Event = field(default_factory=asyncio.Event)
    ended: threading.Event = field(default_factory=threading.Event)


_hosts: dict[Runtime, Host] = {}

# Devices of this process by id, from before their bring-up until they have left; two tenants may use one id.
_named: Counter[str] = Counter()
_naming = threading.Lock()


async def init_device_connect(  # noqa: PLR0917 - the documented signature
    robot: Any,
    peer_id: str | None = None,
    peer_type: str = "robot",
    messaging_url: str | None = None,
    messaging_backend: str | None = None,
    tenant: str = "default",
    allow_insecure: bool | None = None,
    *,
    link: LinkConfig | None = None,
    bringup_timeout: float = BRINGUP_TIMEOUT_S,
    cell: str | None = None,
    tags: Collection[str] | str | None = None,
) -> Runtime:
    """Serve a robot or a simulation; returns when it can be discovered and called.

    Args:
        robot: a simulation, a robot, any object that ``adapted.adapt`` accepts, or a ready ``DeviceDriver``.
        peer_id: its id on the network, without dots; ``<tool_name>-<8 hex>`` by default.
        peer_type: ``robot`` or ``sim``; settles what an object is that could be either.
        messaging_url: ``nats://host:port`` or ``tcp/host:port``, or several with commas; the environment's by default.
            Zenoh without one finds other devices by multicast on the local network.
        messaging_backend: ``zenoh`` or ``nats``; by default what the URL or ``MESSAGING_BACKEND`` says.
        tenant: devices and agents of other tenants neither see nor reach this one.
        allow_insecure: True accepts a transport without authentication; None asks
            ``DEVICE_CONNECT_ALLOW_INSECURE``; a string is refused.
        link: says how to connect in full, instead of URL and backend. A link that stays on this machine
            (``loopback_config()``) needs no ``allow_insecure``.
        bringup_timeout: seconds until the device has to be callable.
        cell: the cell that the robot is in, for stops of one cell; its own or that of ``STRANDS_CELL`` by
            default, "" for none.
        tags: by which callers choose robots; its own or those of ``STRANDS_TAGS`` by default.

    Raises:
        ValidationError: an argument out of its domain, or an unauthenticated transport without an opt-in.
        DuplicateDeviceError: a live device has this id, or another process of this machine serves it on the mesh.
        TimeoutError: not callable in time, or the broker not reached; nothing is left running.
    """
    choice("peer_type", peer_type, ("robot", "sim"))
    name = default_id(robot) if peer_id is None else own_device_id("peer_id", peer_id)
    reach = link_for(messaging_url, messaging_backend, tenant, link)
    insecure = insecure_opt_in(allow_insecure, reach, stated=link is not None)
    driver = driver_for(robot, peer_type)
    stays_in, marked = cell_of(driver, cell), tags_of(tags, driver, body_of(getattr(driver, "robot", None)))
    announceable(driver)
    warnings = _framework_warnings(name)
    registration = asyncio.create_task(
        called(
            REGISTRATIONS,
            lambda: register_safety(name, driver, reach, named=peer_id is not None, cell=stays_in),
            bringup_timeout,
        )
    )

    async def before_live(messaging: Any) -> None:
        await refuse_duplicate(name, reach, messaging)
        if marked:
            runtime.status["tags"] = list(marked)
        # Before it can be called, it can be stopped.
        registered = await asyncio.shield(registration)
        if registered is not None:
            # In its presence from the first one on: a robot that states a cell, or none, reads the scope of a stop.
            runtime.status["cell"] = registered.cell
            if registered.signed_only:
                runtime.status["signed_stops"] = True

    try:
        # Before the link: a worker and the loop that take the interpreter from one another would both take longer.
        await asyncio.wait({registration})
        if isinstance(driver, RobotDriver):
            # The runtime reads the status when it is made, on the loop, where a robot that blocks holds all others.
            await driver.reports.read()
        runtime = Runtime(
            driver=driver,
            device_id=name,
            link=reach,
            allow_insecure=insecure,
            discovery=settings.raw("DEVICE_CONNECT_DISCOVERY_MODE").lower(),
            before_live=before_live,
        )
    except BaseException:
        await asyncio.shield(_leave(name, registration))
        raise
    if isinstance(driver, RobotDriver):
        runtime.set_heartbeat_provider(driver.heartbeat)
        runtime.lives = lambda: driver.lives
    task = asyncio.create_task(_live(runtime, registration), name=f"device {name}")
    try:
        await runtime.wait_ready(bringup_timeout)
        registered = registration.result()
        if registered is not None:
            # A connection of its own, which would take the interpreter from the one that comes up until here.
            await called(REGISTRATIONS, registered.open, bringup_timeout)
    except BaseException as exc:
        await asyncio.shield(_put_down(runtime, task))
        if isinstance(exc, TimeoutError):
            where = redacted(", ".join(reach.connect)) or "the network"
            why = (runtime.problem or warnings.last).rstrip(".") + "."
            raise TimeoutError(f"{name} was not up on {where} within {bringup_timeout:g} s: {why}") from exc
        raise
    _hosts[runtime] = Host(asyncio.get_running_loop(), task)
    # Registered again with each device: the last registration runs first, and the link must still be open then.
    atexit.unregister(_depart_at_exit)
    atexit.register(_depart_at_exit)
    task.add_done_callback(lambda _: _ended(runtime, task))
    return runtime


def init_device_connect_sync(  # noqa: PLR0917 - the documented signature
    robot: Any,
    peer_id: str | None = None,
    peer_type: str = "robot",
    messaging_url: str | None = None,
    messaging_backend: str | None = None,
    tenant: str = "default",
    allow_insecure: bool | None = None,
    *,
    link: LinkConfig | None = None,
    bringup_timeout: float = BRINGUP_TIMEOUT_S,
    cell: str | None = None,
    tags: Collection[str] | str | None = None,
) -> Runtime:
    """Serve a robot as :func:`init_device_connect`, on the process's device loop.

    The arguments are the same. End it with :func:`stop_device_connect`; at the latest the interpreter's end does.

    Raises:
        Exception: what :func:`init_device_connect` raised; nothing of the device is left by then.
        TimeoutError: not callable in time; the bring-up is cancelled and never comes online later.
        RuntimeError: the bring-up ended without a runtime.
    """
    home = enter_loop(alone=isinstance(robot, DeviceDriver))
    started: Future[Runtime] = Future()
    ended = threading.Event()

    async def serve() -> None:
        try:
            runtime = await init_device_connect(
                robot,
                peer_id=peer_id,
                peer_type=peer_type,
                messaging_url=messaging_url,
                messaging_backend=messaging_backend,
                tenant=tenant,
                allow_insecure=allow_insecure,
                link=link,
                bringup_timeout=bringup_timeout,
                cell=cell,
                tags=tags,
            )
            host = _hosts.get(runtime)
            if host is None:
                started.set_exception(RuntimeError("The bring-up ended without a runtime."))
                return
            host.home, host.ended = home, ended
            # A caller who has given up would never stop the device.
            if started.set_running_or_notify_cancel():
                started.set_result(runtime)
                ending = asyncio.create_task(host.end.wait())
                await asyncio.wait({host.task, ending}, return_when=asyncio.FIRST_COMPLETED)
                ending.cancel()
            await runtime.shutdown()
        except BaseException as exc:
            if not started.done():
                started.set_exception(exc)
            elif not isinstance(exc, asyncio.CancelledError):
                logger.exception("A device ended.")
            raise
        finally:
            home.leave()
            ended.set()

    serving = home.submit(serve())
    try:
        return started.result(bringup_timeout + LOOP_JOIN_TIMEOUT_S)
    except BaseException as exc:
        given_up = started.cancel()
        serving.cancel()
        _gone(home, ended, LOOP_JOIN_TIMEOUT_S)
        if given_up and isinstance(exc, TimeoutError):
            late = f"The device was not up within {bringup_timeout:g} s; the bring-up is cancelled."
            raise TimeoutError(late) from exc
        raise


def _gone(home: DeviceLoop, ended: threading.Event, within: float) -> bool:
    """Wait for the end of a device, and of its loop where it was the last one."""
    until = time.monotonic() + within
    return ended.wait(within) and home.join(max(until - time.monotonic(), 0.0))


def stop_device_connect(runtime: Any, within: float = 10.0) -> None:
    """Announce a device's departure and close its link; the last one ends the loop.

    Callable from any thread but the device's own loop; there, ``await runtime.shutdown()``. A device that is off
    already is no error. The robot is not halted: ask ``robot.halt`` first where it may move.

    Raises:
        TimeoutError: not gone within ``within`` seconds.
    """
    host = _hosts.get(runtime)
    if host is None:
        return
    if host.home is None:
        asyncio.run_coroutine_threadsafe(runtime.shutdown(), host.loop).result(within)
        return
    with contextlib.suppress(RuntimeError):  # the loop closed by itself a moment ago
        host.loop.call_soon_threadsafe(host.end.set)
    if not _gone(host.home, host.ended, within):
        raise TimeoutError(f"The device did not leave the network within {within:g} s.")


def driver_for(robot: Any, peer_type: str) -> DeviceDriver:
    """Return the driver of ``robot``, by its class, else by ``peer_type``.

    Raises:
        ValidationError: ``sim`` for a robot that is none, or a plain value in place of a robot.
    """
    if isinstance(robot, DeviceDriver):
        return robot
    # A test double has every attribute, and is what the caller says.
    lists = callable(getattr(robot, "list_robots", None))
    driver = None if peer_type == "sim" and lists else _driver_by_class(robot)
    if peer_type == "sim" and not lists and callable(getattr(robot, "start_task", None)):
        raise ValidationError(f"peer_type must be robot for {type(robot).__name__}, which has no list_robots, not sim.")
    if driver is None:
        return SimulationDeviceDriver(robot) if peer_type == "sim" else RobotDeviceDriver(robot)
    if peer_type == "sim" and not isinstance(driver, SimulationDeviceDriver):
        raise ValidationError(f"peer_type must be robot for {type(robot).__name__}, which is no simulation, not sim.")
    return driver


def _driver_by_class(robot: Any) -> DeviceDriver | None:
    """Return the driver of a robot that can only be one kind of device, else None."""
    if getattr(robot, "device_type", "") == "reachy_mini":
        from strands_robots.device_connect.reachy_mini_driver import ReachyMiniDriver  # noqa: PLC0415 - for it alone

        return ReachyMiniDriver(robot=robot)
    if getattr(robot, "nav_action", None) is not None and callable(getattr(robot, "start_navigation", None)):
        return NavigatingBaseDeviceDriver(robot)
    if callable(getattr(robot, "start_drive", None)):
        return MobileBaseDeviceDriver(robot)
    simulation = getattr(sys.modules.get("strands_robots.simulation"), "Simulation", None)
    if isinstance(simulation, type) and isinstance(robot, simulation):
        return SimulationDeviceDriver(robot)
    world = None if callable(getattr(robot, "start_task", None)) else behind_contract(robot)
    if holds_robots(world):
        return SimulationDeviceDriver(robot, hardware=not simulated(world, "robot"))
    return None


def default_id(robot: Any) -> str:
    """Return ``<tool_name>-<8 hex>``, with dashes for characters no id can have."""
    name = stated_name(robot, "") or getattr(robot, "device_type", "")
    clean = re.sub(r"[^A-Za-z0-9_-]+", "-", name if isinstance(name, str) else "")[:100].strip("-_") or "robot"
    return f"{clean}-{secrets.token_hex(4)}"


def announceable(driver: DeviceDriver) -> None:
    """Refuse a driver whose description JSON cannot carry: discovery would miss it.

    Raises:
        ValidationError: naming the functions and events to mend.
    """
    with contextlib.suppress(TypeError, ValueError):  # the fault is searched below, part by part
        encoded_capabilities(driver)
        return
    capabilities = driver.capabilities
    faults = []
    for part in (*capabilities.functions, *capabilities.events):
        try:
            json.dumps(part.model_dump(), allow_nan=False)
        except (TypeError, ValueError) as exc:
            faults.append(f"{part.name} ({exc})")
    raise ValidationError(
        f"{type(driver).__name__} cannot be announced, because JSON cannot carry a default or a label of "
        f"{', '.join(faults) or 'the device itself'}."
    )


async def refuse_duplicate(name: str, link: LinkConfig, messaging: Any) -> None:
    """Refuse an id that a live device on this network has.

    Raises:
        DuplicateDeviceError: a device with this id answered a probe. One that crashed does not answer.
    """
    taken = await (_announced(name, link, messaging) if link.identified else _answers(name, link, messaging))
    if taken:
        raise DuplicateDeviceError(
            f"A device {name!r} is live in tenant {link.tenant!r} and answered; give this one another peer_id."
        )


async def _announced(name: str, link: LinkConfig, messaging: Any) -> bool:
    """Return True when a device of this id announces itself on a probe.

    Where devices prove who they are, access rules let no device call another one, or itself.
    """
    present = asyncio.Event()

    async def on_presence(data: bytes, reply: str | None) -> None:
        if b'"departing"' not in data:
            present.set()

    root = f"device-connect.{link.tenant}"
    subscription = await messaging.subscribe(f"{root}.{name}.presence", on_presence, subscribe_only=True)
    try:
        await messaging.publish(f"{root}.discovery.probe", b'{"probe": true}')
        async with asyncio.timeout(PRESENCE_WAIT_S):
            return await present.wait()
    except TimeoutError:
        return False
    finally:
        await subscription.unsubscribe()


async def _answers(name: str, link: LinkConfig, messaging: Any) -> bool:
    """Return True when a device of this id answers a call."""
    request = {"jsonrpc": "2.0", "id": "probe", "method": "requestRegistration", "params": {}}
    if link.is_peer:
        # At a meeting point peers learn of one another one by one; any other open link knows all its peers.
        learning = link.meet_port and messaging.linked_for_s < ALL_LINKED_S
        messaging.configure_d2d_retry(retries=PROBES if learning else 1, delay=PROBE_EVERY_S)
    try:
        await messaging.request(
            f"device-connect.{link.tenant}.{name}.cmd", json.dumps(request).encode(), timeout=PROBE_TIMEOUT_S
        )
    except NoResponderError:
        return False
    except MessagingError as exc:
        logger.warning("A device %r is known on this network and does not answer (%s); taking its place.", name, exc)
        return False
    return True


async def _put_down(runtime: Runtime, task: asyncio.Task[None]) -> None:
    await runtime.shutdown()
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)


async def _live(runtime: Runtime, registration: asyncio.Task[SafetyRegistration | None]) -> None:
    try:
        await runtime.run()
    finally:
        # Closing a link blocks, so it is done on a thread, to its end.
        await asyncio.shield(_leave(runtime.device_id, registration))


async def _leave(name: str, registration: asyncio.Task[SafetyRegistration | None]) -> None:
    (taken,) = await asyncio.gather(registration, return_exceptions=True)
    try:
        if isinstance(taken, SafetyRegistration):
            await called(REGISTRATIONS, taken.leave, LEAVE_TIMEOUT_S)
    finally:
        _forget_warnings(name)


def _ended(runtime: Runtime, task: asyncio.Task[None]) -> None:
    _hosts.pop(runtime, None)
    if not task.cancelled() and task.exception() is not None:
        logger.error("Device %s went off the network: %s", runtime.device_id, task.exception())


class _LastWarning(logging.Handler):
    """Keeps the framework's last warning; the application decides what is shown."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.last = ""

    def emit(self, record: logging.LogRecord) -> None:
        self.last = record.getMessage().strip()


def _framework_warnings(name: str) -> _LastWarning:
    """Attach a handler to the runtime's logger, which would else write to stderr."""
    with _naming:
        _named[name] += 1
        framework = logging.getLogger(RUNTIME_LOGGER + name)
        for handler in framework.handlers:
            if isinstance(handler, _LastWarning):
                return handler
        last = _LastWarning()
        framework.addHandler(last)
        return last


def _forget_warnings(name: str) -> None:
    """Drop the runtime's logger, which Python keeps for every id that there ever was.

    It stays while another device of this process has the id, and where the application has set it up.
    """
    with _naming:
        _named[name] -= 1
        if _named[name]:
            return
        del _named[name]
        framework = logging.getLogger(RUNTIME_LOGGER + name)
        ours = all(isinstance(each, _LastWarning) for each in framework.handlers)
        if ours and not framework.filters and framework.level == logging.NOTSET:
            framework.manager.loggerDict.pop(framework.name, None)


def _depart_at_exit() -> None:
    started = {runtime: host for runtime, host in _hosts.items() if host.home is not None}
    for host in started.values():
        with contextlib.suppress(RuntimeError):  # its loop closed a moment ago
            host.loop.call_soon_threadsafe(host.end.set)
    until = time.monotonic() + EXIT_TIMEOUT_S
    for runtime, host in started.items():
        if not host.ended.wait(max(until - time.monotonic(), 0.0)):
            logger.warning("Device %s could not announce its departure.", runtime.device_id)


class DeviceLoop(LoopThread):
    """The event loop of devices; it ends when its last user has left.

    The code of a robot runs on workers, so its device needs no loop of its own. The methods of a ready ``DeviceDriver``
    are coroutines of somebody else; such a driver gets a loop of its own, where it blocks no other device.
    """

    def __init__(self) -> None:
        super().__init__("device-connect")
        self._users = 0

    def enter(self) -> Self:
        """Begin one use."""
        self._users += 1
        return self

    def leave(self) -> None:
        """End one use; the last one ends loop and thread, without waiting for it."""
        with _loops_lock:
            self._users -= 1
            if self._users:
                return
            if self in _loops:
                _loops.remove(self)
        self.end()

    def join(self, within: float) -> bool:
        """Wait for the thread to end where no user is left; False when it did not."""
        with _loops_lock:
            if self._users:
                return True
        return super().join(within)


_loops_lock = threading.Lock()
_loops: list[DeviceLoop] = []


def enter_loop(*, alone: bool) -> DeviceLoop:
    """Return the loop of the process's robots, or one for a driver ``alone``.

    Every call needs one :meth:`DeviceLoop.leave`.
    """
    with _loops_lock:
        if alone:
            return DeviceLoop().enter()
        if not _loops:
            _loops.append(DeviceLoop())
        return _loops[0].enter()
