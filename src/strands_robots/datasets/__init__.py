"""Datasets of robots in LeRobot's format v3.0, one file an episode.

A saved episode is on the disk, whole and indexed. What was running is removed at the next opening. Needs the extra
``dataset``; torch and LeRobot are not needed.
"""

from strands_robots.datasets.episodes import Dataset, DatasetEpisode
from strands_robots.datasets.layout import DatasetError, DatasetInfo, Feature

__all__ = ["Dataset", "DatasetEpisode", "DatasetError", "DatasetInfo", "Feature"]
