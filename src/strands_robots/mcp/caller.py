"""Calls of one MCP client to robots, halted when they are given up."""

from __future__ import annotations

import asyncio
import contextlib
import os
import secrets
import tempfile
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import anyio

from strands_robots.arm_mixin import WAIT_S
from strands_robots.contract import RUNNING
from strands_robots.envelope import Envelope, error, is_error, success, text_of
from strands_robots.errors import NoAnswerError, NoSuchRobotError, RefusalError, StrandsRobotsError, UnreachableError
from strands_robots.fleet.adapter import FoundRobot, NetworkAdapter, ReceivedCall, StopRequest
from strands_robots.fleet.networks import Networks
from strands_robots.fleet.reports import LEASE_CODES, runs, said
from strands_robots.fleet.stops import answer_of, estop_all, stop_all
from strands_robots.fleet.verdicts import FleetVerdict, answer_of_bearers
from strands_robots.mcp.results import refused
from strands_robots.safety.scope import EVERY_ROBOT, Scope
from strands_robots.safety.stopping import Outcome, grade
from strands_robots.serving.advertised import AdvertisedVerb, find_verb
from strands_robots.serving.verbs import LEASE_ID, LEASE_NAMES, LEASE_TTL_S, TTL_MAX_S, TTL_MIN_S
from strands_robots.utils import ValidationError, number

AT_ONCE = 8
"""Reads of one client that a robot has at a time; it carries out four."""

WAITING_MAX = 1024
"""Reads of one client that wait for a turn, of all robots together."""

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

RUN_POLICY = "execute"
"""Verb that runs a policy and answers at its start; some networks call it otherwise."""

NEEDS_LEASE = "wait=false needs acquire_control first: without a lease nothing would halt the robot of a lost client."

OUT_OF_SIGHT = (NoAnswerError, NoSuchRobotError, UnreachableError)
"""Refusals after which nobody knows what the robot does."""

Target = tuple[str, str]
"""A robot's id, and the name of one robot of its world or nothing."""


class NoTurnError(StrandsRobotsError, RuntimeError):
    """A read got no turn in its time, or too many wait; the text says which."""


@dataclass(slots=True)
class _RobotReads:
    turns: asyncio.Semaphore = field(default_factory=lambda: asyncio.Semaphore(AT_ONCE))
    number: int = 0


class Queries:
    """Reads of one client that run or wait.

    A robot has room for a few dozen reads of all its callers together and refuses the next one. A client that asks a
    hundred at once therefore has them sent a few at a time, and leaves the rest of the room to others.
    """

    def __init__(self) -> None:
        self._robots: dict[str, _RobotReads] = {}
        self._waiting = 0

    @asynccontextmanager
    async def turn(self, robot: str, within: float) -> AsyncIterator[None]:
        """Wait for a turn at a robot, and keep it for the length of the block.

        Raises:
            NoTurnError: none within ``within`` seconds, or too many reads wait.
        """
        if self._waiting >= WAITING_MAX:
            raise NoTurnError(f"{WAITING_MAX} reads of this client wait already; try again later.")
        # A name is forgotten with its last read, so that made-up ones take no memory.
        robot_reads = self._robots.setdefault(robot, _RobotReads())
        robot_reads.number += 1
        try:
            await self._turn_of(robot_reads, within)
            try:
                yield
            finally:
                robot_reads.turns.release()
        finally:
            robot_reads.number -= 1
            if not robot_reads.number:
                del self._robots[robot]

    async def _turn_of(self, robot_reads: _RobotReads, within: float) -> None:
        self._waiting += 1
        try:
            async with asyncio.timeout(within):
                await robot_reads.turns.acquire()
        except TimeoutError:
            raise NoTurnError(f"The robot did not answer this client's earlier reads within {within:g} s.") from None
        finally:
            self._waiting -= 1


@dataclass(frozen=True)
class ClientAccess:
    """One client as the tools see it.

    Attributes:
        approves: whether the yes of the client's user is the operator's approval of a motion.
        show_picture: makes a JPEG readable for that user and returns its address.
    """

    caller: Caller
    approves: bool
    show_picture: Callable[[bytes], str]


AccessOf = Callable[[Any], ClientAccess]
"""Returns the access of the client that sent a request."""


class PictureFiles:
    """Pictures for a user on this machine, as files; the newest ones are kept."""

    FILES_MAX = 8

    def __init__(self) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="strands-robots-mcp-")
        self._files: list[Path] = []

    def show(self, jpeg: bytes) -> str:
        """Write a picture; return its address."""
        descriptor, name = tempfile.mkstemp(suffix=".jpg", dir=self._folder.name)
        with os.fdopen(descriptor, "wb") as file:
            file.write(jpeg)
        path = Path(name)
        self._files.append(path)
        while len(self._files) > self.FILES_MAX:
            self._files.pop(0).unlink(missing_ok=True)
        return path.as_uri()

    def close(self) -> None:
        """Remove the files."""
        self._folder.cleanup()


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
    """One client of the server: the networks under its name, and its leases.

    Args:
        networks: opened ones.
        present: whether the client is there now; its leases are renewed as long as it is.
    """

    def __init__(self, networks: Networks, present: Callable[[], bool] = lambda: True) -> None:
        self.networks = networks
        self._present = present
        self._leases: dict[Target, _Held] = {}
        self._first: dict[str, str] = {}
        self._moving: dict[asyncio.Task[Envelope], Target] = {}
        self._secrets: dict[str, str] = {}
        self._binding: set[tuple[str, str]] = set()
        self._used_at = time.monotonic()
        self._queries = Queries()
        # An emergency stop is never behind another call, nor behind the one before it.
        self._urgent = ThreadPoolExecutor(URGENT_MAX, "mcp-estop")

    def used(self) -> None:
        """Note a call of the client; it is there, so its leases are renewed."""
        self._used_at = time.monotonic()

    async def call(
        self,
        robot: str,
        verb: str,
        params: Mapping[str, Any] | None = None,
        seconds: float = ANSWER_S,
        *,
        moves: bool = False,
        lost: tuple[type[RefusalError], ...] = (),
    ) -> Envelope:
        """Call a verb; a refusal is an answer, one of ``lost`` is raised."""
        try:
            return await self.networks.called_on(
                robot,
                verb,
                lambda network: network.call_async(robot, _named_on(network, verb), params or {}, seconds),
                moves=moves,
            )
        except lost:
            raise
        except RefusalError as refusal:
            return refused(refusal)

    async def query(
        self, robot: str, verb: str, params: Mapping[str, Any] | None = None, lasts_s: float = 0.0
    ) -> Envelope:
        """Call a read in the client's turn, so that no burst of reads fills the robot.

        It may last ``lasts_s`` seconds besides the usual time of an answer.
        """
        try:
            async with self._queries.turn(robot, ANSWER_S):
                return await self.call(robot, verb, params, ANSWER_S + lasts_s)
        except NoTurnError as refused:
            return error(str(refused))

    async def describe(self, robot: str) -> FoundRobot:
        """Return a robot as it describes itself now.

        Raises:
            RefusalError: it does not.
        """
        return await (await self.networks.of_async(robot)).describe_async(robot, ANSWER_S)

    async def received(self, robot: str, verb: str, params: Mapping[str, Any]) -> ReceivedCall:
        """Return a motion as its robot receives it; raises as :meth:`Networks.of`."""
        network = await self.networks.of_async(robot, verb, moves=True)
        return network.received(robot, _named_on(network, verb), params)

    async def move(self, robot: str, verb: str, params: Mapping[str, Any]) -> Envelope:
        """Carry out a motion of an arm; a call that is given up halts it.

        With ``wait`` it is followed to its end. Without it the lease has to be held, whose end halts the robot of a
        client that went away.
        """
        named = {name: value for name, value in params.items() if name == "robot_name"}

        async def ended(answer: Envelope) -> Envelope:
            while str(answer.get("task_status", "")).lower() in RUNNING:
                task = {"task_id": answer.get("task_id", ""), **named}
                answer = await self.call(robot, "wait", task, ANSWER_S + WAIT_S, lost=OUT_OF_SIGHT)
            return answer

        return await self._carried_out(robot, verb, params, ANSWER_S + WAIT_S, ended if params["wait"] else None)

    async def run_policy(self, robot: str, params: Mapping[str, Any], *, wait: bool) -> Envelope:
        """Run a policy, to its end with ``wait``; halted and refused as :meth:`move`."""

        async def ended(answer: Envelope) -> Envelope:
            one = str(answer.get("robot_name") or params.get("robot_name") or "")
            while not is_error(answer):
                await asyncio.sleep(POLL_S)
                answer = await self.call(robot, "getStatus", lost=OUT_OF_SIGHT)
                if not runs(answer, one):
                    break
            return answer

        return await self._carried_out(robot, RUN_POLICY, params, ANSWER_S, ended if wait else None)

    async def act(self, robot: str, verb: AdvertisedVerb, params: Mapping[str, Any]) -> Envelope:
        """Carry out a verb as the robot describes it, to its end; halted as :meth:`move`."""

        async def ended(answer: Envelope) -> Envelope:
            status = answer
            # Where its answer says that it goes on, as that of a drive does, the end is waited for.
            while verb.leases and not is_error(status) and runs(status):
                await asyncio.sleep(POLL_S)
                status = await self.call(robot, "getStatus", lost=OUT_OF_SIGHT)
            return status if is_error(status) else answer

        return await self._carried_out(robot, verb.name, params, ANSWER_S + verb.lasts_s, ended, takes=verb.leases)

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
        moves = any(each == robot for each, _ in self._moving.values())
        lease = self._lease(target) or ({LEASE_ID: self._secret(robot)} if moves else {})
        answer = await self.call(robot, "acquireControl", {**params, **lease}, moves=True)
        lease_id = answer.get(LEASE_ID)
        # The secret stays here: a model has no use for it.
        fields = {name: value for name, value in answer.items() if name != LEASE_ID}
        if is_error(answer) or not isinstance(lease_id, str):
            return fields
        one = robot, str(answer.get("robot_name", target[1]))
        self._forget(one)
        held = self._leases[one] = _Held(lease_id, lasts)
        held.renewing = asyncio.ensure_future(self._keep(one, held, at_robot / RENEWALS))
        return {**fields, **success(f"Held until it is released, or {lasts:g} s after this client went away.")} | {
            "expires_in_s": lasts
        }

    async def release(self, robot: str, robot_name: str) -> Envelope:
        """Give the control lease back."""
        target = await self._target(robot, {"robot_name": robot_name})
        if target not in self._leases:
            return error(f"This client holds no lease of {robot}.")
        answer = await self.call(robot, "releaseControl", {**self._lease(target), **_world(target)})
        self._forget(target)
        return answer

    async def stop(self, robot: str, robot_name: str = "") -> Envelope:
        """Stop a robot, one of a world, or all robots, without a lease or a wait."""
        if not robot:
            return await self._urgently(lambda: stop_all(self.networks))
        answers = await self.networks.stop_async(robot, robot_name=robot_name)
        return answer_of_bearers(robot, answers, self.networks.absences)

    async def emergency_stop(self, reason: str, scope: Scope = EVERY_ROBOT) -> Envelope:
        """Stop and lock every robot, or those of ``scope``."""
        return await self._urgently(lambda: estop_all(self.networks, StopRequest(reason, scope)))

    async def _urgently(self, stop: Callable[[], FleetVerdict]) -> Envelope:
        verdict = await asyncio.get_running_loop().run_in_executor(self._urgent, stop)
        return answer_of(verdict, self.networks)

    async def leave(self) -> None:
        """Halt what this client moves and holds, and release it."""
        for each in self._leases.values():
            each.end()
        with anyio.CancelScope(shield=True):
            held = tuple(self._leases)
            await asyncio.gather(*(self.stop(*target) for target in {*held, *self._moving.values()}))
            await asyncio.gather(*(self.release(*target) for target in held))

    def close(self) -> None:
        """End the thread of the emergency stop."""
        self._urgent.shutdown(wait=False)

    async def _carried_out(
        self,
        robot: str,
        verb: str,
        params: Mapping[str, Any],
        seconds: float,
        ended: Callable[[Envelope], Awaitable[Envelope]] | None,
        *,
        takes: frozenset[str] | None = None,
    ) -> Envelope:
        """Carry out a motion; halt it where it is given up or out of sight.

        ``ended`` waits for the end of what the answer says, None for no end; ``takes`` names the lease's parameters
        that the verb takes, for which the robot is asked by default.
        """
        target = await self._target(robot, params)
        if ended is None and not self._holds(target):
            return error(NEEDS_LEASE)
        lease = await self._for_motion(target, verb) if takes is None else self._lease_of(target, takes)
        call = self.call(robot, verb, {**params, **lease}, seconds, moves=True, lost=(NoAnswerError,))
        begun = asyncio.ensure_future(call)
        renewing = asyncio.ensure_future(self._renew_motion(target)) if LEASE_TTL_S in lease else None
        self._moving[begun] = target
        try:
            # The call goes on when its caller is cancelled: its answer says whether the stop came after the start.
            answer = await asyncio.shield(begun)
            return answer if ended is None else await ended(answer)
        except BaseException as given_up:
            moves = await self._halt(target, begun)
            if not isinstance(given_up, OUT_OF_SIGHT):
                raise
            confirmed = f", which is not confirmed: {moves}" if moves else "."
            return error(f"{said(given_up)} What the call began was told to stop{confirmed}")
        finally:
            del self._moving[begun]
            if renewing is not None:
                renewing.cancel()

    async def _halt(self, target: Target, begun: asyncio.Task[Envelope]) -> str:
        """Stop what a call began; return why it may still move, or ""."""
        moves = ""
        with anyio.CancelScope(shield=True):
            for _attempt in range(STOPS_MAX):
                is_answered = begun.done()
                stop = await self.stop(*target)
                moves = "" if grade(stop) is Outcome.STOPPED else text_of(stop)
                # A stop may overtake the command that it is meant for, so one more follows until that is answered.
                if is_answered and not moves:
                    break
                await (asyncio.sleep(SETTLE_S) if is_answered else asyncio.wait([begun], timeout=SETTLE_S))
            begun.cancel()
        return moves

    async def _renew_motion(self, target: Target) -> None:
        """Renew the lease of one motion until its call ends."""
        while True:
            await asyncio.sleep(SILENCE_S / RENEWALS)
            await self._renewed(target, self._secret(target[0]))

    async def _keep(self, target: Target, held: _Held, every_s: float) -> None:
        """Renew a held lease while its client is there, and its time after."""
        while self._present() or time.monotonic() - self._used_at < held.ttl_s:
            await asyncio.sleep(every_s)
            if await self._renewed(target, held.lease_id) in LEASE_CODES:
                # A motion carries it all the same: the robot's refusal says who has taken control.
                held.live = False
                return
        await self.stop(*target)
        await self.release(*target)

    async def _renewed(self, target: Target, lease_id: str) -> str:
        """Renew a lease at the robot; return the code of its refusal, or nothing."""
        params = {LEASE_ID: lease_id, **_world(target)}
        return str((await self.call(target[0], "renewControl", params, RENEWED_S)).get("code", ""))

    async def _target(self, robot: str, params: Mapping[str, Any], *, leased: bool = False) -> Target:
        """Return the robot that is meant, of a world the first where none is named."""
        stated = params.get("robot_name", "")
        name = stated if isinstance(stated, str) else ""
        if name or not (leased or any(each == robot for each, _ in self._leases)):
            return robot, name
        if robot not in self._first:
            status = await self.call(robot, "getStatus")
            names = status.get("robots")
            if not is_error(status):
                self._first[robot] = str(next(iter(names), "")) if isinstance(names, Mapping | list) else ""
        return robot, self._first.get(robot, "")

    def _holds(self, target: Target) -> bool:
        held = self._leases.get(target)
        return held is not None and held.live

    def _lease(self, target: Target) -> dict[str, str]:
        held = self._leases.get(target)
        return {} if held is None else {LEASE_ID: held.lease_id}

    async def _for_motion(self, target: Target, verb: str) -> dict[str, Any]:
        """Return the held lease, or one for this motion where the robot knows such."""
        if (robot := target[0], verb) not in self._binding and not self._lease(target):
            # One that does not answer is asked again.
            with contextlib.suppress(RefusalError):
                published = find_verb((await self.describe(robot)).functions, verb)
                if published is None or LEASE_TTL_S not in published.leases:
                    return {}
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


def _named_on(network: NetworkAdapter, verb: str) -> str:
    return network.starts if verb == RUN_POLICY else verb


def acquire_arguments(ttl_s: float, robot_name: str) -> dict[str, Any]:
    """Return the arguments of ``acquireControl``, as a robot gets them."""
    return {"kind": "agent", "ttl_s": min(ttl_s, SILENCE_S), **({"robot_name": robot_name} if robot_name else {})}


def _world(target: Target) -> dict[str, str]:
    return {"robot_name": target[1]} if target[1] else {}
