"""Authorization: callers that may move or stop a robot, and approved verbs.

A caller's name is what the caller says it is: no transport of Device Connect vouches for it unless a broker's
access rules do, so a name here is a label to sort by and to log, not a proof. Stops and reads never come
here: they are answered to every caller.

The lists are comma lists of case-sensitive globs (:func:`fnmatch.fnmatchcase`), and a blank list is no list.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import re
import secrets
import threading
from collections.abc import Callable, Collection, Mapping, Sequence
from fnmatch import fnmatchcase, translate
from functools import partial
from pathlib import Path
from typing import Any

from strands_robots import settings
from strands_robots.state_files import (
    boot,
    make_private,
    read_private,
    require_private,
    state_dir,
    uptime,
    write_private,
)
from strands_robots.stop_log import stop_logger
from strands_robots.utils import ValidationError, canonical_json, identifier, number, shown, text

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
    if any(fnmatchcase(name, pattern) for pattern in listed if pattern != ANONYMOUS):
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
        """Return and log why ``source`` may not do ``verb`` by a policy, or None."""
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


GRANT_S = 300.0
"""Seconds for which a grant is good when the operator states nothing else."""

GRANT_MAX_S = 24 * 3600.0

_CLAIMED = ".claimed"


def listed(verb: str, peer: str, allow: Sequence[str], callers: Collection[str] = ()) -> bool:
    """True when ``allow`` has the verb: for all, for this peer, or for a caller."""
    here = f"{verb}@{peer}"
    globs = [each.removeprefix(f"{here}:") for each in allow if each.startswith(f"{here}:")]
    named = any(name in globs or (name != ANONYMOUS and matches(name, globs)) for name in callers)
    return verb in allow or here in allow or named


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

    A grant is a small file. It is read first: a command that it is not for leaves it as it is. Claiming it is one
    rename, so two callers cannot both have it; a command that then starts nothing gives it back, and a process that
    dies in between leaves it claimed and useless.

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
        grant = {"verb": verb, "peer": peer, "boot": boot(), "until": self._clock() + lasts, **bound}
        write_private(path, json.dumps(grant).encode())
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
    """The operator's approval of the verbs of one robot that moves real hardware.

    A verb is approved by ``STRANDS_ROBOT_COMMAND_ALLOW`` (a comma list of ``verb``, ``verb@peer`` or
    ``verb@peer:caller``, the caller a glob), by ``BYPASS_TOOL_CONSENT``, or by a one-shot grant that an operator at the
    robot's own machine issued with ``strands-robots grant VERB@PEER``. A grant may name the caller that it is for, and
    the digest of the arguments: the yes to a question has both.

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
        """Return whether ``verb`` is approved without a grant."""
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
