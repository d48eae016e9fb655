"""The linear rail Tarn TR-12 as a robot of strands-robots."""

from tarn_rail.robot import TarnRail

__all__ = ["TarnRail"]
