"""Reasons of a failed connection, in words."""

from __future__ import annotations

import errno
import socket
import ssl

_WORDS = {
    errno.ECONNREFUSED: "nothing listens there",
    errno.ECONNRESET: "it cut the connection",
    errno.EPIPE: "it cut the connection",
    errno.EADDRINUSE: "another program holds the port",
    errno.EHOSTUNREACH: "there is no route to it",
    errno.ENETUNREACH: "there is no route to it",
    errno.EADDRNOTAVAIL: "this machine has no such address",
    errno.EACCES: "this user may not open that port",
}


def reason_of(error: BaseException) -> str:
    """Return why a connection failed, as the end of a sentence."""
    if isinstance(error, ssl.SSLCertVerificationError):
        return f"its certificate is refused: {error.verify_message.rstrip('.')}"
    if isinstance(error, ssl.SSLError):
        alert = (error.reason or str(error)).replace("_", " ").lower()
        if "key values mismatch" in alert:
            return "our key is not that of our certificate"
        if error.library in ("X509", "PEM") or "pem" in alert.split():
            return "our certificates are no PEM files that fit; doctor, with the same flags, names the file"
        _, refused, why = alert.partition("alert ")
        if refused:
            return f"it refuses our certificate: {why}"
        return f"it does not speak TLS as we do: {alert}"
    if isinstance(error, socket.gaierror):
        return "no such host is known"
    if isinstance(error, TimeoutError):
        return "no answer in time"
    if isinstance(error, OSError):
        # asyncio gives the system's number with words of its own.
        return _WORDS.get(error.errno or 0, error.strerror or str(error))
    return str(error)
