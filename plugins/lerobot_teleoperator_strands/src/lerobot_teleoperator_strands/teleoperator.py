"""A served robot as LeRobot's ``Teleoperator``."""

from __future__ import annotations

from typing import Any

from lerobot.teleoperators import Teleoperator
from lerobot_robot_strands.ending import RobotEndedError
from lerobot_robot_strands.newest import Newest
from lerobot_robot_strands.served import MadeElsewhere, ServedRobot

from lerobot_teleoperator_strands.config_strands import StrandsTeleoperatorConfig

STATE_HZ = 60.0


class StrandsTeleoperator(MadeElsewhere, Teleoperator):  # type: ignore[misc]
    """A served robot whose measured joints are the actions. It is only read, and moved by whoever else moves it.

    Args:
        config: names it; see :class:`StrandsTeleoperatorConfig`.
    """

    config_class = StrandsTeleoperatorConfig
    name = "strands"

    def __init__(self, config: StrandsTeleoperatorConfig) -> None:
        super().__init__(config)
        self.config = config
        self._served = ServedRobot(config.peer_id, config.fleet)
        self._state: Newest[dict[str, float]] | None = None

    @property
    def action_features(self) -> dict[str, Any]:
        return dict.fromkeys(self._served.measured, float)

    @property
    def feedback_features(self) -> dict[str, Any]:
        """None: it is only read."""
        return {}

    @property
    def is_connected(self) -> bool:
        return self._state is not None

    def connect(self, calibrate: bool = True) -> None:
        """Begin to read it.

        Raises:
            RobotEndedError: it is not in reach.
        """
        del calibrate
        if self._state is not None:
            raise RobotEndedError(f"strands: {self._served.id} is connected already.")
        if not self.action_features:
            return
        state = Newest(f"the state of {self._served.id}", self._served.reader(), STATE_HZ, self.config.max_age_s)
        try:
            state.first()
        except RobotEndedError:
            state.close()
            self._served.close()
            raise
        self._state = state

    def get_action(self) -> dict[str, Any]:
        """Return its newest joints, without waiting.

        Raises:
            RobotEndedError: it is not connected, or its newest reading is too old.
        """
        if self._state is None:
            raise RobotEndedError(f"strands: {self._served.id} is not connected.")
        joints = self._state.take()
        return {name: joints[own] for name, own in self._served.measured.items() if own in joints}

    def send_feedback(self, feedback: dict[str, Any]) -> None:
        """Do nothing: it is only read."""

    def disconnect(self) -> None:
        """Read it no more, and leave the network."""
        state, self._state = self._state, None
        if state is not None:
            state.close()
            self._served.close()
