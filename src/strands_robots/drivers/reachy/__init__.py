"""Driver of Pollen's Reachy Mini through its daemon; loads third parties on use."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from strands_robots.drivers.reachy.driver import ReachyDriver

__all__ = ["ReachyDriver"]


def __getattr__(name: str) -> Any:
    if name == "ReachyDriver":
        from strands_robots.drivers.reachy.driver import ReachyDriver  # noqa: PLC0415 - loaded on use

        return ReachyDriver
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
