"""Silver: a halt halts, and nothing is written after its verdict."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from itertools import pairwise

from strands_robots.envelope import text_of
from strands_robots.errors import RefusalError
from strands_robots.fleet.verdicts import FleetVerdict
from strands_robots.safety.stopping import StopVerdict
from strands_robots.testing.bench import (
    PEER,
    ConformanceBench,
    NotKeptError,
    NotProvenError,
    check_stopped,
    put,
    runs,
    wait_for,
    within,
)
from strands_robots.testing.promise import promise
from strands_robots.testing.raised import CABLE_OUT
from strands_robots.testing.subject import LongMotion

WHILE_LOCKED = frozenset({"releaseTorque"})
"""Motions that a locked robot does not refuse: they let go of its motors."""

HUNDRED, IN_MOTION = 100, 4
PARALLEL = 3


@promise(
    "silver.halts",
    "A halt in mid-motion says stopped, within the deadline, and no write follows.",
    why="It is the one promise for which everything else is here.",
    look="halt() or stop_task(): return when the last write is made; a verb: look at permit.valid before each write",
    needs_recorder=True,
)
def halts(bench: ConformanceBench) -> str:
    """Halt a motion once."""
    with bench.moving() as run:
        _check_seen_moving(bench, run.motion.verb)
        verdict = bench.halt()
        bench.check_still(verdict, bench.writes, "halt")
    return f"{verdict.elapsed_ms:.1f} ms"


BEGUN_S = 0.05
"""What is written once when a motion begins is written by then."""

SEEN_S = 1.0


def _check_seen_moving(bench: ConformanceBench, verb: str) -> None:
    """Check that it is seen to move: else what is seen after it proves nothing.

    Raises:
        NotProvenError: it runs unseen.
    """
    recorder, moving = bench.subject.recorder, bench.subject.moving
    if recorder is None:
        return
    if moving is not None:
        unseen = f"{verb} runs, and Subject(moving=...) was False for {SEEN_S:g} s: it has to be True while it moves"
        until = time.monotonic() + SEEN_S
        while not moving():
            if time.monotonic() >= until:
                raise NotProvenError(unseen)
            time.sleep(bench.poll_s)
        return
    time.sleep(BEGUN_S)
    count, ends = recorder.count, time.monotonic() + SEEN_S
    while time.monotonic() < ends:
        writes = recorder.since(count)
        if any(second.at - first.at <= bench.subject.watch_s for first, second in pairwise(writes)):
            return
        time.sleep(bench.poll_s)
    raise NotProvenError(
        f"{verb} had no two writes within {bench.subject.watch_s:g} s. Give Subject(motion=...) where it ended, and "
        "Subject(moving=...) where the motor goes on by itself (docs/your-robot.md, The bus and its recorder)"
    )


@promise(
    "silver.again",
    "It is halted a second time as it is the first time: at rest, and in the next motion.",
    why="A stop that works once is found out the second time.",
    look="flags of the first halt that are not reset: an event, a thread that has ended",
    needs_recorder=True,
    needs="silver.halts",
)
def again(bench: ConformanceBench) -> str:
    """Halt two motions, each twice."""
    for nth in ("first", "second"):
        with bench.moving():
            for time_ in ("halt", "halt at rest"):
                bench.check_still(bench.halt(), bench.writes, f"{time_} of the {nth} motion")
    return ""


@promise(
    "silver.hundred",
    "The hundredth halt is as the first.",
    why="What is counted, pooled or remembered for each stop fills up.",
    look="threads, locks and lists that a halt makes and leaves",
    needs_recorder=True,
    needs="silver.halts",
)
def hundred(bench: ConformanceBench) -> str:
    """Halt a hundred times, in motion when it can be."""
    slowest = 0.0
    for nth in range(1, HUNDRED + 1):
        # The first, the hundredth and some others are in mid-motion: a robot may take its time to start.
        if nth > 1 and nth % (HUNDRED // IN_MOTION):
            verdict = bench.halt()
            check_stopped(verdict, f"halt {nth}")
        else:
            with bench.moving():
                verdict = bench.halt()
                bench.check_still(verdict, bench.writes, f"halt {nth}")
        slowest = max(slowest, verdict.elapsed_ms)
    return f"slowest {slowest:.1f} ms"


@promise(
    "silver.threads",
    "Three callers that halt it at once all get a verdict, and no write follows the first that says stopped.",
    why="The operator, the safety controller and the agent press in the same second.",
    look="a lock that a halt takes and waits under",
    needs_recorder=True,
    needs="silver.halts",
)
def threads(bench: ConformanceBench) -> str:
    """Halt one motion from three threads."""
    verdicts: list[StopVerdict] = []
    problems: list[str] = []
    with bench.moving():

        def halt() -> None:
            try:
                verdicts.append(bench.halt())
            except NotKeptError as exc:
                problems.append(str(exc))

        callers = [threading.Thread(target=halt, daemon=True) for _ in range(PARALLEL)]
        for each in callers:
            each.start()
        for each in callers:
            each.join(bench.subject.deadline_s + bench.subject.answer_s)
        if problems or len(verdicts) < PARALLEL:
            raise NotKeptError(f"{PARALLEL - len(verdicts)} of {PARALLEL} halts: {'; '.join(problems) or 'no verdict'}")
        count = bench.writes
        for verdict in verdicts:
            check_stopped(verdict, "one of three halts")
        bench.check_no_write(count, "three halts at once")
    return ""


@promise(
    "silver.networks",
    "A stop over each network halts as the local one does.",
    why="Who presses is seldom at the robot's own process.",
    look="halt() or stop_task(), which every stop calls",
    needs_recorder=True,
    needs="silver.halts",
)
def networks(bench: ConformanceBench) -> str:
    """Stop a motion over each network."""
    limit = bench.subject.answer_s + bench.subject.deadline_s
    for name, robot in bench.on.items():
        with bench.moving():
            verdict = within(limit, robot.halt, f"stop over {name}")
            bench.check_still(verdict, bench.writes, f"stop over {name}")
    return ""


@promise(
    "silver.verbs",
    "Each motion of its own is halted in its middle.",
    why="The stop of the built-in motions says nothing about those that its author wrote.",
    look="the method with @verb: while permit.valid",
    needs_recorder=True,
    needs="silver.halts",
)
def own_verbs(bench: ConformanceBench) -> str:
    """Halt each declared motion while it runs."""
    halted, short, unseen = list[str](), list[str](), list[str]()
    for verb in bench.motions():
        if not verb.own:
            continue
        motion = LongMotion(verb.name, bench.arguments(verb))
        try:
            with bench.moving(motion) as run:
                try:
                    _check_seen_moving(bench, verb.name)
                except NotProvenError as exc:
                    (short if run.over else unseen).append(str(exc))
                    continue
                verdict = bench.halt()
                bench.check_still(verdict, bench.writes, f"halt of {verb.name}")
                run.join()
                if not run.over:
                    raise NotKeptError(f"{verb.name} did not return after its stop")
            halted.append(verb.name)
        except NotProvenError as exc:
            short.append(str(exc))
    if unseen:
        raise NotProvenError("; ".join(unseen))
    if short and not halted:
        raise NotProvenError("; ".join(short))
    return "; ".join([", ".join(halted), *short] if halted else ["it has none of its own"])


@promise(
    "silver.unlinked",
    "A robot that was never on a network is halted all the same.",
    why="The first motion may begin before the first link is up.",
    look="what halt() reads of a connection, a runtime or a peer",
)
def unlinked(bench: ConformanceBench) -> str:
    """Halt it before it is on a network."""
    verdict = bench.halted_unlinked
    if isinstance(verdict, Exception):
        raise verdict
    if verdict.stopped is not True:
        raise NotKeptError(f"halt of a robot on no network: {text_of(verdict.envelope())}")
    return ""


@promise(
    "silver.hung_read",
    "A halt waits for no read: it answers while the robot's status and state hang.",
    why="A dead sensor must not be what keeps an arm moving.",
    look="get_task_status or get_state called by halt(), or a lock that both take",
    needs_recorder=True,
    needs="silver.halts",
)
def hung_read(bench: ConformanceBench) -> str:
    """Halt a motion while reads of the robot hang on other threads."""
    names = [each for each in HANGING if callable(getattr(bench.body, each, None))]
    for name in names:
        with bench.moving(), hung(bench.body, name) as entered:
            threading.Thread(target=lambda: _read(bench), name="conform read", daemon=True).start()
            if not entered.wait(bench.subject.answer_s):
                raise NotProvenError(f"{name} was not read")
            verdict = bench.halt()
            if name == STATUS:
                # Whether it stopped is not known without its status; that it did is seen on its bus.
                bench.check_no_write(bench.writes, f"halt beside a hung {name}")
            else:
                bench.check_still(verdict, bench.writes, f"halt beside a hung {name}")
    return ", ".join(names) or "it has no state that is read"


STATUS = "get_task_status"
HANGING = ("get_state", "get_joints", STATUS)


@contextmanager
def hung(body: object, name: str) -> Iterator[threading.Event]:
    """Have a method of the robot hang for the block; yield its first call."""
    method = getattr(body, name)
    entered, released = threading.Event(), threading.Event()

    def hang(*values: object, **named: object) -> object:
        entered.set()
        released.wait()
        return method(*values, **named)

    with put(body, name, hang):
        try:
            yield entered
        finally:
            released.set()


def _read(bench: ConformanceBench) -> None:
    for read in (bench.remote.state, bench.remote.status):
        try:
            read()
        except RefusalError:
            continue


@promise(
    "silver.lockout",
    "An emergency stop halts and locks it: every motion is refused until the operator's resume, reads are answered.",
    why="A robot that moves again by itself is more dangerous than one that never stopped.",
    look="a thread or timer of the robot that moves it without asking its gate for a permit",
    needs_recorder=True,
    needs="silver.halts",
)
def lockout(bench: ConformanceBench) -> str:
    """Stop a motion by an emergency stop, and ask for each motion again."""
    with bench.moving() as run, bench.halts_noted() as halts:
        verdicts: list[FleetVerdict] = []
        sending = threading.Thread(target=lambda: verdicts.append(bench.estop()), name="conform estop", daemon=True)
        sending.start()
        wait_for(lambda: not runs(bench.body), bench.subject.answer_s, "the end of the motion after an emergency stop")
        # A robot on a bus is frozen after its loop has ended; this halt's verdict comes after that.
        bench.halt()
        count = bench.writes
        bench.check_no_write(count, "emergency stop", halts)
        sending.join()
        answer = verdicts[0].get(PEER) if verdicts else None
        if answer is None or answer.stopped is not True:
            said = "no answer" if answer is None else text_of(answer.envelope())
            raise NotKeptError(f"the verdict on an emergency stop: {said}")
        run.join()
        count = bench.writes
        for robot in bench.on.values():
            for verb in bench.motions(robot.network):
                if verb.name in WHILE_LOCKED:
                    continue
                try:
                    robot.call(verb.name, timeout=bench.subject.answer_s, **bench.arguments(verb))
                except RefusalError:
                    continue
                raise NotKeptError(f"{verb.name} was carried out on {robot.network} while it was locked")
            robot.status()
        if bench.writes > count:
            raise NotKeptError("it wrote while it was locked")
        bench.clear()
    with bench.moving():
        bench.check_still(bench.halt(), bench.writes, "halt after the resume")
    return ""


@promise(
    "silver.honest",
    "While its bus raises or hangs, a halt answers in time, and says stopped only where no write follows.",
    why="A verdict that is wrong is worse than none: people walk up to the robot.",
    look="halt(): an exception of the bus that is swallowed, a lock that a hung write holds; a motor that goes on by "
    "itself, and no halt() that asks it",
    needs_recorder=True,
    needs="silver.halts",
)
def honest(bench: ConformanceBench) -> str:
    """Halt motions on a bus that raises, and on one that hangs."""
    recorder = bench.subject.recorder
    assert recorder is not None
    faults: dict[str, Callable[[], AbstractContextManager[None]]] = {
        "raises": lambda: recorder.raising(OSError(5, CABLE_OUT)),
        "hangs": recorder.hanging,
    }
    seen = []
    for how, fault in faults.items():
        with bench.moving() as run:
            with fault():
                time.sleep(0.05)
                bench.wait_for_fault()
                verdict = bench.halt()
                if verdict.stopped is not True and how == "raises":
                    # A halt that swallows the error says stopped once its verb has returned.
                    run.join()
                    again = bench.halt()
                    if again.stopped is True:
                        bench.check_no_write(bench.writes, f"second halt on a bus that {how}")
                # A write that hangs is made when the fault is over, after the verdict.
                count = bench.writes
            if verdict.stopped is True:
                bench.check_no_write(count, f"halt on a bus that {how}")
            bench.check_fault_met(how)
            seen.append(f"{how}: {'stopped' if verdict.stopped else 'not stopped'}")
        _recovered(bench, how)
    return ", ".join(seen)


def _recovered(bench: ConformanceBench, how: str) -> None:
    deadline = time.monotonic() + bench.subject.answer_s
    verdict = bench.halt()
    while verdict.stopped is not True and time.monotonic() < deadline:
        verdict = bench.halt()
    if verdict.stopped is not True:
        said = text_of(verdict.envelope())
        raise NotKeptError(f"after its bus {how}, no halt says stopped any more: {said}")
    bench.check_moves_again(f"its bus {how}")


PROMISES = (halts, again, hundred, threads, networks, own_verbs, unlinked, hung_read, lockout, honest)
