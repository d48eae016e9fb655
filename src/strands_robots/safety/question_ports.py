"""Askers and answerers of missed stops: robots of a process, controllers."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from strands_robots.audit import queue_safety_event
from strands_robots.errors import StrandsRobotsError
from strands_robots.safety import ed25519
from strands_robots.safety.identity import (
    DEFAULT_TENANT,
    EnrolledKeys,
    SigningIdentity,
    key_here,
    local_name,
)
from strands_robots.safety.network_key import NetworkKey
from strands_robots.safety.orders import MISSED, RobotReport, StopOrder, StopRefused, StopRules
from strands_robots.safety.persistence import ORIGINAL_MAX_BYTES, STOPS_MAX, Original, Originals
from strands_robots.safety.plane import SafetyPlane
from strands_robots.safety.stop_link import ESTOP, JSON_RPC, StopCodec, StopEvent
from strands_robots.state_files import uptime
from strands_robots.stop_log import stop_logger

logger = stop_logger(__name__)

KEYS_AGAIN_S = 10.0
"""Seconds after which the keys of this machine and the enrolled ones are read again."""

KEYS_MAX = 512


@dataclass(frozen=True, slots=True)
class Member:
    """A robot of this process on one network.

    Attributes:
        robot_id: its id in this process.
        name: its name on the network.
        identity: returns what signs for it.
        was_here: it was served from this machine in the ten minutes before its start.
    """

    robot_id: str
    name: str
    identity: Callable[[], SigningIdentity | None]
    was_here: bool = False


@dataclass(frozen=True, slots=True)
class Stated:
    """A missed stop as an answer has it: its bytes, its age in s and who answered."""

    payload: bytes
    age_s: float
    answerer: str


class KnownKeys:
    """Keys of this machine's robots, of enrolled ones, and of those who may stop."""

    def __init__(self, tenant: str = DEFAULT_TENANT, stop_keys: Sequence[bytes] = ()) -> None:
        self._tenant, self._stop_keys = tenant, frozenset(stop_keys)
        self._known: dict[str, bytes | None] = {}
        self._enrolled: Mapping[str, bytes] = {}
        self._read = float("-inf")

    def knows(self, name: str, key: bytes) -> bool:
        """Return True where ``key`` is that of ``name``, or may stop robots."""
        if key in self._stop_keys:
            return True
        if time.monotonic() - self._read > KEYS_AGAIN_S:
            self._read, self._known, self._enrolled = time.monotonic(), {}, _enrolled()
        own = local_name(self._tenant, name)
        if self._enrolled.get(own) == key:
            return True
        if own not in self._known and len(self._known) < KEYS_MAX:
            self._known[own] = key_here(own)
        return self._known.get(own) == key


def _enrolled() -> Mapping[str, bytes]:
    try:
        return EnrolledKeys().load()
    except (StrandsRobotsError, OSError):
        return {}


class RobotsPort:
    """The robots of a process on one network.

    Args:
        network: no missed stop crosses it; None where nothing is asked and answered.
        members: returns those that are served there now.
        publish: sends fields as an event of a name on that network.
        on_report: answers a stop, as for one that came directly.
        codec: reads the stops of that network.
    """

    def __init__(
        self,
        of: SafetyPlane,
        rules: StopRules,
        network: NetworkKey | None,
        *,
        members: Callable[[], Sequence[Member]],
        publish: Callable[[str, str, Mapping[str, Any]], bool],
        on_report: Callable[[RobotReport], None],
        codec: StopCodec = JSON_RPC,
    ) -> None:
        self._plane, self._rules, self._network = of, rules, "" if network is None else network.text
        self._codec = codec
        self._members, self._publish, self._on_report = members, publish, on_report
        self._keys = KnownKeys(DEFAULT_TENANT if network is None else network.tenant, rules.keys)

    def was_here(self) -> bool:
        robots = self._plane.robots
        back = [robots.get(each.robot_id) for each in self._members() if each.was_here]
        # A state directory that was reset since is that of a newcomer.
        returned = [each.robot_id for each in back if each is not None and each.returned()]
        return bool(returned)

    def locked(self) -> bool:
        return all(each.locked for each in self._plane.robots.values())

    def devices(self) -> Sequence[str]:
        return [each.name for each in self._members()]

    def publish(self, event: str, source: str, fields: Mapping[str, Any]) -> bool:
        return self._publish(event, source, fields)

    def signer(self) -> tuple[str, SigningIdentity | None]:
        members = self._members()
        # A robot that is locked answers for its process.
        locked = self._plane.lockouts()
        for each in sorted(members, key=lambda each: each.robot_id not in locked)[:1]:
            return each.name, each.identity()
        return "", None

    def originals(self) -> Sequence[Original]:
        return self._plane.originals(self._network) if self._network else ()

    def learn(self, source: str, payload: bytes, age_s: float, answerer: str) -> bool:
        if not self._rules.signed and not self._rules.open:
            # Who says that an allowed source stopped is not that source.
            return False
        if self._rules.source_refusal(source) is not None:
            return False
        codec = self._codec
        fields = codec.fields(payload)
        epoch = codec.epoch(source, fields)
        if not epoch:
            return False
        stop = StopEvent(ESTOP, source, payload, time.monotonic(), self._network, codec)
        return self.lock(
            epoch,
            lambda: codec.order(self._rules, stop, fields, MISSED, age_s),
            Stated(payload, age_s, answerer),
        )

    def lock(self, epoch: str, decide: Callable[[], StopOrder | StopRefused | None], stated: Stated) -> bool:
        """Lock by a missed stop unless all know it; False when it does not count."""
        if all(each.latch.knows(epoch) for each in self._plane.robots.values()):
            self._plane.stated_again(self._network, epoch, stated.payload, stated.age_s)
            return True
        order = decide()
        if not isinstance(order, StopOrder):
            return False
        run = self._plane.begin(order, self._on_report)
        for robot_id in run.robot_ids if run is not None else ():
            logger.warning("%s is locked by emergency stop %s, which it had missed.", robot_id, epoch)
            sender, answerer = order.source[:256], stated.answerer[:256]
            facts = {"epoch": epoch, "source": sender, "answerer": answerer, "age_s": round(stated.age_s, 3)}
            queue_safety_event("missed_stop_learnt", robot_id, facts)
        return True

    def knows_key(self, source: str, key: bytes) -> bool:
        return self._keys.knows(source, key)

    def hold(self, seconds: float) -> None:
        self._plane.hold(seconds)


class ControllerPort:
    """A safety controller, which answers with the stops that it sent.

    A stop is told until each robot that must answer it has; one without such robots for as long as there is the
    controller.

    Args:
        key: the private key that signs its stops, if any.
        enrolled: returns the public keys of robots by name.
    """

    def __init__(
        self,
        name: str,
        key: Any,
        enrolled: Callable[[], Mapping[str, bytes]],
        publish: Callable[[str, str, Mapping[str, Any]], bool],
    ) -> None:
        self._name, self._enrolled, self._publish = name, enrolled, publish
        self._identity = None if key is None else SigningIdentity(name, ed25519.public_half(key), key)
        self._originals = Originals()
        self._open: dict[str, None] = {}

    def sent(self, estop_id: str, payload: bytes) -> None:
        """Note a stop that leaves; return at once."""
        if len(payload) <= ORIGINAL_MAX_BYTES:
            self._open[estop_id] = None
            self._originals.add(Original(estop_id, self._name, payload, "", uptime()))
            while len(self._open) > STOPS_MAX:
                self._open.pop(next(iter(self._open)), None)

    def answered(self, estop_id: str) -> None:
        """Note that every robot that must answer this stop has."""
        self._open.pop(estop_id, None)

    def was_here(self) -> bool:
        return False

    def locked(self) -> bool:
        return False

    def devices(self) -> Sequence[str]:
        return ()

    def publish(self, event: str, source: str, fields: Mapping[str, Any]) -> bool:
        return self._publish(event, source, fields)

    def signer(self) -> tuple[str, SigningIdentity | None]:
        return self._name, self._identity

    def originals(self) -> Sequence[Original]:
        epochs = frozenset(tuple(self._open))
        self._originals.keep(epochs)
        return self._originals.of(epochs)

    def learn(self, source: str, payload: bytes, age_s: float, answerer: str) -> bool:
        return False

    def knows_key(self, source: str, key: bytes) -> bool:
        own = self._identity is not None and self._identity.public == key
        return own or self._enrolled().get(source) == key

    def hold(self, seconds: float) -> None:
        """It moves nothing."""
