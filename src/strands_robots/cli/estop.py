"""``estop``: an emergency stop for every robot of the tenant, with each robot's answer by name."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from strands_robots.cli.command import command
from strands_robots.cli.mesh import stopped_on_mesh
from strands_robots.cli.network import Network, describe
from strands_robots.cli.output import Exit, Failure, Screen, label, plain, table
from strands_robots.cli.passphrase import PASSPHRASE_FILE, signing_key
from strands_robots.cli.quiet import kept_log
from strands_robots.safety.controller import DEADLINE_S, Answer, Progress, SafetyController, StopReport
from strands_robots.safety.orders import new_epoch
from strands_robots.tools.networks import NativeMesh
from strands_robots.utils import device_id, number

if TYPE_CHECKING:
    from rich.table import Table

    from strands_robots.device_connect.backends import LinkConfig

SLOW_MS = 100.0
"""An answer that took longer is shown in red."""

LOCKED = "They are locked until they are resumed: strands-robots resume."
LINK_WAIT_S = 2.0
DRAW_S = 0.05
COLUMNS = ("robot", "answer", "ms", "what it said")


def register(app: typer.Typer) -> None:
    """Add ``estop`` to the application."""
    command(app, "estop", network=True)(estop)


def estop(
    screen: Screen,
    network: Network,
    *,
    devices: Annotated[
        list[str] | None, typer.Argument(metavar="DEVICE...", help="Who must answer. Every robot of the tenant stops.")
    ] = None,
    everything: Annotated[bool, typer.Option("--all", help="Whoever can be found must answer; the default.")] = False,
    reason: Annotated[str, typer.Option("--reason", help="Told to the robots and their audit.")] = "",
    source: Annotated[str, typer.Option("--as", help="The source that robots see.")] = "strands-robots",
    deadline: Annotated[float, typer.Option("--deadline", help="Seconds until silence is silence.")] = DEADLINE_S,
    key: Annotated[Path | None, typer.Option("--key", help="Sign it, where robots ask for signed stops.")] = None,
    passphrase_file: Annotated[Path | None, PASSPHRASE_FILE] = None,
    on_mesh: Annotated[bool, typer.Option("--mesh", help="On the native mesh instead of Device Connect.")] = False,
) -> None:
    """Stop every robot of the tenant and lock it. Exits with 1 when one did not stop, with 3 when one is silent."""
    if devices and everything:
        raise Failure("estop takes DEVICE... or --all.", Exit.USAGE)
    if on_mesh:
        if devices or key is not None:
            raise Failure("estop --mesh stops everybody, and takes neither DEVICE nor --key.", Exit.USAGE)
        network.on_mesh()
        stopped_on_mesh(screen, NativeMesh().emergency_stop(reason), f" {LOCKED}")
        return
    expected = [device_id("DEVICE", each) for each in devices or []]
    seconds = number("--deadline", deadline, above=0, high=600)
    source = device_id("--as", source)
    link = network.link()
    signer = None if key is None else signing_key(key, passphrase_file)
    from strands_robots.device_connect.safety_controller import (  # noqa: PLC0415 - the network is loaded when it is used
        envelope,
        safety_controller,
    )

    controller = safety_controller(source, link, signing_key=signer)
    try:
        running = Running(controller, expected, reason, seconds, link)
        report = _shown(screen, running) if screen.out.is_terminal and not screen.machine else running.wait()
    finally:
        controller.close()
    if not (screen.out.is_terminal and not screen.machine):
        screen.show(drawn(rows(report), ""))
    told = envelope(report)
    facts = {name: value for name, value in told.items() if name not in ("status", "content", "reason")}
    screen.say(counts(report), "green" if report.ok else "bold red")
    code = verdict(report)
    if code is not Exit.OK:
        where = "" if report.link else f" {describe(link)}"
        raise Failure(plain(f"{told['reason']}{where}", 2000), code, **facts)
    screen.data({"status": "success", **facts})
    screen.say(LOCKED)


class Running:
    """An emergency stop under way on a thread of its own, which never waits for drawing.

    Without ``expected`` the roll is called once the stop has left: whoever can be stopped must answer.
    """

    def __init__(
        self, controller: SafetyController, expected: list[str], reason: str, deadline_s: float, link: LinkConfig
    ) -> None:
        self.latest: Progress | None = None
        self.report: StopReport | None = None
        self._controller, self._expected, self._reason = controller, expected, reason
        self._deadline_s, self._link = deadline_s, link
        self._id = new_epoch()
        self._calling: threading.Thread | None = None
        self._failed: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name="estop", daemon=True)
        self._thread.start()

    def finished(self, within_s: float) -> bool:
        """True when the report is there."""
        self._thread.join(within_s)
        return not self._thread.is_alive()

    def wait(self) -> StopReport:
        """The report."""
        while not self.finished(1.0):
            continue
        if self.report is None:
            raise self._failed or RuntimeError("The stop ended without a report.")
        return self.report

    def _run(self) -> None:
        try:
            # Nothing can leave before the link is up; then the milliseconds are the robots' and not the handshake's.
            self._controller.wait_link(LINK_WAIT_S)
            self.report = self._controller.stop(
                self._expected,
                self._reason,
                deadline_s=self._deadline_s,
                estop_id=self._id,
                on_progress=self._progress,
            )
        except BaseException as exc:  # noqa: BLE001 - raised where it is waited for
            self._failed = exc

    def _progress(self, progress: Progress) -> None:
        self.latest = progress
        if not self._expected and self._calling is None:
            self._calling = threading.Thread(target=self._call_roll, name="roll", daemon=True)
            self._calling.start()

    def _call_roll(self) -> None:
        from device_connect_edge.messaging import MessagingError  # noqa: PLC0415 - the network is loaded when it is used

        from strands_robots.device_connect import FleetClient  # noqa: PLC0415

        try:
            with FleetClient(self._link) as fleet:
                found = [peer.id for peer in fleet.peers(min(2.0, self._deadline_s)) if peer.stop_verb]
        except (MessagingError, TimeoutError):
            # Who answers is still in the report, at the deadline.
            return
        answered = self.latest.answered if self.latest else {}
        self._controller.expect(self._id, {*found, *answered})


def verdict(report: StopReport) -> Exit:
    """0 when all stopped, 1 when one did not or refused, 3 when one, or everybody, is silent."""
    if report.not_stopped or report.refused:
        return Exit.REFUSED
    return Exit.OK if report.ok else Exit.SILENT


def counts(report: StopReport) -> str:
    """The end in one line."""
    parts = [f"{len(report.stopped)} stopped"]
    for many, word in (
        (report.not_stopped, "DID NOT STOP"),
        (report.refused, "did not act on it"),
        (report.silent, "silent"),
    ):
        parts += [f"{len(many)} {word}"] if many else []
    return f"{', '.join(parts)}, in {report.elapsed_ms:.0f} ms. Emergency stop {report.estop_id}."


def rows(report: StopReport) -> list[tuple[Any, ...]]:
    """One row for each robot of a finished stop, the worst first."""
    worst = [_row(name, each) for name, each in sorted({**report.not_stopped, **report.refused}.items())]
    worst += [_silent(name, "NO ANSWER") for name in report.silent]
    slowest = sorted(report.stopped.items(), key=lambda each: -each[1].latency_ms)
    return [*worst, *(_row(*each) for each in slowest)]


def running_rows(progress: Progress) -> list[tuple[Any, ...]]:
    """One row for each robot of a stop under way."""
    told = [_row(*each) for each in sorted(progress.answered.items())]
    return [*(_silent(name, "unconfirmed") for name in progress.unconfirmed), *told]


def drawn(cells: list[tuple[Any, ...]], title: str) -> Table:
    """The table."""
    return table(title, COLUMNS, cells)


def _shown(screen: Screen, running: Running) -> StopReport:
    from rich.live import Live  # noqa: PLC0415 - Rich is loaded when something is shown

    # The report says by name what the log says.
    with kept_log(), Live(drawn([], "EMERGENCY STOP"), console=screen.out, auto_refresh=False) as live:
        while not running.finished(DRAW_S):
            if running.latest is not None:
                link = "" if running.latest.link_up else ": THE LINK IS DOWN"
                live.update(drawn(running_rows(running.latest), f"EMERGENCY STOP{link}"), refresh=True)
        report = running.wait()
        live.update(drawn(rows(report), "EMERGENCY STOP"), refresh=True)
    return report


def _row(name: str, answer: Answer) -> tuple[Any, ...]:
    slow = "bold red" if answer.latency_ms > SLOW_MS else ""
    word = label("stopped", slow or "green") if answer.stopped else label("DID NOT STOP", "bold red")
    if answer.stopped is None:
        word = label("NOBODY KNOWS", "bold red")
    return name, word, label(f"{answer.latency_ms:.1f}", slow), answer.why or _halted(answer.facts)


def _halted(facts: Mapping[str, Any]) -> str:
    halted = facts.get("halted")
    names = ", ".join(str(each) for each in halted) if isinstance(halted, list | tuple) else ""
    return f"halted {names}" if names else "locked; nothing was moving"


def _silent(name: str, word: str) -> tuple[Any, ...]:
    return name, label(word, "bold red"), "", ""
