"""Check of a policy against a robot, before anything moves.

Every question is a row with both sides and their owners. What two sources contradict is *refused*; what none of them
states is *unverified*. Units, rate and image size keep the robot from moving until the profile states them or lists
them under ``confirmed``; other unanswered questions are told. Nothing is taken from the order of a dictionary.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from strands_robots.policies.agreement import agreement
from strands_robots.policies.check_rows import (
    PROFILE,
    ROBOT,
    CheckRow,
    Outcome,
    RobotFacts,
    compared,
    converted,
    of,
    unanswered,
)
from strands_robots.policies.checkpoint import Statement, checkpoint_statements
from strands_robots.policies.dataset_facts import dataset_statements
from strands_robots.policies.profiles import CameraMap, Profile
from strands_robots.utils import ValidationError, joint_name

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
        outcome: Outcome = "confirmed" if "image size" in profile.confirmed else "unverified"
        change = f'set {where}.size, or list "image size" under confirmed'
        yield CheckRow(f"{question}, image size", "not stated", shown, outcome, change)


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
            outcome: Outcome = "confirmed" if "units" in profile.confirmed else "unverified"
            change = 'set units, or list "units" under confirmed'
            yield CheckRow(f"unit of {key}", mine or "not stated", its or "not stated", outcome, change)


def _rate(profile: Profile, statements: Sequence[Statement], robot: RobotFacts) -> Iterator[CheckRow]:
    stated = [(each.source, each.rate) for each in statements if each.rate is not None]
    if profile.rate is not None and not stated:
        yield unanswered("rate of the data", robot=of(f"{profile.rate:g} Hz", PROFILE))
    if profile.rate is None:
        outcome: Outcome = "confirmed" if "rate" in profile.confirmed else "unverified"
        hint = f", {stated[0][1]:g} in {stated[0][0]}" if stated else ""
        change = f'set rate to that of the data{hint}, or list "rate" under confirmed'
        yield CheckRow("rate", "not stated", of(f"{robot.rate:g} Hz", ROBOT), outcome, change)
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
