"""Three agents in one ROS 2 system: ros2 launch three_robots.launch.py files:=$PWD

Each has the namespace of its robot, so that `points`, `odom` and `dagmap/map` are the robot's own.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node

ROBOTS = ("robot1", "robot2", "robot3")


def generate_launch_description() -> LaunchDescription:
    files = LaunchConfiguration("files")
    nodes = [
        Node(
            executable="dagmap-ros2",  # in PATH: pip installs it
            namespace=robot,
            name="dagmap",
            output="screen",
            parameters=[{"config": PathJoinSubstitution([files, f"{robot}.toml"])}],
        )
        for robot in ROBOTS
    ]
    argument = DeclareLaunchArgument("files", description="Folder of the robots' TOML files")
    return LaunchDescription([argument, *nodes])
