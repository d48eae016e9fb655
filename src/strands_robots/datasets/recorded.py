"""Episodes of a dataset from recordings of robots (MCAP).

Each task that a robot carried out is an episode; a recording without tasks is one. Its steps, joints and pictures are
put on the grid of the dataset: a frame has what was newest at its moment, and how old that was.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from strands_robots.contract import SETTLE, VERB
from strands_robots.datasets.encoded import EncodedVideo, common_moments
from strands_robots.datasets.episodes import FRAMES_MAX, Dataset, DatasetEpisode
from strands_robots.datasets.layout import DatasetInfo, Feature
from strands_robots.datasets.video import Video, VideoWriter, decoded
from strands_robots.policies.base import numbers
from strands_robots.recording.file import (
    REFUSED,
    STEP,
    TURN,
    UNITS,
    RecordedEvent,
    RecordedPicture,
    read_items,
    units_in,
)
from strands_robots.utils import ValidationError, shown

STATE, ACTION, SUCCESS, STOP, INTERVENTION = "observation.state", "action", "next.success", "stop", "intervention"
AGE, SAME, IMAGES = "observation.age_ms.", "same.", "observation.images."
"""Beginnings of features. LeRobot normalizes each observation for a policy, and cannot do that with a truth value."""

STOPPED, EMERGENCY, LOCKED_OUT = 1, 2, 3
"""Values of the feature ``stop``; 0 is none. The last one is a motion that was refused while the robot was locked."""

AFTER_S = 2.0
"""Time after the last step in which a stop is of its attempt; its frames go on to a motion that is refused then."""

ACTOR = "actor"
UNKNOWN, BY_POLICY, BY_LEADER, BY_MOTION, BY_RECORDING = range(5)
ACTORS = ("unknown", "policy", "leader", "motion", "recording")
"""Names of the values of the feature ``actor``: who had the robot make its newest step."""

_ACTORS = {"teleoperation": BY_LEADER, "motion": BY_MOTION, SETTLE: BY_MOTION, VERB: BY_MOTION}

SOON_S = 1e-5
"""A reading that comes so soon after a frame's moment, in seconds, is that frame's: times are rounded."""

_WEIGHT = (LOCKED_OUT, STOPPED, EMERGENCY)
"""Of two in one frame the later one here counts: what was refused is of the lockout."""

HALTED = "halted"
"""Event of a recording: its robot was halted, and not as the end of the attempt."""

_STOPS = {HALTED: STOPPED, "locked": EMERGENCY, "emergencyStop": EMERGENCY, REFUSED: LOCKED_OUT}
ATTEMPT_ENDED = "attemptEnded"
"""Event of a recording: the person who records has ended the attempt. What follows is none of it."""

LED_BY_PERSON = "ledByPerson"
"""Event of a recording: from here on a person leads, by an arm, a keyboard or a gamepad."""

LED_BY_RECORDING = "ledByRecording"
"""The same where the leader is a recording."""

_ENDS = ("taskComplete", "policyComplete")
_STARTS = ("taskStarted", "policyStarted")


@dataclass
class Attempt:
    """One task of a robot as it was recorded.

    ``steps`` are moments in seconds, observations and actions by name; ``pictures`` moments and JPEG by camera.
    ``person`` is True where a person led all of it, and ``led`` of the steps in which a leader had its turn; ``videos``
    are by camera, where its pictures were encoded as they came. ``actors`` are of the steps, as :data:`ACTORS` counts
    them; ``units`` are by joint, where the robot states them; ``policies`` are those that acted, by name.
    """

    instruction: str = ""
    steps: list[tuple[float, dict[str, float], dict[str, float]]] = field(default_factory=list)
    pictures: dict[str, list[tuple[float, bytes]]] = field(default_factory=dict)
    stops: list[tuple[float, int]] = field(default_factory=list)
    person: bool = False
    videos: Mapping[str, EncodedVideo] = field(default_factory=dict)
    led: list[bool] = field(default_factory=list)
    actors: list[int] = field(default_factory=list)
    units: Mapping[str, str] = field(default_factory=dict)
    policies: dict[str, None] = field(default_factory=dict)


def attempts_of(path: Path, robot: str | None = None) -> list[Attempt]:
    """Return the attempts in a recording; of a cut file, those that it has.

    Args:
        path: an ``.mcap`` file of one robot's tasks.
        robot: whose, where several were recorded; ``WORLD/ROBOT`` of a simulated world.

    Raises:
        ValidationError: no recording, no steps in it, or those of several robots and none named.
        MissingExtraError: the [dataset] extra is not installed.
    """
    attempts = attempts_in(path, robot)
    if not attempts:
        raise ValidationError(f"{path.name} has no steps of a task: nothing in it is an episode.")
    return attempts


def attempts_in(path: Path, robot: str | None = None, *, whole: bool = False) -> list[Attempt]:
    """Return the attempts in a recording, none where it has no steps.

    Other arguments and errors are those of :func:`attempts_of`.

    Args:
        path: the file.
        robot: whose.
        whole: an attempt ends where the person who recorded it says so, whatever tasks it has.
    """
    items = list(read_items(path))
    known = sorted({each.robot for each in items if isinstance(each, RecordedEvent) and each.event == STEP})
    if not known:
        return []
    if robot not in known and (robot is not None or len(known) > 1):
        raise ValidationError(
            f"robot must be one of those that were recorded ({', '.join(known)}), not {shown(robot)}."
        )
    chosen = robot or known[0]
    events = (each for each in items if isinstance(each, RecordedEvent))
    attempts = _AttemptReader(chosen, whole=whole).read(each for each in events if _is_of(each.robot, chosen))
    for each in items:
        if isinstance(each, RecordedPicture) and chosen.partition("/")[0] == each.device.partition("/")[0]:
            for attempt in attempts:
                attempt.pictures.setdefault(each.camera, []).append((each.at, each.jpeg))
    return attempts


def _is_of(named: str, robot: str) -> bool:
    """Return True for an event of a robot, or of the world that it is in.

    On the mesh the steps of a world's only robot are the world's, and its other events its own.
    """
    world = named.partition("/")[0]
    return robot in (named, world) or named == robot.partition("/")[0]


class _AttemptReader:
    """Attempts of one robot by its events, in the order of their writing."""

    def __init__(self, robot: str, *, whole: bool) -> None:
        self._robot, self._whole = robot, whole
        self._found: list[Attempt] = []
        self._attempt = Attempt()
        self._before: Attempt | None = None
        self._actor, self._policy, self._replayed, self._held = UNKNOWN, "", False, False
        self._units: dict[str, str] = {}

    def read(self, events: Iterable[RecordedEvent]) -> list[Attempt]:
        """Return the attempts."""
        for each in events:
            if each.event == STEP and each.robot == self._robot:
                self._take_step(each)
            elif each.event in _STARTS or each.event in _ENDS:
                self._take_task(each)
            elif each.event == TURN:
                self._held = each.payload.get("state") == "held"
            elif (code := _STOPS.get(each.event)) is not None:
                self._take_stop(each.at, code)
            elif each.event == ATTEMPT_ENDED:
                self._end()
                # What follows is the end itself.
                self._before = None
            elif each.event == UNITS:
                self._units = units_in({"joint_units": each.payload.get("units")})
            elif each.event == LED_BY_PERSON:
                self._attempt.person = True
            elif each.event == LED_BY_RECORDING:
                self._replayed = True
        self._end()
        return self._found

    def _end(self) -> None:
        if self._attempt.steps:
            self._found.append(self._attempt)
            self._before = self._attempt
        self._attempt = Attempt()

    def _take_step(self, event: RecordedEvent) -> None:
        attempt, led_by = self._attempt, event.payload.get("led_by")
        held = self._held and not led_by
        observation, action = (_numbers(event.payload.get(name)) for name in ("observation", "action"))
        attempt.steps.append((event.at, observation, action))
        attempt.units = self._units
        attempt.led.append(attempt.person or (bool(led_by) and not self._replayed))
        actor = BY_LEADER if led_by or attempt.person else _actor(event.payload.get("policy"), self._actor)
        if actor == BY_POLICY and not held and (policy := event.payload.get("policy") or self._policy):
            attempt.policies[str(policy)] = None
        if self._replayed and actor in (BY_LEADER, UNKNOWN):
            actor = BY_RECORDING
        # Nobody has a robot hold that waits for its leader.
        attempt.actors.append(UNKNOWN if held else actor)

    def _take_task(self, event: RecordedEvent) -> None:
        begins, self._held = event.event in _STARTS, False
        if begins and self._attempt.steps and not self._whole:
            self._end()
        if begins:
            self._policy = str(event.payload.get("policy_provider") or "")
            self._actor = _actor(self._policy)
        elif event.payload.get("state") == "stopped":
            self._take_stop(event.at, STOPPED)
        self._attempt.instruction = str(event.payload.get("instruction") or self._attempt.instruction)
        if not begins and self._attempt.steps and not self._whole:
            self._end()

    def _take_stop(self, at: float, code: int) -> None:
        # A task's end is told before the stop or the lockout that ended it.
        if self._attempt.steps:
            self._attempt.stops.append((at, code))
        elif self._before is not None and at - self._before.steps[-1][0] <= AFTER_S:
            self._before.stops.append((at, code))


def info_of(attempts: Sequence[Attempt], fps: int, robot_type: str) -> DatasetInfo:
    """Return the kind of episodes that attempts are.

    Raises:
        ValidationError: they differ in their names or cameras, or have none.
    """
    first = attempts[0]
    states = {tuple(observation) for each in attempts for _, observation, _ in each.steps}
    if len(states) > 1:
        raise ValidationError("the steps do not all state the same joints; they are episodes of different robots.")
    state = states.pop()
    told = {name: None for each in attempts for _, _, action in each.steps for name in action}
    if not state or not told:
        raise ValidationError("the steps state no joints or no actions.")
    units = {name: unit for each in attempts for name, unit in each.units.items()}
    features: dict[str, Feature] = {
        STATE: _joints(state, units),
        ACTION: _joints(tuple(told), units),
        f"{AGE}state": Feature("float32"),
        SUCCESS: Feature("bool"),
        # Rerun draws numbers of this kind alone.
        STOP: Feature("float32"),
        INTERVENTION: Feature("bool"),
        ACTOR: Feature("int64", about={"codes": list(ACTORS)}),
    }
    for camera in sorted({*first.pictures, *first.videos}):
        if any(camera not in each.videos and not each.pictures.get(camera) for each in attempts):
            raise ValidationError(f"camera {camera} has no picture of one of the attempts.")
        video = first.videos.get(camera)
        shape = (video.height, video.width, 3) if video else decoded(first.pictures[camera][0][1]).shape
        features[f"{IMAGES}{camera}"] = Feature("video", shape)
        features[f"{AGE}{camera}"] = Feature("float32")
        features[f"{SAME}{camera}"] = Feature("bool")
    return DatasetInfo(fps, features, robot_type)


def save_attempt(dataset: Dataset, attempt: Attempt, task: str, *, success: bool) -> int:
    """Put an attempt on the grid of a dataset and save it.

    Args:
        dataset: made for attempts of its kind.
        attempt: with steps.
        task: in words; that of the attempt where it is empty.
        success: of the whole attempt.

    Returns:
        The index of the episode.

    Raises:
        ValidationError: it does not fit the dataset.
        DatasetError: it cannot be written.
    """
    steps, fps = attempt.steps, dataset.info.fps
    moments = moments_of(attempt, fps)
    count = len(moments)
    newest = _newest(moments, [at for at, _, _ in steps])
    state, action = (dataset.info.features[name].names for name in (STATE, ACTION))
    told = _told(steps)
    columns: dict[str, NDArray[Any]] = {
        STATE: _rows(state, [observation for _, observation, _ in steps])[newest],
        ACTION: _rows(action, told)[newest],
        f"{AGE}state": (moments - np.array([steps[index][0] for index in newest])) * 1000,
        SUCCESS: np.arange(count) == (count - 1 if success else -1),
        STOP: _stops(moments, attempt.stops),
        INTERVENTION: np.array([attempt.person or attempt.led[index] for index in newest]),
        ACTOR: np.array([attempt.actors[index] for index in newest]),
    }
    videos: dict[str, Video] = {}
    for name in dataset.info.videos:
        camera = name.removeprefix(IMAGES)
        if (encoded := attempt.videos.get(camera)) is not None:
            videos[name], rows = encoded.cut(dataset.running / f"{camera}.mp4", moments, fps)
            columns[f"{AGE}{camera}"] = np.maximum(moments - rows["at"], 0) * 1000
            columns[f"{SAME}{camera}"] = (rows["same"] > 0) & (np.arange(count) > 0)
            continue
        videos[name] = _encoded(dataset, attempt.pictures.get(camera, []), camera, moments, columns)
    policy = ", ".join(attempt.policies)
    return dataset.save(DatasetEpisode(task or attempt.instruction or "unnamed", columns, videos, policy))


def moments_of(attempt: Attempt, fps: int) -> NDArray[np.float64]:
    """Return the moments of an attempt's frames, in seconds since the epoch.

    Where its cameras were encoded as they came, those of which each has a picture; there may be none.

    Raises:
        ValidationError: they are too many.
    """
    first, last = attempt.steps[0][0], attempt.steps[-1][0]
    refused = [at for at, code in attempt.stops if code == LOCKED_OUT and at - last <= AFTER_S]
    last = max([last, *refused])
    if attempt.videos:
        moments = common_moments(attempt.videos, first, last, fps)
    else:
        # Times are kept in nanoseconds, and a step belongs to the frame that it comes with.
        moments = first + np.arange(min(int((last - first) * fps + 1e-3), FRAMES_MAX) + 1) / fps
    if len(moments) > FRAMES_MAX:
        raise ValidationError(f"an episode must have 1 to {FRAMES_MAX:,} frames.")
    return moments


def _encoded(
    dataset: Dataset,
    pictures: Sequence[tuple[float, bytes]],
    camera: str,
    moments: NDArray[np.float64],
    columns: dict[str, NDArray[Any]],
) -> Video:
    """Encode the newest picture of each frame, and state its age in ``columns``."""
    newest = _newest(moments, [at for at, _ in pictures])
    columns[f"{AGE}{camera}"] = np.maximum(moments - np.array([pictures[index][0] for index in newest]), 0) * 1000
    same = [False, *(pictures[now][1] == pictures[before][1] for before, now in pairwise(newest))]
    columns[f"{SAME}{camera}"] = np.array(same)
    height, width, _ = dataset.info.features[f"{IMAGES}{camera}"].shape
    pixels, last = None, -1
    with VideoWriter(dataset.running / f"{camera}.mp4", dataset.info.fps, width, height) as video:
        for index in newest:
            if pixels is None or index != last:
                pixels, last = decoded(pictures[index][1]), index
            video.write(pixels)
        return video.finish()


def _newest(moments: NDArray[np.float64], times: Sequence[float]) -> list[int]:
    """Return the index of the newest time at each moment, else of the first."""
    if not times:
        raise ValidationError("a camera has no picture.")
    return list(np.maximum(np.searchsorted(np.array(times), moments + SOON_S, side="right") - 1, 0))


def _told(steps: Sequence[tuple[float, Mapping[str, float], Mapping[str, float]]]) -> list[dict[str, float]]:
    """Return the whole action of each step: a joint keeps what it was told."""
    told: dict[str, float] = {}
    whole = []
    for _, observation, action in steps:
        told = {**told, **action}
        whole.append({**observation, **told})
    return whole


def _rows(names: Sequence[str], rows: Sequence[Mapping[str, float]]) -> NDArray[np.float32]:
    lacking = sorted({name for row in rows for name in names if name not in row})
    if lacking:
        raise ValidationError(f"{', '.join(lacking)} is missing in a step.")
    table = np.array([[row[name] for name in names] for row in rows], dtype=np.float32)
    # LeRobot has a vector of one number as a plain column.
    return table[:, 0] if len(names) == 1 else table


def _stops(moments: NDArray[np.float64], stops: Sequence[tuple[float, int]]) -> NDArray[np.float32]:
    column = np.zeros(len(moments), dtype=np.float32)
    for at, code in sorted(stops, key=lambda stop: _WEIGHT.index(stop[1])):
        if code == LOCKED_OUT and at - moments[-1] > AFTER_S:
            continue
        column[min(int(np.searchsorted(moments, at)), len(moments) - 1)] = code
    return column


def _actor(policy: object, otherwise: int = UNKNOWN) -> int:
    """Return who acts, by the name of a policy; ``otherwise`` without one."""
    return otherwise if policy in (None, "") else _ACTORS.get(str(policy), BY_POLICY)


def _joints(names: tuple[str, ...], units: Mapping[str, str]) -> Feature:
    stated = tuple(units.get(name, "") for name in names)
    return Feature("float32", (len(names),), names, units=stated if any(stated) else ())


def _numbers(value: object) -> dict[str, float]:
    return numbers(value) if isinstance(value, Mapping) else {}
