"""The clients of ``ur_rtde`` in a process of their own, and this process's program.

While a client of ``ur_rtde`` connects, it holds the interpreter's lock, for ever if the arm is silent, and it waits up to 300 s for a
reply. A process can be ended. If the program that started it dies, it ends the arm's control program. Should it die too, the arm's own
watchdog does that. The program imports the standard library and ``ur_rtde`` only, so that it starts soon.

A client of ``ur_rtde`` that uploads the control program does that again, without a watchdog, whenever it has lost its link. Therefore ours
is made without that option, and uploads the program by request only.
"""

import contextlib
import faulthandler
import json
import os
import queue
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from importlib import import_module
from typing import Any

# The watchdog ends the control program if nothing comes for 1 / WATCHDOG_HZ. Something is sent at least every KICK_S (s).
WATCHDOG_HZ, KICK_S = 2.0, 0.1
# Rate of the feedback: that of a CB3. Interval, s, at which a new packet is looked for.
FEEDBACK_HZ, LOOK_S = 125.0, 0.001
# Longest time, s, of a request, after which the process ends itself, and until the control program runs.
CONNECT_S, START_S = 3, 2.5
# The last of all answers. An answer is the number of its request, the value, and the error.
LOST = (None, None, "")
# What the feedback contains, as ``ur_rtde`` calls it.
FIELDS = ("Timestamp", "ActualTCPPose", "ActualQ", "ActualQd", "TargetQd", "RobotMode", "SafetyMode", "RuntimeState", "TargetSpeedFraction")


class ClientProcess:
    """The clients of an arm. They are connected when the constructor returns.

    Attributes
    ----------
    feedback : dict
        The newest packet: the values of ``FIELDS``, and ``time_s``, the ``time.monotonic()`` of its arrival.

    Raises
    ------
    ConnectionError
        They can't connect.
    """

    def __init__(self, host: str) -> None:
        self.feedback: dict[str, Any] = {}
        self._answers: queue.Queue[Any] = queue.Queue()
        self._lock, self._asked = threading.Lock(), 0
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL, "start_new_session": True}
        self._process = subprocess.Popen([sys.executable, "-P", __file__, host, str(os.getpid())], **pipes)  # type: ignore[call-overload]
        threading.Thread(target=self._read, name="ur client", daemon=True).start()
        try:
            self._answer(CONNECT_S)
        except BaseException:
            self.end()
            raise

    @property
    def is_alive(self) -> bool:
        """Whether the process runs. It ends when the connection is lost."""
        return bool(self._process.poll() is None)

    def ask(self, method: str, *arguments: Any, timeout_s: float) -> Any:
        """What a method of the control program's client returns: ``connect`` makes this client, and ``enable`` uploads the program.

        Raises
        ------
        ConnectionError
            There was no answer, whereupon the process was ended, or the connection is lost.
        RuntimeError
            The client refused.
        """
        with self._lock:
            self._asked += 1
            with contextlib.suppress(OSError):  # its end is an answer, too
                self._process.stdin.write(f"{json.dumps([self._asked, method, *arguments])}\n".encode())
                self._process.stdin.flush()
            return self._answer(timeout_s)

    def end(self) -> None:
        """End the process at once."""
        self._process.kill()
        self._process.wait()

    def _answer(self, timeout_s: float) -> Any:
        while True:
            try:
                number, value, error = self._answers.get(timeout=timeout_s)
            except queue.Empty as late:
                self.end()
                raise ConnectionError(f"no answer within {timeout_s:g} s") from late
            if number is None:
                self._answers.put(LOST)  # for all that ask later
                raise ConnectionError("the connection is lost")
            if number < self._asked:  # the answer to a request whose wait was interrupted
                continue
            if error:
                raise RuntimeError(error)
            return value

    def _read(self) -> None:
        with contextlib.suppress(ValueError):  # a line that was cut short
            for line in self._process.stdout:
                answer = json.loads(line)
                if isinstance(answer, dict):
                    self.feedback = answer
                else:
                    self._answers.put(answer)
        self._answers.put(LOST)


def run_clients(host: str, program: int) -> None:
    """What the process does: sends feedback and answers requests, until the program with this process id ends or the connection is lost."""
    requests: queue.Queue[list[Any]] = queue.Queue()
    out, control = os.dup(1), None
    os.dup2(2, 1)  # ur_rtde prints
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the program that started it

    def send(answer: object) -> None:
        os.write(out, f"{json.dumps(answer)}\n".encode())

    def read() -> None:
        for line in sys.stdin:
            requests.put(json.loads(line))
        requests.put([0, "end"])

    receive = import_module("rtde_receive").RTDEReceiveInterface(host, FEEDBACK_HZ)
    send([0, None, ""])
    threading.Thread(target=read, daemon=True).start()
    threading.Thread(target=_send_feedback, args=(receive, send), daemon=True).start()
    while os.getppid() == program:  # the input does not end with a program that has forked
        try:
            number, method, *arguments = requests.get(timeout=KICK_S)
        except queue.Empty:
            if control is not None:
                control.kickWatchdog()
            continue
        if method == "end":
            break
        with _limit_time():
            try:
                value = None
                if method == "connect":
                    control = control or _connect(host)
                elif method == "enable":
                    _run_program(control)
                else:
                    value = getattr(control, method)(*arguments)
                send([number, value, ""])
            except Exception as error:
                send([number, None, str(error)])
    if control is not None:
        with _limit_time():
            control.stopScript()


@contextlib.contextmanager
def _limit_time() -> Iterator[None]:
    """Context that ends the process if it lasts too long: a silent arm never answers, and perhaps nobody is left to end it."""
    faulthandler.dump_traceback_later(CONNECT_S, exit=True)
    yield
    faulthandler.cancel_dump_traceback_later()


def _send_feedback(client: Any, send: Callable[[object], None]) -> None:
    sent = None
    while client.isConnected():
        packet = {name: getattr(client, f"get{name}")() for name in FIELDS}
        if packet["Timestamp"] in (sent, None) or packet["Timestamp"] != client.getTimestamp():  # old, or parts of two packets
            time.sleep(LOOK_S)
            continue
        send(packet | {"time_s": time.monotonic()})
        sent = packet["Timestamp"]
    os._exit(0)  # at once, also during a request


def _connect(host: str) -> Any:
    """A client that uploads and awaits no program by itself."""
    interface = import_module("rtde_control").RTDEControlInterface
    return interface(host, flags=int(interface.FLAG_NO_WAIT))


def _run_program(control: Any) -> None:
    """Upload the control program, and set its watchdog when it runs."""
    control.reuploadScript()
    until_s = time.monotonic() + START_S
    while not control.isProgramRunning():
        if time.monotonic() > until_s:
            raise RuntimeError(f"its control program does not run within {START_S:g} s, or ended at once")
        time.sleep(LOOK_S)
    if not control.setWatchdog(WATCHDOG_HZ):
        raise RuntimeError("its control program does not answer, or ended at once")


if __name__ == "__main__":
    try:
        run_clients(sys.argv[1], int(sys.argv[2]))
    finally:
        os._exit(0)  # without the half seconds in which ur_rtde closes its sockets
