"""Recordings of ROS and robots that speak it."""
