"""The actions of a recording as frames that lead."""

from __future__ import annotations

from pathlib import Path

from strands_robots.leaders.recorded import Frame
from strands_robots.policies.actions import numbers
from strands_robots.recording.file import STEP, read_entries, whose
from strands_robots.utils import ValidationError, shown


def recorded_actions(path: Path, device: str | None = None) -> list[Frame]:
    """The actions of one device of a recording as frames that lead, seconds since the first.

    Raises:
        ValidationError: no actions, or those of several devices and none named.
    """
    frames: dict[str, list[Frame]] = {}
    for entry in read_entries(path):
        action = numbers(entry.payload.get("action") or {}) if entry.event == STEP else {}
        if action:
            # A robot of a simulated world leads by itself.
            kept = frames.setdefault(whose(entry), [])
            if not kept or entry.at > kept[-1][0]:
                kept.append((entry.at, action))
    if not frames:
        raise ValidationError(f"{path.name} has no actions: nothing was driven while it was recorded.")
    chosen = {who: kept for who, kept in frames.items() if device is None or device in (who, who.partition("/")[0])}
    if len(chosen) != 1:
        known = ", ".join(frames)
        raise ValidationError(f"device must be one of whose actions were recorded ({known}), not {shown(device)}.")
    (kept,) = chosen.values()
    return [(at - kept[0][0], action) for at, action in kept]
