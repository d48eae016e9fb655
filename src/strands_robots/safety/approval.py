"""The operator's approval of verbs that move real hardware.

A verb is approved by ``STRANDS_ROBOT_COMMAND_ALLOW`` (a comma list of ``verb``, ``verb@peer`` or
``verb@peer:caller``), by ``BYPASS_TOOL_CONSENT``, or by a one-shot grant that an operator at the robot's own machine
issued with ``strands-robots grant VERB@PEER``. A grant may name the caller that it is for, and the digest of the
arguments: the yes to a question has both.

A grant is a small file. It is read first: a command that it is not for leaves it as it is. Claiming it is one rename,
so two callers cannot both have it; a command that then starts nothing gives it back, and a process that dies in between
leaves it claimed and useless.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import secrets
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from strands_robots import settings
from strands_robots.safety.authorization import NAME_MAX
from strands_robots.state_files import boot, make_private, read_private, require_private, state_dir, uptime
from strands_robots.stop_log import stop_logger
from strands_robots.utils import ValidationError, canonical_json, identifier, number, text

logger = stop_logger(__name__)

GRANT_S = 300.0
"""Seconds for which a grant is good when the operator states nothing else."""

GRANT_MAX_S = 24 * 3600.0

_CLAIMED = ".claimed"


def listed(verb: str, peer: str, allow: Sequence[str], callers: Collection[str] = ()) -> bool:
    """True when ``allow`` has the verb: for all, for this peer, or for a caller."""
    return any(each in allow for each in (verb, f"{verb}@{peer}", *(f"{verb}@{peer}:{name}" for name in callers)))


def digest(arguments: Mapping[str, Any]) -> str:
    """Return the SHA-256 of a motion's arguments, in hex.

    What is None was not given, and 1 is 1.0.

    Raises:
        ValidationError: JSON cannot carry them.
    """
    try:
        given = {name: _plain(value) for name, value in arguments.items() if value is not None}
        return hashlib.sha256(canonical_json(given)).hexdigest()
    except (TypeError, ValueError, RecursionError) as exc:
        raise ValidationError(f"arguments must be values that JSON can carry: {exc}.") from None


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {name: _plain(each) for name, each in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(each) for each in value]
    return int(value) if isinstance(value, float) and value.is_integer() else value


class Leave:
    """Leave of one motion to begin, until it is known whether it has.

    Args:
        ends: what was taken for it; each is told whether the motion has begun.
    """

    def __init__(self, *ends: Callable[[bool], object]) -> None:
        self._ends = ends

    def settle(self, begun: bool = True) -> None:
        """Spend what was taken for a motion that has begun; else give it back."""
        for end in self._ends:
            end(begun)


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

    def grant(
        self, verb: str, peer: str, seconds: float = GRANT_S, *, caller: str = "", arguments_digest: str = ""
    ) -> Path:
        """Let ``verb`` be done once on ``peer`` within ``seconds``.

        Args:
            caller: the only one that it is for; empty for all.
            arguments_digest: the :func:`digest` of the only arguments that it is for; empty for all.

        Raises:
            ValidationError: ``verb`` or ``peer`` is no identifier, ``caller`` is no name, or ``seconds`` is not above 0
                and at most a day.
            StateFileError: the folder is not this user's alone.
        """
        name = f"{identifier('verb', verb)}@{identifier('peer', peer)}"
        lasts = number("seconds", seconds, above=0, high=GRANT_MAX_S)
        bound = {"caller": text("caller", caller, longest=NAME_MAX, empty=True), "digest": arguments_digest}
        make_private(self.folder)
        require_private(self.folder, self._root)
        path = self.folder / f"{name}+{secrets.token_hex(8)}"
        writing = path.with_name(f".{path.name}")
        with os.fdopen(os.open(writing, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as file:
            json.dump({"verb": verb, "peer": peer, "boot": boot(), "until": self._clock() + lasts, **bound}, file)
        writing.rename(path)
        return path

    def claim(self, verb: str, peer: str, callers: Collection[str] = (), arguments_digest: str = "") -> Leave | None:
        """Take one grant that is for this command, or None."""
        for path in self.fitting(verb, peer, callers, arguments_digest):
            taken = path.with_name(path.name + _CLAIMED)
            with contextlib.suppress(FileNotFoundError):  # another command was first
                path.rename(taken)
                return Leave(partial(_settled, taken))
        return None

    def fitting(self, verb: str, peer: str, callers: Collection[str] = (), arguments_digest: str = "") -> list[Path]:
        """Return the grants that are for this command, the narrowest first."""
        found: list[tuple[int, str, Path]] = []
        for path in self.folder.glob(f"{verb}@{peer}+*") if self.folder.is_dir() else []:
            if path.name.endswith(_CLAIMED):
                continue
            grant = self._read(path, verb, peer)
            if grant is None:
                continue
            caller, bound = grant.get("caller", ""), grant.get("digest", "")
            if caller in ("", *callers) and bound in ("", arguments_digest):
                found.append((2 * (bound == "") + (caller == ""), path.name, path))
        return [path for *_, path in sorted(found)]

    def _read(self, path: Path, verb: str, peer: str) -> dict[str, Any] | None:
        """Return a grant that is still good; remove any other."""
        try:
            grant = json.loads(read_private(path, self._root))
            until = number("until", grant["until"])
            named = (grant.get("verb"), grant.get("peer"), grant.get("boot")) == (verb, peer, boot())
        except FileNotFoundError:  # claimed meanwhile
            return None
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as exc:
            logger.warning("The grant %s is void: %s", path.name, exc)
        else:
            now = self._clock()
            if named and now < until <= now + GRANT_MAX_S:
                return dict(grant)
        path.unlink(missing_ok=True)
        return None


def _settled(claimed: Path, begun: bool) -> None:
    """Remove the grant of a motion that has begun; let any other be claimed again."""
    if begun:
        claimed.unlink(missing_ok=True)
        return
    with contextlib.suppress(FileNotFoundError):  # the folder was tidied meanwhile
        claimed.rename(claimed.with_name(claimed.name.removesuffix(_CLAIMED)))


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

    def standing(self, verb: str, peer: str, callers: Collection[str]) -> bool:
        """Return whether ``verb`` is approved until further notice, so that nothing has to be claimed."""
        allow = self._read("STRANDS_ROBOT_COMMAND_ALLOW")
        return (bool(allow) and listed(verb, peer, allow, callers)) or self._bypass()

    def claim(self, verb: str, peer: str, callers: Collection[str] = (), arguments_digest: str = "") -> Leave | None:
        """Return leave to do ``verb`` on ``peer`` now, or None when not approved.

        Args:
            callers: the names that an approval may know the caller by.
            arguments_digest: of the command's arguments, see :func:`digest`.
        """
        if self.standing(verb, peer, callers):
            return Leave()
        return self._grants().claim(verb, peer, callers, arguments_digest)

    def given(self, verb: str, peer: str, callers: Collection[str] = (), arguments_digest: str = "") -> bool:
        """Return whether :meth:`claim` would give leave now; nothing is taken."""
        if self.standing(verb, peer, callers):
            return True
        return bool(self._grants().fitting(verb, peer, callers, arguments_digest))

    @staticmethod
    def refusal(verb: str, peer: str) -> str:
        """Return the refusal of a verb, with every way to approve it."""
        return (
            f"{verb} moves real hardware and needs operator approval: the operator runs "
            f"'strands-robots grant {verb}@{peer}' for one time, or adds {verb} or {verb}@{peer} to "
            f"STRANDS_ROBOT_COMMAND_ALLOW."
        )
