"""Reachy Mini as a device with LeRobot's five verbs, and with the verbs of its own daemon."""

from __future__ import annotations

import time
from typing import Any

from strands_robots.contract import Observer, Unsubscribe
from strands_robots.drivers.reachy import gestures
from strands_robots.drivers.reachy.catalogue import Library
from strands_robots.drivers.reachy.connection import Connection
from strands_robots.drivers.reachy.envelope import (
    ACTION_KEYS,
    BOUNDS,
    INIT_ANTENNAS,
    SLEEP_ANTENNAS,
    Target,
    check,
    from_action,
)
from strands_robots.drivers.reachy.feed import FRESH_S
from strands_robots.drivers.reachy.links import ZENOH_PORT, PubSub
from strands_robots.drivers.reachy.motion import Motions, head_distance
from strands_robots.drivers.reachy.motors import Motors
from strands_robots.drivers.reachy.rest import DaemonError, DaemonUnreachable
from strands_robots.drivers.reachy.transport import DEFAULT_PREFIX, SLEEP_DISABLES_SINCE
from strands_robots.envelope import Envelope, error, success
from strands_robots.safety.gate import MotionGate
from strands_robots.safety.stopping import StopVerdict
from strands_robots.utils import flag

UPRIGHT_LEGS = (0.6265, -0.6265, 0.6265, -0.6265, 0.6265, -0.6265)
"""Legs of the head at the identity, in radians, by the daemon's own inverse kinematics."""

ARRIVED = 0.2
POSE_EVERY_S = 0.005
GESTURES = {"nod": gestures.nod, "shake": gestures.shake, "happy": gestures.happy}


class ReachyDriver:
    """One Reachy Mini behind its daemon. Thread-safe; verbs that start a motion return at once.

    Args:
        host: bare hostname or IP literal of the daemon.
        prefix: of the Zenoh keys of a daemon before 1.5; the default gives way to the robot's own name.
        api_port: TCP port of the daemon.
        transport: ``auto`` for what the daemon speaks, ``websocket`` or ``zenoh``.
        automatic_body_yaw: let the daemon turn the body along with the head; without it head and body may be at most
            65 degrees apart.
        session: a pub/sub object for the Zenoh link in place of a session of its own.
        zenoh_port: where a daemon before 1.5 listens for it.

    Raises:
        ValidationError: an argument outside its domain.
    """

    name = "reachy_mini"
    tool_name_str = "reachy_mini"
    device_type = "reachy_mini"

    def __init__(
        self,
        host: str = "reachy-mini.local",
        prefix: str = DEFAULT_PREFIX,
        api_port: int = 8000,
        *,
        transport: str = "auto",
        automatic_body_yaw: bool = True,
        session: PubSub | None = None,
        zenoh_port: int = ZENOH_PORT,
    ) -> None:
        self._automatic = flag("automatic_body_yaw", automatic_body_yaw)
        self.connection = Connection(
            host, api_port, prefix=prefix, transport=transport, session=session, zenoh_port=zenoh_port
        )
        self.gate = MotionGate()
        self.motions = Motions(self.connection, self.gate, self.tool_name_str, automatic_body_yaw=self._automatic)
        self.motors = Motors(self.connection, self.motions)
        self.catalogue = Library(self.connection, self.motions)

    @property
    def safety_key(self) -> str:
        """Under which a lockout of this robot is remembered, whatever device id it is given."""
        return f"hardware:{self.tool_name_str}:{self.connection.host}:{self.connection.port}"

    # LeRobot's verbs.

    @property
    def observation_features(self) -> dict[str, type]:
        """Keys of :meth:`get_observation`: metres and radians."""
        return dict.fromkeys(ACTION_KEYS, float)

    @property
    def action_features(self) -> dict[str, type]:
        """Keys of :meth:`send_action`: metres and radians."""
        return dict.fromkeys(ACTION_KEYS, float)

    @property
    def joint_ranges(self) -> dict[str, tuple[float, float]]:
        """Lowest and highest value of each key of :meth:`send_action`: metres and radians."""
        return dict(BOUNDS)

    @property
    def is_connected(self) -> bool:
        """Joint data arrives."""
        return self.connection.alive

    @property
    def is_calibrated(self) -> bool:
        """Always: the daemon calibrates its robot."""
        return True

    def calibrate(self) -> None:
        """Nothing to do: the daemon calibrates its robot."""

    def configure(self) -> None:
        """Nothing to do: the daemon configures its motors."""

    def connect(self, calibrate: bool = False, *, within_s: float = 10.0) -> None:
        """Connect, and wait until joint data arrives, and for its first head pose.

        Raises:
            DaemonUnreachable: no joint data ``within_s``; the driver has let go again.
        """
        del calibrate
        self.connection.start()
        if not self.connection.wait(within_s):
            why = self.connection.refusal()
            self.connection.close()
            raise DaemonUnreachable(f"Reachy Mini at {self.connection.host}:{self.connection.port}: {why}.")
        # The head's pose is a message of its own, and an observation needs both.
        deadline = time.monotonic() + min(within_s, FRESH_S)
        while self.connection.feed.pose() is None and time.monotonic() < deadline:
            time.sleep(POSE_EVERY_S)

    def connect_eagerly(self, within_s: float = 5.0) -> Envelope:
        """Connect and say how it went; a robot that is away is connected to as soon as it appears. Never raises."""
        self.connection.start()
        if self.connection.wait(within_s):
            return success("Connected.", **self.facts())
        return error(
            f"Reachy Mini at {self.connection.host} is unavailable: {self.connection.refusal()}.", **self.facts()
        )

    def disconnect(self) -> None:
        """Halt what we started, then let go. The robot holds its pose."""
        if self.connection.connects:
            self.motions.halt("disconnect")
        self.gate.revoke()
        self.connection.close()

    def cleanup(self) -> None:
        """The same as :meth:`disconnect`."""
        self.disconnect()

    def get_observation(self) -> dict[str, float]:
        """Measured head pose, body yaw and antennas by action key, in metres and radians.

        Raises:
            DaemonUnreachable: not connected, or the data is older than 1.5 s.
        """
        joints, pose = self.connection.feed.fresh_joints, self.connection.feed.pose()
        if joints is None or pose is None:
            raise DaemonUnreachable(
                f"Reachy Mini has no fresh data: {self.connection.refusal() or 'unusable numbers'}."
            )
        return Target(pose, joints.body_yaw, joints.antennas).action()

    def send_action(self, action: dict[str, Any]) -> dict[str, float]:
        """Send one frame and return what was really sent: at most 0.3 rad and 10 mm from the last one, at 50 Hz.

        Raises:
            ValidationError: a key or value outside the envelope.
            MotionRefused: halted, locked, not connected, or held by an application.
        """
        target = self.checked(from_action(action, self.motions.present()))
        return self.motions.stream(target, "send_action").action()

    def hold(self) -> None:
        """Stop whatever moves the robot, so that it keeps its pose: how a control loop around this driver freezes it.

        Raises:
            DaemonError: it is not known to stand still.
        """
        verdict = self.halt("hold")
        if not verdict.stopped:
            raise DaemonError(f"Reachy Mini is not known to stand still: {verdict.envelope().get('reason')}")

    # Reachy's own verbs. Each raises MotionRefused, ValidationError or DaemonError where it does not do it.

    def checked(self, target: Target) -> Target:
        """``target`` when the robot can reach it from where it is. Raises :class:`ValidationError`."""
        return check(target, automatic_body_yaw=self._automatic, body_yaw=self.motions.present().body_yaw)

    def go(self, target: Target, name: str = "go") -> Envelope:
        """Move to a target; a short way in one frame, a longer one by a ramp that goes on after the return."""
        ramped = self.motions.go(self.checked(target), name)
        return success(f"{name}: {'moving there' if ramped else 'sent'}.", target=target.action(), ramp=ramped)

    def gesture(self, name: str) -> Envelope:
        """Start ``nod``, ``shake`` or ``happy``."""
        self.motions.gesture(GESTURES[name], name)
        return success(f"{name}: started.", motion=name)

    def wake_up(self) -> Envelope:
        """Enable the motors, make sure of it, and play the daemon's wake-up; its end is told by event and status."""

        def enable() -> None:
            self.motors.set_mode("enabled")

        uuid = self.motions.daemon_move("wakeUp", "/api/move/play/wake_up", reached=self._awake, before=enable)
        return success("Motors enabled; waking up.", motor_mode="enabled", uuid=uuid)

    def sleep(self) -> Envelope:
        """Play the daemon's way to sleep, after which the motors are off; the end is told by event and status."""
        uuid = self.motions.daemon_move("sleep", "/api/move/play/goto_sleep", reached=self._asleep)
        return success("Going to sleep.", uuid=uuid)

    def subscribe(self, observer: Observer) -> Unsubscribe:
        """Tell ``observer`` of every motion's end."""
        return self.motions.subscribe(observer)

    def halt(self, reason: str = "") -> StopVerdict:
        """Stop every motion source: gestures, ramps, streams, and every move that the daemon runs."""
        return self.motions.halt(reason)

    def emergency_stop(self, reason: str = "", *, release: bool = False) -> Envelope:
        """Halt, then hold the pose or, with ``release``, switch the motors off; says what it did."""
        verdict = self.halt(reason).envelope()
        if not flag("release", release):
            return {**verdict, "torque": "held"}
        try:
            self.motors.release()
        except Exception as exc:  # noqa: BLE001 - an emergency stop reports whatever its parts did
            return error(f"{verdict['content'][0]['text']} Torque was not released: {exc}", stopped=verdict["stopped"])
        return {**verdict, "torque": "released"}

    def get_joints(self) -> Envelope:
        """Joint positions by motor name, radians, and their age; stale ones are refused."""
        joints = self.connection.feed.joints
        age = time.monotonic() - joints.at if joints else None
        if joints is None or age is None or age > FRESH_S or not self.connection.alive:
            return error(f"Joint data is stale: {self.connection.refusal() or 'no usable numbers'}.", age_s=age)
        return success("Joint positions in radians.", joints=joints.named(), age_s=round(age, 4))

    def get_imu(self) -> Envelope:
        """The inertial sample and its age; stale ones are refused, and a robot without a sensor says so."""
        imu = self.connection.feed.imu()
        if imu is None:
            why = self.connection.refusal()
            return error(f"No IMU data: {why}." if why else "This Reachy Mini has no IMU.")
        age = time.monotonic() - imu.at
        if age > FRESH_S:
            return error(f"IMU data is stale: {age:.1f} s old.", age_s=round(age, 3))
        return success(
            "Acceleration in m/s^2, angular rate in rad/s, quaternion w x y z, temperature in degrees Celsius.",
            accelerometer=list(imu.accelerometer),
            gyroscope=list(imu.gyroscope),
            quaternion=list(imu.quaternion),
            temperature=imu.temperature,
            age_s=round(age, 4),
        )

    def facts(self) -> dict[str, Any]:
        """The driver's whole truth: link, daemon, motors, application, data age, motion, and how far off target."""
        connection, info, feed = self.connection, self.connection.info, self.connection.feed
        motion, joints = self.motions.current, feed.joints
        off = head_distance(self.motions.sent_head, feed.pose())
        return {
            "connected": connection.alive,
            "unavailable": connection.refusal() or "",
            "link": connection.link_kind,
            "version": str(info.raw.get("version") or "") if info else "",
            "daemon_state": info.state if info else "",
            "daemon_error": info.error if info else "",
            "motor_mode": connection.motor_mode,
            "app": connection.polled.holder,
            "data_age_s": round(time.monotonic() - joints.at, 3) if joints else None,
            "moving": motion.name if motion and motion.running else "",
            "last_motion": motion.facts() if motion else None,
            "foreign_moves": len(connection.polled.moves - {motion.uuid if motion else ""}),
            "head_error_rad": round(off, 4) if off is not None else None,
            "unusable_frames": feed.unusable_frames,
        }

    def _awake(self) -> str:
        joints = self.connection.feed.fresh_joints
        if joints is None:
            return "no joint data at its end"
        off = [abs(a - b) for a, b in zip(joints.head[1:], UPRIGHT_LEGS, strict=True)]
        off += [abs(a - b) for a, b in zip(joints.antennas, INIT_ANTENNAS, strict=True)]
        return "" if max(off) <= ARRIVED else f"a joint is {max(off):.2f} rad from upright"

    def _asleep(self) -> str:
        joints = self.connection.feed.fresh_joints
        if joints is None:
            return "no joint data at its end"
        off = max(abs(a - b) for a, b in zip(joints.antennas, SLEEP_ANTENNAS, strict=True))
        if off > ARRIVED:
            return f"an antenna is {off:.2f} rad from its place for sleep"
        info = self.connection.info
        if info is not None and not info.since(SLEEP_DISABLES_SINCE):
            self.motors.release()
        mode = self.motors.mode()
        return "" if mode == "disabled" else f"the motors are {mode}"
