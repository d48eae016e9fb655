"""A robot of this process on Device Connect and on the mesh, for a block."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING, Any

from strands_robots.cli.network import Network, mesh_peer
from strands_robots.cli.output import CliError
from strands_robots.cli.readiness import mesh_port_problem
from strands_robots.safety.sightings import DuplicateDeviceError

if TYPE_CHECKING:
    from device_connect_edge.drivers import DeviceDriver

    from strands_robots.device_connect.backends import LinkConfig
    from strands_robots.mesh import Mesh


@contextmanager
def device_of(
    network: Network, link: LinkConfig, robot: Any, peer_id: str | None
) -> Iterator[tuple[str, DeviceDriver]]:
    """Serve a robot on Device Connect; yield its id and its driver.

    Raises:
        CliError: it is not on the network.
    """
    from strands_robots import device_connect  # noqa: PLC0415 - loaded when it is used
    from strands_robots.device_connect.bringup import default_id, driver_for  # noqa: PLC0415 - as above

    driver = driver_for(robot, "robot")
    try:
        runtime = device_connect.init_device_connect_sync(
            driver,
            peer_id=peer_id or default_id(robot),
            link=link,
            allow_insecure=True if network.stated.opted_in else None,
        )
    except (device_connect.DuplicateDeviceError, TimeoutError, OSError) as exc:
        raise CliError(f"The robot is not on the network: {exc}") from exc
    try:
        yield str(runtime.device_id), driver
    finally:
        device_connect.stop_device_connect(runtime)


@contextmanager
def peer_of(robot: Any, peer_id: str | None, peer_type: str) -> Iterator[Mesh]:
    """Serve a robot on the mesh; yield its peer.

    Raises:
        CliError: it is not on the network.
    """
    with ExitStack() as joined:
        try:
            mesh = joined.enter_context(mesh_peer(robot, peer_id, peer_type))
        except DuplicateDeviceError as exc:
            raise CliError(f"The robot is not on the network: {exc}") from exc
        except CliError as exc:
            raise CliError(f"{exc} {mesh_port_problem(answers=False)}".strip(), exc.code) from exc
        yield mesh
