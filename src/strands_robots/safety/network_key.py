"""Name of a network, so that a robot is asked for where it is."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass
from urllib.parse import quote, unquote

from strands_robots.utils import ValidationError

DEVICE_CONNECT, MESH = "device-connect", "mesh"
KINDS = (DEVICE_CONNECT, MESH)

ENDPOINTS_MAX = 64
TEXT_MAX = 4096
NOWHERE = "nowhere"
PLAIN = "/:@!$&'()*+,;=[]"
"""Characters of a tenant that stand in a file as they are, besides letters, digits and ``_.-~``."""


@dataclass(frozen=True, slots=True)
class NetworkKey:
    """One network as this machine reaches it.

    Attributes:
        kind: :data:`DEVICE_CONNECT` or :data:`MESH`.
        where: endpoints, server lists or the meeting point, without credentials; sorted.
        tenant: of Device Connect; the mesh has the default one.
    """

    kind: str
    where: tuple[str, ...]
    tenant: str = "default"

    @classmethod
    def of(cls, kind: str, endpoints: Iterable[str], tenant: str = "default") -> NetworkKey:
        """Return the key for these endpoints, which may be written in several ways.

        Without an endpoint it is :data:`NOWHERE`; a list that is too long for a file becomes its hash.
        """
        where = tuple(sorted({_plain(each) for each in endpoints} - {""})) or (NOWHERE,)
        key = cls(kind, where[:ENDPOINTS_MAX], tenant or "default")
        if len(key.text) <= TEXT_MAX:
            return key
        return cls(kind, (f"sha256-{hashlib.sha256(','.join(where).encode()).hexdigest()}",), key.tenant)

    @classmethod
    def parse(cls, text: str) -> NetworkKey:
        """Read what :attr:`text` wrote.

        Raises:
            ValidationError: it is no network key.
        """
        kind, _, rest = text.partition(" ")
        tenant, _, where = rest.partition(" ")
        if len(text) > TEXT_MAX or kind not in KINDS or not tenant or not where:
            raise ValidationError(f"network must be kind, tenant and endpoints, not {text[:80]!r}.")
        return cls(kind, tuple(where.split(",")), unquote(tenant))

    @property
    def text(self) -> str:
        """The key in one line, for a file."""
        return f"{self.kind} {quote(self.tenant, safe=PLAIN)} {','.join(self.where)}"

    def meets(self, other: NetworkKey) -> bool:
        """True when both have one kind and tenant, and a common endpoint."""
        return (self.kind, self.tenant) == (other.kind, other.tenant) and not set(self.where).isdisjoint(other.where)

    def joins(self, other: NetworkKey) -> bool:
        """True where callers of both take an id for one robot.

        Of two on Device Connect it is the probe that says so.
        """
        return self.tenant == other.tenant and (self.kind != other.kind or (self.kind == MESH and self.may_be(other)))

    def may_be(self, other: NetworkKey) -> bool:
        """False for another kind or tenant, or other ports of this machine."""
        if (self.kind, self.tenant) != (other.kind, other.tenant):
            return False
        return self.meets(other) or not all(each.startswith("127.0.0.1:") for each in (*self.where, *other.where))


NO_NETWORK = NetworkKey("", (NOWHERE,))
"""Where a robot is of which that is not known."""


def _plain(endpoint: str) -> str:
    """Return an endpoint as host and port, without credentials and scheme."""
    rest = endpoint.strip().lower().rsplit("@", 1)[-1]
    rest = rest.partition("://")[2] or rest
    rest = rest.partition("/")[2] if rest.split("/", 1)[0] in ("tcp", "tls", "quic", "udp", "ws", "wss") else rest
    rest = rest.split("#", 1)[0].split("?", 1)[0].rstrip("/")
    host, colon, port = rest.rpartition(":")
    here = host in ("localhost", "[::1]", "0.0.0.0", "[::]", "127.0.0.1")
    return f"127.0.0.1{colon}{port}" if here else rest.replace(",", "_").replace(" ", "_")
