"""Discovery of devices by presence, by the registry service, by heartbeats.

A device in d2d mode answers a probe with its presence. One in registry mode is silent there and registers with the
registry service instead, which lists it for as long as its heartbeats go on. Both kinds are looked for at once. While
the registry is expected and gives no list, devices are found by their heartbeats and asked to describe themselves.
"""

from __future__ import annotations

import asyncio
import json
import logging
import time
import uuid
from collections.abc import AsyncIterator, Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from device_connect_edge.messaging.exceptions import MessagingError

from strands_robots import settings
from strands_robots.bounded_json import json_object
from strands_robots.device_connect.backends.base import Backend, NoResponderError, UnreadableReplyError
from strands_robots.device_connect.backends.config import network_of
from strands_robots.device_connect.presence import HEARTBEAT_S, PROCESS_HEARTBEAT_S, devices_in
from strands_robots.errors import StrandsRobotsError
from strands_robots.safety.sightings import sightings
from strands_robots.tags import read_tags

logger = logging.getLogger(__name__)

PROBE_EVERY_S = 0.25
"""Seconds between the first two probes while peers are collected; then twice as many each time."""

PROBE_AGAIN_S = 0.04
"""Seconds from a new link to a second probe: the first may leave before both sides know their subscriptions."""

LOOK_EVERY_S = 0.02
"""Seconds between two looks at whether the collection is over."""

SETTLED_S, SETTLED_FOR_SURE_S = 0.2, 0.6
"""Seconds without a new device or link after which a collection, or a thorough one, ends early.

That is where at least one device has answered; a device answers a probe within milliseconds.
"""

SETTLED_HERE_S, SETTLED_FOR_SURE_HERE_S = 0.15, 0.2
"""The same on this machine alone, where links come up in milliseconds."""

GAPS = 4
"""Times the longest gap so far between two devices or links, which a thorough collection on this machine waits for.

On a busy machine, where devices answer late, it waits longer in proportion.
"""

SETTLED_AMONG_SCOUTED_S = 0.4
"""The same where peers are found by multicast, because their links come up one by one."""

REGISTRY_S = 0.4
"""Seconds in which a registry that is not known to exist has to answer, where devices answered otherwise."""

REGISTRY_AGAIN_S = 0.05
"""Seconds between two questions to a registry that no peer of this one serves yet."""

REGISTRY_LINKED_S = 0.6
"""Seconds in which a registry among peers has to be linked."""

HEARTBEATS_S = 6.0
"""Seconds in which every live device sends a heartbeat; the framework's default is one in 5 s."""

HEARTBEATS_MAX = 4096
"""Devices whose last heartbeat is kept; the longest silent one makes place."""

DESCRIBE_S = 1.0
"""Seconds in which a device describes itself when asked."""

PAGE = 100
"""Devices of one answer of the registry; fewer are asked for where their descriptions are too long for it."""

PAGES_MAX = 1000

OnDevice = Callable[["Peer"], None]


class RegistryError(StrandsRobotsError, RuntimeError):
    """The registry answered with an error, as it does while its database is gone."""


@dataclass(frozen=True, slots=True)
class Peer:
    """A device as it describes itself."""

    id: str
    type: str = ""
    model: str = ""
    status: Mapping[str, Any] = field(default_factory=dict)
    functions: tuple[Mapping[str, Any], ...] = ()
    events: tuple[str, ...] = ()
    location: str = ""
    heard_at: float | None = field(default=None, compare=False)
    """Monotonic time of its last own message; None where only the registry names it."""

    @property
    def age_s(self) -> float | None:
        """Seconds since its last own message."""
        return None if self.heard_at is None else max(0.0, time.monotonic() - self.heard_at)

    @property
    def stop_verb(self) -> str | None:
        """The function that stops it: ``stop``, else ``stopMotion``, else None."""
        names = {str(each.get("name", "")) for each in self.functions}
        return next((verb for verb in ("stop", "stopMotion") if verb in names), None)

    @property
    def lockable(self) -> bool:
        """True for a device that can be locked and resumed."""
        return any(each.get("name") == "resume" for each in self.functions)

    @property
    def cell(self) -> str | None:
        """Its cell, "" for none; None where it states neither, and reads no scope."""
        cell = self.status.get("cell")
        return cell if isinstance(cell, str) else None

    @property
    def tags(self) -> tuple[str, ...]:
        """The tags that it states."""
        return read_tags(self.status.get("tags"))

    @classmethod
    def of(cls, description: Mapping[str, Any]) -> Peer:
        """Read a presence message or a registration; a field that it lacks is empty."""
        identity, status = _object(description, "identity"), _object(description, "status")
        capabilities = _object(description, "capabilities")
        functions, events = _objects(capabilities, "functions"), _objects(capabilities, "events")
        return cls(
            id=str(description.get("device_id", "")),
            type=str(identity.get("device_type", "")),
            model=str(identity.get("model") or ""),
            status=status,
            functions=functions,
            events=tuple(str(each.get("name", "")) for each in events),
            location=str(status.get("location") or ""),
        )


class Discovery:
    """Devices of one tenant, found on one connection; used on the connection's loop."""

    def __init__(self, messaging: Backend) -> None:
        self.stale = ""
        """Empty, or one sentence on why the last collection may lack devices or name some that are gone."""
        self._messaging = messaging
        self._root = f"device-connect.{messaging.link.tenant}"
        self._network, self._remembered = network_of(messaging.link), sightings()
        self._present: dict[str, Peer] = {}
        self._listed: dict[str, Peer] = {}
        self._listed_at: float | None = None
        self._described: dict[str, Peer] = {}
        self._heartbeats: dict[str, float] = {}
        self._named: set[str] = set()
        self._unserved = False
        """True while the last question to the registry found none."""
        self._listens_since = 0.0
        self._changed_at = self._longest_gap_s = 0.0
        self._on_device: OnDevice = lambda peer: None

    @property
    def known(self) -> tuple[str, ...]:
        """Ids of the devices that were announced since the last collection."""
        return tuple(sorted(self._present))

    def announces(self, name: str, function: str, argument: str) -> bool:
        """Return True where a device's description has this argument of this function."""
        peer = self._present.get(name) or self._described.get(name) or self._listed.get(name)
        stated = (each for each in (peer.functions if peer else ()) if each.get("name") == function)
        return any(argument in _object(_object(each, "parameters"), "properties") for each in stated)

    def last_heartbeat(self, name: str) -> float | None:
        """Return the monotonic time of a device's last heartbeat; None before the first.

        The beat of its process counts as one.
        """
        return self._heartbeats.get(name)

    def beats_every(self, name: str) -> float:
        """Return the seconds between two heartbeats, or beats, of a device."""
        return PROCESS_HEARTBEAT_S if name in self._named else HEARTBEAT_S

    async def start(self) -> None:
        """Receive presence and heartbeats from now on."""
        self._listens_since = asyncio.get_running_loop().time()
        for leaf, take in (("presence", self._on_presence), ("heartbeat", self._on_heartbeat)):
            await self._messaging.subscribe_with_subject(f"{self._root}.*.{leaf}", take, subscribe_only=True)

    async def collect(
        self, within: float, on_device: OnDevice = lambda peer: None, *, thorough: bool = False
    ) -> list[Peer]:
        """Return the devices of the tenant, sorted by id.

        Args:
            within: seconds at most. Where the registry is expected and gives no list, it lasts until heartbeats were
                received for ``HEARTBEATS_S``. It ends early, once no more devices come.
            on_device: called once with each device, when it is found.
            thorough: wait longer for a further device, and where none was found for heartbeats.
        """
        loop = asyncio.get_running_loop()
        self._present.clear()
        self._described.clear()
        named: set[str] = set()

        def report_once(peer: Peer) -> None:
            if peer.id not in named:
                named.add(peer.id)
                self._changed(loop.time())
                on_device(peer)

        self._on_device = report_once
        began = self._changed_at = loop.time()
        self._longest_gap_s = 0.0
        listing = asyncio.create_task(self._list(within))
        try:
            probe_at, pause, links = began, PROBE_EVERY_S, 0
            while (now := loop.time()) < began + within:
                if (linked := self._messaging.links) > links:
                    probe_at = now
                    self._changed(now)
                if now >= probe_at:
                    probe_at = now + (PROBE_AGAIN_S if linked > links else pause)
                    # Hundreds of devices answer each probe.
                    pause *= 1 if linked > links else 2
                    await self._messaging.publish(f"{self._root}.discovery.probe", b'{"probe": true}')
                links = linked
                if named and self._registry_answered(listing, now - began) and self._settled(now, thorough):
                    break
                await asyncio.sleep(min(LOOK_EVERY_S, within))
            await self._settle_registry(listing, began, sure=thorough and not named)
        finally:
            listing.cancel()
            await asyncio.gather(listing, return_exceptions=True)
            self._on_device = lambda peer: None
        # A device's own word is newer than the registry's.
        everyone = {**self._listed, **self._described, **self._present}
        return [self._with_last_heartbeat(everyone[name]) for name in sorted(everyone)]

    def _changed(self, now: float) -> None:
        self._longest_gap_s = max(self._longest_gap_s, now - self._changed_at)
        self._changed_at = now

    def _settled(self, now: float, thorough: bool) -> bool:
        """Return True when no further device or link is to be expected."""
        link = self._messaging.link
        if link.meeting_point:
            settled = max(SETTLED_FOR_SURE_HERE_S, GAPS * self._longest_gap_s) if thorough else SETTLED_HERE_S
        elif thorough:
            settled = SETTLED_FOR_SURE_S
        else:
            settled = SETTLED_AMONG_SCOUTED_S if link.uses_multicast else SETTLED_S
        return now - self._changed_at >= settled

    def _with_last_heartbeat(self, peer: Peer) -> Peer:
        at = self._heartbeats.get(peer.id)
        return peer if at is None or at <= (peer.heard_at or 0.0) else replace(peer, heard_at=at)

    def _registry_answered(self, listing: asyncio.Task[dict[str, Peer]], lasted: float) -> bool:
        """Return False while the registry's list has to be waited for."""
        return listing.done() or (not self._expects_registry and (self._unserved or lasted >= REGISTRY_S))

    @property
    def _expects_registry(self) -> bool:
        return self._listed_at is not None or settings.raw("DEVICE_CONNECT_DISCOVERY_MODE").lower() == "registry"

    async def _settle_registry(self, listing: asyncio.Task[dict[str, Peer]], began: float, *, sure: bool) -> None:
        """Take the registry's list; without one, find devices by their heartbeats.

        Args:
            listing: the task of the list.
            began: start of the collection.
            sure: wait for heartbeats though nothing speaks for a registry.
        """
        loop = asyncio.get_running_loop()
        problem = listing.exception() if listing.done() else None
        if listing.done() and problem is None:
            self._listed, self._listed_at, self.stale = listing.result(), loop.time(), ""
            return
        descriptions: dict[str, asyncio.Task[None]] = {}
        while True:
            now = time.monotonic()
            alive = {name for name, at in self._heartbeats.items() if now - at <= HEARTBEATS_S + loop.time() - began}
            for name in alive - self._present.keys() - descriptions.keys():
                descriptions[name] = asyncio.create_task(self._describe(name))
            # A device that sends heartbeats and no presence is in registry mode.
            if self._expects_registry or descriptions or isinstance(problem, RegistryError):
                self._report_stale(str(problem or "no answer in time"), loop.time())
            elif not sure:
                return
            if loop.time() >= self._listens_since + HEARTBEATS_S:
                break
            await asyncio.sleep(PROBE_EVERY_S)
        await asyncio.gather(*descriptions.values())

    def _report_stale(self, problem: str, now: float) -> None:
        known_before = bool(self.stale)
        self.stale = f"The registry gives no list ({problem}): devices may be missing"
        if self._listed_at is None:
            self.stale += "."
        else:
            self.stale += f", and what it listed {now - self._listed_at:.0f} s ago counts."
        if not known_before:
            logger.warning("%s", self.stale)

    async def _list(self, within: float) -> dict[str, Peer]:
        """Return what the registry lists.

        Raises:
            NoResponderError: there is none.
            RegistryError: it answered with an error.
            MessagingError: no answer within ``within`` seconds.
        """
        loop = asyncio.get_running_loop()
        linked_by = loop.time() + REGISTRY_LINKED_S
        devices = {}
        while True:
            self._unserved = False
            try:
                async for row in self._rows(within):
                    peer = Peer.of(row)
                    devices[peer.id] = peer
                    self._remember(peer)
                    self._on_device(peer)
            except NoResponderError:
                if not self._messaging.link.is_peer or loop.time() >= linked_by:
                    raise
                # Its link may still come up.
                self._unserved = True
                await asyncio.sleep(REGISTRY_AGAIN_S)
            else:
                return devices

    async def _rows(self, within: float) -> AsyncIterator[Mapping[str, Any]]:
        offset: Any = 0
        limit = PAGE
        for _ in range(PAGES_MAX):
            params = {"offset": offset, "limit": limit}
            try:
                answer = await self._ask("discovery", "discovery/listDevices", params, within)
            except UnreadableReplyError:
                if limit == 1:
                    raise
                limit = max(1, limit // 4)
                continue
            rows = answer.get("devices")
            for row in rows if isinstance(rows, list) else ():
                if isinstance(row, Mapping) and row.get("device_id"):
                    yield row
            before, offset = offset, answer.get("next_offset")
            if not isinstance(offset, int) or offset <= before:
                return

    async def _describe(self, name: str) -> None:
        try:
            answer = await self._ask(f"{name}.cmd", "requestRegistration", {}, DESCRIBE_S)
        except (MessagingError, RegistryError) as exc:
            logger.debug("%s sent a heartbeat and does not describe itself: %s", name, exc)
            return
        if answer.get("device_id") == name:
            peer = self._described[name] = replace(Peer.of(answer), heard_at=time.monotonic())
            self._remember(peer)
            self._on_device(peer)

    def _remember(self, peer: Peer, *, departing: bool = False) -> None:
        """Have this machine remember a device that was heard."""
        cell, stops = peer.status.get("cell"), peer.stop_verb is not None
        self._remembered.note(
            self._network,
            peer.id,
            # A device that states no cell is in none, so that a forged presence cannot put it into one.
            cell=None if departing else cell if isinstance(cell, str) else "",
            signed_only=True if peer.status.get("signed_stops") is True else None,
            # A departing device describes itself no more.
            stoppable=True if stops else None if departing else False,
            departing=departing,
        )

    async def _ask(self, leaf: str, method: str, params: Mapping[str, Any], within: float) -> Mapping[str, Any]:
        request = {"jsonrpc": "2.0", "id": uuid.uuid4().hex, "method": method, "params": params}
        data = await self._messaging.request_once(f"{self._root}.{leaf}", json.dumps(request).encode(), within)
        reply = json_object(data)
        result = reply.get("result")
        if not isinstance(result, Mapping):
            raise RegistryError(str(_object(reply, "error").get("message") or "an answer without a result")[:200])
        return result

    async def _on_presence(self, data: bytes, subject: str, reply: str | None) -> None:
        presence, name = json_object(data), parts(subject)[2]
        # Access rules guard the topic, so it outranks the id in the message.
        if presence.get("device_id") != name:
            return
        if presence.get("departing"):
            self._remember(Peer.of(presence), departing=True)
            self._present.pop(name, None)
            self._heartbeats.pop(name, None)
            self._named.discard(name)
        else:
            peer = self._present[name] = replace(Peer.of(presence), heard_at=time.monotonic())
            self._remember(peer)
            self._on_device(peer)

    async def _on_heartbeat(self, data: bytes, subject: str, reply: str | None) -> None:
        device, now = parts(subject)[2], time.monotonic()
        named = devices_in(data)
        if self._messaging.link.identified:
            # Access rules guard the topic of one device, so a beat proves the life of that one only.
            named = [each for each in named if each == device]
        for name in (device, *named):
            self._remembered.note(self._network, name)
            # Taken out and put in again, so that the longest silent ones are dropped first.
            self._heartbeats.pop(name, None)
            self._heartbeats[name] = now
        self._named.update(named)
        while len(self._heartbeats) > HEARTBEATS_MAX:
            silent = next(iter(self._heartbeats))
            del self._heartbeats[silent]
            self._named.discard(silent)


def parts(subject: str) -> list[str]:
    """Return the tokens of a subject or a key, at least four."""
    tokens = subject.split("/" if "/" in subject else ".")
    return tokens if len(tokens) > 3 else ["", "", "", ""]


def _object(message: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    value = message.get(key)
    return value if isinstance(value, Mapping) else {}


def _objects(message: Mapping[str, Any], key: str) -> tuple[Mapping[str, Any], ...]:
    values = message.get(key)
    return tuple(each for each in values if isinstance(each, Mapping)) if isinstance(values, list) else ()
