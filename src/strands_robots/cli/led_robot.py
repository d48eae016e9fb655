"""A follower of this process that is served while it is led."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from strands_robots._mesh_switch import mesh_env_request
from strands_robots.cli.network import Network
from strands_robots.cli.output import CliError, Exit, Screen, wait_until
from strands_robots.cli.own_robot import device_of, peer_of
from strands_robots.cli.readiness import mesh_problems, shortcomings
from strands_robots.contract import put_away
from strands_robots.envelope import text_of
from strands_robots.safety.gate import OrderedStop
from strands_robots.safety.stopping import StopVerdict
from strands_robots.serving.control import FOLLOW, NotHolderError
from strands_robots.serving.control_leases import leases_of
from strands_robots.utils import MissingExtraError, ValidationError, own_device_id

if TYPE_CHECKING:
    from strands_robots.device_connect.backends import LinkConfig

NO_NETWORK = "--no-network leads it without one: then Ctrl-C here is the only stop."

ENDS = (signal.SIGTERM, signal.SIGHUP)
"""Signals that end a command, beside Ctrl-C."""

ENDED = "teleop ended"
"""Reason of the halt at the end of a command."""

VERDICT_S = 60.0
"""Longest wait for the verdict on a stop of others, which is there within the halt deadline."""


@dataclass(frozen=True, slots=True)
class Serving:
    """Networks of a follower.

    Args:
        network: its flags; None for no network.
        peer_id: its id on the networks; made from its name by default.
        on_mesh: on the mesh besides, because the leader is, or is published there.
    """

    network: Network | None
    peer_id: str | None = None
    on_mesh: bool = False

    @classmethod
    def of(cls, network: Network, peer_id: str | None, on_mesh: str | None, *, alone: bool) -> Serving:
        """Return it by the flags of a command.

        Args:
            network: the flags.
            peer_id: of ``--peer-id``.
            on_mesh: the id of a robot that has to be on the mesh; None for one that need not.
            alone: the flag ``--no-network``.

        Raises:
            ValidationError: flags that exclude one another, or an id that is none.
        """
        if alone and (peer_id is not None or on_mesh is not None or network.flags):
            raise ValidationError("--no-network goes without --peer-id, --publish, a leader of the mesh and networks.")
        if alone:
            return cls(None)
        if peer_id is not None and on_mesh not in (None, "", peer_id):
            raise ValidationError(f"--peer-id and --publish are one id: {peer_id} and {on_mesh} are two.")
        own_id = peer_id or on_mesh or None
        return cls(network, None if own_id is None else own_device_id("--peer-id", own_id), on_mesh is not None)

    def check(self) -> None:
        """Refuse flags that no link can be made of, before the robot is connected."""
        with _or_without():
            if self.network is not None and self.network.mesh:
                self.network.use_mesh()
            elif self.network is not None:
                self.network.link()


@contextmanager
def _or_without() -> Iterator[None]:
    """Name the way without a network in a failure of the block."""
    try:
        yield
    except MissingExtraError as missing:
        raise CliError(f"{missing} {NO_NETWORK}") from missing
    except CliError as failed:
        if failed.code is Exit.USAGE:
            raise
        raise CliError(f"{failed.reason} {NO_NETWORK}", failed.code) from failed


class LedRobot:
    """A robot that is led here.

    Args:
        robot: of this process.
        peer_id: its id on the networks, empty for none.
        flags: those that reach it from another terminal.
    """

    def __init__(self, robot: Any, peer_id: str = "", flags: str = "") -> None:
        self.robot, self.peer_id, self.flags = robot, peer_id, flags
        self._before: OrderedStop | None = None

    @property
    def stopped(self) -> bool:
        """True where it was stopped or locked since it began to be led.

        False on no network.
        """
        return bool(self.peer_id) and (self.robot.gate.newest_stop is not self._before or bool(self.locked))

    @property
    def locked(self) -> str:
        """By whom it is locked, and how it is resumed; empty while it is free."""
        lockout = self.robot.gate.lockout("teleop")
        return "" if lockout is None else text_of(lockout).partition(": ")[2] or text_of(lockout)

    @property
    def stopped_by(self) -> str:
        """The reason of the newest stop, with the name that its caller states."""
        stop = self.robot.gate.newest_stop
        return self.locked or ("" if stop is None else f"{stop.reason}.")

    @contextmanager
    def held_by(self, leader: str, leads: Callable[[], bool], verb: str = FOLLOW) -> Iterator[None]:
        """Begin to lead in the block; hold the control lease while the leader leads.

        A stop that comes meanwhile ends that.

        Args:
            leader: the holder's name, as other callers are told.
            leads: returns whether it leads already.
            verb: of the motion; that of a person by default.

        Raises:
            CliError: another holds the robot.
        """
        self._before = self.robot.gate.newest_stop
        if not self.peer_id:
            yield
            return
        try:
            leave = leases_of(self.robot, hardware=False).admit(verb, leader, "", "", begun=leads)
        except NotHolderError as held:
            raise CliError(text_of(held.envelope)) from held
        try:
            yield
        finally:
            leave.settle(leads())
        stop = self.robot.gate.newest_stop
        if stop is not None and stop is not self._before:
            # It may have come before the first permit, which it then has not voided.
            self.robot.halt(f"{stop.reason}, as it began to be led")

    def verdict(self) -> StopVerdict | None:
        """Return the verdict on the newest stop once it is there; None without one."""
        stop = self.robot.gate.newest_stop
        with contextlib.suppress(TimeoutError):
            return None if stop is None else stop.verdict.result(VERDICT_S)
        return None

    def halt_last(self) -> StopVerdict:
        """Halt it at the end: on its networks still, it begins no other motion."""
        put_away(self.robot)
        verdict: StopVerdict = self.robot.halt(ENDED)
        return verdict

    def hold(self, screen: Screen) -> StopVerdict | None:
        """Tell who stopped it, and stay on the network until Ctrl-C."""
        locked, why = self.locked, self.stopped_by
        screen.say(f"{'Locked' if locked else 'Stopped from the network'}: {why}", "bold red")
        verdict = self.verdict()
        if verdict is not None:
            screen.say(text_of(verdict.envelope()), "green" if verdict.stopped else "bold red")
            if verdict.settling:
                screen.say(self.robot.wait_settled())
        stopped = None if verdict is None else verdict.stopped
        screen.data({"event": "held", "peer_id": self.peer_id, "stopped_by": why, "stopped": stopped})
        screen.say("The leader moves it no more. It stays on the network until Ctrl-C; then start this command anew.")

        def resumed() -> str:
            nonlocal locked
            if locked and not self.locked:
                screen.say("Resumed. Ctrl-C, then start this command anew to lead on.", "green")
                screen.data({"event": "resumed", "peer_id": self.peer_id})
            locked = self.locked
            return ""

        wait_until(screen, resumed)
        return verdict


@contextmanager
def served(screen: Screen, robot: Any, how: Serving, peer_type: str) -> Iterator[LedRobot]:
    """Have a robot on the networks for a block, as ``serve`` does.

    Raises:
        CliError: it is not on one of them, or one is not installed.
    """
    network = how.network
    if network is None:
        screen.say("It is on no network: nothing but Ctrl-C here stops it.", "yellow")
        yield LedRobot(robot)
        return
    with ExitStack() as stack:
        with _or_without():
            peer_id = how.peer_id or (_temporary_mesh_id("follow") if how.on_mesh else None)
            names, lacking = list[str](), list[str]()
            if not network.mesh:
                link: LinkConfig = network.link()
                peer_id, driver = stack.enter_context(device_of(network, link, robot, peer_id))
                names, lacking = ["Device Connect"], shortcomings(driver, link)
            if network.mesh or how.on_mesh or mesh_env_request() is True:
                mesh = stack.enter_context(peer_of(robot, peer_id, peer_type))
                stack.callback(_leave_mesh, robot)
                _join(robot, mesh)
                peer_id, names, lacking = mesh.peer_id, [*names, "the mesh"], [*lacking, *mesh_problems()]
        for each in dict.fromkeys(lacking):
            screen.say(f"NOT READY. {each}", "bold red")
        led = LedRobot(robot, str(peer_id), network.flags)
        screen.say(f"{peer_id} is on {' and '.join(names)}. It is stopped from any terminal as well:", "green")
        screen.copyable(f"  strands-robots stop {peer_id}{led.flags}")
        yield led


def _temporary_mesh_id(name: str) -> str:
    """Return a fresh mesh id for one command, covered by its certificate, if any."""
    from strands_robots.mesh.transport import TransportError  # noqa: PLC0415 - loaded when a network is used
    from strands_robots.mesh.wire_identity import IdentityError, visitor_id  # noqa: PLC0415 - as above

    try:
        return visitor_id(name)
    except (TransportError, IdentityError) as exc:
        raise CliError(str(exc), Exit.USAGE) from exc


def _join(robot: Any, mesh: Any) -> None:
    """Let the robot know its peer, on which it publishes its leader's frames."""
    from strands_robots.mesh.input import MeshInputSink  # noqa: PLC0415 - loaded when the network is used

    robot.mesh, robot.input_sink = mesh, MeshInputSink(mesh)


def _leave_mesh(robot: Any) -> None:
    robot.mesh = robot.input_sink = None


class NotBegunError(CliError):
    """Failure of a command that its robot refused.

    Nothing of the command moves it, and a halt would only stop what others have it do.
    """


@contextmanager
def halted_first(robot: Any) -> Iterator[None]:
    """Halt ``robot`` first where the block raises.

    After :class:`NotBegunError` it is left alone.
    SIGTERM and the end of the terminal are Ctrl-C inside.
    What was entered before, such as the leader's device, may take its time to be left.
    """
    before = {}
    if threading.current_thread() is threading.main_thread():
        # With nohup the end of the terminal is ignored, and stays so.
        ends = [each for each in ENDS if signal.getsignal(each) is not signal.SIG_IGN]
        before = {each: signal.signal(each, signal.default_int_handler) for each in ends}
    try:
        yield
    except NotBegunError:
        raise
    except BaseException:
        robot.halt(ENDED)
        raise
    finally:
        for each, handler in before.items():
            signal.signal(each, handler)
