"""What agents read of a device: names, types, defaults and a description of everything."""

from __future__ import annotations

import json
from typing import Any

import pytest
from fixtures.toy_robots import ToyRobot, ToyWorld

from strands_robots.device_connect._compat import rpc
from strands_robots.device_connect.robot_driver import RobotDeviceDriver
from strands_robots.device_connect.simulation_driver import SimulationDeviceDriver
from strands_robots.serving.control_leases import CONTROL_VERBS

DRIVERS = [RobotDeviceDriver(ToyRobot()), SimulationDeviceDriver(ToyWorld())]
TYPES = {"string", "integer", "number", "boolean", "object", "array"}


@pytest.mark.parametrize("driver", DRIVERS, ids=lambda d: d.device_type)
def test_json_carries_the_whole_announcement(driver: Any) -> None:
    json.dumps(driver.capabilities.model_dump(), allow_nan=False)
    json.dumps(driver.identity.model_dump(), allow_nan=False)


@pytest.mark.parametrize("driver", DRIVERS, ids=lambda d: d.device_type)
def test_every_function_event_and_parameter_is_described(driver: Any) -> None:
    for part in (*driver.functions, *driver.events):
        assert part.description.endswith("."), part.name
        schema = getattr(part, "parameters", None) or part.payload_schema
        for name, prop in schema["properties"].items():
            assert prop["type"] in TYPES, (part.name, name)
            assert len(prop.get("description", "")) > 2, (part.name, name)


CONTROL_EVENTS = ("controlTaken", "controlExpired", "motionRefused")
COMMON_EVENTS = {"turnChanged", "emergencyStop", *CONTROL_EVENTS}


def test_the_types_are_those_of_the_arguments() -> None:
    execute = next(f for f in DRIVERS[0].functions if f.name == "execute").parameters
    assert {name: prop["type"] for name, prop in execute["properties"].items()} == {
        "instruction": "string",
        "policy_provider": "string",
        "duration": "number",
        "policy_port": "integer",
        "lease_id": "string",
        "lease_ttl_s": "number",
    }
    assert execute["required"] == ["instruction"]
    update = next(e for e in DRIVERS[1].events if e.name == "observationUpdate").payload_schema
    assert update["properties"]["joints"]["type"] == "object"


@pytest.mark.parametrize(
    ("driver", "functions", "events"),
    [
        (
            DRIVERS[0],
            {"execute", "stop", "resume", "getStatus", "getFeatures", "getState", *CONTROL_VERBS},
            {"taskStarted", "taskComplete", "streamStep", "stateUpdate", *COMMON_EVENTS},
        ),
        (
            DRIVERS[1],
            {"execute", "stop", "resume", "getStatus", "getFeatures", "step", "reset", *CONTROL_VERBS},
            {
                *("policyStarted", "policyComplete", "observationUpdate", "streamStep", "stateUpdate"),
                *COMMON_EVENTS,
            },
        ),
    ],
    ids=["robot", "simulation"],
)
def test_a_device_has_these_functions_and_events(driver: Any, functions: set[str], events: set[str]) -> None:
    assert {f.name for f in driver.functions} == functions
    assert {e.name for e in driver.events} == events


def test_reads_and_writes_are_labelled() -> None:
    for driver in DRIVERS:
        for function in driver.functions:
            reads = function.name.startswith(("get", "list", "wait"))
            assert function.labels["direction"] == ("read" if reads else "write"), function.name


def test_a_fleet_of_one_class_says_the_same_and_a_subclass_says_its_own() -> None:
    class Wider(RobotDeviceDriver):
        """A robot of two more words."""

        @rpc()
        async def greet(self) -> dict[str, Any]:
            """Say hello."""
            return {"status": "success"}

    first, second, wider = RobotDeviceDriver(ToyRobot()), RobotDeviceDriver(ToyRobot()), Wider(ToyRobot())
    first.functions.clear()
    assert second.functions == DRIVERS[0].functions
    assert second.events == DRIVERS[0].events
    assert {f.name for f in wider.functions} - {f.name for f in second.functions} == {"greet"}
