"""Importing the package loads nothing heavy and needs no extra."""

from __future__ import annotations

import subprocess
import sys

import pytest

from strands_robots import device_connect

HEAVY = ("numpy", "pydantic", "zenoh", "nats", "mujoco", "device_connect_edge")


def run(program: str) -> str:
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


@pytest.mark.parametrize(
    "module",
    [
        "strands_robots.device_connect",
        "strands_robots.device_connect.reachy_transport",
        "strands_robots.drivers.reachy_transport",
    ],
)
def test_import_loads_no_heavy_package(module: str) -> None:
    assert run(f"import sys, {module}; print([m for m in {HEAVY!r} if m in sys.modules])") == "[]"


def test_every_exported_name_exists() -> None:
    for name in device_connect.__all__:
        assert getattr(device_connect, name) is not None
        assert name in dir(device_connect)


def test_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="nothing_like_it"):
        _ = device_connect.nothing_like_it


def test_without_the_extra_the_package_imports_and_a_name_says_which_extra_to_install() -> None:
    program = """
import sys
sys.modules.update(dict.fromkeys(("device_connect_edge", "zenoh", "nats", "pydantic")))
from strands_robots import device_connect
assert device_connect._LOOP_JOIN_TIMEOUT_S > 0
try:
    device_connect.init_device_connect
except ImportError as exc:
    print(exc)
"""
    message = run(program)
    assert "[device-connect]" in message
    assert "\n" not in message
