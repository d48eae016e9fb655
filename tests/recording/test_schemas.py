"""Encoded messages of a recording, read by independent decoders."""

from __future__ import annotations

import pytest
from rosbags.typesys import Stores, get_typestore

from strands_robots.recording import schemas

AT = 5 * 10**9 + 7


@pytest.mark.parametrize("names", [(), ("a",), ("shoulder_pan.pos", "lift", "größe"), tuple(f"j{i}" for i in range(7))])
def test_joint_states_decode_with_the_ros_types(names: tuple[str, ...]) -> None:
    joints = {name: 1.5 * index - 1 for index, name in enumerate(names)}
    data = schemas.joint_state(AT, joints)
    message = get_typestore(Stores.ROS2_HUMBLE).deserialize_cdr(data, schemas.JOINT_STATE.name)
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (5, 7)
    assert dict(zip(message.name, message.position, strict=True)) == joints
    assert schemas.read_joint_state(data) == joints


def test_pictures_and_log_lines_equal_the_bytes_of_foxgloves_encoder() -> None:
    # Made with foxglove-sdk 0.30.3 from the same values.
    assert schemas.compressed_image(AT, "front", bytes.fromhex("ffd8ffe000104a46")).hex() == (
        "0a04080510071208ffd8ffe000104a461a046a706567220566726f6e74"
    )
    assert schemas.log_line(AT, schemas.INFO, "arm", "hi").hex() == "0a040805100710021a026869220361726d"


def test_picture_survives_encoding() -> None:
    jpeg = bytes(range(256)) * 3
    assert schemas.read_compressed_image(schemas.compressed_image(AT, "front", jpeg)) == jpeg
    assert schemas.read_compressed_image(b"\x0a\x04\x08\x05\x10\x07") == b""
