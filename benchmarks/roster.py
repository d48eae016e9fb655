"""Robots that were away during a stop: named, locked when they are back, and none locked that need not be.

``ROSTER_NETWORKS`` and ``ROSTER_PARTS``, with commas, choose from the rows, such as ``nats,mesh`` and ``away,crowd``.
The planes of the crowd share processes: 400 processes of their own would take 22 GB.
"""

from __future__ import annotations

import contextlib
import os
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

from fixtures.network_lab import missing
from fixtures.roster_crowd import crowd
from fixtures.roster_lab import KINDS, Kind, RosterLab
from fixtures.roster_returns import CASES, Returning, cases_on
from fixtures.roster_trials import ABSENCES, Absence, Trial, stop_while_away
from fixtures.stop_controller import controller
from fixtures.waiting import eventually

from benchmarks.table import Row

ROBOTS, ROUNDS, ROUNDS_QUICK = 5, 20, 1
"""Robots that are away at once, and how often."""

RETURNS, RETURNS_QUICK = 100, 1
CROWD, CROWD_QUICK, EACH = 400, 40, 25
BACK = (1, 100)
NAMES, NAMES_QUICK = 10_000, 2_000
ANSWERS_MAX = 6
MORE_MB = 5.0
LOCKED_S = 20.0
ASKED_S = 4.0


def run(quick: bool = False) -> list[Row]:
    """Measure and give the rows of the table; some hours, or a quarter of one with ``quick``."""
    networks = os.environ.get("ROSTER_NETWORKS", ",".join(KINDS)).split(",")
    parts = os.environ.get("ROSTER_PARTS", ",".join(PARTS)).split(",")
    return [row for kind in KINDS if kind in networks for part in parts for row in PARTS[part](kind, quick)]


@contextlib.contextmanager
def _lab(kind: Kind, *, cuttable: bool = False) -> Iterator[RosterLab]:
    with tempfile.TemporaryDirectory(prefix="roster-") as folder, ExitStack() as stack:
        Path(folder).chmod(0o700)
        yield RosterLab(kind, Path(folder), stack, cuttable=cuttable)


def _row(kind: Kind, what: str, ours: str, must: str, *, ok: bool) -> Row:
    return Row(f"{kind}: {what}", ours, "", None, must, ok)


def _away(kind: Kind, quick: bool) -> Iterator[Row]:
    for absence in ABSENCES:
        cut = not absence.startswith("frozen")
        if cut and kind == "zenoh d2d" and (why := missing()):
            yield _row(kind, f"{absence} during a one-shot stop", f"not measured: {why}", "", ok=False)
            continue
        trials = _trials(kind, absence, ROUNDS_QUICK if quick else ROUNDS, cut=cut)
        count = len(trials)
        locked = sorted(each.locked_s for each in trials if each.locked_s >= 0)
        worst = f"{locked[-1]:.2f} s at most" if locked else "never"
        yield _row(
            kind,
            f"{count} robots {absence} during a one-shot stop",
            f"{sum(each.told for each in trials)} named with exit code 3 or stopped; {len(locked)} locked, {worst}; "
            f"{sum(each.between > 1 or each.after > 0 for each in trials)} moved on",
            "all named; locked within 1 s; none moves on",
            ok=all(each.ok for each in trials),
        )


def _trials(kind: Kind, absence: Absence, rounds: int, *, cut: bool) -> list[Trial]:
    names = [f"arm-{number}" for number in range(1, ROBOTS + 1)]
    with _lab(kind, cuttable=cut) as lab:
        witness = lab.robots("arm-0", first=True)
        away = [lab.robots(name, cut=True) for name in names]
        console = lab.console()
        lab.meet(console, "arm-0", *names)
        return [each for _ in range(rounds) for each in stop_while_away(lab, console, witness, away, absence)]


def _returns(kind: Kind, quick: bool) -> Iterator[Row]:
    with _lab(kind) as lab:
        names = cases_on(lab)
    for name in names:
        wrong = Counter(_returned(kind, name) for _ in range(RETURNS_QUICK if quick else RETURNS))
        good, count = wrong.pop("", 0), wrong.total()
        said = "".join(f"; {each}: {text}" for text, each in wrong.most_common(3))
        what = name.replace("_", " ")
        yield _row(kind, what, f"{good} of {good + count}{said}", "all", ok=not count)


def _returned(kind: Kind, name: str) -> str:
    with _lab(kind) as lab:
        return CASES[name](Returning(lab))


def _crowd(kind: Kind, quick: bool) -> Iterator[Row]:
    if kind in ("mesh", "zenoh d2d"):
        # Peers link to each of the others: 400 of them have 80,000 links.
        return
    count = CROWD_QUICK if quick else CROWD
    with _lab(kind) as lab:
        link, state = lab.link(), lab.state("crowd")
        assert link is not None
        crowds = [lab.stack.enter_context(crowd(link, first, EACH, state)) for first in range(0, count, EACH)]
        back = lab.stack.enter_context(crowd(link, count, max(BACK), state))
        for each in (*crowds, back):
            eventually(partial(each.ask, "ready"), 120)
        back.ask("leave")
        stranger, hand = lab.stranger(), lab.stack.enter_context(controller(link))
        assert hand.ask("up")
        for number in BACK:
            for each in crowds:
                each.ask("clear")
            stopped = hand.ask("stop", [f"arm-{each}" for each in range(count // EACH * EACH)], 60.0)
            time.sleep(1.0)
            stranger.ask("clear")
            back.ask("join", number)
            with contextlib.suppress(AssertionError):
                eventually(lambda: back.ask("locked_by", stopped["estop_id"]) == number, LOCKED_S)  # noqa: B023
            time.sleep(ASKED_S)
            locked = back.ask("locked_by", stopped["estop_id"])
            questions = {each["nonce"]: 0 for each in stranger.ask("questions")}
            answers = stranger.ask("answers")
            most = max(Counter(each["nonce"] for each in answers).values(), default=0)
            back.ask("leave")
            yield _row(
                kind,
                f"{count} robots locked, {number} back at once",
                f"{locked} locked; {len(questions)} questions, {len(answers)} answers, {most} to one at most",
                f"all locked; ≤ {ANSWERS_MAX} answers to each question",
                ok=locked == number and most <= ANSWERS_MAX,
            )


def _names(kind: Kind, quick: bool) -> Iterator[Row]:
    """Made-up names, and a stranger's stops, beside an enrolled robot that is dead."""
    count = NAMES_QUICK if quick else NAMES
    with _lab(kind) as lab:
        witness, dead = lab.robots("arm-0", first=True), lab.robots("arm-1")
        console = lab.console()
        eventually(lambda: console.run("enroll", "arm-0", "arm-1", *lab.flags).returncode == 0, 60)
        dead.kill()
        stranger = lab.stranger()
        before = witness.ask("memory_mb")
        stranger.ask("names", count)
        stranger.ask("keep_announcing", count, 8.0)
        code, said = console.json("estop", "--deadline", "2", *lab.flags)
        stranger.ask("stop", 500, 100)
        time.sleep(2.0)
        stranger.ask("clear")
        stranger.ask("ask")
        time.sleep(2.0)
        kept: list[dict[str, Any]] = stranger.ask("answers")
        more = witness.ask("memory_mb") - before
    told = max((each["stops"] for each in kept), default=0)
    yield _row(
        kind,
        f"{count} made-up names and 500 stops of a stranger",
        f"exit code {code}, arm-1 {'named' if 'arm-1' in str(said) else 'LOST'}; {told} stops told; {more:+.1f} MB",
        "3 and named; ≤ 64 stops; + 5 MB at most",
        ok=code == 3 and "arm-1" in str(said) and told <= 64 and more <= MORE_MB,
    )


PARTS: Mapping[str, Callable[[Kind, bool], Iterator[Row]]] = {
    "away": _away,
    "returns": _returns,
    "crowd": _crowd,
    "names": _names,
}
