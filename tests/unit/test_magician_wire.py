"""The Magician's frames, against frames checked on real arms."""

import math
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hardware.arms.magician import QUEUED, WRITE, Id, Message, Ptp, take_message
from hardware.emulators.faults import Faults
from hardware.emulators.magician import FAULTS
from hardware.emulators.magician_controller import FORMS, JOG_SPEEDS, SPEEDS, STORED, EmulatedController

CHECKED = {
    "GetPose": (Message(10), "AA AA 02 0A 00 F6"),
    "queued PTP": (Message(84, 3, struct.pack("<B4f", 1, 250, 0, 0, 0)), "AA AA 13 54 03 01 00 00 7A 43" + " 00" * 12 + " EB"),
    "its reply": (Message(84, 3, struct.pack("<Q", 1)), "AA AA 0A 54 03 01 00 00 00 00 00 00 00 A8"),
    "start": (Message(240, 1), "AA AA 02 F0 01 0F"),
    "force stop": (Message(242, 1), "AA AA 02 F2 01 0D"),
    "clear": (Message(245, 1), "AA AA 02 F5 01 0A"),
    "index": (Message(246), "AA AA 02 F6 00 0A"),
    "clear alarms": (Message(20, 1), "AA AA 02 14 01 EB"),
}
MESSAGES = st.builds(Message, st.integers(0, 255), st.integers(0, 3), st.binary(max_size=100))


@pytest.mark.parametrize("name", CHECKED)
def test_frames_are_those_of_real_arms(name):
    message, text = CHECKED[name]
    assert message.to_bytes() == bytes.fromhex(text)
    assert take_message(bytes.fromhex(text)) == (message, b"")


def test_no_frame_is_longer_than_its_length_can_say():
    with pytest.raises(ValueError, match="at most 167"):
        Message(1, 0, bytes(168)).to_bytes()
    assert take_message(Message(1, 0, bytes(167)).to_bytes())[0].params == bytes(167)


@given(st.lists(MESSAGES, min_size=1, max_size=4), st.binary(max_size=6).filter(lambda noise: b"\xaa\xaa" not in noise + b"\xaa"))
def test_frames_are_found_in_noise_and_in_any_pieces(messages, noise):
    stream, buffer, found = b"".join(noise + message.to_bytes() for message in messages), b"", []
    for n in range(len(stream)):
        message, buffer = take_message(buffer + stream[n : n + 1])
        found += [message] if message is not None else []
    assert found == messages


@given(MESSAGES, MESSAGES)
def test_a_damaged_frame_is_skipped(damaged, good):
    broken = damaged.to_bytes()[:-1] + bytes([damaged.to_bytes()[-1] ^ 0xFF])
    found, buffer = [], broken + good.to_bytes()
    message, buffer = take_message(buffer)
    while message is not None:
        found.append(message)
        message, buffer = take_message(buffer)
    assert found[-1] == good


def test_aa_within_a_payload_is_legal():
    message = Message(84, 3, b"\xaa\xaa\xaa\x02\xaa" * 3)
    assert take_message(message.to_bytes()) == (message, b"")


@pytest.fixture
def arm():
    return EmulatedController(Faults(FAULTS), time_scale=1e6)


def ask(arm, id, params=b"", ctrl=0):
    reply = arm.answer(Message(id, ctrl, params))
    assert (reply.id, reply.ctrl) == (id, ctrl)
    return reply.params


def pose(arm):
    return struct.unpack("<8f", ask(arm, Id.GET_POSE))


def start(arm):
    assert ask(arm, Id.QUEUE_START, ctrl=WRITE) == b""


@pytest.mark.parametrize(
    ("id", "form"),
    [
        (Id.HOME_PARAMS, "<4f"),
        (Id.END_EFFECTOR, "<3f"),
        (Id.PTP_JOINT_PARAMS, "<8f"),
        (Id.PTP_COORDINATE_PARAMS, "<4f"),
        (Id.PTP_JUMP_PARAMS, "<2f"),
        (Id.PTP_COMMON_PARAMS, "<2f"),
        (Id.CP_PARAMS, "<3fB"),
    ],
)
def test_parameters_are_kept(arm, id, form):
    values = range(1, len(form.replace("<", "").replace("B", "")) and struct.Struct(form).size // 4 + 1)
    payload = struct.pack(form, *values, *([0] if "B" in form else []))
    assert ask(arm, id, payload, WRITE) == b"" and ask(arm, id) == payload
    start(arm)
    assert struct.unpack("<Q", ask(arm, id, payload, WRITE | QUEUED)) == (1,)  # queued: its index


def test_queued_commands_wait_for_the_start_and_count_on(arm):
    before = pose(arm)
    move = struct.pack("<B4f", Ptp.MOVL_XYZ, 200, 10, 20, 30)
    assert [struct.unpack("<Q", ask(arm, Id.PTP, move, 3))[0] for _ in range(3)] == [1, 2, 3]
    assert struct.unpack("<I", ask(arm, Id.QUEUE_SPACE)) == (29,) and pose(arm) == before
    assert ask(arm, Id.QUEUE_INDEX) == struct.pack("<Q", 0)
    start(arm)
    while ask(arm, Id.QUEUE_INDEX) != struct.pack("<Q", 3):
        pass
    assert pose(arm)[:4] == pytest.approx((200, 10, 20, 30), abs=1e-3)


@pytest.mark.parametrize(
    ("mode", "numbers", "xyzr"),
    [
        (Ptp.JUMP_XYZ, (210, 20, 10, 5), (210, 20, 10, 5)),
        (Ptp.MOVJ_XYZ, (210, 20, 10, 5), (210, 20, 10, 5)),
        (Ptp.MOVL_XYZ, (210, 20, 10, 5), (210, 20, 10, 5)),
        (Ptp.JUMP_ANGLE, (0, 45, 45, 9), None),
        (Ptp.MOVJ_ANGLE, (0, 45, 45, 9), None),
        (Ptp.MOVL_ANGLE, (0, 45, 45, 9), None),
        (Ptp.MOVJ_INC, (1, 2, 3, 4), None),
        (Ptp.MOVL_INC, (5, 6, 7, 8), (205, 6, 7, 8)),
        (Ptp.MOVJ_XYZ_INC, (5, 6, 7, 8), (205, 6, 7, 8)),
        (Ptp.JUMP_MOVL_XYZ, (210, 20, 10, 5), (210, 20, 10, 5)),
    ],
)
def test_every_way_to_move(arm, mode, numbers, xyzr):
    start(arm)
    ask(arm, Id.PTP, struct.pack("<B4f", Ptp.MOVJ_XYZ, 200, 0, 0, 0), 3)
    _finish(arm, 1)
    joints = pose(arm)[4:]
    ask(arm, Id.PTP, struct.pack("<B4f", mode, *numbers), 3)
    _finish(arm, 2)
    if xyzr is not None:
        assert pose(arm)[:4] == pytest.approx(xyzr, abs=1e-3)
    else:
        expected = numbers if mode != Ptp.MOVJ_INC else [a + b for a, b in zip(joints, numbers, strict=True)]
        assert pose(arm)[4:] == pytest.approx(expected, abs=1e-3)


def _finish(arm, index):
    while struct.unpack("<Q", ask(arm, Id.QUEUE_INDEX))[0] < index:
        assert not any(ask(arm, Id.ALARMS))


def test_other_commands(arm):
    start(arm)
    assert ask(arm, Id.RESET_POSE, bytes(9), WRITE) == b""
    for payload in (struct.pack("<I", 0), b""):  # clients send either
        ask(arm, Id.HOME, payload, 3)
    ask(arm, Id.WAIT, struct.pack("<I", 1), 3)
    ask(arm, Id.CP, struct.pack("<B4f", 1, 200, 10, 5, 0), 3)
    ask(arm, Id.CP, struct.pack("<B3fB", 0, 0, 0, 5, 0), 3)  # relative, as pydobot sends it
    _finish(arm, 5)
    assert pose(arm)[:3] == pytest.approx((200, 10, 10), abs=1e-3)
    ask(arm, Id.JOG, bytes([1, 2]), WRITE)
    assert pose(arm)[4] < 0
    ask(arm, Id.JOG, bytes([1, 0]), WRITE)
    for id in (Id.QUEUE_STOP, Id.QUEUE_FORCE_STOP, Id.QUEUE_CLEAR):
        assert ask(arm, id, ctrl=WRITE) == b""


def test_alarms_are_told_by_their_bit_and_cleared_by_a_write_to_20(arm):
    start(arm)
    ask(arm, Id.PTP, struct.pack("<B4f", Ptp.MOVL_XYZ, 900, 0, 0, 0), 3)
    alarms = ask(arm, Id.ALARMS)
    assert len(alarms) == 16 and alarms[17 // 8] == 1 << 17 % 8
    assert ask(arm, Id.ALARMS, ctrl=WRITE) == b"" and not any(ask(arm, Id.ALARMS))


def test_the_queue_space_may_be_wide(arm):
    arm.faults.add("wide-queue-space")
    assert ask(arm, Id.QUEUE_SPACE) == struct.pack("<Q", 32)


def alarms(arm):
    """Numbers of the alarms."""
    bits = int.from_bytes(ask(arm, Id.ALARMS), "little")
    return [n for n in range(128) if bits >> n & 1]


@pytest.mark.parametrize("ctrl", [WRITE, WRITE | QUEUED])
@pytest.mark.parametrize("id", [id for id, forms in FORMS.items() if "f" in forms[0]])
def test_numbers_that_no_arm_can_use_are_an_alarm_and_change_nothing(arm, id, ctrl):
    """Not finite, or a speed or acceleration that is not above 0."""
    form = FORMS[id][0]
    count = sum(isinstance(number, float) for number in struct.unpack(form, bytes(struct.calcsize(form))))
    bad = [math.nan, math.inf, -math.inf, *([0.0, -50.0] if id in SPEEDS else [-50.0] if id in JOG_SPEEDS else [])]
    start(arm)
    before = pose(arm), ask(arm, id) if id in STORED else b""
    for value in bad:
        for n in range(count):
            numbers = [50.0] * count
            numbers[n] = value
            assert ask(arm, id, struct.pack(form.replace("B", "x"), *numbers), ctrl) == b"" and alarms(arm) == [1]
            ask(arm, Id.ALARMS, ctrl=WRITE)
    assert (pose(arm), ask(arm, id) if id in STORED else b"") == before and struct.unpack("<I", ask(arm, Id.QUEUE_SPACE)) == (32,)


@pytest.mark.parametrize("id", JOG_SPEEDS)
def test_a_jog_at_speed_0_is_allowed_and_stands_still(arm, id):
    before = pose(arm)
    ask(arm, id, bytes(struct.calcsize(FORMS[id][0])), WRITE)
    ask(arm, Id.JOG, bytes([int(id == Id.JOG_JOINT_PARAMS), 1]), WRITE)
    assert pose(arm) == before and not alarms(arm)


@pytest.mark.parametrize(("x", "y"), [(1e6, 0.0), (1e9, 0.0), (3e38, -3e38)])
@pytest.mark.parametrize("mode", [Ptp.JUMP_XYZ, Ptp.MOVJ_XYZ, Ptp.MOVL_XYZ, Ptp.MOVL_INC, Ptp.MOVJ_ANGLE])
def test_a_place_far_away_is_an_alarm_at_once(arm, mode, x, y):
    start(arm)
    ask(arm, Id.PTP, struct.pack("<B4f", mode, x, y, 0, 0), 3)
    assert len(alarms(arm)) == 1


@pytest.mark.filterwarnings("ignore:divide by zero")
def test_a_command_that_fails_is_dropped_and_the_queue_goes_on(arm, caplog):
    """Such a command once failed again at each later command, even at the one that clears the queue."""
    move = struct.pack("<B4f", Ptp.MOVL_XYZ, 200, 10, 20, 30)
    arc = struct.pack("<8f", 1e30, 0, 0, 0, 1e30, 1e30, 0, 0)  # its circle is too large to be cut into lines
    start(arm)
    assert ask(arm, Id.ARC, arc, 3) == struct.pack("<Q", 1)
    assert alarms(arm) == [1] and "queued command 101 failed" in caplog.text
    ask(arm, Id.ALARMS, ctrl=WRITE)
    assert ask(arm, Id.QUEUE_INDEX) == struct.pack("<Q", 1) and struct.unpack("<I", ask(arm, Id.QUEUE_SPACE)) == (32,)
    assert ask(arm, Id.PTP, move, 3) == struct.pack("<Q", 2)
    _finish(arm, 2)
    assert pose(arm)[:4] == pytest.approx((200, 10, 20, 30), abs=1e-3)
    assert ask(arm, Id.QUEUE_CLEAR, ctrl=WRITE) == b"" and not alarms(arm)


def test_what_a_makers_client_asks_first_is_told_and_is_no_alarm(arm):
    serial, name, version, slide = (ask(arm, id) for id in (0, 1, 2, 13))
    assert serial.isascii() and name == b"Dobot Magician" and len(version) == 3 and struct.unpack("<f", slide) == (0.0,)
    assert not alarms(arm)


@pytest.mark.parametrize("id", sorted(set(range(256)) - set(Id)))
def test_a_read_of_anything_unknown_is_no_alarm_and_a_write_is(arm, id):
    ask(arm, id)
    assert not alarms(arm)
    for ctrl in (WRITE, QUEUED, WRITE | QUEUED):
        assert ask(arm, id, b"", ctrl) == b"" and alarms(arm) == [1]
        ask(arm, Id.ALARMS, ctrl=WRITE)
