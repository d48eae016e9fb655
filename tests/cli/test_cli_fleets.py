"""``--fleet`` of the commands, and ``fleets``, which lists the connection profiles."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from fixtures.waiting import free_port
from tests.cli.conftest import Run

from strands_robots import settings
from strands_robots.cli.network import Network
from strands_robots.cli.output import CliError, Exit
from strands_robots.mesh.transport.config import Posture

Write = Callable[..., Path]


@pytest.fixture
def write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Write]:
    """Write a profile; the settings that a command puts last as long as the test."""
    with pytest.MonkeyPatch.context() as patch:
        for name in ("STRANDS_MESH", "MESSAGING_CREDENTIALS_FILE"):
            patch.setenv(name, "")
        for each in settings.declared():
            if each.name.startswith("STRANDS_MESH_"):
                patch.setenv(each.name, "")
        monkeypatch.setenv("STRANDS_FLEETS_DIR", str(tmp_path))

        def written(content: str, name: str = "lab") -> Path:
            file = tmp_path / f"{name}.toml"
            file.write_text(content)
            file.chmod(0o644)
            return file

        yield written


def test_flag_names_the_network_and_explicit_flags_win(write: Write) -> None:
    write('port = 7633\ntenant = "lab"')
    link = Network(profile="lab").link()
    assert (link.meet_port, link.tenant) == (7633, "lab")
    link = Network(profile="lab", tenant="other").link()
    assert (link.meet_port, link.tenant) == (7633, "other")
    assert Network(profile="lab", nats=["nats://127.0.0.1:4222"]).link().transport == "nats"
    assert Network(profile="lab", nats=[], connect=[]).link().meet_port == 7633


def test_file_that_changes_gives_one_command_no_second_fleet(write: Write) -> None:
    write("port = 7633")
    network = Network(profile="lab")
    assert network.link().meet_port == 7633
    write("port = 7634")
    assert network.link().meet_port == 7633
    assert Network(profile="lab").link().meet_port == 7634


def test_default_profile_is_that_of_the_setting(write: Write, monkeypatch: pytest.MonkeyPatch) -> None:
    file = write("port = 7633")
    for value in ("lab", str(file)):
        monkeypatch.setenv("STRANDS_FLEET", value)
        assert Network().link().meet_port == 7633
        assert Network(port=7634).link().meet_port == 7634
    monkeypatch.setenv("STRANDS_FLEET", "absent")
    assert Network(port=7634).link().meet_port == 7634
    with pytest.raises(CliError) as refused:
        Network().link()
    assert refused.value.code is Exit.USAGE


def test_flags_for_another_command_name_the_profile(write: Write, monkeypatch: pytest.MonkeyPatch) -> None:
    write("port = 7633")
    assert Network(profile="lab").flags == " --fleet lab"
    assert (
        Network(profile="my lab.toml", tenant="a", insecure=True).flags
        == " --fleet 'my lab.toml' --tenant a --insecure"
    )
    monkeypatch.setenv("STRANDS_FLEET", "lab")
    assert Network(tenant="a").flags == " --fleet lab --tenant a"
    assert Network(port=7634).flags == " --port 7634"


def test_consent_and_tenant_are_the_profiles(write: Write) -> None:
    write('nats = "nats://192.0.2.1:4222"\ninsecure = true\ntenant = "lab"')
    network = Network(profile="lab")
    assert network.stated.opted_in
    assert network.stated.stated_tenant == "lab"
    assert network.link().connect == ("nats://192.0.2.1:4222",)


@pytest.mark.parametrize("words", [("stop", "--all"), ("stop", "arm-1"), ("estop",), ("peers",)], ids=" ".join)
@pytest.mark.parametrize(
    ("flags", "why"),
    [
        (("--tenant", ""), "tenant must be"),
        (("--nats", ""), "nats needs a server"),
        (("--nats", " , "), "nats needs a server"),
        (("--connect", ""), "connect needs an endpoint"),
    ],
    ids=repr,
)
@pytest.mark.parametrize("profile", [(), ("--fleet", "lab")], ids=["without", "profile"])
def test_empty_tenant_or_network_is_wrong_usage(
    run: Run, write: Write, words: tuple[str, ...], flags: tuple[str, ...], why: str, profile: tuple[str, ...]
) -> None:
    write('port = 7633\ntenant = "lab"')
    result = run(*words, *profile, *flags)
    assert (result.exit_code, why in result.output) == (Exit.USAGE, True), result.output


@pytest.mark.parametrize(
    "words",
    [
        ("peers",),
        ("call", "arm-1", "getStatus"),
        ("stop", "--all"),
        ("stop", "arm-1"),
        ("estop",),
        ("stop", "--all", "--mesh"),
        ("estop", "--mesh"),
        ("resume",),
        ("lockout",),
        ("watch", "arm-1"),
        ("safety-controller",),
        ("enroll", "--list"),
        ("dashboard", "--no-browser"),
        ("mcp",),
        ("serve", "so100"),
        ("take", "arm-1"),
        ("record", "arm-1", "--out", "x.mcap"),
        ("record", "arm-1", "--out", "x.mcap", "--mesh"),
    ],
    ids=" ".join,
)
@pytest.mark.parametrize("content", [None, 'tennant = "lab"'], ids=["absent", "unknown key"])
def test_profile_that_cannot_be_read_is_wrong_usage(
    run: Run, write: Write, words: tuple[str, ...], content: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    def joined(*_: object, **__: object) -> None:
        pytest.fail("another network was joined")

    monkeypatch.setattr("strands_robots.device_connect.client.FleetClient.__enter__", joined)
    monkeypatch.setattr("strands_robots.mesh.session.make_transport", joined)
    write("", "near")
    if content is not None:
        write(content)
    result = run(*words, "--fleet", "lab")
    assert result.exit_code == Exit.USAGE, result.output
    assert ("no connection profile 'lab'" if content is None else "unknown key 'tennant'") in result.output


def test_doctor_reports_a_profile_that_cannot_be_read(run: Run, write: Write) -> None:
    write('tennant = "lab"')
    findings = json.loads(run("doctor", "--fleet", "lab", "--json").output)["checks"]
    (found,) = (each for each in findings if each["name"] == "network")
    assert found["mark"] == "broken"
    assert "unknown key 'tennant'" in found["remedy"]


def test_default_profile_is_looked_at_by_what_uses_a_network(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STRANDS_FLEET", "absent")
    assert run("resume", "--local").exit_code != Exit.USAGE
    assert run("estop").exit_code == Exit.USAGE
    assert run("stop", "--all").exit_code == Exit.USAGE
    assert run("stop", "--all", "--mesh").exit_code == Exit.USAGE


def test_stop_needs_neither_name_nor_mesh_of_the_profile(
    run: Run, write: Write, caplog: pytest.LogCaptureFixture
) -> None:
    write(f'port = {free_port()}\nname = "a b"\n[mesh]\nport = 0')
    result = run("peers", "--fleet", "lab")
    assert (result.exit_code, "name in" in result.output) == (Exit.USAGE, True)
    with caplog.at_level(logging.WARNING):
        result = run("stop", "--all", "--fleet", "lab")
    assert result.exit_code == Exit.SILENT, result.output
    assert "The caller is strands-robots." in caplog.text
    assert "The mesh is left out." in caplog.text


def test_caller_is_the_profiles_unless_another_is_given(
    run: Run, write: Write, monkeypatch: pytest.MonkeyPatch
) -> None:
    named: list[str] = []

    def client(link: object, source: str, **_: object) -> None:
        named.append(source)
        raise CliError("seen", Exit.SILENT)

    monkeypatch.setattr("strands_robots.fleet.device_connect.network.DeviceConnectNetwork", client)
    write('name = "bench"')
    call = ("call", "arm-1", "getStatus")
    for words in (call, ("peers",), (*call, "--as", "ada"), (*call, "--as", "strands-robots")):
        run(*words, "--fleet", "lab")
    run(*call)
    assert named == ["bench", "bench", "ada", "strands-robots", "strands-robots"]


def test_stop_has_the_source_that_is_given(run: Run, write: Write, monkeypatch: pytest.MonkeyPatch) -> None:
    named: list[str] = []
    monkeypatch.setattr("strands_robots.cli.stop.device_id", lambda _, source: named.append(source))
    write('port = 7633\nname = "bench"')
    for words in ((), ("--as", "strands-robots")):
        run("estop", *words, "--fleet", "lab", "--deadline", "0.1")
    assert named == ["bench", "strands-robots"]


class TestMesh:
    def test_table_is_put_for_the_process(self, write: Write) -> None:
        write("[mesh]\nport = 7601\nnamespace = 'lab'")
        Network(profile="lab").use_mesh()
        assert settings.integer("STRANDS_MESH_PORT") == 7601
        assert settings.raw("STRANDS_MESH_NAMESPACE") == "lab"

    def test_given_port_replaces_the_tables_endpoints(self, write: Write) -> None:
        write("[mesh]\nconnect = 'tcp/127.0.0.1:7601'")
        Network(profile="lab", port=7602).use_mesh()
        assert settings.integer("STRANDS_MESH_PORT") == 7602
        assert settings.raw("STRANDS_MESH_CONNECT") == settings.NO_ENDPOINT

    @pytest.mark.parametrize("name", ["STRANDS_MESH_CONNECT", "STRANDS_MESH_LISTEN", "ZENOH_CONNECT", "ZENOH_LISTEN"])
    def test_given_port_is_the_mesh_whatever_endpoints_the_shell_names(
        self, write: Write, monkeypatch: pytest.MonkeyPatch, name: str
    ) -> None:
        monkeypatch.setenv(name, "tcp/127.0.0.1:7601")
        Network(port=7602).use_mesh()
        posture = Posture.from_settings()
        assert (posture.hub, posture.connect, posture.listen) == ("tcp/127.0.0.1:7602", (), ())

    def test_profile_without_the_table_is_refused(self, write: Write) -> None:
        write("port = 7633")
        with pytest.raises(CliError, match="lab has no mesh") as refused:
            Network(profile="lab").use_mesh()
        assert refused.value.code is Exit.USAGE

    def test_profile_of_a_mesh_alone_is_refused_without_the_flag(self, write: Write) -> None:
        write("[mesh]\nport = 7601")
        with pytest.raises(CliError, match="a mesh alone: give --mesh") as refused:
            Network(profile="lab").link()
        assert refused.value.code is Exit.USAGE

    def test_doctor_looks_for_no_device_connect_beside_a_mesh_alone(self, run: Run, write: Write) -> None:
        write(f"[mesh]\nport = {free_port()}")
        checks = json.loads(run("doctor", "--fleet", "lab", "--json").output)["checks"]
        found = {each["name"]: (each["mark"], each["said"]) for each in checks}
        assert found["network"] == ("ok", "the connection profile has a mesh and no Device Connect")
        assert found["mesh"][0] == "warn"

    def test_mesh_of_the_environment_is_left_out_beside_a_profile_without(self, write: Write) -> None:
        write("port = 7633")
        Network(profile="lab").link()
        assert settings.raw("STRANDS_MESH") == "false"


class TestFleets:
    def test_profiles_are_listed_with_their_network_in_words(self, run: Run, write: Write, tmp_path: Path) -> None:
        write('port = 7633\ntenant = "lab"\nname = "bench"\n[mesh]')
        write("port = 0", "bad")
        result = run("fleets", "--json")
        assert result.exit_code == 0
        listed = json.loads(result.output)
        assert listed["folder"] == str(tmp_path)
        bad, lab = listed["fleets"]
        assert "port in" in bad["problem"]
        assert lab == {
            "name": "lab",
            "network": "This machine alone: tcp/127.0.0.1:7633; nothing leaves 127.0.0.1.",
            "tenant": "lab",
            "caller": "bench",
            "mesh": True,
            "mesh_network": "Meets at 127.0.0.1:7447.",
            "file": str(tmp_path / "lab.toml"),
            "problem": "",
        }

    def test_table_marks_the_default(self, run: Run, write: Write, monkeypatch: pytest.MonkeyPatch) -> None:
        write("port = 7633")
        monkeypatch.setenv("STRANDS_FLEET", "lab")
        assert "lab (default)" in run("fleets").output

    def test_fleet_on_the_mesh_alone_has_no_network_of_device_connect(self, run: Run, write: Write) -> None:
        write('[mesh]\nconnect = ["tcp/127.0.0.1:7601", "tcp/127.0.0.1:7602"]\nmulticast = true')
        (lab,) = json.loads(run("fleets", "--json").output)["fleets"]
        assert (lab["network"], lab["tenant"], lab["mesh"], lab["problem"]) == (None, None, True, "")
        assert lab["mesh_network"] == "Connects to tcp/127.0.0.1:7601, tcp/127.0.0.1:7602; finds peers by multicast."
        write("port = 7633")
        (lab,) = json.loads(run("fleets", "--json").output)["fleets"]
        assert (lab["mesh"], lab["mesh_network"]) == (False, None)

    @pytest.mark.parametrize("others", [(), ("near",)], ids=["none", "another"])
    def test_default_that_is_not_there_is_said(
        self, run: Run, write: Write, monkeypatch: pytest.MonkeyPatch, others: tuple[str, ...]
    ) -> None:
        for name in others:
            write("port = 7633", name)
        monkeypatch.setenv("STRANDS_FLEET", "nearr")
        result = run("fleets")
        assert "no connection profile 'nearr'" in " ".join(result.output.split())
        assert result.exit_code == 0
        assert "no connection profile 'nearr'" in json.loads(run("fleets", "--json").output)["default_problem"]
        write("port = 7634", "nearr")
        assert "no connection profile" not in " ".join(run("fleets").output.split())

    def test_folder_without_one_is_named(self, run: Run, write: Write, tmp_path: Path) -> None:
        result = run("fleets")
        assert result.exit_code == 0
        assert str(tmp_path) in result.output.replace("\n", "")
