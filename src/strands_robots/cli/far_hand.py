"""A leader of this machine at a robot of another process."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from strands_robots.cli.leading import MANUAL, announce, check_keys, connected_leader
from strands_robots.cli.output import Screen
from strands_robots.envelope import Envelope, is_error, text_of
from strands_robots.errors import RefusalError, RobotError
from strands_robots.fleet.far_lead import FarLead
from strands_robots.fleet.reports import said
from strands_robots.leader_thread import LeaderSilentError, LeaderThread
from strands_robots.policies.base import Ranges, numbers
from strands_robots.recording.file import beats
from strands_robots.teleoperators import GIVE_UP_S, LeaderFinished, RecordedLeader
from strands_robots.utils import DURATION_MAX_S

if TYPE_CHECKING:
    from strands_robots.cli.dataset_recording import Keys

LEAD_HZ = 50
"""Commands a second."""

SPARE_S = 60.0
"""Seconds that a lead may last beyond the time of its attempt."""

MOVED_ARM, MOVED_MANUAL = 0.04, 0.01
"""Part of a joint's range by which a leader arm, or a key or stick, takes over from a policy."""

_DRIVERS = {"policy": "The policy drives.", "led": "The leader leads."}


Ended = Callable[[str, bool], None]


class FollowerElsewhere:
    """A robot that is led, as leaders of this machine begin from it."""

    def __init__(self, lead: FarLead) -> None:
        self._lead = lead

    def body(self) -> FollowerElsewhere:
        """Return this object: the robot and its body are one here."""
        return self

    @property
    def bounds(self) -> Ranges:
        """Range of every joint that can be led."""
        return self._lead.ranges

    def get_joints(self) -> dict[str, float]:
        """Return the joints as the robot told them last."""
        return dict(self._lead.state.joints)


class Leadable(Protocol):
    """A robot that can be led by commands."""

    @property
    def id(self) -> str:
        """Its name."""

    def lead(self, leader: str, **options: Any) -> FarLead:
        """Begin a lead; raises :class:`RefusalError`."""


class LeadableHere:
    """A robot of this process, led by the same commands as one elsewhere.

    Args:
        robot: has ``lead`` and ``lead_to``.
    """

    def __init__(self, robot: Any) -> None:
        self._robot = robot
        self.id = str(robot.tool_name_str)

    def lead(self, leader: str, **options: Any) -> FarLead:
        """Begin a lead; raises :class:`RefusalError`."""
        # No network is between them: it may pause as any leader of this machine.
        opened = self._answer("lead", self._robot.lead(leader, spare_s=GIVE_UP_S, **options))
        return FarLead(self.id, self._call, opened, policy=bool(options.get("policy_provider")))

    def _call(self, verb: str, arguments: Mapping[str, Any], timeout: float) -> Envelope:
        del timeout  # it answers at once
        return self._answer(verb, self._robot.lead_to(**arguments))

    def _answer(self, verb: str, answer: Envelope) -> Envelope:
        if is_error(answer):
            raise RobotError(text_of(answer), robot=self.id, verb=verb, envelope=answer)
        return answer


class Hand:
    """Commands of a leader, fifty a second, until it ends.

    Args:
        lead: the robot.
        source: the leader.
        moved: part of a joint's range by which it takes over from a policy.
        ended: called once at the end, with the reason of a failure or nothing, and True where others stopped the robot.
        told: called with the state and the reason when who drives has changed.
        asked: True where a person goes on after a hold; else the leader does so by itself, at bounded speed.
    """

    def __init__(
        self,
        lead: FarLead,
        source: Any,
        *,
        moved: float,
        ended: Ended,
        told: Callable[[str, str], None],
        asked: bool,
    ) -> None:
        self._lead, self._source, self._moved = lead, source, moved
        self._ended, self._told, self._asked = ended, told, asked
        self._over = threading.Event()
        self._reading = LeaderThread(lead.leader, GIVE_UP_S)
        self._from: dict[str, float] = {}
        self._turns = not lead.leads
        self._thread = threading.Thread(target=self._run, name=f"hand {lead.robot}", daemon=True)
        self._thread.start()

    def turn(self) -> None:
        """Take over, or give back; after a hold, go on."""
        if self._turns and self._lead.leads and self._lead.state.state == "led":
            self._from = {}
            self._lead.give_back()
        else:
            self._lead.grip()

    def cease(self) -> None:
        """Send no more; waits for nothing."""
        self._over.set()

    def close(self) -> None:
        """End the commands, and the lead."""
        self.cease()
        self._reading.interrupt()
        self._thread.join(2 * GIVE_UP_S)
        self._reading.close()
        self._lead.close()

    def _run(self) -> None:
        why, driver, halted = "", "", False
        try:
            for _ in beats(LEAD_HZ, self._over):
                action = numbers(self._reading.read(self._source.get_action))
                self._lead.send(self._known(action))
                if self._turns and not self._lead.leads and self._has_moved(action):
                    self._lead.grip()
                state = self._lead.state
                if state.turn < self._lead.turn:
                    continue
                if state.state != driver:
                    driver = state.state
                    self._told(driver, state.why)
                if driver == "held" and not self._asked:
                    # A leader without a grip goes on by itself, from where the robot is.
                    driver = ""
                    (self._lead.grip if self._lead.leads else self._lead.give_back)()
        except LeaderFinished:
            why = ""
        except RefusalError as exc:
            why = "" if exc.envelope.get("completed") is True else said(exc)
            halted = exc.envelope.get("halted") is True
        except LeaderSilentError as exc:
            why = str(exc)
        except Exception as exc:  # noqa: BLE001 - a leader may raise anything; the attempt ends with it
            why = f"{type(exc).__name__}: {exc}"
        if not self._over.is_set():
            self._ended(why, halted)

    def _known(self, action: Mapping[str, float]) -> dict[str, float]:
        return {key: value for key, value in action.items() if key in self._lead.ranges}

    def _has_moved(self, action: Mapping[str, float]) -> bool:
        """Return True where the leader has left its place of this policy's turn."""
        self._from = self._from or dict(action)
        for key, value in action.items():
            low, high = self._lead.ranges.get(key, (0.0, 0.0))
            if abs(value - self._from.get(key, value)) > self._moved * (high - low):
                return True
        return False


class HandLeader:
    """A leader of this machine, which begins anew in each attempt.

    Args:
        screen: where it is told who drives.
        name: as the command line has it.
        options: of a leader arm.
        keys: of the person; None for nobody.
        source: the leader, where it is made already.
    """

    def __init__(
        self, screen: Screen, name: str, options: dict[str, Any], keys: Keys | None, source: Any = None
    ) -> None:
        self.name = name
        self._screen, self._options, self._keys = screen, options, keys
        self._manual = name in MANUAL
        self._lasting: Any = source
        self._hand: Hand | None = None
        self._attempt = ExitStack()

    @property
    def method(self) -> str:
        """Its kind, as :class:`TeleopOptions` has it."""
        return self.name if self._manual else "arm"

    @property
    def person(self) -> bool:
        """True where a person leads."""
        return not isinstance(self._lasting, RecordedLeader)

    @contextmanager
    def connected(self) -> Iterator[None]:
        """Have a leader arm connected, or a recording read, in the block."""
        with ExitStack() as stack:
            if not self._manual and self._lasting is None:
                self._lasting = stack.enter_context(connected_leader(self.name, None, self._options))
            stack.callback(self.end)
            yield

    def ready(self, name: str, follower: Any, bounds: Ranges) -> Any:
        """Return the leader, ready for an attempt, which :meth:`end` ends.

        Args:
            name: of the robot, for the screen.
            follower: the robot; what a hand moves begins where it is.
            bounds: its ranges.

        Raises:
            ValidationError: the leader leads joints that it does not have.
        """
        source, keys = self._lasting, self._keys
        if self._manual:
            pressed = (lambda key: None) if keys is None else keys.pressed
            source = self._attempt.enter_context(connected_leader(self.name, follower, self._options, pressed))
        elif isinstance(source, RecordedLeader):
            source.rewind()
        check_keys(name, source, bounds)
        announce(self._screen, self.name, name, source)
        if keys is not None and self.name == "keyboard":
            keys.leading = True
            self._attempt.callback(setattr, keys, "leading", False)
        return source

    def begin(self, robot: Leadable, policy: str, task: str, seconds: float | None, ended: Ended, **how: Any) -> None:
        """Lead the robot, or let its policy have the first turn.

        Args:
            robot: elsewhere, or of this process.
            policy: its name; empty for none.
            task: told to the policy.
            seconds: its longest time; None for as long as one may take.
            ended: as of :class:`Hand`.
            how: further options of the lead.

        Raises:
            RefusalError: the robot refused it.
            ValidationError: the leader leads joints that it does not have.
        """
        # The end of the attempt comes from here, not from the robot at the same moment.
        how = {**how, "duration": min((seconds or DURATION_MAX_S) + SPARE_S, DURATION_MAX_S)}
        if policy:
            how = {"policy_provider": policy, "instruction": task, "guide": "differences", **how}
        lead = self._attempt.enter_context(robot.lead(self.leader_id, **how))
        source = self.ready(robot.id, FollowerElsewhere(lead), lead.ranges)
        moved = MOVED_MANUAL if self._manual else MOVED_ARM
        asked = self._keys is not None
        hand = self._hand = Hand(lead, source, moved=moved, ended=ended, told=self._tell, asked=asked)
        self._attempt.callback(hand.close)
        if self._keys is not None:
            self._keys.turn = hand.turn
            if policy:
                key = "v" if self.name == "keyboard" else "t Enter"
                self._screen.say(f"It takes over when it moves; {key} takes over and gives back.")

    def cease(self) -> None:
        """Send no more commands; waits for nothing, as a stop may follow."""
        if self._hand is not None:
            self._hand.cease()

    def end(self) -> None:
        """End the attempt; the robot holds. It waits for the leader."""
        if self._keys is not None:
            self._keys.turn = lambda: None
        self._attempt.close()

    @property
    def leader_id(self) -> str:
        """The leader's name at the robot."""
        kind = Path(self.name.partition("@")[0]).name
        return "".join(each if each.isalnum() or each in "-_." else "-" for each in kind) or "leader"

    def _tell(self, driver: str, why: str) -> None:
        self._screen.data({"event": "turn", "state": driver, "why": why})
        key = " It goes on." if self._keys is None else f" {'v' if self._keys.leading else 't Enter'} goes on."
        line = _DRIVERS.get(driver, f"Held: {why}.{key}")
        self._screen.say(line, "bold" if driver in _DRIVERS else "bold yellow")
