"""Typer converts values as before, and pydantic is loaded only where a value needs it."""

import hashlib
import inspect
import subprocess
import sys
from pathlib import Path
from typing import Annotated

import pytest
import typer
from typer import _coercion, core
from typer.testing import CliRunner

from strands_robots.cli._compat import _LazyConversions, convert_when_needed

SOURCE_HASHES = {
    core._TyperParameter.get_runtime_param: "74aa41c7aad065ca",
    core._TyperParameter.process_value: "405ec55b58c60bc7",
    _coercion.RuntimeParam.coerce: "75e2de2be8c62955",
    _coercion.build_runtime_param: "a2d5790ac918c0b9",
}

LINES = (
    (),
    ("one",),
    ("one", "two"),
    ("ä",),
    ("--ratio", "0.5"),
    ("--ratio", "fast"),
    ("--count", "3"),
    ("--count", "9"),
    ("--name", ""),
    ("--name", "\udcff"),
    ("--path", "a/b"),
    ("--tag", "x", "--tag", "ö"),
    ("--maybe", "1"),
    ("--flag",),
)


@pytest.mark.parametrize("member", SOURCE_HASHES, ids=lambda member: member.__qualname__)
def test_member_of_typer_has_not_changed(member):
    found = hashlib.sha256(inspect.getsource(member).encode()).hexdigest()[:16]
    assert found == SOURCE_HASHES[member], f"read {member.__qualname__} again before trusting cli/_compat.py"


@pytest.mark.parametrize("line", LINES, ids=" ".join)
def test_values_are_converted_as_typer_converts_them(line, monkeypatch):
    monkeypatch.setattr(core, "build_runtime_param", _coercion.build_runtime_param)
    plain = outcome(line)
    convert_when_needed()
    assert isinstance(core.build_runtime_param, _LazyConversions)
    assert outcome(line) == plain


@pytest.mark.parametrize(
    ("words", "loaded"), [(("peers", "--json"), False), (("peers", "--json", "--timeout", "0.01"), True)]
)
def test_pydantic_is_loaded_for_a_value_to_convert_alone(words, loaded):
    code = (
        "import sys; from strands_robots.cli.app import build\n"
        "try: build('peers')()\nexcept SystemExit: print('pydantic.types' in sys.modules)"
    )
    # A flag that contradicts the others ends the command once its values are read.
    line = [sys.executable, "-c", code, *words, "--nats", "nats://127.0.0.1:4222", "--multicast"]
    result = subprocess.run(line, capture_output=True, text=True, timeout=100, check=True)
    assert result.stdout.splitlines()[-1] == str(loaded)


def outcome(line):
    """Return what a command got, or how its line was refused."""
    got = []
    app = typer.Typer(add_completion=False)

    @app.command()
    def take(
        words: Annotated[list[str] | None, typer.Argument()] = None,
        ratio: float = 0.25,
        count: Annotated[int, typer.Option(min=1, max=5)] = 2,
        name: str | None = None,
        path: Path | None = None,
        tag: list[str] | None = None,
        maybe: float | None = None,
        flag: bool = False,
    ):
        got.append((words, ratio, count, name, path, tag, maybe, flag))

    result = CliRunner().invoke(app, list(line))
    return result.exit_code, repr(got), [type(each) for values in got for each in values], result.output
