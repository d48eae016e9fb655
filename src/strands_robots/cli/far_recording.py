"""Recording of a robot that another process serves, as it is seen from here.

It runs a policy itself, or a leader of this machine leads it, or both in turns. The tasks and motions that others give
it (the page, an agent) are in the recording as well. Readings count from their arrival here.
"""

from __future__ import annotations

import base64
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from typing import Any

from strands_robots.cli.far_hand import HandLeader
from strands_robots.cli.led_robot import NotBegunError
from strands_robots.cli.network import one_robot
from strands_robots.cli.output import CliError, Screen
from strands_robots.cli.record import NO_CAMERAS
from strands_robots.datasets.recorded import HALTED, LED_BY_PERSON, LED_BY_RECORDING
from strands_robots.errors import NoAnswerError, RefusalError, RobotError, UnreachableError
from strands_robots.fleet.adapter import DEVICE_CONNECT, Detail, RobotEvent
from strands_robots.fleet.networks import Networks
from strands_robots.fleet.remote_robot import ROBOT_NAME, RemoteRobot
from strands_robots.fleet.reports import outcome_of, runs, said
from strands_robots.policies.handover import LOST_S
from strands_robots.recording.cameras import OVERVIEW
from strands_robots.recording.file import REFUSED, STEP, TURN, UNITS, Pictures, Recorder, beats, units_in
from strands_robots.safety.stopping import StopVerdict
from strands_robots.utils import DURATION_MAX_S, ValidationError, shown

LOOK_S = 0.25
"""Pause between two looks at the robot's status."""

LOADING_S = 300.0
"""Longest wait for a policy that the robot is loading."""

SILENT_S = 3.0
"""Time without an answer of the robot after which an attempt ends."""

PICTURE_S = 2.0
"""Longest wait for one picture."""

JPEG = b"\xff\xd8"
"""Beginning of every JPEG."""

CAMERAS_MAX = 16
"""Most cameras that are recorded of one robot."""

LEASE_S = 2.0
"""Time of the lease on a robot whose policy was started from here."""

PICTURE_WIDTH, PICTURE_HEIGHT = 640, 480

TELLING = frozenset(
    {STEP, TURN, REFUSED, "taskStarted", "policyStarted", "taskComplete", "policyComplete", "emergencyStop"}
)
"""Events of a robot of which an episode is made."""

_REFUSALS = {"motion_refused": REFUSED}
"""Safety events of the mesh that tell of a refused motion."""

_ENDS = ("taskComplete", "policyComplete")


class FarTask:
    """Attempt at a robot of another process, as it is watched from here.

    Attributes:
        error: why it failed; empty while it has not.
        voided: the robot was stopped or locked meanwhile, or nobody knows how its policy ended.
        halted: it was stopped by others, as an event told.
        stopped_by: the reason of that stop, once it is known.
        halting: it is halted from here.
    """

    def __init__(self) -> None:
        self.error = self.stopped_by = ""
        self.voided = self.halting = False
        self.halted = threading.Event()
        self._over, self._ending = threading.Event(), threading.Lock()

    @property
    def running(self) -> bool:
        """True until its end."""
        return not self._over.is_set()

    def end(self, error: str = "", *, voided: bool = False) -> None:
        """Note the end; the first one counts."""
        with self._ending:
            if self.running:
                self.error, self.voided = error, voided
                self._over.set()


class FarRobot:
    """A served robot, as ``dataset record`` needs it.

    Args:
        world: the robot, or the world that it is in.
        networks: on which its events are followed.
        part: which robot of a world; empty for the only one.
        policy: runs there in each attempt; empty for none.
        hand: leads it from here, in turns with the policy; None where others move it.
        task: told to the policy.
        cameras: names, or None for those of the robot itself.

    Raises:
        ValidationError: the world has several robots, or none of that name, or there is no such camera.
        RefusalError: it does not answer, or both networks have a robot of its id.
    """

    def __init__(  # noqa: PLR0917 - one robot, and what is asked of it
        self,
        world: RemoteRobot,
        networks: Networks,
        part: str,
        policy: str,
        task: str,
        cameras: Sequence[str] | None,
        hand: HandLeader | None = None,
    ) -> None:
        self.remote = one_robot(world, part, "--robot")
        self.networks, self._part, self._policy, self._task = networks, part, policy, task
        # The one that motions go to: of one on both networks each step is told twice.
        self._network = networks.of(self.name, "recording", moves=True)
        self._cameras = _cameras_of(world, part, cameras)
        self._hand = hand
        self._units: dict[str, str] = {}
        with suppress(RefusalError):
            # One that states no features states no units.
            self._units = units_in(world.features(), part)
        self._attempt: FarTask | None = None
        self._recorder: Recorder | None = None
        self._tells_ends = False

    locked = ""
    """Empty: whoever locked it, its own process keeps it on the network."""

    @property
    def name(self) -> str:
        """Its id in recordings."""
        return self.remote.address

    @property
    def on_mesh(self) -> bool:
        """True where it is reached over the mesh."""
        return self._network.name != DEVICE_CONNECT

    @property
    def kind(self) -> str:
        """Its kind, as it states it."""
        return self.remote.model or self.remote.type or "unknown"

    @property
    def has_cameras(self) -> bool:
        """True where pictures are recorded."""
        return bool(self._cameras)

    @property
    def cameras(self) -> Sequence[str]:
        """Names of its cameras in the recording."""
        return [each.replace("/", ".") for each in self._cameras]

    @property
    def stopped(self) -> bool:
        """True where others stopped or locked it in this attempt."""
        task = self._attempt
        return task is not None and (bool(task.stopped_by) or task.halted.is_set())

    @property
    def stopped_by(self) -> str:
        """The reason of the stop; empty while there was none."""
        task = self._attempt
        return "" if task is None or not self.stopped else task.stopped_by or f"{self.name} was stopped."

    def begin(self, seconds: float | None, check: Callable[[], object] = lambda: None) -> FarTask:
        """Begin an attempt, and start the policy where it has one.

        Args:
            seconds: longest time of the attempt; None for as long as it lasts.
            check: raises :class:`CliError` where it may no longer begin; asked before each try.

        Raises:
            NotBegunError: the robot refused it.
            CliError: it did not answer.
        """
        if self._policy and self._hand is None and seconds is None and not self.remote.has_lease:
            raise CliError(
                f"--episode-s is needed: {self.name} has no control lease, and would not halt where this is killed."
            )
        task = self._attempt = FarTask()
        if self._policy or self._hand is not None:
            try:
                self._start_loaded(task, seconds, check)
            except RefusalError as refused:
                why = said(refused)
                task.end(why)
                if not isinstance(refused, NoAnswerError | UnreachableError):
                    raise NotBegunError(why) from refused
                # It may have begun all the same.
                verdict = self.remote.halt("its start was not answered")
                why += "" if verdict.stopped else f" {self.name} did not confirm its stop and may move."
                raise CliError(why) from refused
        threading.Thread(target=self._watch, args=(task,), name=f"attempt {self.name}", daemon=True).start()
        return task

    def _start_loaded(self, task: FarTask, seconds: float | None, check: Callable[[], object]) -> None:
        """Start, also where the robot has yet to load its policy."""
        until = time.monotonic() + LOADING_S
        while True:
            check()
            try:
                self._start(task, seconds)
            except RefusalError as refused:
                if refused.envelope.get("loading") is not True or time.monotonic() > until:
                    raise
                time.sleep(LOOK_S)
            else:
                return

    def _start(self, task: FarTask, seconds: float | None) -> None:
        """Start the policy, the leader or both."""
        if self._hand is not None:
            self._hand.begin(self.remote, self._policy, self._task, seconds, partial(self._hand_ended, task))
            return
        duration = min(seconds or DURATION_MAX_S, DURATION_MAX_S)
        self.remote.call(self._network.starts, instruction=self._task, policy_provider=self._policy, duration=duration)

    @staticmethod
    def _hand_ended(task: FarTask, why: str, halted: bool) -> None:
        """Note the end of the leader; whether the robot was locked is asked elsewhere."""
        if halted:
            task.halted.set()
        else:
            task.end(why)

    def halt(self, reason: str) -> StopVerdict:
        """Halt it at the end of an attempt."""
        if self._attempt is not None:
            self._attempt.halting = True
            self._attempt.end()
        if self._hand is None:
            return self.remote.halt(reason)
        self._hand.cease()
        try:
            return self.remote.halt(reason)
        finally:
            # After the stop: it waits for the leader and for the robot's answer.
            self._hand.end()

    def hold(self, screen: Screen) -> None:
        """Tell who stopped it; its own process keeps it on the network."""
        screen.say(f"Stopped: {self.stopped_by}", "bold red")
        screen.data({"event": "held", "peer_id": self.name, "stopped_by": self.stopped_by})

    @contextmanager
    def held(self) -> Iterator[None]:
        """Hold a robot in the block that is started from here.

        If this process dies, the robot halts when :data:`LEASE_S` are over, and that of a leader holds at once.

        Raises:
            RefusalError: another caller holds it.
        """
        if (self._policy or self._hand is not None) and self.remote.has_lease:
            # The robot of a leader that is cut off holds at once, and waits for it.
            with self.remote.control(LEASE_S if self._hand is None else LOST_S):
                yield
        else:
            yield

    @contextmanager
    def recorded(self, recorder: Recorder, fps: int, pictures: Pictures | None) -> Iterator[None]:
        """Record its events in the block, and hand the pictures of its cameras over."""
        self._recorder, over = recorder, threading.Event()
        if self._units:
            recorder.take(self.name, UNITS, {"units": self._units})
        threads = [
            threading.Thread(
                target=self._take_pictures, args=(recorder, each, pictures, fps, over), name=f"pictures {each}"
            )
            for each in (() if pictures is None else self._cameras)
        ]
        if self._hand is not None and not self._policy:
            recorder.take(self.name, LED_BY_PERSON if self._hand.person else LED_BY_RECORDING, {})
        end = self._network.subscribe(self.name, lambda event: self._take(recorder, event), Detail.ALL)
        try:
            for thread in threads:
                thread.start()
            yield
        finally:
            over.set()
            end()
            for thread in threads:
                thread.join()

    def _take(self, recorder: Recorder, event: RobotEvent) -> None:
        name = event.name
        if name == "safety_event":
            name = _REFUSALS.get(str(event.payload.get("event")), name)
        if name not in TELLING:
            return
        named = event.payload.get(ROBOT_NAME)
        if self._part and named not in (None, "", self._part):
            return
        task = self._attempt
        self._tells_ends = self._tells_ends or event.name in _ENDS
        if event.name in _ENDS and task is not None and not task.halting:
            self._ended(task, event.payload)
        recorder.take(self.name, name, event.payload)

    def _ended(self, task: FarTask, payload: Mapping[str, Any]) -> None:
        """Note the end of a motion of the robot."""
        state = payload.get("state")
        if not self._policy and self._hand is None:
            # Others lead it, and let a jog go or end a turn by a halt. A lockout ends the attempt.
            return
        if state == "stopped":
            # Whether it is locked as well is asked on another thread: this one is the network's.
            task.halted.set()
        elif self._policy:
            failed = "" if state in (None, "", "completed") else f"its policy ended as {shown(state)}"
            task.end(str(payload.get("error") or failed))

    def _untold(self, task: FarTask, status: Mapping[str, Any], *, ran: bool) -> None:
        """Note the end of a motion by the robot's status; the mesh tells no ends."""
        ended = outcome_of(status, self._part)
        if not ran and ended.get("state") != "stopped":
            # It may not have begun yet, and tell of the attempt before.
            return
        if ended:
            self._ended(task, ended)
            if ended["state"] == "stopped" and not task.halted.is_set():
                # It is that of others, who go on.
                self._note_halt()
        elif self._policy:
            # Nobody knows whether it is a good one.
            task.end(voided=True)

    def _note_halt(self) -> None:
        """Record a stop of others, where the network does not tell it."""
        if self._recorder is not None and not self._tells_ends:
            self._recorder.take(self.name, HALTED, {})

    def _stopped(self, task: FarTask, status: Mapping[str, Any]) -> None:
        """End an attempt at a robot that others stopped."""
        locked = status.get("locked") is True
        task.stopped_by = f"{self.name} is locked by an emergency stop." if locked else f"{self.name} was stopped."
        if not locked:
            self._note_halt()
        elif self._recorder is not None:
            self._recorder.take(self.name, "locked", {"reason": task.stopped_by})
        task.end(voided=True)

    def _watch(self, task: FarTask) -> None:
        """Look at the robot until the attempt is over; what goes wrong here ends it."""
        try:
            self._look(task)
        except Exception as exc:  # noqa: BLE001 - the status is a stranger's; unwatched, a stop would go unseen
            task.end(f"{self.name} can be watched no more: {type(exc).__name__}: {exc}")

    def _look(self, task: FarTask) -> None:
        answered, ran = time.monotonic(), False
        while True:
            halted = task.halted.wait(LOOK_S)
            if not task.running:
                return
            try:
                status = self.remote.status()
            except RefusalError as silent:
                if halted:
                    self._stopped(task, {})
                elif time.monotonic() - answered > SILENT_S:
                    task.end(f"{self.name} is out of reach: {said(silent)}")
                continue
            if task.halting or task is not self._attempt:
                return
            answered, now = time.monotonic(), runs(status, self._part)
            if halted or status.get("locked") is True:
                self._stopped(task, status)
            elif not now and (ran or self._policy) and not task.halted.wait(LOOK_S):
                # Also where it was stopped before it was seen to run.
                self._untold(task, status, ran=ran)
            ran = now

    def _take_pictures(
        self, recorder: Recorder, camera: str, pictures: Pictures, fps: int, over: threading.Event
    ) -> None:
        """Ask for a picture at each beat; the ages tell of a gap."""
        for _ in beats(fps, over):
            # The picture is no older than its request.
            asked = time.time()
            try:
                answer = self.remote.call(
                    "getPicture", camera=camera, width=PICTURE_WIDTH, height=PICTURE_HEIGHT, timeout=PICTURE_S
                )
                pictures(camera.replace("/", "."), _jpeg_of(answer), asked)
            except (RefusalError, ValueError) as failed:
                recorder.take(self.name, "notRecorded", {"what": f"pictures of {camera}", "error": str(failed)[:200]})
                over.wait(LOOK_S)


def _jpeg_of(answer: Mapping[str, Any]) -> bytes:
    """Return the picture of an answer; raise ValueError where it is none."""
    jpeg = base64.b64decode(str(answer.get("jpeg", "")), validate=True)
    if not jpeg.startswith(JPEG):
        raise ValueError("its answer is no JPEG")
    return jpeg


def _cameras_of(remote: RemoteRobot, part: str, names: Sequence[str] | None) -> tuple[str, ...]:
    """Return the cameras to record: those named, else the robot's own.

    Raises:
        ValidationError: it has no camera of that name.
        RobotError: it names none that can be read.
    """
    if names == [NO_CAMERAS] or (names is None and "listCameras" not in remote.verbs):
        return ()
    listed = remote.call("listCameras").get("cameras")
    if not isinstance(listed, list) or not all(isinstance(each, str) for each in listed):
        raise RobotError("Its list of cameras cannot be read", robot=remote.id, verb="listCameras")
    if names is None:
        own = [name for name in listed if (name.startswith(f"{part}/") if part else "/" in name)]
        return tuple((own or ([OVERVIEW] if OVERVIEW in listed else listed))[:CAMERAS_MAX])
    if not 0 < len({name.replace("/", ".") for name in names}) == len(names) <= CAMERAS_MAX:
        raise ValidationError(f"--cameras must name 1 to {CAMERAS_MAX} different cameras, or be {NO_CAMERAS}.")
    if unknown := [name for name in names if name not in listed]:
        raise ValidationError(f"--cameras must be of {', '.join(listed) or 'none'}, not {', '.join(unknown)}.")
    return tuple(names)
