"""The robot's own ROS: its SLAM's topics in, the fleet's map out.

`feed` makes cycles of messages, `telling` messages of the map; `bridge` is the thread between them
and the agent. A link carries the bytes: `over_zenoh` without ROS installed, `over_rclpy` and
`over_rospy` where it is.
"""
