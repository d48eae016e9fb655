"""Use of one private member of the mcap library, as its 1.x releases have it."""

from __future__ import annotations

from typing import Any


def close_chunk(writer: Any) -> None:
    """Write the open chunk, which the library closes only when full or at the end."""
    writer._Writer__finalize_chunk()
