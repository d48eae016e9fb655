"""Comparison of the sources of one policy with each other and with the joints."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations

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
from strands_robots.policies.checkpoint import ACTION, STATE, Size, Spread, Statement
from strands_robots.policies.profiles import Profile

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
        return _vouched(profile, question, of(wrong, source), of(theirs, ROBOT), change)
    return compared(question, of(wrong, source), of(theirs, ROBOT), not outside and not narrow, change)


def _vouched(profile: Profile, question: str, policy: str, robot: str, change: str) -> CheckRow:
    """Return the row of a difference that the operator may vouch for."""
    outcome: Outcome = "confirmed" if "units" in profile.confirmed else "unverified"
    return CheckRow(question, policy, robot, outcome, f'{change}; or list "units" under confirmed')


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
        return _vouched(profile, question, mine, theirs, change)
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
    outcome: Outcome = "confirmed" if "image size" in profile.confirmed else "unverified"
    change = 'name the dataset that it was trained on, or list "image size" under confirmed'
    return CheckRow(question, mine, of(_shown(theirs[key]), owner), outcome, change)


def _shown(size: Size) -> str:
    return f"{size[0]}x{size[1]}, {size[2]} channels"
