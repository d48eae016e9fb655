"""Joints and cameras of a simulated world on a ROS 2 graph."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from strands_robots.ros_telemetry import RosTelemetryBridge
from strands_robots.utils import ValidationError


class SimRosBridge(RosTelemetryBridge):
    """Publisher of a simulation on ROS 2; it takes no commands.

    ``publish_joint_states`` and ``publish_image`` are those of a real robot's bridge. With a simulation,
    :meth:`publish` publishes all its robots at once, and ``start`` does so at a rate.

    Args:
        simulation: the world whose robots are published; None to publish by hand.
        domain_id: ROS 2 domain, 0 to 232.
        node_name: of the node, ``strands_sim`` by default.
        qos_depth: KEEP_LAST history of each endpoint, 1 to ``MAX_QOS_HISTORY_DEPTH``.

    Raises:
        ValidationError: an argument outside its domain, or two robots or cameras of one topic, before anything else
            has happened.
        RosError: no ROS 2 is sourced, or it did not start.
    """

    default_node_name = "strands_sim"

    def __init__(
        self, simulation: Any = None, *, domain_id: int = 0, node_name: str | None = None, qos_depth: int = 10
    ) -> None:
        self._simulation = simulation
        super().__init__(domain_id=domain_id, node_name=node_name, qos_depth=qos_depth)

    def publish(self, cameras: Sequence[str] = (), *, width: int = 320, height: int = 240) -> None:
        """Publish every robot's joints (rad; m for a slide) and a picture a camera.

        Raises:
            ValidationError: no simulation, no such camera, or one with another one's topic.
        """
        world = self._simulation
        if world is None:
            raise ValidationError("simulation must be given to publish all of it at once, not None.")
        for name in world.list_robots():
            # An observation also has the base's pose, which is no joint.
            observation = world.get_observation(name)
            joints = [joint for joint in world.get_features()["robots"][name]["joints"] if joint in observation]
            self.publish_joint_states(name, joints, [observation[joint] for joint in joints])
        for camera in cameras:
            picture, _ = world.picture(camera, width, height)
            self.publish_image(world.tool_name_str, camera, picture)

    def _claim_known(self) -> None:
        world = self._simulation
        if world is None:
            return
        for name in world.list_robots():
            self._claim(self.joint_states_topic(name), f"robot {name!r}")
        for camera in world.get_features()["cameras"]:
            self._claim_image(world.tool_name_str, camera)
