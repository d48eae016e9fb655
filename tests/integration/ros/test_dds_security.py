"""Members, strangers and listeners of a secured DDS graph, each a process of its own on loopback."""

from __future__ import annotations

import importlib.metadata
import socket
import subprocess
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from fixtures.certificates import Authority
from fixtures.child import Child
from fixtures.dds_pki import DdsPki, governance
from fixtures.ros_bases import OPEN
from fixtures.taking_arm import TakingArm
from fixtures.waiting import eventually

from strands_robots.drivers.ros.rtps_robot import RtpsRobot
from strands_robots.hardware_rtps_bridge import HardwareRtpsBridge
from strands_robots.ros.dds import DdsLink
from strands_robots.ros.link import RosError
from strands_robots.utils import ValidationError

ROOT = Path(__file__).resolve().parents[3]
HAS_PLUGINS = importlib.metadata.version("cyclonedds").startswith("0.10.")
pytestmark = [
    pytest.mark.system,
    pytest.mark.skipif(not HAS_PLUGINS, reason="needs a Cyclone DDS with DDS Security: make dds-security"),
]

DOMAIN = 90
CMD, ODOM, ARM = "/cmd_vel", "/odom_of_ours", "/my_arm/joint_command"
TWIST, ODOMETRY, JOINTS = "geometry_msgs/msg/Twist", "nav_msgs/msg/Odometry", "sensor_msgs/msg/JointState"
SPEED = {"linear": {"x": 0.25}}
SECRET = "base_footprint_of_ours"

Peer = Callable[[dict[str, str] | None], Child]


def publish_until_received(speaker: Child, listener: Child, fields: dict[str, Any]) -> None:
    """Publish again and again: a first message may go out before the other participant has the keys to read it."""
    began = len(listener.ask("received"))

    def received() -> bool:
        speaker.ask("publish", CMD, TWIST, fields)
        return len(listener.ask("received")) > began

    eventually(received)


@pytest.fixture(scope="module")
def pki(tmp_path_factory: pytest.TempPathFactory) -> DdsPki:
    return DdsPki(tmp_path_factory.mktemp("pki"), DOMAIN)


@pytest.fixture(scope="module")
def alice(pki: DdsPki) -> dict[str, str]:
    """May publish velocities and joint commands, and read velocities."""
    return pki.member("alice", publish=("rt/cmd_vel", "rt/my_arm/joint_command"), subscribe=("rt/cmd_vel",))


@pytest.fixture(scope="module")
def bob(pki: DdsPki) -> dict[str, str]:
    """May read velocities and joint commands, and publish odometry."""
    return pki.member("bob", publish=("rt/odom_of_ours",), subscribe=("rt/cmd_vel", "rt/my_arm/joint_command"))


@pytest.fixture(scope="module")
def mallory(pki: DdsPki) -> dict[str, str]:
    """Has a copy of the graph's documents and a certificate of an authority that is unknown there."""
    rogue = Authority(pki.folder, "rogue")
    return pki.member("alice", publish=("rt/cmd_vel",), subscribe=("rt/cmd_vel", "rt/odom_of_ours"), identities=rogue)


@pytest.fixture
def peer() -> Iterator[Peer]:
    made: list[Child] = []

    def start(security: dict[str, str] | None) -> Child:
        made.append(Child("fixtures.dds_member", {"domain_id": DOMAIN, "security": security}))
        return made[-1]

    yield start
    for each in made:
        each.close()


@pytest.fixture(scope="module")
def us(pki: DdsPki) -> dict[str, str]:
    """The one identity of this process, which drives a base and has an arm."""
    return pki.member("us", publish=("rt/cmd_vel",), subscribe=("rt/my_arm/joint_command",))


def test_a_granted_topic_can_be_published(peer: Peer, alice: dict[str, str], bob: dict[str, str]) -> None:
    listener, speaker = peer(bob), peer(alice)
    listener.ask("watch", CMD, TWIST)
    publish_until_received(speaker, listener, SPEED)
    assert listener.ask("received")[0]["linear"]["x"] == 0.25


def test_a_topic_that_is_not_granted_can_be_neither_published_nor_read(
    peer: Peer, alice: dict[str, str], bob: dict[str, str]
) -> None:
    speaker, listener = peer(alice), peer(bob)
    with pytest.raises(RuntimeError, match=r"/odom_of_ours cannot be published.*NOT_ALLOWED_BY_SECURITY"):
        speaker.ask("publish", ODOM, ODOMETRY, {})
    with pytest.raises(RuntimeError, match=r"/odom_of_ours cannot be read.*NOT_ALLOWED_BY_SECURITY"):
        speaker.ask("watch", ODOM, ODOMETRY)
    with pytest.raises(RuntimeError, match=r"/cmd_vel cannot be published.*NOT_ALLOWED_BY_SECURITY"):
        listener.ask("publish", CMD, TWIST, SPEED)


@pytest.mark.parametrize("stranger_is", ["mallory", "without credentials"])
def test_a_stranger_can_neither_publish_nor_read(
    stranger_is: str, request: pytest.FixtureRequest, peer: Peer, alice: dict[str, str], bob: dict[str, str]
) -> None:
    listener, speaker = peer(bob), peer(alice)
    stranger = peer(request.getfixturevalue("mallory") if stranger_is == "mallory" else None)
    listener.ask("watch", CMD, TWIST)
    publish_until_received(speaker, listener, SPEED)
    # It waits for a subscription, several times as long as the members took.
    with pytest.raises(RuntimeError, match="No subscription to /cmd_vel"):
        stranger.ask("publish", CMD, TWIST, {"linear": {"x": 9.0}})
    for _ in range(20):
        stranger.ask("broadcast", CMD, TWIST, {"linear": {"x": 9.0}})
    stranger.ask("watch", CMD, TWIST)
    publish_until_received(speaker, listener, {"linear": {"x": 0.5}})
    assert {each["linear"]["x"] for each in listener.ask("received")} == {0.25, 0.5}
    assert stranger.ask("received") == []


@pytest.mark.parametrize("secured", [True, False])
def test_a_packet_sniffer_reads_an_unsecured_graph_but_not_a_secured_one(
    secured: bool, peer: Peer, pki: DdsPki, bob: dict[str, str]
) -> None:
    try:
        wire = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.ntohs(3))
    except PermissionError:
        pytest.skip("needs root, to listen on the wire")
    reader = pki.member("reader", subscribe=("rt/odom_of_ours",))
    listener, base = peer(reader if secured else None), peer(bob if secured else None)
    seen: list[bytes] = []
    done = threading.Event()

    def sniff() -> None:
        while not done.is_set():
            try:
                seen.append(wire.recv(65535))
            except TimeoutError:
                continue

    with wire:
        wire.bind(("lo", 0))
        wire.settimeout(0.1)
        thread = threading.Thread(target=sniff, name="sniffer")
        thread.start()
        try:
            listener.ask("watch", ODOM, ODOMETRY)

            def received() -> bool:
                base.ask("publish", ODOM, ODOMETRY, {"child_frame_id": SECRET})
                return len(listener.ask("received")) >= 10

            eventually(received)
        finally:
            done.set()
            thread.join(40)
    # The handshake shows permissions before there are keys; nothing else names the topic.
    rtps = [packet.replace(b"<topic>rt/odom_of_ours</topic>", b"") for packet in seen if b"RTPS" in packet]
    assert len(rtps) > 10
    assert any(SECRET.encode() in packet for packet in rtps) is not secured
    assert any(b"rt/odom_of_ours" in packet for packet in rtps) is not secured


@pytest.mark.parametrize("damaged", ["governance", "permissions", "certificate", "identity_ca", "permissions_ca"])
def test_invalid_credentials_prevent_joining_the_domain(
    damaged: str, peer: Peer, alice: dict[str, str], bob: dict[str, str], mallory: dict[str, str], tmp_path: Path
) -> None:
    config = {**alice, damaged: mallory["identity_ca"]}
    if damaged in ("governance", "permissions"):
        document = Path(alice[damaged].removeprefix("file:")).read_bytes()
        tampered = tmp_path / "tampered"
        tampered.write_bytes(document.replace(b"true", b"false").replace(b"rt/cmd_vel", b"*"))
        config[damaged] = str(tampered)
    if damaged == "certificate":
        # The certificate of another member, which these permissions do not name.
        config |= {key: bob[key] for key in ("certificate", "private_key")}
    member = peer(config)
    for _ in range(2):
        with pytest.raises(RuntimeError, match=f"domain {DOMAIN} could not be joined with these credentials"):
            member.ask("join")


def test_a_process_presents_one_set_of_credentials_in_a_domain(us: dict[str, str], alice: dict[str, str]) -> None:
    first, again, other = (DdsLink(DOMAIN, dds_security_config=each) for each in (us, dict(us), alice))
    try:
        first.open()
        again.open()
        with pytest.raises(RosError, match="has presented other credentials"):
            other.open()
    finally:
        first.close()
        again.close()


def test_credentials_may_be_data_uris(alice: dict[str, str], peer: Peer, bob: dict[str, str]) -> None:
    as_data = {key: f"data:,{Path(value.removeprefix('file:')).read_text()}" for key, value in alice.items()}
    listener, speaker = peer(bob), peer(as_data)
    listener.ask("watch", CMD, TWIST)
    publish_until_received(speaker, listener, SPEED)


def test_a_base_on_a_secured_graph_is_driven_and_stopped(peer: Peer, us: dict[str, str], bob: dict[str, str]) -> None:
    base = peer(bob)
    base.ask("watch", CMD, TWIST)
    rover = RtpsRobot("rover", CMD, domain_id=DOMAIN, publish_rate=20, command_gate=OPEN, dds_security_config=us)
    try:
        assert rover.advertise()["status"] == "success"

        def driven() -> bool:
            rover.drive(0.3, 0.0, duration=0.2)
            return any(each["linear"]["x"] == 0.3 for each in base.ask("received"))

        eventually(driven)
        assert rover.stop()["status"] == "success"
        eventually(lambda: base.ask("received")[-1]["linear"]["x"] == 0.0)
    finally:
        rover.disconnect()


def test_an_arm_on_a_secured_graph_takes_commands_from_members_only(
    peer: Peer, us: dict[str, str], alice: dict[str, str]
) -> None:
    arm = TakingArm()
    command = {"name": ["a.pos"], "position": [0.5]}
    bridge = HardwareRtpsBridge(arm, domain_id=DOMAIN, poll_period=0.005, dds_security_config=us)
    try:
        with pytest.raises(RuntimeError, match="No subscription"):
            peer(None).ask("publish", ARM, JOINTS, {"name": ["a.pos"], "position": [9.0]})
        member = peer(alice)
        eventually(lambda: member.ask("publish", ARM, JOINTS, command) or arm.taken)
        assert all(each == {"a.pos": 0.5} for each in arm.taken)
    finally:
        bridge.shutdown()


def test_bridge_without_permission_for_its_command_topic_is_refused(us: dict[str, str]) -> None:
    before = set(threading.enumerate())
    with pytest.raises(RosError, match="/another/joint_command cannot be read"):
        HardwareRtpsBridge(TakingArm(), domain_id=DOMAIN, command_robot_name="another", dds_security_config=us)
    assert set(threading.enumerate()) <= before


@pytest.mark.parametrize(
    ("laws", "open_because"),
    [
        (governance(DOMAIN, strangers=True), "allows unauthenticated participants"),
        (governance(DOMAIN, written_by_all=True), "lets every participant write"),
        (governance(DOMAIN, kind="NONE"), "neither signs nor encrypts"),
        (governance(DOMAIN + 1), f"no rule for domain {DOMAIN}"),
    ],
)
def test_bridge_is_refused_where_the_governance_leaves_its_command_topic_open(
    pki: DdsPki, laws: str, open_because: str
) -> None:
    config = pki.member("lax", subscribe=("rt/my_arm/joint_command",), laws=laws)
    with pytest.raises(ValidationError, match=open_because):
        HardwareRtpsBridge(TakingArm(), domain_id=DOMAIN, dds_security_config=config)


def test_the_documented_key_script_secures_an_arm(tmp_path: Path) -> None:
    for member in ("arm", "controller"):
        subprocess.run([ROOT / "examples/dds_security/make-keys.sh", tmp_path, member], check=True)

    def config(member: str) -> dict[str, str]:
        own = {"certificate": f"{member}.pem", "private_key": f"{member}.key", "permissions": f"{member}.p7s"}
        shared = {"identity_ca": "identity_ca.pem", "permissions_ca": "permissions_ca.pem"}
        files = {**own, **shared, "governance": "governance.p7s"}
        return {key: str(tmp_path / file) for key, file in files.items()}

    arm = TakingArm()
    bridge = HardwareRtpsBridge(arm, command_robot_name="arm", poll_period=0.005, dds_security_config=config("arm"))
    command = {"name": ["a.pos"], "position": [0.5]}
    try:
        with Child("fixtures.dds_member", {"domain_id": 0, "security": config("controller")}) as controller:
            eventually(lambda: controller.ask("publish", "/arm/joint_command", JOINTS, command) or arm.taken)
            controller.ask("watch", "/arm/joint_states", JOINTS)
            eventually(lambda: bridge.publish_joint_states("arm", ["a.pos"], [0.5]) or controller.ask("received"))
            with pytest.raises(RuntimeError, match="NOT_ALLOWED_BY_SECURITY"):
                controller.ask("publish", "/arm/joint_states", JOINTS, command)
    finally:
        bridge.shutdown()
