"""A condition: one kind of degradation of a sensor, as frozen data, and the stage of the chain on which it acts.

The stages are specification, contact, light on the film, camera response, frame, and the pipeline's settings. At severity 0 no hook is
called, so that nothing changes, bit for bit.
"""

import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

import numpy as np
from scipy.spatial import cKDTree

from scenes.base import Section
from scenes.sensor import SensorSpec
from twin.camera.projection import lens_disc, project
from twin.geometry.pins import rest_pins
from twin.pins import DetectorSpec


@dataclass(frozen=True)
class PictureView:
    """The information about a picture that conditions may use.

    Attributes
    ----------
    spec : SensorSpec
        The rendered specification, including its degradations.
    center_px : (2,) float
    radius_px : float
        Centre and radius of the disc through which the gel is seen.
    px_per_mm : float
        Scale at the caps at rest.
    caps_px : (N, 2) float
        Places of the caps in this frame.
    size_px : (int, int)
        Width and height of the frame.
    """

    spec: SensorSpec
    center_px: np.ndarray
    radius_px: float
    px_per_mm: float
    caps_px: np.ndarray
    size_px: tuple[int, int]

    @classmethod
    def of(cls, spec: SensorSpec, caps_px: np.ndarray) -> "PictureView":
        """The view of a sensor whose caps are at ``caps_px`` (N, 2), raw-frame px."""
        disc = lens_disc(spec.view, spec.housing)
        caps_mm = rest_pins(spec.geometry).caps_mm
        apart = [cKDTree(points).query(points, k=2)[0][:, 1] for points in (project(spec.view, caps_mm), caps_mm)]
        size_px = spec.camera.width_px, spec.camera.height_px
        return cls(spec, disc.center_px, disc.radius_px, float(np.median(apart[0] / apart[1])), caps_px, size_px)

    @property
    def cap_radius_px(self) -> float:
        """Radius of a cap that faces the camera."""
        return 0.5 * self.spec.pins.cap_diameter_mm * self.px_per_mm

    @property
    def saturation(self) -> float:
        """Linear light at which the camera is saturated."""
        return 1.0 / self.spec.response.exposure

    def grid(self, shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
        """x and y (H, W) of a frame's pixels from the disc's centre, in units of its radius."""
        y, x = np.mgrid[: shape[0], : shape[1]].astype(np.float32)
        return (x - np.float32(self.center_px[0])) / self.radius_px, (y - np.float32(self.center_px[1])) / self.radius_px


ImageChange = Callable[[np.ndarray, float, PictureView, np.random.Generator], np.ndarray]
S = TypeVar("S", bound=Section)
T = TypeVar("T")


@dataclass(frozen=True)
class OnSection(Generic[S]):
    """A change of one section, as a change of the specification. It is a class, because closures can't be sent between processes."""

    section: str
    change: Callable[[S, float, np.random.Generator], S]

    def __call__(self, spec: SensorSpec, value: float, rng: np.random.Generator) -> SensorSpec:
        return spec.alter(**{self.section: self.change(getattr(spec, self.section), value, rng)})


@dataclass(frozen=True)
class Condition:
    """One kind of degradation of a sensor.

    The parameter is ``nominal`` at severity 0 and ``severe`` at severity 1, and linear in the severity.

    Attributes
    ----------
    name, title, family : str
    parameter, unit : str
        Name and unit of the parameter whose values are ``nominal`` and ``severe``.
    nominal, severe : float
    spec : callable, optional
        ``spec(spec, value, rng)`` returns the degraded specification, before anything is rendered; ``OnSection`` if one section changes.
    solves : bool
        Whether the mechanics of the specification change, so that contacts must be solved again.
    light : callable, optional
        ``light(light, value, view, rng)`` returns the degraded linear light on the film, before the camera's response.
    frame : callable, optional
        ``frame(image, value, view, rng)`` returns the degraded gray levels or RGB (uint8).
    moves : callable, optional
        ``moves(px, value, view)`` returns the places to which ``light`` or ``frame`` moves points (n, 2) of the picture.
    hides : callable, optional
        ``hides(value, view, rng)`` returns the caps that are gone, (N,) bool.
    setting : callable, optional
        ``setting(detector, value)`` returns a `DetectorSpec` with a wrong setting.
    image_level : bool
        Whether the condition acts on a frame alone, so that real frames can also be degraded.
    """

    name: str
    title: str
    family: str
    parameter: str
    unit: str
    severe: float
    nominal: float = 0.0
    spec: Callable[[SensorSpec, float, np.random.Generator], SensorSpec] | None = field(default=None, repr=False)
    solves: bool = False
    light: ImageChange | None = field(default=None, repr=False)
    frame: ImageChange | None = field(default=None, repr=False)
    moves: Callable[[np.ndarray, float, PictureView], np.ndarray] | None = field(default=None, repr=False)
    hides: Callable[[float, PictureView, np.random.Generator], np.ndarray] | None = field(default=None, repr=False)
    setting: Callable[[DetectorSpec, float], DetectorSpec] | None = field(default=None, repr=False)
    image_level: bool = False

    def value(self, severity: float) -> float:
        """The parameter at a severity in [0, 1]."""
        return self.nominal + severity * (self.severe - self.nominal)

    def rng(self, draw: int = 0) -> np.random.Generator:
        """The condition's own random numbers. They are the same at every severity, so that a degradation grows at the same place."""
        return np.random.default_rng([zlib.crc32(self.name.encode()), draw])


def in_family(family: str, *, image_level: bool = False) -> Callable[..., Condition]:
    """A function that makes conditions of one family. Its arguments are those of ``Condition`` without the family."""

    def make(name: str, title: str, parameter: str, unit: str, severe: float, nominal: float = 0.0, **effects: Any) -> Condition:
        return Condition(name, title, family, parameter, unit, severe, nominal, **{"image_level": image_level} | effects)

    return make


@dataclass(frozen=True)
class DegradedCase:
    """One condition, or several at the same severity."""

    conditions: tuple[Condition, ...]

    @property
    def name(self) -> str:
        """Names of the conditions, joined by '+'."""
        return "+".join(c.name for c in self.conditions)

    @property
    def title(self) -> str:
        """Titles of the conditions."""
        return " and ".join(c.title for c in self.conditions)

    @property
    def solves(self) -> bool:
        """Whether contacts must be solved again, because a condition changes the mechanics."""
        return any(c.solves for c in self.conditions)

    @property
    def in_light(self) -> bool:
        """Whether a condition acts before the camera's response, so that it can't be applied to thresholded frames."""
        return any(c.spec is not None or c.light is not None for c in self.conditions)

    @property
    def image_level(self) -> bool:
        """Whether all conditions act on frames alone."""
        return all(c.image_level for c in self.conditions)

    def label(self, severity: float) -> str:
        """The parameters' values in words."""
        return ", ".join(f"{c.value(severity):.3g} {c.unit}".strip() for c in self.conditions)

    def _through(self, stage: str, thing: T, severity: float, *more: Any, draw: int | None = None) -> T:
        """The thing after the changes at a stage, the field of `Condition` with this name. At severity 0 nothing acts.

        Each change gets the thing, its value, ``more`` and, with ``draw``, random numbers.
        """
        for c in self.conditions if severity > 0 else ():
            if (change := getattr(c, stage)) is not None:
                thing = change(thing, c.value(severity), *more, *([] if draw is None else [c.rng(draw)]))
        return thing

    def on_spec(self, spec: SensorSpec, severity: float) -> SensorSpec:
        """The degraded specification."""
        return self._through("spec", spec, severity, draw=0)

    def on_light(self, light: np.ndarray, severity: float, view: PictureView, draw: int) -> np.ndarray:
        """Degraded linear light."""
        return self._through("light", light, severity, view, draw=draw)

    def on_frame(self, image: np.ndarray, severity: float, view: PictureView, draw: int) -> np.ndarray:
        """A degraded frame."""
        return self._through("frame", image, severity, view, draw=draw)

    def on_points(self, px: np.ndarray, severity: float, view: PictureView) -> np.ndarray:
        """The places to which points (n, 2) are moved."""
        return self._through("moves", px, severity, view)

    def missing_caps(self, severity: float, view: PictureView) -> np.ndarray:
        """(N,) bool: caps that are gone."""
        gone = np.zeros(len(view.caps_px), bool)
        for c in self.conditions if severity > 0 else ():
            if c.hides is not None:
                gone |= c.hides(c.value(severity), view, c.rng())
        return gone

    def on_setting(self, detector: DetectorSpec, severity: float) -> DetectorSpec:
        """The detector with wrong settings."""
        return self._through("setting", detector, severity)


def choose_share(count: int, share: float, rng: np.random.Generator) -> np.ndarray:
    """(count,) bool: a random share of the places. A larger share with the same random numbers contains the smaller one."""
    mask = np.zeros(count, bool)
    mask[rng.permutation(count)[: round(share * count)]] = True
    return mask


def over_channels(plane: np.ndarray, light: np.ndarray) -> np.ndarray:
    """A plane (H, W) as float32 that broadcasts over light (H, W) or (H, W, 3)."""
    plane = np.asarray(plane, np.float32)
    return plane[..., None] if light.ndim == 3 else plane
