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


class Caller:
    """One client of the server: the connection of its name, and its leases."""

    def __init__(self, fleet: FleetClient) -> None:
        self.fleet = fleet
        self._leases: dict[str, str] = {}
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
        if not wait and robot not in self._leases:
            return _needs_lease()
        async with _Halting(self, robot) as motion:
            answer = await motion.begin(verb, {**params, "wait": wait}, ANSWER_S + WAIT_S)
            while wait and str(answer.get("task_status", "")).lower() in RUNNING:
                await self._renew(robot)
                task = {"task_id": answer.get("task_id", ""), **_named(params)}
                answer = await self._call(robot, "wait", task, ANSWER_S + WAIT_S)
            return answer

    async def run_policy(self, robot: str, params: Mapping[str, Any], *, wait: bool) -> Envelope:
        """Run a policy, to its end with ``wait``; halted and refused as :meth:`move`."""
        if not wait and robot not in self._leases:
            return _needs_lease()
        async with _Halting(self, robot) as motion:
            answer = await motion.begin("execute", params, ANSWER_S)
            while wait and not is_error(answer):
                await asyncio.sleep(POLL_S)
                await self._renew(robot)
                answer = await self._call(robot, "getStatus", {}, ANSWER_S)
                if str(answer.get("task_status", "")).lower() not in RUNNING:
                    break
            return answer

    async def stop(self, robot: str) -> Envelope:
        """Stop a robot; it needs no lease and waits for no other call."""
        try:
            return await self.fleet.stop_async(robot)
        except ValidationError as refused:
            return error(str(refused), stopped=None)

    async def emergency_stop(self, reason: str) -> Envelope:
        """Stop and lock every robot."""
        loop = asyncio.get_running_loop()
        return await loop.run_in_executor(self._urgent, stop_and_lock, self.fleet, reason)

    async def acquire(self, robot: str, ttl_s: float, robot_name: str) -> Envelope:
        """Acquire the control lease; motions of this client carry it from then on."""
        params = {"kind": "agent", "ttl_s": ttl_s, **({"robot_name": robot_name} if robot_name else {})}
        answer = await self.read(robot, "acquireControl", {**params, **self._lease(robot)})
        if not is_error(answer) and isinstance(answer.get(LEASE_ID), str):
            self._leases[robot] = answer[LEASE_ID]
        # The secret stays here: a model has no use for it.
        return _without_lease(answer)

    async def release(self, robot: str, robot_name: str) -> Envelope:
        """Give the control lease back."""
        if robot not in self._leases:
            return error(f"This client holds no lease of {robot}.")
        params = {**self._lease(robot), **({"robot_name": robot_name} if robot_name else {})}
        answer = await self.read(robot, "releaseControl", params)
        self._leases.pop(robot, None)
        return _without_lease(answer)

    async def leave(self) -> None:
        """Halt each robot that is held and release it: the client has gone away."""
        with anyio.CancelScope(shield=True):
            await asyncio.gather(*(self._leave(robot) for robot in tuple(self._leases)))
        self._urgent.shutdown(wait=False)

    async def _leave(self, robot: str) -> None:
        await self.stop(robot)
        await self.release(robot, "")

    async def _renew(self, robot: str) -> None:
        if robot in self._leases:
            await self.read(robot, "renewControl", self._lease(robot))

    async def _call(self, robot: str, verb: str, params: Mapping[str, Any], seconds: float) -> Envelope:
        try:
            return await self.fleet.call_async(robot, verb, params, seconds)
        except NoSuchDeviceError as exc:
            return error(f"{exc} list_robots names those that there are.")
        except (CallRefusedError, ValidationError, MessagingError) as exc:
            return error(str(exc))

    def _lease(self, robot: str) -> dict[str, str]:
        return {LEASE_ID: self._leases[robot]} if robot in self._leases else {}

    def motion(self, robot: str, verb: str, params: Mapping[str, Any], seconds: float) -> asyncio.Task[Envelope]:
        """Start the call that begins a motion, with the lease of the robot if it is held."""
        return asyncio.ensure_future(self._call(robot, verb, {**params, **self._lease(robot)}, seconds))


class _Halting:
    """A block that halts the robot when its call is given up."""

    def __init__(self, caller: Caller, robot: str) -> None:
        self._caller, self._robot = caller, robot
        self._begun: asyncio.Task[Envelope] | None = None

    async def begin(self, verb: str, params: Mapping[str, Any], seconds: float) -> Envelope:
        self._begun = self._caller.motion(self._robot, verb, params, seconds)
        # The call goes on when its caller is cancelled: its answer says whether the stop came after the start.
        return await asyncio.shield(self._begun)

    async def __aenter__(self) -> _Halting:
        return self

    async def __aexit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None or self._begun is None:
            return
        with anyio.CancelScope(shield=True):
            for _attempt in range(STOPS_MAX):
                await self._caller.stop(self._robot)
                # A stop may overtake the command that it is meant for, so one more follows until that is answered.
                if (await asyncio.wait([self._begun], timeout=SETTLE_S))[0]:
                    break
            self._begun.cancel()


def _named(params: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in params.items() if name == "robot_name"}


def _without_lease(answer: Envelope) -> Envelope:
    return {name: value for name, value in answer.items() if name not in {LEASE_ID, "content"}}


def _needs_lease() -> Envelope:
    return error(
        "wait=false needs acquire_control first: without a lease nothing would halt the robot of a lost client."
    )
