"""A camera that is replayed from memory, and a hand that leads, as a plug-in of LeRobot's own commands.

:mod:`benchmarks.takeover_lerobot` installs this text as a distribution of its own, ``lerobot_camera_replayed``: LeRobot
finds plug-ins by the names of distributions, and the classes of a configuration by its module.
"""

from __future__ import annotations

import io
import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from fixtures.feetech_bus.patience import be_patient
from fixtures.replayed_cameras import BITS, SCENES, scenes, stamp
from lerobot.cameras import Camera, CameraConfig
from lerobot.teleoperators import Teleoperator, TeleoperatorConfig
from PIL import Image

from strands_robots.recording.cameras import jpeg

# LeRobot gives a recording up where a busy machine keeps the emulated servos for 50 ms: that beat is a long one then.
be_patient()


@CameraConfig.register_subclass("replayed")
@dataclass(kw_only=True)
class ReplayedConfig(CameraConfig):  # type: ignore[misc]
    """Size and pictures a second."""


class Replayed(Camera):  # type: ignore[misc]
    """Camera whose picture has its number of the machine's monotonic clock, from which its age is known."""

    def __init__(self, config: ReplayedConfig) -> None:
        super().__init__(config)
        # As a webcam delivers them: else the way over a network would leave the encoder of the set less to do.
        encoded = (jpeg("scene", each) for each in scenes(SCENES, config.width, config.height))
        self._scenes = [np.asarray(Image.open(io.BytesIO(each))) for each in encoded]
        self._open = False

    @property
    def is_connected(self) -> bool:
        return self._open

    @staticmethod
    def find_cameras() -> list[dict[str, Any]]:
        return []

    def connect(self, warmup: bool = True) -> None:
        self._open = True

    def read(self) -> Any:
        return self.read_latest()

    def async_read(self, timeout_ms: float = 200) -> Any:
        return self.read_latest()

    def read_latest(self, max_age_ms: int = 500) -> Any:
        """Return the newest picture."""
        number = int(time.monotonic() * self.fps)
        return stamp(self._scenes[number % SCENES].copy(), number % 2**BITS)

    def disconnect(self) -> None:
        self._open = False


@TeleoperatorConfig.register_subclass("hand")
@dataclass(kw_only=True)
class HandConfig(TeleoperatorConfig):  # type: ignore[misc]
    """A hand at an arm.

    Attributes:
        joints: names of its joints.
        middle: about which it moves each.
        reach: how far, in the same unit.
        file: in which it writes down when it was read, in monotonic seconds; empty for none.
    """

    joints: list[str]
    middle: float
    reach: float
    file: str = ""


class Hand(Teleoperator):  # type: ignore[misc]
    """Leader that moves its joints to and fro. A loop reads it once a beat, just before it acts."""

    config_class = HandConfig
    name = "hand"

    def __init__(self, config: HandConfig) -> None:
        super().__init__(config)
        self.config = config
        self._file: Any = None

    @property
    def action_features(self) -> dict[str, Any]:
        return dict.fromkeys(self.config.joints, float)

    @property
    def feedback_features(self) -> dict[str, Any]:
        return {}

    @property
    def is_connected(self) -> bool:
        return self._file is not None

    @property
    def is_calibrated(self) -> bool:
        return True

    def connect(self, calibrate: bool = True) -> None:
        self._file = Path(self.config.file or os.devnull).open("a", buffering=1, encoding="utf-8")  # noqa: SIM115 - until disconnect

    def calibrate(self) -> None: ...

    def configure(self) -> None: ...

    def get_action(self) -> dict[str, Any]:
        now = time.monotonic()
        self._file.write(f"{now}\n")
        # To and fro in four seconds, without a pause at the ends.
        share = abs((now / 2) % 2 - 1) * 2 - 1
        return dict.fromkeys(self.config.joints, self.config.middle + self.config.reach * share)

    def send_feedback(self, feedback: dict[str, Any]) -> None: ...

    def disconnect(self) -> None:
        self._file.close()
        self._file = None
