"""What is said on Zenoh is said again by a node of ROS's own rclpy: `ros_relay.py relay ENDPOINT DOMAIN TYPE:TOPIC…`.

Each topic is latched. A second process, `listen SECONDS TYPE:TOPIC…`, is a plain node of rclpy that hears them and
prints what it understood, a line of JSON for each topic.
"""

import importlib
import json
import sys
import time

import rclpy
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def topics(words):
    for word in words:
        kind, _, name = word.partition(":")
        package, _, short = kind.split("/")
        yield kind, name, getattr(importlib.import_module(f"{package}.msg"), short)


def relay(endpoint, domain, *words):
    from prior_sg.services.runtime.ros.session import RosSession
    from prior_sg.services.runtime.ros.types import shared_types
    from prior_sg.services.runtime.ros.wire import Channel, Quality

    node = Node("relay")
    with RosSession(endpoint, "relay", int(domain)) as ros:
        for kind, name, of_ros in topics(words):
            out = node.create_publisher(of_ros, name, LATCHED)
            channel = Channel(name, kind, shared_types().hash(kind), Quality(1, latched=True))
            ros.subscribe(channel, lambda message, out=out: out.publish(message.payload), print)
        rclpy.spin(node)


def listen(seconds, *words):
    node, heard, wanted = Node("listener"), {}, list(topics(words))
    for _, name, of_ros in wanted:
        node.create_subscription(of_ros, name, lambda message, name=name: heard.update({name: message}), LATCHED)
    end_s = time.monotonic() + float(seconds)
    while len(heard) < len(wanted) and time.monotonic() < end_s:
        rclpy.spin_once(node, timeout_sec=0.1)
    for name, message in heard.items():
        print(json.dumps({"topic": name, "told": summary(message)}), flush=True)


def summary(message):
    if hasattr(message, "markers"):
        return [[one.ns, one.id, one.type, len(one.points), one.text] for one in message.markers]
    if hasattr(message, "info"):
        return [message.info.width, message.info.height, sorted(set(message.data))]
    return message.data


rclpy.init()
{"relay": relay, "listen": listen}[sys.argv[1]](*sys.argv[2:])
