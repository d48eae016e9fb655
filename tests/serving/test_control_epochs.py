"""First epochs of control leases: never the same twice, and refused by name where they cannot be kept."""

from __future__ import annotations

import itertools
import os
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from strands_robots.safety import ed25519
from strands_robots.safety.resume import EPOCHS_EACH, reserve_epochs, sign_take
from strands_robots.serving.control import ControlLease, FirstEpoch
from strands_robots.state_files import StateFileError

KEY = Ed25519PrivateKey.generate()


@pytest.fixture
def state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    directory = tmp_path / "state"
    monkeypatch.setenv("STRANDS_STATE_DIR", str(directory))
    return directory


def lease(first_epoch: FirstEpoch | None = None) -> ControlLease:
    """A lease as a process that has just begun has it."""
    return ControlLease(
        "arm-1",
        lambda reason: None,
        lambda: False,
        keys=lambda: (ed25519.public_half(KEY),),
        watched=lambda each: None,
        first_epoch=first_epoch or FirstEpoch(),
    )


def test_each_reservation_is_above_all_epochs_of_the_one_before(state: Path) -> None:
    first = [reserve_epochs() for _ in range(5)]
    assert all(later - earlier >= EPOCHS_EACH // 2 for earlier, later in itertools.pairwise(first))
    assert [path.name for path in state.iterdir()] == ["control-epochs"]
    assert state.stat().st_mode & 0o777 == 0o700


def test_reservations_at_the_same_moment_are_distinct(state: Path) -> None:
    with ThreadPoolExecutor(16) as pool:
        first = list(pool.map(lambda _: reserve_epochs() // EPOCHS_EACH, range(200)))
    assert sorted(first) == list(range(1, 201))


def test_lost_state_directory_brings_no_epoch_back(state: Path) -> None:
    before = reserve_epochs()
    (state / "control-epochs").unlink()
    assert reserve_epochs() != before


@pytest.mark.parametrize("mode", [0o620, 0o602])
def test_file_that_others_may_write_is_refused(state: Path, mode: int) -> None:
    reserve_epochs()
    (state / "control-epochs").chmod(mode)
    with pytest.raises(StateFileError, match="control-epochs"):
        reserve_epochs()


def test_link_in_place_of_the_file_is_refused(state: Path, tmp_path: Path) -> None:
    state.mkdir(mode=0o700)
    (tmp_path / "elsewhere").touch()
    (state / "control-epochs").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(OSError):
        reserve_epochs()
    assert (tmp_path / "elsewhere").read_bytes() == b""


def test_recorded_take_is_refused_by_every_later_process(state: Path) -> None:
    first = lease()
    signed = sign_take(KEY, "arm-1", first.facts()["epoch"])
    assert first.take("ann", "because", "arm-1", signed)["status"] == "success"
    for _ in range(5):
        later = lease()
        answer = later.take("mallory", "because", "arm-1", signed)
        assert "names epoch" in answer["content"][0]["text"]
        assert later.epoch > first.epoch
        assert later.facts()["held"] is False


def test_take_is_refused_by_name_while_its_epoch_cannot_be_kept(state: Path) -> None:
    state.touch()
    held = lease()
    lease_id = held.acquire("agent-a", "agent", 60.0)["lease_id"]
    signed = sign_take(KEY, "arm-1", held.facts()["epoch"])
    answer = held.take("ann", "because", "arm-1", signed)
    assert answer["status"] == "error"
    assert "cannot be kept in the state directory" in answer["content"][0]["text"]
    assert held.renew(lease_id)["status"] == "success"
    state.unlink()
    again = sign_take(KEY, "arm-1", held.facts()["epoch"])
    assert held.take("ann", "because", "arm-1", again)["status"] == "success"


def test_disk_that_hangs_is_waited_for_once() -> None:
    hangs = threading.Event()

    def reserve() -> int:
        hangs.wait()
        return 7

    first = FirstEpoch(reserve)
    try:
        assert "no answer in 0.05 s" in str(first.reserved(0.05))
        assert "no answer in 0.05 s" in str(first.reserved(0.05))
        assert first.value == 0
    finally:
        hangs.set()
    assert first.reserved(20.0) is None
    assert first.value == 7


def test_robot_without_an_operators_key_writes_nothing(state: Path) -> None:
    free = ControlLease(
        "sim", lambda reason: None, lambda: False, hardware=False, keys=lambda: (), first_epoch=FirstEpoch()
    )
    assert free.facts()["epoch"] == 0
    assert free.take("ann", "because", "sim", None)["epoch"] == 1
    free.release(str(free.take("ann", "because", "sim", None)["lease_id"]))
    assert not os.path.lexists(state)
