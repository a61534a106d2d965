"""Driver of the Dobot MG400 over TCP."""

import contextlib
import logging
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hardware.arms import mg400_wire as wire
from hardware.arms import motion
from hardware.arms.arm import POLL_S, ArmState, KinematicArm
from hardware.arms.mg400_wire import REPLY_TIMEOUT_S, SILENCE_S, CommandPort, Feedback, NoReplyError
from hardware.arms.motion import LinkageKinematics, explain
from hardware.errors import DeviceError, DeviceNotConnectedError, StaleDataError, on_error

LOG = logging.getLogger(__name__)
# Longest wait in s until feedback shows that the arm is enabled, or that an alarm is cleared.
ENABLE_TIMEOUT_S = 5.0
# Longest wait in s for the reply to a move, which an arm that works sends at once.
MOTION_REPLY_S = 1.0
# The same for a stop, an emergency stop and a disable. After this time the next method is tried, because the arm may still move.
STOP_REPLY_S = 0.5
# Wait, s, in which echoes of moves are read that nobody needs, so that they do not fill the connection.
DRAIN_S = 0.001
# Longest time, s, until feedback shows that a stop or a disable was executed: more than two periods of the slower of the two used ports.
SHOWS_S = 0.5
# Longest time, s, until feedback shows the alarm that caused the refusal of a move.
ALARM_S = 0.2
# Shorter wait for replies. For MUTE_S (s) after a stop, emergency stop or disable has failed, further ones wait only STOP_AGAIN_S (s), so
# that the end of a program is not delayed. The same holds if feedback is silent: a frozen arm gives no reply, and this must be reported
# within a second.
MUTE_S, STOP_AGAIN_S = 3.0, 0.08
# Least time, s, that feedback has to confirm a move: two periods of the slower of the two used ports.
SETTLE_S = 0.5
# Modes of an enabled arm, and of a moving arm. All decisions about this use the feedback's mode, and no other field.
ENABLED_MODES = {wire.Mode.ENABLED, wire.Mode.BACKDRIVE, wire.Mode.RUNNING, wire.Mode.RECORDING, wire.Mode.PAUSE, wire.Mode.JOG}
MOVING_MODES = {wire.Mode.RUNNING, wire.Mode.JOG}
PAUSED = "paused by another client; stop() drops the queue, Continue() of that client would execute it"
DISABLED = "was disabled by another program or at its button; call enable() when nobody else uses it"
# Requests that stop and disable the arm if this program dies.
LAST_WORDS = (b"ResetRobot()", b"DisableRobot()")
# Largest length of a move, mm, in which the turn may determine the speed.
SHORT_MM = 5.0
# Old firmware does not reply to moves. With it, a move counts as done after the arm has rested for this time (s).
RESTED_S = 0.05


@dataclass(frozen=True)
class Mg400Ports:
    """Ports on which the arm listens; the feedback ports are tried in order."""

    dashboard: int = wire.DASHBOARD_PORT
    motion: int = wire.MOTION_PORT
    feedback: tuple[int, ...] = tuple(wire.FEEDBACK_PERIOD_S)[:2]

    def shift_ports(self, offset: int) -> "Mg400Ports":
        """The same ports, shifted by an offset."""
        wire.require_ports(offset)
        return Mg400Ports(self.dashboard + offset, self.motion + offset, tuple(port + offset for port in self.feedback))


class MG400(KinematicArm):
    """A Dobot MG400.

    Its pose is that of the tool in the user frame that are selected in the arm (0 and 0 after ``enable``).

    Parameters
    ----------
    host : str
    ports : Mg400Ports
    kinematics : LinkageKinematics
        Used to check targets before they are sent, so that the arm does not raise an alarm.
    lenient : bool
        For controllers and emulators that are only similar: feedback counts whatever its test value is, a motion is detected from the
        joints, ``Sync`` is not used, and moves need no reply.
    supervised : bool
        Whether a further process stops and disables the arm if this program dies while the arm is enabled.
    """

    axes = 4

    def __init__(
        self,
        host: str = wire.DEFAULT_HOSTS["LAN1"],
        *,
        ports: Mg400Ports = Mg400Ports(),  # noqa: B008  (frozen)
        kinematics: LinkageKinematics = motion.MG400,
        lenient: bool = False,
        supervised: bool = True,
    ) -> None:
        self._supervised = supervised
        self.name, self.kinematics = f"MG400 at {host}", kinematics
        self._dashboard = CommandPort(self.name, host, ports.dashboard)
        self._motion = CommandPort(self.name, host, ports.motion)
        self._feedback = Feedback(self.name, host, ports.feedback, lenient=lenient)
        self._lenient = lenient
        # whether it is in use: from connect to disconnect, even if the connection is lost in between; whether this driver has enabled it
        # and not disabled it since; whether a move was sent whose end feedback has not shown yet; and whether late replies to moves may
        # arrive for which no call waits any more
        self._in_use = self._enabled = self._under_way = self._late_replies = False
        self._bare = False  # whether moves have no reply: old firmware, which only echoes on the dashboard, and some emulators
        self._alarm_text: str | None = None
        self._speed: tuple[float, float] | None = None  # mm/s and deg/s; None after speeds were set in percent
        self._sent: np.ndarray | None = None  # end of the queue while the arm may still move there
        self._mute_s = -np.inf  # time of the newest failed stop, emergency stop or disable

    @property
    def is_connected(self) -> bool:
        return self._dashboard.is_open and self._motion.is_open

    def connect(self) -> None:
        self._require_disconnected()
        self._close()  # remains of a lost connection
        with on_error(self._close):
            self._dashboard.open()
            self._motion.open()
            self._feedback.open()
            self._bare = self._ask("GetErrorID()").error_id is None  # the query that emulators know, too
            self._in_use = True

    def disconnect(self) -> None:
        if self._in_use and (self._enabled or self._under_way):
            self._disconnect(self.disable, close=self._close)
        else:  # an arm that this driver has not enabled may be in use by another program
            self._close()

    def enable(self) -> None:
        self._require_connected()
        if self._mode() == wire.Mode.ERROR:
            raise DeviceError(f"{self.name}: {self._alarm()}")
        if self._mode() in ENABLED_MODES and not self._enabled:
            shared = "is enabled already, so another program may use it; a stop or disable of one program is one for both"
            LOG.warning("%s: %s", self.name, shared)
        if self._supervised and not self._enabled:
            self._dashboard.supervise(*LAST_WORDS)
        with on_error(self.disable):  # it may have obeyed
            self._enabled = True  # from now on it may be, even if nothing is heard of it
            for request in ("EnableRobot()", "User(0)", "Tool(0)"):
                self._ask(request)
            self._await_mode(lambda mode: mode in ENABLED_MODES, "was not enabled; check its button and that no stop is pressed")

    def disable(self) -> None:
        self._unstopped = True
        self._send_over_dashboard("DisableRobot()", "disabled")
        self._unstopped = self._under_way = self._enabled = False
        self._dashboard.supervise()
        self._shows(lambda packet: int(packet["mode"]) not in ENABLED_MODES)  # so that the next state shows it

    def clear_error(self) -> None:
        """Clear the alarms and empty the queue. After an emergency stop, ``enable`` then makes the arm usable again."""
        self._require_connected()
        self._sent = None
        with contextlib.suppress(DeviceError):
            self._ask("ResetRobot()")
        self._ask("ClearError()")
        remains = "the alarm remains; remove its cause (release the emergency stop, free the arm)"
        self._await_mode(lambda mode: mode != wire.Mode.ERROR, remains)
        self._alarm_text = None

    def stop(self) -> None:
        """Stop and empty the queue. If the arm refuses to stop, it is switched off, and a ``DeviceError`` reports this."""
        self._require_in_use()
        self._sent, self._unstopped = None, True
        try:
            self._send_over_dashboard("ResetRobot()", "stopped")
        except DeviceNotConnectedError:
            raise
        except DeviceError as error:
            if not self._shows(lambda packet: int(packet["mode"]) not in MOVING_MODES):  # otherwise only the reply was lost
                try:
                    self.emergency_stop()
                except DeviceError:
                    raise error from None
                remedy = "call clear_error() and enable()"
                raise DeviceError(f"{self.name}: did not stop, so its emergency stop was used; {remedy}. {error}") from error
        self._unstopped = self._under_way = False

    def _shows(self, obeyed: Callable[[np.void], bool], *, within_s: float = SHOWS_S) -> bool:
        """Whether feedback soon and then steadily shows that a command was executed. The first packet may be older than the command."""
        asked_s, since_s = time.monotonic(), np.inf
        with contextlib.suppress(StaleDataError):
            while time.monotonic() - asked_s < within_s:
                packet, time_s = self._feedback.newest(SILENCE_S if within_s > SHOWS_S else SHOWS_S)
                since_s = min(since_s, time_s) if time_s > asked_s and obeyed(packet) else np.inf
                if time_s - since_s >= RESTED_S:
                    return True
                time.sleep(POLL_S)
        return False

    def emergency_stop(self) -> None:
        self._sent = None
        self._send_over_dashboard("EmergencyStop()", "switched off")
        self._unstopped = self._under_way = self._enabled = False

    def state(self, *, max_age_s: float = SILENCE_S) -> ArmState:
        self._require_connected()
        packet, time_s = self._feedback.newest(max_age_s)
        pose = wire.pose_in(packet)
        self._require_possible(pose)
        mode = int(packet["mode"])
        if mode != wire.Mode.ERROR:
            self._alarm_text = None
        moving = mode in MOVING_MODES or (self._lenient and time.monotonic() - self._feedback.turned_s < RESTED_S)
        return ArmState(pose, packet["q_actual"][:4].copy(), time_s, mode in ENABLED_MODES, moving, self._trouble(mode))

    def _trouble(self, mode: int) -> str:
        """The arm's fault in a mode, in words; "" if there is none."""
        if mode == wire.Mode.ERROR:
            return self._alarm()
        if mode == wire.Mode.PAUSE:
            return PAUSED
        return DISABLED if mode == wire.Mode.DISABLED and self._enabled else ""

    def set_speed(self, linear_mm_s: float, angular_deg_s: float) -> None:
        """The arm takes whole percents of its largest speed. A speed below 1 % becomes 1 %.

        In a linear move the turn may also reach the given angular speed, even if the move is short.
        """
        super().set_speed(linear_mm_s, angular_deg_s)
        self.set_speed_percent(linear=100 * linear_mm_s / wire.MAX_LINEAR_MM_S, angular=100 * angular_deg_s / wire.MAX_JOINT_DEG_S)
        self._speed = linear_mm_s, angular_deg_s

    def set_speed_percent(self, *, linear: float | None = None, angular: float | None = None, overall: float | None = None) -> None:
        """Set ``SpeedL``, ``SpeedJ`` and ``SpeedFactor``, which multiply each other. Values are rounded down to whole percents."""
        self._require_connected()
        self._speed = None
        for name, percent in (("SpeedL", linear), ("SpeedJ", angular), ("SpeedFactor", overall)):
            if percent is not None:
                self._ask(f"{name}({int(np.clip(np.floor(percent + 1e-9), 1, 100))})")

    def set_output(self, index: int, on: bool) -> None:
        """Set a digital output at once."""
        self._require_connected()
        self._ask(f"DOExecute({index},{int(on)})")

    @property
    def overall_percent(self) -> float:
        """``SpeedFactor`` in %, as feedback reports it."""
        self._require_connected()
        return float(self._feedback.newest(SILENCE_S)[0]["speed_scaling"])

    def _turning_option(self, pose: np.ndarray) -> str:
        """``SpeedL`` of a short move that mainly turns. The slower part, line or turn, determines the speed.

        The manual gives the syntax of ``SpeedL`` only; we assume that it scales line and turn alike. If an arm applied it to the
        line alone, the fast part would be shorter than ``SHORT_MM``.
        """
        if self._speed is None:
            return ""
        state = self.state()
        start = self._sent if self._sent is not None and state.moving else state.pose
        length_mm, turn_deg = float(np.linalg.norm(pose[:3] - start[:3])), abs(pose[5] - start[5])
        if length_mm > SHORT_MM or turn_deg / wire.MAX_JOINT_DEG_S <= length_mm / wire.MAX_LINEAR_MM_S:
            return ""
        wanted_s = max(length_mm / self._speed[0], turn_deg / self._speed[1])
        return f",SpeedL={int(np.clip(np.floor(100 * turn_deg / wire.MAX_JOINT_DEG_S / wanted_s + 1e-9), 1, 100))}"

    def _move(self, joints: np.ndarray, pose: np.ndarray | None, *, wait: bool, timeout_s: float) -> None:
        self._require_connected()
        self._require_within(joints)
        packet, _ = self._feedback.newest(SILENCE_S)  # checked here, because old firmware does not report a refusal
        if int(packet["mode"]) == wire.Mode.ERROR:
            raise DeviceError(f"{self.name}: {self._alarm()}")
        if int(packet["mode"]) not in ENABLED_MODES:
            raise DeviceError(f"{self.name}: {DISABLED if self._enabled else 'not enabled; call enable() first'}")
        begun_s = time.monotonic()
        if pose is None:
            self._send_motion(f"JointMovJ({_text(joints)})")
        else:
            self._send_motion(f"MovL({_text(pose[[0, 1, 2, 5]])}{self._turning_option(pose)})")
        self._sent = pose
        if not wait:
            return
        self._await_queue(begun_s + timeout_s, timeout_s)
        left_s = max(begun_s + timeout_s - time.monotonic(), SETTLE_S)
        if pose is not None:
            self._wait_until_settled(pose, timeout_s=left_s)
        else:  # our link lengths are not exactly this arm's
            self._wait_until_settled(self.kinematics.forward(joints), tolerance_mm=1.0, timeout_s=left_s)
        self._under_way = False

    def _send_motion(self, text: str) -> None:
        if self._late_replies:  # a late reply to an old request could be taken for the reply to this one
            self._motion.open()
            self._late_replies = False
        self._under_way = True
        if self._bare:
            self._motion.send(text)
            self._motion.poll("", wait_s=DRAIN_S)
            return
        self._late_replies = True
        try:
            reply = self._motion.request(text, timeout_s=MOTION_REPLY_S, look=lambda: self._feedback.newest(SILENCE_S))
        except NoReplyError:
            if not self._lenient:
                raise
            self._bare, self._late_replies = True, False
            return
        self._late_replies = False
        if reply.error_id == wire.ErrorId.FAILED and self._shows(lambda packet: int(packet["mode"]) == wire.Mode.ERROR, within_s=ALARM_S):
            raise DeviceError(f"{self.name}: {self._alarm()}")  # the alarm appeared only now
        self._check(text, reply)

    def _await_queue(self, deadline: float, timeout_s: float) -> None:
        """Wait for the reply to ``Sync``; an alarm, silence or the time limit ends the wait. A short move may never show as RUNNING."""
        syncs = not (self._bare or self._lenient)
        if syncs:
            self._late_replies = True
            self._motion.send("Sync()")
        rest_since, asked_s = None, time.monotonic()
        while True:
            if syncs and self._motion.poll("Sync()", wait_s=POLL_S):
                self._late_replies = False
                return
            state = self.state()
            self._require_on_way(state, deadline, timeout_s)
            rest_since = None if state.moving or state.time_s < asked_s else rest_since or state.time_s
            if not syncs and rest_since is not None and state.time_s - rest_since > RESTED_S:
                return
            if not syncs:
                time.sleep(POLL_S)

    def _may_move(self) -> bool:
        return self._in_use and self._under_way

    def _require_in_use(self) -> None:
        """Raise ``DeviceNotConnectedError`` before ``connect`` and after ``disconnect``, but not while a connection is lost."""
        if not self._in_use:
            self._require_connected()

    def _await_mode(self, reached: Callable[[int], bool], otherwise: str) -> None:
        """Wait for feedback newer than this call whose mode is one of the wanted modes."""
        if not self._shows(lambda packet: reached(int(packet["mode"])), within_s=ENABLE_TIMEOUT_S):
            raise DeviceError(f"{self.name}: {otherwise} (mode {self._mode()})")

    def _mode(self) -> int:
        return int(self._feedback.newest(SILENCE_S)[0]["mode"])

    def _alarm(self) -> str:
        """The alarms in words. The arm is asked only once for each error."""
        if self._alarm_text is None:
            ids: list[int] = []
            with contextlib.suppress(DeviceError):
                ids = self._dashboard.request("GetErrorID()").alarms()
            self._alarm_text = explain(ids)
        return self._alarm_text

    def _send_over_dashboard(self, request: str, what: str) -> None:
        """Send a request over the dashboard connection alone. A lost connection is opened once more, because the arm may still move."""
        self._require_in_use()
        expected = time.monotonic() - self._mute_s > MUTE_S and self._feedback.age_s() <= SILENCE_S
        timeout_s = STOP_REPLY_S if expected else STOP_AGAIN_S
        try:
            with contextlib.suppress(DeviceNotConnectedError):
                self._ask(request, timeout_s=timeout_s)
                return
            self._dashboard.open(timeout_s=timeout_s)
            self._ask(request, timeout_s=timeout_s)
        except DeviceError as error:
            self._mute_s = time.monotonic()
            kind = DeviceNotConnectedError if isinstance(error, DeviceNotConnectedError) else DeviceError
            raise kind(f"{self.name}: can't be {what} and may move. Press its emergency stop! {error}") from error

    def _ask(self, request: str, *, timeout_s: float = REPLY_TIMEOUT_S) -> wire.Reply:
        reply = self._dashboard.request(request, timeout_s=timeout_s)
        self._check(request, reply)
        return reply

    def _check(self, request: str, reply: wire.Reply) -> None:
        if reply.error_id:
            raise DeviceError(f"{self.name}: {wire.why_refused(reply.error_id, request)}")

    def _close(self) -> None:
        self._in_use = self._under_way = self._late_replies = self._unstopped = self._enabled = False
        self._dashboard.supervise()
        self._dashboard.close()
        self._motion.close()
        self._feedback.close()


def _text(numbers: np.ndarray) -> str:
    return ",".join(f"{number:.4f}" for number in numbers)
