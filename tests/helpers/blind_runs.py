"""A fault in a phase of a command that moves an arm to an object: when it is detected, when the arm stands, and how far it went on.

Arm and camera are emulated: an MG400 on its ports or a Magician on a serial line, and a stream of pictures over HTTP. Each run is drawn
from its seed.
"""

import os
import random
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from noisy_camera import NoisyCamera
from true_estimator import TrueEstimator

from hardware.arms.magician import Magician
from hardware.arms.mg400 import MG400, Mg400Ports
from hardware.arms.ros2 import Ros2Arm
from hardware.arms.ur.driver import UR
from hardware.cameras.mjpeg import MjpegCamera
from hardware.cameras.reader import DevicePicture
from hardware.collect.collect import Collection, collect
from hardware.emulators.camera import CameraEmulator
from hardware.emulators.magician import MagicianEmulator
from hardware.emulators.mg400 import Mg400Emulator
from hardware.emulators.ros2 import Ros2Emulator
from hardware.emulators.ur import UrEmulator
from hardware.errors import DeviceError
from hardware.rig.geometry import PlacedObject, shift_in_tool
from hardware.safety.decide import SafetyLimits
from hardware.safety.eyes import NEAR_MM
from hardware.safety.safe_arm import SafeArm
from hardware.servo.loop import LoopHooks, LoopSettings, ServoLoop
from hardware.workcell.build import Rig
from scenes import load_experiment, load_object, load_sensor, load_servo
from twin.rig.kinematics import Mounting
from twin.types import Form

CAMERA_FAULTS = {
    "camera dead": ("silent", "unplugged=60"),
    "frozen": ("frozen",),
    "other size": ("resized",),
    "black": ("black",),
    "torn": ("torn=1",),
}
ARM_FAULTS = {
    "feedback dead": ("silent-feedback=0",),
    "feedback 2 s late": ("late-feedback=2",),
    "feedback garbled": ("wrong-test-value=1", "short-packets=1"),
    "replies lost": ("no-move-reply",),
}
# A Magician sends nothing unasked, so that its feedback and its replies are the same, and a reply that comes 2 s late is lost.
SERIAL_FAULTS = {"feedback dead": ("mute",), "feedback garbled": ("wrong-checksum=1",)}
UR_FAULTS = {"feedback dead": ("silent",), "feedback frozen": ("frozen-feedback",), "replies lost": ("no-replies",), "link lost": ()}
# No reply belongs to a command of ROS 2, so that lost commands are what lost replies are elsewhere.
TOPIC_FAULTS = {
    "feedback dead": ("silent-feedback",),
    "feedback 2 s late": ("late-feedback=2",),
    "feedback garbled": ("jump=50", "frozen"),
    "replies lost": ("ignore-commands",),
}
KINDS = {
    "mg400": ("surface", ARM_FAULTS),
    "magician": ("magician", SERIAL_FAULTS),
    "ur": ("ur5", UR_FAULTS),
    "ros2-twist": ("surface", TOPIC_FAULTS),
    "ros2-pose": ("surface", TOPIC_FAULTS),
}
KILLED, HEALTHY = "program killed", "healthy"
FAULTS = (*CAMERA_FAULTS, *ARM_FAULTS, KILLED)
PHASES = ("standing", "approach", "near", "contact")
COMMANDS = ("servo", "stream", "policy", "collect")
FPS, STEPS, HEALTHY_STEPS = 30.0, 60, 8
# Distances, mm, from the object at which a fault comes in a phase of the approach.
GAPS_MM = {"approach": (8.0, 20.0), "near": (-2.0, NEAR_MM)}
CLEAR_MM, WAIT_S, FRAME_WAIT_S = 25.0, 0.6, 1.0
POLL_S, STEP_S, REST_S = 0.01, 0.005, 0.06
PRESSED_MM = 6.0  # depth that the limits allow
# What a busy machine may add, s.
BUSY_S = 0.15


class HastyRig(Rig):
    """A rig that does not wait long for a frame."""

    frame_timeout_s = FRAME_WAIT_S


@cache
def dome_images() -> list[np.ndarray]:
    """Noisy pictures of a dome with pins, which nobody changes."""
    rng = np.random.default_rng(0)
    y, x = np.mgrid[:480, :640]
    dome = 60.0 + 60.0 * ((x % 24 < 8) & (y % 24 < 8))
    return [np.clip(dome + rng.normal(0.0, 1.5, dome.shape), 0, 255).astype(np.uint8) for _ in range(9)]


class DomeCamera(NoisyCamera):
    """Pictures of a size and a noise as a sensor's camera gives."""

    def __init__(self) -> None:
        super().__init__(fps=FPS, size_px=(640, 480))
        self._images = dome_images()

    def _grab(self) -> DevicePicture:
        self._end.wait(self._period_s)
        self._number += 1
        return DevicePicture(self._images[self._number % len(self._images)], time.monotonic())


@dataclass(frozen=True)
class Run:
    """What happened in one run.

    Attributes
    ----------
    command, phase, fault : str
    seed : int
    detected_s : float
        Time from the fault until the arm got its stop; 0 if it stood, and was moved no more.
    stands_s : float
        Time from the fault until the arm stood. A withdrawal follows.
    towards_mm : float
        Travel towards the object after the fault.
    pressed_mm : float
        The part of it in contact.
    safe : bool
        Whether the arm stands, clear of the object, and disabled at the end.
    told : str
        The error.
    """

    command: str
    phase: str
    fault: str
    seed: int
    detected_s: float
    stands_s: float
    towards_mm: float
    pressed_mm: float
    safe: bool
    told: str

    def wrong(self) -> str:
        """What is not as promised; "" if all is."""
        period_s = 1.0 / FPS
        camera = self.fault in CAMERA_FAULTS
        most_s = {KILLED: 1.0, "feedback 2 s late": 3.0}.get(self.fault, max(0.2, 3 * period_s) if camera else 1.5)
        pressed_mm = 1.0 if camera and self.command != "collect" else PRESSED_MM  # a tap that is planned may end
        found = {
            f"detected after {self.detected_s:.2f} s": self.detected_s > most_s + BUSY_S,
            f"stands after {self.stands_s:.2f} s": self.stands_s > most_s + 0.3 + BUSY_S,
            f"pressed {self.pressed_mm:.1f} mm more": self.pressed_mm > pressed_mm,
            "does not stand, free and disabled": not self.safe,
            "said nothing": not self.told,
        }
        return ", ".join(what for what, broken in found.items() if broken)


def faults_of(kind: str) -> tuple[str, ...]:
    """The faults of runs with this arm."""
    return (*CAMERA_FAULTS, *KINDS[kind][1], KILLED)


def draw(seed: int, kind: str = "mg400") -> tuple[str, str, str]:
    """Command, phase and fault of a run. All phases and faults come in turn."""
    pairs = [(phase, fault) for fault in faults_of(kind) for phase in PHASES]
    phase, fault = pairs[seed % len(pairs)]
    return COMMANDS[(seed // len(pairs) + seed) % len(COMMANDS)], phase, fault


def placed_can(kind: str) -> PlacedObject:
    servo = load_servo(KINDS[kind][0])
    return PlacedObject(load_object("can"), servo.placement, Mounting.of(load_sensor("mg400-331"), load_experiment(servo.experiment)))


def program(
    kind: str, command: str, place: tuple[int, ...] | str, url: str, folder: Path, pose=None, *, steps: int = STEPS, stops=None, scale=1.0
) -> Callable[[], None]:
    """What runs the command with an arm at its ports, at its serial line or in its namespace of topics."""
    placed, servo = placed_can(kind), load_servo(KINDS[kind][0]).model_copy(update={"clear_mm": CLEAR_MM})
    limits = SafetyLimits(box_mm=((-2000, 2000),) * 3)
    if kind.startswith("ros2"):  # its emulator has no scale of time
        servo = servo.model_copy(update={"linear_mm_s": scale * servo.linear_mm_s, "angular_deg_s": scale * servo.angular_deg_s})
        limits = limits.model_copy(update={"retreat_mm_s": scale * limits.retreat_mm_s})
        device = Ros2Arm(kind[5:], namespace=place)
        hold = device._hold
        device._hold = lambda *why, **how: (stops is not None and stops.append(time.monotonic()), hold(*why, **how))
    elif kind == "mg400":
        device = MG400("127.0.0.1", ports=Mg400Ports(place[0], place[1], tuple(place[2:])))
    else:
        device = UR(place) if kind == "ur" else Magician(place)
    arm = SafeArm(device, limits)
    source = MjpegCamera(url, load_sensor("mg400-331"), Form.RAW)

    rig = HastyRig(source, arm, placed, False)

    def run() -> None:
        with rig:
            source.read(timeout_s=5.0)
            if command == "collect":
                about = Collection(folder, {"seed": 1}, Form.RAW)
                experiment, speed = load_experiment("surface-2d"), (servo.linear_mm_s, servo.angular_deg_s)
                collect(rig, experiment, about, 9 if steps == STEPS else 1, seed=1, speed=speed)
                return
            track = SimpleNamespace(pose=pose or (lambda time_s: arm.state().pose))
            truth = TrueEstimator(SimpleNamespace(track=track), placed)
            settings = LoopSettings(steps, blocking=command != "stream", period_s=0.1, frame_timeout_s=FRAME_WAIT_S, give_up_s=WAIT_S)
            law = (lambda here, estimate: shift_in_tool(here, servo.feed_mm * placed.mounting.across)) if command == "policy" else None
            loop = ServoLoop(rig, servo, truth, settings, LoopHooks(law, lambda frame: truth))
            loop.run(placed.start_pose(servo.indent_mm))
            if loop.notes:
                raise DeviceError("; ".join(loop.notes))

    return run


def measure(seed: int, case: tuple[str, str, str] | None = None, kind: str = "mg400", *, scale: float = 1.0) -> Run:
    """Make one run with an arm that is faster than a real one by the factor ``scale``."""
    command, phase, fault = case or draw(seed, kind)
    rng, placed = random.Random(seed), placed_can(kind)
    gap_mm = rng.uniform(*GAPS_MM.get(phase, (0.0, 0.0)))
    later_s = rng.uniform(0.0, 1.0)
    start = placed.start_pose(-CLEAR_MM - 10.0)
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        stops: list[float] = []
        if kind.startswith("ros2"):
            place = f"t{os.getpid()}/run{seed}"
            emulator = stack.enter_context(Ros2Emulator(kind[5:], namespace=place, pose=start))
        else:
            makes = {"magician": MagicianEmulator, "mg400": partial(Mg400Emulator, port_offset=None), "ur": partial(UrEmulator, host=None)}
            emulator = stack.enter_context(makes[kind](time_scale=scale))
            if kind == "mg400":
                place = tuple(emulator.ports[port] for port in (29999, 30003, 30004, 30005))
            else:
                place = emulator.host if kind == "ur" else emulator.device
            _start_at(emulator, start, stops)
        camera = stack.enter_context(CameraEmulator(DomeCamera()))
        done = threading.Event()
        told: list[str] = []
        process = None
        if fault == KILLED:
            words = f"import sys; sys.path[:0] = {sys.path!r}; from pathlib import Path; from blind_runs import program"
            call = f"program({kind!r}, {command!r}, {place!r}, {camera.url!r}, Path({str(folder / 'data')!r}))()"
            process = subprocess.Popen([sys.executable, "-c", f"{words}; {call}"], stderr=subprocess.DEVNULL)
            thread = threading.Thread(target=lambda: (process.wait(), done.set()), daemon=True)
        else:
            steps = HEALTHY_STEPS if fault == HEALTHY else STEPS
            act = program(kind, command, place, camera.url, folder / "data", emulator.pose, steps=steps, stops=stops, scale=scale)

            def go() -> None:
                try:
                    act()
                except DeviceError as error:
                    told.append(str(error))
                finally:
                    done.set()

            thread = threading.Thread(target=go, daemon=True)
        thread.start()
        if fault != HEALTHY:
            _await_phase(emulator, placed, phase, gap_mm, later_s, done)
        if process is not None:
            process.kill()
            told.append("killed")
        elif fault != HEALTHY:
            kinds = (CAMERA_FAULTS | KINDS[kind][1])[fault]
            device = camera if fault in CAMERA_FAULTS else emulator
            device.faults.add(kinds[rng.randrange(len(kinds))]) if kinds else emulator.unplug()
        fault_s = time.monotonic()
        done.wait(30.0)
        time.sleep(1.2 if process is not None else 0.1)
        ended, told_s = done.is_set(), time.monotonic()
        found = (0.0,) * 4 if fault == HEALTHY else _judged(emulator, placed, fault_s, [at_s for at_s in stops if at_s < told_s])
        if isinstance(emulator, Ros2Emulator):  # no more commands come
            commands, pose = emulator.commands, emulator.pose()
            time.sleep(0.2)
            safe = ended and emulator.commands == commands and np.array_equal(emulator.pose(), pose)
        else:
            safe = ended and not emulator.arm.busy() and (kind == "magician" or not emulator.arm.enabled)  # which has no such state
        if fault in (*CAMERA_FAULTS, HEALTHY):  # without feedback, an arm is not moved back
            safe = safe and -placed.touch(emulator.pose()).indent_mm > 5.0
        thread.join(5.0)
        return Run(command, phase, fault, seed, *found, safe, "; ".join(told))


def _start_at(emulator, start: np.ndarray, stops: list[float]) -> None:
    """Put an emulated arm at a pose, and note when it is stopped."""
    kinematics, track = emulator.arm.kinematics, emulator.arm.track
    track.__init__(kinematics, kinematics.inverse(kinematics.nearest_pose(start)))
    stop = track.stop

    def stopped(time_s: float) -> None:
        stops.append(time.monotonic())
        stop(time_s)

    track.stop = stopped


def _await_phase(emulator, placed, phase: str, gap_mm: float, later_s: float, done: threading.Event) -> None:
    """Wait until the arm is in the phase."""
    clear, touched_s = False, None
    while not done.is_set():
        now_s, pose = time.monotonic(), emulator.pose()
        gap = -placed.touch(pose).indent_mm
        clear = clear or gap < CLEAR_MM - 1.0
        if isinstance(emulator, Ros2Emulator):
            ready = emulator.commands > 0
        else:
            ready = emulator.arm._running if isinstance(emulator, MagicianEmulator) else emulator.arm.enabled
        if phase == "standing" and ready:
            return
        if phase in GAPS_MM and clear and gap <= gap_mm:
            return
        if phase == "contact" and gap < -1.0 and touched_s is None:
            touched_s = now_s
        if touched_s is not None and now_s > touched_s + later_s:
            return
        time.sleep(POLL_S)


def _judged(emulator, placed, fault_s: float, stops: list[float]) -> tuple[float, float, float, float]:
    """Time until the stop, time until the arm stood, travel towards the object, and the part of it in contact."""
    times = np.arange(fault_s, time.monotonic(), STEP_S)
    poses = np.array([emulator.pose(time_s) for time_s in times])
    moves = np.r_[np.abs(np.diff(poses, axis=0)).max(axis=1) > 1e-6, False]
    depths = np.array([placed.touch(pose).indent_mm for pose in poses[np.r_[True, moves[:-1]]]])  # elsewhere as just before
    segments: list[list[int]] = []  # first and last sample of each motion
    for k in np.flatnonzero(moves):
        if segments and (k - segments[-1][1]) * STEP_S < REST_S:
            segments[-1][1] = int(k)
        else:
            segments.append([int(k), int(k)])
    # the stop may be followed at once by the withdrawal
    first_stop_s = next((time_s for time_s in stops if time_s > fault_s), np.inf)
    on_the_way = [segment for segment in segments if times[segment[0]] < first_stop_s - STEP_S]
    if not on_the_way:
        return 0.0, 0.0, 0.0, 0.0
    last = on_the_way[-1][1]
    stopped = int(np.searchsorted(times, first_stop_s))
    last = min(last, stopped) if last > stopped else last
    stands_s = float(times[last] - fault_s)
    detected_s = min(first_stop_s - fault_s, stands_s)
    towards_mm = max(0.0, float(depths.max() - depths[0]))
    pressed_mm = float(np.maximum(depths, 0.0).max() - max(depths[0], 0.0))
    return detected_s, stands_s, towards_mm, pressed_mm


def table(runs: list[Run]) -> str:
    """The worst of each fault and phase, in Markdown."""
    lines = ["| fault | phase | runs | detected, s | stands, s | towards, mm | pressed, mm | wrong |", "| --- " * 8 + "|"]
    for fault in dict.fromkeys((*FAULTS, *(run.fault for run in runs))):
        for phase in PHASES:
            some = [run for run in runs if (run.fault, run.phase) == (fault, phase)]
            if some:
                worst = [max(getattr(run, what) for run in some) for what in ("detected_s", "stands_s", "towards_mm", "pressed_mm")]
                wrong = sum(bool(run.wrong()) for run in some)
                lines.append(
                    f"| {fault} | {phase} | {len(some)} | {worst[0]:.2f} | {worst[1]:.2f} | {worst[2]:.2f} | {worst[3]:.2f} | {wrong} |"
                )
    return "\n".join(lines)


if __name__ == "__main__":
    from concurrent.futures import ProcessPoolExecutor
    from multiprocessing import get_context

    first, last, workers = (int(text) for text in sys.argv[1:4])
    kind = sys.argv[4] if len(sys.argv) > 4 else "mg400"
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        found = []
        for run in pool.map(partial(measure, kind=kind), range(first, last)):
            found.append(run)
            print(run, "WRONG: " + run.wrong() if run.wrong() else "", flush=True)
    print(table(found))
