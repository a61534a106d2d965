"""The loop over a simulated arm and a live source: it follows, it measures, and whatever goes wrong it stops and lets go."""

import time
from dataclasses import asdict, replace

import numpy as np
import pytest
from faulty_arm import ArmFault, FaultyArm
from noisy_camera import NoisyCamera
from true_estimator import TrueEstimate, TrueEstimator

from hardware.arms.arm import SimulatedArm
from hardware.cameras.mjpeg import MjpegCamera
from hardware.cameras.source import SessionSource
from hardware.emulators.camera import CameraEmulator
from hardware.errors import DeviceError
from hardware.rig.geometry import PlacedObject
from hardware.servo.loop import Decided, LoopHooks, LoopSettings, ServoLoop
from hardware.servo.trajectory import measure, trajectory_of, write_csv
from hardware.workcell.build import Rig
from scenes import PlacementSpec, load_experiment, load_object, load_sensor, load_servo
from twin.records.session import Session, SessionWriter
from twin.rig.kinematics import Mounting

SPEED = 20.0  # of the simulated arm, times real
ALLOCATOR_BYTES = 4_000_000  # that it may take at a time
CLEAR_INDENT_MM = -10.0  # a sensor that has let go is farther than this from the surface


@pytest.fixture
def rig():
    sensor = load_sensor("mg400-331")
    mounting = Mounting.of(sensor, load_experiment("surface-2d"))
    placed = PlacedObject(load_object("can"), PlacementSpec(), mounting)
    arm = FaultyArm(axes=6, pose=placed.start_pose(-60.0), time_scale=SPEED)
    return placed, arm


def loop_of(rig, source, steps=20, *, servo=None, estimator=None, **settings):
    placed, arm = rig
    servo = servo or load_servo("surface")
    return ServoLoop(Rig(source, arm, placed, False), servo, estimator or TrueEstimator(arm, placed), LoopSettings(steps, **settings))


def start(rig):
    return rig[0].start_pose(2.0)


def assert_let_go(rig):
    placed, arm = rig
    state = arm.state()
    assert not state.enabled and not state.moving
    assert placed.touch(state.pose).indent_mm < CLEAR_INDENT_MM


@pytest.mark.parametrize("blocking", [True, False])
def test_it_follows_the_can_and_lets_go(rig, blocking, tmp_path):
    placed, arm = rig
    with arm, NoisyCamera() as source:
        loop = loop_of(rig, source, 40, blocking=blocking, period_s=0.04)
        timing = loop.run(start(rig))
        assert_let_go(rig)
    assert timing.steps == 40 and loop.notes == []
    path = trajectory_of(loop.records, placed.mounting, placed)
    found = measure(path, indent_mm=loop.servo.indent_mm, angle_deg=0.0, wanted_mm=30.0)
    assert found.lost_contacts == 0
    assert found.path_error_mm < 0.1  # the pose at the exposure is interpolated
    assert found.hold_depth_mm < 0.3 and found.completed > 0.5
    lines = write_csv(tmp_path / "t.csv", path).read_text().splitlines()
    assert len(lines) == 1 + len(path.depth_mm) and "true_indent_mm" in lines[0]


def test_each_blocking_step_waits_for_a_frame_after_the_arm_has_settled(rig):
    _, arm = rig
    with arm, NoisyCamera() as source:
        loop = loop_of(rig, source, 15)
        loop.run(start(rig))
    assert all(record.fresh for record in loop.records)
    for before, record in zip(loop.records[:-1], loop.records[1:], strict=True):
        assert record.frame_s > before.time_s
        np.testing.assert_allclose(record.exposed_pose, before.sent, atol=1e-6)


def test_the_figures_add_up(rig):
    _, arm = rig
    with arm, NoisyCamera(fps=20) as source:
        loop = loop_of(rig, source, 30, blocking=False, period_s=0.02)
        timing = loop.run(start(rig))
    moved = [age_s for decided, age_s in loop.decided if decided is Decided.MOVE]
    assert moved == [record.age_s for record in loop.records]
    assert timing.age_s.p50 == pytest.approx(np.nanpercentile([age_s for _, age_s in loop.decided], 50))
    assert sum(timing.decided.values()) == len(loop.decided) >= timing.steps == timing.decided["moved"]
    assert timing.decided_hz >= timing.rate_hz
    assert timing.latency_s.p50 <= timing.latency_s.p95 <= timing.latency_s.p99
    fresh = [record for record in loop.records if record.fresh]
    assert 1 < len(fresh) < timing.steps  # decisions are faster than frames
    assert len({record.sequence for record in loop.records}) == len(fresh)
    assert timing.rate_hz > timing.fresh_hz > 0
    assert all(record.latency_s >= record.age_s for record in loop.records)


def test_it_takes_a_frame_clear_of_the_object_before_it_touches(rig):
    placed, arm = rig
    taken = []

    def take(frame):
        taken.append((frame.time_s, placed.touch(arm.track.pose(frame.time_s)).indent_mm))
        return loop.estimator

    with arm, NoisyCamera() as source:
        loop = loop_of(rig, source, 3)
        loop.hooks = LoopHooks(take_rest=take)
        loop.run(start(rig))
    ((time_s, indent_mm),) = taken
    assert indent_mm < -10 and time_s < loop.records[0].frame_s


@pytest.mark.parametrize("fault", ["frozen", "black", "late=0.9", "silent", "unplugged=60"])
def test_a_camera_that_fails_for_good_stops_the_arm(rig, fault):
    _, arm = rig
    with CameraEmulator(NoisyCamera(fps=60)) as emulator, arm, MjpegCamera(emulator.url) as source:
        loop = loop_of(rig, source, 10_000, blocking=False, period_s=0.02, give_up_s=1.0)
        loop.hooks = LoopHooks(on_step=lambda record, frame, estimate: record.index == 5 and emulator.faults.add(fault))
        with pytest.raises(DeviceError, match="holds still"):
            loop.run(start(rig))
        assert_let_go(rig)
    assert any("held still" in note for note in loop.notes)


def test_a_short_fault_is_waited_for(rig):
    _, arm = rig
    with CameraEmulator(NoisyCamera(fps=60)) as emulator, arm, MjpegCamera(emulator.url) as source:
        loop = loop_of(rig, source, 60, blocking=False, period_s=0.02, give_up_s=5.0)
        loop.hooks = LoopHooks(on_step=lambda record, frame, estimate: record.index == 5 and emulator.faults.add("unplugged=0.8"))
        timing = loop.run(start(rig))
    assert timing.steps == 60
    assert all(record.age_s <= loop.servo.max_frame_age_s + 0.05 for record in loop.records)
    blind = [np.linalg.norm(record.sent[:3] - record.exposed_pose[:3]) for record in loop.records if not record.fresh]
    assert max(blind) <= loop.servo.blind_mm + loop.servo.largest_move_mm
    assert min(rig[0].touch(record.pose).indent_mm for record in loop.records) > 0


def test_the_arm_stands_still_while_it_holds(rig):
    _, arm = rig
    with CameraEmulator(NoisyCamera(fps=60)) as emulator, arm, MjpegCamera(emulator.url) as source:
        loop = loop_of(rig, source, 10_000, blocking=False, period_s=0.02, give_up_s=1.0)
        held: list[np.ndarray] = []
        hold = loop._hold

        def watched(*arguments):
            hold(*arguments)
            held.append(arm.state().pose)

        loop._hold = watched
        loop.hooks = LoopHooks(on_step=lambda record, frame, estimate: record.index == 5 and emulator.faults.add("silent"))
        with pytest.raises(DeviceError):
            loop.run(start(rig))
    assert len(held) > 3
    np.testing.assert_array_equal(held[0], held[-1])


class LateArm(SimulatedArm):
    """Its feedback says for a while after a stop that it still moves."""

    stopped_s = -np.inf

    def stop(self):
        super().stop()
        self.stopped_s = time.monotonic()

    def state(self, *, max_age_s=1.0):
        told = super().state(max_age_s=max_age_s)
        return replace(told, moving=told.moving or told.time_s < self.stopped_s + 0.3)


def test_after_a_hold_it_goes_on_from_where_the_arm_stands(rig):
    """And not from where the move that was dropped would have ended, though feedback is late."""
    placed, _ = rig
    arm = LateArm(axes=6, pose=placed.start_pose(-60.0), time_scale=1.0)
    estimator = TrueEstimator(arm, placed)
    stands: list[np.ndarray] = []
    with arm, NoisyCamera() as source:
        loop = loop_of((placed, arm), source, 6, estimator=estimator, blocking=False, period_s=0.02)
        hold = loop._hold

        def held(*arguments):
            hold(*arguments)
            stands.append(arm.state().pose)
            estimator.fail = ""

        loop._hold = held
        loop.hooks = LoopHooks(on_step=lambda record, frame, estimate: setattr(estimator, "fail", "no pins" if record.index == 2 else ""))
        loop.run(start((placed, arm)))
    assert len(stands) >= 1
    dropped, after = loop.records[2], loop.records[3]
    assert np.linalg.norm(dropped.sent[:3] - stands[-1][:3]) > 0.3  # mm: it had been on its way
    np.testing.assert_allclose(after.pose, stands[-1], atol=1e-6)


def test_a_long_way_to_the_object_is_given_its_time(rig, monkeypatch):
    placed, _ = rig
    arm = SimulatedArm(axes=6, pose=placed.start_pose(-60.0), time_scale=1.0)
    monkeypatch.setattr("hardware.servo.loop.MOVE_TIMEOUT_S", 1.0)  # the 50 mm from clear of it take 2.5 s
    with arm, NoisyCamera() as source:
        assert loop_of((placed, arm), source, 1).run(start((placed, arm))).steps == 1


class HeldArm(SimulatedArm):
    """Once held, its feedback says that it moves, and it does not."""

    held: np.ndarray | None = None

    def state(self, *, max_age_s=1.0):
        told = super().state(max_age_s=max_age_s)
        return told if self.held is None else replace(told, pose=self.held, moving=True)

    def stop(self):
        super().stop()
        self.held = None


def test_an_arm_that_is_held_is_not_awaited_for_ever(rig, monkeypatch):
    placed, _ = rig
    arm = HeldArm(axes=6, pose=placed.start_pose(-60.0), time_scale=SPEED)
    with arm, NoisyCamera() as source:
        loop = loop_of((placed, arm), source, 10_000, blocking=False, period_s=0.02)

        def hold(record, frame, estimate):
            if record.index == 5:
                arm.held = record.pose
                monkeypatch.setattr("hardware.servo.loop.MOVE_TIMEOUT_S", 1.0)

        loop.hooks = LoopHooks(on_step=hold)
        with pytest.raises(DeviceError, match="look for an obstacle"):
            loop.run(start((placed, arm)))
        assert_let_go((placed, arm))


def test_an_estimate_that_is_not_valid_moves_nothing(rig):
    placed, arm = rig
    estimator = TrueEstimator(arm, placed)
    with arm, NoisyCamera() as source:
        loop = loop_of(rig, source, 10_000, estimator=estimator, give_up_s=0.5)
        loop.hooks = LoopHooks(on_step=lambda record, frame, estimate: setattr(estimator, "fail", "no pins" if record.index >= 5 else ""))
        with pytest.raises(DeviceError, match="no pins"):
            loop.run(start(rig))
        assert_let_go(rig)
    assert len(loop.records) == 6


@pytest.mark.parametrize("off", [(300.0, 0.0), (-30.0, 0.0), (0.0, 100.0), (np.nan, 0.0)])
def test_an_estimate_that_cannot_be_moves_nothing(rig, off):
    placed, arm = rig
    true = TrueEstimator(arm, placed)

    def wild(frame):
        made = true(frame)
        return made if true.calls <= 5 else TrueEstimate(made.names, made.value + off, made.low, made.high)

    with arm, NoisyCamera() as source:
        loop = loop_of(rig, source, 10_000, estimator=wild, give_up_s=0.3)
        with pytest.raises(DeviceError, match="outside the possible"):
            loop.run(start(rig))
        assert_let_go(rig)
    assert len(loop.records) == 5


@pytest.mark.parametrize("fault", [ArmFault.COLLIDE, ArmFault.SILENT, ArmFault.STALL])
def test_an_arm_that_fails_ends_the_loop(rig, fault):
    _, arm = rig
    with arm, NoisyCamera() as source:
        loop = loop_of(rig, source, 10_000)
        loop.hooks = LoopHooks(on_step=lambda record, frame, estimate: record.index == 5 and arm.faults.add(fault))
        with pytest.raises(DeviceError):
            loop.run(start(rig))
        assert not arm._enabled
        arm.faults.clear()


@pytest.mark.parametrize("error", [KeyboardInterrupt, ValueError])
def test_ctrl_c_and_any_exception_retreat_and_disable(rig, error):
    _, arm = rig

    def broken(record, frame, estimate):
        if record.index == 5:
            raise error("now")

    with arm, NoisyCamera() as source:
        loop = loop_of(rig, source, 10_000)
        loop.hooks = LoopHooks(on_step=broken)
        with pytest.raises(error):
            loop.run(start(rig))
        assert_let_go(rig)
    assert loop.notes == []


def test_an_arm_may_refuse_a_step(rig, monkeypatch):
    _, arm = rig
    move = arm.move_linear

    def guarded(target, **options):
        if len(loop.records) == 10 and not options.get("wait", True):
            raise DeviceError("outside the box")
        return move(target, **options)

    monkeypatch.setattr(arm, "move_linear", guarded)
    with arm, NoisyCamera() as source:
        loop = loop_of(rig, source, 10_000)
        with pytest.raises(DeviceError, match="outside the box"):
            loop.run(start(rig))
        assert_let_go(rig)
    assert len(loop.records) == 10


def test_a_replayed_session_decides_the_same(rig, tmp_path):
    """Replay equals live: the same frames give the same estimates, and from the recorded places the same commands."""
    placed, arm = rig
    estimates = []

    def of_picture(frame):  # depends on the frame's levels alone
        value = np.array(placed.mounting.labels(2.0 + 0.01 * float(frame.image.mean() % 7), float(frame.image.std() % 3)))
        made = TrueEstimator(arm, placed)(frame)
        estimates.append(value)
        return type(made)(made.names, value, value, value)

    with arm, NoisyCamera() as source, SessionWriter(tmp_path / "s", {"camera": source.name}) as session:
        loop = loop_of(rig, source, 12, estimator=of_picture)
        loop.hooks = LoopHooks(on_step=lambda record, frame, estimate: session.append(frame, asdict(record)))
        loop.run(start(rig))
    live, estimates = np.array(estimates), []
    with SessionSource(tmp_path / "s") as replayed:
        again = []
        while True:
            try:
                again.append(of_picture(replayed.read()).value)
            except EOFError:
                break
    np.testing.assert_array_equal(np.array(again), live)
    steps = Session(tmp_path / "s").steps
    np.testing.assert_array_equal([step["value"] for step in steps], live)
    np.testing.assert_array_equal([step["sent"] for step in steps], [record.sent for record in loop.records])


@pytest.mark.slow
def test_an_hour_of_it_neither_grows_nor_slows(rig):
    """Bounded by TACTIP_ENDURANCE_MIN minutes (1 by default): memory, latency, and every frame accounted for.

    What may grow is the record of every decision.
    """
    import os
    import resource
    import sys

    minutes = float(os.environ.get("TACTIP_ENDURANCE_MIN", "1"))
    _, arm = rig
    halves: list[list[float]] = [[], []]
    memory_kib: list[int] = []
    decisions: list[int] = []
    end_s = time.monotonic() + 60 * minutes
    middle_s = end_s - 30 * minutes

    class Enough(Exception):
        pass

    def watch(record, frame, estimate):
        now_s = time.monotonic()
        halves[now_s > middle_s].append(record.latency_s)
        if record.index % 100 == 0:
            memory_kib.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
            decisions.append(len(loop.decided))
        if now_s > end_s:
            raise Enough

    with CameraEmulator(NoisyCamera(fps=30)) as emulator, arm, MjpegCamera(emulator.url) as source:
        loop = loop_of(rig, source, 10**9, blocking=False, period_s=0.05)
        loop.hooks = LoopHooks(on_step=watch)
        with pytest.raises(Enough):
            loop.run(start(rig))
        with source._new:
            assert source.arrived == source.delivered + source.dropped
        assert source.failed == 0
    third = len(memory_kib) // 3
    print(f"\n{minutes:g} min, {source.arrived} frames arrived, {source.delivered} read, {source.dropped} dropped, {source.failed} failed")
    grown_kib, taken = memory_kib[-1] - memory_kib[third], decisions[-1] - decisions[third]
    print(f"{len(loop.decided)} decisions; memory +{grown_kib} KiB in the last two thirds, {1024 * grown_kib / taken:.0f} bytes a decision")
    for name, half in zip(("first", "second"), halves, strict=True):
        print(f"{name} half: exposure to command {1e3 * np.median(half):.1f} ms, 95 % {1e3 * np.percentile(half, 95):.1f} ms")
    record = loop.records[-1]
    own = sum(sys.getsizeof(getattr(record, slot)) for slot in record.__slots__) + sys.getsizeof(record)
    assert 1024 * grown_kib < 1.5 * own * taken + ALLOCATOR_BYTES, "what the records take, and no more"
    assert np.median(halves[1]) < 1.5 * np.median(halves[0])
    assert np.percentile(halves[1], 95) < 2.0 * np.percentile(halves[0], 95)
