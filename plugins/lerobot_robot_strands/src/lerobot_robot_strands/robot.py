"""A served robot as LeRobot's ``Robot``."""

from __future__ import annotations

import threading
import time
from contextlib import ExitStack
from functools import cached_property
from typing import Any

from lerobot.robots import Robot

from lerobot_robot_strands.config_strands import StrandsRobotConfig
from lerobot_robot_strands.ending import RobotEndedError
from lerobot_robot_strands.newest import Newest
from lerobot_robot_strands.served import MadeElsewhere, ServedRobot, told
from strands_robots.errors import RefusalError

LEADER = "lerobot"
"""Name of the leader that others see."""

STATE_HZ = 50.0
LEASE_S = 10.0
"""After this time the robot is free again where the command was killed; it has held since 0.1 s after its last word.
LeRobot's video encoder may keep every thread of this process from running for a second or two."""

KEEP_S = 0.05
"""Beat at which the command's silence is watched: half of the silence in which the robot holds by itself."""

ALIVE_S = 1.0
"""Pause between two signs of life in a hold; the robot gives a leader up that is silent for ten seconds."""

TELLS_S = 1.0
"""Longest wait for the reason of an end."""


class StrandsRobot(MadeElsewhere, Robot):  # type: ignore[misc]
    """A robot of another process, which this command holds the lease of and leads.

    It stands still until the first :meth:`send_action`, and holds as soon as the commands cease.

    Args:
        config: names it; see :class:`StrandsRobotConfig`.
    """

    config_class = StrandsRobotConfig
    name = "strands"

    def __init__(self, config: StrandsRobotConfig) -> None:
        super().__init__(config)
        self.config = config
        self._served = ServedRobot(config.peer_id, config.fleet)
        self._opened: ExitStack | None = None
        self._state: Newest[dict[str, float]] | None = None
        self._pictures: dict[str, Newest[Any]] = {}
        self._driving = threading.Lock()
        self._sent_at = self._alive_at = 0.0
        self._resting = False
        self._turn = 0
        self._held_since: float | None = None

    @cached_property
    def cameras(self) -> dict[str, str]:
        """Its cameras: LeRobot's name, and the robot's own. LeRobot counts them."""
        return self._served.cameras(self.config.camera_names)

    @cached_property
    def _shapes(self) -> dict[str, tuple[int, ...]]:
        with told(self._served.id):
            return {name: self._reader(camera)()[0].shape for name, camera in self.cameras.items()}

    @property
    def observation_features(self) -> dict[str, Any]:
        return {**dict.fromkeys(self._served.measured, float), **self._shapes}

    @property
    def action_features(self) -> dict[str, Any]:
        return dict.fromkeys(self._served.joints, float)

    @property
    def is_connected(self) -> bool:
        return self._opened is not None

    def connect(self, calibrate: bool = True) -> None:
        """Take the robot's lease, and lead it from where it stands.

        Raises:
            RobotEndedError: it is not in reach, locked, held by another caller, or may not be moved from here.
        """
        if self._opened is not None:
            raise RobotEndedError(f"strands: {self._served.id} is connected already.")
        del calibrate
        with ExitStack() as stack:
            stack.callback(self._served.close)
            features = self.observation_features, self.action_features
            del features
            remote = self._served.remote
            with told(remote.id):
                if remote.has_lease:
                    stack.enter_context(remote.control(LEASE_S))
                stack.callback(remote.halt, "the LeRobot command is over")
                self._lead = stack.enter_context(remote.lead(LEADER, max_speed=self.config.max_speed))
            self._turn, self._resting, self._held_since = 0, True, None
            self._begin_reading(stack)
            over = threading.Event()
            keeper = threading.Thread(target=self._keep, args=(over,), name="strands lead", daemon=True)
            keeper.start()
            stack.callback(keeper.join)
            stack.callback(over.set)
            self._opened = stack.pop_all()

    def _begin_reading(self, stack: ExitStack) -> None:
        far, age = self._served.id, self.config.max_age_s
        self._state = Newest(f"the state of {far}", self._served.reader(), STATE_HZ, age)
        stack.callback(self._state.close)
        for name, camera in self.cameras.items():
            newest = Newest(
                f"the picture of {far}'s camera {camera}", self._reader(camera), self.config.camera_fps, age
            )
            self._pictures[name] = newest
            stack.callback(newest.close)
        for newest in (self._state, *self._pictures.values()):
            newest.first()

    def _reader(self, camera: str) -> Any:
        remote, width, height = self._served.remote, self.config.camera_width, self.config.camera_height
        return lambda: (remote.picture(camera, width, height), 0.0)

    def get_observation(self) -> dict[str, Any]:
        """Return the newest joints and pictures, without waiting.

        Raises:
            RobotEndedError: it is not connected, or one of them is older than ``max_age_s``.
        """
        self._check_connected()
        assert self._state is not None
        try:
            joints = self._state.take()
            pictures = {name: newest.take() for name, newest in self._pictures.items()}
        except RobotEndedError as stale:
            raise RobotEndedError(self._reason() or str(stale)) from stale
        measured = self._served.measured
        if absent := [own for own in measured.values() if own not in joints]:
            raise RobotEndedError(f"strands: {self._served.id} tells no {', '.join(absent)}.")
        return {**{name: joints[own] for name, own in measured.items()}, **pictures}

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        """Send targets, and return what the robot wrote last, as it told.

        A robot that held, because the command or the network was silent, goes on from where it is, bounded in speed.

        Raises:
            RobotEndedError: it was stopped or locked, its lease is lost, or it held for longer than ``max_hold_s``.
            ValueError: an unknown joint.
        """
        self._check_connected()
        joints = self._served.joints
        if unknown := [name for name in action if name not in joints]:
            raise ValueError(f"{self._served.id} has no joint {', '.join(unknown)}; it has {', '.join(joints)}.")
        targets = {joints[name]: float(value) for name, value in action.items()}
        picture_age_s = max((newest.age_s for newest in self._pictures.values()), default=None)
        with self._driving, told(self._served.id):
            self._grip()
            written = self._lead.send(targets, picture_age_s=picture_age_s)
            self._sent_at, self._resting = time.monotonic(), False
        known = {**targets, **written}
        return {name: known[own] for name, own in joints.items() if own in known}

    def _grip(self) -> None:
        """Begin a turn where the robot holds.

        Raises:
            RobotEndedError: the network has made it hold for too long.
        """
        state, now = self._lead.state, time.monotonic()
        if state.state != "held" or self._resting:
            self._held_since = None
        elif self._held_since is None:
            self._held_since = now
        elif now - self._held_since > self.config.max_hold_s:
            raise RobotEndedError(f"strands: {self._served.id} has held for {self.config.max_hold_s:g} s: {state.why}.")
        # An answer to a command of before the newest turn tells nothing of it.
        if self._resting or (state.state == "held" and state.turn >= self._turn):
            self._take_turn(self._lead.grip)

    def _take_turn(self, begin: Any) -> None:
        self._turn = max(self._turn, self._lead.state.turn) + 1
        begin()

    def _keep(self, over: threading.Event) -> None:
        """Keep the lead through the pauses of the command: the last target for a moment, then a hold."""
        while not over.wait(KEEP_S):
            with self._driving:
                now = time.monotonic()
                silent = now - self._sent_at
                try:
                    if not self._resting and silent > self.config.pause_s:
                        self._take_turn(self._lead.give_back)
                        self._resting, self._alive_at = True, now
                        self._lead.send({})
                    elif (not self._resting and silent > KEEP_S) or (self._resting and now - self._alive_at > ALIVE_S):
                        self._alive_at = now
                        self._lead.send({})
                except RefusalError:
                    # The next call of the command tells why.
                    return

    def _reason(self) -> str:
        """Return why the lead is over, asked of the robot itself; empty where it is not known to be."""
        if self._lead.state.state == "over":
            return f"strands: {self._lead.state.why}"
        return ""

    def _check_connected(self) -> None:
        if self._opened is None:
            raise RobotEndedError(f"strands: {self._served.id} is not connected.")

    def disconnect(self) -> None:
        """Halt the robot, release its lease and leave the network."""
        opened, self._opened = self._opened, None
        self._pictures = {}
        if opened is not None:
            opened.close()
