"""Objects around an arm: seen, held, moved, and its contacts with them."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

import mujoco
import numpy as np

from strands_robots.kinematics.chain import (
    BALL,
    BOX,
    CYLINDER,
    TABLE,
    Chain,
    Floats,
    ObstacleShape,
    TipPose,
    held_body,
    place_obstacle,
    spare_body,
)
from strands_robots.utils import ValidationError, flag, mapping, number, plain_value, shown, text


@dataclass(frozen=True, slots=True)
class SeenObject:
    """An object: centre (m) and yaw (rad) in the base frame, and its extents (m).

    ``round`` objects have no faces that the jaws must follow; ``fixed`` ones cannot be picked up.
    """

    name: str
    position: Floats
    yaw: float
    size: Floats
    round: bool = False
    fixed: bool = False


@dataclass(frozen=True, slots=True)
class Held:
    """An object between the jaws.

    Attributes:
        offset: of its centre from the tip, in the frame of the tip (m).
        below: of its bottom from its centre (m).
        width: between the jaws (m).
        approach_deg: at which it was grasped, so that it stands upright.
        radius: of the circle within its outline from above (m).
        half: its half extents (m); zeros where only the radius is known.
        turn: rotation of its axes in the frame of the tip, by columns.
        round: as of :class:`SeenObject`.
    """

    name: str
    offset: Floats
    below: float
    width: float
    approach_deg: float
    radius: float = 0.0
    half: Floats = field(default_factory=lambda: np.zeros(3))
    turn: Floats = field(default_factory=lambda: np.eye(3))
    round: bool = False

    def centre(self, pose: TipPose) -> Floats:
        """Return the place of its centre for a pose of the tip (m)."""
        centre: Floats = pose.position + pose.rotation @ self.offset
        return centre


PLACED_MM = 15.0
"""An object that was put down further from its place was not put there."""

CARRIED_MM = 40.0
"""An object further from where the jaws have it was not picked up."""

PUSHED_MM = 5.0
"""Horizontal distance from which an object counts as moved."""

FELL_MM = 20.0
"""Vertical distance from which it does; one that was added in the air settles by less."""

GIVEN_NEAR_M = 0.025
"""Greatest distance of an object from the place that a caller gave for it."""

_RESTS_M = 0.01
"""Greatest gap between an object and what it stands on."""


@dataclass
class Sight:
    """Objects around one motion.

    Attributes:
        before: the objects at its start.
        name: of the object that it picks up or puts down; empty for none.
        wanted: where the centre of that object shall be in the end (m), None where that is not known.
        within_mm: greatest distance from there.
        after: the objects at its end; None until then, and where they could not be seen.
    """

    before: Sequence[SeenObject]
    name: str = ""
    wanted: Floats | None = None
    within_mm: float = PLACED_MM
    after: Sequence[SeenObject] | None = field(default=None, init=False)

    @property
    def moved(self) -> dict[str, int] | None:
        """Millimetres by which other objects were moved; None where that is not known."""
        if self.after is None:
            return None
        now = {each.name: each.position for each in self.after}
        found = {}
        for each in self.before:
            if each.name == self.name or each.name not in now:
                continue
            offset = 1000 * (now[each.name] - each.position)
            if np.hypot(offset[0], offset[1]) >= PUSHED_MM or abs(offset[2]) >= FELL_MM:
                found[each.name] = round(float(np.linalg.norm(offset)))
        return found

    def row(self) -> dict[str, Any]:
        """Return the fields of an answer that tell of objects."""
        at, error_mm = self._object_at(), self._error_mm()
        return {
            "object_at": None if at is None else {a: round(float(v), 4) for a, v in zip("xyz", at, strict=True)},
            "object_error_mm": None if error_mm is None else round(error_mm, 1),
            "moved": self.moved,
        }

    def problem(self) -> str:
        """Return why the object is not in its place; empty where it is, or is unseen."""
        error_mm = self._error_mm()
        if error_mm is None or error_mm <= self.within_mm:
            return ""
        return f"{self.name} is {error_mm:.0f} mm from where it should be"

    def remark(self) -> str:
        """Return what else the motion moved, in words; empty for nothing."""
        return ", ".join(f"{name} was moved by {distance} mm" for name, distance in (self.moved or {}).items())

    def _object_at(self) -> Floats | None:
        return next((each.position for each in self.after or () if self.name and each.name == self.name), None)

    def _error_mm(self) -> float | None:
        at = self._object_at()
        return None if at is None or self.wanted is None else 1000 * float(np.linalg.norm(at - self.wanted))


def require_uncovered(target: SeenObject, objects: Iterable[SeenObject]) -> None:
    """Refuse to pick an object up on which another one stands."""
    top = float(target.position[2] + target.size[2] / 2)
    for each in objects:
        bottom = float(each.position[2] - each.size[2] / 2)
        if each.name != target.name and abs(bottom - top) <= _RESTS_M and _over(target, each):
            raise ValidationError(f"{each.name} stands on {target.name}; pick {each.name} up first.")


def require_vacant(position: Floats, held: Held, objects: Iterable[SeenObject], on: str = "") -> None:
    """Refuse to put the held object down where another one is.

    Args:
        position: of its bottom (m).
        held: what is put down.
        objects: those that are seen.
        on: the object on which it is put.
    """
    low, high = float(position[2]) + _RESTS_M, float(position[2]) + 2 * held.below
    for each in objects:
        if each.name in (held.name, on):
            continue
        bottom, top = (float(each.position[2] + sign * each.size[2] / 2) for sign in (-1, 1))
        apart = float(np.hypot(*(each.position - position)[:2]))
        if bottom < high and top > min(low, high - 1e-3) and apart < _inner(each.size) + held.radius:
            raise ValidationError(
                f"{each.name} is at that place; put {held.name or 'it'} elsewhere, or on it by on={each.name}."
            )


def nearest(position: Floats, objects: Iterable[SeenObject]) -> str:
    """Return the name of the object at a place that a caller gave; empty for none."""
    near = [(float(np.linalg.norm(each.position - position)), each.name) for each in objects]
    distance, name = min(near, default=(np.inf, ""))
    return name if distance <= GIVEN_NEAR_M else ""


def _over(lower: SeenObject, upper: SeenObject) -> bool:
    apart = float(np.hypot(*(upper.position - lower.position)[:2]))
    return apart < _inner(lower.size) + _inner(upper.size)


def _inner(size: Floats) -> float:
    """Return the radius of the circle within an object's outline."""
    return float(min(size[0], size[1])) / 2


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
    given = plain_value(value)
    if not isinstance(given, list | tuple) or len(given) != 3:
        raise ValidationError(f"{name} must be three numbers, x, y and z in metres, not {shown(value)}.")
    return np.array([number(name, each, low=low, high=FAR_M) for each in given], dtype=np.float64)


STEP_RAD = 0.02
"""Largest step of a joint between two checked poses (rad or m)."""

DEEPER_M = 1e-3
"""How much deeper than at its start a path may press two parts that touch already."""

Contacts = Mapping[tuple[str, str], float]
"""Penetration in metres, above 0, by the names of the two parts."""


class ContactCheck:
    """Finds contacts of one chain; for one thread.

    Args:
        chain: the arm and its table.
        gripper: position of the gripper's joint; None for that of the home pose.
    """

    def __init__(self, chain: Chain, gripper: float | None = None) -> None:
        self._chain = chain
        self._gripper = gripper
        self._data: Any = chain.data(chain.rest, gripper)
        self.objects = frozenset(chain.objects.values())
        """Names of the objects in the model."""

    def at(self, joints: Floats) -> dict[tuple[str, str], float]:
        """Return the contacts of one pose."""
        model, data = self._chain.model, self._data
        self._chain.put(data, joints, self._gripper)
        mujoco.mj_collision(model, data)
        found: dict[tuple[str, str], float] = {}
        for index in range(data.ncon):
            depth = -float(data.contact.dist[index])
            if depth > 0 and not (self._chain.floats and 0 in model.geom_bodyid[data.contact.geom[index]]):
                first, second = (self._part(int(geom)) for geom in data.contact.geom[index])
                pair = (second, first) if first == TABLE else (first, second)
                found[pair] = max(depth, found.get(pair, 0.0))
        return found

    def along(self, path: Floats, known: Contacts | None = None) -> str:
        """Return the first contact along ``path`` (n, joints); empty for none.

        Parts that touch in ``known``, by default at the path's start, may touch on, but not press deeper.
        """
        allowed = self.at(path[0]) if known is None else known
        for joints in dense(path):
            problem = new_contact(self.at(joints), allowed)
            if problem:
                return problem
        return ""

    def _part(self, geom: int) -> str:
        model = self._chain.model
        body = int(model.geom_bodyid[geom])
        if body in self._chain.objects:
            return self._chain.objects[body]
        return TABLE if body == 0 else str(model.body(body).name).replace("_", " ")


def new_contact(contacts: Contacts, allowed: Contacts) -> str:
    """Name the first contact that is not ``allowed``; empty for none."""
    for (first, second), depth in contacts.items():
        if depth > allowed.get((first, second), -DEEPER_M) + DEEPER_M:
            return f"the {first} touches the {second}"
    return ""


def dense(path: Floats) -> Floats:
    """Return ``path`` with points at most :data:`STEP_RAD` apart."""
    parts = [path[:1]]
    for before, after in itertools.pairwise(path):
        count = max(1, int(np.ceil(np.abs(after - before).max() / STEP_RAD)))
        shares = np.arange(1, count + 1)[:, None] / count
        parts.append(before + shares * (after - before))
    return np.concatenate(parts)


CLEARANCE_M = 0.003
"""Distance that a path keeps from an object's sides."""

FLAT_M = 0.002
"""Height above the table up to which a fixed object is a table itself."""


def beside(chain: Chain, seen: Sequence[SeenObject], held: Held | None = None) -> Chain:
    """Return a chain whose model has objects as obstacles.

    Args:
        chain: it is not changed.
        seen: objects in the base frame. One of them that is held is no obstacle.
        held: what is between the jaws, which goes where the tip goes.
    """
    obstacles = [each for each in seen if not _is_table(chain, each) and (held is None or each.name != held.name)]
    # The base of a robot that moves about is not where its model has it.
    if chain.floats or not (obstacles or held):
        return chain
    model = chain.spares.model(len(obstacles))
    objects = {}
    for index, each in enumerate(obstacles):
        body = spare_body(model, index)
        objects[body] = each.name
        turned = np.array([np.cos(each.yaw / 2), 0.0, 0.0, np.sin(each.yaw / 2)])
        half = each.size / 2 + np.array([CLEARANCE_M, CLEARANCE_M, 0.0])
        kind = CYLINDER if each.round else BOX
        place_obstacle(model, body, ObstacleShape(kind, half, each.position, turned))
    if held is not None and held.radius > 0:
        body = held_body(model)
        objects[body] = held.name
        place_obstacle(model, body, _carried(chain, held))
    return chain.beside(objects, model)


def _carried(chain: Chain, held: Held) -> ObstacleShape:
    """Return the shape of the held object in the frame of the body that has the tip."""
    site, turn = chain.model.site_quat[chain.site], np.zeros(4)
    rotation, quaternion = np.zeros(9), np.zeros(4)
    mujoco.mju_quat2Mat(rotation, site)
    position = chain.model.site_pos[chain.site] + rotation.reshape(3, 3) @ held.offset
    if not held.half.any():
        return ObstacleShape(BALL, np.full(3, held.radius), position, np.array([1.0, 0.0, 0.0, 0.0]))
    mujoco.mju_mat2Quat(turn, np.ascontiguousarray(held.turn).ravel())
    mujoco.mju_mulQuat(quaternion, site, turn)
    return ObstacleShape(CYLINDER if held.round else BOX, held.half, position, quaternion)


def _is_table(chain: Chain, each: SeenObject) -> bool:
    return each.fixed and float(each.position[2] + each.size[2] / 2) <= chain.table_z + FLAT_M
