from __future__ import annotations

import io
import json

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from strands_robots.cli.output import LENGTH_MAX, CliError, Exit, Screen, plain, table


def drawn(thing: object) -> str:
    sink = io.StringIO()
    Console(file=sink, width=200).print(thing)
    return sink.getvalue()


@pytest.mark.parametrize(
    ("hostile", "harmless"),
    [("\x1b[2Jgone", "\\x1b[2Jgone"), ("a\r\nb", "a\\r\\nb"), ("\u202eevil", "\\u202eevil"), ("\x9b31m", "\\x9b31m")],
)
def test_control_and_bidi_characters_become_visible(hostile: str, harmless: str) -> None:
    assert plain(hostile) == harmless


@given(st.text())
def test_any_network_text_is_one_printable_line(text: str) -> None:
    assert plain(text).isprintable()


def test_markup_from_the_network_is_printed_as_text() -> None:
    assert "[bold red]arm[/]" in drawn(table("", ["device"], [["[bold red]arm[/]"]]))


def test_long_text_is_cut_with_its_length() -> None:
    assert plain("a" * 5000).endswith("... (5000 characters)")
    assert len(plain("a" * 5000)) < LENGTH_MAX + 40


def test_value_without_json_form_is_described() -> None:
    loop: list[object] = []
    loop.append(loop)
    assert plain(loop) == "a list"
    assert plain({"speed": 1.5}) == '{"speed": 1.5}'


def test_json_option_prints_only_json_on_stdout(capsys: pytest.CaptureFixture[str]) -> None:
    screen = Screen(machine=True)
    screen.say("for people")
    screen.show("for people")
    screen.data({"a": "\x1b"})
    screen.fail(CliError("no", Exit.SILENT, who="arm"))
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert lines == [{"a": "\x1b"}, {"status": "error", "reason": "no", "exit": 3, "who": "arm"}]


def test_copyable_line_is_not_wrapped_at_the_terminal_width() -> None:
    sink = io.StringIO()
    line = f"export NAME={'x' * 100}"
    Screen(console=Console(file=sink, width=40)).copyable(line)
    assert sink.getvalue() == line + "\n"
