"""The framework is still the one whose private members we lean on."""

import hashlib
import importlib.metadata
import inspect

import pytest

from strands_robots.device_connect import _compat

SOURCE_HASHES = {
    "DeviceDriver._get_functions": "7dc82c18974d7295",
    "DeviceDriver._invoke_decorated": "2edf78c79ad0cb8d",
    "DeviceDriver.invoke": "275902836c43f991",
    "DeviceRuntime.__init__": "df4dbaf9278fcd85",
    "DeviceRuntime._build_registration_params": "da0e9a8d64b409de",
    "DeviceRuntime._cmd_subscription": "8b7c088c5623da36",
    "DeviceRuntime._connect_messaging": "2b6523fb05815087",
    "DeviceRuntime._event_dispatch_loop": "6502b78a542fcf6a",
    "DeviceRuntime._heartbeat_loop": "966ef1a01aecda52",
    "DeviceRuntime._notify_conn_state": "81238ddf7da961b3",
    "DeviceRuntime._register": "d157bbac0df5ea4d",
    "DeviceRuntime._resubscribe_after_reconnect": "66a353dea257fe50",
    "DeviceRuntime._track_task": "37e65a174cde4a05",
    "DeviceRuntime._warn_if_predicate_extra_missing": "0af1317091150b22",
    "DeviceRuntime._validate_startup_config": "5b239cd646cf984c",
    "DeviceRuntime.enqueue_event": "40b84ccb6d07b492",
    "DeviceRuntime.run": "a2472bb8763ce3c6",
    "DeviceRuntime.stop": "e2d84df25977a1c9",
    "decorators.rpc": "4c6b571e695dcfd9",
}


def digest(function):
    return hashlib.sha256(inspect.getsource(function).encode()).hexdigest()[:16]


def test_the_framework_has_the_version_that_was_read():
    assert importlib.metadata.version("device-connect-edge") == _compat.FRAMEWORK_VERSION


@pytest.mark.parametrize("name", sorted(_compat.sources()))
def test_what_is_leaned_on_has_not_changed(name):
    assert digest(_compat.sources()[name]) == SOURCE_HASHES[name], f"read {name} again before trusting _compat.py"
