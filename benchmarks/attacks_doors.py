"""Attacks by what a configuration leaves open: access rules, stored commands, the framework's own runtime."""

from __future__ import annotations

import json
import logging
import time
from contextlib import ExitStack
from pathlib import Path

import pytest
from fixtures.access_rules import NOBODY, OPEN, rules
from fixtures.bare_robot import bare_robot
from fixtures.mesh_peer import MeshPeer
from fixtures.mqtt_broker import PROGRAM, MqttBroker
from fixtures.mqtt_retainer import Retainer, command
from fixtures.nats_server import NatsServer
from fixtures.stop_controller import controller
from fixtures.waiting import eventually

from benchmarks.attacks_robots import state_folder
from benchmarks.table import Row
from strands_robots.device_connect.backends import LinkConfig
from strands_robots.mesh.transport import TransportError, config
from strands_robots.mesh.transport.config import Posture

STOPS, STOPS_QUICK = 100, 5
STORED, STORED_QUICK = 10, 2
WAVE = {"action": "start", "instruction": "wave", "policy_provider": "mock", "duration": 60}
AFTER_S = 20.0


def rows(quick: bool = False) -> list[Row]:
    """Measure and give the rows of the table."""
    measured = [access_row(), bare_row(STOPS_QUICK if quick else STOPS)]
    # Debian's broker is no part of the Python environment.
    return [*measured, *([stored_row(STORED_QUICK if quick else STORED)] if PROGRAM else [])]


class _Lines(logging.Handler):
    """Counts the lines at WARNING and above."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.count = 0

    def emit(self, record: logging.LogRecord) -> None:
        self.count += 1


def access_row() -> Row:
    """Rules by which anyone may command, with the opt-in and without."""
    wrong = [*OPEN.values(), *(rules(["**"], {field: names}) for field, names in NOBODY.values())]
    lines, refused, silent = _Lines(), 0, 0
    log = logging.getLogger("strands_robots.mesh")
    with ExitStack() as stack:
        folder = state_folder(stack)
        patch = stack.enter_context(pytest.MonkeyPatch.context())
        log.addHandler(lines)
        stack.callback(log.removeHandler, lines)
        config.make_authority(folder / "keys")
        path = folder / "acl.json5"
        issued = config.issue_certificate(folder / "keys", "arm-1").settings()
        for name, value in {**issued, "STRANDS_MESH_ACL_FILE": str(path)}.items():
            patch.setenv(name, value)
        for accepted in ("false", "true"):
            patch.setenv("STRANDS_MESH_ACCEPT_PERMISSIVE_ACL", accepted)
            for each in wrong:
                path.write_text(json.dumps(each))
                before = lines.count
                try:
                    Posture.from_settings()
                except TransportError:
                    refused += accepted == "false"
                else:
                    silent += accepted == "false" or lines.count == before
    return Row(
        f"mesh: {len(wrong)} access rules that let anyone command, or name nobody",
        f"{refused} refused; {silent} joined in silence",
        "",
        None,
        "all refused, none in silence with the opt-in",
        refused == len(wrong) and not silent,
    )


def bare_row(stops: int) -> Row:
    """Emergency stops of a robot that the framework's own runtime serves."""
    locked = stood = 0
    with ExitStack() as stack:
        state = {"STRANDS_STATE_DIR": str(state_folder(stack))}
        server = stack.enter_context(NatsServer())
        robot = stack.enter_context(bare_robot("arm-1", "nats", server.url, **state))
        hand = stack.enter_context(controller(LinkConfig("nats", connect=(server.url,)), environment=state))
        eventually(lambda: robot.ask("link_up") and hand.ask("up"))
        for _ in range(stops):
            assert robot.ask("start") == "success"
            hand.ask("stop", ["arm-1"], AFTER_S)
            locked += robot.ask("locked")
            stood += not robot.ask("moving")
            robot.ask("clear")
    return Row(
        "NATS: emergency stops of a robot in the framework's own runtime",
        f"{stood} of {stops} stood still, {locked} locked",
        "",
        None,
        "all",
        stood == locked == stops,
    )


def stored_row(count: int) -> Row:
    """Commands that a real broker stored, each met by a simulation that joins."""
    moved = refused = 0
    with ExitStack() as stack:
        folder = state_folder(stack)
        config.make_authority(folder)
        config.issue_certificate(folder, "broker")
        files = (folder / "ca.pem", folder / "broker.pem", folder / "broker.key")
        broker = stack.enter_context(MqttBroker(folder, *files))
        retainer = stack.enter_context(Retainer(broker.port, config.issue_certificate(folder, "retainer")))
        for number in range(count):
            name = f"sim-{number}"
            retainer.store(f"strands/{name}/cmd", command(WAVE))
            retainer.store("strands/broadcast", command(WAVE))
            with MeshPeer(name, "world", _account(folder, broker.port, name)) as peer:
                deadline = time.monotonic() + AFTER_S
                while peer.ask("audited").count("command_refused") < 2 and time.monotonic() < deadline:
                    time.sleep(0.05)
                refused += peer.ask("audited").count("command_refused")
                moved += bool(peer.ask("moving"))
    return Row(
        f"MQTT: {2 * count} stored commands at {count} joins",
        f"{moved} carried out, {refused} refused by name",
        "",
        None,
        "none carried out, all refused",
        not moved and refused == 2 * count,
    )


def _account(folder: Path, port: int, name: str) -> dict[str, str]:
    config.issue_certificate(folder, name)
    state = folder / f"state-{name}"
    state.mkdir(mode=0o700)
    return {
        "STRANDS_MESH_BACKEND": "iot",
        "STRANDS_IOT_ENDPOINT": f"localhost:{port}",
        "STRANDS_IOT_THING_NAME": name,
        "STRANDS_IOT_CERT_DIR": str(folder),
        "STRANDS_IOT_CA_FILE": str(folder / "ca.pem"),
        "STRANDS_STATE_DIR": str(state),
    }
