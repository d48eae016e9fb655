"""Many processes that lock at once: every lockout is on the disk, and a kill -9 forgets none."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path

import pytest
from fixtures.child import Child
from fixtures.plane_process import planned
from fixtures.waiting import eventually

from strands_robots.safety.persistence import LockoutStore

PROCESSES, ROBOTS, STOPS = 4, 25, 10
NAMES = [[f"arm-{process}-{number}" for number in range(ROBOTS)] for process in range(PROCESSES)]


@pytest.fixture
def processes() -> Iterator[list[Child]]:
    with ExitStack() as stack, ThreadPoolExecutor(PROCESSES) as pool:
        yield [stack.enter_context(child) for child in pool.map(planned, NAMES)]


def kept(state: Path) -> dict[str, tuple[str, ...]]:
    """The epochs that are on the disk, by robot."""
    return {each.name: each.state.epochs for each in LockoutStore(state).load_all().values()}


def test_four_processes_with_one_state_directory_keep_every_lockout_of_a_hundred_robots(
    processes: list[Child], state_directory: Path
) -> None:
    with ThreadPoolExecutor(PROCESSES) as pool:
        for _ in range(STOPS):
            for answers in pool.map(lambda child: child.ask("stop"), processes):
                assert [stopped for stopped, _ in answers] == [True] * ROBOTS
    # A report waits for a slow disk for 0.7 s; the writer goes on.
    eventually(lambda: {len(epochs) for epochs in kept(state_directory).values()} == {STOPS})
    stored = kept(state_directory)
    assert set(stored) == {name for part in NAMES for name in part}
    processes[0].kill()
    with planned(NAMES[0]) as again:
        facts = again.ask("facts")
    assert {name: tuple(facts[name]["epochs"]) for name in NAMES[0]} == {name: stored[name] for name in NAMES[0]}
    for child, names in zip(processes[1:], NAMES[1:], strict=True):
        assert child.ask("clear") == sorted(names)
    assert {name for name, epochs in kept(state_directory).items() if epochs} == set(NAMES[0])
