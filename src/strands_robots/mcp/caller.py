"""Calls of one MCP client to robots, halted when they are given up."""

from __future__ import annotations

import asyncio
import secrets
import time
from collections.abc import Awaitable, Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import anyio
from device_connect_edge.messaging import MessagingError

from strands_robots.arm_mixin import WAIT_S
from strands_robots.contract import RUNNING
from strands_robots.device_connect import FleetClient
from strands_robots.device_connect.client import CallRefusedError, DeviceTimeoutError, NoSuchDeviceError
from strands_robots.device_connect.discovery import Peer
from strands_robots.envelope import Envelope, error, is_error, success, text_of
from strands_robots.fleet.device_connect.stops import stop_and_lock, stop_everything
from strands_robots.mcp.queries import NoTurnError, Queries
from strands_robots.safety.scope import EVERY_ROBOT, Scope
from strands_robots.safety.stopping import Outcome, grade
from strands_robots.serving.advertised import AdvertisedVerb, find_verb
from strands_robots.serving.verbs import LEASE_ID, LEASE_NAMES, LEASE_TTL_S, TTL_MAX_S, TTL_MIN_S
from strands_robots.utils import ValidationError, number

ANSWER_S = 10.0
"""Longest wait for the answer to a call that does not wait for a motion."""

POLL_S = 0.2
STOPS_MAX = 3
"""Stops of a motion whose call was given up while its answer is still missing."""

SETTLE_S = 0.5

SILENCE_S = 5.0
"""Seconds after the server's last renewal at which a robot halts what the server began, as after its SIGKILL."""

RENEWALS = 4
"""Renewals of a lease in its time at the robot."""

RENEWED_S = 2.0
"""Longest wait for the answer to a renewal: the next one is in time even so."""

URGENT_MAX = 8
"""Stops of all robots that one client has running at once."""

OVER = frozenset({"displaced", "lease_over", "not_holder"})
"""Answers to a renewal after which the lease is another's, or nobody's."""

Target = tuple[str, str]
"""A robot's id, and the name of one robot of its world or nothing."""


@dataclass
class _Held:
    lease_id: str
    ttl_s: float
    renewing: asyncio.Task[None] | None = None
    live: bool = True

    def end(self) -> None:
        """Renew it no more."""
        if self.renewing is not None and self.renewing is not asyncio.current_task():
            self.renewing.cancel()


class Caller:
    """One client of the server: the connection of its name, and its leases.

    Args:
        present: whether the client is there now; its leases are renewed as long as it is.
    """

    def __init__(self, fleet: FleetClient, present: Callable[[], bool] = lambda: True) -> None:
        self.fleet = fleet
        self._present = present
        self._leases: dict[Target, _Held] = {}
        self._first: dict[str, str] = {}
        self._moving: set[_Halting] = set()
        self._secrets: dict[str, str] = {}
        self._binding: set[tuple[str, str]] = set()
        self._used_at = time.monotonic()
        self._queries = Queries()
        # An emergency stop is never behind another call, nor behind the one before it.
        self._urgent = ThreadPoolExecutor(URGENT_MAX, "mcp-estop")

    def used(self) -> None:
        """Note a call of the client; it is there, so its leases are renewed."""
        self._used_at = time.monotonic()

    async def read(
        self, robot: str, verb: str, params: Mapping[str, Any] | None = None, lasts_s: float = 0.0
    ) -> Envelope:
        """Call a verb that moves nothing, and may last so long."""
        try:
            return await self._call(robot, verb, params or {}, ANSWER_S + lasts_s)
        except DeviceTimeoutError as exc:
            return error(str(exc))

    async def query(
        self, robot: str, verb: str, params: Mapping[str, Any] | None = None, lasts_s: float = 0.0
    ) -> Envelope:
        """Do as :meth:`read`, in the client's turn: no burst of reads fills the robot."""
        try:
            async with self._queries.turn(robot, ANSWER_S):
                return await self.read(robot, verb, params, lasts_s)
        except NoTurnError as refused:
            return error(str(refused))

    async def describe(self, robot: str) -> Peer | Envelope:
        """Return a robot as it describes itself now, or why it does not."""
        description = await self.read(robot, "requestRegistration")
        return description if is_error(description) else Peer.of(description)

    async def move(self, robot: str, verb: str, params: Mapping[str, Any], *, wait: bool) -> Envelope:
        """Carry out a motion of an arm; a call that is given up halts it.

        Without ``wait`` the lease has to be held, whose end halts the robot of a client that went away.
        """
        target = await self._target(robot, params)
        if not wait and not self._holds(target):
            return _needs_lease()
        lease = await self._for_motion(target, verb)
        arguments = {**move_arguments(params, wait=wait), **lease}

        async def to_the_end(motion: _Halting) -> Envelope:
            answer = await motion.begin(verb, arguments, ANSWER_S + WAIT_S)
            while wait and str(answer.get("task_status", "")).lower() in RUNNING:
                task = {"task_id": answer.get("task_id", ""), **_named(params)}
                answer = await self._followed(robot, "wait", task, ANSWER_S + WAIT_S)
            return answer

        return await self._halting(target, lease, to_the_end)

    async def run_policy(self, robot: str, params: Mapping[str, Any], *, wait: bool) -> Envelope:
        """Run a policy, to its end with ``wait``; halted and refused as :meth:`move`."""
        target = await self._target(robot, params)
        if not wait and not self._holds(target):
            return _needs_lease()
        lease = await self._for_motion(target, "execute")

        async def to_the_end(motion: _Halting) -> Envelope:
            answer = await motion.begin("execute", {**params, **lease}, ANSWER_S)
            one = str(answer.get("robot_name") or params.get("robot_name") or "")
            while wait and not is_error(answer):
                await asyncio.sleep(POLL_S)
                answer = await self._followed(robot, "getStatus", {}, ANSWER_S)
                if not runs(answer, one):
                    break
            return answer

        return await self._halting(target, lease, to_the_end)

    async def act(self, robot: str, verb: AdvertisedVerb, params: Mapping[str, Any]) -> Envelope:
        """Carry out a verb as the robot describes it, to its end; halted as :meth:`move`."""
        target = await self._target(robot, params)
        lease = self._lease_of(target, verb.leases)

        async def to_the_end(motion: _Halting) -> Envelope:
            answer = await motion.begin(verb.name, {**params, **lease}, ANSWER_S + verb.lasts_s)
            status = answer
            # Where its answer says that it goes on, as that of a drive does, the end is waited for.
            while verb.leases and not is_error(status) and runs(status, ""):
                await asyncio.sleep(POLL_S)
                status = await self._followed(robot, "getStatus", {}, ANSWER_S)
            return status if is_error(status) else answer

        return await self._halting(target, lease, to_the_end)

    async def acquire(self, robot: str, ttl_s: float, robot_name: str) -> Envelope:
        """Acquire the control lease; motions of this client carry it from then on.

        Args:
            ttl_s: seconds for which it lasts after the client's last call, while the client is not there.
        """
        try:
            lasts = number("ttl_s", ttl_s, low=TTL_MIN_S, high=TTL_MAX_S)
        except ValidationError as refused:
            return error(str(refused))
        target = await self._target(robot, {"robot_name": robot_name}, leased=True)
        at_robot = min(lasts, SILENCE_S)
        params = acquire_arguments(lasts, robot_name)
        # While a motion of its own runs, the secret of that motion says that the robot is this client's.
        moves = any(each.target[0] == robot for each in self._moving)
        own = self._lease(target) or ({LEASE_ID: self._secret(robot)} if moves else {})
        answer = await self.read(robot, "acquireControl", {**params, **own})
        lease_id = answer.get(LEASE_ID)
        # The secret stays here: a model has no use for it.
        told = {name: value for name, value in answer.items() if name != LEASE_ID}
        if is_error(answer) or not isinstance(lease_id, str):
            return told
        one = robot, str(answer.get("robot_name", target[1]))
        self._forget(one)
        held = self._leases[one] = _Held(lease_id, lasts)
        held.renewing = asyncio.ensure_future(self._keep(one, held, at_robot / RENEWALS))
        return {**told, **success(f"Held until it is released, or {lasts:g} s after this client went away.")} | {
            "expires_in_s": lasts
        }

    async def release(self, robot: str, robot_name: str) -> Envelope:
        """Give the control lease back."""
        target = await self._target(robot, {"robot_name": robot_name})
        if target not in self._leases:
            return error(f"This client holds no lease of {robot}.")
        answer = await self.read(robot, "releaseControl", {**self._lease(target), **_world(target)})
        self._forget(target)
        return answer

    async def stop(self, robot: str, robot_name: str = "") -> Envelope:
        """Stop a robot, one of a world, or all robots, without a lease or a wait."""
        if not robot:
            loop = asyncio.get_running_loop()
            return await loop.run_in_executor(self._urgent, stop_everything, self.fleet)
        try:
            return await self.fleet.stop_async(robot, robot_name=robot_name)
        except ValidationError as refused:
            return error(str(refused), stopped=None)

    async def emergency_stop(self, reason: str, scope: Scope = EVERY_ROBOT) -> Envelope:
        """Stop and lock every robot, or those of ``scope``."""
        loop = asyncio.get_running_loop()
        return await loop.run_in_executor(self._urgent, stop_and_lock, self.fleet, reason, scope)

    async def leave(self) -> None:
        """Halt what this client moves and holds, and release it."""
        for each in self._leases.values():
            each.end()
        with anyio.CancelScope(shield=True):
            held = tuple(self._leases)
            await asyncio.gather(*(self.stop(*target) for target in {*held, *(each.target for each in self._moving)}))
            await asyncio.gather(*(self.release(*target) for target in held))

    def close(self) -> None:
        """End the thread of the emergency stop."""
        self._urgent.shutdown(wait=False)

    def motion(self, robot: str, verb: str, params: Mapping[str, Any], seconds: float) -> asyncio.Task[Envelope]:
        """Start the call that begins a motion."""
        return asyncio.ensure_future(self._call(robot, verb, params, seconds))

    def watch(self, motion: _Halting, *, ended: bool) -> None:
        """Keep a motion among those that :meth:`leave` halts."""
        (self._moving.discard if ended else self._moving.add)(motion)

    async def _halting(
        self, target: Target, lease: Mapping[str, Any], work: Callable[[_Halting], Awaitable[Envelope]]
    ) -> Envelope:
        halting = _Halting(self, target)
        renewing = asyncio.ensure_future(self._renew_motion(target)) if LEASE_TTL_S in lease else None
        try:
            async with halting as motion:
                return await work(motion)
        except (DeviceTimeoutError, NoSuchDeviceError, MessagingError) as exc:
            confirmed = f", which is not confirmed: {halting.moves}" if halting.moves else "."
            return error(f"{exc} What the call began was told to stop{confirmed}")
        finally:
            if renewing is not None:
                renewing.cancel()

    async def _renew_motion(self, target: Target) -> None:
        """Renew the lease of one motion until its call ends."""
        while True:
            await asyncio.sleep(SILENCE_S / RENEWALS)
            await self._renewed(target, self._secret(target[0]))

    async def _keep(self, target: Target, held: _Held, every_s: float) -> None:
        """Renew a held lease while its client is there, and its time after."""
        while self._present() or time.monotonic() - self._used_at < held.ttl_s:
            await asyncio.sleep(every_s)
            if await self._renewed(target, held.lease_id) in OVER:
                # A motion carries it all the same: the robot's refusal says who has taken control.
                held.live = False
                return
        await self.stop(*target)
        await self.release(*target)

    async def _renewed(self, target: Target, lease_id: str) -> str:
        """Renew a lease at the robot; return the code of its refusal, or nothing."""
        try:
            answer = await self._call(target[0], "renewControl", {LEASE_ID: lease_id, **_world(target)}, RENEWED_S)
        except DeviceTimeoutError:
            return ""
        return str(answer.get("code", ""))

    async def _target(self, robot: str, params: Mapping[str, Any], *, leased: bool = False) -> Target:
        """Return the robot that is meant, of a world the first where none is named."""
        stated = params.get("robot_name", "")
        name = stated if isinstance(stated, str) else ""
        if name or not (leased or any(each == robot for each, _ in self._leases)):
            return robot, name
        if robot not in self._first:
            status = await self.read(robot, "getStatus")
            names = status.get("robots")
            if not is_error(status):
                self._first[robot] = str(next(iter(names), "")) if isinstance(names, Mapping) else ""
        return robot, self._first.get(robot, "")

    async def _call(self, robot: str, verb: str, params: Mapping[str, Any], seconds: float) -> Envelope:
        try:
            return await self.fleet.call_async(robot, verb, params, seconds)
        except NoSuchDeviceError as exc:
            return error(f"{exc} list_robots names those that there are.")
        except (CallRefusedError, ValidationError, MessagingError) as exc:
            return error(str(exc))

    async def _followed(self, robot: str, verb: str, params: Mapping[str, Any], seconds: float) -> Envelope:
        """Ask about a motion that was begun; no answer ends its block, which halts it."""
        try:
            return await self.fleet.call_async(robot, verb, params, seconds)
        except (CallRefusedError, ValidationError) as exc:
            return error(str(exc))

    def _holds(self, target: Target) -> bool:
        held = self._leases.get(target)
        return held is not None and held.live

    def _lease(self, target: Target) -> dict[str, str]:
        held = self._leases.get(target)
        return {} if held is None else {LEASE_ID: held.lease_id}

    async def _for_motion(self, target: Target, verb: str) -> dict[str, Any]:
        """Return the held lease, or one for this motion where the robot knows such."""
        if (robot := target[0], verb) not in self._binding and not self._lease(target):
            description = await self.describe(robot)
            published = find_verb(description.functions, verb) if isinstance(description, Peer) else None
            if isinstance(description, Peer) and LEASE_TTL_S not in (published.leases if published else ()):
                return {}
            # One that did not answer is asked again.
            if published is not None:
                self._binding.add((robot, verb))
        return self._lease_of(target, LEASE_NAMES)

    def _lease_of(self, target: Target, takes: frozenset[str]) -> dict[str, Any]:
        """Return the held lease, or one for this motion, as far as the verb takes it."""
        held = self._lease(target)
        if held:
            return held if LEASE_ID in takes else {}
        return {LEASE_ID: self._secret(target[0]), LEASE_TTL_S: SILENCE_S} if LEASE_TTL_S in takes else {}

    def _secret(self, robot: str) -> str:
        return self._secrets.setdefault(robot, secrets.token_hex(16))

    def _forget(self, target: Target) -> None:
        held = self._leases.pop(target, None)
        if held is not None:
            held.end()


class _Halting:
    """A block that halts the robot when its call is given up."""

    def __init__(self, caller: Caller, target: Target) -> None:
        self.target = target
        self.moves = ""
        """Why the robot may still move after the halt; empty once it has confirmed its stop."""
        self._caller = caller
        self._begun: asyncio.Task[Envelope] | None = None

    async def begin(self, verb: str, params: Mapping[str, Any], seconds: float) -> Envelope:
        self._begun = self._caller.motion(self.target[0], verb, params, seconds)
        self._caller.watch(self, ended=False)
        # The call goes on when its caller is cancelled: its answer says whether the stop came after the start.
        return await asyncio.shield(self._begun)

    async def __aenter__(self) -> _Halting:
        return self

    async def __aexit__(self, kind: type[BaseException] | None, *_: object) -> None:
        try:
            if kind is not None and self._begun is not None:
                await self._halt(self._begun)
        finally:
            self._caller.watch(self, ended=True)

    async def _halt(self, begun: asyncio.Task[Envelope]) -> None:
        with anyio.CancelScope(shield=True):
            for _attempt in range(STOPS_MAX):
                answered = begun.done()
                stop = await self._caller.stop(*self.target)
                self.moves = "" if grade(stop) is Outcome.STOPPED else text_of(stop)
                # A stop may overtake the command that it is meant for, so one more follows until that is answered.
                if answered and not self.moves:
                    break
                await (asyncio.sleep(SETTLE_S) if answered else asyncio.wait([begun], timeout=SETTLE_S))
            begun.cancel()


def runs(status: Envelope, robot_name: str) -> bool:
    """True while the robot, or the named robot of a world, runs a policy."""
    policies = status.get("running_policies")
    if isinstance(policies, Mapping):
        return robot_name in policies if robot_name else bool(policies)
    return str(status.get("task_status", "")).lower() in RUNNING


def move_arguments(params: Mapping[str, Any], *, wait: bool) -> dict[str, Any]:
    """Return the arguments of an arm's motion, as a robot gets them."""
    return {**params, "wait": wait}


def acquire_arguments(ttl_s: float, robot_name: str) -> dict[str, Any]:
    """Return the arguments of ``acquireControl``, as a robot gets them."""
    return {"kind": "agent", "ttl_s": min(ttl_s, SILENCE_S), **({"robot_name": robot_name} if robot_name else {})}


def _named(params: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in params.items() if name == "robot_name"}


def _world(target: Target) -> dict[str, str]:
    return {"robot_name": target[1]} if target[1] else {}


def _needs_lease() -> Envelope:
    return error(
        "wait=false needs acquire_control first: without a lease nothing would halt the robot of a lost client."
    )
