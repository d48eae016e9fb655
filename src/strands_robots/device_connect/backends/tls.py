"""TLS of a link: the context of its clients."""

from __future__ import annotations

import ssl
import tempfile
from pathlib import Path

from .config import LinkConfig


def client_context(link: LinkConfig) -> ssl.SSLContext:
    """Return a context that trusts the stated authority alone, else the system's."""
    stated = {"cadata" if link.ca.lstrip().startswith("-----BEGIN") else "cafile": link.ca} if link.ca else {}
    context = ssl.create_default_context(**stated)  # type: ignore[arg-type]  # both keys take text
    context.check_hostname = link.verify_hostname
    if link.cert:
        _load_identity(context, link.cert, link.key)
    return context


def _load_identity(context: ssl.SSLContext, cert: str, key: str) -> None:
    """Load certificate and key, which the standard library reads from files only."""
    if not cert.lstrip().startswith("-----BEGIN"):
        context.load_cert_chain(cert, key)
        return
    with tempfile.TemporaryDirectory(prefix="strands-") as folder:
        both = Path(folder, "identity.pem")
        both.touch(mode=0o600)
        both.write_text(f"{cert}\n{key}\n")
        context.load_cert_chain(both)
