"""Robots that real commands and servers remember, on Device Connect and on the mesh."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest
from fixtures.command_line import Machine
from fixtures.waiting import eventually, free_port

from strands_robots.safety.identity import EnrolledKeys
from strands_robots.safety.sightings import Known, RosterRow, Sightings

NETWORKS = [pytest.param((), id="device-connect"), pytest.param(("--mesh",), id="mesh")]


@pytest.fixture
def ports() -> dict[str, str]:
    """One network for every machine of a test."""
    return {"STRANDS_DC_PORT": str(free_port()), "STRANDS_MESH_PORT": str(free_port())}


@pytest.fixture
def machine(tmp_path: Path, ports: dict[str, str]) -> Machine:
    return Machine(tmp_path / "console", **ports)


@pytest.fixture
def another(tmp_path: Path, ports: dict[str, str]) -> Machine:
    """Another machine on the same network: its own state directory."""
    return Machine(tmp_path / "robots", **ports)


def remembered(directory: Path) -> dict[str, RosterRow]:
    rows, problem = Sightings(directory).read()
    assert problem == ""
    return {each.name: each for each in rows}


@pytest.mark.parametrize("mesh", NETWORKS)
def test_command_remembers_whom_it_heard_and_who_answered_signed(
    tmp_path: Path, machine: Machine, another: Machine, mesh: tuple[str, ...]
) -> None:
    more = {"DEVICE_CONNECT_ESTOP_PUBLIC_KEYS": "A" * 43 + "=", "STRANDS_ESTOP_REQUIRE_SIGNED": "true"}
    with another.serving("arm-1", *mesh, STRANDS_CELL="cell-1", **more):
        assert machine.json("peers", *mesh)[0] == 0
        arm = remembered(tmp_path / "console")["arm-1"]
        assert (arm.known, arm.cell, arm.signed_only, arm.stoppable, arm.alive) == (
            Known.HEARD,
            "cell-1",
            True,
            True,
            None,
        )
        # Enrolled now, so it is asked with a nonce.
        assert machine.json("enroll", *mesh)[0] == 0
        assert machine.json("enroll", "--retire", "arm-1", *mesh)[0] == 0
        assert machine.json("peers", *mesh)[0] == 0
        enrolled = EnrolledKeys(tmp_path / "console")
        assert enrolled.robots()["arm-1"].exemption is not None
        assert machine.json("lockout", *mesh)[0] == 0
        assert remembered(tmp_path / "console")["arm-1"].known is Known.SIGNED
        record = enrolled.robots()["arm-1"]
        assert record.exemption is None
        assert record.networks == (arm.network,)


@pytest.mark.parametrize("mesh", NETWORKS)
def test_served_robot_counts_until_its_orderly_end(tmp_path: Path, machine: Machine, mesh: tuple[str, ...]) -> None:
    state = tmp_path / "console"
    with machine.serving("arm-1", *mesh, STRANDS_CELL="cell-1") as (served, _):
        arm = eventually(lambda: remembered(state).get("arm-1"))
        assert (arm.known, arm.alive, arm.pid, arm.cell) == (Known.SERVED, True, served.pid, "cell-1")
        assert machine.json("peers", *mesh)[0] == 0
        served.send_signal(signal.SIGTERM)
        served.wait(60)
        assert remembered(state) == {}
        assert Sightings(state).was_here(arm.network, "arm-1") is not None


@pytest.mark.parametrize("mesh", NETWORKS)
def test_killed_robot_counts_for_ten_minutes(tmp_path: Path, machine: Machine, mesh: tuple[str, ...]) -> None:
    state = tmp_path / "console"
    with machine.serving("arm-1", *mesh) as (served, _):
        eventually(lambda: remembered(state).get("arm-1"))
        served.kill()
        served.wait(60)
        arm = remembered(state)["arm-1"]
        assert (arm.known, arm.alive) == (Known.SERVED, False)
        assert Sightings(state).was_here(arm.network, "arm-1") is not None


@pytest.mark.parametrize("mesh", NETWORKS)
def test_robots_own_processes_collect_no_presence(tmp_path: Path, machine: Machine, mesh: tuple[str, ...]) -> None:
    state = tmp_path / "console"
    with machine.serving("arm-1", *mesh), machine.serving("arm-2", *mesh):
        # A console hears both, so their presence has been sent; its own memory is elsewhere.
        console = Machine(
            tmp_path / "other", **{name: machine.environment[name] for name in ("STRANDS_DC_PORT", "STRANDS_MESH_PORT")}
        )
        assert console.json("peers", *mesh)[0] == 0
        assert set(remembered(tmp_path / "other")) == {"arm-1", "arm-2"}
        rows = eventually(lambda: len(found := remembered(state)) == 2 and found)
        # The order of a row that was heard is above 0.
        assert {(each.known, each.order) for each in rows.values()} == {(Known.SERVED, 0)}
