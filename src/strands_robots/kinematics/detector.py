"""Detectors of objects: the protocol of what a real arm sees, and the check of its answers."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Mapping
from typing import Any, Protocol, runtime_checkable

import numpy as np

from strands_robots.kinematics.objects import SeenObject
from strands_robots.utils import ValidationError, flag, mapping, number, shown, text

OBJECTS_MAX = 64
"""Most objects of one answer."""

FAR_M = 3.0
"""Largest coordinate and extent of an object."""

FIELDS = frozenset({"name", "position", "size", "yaw", "round", "fixed"})


@runtime_checkable
class ObjectDetector(Protocol):
    """Finds objects in the pictures of a robot; a robot's ``detector`` is one."""

    def detect(self, frames: Mapping[str, Any]) -> Iterable[Mapping[str, Any]]:
        """Return a row for each object that is seen now.

        ``name`` is unique; ``position`` is the centre and ``size`` the extents (x, y, z in metres) in the base frame
        of the arm, x forward and z up; ``yaw`` its turn about z in radians, by default 0; ``round`` objects have no
        faces that the jaws must follow; ``fixed`` ones cannot be picked up.

        Args:
            frames: pictures by camera, height x width x 3 of uint8 RGB, each taken when it is read.
        """


class Asking:
    """One question to a detector at a time, each with a deadline."""

    def __init__(self) -> None:
        self._lock = threading.Lock()

    def within(self, ask: Callable[[], list[SeenObject]], seconds: float) -> list[SeenObject]:
        """Return what ``ask`` returns, which goes on in a thread of its own if it hangs.

        Raises:
            ValidationError: it refused, failed, gave no answer in time, or still hangs.
        """
        if not self._lock.acquire(timeout=seconds):
            raise ValidationError(f"the detector gave no answer within {seconds:g} s to an earlier question.")
        answers: list[list[SeenObject] | Exception] = []
        done = threading.Event()

        def run() -> None:
            try:
                answers.append(ask())
            except Exception as exc:  # noqa: BLE001 - told by the caller
                answers.append(exc)
            finally:
                self._lock.release()
                done.set()

        threading.Thread(target=run, name="detector", daemon=True).start()
        if not done.wait(seconds):
            raise ValidationError(f"the detector gave no answer within {seconds:g} s.")
        answer = answers[0]
        if isinstance(answer, ValidationError):
            raise answer
        if isinstance(answer, Exception):
            raise ValidationError(f"the detector failed: {type(answer).__name__}: {answer}") from answer
        return answer


def detected(detector: ObjectDetector, frames: Mapping[str, Any]) -> list[SeenObject]:
    """Return what a detector sees.

    Raises:
        ValidationError: it failed, or a row of its answer is outside its domain.
    """
    try:
        rows = list(detector.detect(frames))
    except Exception as exc:
        raise ValidationError(f"the detector failed: {type(exc).__name__}: {exc}") from exc
    if len(rows) > OBJECTS_MAX:
        raise ValidationError(f"the detector gave {len(rows)} objects; at most {OBJECTS_MAX} are taken.")
    try:
        objects = [_object(row) for row in rows]
    except ValidationError as exc:
        raise ValidationError(f"the detector gave an unusable object: {exc}") from exc
    names = [each.name for each in objects]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise ValidationError(f"the detector gave two objects the name {shown(twice)}.")
    return objects


def _object(row: object) -> SeenObject:
    given = mapping("object", row)
    unknown = set(given) - FIELDS
    if unknown:
        raise ValidationError(f"object has no {', '.join(sorted(map(str, unknown)))}; it has {', '.join(FIELDS)}.")
    name = text("name", given.get("name"), longest=128)
    return SeenObject(
        name,
        _vector(f"position of {name}", given.get("position"), -FAR_M),
        number(f"yaw of {name}", given.get("yaw", 0.0), low=-7.0, high=7.0),
        _vector(f"size of {name}", given.get("size"), 1e-3),
        flag(f"round of {name}", given.get("round", False)),
        flag(f"fixed of {name}", given.get("fixed", False)),
    )


def _vector(name: str, value: object, low: float) -> Any:
    given = value.tolist() if isinstance(value, np.ndarray) else value
    if not isinstance(given, list | tuple) or len(given) != 3:
        raise ValidationError(f"{name} must be three numbers, x, y and z in metres, not {shown(value)}.")
    return np.array([number(name, each, low=low, high=FAR_M) for each in given], dtype=np.float64)
