"""Robots on ROS graphs, beside bare Cyclone DDS and a bare ``websockets`` client in the same run."""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from fixtures.ros1_graph import Ros1Graph, missing
from fixtures.waiting import eventually
from websockets.sync.client import connect

from benchmarks.ros_children import TWIST_TOPIC, Bare
from benchmarks.table import Row
from strands_robots.drivers.ros.rosbridge_robot import ROS1_TWIST, RosbridgeRobot
from strands_robots.drivers.ros.rtps_robot import RtpsRobot

DOMAIN = 84
POLL_S = 0.02
PAUSE_S = 0.002
WARM = 10
"""Trips that meet a connection, a thread or an import for the first time, and are not counted."""

ENVIRONMENT = {
    "ROS_LOCALHOST_ONLY": "1",
    "STRANDS_ROS2_BRIDGE_I_KNOW_THIS_IS_INSECURE": "1",
    "STRANDS_ROS2_COMMAND_ALLOW": "cmd_vel",
}


class _Child:
    """A program of :mod:`benchmarks.ros_children`."""

    def __init__(self, *words: str) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-m", "benchmarks.ros_children", *words],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self.ready = self._read()

    def ask(self, line: str = "") -> Any:
        assert self._process.stdin is not None
        self._process.stdin.write(f"{line}\n")
        self._process.stdin.flush()
        return self._read()

    def close(self) -> None:
        self._process.communicate(timeout=10)

    def _read(self) -> Any:
        assert self._process.stdout is not None
        return json.loads(self._process.stdout.readline())


def run(quick: bool = False) -> list[Row]:
    """Measure and give the rows of the table."""
    repeats, seconds = (60, 2.0) if quick else (500, 10.0)
    with _surroundings(), ExitStack() as stack:
        echo = _Child("echo", str(DOMAIN))
        stack.callback(echo.close)
        bare = Bare(DOMAIN)
        trips = _round_trips(bare, repeats)
        return [
            _joint_command(stack, bare, trips, repeats),
            _first_message(echo, trips, repeats // 2),
            _images(seconds),
            *_rosbridge(repeats),
        ]


@contextmanager
def _surroundings() -> Iterator[None]:
    before = {name: os.environ.get(name) for name in (*ENVIRONMENT, "CYCLONEDDS_URI")}
    os.environ.update(ENVIRONMENT)
    os.environ.pop("CYCLONEDDS_URI", None)
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name, None)
            if value is not None:
                os.environ[name] = value


def _round_trips(bare: Bare, repeats: int) -> list[float]:
    """Seconds from a bare write to the bare echo of it."""
    from strands_robots.ros.dds_types import KINDS  # noqa: PLC0415 - in the surroundings of the benchmark

    joint_state_type = KINDS["sensor_msgs/JointState"]

    writer, reader = bare.writer("rt/bench/ask", joint_state_type), bare.reader("rt/bench/answer", joint_state_type)
    answers = bare.samples(reader, threading.Event())
    eventually(lambda: writer.get_matched_subscriptions() and reader.get_matched_publications(), 10, "the echo")
    time.sleep(0.2)
    found = []
    for number in range(repeats):
        began = time.monotonic()
        writer.write(joint_state_type(name=["joint.pos"], position=[float(number)]))
        next(answers)
        found.append(time.monotonic() - began)
        time.sleep(0.002)
    return found


def _joint_command(stack: ExitStack, bare: Bare, trips: list[float], repeats: int) -> Row:
    from strands_robots.ros.dds_types import KINDS  # noqa: PLC0415 - in the surroundings of the benchmark

    joint_state_type = KINDS["sensor_msgs/JointState"]

    child = _Child("bridge", str(DOMAIN))
    stack.callback(child.close)
    writer = bare.writer("rt/bench/joint_command", joint_state_type)
    eventually(writer.get_matched_subscriptions, 10, "the bridge")
    time.sleep(0.2)
    written = {}
    for number in range(repeats):
        written[float(number)] = time.monotonic()
        writer.write(joint_state_type(name=["joint.pos"], position=[float(number)]))
        # Not a multiple of the poll period, so that every phase of it is met.
        time.sleep(0.0313)
    delays = [at - written[number] for number, at in child.ask()]
    p50, half = statistics.median(delays), statistics.median(trips) / 2
    bound = 1.3 * half + POLL_S
    return Row(
        f"`joint_command` written to `send_action` called, p50 of {len(delays)}",
        f"{p50 * 1000:.2f} ms",
        f"{half * 1000:.2f} ms (half a bare round trip) + {POLL_S * 1000:.0f} ms (poll)",
        p50 / (half + POLL_S),
        "≤ 1.3 halves + one poll period",
        p50 <= bound and len(delays) > 0.95 * repeats,
    )


def _first_message(echo: _Child, trips: list[float], repeats: int) -> Row:
    """From the call of ``drive`` to its first message in the other process."""
    robot = RtpsRobot("bench", TWIST_TOPIC.removeprefix("rt"), domain_id=DOMAIN, publish_rate=100)
    called = {}
    try:
        robot.advertise()
        time.sleep(0.5)
        for number in range(1, repeats + 1):
            called[number / 1000] = time.monotonic()
            answer = robot.drive(number / 1000, 0.0, duration=0.02)
            if answer["status"] != "success":
                raise RuntimeError(str(answer))
    finally:
        robot.disconnect()
    first: dict[float, float] = {}
    for speed, at in echo.ask():
        first.setdefault(speed, at)
    delays = [first[speed] - began for speed, began in called.items() if speed in first]
    p50, half = statistics.median(delays), statistics.median(trips) / 2
    return Row(
        f"`drive` called to its first message at the other process, p50 of {len(delays)}",
        f"{p50 * 1000:.2f} ms",
        f"{half * 1000:.2f} ms (half a bare round trip)",
        p50 / half,
        "≤ 2 ms",
        p50 <= 0.002 and len(delays) > 0.95 * repeats,
    )


def _images(seconds: float) -> Row:
    """The share of a core that pictures at 30 Hz take, with a reader in this process; ours and bare in turns."""
    from strands_robots.ros.dds_types import KINDS  # noqa: PLC0415 - in the surroundings of the benchmark

    image_type = KINDS["sensor_msgs/Image"]

    reader = Bare(DOMAIN + 1)
    taken, ended = [0], threading.Event()

    def take() -> None:
        for _ in reader.samples(reader.reader("rt/bench/front/image_raw", image_type), ended):
            taken[0] += 1

    thread = threading.Thread(target=take)
    thread.start()
    ours, bare = (_Child("images", str(DOMAIN + 1), whose) for whose in ("ours", "bare"))
    try:
        shares: dict[str, list[float]] = {"ours": [], "bare": []}
        sent = 0
        for _ in range(2):
            for name, child in (("ours", ours), ("bare", bare)):
                share, count = child.ask(str(seconds / 2))
                shares[name].append(share)
                sent += count
    finally:
        ended.set()
        thread.join()
        ours.close()
        bare.close()
    share, against = statistics.mean(shares["ours"]), statistics.mean(shares["bare"])
    return Row(
        f"320x240 pictures published at 30 Hz ({taken[0]} of {sent} read)",
        f"{share:.1%} of a core",
        f"{against:.1%} (bare writer)",
        share / against,
        "< 20 % of a core",
        share < 0.2,
    )


def _rosbridge(repeats: int) -> list[Row]:
    """A velocity until the remote side publishes it again; ours and a bare client in turns, on one server."""
    child = _Child("rosbridge")
    try:
        p50, against = _trips(child.ready, repeats)
    finally:
        child.close()
    what = "a drive over rosbridge until {} reports it, p50"
    # A stand-in with nothing behind it shows what the checks of a drive cost; a robot is never that near.
    rows = [_trip_row(what.format("a stand-in without ROS"), p50, against, None)]
    if not missing():
        with TemporaryDirectory() as folder, Ros1Graph(Path(folder)) as graph:
            rows.append(_trip_row(what.format("a ROS 1 graph"), *_trips(graph.port, repeats), 1.2))
    return rows


def _trips(port: int, repeats: int) -> tuple[float, float]:
    """Median seconds of ours and of the bare client. Each alone in its turn: a server tells one after the other."""
    ours, bare = list[float](), list[float]()
    for _ in range(5):
        bare += _bare_trips(port, repeats // 5)
        ours += _our_trips(port, repeats // 5)
    return statistics.median(ours), statistics.median(bare)


def _trip_row(what: str, p50: float, against: float, bound: float | None) -> Row:
    ratio = p50 / against
    return Row(
        what,
        f"{p50 * 1000:.2f} ms",
        f"{against * 1000:.2f} ms (bare websockets client)",
        ratio,
        "" if bound is None else f"≤ {bound:g}",
        bound is None or ratio <= bound,
    )


def _bare_trips(port: int, repeats: int) -> list[float]:
    twist = {"linear": {"x": 0.1, "y": 0.0, "z": 0.0}, "angular": {"x": 0.0, "y": 0.0, "z": 0.0}}
    found = []
    with connect(f"ws://127.0.0.1:{port}", compression=None, ping_interval=None, proxy=None) as ws:
        for op in ("subscribe", "advertise"):
            ws.send(json.dumps({"op": op, "id": f"{op}:1", "topic": "/cmd_vel", "type": ROS1_TWIST}))
        _settle()
        for number in range(repeats + WARM):
            began = time.monotonic()
            ws.send(json.dumps({"op": "publish", "id": f"publish:{number}", "topic": "/cmd_vel", "msg": twist}))
            json.loads(ws.recv(5.0))
            found.append(time.monotonic() - began)
            time.sleep(PAUSE_S)
    return found[WARM:]


def _our_trips(port: int, repeats: int) -> list[float]:
    arrived, came, found = threading.Event(), [0.0], []

    def heard(message: Mapping[str, Any]) -> None:
        came[0] = time.monotonic()
        arrived.set()

    robot = RosbridgeRobot("bench", "/cmd_vel", "/odom", host="127.0.0.1", port=port, odom_type="nav_msgs/Odometry")
    try:
        robot.link.watch("/cmd_vel", ROS1_TWIST, heard)
        robot.drive(0.1)
        _settle()
        for _ in range(repeats + WARM):
            arrived.clear()
            began = time.monotonic()
            robot.drive(0.1)
            if not arrived.wait(5.0):
                raise RuntimeError("the drive was not told back")
            found.append(came[0] - began)
            time.sleep(PAUSE_S)
        robot.drive(0.0)
    finally:
        robot.disconnect()
    return found[WARM:]


def _settle() -> None:
    """Time for a graph to join a new publisher to who subscribes already."""
    time.sleep(0.5)
