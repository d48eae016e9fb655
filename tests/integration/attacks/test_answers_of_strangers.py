"""A robot's process is frozen, and a program without its key answers for it."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from fixtures.answering_stranger import Cell, claimed_verdict
from fixtures.nats_server import NatsServer
from fixtures.waiting import eventually, free_port

from strands_robots.device_connect.backends import LinkConfig, loopback_config
from strands_robots.device_connect.safety_controller import envelope
from strands_robots.envelope import is_error
from strands_robots.safety.identity import ROBOTS, KeyFile
from strands_robots.safety.orders import new_epoch
from strands_robots.safety.statements import Proof, Purpose, signed

TIMES = 10


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
    cell.stranger.forge = lambda estop_id: signed(stranger, Purpose.STOP_VERDICT, "arm-1", claimed_verdict(estop_id))
    for _ in range(TIMES):
        report = cell.frozen_stop(lambda progress: "arm-1" in progress.alarms)
        assert report.stopped["arm-1"].proof is Proof.SIGNED
        assert set(report.alarms) == {"arm-1"}


def test_a_recorded_verdict_of_the_robot_does_not_answer_another_stop(cell: Cell) -> None:
    assert cell.controller.stop(["arm-1"], deadline_s=20).ok
    recorded = eventually(lambda: cell.stranger.recorded)[0]
    cell.stranger.forge = lambda estop_id: {**recorded, "estop_id": estop_id}
    for _ in range(TIMES):
        report = cell.frozen_stop(lambda progress: "arm-1" in progress.alarms)
        assert report.stopped["arm-1"].proof is Proof.SIGNED


def test_a_robot_that_stays_frozen_is_claimed_and_never_stopped(cell: Cell) -> None:
    def is_claimed() -> bool:
        """Stop once; on a busy machine the stranger may be too late for one stop."""
        report = cell.controller.stop(["arm-1"], deadline_s=0.3)
        assert not report.ok
        assert is_error(envelope(report))
        return set(report.claimed) == {"arm-1"}

    cell.robot.signal(signal.SIGSTOP)
    try:
        for _ in range(TIMES):
            eventually(is_claimed, 60)
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
