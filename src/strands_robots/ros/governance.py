"""What a signed DDS governance document leaves open for one topic.

The documents are those of the OMG's DDS Security 1.1, section 9.4.1.2: XML inside S/MIME. The signature is the
plugins' to check; this module reads what was signed.
"""

from __future__ import annotations

from email import message_from_bytes
from fnmatch import fnmatchcase
from xml.etree import ElementTree

TRUE = ("true", "1")


def opening(document: bytes, domain_id: int, topic: str) -> str | None:
    """What lets a stranger write ``topic`` (its name on the wire, such as ``rt/cmd_vel``); None where nothing does."""
    rule = _domain_rule(document, domain_id)
    if rule is None:
        return f"it has no rule for domain {domain_id}"
    if _flag(rule, "allow_unauthenticated_participants"):
        return "it allows unauthenticated participants"
    topics = rule.iterfind("topic_access_rules/topic_rule")
    # The first rule that fits is the one that counts.
    fitting = next((each for each in topics if fnmatchcase(topic, _said(each, "topic_expression"))), None)
    if fitting is None:
        return f"it has no rule for {topic}"
    if not _flag(fitting, "enable_write_access_control"):
        return f"it lets everybody write {topic}"
    kinds = (_said(rule, "rtps_protection_kind"), _said(fitting, "metadata_protection_kind"))
    if all(kind in ("", "NONE") for kind in (*kinds, _said(fitting, "data_protection_kind"))):
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
        low, high = _said(span, "min") or "0", _said(span, "max") or str(domain_id)
        if low.isdecimal() and high.isdecimal() and int(low) <= domain_id <= int(high):
            return True
    return False


def _flag(rule: ElementTree.Element, name: str) -> bool:
    return _said(rule, name).lower() in TRUE


def _said(rule: ElementTree.Element, name: str) -> str:
    return (rule.findtext(name) or "").strip()
