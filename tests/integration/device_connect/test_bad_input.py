"""Whatever is sent to a live device: a clear refusal, no motion, no dead handler."""

from __future__ import annotations

import gc
import json
from collections.abc import Iterator
from typing import Any

import psutil
import pytest
from fixtures.toy_robots import ToyRobot, ToyWorld
from fixtures.waiting import free_port

from strands_robots.device_connect import FleetClient, init_device_connect_sync, loopback_config, stop_device_connect
from strands_robots.device_connect.backends import open_client
from strands_robots.device_connect.client import CallRefusedError

BAD_TEXT: list[Any] = ["", " ", "x" * 2001, "a\u0000b", "\n", None, 5, True, [], {}, ["x"]]
BAD_NUMBER: list[Any] = [0, -1, True, "5", None, [], {}, 10**400]
ARGUMENTS: dict[str, dict[str, dict[str, list[Any]]]] = {
    "sim-1": {
        "execute": {
            "instruction": BAD_TEXT,
            "policy_provider": [*BAD_TEXT, "a b", "../x", "no_such"],
            "duration": [*BAD_NUMBER, 3601],
            "robot_name": ["nobody", "x" * 200, "\u0007", 5, True, None, []],
        },
        "step": {"n_steps": [*BAD_NUMBER, 1.5, 100_001]},
    },
    "metal-1": {
        "execute": {
            "instruction": BAD_TEXT,
            "policy_provider": [*BAD_TEXT, "a b", "no_such"],
            "duration": [*BAD_NUMBER, 3601],
            "policy_port": [-1, 65536, 1.5, True, "80", None, [], 10**400],
        },
    },
}
CASES = [
    (device, function, name, value)
    for device, functions in ARGUMENTS.items()
    for function, names in functions.items()
    for name, values in names.items()
    for value in values
]
NO_ARGUMENTS = {"sim-1": ["stop", "getStatus", "getFeatures", "reset"], "metal-1": ["stop", "getStatus", "getState"]}


class Site:
    def __init__(self) -> None:
        link = loopback_config(free_port())
        self.world, self.robot = ToyWorld(), ToyRobot()
        self.runtimes = [
            init_device_connect_sync(self.world, peer_id="sim-1", link=link),
            init_device_connect_sync(self.robot, peer_id="metal-1", link=link),
        ]
        self.fleet = FleetClient(link, "tester").__enter__()
        self.client = self.fleet.run(open_client(link), 20.0)

    def raw(self, device: str, data: bytes, within: float = 20.0) -> dict[str, Any]:
        """Send ``data`` as it is on a device's command topic; the decoded reply."""
        request = self.client.request(f"device-connect.default.{device}.cmd", data, timeout=within)
        return json.loads(self.fleet.run(request, within + 1.0))  # type: ignore[no-any-return]

    def refusal(self, device: str, function: str, params: dict[str, Any]) -> str:
        """Why the device refused, in its envelope or in JSON-RPC's own error."""
        try:
            answer = self.fleet.call(device, function, params)
        except CallRefusedError as exc:
            return str(exc)
        assert answer["status"] == "error"
        return str(answer["reason"])

    @property
    def moving(self) -> bool:
        return bool(self.world.rollouts or self.robot.rollouts)

    def close(self) -> None:
        self.fleet.run(self.client.close(), 20.0)
        self.fleet.close()
        for runtime in self.runtimes:
            stop_device_connect(runtime)
        self.world.close()
        self.robot.close()


@pytest.fixture(scope="module")
def site() -> Iterator[Site]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("DEVICE_CONNECT_RPC_ALLOW", "tester")
        patch.setenv("STRANDS_ROBOT_COMMAND_ALLOW", "execute")
        made = Site()
        yield made
        made.close()


@pytest.fixture(autouse=True)
def allowed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DEVICE_CONNECT_RPC_ALLOW", "tester")
    monkeypatch.setenv("STRANDS_ROBOT_COMMAND_ALLOW", "execute")


@pytest.mark.parametrize(("device", "function", "name", "value"), CASES)
def test_argument_out_of_its_domain_is_refused(site: Site, device: str, function: str, name: str, value: Any) -> None:
    base = {"instruction": "wave"} if function == "execute" else {}
    answer = site.fleet.call(device, function, {**base, name: value})
    assert answer["status"] == "error"
    assert name in answer["reason"] or "policy" in answer["reason"]
    assert not site.moving


@pytest.mark.parametrize("word", ["NaN", "Infinity", "-Infinity", "1e999", "[" * 10_000 + "]" * 10_000])
def test_value_that_is_not_json_never_moves_a_robot(site: Site, word: str) -> None:
    request = (
        '{"jsonrpc":"2.0","id":"1","method":"execute","params":{"instruction":"wave","duration":'
        + word
        + ',"_dc_meta":{"source_device":"tester"}}}'
    )
    answer = site.raw("sim-1", request.encode())
    assert "error" in answer or answer["result"]["status"] == "error"
    assert not site.moving


@pytest.mark.parametrize("device", ["sim-1", "metal-1"])
@pytest.mark.parametrize("params", [{"extra": 1}, {"self": 1}, {"function_name": "x"}, {"instruction": "wave", "x": 1}])
def test_extra_parameters_are_refused_on_every_motion_and_ignored_by_reads_and_stops(
    site: Site, device: str, params: dict[str, Any]
) -> None:
    # A method in Python cannot be given an argument of these names besides its own.
    unsendable = not params.keys().isdisjoint(("self", "function_name"))
    for function in {*NO_ARGUMENTS[device], "execute"}:
        if function in ("execute", "reset") or (unsendable and function != "stop"):
            assert "takes" in site.refusal(device, function, params)
        else:
            assert site.fleet.call(device, function, params)["status"] == "success"
    assert not site.moving


def test_missing_parameter_is_refused_by_name(site: Site) -> None:
    assert "instruction" in site.fleet.call("sim-1", "execute")["reason"]


@pytest.mark.parametrize("source", [None, "", 5, [], {}, {"name": "tester"}, "x" * 300, "tester\u0000"])
def test_caller_without_a_valid_name_moves_no_robot(site: Site, source: Any) -> None:
    request = {
        "jsonrpc": "2.0",
        "id": "1",
        "method": "execute",
        "params": {"instruction": "wave", "_dc_meta": {"source_device": source}},
    }
    answer = site.raw("sim-1", json.dumps(request).encode())
    assert "error" in answer or answer["result"]["status"] == "error"
    assert not site.moving


def test_command_of_ten_megabytes_is_refused_and_its_memory_freed(site: Site) -> None:
    me = psutil.Process()

    def refused_often() -> int:
        for _ in range(8):
            assert len(site.refusal("sim-1", "execute", {"instruction": "x" * 10_000_000})) < 500
        gc.collect()
        return int(me.memory_info().rss)

    # The allocator keeps what the first rounds touched; what would grow for ever grows in every round.
    rounds = [refused_often() for _ in range(6)]
    assert rounds[-1] < rounds[-3] + 80_000_000, rounds


def test_devices_answer_and_move_after_bad_input(site: Site) -> None:
    for device in ("sim-1", "metal-1"):
        assert site.fleet.call(device, "execute", {"instruction": "wave", "duration": 5})["status"] == "success"
        assert site.fleet.stop(device)["status"] == "success"
