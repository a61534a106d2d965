"""The Magician's frames, against frames checked on real arms."""

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hardware.arms.magician_wire import QUEUED, WRITE, Id, Message, Ptp, take_message
from hardware.emulators.faults import Faults
from hardware.emulators.magician import FAULTS
from hardware.emulators.magician_controller import MagicianController

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
    return MagicianController(Faults(FAULTS), time_scale=1e6)


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
