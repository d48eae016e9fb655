"""Check of a policy against a robot, before anything moves.

Every question is a row with both sides and their owners. What two sources contradict is *refused*; what none of them
states is *unverified*. Units, rate and image size keep the robot from moving until the profile states them or lists
them under ``confirmed``; other unanswered questions are told. Nothing is taken from the order of a dictionary.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path
from typing import Literal

from strands_robots.policies.base import Ranges
from strands_robots.policies.checkpoint import (
    ACTION,
    STATE,
    Size,
    Spread,
    Statement,
    checkpoint_statements,
    dataset_statements,
)
from strands_robots.policies.profiles import CameraMap, Profile
from strands_robots.utils import ValidationError, joint_name

Outcome = Literal["ok", "confirmed", "unverified", "refused"]

PROFILE, ROBOT = "profile", "robot"
"""Owners of values beside the sources on disk."""


def of(value: object, owner: str) -> str:
    """Return a value with its owner."""
    return f"{value} ({owner})"


def converted(value: float, unit: str | None, to: str | None) -> float:
    """Return a value in another unit; unchanged where there is no conversion."""
    if unit == "radians" and to == "degrees":
        return math.degrees(value)
    return math.radians(value) if unit == "degrees" and to == "radians" else value


@dataclass(frozen=True)
class RobotFacts:
    """Facts of a robot, for the check.

    Attributes:
        state: present values of what it observes, by key.
        action: its action keys.
        units: unit by key, where it is known.
        cameras: size by name; None for one that draws any size.
        rate: its control rate in Hz.
        ranges: lowest and highest target by action key.
        kind: its type, such as ``so101_follower``; empty where it is not known.
    """

    name: str
    state: Mapping[str, float]
    action: Sequence[str]
    units: Mapping[str, str] = field(default_factory=dict)
    cameras: Mapping[str, Size | None] = field(default_factory=dict)
    rate: float = 50.0
    ranges: Ranges = field(default_factory=dict)
    kind: str = ""


@dataclass(frozen=True)
class CheckRow:
    """One question: both sides, the outcome, and the line of the profile to change.

    Attributes:
        blocks: the robot may not move while the row is unverified.
    """

    question: str
    policy: str
    robot: str
    outcome: Outcome
    change: str = ""
    blocks: bool = True


def compared(question: str, policy: str, robot: str, fits: bool, change: str) -> CheckRow:
    """Return the row of two values that are both stated."""
    return CheckRow(question, policy, robot, "ok" if fits else "refused", "" if fits else change)


def unanswered(question: str, policy: str = "not stated", robot: str = "-", change: str = "") -> CheckRow:
    """Return the row of a question that no source answers; it blocks no motion."""
    return CheckRow(question, policy, robot, "unverified", change or "look at it yourself", blocks=False)


OUTSIDE_SHARE = 0.5
"""Part of a joint's range by which the actions of the data may be outside of it: another arm's calibration."""

NARROW_SHARE = 0.04
"""Part of the joints' ranges below which all actions are no positions in their unit; radians of degrees are 0.0175."""

CHANGES_SHARE = 0.2
"""Part of the states' range below which the actions of the same data are changes of positions."""

WIDEST = math.pi
"""Most of a joint's range that the actions are compared with, in radians: few tasks turn a joint further."""

RATIO_MAX = 3.0
"""Greatest ratio of the ranges that two sources state of the same data."""

UNIT_RATIOS, UNIT_RATIO_WITHIN = (math.degrees(1.0), 100.0), 1.25
"""Ratios of ranges in two units, radians of degrees and parts of percent, and the factor by which they may vary."""

NOISE_SHARE = 0.02
"""Part of the widest range that two sources may always differ by, as of a joint that stood still."""

_SO_ARMS = frozenset({"so", "so100", "so101"})
"""Arms with the same joints, units and directions."""


def agreement(profile: Profile, statements: Sequence[Statement], robot: RobotFacts) -> Iterator[CheckRow]:
    """Yield the rows of every source against every other."""
    yield from _robot(profile, statements, robot)
    yield from _order(profile, statements)
    yield from _ranges(profile, statements, robot)
    yield from _normalization(statements)
    yield from _pictures(profile, statements)


def _robot(profile: Profile, statements: Sequence[Statement], robot: RobotFacts) -> Iterator[CheckRow]:
    stated = [(each.source, each.robot) for each in statements if each.robot]
    if not stated or not _family(robot.kind):
        recorded = ", ".join(of(name, source) for source, name in stated) or "not stated"
        yield unanswered("robot type", recorded, of(robot.kind or "not stated", ROBOT))
        return
    for source, name in stated:
        same = _family(name) == _family(robot.kind)
        outcome: Outcome = "ok" if same else "confirmed" if "robot type" in profile.confirmed else "unverified"
        change = "" if same else 'take a policy of this robot, or list "robot type" under confirmed'
        yield CheckRow("robot type", of(name, source), of(robot.kind, ROBOT), outcome, change)


def _family(kind: str) -> str:
    """Return the name of robots of one kind; empty for the file of a model."""
    name = kind.lower().removesuffix("_follower")
    if "/" in name or "." in name:
        return ""
    return "so" if name in _SO_ARMS else name


def _order(profile: Profile, statements: Sequence[Statement]) -> Iterator[CheckRow]:
    for name, keys, stated in (
        ("state order", profile.state, any(each.state is not None for each in statements)),
        ("action order", profile.action, any(each.action is not None for each in statements)),
    ):
        if not stated:
            yield unanswered(name, robot=of(", ".join(keys), PROFILE), change="name the dataset, for its names")


def _ranges(profile: Profile, statements: Sequence[Statement], robot: RobotFacts) -> Iterator[CheckRow]:
    states = _usable([(each.source, each.state_range) for each in statements], len(profile.state))
    actions = _usable([(each.source, each.action_range) for each in statements], len(profile.action))
    if not states:
        yield unanswered("state in the data", change="name the dataset, for its statistics")
    for feature, keys, stated in ((STATE, profile.state, states), (ACTION, profile.action, actions)):
        for (one, first), (other, second) in combinations(stated.items(), 2):
            yield _same_data(profile, feature, keys, (one, first), (other, second))
    limits = _limits(profile, robot)
    if not actions or not limits:
        shown = of("its range", next(iter(actions))) if actions else "not stated"
        known = of("ranges of the joints", ROBOT) if limits else "not stated"
        yield unanswered("range of the actions", shown, known)
    for source, bounds in actions.items():
        if limits:
            yield _inside(profile, limits, _spread(states, source, bounds), source, bounds)
        if source in states:
            yield _positions(profile, source, states[source], bounds)
    for source, bounds in actions.items():
        # The preprocessor has the state's statistics, the postprocessor those of the action.
        spread = _spread(states, source, bounds)
        if source not in states and spread:
            yield _positions(profile, source, spread, bounds)


def _spread(states: Mapping[str, Spread], source: str, actions: Spread) -> Spread | None:
    """Return the range of the states that actions are compared with."""
    return states.get(source) or next((each for each in states.values() if each.kind == actions.kind), None)


def _usable(stated: Sequence[tuple[str, Spread | None]], size: int) -> dict[str, Spread]:
    """Return the ranges of the right size, by source. Sizes have rows of their own."""
    return {source: bounds for source, bounds in stated if bounds is not None and len(bounds.low) == size}


def _limits(profile: Profile, robot: RobotFacts) -> dict[str, tuple[float, float]]:
    """Return the finite range of each action key, in the policy's unit."""
    found = {}
    for key in profile.action:
        low, high = robot.ranges.get(key, (-math.inf, math.inf))
        if math.isfinite(high - low) and high > low:
            ends = [converted(end, robot.units.get(key), profile.unit(key)) for end in (low, high)]
            found[key] = (ends[0], ends[1])
    return found


def _inside(
    profile: Profile,
    limits: Mapping[str, tuple[float, float]],
    states: Spread | None,
    source: str,
    bounds: Spread,
) -> CheckRow:
    """The actions lie in the joints' ranges, and cover more than a sliver of them."""
    outside: list[tuple[str, str]] = []
    shares: list[float] = []
    for key, low, high in zip(profile.action, bounds.low, bounds.high, strict=True):
        if key not in limits:
            continue
        bottom, top = limits[key]
        width = top - bottom
        if low < bottom - OUTSIDE_SHARE * width or high > top + OUTSIDE_SHARE * width:
            outside.append((f"{key} {low:g} to {high:g}", f"{key} {bottom:g} to {top:g}"))
        if profile.unit(key) != "percent":
            shares.append((high - low) / min(width, converted(WIDEST, "radians", profile.unit(key))))
    narrow = bool(shares) and max(shares) < NARROW_SHARE
    wrong = "; ".join(each for each, _ in outside) or ("less than 4 % of every joint" if narrow else "inside")
    theirs = "; ".join(each for _, each in outside) or "ranges of the joints"
    question, change = "range of the actions", "check units, and that the actions are positions of joints"
    changes = states is not None and 0 < max(_shares(profile, states, bounds), default=0.0) < CHANGES_SHARE
    if narrow and not outside and not changes:
        return _vouched(profile, question, of(wrong, source), of(theirs, ROBOT), f"{change};", by="units")
    return compared(question, of(wrong, source), of(theirs, ROBOT), not outside and not narrow, change)


def _vouched(profile: Profile, question: str, policy: str, robot: str, change: str, *, by: str) -> CheckRow:
    """Return the row of a question for which the operator may vouch in the profile."""
    outcome: Outcome = "confirmed" if by in profile.confirmed else "unverified"
    return CheckRow(question, policy, robot, outcome, f'{change} or list "{by}" under confirmed')


def _shares(profile: Profile, states: Spread, actions: Spread) -> list[float]:
    """Return the part of each state's range that its action spans."""
    spans = dict(zip(profile.state, zip(states.low, states.high, strict=True), strict=True))
    shares = []
    for key, low, high in zip(profile.action, actions.low, actions.high, strict=True):
        bottom, top = spans.get(key, (0.0, 0.0))
        if top > bottom and profile.unit(key) != "percent":
            shares.append((high - low) / (top - bottom))
    return shares


def _positions(profile: Profile, source: str, states: Spread, actions: Spread) -> CheckRow:
    """The actions span about what the states span, or they are changes of them."""
    shares = _shares(profile, states, actions)
    changes = bool(shares) and max(shares) < CHANGES_SHARE
    said = f"at most {100 * max(shares):.0f} % of the states' range" if shares else "no key of the state"
    change = "take a policy whose actions are positions, not changes"
    return compared("actions and states", of(said, source), "positions", not changes, change)


def _same_data(
    profile: Profile, feature: str, keys: Sequence[str], one: tuple[str, Spread], other: tuple[str, Spread]
) -> CheckRow:
    """Two sources state about the same range, as of the same data."""
    question, (_, first), (_, second) = f"range of {feature}", one, other
    if first.kind != second.kind:
        sides = ["quantiles" if bounds.kind != "min" else "bounds" for bounds in (first, second)]
        return unanswered(question, of(sides[0], one[0]), of(sides[1], other[0]))
    far: list[tuple[str, str]] = []
    ratios: list[float] = []
    disjoint = False
    every = [high - low for bounds in (first, second) for low, high in zip(bounds.low, bounds.high, strict=True)]
    noise = NOISE_SHARE * max(every)
    for key, low, high, bottom, top in zip(keys, *first[:2], *second[:2], strict=True):
        spans = sorted((high - low, top - bottom))
        apart = low > top + noise or bottom > high + noise
        disjoint |= apart
        if spans[1] > noise:
            ratios.append(spans[1] / spans[0] if spans[0] > 0 else math.inf)
        if apart or spans[1] > RATIO_MAX * spans[0] + noise:
            far.append((f"{key} {low:g} to {high:g}", f"{key} {bottom:g} to {top:g}"))
    mine, theirs = (
        of("; ".join(each[side] for each in far) or "the same range", (one, other)[side][0]) for side in (0, 1)
    )
    change = "name the dataset that the checkpoint was trained on, or the checkpoint of this dataset"
    if far and not disjoint and 2 * sum(map(_is_unit, ratios)) < len(ratios):
        return _vouched(profile, question, mine, theirs, f"{change};", by="units")
    return compared(question, mine, theirs, not far, change)


def _is_unit(ratio: float) -> bool:
    """Return True for the ratio of ranges in two units."""
    return any(unit / UNIT_RATIO_WITHIN <= ratio <= unit * UNIT_RATIO_WITHIN for unit in UNIT_RATIOS)


def _normalization(statements: Sequence[Statement]) -> Iterator[CheckRow]:
    """Configuration and processors normalise alike."""
    if all(each.statistics is None for each in statements):
        return
    for kind in ("STATE", "ACTION"):
        stated = [(each.source, (each.normalization or {}).get(kind)) for each in statements]
        modes = [(source, mode) for source, mode in stated if mode]
        if len(modes) < 2:
            yield unanswered(f"normalisation of {kind}", ", ".join(of(mode, source) for source, mode in modes) or "-")
        for source, mode in modes[1:]:
            fits = mode == modes[0][1]
            change = "save the checkpoint anew, with the processors of its configuration"
            yield compared(f"normalisation of {kind}", of(modes[0][1], modes[0][0]), of(mode, source), fits, change)


def _pictures(profile: Profile, statements: Sequence[Statement]) -> Iterator[CheckRow]:
    """The policy's pictures are those of the data."""
    seen = [(each.source, each.cameras) for each in statements if each.cameras]
    data = [(each.source, each.recorded) for each in statements if each.recorded is not None]
    renamed: dict[str, str] = {}
    for each in statements:
        renamed |= each.renamed or {}
    for source, cameras in seen:
        if not data:
            yield unanswered("pictures of the data", of(", ".join(cameras), source))
        for owner, recorded in data:
            theirs = {renamed.get(key, key): size for key, size in recorded.items()}
            for key, size in cameras.items():
                yield _picture(profile, key, (size, source), (theirs, owner))
            for key in theirs.keys() - cameras.keys():
                change = "the policy does not see it"
                yield unanswered(
                    f"data of {key}", of("no such picture", source), of(_shown(theirs[key]), owner), change
                )


def _picture(profile: Profile, key: str, seen: tuple[Size, str], data: tuple[Mapping[str, Size], str]) -> CheckRow:
    """Compare a picture of the policy with those of the data; each with its source."""
    question, (size, source), (theirs, owner) = f"data of {key}", seen, data
    mine = of(_shown(size), source)
    if key not in theirs:
        have = of(", ".join(theirs) or "no pictures", owner)
        return compared(question, mine, have, fits=False, change="name the dataset that it was trained on")
    if theirs[key] == size:
        return compared(question, mine, of(_shown(theirs[key]), owner), fits=True, change="")
    change = "name the dataset that it was trained on,"
    return _vouched(profile, question, mine, of(_shown(theirs[key]), owner), change, by="image size")


def _shown(size: Size) -> str:
    return f"{size[0]}x{size[1]}, {size[2]} channels"


CONVERTIBLE = frozenset({"degrees", "radians"})
"""Units between which a profile converts."""

RGB = 3

PLAY_SHARE = 0.02
"""Part of a joint's range by which it may always be outside of the data."""


@dataclass(frozen=True)
class PolicyCheck:
    """All rows of one policy on one robot."""

    profile: str
    rows: tuple[CheckRow, ...]

    @property
    def passed(self) -> bool:
        """True when the robot may move."""
        return not self.failures

    @property
    def failures(self) -> tuple[CheckRow, ...]:
        """The rows for which the robot may not move."""
        return tuple(
            row for row in self.rows if row.outcome == "refused" or (row.outcome == "unverified" and row.blocks)
        )

    @property
    def unanswered(self) -> tuple[CheckRow, ...]:
        """Questions that no source answers, and that keep nothing from moving."""
        return tuple(row for row in self.rows if row.outcome == "unverified" and not row.blocks)

    def refusal(self) -> str:
        """Return the failed rows as a sentence each; empty when it passed."""
        lines = [
            f"{row.question} is {row.outcome}: the policy has {row.policy}, the robot {row.robot}; {row.change}"
            for row in self.failures
        ]
        return f"the profile {self.profile} does not fit this robot. {'. '.join(lines)}." if lines else ""


class PolicyCheckError(ValidationError):
    """A policy does not fit its robot; ``check`` has both sides."""

    def __init__(self, check: PolicyCheck) -> None:
        super().__init__(check.refusal())
        self.check = check


def statements_of(profile: Profile) -> list[Statement]:
    """Return what checkpoint and dataset on this machine state of a profile."""
    checkpoint = Path(profile.checkpoint).expanduser()
    # What a server loads may be on its own disk alone.
    absent = not profile.checkpoint or (profile.url and not checkpoint.is_dir())
    found = [] if absent else checkpoint_statements(checkpoint)
    return found + (dataset_statements(Path(profile.dataset).expanduser()) if profile.dataset else [])


def check_policy(profile: Profile, statements: Sequence[Statement], robot: RobotFacts) -> PolicyCheck:
    """Compare a profile and what its sources state with a robot."""
    rows = [
        *_sources(statements),
        *_kind(profile, statements),
        *_vector("state", profile.state, [(s.source, s.state, s.state_size) for s in statements], list(robot.state)),
        *_environment(profile, statements, robot),
        *_values(profile, statements, robot),
        *_vector("action", profile.action, [(s.source, s.action, s.action_size) for s in statements], robot.action),
        *_cameras(profile, statements, robot),
        *_statistics(profile, statements),
        *_units(profile, robot),
        *_rate(profile, statements, robot),
        *_chunk(profile, statements),
        *_task(profile, statements),
        *agreement(profile, statements, robot),
    ]
    return PolicyCheck(profile.name, tuple(rows))


def _sources(statements: Sequence[Statement]) -> Iterator[CheckRow]:
    for each in statements:
        if each.problem:
            yield CheckRow(
                "checkpoint", f"{each.source}: {each.problem}", "-", "refused", "correct checkpoint or dataset"
            )


def _kind(profile: Profile, statements: Sequence[Statement]) -> Iterator[CheckRow]:
    for each in statements:
        if each.kind and profile.policy_type:
            change = f'set policy_type = "{each.kind}"'
            fits = each.kind == profile.policy_type
            yield compared("policy type", of(each.kind, each.source), of(profile.policy_type, PROFILE), fits, change)


def _vector(
    name: str,
    chosen: tuple[str, ...],
    stated: Sequence[tuple[str, tuple[str, ...] | None, int | None]],
    present: Sequence[str],
) -> Iterator[CheckRow]:
    """Names, order and dimension of state or action."""
    mine = of(", ".join(chosen), PROFILE)
    unknown = [key for key in chosen if key not in present]
    missing = [key for key in present if key not in chosen] if name == "action" else []
    change = f"{name} has {', '.join(unknown)}, which the robot has not" if unknown else ""
    change = change or f"{name} lacks {', '.join(missing)}: they would keep still"
    yield compared(f"{name} names", mine, of(", ".join(present), ROBOT), not (unknown or missing), change)
    for source, names, size in stated:
        if names is not None:
            same = [joint_name(key) for key in names] == [joint_name(key) for key in chosen]
            change = f"put {name} into the order of {source}"
            yield compared(f"{name} order", f"{', '.join(names)} ({source})", mine, same, change)
        if size is not None:
            same = size == len(chosen)
            yield compared(
                f"{name} size", f"{size} ({source})", of(len(chosen), PROFILE), same, f"name {size} keys in {name}"
            )


def _environment(profile: Profile, statements: Sequence[Statement], robot: RobotFacts) -> Iterator[CheckRow]:
    """Numbers of what is around the robot, of a policy that takes them."""
    stated = [(s.source, s.environment, s.environment_size) for s in statements]
    if profile.environment or any(size or names for _, names, size in stated):
        yield from _vector("environment", profile.environment, stated, list(robot.state))


def _values(profile: Profile, statements: Sequence[Statement], robot: RobotFacts) -> Iterator[CheckRow]:
    """The present state: finite, and not far outside of the data."""
    present = [robot.state.get(key) for key in profile.state]
    unusable = [
        key for key, value in zip(profile.state, present, strict=True) if value is None or not math.isfinite(value)
    ]
    if unusable and all(key in robot.state for key in unusable):
        yield CheckRow(
            "state values", "finite numbers", f"none for {', '.join(unusable)}", "refused", "look at the robot"
        )
    for each in statements:
        if each.state_range is None or unusable or len(each.state_range.low) != len(profile.state):
            continue
        far = []
        for key, low, high in zip(profile.state, *each.state_range[:2], strict=True):
            value = converted(robot.state[key], robot.units.get(key), profile.unit(key))
            # A joint that never moved in the data is never exactly there again.
            bottom, top = (
                converted(end, robot.units.get(key), profile.unit(key)) for end in robot.ranges.get(key, (0.0, 0.0))
            )
            play = PLAY_SHARE * (top - bottom) if math.isfinite(top - bottom) else 0.0
            margin = max(profile.state_margin * (high - low), play)
            if not low - margin <= value <= high + margin:
                far.append(f"{key} {value:g} outside {low:g} to {high:g}")
        change = "move the robot to where the data begins, or check units and zero"
        outside = "; ".join(far) or "inside"
        yield compared("state in the data", f"its range ({each.source})", of(outside, ROBOT), not far, change)


def _cameras(profile: Profile, statements: Sequence[Statement], robot: RobotFacts) -> Iterator[CheckRow]:
    mapped = {each.key: each for each in profile.cameras}
    for each in profile.cameras:
        yield from _camera(profile, each, robot)
    for statement in statements:
        if statement.cameras is None:
            continue
        for key, (height, width, channels) in statement.cameras.items():
            wanted = f"{height}x{width}, {channels} channels ({statement.source})"
            camera = mapped.get(key)
            if camera is None:
                change = f"give a camera the key {key}"
                yield CheckRow(f"picture {key}", wanted, "no camera", "refused", change)
                continue
            size = _size(camera, robot)
            given = f"{camera.camera}, {'any size' if size is None else f'{size[0]}x{size[1]}'}"
            fits = channels == RGB and (size is None or size == (height, width))
            yield compared(
                f"picture {key}", wanted, given, fits, f"set cameras.{camera.camera}.size = [{height}, {width}]"
            )
        for key in mapped.keys() - statement.cameras.keys():
            known = ", ".join(statement.cameras) or "no pictures"
            change = f"no picture of the policy has the key {key}"
            yield CheckRow(f"picture {key}", f"{known} ({statement.source})", mapped[key].camera, "refused", change)


def _camera(profile: Profile, camera: CameraMap, robot: RobotFacts) -> Iterator[CheckRow]:
    """The robot's side of one camera."""
    question, where = f"camera {camera.camera}", f"cameras.{camera.camera}"
    if camera.camera not in robot.cameras:
        have = ", ".join(robot.cameras) or "no cameras"
        yield CheckRow(question, camera.key, have, "refused", f"rename {where} to one of them")
        return
    size = robot.cameras[camera.camera]
    shown = "any size" if size is None else f"{size[0]}x{size[1]}, {size[2]} channels"
    if size is not None and size[2] != RGB:
        first = size[0] == RGB
        change = "it gives pictures channel-first" if first else "it must give RGB"
        yield CheckRow(question, "height x width x 3", shown, "refused", change)
        return
    if size is not None and camera.crop is not None:
        x, y, width, height = camera.crop
        if x + width > size[1] or y + height > size[0]:
            yield CheckRow(question, f"crop {list(camera.crop)}", shown, "refused", f"{where}.crop is outside of it")
    if camera.size is None and (size is None or profile.url):
        change = f"set {where}.size,"
        yield _vouched(profile, f"{question}, image size", "not stated", shown, change, by="image size")


def _size(camera: CameraMap, robot: RobotFacts) -> tuple[int, int] | None:
    if camera.size is not None:
        return camera.size
    if camera.crop is not None:
        return camera.crop[3], camera.crop[2]
    size = robot.cameras.get(camera.camera)
    return None if size is None else (size[0], size[1])


def _statistics(profile: Profile, statements: Sequence[Statement]) -> Iterator[CheckRow]:
    for each in statements:
        if each.statistics is None:
            continue
        for feature in sorted(each.needed):
            there = feature in each.statistics
            change = "save the checkpoint with its processors: raw numbers would go to the motors"
            has = of("present" if there else "none", each.source)
            yield compared(f"statistics of {feature}", has, "-", there, change)


def _units(profile: Profile, robot: RobotFacts) -> Iterator[CheckRow]:
    for key in dict.fromkeys((*profile.action, *profile.state)):
        mine, its = profile.unit(key), robot.units.get(key)
        if mine is not None and its is not None:
            fits = mine == its or {mine, its} <= CONVERTIBLE
            change = f'units."{key}" must be {its}, or the robot configured for {mine}'
            yield compared(f"unit of {key}", of(mine, PROFILE), of(its, ROBOT), fits, change)
        elif key in profile.action:
            sides = mine or "not stated", its or "not stated"
            yield _vouched(profile, f"unit of {key}", *sides, "set units,", by="units")


def _rate(profile: Profile, statements: Sequence[Statement], robot: RobotFacts) -> Iterator[CheckRow]:
    stated = [(each.source, each.rate) for each in statements if each.rate is not None]
    if profile.rate is not None and not stated:
        yield unanswered("rate of the data", robot=of(f"{profile.rate:g} Hz", PROFILE))
    if profile.rate is None:
        hint = f", {stated[0][1]:g} in {stated[0][0]}" if stated else ""
        change = f"set rate to that of the data{hint},"
        yield _vouched(profile, "rate", "not stated", of(f"{robot.rate:g} Hz", ROBOT), change, by="rate")
        return
    for source, rate in stated:
        same = math.isclose(rate, profile.rate, rel_tol=1e-3)
        yield compared(
            "rate of the data",
            f"{rate:g} Hz ({source})",
            of(f"{profile.rate:g} Hz", PROFILE),
            same,
            f"set rate = {rate:g}",
        )
    change = f"serve the robot with control_hz={profile.rate:g}"
    yield compared(
        "rate", of(f"{profile.rate:g} Hz", PROFILE), of(f"{robot.rate:g} Hz", ROBOT), profile.rate <= robot.rate, change
    )


def _chunk(profile: Profile, statements: Sequence[Statement]) -> Iterator[CheckRow]:
    for each in statements:
        if each.chunk is None:
            continue
        for name, value in (("chunk", profile.chunk), ("horizon", profile.horizon)):
            if value is not None:
                fits = value == each.chunk if name == "chunk" else value <= each.chunk
                change = f"set {name} {'to' if name == 'chunk' else 'to at most'} {each.chunk}"
                yield compared(name, f"{each.chunk} ({each.source})", of(value, PROFILE), fits, change)


def _task(profile: Profile, statements: Sequence[Statement]) -> Iterator[CheckRow]:
    if any(each.language is False for each in statements) and profile.task:
        yield CheckRow("task", "follows no text", repr(profile.task), "refused", "leave task out")
