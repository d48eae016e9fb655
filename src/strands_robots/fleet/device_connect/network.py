"""Robots on Device Connect, for the calling side."""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Self

from strands_robots.envelope import Envelope, error
from strands_robots.errors import (
    ArgumentsError,
    NoAnswerError,
    NoSuchRobotError,
    RefusalError,
    RobotError,
    UnknownVerbError,
    UnreachableError,
)
from strands_robots.fleet.adapter import (
    CLOSED,
    DEVICE_CONNECT,
    FIND_S,
    STOP_S,
    Detail,
    FoundRobot,
    OnEvent,
    Place,
    ReceivedCall,
    RobotEvent,
    StopRequest,
)
from strands_robots.fleet.device_connect.config import described, enrolled_keys
from strands_robots.fleet.reports import task_of
from strands_robots.utils import ValidationError, device_id, plain_text

if TYPE_CHECKING:
    from strands_robots.device_connect.backends import LinkConfig
    from strands_robots.device_connect.client import DeviceEvent, FleetClient
    from strands_robots.device_connect.discovery import Peer
    from strands_robots.fleet.adapter import LockoutReport, Resumed, StopSender
    from strands_robots.fleet.shared_id import CachedKeys
    from strands_robots.safety.network_key import NetworkKey
    from strands_robots.safety.stop_roster import StopOutcome
    from strands_robots.serving.advertised import AdvertisedVerb

logger = logging.getLogger(__name__)

STATE, OBSERVATION, STEP = "stateUpdate", "observationUpdate", "streamStep"
FREQUENT = frozenset({STATE, OBSERVATION, STEP})
JOINTS = {OBSERVATION: "joints", STEP: "observation"}
"""Fields with the joints, by event."""

NAME_MAX = 100


def robot_event(event: DeviceEvent) -> RobotEvent:
    """Return a device's event with what it says of its joints and its task."""
    facts, part = event.payload, event.payload.get("robot_name")
    joints = facts.get(JOINTS.get(event.name, ""))
    return RobotEvent(
        event.device,
        _plain(event.name[: 2 * NAME_MAX]),
        facts,
        joints=joints if isinstance(joints, Mapping) else None,
        part=part if isinstance(part, str) else "",
        task=task_of(facts) if event.name == STATE else None,
        frequent=event.name in FREQUENT,
    )


@lru_cache(64)
def _plain(name: str) -> str:
    return plain_text(name, NAME_MAX)


UNKNOWN_METHOD, BAD_PARAMS = -32601, -32602
"""JSON-RPC's codes of an unknown function and of arguments that do not fit."""

DESCRIBE = "requestRegistration"
"""Function by which a device describes itself."""

DESCRIBE_S = 2.0
"""Seconds in which a device has to describe itself."""


class DeviceConnectNetwork:
    """One tenant of Device Connect.

    Args:
        link: how to reach it.
        source: the caller's name that goes with every call.
        preload: load at joining what a stop must not wait for.
    """

    name = DEVICE_CONNECT
    has_stop_link = True
    tells_absence = True
    announces_verbs = True
    reads: Mapping[str, str] = {"status": "getStatus", "state": "getState", "features": "getFeatures"}
    starts = "execute"
    _aliases: Mapping[str, str] = {**reads, "start": starts}

    def __init__(self, link: LinkConfig, source: str, *, preload: bool = False) -> None:
        self._link, self._source, self._preload = link, device_id("source", source), preload
        self._client: FleetClient | None = None
        self._given = False
        self._peers: dict[str, Peer] = {}
        self._discoveries = 0
        self._keys: CachedKeys | None = None

    @classmethod
    def joined(cls, client: FleetClient) -> Self:
        """Return the network of a connected client, which is closed by its owner."""
        network = cls(client.link, client.source)
        network._client, network._given = client, True
        return network

    def open(self) -> None:
        """Connect; raise :class:`UnreachableError` where that fails."""
        if self._given:
            return
        from device_connect_edge.messaging import MessagingError  # noqa: PLC0415 - loaded when it is used

        from strands_robots.device_connect import FleetClient  # noqa: PLC0415 - as above

        if self._preload:
            import strands_robots.device_connect.safety_controller  # noqa: PLC0415
            import strands_robots.fleet.device_connect.stops  # noqa: PLC0415, F401

        # A client connects once: each attempt has its own.
        client = FleetClient(self._link, self._source)
        try:
            client.__enter__()
        except (MessagingError, TimeoutError, OSError) as exc:
            raise UnreachableError(plain_text(str(exc))) from exc
        self._client = client

    def find(self, timeout: float | None = FIND_S, *, peers: bool = False) -> list[FoundRobot]:
        """Return the devices of the tenant, each of which is one to list."""
        del peers
        self._discoveries += 1
        with _carried():
            self._peers = {peer.id: peer for peer in self._connected.peers(FIND_S if timeout is None else timeout)}
        return [_found(peer) for peer in self._peers.values()]

    def known(self, robot: str) -> FoundRobot:
        """Return what the device stated last."""
        return _found(self._peers[robot]) if robot in self._peers else FoundRobot(robot)

    def announced(self) -> Collection[str]:
        """Return the devices that have announced themselves since the last search."""
        return self._connected.known()

    def bears(self, robot: str) -> bool:
        """Return whether a device of this id was found or has announced itself."""
        client = self._client
        return robot in self._peers or (client is not None and robot in client.known())

    def reaches(self, robot: str) -> bool:
        """Return whether a device of this id is known, answers, or is slow to answer."""
        try:
            return self.bears(robot) or self.describe(robot, anew=True) is not None or self.bears(robot)
        except NoSuchRobotError:
            return False
        except NoAnswerError:
            return True

    def session(self, robot: str) -> object:
        """Return the number of discoveries: a device has no session."""
        return self._discoveries

    def enrolled_key(self, robot: str) -> bytes | None:
        """Return the device's enrolled key."""
        from strands_robots.safety.identity import KeyFileError  # noqa: PLC0415 - a call need not load it

        try:
            return enrolled_keys(self._link).get(robot)
        except KeyFileError as exc:
            logger.warning("%s So none counts.", exc)
            return None

    def announced_functions(self, robot: str) -> object:
        """Return the functions that the device announced."""
        peer = self._peers.get(robot)
        return None if peer is None else peer.functions

    def describe(self, robot: str, *, anew: bool = False) -> object:
        """Return the functions that the device announced."""
        if anew:
            try:
                self._peers[robot] = self._connected.describe(robot, DESCRIBE_S)
            except Exception as exc:
                refusal = _refusal(exc, robot, DESCRIBE)
                if refusal is None:
                    raise
                if robot not in self._peers:
                    raise refusal from exc
                logger.debug("%s: it does not describe itself anew: %s", robot, refusal)
        return self.announced_functions(robot)

    def describe_each(self, robots: Iterable[str]) -> Mapping[str, object]:
        """Return the functions that the devices announced."""
        return {name: self._peers[name].functions for name in robots if name in self._peers}

    def verb(self, robot: str, name: str) -> AdvertisedVerb | None:
        """Return a function as the device itself describes it."""
        with self._asked(robot, name):
            described = self._connected.verb(robot, name)
            if described is None and (alias := self._aliases.get(name)):
                return self._connected.verb(robot, alias)
            return described

    def call(self, robot: str, verb: str, arguments: Mapping[str, Any], timeout: float) -> Envelope:
        """Call a function of the device, also by its name on the mesh."""
        if verb in self._aliases:
            # A device may have a function of that name.
            described = self.verb(robot, verb)
            verb = self._aliases[verb] if described is None else described.name
        with self._asked(robot, verb):
            return self._connected.call(robot, verb, arguments, timeout)

    def stop(
        self, robot: str, timeout: float = STOP_S, robot_name: str = "", *, insist: bool = False
    ) -> Envelope | None:
        """Stop the device by ``stop``, else by ``stopMotion``."""
        answer = self._connected.stop(robot, timeout, robot_name)
        if answer.get("in_reach") is False:
            # Its presence says whether it is still there.
            self._peers.pop(robot, None)
            return answer if insist or self.bears(robot) else None
        return answer

    def received(self, robot: str, verb: str, arguments: Mapping[str, Any]) -> ReceivedCall:
        """Return the call as it is: a device receives what was sent."""
        del robot
        return ReceivedCall(self._source, verb, arguments)

    async def call_async(self, robot: str, verb: str, arguments: Mapping[str, Any], within: float) -> Envelope:
        """Call a function of the device."""
        with self._asked(robot, verb):
            return await self._connected.call_async(robot, verb, arguments, within)

    async def describe_async(self, robot: str, within: float) -> FoundRobot:
        """Return the device as it describes itself."""
        described = await self.call_async(robot, DESCRIBE, {}, within)
        from strands_robots.device_connect.discovery import Peer  # noqa: PLC0415 - loaded when it is used

        return _found(replace(Peer.of(described), id=robot))

    async def stop_async(self, robot: str, within: float = STOP_S, robot_name: str = "") -> Envelope:
        """Stop the device by ``stop``, else by ``stopMotion``."""
        try:
            return await self._connected.stop_async(robot, within, robot_name)
        except Exception as exc:  # noqa: BLE001 - a stop that fails is a verdict, whatever it raised
            return error(plain_text(str(exc.args[0]) if exc.args else "") or type(exc).__name__, stopped=None)

    @property
    def key(self) -> NetworkKey:
        """The name of the tenant's network."""
        from strands_robots.fleet.device_connect.stops import network_key  # noqa: PLC0415 - a call need not load it

        return network_key(self._link)

    @property
    def place(self) -> Place:
        """The link in words, and what is known of it."""
        return Place(described(self._link), self._link.loopback_only, self._link.meet_port)

    @property
    def stale(self) -> str:
        """Reason why the registry's list may lack devices, or ""."""
        client = self._client
        return client.stale if client is not None else ""

    def stop_all(self, timeout: float = STOP_S) -> tuple[dict[str, Envelope], StopOutcome]:
        """Stop each device when it is found."""
        from strands_robots.fleet.device_connect.stops import stop_found  # noqa: PLC0415 - a call need not load it

        with _carried():
            return stop_found(self._connected, timeout)

    def emergency_stop(self, request: StopRequest) -> StopOutcome:
        """Stop and lock the robots of the tenant, on a connection of its own.

        A device in reach that did not act on it gets a plain ``stop`` as well.
        """
        from strands_robots.fleet.device_connect.stops import stopped_and_locked  # noqa: PLC0415 - a call need not load it

        with _carried():
            return stopped_and_locked(self._link, self._source, self._lent, request)

    def verdict(self, outcome: StopOutcome) -> Envelope:
        """Return the outcome as a safety controller words it."""
        from strands_robots.device_connect.safety_controller import outcome_envelope  # noqa: PLC0415 - as above

        return outcome_envelope(outcome)

    @contextmanager
    def standing(self, signing_key: Any, known: Callable[[], Collection[str]]) -> Iterator[StopSender]:
        """Make a controller with a connection of its own; the network need not be joined."""
        from strands_robots.device_connect.safety_controller import safety_controller, stand  # noqa: PLC0415 - as above

        link = self._link
        controller = safety_controller(
            self._source, link, signing_key=signing_key, require_signed=signing_key is not None, stands=True
        )
        with closing(controller), closing(stand(controller, link, known)):
            yield controller

    def beats(self, robots: Iterable[str]) -> Mapping[str, float | None]:
        """Return the devices' last beats or heartbeats."""
        return {name: self._connected.last_heartbeat(name) for name in robots}

    def lockable(self, timeout: float = FIND_S) -> list[str]:
        """Return the devices that have a ``resume``."""
        with _carried():
            return [peer.id for peer in self._connected.peers(timeout) if peer.lockable]

    def lockouts(self, robots: Iterable[str], timeout: float, *, signed: bool = False) -> list[LockoutReport]:
        """Ask each device for its status."""
        from strands_robots.fleet.device_connect.stops import ask_robots  # noqa: PLC0415 - a call need not load it

        with _carried():
            return ask_robots(self._connected, dict.fromkeys(robots), timeout, signed=signed)

    async def lockout_async(self, robot: str, within: float) -> LockoutReport:
        """Ask the device for its status."""
        from strands_robots.fleet.adapter import LockoutReport  # noqa: PLC0415 - as above
        from strands_robots.fleet.device_connect.stops import ask_robot, usable_keys  # noqa: PLC0415 - as above
        from strands_robots.fleet.shared_id import CachedKeys  # noqa: PLC0415 - a call need not load it

        if self._keys is None:
            self._keys = CachedKeys(lambda: usable_keys(self._link))
        try:
            return await ask_robot(self._connected, robot, within, self._keys.read())
        except UnreachableError as exc:
            return LockoutReport(robot, problem=exc.why)

    def resume(self, reports: Sequence[LockoutReport], signer: Any, timeout: float) -> dict[str, Resumed]:
        """Send each device a resume of each of its lockouts."""
        from strands_robots.fleet.device_connect.stops import resume_robots  # noqa: PLC0415 - a call need not load it

        with _carried():
            return resume_robots(self._connected, reports, signer, timeout)

    def beats_every(self, robot: str) -> float:
        """Return the seconds between two heartbeats of the device, or of its process."""
        return self._connected.beats_every(robot)

    def subscribe(self, robot: str, on_event: OnEvent, detail: Detail = Detail.EVENTS) -> Callable[[], None]:
        """Receive the device's events, which are all that it sends."""
        del detail

        with _carried():
            subscription = self._connected.subscription(robot, lambda event: on_event(robot_event(event)))

        def end() -> None:
            try:
                with _carried():
                    subscription.close()
            except UnreachableError as exc:
                # A connection that is lost needs no farewell.
                logger.debug("Events of %s were not ended in good order: %s", robot, exc)

        return end

    def close(self) -> None:
        """Disconnect."""
        if self._client is not None and not self._given:
            client, self._client = self._client, None
            client.close()

    @contextmanager
    def _lent(self) -> Iterator[FleetClient]:
        """Lend the joined client, or one for the length of the block."""
        client = self._client
        if client is not None:
            yield client
            return
        from strands_robots.device_connect import FleetClient  # noqa: PLC0415 - loaded when it is used

        with FleetClient(self._link, self._source) as own:
            yield own

    @contextmanager
    def _asked(self, robot: str, verb: str) -> Iterator[None]:
        """Raise refusals for a call's exceptions; forget a device that is gone."""
        try:
            yield
        except RefusalError:
            raise
        except Exception as exc:
            refusal = _refusal(exc, robot, verb)
            if refusal is None:
                raise
            if isinstance(refusal, NoSuchRobotError):
                self._peers.pop(robot, None)
            raise refusal from exc

    @property
    def _connected(self) -> FleetClient:
        if self._client is None:
            raise UnreachableError("Device Connect is not joined: use the fleet as a context manager")
        return self._client


@contextmanager
def _carried() -> Iterator[None]:
    """Raise :class:`UnreachableError` for what the network cannot carry."""
    from device_connect_edge.messaging import MessagingError  # noqa: PLC0415 - loaded when it is used

    try:
        yield
    except (MessagingError, TimeoutError, OSError) as exc:
        if isinstance(exc, RefusalError):
            raise
        raise UnreachableError(plain_text(str(exc)) or "Device Connect did not answer in time") from exc


def _found(peer: Peer) -> FoundRobot:
    age, stated = peer.age_s, peer.status.get("locked")
    locked = stated if isinstance(stated, bool) else None
    return FoundRobot(
        peer.id,
        plain_text(peer.type, 100),
        plain_text(peer.model, 100),
        peer.tags,
        must_answer=peer.stop_verb is not None or peer.lockable,
        status=plain_text(peer.status.get("availability"), 100),
        age_s=age,
        locked=locked,
        facts={
            **{"id": peer.id, "type": peer.type, "model": peer.model, "status": peer.status},
            **{"functions": peer.functions, "events": peer.events, "tags": list(peer.tags)},
            **({} if locked is None else {"locked": locked}),
            "age_s": None if age is None else round(age, 3),
        },
        functions=peer.functions,
    )


def _refusal(exc: Exception, robot: str, verb: str) -> RefusalError | None:
    from device_connect_edge.messaging import MessagingError  # noqa: PLC0415 - loaded when it is used

    from strands_robots.device_connect.client import (  # noqa: PLC0415 - as above
        CallRefusedError,
        ClientClosedError,
        NoSuchDeviceError,
    )

    if isinstance(exc, ClientClosedError):
        return NoAnswerError(CLOSED, robot=robot, verb=verb)
    why = plain_text(str(exc))
    cause: type[RefusalError] | None = None
    if isinstance(exc, CallRefusedError):
        refused = {UNKNOWN_METHOD: UnknownVerbError, BAD_PARAMS: ArgumentsError}.get(exc.code, RobotError)
        return refused(why or "no answer", robot=robot, verb=verb, envelope=error(why, jsonrpc_code=exc.code))
    if isinstance(exc, NoSuchDeviceError):
        cause = NoSuchRobotError
    elif isinstance(exc, ValidationError):
        cause = ArgumentsError
    elif isinstance(exc, TimeoutError):
        cause = NoAnswerError
    elif isinstance(exc, MessagingError):
        cause = UnreachableError
    return None if cause is None else cause(why or "no answer", robot=robot, verb=verb)
