from __future__ import annotations

import io
import json
from collections.abc import Callable, Collection
from typing import Any

import pytest
from click.testing import Result
from rich.console import Console

from strands_robots.cli import console, estop
from strands_robots.cli.button import Button
from strands_robots.cli.console import Board
from strands_robots.cli.holds import Standing
from strands_robots.cli.output import Exit
from strands_robots.device_connect import safety_controller
from strands_robots.device_connect.backends import loopback_config
from strands_robots.safety.controller import Answer, Progress, StopReport
from strands_robots.safety.lockout import Hold

Run = Callable[..., Result]


def answer(name: str, stopped: bool | None = True, ms: float = 3.0, why: str = "") -> Answer:
    return Answer(name, stopped, ms, why, {"halted": ["task"]} if stopped else {})


def report(*answers: Answer, silent: tuple[str, ...] = (), link: bool = True) -> StopReport:
    refused = {each.device_id: each for each in answers if "resumed before" in each.why}
    stopped = {each.device_id: each for each in answers if each.stopped}
    others = {each.device_id: each for each in answers if not each.stopped and each.device_id not in refused}
    return StopReport("e" * 32, stopped, others, refused, silent, link, 12.0)


class FakeController:
    controller_id = "safety-1"
    link_up = True

    def __init__(self, ends: StopReport) -> None:
        self.ends = ends
        self.asked: list[tuple[Collection[str], str]] = []

    def wait_link(self, timeout: float) -> bool:
        return True

    def stop(self, expected: Collection[str], reason: str, **more: Any) -> StopReport:
        self.asked.append((expected, reason))
        return self.ends

    def close(self) -> None:
        pass


@pytest.mark.parametrize(
    ("ends", "code", "shown"),
    [
        (report(answer("a")), 0, "stopped"),
        (report(answer("a"), answer("b", False, why="bus: no answer in 1 s")), 1, "DID NOT STOP"),
        (report(answer("a"), answer("b", None, why="b: nobody can tell")), 1, "NOBODY KNOWS"),
        (report(answer("a", None, why="a: this stop was resumed before it came again")), 1, "resumed before"),
        (report(answer("a"), silent=("b",)), 3, "NO ANSWER"),
        (report(), 3, "0 stopped"),
        (report(link=False, silent=("b",)), 3, "NO ANSWER"),
    ],
)
def test_each_robot_is_named_and_the_worst_answer_is_the_exit_code(
    run: Run, monkeypatch: pytest.MonkeyPatch, ends: StopReport, code: int, shown: str
) -> None:
    fake = FakeController(ends)
    monkeypatch.setattr(safety_controller, "safety_controller", lambda *given, **more: fake)
    result = run("estop", "a", "b", "--reason", "a hand")
    assert result.exit_code == code
    assert shown in result.stdout
    assert fake.asked == [(["a", "b"], "a hand")]
    told = json.loads(run("estop", "a", "--json").stdout)
    assert told["silent"] == list(ends.silent)
    assert (told["status"] == "success") is (code == 0)


@pytest.mark.parametrize("words", [("a", "--all"), ("a.b",), ("--deadline", "0"), ("--as", ""), ("--key", "nowhere")])
def test_wrong_words_are_exit_2(run: Run, words: tuple[str, ...]) -> None:
    assert run("estop", *words).exit_code == 2


def test_slow_and_silent_robots_are_red() -> None:
    progress = Progress("e" * 32, {"quick": answer("quick"), "slow": answer("slow", ms=170.0)}, ("mute",), True, 200.0)
    styles = {row[0]: str(row[1].style) for row in estop.running_rows(progress)}
    assert styles == {"quick": "green", "slow": "bold red", "mute": "bold red"}
    assert estop.rows(report(answer("a"), silent=("b",)))[0][0] == "b"


def drawn(board: Board, bar: Button) -> str:
    out = Console(file=io.StringIO(), width=160, height=40)
    out.print(board.draw(bar, ["ERROR something"]))
    shown: str = out.file.getvalue()  # type: ignore[attr-defined]  # it is a StringIO
    return shown


def test_the_board_shows_lockouts_check_ins_and_who_is_gone(monkeypatch: pytest.MonkeyPatch) -> None:
    fake: Any = FakeController(report())
    board, bar = Board(fake, loopback_config(), 0.5), Button(fake, lambda: (), "")
    hold = Hold("e" * 32, "desk-1", "a hand", 0.0)
    checked = {"check_in": {"required": True, "timeout_s": 2.0, "time_left_s": 1.25}}
    board.learn([Standing("arm-1", (hold,)), Standing("arm-2", facts=checked), Standing("arm-9", problem="no answer")])
    shown = drawn(board, bar)
    assert "LOCKED" in shown and "desk-1 a hand" in shown
    assert "1.2 s left" in shown
    assert "arm-9" not in shown
    assert "SPACE stops everything" in shown and "ERROR something" in shown
    monkeypatch.setattr(console, "GONE_S", 0.0)
    board.learn([Standing("arm-1", problem="no answer")])
    assert "GONE" in drawn(board, bar)
    assert set(board.expected()) == {"arm-1", "arm-2"}
    board.forget()
    assert board.expected() == ()


def test_the_exit_code_of_a_stop_names_its_worst() -> None:
    assert estop.verdict(report(answer("a", False), silent=("b",))) is Exit.REFUSED
    assert estop.verdict(report(answer("a"))) is Exit.OK
