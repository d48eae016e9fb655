"""Tip of a robot's model: the site that motions place, found by rule or named.

1. The site or body that the caller names.
2. A site called ``gripper_tip``.
3. Of the sites with one of :data:`WORDS` in their name, that with the most actuated joints before it, at least three.
4. The last body of the longest chain of actuated joints. Where fingers branch off an arm, the body that carries them.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import mujoco

from strands_robots.utils import ValidationError, shown

WORDS = frozenset({"tip", "tcp", "ee", "eef", "effector", "pinch", "grip", "gripper", "attachment"})
"""Words of a site's name that make it a tip; names are split at everything but letters and digits."""

ARM_JOINTS_MIN = 3
"""Fewest joints that place a tip at a point."""

FINGER_JOINTS_MAX = 5
"""Most joints of a finger."""

_NAMES_SHOWN = 12

_SINGLE = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
_ON_JOINT = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)


@dataclass(frozen=True)
class _Node:
    """One body, and how many actuated joints lead to it."""

    body: Any
    joints: int
    jointed: bool
    children: tuple[_Node, ...]

    @property
    def below(self) -> int:
        """Actuated joints of its longest branch below it."""
        return max((child.joints + child.below - self.joints for child in self.children), default=0)

    def nodes(self) -> Iterator[_Node]:
        yield self
        for child in self.children:
            yield from child.nodes()

    @property
    def moves(self) -> bool:
        return any(node.jointed for node in self.nodes())


def mark_tip(spec: Any, tip: str = "") -> str:
    """Return the name of the tip's site, which is added where the tip is a body.

    Args:
        spec: the model, which is changed.
        tip: name of a site or a body; empty for the rule of this module.

    Returns:
        The site's name; empty for a model without a site for it and without an actuated joint.

    Raises:
        ValidationError: the model has no site and no body called ``tip``.
    """
    actuated = {each.target for each in spec.actuators if each.trntype in _ON_JOINT}
    tree = _tree(spec.worldbody, 0, actuated if spec.actuators else None)
    if tip:
        return _named(tree, tip)
    sites = [(node, str(site.name)) for node in tree.nodes() for site in node.body.sites]
    for _, name in sites:
        if name.endswith("gripper_tip"):
            return name
    worded = [(node.joints, name) for node, name in sites if WORDS & set(re.split(r"[^a-z0-9]+", name.lower()))]
    joints, name = max(worded, key=lambda each: each[0], default=(0, ""))
    if joints >= ARM_JOINTS_MIN:
        return name
    end = _end(tree)
    return "" if end is None else _site_of(end.body, {name for _, name in sites})


def _tree(body: Any, joints: int, actuated: set[str] | None) -> _Node:
    own = [joint for joint in body.joints if joint.type in _SINGLE]
    joints += sum(actuated is None or joint.name in actuated for joint in own)
    return _Node(body, joints, bool(own), tuple(_tree(child, joints, actuated) for child in body.bodies))


def _end(tree: _Node) -> _Node | None:
    """Return the end of the longest actuated chain, or what carries its fingers."""
    node = tree
    if not node.below:
        return None
    while node.below:
        fingers = sum(child.moves for child in node.children) > 1 and node.below <= FINGER_JOINTS_MAX
        if fingers and node.joints >= ARM_JOINTS_MIN and node.joints > node.below:
            break
        node = max(node.children, key=lambda child: child.joints + child.below)
    return node


def _named(tree: _Node, tip: str) -> str:
    sites = {str(site.name) for node in tree.nodes() for site in node.body.sites}
    if tip in sites:
        return tip
    bodies = [node.body for node in tree.nodes()][1:]
    body = next((each for each in bodies if each.name == tip), None)
    if body is None:
        known = [*sorted(sites - {""}), *(str(each.name) for each in bodies if each.name)]
        more = f" and {len(known) - _NAMES_SHOWN} more" if len(known) > _NAMES_SHOWN else ""
        raise ValidationError(
            f"tip must be a site or a body of the model ({', '.join(known[:_NAMES_SHOWN])}{more}), not {shown(tip)}."
        )
    return _site_of(body, sites)


def _site_of(body: Any, taken: set[str]) -> str:
    name = "tip"
    while name in taken:
        name += "_"
    body.add_site(name=name)
    return name
