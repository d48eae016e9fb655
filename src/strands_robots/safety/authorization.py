"""Authorization: callers that may move or stop a robot, and their policies.

A caller's name is what the caller says it is: no transport of Device Connect vouches for it unless a broker's
access rules do, so a name here is a label to sort by and to log, not a proof. Stops and reads never come
here: they are answered to every caller.

The lists are comma lists of case-sensitive globs (:func:`fnmatch.fnmatchcase`), and a blank list is no list.
"""

from __future__ import annotations

import re
import threading
from collections.abc import Callable, Sequence
from fnmatch import fnmatchcase, translate

from strands_robots import settings
from strands_robots.stop_log import stop_logger
from strands_robots.utils import shown

logger = stop_logger(__name__)

ANONYMOUS = "anonymous"
"""The entry that admits callers without a name, which the framework's plain agent tools are."""

NAME_MAX = 255
"""Longest name of a caller, the framework's own bound on a device id."""


def caller_name(source: object) -> str | None:
    """Return the declared name, or None for a value that is no printable name."""
    if not isinstance(source, str) or not source.strip() or len(source) > NAME_MAX or not source.isprintable():
        return None
    return source


def entries(patterns: Sequence[str]) -> tuple[str, ...]:
    """Return the list without its blanks; empty means that it is not set."""
    return tuple(pattern.strip() for pattern in patterns if pattern.strip())


def matches(name: str, patterns: Sequence[str]) -> bool:
    """True when one of the globs fits ``name``, letter case included."""
    return any(fnmatchcase(name, pattern) for pattern in patterns)


def matcher(patterns: Sequence[str]) -> Callable[[str], object]:
    """Return :func:`matches` compiled, for a flood of names."""
    return re.compile("|".join(map(translate, patterns)) or "(?!)").match


def motion_refusal(source: object, allow: Sequence[str], *, hardware: bool) -> str | None:
    """Return the reason why ``source`` may not move a robot, or None.

    Without a list every caller may move a simulation and none real hardware. ``*`` and the other globs admit
    named callers; only the entry ``anonymous`` admits the unnamed.
    """
    listed, name = entries(allow), caller_name(source)
    if not listed:
        if not hardware:
            return None
        return (
            "No caller may move this robot: DEVICE_CONNECT_RPC_ALLOW is not set. Set it to the callers that may, such "
            f"as this one, {name or ANONYMOUS} (names or globs, '*' for every named caller, 'anonymous' for callers "
            "without a name)."
        )
    if name is None:
        if ANONYMOUS in listed:
            return None
        return (
            "A caller without a name may not move this robot: add 'anonymous' to DEVICE_CONNECT_RPC_ALLOW to admit "
            "those, or have the caller name itself."
        )
    if matches(name, [pattern for pattern in listed if pattern != ANONYMOUS]):
        return None
    return f"Caller {shown(name)} may not move this robot: no entry of DEVICE_CONNECT_RPC_ALLOW fits it."


def estop_refusal(source: object, allow: Sequence[str]) -> str | None:
    """Return the reason why a stop of ``source`` does not count, or None."""
    name, listed = caller_name(source), entries(allow)
    if name is None:
        return "an emergency stop without a source is not honoured"
    if not listed or matches(name, listed):
        return None
    return f"source {shown(name)} fits no entry of DEVICE_CONNECT_ESTOP_ALLOW"


def provider_refusal(provider: str, allow: Sequence[str]) -> str | None:
    """Return the reason why a policy provider is refused, or None."""
    listed = entries(allow)
    if not listed or matches(provider, listed):
        return None
    return (
        f"policy_provider must be one of {', '.join(listed)} (STRANDS_MESH_POLICY_TYPE_ALLOW), not {shown(provider)}."
    )


class Authorization:
    """The same questions for one robot, with the lists read when they are asked.

    Args:
        hardware: True for a robot that can hurt a person.
        read_list: gives the list of a setting by its name; the environment's by default.
    """

    def __init__(
        self, *, hardware: bool, read_list: Callable[[str], Sequence[str]] = settings.items, robot: str = "robot"
    ) -> None:
        self.hardware = hardware
        self._read = read_list
        self._robot = robot
        self._warned = threading.Event()

    def motion(self, source: object, verb: str, provider: str = "") -> str | None:
        """Return and log the reason why ``source`` may not do ``verb`` by a policy, or None."""
        allow, providers = self._read("DEVICE_CONNECT_RPC_ALLOW"), self._read("STRANDS_MESH_POLICY_TYPE_ALLOW")
        refusal = motion_refusal(source, allow, hardware=self.hardware)
        if refusal is not None:
            logger.warning("%s: %s refused to caller %s (self-declared).", self._robot, verb, shown(source))
        elif not entries(allow) and not self._warned.is_set():
            self._warned.set()
            logger.warning(
                "%s moves for any caller on its network: it is a simulation and DEVICE_CONNECT_RPC_ALLOW is not set.",
                self._robot,
            )
        if refusal is None and provider and providers:
            return provider_refusal(provider, providers)
        return refusal

    def opened(self) -> str | None:
        """Return the entries by which callers that nobody named move real hardware."""
        allow = entries(self._read("DEVICE_CONNECT_RPC_ALLOW")) if self.hardware else ()
        wide = [each for each in allow if each == ANONYMOUS or not each.strip("*?")]
        return f"DEVICE_CONNECT_RPC_ALLOW holds {', '.join(wide)}" if wide else None

    def estop(self, source: object) -> str | None:
        """Return the reason why an emergency stop of ``source`` does not count, or None."""
        return estop_refusal(source, self._read("DEVICE_CONNECT_ESTOP_ALLOW"))
