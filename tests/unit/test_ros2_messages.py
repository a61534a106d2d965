"""The table of ROS 2 messages: its bytes are those of other libraries, and it reads what it writes."""

import numpy as np
import pytest
from any_message import KINDS, messages
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap_ros2._dynamic import generate_dynamic, serialize_dynamic
from rosbags.typesys import Stores, get_typestore

from twin.records.ros2 import decode, definition_of, encode, fields_of, full_name

ROS = get_typestore(Stores.ROS2_HUMBLE)


def in_rosbags(kind, message):
    """The message as an object of rosbags."""
    made = {}
    for field in fields_of(kind):
        value = message[field.name]
        if "/" in field.kind:
            value = in_rosbags(field.kind, value) if field.length is None else [in_rosbags(field.kind, each) for each in value]
        elif field.length is not None and field.kind != "string":
            value = np.array(value, {"bool": "?", "byte": "uint8"}.get(field.kind, field.kind))
        made[field.name] = value
    return ROS.types[full_name(kind)](**made)


@pytest.mark.parametrize("kind", KINDS)
def test_the_fields_are_those_of_ros(kind):
    ours = [(field.name, field.length) for field in fields_of(kind)]
    theirs = []
    for name, (node, detail) in ROS.fielddefs[full_name(kind)][1]:
        length = {"ARRAY": detail[1] if node.name == "ARRAY" else None, "SEQUENCE": 0}.get(node.name)
        theirs.append((name, length))
    assert ours == theirs


@pytest.mark.parametrize("kind", KINDS)
def test_bytes_are_those_of_other_libraries_and_come_back(kind):
    write = serialize_dynamic(full_name(kind), definition_of(kind))[full_name(kind)]
    read = generate_dynamic(full_name(kind), definition_of(kind))[full_name(kind)]

    @settings(max_examples=40)
    @given(messages(kind))
    def check(message):
        data = encode(kind, message)
        assert data == write(message)
        assert data == bytes(ROS.serialize_cdr(in_rosbags(kind, message), full_name(kind)))
        assert encode(kind, decode(kind, data)) == data
        assert encode(kind, decode(kind, bytes(ROS.serialize_cdr(in_rosbags(kind, message), full_name(kind), little_endian=False)))) == data
        assert read(data) is not None

    check()


def test_arrays_of_points_are_written_as_lists_of_them_are():
    points = np.arange(12.0).reshape(4, 3)
    as_dicts = [dict(zip("xyz", point, strict=True)) for point in points.tolist()]
    marker = {"id": 3, "points": points, "colors": np.ones((4, 4), np.float32)}
    plain = marker | {"points": as_dicts, "colors": [dict.fromkeys("rgba", 1.0)] * 4}
    assert encode("visualization_msgs/Marker", marker) == encode("visualization_msgs/Marker", plain)


def test_missing_fields_are_zero():
    full = {"header": {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""}, "pose": {"pose": {}, "covariance": [0.0] * 36}}
    assert encode("geometry_msgs/PoseWithCovarianceStamped", {}) == encode("geometry_msgs/PoseWithCovarianceStamped", full)


@given(st.data())
def test_cut_or_foreign_bytes_are_refused(data):
    whole = encode("sensor_msgs/CompressedImage", {"format": "jpeg", "data": b"12345"})
    cut = data.draw(st.integers(0, len(whole) - 1))
    with pytest.raises(ValueError, match="sensor_msgs/msg/CompressedImage: "):
        decode("sensor_msgs/CompressedImage", whole[:cut])
    with pytest.raises(ValueError, match="an encoding other than CDR"):
        decode("sensor_msgs/CompressedImage", b"\x00\x07" + whole[2:])


@given(st.binary(max_size=200))
def test_any_bytes_are_a_message_or_refused(data):
    for kind in ("sensor_msgs/Image", "visualization_msgs/MarkerArray", "tf2_msgs/TFMessage"):
        try:
            decode(kind, b"\x00\x01\x00\x00" + data)
        except ValueError:
            continue
