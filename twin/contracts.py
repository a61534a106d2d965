"""Contracts of parts: what each arm, camera, layout, material law, degradation, model and task must hold, as classes for pytest.

A package that adds a part derives a class whose name begins with ``Test`` and gives the part; pytest then runs the contract on it:

    from twin.extend import ArmContract

    class TestBenchArm(ArmContract):
        home = (300, 0, 0, 0, 0, 0)

        def open(self, stack):
            emulator = stack.enter_context(BenchEmulator())
            return BenchArm(emulator.address)

The arms and cameras of this project are tried by the same classes.
"""

import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

import twin
from hardware.arms.arm import Arm
from hardware.cameras.source import FrameSource
from hardware.errors import DeviceAlreadyConnectedError, DeviceError, DeviceNotConnectedError
from scenes import load_sensor
from scenes.layouts.base import Layout
from scenes.materials.base import MaterialLaw
from scenes.pins import PinsSpec
from twin.camera.projection import project
from twin.evaluation.degradation.condition import Condition, DegradedCase, PictureView
from twin.geometry.pins import rest_pins
from twin.optics.preview import Preview
from twin.pins import Pipeline
from twin.simulator import Simulator

BAD_TARGETS = (np.zeros(3), "home", None, [np.nan] * 6, [[0.0] * 6], [10**400] * 6, np.ones(6) * 1j, ["1"] * 6, [2e4, 0, 0, 0, 0, 0])
SEVERITIES = (0.0, 0.3, 1.0)


def refuses(error: type[Exception], call: Callable[[], object], words: str = "") -> None:
    """Assert that a call raises this error with these words."""
    try:
        call()
    except error as refusal:
        assert words in str(refusal), f"{refusal!r} does not name {words!r}"
    else:
        raise AssertionError(f"no {error.__name__} was raised")


class ArmContract:
    """Laws of an `Arm`. The emulator's or client's moves must take time.

    Attributes
    ----------
    home : (6,) float
        A pose, mm and deg, around which the arm can move by 50 mm along y and by 20 mm along x and z.
    settled_mm : float
        Largest distance from the target at which a move ends.
    slow_mm_s, fast_mm_s : float
        Speeds. A slow move of 50 mm takes half a second or more.
    """

    home: Sequence[float] = (300.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    settled_mm = 0.1
    slow_mm_s, fast_mm_s = 20.0, 200.0
    arm: Arm

    def open(self, stack: ExitStack) -> Arm:
        """The arm, which is not connected. What it needs, such as an emulator, is entered into ``stack``."""
        raise NotImplementedError

    def read(self) -> np.ndarray:
        """Pose (6,) of the device itself, by another way than the arm if there is one."""
        return self.arm.state().pose

    def setup_method(self) -> None:
        """Make the arm."""
        self._stack = ExitStack()
        self.arm = self.open(self._stack)

    def teardown_method(self) -> None:
        """Disconnect it."""
        self.arm.disconnect()
        self._stack.close()

    def make_ready(self) -> np.ndarray:
        """Connect and enable the arm, and move it home."""
        self.arm.connect()
        self.arm.enable()
        self.arm.set_speed(self.fast_mm_s, self.fast_mm_s)
        self.arm.move_linear(np.array(self.home, float))
        self.arm.set_speed(self.slow_mm_s, self.slow_mm_s)
        return np.array(self.home, float)

    def stands(self) -> np.ndarray:
        """Assert that the arm stands, and return its pose."""
        time.sleep(0.1)
        still = np.array(self.read())
        time.sleep(0.2)
        assert np.array_equal(self.read(), still)
        return still

    def test_nothing_works_before_connect_and_nothing_moves_before_enable(self) -> None:
        arm, home = self.arm, np.array(self.home, float)
        assert not arm.is_connected
        calls: list[Callable[[], object]] = [arm.enable, arm.disable, arm.clear_error, arm.stop, arm.emergency_stop, arm.state]
        for call in (*calls, lambda: arm.move_linear(home), lambda: arm.set_speed(1, 1)):
            refuses(DeviceNotConnectedError, call, "connect")
        arm.connect()
        before = self.read()
        assert arm.is_connected and not arm.state().enabled
        refuses(DeviceAlreadyConnectedError, arm.connect)
        refuses(DeviceError, lambda: arm.move_linear(home))
        assert np.array_equal(self.read(), before)
        arm.disconnect()
        arm.disconnect()
        assert not arm.is_connected

    def test_a_move_ends_at_rest_at_its_target(self) -> None:
        home = self.make_ready()
        self.arm.set_speed(self.fast_mm_s, self.fast_mm_s)
        for offset in ([10, 20, -5, 0, 0, 15], [-10, -20, 5, 0, 0, -15], [0, 0, 0, 0, 0, 0]):
            sent, state = self.arm.move_linear(home + offset), self.arm.state()
            assert np.allclose(sent, home + offset) and not state.moving and state.enabled and not state.error
            assert np.linalg.norm(state.pose[:3] - sent[:3]) < self.settled_mm
            assert np.allclose(self.read(), sent, atol=self.settled_mm)
            assert state.joints_deg.shape == (self.arm.axes,) and abs(time.monotonic() - state.time_s) < 1.0

    def test_a_target_that_cannot_be_is_refused_and_nothing_moves(self) -> None:
        self.make_ready()
        before = self.read()
        for target in BAD_TARGETS:
            refuses(DeviceError, lambda target=target: self.arm.move_linear(target))  # type: ignore[misc]
        for speeds in ((0, 10), (10, np.nan), (-1, 1), (np.inf, 1)):
            refuses(DeviceError, lambda speeds=speeds: self.arm.set_speed(*speeds), "positive")  # type: ignore[misc]
        assert np.array_equal(self.read(), before) and not self.arm.state().moving

    def test_without_wait_a_move_returns_at_once_and_stop_ends_it(self) -> None:
        home = self.make_ready()
        for n in (1, 2, 3):
            self.arm.move_linear(home + [0, 20 * (-1) ** n, 0, 0, 0, 0], wait=False)
        time.sleep(0.1)
        assert self.arm.state().moving
        self.arm.stop()
        assert np.linalg.norm(self.stands()[:3] - home[:3]) < 20 and not self.arm.state().moving
        self.arm.move_linear(home)

    def test_an_emergency_stop_ends_all_until_the_arm_is_enabled_again(self) -> None:
        home = self.make_ready()
        self.arm.move_linear(home + [0, 20, 0, 0, 0, 0], wait=False)
        time.sleep(0.1)
        self.arm.emergency_stop()
        self.stands()
        assert not self.arm.state().enabled
        refuses(DeviceError, lambda: self.arm.move_linear(home), "enable")
        self.arm.clear_error()
        self.arm.enable()
        self.arm.move_linear(home)

    def test_too_little_time_is_an_error_and_the_arm_stops(self) -> None:
        home = self.make_ready()
        refuses(DeviceError, lambda: self.arm.move_linear(home + [0, 50, 0, 0, 0, 0], timeout_s=0.2), "time")
        self.arm.stop()
        self.stands()

    def test_disable_stops_and_enable_moves_again(self) -> None:
        home = self.make_ready()
        self.arm.move_linear(home + [0, 50, 0, 0, 0, 0], wait=False)
        self.arm.disable()
        still = self.stands()
        assert not self.arm.state().enabled
        refuses(DeviceError, lambda: self.arm.move_linear(home))
        assert np.array_equal(self.read(), still)
        self.arm.enable()
        self.arm.move_linear(home)

    def test_it_connects_again_and_is_a_context_manager(self) -> None:
        home = self.make_ready()
        self.arm.disconnect()
        with self.arm as arm:
            assert arm is self.arm and arm.is_connected
            assert np.allclose(arm.state().pose[:3], home[:3], atol=self.settled_mm)
        assert not self.arm.is_connected


class CameraContract:
    """Laws of a `FrameSource`.

    Attributes
    ----------
    wait_s : float
        Longest time until a frame, s.
    """

    wait_s = 10.0
    source: FrameSource

    def open(self, stack: ExitStack) -> FrameSource:
        """The camera, which is not connected, with four different pictures or more. What it needs is entered into ``stack``."""
        raise NotImplementedError

    def setup_method(self) -> None:
        """Make the camera."""
        self._stack = ExitStack()
        self.source = self.open(self._stack)

    def teardown_method(self) -> None:
        """Disconnect it."""
        self.source.disconnect()
        self._stack.close()

    def test_it_opens_once_and_closes(self) -> None:
        assert not self.source.is_connected
        refuses(DeviceError, lambda: self.source.read(timeout_s=0.01))
        with self.source:
            assert self.source.is_connected
            refuses(DeviceAlreadyConnectedError, self.source.connect)
            assert self.source.read(timeout_s=self.wait_s).image.dtype == np.uint8
        assert not self.source.is_connected
        self.source.disconnect()

    def test_read_returns_each_frame_once_and_in_order(self) -> None:
        with self.source as source:
            frames = [source.read(timeout_s=self.wait_s) for _ in range(4)]
            assert source.read_latest(max_age_s=self.wait_s).sequence >= frames[-1].sequence
        assert (np.diff([frame.sequence for frame in frames]) > 0).all() and (np.diff([frame.time_s for frame in frames]) >= 0).all()
        assert all(frame.form == source.form and frame.image.shape == frames[0].image.shape for frame in frames)
        assert not source.is_live or abs(frames[-1].time_s - time.monotonic()) < self.wait_s

    def test_a_live_source_never_returns_an_old_frame(self) -> None:
        if not self.source.is_live:
            return
        with self.source as source:
            source.read(timeout_s=self.wait_s)
            now = time.monotonic()
            assert source.read_after(now, timeout_s=self.wait_s).time_s > now
            refuses(TimeoutError, lambda: source.read_after(time.monotonic() + 3600.0, timeout_s=0.05))
            refuses(DeviceError, lambda: source.read_latest(max_age_s=-1.0))


class LayoutContract:
    """Laws of a `Layout`: ``layout`` is one of it, and ``name`` the name by which specifications ask for it."""

    name: ClassVar[str]
    layout: ClassVar[Layout]

    def test_its_places_are_as_many_as_it_counts_and_apart(self) -> None:
        places = self.layout.places()
        assert places.shape == (self.layout.count, 2) and np.isfinite(places).all()
        apart = np.linalg.norm(places[:, None] - places, axis=2)[~np.eye(len(places), dtype=bool)]
        assert apart.min() > 0.05 * np.abs(places).max() / np.sqrt(len(places))

    def test_the_pipeline_finds_all_its_pins_in_a_rasterised_frame(self) -> None:
        sensor = load_sensor("ur5-331")
        plain = sensor.appearance.alter(cap_levels=(), cap_shapes=(), cap_offsets=(), relief=None)
        pins = PinsSpec(layout=self.name, cap_diameter_mm=1.0, **self.layout.model_dump())
        spec = sensor.alter(pins=pins, appearance=plain)
        rendered = Simulator(spec, quality="rasterised").render_rest()
        observation = Pipeline(spec, rendered.frame.form)(rendered.frame)
        assert observation.valid and observation.found == self.layout.count, observation.reason


class MaterialContract:
    """Laws of a `MaterialLaw`: ``law`` is one of it."""

    law: ClassVar[MaterialLaw]

    def test_its_shear_modulus_is_the_specifications(self) -> None:
        c10, c01, *higher = self.law.coefficients()
        assert np.isclose(c10 + c01, 1.0) and np.isfinite(higher).all()

    def test_more_stretch_takes_more_stress(self) -> None:
        c10, c01, c20, c30 = self.law.coefficients()
        stretch = np.linspace(0.6, 1.6, 101)
        over = stretch**2 + 2 / stretch - 3
        stress = 2 * (stretch - stretch**-2) * (c10 + 2 * c20 * over + 3 * c30 * over**2 + c01 / stretch)
        assert (np.diff(stress) > 0).all(), "the law is unstable in tension or compression"


class ConditionContract:
    """Laws of a `Condition`, a degradation: ``condition`` is one."""

    condition: ClassVar[Condition]
    sensor = "mg400-127"

    def test_severity_0_changes_nothing_and_severity_1_does(self) -> None:
        spec, case = load_sensor(self.sensor), DegradedCase((self.condition,))
        view = PictureView.of(spec, project(spec.view, rest_pins(spec.geometry).caps_mm))
        assert case.on_spec(spec, 0.0) == spec and case.on_spec(spec, 1.0) is not None
        light = Preview(spec).render()
        gray = np.clip(255 * light / light.max(), 0, 255).astype(np.uint8)
        for picture, act in ((light, case.on_light), (gray, case.on_frame)):
            changed = [act(picture, severity, view, 0) for severity in SEVERITIES]
            assert np.array_equal(changed[0], picture)
            assert all(each.shape == picture.shape and each.dtype == picture.dtype and np.isfinite(each).all() for each in changed)
            acts = (self.condition.light if picture is light else self.condition.frame) is not None
            assert np.array_equal(changed[-1], picture) != acts
            assert np.array_equal(act(picture, 1.0, view, 0), changed[-1]), "the same draw gives another picture"
        assert np.array_equal(case.on_points(view.caps_px, 0.0, view), view.caps_px)
        assert not case.missing_caps(0.0, view).any()


class ModelContract:
    """Laws of a registered model, by its ``name``: it trains, estimates, and is the same after it is loaded again."""

    name: ClassVar[str]
    options: ClassVar[dict[str, Any]] = {"epochs": 2, "members": 1}

    def test_it_trains_estimates_and_is_loaded_again(self, tmp_path: Path) -> None:
        made: dict[str, Any] = {"experiment": "surface-2d", "sensor": "mg400-127", "count": 12, "states": "all", "elements": 6}
        twin.make_dataset(**made, workers=1, images="processed", quality="rasterised", out=tmp_path / "sim")
        twin.train(model=self.name, sensor="mg400-127", data=tmp_path / "sim", split=-1, out=tmp_path / "run", **self.options)
        first, again = ([estimate for _, estimate in twin.predict(tmp_path / "run", tmp_path / "sim")] for _ in range(2))
        assert first and [each.reason for each in first] == [each.reason for each in again]
        assert all(np.array_equal(one.value, other.value, equal_nan=True) for one, other in zip(first, again, strict=True))


class TaskContract:
    """Laws of a `Task`, by its ``name``: episodes repeat by their seed, rows are single environments, and nothing pays less than failing.

    Attributes
    ----------
    steps : int
        Number of steps that are tried.
    """

    name: ClassVar[str]
    options: ClassVar[dict[str, Any]] = {}
    steps = 20

    def _episode(self, seed: int) -> list[np.ndarray]:
        gymnasium = __import__("gymnasium")
        env = gymnasium.make(f"twin:tactip/{self.name}-v0", **self.options)
        observation, _ = env.reset(seed=seed)
        env.action_space.seed(seed)
        passed = [np.concatenate([np.ravel(part) for part in observation.values()])]
        for _ in range(self.steps):
            observation, reward, terminated, truncated, _ = env.step(env.action_space.sample())
            assert env.observation_space.contains(observation) and np.isfinite(reward) and reward >= 0.0
            passed.append(np.concatenate([*(np.ravel(part) for part in observation.values()), [reward]]))
            if terminated or truncated:
                break
        env.close()
        return passed

    def test_an_episode_repeats_by_its_seed(self) -> None:
        first, second, other = self._episode(1), self._episode(1), self._episode(2)
        assert len(first) == len(second) and all(map(np.array_equal, first, second))
        assert not all(map(np.array_equal, first, other))
