"""Hands topics of ROS 2 nodes, heard over DDS, on to a Zenoh router: relay.py ENDPOINT TOPIC=TYPE…"""

import importlib
import sys

import rclpy
from rclpy.qos import QoSProfile

from prior_sg.services.runtime.ros.session import RosSession
from prior_sg.services.runtime.ros.types import shared_types
from prior_sg.services.runtime.ros.wire import Channel


def main():
    endpoint, *topics = sys.argv[1:]
    rclpy.init()
    node, types = rclpy.create_node("relay"), shared_types()
    with RosSession(endpoint, "relay") as session:
        for topic, name in (text.split("=") for text in topics):
            package, _, short = name.partition("/msg/")
            kind = getattr(importlib.import_module(f"{package}.msg"), short)
            publisher = session.publisher(Channel(topic, name, types.hash(name)))
            node.create_subscription(kind, topic, publisher.publish, QoSProfile(depth=50), raw=True)
        print("ready", flush=True)
        rclpy.spin(node)


if __name__ == "__main__":
    main()
