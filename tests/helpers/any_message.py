"""Hypothesis strategies of ROS 2 messages with any content."""

from functools import cache

from hypothesis import strategies as st

from twin.records.ros2_messages import DEFINITIONS, fields_of

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
    if field.kind in DEFINITIONS:
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
