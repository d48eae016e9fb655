"""E-stop link of an MCP server: opened behind its start, closed at its end."""

from __future__ import annotations

import threading
from typing import Any

import pytest
from fixtures.waiting import eventually, free_port

from strands_robots.device_connect.backends import LinkConfig, loopback_config
from strands_robots.mcp import standing as module
from strands_robots.mcp.standing import StandingController


class FakeController:
    """A controller, or what follows stops for it, that notes its end."""

    link_up = True

    def __init__(self, name: str, closed: list[str]) -> None:
        self._name, self._closed = name, closed

    def close(self) -> None:
        """Note the end."""
        self._closed.append(self._name)


def names() -> set[str]:
    return {each.name for each in threading.enumerate()}


@pytest.fixture
def link() -> LinkConfig:
    return loopback_config(free_port())


def test_server_goes_on_while_its_link_is_opened(monkeypatch: pytest.MonkeyPatch, link: LinkConfig) -> None:
    slow, opened, closed = threading.Event(), list[tuple[str, bool]](), list[str]()

    def make(source: str, _link: LinkConfig, *, stands: bool) -> Any:
        assert slow.wait(30)
        opened.append((source, stands))
        return FakeController("controller", closed)

    monkeypatch.setattr(module, "safety_controller", make)
    monkeypatch.setattr(module, "stand", lambda _controller, _link: FakeController("roster", closed))
    standing = StandingController("helper", link)
    standing.open()
    assert not opened, "the server waited for its e-stop link"
    slow.set()
    standing.close()
    assert opened == [("helper", True)]
    assert closed == ["roster", "controller"]
    assert "standing controller" not in names()


def test_link_that_cannot_be_opened_is_told_and_tried_again(
    monkeypatch: pytest.MonkeyPatch, link: LinkConfig, caplog: pytest.LogCaptureFixture
) -> None:
    tries, works, closed = list[str](), threading.Event(), list[str]()

    def make(source: str, *_arguments: Any, **_options: Any) -> Any:
        tries.append(source)
        if not works.is_set():
            raise OSError("no file descriptor is left")
        return FakeController("controller", closed)

    monkeypatch.setattr(module, "safety_controller", make)
    monkeypatch.setattr(module, "stand", lambda _controller, _link: FakeController("roster", closed))
    monkeypatch.setattr(module, "AGAIN_S", 0.01)
    standing = StandingController("helper", link)
    standing.open()
    eventually(lambda: len(tries) > 2, what="further tries")
    assert "no file descriptor is left" in standing.problem
    assert caplog.text.count("helper does not report whom it misses") == 1
    works.set()
    eventually(lambda: standing.problem == "", what="its stand")
    standing.close()
    assert closed == ["roster", "controller"]


def test_close_waits_for_no_further_try(monkeypatch: pytest.MonkeyPatch, link: LinkConfig) -> None:
    def make(*_arguments: Any, **_options: Any) -> Any:
        raise OSError("no file descriptor is left")

    monkeypatch.setattr(module, "safety_controller", make)
    monkeypatch.setattr(module, "AGAIN_S", 1000.0)
    standing = StandingController("helper", link)
    standing.open()
    eventually(lambda: "no file descriptor" in standing.problem, what="the failure")
    standing.close()
    assert "standing controller" not in names()


def test_controller_that_was_never_opened_can_be_closed(link: LinkConfig) -> None:
    StandingController("helper", link).close()


def test_no_thread_is_left_of_a_true_link(link: LinkConfig) -> None:
    before = names()
    standing = StandingController("helper", link)
    standing.open()
    eventually(lambda: "standing roster" in names(), 30.0, what="the link")
    standing.close()
    eventually(lambda: not {"standing roster", "standing controller"} & (names() - before), 10.0, what="its end")
