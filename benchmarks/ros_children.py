"""Programs of their own for :mod:`benchmarks.ros`: ``python -m benchmarks.ros_children NAME ARGUMENT...``.

Each prints one line when it is ready, answers each line of its input, and ends with it. Times are those of
``time.monotonic``, which processes of one machine share.
"""

from __future__ import annotations

import json
import sys
import threading
import time
from collections.abc import Iterator, Mapping
from typing import Any

from strands_robots.ros.dds import confine

TWIST_TOPIC = "rt/bench/cmd_vel"
SHAPE = (240, 320, 3)


def answer_line(value: Any) -> None:
    print(json.dumps(value), flush=True)


class Bare:
    """A participant on loopback with nothing of ours but the types."""

    def __init__(self, domain_id: int) -> None:
        from cyclonedds import domain  # noqa: PLC0415 - likewise
        from cyclonedds.core import Policy, Qos  # noqa: PLC0415 - only these roles need it

        confine(domain, domain_id)
        self.participant = domain.DomainParticipant(domain_id)
        reliable = Policy.Reliability.Reliable(max_blocking_time=100_000_000)
        self.qos = Qos(reliable, Policy.History.KeepLast(10))

    def writer(self, topic: str, kind: type[Any]) -> Any:
        from cyclonedds.pub import DataWriter  # noqa: PLC0415 - likewise
        from cyclonedds.topic import Topic  # noqa: PLC0415 - likewise

        return DataWriter(self.participant, Topic(self.participant, topic, kind), qos=self.qos)

    def reader(self, topic: str, kind: type[Any]) -> Any:
        from cyclonedds.sub import DataReader  # noqa: PLC0415 - likewise
        from cyclonedds.topic import Topic  # noqa: PLC0415 - likewise

        return DataReader(self.participant, Topic(self.participant, topic, kind), qos=self.qos)

    def samples(self, reader: Any, ended: threading.Event) -> Iterator[Any]:
        """Each sample as it comes, by a WaitSet."""
        from cyclonedds.core import InstanceState, ReadCondition, SampleState, ViewState, WaitSet  # noqa: PLC0415

        waitset = WaitSet(self.participant)
        waitset.attach(ReadCondition(reader, SampleState.Any | ViewState.Any | InstanceState.Any))
        while not ended.is_set():
            if waitset.wait(100_000_000):
                for sample in reader.take(N=10):
                    if sample.sample_info.valid_data:
                        yield sample


def echo(domain: str) -> None:
    """Answers each joint command on another topic, and tells when each velocity came."""
    from strands_robots.ros.dds_types import KINDS  # noqa: PLC0415 - likewise

    joint_state_type, twist_type = KINDS["sensor_msgs/JointState"], KINDS["geometry_msgs/Twist"]

    bare, ended = Bare(int(domain)), threading.Event()
    answers = bare.writer("rt/bench/answer", joint_state_type)
    asked, velocities = bare.reader("rt/bench/ask", joint_state_type), bare.reader(TWIST_TOPIC, twist_type)
    arrivals: list[tuple[float, float]] = []

    def answer() -> None:
        for sample in bare.samples(asked, ended):
            answers.write(sample)

    def note() -> None:
        for sample in bare.samples(velocities, ended):
            arrivals.append((sample.linear.x, time.monotonic()))  # noqa: PERF401 - others look at it meanwhile

    threads = [threading.Thread(target=answer), threading.Thread(target=note)]
    for thread in threads:
        thread.start()
    answer_line("ready")
    for _ in sys.stdin:
        answer_line(arrivals)
    ended.set()
    for thread in threads:
        thread.join()


class _Timed:
    """Tells when it was commanded what."""

    tool_name_str = "bench"

    def __init__(self) -> None:
        self.commands: list[tuple[float, float]] = []

    def send_action(self, action: Mapping[str, float]) -> None:
        self.commands.append((action["joint.pos"], time.monotonic()))


def bridge(domain: str) -> None:
    """Our bridge before a robot that tells when it was commanded."""
    from strands_robots.hardware_rtps_bridge import HardwareRtpsBridge  # noqa: PLC0415 - likewise

    robot = _Timed()
    made = HardwareRtpsBridge(robot, domain_id=int(domain))
    answer_line("ready")
    for _ in sys.stdin:
        answer_line(robot.commands)
    made.shutdown()


def images(domain: str, ours: str) -> None:
    """Publishes pictures at 30 Hz for as many seconds as each line says, and tells the share of a core that took."""
    import numpy as np  # noqa: PLC0415 - likewise

    from strands_robots.hardware_rtps_bridge import HardwareRtpsBridge  # noqa: PLC0415 - likewise
    from strands_robots.ros.dds_types import KINDS  # noqa: PLC0415 - likewise

    image_type = KINDS["sensor_msgs/Image"]

    picture = np.zeros(SHAPE, np.uint8)
    made = HardwareRtpsBridge(domain_id=int(domain)) if ours == "ours" else None
    bare = Bare(int(domain)) if made is None else None
    writer = bare.writer("rt/bench/front/image_raw", image_type) if bare is not None else None

    def publish() -> None:
        if made is not None:
            made.publish_image("bench", "front", picture)
        elif writer is not None:
            height, width, depth = SHAPE
            writer.write(
                image_type(height=height, width=width, encoding="rgb8", step=width * depth, data=picture.tobytes())
            )

    publish()
    answer_line("ready")
    for line in sys.stdin:
        began, spent, sent = time.monotonic(), time.process_time(), 0
        while time.monotonic() - began < float(line):
            publish()
            sent += 1
            time.sleep(max(0.0, began + sent / 30 - time.monotonic()))
        answer_line([(time.process_time() - spent) / (time.monotonic() - began), sent])
    if made is not None:
        made.shutdown()


def rosbridge() -> None:
    """A rosbridge server with nothing behind it, that tells each velocity to who listens; tells its port."""
    from fixtures.rosbridge_server import RosbridgeServer  # noqa: PLC0415 - likewise

    server = RosbridgeServer()
    server.on_publish = server.tell
    server.start()
    answer_line(server.port)
    for _ in sys.stdin:
        answer_line("on")
    server.stop()


if __name__ == "__main__":
    {"echo": echo, "bridge": bridge, "images": images, "rosbridge": rosbridge}[sys.argv[1]](*sys.argv[2:])
