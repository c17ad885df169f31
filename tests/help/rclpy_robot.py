"""A node of ROS 2 itself, which publishes the first frames of a log: rclpy_robot.py LOG FRAMES.

It rehearses, long before the log's stamps, until a line comes in; after another it plays the frames once.
"""

import struct
import sys
import threading
import time

import numpy as np
import rclpy
from geometry_msgs.msg import PoseStamped
from rclpy.qos import QoSProfile
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import CameraInfo, CompressedImage

from prior_sg.services.ingest.sources import open_source

COLOR, DEPTH, INFO, POSE = "/camera/color/image_raw/compressed", "/camera/depth/image_raw/compressedDepth", \
    "/camera/color/camera_info", "/pose"  # fmt: skip
TYPES = {COLOR: CompressedImage, DEPTH: CompressedImage, INFO: CameraInfo, POSE: PoseStamped}
PAUSE_S, EARLIER_S = 0.05, 10_000


def stamped(message, stamp_ns):
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, 10**9)
    message.header.frame_id = "world" if isinstance(message, PoseStamped) else "camera"
    return message


def messages(frame, earlier_ns=0):
    """What a robot with this frame would publish."""
    at_ns, camera = frame.stamp_ns - earlier_ns, frame.intrinsics
    color = CompressedImage(format="jpeg", data=frame.color)
    depth = CompressedImage(format="16UC1; compressedDepth png", data=struct.pack("<iff", 0, 0, 0) + frame.depth)
    fx, fy, cx, cy = camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px
    size = {"width": camera.width_px, "height": camera.height_px}
    info = CameraInfo(distortion_model="plumb_bob", d=[0.0] * 5, k=[fx, 0, cx, 0, fy, cy, 0, 0, 1], **size)
    info.p = [fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0]
    pose, matrix = PoseStamped(), np.array(frame.world_from_camera)
    place, turn = pose.pose.position, pose.pose.orientation
    place.x, place.y, place.z = matrix[:3, 3].tolist()
    turn.x, turn.y, turn.z, turn.w = Rotation.from_matrix(matrix[:3, :3]).as_quat().tolist()
    return {topic: stamped(m, at_ns) for topic, m in zip(TYPES, (color, depth, info, pose), strict=True)}


def main():
    frames = [frame for frame, _ in zip(open_source(sys.argv[1]), range(int(sys.argv[2])), strict=False)]
    rclpy.init()
    node, told = rclpy.create_node("camera"), threading.Event()
    publishers = {topic: node.create_publisher(kind, topic, QoSProfile(depth=50)) for topic, kind in TYPES.items()}
    threading.Thread(target=lambda: (sys.stdin.readline(), told.set()), daemon=True).start()
    round_ns = 0
    while not told.is_set():
        round_ns += 10**9
        for topic, message in messages(frames[0], EARLIER_S * 10**9 - round_ns).items():
            publishers[topic].publish(message)
        time.sleep(PAUSE_S)
    sys.stdin.readline()
    for frame in frames:
        for topic, message in messages(frame).items():
            publishers[topic].publish(message)
        time.sleep(PAUSE_S)
    sys.stdin.readline()


if __name__ == "__main__":
    main()
