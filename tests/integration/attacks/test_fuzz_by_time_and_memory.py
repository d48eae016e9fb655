"""Every decoder of foreign messages keeps its bounds on time and memory, beside a robot that moves."""

from __future__ import annotations

import re
import threading
from collections import defaultdict
from pathlib import Path

import pytest
from fixtures.decoders import MEMORY_MAX, TIME_MAX_S, cost_of, worst_of
from fixtures.recording_robot import RecordingRobot

from strands_robots.ros import dds, dds_types

PACKAGE = Path(__file__).parents[3] / "src" / "strands_robots"

PARSING = re.compile(
    r"\bjson\.loads?\(|JSONDecoder\(|raw_decode\(|\.json\(\)|\bparsed\(|\bjson_object\(|wire\.decode\("
)
RECEIVING = re.compile(
    r"\.declare_subscriber\(|\.declare_queryable\(|subscribe_with_subject\(|subscribe_to_stops\(|messaging\.subscribe\("
    r"|\.listen\(|receive_text\(|\bopen_socket\(|reader\.take\(|create_subscription\(|\.request(?:_once)?\(|\.stream\("
    r"|SubscribePacket\("
)

OWN_FILE = "a file or a program of this machine's user"
BOUNDED = "the text is bounded before it is parsed"

PARSERS = {
    "audit/head.py": OWN_FILE,
    "audit/journal.py": OWN_FILE,
    "bounded_json.py": BOUNDED,
    "cli/app.py": OWN_FILE,
    "cli/conform_child.py": OWN_FILE,
    "cli/conform_process.py": OWN_FILE,
    "cli/serve.py": OWN_FILE,
    "dashboard/page_session.py": BOUNDED,
    "dashboard/pose_process.py": OWN_FILE,
    "dashboard/pictures.py": OWN_FILE,
    "dashboard/server.py": "WebSocket messages of 64 KiB at most, and the audit of this machine",
    "datasets/encoded.py": BOUNDED,
    "datasets/encoder.py": OWN_FILE,
    "datasets/encoder_process.py": OWN_FILE,
    "datasets/episodes.py": BOUNDED,
    "datasets/fit.py": BOUNDED,
    "datasets/layout.py": BOUNDED,
    "device_connect/backends/config.py": OWN_FILE,
    "device_connect/backends/dial.py": BOUNDED,
    "device_connect/backends/jsonrpc.py": BOUNDED,
    "device_connect/client.py": BOUNDED,
    "device_connect/discovery.py": BOUNDED,
    "device_connect/presence.py": BOUNDED,
    "drivers/reachy/connection.py": BOUNDED,
    "drivers/reachy/links.py": BOUNDED,
    "drivers/reachy/motion.py": BOUNDED,
    "drivers/reachy/rest.py": BOUNDED,
    "fleet/mesh/stops.py": BOUNDED,
    "hardware/lerobot_device.py": OWN_FILE,
    "http_access.py": OWN_FILE,
    "kinematics/__init__.py": OWN_FILE,
    "mesh/commands.py": BOUNDED,
    "mesh/input_receiver.py": BOUNDED,
    "mesh/presence.py": BOUNDED,
    "mesh/rpc.py": BOUNDED,
    "mesh/safety.py": BOUNDED,
    "mesh/stop_link.py": BOUNDED,
    "mesh/transport/__init__.py": BOUNDED,
    "mesh/transport/bridge.py": BOUNDED,
    "mesh/transport/config.py": OWN_FILE,
    "mesh/wire.py": BOUNDED,
    "ros/rosbridge_session.py": BOUNDED,
    "safety/authorization.py": OWN_FILE,
    "safety/identity.py": OWN_FILE,
    "safety/orders.py": BOUNDED,
    "safety/persistence.py": OWN_FILE,
    "safety/resume.py": OWN_FILE,
    "testing/scripted_model.py": "what it has written itself",
    "tools/robot_mesh.py": BOUNDED,
}
"""Each module that parses JSON, and whose text it is. The decoders of foreign text are in fixtures/decoders.py."""

RECEIVERS = {
    "dashboard/page_session.py": "64 KiB by the WebSocket",
    "dashboard/server.py": "64 KiB by the WebSocket",
    "device_connect/backends/__init__.py": "a docstring",
    "device_connect/backends/base.py": "feeds and servers: 1 MiB, a stop 64 KiB",
    "device_connect/backends/nats.py": "1 MiB by the parser of frames, a reply 4 MiB",
    "device_connect/backends/zenoh.py": "1 MiB, looked at before it is copied, a reply 4 MiB",
    "device_connect/bringup.py": "by the back end; nothing is parsed",
    "device_connect/client.py": "by the back end",
    "device_connect/device_stops.py": "64 KiB by the back end",
    "device_connect/discovery.py": "by the back end",
    "device_connect/stop_link.py": "64 KiB, looked at before it is copied",
    "drivers/reachy/driver.py": "an event stream of this process",
    "drivers/reachy/links.py": "64 KiB, by the WebSocket and before it is copied",
    "drivers/reachy/motion.py": "64 KiB by the WebSocket",
    "drivers/reachy/rest.py": "512 KiB, of a stop 64 KiB, read in parts",
    "fleet/mesh/peers.py": "by the transport: the topic's own bound",
    "fleet/mesh/stops.py": "by the transport: the topic's own bound",
    "mesh/core.py": "by the transport: the topic's own bound",
    "mesh/input_receiver.py": "by the transport: the topic's own bound",
    "mesh/presence.py": "by the transport: the topic's own bound",
    "mesh/state.py": "none: it publishes on a topic of that name",
    "mesh/stop_link.py": "by the transport: the topic's own bound",
    "mesh/transport/__init__.py": "by the transport: the topic's own bound",
    "mesh/transport/bridge.py": "by its two transports",
    "mesh/transport/iot.py": "the topic's own bound, looked at before it is copied",
    "mesh/transport/zenoh.py": "the topic's own bound, by Zenoh and before it is copied",
    "ros/dds.py": "by ros/dds_types.py, before a sample is decoded",
    "ros/rclpy.py": "decoded by rclpy itself",
    "zenoh_session.py": "the sinks of its users",
}
"""Each module that receives foreign messages, and their bound."""


def modules(pattern: re.Pattern[str]) -> set[str]:
    """Return the modules of the package that match; policies, recordings and MCP have tests of their own."""
    found = set()
    for path in PACKAGE.rglob("*.py"):
        name = path.relative_to(PACKAGE).as_posix()
        if not name.startswith(("policies/", "mcp/", "recording/")) and pattern.search(path.read_text("utf-8")):
            found.add(name)
    return found


def test_every_module_that_parses_is_known_with_whose_text_it_parses() -> None:
    assert modules(PARSING) == set(PARSERS)


def test_every_module_that_receives_is_known_with_its_bound() -> None:
    assert modules(RECEIVING) == set(RECEIVERS)


def _fuzz(count: int) -> None:
    robot = RecordingRobot(hz=50.0)
    robot.start()
    results: list[tuple[list[str], int]] = []

    def run() -> None:
        _, over, done = worst_of(count)
        results.append((over, done))

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    try:
        assert robot.moving
    finally:
        robot.halt()
        robot.close()
    over, done = results[0]
    assert done >= count
    kinds = defaultdict(list)
    for each in over:
        kinds[each.partition(":")[0]].append(each)
    assert not over, "\n".join(f"{len(several)} times, such as {several[0]}" for several in kinds.values())


def test_no_decoder_takes_20_ms_or_10_mb_for_a_hostile_message() -> None:
    _fuzz(600)


@pytest.mark.system
@pytest.mark.timeout(600)
def test_no_decoder_takes_20_ms_or_10_mb_for_10000_hostile_messages() -> None:
    _fuzz(10_000)


def test_dds_samples_at_their_bound_are_decoded_in_20_ms_and_10_mb() -> None:
    kinds = dds_types.KINDS
    frame = kinds["geometry_msgs/TransformStamped"]()
    full = {
        "sensor_msgs/LaserScan": {"ranges": [0.5] * 65_000},
        "nav_msgs/OccupancyGrid": {"data": [1] * 262_000},
        "sensor_msgs/JointState": {"name": [""] * 2000},
        "tf2_msgs/TFMessage": {"transforms": [frame] * 200},
        "std_msgs/String": {"data": "x" * (2**20 - 100)},
        "sensor_msgs/Image": {"data": bytes(3 * 2**20 - 200)},
    }
    for kind, fields in full.items():
        message = kinds[kind](**fields)
        cost = cost_of(lambda data, kind=kind: dds.plain(kinds[kind].deserialize(data)), message.serialize())
        assert cost.kept, f"{kind}: {cost}, of {TIME_MAX_S} s and {MEMORY_MAX} bytes"
    for struct in kinds.values():
        with pytest.raises(ValueError, match="at most"):
            struct.deserialize(bytes(16 * 2**20))
