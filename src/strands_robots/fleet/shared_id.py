"""Id that robots on two networks have: one robot where its key proves it."""

from __future__ import annotations

import math
import secrets
import threading
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from types import MappingProxyType

from strands_robots.errors import AmbiguousRobotError, NoAnswerError, NoSuchRobotError, RefusalError, UnreachableError
from strands_robots.fleet.adapter import NetworkAdapter
from strands_robots.fleet.joining import side_by_side
from strands_robots.safety.statements import Purpose, own_key

AGAIN_S = 2.0
"""Seconds for which the keys count that were read last."""

Keys = Mapping[str, bytes] | None
"""Keys by robot; None where they cannot be used, so that nothing can be proven."""


class CachedKeys:
    """Enrolled keys of a network, read again when they are needed.

    Args:
        load: reads them.
    """

    def __init__(self, load: Callable[[], Keys]) -> None:
        self._load = load
        self._keys: Keys = None
        self._read_at = float("-inf")

    def read(self) -> Keys:
        """Return the keys, at most :data:`AGAIN_S` old."""
        now = time.monotonic()
        if now - self._read_at >= AGAIN_S:
            # The time last: another thread must not take the keys of before for these.
            self._keys = self._load()
            self._read_at = now
        return self._keys


ASK_S = 5.0
"""Seconds in which both robots have to sign."""

DECIDED_S = 10.0
"""Seconds for which a decision counts: another process may take the id unseen."""

SILENT = b""
"""Stands for the key of a robot that does not answer."""


class SharedId:
    """Decides which network has the robot that motions of one id go to.

    A robot that is served on both networks signs on both with the key of its machine. A decision counts for
    :data:`DECIDED_S` seconds, unless a session ends or robots are looked for again. A robot that falls silent on one
    network stays the robot of the key that it showed on all of them.

    Attributes:
        decided: the network of the last decision; None without one.
        key: the key that signed on all networks, so that they have one robot; None for several, or before that.
    """

    def __init__(self) -> None:
        self.decided: NetworkAdapter | None = None
        self.key: bytes | None = None
        self._lock = threading.Lock()
        self._asked: tuple[object, ...] = ()
        self._asked_at = -math.inf

    def decide(
        self, robot: str, bearers: Sequence[NetworkAdapter], absent: Mapping[str, bytes] = MappingProxyType({})
    ) -> NetworkAdapter | None:
        """Return the network that motions go to; None where no key decides.

        Args:
            robot: the id.
            bearers: networks that have it, the one to prefer first.
            absent: keys of this id that are enrolled on networks which are not joined, one of which has to sign then.

        Raises:
            NoSuchRobotError: it has left all of them.
        """
        with self._lock:
            asked = (tuple(absent.items()), *((each.name, each.session(robot)) for each in bearers))
            old = time.monotonic() - self._asked_at > DECIDED_S
            if old or asked != self._asked or self.decided not in bearers:
                signed = side_by_side(lambda each: _signing_key(robot, each), bearers)
                keys = {each: key for each, (there, key) in zip(bearers, signed, strict=True) if there}
                if not keys:
                    raise NoSuchRobotError(f"No robot {robot!r} is in reach any more", robot=robot)
                self.decided = self._of_one(keys, absent.values()) or _proven(robot, keys, set(absent.values()))
                # A robot that did not answer, or not signed, is asked again.
                self._asked, self._asked_at = (asked if self.decided is not None else ()), time.monotonic()
            return self.decided

    def _of_one(self, keys: Mapping[NetworkAdapter, bytes | None], absent: Collection[bytes]) -> NetworkAdapter | None:
        """Return the network of the robot that one key proves; None for several."""
        shown = {*keys.values()} - {SILENT}
        if len(shown) == 1 < len(keys) and SILENT not in keys.values():
            (self.key,) = shown
        elif shown - {self.key}:
            self.key = None
        known = None if absent and self.key not in absent else self.key
        return next((each for each, key in keys.items() if known is not None and key == known), None)


def decided(
    shared_id: SharedId,
    robot: str,
    verb: str,
    bearers: Sequence[NetworkAdapter],
    absent: Mapping[str, bytes] = MappingProxyType({}),
) -> NetworkAdapter:
    """Return the network that a motion goes to.

    Raises:
        NoSuchRobotError: it has left all of them.
        AmbiguousRobotError: no key decides.
    """
    network = shared_id.decide(robot, bearers, absent)
    if network is None:
        named = " and ".join(each.name for each in bearers)
        several = f"{named} both have a robot of this id, and no key decides"
        enrolled = " and ".join(absent)
        alone = f"it is enrolled on {enrolled}, which is not joined, and that on {named} has not shown the key"
        raise AmbiguousRobotError(
            f"{verb} is sent to neither: {several}" if len(bearers) > 1 else f"{verb} is not sent: {alone}",
            robot=robot,
            verb=verb,
        )
    return network


def _proven(
    robot: str, keys: Mapping[NetworkAdapter, bytes | None], absent: Collection[bytes]
) -> NetworkAdapter | None:
    """Return the network whose robot's key proves it.

    Args:
        robot: the id.
        keys: that signed the answer on each network that has the robot, the one to prefer first.
        absent: keys that are enrolled on networks which are not joined.
    """
    if len(keys) == 1 and not absent:
        return next(iter(keys))
    enrolled = [each for each, key in keys.items() if key and key in {each.enrolled_key(robot), *absent}]
    return enrolled[0] if enrolled and len({keys[each] for each in enrolled}) == 1 else None


def _signing_key(robot: str, network: NetworkAdapter) -> tuple[bool, bytes | None]:
    """Return whether the robot is there, and the key that signs a fresh answer.

    It is :data:`SILENT` where none comes.
    """
    nonce = secrets.token_hex(16)
    try:
        answer = network.call(robot, network.reads["status"], {"nonce": nonce}, ASK_S)
    except NoSuchRobotError:
        return False, None
    except (NoAnswerError, UnreachableError):
        return True, SILENT
    except RefusalError:
        return True, None
    statement = answer.get("statement")
    if not isinstance(statement, Mapping) or statement.get("nonce") != nonce:
        return True, None
    return True, own_key(Purpose.LOCKOUT_STATE, robot, statement)
