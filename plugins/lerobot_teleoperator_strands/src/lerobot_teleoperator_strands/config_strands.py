"""Options ``--teleop.…`` of a served robot that leads."""

from __future__ import annotations

from dataclasses import dataclass

from lerobot.teleoperators import TeleoperatorConfig


@TeleoperatorConfig.register_subclass("strands")
@dataclass(kw_only=True)
class StrandsTeleoperatorConfig(TeleoperatorConfig):  # type: ignore[misc]
    """A robot that ``strands-robots serve`` has on the network, and that is only read.

    Attributes:
        peer_id: its id there, such as ``leader-1``; a robot of a world of several is ``WORLD/ROBOT``.
        fleet: connection profile by which it is reached; empty for this machine, or what the environment names.
        max_age_s: age of a reading beyond which the command ends.
    """

    peer_id: str
    fleet: str = ""
    max_age_s: float = 0.3
