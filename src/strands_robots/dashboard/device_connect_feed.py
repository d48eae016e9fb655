"""Robots on Device Connect: events as they come, lockouts by question."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
from collections.abc import Callable, Mapping
from typing import Any

from device_connect_edge.messaging import MessagingError

from strands_robots.dashboard.feed import ASK_S, DEVICE_CONNECT, PARALLEL, LoopThread, poll_interval
from strands_robots.dashboard.fleet_model import FleetModel, key_of
from strands_robots.dashboard.verb_forms import forms_of
from strands_robots.device_connect import FleetClient
from strands_robots.device_connect.client import DeviceEvent
from strands_robots.device_connect.discovery import Peer
from strands_robots.device_connect.safety_controller import safety_controller, stand
from strands_robots.envelope import Envelope, error, is_error
from strands_robots.fleet.device_connect.lockouts import (
    ask_robots,
    enrolled_keys,
    resume_robots,
    status_question,
    status_report,
)
from strands_robots.fleet.joint_features import joint_limits, joint_units
from strands_robots.safety.identity import KeyFileError
from strands_robots.utils import ValidationError

logger = logging.getLogger(__name__)

SEARCH_S = 2.0
SEARCH_AGAIN_S = 30.0
"""Seconds between two searches where no new robot was announced meanwhile."""

LOOK_S = 0.2
KEYS_AGAIN_S = 2.0
QUIET = frozenset({"stateUpdate", "observationUpdate", "streamStep"})
"""Events that the timeline leaves out: there are many, and they are shown as what the robot does now."""


class DeviceConnectFeed:
    """Robots of one tenant, and a safety controller with a connection of its own.

    Args:
        model: takes what they say.
        fleet: a connected client; its source is the caller that robots see.
        signing_key: signs emergency stops; then only enrolled robots can confirm one.
    """

    network = DEVICE_CONNECT

    def __init__(self, model: FleetModel, fleet: FleetClient, signing_key: Any = None) -> None:
        self._model, self._fleet = model, fleet
        self.controller = safety_controller(
            fleet.source, fleet.link, signing_key=signing_key, require_signed=signing_key is not None, stands=True
        )
        self._standing = stand(self.controller, fleet.link, lambda: model.expected(self.network))
        self._keys: dict[str, bytes] = {}
        self._keys_usable, self._keys_at = True, float("-inf")
        self._names: set[str] = set()
        self._strangers: set[str] = set()
        self._thread = LoopThread("dashboard-device-connect")
        self._subscription = fleet.subscription("*", self._take)
        self._running = asyncio.run_coroutine_threadsafe(self._run(), self._thread.loop)

    async def call(self, robot: str, verb: str, params: Mapping[str, Any], seconds: float) -> Envelope:
        """Call a verb; every failure is an answer of status error."""
        try:
            return await self._fleet.call_async(robot, verb, params, seconds)
        except (LookupError, TimeoutError, RuntimeError, ValidationError, ValueError, MessagingError) as exc:
            return error(str(exc.args[0]) if exc.args else type(exc).__name__)

    async def stop(self, robot: str) -> Envelope:
        """End a robot's motion without a lockout; graded, never raises."""
        try:
            return await self._fleet.stop_async(robot, 2.0)
        except (RuntimeError, ValidationError, MessagingError) as exc:
            return error(str(exc), stopped=None)

    async def look_closer(self, robot: str) -> None:
        """Read the limits and the cameras of a robot, and its joints where it is idle."""
        features, cameras, state = await asyncio.gather(
            self.call(robot, "getFeatures", {}, 3.0),
            self.call(robot, "listCameras", {}, 3.0),
            self.call(robot, "getState", {}, 3.0),
        )
        found = cameras.get("cameras")
        names = tuple(str(each)[:128] for each in found[:32]) if isinstance(found, list) else ()
        limits = joint_limits(features) if not is_error(features) else {}
        self._model.update(self.network, robot, cameras=names, limits=limits, units=joint_units(features))
        if isinstance(state.get("joints"), Mapping):
            self._model.observe(self.network, robot, state["joints"])

    def resume(self, robots: list[str], signer: Any, seconds: float) -> dict[str, tuple[bool, str]]:
        """Free robots with the operator's key; blocks, and returns each outcome."""
        try:
            return resume_robots(self._fleet, ask_robots(self._fleet, robots, seconds), signer, seconds)
        except (KeyFileError, MessagingError) as exc:
            return dict.fromkeys(robots, (False, str(exc)))

    def close(self) -> None:
        """Leave the network."""
        with contextlib.suppress(MessagingError, TimeoutError):  # a connection that is lost needs no farewell
            self._subscription.close()
        self._running.cancel()
        self._thread.close()
        self._standing.close()
        self.controller.close()

    # On the client's thread: returns at once and may not raise.

    def _take(self, event: DeviceEvent) -> None:
        name, facts = event.device, event.payload
        if name not in self._names:
            self._strangers.add(name) if len(self._strangers) < PARALLEL else None
            return
        self._model.sign_of_life(self.network, name)
        part = str(facts.get("robot_name", ""))
        joints = facts.get("joints" if event.name == "observationUpdate" else "observation")
        if isinstance(joints, Mapping):
            self._model.observe(self.network, name, joints, part)
        if event.name == "stateUpdate":
            self._model.task(self.network, name, **_task(facts))
        elif event.name not in QUIET:
            self._model.note(self.network, name, event.name, facts)

    # On this feed's own loop.

    async def _run(self) -> None:
        asking: dict[str, asyncio.Task[None]] = {}
        asked: dict[str, float] = {}
        limit = asyncio.Semaphore(PARALLEL)
        searching: asyncio.Task[None] | None = None
        searched = float("-inf")
        while True:
            now = time.monotonic()
            announced = self._strangers or set(self._fleet.known()) - self._names
            if (searching is None or searching.done()) and (announced or now - searched > SEARCH_AGAIN_S):
                searched = now
                searching = asyncio.create_task(self._guarded(self._search, "the search for robots"))
            every = poll_interval(len(self._names))
            for name in sorted(self._names):
                busy = name in asking and not asking[name].done()
                if not busy and now - asked.get(name, float("-inf")) >= every:
                    asked[name] = now
                    asking[name] = asyncio.create_task(self._guarded(lambda name=name: self._ask(name, limit), name))  # type: ignore[misc]
            await asyncio.sleep(LOOK_S if len(self._names) > 1 else LOOK_S / 2)

    async def _guarded(self, work: Callable[[], Any], what: str) -> None:
        try:
            await work()
        except (LookupError, TimeoutError, RuntimeError, MessagingError) as exc:
            logger.warning("%s failed: %s", what, exc)

    async def _search(self) -> None:
        self._strangers.clear()
        for peer in await asyncio.to_thread(self._fleet.peers, SEARCH_S):
            self._meet(peer)

    def _meet(self, peer: Peer) -> None:
        names = {str(each.get("name", "")) for each in peer.functions}
        lockable = "resume" in names
        self._model.update(
            self.network,
            peer.id,
            kind=peer.type[:80],
            model=peer.model[:80],
            forms=forms_of(peer.functions),
            expected=lockable or peer.stop_verb is not None,
        )
        if self._model.row(key_of(self.network, peer.id)) is not None:
            self._names.add(peer.id)

    async def _ask(self, name: str, limit: asyncio.Semaphore) -> None:
        async with limit:
            self._load_keys()
            key, began = self._keys.get(name), time.monotonic()
            asked = status_question(self._fleet, name, signed=key is not None)
            try:
                answer = await self._fleet.call_async(name, "getStatus", asked, ASK_S)
            except (LookupError, TimeoutError, RuntimeError, MessagingError, ValidationError):
                # A robot that does not answer is shown by the age of what it said last.
                return
        took_ms = (time.monotonic() - began) * 1000
        self._model.sign_of_life(self.network, name, took_ms)
        if self._model.row(key_of(self.network, name)) is None:
            self._names.discard(name)
            return
        report = status_report(name, answer, took_ms, key, asked)
        if not self._keys_usable:
            self._model.update(self.network, name, locked=None, doubt="the enrolled keys cannot be used")
        else:
            self._model.report(self.network, report)
        if "task_status" in answer or "running_policies" in answer:
            self._model.task(self.network, name, **_task(answer))
        robots = answer.get("robots")
        for part, joints in list(robots.items())[:16] if isinstance(robots, Mapping) else ():
            if isinstance(joints, Mapping):
                self._model.observe(self.network, name, joints, str(part))

    def _load_keys(self) -> None:
        now = time.monotonic()
        if now - self._keys_at < KEYS_AGAIN_S:
            return
        self._keys_at = now
        try:
            self._keys, self._keys_usable = enrolled_keys(self._fleet.link), True
        except KeyFileError as exc:
            # Nothing can be proven, so no lockout state is shown as known.
            self._keys_usable = False
            logger.critical("No answer counts as a robot's own: %s", exc)


def _task(facts: Mapping[str, Any]) -> dict[str, Any]:
    """Return what a robot does, from a state event or an answer to getStatus."""
    running = facts.get("running_policies")
    if isinstance(running, Mapping):
        rows = [(name, row) for name, row in running.items() if isinstance(row, Mapping)]
        if not rows:
            return {"state": "idle"}
        name, row = rows[0]
        policy = str(row.get("policy", ""))
        instruction = str(row.get("instruction", ""))
        return {"state": "running", "instruction": instruction, "policy": policy, "step": row.get("step"), "who": name}
    state = str(facts.get("task_status", "")).lower() or "idle"
    return {"state": state, "instruction": str(facts.get("instruction", "")), "step": facts.get("step_count")}
