"""ROS 2 over Zenoh as the middleware rmw_zenoh speaks it: names on the wire, types, a session; ROS is not needed."""
