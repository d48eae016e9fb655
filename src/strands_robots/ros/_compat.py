"""The one place that uses private members of cyclonedds, which is pinned to 11.0 for it."""

from __future__ import annotations

from typing import Any

from cyclonedds.idl._machinery import BytesMachine


def pack_as_bytes(struct: Any, *members: str) -> None:
    """Serialize these ``sequence[byte]`` members of an IDL struct from and to ``bytes``, in one piece.

    The library packs one Python integer at a time, tens of milliseconds for a small image. The bytes on the wire
    and the type that peers see are the same.
    """
    machine: Any = BytesMachine
    idl = struct.__idl__
    idl.populate()
    for member in members:
        idl.v1_machine.members_machines[member] = machine()
        idl.v2_machine.members_machines[member] = machine()
