"""The page of other people's robots against its results, and the emulated Dynamixel line against its protocol."""

from __future__ import annotations

from fixtures.foreign_robots.catalogue import ROBOTS
from fixtures.foreign_robots.dynamixel_bus import PING, READ, DynamixelBus, DynamixelPacket, DynamixelServo, parsed
from fixtures.foreign_robots.servo_buses import ServoRecorder
from fixtures.foreign_robots.table import PAGE, results, with_table

from strands_robots.testing import Tier

BRONZE = 10
"""Packages of strangers that have at least bronze."""

PING_OF_THE_MANUAL = bytes.fromhex("fffffd0001030001194e")
"""Ping of servo 1 in the e-Manual of ROBOTIS, with its CRC."""


def test_table_of_the_page_is_that_of_the_results() -> None:
    page = PAGE.read_text(encoding="utf-8")
    assert page == with_table(page, results())


def test_every_package_was_graded_in_the_version_of_the_catalogue() -> None:
    found = results()
    graded = {name: (each["version"], each["lerobot"]) for name, each in found.items()}
    assert graded == {each.package: (each.version, each.lerobot) for each in ROBOTS}
    tiers = {name: each["tier"] and Tier[each["tier"].upper()].value for name, each in found.items()}
    assert sum(bool(tier) for tier in tiers.values()) >= BRONZE
    servos = [robot.package for robot in ROBOTS if robot.servos and tiers[robot.package]]
    assert all(tiers[name] >= Tier.SILVER.value for name in servos), tiers


def test_dynamixel_packet_is_that_of_the_manual_and_what_is_none_is_skipped() -> None:
    ping = DynamixelPacket(1, PING)
    assert ping.encoded() == PING_OF_THE_MANUAL
    stuffed = DynamixelPacket(1, READ, b"\xff\xff\xfd\x01")
    broken = PING_OF_THE_MANUAL[:-1] + b"\0"
    buffer = bytearray(b"noise" + ping.encoded() + broken + stuffed.encoded() + ping.encoded()[:5])
    assert list(parsed(buffer)) == [ping, stuffed]
    assert bytes(buffer) == ping.encoded()[:5]


def test_dynamixel_line_is_silent_for_a_check_and_moves_to_its_goal() -> None:
    recorder = ServoRecorder()
    servo = DynamixelServo(1, shaft=1000)
    bus = DynamixelBus([servo], recorder)
    servo.put("torque_enable", 1)
    servo.put("goal_position", 2000)
    servo.advance(0.1)
    assert servo.moving
    assert round(servo.shaft) == 1300
    servo.advance(1.0)
    assert not servo.moving
    with recorder.hanging():
        assert bus.silent
    with recorder.raising(OSError(5, "unplugged")):
        assert bus.silent
    assert not bus.silent
