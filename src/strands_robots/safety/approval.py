"""The operator's approval of verbs that move real hardware.

A verb is approved by ``STRANDS_ROBOT_COMMAND_ALLOW`` (a comma list of ``verb`` or ``verb@peer``), by
``BYPASS_TOOL_CONSENT``, or by a one-shot grant that an operator at the robot's own machine issued with
``strands-robots grant VERB@PEER``.

A grant is a small file. Claiming it is one rename, so two callers cannot both have it; a command that is then
refused for another reason gives it back, and a process that dies in between leaves it claimed and useless.
"""

from __future__ import annotations

import contextlib
import json
import os
import secrets
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from strands_robots import settings
from strands_robots.safety.state_files import boot, make_private, read_private, require_private, uptime
from strands_robots.safety.stop_log import stop_logger
from strands_robots.utils import identifier, number

logger = stop_logger(__name__)

GRANT_S = 300.0
"""Seconds for which a grant is good when the operator states nothing else."""

GRANT_MAX_S = 24 * 3600.0

_CLAIMED = ".claimed"


def state_dir() -> Path:
    """Return the directory of grants and lockouts, ``STRANDS_STATE_DIR`` first."""
    stated = settings.raw("STRANDS_STATE_DIR")
    return Path(stated).expanduser() if stated else Path.home() / ".strands_robots"


def listed(verb: str, peer: str, allow: Sequence[str]) -> bool:
    """True when ``allow`` holds the verb, for all peers or for this one."""
    return verb in allow or f"{verb}@{peer}" in allow


@dataclass(frozen=True, slots=True)
class Claim:
    """Leave to do one verb once; end it by :meth:`spend` or :meth:`give_back`."""

    file: Path | None = None

    def spend(self) -> None:
        """The verb was done: a grant is gone for good."""
        if self.file is not None:
            self.file.unlink(missing_ok=True)

    def give_back(self) -> None:
        """The verb was not done: a grant may be claimed again until it expires."""
        if self.file is not None:
            with contextlib.suppress(FileNotFoundError):  # the folder was tidied meanwhile
                self.file.rename(self.file.with_name(self.file.name.removesuffix(_CLAIMED)))


class Grants:
    """The one-shot grants in one folder, shared by every process of this machine.

    Args:
        folder: made on the first grant, readable by its owner alone.
        clock: seconds since boot, which cannot be set; a grant outlives the process that issued it, and no restart
            of the machine.
    """

    def __init__(self, folder: Path, clock: Callable[[], float] = uptime) -> None:
        self.folder = folder
        self._root = folder.parent
        self._clock = clock

    def grant(self, verb: str, peer: str, seconds: float = GRANT_S) -> Path:
        """Let ``verb`` be done once on ``peer`` within ``seconds``.

        Raises:
            ValidationError: ``verb`` or ``peer`` is no identifier, or ``seconds`` is not above 0 and at most a day.
            StateFileError: the folder is not this user's alone.
        """
        name = f"{identifier('verb', verb)}@{identifier('peer', peer)}"
        lasts = number("seconds", seconds, above=0, high=GRANT_MAX_S)
        make_private(self.folder)
        require_private(self.folder, self._root)
        path = self.folder / f"{name}+{secrets.token_hex(8)}"
        writing = path.with_name(f".{path.name}")
        with os.fdopen(os.open(writing, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as file:
            json.dump({"verb": verb, "peer": peer, "boot": boot(), "until": self._clock() + lasts}, file)
        writing.rename(path)
        return path

    def claim(self, verb: str, peer: str) -> Claim | None:
        """Take one grant that is still good, or None."""
        for path in sorted(self.folder.glob(f"{verb}@{peer}+*")) if self.folder.is_dir() else []:
            if path.name.endswith(_CLAIMED):
                continue
            taken = path.with_name(path.name + _CLAIMED)
            try:
                path.rename(taken)
            except FileNotFoundError:
                continue
            if self._good(taken, verb, peer):
                return Claim(taken)
            taken.unlink(missing_ok=True)
        return None

    def _good(self, path: Path, verb: str, peer: str) -> bool:
        try:
            grant = json.loads(read_private(path, self._root))
            until = number("until", grant["until"])
        except (OSError, ValueError, KeyError, TypeError) as exc:
            logger.warning("The grant %s is void: %s", path.name.removesuffix(_CLAIMED), exc)
            return False
        named = (grant.get("verb"), grant.get("peer"), grant.get("boot")) == (verb, peer, boot())
        now = self._clock()
        return named and now < until <= now + GRANT_MAX_S


class Approval:
    """The operator's approval of the verbs of one robot.

    Args:
        read_list: gives the list of a setting by its name.
        bypass: True while every verb is approved.
        grants: where the one-shot grants are; those of :func:`state_dir` by default.
    """

    def __init__(
        self,
        read_list: Callable[[str], Sequence[str]] = settings.items,
        bypass: Callable[[], bool] = lambda: settings.boolean("BYPASS_TOOL_CONSENT"),
        grants: Callable[[], Grants] = lambda: Grants(state_dir() / "grants"),
    ) -> None:
        self._read = read_list
        self._bypass = bypass
        self._grants = grants

    def claim(self, verb: str, peer: str) -> Claim | None:
        """Return leave to do ``verb`` on ``peer`` now, or None when not approved."""
        if listed(verb, peer, self._read("STRANDS_ROBOT_COMMAND_ALLOW")) or self._bypass():
            return Claim()
        return self._grants().claim(verb, peer)

    @staticmethod
    def refusal(verb: str, peer: str) -> str:
        """Return the refusal of a verb, with every way to approve it."""
        return (
            f"{verb} moves real hardware and needs operator approval: the operator runs "
            f"'strands-robots grant {verb}@{peer}' for one time, or adds {verb} or {verb}@{peer} to "
            f"STRANDS_ROBOT_COMMAND_ALLOW."
        )
