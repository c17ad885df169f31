"""A scene as topics of ROS 2: markers, grids, frames, masks for Nav2, and a task that comes from there."""
