"""Robots that must answer one stop: remembered, named, found and reported."""

from __future__ import annotations

import threading
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

from strands_robots.audit import queue_safety_event
from strands_robots.safety.answers import Answer, Progress, StopReport
from strands_robots.safety.identity import key_here, local_name
from strands_robots.safety.network_key import DEVICE_CONNECT, NetworkKey
from strands_robots.safety.roster import Roster, RosterReport, Sending, reason_of
from strands_robots.safety.scope import EVERY_ROBOT, Remembers, Scope
from strands_robots.safety.sightings import Known, RosterRow, sightings
from strands_robots.safety.statements import Proof, Purpose, proof_of
from strands_robots.state_files import uptime
from strands_robots.stop_log import stop_logger
from strands_robots.utils import plain_text

logger = stop_logger(__name__)

OTHERS_AWAITED = 64
"""Names that do not alter the exit code, and for whose answer a stop goes on all the same."""

TRUSTED_MAX, UNPROVEN_MAX = 64, 16
"""Controllers whose reports are kept, with a signature that counts and without one."""

NAMED_MAX = 64
"""Robots of each kind that the audit names; the others are counted."""

READ_WITHIN_S = 0.5
"""Seconds that the end of a stop waits for a roster that is still being read."""

REMEMBERED_MAX = 512
"""Answers to one stop that are remembered."""

ENROLL = "strands-robots enroll"


@dataclass(frozen=True, slots=True)
class StopOutcome:
    """Outcome of a stop, measured by the roster.

    Attributes:
        report: of the robots that count.
        others: of the names that do not.
        roster: all rows: remembered, reported, named, found, and those that only answered.
        no_stop: devices that have no stop.
        unproven: robots that controllers without a known signature say they miss, and who says so.
        reasons: of silent robots, and of those that are not locked.
        problems: why the roster may lack robots; with one of them no exit code is 0.
        unsigned: the answers are those to a plain stop, which no robot signs on Device Connect.
        not_locked: devices that did not act on the emergency stop, and got a plain stop.
    """

    report: StopReport
    others: StopReport
    roster: Roster
    no_stop: tuple[str, ...] = ()
    unproven: Mapping[str, str] = field(default_factory=dict)
    reasons: Mapping[str, str] = field(default_factory=dict)
    problems: tuple[str, ...] = ()
    sending: Sending = field(default_factory=Sending)
    unsigned: bool = False
    not_locked: tuple[str, ...] = ()

    @property
    def ok(self) -> bool:
        """True when every robot of the roster is known to stand still.

        Where the answers are ``unsigned``, each one said so.
        """
        return self.report.ok and not self.problems

    @property
    def size(self) -> int:
        """Number of robots that had to answer."""
        return len(self.report.answered.keys() | {*self.report.silent, *self.report.alarms})

    @property
    def sentence(self) -> str:
        """The number of robots that stand still, known or said, in a sentence."""
        still, size = len(self.report.stopped), self.size
        some = not (self.report.scope.everything or self.report.widened)
        which = "that this stop was for" if some else "of the roster"
        if not size:
            return "The roster has no robot."
        if self.unsigned:
            many = f"The one robot {which} said that it stands" if size == still == 1 else ""
            many = many or f"{still} of the {size} robots {which} said that they stand"
            return f"{many} still; answers to a plain stop are not signed."
        if size == 1:
            return f"The one robot {which} is {'' if still else 'not '}known to stand still."
        if still == size:
            return f"All {size} robots {which} are known to stand still."
        return f"{still} of the {size} robots {which} {'is' if still == 1 else 'are'} known to stand still."

    @property
    def worth(self) -> str:
        """The limit of that sentence where no robot is enrolled, else ""."""
        if self.roster.enrolled:
            return ""
        return f"No robot is enrolled here, so one that was not heard for ten minutes is not missed: {ENROLL}"

    def facts(self) -> dict[str, Any]:
        """Return what a script reads besides the report's own fields."""
        return {
            "roster": {"size": self.size, "still": len(self.report.stopped), "enrolled": self.roster.enrolled},
            "reasons": dict(list(self.reasons.items())[:NAMED_MAX]),
            "retired": [row.name for row in self.roster.exempt if row.exemption and row.exemption.state == "retired"],
            "off": [row.name for row in self.roster.exempt if row.exemption and row.exemption.state == "off"],
            "elsewhere": self.roster.elsewhere,
            "no_stop": list(self.no_stop[:NAMED_MAX]),
            "others": _others(self),
            "problems": list(self.problems),
            **({"unsigned": True} if self.unsigned else {}),
        }

    def record(self, controller: str) -> None:
        """Write the outcome into this console's own audit; one bounded record a stop."""
        report = self.report
        moving = {**report.not_stopped, **report.refused}
        queue_safety_event(
            "estop_outcome" if report.estop_id else "stop_outcome",
            controller,
            {
                **({"estop_id": report.estop_id} if report.estop_id else {}),
                "roster": self.size,
                "stopped": len(report.stopped),
                "not_stopped": {name: moving[name].why[:200] for name in sorted(moving)[:NAMED_MAX]},
                "claimed": sorted(report.claimed)[:NAMED_MAX],
                "silent": {name: self.reasons.get(name, "") for name in report.silent[:NAMED_MAX]},
                "silent_in_all": len(report.silent),
                "others": {name: count for name, count in _others(self).items() if name != "names"},
                "retired_or_off": [row.name for row in self.roster.exempt][:NAMED_MAX],
                "denied": self.sending.denied,
                "problems": list(self.problems),
                "ok": self.ok,
                **report.scope.field(),
                **({"widened": True} if report.widened else {}),
            },
        )


class StopRoster:
    """Robots that must answer one stop; every method may be called from any thread.

    Args:
        network: of the stop.
        named: robots that the caller says must answer, besides the roster.
        scope: the robots that the stop is for. Those that stop all the same must answer as well.
    """

    def __init__(self, network: NetworkKey, named: Collection[str] = (), scope: Scope = EVERY_ROBOT) -> None:
        self._network, self._pressed = network, uptime()
        self._lock, self._is_read = threading.Lock(), threading.Event()
        self._named, self._asked, self.scope = frozenset(named) | scope.only, scope, scope
        self._roster = Roster(network, problems=("the roster was not read in time",))
        self._keys: dict[str, bytes | None] = {}
        self._divided: dict[str, str] = {}
        self._found: dict[str, bool] = {}
        self._cells: dict[str, str | None] = {}
        self._trusted: dict[str, RosterReport] = {}
        self._unproven: dict[str, RosterReport] = {}

    def read(self) -> None:
        """Read the roster from the disk; call it once the stop has left, off its thread."""
        try:
            roster = Roster.of(self._network, self._pressed)
        except Exception as exc:  # noqa: BLE001 - a roster that cannot be read is said, and the stop goes on
            roster = Roster(self._network, problems=(f"the roster cannot be read: {exc}",))
        with self._lock:
            self._roster = roster
        self._is_read.set()

    def find(self, devices: Mapping[str, bool], cells: Mapping[str, str | None] | None = None) -> None:
        """Take devices that were found since the press, and whether each has a stop.

        Args:
            cells: of each; None for one that states none, and reads no scope.
        """
        with self._lock:
            self._found |= devices
            self._cells |= cells or {}

    def widen(self) -> None:
        """Have every robot answer: the stop has become one of all."""
        with self._lock:
            self.scope = EVERY_ROBOT

    def take(self, report: RosterReport) -> bool:
        """Take a controller's report in place of its last; False where nothing changed."""
        with self._lock:
            kept, most = (self._trusted, TRUSTED_MAX) if report.trusted else (self._unproven, UNPROVEN_MAX)
            if kept.get(report.source) == report or (report.source not in kept and len(kept) >= most):
                return False
            kept[report.source] = report
        return True

    def incomplete(self, answered: Mapping[str, Answer] | None = None) -> bool:
        """Return True while robots are missing that no name stands for.

        A controller misses more than it has named, or one of several processes of a name gives no answer.
        """
        answers = answered or {}
        with self._lock:
            twice = [row for row in self._roster.rows if len(row.processes) > 1 and row.name in answers]
            more = any(each.more for each in self._trusted.values())
        return more or any(self._unanswered(row, answers[row.name]) for row in twice)

    @property
    def divided(self) -> bool:
        """True where several processes serve a robot, so that each answer counts."""
        with self._lock:
            return any(len(row.processes) > 1 for row in self._roster.rows)

    def awaited(self, answered: Mapping[str, Answer] | None = None) -> frozenset[str]:
        """Return the robots for whose answer the stop goes on.

        Args:
            answered: what came so far.
        """
        answers = answered or {}
        with self._lock:
            roster = self._whole(answers.items())
            heard = {name for name, stops in self._found.items() if stops} | answers.keys()
            others = [row.name for row in roster.rows if row.name in heard and not roster.counts(row)]
            return frozenset((*(row.name for row in roster.must_answer), *others[:OTHERS_AWAITED]))

    def wait_until_read(self) -> bool:
        """Wait at most :data:`READ_WITHIN_S` for the disk; False where it hangs."""
        return self._is_read.wait(READ_WITHIN_S)

    def outcome(self, report: StopReport, sending: Sending | None = None, problem: str = "") -> StopOutcome:
        """Measure the report of the stop.

        Args:
            report: with every answer.
            sending: how the stop was sent.
            problem: why robots may be missing that were to be found.
        """
        sending = sending or Sending(report.link)
        if report.widened:
            self.widen()
        report = replace(report, scope=self._asked, widened=self.scope != self._asked)
        # The stop is over; a disk that hangs is given this long.
        self.wait_until_read()
        with self._lock:
            roster, found = self._whole(report.answered.items()), dict(self._found)
            unproven = _missed_by(self._unproven, roster)
            problems = [*roster.problems, *([problem] if problem else [])]
            problems += [report.widening] if report.widening else []
            problems += [
                f"{each.source} misses {each.more} more robots than it names"
                for each in self._trusted.values()
                if each.more
            ]
        problems += self._unsure(roster, report)
        rows = {row.name: row for row in roster.rows}
        report, divided = self._proven(report, rows)
        must = {row.name for row in roster.must_answer} | report.alarms.keys()
        no_stop = tuple(row.name for row in roster.rows if row.stoppable is False and row.name not in must)
        told = {*rows} - must - {*no_stop}
        counted, others = _part(report, must), _part(report, told)
        elsewhere = self._elsewhere({*counted.silent})
        reasons = {
            name: reason_of(rows[name], sending, found=name in found, elsewhere=elsewhere)
            for name in counted.silent
            if name in rows
        } | {name: why for name, why in divided.items() if name in counted.silent}
        return StopOutcome(counted, others, roster, no_stop, unproven, reasons, tuple(problems), sending)

    def _unsure(self, roster: Roster, report: StopReport) -> list[str]:
        """Return a sentence on robots of this machine that may be on this network."""
        answered = report.answered
        unsure = sorted(
            name
            for name, each in roster.perhaps_here.items()
            if (name not in answered or self._unanswered(each, answered[name]))
            and self.scope.covers(name, {each.cell} - {""})
        )
        if not unsure:
            return []
        more = f" and {len(unsure) - NAMED_MAX} more" if len(unsure) > NAMED_MAX else ""
        return [
            f"{', '.join(unsure[:NAMED_MAX])}{more}: served by this machine under another address, which may be of this"
            " network, and gave no answer"
        ]

    def _proven(self, report: StopReport, rows: Mapping[str, RosterRow]) -> tuple[StopReport, dict[str, str]]:
        """Return the report without what proves nothing of robots that are served here.

        Their keys lie on this machine, whether or not they are enrolled, so an unsigned answer is a claim. Where a
        process gave no answer the robot is silent, and the second part of the result says why.
        """
        stopped, claimed, why = dict(report.stopped), dict(report.claimed), dict[str, str]()
        for name, answer in report.stopped.items():
            row = rows.get(name)
            if row is None or not row.processes:
                continue
            missing = self._unanswered(row, answer)
            if not self._proven_runs(name, answer):
                claimed[name] = replace(stopped.pop(name), required=True)
            elif missing or (name in self._divided and not answer.facts):
                del stopped[name]
                # The answer to a plain stop, after the emergency stop, does not say which process gave it.
                why[name] = self._divided.get(name) or _divided(missing, len(row.processes))
        self._divided = why
        return replace(report, stopped=stopped, claimed=claimed), why

    def _unanswered(self, row: RosterRow, answer: Answer) -> list[int]:
        """Return the processes of a robot that gave no answer of their own."""
        runs = self._proven_runs(row.name, answer)
        # An earlier release states no process: its answer is that of the only one.
        if "" in runs and len(row.processes) == 1:
            return []
        return [pid for run, pid in row.processes if run not in runs]

    def _proven_runs(self, name: str, answer: Answer) -> frozenset[str]:
        """Return the run ids in answers that the robot's key signed; "" for none."""
        if self._network.kind != DEVICE_CONNECT or not answer.facts:
            return frozenset(answer.runs or ("",))
        if name not in self._keys:
            self._keys[name] = key_here(local_name(self._network.tenant, name))
        key, runs = self._keys[name], answer.runs or {"": answer}
        return frozenset(
            run
            for run, each in runs.items()
            if key is None or proof_of(Purpose.STOP_VERDICT, name, each.facts, key) is Proof.SIGNED
        )

    def _whole(self, answered: Collection[tuple[str, Answer]]) -> Roster:
        """Return the roster with all that was named, found, reported and answered since."""
        roster = self._roster = self._roster.with_answers(self._proofs(answered))
        for each in self._trusted.values():
            roster = roster.with_reported(each.rows, each.source)
        rows = {row.name: row for row in roster.rows}
        marked = {row.name: row for row in roster.exempt}
        for name, stops in self._found.items():
            row = rows.get(name)
            if row is None:
                # What is retired or off and only heard under its name stays so; its signed answer counts.
                rows |= {} if name in marked else {name: RosterRow(name, Known.HEARD, stoppable=stops)}
            elif row.stoppable is None:
                rows[name] = replace(row, stoppable=stops)
        for name, answer in answered:
            if name not in rows and (name not in marked or answer.enrolled):
                rows[name] = RosterRow(name, Known.ENROLLED if answer.enrolled else Known.HEARD, stoppable=True)
            elif name in rows and rows[name].stoppable is False:
                rows[name] = replace(rows[name], stoppable=True)
        for name in self._named:
            # As surely as if it were enrolled: the caller says so.
            row = rows.get(name, RosterRow(name, Known.ENROLLED, named=True))
            rows[name] = replace(row, known=Known.ENROLLED, stoppable=True)
        kept = tuple(row for name, row in marked.items() if name not in rows)
        inside = self._named | dict(answered).keys()
        return replace(
            roster, rows=tuple(row for row in rows.values() if row.name in inside or self._covers(row)), exempt=kept
        )

    def _proofs(self, answered: Collection[tuple[str, Answer]]) -> dict[str, Collection[str]]:
        """Return the robots whose key, known here, signed an answer, and their run ids."""
        served, on_mesh = self._roster.served_elsewhere, self._network.kind != DEVICE_CONNECT
        proofs: dict[str, Collection[str]] = {}
        for name, answer in answered:
            runs = self._proven_runs(name, answer) if name in served and answer.facts else ()
            # On the mesh what is not proven of an enrolled robot is claimed.
            if not answer.claimed and (runs or answer.enrolled or on_mesh):
                proofs[name] = runs
        return proofs

    def _covers(self, row: RosterRow) -> bool:
        """Return False for a robot of another cell."""
        return row.within(self.scope, self._cells.get(row.name, row.last_cell))

    def _elsewhere(self, silent: Collection[str]) -> dict[str, tuple[NetworkKey, float]]:
        """Return where else robots of these names were heard last, and seconds since."""
        if not silent:
            return {}
        heard: dict[str, tuple[NetworkKey, float]] = {}
        for each in sightings().read()[0]:
            if each.name in silent and not each.network.meets(self._network):
                last = heard.get(each.name)
                if last is None or each.age_s < last[1]:
                    heard[each.name] = each.network, each.age_s
        return heard

    def remember(self, report: StopReport) -> None:
        """Have this machine remember who answered; returns at once."""
        store = sightings()
        for name, answer in list(report.answered.items())[:REMEMBERED_MAX]:
            store.note_answer(
                self._network, name, Purpose.STOP_VERDICT, dict(answer.facts), {"estop_id": report.estop_id}
            )


def robots_known_at(network: Callable[[], NetworkKey]) -> Remembers:
    """Return what says whether this machine's roster has a robot that a scope means.

    A name that was only heard counts no more than for the exit code.
    """

    def remembers(scope: Scope) -> bool:
        roster = Roster.of(network())
        return any(scope.names(row.name, row.last_cell) for row in roster.must_answer)

    return remembers


def _divided(missing: Sequence[int], processes: int) -> str:
    """Return why a robot counts as silent although one of its processes answered."""
    pids = ", ".join(map(str, missing))
    if len(missing) == processes > 1:
        return f"the processes {pids} of this machine serve it, and its answer does not tell which of them stopped"
    which = f"its process {pids} gives" if len(missing) == 1 else f"its processes {pids} give"
    return f"{which} no answer; another process of that name did"


def _part(report: StopReport, names: Collection[str]) -> StopReport:
    """Return the part of a report about these robots, silent ones included."""

    def of(answers: Mapping[str, Answer]) -> dict[str, Answer]:
        return {name: each for name, each in answers.items() if name in names}

    alarms = {name: why for name, why in report.alarms.items() if name in names}
    silent = tuple(sorted({*names} - report.answered.keys() - alarms.keys()))
    return replace(
        report,
        stopped=of(report.stopped),
        not_stopped=of(report.not_stopped),
        refused=of(report.refused),
        claimed=of(report.claimed),
        silent=silent,
        alarms=alarms,
    )


def _missed_by(reports: Mapping[str, RosterReport], roster: Roster) -> dict[str, str]:
    """Return unknown names of unproven reports, and the reporter of each."""
    known = {row.name for row in (*roster.rows, *roster.exempt)}
    return {row.name: each.source for each in reports.values() for row in each.rows if row.name not in known}


def _others(outcome: StopOutcome) -> dict[str, Any]:
    """Return the count of names that do not alter the exit code, and a few of them."""
    others = outcome.others
    moving = sorted({**others.not_stopped, **others.refused})
    names = [*moving, *others.silent, *sorted(others.claimed), *sorted(others.stopped)]
    return {
        "count": len(names),
        "stopped": len(others.stopped),
        "not_stopped": len(moving),
        "silent": len(others.silent),
        "claimed": len(others.claimed),
        "unproven": len(outcome.unproven),
        "names": names[:NAMED_MAX],
    }


@dataclass(frozen=True, slots=True)
class FoundDevices:
    """Devices in reach, each with its cell and whether it has a stop.

    The cell is None where it states none. ``problem`` says why there may be more; empty where there are none.
    """

    devices: Mapping[str, tuple[bool, str | None]]
    problem: str = ""


LookUp = Callable[[], FoundDevices]


class Expecting(Protocol):
    """A controller that is told who must answer."""

    def expect(self, estop_id: str, names: Collection[str], *, more: bool = False) -> bool:
        """Name further robots that must answer."""


class RosterSearch:
    """Names the robots of the roster as those that must answer.

    Args:
        controller: that sends the stop.
        estop_id: of the stop.
        network: whose roster it is.
        look_up: finds devices, on a thread of its own; the stop goes on until then.
        scope: the robots that the stop is for.
        named: robots that must answer besides the roster.
    """

    def __init__(
        self,
        controller: Expecting,
        estop_id: str,
        network: NetworkKey,
        look_up: LookUp | None = None,
        scope: Scope = EVERY_ROBOT,
        *,
        named: Collection[str] = (),
    ) -> None:
        self.roster, self.begun = StopRoster(network, named, scope), False
        self.estop_id, self.scope = estop_id, scope
        self._controller, self._look_up = controller, look_up
        self._answered: Mapping[str, Answer] = {}
        self._lock = threading.Lock()
        self._left = 1 if look_up is None else 2
        self._problem = "" if look_up is None else "no list of them in time"

    @property
    def problem(self) -> str:
        """Reason why robots may be missing that were to be found."""
        with self._lock:
            return self._problem

    def begin(self, progress: Progress) -> None:
        """Take the answers so far; start the search at the first call."""
        self._answered = progress.answered
        widened = progress.widened and not self.roster.scope.everything
        if widened:
            self.roster.widen()
        if widened or self.roster.divided:
            self._expect(0)
        self.start()

    def start(self) -> None:
        """Start the search; a second call does nothing."""
        if not self.begun:
            self.begun = True
            threading.Thread(target=self._read, name="stop roster", daemon=True).start()
            if self._look_up is not None:
                threading.Thread(target=self._find, args=(self._look_up,), name="stop lookup", daemon=True).start()

    def take(self, report: RosterReport) -> None:
        """Take the robots that another standing controller misses."""
        if self.roster.take(report):
            self._expect(0)

    def _read(self) -> None:
        self.roster.read()
        self._expect(1)

    def _find(self, look_up: LookUp) -> None:
        try:
            found = look_up()
        except BaseException as exc:  # noqa: BLE001 - said with the report; the stop goes on to its deadline
            logger.warning("The search for robots failed: %s", exc)
            self.failed(exc)
            return
        self.roster.find(
            {name: stops for name, (stops, _) in found.devices.items()},
            {name: cell for name, (_, cell) in found.devices.items()},
        )
        self._expect(1, found.problem.rstrip("."))

    def complete(self, found: FoundDevices) -> None:
        """Note that these are all devices in reach, also where the stop is over."""
        with self._lock:
            self._problem = found.problem.rstrip(".")

    def failed(self, exc: BaseException) -> None:
        """Note why devices in reach could not be looked up."""
        with self._lock:
            self._problem = plain_text(str(exc), 300).rstrip(".") or type(exc).__name__

    def _expect(self, done: int, problem: str | None = None) -> None:
        # The report of a stop that this completes is read after what this says.
        with self._lock:
            self._left -= done
            more = self._left > 0 or self.roster.incomplete(self._answered)
            goes_on = self._controller.expect(self.estop_id, self.roster.awaited(self._answered), more=more)
            if goes_on and problem is not None:
                self._problem = problem
