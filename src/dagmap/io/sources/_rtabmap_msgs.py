"""`rtabmap_msgs` of ROS 2, field by field, for bags and topics that bring no definition of them.

ROS 1 sends its definitions along, and so do MCAP and newer `.db3` files.
"""

from __future__ import annotations

from typing import Any

MAP_DATA = ("rtabmap_msgs/msg/MapData", "rtabmap_ros/msg/MapData")
MAP_GRAPH = ("rtabmap_msgs/msg/MapGraph", "rtabmap_ros/msg/MapGraph")

_DEFINITIONS = {
    "Point2f": "float32 x\nfloat32 y",
    "Point3f": "float32 x\nfloat32 y\nfloat32 z",
    "KeyPoint": (
        "Point2f pt\nfloat32 size\nfloat32 angle\nfloat32 response\nint32 octave\nint32 class_id"
    ),
    "GlobalDescriptor": "std_msgs/Header header\nint32 type\nuint8[] info\nuint8[] data",
    "EnvSensor": "std_msgs/Header header\nint32 type\nfloat64 value",
    "GPS": (
        "float64 stamp\nfloat64 longitude\nfloat64 latitude\nfloat64 altitude\nfloat64 error\n"
        "float64 bearing"
    ),
    "LandmarkDetection": (
        "std_msgs/Header header\nstring landmark_frame_id\nint32 id\nfloat32 size\n"
        "geometry_msgs/PoseWithCovariance pose"
    ),
    "Link": (
        "int32 from_id\nint32 to_id\nint32 type\ngeometry_msgs/Transform transform\n"
        "float64[36] information"
    ),
    "SensorData": """
        std_msgs/Header header
        sensor_msgs/Image left
        sensor_msgs/Image right
        uint8[] left_compressed
        uint8[] right_compressed
        sensor_msgs/CameraInfo[] left_camera_info
        sensor_msgs/CameraInfo[] right_camera_info
        geometry_msgs/Transform[] local_transform
        sensor_msgs/PointCloud2 laser_scan
        uint8[] laser_scan_compressed
        int32 laser_scan_max_pts
        float32 laser_scan_max_range
        int32 laser_scan_format
        geometry_msgs/Transform laser_scan_local_transform
        uint8[] user_data
        uint8[] grid_ground
        uint8[] grid_obstacles
        uint8[] grid_empty_cells
        float32 grid_cell_size
        Point3f grid_view_point
        KeyPoint[] key_points
        Point3f[] points
        uint8[] descriptors
        GlobalDescriptor[] global_descriptors
        EnvSensor[] env_sensors
        sensor_msgs/Imu imu
        geometry_msgs/Transform imu_local_transform
        LandmarkDetection[] landmarks
        geometry_msgs/Pose ground_truth_pose
        GPS gps""",
    "Node": """
        int32 id
        int32 map_id
        int32 weight
        float64 stamp
        string label
        geometry_msgs/Pose pose
        int32[] word_id_keys
        int32[] word_id_values
        KeyPoint[] word_kpts
        Point3f[] word_pts
        uint8[] word_descriptors
        SensorData data""",
    "MapGraph": """
        std_msgs/Header header
        geometry_msgs/Transform map_to_odom
        int32[] poses_id
        geometry_msgs/Pose[] poses
        Link[] links""",
    "MapData": "std_msgs/Header header\nMapGraph graph\nNode[] nodes",
}


def register(types: Any, typesys: Any) -> None:
    """Add what a type store of ROS 2 lacks of them. typesys: the module `rosbags.typesys`."""
    wanted: dict[str, Any] = {}
    for name, definition in _DEFINITIONS.items():
        kind = f"rtabmap_msgs/msg/{name}"
        if kind not in types.types:
            wanted |= typesys.get_types_from_msg(definition, kind)
    types.register(wanted)
