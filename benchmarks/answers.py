"""Answers in a robot's name: strangers that answer for a frozen robot, and the cost of a signature."""

from __future__ import annotations

import logging
import statistics
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import pytest
from fixtures.answering_stranger import Cell, Forge, claimed_verdict
from fixtures.nats_server import NatsServer
from fixtures.waiting import free_port

from benchmarks.table import Row
from strands_robots.device_connect.backends import LinkConfig, loopback_config
from strands_robots.safety.answers import Progress
from strands_robots.safety.identity import ROBOTS, KeyFile, SigningIdentity
from strands_robots.safety.orders import RobotReport, new_epoch
from strands_robots.safety.statements import Proof, Purpose, proof_of, signed
from strands_robots.safety.stopping import StopVerdict

STOPS, STOPS_QUICK = 500, 10
SIGNATURES = 2000


def run(quick: bool = False) -> list[Row]:
    """Measure and give the rows of the table."""
    stops, rows = STOPS_QUICK if quick else STOPS, list[Row]()
    with ExitStack() as stack:
        logging.disable(logging.CRITICAL)
        stack.callback(logging.disable, logging.NOTSET)
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="bench-answers-")))
        stack.enter_context(pytest.MonkeyPatch.context()).setenv("STRANDS_STATE_DIR", str(folder / "controller"))
        stranger = KeyFile(ROBOTS, "arm-1", folder / "stranger").load_or_make()
        server = stack.enter_context(NatsServer())
        links = {"Zenoh D2D": loopback_config(free_port()), "NATS": LinkConfig("nats", connect=(server.url,))}
        for name, link in links.items():
            rows += _attacked(name, link, folder / name.replace(" ", "-"), stops, stranger)
        rows.append(_cost(stranger))
    return rows


def _attacked(name: str, link: LinkConfig, folder: Path, stops: int, stranger: SigningIdentity) -> list[Row]:
    folder.mkdir(mode=0o700)

    def wrong_key(estop_id: str) -> dict[str, object]:
        return signed(stranger, Purpose.STOP_VERDICT, "arm-1", claimed_verdict(estop_id))

    def is_claimed(progress: Progress) -> bool:
        return "arm-1" in progress.answered

    def is_alarmed(progress: Progress) -> bool:
        return "arm-1" in progress.alarms

    attacks: dict[str, tuple[Forge, Callable[[Progress], bool]]] = {
        "an unsigned answer": (claimed_verdict, is_claimed),
        "an answer with a wrong key": (wrong_key, is_alarmed),
    }
    rows = []
    with ExitStack() as stack:
        cell = Cell(link, folder, stack)
        for what, (forge, seen) in attacks.items():
            cell.stranger.forge = forge
            own = missed = 0
            for _ in range(stops):
                report = cell.frozen_stop(seen)
                own += "arm-1" in report.stopped and report.stopped["arm-1"].proof is Proof.SIGNED
                missed += not report.ok
            text = (
                f"{own} of {stops} stopped by the robot's own answer, {missed} missed, {stops - own - missed} falsely"
            )
            row = f"{name}: {what} for a frozen robot, which wakes later"
            rows.append(Row(row, text, "", None, "none missed, none falsely green", own == stops))
    return rows


def _cost(identity: SigningIdentity) -> Row:
    """Computing time of signing one verdict and of checking it, once each for a robot in a stop."""
    fields = RobotReport("arm-1", new_epoch(), StopVerdict(halted=("policy",)), (new_epoch(),), 1.25).fields()
    signing, checking = list[float](), list[float]()
    for _ in range(SIGNATURES):
        began = time.thread_time()
        statement = signed(identity, Purpose.STOP_VERDICT, "arm-1", fields)
        between = time.thread_time()
        assert proof_of(Purpose.STOP_VERDICT, "arm-1", statement, identity.public) is Proof.SIGNED
        signing.append(between - began)
        checking.append(time.thread_time() - between)
    both = sorted(one + other for one, other in zip(signing, checking, strict=True))
    worst = both[int(0.99 * len(both))]
    text = (
        f"signing p50 {statistics.median(signing) * 1e3:.3f}, checking p50 {statistics.median(checking) * 1e3:.3f}, "
        f"both p99 {worst * 1e3:.3f} ms"
    )
    return Row("a verdict signed and checked, computing time", text, "", None, "p99 ≤ 1 ms", worst <= 1e-3)
