"""Emulated servos of an SO-100 or SO-101, on a pseudo-terminal.

LeRobot's driver opens the port as that of a real arm. What a real servo does with a goal that it was given before its
torque came on is not modelled: here it keeps it.

Packets are those of Feetech's serial protocol for the STS and SMS series, which LeRobot calls protocol 0. A packet is
``FF FF id length instruction parameters... checksum``; an answer has an error byte in the place of the instruction.
``length`` counts instruction, parameters and checksum. The checksum is the complement of the low byte of the sum from
the id on. Numbers of two bytes are little-endian. Source: Feetech's STS manual and its public SDK.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import pty
import select
import subprocess
import sys
import tempfile
import threading
import time
import tty
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, Self

HEADER = b"\xff\xff"
BROADCAST = 0xFE

PING, READ, WRITE = 1, 2, 3
SYNC_READ, SYNC_WRITE = 0x82, 0x83

OVERLOAD = 0x20
"""Bit of the error byte that says a servo protects itself from overload."""

_LONGEST = 250


@dataclass(frozen=True, slots=True)
class Packet:
    """One instruction (or answer, whose ``instruction`` is its error byte)."""

    servo: int
    instruction: int
    parameters: bytes = b""

    def encoded(self) -> bytes:
        """The bytes on the line."""
        body = bytes((self.servo, len(self.parameters) + 2, self.instruction)) + self.parameters
        return HEADER + body + bytes((checksum(body),))


def checksum(body: bytes) -> int:
    """Of everything between header and checksum."""
    return ~sum(body) & 0xFF


class Parser:
    """Parser of a stream of bytes; what is no packet is skipped and counted."""

    def __init__(self) -> None:
        self.skipped = 0
        self._buffer = bytearray()

    def feed(self, data: bytes) -> Iterator[Packet]:
        """Add ``data``, and give every whole packet there is."""
        self._buffer += data
        while (packet := self._next()) is not None:
            yield packet

    def _next(self) -> Packet | None:
        while True:
            start = self._buffer.find(HEADER)
            if start < 0:
                # The last byte may be the first half of a header.
                self._drop(max(len(self._buffer) - 1, 0))
                return None
            self._drop(start)
            if len(self._buffer) < 4:
                return None
            length = self._buffer[3]
            if self._buffer[2] == 0xFF or not 2 <= length <= _LONGEST:
                self._drop(1)
                continue
            end = 4 + length
            if len(self._buffer) < end:
                return None
            body = bytes(self._buffer[2 : end - 1])
            if checksum(body) != self._buffer[end - 1]:
                self._drop(2)
                continue
            del self._buffer[:end]
            return Packet(body[0], body[2], body[3:])

    def _drop(self, count: int) -> None:
        self.skipped += count
        del self._buffer[:count]


REGISTERS: Mapping[str, tuple[int, int]] = MappingProxyType(
    {
        "firmware_major": (0, 1),
        "firmware_minor": (1, 1),
        "model": (3, 2),
        "id": (5, 1),
        "return_delay": (7, 1),
        "min_position": (9, 2),
        "max_position": (11, 2),
        "max_torque": (16, 2),
        "p_coefficient": (21, 1),
        "homing_offset": (31, 2),
        "operating_mode": (33, 1),
        "torque_enable": (40, 1),
        "acceleration": (41, 1),
        "goal_position": (42, 2),
        "goal_velocity": (46, 2),
        "torque_limit": (48, 2),
        "lock": (55, 1),
        "present_position": (56, 2),
        "present_velocity": (58, 2),
        "present_load": (60, 2),
        "present_voltage": (62, 1),
        "present_temperature": (63, 1),
        "status": (65, 1),
        "moving": (66, 1),
        "present_current": (69, 2),
    }
)
"""Address and size in bytes of the registers used here, of the STS control table."""

COUNTS = 4096
"""Encoder counts of one turn."""

MODEL = 777
SPEED = 3000.0
"""Counts a second at no load: about 44 turns a minute."""

STILL_SPEED = 20.0
"""Counts a second of a shaft that has all but settled: less than two degrees."""

STIFFNESS_NM = 0.0273
"""Torque for one count of distance to the target (Nm), 17.8 Nm a radian: assumed for LeRobot's gain of 16."""

STALL_NM = 1.9
STALL_A = 2.4
"""Greatest torque and current, of a shaft that cannot turn."""

CURRENT_UNIT_A = 0.0065
_SIGN_BIT = {
    "homing_offset": 11,
    "goal_position": 15,
    "goal_velocity": 15,
    "present_position": 15,
    "present_velocity": 15,
    "present_current": 15,
}
_READ_ONLY = range(56, 71)
_TABLE = 128
_LAG_S = 0.04


class Servo:
    """A servo at ``shaft`` encoder counts, before the homing offset is taken off.

    With torque on it runs to its goal at most at :data:`SPEED` and settles with a time constant of 40 ms; without,
    it stays where it is. An overloaded one says so in the error byte of every answer and has no force.

    Its current grows with the distance to its target up to :data:`STALL_A`: that of a blocked shaft as it is told to go
    on, and of one that its payload keeps from the target. Neither friction nor the speed counts.
    """

    def __init__(self, number: int, shaft: float = COUNTS / 2) -> None:
        self.number = number
        self.shaft = float(shaft)
        self.velocity = 0.0
        self.dead = False
        self.overloaded = False
        self.blocked_at: float | None = None
        """Shaft position of a fixed thing, which it reaches from its present side and does not pass."""
        self.payload_nm = 0.0
        """Torque to the low side that the shaft carries; it sags by this over :data:`STIFFNESS_NM`."""
        self.silent: frozenset[str] = frozenset()
        """Registers of which it answers no read that begins at them."""
        self._table = bytearray(_TABLE)
        first = {"firmware_major": 3, "firmware_minor": 10, "model": MODEL, "id": number, "max_position": COUNTS - 1}
        first |= {"max_torque": 1000, "torque_limit": 1000, "p_coefficient": 32, "return_delay": 250}
        first |= {"present_voltage": 74, "present_temperature": 30, "lock": 1, "goal_position": round(shaft)}
        for name, value in first.items():
            self.put(name, value)

    @property
    def error(self) -> int:
        """The error byte of an answer."""
        return OVERLOAD if self.overloaded else 0

    @property
    def torque(self) -> bool:
        """True while it holds its shaft."""
        return bool(self.get("torque_enable")) and not self.overloaded

    @property
    def target(self) -> float:
        """Target of the shaft: the goal inside its limits, with the homing offset added."""
        goal = min(max(self.get("goal_position"), self.get("min_position")), self.get("max_position"))
        return float(goal + self.get("homing_offset"))

    @property
    def current(self) -> float:
        """Current of its motor in ampere, negative towards the low side."""
        if not self.torque:
            return 0.0
        share = STIFFNESS_NM * (self.target - self.shaft) / STALL_NM
        return STALL_A * min(max(share, -1.0), 1.0)

    def answers(self, address: int) -> bool:
        """True where it answers a read that begins at ``address``."""
        return all(REGISTERS[name][0] != address for name in self.silent)

    def get(self, name: str) -> int:
        """The number in a register, signed where the servo's is."""
        address, size = REGISTERS[name]
        raw = int.from_bytes(self._table[address : address + size], "little")
        bit = _SIGN_BIT.get(name)
        if bit is None or not raw >> bit & 1:
            return raw
        return -(raw & ((1 << bit) - 1))

    def put(self, name: str, value: int) -> None:
        """Set a register, whatever it is."""
        address, size = REGISTERS[name]
        bit = _SIGN_BIT.get(name)
        raw = abs(value) | 1 << bit if bit is not None and value < 0 else value
        self._table[address : address + size] = raw.to_bytes(size, "little")

    def read(self, address: int, size: int) -> bytes:
        """Data of an answer to READ."""
        self._present()
        return bytes(self._table[address : address + size]).ljust(size, b"\0")

    def write(self, address: int, data: bytes) -> None:
        """Carry out WRITE; read-only registers stay."""
        for at, value in enumerate(data, start=address):
            if at < _TABLE and at not in _READ_ONLY:
                self._table[at] = value

    def advance(self, seconds: float) -> None:
        """Let ``seconds`` pass."""
        if not self.torque:
            self.velocity = 0.0
            return
        rest = self.target - self.payload_nm / STIFFNESS_NM
        left = rest - self.shaft
        before = self.shaft
        # Far away at full speed; near, where the lag asks for less than that, exponentially.
        near = SPEED * _LAG_S
        fast = min(max(abs(left) - near, 0.0) / SPEED, seconds)
        self.shaft += math.copysign(SPEED * fast, left)
        slow = seconds - fast
        self.shaft = rest - (rest - self.shaft) * math.exp(-slow / _LAG_S)
        block = self.blocked_at
        if block is not None and min(before, self.shaft) <= block <= max(before, self.shaft):
            self.shaft = before if abs(block - before) <= 1.0 else block - math.copysign(1.0, block - before)
        self.velocity = (self.shaft - before) / seconds if seconds > 0 else 0.0

    def _present(self) -> None:
        self.put("present_position", round(self.shaft) - self.get("homing_offset"))
        self.put("present_velocity", round(min(max(self.velocity, -32767), 32767)))
        self.put("moving", int(abs(self.velocity) > 1))
        self.put("present_current", round(self.current / CURRENT_UNIT_A))
        self.put("status", self.error)


MOTORS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
"""Names of the servos 1 to 6, as LeRobot gives them."""

OFFSETS = dict(zip(MOTORS, (100, -150, 200, -50, 0, 25), strict=True))
LOW, HIGH = 800, 3300


def arm_servos(*, calibrated: bool = True) -> list[Servo]:
    """Make six servos in mid-range; fresh from the factory unless ``calibrated``."""
    servos = []
    for number, motor in enumerate(MOTORS, start=1):
        offset = OFFSETS[motor] if calibrated else 0
        servo = Servo(number, shaft=COUNTS / 2 + offset)
        servo.put("goal_position", COUNTS // 2)
        if calibrated:
            servo.put("homing_offset", offset)
            for register, value in zip(("min_position", "max_position"), _range(motor), strict=True):
                servo.put(register, value)
        servos.append(servo)
    return servos


def arm_calibration() -> dict[str, dict[str, int]]:
    """Return the calibration as LeRobot writes it, in encoder counts by motor."""
    return {
        motor: {
            "id": number,
            "drive_mode": 0,
            "homing_offset": OFFSETS[motor],
            "range_min": _range(motor)[0],
            "range_max": _range(motor)[1],
        }
        for number, motor in enumerate(MOTORS, start=1)
    }


def write_calibration(path: Path, **changed: Any) -> Path:
    """Write the calibration to a file, as LeRobot does."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({**arm_calibration(), **changed}), encoding="utf-8")
    return path


def _range(motor: str) -> tuple[int, int]:
    return (0, COUNTS - 1) if motor == "wrist_roll" else (LOW, HIGH)


_POLL_S = 0.05
_CHUNK = 4096


class ServoBus:
    """Servos on one line, which answer from :meth:`plug` to :meth:`unplug`.

    They answer on a thread of their own.

    Args:
        servos: in the order of the line.
        link: path of a symbolic link to the port, which stays the same when it is plugged in again.
        on_write: called with servo, address and data of each write, before it is carried out.
    """

    def __init__(
        self,
        servos: Iterable[Servo],
        *,
        link: Path | None = None,
        on_write: Callable[[int, int, bytes], None] = lambda servo, address, data: None,
    ) -> None:
        self.servos = {servo.number: servo for servo in servos}
        self.silent = False
        """While True they take no packet and answer none."""
        self._link = link
        self._on_write = on_write
        self._moved_at = time.monotonic()
        self._lock = threading.Lock()
        self._master: int | None = None
        self._port = ""
        self._ending = threading.Event()
        self._thread: threading.Thread | None = None

    @property
    def port(self) -> str:
        """The path that a driver opens."""
        return str(self._link or self._port)

    @property
    def moving(self) -> bool:
        """True while a shaft turns by more than :data:`STILL_SPEED`."""
        with self._lock:
            self._advance()
            return any(abs(servo.velocity) > STILL_SPEED for servo in self.servos.values())

    def __enter__(self) -> Self:
        self.plug()
        return self

    def __exit__(self, *exc: object) -> None:
        self.unplug()

    def plug(self) -> None:
        """Let the port appear; servos keep what they had."""
        if self._master is not None:
            return
        self._master = self._open()
        self._ending.clear()
        self._thread = threading.Thread(target=self._serve, args=(self._master,), name="servo-bus", daemon=True)
        self._thread.start()

    def _open(self) -> int:
        master, slave = pty.openpty()
        tty.setraw(slave)
        self._port = os.ttyname(slave)
        os.close(slave)
        if self._link is not None:
            self._link.unlink(missing_ok=True)
            self._link.symlink_to(self._port)
        return master

    def unplug(self) -> None:
        """Let the port vanish like a pulled cable; its users get input and output errors."""
        master, self._master = self._master, None
        if master is None:
            return
        self._ending.set()
        if self._thread is not None:
            self._thread.join(5)
        os.close(master)
        if self._link is not None:
            self._link.unlink(missing_ok=True)

    def _serve(self, master: int) -> None:
        parser = Parser()
        while not self._ending.is_set():
            for packet in parser.feed(self._read(master)):
                if self.silent:
                    continue
                answers: list[Packet] = []
                self._obey(packet, answers.append)
                if answers:
                    self._answer(master, [answer.encoded() for answer in answers])

    def _read(self, master: int) -> bytes:
        """Return what has come within a moment; empty for nothing."""
        readable, _, _ = select.select([master], [], [], _POLL_S)
        try:
            return os.read(master, _CHUNK) if readable else b""
        except OSError:
            # No process has the port open.
            self._ending.wait(0.002)
            return b""

    def _obey(self, packet: Packet, answer: Callable[[Packet], None]) -> None:
        given = packet.parameters
        with self._lock:
            self._advance()
            if packet.instruction == SYNC_READ and len(given) >= 2:
                for number in given[2:]:
                    for servo in self._alive(number):
                        if servo.answers(given[0]):
                            answer(Packet(number, servo.error, servo.read(given[0], given[1])))
            elif packet.instruction == SYNC_WRITE and len(given) >= 2:
                step = given[1] + 1
                for start in range(2, len(given) - given[1], step):
                    for servo in self._alive(given[start]):
                        self._write(servo, given[0], given[start + 1 : start + step])
            else:
                for servo in self._alive(packet.servo):
                    reply = self._one(servo, packet)
                    if reply is not None and (packet.servo != BROADCAST or packet.instruction == PING):
                        answer(reply)

    def _one(self, servo: Servo, packet: Packet) -> Packet | None:
        given = packet.parameters
        if packet.instruction == PING:
            return Packet(servo.number, servo.error)
        if packet.instruction == READ and len(given) == 2 and servo.answers(given[0]):
            return Packet(servo.number, servo.error, servo.read(given[0], given[1]))
        if packet.instruction == WRITE and given:
            self._write(servo, given[0], given[1:])
            return Packet(servo.number, servo.error)
        return None

    def _alive(self, number: int) -> list[Servo]:
        asked = self.servos.values() if number == BROADCAST else [self.servos[number]] if number in self.servos else []
        return [servo for servo in asked if not servo.dead]

    def _write(self, servo: Servo, address: int, data: bytes) -> None:
        self._on_write(servo.number, address, data)
        servo.write(address, data)

    def _advance(self) -> None:
        """Let the time pass since the last call."""
        now = time.monotonic()
        seconds, self._moved_at = now - self._moved_at, now
        self._turn(seconds)

    def _turn(self, seconds: float) -> None:
        for servo in self.servos.values():
            servo.advance(seconds)

    def _answer(self, master: int, answers: list[bytes]) -> None:
        # A driver that closed its port takes no answer.
        with contextlib.suppress(OSError):
            os.write(master, b"".join(answers))


@contextmanager
def emulated_arm() -> Iterator[dict[str, Any]]:
    """Run the servos of one arm; yield a robot's options for it.

    Raises:
        ConnectionError: the process of the servos does not start.
    """
    with tempfile.TemporaryDirectory(prefix="emulated-arm-") as folder:
        link = Path(folder, "arm")
        command = [sys.executable, "-m", __name__, str(link)]
        # A Ctrl-C in the terminal stops the robot first: the servos end after it, when their input closes.
        process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True)
        try:
            if process.stdout is None or not process.stdout.readline():
                raise ConnectionError("The emulated arm did not start.")
            calibration = write_calibration(Path(folder, "calibration.json"))
            yield {"port": str(link), "calibration": str(calibration), "calibration_dir": folder}
        finally:
            process.communicate()


def main(link: Path) -> None:
    """Answer on the port ``link`` until the input closes."""
    with ServoBus(arm_servos(), link=link):
        print(link, flush=True)
        sys.stdin.read()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
