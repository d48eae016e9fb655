"""Certificates that are not the ones that are meant, between the mesh and a real MQTT broker."""

from __future__ import annotations

import os
from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path

import pytest
from fixtures.certificates import Authority, Identity
from fixtures.mqtt_broker import PROGRAM, MqttBroker

from strands_robots.mesh.transport import TransportError
from strands_robots.mesh.transport.iot import Account, IotMqttTransport

pytestmark = pytest.mark.system

OVER = timedelta(seconds=-10)


@pytest.fixture
def fleet(tmp_path: Path) -> Authority:
    if PROGRAM is None:
        reason = "mosquitto is not installed (Debian package mosquitto)"
        (pytest.fail if os.environ.get("CI") else pytest.skip)(reason)
    return Authority(tmp_path / "fleet")


def broker(folder: Path, ca: Path, shown: Identity) -> MqttBroker:
    return MqttBroker(folder, ca, shown.cert, shown.key)


@pytest.fixture
def true_broker(fleet: Authority, tmp_path: Path) -> Iterator[MqttBroker]:
    with broker(tmp_path, fleet.ca, fleet.issue("broker")) as running:
        yield running


def link(port: int, ca: Path, robot: Identity) -> IotMqttTransport:
    return IotMqttTransport(Account("localhost", port, robot.name, robot.cert, robot.key, ca))


def test_robot_of_the_fleet_is_connected(fleet: Authority, true_broker: MqttBroker) -> None:
    robot = link(true_broker.port, fleet.ca, fleet.issue("sim-1"))
    robot.connect()
    robot.close()


@pytest.mark.parametrize("wrong", ["expired", "of another authority"])
def test_robot_with_a_wrong_certificate_gets_no_connection(
    fleet: Authority, true_broker: MqttBroker, tmp_path: Path, wrong: str
) -> None:
    stranger = Authority(tmp_path / "foreign", "foreign")
    robot = fleet.issue("sim-1", lasts=OVER) if wrong == "expired" else stranger.issue("sim-1")
    with pytest.raises(TransportError, match="no MQTT connection"):
        link(true_broker.port, fleet.ca, robot).connect()


@pytest.mark.parametrize("wrong", ["expired", "for another name", "of another authority"])
def test_broker_with_a_wrong_certificate_gets_no_robot(fleet: Authority, tmp_path: Path, wrong: str) -> None:
    stranger = Authority(tmp_path / "foreign", "foreign")
    shown = {
        "expired": lambda: fleet.issue("broker", lasts=OVER),
        "for another name": lambda: fleet.issue("broker", hosts=("elsewhere.example",)),
        "of another authority": lambda: stranger.issue("broker"),
    }[wrong]()
    with broker(tmp_path, fleet.ca, shown) as liar, pytest.raises(TransportError) as refused:
        link(liar.port, fleet.ca, fleet.issue("sim-1")).connect()
    assert "no MQTT connection" in str(refused.value)
