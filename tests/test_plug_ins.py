"""Parts of other packages: found by metadata, imported when asked for, refused by name."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from fixtures.installed import install

from strands_robots.plug_ins import PlugIn, PlugIns
from strands_robots.utils import ValidationError

ROBOTS = "strands_robots.robots"


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder of the path into which packages are installed; what they import is forgotten."""
    before = set(sys.modules)
    monkeypatch.syspath_prepend(tmp_path)
    yield tmp_path
    for name in set(sys.modules) - before:
        del sys.modules[name]


def part(name: str) -> PlugIn:
    found = PlugIns("robot", ("so100",)).get(name)
    assert found is not None
    return found


def test_part_is_known_by_the_place_of_its_callable(site: Path) -> None:
    imported = install(site, "my-robots", "def make(): return 1", {ROBOTS: {"a": "my_robots:make"}})
    plug_ins = PlugIns("robot", ())
    assert plug_ins.makes("my_robots:make")
    assert not plug_ins.makes("my_robots:other")
    assert not imported.exists()


def test_names_are_listed_without_an_import(site: Path) -> None:
    imported = install(
        site, "my-robots", "def make(): return 1", {ROBOTS: {"b": "my_robots:make", "a": "my_robots:make"}}
    )
    plug_ins = PlugIns("robot", ())
    assert [each for each in plug_ins.names() if each in ("a", "b")] == ["a", "b"]
    assert str(plug_ins.get("a")) == "robot a of my-robots 1.0"
    assert not imported.exists()
    assert part("a").make() == 1
    assert imported.exists()


def test_kinds_are_told_apart(site: Path) -> None:
    install(site, "my-robots", "", {ROBOTS: {"a": "my_robots:x"}, "strands_robots.policies": {"p": "my_robots:x"}})
    assert PlugIns("robot", ()).get("p") is None
    assert PlugIns("policy", ()).get("p") is not None
    assert PlugIns("teleoperator", ()).get("p") is None


@pytest.mark.parametrize("name", ["so100", "nope", "", 3, None])
def test_built_in_and_unknown_names_are_none(site: Path, name: object) -> None:
    install(site, "my-robots", "", {ROBOTS: {"so100": "my_robots:x"}})
    plug_ins = PlugIns("robot", ("so100",))
    assert plug_ins.get(name) is None
    assert plug_ins.refused() == {"so100": "my-robots 1.0 cannot take the name of a built-in robot"}


def test_name_of_two_packages_is_refused_with_both(site: Path) -> None:
    for each in ("one-robot", "other-robot"):
        install(site, each, "", {ROBOTS: {"twin": f"{each.replace('-', '_')}:x"}})
    plug_ins = PlugIns("robot", ())
    with pytest.raises(ValidationError, match=r"robot twin is stated by o\w+-robot 1.0 and o\w+-robot 1.0; uninstall"):
        plug_ins.get("twin")
    assert "twin" in plug_ins.refused()


@pytest.mark.parametrize(
    ("source", "reference", "problem"),
    [
        ("import no_such_package", "broken:make", "ModuleNotFoundError: No module named 'no_such_package'"),
        ("raise SystemExit(3)", "broken:make", "SystemExit: 3"),
        ("def make(:", "broken:make", "SyntaxError"),
        ("", "broken:make", "AttributeError"),
        ("", "elsewhere:make", "ModuleNotFoundError"),
        ("make = 3", "broken:make", "must be a callable that makes one, not 3"),
    ],
)
def test_broken_package_is_named_with_its_error(site: Path, source: str, reference: str, problem: str) -> None:
    install(site, "broken", source, {ROBOTS: {"mine": reference}})
    with pytest.raises(ValidationError) as refused:
        part("mine").load()
    assert str(refused.value).startswith("robot mine of broken 1.0 ")
    assert problem in str(refused.value)


@pytest.mark.parametrize(
    ("source", "options", "problem"),
    [
        ("def make(port): return port", {}, "missing a required argument: 'port'; its options are port"),
        ("def make(port=''): return port", {"speed": 1}, "unexpected keyword argument 'speed'; its options are port"),
        ("def make(): raise RuntimeError('no\\nbus')", {}, "RuntimeError: no bus."),
        ("def make(): raise TypeError('inside')", {}, "TypeError: inside."),
    ],
)
def test_part_that_cannot_be_made_is_named_with_the_reason(
    site: Path, source: str, options: dict[str, object], problem: str
) -> None:
    install(site, "broken", source, {ROBOTS: {"mine": "broken:make"}})
    with pytest.raises(ValidationError) as refused:
        part("mine").make(**options)
    assert str(refused.value).startswith("robot mine of broken 1.0 cannot be made: ")
    assert problem in str(refused.value)


def test_connection_error_of_a_part_stays_one(site: Path) -> None:
    install(site, "cut", "def make(): raise ConnectionRefusedError('cable')", {ROBOTS: {"cut": "cut:make"}})
    with pytest.raises(ConnectionRefusedError, match="cable"):
        part("cut").make()
