"""Private members of cyclonedds 11.0 (pinned for them) and 0.10.5."""

from __future__ import annotations

import ctypes
from typing import Any

from cyclonedds.idl._machinery import BytesMachine

from strands_robots.bounded_json import OutOfBoundsError

# The version decides whether there is a v0 or a v1 machine.
_MACHINES = ("v0_machine", "v1_machine", "v2_machine")


def pack_as_bytes(struct: Any, *members: str) -> None:
    """Serialize these ``sequence[byte]`` members of a struct as ``bytes``.

    The library packs one Python integer at a time, tens of milliseconds for a small image. The bytes on the wire
    and the type that peers see are the same.
    """
    machine: Any = BytesMachine
    idl = struct.__idl__
    idl.populate()
    for version in _MACHINES:
        members_machines = getattr(getattr(idl, version, None), "members_machines", {})
        for member in members:
            members_machines[member] = machine()


def bound_samples(struct: Any, longest: int) -> None:
    """Refuse to decode samples of a struct that are longer, in bytes."""
    decode = struct.deserialize

    def deserialize(data: bytes, *arguments: Any, **options: Any) -> Any:
        if len(data) > longest:
            raise OutOfBoundsError(f"it has {len(data)} bytes, and at most {longest} are read")
        return decode(data, *arguments, **options)

    struct.deserialize = deserialize


def subscribed(writer: Any) -> bool:
    """Return True while a subscription matches; 0.10.5 offers this in C only."""
    if hasattr(writer, "get_matched_subscriptions"):
        return bool(writer.get_matched_subscriptions())
    return int(writer._dll_handle.dds_get_matched_subscriptions(writer._ref, None, ctypes.c_size_t(0))) > 0
