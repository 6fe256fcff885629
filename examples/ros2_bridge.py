"""A ROS 2 node that publishes a gateway's tools as PoseStamped and its markers as PointCloud2.

    python examples/ros2_bridge.py tcp/192.0.2.5:7447 lab

It reads the gateway's Zenoh keys and publishes /lab/markers and one topic per tool, such as /lab/tool_Tool_1.
It needs rclpy (from a sourced ROS 2 environment), eclipse-zenoh and numpy. The configuration of the gateway
must contain ``zenoh: {tool_poses: true}``.
"""

import argparse
import contextlib
import json
import re
import struct
from array import array
from urllib.parse import unquote

import rclpy
import ros2_values
import zenoh
from geometry_msgs.msg import PoseStamped
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import Header

FIELDS = [
    PointField(name=name, offset=offset, datatype=PointField.FLOAT32, count=1)
    for name, offset in (("x", 0), ("y", 4), ("z", 8))
]


class Bridge(Node):
    """A node for the markers and tools of one source. The ROS frame has the name of the source."""

    def __init__(self, source: str) -> None:
        super().__init__("rtc3d_bridge")
        self._source = source
        self._markers = self.create_publisher(PointCloud2, f"{source}/markers", qos_profile_sensor_data)
        self._tools: dict[str, Publisher] = {}

    def on_markers(self, sample: zenoh.Sample) -> None:
        try:
            cloud = ros2_values.cloud(sample.payload.to_bytes())
        except (struct.error, ValueError) as error:
            self.get_logger().warning(f"ignored a malformed message: {error}")
            return
        message = PointCloud2(header=self._header(cloud.stamp), height=1, width=cloud.width, fields=FIELDS)
        message.point_step, message.row_step = 12, 12 * cloud.width
        message.is_bigendian, message.is_dense, message.data = False, False, array("B", cloud.data)
        self._markers.publish(message)

    def on_tool(self, sample: zenoh.Sample) -> None:
        try:
            pose = ros2_values.pose(sample.payload.to_bytes())
        except (struct.error, ValueError) as error:
            self.get_logger().warning(f"ignored a malformed message: {error}")
            return
        if pose is None:
            return
        message = PoseStamped(header=self._header(pose.stamp))
        position, orientation = message.pose.position, message.pose.orientation
        position.x, position.y, position.z = pose.position_m
        orientation.x, orientation.y, orientation.z, orientation.w = pose.orientation_xyzw
        label = unquote(str(sample.key_expr).rpartition("/")[2])
        if label not in self._tools:
            topic = f"{self._source}/" + re.sub(r"\W", "_", f"tool_{label}", flags=re.ASCII)
            self._tools[label] = self.create_publisher(PoseStamped, topic, qos_profile_sensor_data)
        self._tools[label].publish(message)

    def _header(self, stamp: ros2_values.Stamp) -> Header:
        header = Header(frame_id=self._source)
        header.stamp.sec, header.stamp.nanosec = stamp
        return header


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("endpoint", help="endpoint of the gateway or a router, such as tcp/192.0.2.5:7447")
    parser.add_argument("source", help="the source's name")
    options = parser.parse_args()
    source = options.source
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps([options.endpoint]))
    rclpy.init()
    bridge = Bridge(source)
    with zenoh.open(config) as session:
        session.declare_subscriber(f"mocap/{source}/3d", bridge.on_markers)
        session.declare_subscriber(f"mocap/{source}/6d/*", bridge.on_tool)
        rclpy.spin(bridge)


if __name__ == "__main__":
    with contextlib.suppress(KeyboardInterrupt):
        main()
