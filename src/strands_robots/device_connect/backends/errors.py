"""What goes wrong on a link, besides the framework's own errors."""

from __future__ import annotations

from device_connect_edge.messaging.exceptions import PublishError, RequestTimeoutError


class NoResponderError(RequestTimeoutError, PublishError):  # type: ignore[misc]  # the framework has no type information
    """Nobody serves the subject, known at once and not after the deadline.

    The framework raises ``RequestTimeoutError`` for this over Zenoh and ``PublishError`` over NATS; this is both.
    """
