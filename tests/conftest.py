"""What every test gets: settings and state that are not the user's, a working Ctrl-C, and an end to its threads."""

from __future__ import annotations

import gc
import os
import signal
import tempfile
import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
from fixtures.waiting import eventually, free_port

from strands_robots import audit, settings
from strands_robots.audit import flush_audit
from strands_robots.policies import settling
from strands_robots.stop_log import flush_stop_log

INTEGRATION = Path(__file__).parent / "integration"

# What is set in the shell that starts the tests would change what they say; how pictures are made stays as it is.
for setting in settings.declared():
    if setting.name not in {"DISPLAY", "MUJOCO_GL"}:
        os.environ.pop(setting.name, None)
for name in settings.UNREAD:
    os.environ.pop(name, None)

# What moves in the tests is no metal.
os.environ["STRANDS_ALLOW_MOCK"] = "true"

# Commands and callers that a test starts look for a mesh: never for one of this machine's user, or of another worker.
os.environ["STRANDS_MESH_PORT"] = str(free_port())

# An example takes as long as a busy machine lets it; the environments of real arms and DDS Security have no examples.
if find_spec("hypothesis"):
    import hypothesis

    slow = [hypothesis.HealthCheck.too_slow]
    hypothesis.settings.register_profile("patient", deadline=None, suppress_health_check=slow)
    patient = hypothesis.settings.get_profile("patient")
    hypothesis.settings.register_profile("ten-thousand", patient, max_examples=10_000)
    hypothesis.settings.load_profile("patient")

# A shell starts background jobs with Ctrl-C ignored, and nohup ignores the end of a terminal; every process that a test
# starts would inherit that.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:
    signal.signal(signal.SIGHUP, signal.SIG_DFL)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mix the files that start processes with those that do not, so that neither leaves the processors idle."""
    groups: tuple[dict[Path, None], dict[Path, None]] = ({}, {})
    for item in items:
        groups[INTEGRATION in item.path.parents].setdefault(item.path)
    place = {path: (n + 0.5) / len(group) for group in groups for n, path in enumerate(group)}
    items.sort(key=lambda item: place[item.path])


def pytest_collection_finish() -> None:
    """Keep what collecting made from being looked at by each full garbage collection: a million objects that stay."""
    gc.freeze()


@pytest.fixture(autouse=True, scope="module")
def state_directory_of_the_file(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """The state directory of what a whole file shares: its robots start before a test's own directory is set."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("STRANDS_STATE_DIR", str(tmp_path_factory.mktemp("state")))
        yield


@pytest.fixture(scope="session")
def state_directories(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The parent of all tests' state directories: pytest numbers what it makes, and looks at all of them for each."""
    return tmp_path_factory.mktemp("states")


@pytest.fixture(autouse=True)
def state_directory(state_directories: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The directory of grants, lockouts and the audit of this test, mode 0700."""
    directory = Path(tempfile.mkdtemp(prefix="state", dir=state_directories))
    monkeypatch.setenv("STRANDS_STATE_DIR", str(directory))
    # Whoever reads the audit waits for a slow disk.
    monkeypatch.setattr(audit, "FLUSH_S", 20.0)
    yield directory
    flush_audit(0.5)


@pytest.fixture(autouse=True)
def settings_put_are_taken_back(state_directory: Path) -> Iterator[None]:
    """What a command sets for its process ends with the test; how pictures are made is found once for all."""
    names = [setting.name for setting in settings.declared() if setting.name != "MUJOCO_GL"]
    before = {name: os.environ.get(name) for name in names}
    yield
    for name, value in before.items():
        if value is None:
            os.environ.pop(name, None)
        elif os.environ.get(name) != value:
            os.environ[name] = value


class _WrittenLog:
    """The log as a test reads it, once the records of the safety plane are in it."""

    def __init__(self, log: pytest.LogCaptureFixture) -> None:
        self._log = log

    def __getattr__(self, name: str) -> Any:
        flush_stop_log(20.0)
        return getattr(self._log, name)


@pytest.fixture
def caplog(caplog: pytest.LogCaptureFixture) -> Any:
    """Pytest's log; the safety plane's records are written on a thread of their own."""
    return _WrittenLog(caplog)


@pytest.fixture
def patient_halts(monkeypatch: pytest.MonkeyPatch) -> None:
    """A halt that comes late on a busy machine is a halt; a test of the deadline sets its own."""
    monkeypatch.setenv("STRANDS_HALT_DEADLINE_S", "20")


@pytest.fixture
def patient_settling(monkeypatch: pytest.MonkeyPatch) -> None:
    """An arm that settles slowly on a busy machine settles."""
    monkeypatch.setattr(settling, "SETTLE_S", 600.0)
    monkeypatch.setattr(settling, "STALLED_S", 600.0)


@pytest.fixture
def unending_settling(patient_settling: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """An arm settles until the test stops it again, however late that is."""
    monkeypatch.setattr(settling, "RANGES_PER_S", 0.001)


OURS = ("rollout-", "simulation", "device-connect", "fleet-client", "rosbridge", "rtps-bridge", "dds-", "mesh-")


@pytest.fixture(autouse=True)
def no_thread_of_ours_left(state_directory: Path) -> Iterator[None]:
    """Every thread of the package that a test starts has ended when the test has, so that none meets the next one."""
    with threads_ended():
        yield


@contextmanager
def threads_ended() -> Iterator[None]:
    """Wait at the end of a block for the threads of the package that it started.

    A pool that the robots of a file use may have replaced one.
    """
    before = Counter(thread.name for thread in threading.enumerate())
    yield

    def left() -> list[str]:
        now = Counter(thread.name for thread in threading.enumerate() if thread.name.startswith(OURS))
        return sorted((now - before).elements())

    eventually(lambda: not left(), what=f"the end of {left()}")
