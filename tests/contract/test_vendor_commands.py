"""The emulated MG400's commands as the vendor's document gives them, over real sockets."""

import socket
import time

import numpy as np
import pytest

from hardware.emulators.mg400 import Mg400Emulator

HOME = "MovL(300,0,0,0)"


class Client:
    """Sends a text to the port on which the document has it; the reply without its echo."""

    def __init__(self, emulator):
        self.ports = {name: socket.create_connection(("127.0.0.1", emulator.ports[port]), 5) for name, port in (("d", 29999), ("m", 30003))}

    def __call__(self, port, text):
        connection = self.ports[port]
        connection.sendall(text.encode())
        reply = ""
        while not reply.endswith(";"):
            reply += connection.recv(1024).decode()
        assert reply.endswith(f",{text};")
        return reply[: -len(text) - 2]

    def close(self):
        for connection in self.ports.values():
            connection.close()


@pytest.fixture
def emulator():
    with Mg400Emulator(port_offset=None, time_scale=10.0) as emulator:
        yield emulator


@pytest.fixture
def ask(emulator):
    client = Client(emulator)
    client("d", "EnableRobot()")
    client("m", HOME)
    client("m", "Sync()")
    yield client
    client.close()


ACCEPTED = [
    ("d", "SetPayload(0.3)"),
    ("d", "SetPayLoad(0.3,0.01)"),
    ("d", "PayLoad(0.300000,0.010000)"),
    ("d", "SetPayload(0.300000,0.01,)"),
    ("d", "Arch(1)"),
    ("d", "LimZ(80)"),
    ("d", "ToolDO(1,1)"),
    ("d", "ToolDOExecute(2,0)"),
    ("d", "DOGroup(4,1,6,0)"),
    ("d", "wait(10)"),
    ("d", "wait()"),
    ("d", "StartDrag()"),
    ("d", "StopDrag()"),
    ("d", "SetUser(0,{1,2,3,4})"),
    ("d", "SetUser(1,10,10,10,0)"),
    ("d", "SetTool(1,{10,10,10,0,0,5})"),
    ("d", "LoadSwitch(1)"),
    ("d", "SetArmOrientation(1)"),
    ("d", "SetArmOrientation(1,1,-1,1)"),
    ("d", "StopScript()"),
    ("d", "PauseScript()"),
    ("d", "ContinueScript()"),
    ("d", "SetHoldRegs(0,3095,2,{1,2},U16)"),
    ("d", "SetHoldRegs(0,3095,1,7)"),
    ("d", "SetCoils(0,0,3,'{1,0,1}')"),
    ("m", "Arc(320,20,0,0,340,0,0,0)"),
    ("m", "Arc(320.0,20.0,0.0,0.0,340.0,0.0,0.0,0.0,SpeedL=50,AccL=50)"),
    ("m", "Circle(2,{320,20,0,0},{340,0,0,0})"),
    ("m", "Circle(320.0,20.0,0.0,0.0,340.0,0.0,0.0,0.0,1)"),
    ("m", "MovLIO(320,0,0,0,{0,50,1,1},SpeedL=50)"),
    ("m", "MovJIO(320,0,0,0,(0, 50, 1, 0),(1, -5, 2, 1))"),
    ("m", "MoveJog(nothing)"),
]
REFUSED = [
    ("d", "EnableRobot(0.5,600,0,5)", -40002),
    ("d", "EnableRobot(0.9)", -40001),
    ("d", "SetUser(10,{1,2,3,4})", -40001),
    ("d", "SetUser(1,{1,2,3})", -40002),
    ("d", "SetUser(1,{a,2,3,4})", -30002),
    ("d", "SetUser(1)", -20000),
    ("d", "CalcUser(0,2,{1,2,3,4})", -40002),
    ("d", "CalcUser(3,1,{1,2,3,4})", -1),
    ("d", "DI(0)", -40001),
    ("d", "ToolDO(1)", -20000),
    ("d", "DOGroup(1)", -20000),
    ("d", "wait(0)", -40001),
    ("d", "LoadSwitch(2)", -40001),
    ("d", "SetArmOrientation(1,1)", -20000),
    ("d", "BrakeControl(1,1)", -1),  # the arm is enabled
    ("d", "RunScript(demo)", -1),
    ("d", "RunScript()", -20000),
    ("d", "ModbusCreate(127.0.0.1,502)", -20000),
    ("d", "ModbusClose(1)", -1),
    ("d", "GetHoldRegs(1,3095,1)", -1),
    ("d", "GetHoldRegs(5,3095,1)", -40001),
    ("d", "GetInRegs(0,3095,17)", -40003),
    ("d", "SetCoils(0,0,2,{1})", -40004),
    ("d", "SetCoils(0,0,2)", -20000),
    ("d", "SetPayload(0.9)", -40001),
    ("d", "Arch(10)", -40001),
    ("m", "Arc(320,0,0,0,340,0,0,0)", -1),
    ("m", "Arc(320,0,0,0)", -20000),
    ("m", "Circle(0,{320,20,0,0},{340,0,0,0})", -40001),
    ("m", "MovLIO(320,0,0,0)", -20000),
    ("m", "MovLIO(320,0,0,0,{0,150,1,1})", -40005),
    ("m", "MovLIO(320,0,0,0,{0,50,99,1})", -40005),
]


@pytest.mark.parametrize(("port", "text"), ACCEPTED)
def test_accepted(ask, port, text):
    assert ask(port, text) == "0,{}"


@pytest.mark.parametrize(("port", "text", "error_id"), REFUSED)
def test_refused_with_the_documents_number(ask, port, text, error_id):
    assert ask(port, text) == f"{error_id},{{}}"


def test_inputs_have_no_signal(ask):
    assert ask("d", "DI(1)") == "0,{0}" and ask("d", "ToolDI(2)") == "0,{0}"


def test_brakes_are_those_of_a_disabled_arm(ask):
    ask("d", "DisableRobot()")
    assert ask("d", "BrakeControl(2,1)") == "0,{}"


def test_slaves_hold_what_is_written_to_them(ask):
    assert [ask("d", "ModbusCreate(192.168.1.8,502,1,0)") for _ in range(4)] == ["0,{1}", "0,{2}", "0,{3}", "0,{4}"]
    assert ask("d", "ModbusCreate(192.168.1.8,502,1)") == "-1,{}"
    assert ask("d", "SetHoldRegs(2,3095,2,{4000000000,1.5},F32)") == "0,{}"
    assert ask("d", "GetHoldRegs(2,3095,2,F32)") == "0,{4000000000,1.5}"
    assert ask("d", "GetHoldRegs(2,3097,1)") == "0,{1.5}"  # the first value takes two registers
    assert ask("d", "GetInRegs(2,3095,1,{U16})") == "0,{0}" and ask("d", "GetHoldRegs(1,3095,2,F32)") == "0,{0,0}"
    assert ask("d", "SetCoils(2,7,3,{1,0,1})") == "0,{}" and ask("d", "GetCoils(2,7,3)") == "0,{1,0,1}"
    assert ask("d", "GetInBits(2,7,1)") == "0,{0}"
    assert ask("d", "ModbusClose(2)") == "0,{}" and ask("d", "GetCoils(2,7,3)") == "-1,{}"
    assert ask("d", "ModbusCreate(192.168.1.8,502,1)") == "0,{2}" and ask("d", "GetCoils(2,7,3)") == "0,{0,0,0}"


def test_frames_are_calculated_along_the_base_or_along_themselves(ask):
    ask("d", "SetUser(1,{10,20,30,90})")
    assert ask("d", "CalcUser(1,1,{1,2,3,4})") == "0,{11.000000,22.000000,33.000000,94.000000}"
    assert ask("d", "CalcUser(1,0,{1,2,3,4})") == "0,{8.000000,21.000000,33.000000,94.000000}"
    assert ask("d", "CalcTool(0,0,5,6,7,8)") == "0,{5.000000,6.000000,7.000000,8.000000}"


@pytest.mark.parametrize(
    ("text", "end"), [("Arc(320,20,0,0,340,0,0,20)", [340, 0, 20]), ("Circle(1,{320,20,0,0},{340,0,0,0})", [300, 0, 0])]
)
def test_a_circle_is_one_and_ends_where_it_should(ask, emulator, text, end):
    begun_s = time.monotonic()
    ask("m", text)
    ask("m", "Sync()")
    poses = np.array([emulator.pose(at) for at in np.linspace(begun_s, time.monotonic(), 300)])
    np.testing.assert_allclose(poses[-1][[0, 1, 5]], end, atol=1e-6)
    assert np.abs(np.hypot(poses[:, 0] - 320, poses[:, 1]) - 20.0).max() < 0.15
    assert (poses[:, 1].min() < -19.5) == text.startswith("Circle") and poses[:, 1].max() > 19.5


def test_an_output_is_set_on_the_way_and_a_queued_one_after_it(ask, emulator):
    ask("d", "SpeedL(5)")
    ask("m", "MovLIO(350,0,0,0,{0,50,1,1},{1,-5,2,1})")
    ask("d", "DO(3,1)")
    ask("d", "DOExecute(4,1)")
    seen = []
    while emulator.arm.busy():
        emulator.arm.update()
        seen.append((emulator.pose()[0], emulator.arm.digital_out))
    emulator.arm.update()
    assert emulator.arm.digital_out == 0b1111
    assert all(bits == 0b1000 for x, bits in seen if x < 320) and all(bits & 1 for x, bits in seen if x > 330)
    assert all(bits & 0b100 == 0 for x, bits in seen if x < 349)


def test_a_wait_holds_the_queue(ask, emulator):
    ask("d", "wait(150)")
    ask("m", "MovL(320,0,0,0)")
    time.sleep(0.05)
    assert emulator.pose()[0] == pytest.approx(300.0)
    ask("m", "Sync()")
    assert emulator.pose()[0] == pytest.approx(320.0)


def test_an_unknown_axis_stops_a_jog_and_leaves_a_move(ask, emulator):
    ask("m", "MoveJog(X+)")
    time.sleep(0.05)
    ask("m", "MoveJog(stop)")
    still = emulator.pose()
    time.sleep(0.05)
    assert np.array_equal(emulator.pose(), still) and still[0] > 300
    ask("d", "SpeedL(5)")
    ask("m", HOME)
    ask("m", "MoveJog(stop)")
    ask("m", "Sync()")
    assert emulator.pose()[0] == pytest.approx(300.0)


def test_the_speed_factor_acts_on_a_running_move(ask, emulator):
    ask("d", "SpeedL(1)")
    ask("d", "SpeedFactor(10)")
    ask("m", "MovL(310,0,0,0)")
    ask("m", "MovL(320,0,0,0)")
    time.sleep(0.1)
    assert emulator.pose()[0] < 303  # at 10 mm/s
    begun_s = time.monotonic()
    ask("d", "SpeedFactor(100)")
    ask("m", "Sync()")
    assert time.monotonic() - begun_s < 1.0  # at a tenth of the speed it would take two
    assert emulator.pose()[0] == pytest.approx(320.0)


def test_a_dragged_arm_takes_no_moves(ask):
    ask("d", "StartDrag()")
    assert ask("d", "RobotMode()") == "0,{6}" and ask("m", HOME) == "-1,{}"
    ask("d", "StopDrag()")
    assert ask("d", "RobotMode()") == "0,{5}" and ask("m", HOME) == "0,{}"
