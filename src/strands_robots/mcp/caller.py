"""Calls of one MCP client to robots, halted when they are given up."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import anyio
from device_connect_edge.messaging import MessagingError

from strands_robots.arm_mixin import WAIT_S
from strands_robots.contract import RUNNING
from strands_robots.device_connect import FleetClient
from strands_robots.device_connect.client import CallRefusedError, DeviceTimeoutError, NoSuchDeviceError
from strands_robots.envelope import Envelope, error, is_error
from strands_robots.serving.verbs import LEASE_ID
from strands_robots.tools.networks import stop_and_lock
from strands_robots.utils import ValidationError

ANSWER_S = 10.0
"""Longest wait for the answer to a call that does not wait for a motion."""

POLL_S = 0.2
STOPS_MAX = 3
"""Stops of a motion whose call was given up while its answer is still missing."""

SETTLE_S = 0.5


Held = tuple[str, str]
"""A robot that is held: its id, and its name in a world; empty where it is no world."""


class Caller:
    """One client of the server: the connection of its name, and its leases."""

    def __init__(self, fleet: FleetClient) -> None:
        self.fleet = fleet
        self._leases: dict[Held, str] = {}
        # An emergency stop is never behind another call.
        self._urgent = ThreadPoolExecutor(1, "mcp-estop")

    async def read(self, robot: str, verb: str, params: Mapping[str, Any] | None = None) -> Envelope:
        """Call a verb that moves nothing."""
        try:
            return await self._call(robot, verb, params or {}, ANSWER_S)
        except DeviceTimeoutError as exc:
            return error(str(exc))

    async def move(self, robot: str, verb: str, params: Mapping[str, Any], *, wait: bool) -> Envelope:
        """Carry out a motion of an arm; a call that is given up halts it.

        Without ``wait`` the lease has to be held, whose end halts the robot of a client that went away.
        """
        held = self._meant(robot, str(params.get("robot_name", "")))
        if not wait and held not in self._leases:
            return _needs_lease()
        async with _Halting(self, held) as motion:
            answer = await motion.begin(verb, {**params, "wait": wait}, ANSWER_S + WAIT_S)
            while wait and str(answer.get("task_status", "")).lower() in RUNNING:
                await self._renew(held)
                task = {"task_id": answer.get("task_id", ""), **_named(held)}
                answer = await self._call(robot, "wait", task, ANSWER_S + WAIT_S)
            return answer

    async def run_policy(self, robot: str, params: Mapping[str, Any], *, wait: bool) -> Envelope:
        """Run a policy, to its end with ``wait``; halted and refused as :meth:`move`."""
        held = self._meant(robot, str(params.get("robot_name", "")))
        if not wait and held not in self._leases:
            return _needs_lease()
        async with _Halting(self, held) as motion:
            answer = await motion.begin("execute", params, ANSWER_S)
            while wait and not is_error(answer):
                await asyncio.sleep(POLL_S)
                await self._renew(held)
                answer = await self._call(robot, "getStatus", {}, ANSWER_S)
                if str(answer.get("task_status", "")).lower() not in RUNNING:
                    break
            return answer

    async def stop(self, robot: str, robot_name: str = "") -> Envelope:
        """Stop a robot, or one of a world, without a lease or a wait."""
        try:
            return await self.fleet.stop_async(robot, robot_name=robot_name)
        except ValidationError as refused:
            return error(str(refused), stopped=None)

    async def emergency_stop(self, reason: str) -> Envelope:
        """Stop and lock every robot."""
        loop = asyncio.get_running_loop()
        return await loop.run_in_executor(self._urgent, stop_and_lock, self.fleet, reason)

    async def acquire(self, robot: str, ttl_s: float, robot_name: str) -> Envelope:
        """Acquire the control lease; motions of this client carry it from then on."""
        held = (robot, robot_name)
        params = {"kind": "agent", "ttl_s": ttl_s, **_named(held), **self._lease(self._meant(*held))}
        answer = await self.read(robot, "acquireControl", params)
        if not is_error(answer) and isinstance(answer.get(LEASE_ID), str):
            self._leases[robot, str(answer.get("robot_name", ""))] = answer[LEASE_ID]
        # The secret stays here: a model has no use for it.
        return _without_lease(answer)

    async def release(self, robot: str, robot_name: str) -> Envelope:
        """Give the control lease back."""
        held = self._meant(robot, robot_name)
        if held not in self._leases:
            return error(f"This client holds no lease of {'/'.join(filter(None, held))}.")
        answer = await self.read(robot, "releaseControl", {**self._lease(held), **_named(held)})
        self._leases.pop(held, None)
        return _without_lease(answer)

    async def leave(self) -> None:
        """Halt each robot that is held and release it: the client has gone away."""
        with anyio.CancelScope(shield=True):
            await asyncio.gather(*(self._leave(held) for held in tuple(self._leases)))
        self._urgent.shutdown(wait=False)

    async def _leave(self, held: Held) -> None:
        await self.stop(*held)
        await self.release(*held)

    async def _renew(self, held: Held) -> None:
        if held in self._leases:
            await self.read(held[0], "renewControl", {**self._lease(held), **_named(held)})

    async def _call(self, robot: str, verb: str, params: Mapping[str, Any], seconds: float) -> Envelope:
        try:
            return await self.fleet.call_async(robot, verb, params, seconds)
        except NoSuchDeviceError as exc:
            return error(f"{exc} list_robots names those that there are.")
        except (CallRefusedError, ValidationError, MessagingError) as exc:
            return error(str(exc))

    def _meant(self, robot: str, robot_name: str) -> Held:
        """Return the robot of a world that a call without its name means."""
        mine = [held for held in self._leases if held[0] == robot]
        return mine[0] if not robot_name and len(mine) == 1 else (robot, robot_name)

    def _lease(self, held: Held) -> dict[str, str]:
        return {LEASE_ID: self._leases[held]} if held in self._leases else {}

    def motion(self, held: Held, verb: str, params: Mapping[str, Any], seconds: float) -> asyncio.Task[Envelope]:
        """Start the call that begins a motion, with the lease of the robot if it is held."""
        return asyncio.ensure_future(
            self._call(held[0], verb, {**params, **_named(held), **self._lease(held)}, seconds)
        )


class _Halting:
    """A block that halts the robot when its call is given up."""

    def __init__(self, caller: Caller, held: Held) -> None:
        self._caller, self._held = caller, held
        self._begun: asyncio.Task[Envelope] | None = None

    async def begin(self, verb: str, params: Mapping[str, Any], seconds: float) -> Envelope:
        self._begun = self._caller.motion(self._held, verb, params, seconds)
        # The call goes on when its caller is cancelled: its answer says whether the stop came after the start.
        return await asyncio.shield(self._begun)

    async def __aenter__(self) -> _Halting:
        return self

    async def __aexit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None or self._begun is None:
            return
        with anyio.CancelScope(shield=True):
            for _attempt in range(STOPS_MAX):
                await self._caller.stop(*self._held)
                # A stop may overtake the command that it is meant for, so one more follows until that is answered.
                if (await asyncio.wait([self._begun], timeout=SETTLE_S))[0]:
                    break
            self._begun.cancel()


def _named(held: Held) -> dict[str, str]:
    return {"robot_name": held[1]} if held[1] else {}


def _without_lease(answer: Envelope) -> Envelope:
    return {name: value for name, value in answer.items() if name not in {LEASE_ID, "content"}}


def _needs_lease() -> Envelope:
    return error(
        "wait=false needs acquire_control first: without a lease nothing would halt the robot of a lost client."
    )
