"""Messages of ROS as posed RGB-D frames: images, cameras, transforms, and which topics are meant (pure).

Messages are taken by their fields alone, so those of any library serve: of rosbags, of rclpy, of a test.
"""
