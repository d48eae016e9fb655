"""Progress of a running attempt: seconds, frames, rate, ages, lag and drops."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from strands_robots.cli.output import Screen
from strands_robots.recording.file import STEP, Recorder

if TYPE_CHECKING:
    from strands_robots.datasets.encoder import CameraEncoder

LIVE_S, PLAIN_S = 0.2, 5.0
"""Seconds between two lines: on a terminal, where one is drawn over the other, and elsewhere."""

RATE_S = 2.0
"""Seconds over which the rate of the steps is taken."""


class AttemptProgress:
    """Progress of one attempt.

    Args:
        recorder: of its steps.
        fps: frames a second.
        encoder: of its pictures; None without cameras.
    """

    def __init__(self, recorder: Recorder, fps: int, encoder: CameraEncoder | None) -> None:
        self._recorder, self._fps, self._encoder = recorder, fps, encoder
        self._began = time.monotonic()
        self._pictures: dict[str, float] = {}
        self._steps: deque[tuple[float, int]] = deque([(self._began, 0)])
        self._counting = threading.Lock()

    def take_picture(self, camera: str, picture: Any, at: float | None) -> None:
        """Note when a picture had arrived, and hand it to the encoder."""
        self._pictures[camera] = time.time() if at is None else at
        if self._encoder is not None:
            self._encoder.offer(camera, picture, at)

    def row(self) -> dict[str, Any]:
        """Return the figures of now.

        Seconds since the beginning; frames that it would have; steps a second; ages of the newest state and of the
        newest picture of each camera, and the lag of the recorder, in milliseconds; pictures that were dropped by
        camera; other readings that were lost. A reading that has not come is left out.
        """
        now, moment = time.time(), time.monotonic()
        steps = self._recorder.arrived.get(STEP)
        ages = ({} if steps is None else {"state": steps[1]}) | self._pictures
        return {
            "seconds": round(moment - self._began, 1),
            "frames": 0 if steps is None else int((steps[1] - steps[0]) * self._fps) + 1,
            "hz": round(self._rate(moment), 1),
            "age_ms": {name: round(max(0.0, now - at) * 1000) for name, at in ages.items()},
            "lag_ms": round(self._recorder.lag_s * 1000),
            "dropped": {} if self._encoder is None else dict(self._encoder.dropped),
            "lost": self._recorder.lost,
        }

    def line(self) -> str:
        """Return the figures of now as one line."""
        row = self.row()
        ages = [f"{name} {age} ms" for name, age in row["age_ms"].items()]
        dropped = [f"{name} {count}" for name, count in row["dropped"].items()]
        dropped += [f"readings {row['lost']}"] if row["lost"] else []
        parts = [f"{row['seconds']:.1f} s", f"{row['frames']} frames", f"{row['hz']:.1f} Hz", *ages]
        return "  ".join([*parts, f"lag {row['lag_ms']} ms", f"dropped {', '.join(dropped) or 'none'}"])

    @contextmanager
    def shown(self, screen: Screen) -> Iterator[None]:
        """Show the progress in the block.

        It is drawn by a thread of its own, for a terminal may take no more output.
        """
        over = threading.Event()
        thread = threading.Thread(target=self._show, args=(screen, over), name="progress", daemon=True)
        thread.start()
        try:
            yield
        finally:
            over.set()
            thread.join()
            screen.redraw("")

    def _show(self, screen: Screen, over: threading.Event) -> None:
        while not over.wait(LIVE_S if screen.live else PLAIN_S):
            if screen.live:
                screen.redraw(self.line())
            else:
                screen.data({"event": "progress", **self.row()})
                screen.say(self.line())

    def _rate(self, moment: float) -> float:
        # The screen asks, and who looks from the network.
        with self._counting:
            count = sum(each for topic, each in list(self._recorder.counts.items()) if topic.endswith(f"/{STEP}"))
            if not count:
                # The rate is that of a robot that moves.
                self._steps.clear()
            self._steps.append((moment, count))
            while len(self._steps) > 2 and moment - self._steps[1][0] >= RATE_S:
                self._steps.popleft()
            (since, before), (_, count) = self._steps[0], self._steps[-1]
        return (count - before) / (moment - since) if moment > since else 0.0
