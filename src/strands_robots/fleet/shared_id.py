"""Id that robots on two networks have: one robot where its key proves it."""

from __future__ import annotations

import secrets
import threading
from collections.abc import Mapping, Sequence

from strands_robots.errors import AmbiguousRobotError, NoAnswerError, NoSuchRobotError, RefusalError, UnreachableError
from strands_robots.fleet.adapter import NetworkAdapter
from strands_robots.fleet.side_by_side import side_by_side
from strands_robots.safety.statements import Purpose, own_key

ASK_S = 5.0
"""Seconds in which both robots have to sign."""

SILENT = b""
"""Stands for the key of a robot that does not answer."""


class SharedId:
    """Decides which network has the robot that motions of one id go to.

    A robot that is served on both networks signs on both with the key of its machine. Answers are remembered until a
    session ends or robots are looked for again. One that falls silent on a network stays the robot of its key.

    Attributes:
        decided: the network of the last decision; None without one.
        key: the key that signed on all of its networks, so that they have one robot; None where they do not.
    """

    def __init__(self) -> None:
        self.decided: NetworkAdapter | None = None
        self.key: bytes | None = None
        self._lock = threading.Lock()
        self._asked: tuple[object, ...] = ()

    def decide(self, robot: str, bearers: Sequence[NetworkAdapter]) -> NetworkAdapter | None:
        """Return the network that motions go to; None where no key decides.

        Args:
            robot: the id.
            bearers: networks that have it, the one to prefer first.
        """
        with self._lock:
            asked = tuple((each.name, each.session(robot)) for each in bearers)
            if asked != self._asked or self.decided not in bearers:
                keys = side_by_side(lambda each: _signing_key(robot, each), bearers)
                self.decided = self._of_one(bearers, keys) or _enrolled(robot, bearers, keys)
                # A robot that did not answer, or not signed, is asked again.
                self._asked = asked if self.decided is not None else ()
            return self.decided

    def _of_one(self, bearers: Sequence[NetworkAdapter], keys: Sequence[bytes | None]) -> NetworkAdapter | None:
        """Return the network of a robot that one key proves; None for several robots."""
        shown = {*keys} - {SILENT}
        if len(shown) == 1 < len(bearers) and SILENT not in keys:
            self.key = keys[0]
        elif shown - {self.key}:
            self.key = None
        proven = self.key is not None and self.key in keys
        return bearers[keys.index(self.key)] if proven else None


def decided(shared_id: SharedId, robot: str, verb: str, bearers: Sequence[NetworkAdapter]) -> NetworkAdapter:
    """Return the network that a motion goes to.

    Raises:
        AmbiguousRobotError: no key decides.
    """
    network = shared_id.decide(robot, bearers)
    if network is None:
        named = " and ".join(each.name for each in bearers)
        raise AmbiguousRobotError(
            f"{verb} is sent to neither: {named} both have a robot of this id, and no key decides",
            robot=robot,
            verb=verb,
        )
    return network


def _enrolled(robot: str, bearers: Sequence[NetworkAdapter], keys: Sequence[bytes | None]) -> NetworkAdapter | None:
    enrolled = [each for each, key in zip(bearers, keys, strict=True) if key and key == each.enrolled_key(robot)]
    return enrolled[0] if len(enrolled) == 1 else None


def _signing_key(robot: str, network: NetworkAdapter) -> bytes | None:
    """Return the key that signs a fresh answer, None for none, or :data:`SILENT`."""
    nonce = secrets.token_hex(16)
    try:
        answer = network.call(robot, network.reads["status"], {"nonce": nonce}, ASK_S)
    except (NoAnswerError, NoSuchRobotError, UnreachableError):
        return SILENT
    except RefusalError:
        return None
    statement = answer.get("statement")
    if not isinstance(statement, Mapping) or statement.get("nonce") != nonce:
        return None
    return own_key(Purpose.LOCKOUT_STATE, robot, statement)
