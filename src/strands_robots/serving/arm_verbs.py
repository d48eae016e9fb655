"""Verbs of an arm: its tip, its motions, its gripper; pictures of any robot.

Metres and degrees in the base frame, x forward; the gripper's opening is 0 closed to 1 open.
"""

from __future__ import annotations

import base64
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from strands_robots.contract import Robot, body_of, for_request
from strands_robots.envelope import Envelope, error, is_error, success
from strands_robots.recording.cameras import (
    PICTURE_MAX_BYTES,
    camera_list,
    camera_named,
    has_cameras,
    jpeg,
    take_picture,
)
from strands_robots.safety.gate import MotionRequest
from strands_robots.serving.verbs import ROBOT_NAME, Arguments, Begin, Kind, Verb, between, table
from strands_robots.utils import (
    WAIT_S,
    MissingExtraError,
    ValidationError,
    flag,
    identifier,
    mapping,
    number,
    shown,
    text,
)
from strands_robots.verb_parameters import Check, Parameter

WIDTH, HEIGHT = 640, 480
"""Size of a picture where none is asked for, in pixels."""


def _list(robot: Robot, arguments: Arguments) -> Envelope:
    names = camera_list(robot)
    return success(f"{len(names)} cameras: {', '.join(names) or 'none'}.", cameras=names)


def _get_picture(robot: Robot, arguments: Arguments) -> Envelope:
    # The mesh leaves out what was not given.
    return picture(robot, arguments.get("camera", ""), arguments.get("width", WIDTH), arguments.get("height", HEIGHT))


def picture(robot: Robot, camera: str, width: int = WIDTH, height: int = HEIGHT) -> Envelope:
    """Return a picture as ``camera``, ``width``, ``height``, ``format``, ``jpeg``."""
    try:
        name, pixels = take_picture(robot, camera, width, height)
        encoded = jpeg(name, pixels)
    except (ValidationError, MissingExtraError) as refused:
        return error(str(refused))
    except Exception as exc:  # noqa: BLE001 - a camera may raise anything; the answer says what
        return error(f"{camera or 'The camera'} gave no picture: {type(exc).__name__}: {exc}")
    if len(encoded) > PICTURE_MAX_BYTES:
        return error(
            f"A picture of {width} x {height} has {len(encoded)} bytes and a message {PICTURE_MAX_BYTES}; "
            "ask for a smaller one."
        )
    high, wide = pixels.shape[:2]
    answer = success(f"{name}, {wide} x {high} pixels.", camera=name, width=wide, height=high, format="jpeg")
    # It is not in the content besides, which would double the message.
    return {**answer, "jpeg": base64.b64encode(encoded).decode("ascii")}


PICTURE_VERBS = table(
    [
        Verb(
            "listCameras", Kind.READ, "Read the names of the cameras.", returns="cameras", run=_list, suits=has_cameras
        ),
        Verb(
            "getPicture",
            Kind.READ,
            "Take one picture, as base64 of a JPEG.",
            (
                Parameter(
                    "camera",
                    str,
                    "Name of the camera, as listCameras has it; empty for the first",
                    lambda name, value: text(name, value, longest=128, empty=True),
                    default="",
                ),
                Parameter("width", int, "Largest width in pixels, 16 to 1920", between(16, 1920), default=WIDTH),
                Parameter("height", int, "Largest height in pixels, 16 to 1440", between(16, 1440), default=HEIGHT),
            ),
            returns="camera, width, height, format, jpeg",
            run=_get_picture,
            suits=has_cameras,
        ),
    ]
)
"""The verbs of every robot with cameras."""


REACH_MAX_M = 3.0
"""Largest coordinate of a goal."""

JOINTS_MAX = 64


def within(low: float, high: float) -> Check:
    """Check a number within these bounds."""
    return lambda name, value: number(name, value, low=low, high=high)


def optional(check: Check) -> Check:
    """Let None pass, which stands for an argument that was not given."""
    return lambda name, value: None if value is None else check(name, value)


def _positions(name: str, value: object) -> dict[str, float]:
    given = mapping(name, value)
    if not 0 < len(given) <= JOINTS_MAX:
        raise ValidationError(f"{name} must name 1 to {JOINTS_MAX} joints, not {shown(value)}.")
    return {joint: number(f"{name}[{joint!r}]", at, low=-7200, high=7200) for joint, at in given.items()}


def _coordinate(name: str) -> Parameter:
    return Parameter(name, float, f"{name} of the tip in the base frame, in metres", within(-REACH_MAX_M, REACH_MAX_M))


def _optional_coordinate(name: str, what: str) -> Parameter:
    meaning = f"{name} of {what}, in metres in the base frame"
    return Parameter(name, float, meaning, optional(within(-REACH_MAX_M, REACH_MAX_M)), default=None)


def _name(name: str, value: object) -> str:
    return text(name, value, longest=128, empty=True)


def _offset(axis: str, direction: str) -> Parameter:
    meaning = f"Metres {direction}, negative for the other way"
    return Parameter(f"d{axis}", float, meaning, within(-REACH_MAX_M, REACH_MAX_M), default=0.0)


APPROACH = Parameter(
    "approach",
    float,
    "Degrees of the gripper below the horizontal, -90 to 90; left out for the steepest that is reachable",
    optional(within(-90, 90)),
    default=None,
)
SPEED = Parameter(
    "speed",
    float,
    "Share of the arm's full speed, above 0 and at most 1",
    lambda name, value: number(name, value, above=0, high=1),
    default=0.5,
)
AROUND = Parameter(
    "around",
    bool,
    "Whether to go around the objects that getObjects knows; false goes as if there were none",
    flag,
    default=True,
)
WAIT = Parameter(
    "wait",
    bool,
    f"Whether to answer at the end of the motion, after at most {WAIT_S:g} s, or at once with its task_id",
    flag,
    default=True,
)
PICTURE = Parameter(
    "picture",
    str,
    "Camera whose picture the answer brings, as listCameras has it; empty for none",
    _name,
    default="",
)
PLACE = Parameter("place", str, "Name of a saved place; home is always there", identifier)
RESULT = (
    "task_id, task_status, asked, reached, error_mm, holding, object_at, object_error_mm, moved, duration, why, picture"
)

_DIRECTION = Parameter(
    "direction",
    str,
    "In place of an offset: forward, back, left, right, up or down",
    lambda name, value: text(name, value, longest=16, empty=True),
    default="",
)
_DISTANCE = Parameter("distance", float, "Metres in that direction, 0 to 1", within(0, 1), default=0.05)


def of_arm(method: str) -> Callable[[Any, Arguments, MotionRequest | None], Envelope]:
    """Carry a verb out by a method of the robot, refused where it has none."""

    def begin(robot: Any, arguments: Arguments, request: MotionRequest | None) -> Envelope:
        carried_out = getattr(body_of(robot), method, None)
        if not callable(carried_out):
            return error("This robot has no arm whose motions can be planned here.")
        answer: Envelope = for_request(request, carried_out)(**arguments)
        return answer

    return begin


def _motion(method: str) -> Begin:
    """Carry a motion out, and add the picture that was asked for to its answer."""
    move = of_arm(method)

    def begin(robot: Robot, arguments: Arguments, request: MotionRequest | None) -> object:
        given = dict(arguments)
        if given.get("around") is True:
            # A robot of one's own may have the motion without this argument.
            del given["around"]
        camera = given.pop("picture", "")
        if camera:
            try:
                camera = camera_named(robot, camera)
            except ValidationError as refused:
                return error(f"picture: {refused}")
        answer = move(robot, given, request)
        if not camera or "task_id" not in answer:
            return answer
        taken = picture(robot, camera)
        if is_error(taken):
            return {**answer, "picture_error": taken["reason"]}
        return {**answer, "picture": {name: taken[name] for name in ("camera", "width", "height", "format", "jpeg")}}

    return begin


def _moves(name: str, method: str, summary: str, *parameters: Parameter, kind: Kind = Kind.MOTION) -> Verb:
    """Describe a verb that may wait for the end of a motion, and bring a picture."""
    begin = _motion(method)
    return Verb(name, kind, summary, parameters, returns=RESULT, method=method, begin=begin, lasts=True)


def _reads(name: str, method: str, summary: str, returns: str) -> Verb:
    return Verb(name, Kind.READ, summary, returns=returns, method=method, begin=of_arm(method))


_HOW = (SPEED, WAIT, PICTURE, AROUND)
_VERBS = (
    _reads(
        "getPose",
        "arm_pose",
        "Read where the tip of the gripper is, its approach and the joints, in metres and degrees in the base frame.",
        "x, y, z, approach, joints, gripper, holding, model",
    ),
    _moves(
        "moveJoints",
        "move_joints",
        "Move joints to positions; the way is checked for limits, and with a model for contacts, before it moves.",
        Parameter("joints", dict, "Degrees by joint name, metres for a slide; joints left out stay", _positions),
        *_HOW,
    ),
    _moves(
        "moveTo",
        "move_to",
        "Move the tip of the gripper to a point; the way is checked for limits and contacts before anything moves.",
        *(_coordinate(axis) for axis in "xyz"),
        APPROACH,
        *_HOW,
    ),
    _moves(
        "moveBy",
        "move_by",
        "Move the tip of the gripper on a straight line, by an offset or in a direction.",
        *(_offset(axis, way) for axis, way in zip("xyz", ("forward", "to the left", "up"), strict=True)),
        _DIRECTION,
        _DISTANCE,
        *_HOW,
    ),
    _moves(
        "setGripper",
        "set_gripper",
        "Open or close the gripper; holding says whether something is between the jaws.",
        Parameter("opening", float, "From 0 (closed) to 1 (open)", within(0, 1)),
        WAIT,
        PICTURE,
    ),
    _moves("goTo", "go_to", "Move to a place that was saved, or to home.", PLACE, *_HOW),
    _reads(
        "getObjects",
        "get_objects",
        "Read the objects that can be seen: centre and extents in metres and yaw in degrees in the base frame.",
        "objects",
    ),
    _moves(
        "pick",
        "pick",
        "Pick an object up, by its name in getObjects or by its place; holding says whether it is between the jaws.",
        Parameter("object", str, "Name of the object; empty to give its place", _name, default=""),
        *(_optional_coordinate(axis, "the object's centre") for axis in "xyz"),
        Parameter("width", float, "Metres between the jaws, for a place", within(0.002, 0.2), default=0.025),
        Parameter("yaw", float, "Degrees by which it is turned, for a place", within(-360, 360), default=0.0),
        APPROACH,
        *_HOW,
    ),
    _moves(
        "place",
        "place",
        "Put the held object down at a point, or on another object.",
        *(_optional_coordinate(axis, "the place; z is the table's height where left out") for axis in "xyz"),
        Parameter("on", str, "Name of the object on which to put it; empty for a point", _name, default=""),
        APPROACH,
        *_HOW,
    ),
    Verb(
        "savePlace",
        Kind.MOTION,
        "Save the present joints as a place for goTo; nothing moves.",
        (PLACE,),
        returns="place, joints, places",
        method="save_place",
        begin=of_arm("save_place"),
        critical=False,
    ),
    _moves(
        "wait",
        "wait_for",
        "Wait for the end of a motion and read its result.",
        Parameter(
            "task_id",
            str,
            "The motion's task_id; empty for the last one",
            lambda name, value: text(name, value, longest=64, empty=True),
            default="",
        ),
        Parameter("seconds", float, f"Longest wait, 0 to {WAIT_S:g}", within(0, WAIT_S), default=WAIT_S),
        PICTURE,
        kind=Kind.READ,
    ),
)

ARM_MOTION_VERBS = table(_VERBS)
"""The verbs of a robot with one body."""


def for_robot(verb: Verb, robot_name: Parameter, **changes: Any) -> Verb:
    """Return a verb that names one robot of a world besides."""
    return replace(verb, parameters=(*verb.parameters, robot_name), **changes)


WORLD_MOTION_VERBS = table([for_robot(verb, ROBOT_NAME) for verb in _VERBS])
"""The same for a robot of a simulated world."""
