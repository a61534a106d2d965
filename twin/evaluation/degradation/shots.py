"""Degraded frames with known pins: rendered frames, or real frames in which several detectors agree on the pins.

The contacts of rendered frames are solved once and stored. All conditions that do not change the mechanics use the same contacts.
"""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from scenes import load_object
from scenes.sensor import ResponseSpec, SensorSpec
from twin.camera.capture import expose
from twin.camera.projection import CapTruth, cap_truth
from twin.errors import ContactError, TwinError
from twin.evaluation.degradation.condition import DegradedCase, PictureView
from twin.evaluation.pictures.aligned import to_light
from twin.geometry.pins import PinRest, rest_pins
from twin.mechanics.path import ContactPose
from twin.mechanics.solver import SkinSolver
from twin.optics.preview import Preview, Shading
from twin.store import cached_arrays
from twin.types import Form, Frame
from twin.types import PinState as AnyPinState


@dataclass(frozen=True)
class ObjectContact:
    """An object of `scenes`, and the pose in which the sensor is pressed against it."""

    name: str
    object_name: str
    pose: ContactPose


CONTACTS = (
    ObjectContact("none", "plane", ContactPose(0.0)),
    ObjectContact("flat", "plane", ContactPose(2.5)),
    ObjectContact("tilted", "plane", ContactPose(4.0, tilt_deg=(8.0, -5.0))),
    ObjectContact("sheared", "plane", ContactPose(3.0, shear_mm=(2.0, 1.0))),
    ObjectContact("edge", "edge", ContactPose(3.5, twist_deg=15.0)),
    ObjectContact("cylinder", "cylinder", ContactPose(3.0, offset_mm=(3.0, 2.0))),
)
"""Contacts of a sweep."""


@dataclass(frozen=True)
class DegradedFrame:
    """A degraded frame and the true places of its pins.

    Attributes
    ----------
    name : str
        Name of the contact, or of the real frame.
    frame : Frame
    caps_px : (N, 2) float
        True places of the pins.
    visible : (N,) bool
        Whether the cap exists, is within the frame, and is not hidden.
    touched : bool
        Whether there is a contact. Real frames are assumed to show one.
    """

    name: str
    frame: Frame
    caps_px: np.ndarray
    visible: np.ndarray
    touched: bool = True


@dataclass(frozen=True)
class RenderedSource:
    """Frames of contacts of a sensor, drawn by `Preview`. The places of all pins are known."""

    spec: SensorSpec
    contacts: tuple[ObjectContact, ...]

    form = Form.RAW
    """Form of the frames."""

    def __len__(self) -> int:
        return len(self.contacts)

    @property
    def rest_frame(self) -> Frame:
        """The frame without contact, not degraded."""
        return replace(self, contacts=CONTACTS[:1]).render(DegradedCase(()), 0.0)[0].frame

    def render(self, case: DegradedCase, severity: float) -> list[DegradedFrame]:
        """The frames degraded by a case. Contacts that cannot be solved are omitted."""
        spec = case.on_spec(self.spec, severity)
        view, geometry = PictureView.of(spec, np.zeros((spec.pins.count, 2))), _with_light_of(self.spec, spec)
        films = _films(spec.alter(response=self.spec.response), geometry, geometry if case.solves else self.spec, self.contacts)
        return [_expose(name, light, truth, case, severity, view, draw, touched) for draw, name, light, truth, touched in films]


@dataclass(frozen=True)
class RealSource:
    """Real frames. The places on which several detectors agree (`consensus`) count as the true places of the pins.

    Attributes
    ----------
    spec : SensorSpec
    frames : tuple of Frame
    caps_px : (M, N, 2) float
        True places; NaN for pins on which the detectors do not agree.
    rest_frame : Frame, optional
        Frame without contact.
    """

    spec: SensorSpec
    frames: tuple[Frame, ...]
    caps_px: np.ndarray
    rest_frame: Frame | None = None

    @property
    def form(self) -> Form:
        """Form of the frames."""
        return self.frames[0].form

    def __len__(self) -> int:
        return len(self.frames)

    def render(self, case: DegradedCase, severity: float) -> list[DegradedFrame]:
        """The frames degraded by a case, which must be `image_level`."""
        neutral = _neutral(self.spec)
        spec = case.on_spec(neutral, severity)
        in_light = severity > 0 and self.form == Form.RAW and case.in_light
        view, shots = PictureView.of(neutral, self.caps_px[0]), []
        for draw, (frame, caps_px) in enumerate(zip(self.frames, self.caps_px, strict=True)):
            view, image = replace(view, caps_px=caps_px, size_px=frame.image.shape[1::-1]), frame.image
            if in_light:
                light = to_light(image, neutral.response).astype(np.float32)
                image = expose(case.on_light(light, severity, view, draw), spec.capture, np.random.default_rng(draw))
            image = case.on_frame(image, severity, view, draw)
            shots.append(_degrade(frame.name, image, self.form, case, severity, view, np.isfinite(caps_px[:, 0])))
        return shots


def degraded_state(
    spec: SensorSpec, state: AnyPinState, cases: list[tuple[DegradedCase, float]], *, shading: Shading | None = None, touched: bool = True
) -> DegradedFrame:
    """One contact under several cases, each at a severity of its own; they act one after the other at every stage.

    Parameters
    ----------
    spec : SensorSpec
    state : ContactState or PinRest
        The contact of the sensor as it is.
    cases : list of (Case, float)
    shading : Shading, optional
        Of the preview that draws the frame; direct light alone by default.
    touched : bool
        Something is in contact.

    Raises
    ------
    TwinError
        A case changes the mechanics: its contacts must be solved again, with `RenderedSource`.
    """
    if solved := [case.name for case, _ in cases if case.solves]:
        raise TwinError(f"{', '.join(solved)}: changes the mechanics, so this contact would be another one; use 'twin robustness'")
    together = DegradedCase(tuple(replace(c, severe=c.value(severity)) for case, severity in cases if severity for c in case.conditions))
    degraded = together.on_spec(spec, 1.0)
    truth = cap_truth(_with_light_of(spec, degraded), rest_pins(spec.geometry), state, Form.RAW)
    light = Preview(degraded.alter(response=spec.response), shading=shading).render(state)
    return _expose("contact", light, truth, together, 1.0, PictureView.of(degraded, truth.caps_px), 0, touched)


def pins_under(spec: SensorSpec, contact: ObjectContact) -> PinRest:
    """The pins in a contact, from the cache if it was solved before.

    Raises
    ------
    ContactError
        The contact can't be solved.
    """
    if contact.pose.indent_mm <= 0:
        return rest_pins(spec.geometry)

    def solve() -> dict[str, np.ndarray]:
        state = SkinSolver(spec).press(load_object(contact.object_name), contact.pose)
        return {"base_mm": state.base_mm, "axis": state.axis, "caps_mm": state.caps_mm}

    optical = {"refractive_index", "absorption_per_mm", "haze", "haze_sigma_px"}
    key = {part: getattr(spec, part).model_dump(mode="json", exclude=optical) for part in ("skin", "gel", "lens", "pins")}
    key |= {"object": load_object(contact.object_name).model_dump(mode="json"), "pose": vars(contact.pose)}
    return PinRest(**cached_arrays("pins-under-contact", key, solve))


def _expose(
    name: str, light: np.ndarray, truth: CapTruth, case: DegradedCase, severity: float, view: PictureView, draw: int, touched: bool
) -> DegradedFrame:
    """The frame that the camera of a view makes of undegraded light; ``draw`` is the seed of its random numbers."""
    view = replace(view, caps_px=truth.caps_px)
    light = case.on_light(light, severity, view, draw)
    image = case.on_frame(expose(light, view.spec.capture, np.random.default_rng(draw)), severity, view, draw)
    return replace(_degrade(name, image, Form.RAW, case, severity, view, truth.visible), touched=touched)


def _degrade(
    name: str, image: np.ndarray, form: Form, case: DegradedCase, severity: float, view: PictureView, visible: np.ndarray
) -> DegradedFrame:
    """A degraded image with its pins where the case leaves them."""
    caps_px, gone = case.on_points(view.caps_px, severity, view), case.missing_caps(severity, view)
    inside = np.all((caps_px >= 0) & (caps_px <= np.array(image.shape[1::-1]) - 1), axis=1)
    return DegradedFrame(name, Frame(image, form, name), caps_px, visible & inside & ~gone)


def _neutral(spec: SensorSpec) -> SensorSpec:
    """A specification whose camera adds no blur, colour or noise. It is used for real frames, which a camera has already taken."""
    curve = {name: getattr(spec.response, name) for name in ("gamma", "black_level", "sharpening_sigma_px", "noise_sigma_px")}
    response = ResponseSpec(**curve, blur_sigma_px=0.0, read_noise=0.0, shot_noise=0.0)
    fringes = {"red_scale": 1.0, "blue_scale": 1.0, "red_shift_px": (0.0, 0.0), "blue_shift_px": (0.0, 0.0)}
    return spec.alter(response=response, camera={"vignetting": 0.0} | fringes, gel={"haze": 0.0})


def _with_light_of(base: SensorSpec, spec: SensorSpec) -> SensorSpec:
    """``spec`` with the values of ``base`` that do not affect the pins' places. Under most conditions the result equals ``base``."""
    gel = {name: getattr(base.gel, name) for name in ("haze", "haze_sigma_px", "absorption_per_mm")}
    alike = spec.alter(gel=gel, camera={"vignetting": base.camera.vignetting})
    return alike.alter(**{name: getattr(base, name) for name in ("leds", "housing", "appearance", "response")})


@lru_cache(maxsize=2)
def _films(
    spec: SensorSpec, geometry: SensorSpec, mechanics: SensorSpec, contacts: tuple[ObjectContact, ...]
) -> tuple[tuple[int, str, np.ndarray, CapTruth, bool], ...]:
    """Contacts of the sensor ``mechanics``, projected by the camera of ``geometry``, with the lights of ``spec``.

    All conditions that act after the film use the same ones. Contacts that cannot be solved are omitted. Of each: the seed of its random
    numbers, its name, its linear light before the camera's response, its true pins, and whether anything is touched.
    """
    preview, films = Preview(spec), []
    for draw, contact in enumerate(contacts):
        try:
            state = pins_under(mechanics, contact)
        except ContactError:
            continue
        truth = cap_truth(geometry, rest_pins(geometry.geometry), state, Form.RAW)
        light = preview.render(state)
        light.flags.writeable = False  # the array is shared by all conditions
        films.append((draw, contact.name, light, truth, contact.pose.indent_mm > 0))
    return tuple(films)
