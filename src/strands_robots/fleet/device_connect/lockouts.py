"""Lockouts of robots on Device Connect, asked for and cleared."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from strands_robots.envelope import Envelope, text_of
from strands_robots.fleet.adapter import LockoutReport, Resumed, before_resume
from strands_robots.fleet.shared_id import Keys
from strands_robots.safety.identity import KeyFileError
from strands_robots.safety.lockout import OVERFLOW, Lockout
from strands_robots.safety.orders import new_epoch
from strands_robots.safety.resume import sign
from strands_robots.safety.statements import Purpose, distrust
from strands_robots.utils import plain_text

if TYPE_CHECKING:
    from strands_robots.device_connect import FleetClient
    from strands_robots.device_connect.backends import LinkConfig

logger = logging.getLogger(__name__)

KEYS_UNUSABLE = "the enrolled keys cannot be used"


def ask_robots(
    fleet: FleetClient, names: Iterable[str], seconds: float, *, signed: bool = False
) -> list[LockoutReport]:
    """Ask each robot for its status, many at once and without a thread for each.

    An enrolled robot whose answer is not its own has a ``problem``.

    Args:
        signed: ask every robot to sign its answer, even one that announces no nonce.
    """
    keys = enrolled_keys(fleet.link)
    asked = {name: status_question(fleet, name, signed=signed or name in keys) for name in names}
    reports = []
    for name, (answer, took_s) in fleet.call_each(asked, "getStatus", seconds).items():
        if isinstance(answer, Exception):
            reports.append(LockoutReport(name, problem=plain_text(str(answer), 2000)))
        else:
            reports.append(status_report(name, answer, took_s * 1000, keys.get(name), asked[name]))
    return reports


async def ask_robot(fleet: FleetClient, name: str, seconds: float, keys: Keys) -> LockoutReport:
    """Ask one robot for its status, on the event loop of the caller.

    Args:
        keys: enrolled ones; without any no answer counts.
    """
    from device_connect_edge.messaging import MessagingError  # noqa: PLC0415 - loaded when it is used

    key = None if keys is None else keys.get(name)
    asked, began = status_question(fleet, name, signed=key is not None), time.monotonic()
    try:
        answer = await fleet.call_async(name, "getStatus", asked, seconds)
    except (LookupError, TimeoutError, RuntimeError, ValueError, MessagingError) as exc:
        return LockoutReport(name, problem=plain_text(str(exc), 2000))
    took_ms = (time.monotonic() - began) * 1000
    if keys is None:
        return LockoutReport(name, problem=KEYS_UNUSABLE, facts=answer, round_trip_ms=took_ms)
    return status_report(name, answer, took_ms, key, asked)


def status_question(fleet: FleetClient, name: str, *, signed: bool) -> dict[str, str]:
    """Return the arguments of ``getStatus``: a fresh nonce, by which the robot signs.

    Args:
        signed: ask for the signature in any case; without it only a robot that announces the nonce is asked for it.
    """
    return {"nonce": new_epoch()} if signed or fleet.announces(name, "getStatus", "nonce") else {}


def status_report(
    name: str, answer: Mapping[str, Any], took_ms: float, key: bytes | None, asked: Mapping[str, str]
) -> LockoutReport:
    """Return the lockouts in an answer to getStatus.

    Args:
        key: the enrolled one, or None.
        asked: the arguments of the question, its nonce where the robot is enrolled.
    """
    if "locked" not in answer:
        return LockoutReport(name, problem="it does not report lockouts", facts=answer, round_trip_ms=took_ms)
    rows = answer.get("lockout")
    lockouts = tuple(Lockout.of(each) for each in rows if isinstance(each, Mapping)) if isinstance(rows, list) else ()
    stated = {"locked": answer["locked"], "epochs": [each.epoch for each in lockouts], **asked}
    problem = distrust(Purpose.LOCKOUT_STATE, name, answer.get("statement"), key, stated)
    return LockoutReport(name, () if problem else lockouts, problem, answer, took_ms)


def resume_robots(
    fleet: FleetClient, found: Sequence[LockoutReport], signer: Any, seconds: float
) -> dict[str, Resumed]:
    """Sign and send a resume of every lockout; return each robot's outcome."""
    keys = enrolled_keys(fleet.link)
    by_epoch: dict[str, list[str]] = {}
    for robot in found:
        for lockout in robot.lockouts:
            if lockout.epoch != OVERFLOW:
                by_epoch.setdefault(lockout.epoch, []).append(robot.name)
    assertions: dict[str, list[dict[str, Any]]] = {}
    for epoch, names in by_epoch.items():
        for assertion in sign(signer, epoch, names):
            for name in assertion["targets"]:
                assertions.setdefault(name, []).append(assertion)
    outcomes = {robot.name: before_resume(robot) for robot in found}
    # All robots at once, and the lockouts of each one after the other, until it refuses.
    left = {each.name: assertions.get(each.name, []) for each in found if each.lockouts and not each.problem}
    while sent := {name: waiting[0] for name, waiting in left.items() if waiting}:
        calls = {name: {"assertion": assertion} for name, assertion in sent.items()}
        for name, (answer, _) in fleet.call_each(calls, "resume", seconds).items():
            goes_on, outcomes[name] = _resumed(name, answer, sent[name], keys.get(name))
            left[name] = left[name][1:] if goes_on else []
    return outcomes


def _resumed(
    name: str, answer: Envelope | Exception, assertion: Mapping[str, Any], key: bytes | None
) -> tuple[bool, Resumed]:
    """Return True where its next lockout may be resumed, and the outcome."""
    if isinstance(answer, Exception):
        return False, (False, plain_text(str(answer.args[0] if answer.args else answer), 2000))
    stated = {"status": answer.get("status"), "nonce": assertion["nonce"]}
    stated |= {"locked": answer["locked"]} if "locked" in answer else {}
    problem = distrust(Purpose.RESUME_ANSWER, name, answer.get("statement"), key, stated)
    if problem:
        return False, (False, problem)
    if answer.get("status") != "success":
        return False, (False, f"{text_of(answer)}: its own audit says why")
    return True, (answer.get("locked") is False, text_of(answer))


def enrolled_keys(link: LinkConfig) -> dict[str, bytes]:
    """Return the enrolled keys of the robots on this network.

    Raises:
        KeyFileError: the keys cannot be used.
    """
    from strands_robots.device_connect.backends.config import enrolled_robots  # noqa: PLC0415 - the network is loaded when it is used

    try:
        return enrolled_robots(link)
    except (KeyFileError, OSError) as exc:
        raise KeyFileError(f"The enrolled keys cannot be used: {exc}") from exc


def usable_keys(link: LinkConfig) -> Keys:
    """Return the enrolled keys; None, and a log record, where they cannot be used."""
    try:
        return enrolled_keys(link)
    except KeyFileError as exc:
        logger.critical("No answer counts as a robot's own: %s", exc)
        return None
