"""Emulated servos of an SO-100 or SO-101, on a pseudo-terminal.

LeRobot's driver opens the port as that of a real arm. What a real servo does with a goal that it was given before its
torque came on is not modelled: here it keeps it.
"""

from __future__ import annotations
