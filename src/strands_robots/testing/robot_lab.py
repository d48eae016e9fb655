"""Simulated robots on a network of one process, with faults."""

from __future__ import annotations

import asyncio
import sys
import threading
import time
from collections.abc import Awaitable, Callable, Coroutine, Iterable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from typing import Any, Self, TypeVar

from strands_robots import settings
from strands_robots.device_connect import FleetClient, init_device_connect, loopback_config
from strands_robots.device_connect.device_stops import stops_of
from strands_robots.device_connect.robot_driver import RobotDeviceDriver
from strands_robots.envelope import error, success
from strands_robots.safety.estop_listener import estop_listener
from strands_robots.safety.plane import plane
from strands_robots.testing.private_network import private_network
from strands_robots.testing.simulated_arm import SimulatedArm
from strands_robots.threads import LoopThread
from strands_robots.utils import ValidationError, mapping, near, number, shown, text, whole

T = TypeVar("T")

ROBOTS_MAX = 200
LATE_MAX_S = 60.0
HALT_DEADLINE_S = 2.0
UP_S = 60.0
"""Seconds in which all robots have to be served, or gone."""

EVERY_S = 0.005

SETTINGS = {
    "DEVICE_CONNECT_DISCOVERY_MODE": "d2d",
    "DEVICE_CONNECT_RPC_ALLOW": "*, anonymous",
    "STRANDS_ALLOW_MOCK": "true",
    "STRANDS_MESH": "false",
}

KNOWN = frozenset(each.name for each in settings.declared())

_ONLY_ONE = threading.Lock()

STANDS = success("It stands.", stopped=True)
UNREACHED = error("No order reaches it.", stopped=False)


@dataclass(frozen=True, slots=True)
class LabCall:
    """A call as it reached a robot."""

    verb: str
    arguments: Mapping[str, Any]
    caller: str = ""
    """The name that the caller gave."""


class LabRobot:
    """One robot of a lab: what it does, what it was asked for, and its faults.

    Args:
        lab: where it is served.
        name: its id.
    """

    def __init__(self, lab: RobotLab, name: str) -> None:
        self.id = name
        self.calls: list[LabCall] = []
        """Calls that reached it over the network, in order; reads and stops are among them."""

        self._lab, self._arm = lab, SimulatedArm(name)
        self._late_s = 0.0
        self._silent = False
        self.off = False
        """True while its network is cut."""

        self._runtime: Any = None
        self._driver: Any = None

    @property
    def moving(self) -> bool:
        """True while it moves, whatever it answers."""
        return self._arm.moving

    @property
    def joints(self) -> dict[str, float]:
        """Its joints in degrees, whatever it answers."""
        return self._arm.joints

    @property
    def locked(self) -> bool:
        """True while an emergency stop locks it."""
        return plane().robots[self.id].locked

    def silence(self) -> None:
        """Have it answer no call and no emergency stop.

        It is still discovered, and a motion goes on.
        """
        self._arm.obeys, self._arm.stop_answer = False, UNREACHED
        self._silent = True
        self._leave_estops()

    def lie(self) -> None:
        """Have it say that it stopped, and move on.

        Its status and its joints show that it moves.
        """
        self._arm.obeys, self._arm.stop_answer = False, STANDS

    def delay(self, seconds: float) -> None:
        """Have it do at once what it is asked for, and answer so many seconds later.

        Raises:
            ValidationError: ``seconds`` is not above 0 and at most 60.
        """
        self._late_s = self._arm.stop_takes_s = number("seconds", seconds, above=0, high=LATE_MAX_S)

    def cut(self) -> None:
        """Cut its network: it is not found and hears nothing, and a motion goes on.

        Whoever knew it misses it, as it did not say good-bye.
        """
        self._lab.run(self.go_off())

    def restore(self) -> None:
        """Clear its faults; one that was cut or silent joins the network again.

        A motion goes on, and a lockout stays: that of an emergency stop that it missed is learnt now.
        """
        self._lab.run(self.rejoin())
        self._lab.await_estops()

    async def go_off(self) -> None:
        """Cut its network, as :meth:`cut`."""
        self._arm.obeys, self._arm.stop_answer = False, UNREACHED
        self.off = True
        self._leave_estops()
        # While it can still unsubscribe: its end would wait for that in vain.
        await stops_of(self._runtime.link).leave(self._driver)
        await self._runtime.messaging.close()

    async def rejoin(self) -> None:
        """Clear its faults, as :meth:`restore`."""
        self._arm.obeys, self._arm.stop_answer = True, None
        self._late_s = self._arm.stop_takes_s = 0.0
        if self._silent or self.off:
            self._silent = self.off = False
            await self.leave()
            await self.serve()

    async def serve(self) -> None:
        """Join the network; return once it can be called."""
        self._driver = LabDriver(self, self._arm)
        self._runtime = await init_device_connect(self._driver, peer_id=self.id, link=loopback_config())

    async def leave(self) -> None:
        """Leave the network."""
        if self._runtime is not None:
            await self._runtime.shutdown()

    def end(self) -> None:
        """Have it stand still, whatever its faults are."""
        self._arm.end()

    async def received(self, call: LabCall, carry_out: Callable[[], Awaitable[Any]]) -> Any:
        """Return the answer to a call, late or never."""
        self.calls.append(call)
        if self._silent:
            await asyncio.get_running_loop().create_future()
        due = time.monotonic() + self._late_s
        answer = await carry_out()
        await asyncio.sleep(due - time.monotonic())
        return answer

    def _leave_estops(self) -> None:
        for each in estop_listener().registrations:
            if each.name == self.id:
                each.close()

    def __repr__(self) -> str:
        return f"<{self.id}: {'moves' if self.moving else 'stands'}>"


class LabDriver(RobotDeviceDriver):
    """Simulated arm as a device whose calls may stay unanswered."""

    def __init__(self, robot: LabRobot, arm: SimulatedArm) -> None:
        super().__init__(arm, hardware=False)
        self._robot = robot

    @property
    def lives(self) -> bool:
        """False while its network is cut: the heartbeat of the process leaves it out."""
        return super().lives and not self._robot.off

    async def invoke(self, function_name: str, observable: bool = True, /, **params: Any) -> Any:
        carry_out = partial(super().invoke, function_name, observable, **params)
        if not observable:  # the framework's own wrapper, which was called by this method
            return await carry_out()
        caller = str(params.pop("source_device", None) or "")
        return await self._robot.received(LabCall(function_name, params, caller), carry_out)


class RobotLab:
    """Simulated robots on a private network of this machine; a context manager.

    They are on Device Connect, where ``connect()``, ``robot_mesh`` and Device Connect's own tools find them: for the
    length of the block the environment of this process names their network and a state directory of its own, and no
    setting of the user's counts. Only one lab exists at a time.

    Args:
        count: robots, 1 to 200; their ids are ``robot-1``, ``robot-2``, ...
        more: settings by name; by default any caller may move the robots.

    Raises:
        ValidationError: ``count`` outside its domain, or a setting that does not exist.
    """

    def __init__(self, count: int, more: Mapping[str, str] | None = None) -> None:
        number_of = whole("count", count, low=1, high=ROBOTS_MAX)
        self._settings = dict(SETTINGS)
        for name, value in mapping("more", more or {}).items():
            if name not in KNOWN:
                raise ValidationError(f"more must have settings, not {shown(name)}.{near(name, KNOWN)}")
            self._settings[name] = text(f"more[{name!r}]", value, empty=True)
        self._robots = {name: LabRobot(self, name) for name in (f"robot-{each + 1}" for each in range(number_of))}
        self._loop: LoopThread | None = None
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        """Serve the robots; return once all of them can be found, called and stopped.

        Raises:
            RuntimeError: this process has another lab.
            TimeoutError: they were not served within 60 s.
        """
        if not _ONLY_ONE.acquire(blocking=False):
            raise RuntimeError("a process has one lab at a time; leave the other one first")
        with ExitStack() as stack:
            stack.callback(_ONLY_ONE.release)
            stack.enter_context(private_network(HALT_DEADLINE_S, self._settings))
            settings.put("ZENOH_CONNECT", str(loopback_config().meeting_point))
            self._loop = LoopThread("robot-lab")
            stack.callback(self._loop.close)
            stack.callback(self._leave)
            self.run(_all(each.serve() for each in self))
            self.await_estops()
            self._be_found()
            stack.callback(_disconnect_agent)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *exception: object) -> None:
        self._stack.close()

    @property
    def ids(self) -> list[str]:
        """Ids of its robots."""
        return list(self._robots)

    @property
    def moving(self) -> list[str]:
        """Ids of the robots that move, whatever they answer."""
        return [each.id for each in self if each.moving]

    def cut(self) -> None:
        """Cut the network of every robot, as :meth:`LabRobot.cut`."""
        self.run(_all(each.go_off() for each in self))

    def restore(self) -> None:
        """Clear the faults of every robot, as :meth:`LabRobot.restore`."""
        self.run(_all(each.rejoin() for each in self))
        self.await_estops()

    def resume(self) -> None:
        """Clear the lockout of every robot, as its operator does."""
        plane().clear_local("the test")

    def run(self, work: Coroutine[Any, Any, T]) -> T:
        """Run a coroutine where the robots are served.

        Raises:
            TimeoutError: it took more than 60 s.
            RuntimeError: the lab is not entered.
        """
        if self._loop is None:
            work.close()
            raise RuntimeError("a lab is a context manager: with RobotLab(50) as lab")
        return self._loop.submit(work).result(UP_S)

    def __getitem__(self, robot: str) -> LabRobot:
        """Return the robot of this id.

        Raises:
            ValidationError: the lab has no such robot.
        """
        if robot not in self._robots:
            raise ValidationError(f"robot must be one of the lab's, not {shown(robot)}.{near(str(robot), self.ids)}")
        return self._robots[robot]

    def __iter__(self) -> Iterator[LabRobot]:
        return iter(self._robots.values())

    def __len__(self) -> int:
        return len(self._robots)

    def await_estops(self) -> None:
        """Wait until an emergency stop reaches each robot that is not cut off or silent.

        Raises:
            TimeoutError: not within 60 s.
        """
        self._wait(lambda: all(each.link.up for each in estop_listener().registrations), "reached by an e-stop")

    def _be_found(self) -> None:
        """Wait until a client finds all of them; the first discovery is the slowest."""
        with FleetClient(loopback_config(), "robot-lab") as client:
            self._wait(lambda: {each.id for each in client.peers(thorough=True)} >= self._robots.keys(), "found")

    def _wait(self, condition: Callable[[], bool], what: str) -> None:
        ends = time.monotonic() + UP_S
        while not condition():
            if time.monotonic() >= ends:
                raise TimeoutError(f"The robots were not all {what} within {UP_S:g} s.")
            time.sleep(EVERY_S)

    def _leave(self) -> None:
        for each in self:
            each.end()
        self.run(_all(each.leave() for each in self))


async def _all(work: Iterable[Awaitable[None]]) -> None:
    await asyncio.gather(*work)


def _disconnect_agent() -> None:
    """Disconnect Device Connect's own tools, whose connection is one of the process."""
    tools = sys.modules.get("device_connect_agent_tools")
    if tools is not None:
        tools.disconnect()
