"""Connection profiles: their files, what is refused, and what they say of both networks."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from strands_robots import settings
from strands_robots.device_connect.backends import LinkConfig
from strands_robots.errors import UnreachableError
from strands_robots.fleet.adapter import DEVICE_CONNECT, MESH
from strands_robots.fleet.device_connect.config import LinkFlags
from strands_robots.fleet.fleet import connect
from strands_robots.fleet.mesh.config import MeshSettings
from strands_robots.fleet.mesh.network import MeshNetwork
from strands_robots.fleet.profiles import mesh_at, profile_for, profile_names, profiles_folder, read_profile
from strands_robots.mesh import Mesh, session
from strands_robots.mesh.transport import MemoryTransport
from strands_robots.utils import ValidationError

Write = Callable[..., Path]


@pytest.fixture
def write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Write:
    """Write a profile into the folder that the settings name."""
    monkeypatch.setenv("STRANDS_FLEETS_DIR", str(tmp_path))

    def written(content: str | bytes, name: str = "lab", mode: int = 0o644) -> Path:
        file = tmp_path / f"{name}.toml"
        file.write_bytes(content.encode() if isinstance(content, str) else content)
        file.chmod(mode)
        return file

    return written


class TestFile:
    def test_name_is_looked_up_in_the_folder_and_a_path_is_one(self, write: Write, tmp_path: Path) -> None:
        file = write('tenant = "lab"')
        for wanted in ("lab", str(file), file):
            assert read_profile(wanted).flags({}).tenant == "lab"
        assert read_profile("lab").file == file
        assert profile_names() == ["lab"]

    def test_path_is_relative_to_the_working_directory(
        self, write: Write, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        write('tenant = "lab"')
        monkeypatch.chdir(tmp_path)
        assert read_profile("lab.toml").file == tmp_path / "lab.toml"
        assert read_profile("./lab.toml").file.samefile(tmp_path / "lab.toml")

    def test_folder_is_that_of_the_users_configuration(self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
        monkeypatch.setenv("HOME", str(tmp_path))
        assert profiles_folder() == tmp_path / ".config" / "strands-robots" / "fleets"
        monkeypatch.setenv("XDG_CONFIG_HOME", "relative")
        assert profiles_folder() == tmp_path / ".config" / "strands-robots" / "fleets"
        monkeypatch.setenv("XDG_CONFIG_HOME", "/etc/xdg")
        assert profiles_folder() == Path("/etc/xdg/strands-robots/fleets")
        monkeypatch.setenv("STRANDS_FLEETS_DIR", "~/fleets")
        assert profiles_folder() == tmp_path / "fleets"
        assert profile_names() == []

    def test_absent_one_is_refused_with_similar_names(self, write: Write) -> None:
        write("")
        with pytest.raises(ValidationError, match=r"profile 'lbb': .*lbb\.toml is no file\. Near it: lab"):
            read_profile("lbb")

    @pytest.mark.parametrize("name", ["", "two words", "-x", "x" * 129, "lab\n"])
    def test_what_is_no_name_is_refused(self, write: Write, name: str) -> None:
        with pytest.raises(ValidationError, match="fleet must be 1 to 128 letters"):
            read_profile(name)

    @pytest.mark.parametrize("mode", [0o664, 0o646, 0o666])
    def test_file_that_others_can_write_is_refused(self, write: Write, mode: int) -> None:
        write("", mode=mode)
        with pytest.raises(ValidationError, match=f"mode {mode:04o}: others may write it; run chmod go-w"):
            read_profile("lab")

    def test_file_that_others_can_read_is_fine(self, write: Write) -> None:
        write("", mode=0o444)
        assert read_profile("lab").network == {}

    @pytest.mark.skipif(os.getuid() != 0, reason="only root gives a file away")
    def test_file_of_another_user_is_refused(self, write: Write) -> None:
        os.chown(write(""), 12345, -1)
        with pytest.raises(ValidationError, match="belongs to uid 12345"):
            read_profile("lab")

    def test_folder_and_pipe_are_no_file(self, write: Write, tmp_path: Path) -> None:
        (tmp_path / "dir.toml").mkdir()
        os.mkfifo(tmp_path / "pipe.toml", 0o600)
        for name in ("dir", "pipe"):
            with pytest.raises(ValidationError, match="no plain file"):
                read_profile(name)

    @pytest.mark.parametrize(
        ("content", "why"),
        [
            (b"#" * 65537, "at most 65536 bytes, not 65537"),
            (b"tenant = ", "is no TOML"),
            (b"\xff\xfe", "not UTF-8 at byte 0"),
            (b"x = " + b"[" * 30_000 + b"]" * 30_000, "no TOML"),
        ],
    )
    def test_what_is_no_profile_is_refused(self, write: Write, content: bytes, why: str) -> None:
        write(content)
        with pytest.raises(ValidationError, match=why):
            read_profile("lab")

    def test_file_of_the_greatest_size_is_read(self, write: Write) -> None:
        write(b"#" * 65536)
        assert read_profile("lab").network == {}


class TestFilesThatItNames:
    KEYS = ("tls_ca", "tls_cert", "tls_key", "credentials", "mesh.tls_ca", "mesh.tls_key", "mesh.acl_file")

    @pytest.mark.parametrize("key", KEYS)
    def test_one_that_others_can_write_is_refused(self, write: Write, tmp_path: Path, key: str) -> None:
        named = tmp_path / "named"
        named.touch()
        write(f'{key} = "named"')
        named.chmod(0o644)
        read_profile("lab").check()
        named.chmod(0o666)
        with pytest.raises(ValidationError, match="named has mode 0666: others may write it; run chmod go-w"):
            read_profile("lab").check()

    @pytest.mark.skipif(os.getuid() != 0, reason="only root gives a file away")
    def test_one_of_another_user_is_refused(self, write: Write, tmp_path: Path) -> None:
        (tmp_path / "ca.pem").touch()
        os.chown(tmp_path / "ca.pem", 12345, -1)
        write('tls_ca = "ca.pem"')
        with pytest.raises(ValidationError, match=r"ca\.pem belongs to uid 12345"):
            read_profile("lab")

    def test_link_to_one_that_others_can_write_is_refused(self, write: Write, tmp_path: Path) -> None:
        (tmp_path / "real.pem").touch()
        (tmp_path / "real.pem").chmod(0o622)
        (tmp_path / "ca.pem").symlink_to(tmp_path / "real.pem")
        write('tls_ca = "ca.pem"')
        with pytest.raises(ValidationError, match=r"ca\.pem has mode 0622"):
            read_profile("lab")


class TestKeys:
    @pytest.mark.parametrize(
        ("content", "why"),
        [
            ('tennant = "x"', r"unknown key 'tennant'. Near it: tenant"),
            ("[mesh]\nprot = 1", r"unknown key 'prot' in \[mesh\]. Near it: port"),
            ('port = "7447"', r"port in .*lab\.toml must be an integer from 1 to 65535, not '7447'"),
            ("port = 70000", "not 70000"),
            ("port = true", "not True"),
            ('insecure = "yes"', "insecure in .* must be true or false, not 'yes'"),
            ("nats = 3", "nats in .* must be a text or a list of at most 64 texts, not 3"),
            ('nats = ["a", 3]', "nats in .*not 3"),
            ("nats = []\nlisten = 1979-05-27", "listen in .*not datetime"),
            ('tenant = "a.b"', r"tenant in .*not 'a\.b'"),
            ("tls_ca = 1", "tls_ca in .*not 1"),
            ('credentials = ""', "credentials in .*not ''"),
            ('name = "a b"', "name in .*not 'a b'"),
            ("mesh = true", "mesh in .* must be a table, not True"),
            ("[mesh]\nport = 0", r"mesh\.port in .*not 0"),
            ('[mesh]\nenabled = "no"', r"mesh\.enabled in .*not 'no'"),
        ],
    )
    def test_wrong_one_is_refused_by_name_value_and_domain(self, write: Write, content: str, why: str) -> None:
        write(content)
        with pytest.raises(ValidationError, match=why):
            read_profile("lab").check()
        with pytest.raises(ValidationError, match=why):
            connect("lab")

    def test_paths_are_those_beside_the_file(
        self, write: Write, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setenv("HOME", "/home/ada")
        write('tls_ca = "ca.pem"\ntls_cert = "~/cert.pem"\ntls_key = "/etc/key.pem"\n[mesh]\ntls_ca = "../ca.pem"')
        profile = read_profile("lab")
        assert profile.network == {
            "tls_ca": tmp_path / "ca.pem",
            "tls_cert": Path("/home/ada/cert.pem"),
            "tls_key": Path("/etc/key.pem"),
        }
        assert profile.mesh is not None
        assert profile.mesh["STRANDS_MESH_TLS_CA"] == str(tmp_path / ".." / "ca.pem")

    def test_one_server_or_several(self, write: Write) -> None:
        write('nats = "nats://a:1"')
        assert read_profile("lab").flags({}).nats == ("nats://a:1",)
        write('connect = ["tcp/a:1", "tcp/b:1"]')
        assert read_profile("lab").flags({}).connect == ("tcp/a:1", "tcp/b:1")


def test_profile_of_the_page_is_one(write: Write, tmp_path: Path) -> None:
    page = Path(__file__).parents[2] / "docs" / "python.md"
    (content,) = re.findall(r"```toml\n(.*?)```", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    write(content)
    profile = read_profile("lab")
    profile.check()
    assert profile.name == "bench"
    assert profile.network["credentials"] == tmp_path / "lab.creds.json"
    assert (profile.mesh or {})["STRANDS_MESH_CONNECT"] == "tls/192.168.1.10:7447"


class TestGivenBesides:
    def test_given_value_wins(self, write: Write) -> None:
        write('nats = "nats://a:1"\ntenant = "lab"\ntls_ca = "ca.pem"')
        flags = read_profile("lab").flags({"tenant": "other", "tls_ca": Path("/x")})
        assert (flags.nats, flags.tenant, flags.tls_ca) == (("nats://a:1",), "other", Path("/x"))

    def test_another_network_replaces_the_files_and_its_consent(self, write: Write) -> None:
        write('nats = "nats://a:1"\ninsecure = true\ntenant = "lab"')
        flags = read_profile("lab").flags({"connect": ["tcp/192.0.2.1:1"]})
        assert (flags.nats, flags.connect, flags.insecure, flags.tenant) == (None, ["tcp/192.0.2.1:1"], False, "lab")
        with pytest.raises(ValidationError, match="needs authentication"):
            connect("lab", connect="tcp/192.0.2.1:1")

    def test_empty_tenant_is_refused_instead_of_the_default_one(self, write: Write) -> None:
        write('tenant = "lab"')
        for refused in (
            lambda: connect("lab", tenant=""),
            lambda: connect(tenant=""),
            lambda: read_profile("lab").flags({"tenant": ""}),
        ):
            with pytest.raises(ValidationError, match=r"tenant must be 1 to 128 letters.*not ''"):
                refused()

    @pytest.mark.parametrize("value", ["", " , ", ["nats://a:1", ""]], ids=repr)
    def test_empty_server_is_refused_instead_of_another_network(self, write: Write, value: str | list[str]) -> None:
        write("port = 7500")
        with pytest.raises(ValidationError, match="nats needs a server"):
            connect("lab", nats=value)
        with pytest.raises(ValidationError, match="connect needs an endpoint"):
            connect("lab", connect=value)
        with pytest.raises(ValidationError, match="listen needs an endpoint"):
            connect(listen=value)

    def test_no_server_at_all_leaves_the_files(self, write: Write, monkeypatch: pytest.MonkeyPatch) -> None:
        links: list[LinkConfig] = []
        monkeypatch.setattr(
            "strands_robots.fleet.device_connect.network.DeviceConnectNetwork.__init__",
            lambda self, link, source, preload: links.append(link),
        )
        write('nats = "nats://127.0.0.1:4333"')
        for empty in ((), [], iter(())):
            connect("lab", nats=empty, connect=empty, listen=empty)  # type: ignore[arg-type]
        assert [each.connect for each in links] == [("nats://127.0.0.1:4333",)] * 3

    def test_default_profile_is_left_out_beside_another_network(
        self, write: Write, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        write('tenant = "lab"')
        assert profile_for(None, {}) is None
        monkeypatch.setenv("STRANDS_FLEET", "lab")
        chosen = profile_for(None, {"tenant": "other"})
        assert chosen is not None
        assert chosen.label == "lab"
        assert profile_for(None, {"port": 7500}) is None

    def test_caller_is_the_profiles_unless_it_is_given(self, write: Write, monkeypatch: pytest.MonkeyPatch) -> None:
        named: list[str] = []
        monkeypatch.setattr(
            "strands_robots.fleet.device_connect.network.DeviceConnectNetwork.__init__",
            lambda self, link, source, preload: named.append(source),
        )
        write('name = "bench"')
        connect("lab")
        connect("lab", name="ada")
        connect()
        assert named == ["bench", "ada", "strands-robots"]
        with pytest.raises(ValidationError, match="name"):
            connect("lab", name="")


class TestEnvironment:
    """What a shell states is another fleet's."""

    @pytest.fixture(autouse=True)
    def shell(self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
        other = {
            "MESSAGING_URLS": "nats://192.0.2.9:4222",
            "MESSAGING_BACKEND": "nats",
            "MESSAGING_TLS_CA_FILE": str(tmp_path / "other.pem"),
            "ZENOH_LISTEN": "tcp/0.0.0.0:7447",
            "ZENOH_CONNECT": "tcp/192.0.2.9:7447",
            "TENANT": "other",
            "STRANDS_DC_PORT": "7555",
            "STRANDS_MESH_PORT": "7556",
        }
        for name, value in other.items():
            monkeypatch.setenv(name, value)

    def test_profile_without_a_network_is_this_machine(self, write: Write) -> None:
        write('name = "bench"')
        link = read_profile("lab").flags({}).link()
        assert (link.loopback_only, link.meet_port, link.tenant, link.ca) == (True, 7447, "default", "")

    def test_mesh_without_a_port_has_the_usual_one(self, write: Write) -> None:
        write("[mesh]")
        assert (read_profile("lab").mesh or {})["STRANDS_MESH_PORT"] == "7447"

    def test_credentials_alone_name_the_network(self, write: Write, tmp_path: Path) -> None:
        (tmp_path / "lab.json").write_text('{"tenant": "lab", "nats": {"urls": ["nats://127.0.0.1:4333"]}}')
        write('credentials = "lab.json"')
        link = read_profile("lab").flags({}).link()
        assert (link.transport, link.connect, link.tenant, link.ca) == ("nats", ("nats://127.0.0.1:4333",), "lab", "")
        write('credentials = "lab.json"\nnats = "nats://127.0.0.1:4334"')
        link = read_profile("lab").flags({}).link()
        assert (link.connect, link.tenant, link.ca) == (("nats://127.0.0.1:4334",), "lab", "")

    def test_without_a_profile_it_counts(self) -> None:
        assert LinkFlags(insecure=True).link().connect == ("nats://192.0.2.9:4222",)


class TestMesh:
    def test_table_names_the_whole_mesh(self, write: Write, monkeypatch: pytest.MonkeyPatch) -> None:
        from strands_robots.mesh.session import network  # noqa: PLC0415 - needs the settings
        from strands_robots.mesh.transport.config import Posture  # noqa: PLC0415 - as above

        monkeypatch.setenv("ZENOH_CONNECT", "tcp/192.0.2.9:7447")
        monkeypatch.setenv("STRANDS_MESH_LOCAL_DEV", "true")
        monkeypatch.setenv("STRANDS_MESH_NAMESPACE", "other")
        write("[mesh]\nport = 7601")
        stated = read_profile("lab").mesh
        assert stated is not None
        for name, value in stated.items():
            monkeypatch.setenv(name, value)
        posture = Posture.from_settings()
        assert (posture.hub, posture.connect, posture.listen) == ("tcp/127.0.0.1:7601", (), ())
        assert (posture.namespace, posture.multicast) == ("strands", False)
        assert network().text.endswith("7601")
        write('[mesh]\nconnect = ["tcp/127.0.0.1:7602", "tcp/127.0.0.1:7603"]')
        for name, value in (read_profile("lab").mesh or {}).items():
            monkeypatch.setenv(name, value)
        posture = Posture.from_settings()
        assert (posture.hub, posture.connect) == (None, ("tcp/127.0.0.1:7602", "tcp/127.0.0.1:7603"))

    def test_insecure_is_the_files_alone(self, write: Write, monkeypatch: pytest.MonkeyPatch) -> None:
        from strands_robots.mesh.transport import TransportError  # noqa: PLC0415 - needs the settings
        from strands_robots.mesh.transport.config import Posture  # noqa: PLC0415 - as above

        monkeypatch.setenv("STRANDS_MESH_LOCAL_DEV", "true")
        for insecure, refused in (("false", True), ("true", False)):
            write(f'[mesh]\nconnect = "tcp/192.0.2.1:7447"\ninsecure = {insecure}')
            for name, value in (read_profile("lab").mesh or {}).items():
                monkeypatch.setenv(name, value)
            if refused:
                with pytest.raises(TransportError, match="leaves this machine"):
                    Posture.from_settings()
            else:
                assert Posture.from_settings().connect == ("tcp/192.0.2.1:7447",)

    def test_fleet_without_the_table_has_no_mesh(self, write: Write, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setenv("STRANDS_MESH", "true")
        for content in ("", "[mesh]\nenabled = false"):
            write(content)
            assert connect("lab").absent == {MESH: "the connection profile lab has none"}
        assert connect("lab", mesh=True).absent == {}
        write("[mesh]")
        assert connect("lab", port=7500).absent == {}
        assert connect("lab", mesh=False, port=7500).absent == {MESH: "it is switched off"}

    def test_fleet_with_the_table_alone_has_no_devices(self, write: Write) -> None:
        write('name = "bench"\n[mesh]\nport = 7601')
        assert connect("lab").absent == {DEVICE_CONNECT: "the connection profile lab has none of its networks"}

    def test_switch_of_the_mesh_wins(self, write: Write, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setenv("STRANDS_MESH", "false")
        write("port = 7500\n[mesh]\nenabled = true")
        assert connect("lab").absent == {MESH: "it is switched off"}


class TestMeshOfOneProcess:
    @pytest.fixture
    def no_session(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setenv("STRANDS_MESH_PORT", "7001")
        monkeypatch.setattr(session, "opened_with", lambda: None)

    @pytest.fixture
    def opened(self, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[], None]]:
        """Opens a session with the settings of the moment, as a robot of this process does."""
        monkeypatch.setenv("STRANDS_MESH_PORT", "7001")
        monkeypatch.setattr(session, "make_transport", MemoryTransport)
        references = list[object]()
        yield lambda: references.append(session.dial())
        for _ in references:
            session.release_session()

    @pytest.mark.usefixtures("no_session")
    def test_settings_hold_while_a_fleet_is_joined(self) -> None:
        one, two = (MeshSettings({"STRANDS_MESH_PORT": "7002"}) for _ in range(2))
        one.take()
        two.take()
        assert settings.raw("STRANDS_MESH_PORT") == "7002"
        one.give_back()
        assert settings.raw("STRANDS_MESH_PORT") == "7002"
        two.give_back()
        assert settings.raw("STRANDS_MESH_PORT") == "7001"

    @pytest.mark.usefixtures("no_session")
    @pytest.mark.parametrize("stated", [{}, {"STRANDS_MESH_PORT": "7002"}], ids=["environment", "profile"])
    def test_peers_are_forgotten_once_their_mesh_is_left(self, stated: dict[str, str]) -> None:
        fleet = MeshSettings(stated)
        fleet.take()
        # A robot that restarts meanwhile has another session, and would be taken for a stranger for 10 s.
        assert session.update_peer("arm-1", "robot", "desk", {})
        fleet.give_back()
        assert session.get_peer("arm-1") is None

    @pytest.mark.usefixtures("no_session")
    def test_fleet_of_another_profile_is_refused_meanwhile(self) -> None:
        one, other, none = MeshSettings({"STRANDS_MESH_PORT": "7002"}), MeshSettings({}), MeshSettings({})
        one.take()
        with pytest.raises(UnreachableError, match="another connection profile"):
            other.take()
        one.give_back()
        other.take()
        none.take()
        with pytest.raises(UnreachableError, match="another connection profile"):
            one.take()
        other.give_back()
        none.give_back()

    def test_session_of_a_robot_here_is_not_taken_for_the_profiles(self, opened: Callable[[], None]) -> None:
        opened()
        with pytest.raises(UnreachableError, match="on a mesh already, with other settings than the profile's"):
            MeshSettings({"STRANDS_MESH_PORT": "7002"}).take()
        assert settings.raw("STRANDS_MESH_PORT") == "7001"
        same = MeshSettings({"STRANDS_MESH_NAMESPACE": "", **mesh_at(7001)})
        same.take()
        same.give_back()

    def test_session_that_outlives_its_profile_is_not_taken_for_the_environments(
        self, opened: Callable[[], None]
    ) -> None:
        lab, here = MeshSettings({"STRANDS_MESH_PORT": "7002"}), MeshNetwork("tool")
        lab.take()
        opened()
        lab.give_back()
        assert settings.raw("STRANDS_MESH_PORT") == "7001"
        with pytest.raises(UnreachableError, match="on a mesh already, with other settings than the environment's"):
            here.open()
        lab.take()
        lab.give_back()
        session.release_session()
        here.open()
        here.close()

    @pytest.mark.usefixtures("opened")
    def test_settings_are_restored_where_the_mesh_is_not_left_in_good_order(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        def close(mesh: Mesh) -> None:
            left(mesh)
            raise OSError("the link is gone")

        left = Mesh.close
        monkeypatch.setattr(Mesh, "close", close)
        lab = MeshNetwork("tool", {"STRANDS_MESH_PORT": "7002"})
        lab.open()
        assert settings.raw("STRANDS_MESH_PORT") == "7002"
        with pytest.raises(OSError, match="the link is gone"):
            lab.close()
        assert settings.raw("STRANDS_MESH_PORT") == "7001"
