from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from strands_robots.cli.app import assignments, parse_ports
from strands_robots.utils import ValidationError


def test_values_are_json_where_possible_else_text() -> None:
    arguments = [
        "duration=1.5",
        "n_steps=3",
        "instruction=pick up the cube",
        'name="1.5"',
        "on=true",
        "pose=[1, 2]",
        "url=a=b",
    ]
    assert assignments(arguments) == {
        "duration": 1.5,
        "n_steps": 3,
        "instruction": "pick up the cube",
        "name": "1.5",
        "on": True,
        "pose": [1, 2],
        "url": "a=b",
    }


@pytest.mark.parametrize(
    "argument", ["duration", "=3", "a b=3", "1a=3", "a-b=3", "x=NaN", "x=Infinity", "x=-Infinity", "x=1e999"]
)
def test_malformed_argument_is_refused(argument: str) -> None:
    with pytest.raises(ValidationError):
        assignments([argument])


def test_key_given_twice_is_refused() -> None:
    with pytest.raises(ValidationError, match="twice"):
        assignments(["a=1", "a=2"])


def test_json_nested_too_deep_is_text() -> None:
    deep = "[" * 100_000
    assert assignments([f"a={deep}"]) == {"a": deep}


@given(st.text())
def test_any_argument_is_parsed_or_refused_by_name(argument: str) -> None:
    try:
        assignments([f"key={argument}"])
    except ValidationError as refused:
        assert "key" in str(refused)


@pytest.mark.parametrize(
    ("ports", "tcp", "serial"),
    [
        ([], None, None),
        (["7447"], 7447, None),
        (["/dev/ttyACM0"], None, "/dev/ttyACM0"),
        (["com3", "1"], 1, "com3"),
        (["65535", "/dev/serial/by-id/x"], 65535, "/dev/serial/by-id/x"),
    ],
)
def test_port_is_a_tcp_port_or_a_serial_path(ports: list[str], tcp: int | None, serial: str | None) -> None:
    assert parse_ports(ports) == (tcp, serial)


@pytest.mark.parametrize(
    "ports", [["0"], ["65536"], ["-1"], [""], ["ttyACM0"], ["/"], ["1", "2"], ["/dev/a", "/dev/b"], ["7447.0"], ["²"]]
)
def test_any_other_port_is_refused(ports: list[str]) -> None:
    with pytest.raises(ValidationError, match="--port"):
        parse_ports(ports)
