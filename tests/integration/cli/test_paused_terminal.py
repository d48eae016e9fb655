"""Stops of a robot whose terminal is paused: nobody reads what its process prints, and its lines wait for good."""

from __future__ import annotations

import os
import threading
from pathlib import Path

import pytest
from fixtures.command_line import Machine
from fixtures.waiting import eventually

pytestmark = pytest.mark.timeout(600)


def fill(pipe: int) -> int:
    """Write to a pipe until it takes no byte more; return their number."""
    # Opened anew, because the writer of the other end must go on blocking.
    end = os.open(f"/proc/self/fd/{pipe}", os.O_WRONLY | os.O_NONBLOCK)
    written = 0
    try:
        while True:
            written += os.write(end, b"." * 512)
    except BlockingIOError:
        return written
    finally:
        os.close(end)


@pytest.mark.parametrize("stop", ["estop", "stop"])
def test_every_stop_works_while_no_line_of_the_robot_can_be_printed(tmp_path: Path, stop: str) -> None:
    machine = Machine(tmp_path / "state", DEVICE_CONNECT_LOG_LEVEL="DEBUG")
    reader, writer = os.pipe()
    served = machine.start("serve", "so100", "--peer-id", "arm-1", stdout=writer, stderr=writer)
    said: list[bytes] = []
    paused = threading.Event()

    def read() -> None:
        while not paused.is_set():
            said.append(os.read(reader, 4096))

    reading = threading.Thread(target=read, daemon=True)
    reading.start()
    try:
        eventually(lambda: b"arm-1" in b"".join(said), 60.0, what="the banner")
        eventually(lambda: "arm-1" in str(machine.json("peers")), 60.0)
        paused.set()
        os.write(writer, b".")
        reading.join(20)
        assert fill(writer)
        for _ in range(3):
            assert machine.json("call", "arm-1", "execute", "instruction=wave", "duration=600")[0] == 0
            if stop == "estop":
                # Refused ones are logged as well.
                code, report = machine.json("estop", "arm-1", "--deadline", "30")
                assert (code, set(report["stopped"])) == (0, {"arm-1"}), report
                assert machine.json("resume", "--local")[0] == 0
            else:
                assert machine.json("stop", "arm-1")[0] == 0
    finally:
        served.kill()
        served.communicate()
        os.close(reader)
        os.close(writer)
