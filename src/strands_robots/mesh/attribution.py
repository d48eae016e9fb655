"""Whose message is this? The one table that binds a peer's name to the session it announced itself from."""

from __future__ import annotations

from enum import Enum

from strands_robots.mesh.transport import Sample


class Attribution(Enum):
    """Whether a sample is of the peer it names, and why not."""

    BOUND = "the session the peer announced itself from"
    PINNED = "no session on this transport; the broker's policy pins the topic"
    OTHER = "another session than the peer announced itself from"
    MISSING = "no session, and the peer announced itself from one"
    UNKNOWN = "the peer was never seen"

    @property
    def accepted(self) -> bool:
        """A reply counts."""
        return self in (Attribution.BOUND, Attribution.PINNED)

    @property
    def proven(self) -> bool:
        """Good enough to move metal: a topic that anybody may write to pins nobody."""
        return self is Attribution.BOUND


def attribute(bound: str | None, sample: Sample) -> Attribution:
    """Compare the session bound to a peer with the one on a sample."""
    if bound is not None:
        if sample.session == bound:
            return Attribution.BOUND
        return Attribution.OTHER if sample.session is not None else Attribution.MISSING
    return Attribution.PINNED if sample.session is None and sample.sessionless else Attribution.UNKNOWN
