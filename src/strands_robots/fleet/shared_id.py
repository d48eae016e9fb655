"""Id that robots on two networks have: one robot where its key proves it."""

from __future__ import annotations

import secrets
import threading
from collections.abc import Mapping, Sequence

from strands_robots.errors import AmbiguousRobotError, RefusalError
from strands_robots.fleet.adapter import NetworkAdapter
from strands_robots.fleet.side_by_side import side_by_side
from strands_robots.safety.statements import Purpose, own_key

ASK_S = 5.0
"""Seconds in which both robots have to sign."""


class SharedId:
    """Decides which network has the robot that motions of one id go to.

    A robot that is served on both networks signs on both with the key of its machine. Answers are remembered until a
    session ends or robots are looked for again.

    Attributes:
        decided: the network of the last decision; None without one.
    """

    def __init__(self) -> None:
        self.decided: NetworkAdapter | None = None
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
                self.decided = _proven(robot, bearers, keys)
                # A robot that did not answer, or not signed, is asked again.
                self._asked = asked if self.decided is not None else ()
            return self.decided


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


def _proven(robot: str, bearers: Sequence[NetworkAdapter], keys: Sequence[bytes | None]) -> NetworkAdapter | None:
    if None not in keys and len(set(keys)) == 1:
        return bearers[0]
    enrolled = [
        each for each, key in zip(bearers, keys, strict=True) if key is not None and key == each.enrolled_key(robot)
    ]
    return enrolled[0] if len(enrolled) == 1 else None


def _signing_key(robot: str, network: NetworkAdapter) -> bytes | None:
    """Return the key that signs an answer to a fresh question; None for none."""
    nonce = secrets.token_hex(16)
    try:
        answer = network.call(robot, network.reads["status"], {"nonce": nonce}, ASK_S)
    except RefusalError:
        return None
    statement = answer.get("statement")
    if not isinstance(statement, Mapping) or statement.get("nonce") != nonce:
        return None
    return own_key(Purpose.LOCKOUT_STATE, robot, statement)
