"""Reachy Mini with LeRobot's five verbs and the verbs of its own daemon."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

from strands_robots import settings
from strands_robots.audit import queue_safety_event
from strands_robots.contract import AT_REST, Observer, Unsubscribe
from strands_robots.drivers.reachy.connection import FRESH_S, JOINTS, Connection
from strands_robots.drivers.reachy.links import (
    DEFAULT_PREFIX,
    SLEEP_DISABLES_SINCE,
    STOP_MOVE_SINCE,
    ZENOH_PORT,
    PubSub,
)
from strands_robots.drivers.reachy.motion import MotionController
from strands_robots.drivers.reachy.rest import (
    DaemonError,
    DaemonFaultError,
    DaemonUnreachableError,
    RestClient,
    StopRounds,
)
from strands_robots.drivers.reachy.target import (
    ACTION_KEYS,
    BOUNDS,
    GESTURES,
    INIT_ANTENNAS,
    SLEEP_ANTENNAS,
    Target,
    check,
    from_action,
)
from strands_robots.envelope import Envelope, error, success, text_of
from strands_robots.safety.gate import MotionGate, MotionRequest
from strands_robots.safety.stop_executor import RETURN_SHARE
from strands_robots.safety.stop_targets import halted_with_verbs
from strands_robots.safety.stopping import StopVerdict
from strands_robots.utils import ValidationError, choice, flag, identifier, shown, text

UPRIGHT_LEGS = (0.6265, -0.6265, 0.6265, -0.6265, 0.6265, -0.6265)
"""Legs of the head at the identity, in radians, by the daemon's own inverse kinematics."""

ARRIVED = 0.2
"""Largest error of a joint at the end of a move, in radians."""

POSE_EVERY_S = 0.005

NO_POLICIES = "{} follows no policy; move it with look, a gesture such as nod, or playMove."

MOTOR_IDS = {
    "body_rotation": 10,
    **{f"stewart_{leg}": 10 + leg for leg in range(1, 7)},
    "right_antenna": 17,
    "left_antenna": 18,
}
"""Motor names that the daemon knows, and their ids on the bus."""

LIBRARIES = {
    "emotions": "pollen-robotics/reachy-mini-emotions-library",
    "dances": "pollen-robotics/reachy-mini-dances-library",
}
"""Data sets of recorded moves."""


def motor_names(motor_ids: object) -> tuple[str, ...]:
    """Return the motors of a comma list of names or bus ids; empty for all.

    Raises:
        ValidationError: no text, a part that is no motor, or a list that names none.
    """
    chosen = text("motor_ids", motor_ids, longest=200, empty=True)
    if not chosen:
        return ()
    by_id = {str(number): name for name, number in MOTOR_IDS.items()}
    parts = [part.strip() for part in chosen.split(",") if part.strip()]
    names = tuple(dict.fromkeys(by_id.get(part, part) for part in parts))
    if not names or any(name not in MOTOR_IDS for name in names):
        known = ", ".join(f"{name} ({number})" for name, number in MOTOR_IDS.items())
        raise ValidationError(f"motor_ids must name motors of {known}, or be empty for all, not {shown(motor_ids)}.")
    return names


class Motors:
    """Torque of one robot's motors.

    The mode of all motors is verified by asking back; the daemon never reports the torque of a single motor. Every
    method raises :class:`DaemonError` where the daemon fails.
    """

    def __init__(self, connection: Connection, motions: MotionController) -> None:
        self._connection, self._motions = connection, motions
        self._set_singly = False

    def mode(self, rest: RestClient | None = None, within_s: float | None = None) -> str:
        """Return the daemon's mode: enabled, disabled or gravity_compensation."""
        answer = (rest or self._connection.rest).get("/api/motors/status", within_s)
        mode = str(answer.get("mode")) if isinstance(answer, dict) else "unknown"
        self._connection.note_mode(mode)
        return mode

    def set_mode(self, mode: str) -> None:
        """Set the mode of all motors and verify it."""
        info = self._connection.info
        if mode == "enabled" and self._set_singly and info is not None and not info.since(STOP_MOVE_SINCE):
            # Before 1.10 a robot ignored this after torque was set motor by motor, unless all were off in between.
            self._connection.rest.post("/api/motors/set_mode/disabled")
        self._set(mode, self._connection.rest)
        self._set_singly = False

    def release(self, within_s: float = 1.0, names: tuple[str, ...] = ()) -> None:
        """Switch all motors off, or those of ``names``, without a turn or a permit."""
        if names:
            self._connection.link().send_torque(False, names)
            self._set_singly = True
        else:
            self._set("disabled", self._connection.stop_rest, within_s)
        self._motions.forget_sent()

    def _set(self, mode: str, rest: RestClient, within_s: float | None = None) -> None:
        rest.post(f"/api/motors/set_mode/{mode}", within_s=within_s)
        now = self.mode(rest, within_s)
        if now != mode:
            raise DaemonFaultError(f"the motors were to be {mode} and are {now}.")

    def torque(self, on: bool, motor_ids: str, name: str, *, request: MotionRequest | None = None) -> Envelope:
        """Switch the torque of all or some motors; ``name`` is the caller's verb."""
        names, mode = motor_names(motor_ids), "enabled" if on else "disabled"
        if not names:
            self._motions.torque(lambda: self.set_mode(mode), name, request)
            return success(f"All motors are {mode}.", motors="all", motor_mode=mode, verified=True)

        def change() -> None:
            self._connection.link().send_torque(on, names)
            self._set_singly = True

        self._motions.torque(change, name, request)
        return success(
            f"Asked for {', '.join(names)} {mode}; the daemon does not report the torque of a single motor.",
            motors=list(names),
            verified=False,
        )


class RecordedMoves:
    """Recorded moves of one robot's daemon, kept on a hub that may be out of reach.

    A daemon that asks a hub which accepts and does not answer freezes as a whole, stop included (measured: over
    120 s). So a data set that is not known to be in the daemon's cache is asked for only while nothing moves, over a
    connection of its own.
    """

    def __init__(self, connection: Connection, motions: MotionController) -> None:
        self._connection, self._motions = connection, motions
        self._known: dict[str, tuple[int, tuple[str, ...]]] = {}

    def names(self, library: str) -> Envelope:
        """Answer with the ``moves`` of a library, or why they are unknown."""
        checked = choice("library", library, tuple(LIBRARIES))
        refusal = self._fetch(checked)
        if refusal is not None:
            return refusal
        moves = list(self._known[checked][1])
        return success(f"{len(moves)} recorded moves in {checked}.", library=checked, moves=moves)

    def play(self, move_name: str, library: str, *, request: MotionRequest | None = None) -> Envelope:
        """Start a recorded move; an event reports its end."""
        name = identifier("move_name", move_name)
        checked = choice("library", library, tuple(LIBRARIES))
        reason = self._connection.refusal()
        if reason is not None:
            return error(f"playMove refused: {reason}.")
        refusal = self._fetch(checked)
        if refusal is not None:
            return refusal
        if name not in self._known[checked][1]:
            return error(f"{checked} has no move {name!r}; listMoves has the names.")
        path = f"/api/move/play/recorded-move-dataset/{LIBRARIES[checked]}/{name}"
        uuid = self._motions.daemon_move(name, path, request, arrived=str)
        return success(f"Playing {name}.", move=name, library=checked, uuid=uuid)

    def _fetch(self, library: str) -> Envelope | None:
        """Fetch the names if needed, and with them the data set; return a refusal."""
        known = self._known.get(library)
        if known is not None and known[0] == self._connection.connects:
            return None
        unknown = f"The catalogue of {library} is unknown"
        try:
            if self._motions.moving():
                return error(f"{unknown}, and asking while the robot moves could freeze its daemon; stop it first.")
            answer = self._connection.hub_rest.get(f"/api/move/recorded-move-datasets/list/{LIBRARIES[library]}")
        except (DaemonError, ValidationError) as exc:
            return error(f"{unknown}: {exc}")
        if not isinstance(answer, list) or not all(isinstance(name, str) for name in answer):
            return error(f"{unknown}: the daemon's answer is no list of names.")
        self._known[library] = (self._connection.connects, tuple(answer))
        return None


class ReachyDriver:
    """One Reachy Mini. Thread-safe; verbs that start a motion return at once.

    Args:
        host: bare hostname or IP literal of the daemon.
        prefix: of the Zenoh keys of a daemon before 1.5; the default gives way to the robot's own name.
        api_port: TCP port of the daemon.
        transport: ``auto`` for the link that the daemon speaks, ``websocket`` or ``zenoh``.
        automatic_body_yaw: let the daemon turn the body along with the head; without it head and body may be at most
            65 degrees apart.
        session: a pub/sub object for the Zenoh link in place of a session of its own.
        zenoh_port: Zenoh port of a daemon before 1.5.
        release_on_estop: switch the motors off at every emergency stop; the head drops. By default it holds.

    Raises:
        ValidationError: an argument outside its domain.
    """

    holds_unconnected = True
    """:meth:`hold` reaches the daemon without the link that frames need."""

    takes_tasks = False
    """It follows no policy: :meth:`start_task` refuses."""

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
        release_on_estop: bool = False,
    ) -> None:
        self.release_on_estop = flag("release_on_estop", release_on_estop)
        self._automatic = flag("automatic_body_yaw", automatic_body_yaw)
        self.connection = Connection(
            host, api_port, prefix=prefix, transport=transport, session=session, zenoh_port=zenoh_port
        )
        self.gate = MotionGate()
        self.motions = MotionController(
            self.connection, self.gate, self.tool_name_str, automatic_body_yaw=self._automatic
        )
        self.motors = Motors(self.connection, self.motions)
        self._releases: StopRounds[None] = StopRounds(self._release)
        self.catalogue = RecordedMoves(self.connection, self.motions)

    @property
    def safety_key(self) -> str:
        """Key of this robot's lockout in the store, independent of its device id."""
        return f"hardware:{self.tool_name_str}:{self.connection.host}:{self.connection.port}"

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
        """Lowest and highest value of each action key, in metres and radians."""
        return dict(BOUNDS)

    @property
    def is_connected(self) -> bool:
        """Joint data arrives."""
        return self.connection.alive

    @property
    def is_calibrated(self) -> bool:
        """Always true: the daemon calibrates its robot."""
        return True

    def calibrate(self) -> None:
        """Do nothing: the daemon calibrates its robot."""

    def configure(self) -> None:
        """Do nothing: the daemon configures its motors."""

    def connect(self, calibrate: bool = False, *, within_s: float = 10.0) -> None:
        """Connect and wait for joint data and the first head pose.

        Raises:
            DaemonUnreachableError: no joint data ``within_s``; the driver has disconnected again.
        """
        del calibrate
        self.connection.start()
        if not self.connection.wait(within_s):
            reason = self.connection.refusal()
            self.connection.close()
            raise DaemonUnreachableError(f"Reachy Mini at {self.connection.host}:{self.connection.port}: {reason}.")
        # The head's pose is a message of its own, and an observation needs both.
        deadline = time.monotonic() + min(within_s, FRESH_S)
        while self.connection.feed.pose() is None and time.monotonic() < deadline:
            time.sleep(POSE_EVERY_S)

    def connect_eagerly(self, within_s: float = 5.0) -> Envelope:
        """Connect and answer with the result; the driver goes on trying. Never raises."""
        self.connection.start()
        if self.connection.wait(within_s):
            return success("Connected.", **self.facts())
        return error(
            f"Reachy Mini at {self.connection.host} is unavailable: {self.connection.refusal()}.", **self.facts()
        )

    def disconnect(self) -> None:
        """Halt every motion, then disconnect. The robot keeps its pose."""
        if self.connection.connects:
            self.motions.halt("disconnect")
        self.gate.revoke()
        self.connection.close()

    def cleanup(self) -> None:
        """Disconnect, as :meth:`disconnect` does."""
        self.disconnect()

    def get_observation(self) -> dict[str, float]:
        """Return the measured pose by action key, in metres and radians.

        Raises:
            DaemonUnreachableError: not connected, or the data is older than 1.5 s.
        """
        joints, pose = self.connection.feed.fresh_joints, self.connection.feed.pose()
        if joints is None or pose is None:
            raise DaemonUnreachableError(
                f"Reachy Mini has no fresh data: {self.connection.refusal() or 'unusable numbers'}."
            )
        return Target(pose, joints.body_yaw, joints.antennas).action()

    def send_action(self, action: dict[str, Any], *, request: MotionRequest | None = None) -> dict[str, float]:
        """Send one frame, at most 0.3 rad and 10 mm from the last, and return it.

        Raises:
            ValidationError: an unknown key, or a value outside its bounds.
            MotionRefused: halted, locked, not connected, or held by an application.
        """
        target = self.checked(from_action(action, self.motions.present()))
        return self.motions.stream(target, "send_action", request).action()

    def hold(self) -> None:
        """Stop every motion for a control loop around this driver; the pose is kept.

        Raises:
            DaemonError: it is not known to stand still.
        """
        verdict = self.halt("hold")
        if not verdict.stopped:
            raise DaemonError(f"Reachy Mini is not known to stand still: {verdict.envelope().get('reason')}")

    # Reachy's own verbs. A verb that fails raises MotionRefused, ValidationError or DaemonError.

    def checked(self, target: Target) -> Target:
        """Return a reachable ``target``. Raises :class:`ValidationError` for any other."""
        return check(target, automatic_body_yaw=self._automatic, body_yaw=self.motions.present().body_yaw)

    def go(self, target: Target, name: str = "go", *, request: MotionRequest | None = None) -> Envelope:
        """Move to a target in one frame, or by a ramp that goes on after the return."""
        ramped = self.motions.go(self.checked(target), name, request)
        return success(f"{name}: {'moving there' if ramped else 'sent'}.", target=target.action(), ramp=ramped)

    def gesture(self, name: str, *, request: MotionRequest | None = None) -> Envelope:
        """Start ``nod``, ``shake`` or ``happy``."""
        self.motions.gesture(GESTURES[name], name, request)
        return success(f"{name}: started.", motion=name)

    def wake_up(self, *, request: MotionRequest | None = None) -> Envelope:
        """Enable the motors and start the daemon's wake-up; an event reports its end."""
        uuid = self.motions.daemon_move(
            "wakeUp",
            "/api/move/play/wake_up",
            request,
            arrived=self._awake,
            before=lambda: self.motors.set_mode("enabled"),
        )
        return success("Motors enabled; waking up.", motor_mode="enabled", uuid=uuid)

    def sleep(self, *, request: MotionRequest | None = None) -> Envelope:
        """Start the daemon's way to sleep, which ends with motors off, and an event."""
        uuid = self.motions.daemon_move("sleep", "/api/move/play/goto_sleep", request, arrived=self._asleep)
        return success("Going to sleep.", uuid=uuid)

    def subscribe(self, observer: Observer) -> Unsubscribe:
        """Call ``observer`` at every motion's end."""
        return self.motions.observers.subscribe(observer)

    # The robot contract, so that every network takes a Reachy Mini.

    def start_task(
        self, instruction: str, policy_provider: str = "mock", duration: float = 30.0, policy_port: int = 0
    ) -> Envelope:
        """Refuse: a Reachy Mini has motions of its own, it follows no policy."""
        del instruction, policy_provider, duration, policy_port
        return error(NO_POLICIES.format(self.tool_name_str))

    def stop_task(self) -> Envelope:
        """Halt, as :meth:`halt` does."""
        return self.halt("stop").envelope()

    def get_task_status(self) -> Envelope:
        """Return :meth:`facts`, with ``task_status`` of the present or the last motion."""
        task = self._task()
        return success(f"{task['instruction'] or 'No motion'}: {task['task_status']}.", **self.facts(), **task)

    def get_features(self) -> Envelope:
        """Return the features of observations and actions, ``ranges``, ``joint_units``.

        The joints are those of :meth:`get_state`: the motors, which no action names.
        """
        features = dict.fromkeys(ACTION_KEYS, "float")
        return success(
            "A Reachy Mini: metres and radians.",
            observation_features=features,
            action_features=features,
            ranges={key: list(bounds) for key, bounds in BOUNDS.items()},
            joint_units=dict.fromkeys(JOINTS, "radians"),
        )

    def get_state(self) -> Envelope:
        """Return ``joints`` in radians by motor, ``joints_age_s`` and ``task``."""
        joints = self.get_joints()
        fields: dict[str, Any] = {"joints": joints.get("joints", {}), "joints_age_s": joints["age_s"]}
        if joints["status"] == "error":
            fields["joints_error"] = str(joints["reason"])
        return success(text_of(joints), **fields, task=self._task())

    def halt_ordered(self) -> None:
        """Note what moves before the permits are void."""
        self.motions.halt_ordered()

    def halt(self, reason: str = "") -> StopVerdict:
        """Stop gestures, ramps, streams, and every move that the daemon runs.

        While it is locked by an emergency stop, the motors go off as well where ``release_on_estop`` says so.
        """
        deadline = time.monotonic() + RETURN_SHARE * settings.number("STRANDS_HALT_DEADLINE_S")
        return halted_with_verbs(self, lambda: self._halt(reason), deadline)

    def _halt(self, reason: str) -> StopVerdict:
        began = time.monotonic()
        verdict = self.motions.halt(reason)
        locked = self.gate.lockout("motion") or {}
        if not (self.release_on_estop and locked.get("locked") is True):
            return verdict
        left = 0.95 * settings.number("STRANDS_HALT_DEADLINE_S") - (time.monotonic() - began)
        try:
            self._releases.claim(None, max(left, 0.1)).wait()
        except Exception as exc:  # noqa: BLE001 - a stop reports every failure of its parts
            return replace(verdict, unknown={**verdict.unknown, "torque": f"it was not released: {exc}"})
        return verdict

    def release_torque(self, motor_ids: str = "") -> Envelope:
        """Stop every motion and switch motors off; it works while the robot is locked.

        Args:
            motor_ids: names or bus ids with commas, which the daemon offers no way to verify. Empty for all, verified.
        """
        names = motor_names(motor_ids)
        verdict = self.halt("releaseTorque").envelope()
        fields = {key: value for key, value in verdict.items() if key not in ("status", "content", "reason")}
        try:
            self.motors.release(names=names)
        except Exception as exc:  # noqa: BLE001 - as in halt
            return error(f"{verdict['content'][0]['text']} Torque was not released: {exc}", **fields, released=[])
        queue_safety_event("torque_released", self.tool_name_str, {"motors": list(names) or "all"})
        released = list(names or MOTOR_IDS)
        text = f"Torque is off: {', '.join(names) or 'all motors'}."
        if verdict["status"] == "error":
            return error(f"{text} {verdict['content'][0]['text']}", **fields, released=released)
        return success(text, **fields, released=released, verified=not names)

    def emergency_stop(self, reason: str = "", *, release: bool = False) -> Envelope:
        """Halt, then keep the pose or, with ``release``, switch the motors off."""
        verdict = self.halt(reason).envelope()
        if not flag("release", release):
            return {**verdict, "torque": "held"}
        try:
            self.motors.release()
        except Exception as exc:  # noqa: BLE001 - an emergency stop reports every failure of its parts
            return error(f"{verdict['content'][0]['text']} Torque was not released: {exc}", stopped=verdict["stopped"])
        return {**verdict, "torque": "released"}

    def get_joints(self) -> Envelope:
        """Answer with fresh joint positions by motor name in radians, and their age."""
        joints = self.connection.feed.joints
        age = time.monotonic() - joints.at if joints else None
        if joints is None or age is None or age > FRESH_S or not self.connection.alive:
            return error(f"Joint data is stale: {self.connection.refusal() or 'no usable numbers'}.", age_s=age)
        return success("Joint positions in radians.", joints=joints.named(), age_s=round(age, 4))

    def get_imu(self) -> Envelope:
        """Answer with a fresh inertial sample and its age."""
        imu = self.connection.feed.imu()
        if imu is None:
            reason = self.connection.refusal()
            return error(f"No IMU data: {reason}." if reason else "This Reachy Mini has no IMU.")
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
        """Return the state of link, daemon, motors, application, data and motion."""
        connection, info, feed = self.connection, self.connection.info, self.connection.feed
        motion, joints = self.motions.current, feed.joints
        sent, measured = self.motions.sent_head, feed.pose()
        return {
            "connected": connection.alive,
            "unavailable": connection.refusal() or "",
            "link": connection.link_kind,
            "version": str(info.raw.get("version") or "") if info else "",
            "daemon_state": info.state if info else "",
            "daemon_error": info.error if info else "",
            "motor_mode": connection.motor_mode,
            "app": connection.holder,
            "data_age_s": round(time.monotonic() - joints.at, 3) if joints else None,
            "moving": motion.name if motion and motion.running else "",
            "last_motion": motion.facts() if motion else None,
            "foreign_moves": len(connection.moves - {motion.uuid if motion else ""}),
            "head_error_rad": round(sent.angle_to(measured), 4) if sent and measured else None,
            "unusable_frames": feed.unusable_frames,
        }

    def _task(self) -> dict[str, Any]:
        motion = self.motions.current
        if motion is None:
            return {"task_status": "idle", "instruction": "", "outcome": None}
        if motion.running:
            return {"task_status": "running", "instruction": motion.name, "outcome": None}
        # A move whose end the daemon did not report has ended here.
        state = motion.state if motion.state in AT_REST else "error"
        why = motion.detail or ("it is done" if state == "completed" else f"its end is {motion.state}")
        return {
            "task_status": state,
            "instruction": motion.name,
            "outcome": {"task_status": state, "instruction": motion.name, "why": why},
        }

    def _release(self, about: None, deadline: float) -> None:
        # Two requests, and each may take half of the time.
        self.motors.release(max((deadline - time.monotonic()) / 2, 0.05))

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
