"""The MG400's connections: one for requests and replies, one that keeps the newest feedback."""

import contextlib
import socket
import time
from collections.abc import Callable
from threading import Condition, Event, RLock, Thread

import numpy as np

from hardware.arms.arm import FEEDBACK_AGE_S
from hardware.arms.awake import awake_s
from hardware.arms.mg400_wire import PACKET_BYTES, Reply, describe_bytes, newest_packet, take_reply, why_no_packet
from hardware.arms.supervisor import Supervisor
from hardware.errors import DeviceError, DeviceNotConnectedError, StaleDataError

# Longest wait for a connection, in s.
CONNECT_TIMEOUT_S = 2.0
# Longest wait for a reply, in s.
REPLY_TIMEOUT_S = 2.0
# Time, s, of silence after which a feedback connection is closed and opened again.
SILENCE_S = FEEDBACK_AGE_S
# Interval in s at which a wait for a reply checks whether the arm still answers.
LOOK_S = 0.05
# Pause before feedback is connected again, in s. Public clients wait 5 s, but a servo that stands still needs feedback sooner.
RECONNECT_S = 0.5
# Difference of a joint between two packets, deg, above which the arm is in motion.
MOTION_DEG = 1e-4
# Interval in s at which a wait for feedback after a stall checks it.
STALL_CHECK_S = 0.01
# Largest number of bytes in one read: more than half a second of feedback.
BACKLOG_BYTES = 64 * PACKET_BYTES


class NoReplyError(DeviceError):
    """No reply came in time."""


class CommandPort:
    """Requests and their replies over one connection. Calls from several threads take turns."""

    def __init__(self, name: str, host: str, port: int) -> None:
        self._name, self._address = name, (host, port)
        self._socket: socket.socket | None = None
        self._lock, self._buffer = RLock(), ""
        self._heard = False  # whether anything came from this address
        self._last_words: tuple[bytes, ...] = ()
        self._supervisor = Supervisor()

    @property
    def is_open(self) -> bool:
        """Whether the connection is open."""
        return self._socket is not None

    def open(self, *, timeout_s: float = CONNECT_TIMEOUT_S) -> None:
        self.close()
        try:
            self._socket = socket.create_connection(self._address, timeout_s)
        except OSError as error:
            host, port = self._address
            check = f"Check that the arm is on, that this machine has an address in its network ('ping {host}')"
            remedy = f"{check} and that no other program holds the port; without an arm: 'twin emulate mg400' and mg400:127.0.0.1"
            raise DeviceNotConnectedError(f"{self._name}: no connection to {host}:{port} ({error.strerror or error}). {remedy}") from error
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.supervise(*self._last_words)

    def supervise(self, *last_words: bytes) -> None:
        """Have a further process send these requests if this program dies, over this connection or one that is opened after it.

        Without requests there is no such process.
        """
        with self._lock:
            self._last_words = last_words
            self._supervisor.end()
            if self._socket is not None:
                self._supervisor = Supervisor(self._socket.fileno, last_words)

    def close(self) -> None:
        with self._lock:
            self._supervisor.end()
            if self._socket is not None:
                self._socket.close()
            self._socket, self._buffer = None, ""

    def request(self, text: str, *, timeout_s: float = REPLY_TIMEOUT_S, look: Callable[[], object] = lambda: None) -> Reply:
        """Send a request and wait for its reply. Late replies to other requests are dropped. ``look`` is called meanwhile and may raise an
        error.

        Raises
        ------
        DeviceNotConnectedError
            The connection is lost.
        NoReplyError
            No reply came in time.
        """
        with self._lock:
            self.send(text)
            deadline = awake_s() + timeout_s
            while (left_s := deadline - awake_s()) > 0:
                if reply := self.poll(text, wait_s=min(LOOK_S, left_s)):
                    return reply
                look()
            came = self._buffer
        host, port = self._address
        instead = f", {describe_bytes(came.encode('ascii', errors='replace'))} came instead: is this an MG400?" if came else ""
        late = f"no reply to {text} from {host}:{port} within {timeout_s:g} s"
        raise NoReplyError(f"{self._name}: {late}{instead}; check the arm, then connect again")

    def send(self, text: str) -> None:
        """Send one command; its reply is read by ``poll``."""
        with self._lock:
            if self._socket is None:
                raise DeviceNotConnectedError(f"{self._name}: the connection was lost; disconnect() and connect() again")
            try:
                self._socket.settimeout(REPLY_TIMEOUT_S)
                self._socket.sendall(text.encode("ascii"))
            except OSError as error:
                self._lost_error(error)

    def poll(self, request: str, *, wait_s: float) -> Reply | None:
        """The reply to a request, if it comes within ``wait_s``."""
        with self._lock:
            deadline = time.monotonic() + wait_s
            wanted = request.split("(")[0].lower()
            while True:
                reply, self._buffer = take_reply(self._buffer)
                if reply is not None and reply.name == wanted:
                    return reply
                if reply is None and (time.monotonic() >= deadline or not self._receive(deadline)):
                    return None

    def _receive(self, deadline: float) -> bool:
        if self._socket is None:
            raise DeviceNotConnectedError(f"{self._name}: the connection was lost; disconnect() and connect() again")
        try:
            self._socket.settimeout(max(deadline - time.monotonic(), 1e-4))
            data = self._socket.recv(4096)
        except TimeoutError:
            return False
        except OSError as error:
            self._lost_error(error)
        if not data:
            self._lost_error(None)
        self._heard = True
        self._buffer += data.decode("ascii", errors="replace")
        return True

    def _lost_error(self, error: OSError | None) -> None:
        came = self._buffer
        self.close()
        reason = f" ({error.strerror or error})" if error else ""
        if came and came.lstrip()[:1] not in "-0123456789":  # it can't be the beginning of a reply
            said, (host, port) = describe_bytes(came.encode("ascii", errors="replace")), self._address
            strange = f"{said} came from {host}:{port}: this is no MG400. Check address and port"
            raise DeviceNotConnectedError(f"{self._name}: {strange}") from error
        why = "Check its power and cable" if self._heard else "Another program may hold it (DobotStudio Pro, a script): close that"
        lost = f"the arm closed the connection{reason}. {why}, then disconnect() and connect() again"
        raise DeviceNotConnectedError(f"{self._name}: {lost}") from error


class Feedback:
    """Keeps the newest feedback packet. A thread reads all packets, and reconnects after silence.

    Parameters
    ----------
    name, host : str
    ports : tuple of int
        Tried in order.
    lenient : bool
        Whether packets count whatever their test value is.
    """

    def __init__(self, name: str, host: str, ports: tuple[int, ...], *, lenient: bool = False) -> None:
        self._name, self._host, self._ports, self._lenient = name, host, ports, lenient
        self._came, self._closed = b"", False  # the first received bytes without a packet, and whether the newest connection was closed
        self._joints: np.ndarray | None = None
        self.turned_s = -np.inf  # when the joints were last seen in motion
        self._newest: tuple[np.void, float] | None = None
        self._heard_s = 0.0  # when the newest packet arrived, on the clock of ``awake_s``
        self._arrived, self._ended = Condition(), Event()
        self._thread: Thread | None = None

    def open(self) -> None:
        """Connect to the first port that accepts and wait for a packet.

        Raises
        ------
        DeviceNotConnectedError
            No port accepts, or no packet arrives.
        """
        connection = self._connect()
        self._ended = Event()  # a new event: an earlier reader that still runs must keep its own and end
        self._thread = Thread(target=self._read_loop, args=(connection, self._ended), daemon=True, name="mg400-feedback")
        self._thread.start()
        with self._arrived:
            if not self._arrived.wait_for(lambda: self._newest is not None, CONNECT_TIMEOUT_S):
                why = why_no_packet(self._came, closed=self._closed)
                self.close()
                raise DeviceNotConnectedError(f"{self._name}: no feedback from {self._host}: {why}")

    def close(self) -> None:
        self._ended.set()
        if self._thread is not None:
            self._thread.join(timeout=2.0)
        self._thread, self._newest, self._came = None, None, b""

    def age_s(self) -> float:
        """How long ago the newest packet arrived; infinite if none did."""
        with self._arrived:
            newest = self._newest
        return float("inf") if newest is None else time.monotonic() - newest[1]

    def newest(self, max_age_s: float) -> tuple[np.void, float]:
        """The newest packet and the time of its arrival. After a stall of this process it waits for what arrived meanwhile.

        Raises
        ------
        StaleDataError
            The packet is older than ``max_age_s``.
        """
        with self._arrived:
            while (newest := self._newest) is not None and time.monotonic() - newest[1] > max_age_s > awake_s() - self._heard_s:
                self._arrived.wait(STALL_CHECK_S)
        age_s = np.inf if newest is None else time.monotonic() - newest[1]
        if newest is None or age_s > max_age_s:
            remedy = "the reader keeps trying to reconnect. Don't trust the last pose: stop, check the cable, then go on"
            raise StaleDataError(f"{self._name}: no feedback for {age_s:.1f} s (allowed {max_age_s:g} s); {remedy}")
        return newest

    def _connect(self) -> socket.socket:
        errors = []
        for port in self._ports:
            try:
                return socket.create_connection((self._host, port), CONNECT_TIMEOUT_S)
            except OSError as error:
                errors.append(f"{port}: {error.strerror or error}")
        remedy = "check that it is on (without an arm: 'twin emulate mg400'), and close other programs that use the arm"
        deaf = f"no feedback port of {self._host} takes connections ({'; '.join(errors)})"
        raise DeviceNotConnectedError(f"{self._name}: {deaf}; {remedy}")

    def _read_loop(self, connection: socket.socket, ended: Event) -> None:
        while not ended.is_set():
            with contextlib.suppress(OSError):
                self._read_until_silent(connection, ended)
            connection.close()
            if ended.wait(RECONNECT_S):
                return
            with contextlib.suppress(DeviceNotConnectedError):
                connection = self._connect()
        connection.close()

    def _read_until_silent(self, connection: socket.socket, ended: Event) -> None:
        connection.settimeout(SILENCE_S / 4)
        buffer, heard_s = b"", awake_s()
        while not ended.is_set() and awake_s() - heard_s < SILENCE_S:
            try:
                data = connection.recv(BACKLOG_BYTES)
            except TimeoutError:
                continue
            self._closed = not data
            if not data:
                return
            if self._newest is None:
                self._came = (self._came + data)[-2 * PACKET_BYTES :]
            packet, buffer = newest_packet(buffer + data, lenient=self._lenient)
            if packet is not None and len(data) < BACKLOG_BYTES:  # otherwise newer packets are still waiting to be read
                valid_s, heard_s = time.monotonic(), awake_s()
                if self._joints is not None and np.abs(packet["q_actual"] - self._joints).max() > MOTION_DEG:
                    self.turned_s = valid_s
                self._joints = packet["q_actual"].copy()
                with self._arrived:
                    self._newest, self._heard_s = (packet, valid_s), heard_s
                    self._arrived.notify_all()
