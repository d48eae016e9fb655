"""The emulated servo bus, spoken to in raw bytes over its port."""

from __future__ import annotations

import os
import select
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from fixtures.feetech_bus import REGISTERS, FeetechBus, Packet, Parser, arm_servos
from fixtures.feetech_bus.twin import ArmTwin
from fixtures.waiting import eventually

from strands_robots.hardware.emulated import (
    BROADCAST,
    CURRENT_UNIT_A,
    OVERLOAD,
    PING,
    READ,
    STALL_A,
    STALL_NM,
    STIFFNESS_NM,
    SYNC_READ,
    SYNC_WRITE,
    WRITE,
)


class Line:
    """A raw end of the port: sends packets, collects answers."""

    def __init__(self, port: str) -> None:
        self._fd = os.open(port, os.O_RDWR | os.O_NOCTTY)
        self._parser = Parser()

    def close(self) -> None:
        os.close(self._fd)

    def send(self, data: bytes) -> None:
        os.write(self._fd, data)

    def ask(self, packet: Packet, count: int = 1, within: float = 20.0) -> list[Packet]:
        """Send and wait for ``count`` answers; fewer when the time is over."""
        self.send(packet.encoded())
        answers: list[Packet] = []
        deadline = time.monotonic() + within
        while len(answers) < count and (left := deadline - time.monotonic()) > 0:
            if select.select([self._fd], [], [], left)[0]:
                answers += self._parser.feed(os.read(self._fd, 4096))
        return answers

    def read(self, servo: int, register: str) -> int:
        address, size = REGISTERS[register]
        (answer,) = self.ask(Packet(servo, READ, bytes((address, size))))
        return int.from_bytes(answer.parameters, "little")

    def write(self, servo: int, register: str, value: int) -> Packet:
        address, size = REGISTERS[register]
        (answer,) = self.ask(Packet(servo, WRITE, bytes((address,)) + value.to_bytes(size, "little")))
        return answer


@pytest.fixture
def bus() -> Iterator[FeetechBus]:
    with FeetechBus(arm_servos()) as bus:
        yield bus


@pytest.fixture
def line(bus: FeetechBus) -> Iterator[Line]:
    line = Line(bus.port)
    yield line
    line.close()


def test_a_packet_has_the_bytes_of_the_manual() -> None:
    assert Packet(1, PING).encoded() == bytes.fromhex("ff ff 01 02 01 fb")
    assert Packet(1, READ, bytes((56, 2))).encoded() == bytes.fromhex("ff ff 01 04 02 38 02 be")


def test_the_parser_finds_packets_in_pieces_and_in_noise() -> None:
    stream = b"\x00\xff" + Packet(1, PING).encoded() + b"noise" + Packet(2, PING).encoded()
    parser = Parser()
    found = [packet for at in range(len(stream)) for packet in parser.feed(stream[at : at + 1])]
    assert [packet.servo for packet in found] == [1, 2]
    assert parser.skipped == 7


def test_a_packet_with_a_wrong_checksum_is_not_answered(line: Line) -> None:
    line.send(bytes.fromhex("ff ff 01 02 01 00"))
    assert [each.servo for each in line.ask(Packet(2, PING))] == [2]


def test_every_servo_answers_a_ping_and_a_broadcast_gets_all(line: Line) -> None:
    assert line.ask(Packet(4, PING)) == [Packet(4, 0)]
    assert [each.servo for each in line.ask(Packet(BROADCAST, PING), count=6)] == [1, 2, 3, 4, 5, 6]
    assert line.read(1, "model") == 777


def test_what_is_written_is_read_again_and_read_only_registers_stay(line: Line) -> None:
    assert line.write(2, "p_coefficient", 16) == Packet(2, 0)
    assert line.read(2, "p_coefficient") == 16
    before = line.read(2, "present_position")
    line.write(2, "present_position", 7)
    assert line.read(2, "present_position") == before


def test_a_sync_read_is_answered_in_the_order_asked(line: Line) -> None:
    address, size = REGISTERS["present_position"]
    answers = line.ask(Packet(BROADCAST, SYNC_READ, bytes((address, size, 3, 1, 2))), count=3)
    assert [each.servo for each in answers] == [3, 1, 2]
    assert {int.from_bytes(each.parameters, "little") for each in answers} == {2048}


def signed(raw: int) -> int:
    return -(raw & 0x7FFF) if raw & 0x8000 else raw


def test_a_blocked_servo_draws_its_stall_current_and_a_free_one_none(line: Line, bus: FeetechBus) -> None:
    assert line.read(1, "present_current") == 0
    bus.servos[1].blocked_at = bus.servos[1].shaft + 100
    line.write(1, "torque_enable", 1)
    line.write(1, "goal_position", line.read(1, "present_position") + 100 + 90)
    # 90 counts are 7.9 degrees; the stall torque is reached at 6.1.
    eventually(lambda: line.read(1, "present_current") == round(STALL_A / CURRENT_UNIT_A), what="the stall current")
    bus.servos[1].blocked_at = None
    eventually(lambda: line.read(1, "present_current") == 0, what="rest at the goal")
    line.write(1, "torque_enable", 0)
    line.write(1, "goal_position", 2500)
    assert line.read(1, "present_current") == 0


@pytest.mark.parametrize("payload_nm", [0.8, -0.8])
def test_a_servo_that_carries_a_payload_sags_and_draws_the_current_that_holds_it(
    line: Line, bus: FeetechBus, payload_nm: float
) -> None:
    bus.servos[2].payload_nm = payload_nm
    before = line.read(2, "present_position")
    line.write(2, "torque_enable", 1)
    sag = payload_nm / STIFFNESS_NM
    eventually(lambda: abs(before - sag - line.read(2, "present_position")) <= 1, what="its sag")
    held = payload_nm / STALL_NM * STALL_A / CURRENT_UNIT_A
    assert signed(line.read(2, "present_current")) == pytest.approx(held, abs=8)


def test_a_register_that_is_silent_is_not_answered_and_the_others_are(line: Line, bus: FeetechBus) -> None:
    bus.servos[3].silent = frozenset({"present_current"})
    address, size = REGISTERS["present_current"]
    assert line.ask(Packet(3, READ, bytes((address, size))), within=0.1) == []
    asked = Packet(BROADCAST, SYNC_READ, bytes((address, size, 3, 1)))
    assert [each.servo for each in line.ask(asked, count=1)] == [1]
    assert line.read(3, "present_position") == 2048


def test_a_servo_moves_to_its_goal_only_with_torque(line: Line, bus: FeetechBus) -> None:
    line.write(1, "goal_position", 2600)
    assert line.read(1, "present_position") == 2048
    line.write(1, "torque_enable", 1)
    eventually(lambda: abs(line.read(1, "present_position") - 2600) <= 1, what="arrival")
    assert abs(bus.shafts()[1] - 2700) <= 2, "the shaft is the homing offset further"


def test_a_goal_outside_the_limits_is_held_to_them(line: Line) -> None:
    line.write(2, "torque_enable", 1)
    line.write(2, "goal_position", 4000)
    eventually(lambda: abs(line.read(2, "present_position") - 3300) <= 1, what="arrival at the limit")


def test_motion_takes_time(line: Line) -> None:
    line.write(1, "torque_enable", 1)
    began = time.monotonic()
    line.write(1, "goal_position", 3248)
    eventually(lambda: line.read(1, "present_position") >= 3200, what="arrival")
    assert time.monotonic() - began >= 1150 / 3000


def test_a_sync_write_reaches_all_is_logged_and_is_not_answered(line: Line, bus: FeetechBus) -> None:
    address, size = REGISTERS["goal_position"]
    before = time.monotonic()
    goals = b"".join(bytes((servo,)) + (2000 + servo).to_bytes(2, "little") for servo in (1, 2, 6))
    line.send(Packet(BROADCAST, SYNC_WRITE, bytes((address, size)) + goals).encoded())
    assert [each.servo for each in line.ask(Packet(1, PING))] == [1]
    written = bus.written_after(before)
    assert [(each.servo, int.from_bytes(each.data, "little")) for each in written] == [(1, 2001), (2, 2002), (6, 2006)]
    assert bus.written_after(time.monotonic()) == []


def test_a_dead_servo_is_silent_and_the_others_answer(line: Line, bus: FeetechBus) -> None:
    bus.servos[3].dead = True
    assert line.ask(Packet(3, PING), within=0.1) == []
    assert line.ask(Packet(2, PING)) == [Packet(2, 0)]


def test_an_overloaded_servo_says_so_and_has_no_force(line: Line, bus: FeetechBus) -> None:
    line.write(1, "torque_enable", 1)
    bus.servos[1].overloaded = True
    assert line.write(1, "goal_position", 2600).instruction == OVERLOAD
    assert line.read(1, "present_position") == 2048


def test_a_wedged_bus_is_deaf_and_comes_back(line: Line, bus: FeetechBus) -> None:
    bus.wedge(30)
    assert line.ask(Packet(1, PING), within=0.1) == []
    bus.release()
    eventually(lambda: line.ask(Packet(1, PING), within=0.2), what="an answer")


def test_answers_to_every_second_request_are_dropped(line: Line, bus: FeetechBus) -> None:
    bus.drop_every = 2
    assert line.ask(Packet(1, PING)) == [Packet(1, 0)]
    assert line.ask(Packet(1, PING), within=0.1) == []
    assert line.ask(Packet(1, PING)) == [Packet(1, 0)]


def test_latency_holds_every_answer_up(line: Line, bus: FeetechBus) -> None:
    bus.latency_s = 0.03
    began = time.monotonic()
    line.ask(Packet(BROADCAST, PING), count=6)
    assert time.monotonic() - began >= 0.18


def test_an_arm_without_torque_falls_and_one_with_it_is_held() -> None:
    twin = ArmTwin("so101")
    with FeetechBus(arm_servos(), plant=twin) as bus:
        line = Line(bus.port)
        try:
            for servo in bus.servos:
                line.write(servo, "torque_enable", 1)
            eventually(lambda: abs(line.read(2, "present_position") - 2048) <= 10, what="the middle")
            time.sleep(0.3)
            assert abs(line.read(2, "present_position") - 2048) <= 10
            for servo in bus.servos:
                line.write(servo, "torque_enable", 0)
            eventually(lambda: line.read(2, "present_position") > 2148, what="its fall")
        finally:
            line.close()
            twin.close()


def test_an_unplugged_port_vanishes_and_comes_back_under_the_same_name(tmp_path: Path) -> None:
    with FeetechBus(arm_servos(), link=tmp_path / "arm") as bus:
        line = Line(bus.port)
        bus.unplug()
        assert not Path(bus.port).exists()
        with pytest.raises(OSError):
            eventually(lambda: line.ask(Packet(1, PING), within=0.1), what="an input and output error")
        line.close()
        bus.plug()
        again = Line(bus.port)
        assert again.ask(Packet(1, PING)) == [Packet(1, 0)]
        again.close()
