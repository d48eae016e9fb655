"""Where a local teleoperation puts its leader's frames, so that others may follow them over the mesh."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from strands_robots.mesh import topics

if TYPE_CHECKING:
    from strands_robots.mesh.core import Mesh


class MeshInputSink:
    """The sink of ``teleoperate(publish=True)``: the frames that :class:`~strands_robots.mesh.input.InputReceiver`
    hears, of a leader that drives a body here as well."""

    def __init__(self, mesh: Mesh) -> None:
        self._mesh = mesh

    def publish(self, device: str, method: str, action: Mapping[str, float], events: Mapping[str, Any] | None) -> None:
        """Send one frame. Raises what the mesh raises; the follower here goes on."""
        frame = {
            "peer_id": self._mesh.peer_id,
            "device": device,
            "method": method,
            "t": self._mesh.now(),
            "seq": self._mesh.next_input(device),
            "action": dict(action),
            "events": None if events is None else {str(key): bool(value) for key, value in events.items()},
        }
        self._mesh.publish(topics.input_stream(self._mesh.peer_id, device), frame)
