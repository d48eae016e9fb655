"""``stop``, ``estop`` and ``safety-controller`` with robots on both networks: real processes, some of which hang."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest
from fixtures.command_line import COMMAND, WITHIN_S, Machine, on_a_terminal
from fixtures.mesh_peer import MeshPeer
from fixtures.nats_server import NatsServer
from fixtures.toy_robots import ToyRobot
from fixtures.waiting import eventually, free_port

from strands_robots.device_connect import LinkConfig, init_device_connect_sync, loopback_config, stop_device_connect
from strands_robots.safety.sightings import Sightings

pytestmark = pytest.mark.timeout(600)
TASK = {"instruction": "wave", "duration": 600.0, "policy_provider": "mock"}


class Site(Machine):
    """A machine whose commands reach robots on both networks; none of them lives on it.

    Args:
        folder: for the states of all.
        nats: the URL of the broker of Device Connect, else its robots meet at a loopback port.
    """

    def __init__(self, folder: Path, nats: str = "") -> None:
        self._folder, self._stack = folder, ExitStack()
        self.flags = ("--nats", nats) if nats else ()
        super().__init__(folder / "state", STRANDS_MESH_PORT=str(free_port()))
        port = int(self.environment["STRANDS_DC_PORT"])
        self.link = LinkConfig(transport="nats", connect=(nats,)) if nats else loopback_config(port)

    def device(self, name: str) -> ToyRobot:
        """Serve a moving robot on Device Connect."""
        toy = ToyRobot(name)
        self._stack.callback(toy.close)
        runtime = init_device_connect_sync(toy, peer_id=name, link=self.link)
        self._stack.callback(stop_device_connect, runtime)
        toy.start_task(**TASK)
        eventually(lambda: toy.writes, what="a first write")
        return toy

    def peer(self, name: str) -> MeshPeer:
        """Serve a moving robot on the mesh; the first one is its hub."""
        state = self._folder / name
        state.mkdir(mode=0o700, exist_ok=True)
        settings = {"STRANDS_MESH_PORT": self.environment["STRANDS_MESH_PORT"], "STRANDS_STATE_DIR": str(state)}
        peer = MeshPeer(name, "world", settings)
        self._stack.callback(peer.close)
        peer.ask("start", "wave")
        return peer

    def stops(self, *arguments: str) -> tuple[int, dict[str, Any]]:
        """Run a command and return its code and what it said."""
        return self.json(*arguments, *self.flags)

    def remembers(self, *names: str) -> None:
        """Wait until this machine remembers these robots."""
        store = Sightings(Path(self.environment["STRANDS_STATE_DIR"]))
        eventually(lambda: {*names} <= {each.name for each in store.read()[0]}, what=f"the memory of {names}")

    def close(self) -> None:
        """End the robots."""
        self._stack.close()


@pytest.fixture(autouse=True)
def anyone_may_stop(monkeypatch: pytest.MonkeyPatch, patient_halts: None) -> None:
    monkeypatch.setenv("DEVICE_CONNECT_ESTOP_ALLOW", "*")
    monkeypatch.setenv("BYPASS_TOOL_CONSENT", "true")


@pytest.fixture
def site(tmp_path: Path) -> Iterator[Site]:
    made = Site(tmp_path)
    yield made
    made.close()


@contextmanager
def frozen(peer: Any) -> Iterator[None]:
    """Stop a process for the length of the block."""
    peer.signal(signal.SIGSTOP)
    try:
        yield
    finally:
        peer.signal(signal.SIGCONT)


def moves(robot: ToyRobot | MeshPeer) -> bool:
    if isinstance(robot, MeshPeer):
        return bool(robot.ask("moving"))
    return bool(robot.get_task_status()["task_status"] == "running")


def test_stop_of_a_robot_on_one_network_looks_as_if_it_were_the_only_one(site: Site) -> None:
    near, far = site.device("arm-1"), site.peer("arm-2")
    for name, robot, other in (("arm-1", near, far), ("arm-2", far, near)):
        robot.start_task(**TASK) if isinstance(robot, ToyRobot) else robot.ask("start", "wave")
        other.start_task(**TASK) if isinstance(other, ToyRobot) else other.ask("start", "wave")
        code, said = site.stops("stop", name)
        assert (code, list(said["devices"]), said["devices"][name]["stopped"]) == (0, [name], True), said
        assert (said["robots"].keys(), said["absent"]) == ({name}, {})
        assert (moves(robot), moves(other)) == (False, True)
    code, said = site.stops("stop", "arm-9")
    assert (code, said["devices"]["arm-9"]["stopped"]) == (3, None)
    assert said["reason"].startswith("NO ANSWER: arm-9.")
    assert "arm-1" in said["reason"]


def test_stop_goes_to_all_bearers_of_a_name_and_names_the_one_that_is_silent(site: Site) -> None:
    near, far = site.device("twin"), site.peer("twin")
    code, said = site.stops("stop", "twin")
    assert (code, said["devices"]["twin"]["stopped"]) == (0, True), said
    assert set(said["robots"]) == {"twin on device_connect", "twin on mesh"}
    assert not moves(near) and not moves(far)
    site.remembers("twin")
    near.start_task(**TASK)
    with frozen(far):
        code, said = site.stops("stop", "twin")
    assert (code, said["silent"], said["not_stopped"]) == (3, ["twin on mesh"], []), said
    assert said["devices"]["twin"]["stopped"] is None
    assert not moves(near)


@pytest.mark.parametrize("verb", ["stop", "estop"])
def test_stop_of_all_stops_both_networks_and_is_one_table(site: Site, verb: str) -> None:
    near, far = site.device("arm-1"), site.peer("arm-2")
    code, said = site.stops(verb, "--all")
    assert (code, said["mesh"]) == (0, {"arm-2": True}), said
    assert not moves(near) and not moves(far)
    assert (near.gate.lockout("execute") is not None) is (verb == "estop")
    if verb == "estop":
        assert list(said["stopped"]) == ["arm-1"]
        epoch = near.gate.lockout("execute")
        assert epoch is not None and said["estop_id"] in str(epoch)
        assert far.ask("epoch") == said["estop_id"]
    table = site.run(verb, "--all", *site.flags)
    assert table.returncode == 0, table.stderr
    lines = [line.split() for line in table.stdout.splitlines() if line.strip().startswith("arm-")]
    rows = {line[0]: line[1] for line in lines}
    assert rows == {"arm-1": "device_connect", "arm-2": "mesh"}
    assert "On mesh:" in table.stdout, table.stdout


def test_named_robot_must_answer_on_the_network_that_has_it(site: Site) -> None:
    site.device("arm-1")
    site.peer("arm-2")
    code, said = site.stops("estop", "arm-1", "arm-2", "--deadline", "2")
    assert (code, list(said["stopped"]), said["silent"], said["mesh"]) == (0, ["arm-1"], [], {"arm-2": True}), said
    code, said = site.stops("estop", "arm-9", "--deadline", "1")
    assert (code, said["silent"], said["mesh"]) == (3, ["arm-9"], {"arm-2": True})
    assert said["reason"].startswith("NO ANSWER: arm-9.")


@pytest.mark.parametrize("verb", ["stop", "estop"])
def test_mesh_whose_hub_hangs_keeps_no_stop_from_the_other_network_and_is_named(site: Site, verb: str) -> None:
    near, far = site.device("arm-1"), site.peer("arm-2")
    assert site.stops("stop", "--all")[0] == 0
    site.remembers("arm-1", "arm-2")
    near.start_task(**TASK)
    far.ask("start", "wave")
    with frozen(far):
        code, said = site.stops(verb, "--all")
        assert not moves(near)
        assert (code, said["mesh"]) == (3, {"arm-2": None}), said
        assert "NO ANSWER: arm-2." in said["reason"]
    assert moves(far)


@pytest.fixture
def on_nats(tmp_path: Path) -> Iterator[tuple[Site, NatsServer]]:
    with NatsServer() as server:
        made = Site(tmp_path, server.url)
        yield made, server
        made.close()


@pytest.mark.parametrize("verb", ["stop", "estop"])
@pytest.mark.parametrize("how", ["hangs", "is gone"])
def test_mesh_is_stopped_at_once_while_the_broker_hangs_or_is_gone(
    on_nats: tuple[Site, NatsServer], verb: str, how: str
) -> None:
    site, server = on_nats
    far = site.peer("arm-2")
    # Nothing is remembered of Device Connect: it is named, and fails no stop of others.
    with server.paused() if how == "hangs" else server.gone():
        running = site.start(verb, "--all", *site.flags, "--json")
        eventually(lambda: not moves(far), what="the halt")
        assert running.poll() is None or how == "is gone"
        out, err = running.communicate(timeout=WITHIN_S)
        assert running.returncode == 0, out + err
    assert '"absent": {"device_connect": ' in out
    near = site.device("arm-1")
    assert site.stops("stop", "--all")[0] == 0
    site.remembers("arm-1", "arm-2")
    near.start_task(**TASK)
    with server.paused() if how == "hangs" else server.gone():
        code, said = site.stops(verb, "--all")
    assert (code, said["mesh"]) == (3, {"arm-2": True}), said
    assert "arm-1" in said["reason"]


def test_none_in_reach_is_exit_3_and_names_the_robots_of_both(on_nats: tuple[Site, NatsServer]) -> None:
    site, server = on_nats
    site.device("arm-1")
    far = site.peer("arm-2")
    assert site.stops("stop", "--all")[0] == 0
    site.remembers("arm-1", "arm-2")
    with server.gone(), frozen(far):
        for verb in ("stop", "estop"):
            code, said = site.stops(verb, "--all")
            assert (code, said["mesh"]) == (3, {"arm-2": None}), said
            assert "NO ANSWER: arm-1." in said["reason"] and "NO ANSWER: arm-2." in said["reason"]
        code, said = site.stops("stop", "arm-1")
        assert (code, said["stopped"]) == (3, None)
        assert said["reason"].startswith("The network does not carry this: ")


class TestConsole:
    """The operator's console, which is there before and after its robots."""

    LINE = (*COMMAND, "safety-controller", "--id", "desk-1")

    def test_space_stops_robots_of_both_networks_that_came_after_it(self, site: Site) -> None:
        # So small that the table of robots does not fit: what came of the stop is seen all the same.
        with on_a_terminal(self.LINE, site.environment, size=(16, 80)) as terminal:
            eventually(lambda: "SPACE stops everything" in terminal.drawn, within=WITHIN_S)
            near, far = site.device("arm-1"), site.peer("arm-2")
            eventually(lambda: "up on device_connect, up on mesh" in terminal.drawn, within=WITHIN_S)
            terminal.press(" ")
            eventually(lambda: not moves(near) and not moves(far), what="the halts")
            eventually(lambda: terminal.drawn.count("LOCKED") > 1, within=WITHIN_S)
            locked = near.gate.lockout("execute")
            assert locked is not None and str(far.ask("epoch")) in str(locked), "one press is one stop"
            eventually(lambda: "On mesh: 1 stopped" in terminal.drawn, within=WITHIN_S)
            terminal.press("q")
            assert terminal.process.wait(WITHIN_S) == 0
        assert "Traceback" not in terminal.drawn

    def test_press_leaves_on_a_mesh_that_comes_within_seconds_of_it(self, site: Site) -> None:
        near = site.device("arm-1")
        with on_a_terminal(self.LINE, site.environment) as terminal:
            eventually(lambda: "arm-1" in terminal.drawn, within=WITHIN_S)
            terminal.press(" ")
            eventually(lambda: not moves(near), what="the halt")
            far = site.peer("arm-2")
            eventually(lambda: far.ask("epoch") is not None, what="the lockout on the mesh", within=WITHIN_S)
            assert str(far.ask("epoch")) in str(near.gate.lockout("execute"))

    def test_hub_that_is_gone_is_shown_and_a_stop_leaves_when_the_mesh_is_back(self, site: Site) -> None:
        site.device("arm-1")
        hub = site.peer("arm-2")
        with on_a_terminal(self.LINE, site.environment) as terminal:
            eventually(lambda: "up on device_connect, up on mesh" in terminal.drawn, within=WITHIN_S)
            eventually(lambda: "arm-2" in terminal.drawn, within=WITHIN_S)
            hub.kill()
            eventually(lambda: "up on device_connect, DOWN on mesh" in terminal.drawn, within=WITHIN_S)
            terminal.press(" ")
            eventually(lambda: "On mesh: STOPPING" in terminal.drawn, within=WITHIN_S)
            back = site.peer("arm-2")
            eventually(lambda: back.ask("epoch") is not None, what="the lockout on the mesh", within=WITHIN_S)
            assert not moves(back)

    def test_second_stop_leaves_behind_one_that_hangs(self, on_nats: tuple[Site, NatsServer]) -> None:
        site, server = on_nats
        site.device("arm-1")
        far = site.peer("arm-2")
        with on_a_terminal((*self.LINE, *site.flags), site.environment) as terminal:
            eventually(lambda: "up on device_connect, up on mesh" in terminal.drawn, within=WITHIN_S)
            eventually(lambda: "arm-1" in terminal.drawn and "arm-2" in terminal.drawn, within=WITHIN_S)
            with server.paused():
                terminal.press(" ")
                first = eventually(lambda: far.ask("epoch"), what="the stop on the mesh")
                far.ask("clear")
                far.ask("start", "wave")

                def pressed_again() -> bool:
                    terminal.press(" ")
                    return far.ask("epoch") not in (None, first)

                # A key that is held down is one stop: presses of a stop of their own are further apart.
                eventually(pressed_again, every=1.5, what="a stop of its own")
                assert not moves(far)
