"""The list of motions of a check: its digest, and the operator's yes at a terminal, which is no by default."""

from __future__ import annotations

import io
import sys

import pytest
from rich.console import Console

from strands_robots.cli.motion_approval import MotionList
from strands_robots.cli.output import CliError, Screen

MOTIONS = MotionList("arm-1", ["execute(duration=3), once"])


@pytest.fixture
def drawn() -> io.StringIO:
    return io.StringIO()


@pytest.fixture
def screen(drawn: io.StringIO, monkeypatch: pytest.MonkeyPatch) -> Screen:
    """A terminal, whose user is asked on its input."""
    monkeypatch.setattr(sys, "stdin", type("Terminal", (io.StringIO,), {"isatty": lambda self: True})())
    return Screen(console=Console(file=drawn, force_terminal=True, width=200))


def answered(monkeypatch: pytest.MonkeyPatch, answer: str | None) -> None:
    def ask(question: str) -> str:
        assert "stand beside it" in question
        if answer is None:
            raise EOFError
        return answer

    monkeypatch.setattr("builtins.input", ask)


@pytest.mark.parametrize("answer", ["", "n", "no", "yess", "1", None])
def test_all_but_a_yes_is_a_no(screen: Screen, monkeypatch: pytest.MonkeyPatch, answer: str | None) -> None:
    answered(monkeypatch, answer)
    with pytest.raises(CliError, match="Nothing was moved"):
        MOTIONS.approve(screen, None)


@pytest.mark.parametrize("answer", ["y", "yes", " YES "])
def test_yes_approves_the_printed_list(
    screen: Screen, drawn: io.StringIO, monkeypatch: pytest.MonkeyPatch, answer: str
) -> None:
    answered(monkeypatch, answer)
    MOTIONS.approve(screen, None)
    assert "These checks move arm-1:" in drawn.getvalue()
    assert "execute(duration=3), once" in drawn.getvalue()


def test_digest_approves_without_a_question(screen: Screen, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("builtins.input", lambda question: pytest.fail("it asked"))
    MOTIONS.approve(screen, MOTIONS.digest)


def test_program_is_not_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("builtins.input", lambda question: pytest.fail("it asked"))
    with pytest.raises(CliError, match=f"--approve-motions {MOTIONS.digest}"):
        MOTIONS.approve(Screen(machine=True), None)
