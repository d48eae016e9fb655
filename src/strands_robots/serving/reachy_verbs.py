"""Verbs of a Reachy Mini, in degrees and mm; its driver has radians and m."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import ParamSpec

from strands_robots.drivers.reachy import ReachyDriver
from strands_robots.drivers.reachy.connection import STATUS_PATH
from strands_robots.drivers.reachy.driver import LIBRARIES, motor_names
from strands_robots.drivers.reachy.rest import DaemonError
from strands_robots.drivers.reachy.target import HeadPose, Target, bounded
from strands_robots.envelope import Envelope, error, success
from strands_robots.safety.gate import MotionRequest
from strands_robots.serving.control_leases import CONTROL_VERBS
from strands_robots.serving.verbs import NONCE, RESUME, Arguments, Begin, Kind, Run, Verb, release_torque_verb, table
from strands_robots.utils import choice, identifier, shown
from strands_robots.verb_parameters import Check, Parameter

P = ParamSpec("P")

DEGREES, MILLIMETRES = math.degrees(1.0), 1000.0


def _bound(key: str, unit: str, scale: float) -> Check:
    return lambda name, value: bounded(key, value, unit=unit, scale=scale, name=name)


def _angle(name: str, key: str, meaning: str) -> Parameter:
    return Parameter(name, float, meaning, _bound(key, "degrees", DEGREES), default=0)


def _offset(name: str, key: str, meaning: str) -> Parameter:
    return Parameter(name, float, meaning, _bound(key, "mm", MILLIMETRES), default=0)


def _answering(act: Callable[P, object]) -> Callable[P, object]:
    """Answer an error of the daemon with its sentence and HTTP status."""

    def answering(*args: P.args, **kwargs: P.kwargs) -> object:
        try:
            return act(*args, **kwargs)
        except DaemonError as exc:
            return error(str(exc), http_status=exc.status)

    return answering


def _torque(verb: str, on: bool) -> Begin:
    return lambda reachy, arguments, request: reachy.motors.torque(on, arguments["motor_ids"], verb, request=request)


def _gesture(name: str) -> Begin:
    return lambda reachy, _, request: reachy.gesture(name, request=request)


def _look(reachy: ReachyDriver, arguments: Arguments, request: MotionRequest | None) -> object:
    return reachy.go(reachy.checked(Target(HeadPose(**arguments))), "look", request=request)


def _antennas(reachy: ReachyDriver, arguments: Arguments, request: MotionRequest | None) -> object:
    return reachy.go(Target(antennas=(arguments["right"], arguments["left"])), "antennas", request=request)


def _body(reachy: ReachyDriver, arguments: Arguments, request: MotionRequest | None) -> object:
    return reachy.go(reachy.checked(Target(body_yaw=arguments["yaw"])), "body", request=request)


def _daemon_status(reachy: ReachyDriver, arguments: Arguments) -> Envelope:
    payload = reachy.connection.rest.get(STATUS_PATH)
    if not isinstance(payload, dict):
        return error(f"The daemon's status is no object: {shown(payload)}.")
    answer = success("The daemon's status.", daemon=payload)
    return {**payload, "status": answer["status"], "content": answer["content"]}


def _motion(name: str, summary: str, begin: Begin, *parameters: Parameter, instead: str = "") -> Verb:
    return Verb(name, Kind.MOTION, summary, parameters, begin=_answering(begin), instead=instead)


def _read(name: str, summary: str, run: Run, *parameters: Parameter) -> Verb:
    return Verb(name, Kind.READ, summary, parameters, run=run)


_MOTOR_IDS = Parameter(
    "motor_ids",
    str,
    "Comma list of motor names or bus ids; empty for all",
    lambda name, value: ",".join(motor_names(value)),
    default="",
)
_LIBRARY = Parameter(
    "library",
    str,
    "Which library, one of 'emotions' or 'dances'",
    lambda name, value: choice(name, value, tuple(LIBRARIES)),
    default="emotions",
)

REACHY_VERBS = table(
    [
        _motion(
            "look",
            "Set the head pose: at once within a short way, else by a quick ramp that any later motion or stop ends.",
            _look,
            _angle(
                "pitch", "head_pitch", "Degrees, -40 to 40, positive looks down; pitch and roll together at most 60"
            ),
            _angle("roll", "head_roll", "Degrees, -40 to 40"),
            _angle("yaw", "head_yaw", "Degrees, -180 to 180, positive looks left; the body turns along beyond 65"),
            _offset("x", "head_x", "Forward offset in mm, -25 to 25"),
            _offset("y", "head_y", "Leftward offset in mm, -25 to 25"),
            _offset("z", "head_z", "Upward offset in mm, -30 to 15"),
        ),
        _motion(
            "antennas",
            "Set the antenna angles.",
            _antennas,
            _angle("left", "antenna_left", "Left antenna in degrees, -180 to 180"),
            _angle("right", "antenna_right", "Right antenna in degrees, -180 to 180"),
        ),
        _motion(
            "body",
            "Turn the body.",
            _body,
            _angle("yaw", "body_yaw", "Degrees, -160 to 160, positive turns left"),
        ),
        _motion("nod", "Nod the head: yes.", _gesture("nod")),
        _motion("shake", "Shake the head: no.", _gesture("shake")),
        _motion("happy", "Wiggle the antennas: happy.", _gesture("happy")),
        _motion(
            "wakeUp",
            "Enable the motors, make sure that they are, and play the wake-up; its end is told by motionComplete.",
            lambda reachy, _, request: reachy.wake_up(request=request),
        ),
        _motion(
            "sleep",
            "Lie down, with the motors off at the end; the end is told by motionComplete.",
            lambda reachy, _, request: reachy.sleep(request=request),
        ),
        _motion(
            "playMove",
            "Play a recorded move; its end is told by motionComplete.",
            lambda reachy, a, request: reachy.catalogue.play(a["move_name"], a["library"], request=request),
            Parameter("move_name", str, "Name of the move, as listMoves gives it", identifier),
            _LIBRARY,
        ),
        _motion(
            "enableMotors",
            "Switch torque on. Whatever moves is stopped first.",
            _torque("enableMotors", True),
            _MOTOR_IDS,
        ),
        _motion(
            "disableMotors",
            "Switch torque off; the head drops. Whatever moves is stopped first.",
            _torque("disableMotors", False),
            _MOTOR_IDS,
            instead="releaseTorque",
        ),
        release_torque_verb(_MOTOR_IDS, method="release_torque"),
        Verb(
            "stopMotion",
            Kind.STOP,
            "Stop everything that moves now, gestures and every move of the daemon; the answer says what stopped.",
            returns="stopped, halted, not_stopped, unknown, elapsed_ms",
        ),
        RESUME,
        *CONTROL_VERBS.values(),
        _read(
            "getStatus",
            "Read link, daemon state, version, motor mode, application, data age, motion, its outcome and lockouts.",
            lambda reachy, _: reachy.get_task_status(),
            NONCE,
        ),
        _read(
            "getDaemonStatus",
            "Read the daemon's own status object under this device's verdict, or why the daemon was not reached.",
            _answering(_daemon_status),
        ),
        _read(
            "getJoints",
            "Read joint positions by motor name in radians and their age in seconds; stale ones are refused.",
            lambda reachy, _: reachy.get_joints(),
        ),
        _read(
            "getImu",
            "Read accelerometer, gyroscope, quaternion (w x y z), temperature and their age; stale ones are refused.",
            lambda reachy, _: reachy.get_imu(),
        ),
        _read(
            "listMoves",
            "Read the names of the recorded moves, or why they are unknown.",
            lambda reachy, a: reachy.catalogue.names(a["library"]),
            _LIBRARY,
        ),
    ]
)
