"""Cameras of a robot by name, and pictures as JPEG."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any

from strands_robots.contract import body_of, holds_robots
from strands_robots.utils import ValidationError, optional_module, shown

QUALITY = 80

OVERVIEW = "overview"
"""Camera that every simulated world has."""

FIRST = "front"
"""Camera of a simulated world that shows a picture where none is named."""

PICTURE_MAX_BYTES = 700_000
"""Largest JPEG of one answer: as base64 it fits into a message of 1 MiB."""

Frames = Callable[[], Mapping[str, Any]]
"""Returns height x width x 3 arrays of uint8 by camera name."""


Draw = Callable[[str], Any]
"""Draws the picture of a camera of a simulated world."""

STREAM_WIDTH, STREAM_HEIGHT = 320, 240
"""Size of the pictures that a simulated world streams and records."""


class LazyFrames(Mapping[str, Any]):
    """Pictures by camera name, each taken when read: a failure affects no other."""

    def __init__(self, sources: Mapping[str, Callable[[], Any]]) -> None:
        self._sources = dict(sources)

    def __getitem__(self, name: str) -> Any:
        return self._sources[name]()

    def __iter__(self) -> Iterator[str]:
        return iter(self._sources)

    def __len__(self) -> int:
        return len(self._sources)


def frames_of(robot: Any) -> Frames | None:
    """Return a function that takes a picture with each camera, or None without any.

    A robot's own ``camera_frames()`` comes first, then a simulation's drawing, then the pictures in a device's
    ``get_observation()``. A camera ``arm/wrist`` is called ``arm.wrist`` on the wire, which allows no slash.
    """
    body = body_of(robot)
    camera_frames, observe = getattr(body, "camera_frames", None), getattr(body, "get_observation", None)
    if callable(camera_frames):
        frames: Frames = camera_frames
        return frames
    draw = _drawing(robot)
    if draw is not None:
        return lambda: _drawn(draw, robot.get_features().get("cameras", ()))
    if callable(observe):
        return lambda: {str(name): value for name, value in observe().items() if getattr(value, "ndim", 0) == 3}
    return None


def chosen_frames(robot: Any, names: Sequence[str] | None) -> Frames | None:
    """Return the function of :func:`frames_of` for some cameras.

    Args:
        robot: the robot or simulated world.
        names: of the cameras; None means all of a real robot, and of a simulated world the robots' own (such as
            ``wrist``) or, where they have none, the overview, because rendering is expensive.

    Raises:
        ValidationError: a simulated world has no camera of that name.
    """
    draw = _drawing(robot)
    if draw is None:
        frames = frames_of(robot)
        if frames is None or names is None:
            return frames
        return lambda: _selected(frames(), names)
    features = robot.get_features()
    known = [str(name) for name in features.get("cameras", ())]
    of_robots = [name for name in known if "/" in name] or [OVERVIEW]
    wanted = of_robots if names is None else list(names)
    for name in wanted:
        if name not in known:
            raise ValidationError(f"camera must be one of {', '.join(known)}, not {shown(name)}.")
    return lambda: _drawn(draw, wanted)


def _drawing(robot: Any) -> Draw | None:
    """Return what draws a picture of a simulated world, None for a real robot."""
    if not holds_robots(robot):
        return None
    draw, render = getattr(robot, "camera_picture", None), getattr(robot, "render", None)
    if callable(draw):
        return lambda name: draw(name, STREAM_WIDTH, STREAM_HEIGHT)
    return render if callable(render) else None


def _drawn(draw: Draw, names: Iterable[object]) -> LazyFrames:
    return LazyFrames({str(name).replace("/", "."): partial(draw, str(name)) for name in names})


def _selected(frames: Mapping[str, Any], names: Sequence[str]) -> LazyFrames:
    return LazyFrames({name: partial(frames.__getitem__, name) for name in frames if name in names})


def has_cameras(robot: Any) -> bool:
    """Return True where a robot has a camera, as far as it can say without a picture.

    From its ``has_cameras``, else by what draws or takes pictures, else by the shapes in ``observation_features``.
    """
    body = body_of(robot)
    stated = getattr(body, "has_cameras", None)
    if isinstance(stated, bool):
        return stated
    if callable(getattr(body, "camera_frames", None)):
        return True
    if (
        any(callable(getattr(body, draw, None)) for draw in ("camera_picture", "render"))
        and _drawing(robot) is not None
    ):
        return True
    features = getattr(body, "observation_features", None)
    shapes = list(features.values()) if isinstance(features, Mapping) else []
    return callable(getattr(body, "get_observation", None)) and any(
        isinstance(shape, tuple | list) and len(shape) == 3 for shape in shapes
    )


def camera_list(robot: Any) -> list[str]:
    """Return the names of a robot's cameras, the one that is meant by none first."""
    if _draws(robot):
        names = [str(name) for name in robot.get_features().get("cameras", ())]
        return sorted(names, key=lambda name: name != FIRST)
    frames = frames_of(robot)
    return [] if frames is None else [str(name) for name in frames()]


def camera_named(robot: Any, camera: str) -> str:
    """Return the full name of a camera, of which its last part is enough if unique.

    Empty stands for the first one.

    Raises:
        ValidationError: the robot has no such camera, or none.
    """
    names = camera_list(robot)
    if not names:
        raise ValidationError("this robot has no camera.")
    if not camera:
        return names[0]
    ends = [camera] if camera in names else [name for name in names if name.endswith(f"/{camera}")]
    if len(ends) != 1:
        raise ValidationError(f"camera must be one of {', '.join(names)}, not {shown(camera)}.")
    return ends[0]


def take_picture(robot: Any, camera: str, width: int, height: int) -> tuple[str, Any]:
    """Take one RGB picture of at most this size; return its camera and it.

    A simulation draws it in this size; a real camera's is scaled down where it is larger.

    Raises:
        ValidationError: the robot has no such camera, or none.
        MissingExtraError: Pillow is not installed.
        Exception: what the camera raises.
    """
    name = camera_named(robot, camera)
    if _draws(robot):
        return name, robot.camera_picture(name, width, height)
    frames = frames_of(robot)
    assert frames is not None
    return name, _scaled(name, frames()[name], width, height)


def _draws(robot: Any) -> bool:
    return holds_robots(robot) and callable(getattr(robot, "camera_picture", None))


def _scaled(name: str, pixels: Any, width: int, height: int) -> Any:
    high, wide = pixels.shape[:2]
    if wide <= width and high <= height:
        return pixels
    image = _image(name, pixels)
    image.thumbnail((width, height))
    import numpy as np  # noqa: PLC0415 - optional, there where pictures are

    return np.asarray(image)


def jpeg(name: str, pixels: Any) -> bytes:
    """Encode one picture of the camera ``name`` as JPEG.

    Raises:
        ValidationError: ``pixels`` is no height x width x 3 array of uint8.
        MissingExtraError: Pillow is not installed.
    """
    buffer = io.BytesIO()
    _image(name, pixels).save(buffer, format="JPEG", quality=QUALITY)
    return buffer.getvalue()


def _image(name: str, pixels: Any) -> Any:
    shape = tuple(getattr(pixels, "shape", ()))
    if len(shape) != 3 or shape[2] != 3 or str(getattr(pixels, "dtype", "")) != "uint8":
        raise ValidationError(f"a frame of {name} must be height x width x 3 of uint8, not {shape}.")
    return optional_module("PIL.Image", what="Encoding camera frames", extra="record").fromarray(pixels)
