"""Robots and controllers in processes of their own, on a real network of the test's own."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from fixtures.child import Child
from fixtures.nats_server import NatsServer
from fixtures.network_lab import NetworkLab
from fixtures.stop_controller import controller
from fixtures.stop_robots import robots
from fixtures.waiting import eventually, free_port

from strands_robots.device_connect.backends import LinkConfig, loopback_config


@pytest.fixture(autouse=True)
def patient_halts(monkeypatch: pytest.MonkeyPatch) -> None:
    """A busy machine may keep a thread that halts from running for a while; no test here is about how long."""
    monkeypatch.setenv("STRANDS_HALT_DEADLINE_S", "10")


class Stage:
    """Starts processes on one link and ends them; all robots of a stage keep their state in one folder.

    Args:
        link: of robots and controllers.
        far: of controllers, where theirs is another.
        lab: where robots live on this side and controllers on that.
    """

    def __init__(
        self, link: LinkConfig, folder: Path, far: LinkConfig | None = None, lab: NetworkLab | None = None
    ) -> None:
        self.link, self.far = link, far or link
        self.folder = folder
        self._here: tuple[str, ...] = lab.here.within if lab else ()
        self._there: tuple[str, ...] = lab.there.within if lab else ()
        self._stack = ExitStack()

    def robots(self, *ids: str, **settings: str) -> Child:
        """Robots that are on the network and reached by the e-stop listener."""
        state = {"STRANDS_STATE_DIR": str(self.folder), **settings}
        child = self._stack.enter_context(robots(self.link, *ids, environment=state, within=self._here))
        eventually(lambda: child.ask("ready"), what="the robots' e-stop links")
        return child

    def controller(self, controller_id: str = "safety-1", seed: str = "") -> Child:
        """A controller whose link is up."""
        made = controller(self.far, controller_id, seed=seed, within=self._there)
        child = self._stack.enter_context(made)
        assert child.ask("up", 30.0)
        return child

    def meet(self, hand: Child, *ids: str) -> None:
        """Wait until a stop of ``hand`` comes through to each robot and back: from then on nobody is unknown."""
        eventually(lambda: hand.ask("stop", ids, 5.0)["ok"], what="the first stop")

    def close(self) -> None:
        """End every process."""
        self._stack.close()


@pytest.fixture(params=["zenoh", "nats"])
def stage(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Stage]:
    """A stage on Zenoh between peers, or on a NATS server."""
    folder = tmp_path / "robots"
    folder.mkdir(mode=0o700)
    with ExitStack() as stack:
        if request.param == "nats":
            server = stack.enter_context(NatsServer())
            link = LinkConfig(transport="nats", connect=(server.url,))
        else:
            link = loopback_config(free_port())
        made = Stage(link, folder)
        stack.callback(made.close)
        yield made
