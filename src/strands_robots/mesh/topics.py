"""The table of topics: keys, rates, sizes, quality of service and retention.

The Zenoh configuration, the MQTT mapping, the bridge and the publishers read this table and nothing else. A key
is written without Zenoh's namespace, which the session adds.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

ROOT = "strands"
KIB = 1024


@dataclass(frozen=True, slots=True)
class Topic:
    """One row.

    Attributes:
        pattern: key expression, ``*`` one segment and ``**`` any number of them.
        rate_hz: the publisher's default rate; 0 is off or on event.
        ceiling_hz: rate that the transport admits from one link. None where a valid message must never be dropped:
            a Zenoh downsampler drops by spacing, so of two commands sent side by side one would be lost.
        max_bytes: largest encoded message.
        reliable: delivered in order without loss while a link holds, and sent before telemetry.
        qos: MQTT quality of service; None is not sent over MQTT.
        retain: the MQTT broker stores the last one for late joiners.
        bridged: the bridge carries it to the cloud leg.
    """

    name: str
    pattern: str
    rate_hz: float
    ceiling_hz: float | None
    max_bytes: int
    reliable: bool = False
    urgent: bool = False
    qos: int | None = 0
    retain: bool = False
    bridged: bool = False


TABLE: tuple[Topic, ...] = (
    Topic("estop", "strands/safety/estop", 0, None, 4 * KIB, True, True, 1, True, True),
    Topic("resume", "strands/safety/resume", 0, None, 4 * KIB, True, True, 1, True, True),
    Topic("checkin", "strands/*/checkin", 0, None, 4 * KIB, True, True, 1, False, True),
    Topic("checkin_answer", "strands/*/checkin/answer", 0, None, 4 * KIB, True, False, 1, False, True),
    Topic("missed_ask", "strands/*/missed/ask", 0, None, 8 * KIB, True, False, 1, False, True),
    Topic("missed_answer", "strands/*/missed/answer", 0, None, 64 * KIB, True, False, 1, False, True),
    Topic("missed_roster", "strands/*/missed/roster", 0, None, 16 * KIB, True, False, 1, False, True),
    Topic("broadcast", "strands/broadcast", 0, None, 16 * KIB, True, True, 1, False, True),
    Topic("cmd", "strands/*/cmd", 0, None, 16 * KIB, True, True, 1, False, True),
    Topic("response", "strands/*/response/**", 0, None, 1024 * KIB, True, True, 1, False, True),
    Topic("presence", "strands/*/presence", 2, None, 64 * KIB, True, False, 1, True, True),
    Topic("safety_event", "strands/*/safety/event", 0, None, 16 * KIB, True, False, 1, True, True),
    Topic("state", "strands/*/state", 10, 400, 256 * KIB),
    Topic("stream", "strands/*/stream", 0, 400, 256 * KIB),
    Topic("turn", "strands/*/turn", 0, None, 16 * KIB, True, False, 1),
    Topic("pose", "strands/*/pose", 10, 400, 64 * KIB),
    Topic("imu", "strands/*/imu", 10, 400, 64 * KIB),
    Topic("odom", "strands/*/odom", 10, 400, 64 * KIB),
    Topic("health", "strands/*/health", 0.5, 20, 64 * KIB, retain=True, bridged=True),
    Topic("lidar_summary", "strands/*/lidar/summary", 5, 200, 256 * KIB),
    Topic("lidar_state", "strands/*/lidar/state", 1, 40, 64 * KIB, retain=True),
    Topic("map_info", "strands/*/map/info", 0.2, 20, 64 * KIB, retain=True),
    Topic("camera", "strands/*/camera/*", 0, 200, 1024 * KIB, qos=None),
    Topic("hand", "strands/*/hand/*/state", 50, 400, 64 * KIB, qos=None),
    Topic("input", "strands/*/input/*", 50, None, 16 * KIB, True, True, qos=None),
)

BY_NAME = {topic.name: topic for topic in TABLE}

OTHER = Topic("other", "**", 0, None, 1024 * KIB)
"""A topic outside the table, such as one of the user's own."""


def presence(peer: str) -> str:
    return f"{ROOT}/{peer}/presence"


def state(peer: str) -> str:
    return f"{ROOT}/{peer}/state"


def command(peer: str) -> str:
    return f"{ROOT}/{peer}/cmd"


def broadcast() -> str:
    return f"{ROOT}/broadcast"


def check_in(controller: str) -> str:
    return f"{ROOT}/{controller}/checkin"


def check_in_answer(robot: str) -> str:
    return f"{ROOT}/{robot}/checkin/answer"


def missed_ask(peer: str) -> str:
    return f"{ROOT}/{peer}/missed/ask"


def missed_answer(peer: str) -> str:
    return f"{ROOT}/{peer}/missed/answer"


def missed_roster(controller: str) -> str:
    return f"{ROOT}/{controller}/missed/roster"


def response(requester: str, responder: str, turn: str) -> str:
    return f"{ROOT}/{requester}/response/{responder}/{turn}"


def responses(requester: str) -> str:
    return f"{ROOT}/{requester}/response/**"


def stream(peer: str) -> str:
    return f"{ROOT}/{peer}/stream"


def turn(peer: str) -> str:
    return f"{ROOT}/{peer}/turn"


def camera(peer: str, name: str) -> str:
    return f"{ROOT}/{peer}/camera/{name}"


def sensor(peer: str, name: str) -> str:
    """Key of a sensor, such as ``pose``, ``lidar/summary`` or ``hand/left/state``."""
    return f"{ROOT}/{peer}/{name}"


def input_stream(peer: str, device: str) -> str:
    return f"{ROOT}/{peer}/input/{device}"


def safety_event(peer: str) -> str:
    return f"{ROOT}/{peer}/safety/event"


def token(peer: str, session: str) -> str:
    """Liveliness token of a peer in a session; nothing is published there."""
    return f"{ROOT}/{peer}/alive/{session}"


def estop() -> str:
    return f"{ROOT}/safety/estop"


def resume() -> str:
    return f"{ROOT}/safety/resume"


def matches(pattern: str, key: str) -> bool:
    """True where a key expression of ``*`` and ``**`` segments covers a concrete key."""
    # Iterative with one point to come back to, so that a hostile pattern of many ** costs no exponential time.
    wanted, parts = pattern.split("/"), key.split("/")
    at = here = 0
    star, mark = -1, 0
    while here < len(parts):
        if at < len(wanted) and wanted[at] == "**":
            star, mark = at, here
            at += 1
        elif at < len(wanted) and wanted[at] in ("*", parts[here]):
            at, here = at + 1, here + 1
        elif star >= 0:
            mark += 1
            at, here = star + 1, mark
        else:
            return False
    return all(part == "**" for part in wanted[at:])


def topic_of(key: str) -> Topic:
    """Return the row that a key falls under, :data:`OTHER` where there is none."""
    # A reply's key is used once, so remembering it would only push the others out.
    parts = key.split("/", 3)
    if len(parts) > 2 and parts[0] == ROOT and parts[2] == "response":
        return BY_NAME["response"]
    return _topic_of(key)


@lru_cache(maxsize=4096)
def _topic_of(key: str) -> Topic:
    for topic in TABLE:
        if matches(topic.pattern, key):
            return topic
    return OTHER
