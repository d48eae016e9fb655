"""LeRobot devices by name.

LeRobot keeps its robots in a registry of configuration classes (``RobotConfig``), filled when the module of each
robot is imported; ``make_robot_from_config`` then builds the device. Written against LeRobot 0.4; the light parts
of that interface are exercised by this project, the real package is not installed where it is tested.
"""

from __future__ import annotations

import difflib
import importlib
import logging
import pkgutil
from typing import Any

from strands_robots.utils import ValidationError, missing_extra, shown

logger = logging.getLogger(__name__)

_SUFFIX = "_follower"


def make_device(name: str, options: dict[str, Any]) -> Any:
    """A LeRobot device, not connected yet.

    Args:
        name: a LeRobot robot type, such as ``so100_follower``; ``so100`` means the same.
        options: fields of its configuration, such as ``port`` and ``id``.

    Raises:
        MissingExtraError: LeRobot is not installed.
        ValidationError: an unknown name, with the near ones, or options that its configuration refuses.
    """
    try:
        robots = importlib.import_module("lerobot.robots")
    except ModuleNotFoundError as exc:
        raise missing_extra(f"The real robot {shown(name)}", "lerobot") from exc
    _register_all(robots)
    known: dict[str, Any] = robots.RobotConfig.get_known_choices()
    kind = name if name in known else f"{name}{_SUFFIX}"
    if kind not in known:
        near = difflib.get_close_matches(str(name), known, n=4, cutoff=0.4)
        hint = f"near it: {', '.join(near)}" if near else f"known: {', '.join(sorted(known))}"
        raise ValidationError(f"name must be a LeRobot robot type, not {shown(name)}; {hint}.")
    try:
        config = known[kind](**options)
    except (TypeError, ValueError) as exc:
        raise ValidationError(f"the options {sorted(options)} do not configure {kind}: {exc}.") from exc
    return robots.make_robot_from_config(config)


def _register_all(robots: Any) -> None:
    for module in pkgutil.iter_modules(robots.__path__, f"{robots.__name__}."):
        if not module.ispkg:
            continue
        try:
            importlib.import_module(module.name)
        except ImportError as exc:
            logger.debug("%s is not available: %s", module.name, exc)
