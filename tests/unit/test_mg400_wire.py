"""What goes over the MG400's wires, byte by byte and letter by letter."""

import struct
import time

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from hardware.arms.mg400_wire import PACKET_BYTES, TEST_VALUE, Mode, newest_packet, take_reply, why_refused
from hardware.arms.motion import ALARMS, explain
from hardware.emulators.faults import Faults
from hardware.emulators.mg400 import FAULTS, feedback_packet
from hardware.emulators.mg400_commands import LONGEST_REQUEST, Mg400Commands, take_request
from hardware.emulators.mg400_controller import Mg400Controller, PlanarFrame, RefusedError


def commands(firmware=(1, 7, 0), faults=(), enabled=True):
    arm = Mg400Controller(Faults(FAULTS, faults), time_scale=1000.0)
    table = Mg400Commands(arm, firmware)

    def run(text):
        request, rest = take_request(text)
        assert not rest
        try:
            return {**table.dashboard, **table.motion}[request.name](request) or ""
        except RefusedError as refusal:
            return refusal.error_id

    if enabled:
        run("EnableRobot()")
    return arm, run


def test_packet_has_every_field_where_the_arm_has_it():
    arm, run = commands()
    for text in (
        "EnableRobot(0.4,1,2,3)",
        "SetUser(2,{1,2,3,4})",
        "User(2)",
        "SetTool(3,{5,6,7,8})",
        "Tool(3)",
        "SpeedFactor(37)",
        "DO(3,1)",
    ):
        assert run(text) == ""
    data = feedback_packet(arm).tobytes()
    joints = arm.track.joints_deg(0.0)
    seen = (PlanarFrame(1, 2, 3, 4).inverse() @ PlanarFrame.of_pose(arm.track.pose(0.0)) @ PlanarFrame(5, 6, 7, 8)).pose[[0, 1, 2, 5]]

    def at(offset, form):
        return struct.unpack_from("<" + form, data, offset)

    assert len(data) == 1440 and at(0, "H") == (1440,) and at(48, "Q") == (0x0123456789ABCDEF,)
    assert at(8, "Q") == (0,) and at(16, "Q") == (1 << 2,) and at(24, "Q") == (5,) and at(64, "d") == (37.0,)
    assert abs(at(32, "Q")[0] / 1000 - time.time()) < 5
    for offset in (192, 432):
        assert at(offset, "4d") == pytest.approx(tuple(joints))
    for offset in (240, 480, 528, 672, 720, 816, 1120):
        assert at(offset, "6d") == (0.0,) * 6  # at rest; currents and forces are not emulated
    for offset in (624, 768):
        assert at(offset, "4d") == pytest.approx(tuple(seen))  # R is the fourth
    assert at(1012, "BBBB") == (2, 3, 1, 0) and at(1025, "7B") == (0, 1, 0, 0, 0, 0, 1)
    assert at(1168, "4d") == (0.4, 1, 2, 3) and at(1200, "4d") == (1, 2, 3, 4) and at(1248, "4d") == (5, 6, 7, 8)
    assert at(1296, "Q") == (0,)
    half = np.radians(seen[3]) / 2
    assert at(1352, "4d") == at(1384, "4d") == pytest.approx((np.cos(half), 0, 0, np.sin(half)))


def test_the_speeds_in_the_packet_are_those_of_the_motion():
    arm, run = commands()
    arm._time_scale = 1.0
    assert run("MovL(230,20,-20,0,SpeedL=10,AccL=100)") == ""
    time.sleep(0.15)
    packet = feedback_packet(arm)
    assert packet["mode"] == Mode.RUNNING and packet["running"]
    assert np.linalg.norm(packet["tcp_speed_actual"][:3]) == pytest.approx(100.0, rel=0.02)  # 10 % of 1000 mm/s
    assert np.abs(packet["qd_actual"][:4]).max() > 1.0


@given(st.lists(st.sampled_from(["good", "short", "wrong"]), min_size=1, max_size=5), st.integers(1, 3000), st.integers(0, 100))
def test_the_newest_whole_packet_is_taken_whatever_came_between(kinds, cut, noise):
    good, short = [], []
    stream = b"\x11" * noise
    for n, kind in enumerate(kinds):
        packet = bytearray(PACKET_BYTES)
        struct.pack_into("<H", packet, 0, PACKET_BYTES)
        struct.pack_into("<Q", packet, 32, n + 1)
        struct.pack_into("<Q", packet, 48, TEST_VALUE if kind != "wrong" else 0)
        short += [len(stream)] if kind == "short" else []
        stream += bytes(packet[:1000] if kind == "short" else packet)
        good += [n + 1] if kind == "good" else []
    assume(cut - PACKET_BYTES not in short)  # a short one that seems to end with what came so far looks whole
    newest, rest = None, b""
    for piece in (stream[:cut], stream[cut:]):
        packet, rest = newest_packet(rest + piece)
        newest = packet if packet is not None else newest
    assert (None if newest is None else int(newest["unix_ms"])) == (good[-1] if good else None)


@pytest.mark.parametrize(
    ("arrived", "reply"),
    [
        ("0,{5},RobotMode();", (0, "5", "robotmode")),
        ("-1,{},;EnableRobot();", (-1, "", "enablerobot")),  # a refusal in two fragments
        ("-1,{},EnableRobot();", (-1, "", "enablerobot")),
        ("EnableRobot();", (None, "", "enablerobot")),  # old firmware
        ("0,{[[17],[],[],[],[],[],[]]},GetErrorID();", (0, "[[17],[],[],[],[],[],[]]", "geterrorid")),
    ],
)
def test_replies_of_every_form(arrived, reply):
    for cut in range(len(arrived)):  # split anywhere
        assert take_reply(arrived[:cut])[0] is None
    taken, rest = take_reply(arrived + "0,{")
    assert (taken.error_id, taken.values, taken.name) == reply and rest == "0,{"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("enablerobot()", ""),  # case does not matter
        ("  EnableRobot ( 0.5 )", ""),
        ("EnableRobot(0.5,1)", -20000),
        ("EnableRobot(0.6)", -40001),  # payload is 500 g
        ("SpeedFactor(0)", -40001),
        ("SpeedFactor(100)", ""),
        ("SpeedFactor(101)", -40001),
        ("SpeedJ(1.5)", -30001),
        ("AccL(x)", -30001),
        ("CP(0)", ""),
        ("CP(101)", -40001),
        ("User(0)", ""),
        ("User(4)", -1),  # absent
        ("Tool(4)", -1),
        ("SetCollisionLevel(5)", ""),
        ("SetCollisionLevel(6)", -40001),
        ("RobotMode()", "5"),
        ("RobotMode(1)", -20000),
        ("GetErrorID()", "[[],[],[],[],[]]"),
        ("MovL(1,2,3)", -20000),
        ("MovL(250,0,x,0)", -30003),
        ("MovL(250,0,0,0,SpeedL=0)", -40005),
        ("MovL(250,0,0,0,User=4)", -1),
        ("MovJ(250,0,0,0, SpeedJ=50, AccJ=50, CP=1)", ""),
        ("JointMovJ(0,10,50,0)", ""),
        ("RelJointMovJ(0,1,1,0)", ""),
        ("RelMovLUser(1,0,0,0, 0)", ""),  # clients put a space before the user
        ("RelMovJUser(1,0,0,0, 0,SpeedJ=5)", ""),
        ("MoveJog(J1+)", ""),
        ("MoveJog(X-)", ""),
        ("MoveJog(Q-)", ""),  # any other text stops a jog
        ("MoveJog()", ""),
        ("GetPose(User=1,Tool=0)", -30001),  # firmware 1.7
        ("InverseSolution(900,0,0,0,0,0)", -1),
        ("PositiveSolution(0,0,61,0,0,0)", -1),
        ("InverseSolution(1e308,1e308,1e308,1,0,0)", -1),
        (f"SpeedFactor({10**400})", -40001),
    ],
)
def test_what_a_command_answers(text, expected):
    assert commands()[1](text) == expected


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("text", ["MovL(300,0,-300,0)", "MovJ(1e5,0,0,0)"])
@pytest.mark.parametrize("paused", [False, True])
def test_a_place_that_can_not_be_reached_is_accepted_and_ends_in_an_alarm(text, paused):
    _reaches_nothing(text, paused=paused)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    "text",
    [
        "MovL(1e308,1e308,1e308,1)",
        "MovL(1e12,0,0,0)",
        "MovL(0,0,0,-1e308)",
        "MovLIO(1e308,-1e308,0,0,{0,50,1,1})",
        "MovJ(-1e308,1e308,0,1e308)",
        "RelMovL(1e308,0,0,0)",
        "RelMovJTool(0,1e308,0,1e308,0)",
        "JointMovJ(1e308,0,0,0)",
    ],
)
def test_a_place_beyond_all_numbers_is_one_that_can_not_be_reached(text):
    _reaches_nothing(text, paused=False)


@pytest.mark.filterwarnings("error")
def test_frames_beyond_all_numbers_are_far_away():
    _, run = commands()
    for text in ("SetUser(1,{1e308,-1e308,1e308,1e308})", "SetTool(1,{1e308,1e308,1e308,1e308})", "User(1)", "Tool(1)"):
        assert run(text) == ""
    assert all(np.isfinite(float(value)) for value in run("GetPose()").split(","))


def _reaches_nothing(text, *, paused):
    arm, run = commands()
    before = arm.track.pose(time.monotonic())
    assert not paused or run("Pause()") == ""
    assert run(text) == ""
    assert not paused or run("Continue()") == ""
    arm.update()
    assert len(arm.alarms) == 1 and np.array_equal(arm.track.pose(time.monotonic()), before)


def test_a_wait_is_as_long_as_it_may_be():
    arm, run = commands()
    assert run("wait(3600000)") == ""
    assert arm.track.target().duration_s == 3600.0


def test_the_packet_tells_that_the_arm_is_dragged():
    arm, run = commands()
    told = []
    for text in ("StartDrag()", "StopDrag()"):
        run(text)
        data = feedback_packet(arm).tobytes()
        told.append((data[24], data[1027]))
    assert told == [(6, 1), (5, 0)]


def test_solutions_and_poses_agree():
    arm, run = commands()
    told = [float(v) for v in run("GetPose()").split(",")]
    joints = run("GetAngle()")
    assert run(f"PositiveSolution({joints},0,0)") == run("GetPose()")
    assert [float(v) for v in run(f"InverseSolution({run('GetPose()')},0,0)").split(",")] == pytest.approx(
        [float(v) for v in joints.split(",")], abs=1e-4
    )
    assert len(told) == 4


def test_firmware_decides_on_frames():
    assert "setuser" not in Mg400Commands(commands()[0], (1, 5, 9)).dashboard
    _, run = commands(firmware=(1, 6))
    assert run("SetTool(1,{0,0,-50,0})") == "" and run("Tool(1)") == ""
    flange = [float(v) for v in run("GetPose(User=0,Tool=0)").split(",")]
    tip = [float(v) for v in run("GetPose()").split(",")]
    assert tip == pytest.approx([*flange[:2], flange[2] - 50, flange[3]])


def test_requests_in_pieces_and_in_a_row():
    request, rest = take_request("MovL(1,2,3,4)MovL(5,")
    assert request.values == ("1", "2", "3", "4") and rest == "MovL(5,"
    assert take_request(rest) == (None, rest)
    assert take_request("\r\n;Sync()")[0].name == "sync"
    assert take_request("MovLIO(1,2,3,4,(0,50,1,0))")[1] == ""


# Pieces of requests that never close.
OPEN = st.text(st.characters(codec="ascii", exclude_characters="\r\n)"), min_size=1, max_size=30).filter(lambda text: text.strip(" \t;"))


@given(OPEN, st.sampled_from(["\n", "\r\n", " \n\n"]))
def test_a_newline_ends_a_request_that_is_not_closed_and_what_follows_is_understood(text, newline):
    stream, buffer, found = f"{text}{newline}RobotMode(){newline}", "", []
    for letter in stream:  # split anywhere
        request, buffer = take_request(buffer + letter)
        found += [request] if request is not None else []
    assert [one.text for one in found] == [text.strip(" \t;"), "RobotMode()"] and not buffer.strip()
    assert not found[0].name and not found[0].values and found[1].name == "robotmode"


def test_a_request_that_never_ends_is_refused_at_its_largest_length():
    assert take_request("x" * LONGEST_REQUEST) == (None, "x" * LONGEST_REQUEST)
    request, rest = take_request("(" * (LONGEST_REQUEST + 1))
    assert (request.name, request.text, rest) == ("", "(" * (LONGEST_REQUEST + 1), "")
    many = "RobotMode()" * LONGEST_REQUEST  # complete ones may come in any number
    assert take_request(many)[1] == many[len("RobotMode()") :]


@pytest.mark.parametrize("alarm", [17, 18, 23, *range(64, 74), 85, 112, -2])
def test_every_alarm_is_explained_with_a_remedy(alarm):
    text = explain([alarm])
    assert str(alarm) in text and ALARMS[alarm] in text and "clear_error()" in text


@pytest.mark.parametrize(
    ("error_id", "word"), [(-1, "TCP mode"), (-10000, "30003"), (-20000, "number"), (-30002, "parameter 2"), (-40003, "parameter 3")]
)
def test_every_refusal_is_explained(error_id, word):
    assert word in why_refused(error_id, "MovL(1)")
