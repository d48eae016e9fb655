"""The actions of a recording as frames that lead."""

from __future__ import annotations

from pathlib import Path

from strands_robots.policies.base import Action, numbers
from strands_robots.recording.file import STEP, Entry, Joints, read_items, whose
from strands_robots.teleoperators.recorded import Frame
from strands_robots.utils import ValidationError, shown


def recorded_actions(path: Path, device: str | None = None) -> list[Frame]:
    """The actions of one device of a recording as frames that lead, seconds since the first.

    Where nobody drove it through this machine while it was recorded, as when it was moved by hand, the joints lead.

    Args:
        path: an ``.mcap`` file.
        device: whose; ``WORLD/ROBOT``, or the world alone, for a robot of a simulated world.

    Raises:
        ValidationError: nothing that leads, or that of several devices and none named.
    """
    actions: dict[str, list[Frame]] = {}
    joints: dict[str, list[Frame]] = {}
    for item in read_items(path):
        if isinstance(item, Joints):
            _keep(joints.setdefault(item.device, []), item.at, dict(item.joints))
        elif isinstance(item, Entry) and item.event == STEP:
            # A robot of a simulated world leads by itself.
            _keep(actions.setdefault(whose(item), []), item.at, numbers(item.payload.get("action") or {}))
    leading = {**joints, **{who: kept for who, kept in actions.items() if kept}}
    if not leading:
        raise ValidationError(f"{path.name} has neither actions nor joints: nothing in it can lead.")
    named = {who: kept for who, kept in leading.items() if device is None or device in (who, who.partition("/")[0])}
    chosen = {who: kept for who, kept in named.items() if actions.get(who)} or named
    if len(chosen) != 1:
        known = ", ".join(leading)
        raise ValidationError(f"device must be one of those that were recorded ({known}), not {shown(device)}.")
    (kept,) = chosen.values()
    return [(at - kept[0][0], action) for at, action in kept]


def _keep(kept: list[Frame], at: float, action: Action) -> None:
    if action and (not kept or at > kept[-1][0]):
        kept.append((at, action))
