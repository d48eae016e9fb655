"""Connection profiles: one TOML file a fleet, with its network and certificates.

A profile decides which authority is trusted and which robots a stop reaches. So a file that others can write is
refused, an unknown key is never skipped, and the file says all: the environment's networks, ports, tenant and
certificates do not count besides.
"""

from __future__ import annotations

import os
import stat
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar, cast

from strands_robots import settings
from strands_robots._mesh_switch import mesh_env_request
from strands_robots.fleet.adapter import DEVICE_CONNECT, MESH, NetworkAdapter
from strands_robots.fleet.device_connect.config import LinkFlags
from strands_robots.fleet.mesh.config import LocalMesh, local_key, no_hub
from strands_robots.state_files import WRITABLE
from strands_robots.utils import (
    MissingExtraError,
    ValidationError,
    device_id,
    flag,
    identifier,
    near,
    port,
    shown,
    text,
)

if TYPE_CHECKING:
    from strands_robots.fleet.networks import Networks
    from strands_robots.safety.network_key import NetworkKey

BYTES_MAX = 64 * 1024
ENTRIES_MAX = 64
SUFFIX = ".toml"

WAYS = ("nats", "connect", "listen", "multicast", "port")
"""Flags that say where a network is. One that is given replaces all of a profile's, and its ``insecure``."""

Check = Callable[[str, object, Path], Any]
Value = TypeVar("Value")


@dataclass(frozen=True, slots=True)
class FleetProfile:
    """One fleet as its file describes it.

    Attributes:
        label: the name or the path by which it was asked for.
        file: where it stands.
        network: the fields of :class:`LinkFlags` that it states; no variable of another one counts besides.
        stated_name: the caller's name, None for none; or why it cannot be used.
        stated_mesh: the mesh's settings by variable, None where the mesh is left out; or why they cannot be used.
    """

    label: str
    file: Path
    network: Mapping[str, Any]
    stated_name: str | ValidationError | None = None
    stated_mesh: Mapping[str, str] | ValidationError | None = None

    @property
    def name(self) -> str | None:
        """The caller's name, None for none.

        Raises:
            ValidationError: it is no id of a caller.
        """
        return _usable(self.stated_name)

    @property
    def mesh(self) -> Mapping[str, str] | None:
        """Settings of the mesh by variable; None where the fleet has no mesh.

        Raises:
            ValidationError: the table ``[mesh]`` cannot be used.
        """
        return _usable(self.stated_mesh)

    def check(self) -> None:
        """Refuse a name or a mesh that cannot be used.

        Raises:
            ValidationError: naming the first of them.
        """
        _ = self.name, self.mesh

    def flags(self, given: Mapping[str, Any]) -> LinkFlags:
        """Return the network with the flags that were given besides, which win.

        Args:
            given: fields of :class:`LinkFlags`, without those that were not stated.
        """
        own = dict(self.network)
        if any(given.get(way) for way in WAYS):
            # Consent to an unauthenticated network is for the one that the file names.
            own = {key: value for key, value in own.items() if key not in {*WAYS, "insecure"}}
        return LinkFlags(**{**own, **given, "alone": True})

    def reaches_devices(self, given: Mapping[str, Any]) -> bool:
        """Return False for a fleet that is on the mesh alone."""
        return bool(self.network) or self.stated_mesh is None or any(given.get(way) for way in WAYS)


def profile_for(fleet: str | Path | None, given: Mapping[str, Any]) -> FleetProfile | None:
    """Return the profile that is asked for, else the default one.

    Args:
        fleet: a name or a file; None for that of ``STRANDS_FLEET``, unless ``given`` says where the network is.
        given: fields of :class:`LinkFlags` that were stated besides.

    Raises:
        ValidationError: it cannot be used.
    """
    wanted = profile_name(fleet, given)
    return None if wanted is None else read_profile(wanted)


def profile_name(fleet: str | Path | None, given: Mapping[str, Any]) -> str | None:
    """Return the name or the file of the profile that counts; None for none."""
    if fleet is not None:
        return str(fleet)
    return None if any(given.get(way) for way in WAYS) else settings.raw("STRANDS_FLEET") or None


def profiles_folder() -> Path:
    """Return the folder of the profiles that have a name."""
    stated = settings.raw("STRANDS_FLEETS_DIR")
    if stated:
        return Path(stated).expanduser()
    configuration = Path(settings.raw("XDG_CONFIG_HOME"))
    # The XDG specification has a relative path ignored.
    home = configuration if configuration.is_absolute() else Path.home() / ".config"
    return home / "strands-robots" / "fleets"


def profile_names() -> list[str]:
    """Return the names of the profiles, sorted."""
    try:
        return sorted(each.stem for each in profiles_folder().iterdir() if each.suffix == SUFFIX)
    except OSError:
        return []


def read_profile(wanted: str | Path) -> FleetProfile:
    """Read a connection profile.

    Args:
        wanted: its name, or the path of a file: a value with a ``/`` or that ends in ``.toml``.

    Raises:
        ValidationError: there is none, others can write it, or it states what it cannot.
    """
    label = str(wanted)
    if "/" in label or label.endswith(SUFFIX):
        file = _expanded(Path(label)).absolute()
    else:
        file = profiles_folder().absolute() / f"{identifier('fleet', label)}{SUFFIX}"
    table = _parsed(file, _content(label, file))
    named: str | ValidationError | None = None
    mesh: Mapping[str, str] | ValidationError | None = None
    unknown = next((key for key in table if key not in _KEYS), None)
    if unknown is not None:
        raise ValidationError(f"{file} has the unknown key {shown(unknown)}.{near(unknown, _KEYS)}")
    if "name" in table:
        try:
            named = device_id(f"name in {file}", table["name"])
        except ValidationError as exc:
            named = exc
    if "mesh" in table:
        try:
            mesh = _mesh(table["mesh"], file)
        except ValidationError as exc:
            mesh = exc
    network = {key: check(f"{key} in {file}", table[key], file) for key, check in _NETWORK.items() if key in table}
    return FleetProfile(label, file, network, named, mesh)


def _content(label: str, file: Path) -> bytes:
    """Return the bytes of a file that nobody but its owner can write."""
    try:
        descriptor = os.open(file, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
    except FileNotFoundError:
        names = "" if file.parent != profiles_folder().absolute() else near(file.stem, profile_names())
        raise ValidationError(f"There is no connection profile {shown(label)}: {file} is no file.{names}") from None
    except (OSError, ValueError) as exc:
        raise ValidationError(f"The connection profile {shown(label)} cannot be read: {exc}.") from exc
    try:
        status = os.fstat(descriptor)
        _require_own(file, status)
        with os.fdopen(os.dup(descriptor), "rb") as opened:
            content = opened.read(BYTES_MAX + 1)
    except OSError as exc:
        raise ValidationError(f"{file} cannot be read: {exc.strerror}.") from exc
    finally:
        os.close(descriptor)
    if len(content) > BYTES_MAX:
        raise ValidationError(f"{file} must have at most {BYTES_MAX} bytes, not {max(status.st_size, len(content))}.")
    return content


def _require_own(file: Path, status: os.stat_result) -> None:
    if not stat.S_ISREG(status.st_mode):
        raise ValidationError(f"{file} is no plain file.")
    if status.st_uid not in {0, os.getuid()}:
        raise ValidationError(f"{file} belongs to uid {status.st_uid} and not to you (uid {os.getuid()}).")
    mode = stat.S_IMODE(status.st_mode)
    if mode & WRITABLE:
        raise ValidationError(f"{file} has mode {mode:04o}: others may write it; run chmod go-w on it.")


def _parsed(file: Path, content: bytes) -> dict[str, Any]:
    import tomllib  # noqa: PLC0415 - a command without a profile starts without it

    try:
        return tomllib.loads(content.decode())
    except UnicodeDecodeError as exc:
        raise ValidationError(f"{file} is no TOML: it is not UTF-8 at byte {exc.start}.") from exc
    except tomllib.TOMLDecodeError as exc:
        raise ValidationError(f"{file} is no TOML: {exc}.") from exc
    except RecursionError:
        raise ValidationError(f"{file} is no TOML of a profile: it is nested too deeply.") from None


def _mesh(value: object, file: Path) -> Mapping[str, str] | None:
    """Return the table ``[mesh]`` as settings; None where it switches the mesh off."""
    if not isinstance(value, dict):
        raise ValidationError(f"mesh in {file} must be a table, not {shown(value)}.")
    unknown = next((key for key in value if key not in _MESH), None)
    if unknown is not None:
        raise ValidationError(f"{file} has the unknown key {shown(unknown)} in [mesh].{near(unknown, _MESH)}")
    stated = {key: check(f"mesh.{key} in {file}", value[key], file) for key, check in _MESH.items() if key in value}
    if not stated.pop("enabled", True):
        return None
    insecure = stated.pop("insecure", False)
    named = {_VARIABLES[key]: each if isinstance(each, str) else _spelled(each) for key, each in stated.items()}
    return {
        **dict.fromkeys(_OF_NO_MESH, ""),
        **mesh_at(int(settings.default("STRANDS_MESH_PORT"))),
        "STRANDS_MESH_AUTH_MODE": "none" if insecure else "mtls",
        "STRANDS_MESH_I_KNOW_THIS_IS_INSECURE": _spelled(insecure),
        "STRANDS_MESH_LOCAL_DEV": "false",
        **named,
    }


def mesh_at(port_number: int) -> dict[str, str]:
    """Return the settings of a mesh that meets on this machine, and nowhere else.

    Args:
        port_number: the loopback port of its hub.
    """
    return {
        "STRANDS_MESH_BACKEND": "zenoh",
        "STRANDS_MESH_CONNECT": settings.NO_ENDPOINT,
        "STRANDS_MESH_LISTEN": settings.NO_ENDPOINT,
        "STRANDS_MESH_MULTICAST": "false",
        "STRANDS_MESH_PORT": str(port_number),
    }


def _spelled(value: object) -> str:
    if isinstance(value, tuple):
        return ",".join(value) or settings.NO_ENDPOINT
    return str(value).lower() if isinstance(value, bool) else str(value)


def _urls(name: str, value: object, _file: Path) -> tuple[str, ...]:
    several = [value] if isinstance(value, str) else value
    if not isinstance(several, list) or len(several) > ENTRIES_MAX:
        raise ValidationError(f"{name} must be a text or a list of at most {ENTRIES_MAX} texts, not {shown(value)}.")
    return tuple(text(name, each, longest=500) for each in several)


def _path(name: str, value: object, file: Path) -> Path:
    """Return a file that a profile names, refused where others can write it."""
    named = file.parent / _expanded(Path(text(name, value, longest=1000)))
    try:
        status = named.stat()
    except (OSError, ValueError):
        # What needs the file says so.
        return named
    _require_own(named, status)
    return named


def _expanded(path: Path) -> Path:
    try:
        return path.expanduser()
    except RuntimeError as exc:
        raise ValidationError(f"{path} has no home directory to expand.") from exc


def _plain(check: Callable[[str, object], Any]) -> Check:
    return lambda name, value, _file: check(name, value)


_NETWORK: dict[str, Check] = {
    "nats": _urls,
    "connect": _urls,
    "listen": _urls,
    "multicast": _plain(flag),
    "port": _plain(port),
    "tenant": _plain(device_id),
    "insecure": _plain(flag),
    "tls_ca": _path,
    "tls_cert": _path,
    "tls_key": _path,
    "credentials": _path,
}

_MESH: dict[str, Check] = {
    "enabled": _plain(flag),
    "port": _plain(port),
    "connect": _urls,
    "listen": _urls,
    "multicast": _plain(flag),
    "namespace": _plain(lambda name, value: text(name, value, longest=100)),
    "insecure": _plain(flag),
    "tls_ca": _path,
    "tls_cert": _path,
    "tls_key": _path,
    "acl_file": _path,
}

_VARIABLES = {key: f"STRANDS_MESH_{key.upper()}" for key in _MESH}

_OF_NO_MESH = tuple(_VARIABLES[key] for key in ("namespace", "tls_ca", "tls_cert", "tls_key", "acl_file"))
"""Variables that are empty where the file does not state them."""

_KEYS = (*_NETWORK, "name", "mesh")


def _usable(stated: Value | ValidationError) -> Value:
    if isinstance(stated, ValidationError):
        raise stated
    return stated


def networks_of(
    profile: FleetProfile | None,
    given: Mapping[str, Any],
    source: str,
    *,
    devices: bool = True,
    mesh: bool | None = None,
    stays: bool = False,
    preload: bool = False,
    console: bool = False,
) -> Networks:
    """Return the networks of a caller, not joined yet.

    Device Connect is one where its extra is installed; the mesh where it is not switched off and has a hub on this
    machine, a stated endpoint, multicast, or a profile. The caller only dials: it is never the hub.

    Args:
        profile: a connection profile, or None.
        given: fields of :class:`LinkFlags` that the user stated.
        source: the caller's name.
        devices: False leaves Device Connect out.
        mesh: True joins the mesh in any case, False leaves it out.
        stays: go on trying to join what is not there yet, such as the mesh once its hub has come.
        preload: load now what a stop must not wait for, as a program does that lasts longer than a command.
        console: on the mesh the caller's name is its whole id, by which robots may know a safety controller.

    Raises:
        ValidationError: the profile or the flags cannot be used.
    """
    from strands_robots.fleet.networks import Networks  # noqa: PLC0415 - loaded when a network is used

    absent: dict[str, str] = {}
    keys: dict[str, Callable[[], NetworkKey]] = {}
    networks: list[NetworkAdapter] = []
    if not devices:
        absent[DEVICE_CONNECT] = "it is left out"
    elif profile is not None and not profile.reaches_devices(given):
        absent[DEVICE_CONNECT] = f"the connection profile {profile.label} has none of its networks"
    elif given or (profile is not None and profile.network) or find_spec("device_connect_edge") is not None:
        from strands_robots.fleet.device_connect.network import DeviceConnectNetwork  # noqa: PLC0415 - loaded when it is used

        flags = LinkFlags(**given) if profile is None else profile.flags(given)
        networks.append(DeviceConnectNetwork(flags.link(), source, preload=preload or stays))
    else:
        absent[DEVICE_CONNECT] = "the extra device-connect is not installed"
    unasked = {*absent}
    stated = None if profile is None or mesh is False else profile.mesh
    off = mesh is False or mesh_env_request() is False
    if not mesh and (off or (stated is None and (profile is not None or not _states_mesh()))):
        unasked.add(MESH)
    if off:
        absent[MESH] = "it is switched off"
    elif profile is not None and stated is None and mesh is None:
        # The mesh of the environment may be another fleet's.
        absent[MESH] = f"the connection profile {profile.label} has none"
    elif mesh is None and stated is None and find_spec("zenoh") is None:
        absent[MESH] = "the extra mesh is not installed"
    elif MESH in unasked and not _on_a_mesh():
        # Its code is not loaded: most machines have no mesh.
        if stays or not (why := no_hub()):
            networks.append(cast("NetworkAdapter", LocalMesh(partial(_mesh_network, source, None, console=console))))
        else:
            absent[MESH], keys[MESH] = why, local_key
    else:
        networks.append(_mesh_network(source, stated, console=console))
    return Networks(networks, absent, keys, stays=stays, unasked=unasked)


def _mesh_network(source: str, stated: Mapping[str, str] | None, *, console: bool) -> NetworkAdapter:
    from strands_robots.fleet.mesh.network import MeshNetwork  # noqa: PLC0415 - loaded when it is used

    return MeshNetwork(source, stated, console=console)


def networks_for_stop(
    profile: FleetProfile | None, given: Mapping[str, Any], source: str, *, devices: bool = True
) -> Networks:
    """Return the networks of a stop, as :func:`networks_of`.

    A stop leaves on one network though the settings of the other cannot be used; its verdict names that one.

    Raises:
        ValidationError: the settings of neither can be used.
    """
    try:
        return networks_of(profile, given, source, devices=devices)
    except (ValidationError, MissingExtraError) as exc:
        unfit = exc
    parts: list[tuple[str, FleetProfile | None, dict[str, bool]]] = [(DEVICE_CONNECT, profile, {"devices": False})]
    if devices and profile is not None and profile.network:
        parts.append((MESH, replace(profile, stated_mesh=None), {}))
    for left_out, rest, without in parts:
        try:
            networks = networks_of(rest, given, source, **without)
        except (ValidationError, MissingExtraError):
            continue
        networks.absent[left_out] = str(unfit)
        networks.keys[left_out] = partial(_unusable, unfit)
        return networks
    raise unfit


def _on_a_mesh() -> bool:
    """Return whether this process is on a mesh: it can join no other one."""
    session = sys.modules.get("strands_robots.mesh.session")
    return session is not None and session.opened_with() is not None


def _states_mesh() -> bool:
    """Return whether the settings ask for a mesh."""
    return (
        settings.raw("STRANDS_MESH_BACKEND").lower() != "zenoh"
        or bool(mesh_env_request())
        or settings.boolean("STRANDS_MESH_MULTICAST")
        or any(settings.items(f"{whose}_{way}") for whose in ("STRANDS_MESH", "ZENOH") for way in ("CONNECT", "LISTEN"))
    )


def _unusable(unfit: Exception) -> NoReturn:
    """Raise what keeps a network from being used, so that its robots are not known."""
    raise unfit
