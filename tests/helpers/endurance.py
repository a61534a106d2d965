"""The streamed loop for as long as one likes, with both emulators in processes of their own and a random fault every so often.

What a user would do after an error is done here: the device is repaired, the alarm cleared, and the loop begun again.
"""

import gc
import json
import random
import subprocess
import sys
import threading
import time
from dataclasses import dataclass, field
from typing import Self

import psutil
from free_ports import free_offset

from hardware.arms.mg400_wire import DASHBOARD_PORT
from hardware.servo.loop import Decided, LoopSettings, ServoLoop
from hardware.workcell.build import RigPlan, build_rig
from scenes import load_experiment, load_object, load_sensor, load_servo
from twin.errors import TwinError
from twin.estimate import SensorModel

OBJECT, SENSOR, SERVO = "can", "mg400-331", "surface"
ROUND_STEPS = 60  # steps of a round here: a part of the way around, so that some rounds lie between two faults
RATE_HZ, CAMERA_HZ, TIME_SCALE = 10.0, 6.0, 2.0
EVERY_S = 20.0
GIVE_UP_S = 5.0
LONGEST_ROUND_S = 240.0  # on a machine that other work slows down
LOUD = ("emergency stop", "witch it off")  # what must be said where the arm may still move
ARM_FAULTS = (
    *("silent-feedback=0", "short-packets=2", "wrong-test-value=2", "collision", "stall", "ignore-moves", "slow=0.05"),
    *("no-move-reply", "no-sync-reply", "frozen=0", "no-tcp-mode", "split-refusals", "press"),
)
CAMERA_FAULTS = ("frozen", "black", "dropped", "late=1", "torn=2", "unplugged=2", "silent")
PROCESS_FAULTS = ("kill arm", "kill camera", "pause arm", "pause camera")
SPANS_S = (0.5, 2.0, 8.0)  # how long a fault lasts; PAUSE_S of a process that stands still
PAUSE_S = 3.0

ARM = """
import json, sys, time
from hardware.emulators.mg400 import Mg400Emulator
with Mg400Emulator(port_offset=int(sys.argv[1]), time_scale=float(sys.argv[2])) as arm:
    print("ready", flush=True)
    for line in sys.stdin:
        word, _, rest = line.strip().partition(" ")
        if word == "fault" and rest == "press":
            arm.arm.press_emergency_stop()
        elif word == "fault":
            arm.faults.add(rest)
        elif word == "clear":
            arm.faults.clear()
        elif word == "state":
            before = arm.pose()
            time.sleep(0.1)
            print(json.dumps({"moves": bool(abs(arm.pose() - before).max() > 1e-6)}), flush=True)
"""
CAMERA = """
import sys
from hardware.cameras.twin import TwinCamera
from hardware.emulators.camera import CameraEmulator, FeedbackPose
from hardware.rig.geometry import PlacedObject
from scenes import load_experiment, load_object, load_sensor, load_servo
from twin.rig.kinematics import Mounting
arm, port, sensor, thing, servo, fps = sys.argv[1:]
spec, how = load_sensor(sensor), load_servo(servo)
placed = PlacedObject(load_object(thing), how.placement, Mounting.of(spec, load_experiment(how.experiment)))
with FeedbackPose.of(arm) as pose:
    source = TwinCamera(spec, placed, pose, fps=float(fps), waits_for_arm=True)
    with CameraEmulator(source, port=int(port)) as camera:
        print("ready", camera.url, flush=True)
        for line in sys.stdin:
            word, _, rest = line.strip().partition(" ")
            if word == "fault":
                camera.faults.add(rest)
            elif word == "clear":
                camera.faults.clear()
            if camera.error is not None:
                raise camera.error
"""


class Child:
    """An emulator in a process of its own, which is told its faults line by line."""

    def __init__(self, source: str, *arguments: object) -> None:
        self._command = [sys.executable, "-c", source, *map(str, arguments)]
        self.answer = self.start()

    def start(self) -> str:
        """Start the process; returns what it says when it listens."""
        self.process = subprocess.Popen(self._command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1)
        answer = self.process.stdout.readline().strip()
        if not answer.startswith("ready"):
            raise RuntimeError(f"an emulator did not start: {answer}")
        return answer

    def say(self, line: str) -> None:
        if self.process.poll() is None:
            self.process.stdin.write(line + "\n")

    def state(self) -> dict:
        """What the arm does."""
        self.say("state")
        return json.loads(self.process.stdout.readline())

    def kill(self) -> None:
        self.process.kill()
        self.process.wait()
        self.process.stdin.close()
        self.process.stdout.close()

    def megabytes(self) -> float:
        """Its memory."""
        return psutil.Process(self.process.pid).memory_info().rss / 1e6 if self.process.poll() is None else 0.0


@dataclass
class Round:
    """One round, or a part of one that a fault ended."""

    steps: int
    wanted: int
    decided: dict[str, int]
    moves: int  # decisions to move
    seconds: float
    told: str  # the error that ended it
    notes: list[str]
    moves_on: bool  # the arm, after the round


@dataclass
class Endured:
    """What came of it."""

    rounds: list[Round] = field(default_factory=list)
    faults: list[tuple[float, str, float]] = field(default_factory=list)  # when (s), which, for how long (s)
    memory_mb: list[tuple[float, float, float]] = field(default_factory=list)  # own, arm's, camera's, after each round
    threads: list[int] = field(default_factory=list)
    files: list[int] = field(default_factory=list)
    seconds: float = 0.0

    @property
    def whole(self) -> int:
        """Rounds that were completed."""
        return sum(one.steps == one.wanted for one in self.rounds)

    def lines(self) -> list[str]:
        """The result in words."""
        decided = {str(code): sum(one.decided.get(str(code), 0) for one in self.rounds) for code in Decided}
        first, last = self.memory_mb[min(2, len(self.memory_mb) - 1)], self.memory_mb[-1]
        return [
            f"{self.seconds:.0f} s, {len(self.rounds)} rounds begun, {self.whole} completed, {len(self.faults)} faults",
            f"decisions: {sum(decided.values())}, " + ", ".join(f"{count} {what}" for what, count in decided.items()),
            f"steps: {sum(one.steps for one in self.rounds)}",
            f"ended by an error: {sum(bool(one.told) for one in self.rounds)}",
            f"longest round: {max(one.seconds for one in self.rounds):.0f} s",
            "memory of loop, arm, camera: " + " / ".join(f"{a:.0f} -> {b:.0f} MB" for a, b in zip(first, last, strict=True)),
            f"threads {self.threads[0]} -> {self.threads[-1]}, open files {self.files[0]} -> {self.files[-1]}",
        ]


class Bench:
    """The two emulators and their faults. A context manager."""

    def __init__(self, seed: int) -> None:
        offset = free_offset()
        self.address = f"mg400:127.0.0.1:{DASHBOARD_PORT + offset}"
        self.random = random.Random(seed)
        self.arm = Child(ARM, offset, TIME_SCALE)
        self.camera = Child(CAMERA, self.address, offset + 30007, SENSOR, OBJECT, SERVO, CAMERA_HZ)
        self.url = self.camera.answer.split()[1]
        self.lock = threading.Lock()
        self._end = threading.Event()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._end.set()
        self.arm.kill()
        self.camera.kill()

    def fail(self) -> tuple[str, float]:
        """Switch a random fault on, and off again after a while. Returns its name and its time in s."""
        kind = self.random.choice(("arm", "camera", "process"))
        name = self.random.choice({"arm": ARM_FAULTS, "camera": CAMERA_FAULTS, "process": PROCESS_FAULTS}[kind])
        span_s = PAUSE_S if kind == "process" else self.random.choice(SPANS_S)
        if kind == "process":
            word, which = name.split()
            child = self.arm if which == "arm" else self.camera
            with self.lock:
                child.kill() if word == "kill" else psutil.Process(child.process.pid).suspend()
            self._end.wait(span_s)
            with self.lock:
                child.start() if word == "kill" else psutil.Process(child.process.pid).resume()
        else:
            child = self.arm if kind == "arm" else self.camera
            with self.lock:
                child.say(f"fault {name}")
            self._end.wait(span_s)
            with self.lock:
                child.say("clear")
        return f"{kind}: {name}" if kind != "process" else name, span_s


def endure(model: SensorModel, seconds: float, *, seed: int = 0, every_s: float = EVERY_S, report=lambda line: None) -> Endured:
    """Run rounds for a time, with a random fault every ``every_s``."""
    found, begun_s, over = Endured(), time.monotonic(), threading.Event()
    with Bench(seed) as bench:

        def trouble() -> None:
            while not over.wait(every_s):
                at_s = time.monotonic() - begun_s
                name, span_s = bench.fail()
                found.faults.append((at_s, name, span_s))
                report(f"{at_s:6.0f} s  {name}, {span_s:g} s")

        thread = threading.Thread(target=trouble, name="trouble", daemon=True)
        thread.start()
        while time.monotonic() - begun_s < seconds:
            found.rounds.append(one := run_round(model, bench))
            gc.collect()
            own = psutil.Process()
            with bench.lock:
                found.memory_mb.append((own.memory_info().rss / 1e6, bench.arm.megabytes(), bench.camera.megabytes()))
            found.threads.append(threading.active_count())
            found.files.append(own.num_fds())
            told = f": {one.told}" if one.told else ""
            report(f"{time.monotonic() - begun_s:6.0f} s  {one.steps} of {one.wanted} steps in {one.seconds:.0f} s{told}")
        over.set()
        thread.join()
    found.seconds = time.monotonic() - begun_s
    return found


def run_round(model: SensorModel, bench: Bench) -> Round:
    """Connect, follow a part of the object's outline, let go, disconnect."""
    servo = load_servo(SERVO)
    spec = load_sensor(SENSOR)
    plan = RigPlan(load_object(OBJECT), servo, camera=bench.url, arm=bench.address)
    rig = build_rig(plan, spec, load_experiment(servo.experiment), form=model.form)
    settings = LoopSettings(ROUND_STEPS, blocking=False, period_s=1.0 / RATE_HZ, frame_timeout_s=rig.frame_timeout_s, give_up_s=GIVE_UP_S)
    began_s, told, loop = time.monotonic(), "", None
    try:
        with rig:
            loop = ServoLoop(rig, servo, model, settings)
            if rig.arm.state().error:
                rig.arm.clear_error()
            rig.await_frame()
            loop.run(rig.placed.start_pose(servo.indent_mm))
    except TwinError as error:
        told = "; ".join([str(error), *getattr(error, "__notes__", ())])
    seconds = time.monotonic() - began_s
    return _round(loop, told, seconds, bench)


def _round(loop: ServoLoop | None, told: str, seconds: float, bench: Bench) -> Round:
    codes = [code for code, _ in loop.decided] if loop is not None else []
    with bench.lock:
        alive = bench.arm.process.poll() is None and psutil.Process(bench.arm.process.pid).status() != psutil.STATUS_STOPPED
        moves_on = bool(bench.arm.state()["moves"]) if alive else False
    decided = {str(code): codes.count(code) for code in Decided}
    steps, notes = (len(loop.records), loop.notes) if loop is not None else (0, [])
    return Round(steps, ROUND_STEPS, decided, codes.count(Decided.MOVE), seconds, told, notes, moves_on)
