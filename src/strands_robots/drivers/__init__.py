"""Native drivers: robots that are reached without LeRobot."""

from typing import TYPE_CHECKING

from strands_robots.moved import getter

if not TYPE_CHECKING:  # a package with a __getattr__ has every name for a type checker
    __getattr__ = getter(__name__)
