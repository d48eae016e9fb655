"""``stop``: stop one robot, or all. ``estop``: stop and lock every robot."""

from __future__ import annotations

import shlex
import threading
from collections.abc import Mapping
from concurrent.futures import Future, wait
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.table import Table

from strands_robots.cli.command import OnMesh, Timeout, command
from strands_robots.cli.keys import PassphraseFile, operator_key, signing_key
from strands_robots.cli.network import SOURCE, Network, describe, near_devices
from strands_robots.cli.output import POLL_S, CliError, Exit, Screen, captured_log, label, plain, table
from strands_robots.cli.readiness import meeting_user
from strands_robots.envelope import Envelope, text_of
from strands_robots.safety.answers import Answer
from strands_robots.safety.controller import DEADLINE_S, Progress, SafetyController, StopReport
from strands_robots.safety.orders import new_epoch
from strands_robots.serving.robot_verbs import WORLD_VERBS
from strands_robots.serving.stop_arguments import stop_reason, stop_robot
from strands_robots.tools.networks import NativeMesh, stop_outcome
from strands_robots.utils import ValidationError, device_id, number

if TYPE_CHECKING:
    from strands_robots.device_connect.backends import LinkConfig

SLOW_MS = 100.0
"""An answer that took longer is shown in red."""

LATE_MS = 1000.0
"""A stop that left later than this after the press says so."""

LOCKED = "They are locked until they are resumed:"
LOCKED_THERE = "They are locked until they are resumed, at the machine of each robot:"
BY_KEY = "Or from here, once the robots know the key that this makes (docs/safety.md):"
UNKNOWN_KEY = "A robot that does not know that key is resumed at its own machine:"
RESUME_HERE = "strands-robots resume --local"
CLAIMED = "Claimed is not proven: no enrolled robot signed it. Enroll robots with strands-robots enroll."
LINK_WAIT_S = 2.0

LOOKUP_SHARE = 2 / 3
"""Part of the deadline in which robots are looked up; the rest is for their answers."""


def register(app: typer.Typer) -> None:
    """Add both commands to the application."""
    command(app, "stop", network=True)(stop)
    command(app, "estop", network=True)(estop)


def stop(
    screen: Screen,
    network: Network,
    *,
    device: Annotated[str | None, typer.Argument(help="The device's id.")] = None,
    everything: Annotated[bool, typer.Option("--all", help="Stop every device that answers.")] = False,
    one: Annotated[str, typer.Option("--robot", help="Stop this robot of DEVICE's world alone.")] = "",
    timeout: Timeout = 5.0,
    on_mesh: OnMesh = False,
) -> None:
    """Stop one robot, or all. Exits with 1 when one did not stop, with 3 when one is silent."""
    device, unread = stop_robot("DEVICE", None if everything else device)
    everything, device = not device, device or None
    name = WORLD_VERBS["stop"].readable({"robot_name": one})[0]["robot_name"] if device else ""
    if one and not name:
        unread = unread or "--robot names no robot of a DEVICE's world, so all of it is stopped"
    _say_ignored(screen, unread)
    if on_mesh:
        network.use_mesh()
        _report_mesh_stop(screen, NativeMesh().stop(device or "", name))
        return
    seconds = _seconds(screen, "--timeout", timeout, 60, 5.0)
    with network.fleet() as fleet:
        answers = fleet.stop_all(seconds) if device is None else {device: fleet.stop(device, seconds, name)}
        unknown = device is not None and stop_outcome(answers[device])[0] is None
        near = near_devices(fleet, device) if unknown and device is not None else ""
    if not answers:
        raise CliError(f"No robot that can be stopped answered. {describe(fleet.link)}", Exit.SILENT, devices={})
    # One robot of a world is named with it: the others may move on.
    outcomes = {f"{each}/{name}" if name else each: stop_outcome(answer) for each, answer in answers.items()}
    _show_outcomes(screen, outcomes)
    devices = {name: {"stopped": stopped, "said": said} for name, (stopped, said) in outcomes.items()}
    moving = [name for name, (stopped, _) in outcomes.items() if stopped is False]
    silent = [name for name, (stopped, _) in outcomes.items() if stopped is None]
    if moving:
        raise CliError(f"DID NOT STOP: {', '.join(moving)}.", Exit.REFUSED, devices=devices)
    if silent:
        raise CliError(f"It is unknown whether these stopped: {', '.join(silent)}.{near}", Exit.SILENT, devices=devices)
    if everything and fleet.stale:
        raise CliError(f"These stopped: {', '.join(outcomes)}. {fleet.stale}", Exit.SILENT, devices=devices)
    screen.data({"status": "success", "devices": devices})


def estop(
    screen: Screen,
    network: Network,
    *,
    devices: Annotated[
        list[str] | None,
        typer.Argument(metavar="DEVICE...", help="Those that must answer. Every robot of the tenant stops."),
    ] = None,
    everything: Annotated[
        bool, typer.Option("--all", help="Every robot that can be found must answer; the default.")
    ] = False,
    reason: Annotated[str, typer.Option("--reason", help="Sent to the robots and written to their audit.")] = "",
    source: Annotated[str, typer.Option("--as", help="The source that robots see.")] = SOURCE,
    deadline: Annotated[
        float, typer.Option("--deadline", help="Seconds until a robot without an answer counts as silent.")
    ] = DEADLINE_S,
    key: Annotated[
        Path | None, typer.Option("--key", help="Sign it; then only enrolled robots can confirm it.")
    ] = None,
    passphrase_file: PassphraseFile = None,
    on_mesh: OnMesh = False,
) -> None:
    """Stop every robot of the tenant and lock it. Exits with 1 when one did not stop, with 3 when one is silent.

    The tenant is the fleet that --tenant names, default without it. The id of the stop is the epoch of the lockout that
    it leaves; a resume names it.
    """
    reason, cut = stop_reason(reason)
    _say_ignored(screen, cut)
    if on_mesh:
        if devices:
            _say_ignored(screen, "estop --mesh stops every robot, and no DEVICE is waited for")
        network.use_mesh()
        on_key = None if key is None else signing_key(key, passphrase_file)
        _report_mesh_stop(screen, NativeMesh().emergency_stop(reason, on_key))
        show_resume(screen, key, f" --mesh{network.flags}")
        return
    # What is no device's id answers to nothing, so the report has it as silent.
    expected = [] if everything else list(devices or [])
    seconds = _seconds(screen, "--deadline", deadline, 600, DEADLINE_S)
    source = device_id("--as", source)
    link = network.link()
    signer = None if key is None else signing_key(key, passphrase_file)
    from strands_robots.device_connect.safety_controller import (  # noqa: PLC0415 - the network is loaded when it is used
        envelope,
        safety_controller,
    )

    controller = safety_controller(source, link, signing_key=signer, require_signed=signer is not None)
    try:
        running = RunningStop(controller, expected, reason, seconds, link)
        if screen.live:
            report = _watch(screen, running)
        else:
            report = running.report.result()
            screen.show(_table(report_rows(report)))
    finally:
        controller.close()
    answer = envelope(report)
    facts = _facts(answer)
    missed = running.missed()
    screen.say(f"{summary(report)}{missed}", "bold red" if missed else style_of(report))
    for name, why in report.alarms.items():
        screen.say(
            f"ALARM: {name}: {why}. Its own answer {'is missing' if name in report.alarmed else 'came, too'}.",
            "bold red",
        )
    if report.claimed:
        screen.say(CLAIMED, "yellow")
    code = exit_code(report)
    if code is not Exit.OK or missed:
        where = "" if report.link else f" {describe(link)}"
        said = text_of(answer) if code is Exit.OK else answer["reason"]
        raise CliError(plain(f"{said}{missed}{where}", 2000), Exit.SILENT if code is Exit.OK else code, **facts)
    screen.data({"status": "success", **facts})
    if link.loopback_only:
        user = meeting_user(link)
        screen.say(LOCKED)
        screen.copyable(f"  sudo -u {user} {RESUME_HERE}" if user else f"  {RESUME_HERE}")
    else:
        show_resume(screen, key, network.flags)


def _say_ignored(screen: Screen, note: str) -> None:
    """Say what of a stop's arguments is left out; none of them refuses it."""
    if note:
        screen.say(f"Ignored: {plain(note, 300)}.", "yellow")


def _seconds(screen: Screen, name: str, value: float, most: float, usual: float) -> float:
    try:
        return number(name, value, above=0, high=most)
    except ValidationError as unfit:
        _say_ignored(screen, f"{str(unfit).rstrip('.')}; it is {usual:g}")
        return usual


def show_resume(screen: Screen, key: Path | None, flags: str) -> None:
    """Print the command that frees robots of other machines.

    Args:
        screen: where.
        key: the key that signed the stop; it is not an operator's.
        flags: the network's.
    """
    held = next((each for each in (Path("operator.pem"), operator_key()) if each.is_file() and each != key), None)
    if held is not None:
        screen.say(LOCKED)
        screen.copyable(f"  strands-robots resume --key {shlex.quote(str(held.resolve()))}{flags}")
        screen.say(UNKNOWN_KEY)
        screen.copyable(f"  {RESUME_HERE}")
        return
    screen.say(LOCKED_THERE)
    screen.copyable(f"  {RESUME_HERE}")
    screen.say(BY_KEY)
    screen.copyable(f"  strands-robots keys resume {shlex.quote(str(operator_key()))}")


class RunningStop:
    """An emergency stop on a thread of its own, which never waits for drawing.

    Without ``expected``, every robot that can be found and stopped must answer. The connection on which they are looked
    up is made beside the stop's; they are looked up once the stop has begun.
    """

    def __init__(
        self, controller: SafetyController, expected: list[str], reason: str, deadline_s: float, link: LinkConfig
    ) -> None:
        self.latest: Progress | None = None
        self._controller, self._expected, self._reason = controller, expected, reason
        self._deadline_s, self._link = deadline_s, link
        self._id = new_epoch()
        controller.press(self._id)
        self._begun = threading.Event()
        self._looking = threading.Lock()
        self._missed = "" if expected else "no list of them in time"
        self.report: Future[StopReport] = Future()
        threading.Thread(target=self._run, name="estop", daemon=True).start()
        if not expected:
            threading.Thread(target=self._expect_all, name="estop lookup", daemon=True).start()

    def _run(self) -> None:
        try:
            # Nothing can leave before the link is up; then the milliseconds are the robots' and not the handshake's.
            self._controller.wait_link(LINK_WAIT_S)
            report = self._controller.stop(
                self._expected,
                self._reason,
                deadline_s=self._deadline_s,
                estop_id=self._id,
                on_progress=self._progress,
            )
        except BaseException as exc:  # noqa: BLE001 - raised again by the future
            self.report.set_exception(exc)
        else:
            self.report.set_result(report)
        finally:
            # A stop that ends before its first progress leaves no lookup waiting.
            self._begun.set()

    def missed(self) -> str:
        """Return the sentence that robots could not be looked up, or nothing."""
        with self._looking:
            return f" The robots that must answer could not be looked up: {self._missed}." if self._missed else ""

    def _progress(self, progress: Progress) -> None:
        self.latest = progress
        self._begun.set()

    def _expect_all(self) -> None:
        if not self._found():
            # A network that is not there yet is asked again once the stop has begun.
            self._begun.wait()
            if not self.report.done():
                self._found()

    def _found(self) -> bool:
        """Look up those that must answer; False when it failed, with the reason kept."""
        try:
            self._look_up()
        except Exception as exc:  # noqa: BLE001 - said with the report, which names those that answered
            with self._looking:
                self._missed = plain(str(exc).rstrip(".") or type(exc).__name__, 300)
            return False
        return True

    def _look_up(self) -> None:
        from strands_robots.device_connect import FleetClient  # noqa: PLC0415 - the network is loaded when it is used

        with FleetClient(self._link) as fleet:
            self._begun.wait()
            if self.report.done():
                return
            within = min(2.0, self._deadline_s * LOOKUP_SHARE)
            found = [peer.id for peer in fleet.peers(within, thorough=True) if peer.stop_verb]
            stale = fleet.stale
        answered = self.latest.answered if self.latest else {}
        # The report of a stop that this completes is read after what this says.
        with self._looking:
            if self._controller.expect(self._id, {*found, *answered}):
                self._missed = stale.rstrip(".")


def exit_code(report: StopReport) -> Exit:
    """Return 0 when all stopped, 1 when one did not, 3 when one has not answered."""
    if report.not_stopped or report.refused or report.alarmed:
        return Exit.REFUSED
    return Exit.OK if report.ok else Exit.SILENT


def style_of(report: StopReport) -> str:
    """Return green when every robot is still, yellow when some only by a claim."""
    if report.ok:
        return "green"
    only_claimed = not (report.not_stopped or report.refused or report.alarmed or report.silent)
    return "yellow" if report.claimed and only_claimed else "bold red"


def summary(report: StopReport) -> str:
    """Return the result in one line of counts."""
    parts = [f"{len(report.stopped)} stopped"]
    for robots, outcome in (
        (report.not_stopped, "DID NOT STOP"),
        (report.refused, "did not act on it"),
        (report.alarmed, "answered with a WRONG KEY"),
        (report.claimed, "claimed"),
        (report.silent, "silent"),
    ):
        parts += [f"{len(robots)} {outcome}"] if robots else []
    late = f" It left {report.left_ms / 1000:.1f} s after the press." if report.left_ms > LATE_MS else ""
    return f"{', '.join(parts)}, in {report.elapsed_ms:.0f} ms.{late} Emergency stop {report.estop_id}."


def report_rows(report: StopReport) -> list[tuple[Any, ...]]:
    """Return one row for each robot of a finished stop, the worst first."""
    left_ms = report.left_ms
    worst = [_row(name, each, left_ms) for name, each in sorted({**report.not_stopped, **report.refused}.items())]
    worst += [(*_silent_row(name, "WRONG KEY")[:3], report.alarms[name]) for name in report.alarmed]
    worst += [_silent_row(name, "NO ANSWER") for name in report.silent]
    worst += [_row(name, each, left_ms) for name, each in sorted(report.claimed.items())]
    slowest = sorted(report.stopped.items(), key=lambda each: -each[1].latency_ms)
    return [*worst, *(_row(*each, left_ms) for each in slowest)]


def progress_rows(progress: Progress) -> list[tuple[Any, ...]]:
    """Return one row for each robot of a stop in progress."""
    answered = [_row(*each, progress.left_ms) for each in sorted(progress.answered.items())]
    marks = {name: "WRONG KEY" if name in progress.alarms else "unconfirmed" for name in progress.unconfirmed}
    return [*(_silent_row(name, mark) for name, mark in marks.items() if name not in progress.answered), *answered]


def _table(rows: list[tuple[Any, ...]], title: str = "") -> Table:
    return table(title, ("robot", "answer", "ms", "what it said"), rows)


def _watch(screen: Screen, running: RunningStop) -> StopReport:
    """Draw the answers as they come, and return the report."""
    from rich.live import Live  # noqa: PLC0415 - loaded when a screen is redrawn

    # The table already names what the log would report.
    with captured_log(), Live(_table([], "EMERGENCY STOP"), console=screen.out, auto_refresh=False) as live:
        while not wait([running.report], POLL_S).done:
            if running.latest is not None:
                live.update(_table(progress_rows(running.latest), _title(running.latest)), refresh=True)
        report = running.report.result()
        live.update(_table(report_rows(report), "EMERGENCY STOP"), refresh=True)
    return report


def _title(progress: Progress) -> str:
    age = f", pressed {progress.elapsed_ms / 1000:.1f} s ago" if progress.elapsed_ms > LATE_MS else ""
    return f"EMERGENCY STOP{age}" + ("" if progress.link_up else ": THE LINK IS DOWN")


def _row(name: str, answer: Answer, left_ms: float) -> tuple[Any, ...]:
    # Connecting takes this command some tenths of a second; the table shows the robots' time, the summary the rest.
    took_ms = answer.latency_ms - (left_ms if left_ms <= LATE_MS else 0.0)
    slow = "bold red" if took_ms > SLOW_MS else ""
    still = "stopped, settling" if answer.facts.get("settling") is True else "stopped"
    mark = label(still, slow or "green") if answer.stopped else label("DID NOT STOP", "bold red")
    if answer.stopped is None:
        mark = label("UNKNOWN", "bold red")
    said = answer.why or _halted(answer.facts)
    if answer.claimed and answer.stopped:
        mark, said = label("claimed", "yellow"), f"not signed by {name}; {said}"
    if answer.delay_s is not None and answer.delay_s * 1000 > LATE_MS:
        said = f"{said}; it arrived {answer.delay_s:.1f} s after the press"
    return name, mark, label(f"{took_ms:.1f}", slow), said


def _silent_row(name: str, mark: str) -> tuple[Any, ...]:
    return name, label(mark, "bold red"), "", ""


def _halted(facts: Mapping[str, Any]) -> str:
    halted = facts.get("halted")
    names = ", ".join(str(each) for each in halted) if isinstance(halted, list | tuple) else ""
    return f"halted {names}" if names else "locked; nothing was moving"


def _show_outcomes(screen: Screen, outcomes: Mapping[str, tuple[bool | None, str]]) -> None:
    marks = {
        True: label("stopped", "green"),
        False: label("DID NOT STOP", "bold red"),
        None: label("NO ANSWER", "bold red"),
    }
    rows = ((name, marks[stopped], said) for name, (stopped, said) in outcomes.items())
    screen.show(table("", ("robot", "answer", "what it said"), rows))


def _report_mesh_stop(screen: Screen, answer: Envelope) -> None:
    """Print the mesh's answers; raise :class:`CliError` unless all confirmed."""
    moving, silent = answer.get("not_stopped", []), answer.get("silent", [])

    def outcome(name: str) -> bool | None:
        return False if name in moving else None if name in silent else True

    _show_outcomes(screen, {name: (outcome(name), text) for name, text in answer.get("robots", {}).items()})
    facts = _facts(answer)
    if answer["status"] != "success":
        raise CliError(plain(text_of(answer), 2000), Exit.REFUSED if moving else Exit.SILENT, **facts)
    screen.data({"status": "success", **facts})
    screen.say(text_of(answer), "green")


def _facts(answer: Envelope) -> dict[str, Any]:
    return {name: value for name, value in answer.items() if name not in ("status", "content", "reason")}
