"""Networks of a caller: of a connection profile, of flags, or of this machine."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from importlib.util import find_spec
from typing import Any, NoReturn, cast

from strands_robots import settings
from strands_robots._mesh_switch import mesh_env_request
from strands_robots.fleet.adapter import DEVICE_CONNECT, MESH, NetworkAdapter
from strands_robots.fleet.link_flags import LinkFlags
from strands_robots.fleet.mesh_settings import local_key, no_hub
from strands_robots.fleet.networks import Networks
from strands_robots.fleet.profiles import FleetProfile
from strands_robots.safety.network_key import NetworkKey
from strands_robots.utils import MissingExtraError, ValidationError


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
            from strands_robots.fleet.mesh.local import LocalMesh  # noqa: PLC0415 - as above

            networks.append(cast("NetworkAdapter", LocalMesh(source, console=console)))
        else:
            absent[MESH], keys[MESH] = why, local_key
    else:
        networks.append(_mesh(source, stated, console))
    return Networks(networks, absent, keys, stays=stays, unasked=unasked)


def _mesh(source: str, stated: Mapping[str, str] | None, console: bool) -> NetworkAdapter:
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
