"""Hypothesis strategies of ROS 2 messages with any content."""

from functools import cache

from hypothesis import strategies as st

from twin.records.ros2 import fields_of

KINDS = (
    "builtin_interfaces/Duration",
    "builtin_interfaces/Time",
    "diagnostic_msgs/DiagnosticArray",
    "diagnostic_msgs/DiagnosticStatus",
    "diagnostic_msgs/KeyValue",
    "geometry_msgs/Point",
    "geometry_msgs/Pose",
    "geometry_msgs/PoseStamped",
    "geometry_msgs/PoseWithCovariance",
    "geometry_msgs/PoseWithCovarianceStamped",
    "geometry_msgs/Quaternion",
    "geometry_msgs/Transform",
    "geometry_msgs/TransformStamped",
    "geometry_msgs/Twist",
    "geometry_msgs/TwistStamped",
    "geometry_msgs/Vector3",
    "geometry_msgs/Wrench",
    "geometry_msgs/WrenchStamped",
    "sensor_msgs/CompressedImage",
    "sensor_msgs/Image",
    "sensor_msgs/JointState",
    "sensor_msgs/PointCloud2",
    "sensor_msgs/PointField",
    "std_msgs/ColorRGBA",
    "std_msgs/Float32MultiArray",
    "std_msgs/Float64MultiArray",
    "std_msgs/Header",
    "std_msgs/Int8",
    "std_msgs/MultiArrayDimension",
    "std_msgs/MultiArrayLayout",
    "std_msgs/String",
    "tf2_msgs/TFMessage",
    "visualization_msgs/Marker",
    "visualization_msgs/MarkerArray",
    "visualization_msgs/MeshFile",
    "visualization_msgs/UVCoordinate",
)
"""The messages that the program uses, with those in them."""

RANGES = {
    "int8": (-128, 127),
    "int32": (-(2**31), 2**31 - 1),
    "uint8": (0, 255),
    "byte": (0, 127),
    "uint32": (0, 2**32 - 1),
    "bool": (0, 1),
}
NAMES = st.text(st.characters(exclude_characters="\0", exclude_categories=("Cs",)), max_size=9)


@cache
def messages(kind):
    """Any message of a kind, as a dict of plain values."""
    return st.fixed_dictionaries({field.name: _values(field) for field in fields_of(kind)})


def _values(field):
    if "/" in field.kind:
        one = messages(field.kind)
    elif field.kind == "string":
        one = NAMES
    elif field.kind in RANGES:
        one = st.integers(*RANGES[field.kind])
    else:
        one = st.floats(width=int(field.kind[-2:]), allow_nan=False)
    if field.length is None:
        return one
    return st.lists(one, min_size=field.length, max_size=field.length or 3)
