"""The rail on its emulator, for ``strands-robots conform`` and the tests."""

from __future__ import annotations

from collections.abc import Callable

from strands_robots.testing import BusRecorder, LongMotion, Subject
from tarn_rail.emulator import RailEmulator
from tarn_rail.robot import TarnRail


class EmulatedRail(TarnRail):
    """A rail with an emulator of its own."""

    def __init__(self, before_step: Callable[[], object] = lambda: None) -> None:
        self.emulator = RailEmulator(before_step)
        super().__init__(port=self.emulator.port)

    def cleanup(self) -> dict[str, object]:
        """Stop the carriage, hang up and switch the emulator off."""
        verdict = super().cleanup()
        self.emulator.close()
        return verdict


def subject() -> Subject:
    """Return the rail, and the recorder of each step of its motor."""
    recorder = BusRecorder()
    return Subject(
        lambda: EmulatedRail(recorder.wrote), recorder, motion=LongMotion("shuttle", {"trips": 20}), name="tarn_rail"
    )
