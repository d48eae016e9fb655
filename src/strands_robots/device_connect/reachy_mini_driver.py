"""Reachy Mini as a device. Degrees and millimetres here, radians and metres below."""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import Callable
from typing import Any, ClassVar, cast

from device_connect_edge.types import DeviceIdentity, DeviceStatus

from strands_robots.contract import RolloutEvent, TaskRobot
from strands_robots.device_connect._compat import Labels, emit, rpc
from strands_robots.device_connect.base_driver import Call, RobotDriver
from strands_robots.device_connect.live_driver import Activity
from strands_robots.drivers.reachy import ReachyDriver
from strands_robots.drivers.reachy.connection import STATUS_PATH
from strands_robots.drivers.reachy.driver import LIBRARIES, motor_names
from strands_robots.drivers.reachy.links import DEFAULT_PREFIX
from strands_robots.drivers.reachy.rest import DaemonError
from strands_robots.drivers.reachy.target import HeadPose, Target, bounded
from strands_robots.envelope import Envelope, error, success
from strands_robots.safety.approval import Approval
from strands_robots.safety.authorization import Authorization
from strands_robots.utils import choice, flag, identifier, shown

logger = logging.getLogger(__name__)

DEGREES, MILLIMETRES = math.degrees(1.0), 1000.0
UNAVAILABLE = "unavailable"
_MOTION: Labels = {"direction": "write", "safety": "critical"}
_READ: Labels = {"direction": "read"}


def _angle(key: str, name: str, value: object) -> float:
    return bounded(key, value, unit="degrees", scale=DEGREES, name=name)


def _offset(key: str, name: str, value: object) -> float:
    return bounded(key, value, unit="mm", scale=MILLIMETRES, name=name)


class ReachyMiniDriver(RobotDriver):
    """A Reachy Mini head: look, gesture, play recorded moves; end any motion with stopMotion.

    Args:
        host: bare hostname or IP literal of the daemon.
        prefix: of the Zenoh keys of a daemon before 1.5: identifiers joined by ``/``.
        api_port: TCP port of the daemon, 1 to 65535.
        transport: ``auto`` for what the daemon speaks, ``websocket`` or ``zenoh``.
        release_on_estop: switch the motors off at an emergency stop of this device's own; the head drops. By default
            it stops and holds.
        robot: a ready :class:`ReachyDriver` in place of one for ``host``.

    Raises:
        ValidationError: (a ValueError) a host, prefix, port or transport outside its domain.
    """

    device_type = "reachy_mini"
    labels: ClassVar[Labels] = {"category": "robot"}

    def __init__(
        self,
        host: str = "reachy-mini.local",
        prefix: str = DEFAULT_PREFIX,
        api_port: int = 8000,
        *,
        transport: str = "auto",
        release_on_estop: bool = False,
        robot: ReachyDriver | None = None,
        authorization: Authorization | None = None,
        approval: Approval | None = None,
    ) -> None:
        self.reachy = robot or ReachyDriver(host, prefix, api_port, transport=transport)
        self._release = flag("release_on_estop", release_on_estop)
        # The door needs of a robot its name, gate, halt and subscribe; tasks by instruction are not a Reachy's.
        super().__init__(cast(TaskRobot, self.reachy), hardware=True, authorization=authorization, approval=approval)

    @property
    def identity(self) -> DeviceIdentity:
        """Who this device is; ``model`` names the daemon's host."""
        connection = self.reachy.connection
        info = connection.info
        return DeviceIdentity(
            device_type=self.device_type,
            manufacturer="Pollen Robotics",
            model=f"Reachy Mini ({connection.host})",
            firmware_version=str(info.raw.get("version") or "") if info else "",
            description="Reachy Mini: an expressive head on a turning body",
        )

    @property
    def status(self) -> DeviceStatus:
        """``busy`` while it moves, ``idle`` while it could, else ``unavailable`` with the reason as error state."""
        away = self.reachy.connection.refusal()
        if away is None:
            return super().status
        return DeviceStatus(availability=UNAVAILABLE, busy_score=0.0, error_state=away)

    def heartbeat(self) -> dict[str, Any]:
        """What every heartbeat carries besides the id and the time."""
        told = super().heartbeat()
        return {**told, "availability": UNAVAILABLE} if self.activity.fault else told

    async def refresh(self) -> Activity:
        """Ask the robot again; the answer is what status and presence say from now on."""
        activity = await super().refresh()
        if activity.fault:
            self.runtime.status["availability"] = UNAVAILABLE
        return activity

    async def connect(self) -> None:
        """Begin to connect; a daemon that is away is connected to when it appears."""
        self.reachy.connection.start()
        await super().connect()

    async def disconnect(self) -> None:
        """Halt what we started, let go of the robot, and refuse every motion from now on."""
        await super().disconnect()
        await asyncio.to_thread(self.reachy.disconnect)

    def answering(self, verb: Callable[[], object]) -> Call:
        """``verb`` whose daemon errors are answers."""

        def call() -> object:
            try:
                return verb()
            except DaemonError as exc:
                return error(str(exc), http_status=exc.status)

        return call

    async def act(self, name: str, verb: Callable[[], object]) -> dict[str, Any]:
        """Start a motion without arguments."""
        return await self.move(name, lambda: self.answering(verb))

    # Motion.

    @rpc(labels=_MOTION)
    async def look(  # noqa: PLR0917 - the documented signature
        self, pitch: float = 0, roll: float = 0, yaw: float = 0, x: float = 0, y: float = 0, z: float = 0
    ) -> dict[str, Any]:
        """Set the head pose: at once within a short way, else by a quick ramp that any later motion or stop ends.

        Args:
            pitch: Degrees, -40 to 40, positive looks down; pitch and roll together at most 60
            roll: Degrees, -40 to 40
            yaw: Degrees, -180 to 180, positive looks left; the body turns along beyond 65
            x: Forward offset in mm, -25 to 25
            y: Leftward offset in mm, -25 to 25
            z: Upward offset in mm, -30 to 15
        """

        def prepare() -> Call:
            head = HeadPose(
                pitch=_angle("head_pitch", "pitch", pitch),
                roll=_angle("head_roll", "roll", roll),
                yaw=_angle("head_yaw", "yaw", yaw),
                x=_offset("head_x", "x", x),
                y=_offset("head_y", "y", y),
                z=_offset("head_z", "z", z),
            )
            target = self.reachy.checked(Target(head))
            return self.answering(lambda: self.reachy.go(target, "look"))

        return await self.move("look", prepare)

    @rpc(labels=_MOTION)
    async def antennas(self, left: float = 0, right: float = 0) -> dict[str, Any]:
        """Set the antenna angles.

        Args:
            left: Left antenna in degrees, -180 to 180
            right: Right antenna in degrees, -180 to 180
        """

        def prepare() -> Call:
            target = Target(antennas=(_angle("antenna_right", "right", right), _angle("antenna_left", "left", left)))
            return self.answering(lambda: self.reachy.go(target, "antennas"))

        return await self.move("antennas", prepare)

    @rpc(labels=_MOTION)
    async def body(self, yaw: float = 0) -> dict[str, Any]:
        """Turn the body.

        Args:
            yaw: Degrees, -160 to 160, positive turns left
        """

        def prepare() -> Call:
            target = self.reachy.checked(Target(body_yaw=_angle("body_yaw", "yaw", yaw)))
            return self.answering(lambda: self.reachy.go(target, "body"))

        return await self.move("body", prepare)

    @rpc(labels=_MOTION)
    async def nod(self) -> dict[str, Any]:
        """Nod the head: yes."""
        return await self.act("nod", lambda: self.reachy.gesture("nod"))

    @rpc(labels=_MOTION)
    async def shake(self) -> dict[str, Any]:
        """Shake the head: no."""
        return await self.act("shake", lambda: self.reachy.gesture("shake"))

    @rpc(labels=_MOTION)
    async def happy(self) -> dict[str, Any]:
        """Wiggle the antennas: happy."""
        return await self.act("happy", lambda: self.reachy.gesture("happy"))

    @rpc(labels=_MOTION)
    async def wakeUp(self) -> dict[str, Any]:
        """Enable the motors, make sure that they are, and play the wake-up; its end is told by motionComplete."""
        return await self.act("wakeUp", self.reachy.wake_up)

    @rpc(labels=_MOTION)
    async def sleep(self) -> dict[str, Any]:
        """Lie down, with the motors off at the end; the end is told by motionComplete."""
        return await self.act("sleep", self.reachy.sleep)

    @rpc(labels=_MOTION)
    async def playMove(self, move_name: str, library: str = "emotions") -> dict[str, Any]:
        """Play a recorded move; its end is told by motionComplete.

        Args:
            move_name: Name of the move, as listMoves gives it
            library: Which library, one of 'emotions' or 'dances'
        """

        def prepare() -> Call:
            name, known = identifier("move_name", move_name), choice("library", library, tuple(LIBRARIES))
            return self.answering(lambda: self.reachy.catalogue.play(name, known))

        return await self.move("playMove", prepare)

    @rpc(labels=_MOTION)
    async def enableMotors(self, motor_ids: str = "") -> dict[str, Any]:
        """Switch torque on. Whatever moves is stopped first.

        Args:
            motor_ids: Comma list of motor names or bus ids; empty for all
        """
        return await self._torque("enableMotors", True, motor_ids)

    @rpc(labels=_MOTION)
    async def disableMotors(self, motor_ids: str = "") -> dict[str, Any]:
        """Switch torque off; the head drops. Whatever moves is stopped first.

        Args:
            motor_ids: Comma list of motor names or bus ids; empty for all
        """
        return await self._torque("disableMotors", False, motor_ids)

    async def _torque(self, verb: str, on_: bool, motor_ids: object) -> Envelope:
        def prepare() -> Call:
            names = ",".join(motor_names(motor_ids))
            return self.answering(lambda: self.reachy.motors.torque(on_, names, verb))

        return await self.move(verb, prepare)

    # Stops and reads: answered to every caller.

    @rpc(labels=_MOTION)
    async def stopMotion(self) -> dict[str, Any]:
        """Stop everything that moves now, gestures and every move of the daemon; the answer says what stopped."""
        return await self.halted(lambda: self.halt("stopMotion").envelope())

    @rpc(labels=_READ)
    async def getStatus(self) -> dict[str, Any]:
        """Link, daemon state and version, motor mode, application, data age, motion, and what holds the robot."""
        return await self.read("getStatus", self.with_safety(lambda: success("Reachy Mini.", **self.reachy.facts())))

    @rpc(labels=_READ)
    async def getDaemonStatus(self) -> dict[str, Any]:
        """The daemon's own status object under this device's verdict, or why the daemon was not reached."""
        return await self.read("getDaemonStatus", self.answering(self._daemon_status))

    @rpc(labels=_READ)
    async def getJoints(self) -> dict[str, Any]:
        """Joint positions by motor name in radians and their age in seconds; stale ones are refused."""
        return await self.read("getJoints", self.reachy.get_joints)

    @rpc(labels=_READ)
    async def getImu(self) -> dict[str, Any]:
        """Accelerometer, gyroscope, quaternion (w x y z), temperature and their age; stale ones are refused."""
        return await self.read("getImu", self.reachy.get_imu)

    @rpc(labels=_READ)
    async def listMoves(self, library: str = "emotions") -> dict[str, Any]:
        """Names of the recorded moves, or why they are unknown.

        Args:
            library: Which library, one of 'emotions' or 'dances'
        """
        return await self.read("listMoves", lambda: self.reachy.catalogue.names(library))

    def _daemon_status(self) -> Envelope:
        payload = self.reachy.connection.rest.get(STATUS_PATH)
        if not isinstance(payload, dict):
            return error(f"The daemon's status is no object: {shown(payload)}.")
        told = success("The daemon's status.", daemon=payload)
        return {**payload, "status": told["status"], "content": told["content"]}

    # Emergency.

    @emit(labels={"safety": "critical"})
    async def emergencyStop(self, reason: str = "") -> None:
        """This device halts, holds or releases its torque as configured, and calls for an emergency stop.

        Args:
            reason: Why the emergency stop was triggered
        """
        told = await self.halted(lambda: self.reachy.emergency_stop(reason, release=self._release))
        level = logging.WARNING if told.get("stopped") else logging.CRITICAL
        text = told["content"][0]["text"]
        logger.log(level, "%s: emergency stop (%s): %s Torque %s.", self.peer_id, reason, text, told.get("torque"))

    @emit()
    async def motionComplete(self, name: str, state: str, detail: str = "", duration: float = 0.0) -> None:
        """A motion ended.

        Args:
            name: Which motion, by its function or recorded move
            state: How it ended: completed, stopped, error or unknown
            detail: What ended it, or where it is instead of where it should be
            duration: Seconds from its start to its end
        """

    @emit()
    async def stateUpdate(
        self, moving: str = "", link: str = "", motor_mode: str = "", data_age_s: float = 0.0
    ) -> None:
        """What the robot is doing, told at a steady rate while it is available.

        Args:
            moving: Which motion runs, empty for none
            link: websocket or zenoh
            motor_mode: enabled, disabled or gravity_compensation
            data_age_s: Age of the newest joint sample in seconds
        """

    # What the base asks.

    def glance(self) -> Activity:
        """The driver's facts; away, they are its fault."""
        facts = self.reachy.facts()
        told = {key: facts[key] for key in ("moving", "link", "motor_mode")}
        return Activity(bool(facts["moving"]), {**told, "data_age_s": facts["data_age_s"] or 0.0}, facts["unavailable"])

    async def tell(self, activity: Activity) -> None:
        """Emit ``stateUpdate``."""
        await self.stateUpdate(**activity.facts)

    async def tell_rollout(self, event: RolloutEvent) -> None:
        """Emit ``motionComplete``."""
        if event.kind == "finished":
            await self.motionComplete(
                name=event.instruction, state=event.state, detail=event.error, duration=round(event.elapsed_s, 3)
            )
            self.changed.set()
