from __future__ import annotations

import importlib.metadata
from pathlib import Path
from typing import Any

import pytest
from fixtures.certificates import Authority
from fixtures.dds_pki import DdsPki, governance

from strands_robots.drivers.ros.rtps_robot import RtpsRobot
from strands_robots.hardware_rtps_bridge import HardwareRtpsBridge
from strands_robots.ros.dds import REQUIRED, DdsLink, checked_credentials, governance_gap
from strands_robots.utils import ValidationError

DOMAIN = 7
TOPIC = "rt/my_arm/joint_command"
OLD = importlib.metadata.version("cyclonedds").startswith("0.10.")


@pytest.fixture
def pki(tmp_path: Path) -> DdsPki:
    return DdsPki(tmp_path / "pki", DOMAIN)


@pytest.fixture
def member(pki: DdsPki) -> dict[str, str]:
    return pki.member("alice", publish=(TOPIC,))


@pytest.mark.skipif(OLD, reason="this Cyclone DDS has DDS Security")
@pytest.mark.parametrize(
    "make",
    [
        lambda config: DdsLink(DOMAIN, dds_security_config=config),
        lambda config: RtpsRobot("rover", "/cmd_vel", domain_id=DOMAIN, dds_security_config=config),
        lambda config: HardwareRtpsBridge(domain_id=DOMAIN, dds_security_config=config),
    ],
)
def test_library_without_the_plugins_is_refused_with_installation_advice(make: Any, member: dict[str, str]) -> None:
    with pytest.raises(ValidationError, match=r"no DDS Security plugins.*cyclonedds 0\.10\.5 built on Debian"):
        make(member)


def test_paths_and_file_and_data_uris_name_the_same_credentials(member: dict[str, str]) -> None:
    ca = Path(member["identity_ca"])
    for value in (str(ca), f"file:{ca}", f"file://{ca}"):
        read = checked_credentials({**member, "identity_ca": value})
        assert read is not None
        assert read.uris["identity_ca"] == f"file:{ca}"
    given = checked_credentials({**member, "identity_ca": f"data:,{ca.read_text()}"})
    assert given is not None
    assert given.document("identity_ca") == ca.read_bytes()


def test_permissions_authority_defaults_to_the_identity_authority(member: dict[str, str]) -> None:
    alone = {key: member[key] for key in REQUIRED}
    read = checked_credentials(alone)
    assert read is not None
    assert read.uris["permissions_ca"] == read.uris["identity_ca"]
    assert checked_credentials(None) is None


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"certificate": None}, "certificate'] must be a path"),
        ({"certificate": ""}, "certificate'] must be a path"),
        ({"certificate": "  "}, "certificate'] must be a path"),
        ({"certificate": "data:,"}, "another scheme"),
        ({"certificate": "pkcs11:object=alice"}, "another scheme"),
        ({"certificate": "file://elsewhere/alice.pem"}, "another scheme"),
        ({"certificate": "/nowhere/alice.pem"}, "must name a readable file, not '/nowhere/alice.pem'"),
        ({"permissions_ca": 3}, "permissions_ca'] must be a path"),
        ({"password": "x"}, "an unknown password"),
    ],
)
def test_invalid_credential_is_refused_by_name(change: dict[str, Any], named: str, member: dict[str, str]) -> None:
    with pytest.raises(ValidationError) as refused:
        checked_credentials({**member, **change})
    assert named in str(refused.value)


@pytest.mark.parametrize("missing", REQUIRED)
def test_a_missing_credential_is_named(missing: str, member: dict[str, str]) -> None:
    del member[missing]
    with pytest.raises(ValidationError, match=f"it has no {missing}"):
        checked_credentials(member)


def test_credentials_must_be_an_object() -> None:
    with pytest.raises(ValidationError, match="not list"):
        checked_credentials(["identity_ca"])


def test_no_refusal_and_no_repr_shows_a_key(member: dict[str, str]) -> None:
    key = Path(member["private_key"]).read_text()
    for value in (key, f"data:{key}"):
        with pytest.raises(ValidationError) as refused:
            checked_credentials({**member, "private_key": value})
        assert key.splitlines()[1][:20] not in str(refused.value)
    assert key.splitlines()[1][:20] not in repr(checked_credentials({**member, "private_key": f"data:,{key}"}))


def test_a_key_of_another_certificate_is_refused(member: dict[str, str], pki: DdsPki, tmp_path: Path) -> None:
    other = Authority(tmp_path / "other").issue("alice")
    with pytest.raises(ValidationError, match="must be the PEM key"):
        checked_credentials({**member, "private_key": str(other.key)})
    with pytest.raises(ValidationError, match="must be the PEM key"):
        checked_credentials({**member, "private_key": member["governance"]})


def signed(tmp_path: Path, laws: str) -> bytes:
    return Authority(tmp_path / "authority").signed(laws)


def test_a_strict_governance_leaves_a_topic_closed(tmp_path: Path) -> None:
    assert governance_gap(signed(tmp_path, governance(DOMAIN)), DOMAIN, TOPIC) is None
    ranged = governance(DOMAIN).replace(f"<id>{DOMAIN}</id>", "<id_range><min>3</min><max>9</max></id_range>")
    assert governance_gap(signed(tmp_path, ranged), DOMAIN, TOPIC) is None
    assert governance_gap(signed(tmp_path, ranged), 10, TOPIC) == "it has no rule for domain 10"


@pytest.mark.parametrize(
    ("laws", "why"),
    [
        (governance(DOMAIN, strangers=True), "allows unauthenticated participants"),
        (governance(DOMAIN, written_by_all=True), f"lets every participant write {TOPIC}"),
        (governance(DOMAIN, kind="NONE"), f"neither signs nor encrypts {TOPIC}"),
        (governance(DOMAIN + 1), f"no rule for domain {DOMAIN}"),
        (governance(DOMAIN).replace("<topic_expression>*", "<topic_expression>rt/odom"), f"no rule for {TOPIC}"),
        ("<dds>", f"no rule for domain {DOMAIN}"),
        ("", f"no rule for domain {DOMAIN}"),
    ],
)
def test_governance_that_leaves_a_topic_open_is_reported_with_the_reason(tmp_path: Path, laws: str, why: str) -> None:
    assert why in (governance_gap(signed(tmp_path, laws), DOMAIN, TOPIC) or "")


def test_first_matching_topic_rule_applies(tmp_path: Path) -> None:
    laws = governance(DOMAIN)
    start, end = laws.index("<topic_rule>"), laws.index("</topic_access_rules>")
    lax = laws[start:end].replace("<topic_expression>*", "<topic_expression>rt/*_arm/*").replace("true", "false")
    assert "lets every participant write" in str(
        governance_gap(signed(tmp_path, laws[:start] + lax + laws[start:]), DOMAIN, TOPIC),
    )
    assert governance_gap(signed(tmp_path, laws[:end] + lax + laws[end:]), DOMAIN, TOPIC) is None
