"""A participant of a DDS domain that writes and reads ROS 2 messages as bytes (CDR), so that no picture is converted number by number.

A topic ``/name`` of ROS 2 is ``rt/name`` in DDS, and a message ``PKG/msg/Name`` is the type ``PKG::msg::dds_::Name_``.
"""

import os
import time
from functools import cache
from typing import Any

from hardware.errors import DeviceError
from scenes.files import quote
from twin.errors import ErrorsAs, extras_named
from twin.records.ros2 import fields_of

DOMAIN_VARIABLE = "ROS_DOMAIN_ID"
LOCAL_VARIABLE = "ROS_LOCALHOST_ONLY"
LOCAL = (
    '<CycloneDDS><Domain><General><AllowMulticast>false</AllowMulticast><Interfaces><NetworkInterface address="127.0.0.1"/></Interfaces>'
    '</General><Discovery><ParticipantIndex>auto</ParticipantIndex><Peers><Peer Address="localhost"/></Peers></Discovery></Domain>'
    "</CycloneDDS>"
)
"""Cyclone DDS's configuration where ``ROS_LOCALHOST_ONLY`` is 1: nothing leaves this computer."""
LARGEST_DOMAIN = 232
"""Largest number of a domain: the ports of larger ones do not exist."""
KEPT_SENSOR, KEPT = 5, 10
"""Messages that a topic keeps: those of ROS 2's profiles for sensor data, and for everything else."""
WAIT_S = 0.1
"""Time, s, after which a wait for a message looks whether it should end."""
LOOK_S = 1.5
"""Time, s, in which the participants of a domain find each other."""


def domain_id() -> int:
    """The domain that the environment names (``ROS_DOMAIN_ID``), or 0; ``DeviceError`` if it is no number of a domain."""
    text = os.environ.get(DOMAIN_VARIABLE) or "0"
    if not text.isdecimal() or int(text) > LARGEST_DOMAIN:
        raise DeviceError(f"{DOMAIN_VARIABLE}={quote(text)}: expected 0 to {LARGEST_DOMAIN}")
    return int(text)


class Participant:
    """A participant of the domain of the environment.

    Raises
    ------
    ExtraError
        The package ``cyclonedds`` is not installed.
    DeviceError
        The domain is not possible, or there is no network for it.
    """

    def __init__(self) -> None:
        with extras_named():
            from cyclonedds import core, domain
        number = domain_id()
        if os.environ.get(LOCAL_VARIABLE) == "1":
            os.environ.setdefault("CYCLONEDDS_URI", LOCAL)
        why = "check the network, and CYCLONEDDS_URI if it is set"
        with ErrorsAs(core.DDSException, lambda error: DeviceError(f"ROS 2, domain {number}: can't be joined ({error.msg}); {why}")):
            self._participant = domain.DomainParticipant(number)

    def writer(self, topic: str, kind: str, *, sensor: bool = False, kept: bool = False) -> "Writer":
        """A writer of a topic. ``sensor``: best effort, as ROS 2's profile for sensor data; ``kept``: late readers get the last message."""
        return Writer(self._participant, topic, kind, sensor=sensor, kept=kept)

    def reader(self, topic: str, kind: str) -> "Reader":
        """A reader of a topic, best effort, which fits every writer."""
        return Reader(self._participant, topic, kind)

    def topics(self) -> dict[str, str]:
        """The topics that somebody writes, with the short names of their messages (``sensor_msgs/Image``). This takes ``LOOK_S``."""
        from cyclonedds import builtin

        reader = builtin.BuiltinDataReader(self._participant, builtin.BuiltinTopicDcpsPublication)
        time.sleep(LOOK_S)
        found = {each.topic_name: each.type_name for each in reader.take(N=10_000)}
        return {name[2:]: kind.replace("::msg::dds_::", "/")[:-1] for name, kind in sorted(found.items()) if name.startswith("rt/")}


class Writer:
    """Writes messages to a topic."""

    def __init__(self, participant: Any, topic: str, kind: str, *, sensor: bool, kept: bool) -> None:
        from cyclonedds import _clayer, pub
        from cyclonedds.core import Policy

        reliability = Policy.Reliability.BestEffort if sensor else Policy.Reliability.Reliable(100_000_000)
        durability = Policy.Durability.TransientLocal if kept else Policy.Durability.Volatile
        depth = 1 if kept else KEPT_SENSOR if sensor else KEPT
        self._write, self.name = _clayer.ddspy_write_ts, topic
        self._writer = pub.DataWriter(participant, _topic(participant, topic, kind), _qos(reliability, durability, depth))

    @property
    def heard(self) -> bool:
        """Whether anybody reads the topic."""
        return bool(self._writer.get_matched_subscriptions())

    def write(self, message: bytes, at_ns: int) -> None:
        """Write an encoded message with the time of what it shows, ns since 1970.

        Raises
        ------
        DeviceError
            It can't be sent.
        """
        if (code := self._write(self._writer._ref, message + bytes(-len(message) % 4), at_ns)) < 0:
            raise DeviceError(f"{self.name}: not sent (DDS code {code})")


class Reader:
    """Reads messages of a topic."""

    def __init__(self, participant: Any, topic: str, kind: str) -> None:
        from cyclonedds import _clayer, core, sub
        from cyclonedds.core import Policy

        qos = _qos(Policy.Reliability.BestEffort, Policy.Durability.Volatile, KEPT_SENSOR)
        self._reader = sub.DataReader(participant, _topic(participant, topic, kind), qos)
        self._take, self._states = _clayer.ddspy_take, core.SampleState.Any | core.ViewState.Any | core.InstanceState.Any
        condition = core.ReadCondition(self._reader, core.SampleState.NotRead | core.ViewState.Any | core.InstanceState.Any)
        self._waits = core.WaitSet(participant)
        self._waits.attach(condition)

    @property
    def served(self) -> bool:
        """Whether anybody writes the topic."""
        return bool(self._reader.get_matched_publications())

    def take(self, wait_s: float = WAIT_S) -> list[bytes]:
        """The messages that came since the last call, the oldest first. It waits at most ``wait_s`` for one."""
        self._waits.wait(round(1e9 * wait_s))
        found = self._take(self._reader._ref, self._states, KEPT_SENSOR)
        return [] if isinstance(found, int) else [bytes(data) for data, info in found if info.valid_data]


def _qos(reliability: Any, durability: Any, depth: int) -> Any:
    from cyclonedds.core import Policy, Qos

    return Qos(reliability, durability, Policy.History.KeepLast(depth), Policy.DataRepresentation(use_cdrv0_representation=True))


def _topic(participant: Any, name: str, kind: str) -> Any:
    from cyclonedds.topic import Topic

    return Topic(participant, f"rt{name}", _type_of(kind))


@cache
def _type_of(kind: str) -> Any:
    """The DDS type of a message."""
    from cyclonedds.idl import make_idl_struct, types

    many: Any = types  # its types have no annotations

    def of(name: str, length: int | None) -> Any:
        one = {"string": str, "bool": bool}.get(name) or getattr(types, name, None) or _type_of(name)
        return one if length is None else many.array[one, length] if length else many.sequence[one]

    package, name = kind.split("/")
    fields = {field.name: of(field.kind, field.length) for field in fields_of(kind)}
    return make_idl_struct(f"{name}_", f"{package}.msg.dds_.{name}_", fields)
