"""Verbs of cameras: which there are, and one picture of one."""

from __future__ import annotations

import base64

from strands_robots.contract import Robot
from strands_robots.envelope import Envelope, error, success
from strands_robots.recording.cameras import PICTURE_MAX_BYTES, camera_list, has_cameras, jpeg, take_picture
from strands_robots.serving.verbs import Arguments, Kind, Parameter, Verb, between, table
from strands_robots.utils import MissingExtraError, ValidationError, text

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
