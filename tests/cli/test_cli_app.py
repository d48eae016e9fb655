"""The application and its commands."""

from __future__ import annotations

import pytest
import typer
from typer.testing import CliRunner

from strands_robots.cli.app import COMMANDS, build


def words_of(app: typer.Typer) -> list[str]:
    """Return the words that an application knows."""
    return [str(each.name) for each in (*app.registered_commands, *app.registered_groups)]


def test_every_command_is_listed_with_its_module() -> None:
    assert words_of(build()) and sorted(words_of(build())) == sorted(sum(COMMANDS.values(), ()))


@pytest.mark.parametrize("word", sorted(sum(COMMANDS.values(), ())))
def test_one_word_loads_the_commands_of_its_module_alone(word: str) -> None:
    (words,) = (words for words in COMMANDS.values() if word in words)
    assert sorted(words_of(build(word))) == sorted(words)
    said = CliRunner().invoke(build(word), [word, "--help"])
    assert said.exit_code == 0
    assert f" {word} " in said.output


def test_unknown_word_is_refused_by_the_whole_application() -> None:
    assert words_of(build("fly")) == words_of(build())
    assert CliRunner().invoke(build("fly"), ["fly"]).exit_code == 2


@pytest.mark.parametrize(
    ("flags", "says"),
    [
        (["--model", "arm.xml"], "a real arm's"),
        (["--mode", "real", "--detector", "nowhere:make"], "cannot be made"),
        (["--mode", "real", "--detector", "json:no_such"], "cannot be made"),
    ],
)
def test_serve_refuses_a_model_and_a_detector_that_it_cannot_use(flags: list[str], says: str) -> None:
    told = CliRunner().invoke(build("serve"), ["serve", "so100", *flags])
    assert told.exit_code != 0
    assert says in f"{told.output} {told.exception}"
