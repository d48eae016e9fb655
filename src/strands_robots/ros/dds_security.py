"""DDS Security of a participant: credentials, plugins and governance.

The names of the properties are those of the OMG's DDS Security 1.1; the plugins are the ones built with Cyclone DDS.
"""

from __future__ import annotations

import contextlib
import os
import ssl
import threading
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from email import message_from_bytes
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from strands_robots.ros.link import RosError
from strands_robots.utils import ValidationError

REQUIRED = ("identity_ca", "certificate", "private_key", "governance", "permissions")
OPTIONAL = ("permissions_ca",)

_FILE, _DATA = "file:", "data:,"
_LONGEST = 100_000
_PROPERTIES = {
    "identity_ca": "dds.sec.auth.identity_ca",
    "certificate": "dds.sec.auth.identity_certificate",
    "private_key": "dds.sec.auth.private_key",
    "permissions_ca": "dds.sec.access.permissions_ca",
    "governance": "dds.sec.access.governance",
    "permissions": "dds.sec.access.permissions",
}
_PLUGINS = (
    ("auth", "libdds_security_auth.so", "authentication"),
    ("access", "libdds_security_ac.so", "access_control"),
    ("crypto", "libdds_security_crypto.so", "crypto"),
)

_presented: dict[int, DdsCredentials] = {}
_presenting = threading.Lock()


@dataclass(frozen=True, slots=True)
class DdsCredentials:
    """The checked credentials of one participant, as URIs; never printed."""

    uris: Mapping[str, str] = field(repr=False)

    def document(self, name: str) -> bytes:
        """Return the content of one of them, such as the signed ``governance``."""
        uri = self.uris[name]
        return uri.removeprefix(_DATA).encode() if uri.startswith(_DATA) else Path(uri.removeprefix(_FILE)).read_bytes()

    def policies(self, qos: Any) -> list[Any]:
        """Return property policies of a participant for the given ``cyclonedds.qos``.

        Raises:
            ValidationError: the loaded Cyclone DDS has no DDS Security.
        """
        found = {_PROPERTIES[name]: uri for name, uri in self.uris.items()}
        folder = _plugin_folder()
        for role, file, called in _PLUGINS:
            loaded = {"path": str(folder / file), "init": f"init_{called}", "finalize": f"finalize_{called}"}
            found |= {".".join(("dds.sec", role, "library", part)): value for part, value in loaded.items()}
        return [qos.Policy.Property(key, value) for key, value in found.items()]


def checked_credentials(config: object) -> DdsCredentials | None:
    """Check a ``dds_security_config`` and return its credentials; None stays None.

    Values are paths or ``file:`` or ``data:,`` URIs. The permissions CA is the identity CA unless it is given. No
    message shows a value that may be a key.

    Raises:
        ValidationError: a key is missing or unknown, a value names no readable file and is no ``data:,`` URI, or the
            private key is not that of the certificate.
    """
    if config is None:
        return None
    if not isinstance(config, dict):
        raise ValidationError(f"dds_security_config must be an object of paths by name, not {type(config).__name__}.")
    missing = [key for key in REQUIRED if key not in config]
    unknown = sorted(str(key) for key in config if key not in REQUIRED + OPTIONAL)
    if missing or unknown:
        wrong = [f"no {key}" for key in missing] + [f"an unknown {key}" for key in unknown]
        raise ValidationError(
            f"dds_security_config must have {', '.join(REQUIRED)} and may have permissions_ca; it has "
            f"{' and '.join(wrong)}."
        )
    uris = {key: _uri(f"dds_security_config[{key!r}]", value) for key, value in config.items()}
    uris.setdefault("permissions_ca", uris["identity_ca"])
    credentials = DdsCredentials(uris)
    _check_key(credentials)
    return credentials


@contextlib.contextmanager
def presenting(domain_id: int, credentials: DdsCredentials | None) -> Iterator[None]:
    """Join a domain with ``credentials`` inside this context, one thread at a time.

    The access control of Cyclone DDS 0.10 keeps the governance and permissions of the first participant of a domain
    for every later one of the process, so this refuses other credentials, which the library would ignore.

    Raises:
        RosError: this process has presented other credentials in this domain.
    """
    with _presenting:
        if credentials is not None and _presented.get(domain_id, credentials) != credentials:
            raise RosError(
                f"This process has presented other credentials in DDS domain {domain_id}; use another process."
            )
        yield
        if credentials is not None:
            _presented[domain_id] = credentials


def _check_key(credentials: DdsCredentials) -> None:
    # The plugins accept a key that does not fit and then fail with every peer.
    with contextlib.ExitStack() as files:
        names = []
        for name in ("certificate", "private_key"):
            # In memory, because a key given as data has no business on a disk.
            file = files.enter_context(os.fdopen(os.memfd_create(name), "wb"))
            file.write(credentials.document(name))
            file.flush()
            names.append(f"/proc/self/fd/{file.fileno()}")
        try:
            ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT).load_cert_chain(names[0], names[1], password=lambda: "")
        except (ssl.SSLError, ValueError) as exc:
            raise ValidationError(
                "dds_security_config['private_key'] must be the PEM key of dds_security_config['certificate'], without "
                "a passphrase; it is not."
            ) from exc


def _uri(name: str, value: object) -> str:
    domain = f"{name} must be a path, a file: URI or a data:, URI of 1 to {_LONGEST} characters"
    if not isinstance(value, str):
        raise ValidationError(f"{domain}, not {type(value).__name__}.")
    if not value.strip() or len(value) > _LONGEST or "\0" in value:
        raise ValidationError(f"{domain}, not one of {len(value)}.")
    if value.startswith(_DATA) and value != _DATA:
        return value
    path = value.removeprefix(_FILE).removeprefix("//" if value.startswith("file:///") else "")
    if not path.isprintable() or path.startswith(("data:", "pkcs11:", "//")):
        raise ValidationError(f"{domain}; this one has another scheme, a host or control characters.")
    file = Path(path).absolute()
    if not (file.is_file() and os.access(file, os.R_OK)):
        raise ValidationError(f"{name} must name a readable file, not {str(file)!r}.")
    return f"{_FILE}{file}"


def _plugin_folder() -> Path:
    library = _loaded_library()
    if library is not None:
        # Upstream installs the plugins beside the library, Debian in a folder of the library's name.
        for folder in (library.parent, *sorted(library.parent.glob("libddsc*/"))):
            if all((folder / file).is_file() for _, file, _ in _PLUGINS):
                return folder
    raise ValidationError(
        f"dds_security_config cannot be honoured: the Cyclone DDS of this process ({library or 'not found'}) has no "
        "DDS Security plugins, and no wheel of cyclonedds 11 brings them; use cyclonedds 0.10.5 built on Debian's "
        "cyclonedds-dev, which scripts/dds-security.sh of this project does."
    )


def _loaded_library() -> Path | None:
    """Return the file of the loaded Cyclone DDS, on Linux."""
    maps = Path("/proc/self/maps")
    lines = maps.read_text().splitlines() if maps.exists() else []
    paths = (Path(line.split(maxsplit=5)[5]) for line in lines if "/libddsc" in line)
    return next((path for path in paths if path.name.startswith("libddsc")), None)


def governance_gap(document: bytes, domain_id: int, topic: str) -> str | None:
    """Return how a governance document lets a stranger write ``topic``, or None.

    The documents are those of DDS Security 1.1, section 9.4.1.2: XML inside S/MIME. The plugins check the signature.

    Args:
        document: the signed document.
        domain_id: the DDS domain.
        topic: the topic's name on the wire, such as ``rt/cmd_vel``.
    """
    rule = _domain_rule(document, domain_id)
    if rule is None:
        return f"it has no rule for domain {domain_id}"
    if _flag(rule, "allow_unauthenticated_participants"):
        return "it allows unauthenticated participants"
    topics = rule.iterfind("topic_access_rules/topic_rule")
    # The first rule that fits is the one that counts.
    fitting = next((each for each in topics if fnmatchcase(topic, _text(each, "topic_expression"))), None)
    if fitting is None:
        return f"it has no rule for {topic}"
    if not _flag(fitting, "enable_write_access_control"):
        return f"it lets every participant write {topic}"
    kinds = (_text(rule, "rtps_protection_kind"), _text(fitting, "metadata_protection_kind"))
    if all(kind in ("", "NONE") for kind in (*kinds, _text(fitting, "data_protection_kind"))):
        return f"it neither signs nor encrypts {topic}"
    return None


def _domain_rule(document: bytes, domain_id: int) -> ElementTree.Element | None:
    parts = message_from_bytes(document).walk()
    signed = next((part for part in parts if part.get_content_type() == "text/plain"), None)
    content = signed.get_payload(decode=True) if signed is not None else None
    try:
        root = ElementTree.fromstring(content if isinstance(content, bytes) else b"")
    except ElementTree.ParseError:
        return None
    rules = root.iterfind("domain_access_rules/domain_rule")
    return next((each for each in rules if _covers(each.find("domains"), domain_id)), None)


def _covers(domains: ElementTree.Element | None, domain_id: int) -> bool:
    if domains is None:
        return False
    if any((each.text or "").strip() == str(domain_id) for each in domains.iterfind("id")):
        return True
    for span in domains.iterfind("id_range"):
        low, high = _text(span, "min") or "0", _text(span, "max") or str(domain_id)
        if low.isdecimal() and high.isdecimal() and int(low) <= domain_id <= int(high):
            return True
    return False


def _flag(rule: ElementTree.Element, name: str) -> bool:
    return _text(rule, name).lower() in ("true", "1")


def _text(rule: ElementTree.Element, name: str) -> str:
    return (rule.findtext(name) or "").strip()
