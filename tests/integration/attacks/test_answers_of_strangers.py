"""A robot's process is frozen, and a program without its key answers for it."""

from __future__ import annotations

import json
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from fixtures.child import Child
from fixtures.nats_server import NatsServer
from fixtures.stop_robots import robots
from fixtures.waiting import eventually, free_port

from strands_robots.device_connect.backends import LinkConfig, loopback_config
from strands_robots.device_connect.safety_controller import envelope, safety_controller
from strands_robots.device_connect.stop_link import stop_link
from strands_robots.envelope import is_error
from strands_robots.safety import ed25519
from strands_robots.safety.controller import Progress, SafetyController, StopReport
from strands_robots.safety.estop_listener import ESTOP, VERDICT, notification
from strands_robots.safety.identity import ROBOTS, EnrolledKeys, KeyFile
from strands_robots.safety.orders import new_epoch
from strands_robots.safety.statements import Proof, Purpose, signed

TIMES = 10
Forge = Callable[[str], dict[str, Any]]
"""Returns the fields of a verdict for an emergency stop's id."""


def claimed_verdict(estop_id: str) -> dict[str, Any]:
    return {"device_id": "arm-1", "estop_id": estop_id, "stopped": True, "halted": ["policy"]}


class Liar:
    """Answers every emergency stop of the network as ``arm-1``, as soon as it is heard."""

    def __init__(self, link: LinkConfig) -> None:
        self.forge: Forge = claimed_verdict
        self.recorded: list[dict[str, Any]] = []
        self.link = stop_link(link)
        self.link.open((ESTOP, VERDICT), self._hear, lambda up: None)

    def _hear(self, event: str, source: str, payload: bytes) -> None:
        params = json.loads(payload)["params"]
        if event == ESTOP:
            self.link.publish("arm-1", VERDICT, notification(VERDICT, self.forge(params["estop_id"])))
        elif "sig" in params:
            self.recorded.append(params)


class Cell:
    """A robot in a process of its own, its key enrolled here; a controller; a liar."""

    def __init__(self, link: LinkConfig, folder: Path, stack: ExitStack) -> None:
        key = Ed25519PrivateKey.generate()
        state = {
            "STRANDS_STATE_DIR": str(folder),
            "DEVICE_CONNECT_ESTOP_PUBLIC_KEYS": ed25519.encode(ed25519.public_half(key)),
        }
        self.robot: Child = stack.enter_context(robots(link, "arm-1", environment=state))
        eventually(lambda: self.robot.ask("ready"), what="the robot's e-stop link")
        identity = KeyFile(ROBOTS, "arm-1", folder).load()
        assert identity is not None
        EnrolledKeys().enroll({"arm-1": identity.public})
        self.controller: SafetyController = safety_controller("safety-1", link, signing_key=key, require_signed=True)
        stack.callback(self.controller.close)
        assert self.controller.wait_link(20)
        eventually(lambda: self.controller.stop(["arm-1"], deadline_s=5).ok, what="the first stop")
        self.liar = Liar(link)
        stack.callback(self.liar.link.close)
        eventually(lambda: self.liar.link.up)

    def frozen_stop(self, seen: Callable[[Progress], bool]) -> StopReport:
        """Stop the frozen robot; wake it once ``seen`` is true of the progress, and return the report."""
        reports, progress = list[StopReport](), list[Progress]()

        def stop() -> None:
            reports.append(self.controller.stop(["arm-1"], deadline_s=60, on_progress=progress.append))

        thread = threading.Thread(target=stop)
        self.robot.signal(signal.SIGSTOP)
        try:
            thread.start()
            eventually(lambda: any(seen(each) for each in progress))
            assert thread.is_alive(), "the stop goes on"
            assert not any(each.proof is Proof.SIGNED for one in progress for each in one.answered.values())
        finally:
            self.robot.signal(signal.SIGCONT)
            thread.join()
        return reports[0]


@pytest.fixture(params=["zenoh", "nats"])
def cell(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Cell]:
    folder = tmp_path / "robot"
    folder.mkdir(mode=0o700)
    with ExitStack() as stack:
        if request.param == "nats":
            server = stack.enter_context(NatsServer())
            link = LinkConfig(transport="nats", connect=(server.url,))
        else:
            link = loopback_config(free_port())
        yield Cell(link, folder, stack)


def test_a_claim_for_a_frozen_robot_is_no_answer_and_its_own_answer_counts_when_it_wakes(cell: Cell) -> None:
    for _ in range(TIMES):
        report = cell.frozen_stop(lambda progress: "arm-1" in progress.answered and "arm-1" in progress.unconfirmed)
        assert report.ok
        assert report.stopped["arm-1"].proof is Proof.SIGNED
    assert cell.robot.ask("facts")["arm-1"]["moving"] is False


def test_a_wrong_key_for_a_frozen_robot_is_an_alarm(cell: Cell, tmp_path: Path) -> None:
    stranger = KeyFile(ROBOTS, "arm-1", tmp_path / "stranger").load_or_make()
    cell.liar.forge = lambda estop_id: signed(stranger, Purpose.STOP_VERDICT, "arm-1", claimed_verdict(estop_id))
    for _ in range(TIMES):
        report = cell.frozen_stop(lambda progress: "arm-1" in progress.alarms)
        assert report.stopped["arm-1"].proof is Proof.SIGNED
        assert set(report.alarms) == {"arm-1"}


def test_a_recorded_verdict_of_the_robot_does_not_answer_another_stop(cell: Cell) -> None:
    assert cell.controller.stop(["arm-1"], deadline_s=20).ok
    recorded = eventually(lambda: cell.liar.recorded)[0]
    cell.liar.forge = lambda estop_id: {**recorded, "estop_id": estop_id}
    for _ in range(TIMES):
        report = cell.frozen_stop(lambda progress: "arm-1" in progress.alarms)
        assert report.stopped["arm-1"].proof is Proof.SIGNED


def test_a_robot_that_stays_frozen_is_claimed_and_never_stopped(cell: Cell) -> None:
    cell.robot.signal(signal.SIGSTOP)
    try:
        for _ in range(TIMES):
            report = cell.controller.stop(["arm-1"], deadline_s=0.3)
            assert set(report.claimed) == {"arm-1"}
            assert not report.ok
            assert is_error(envelope(report))
    finally:
        cell.robot.signal(signal.SIGCONT)


def test_a_stranger_cannot_hide_that_a_robot_did_not_stop(cell: Cell) -> None:
    """The robot's bus hangs: its own *not stopped* counts, and the stranger's *stopped* does not."""
    cell.robot.ask("clear")
    cell.robot.ask("move")
    cell.robot.ask("wedge", "arm-1", 2.0)
    report = cell.controller.stop(["arm-1"], deadline_s=20, estop_id=new_epoch())
    assert set(report.not_stopped) == {"arm-1"}
    assert report.not_stopped["arm-1"].proof is Proof.SIGNED
