"""The camera's turn and mirror, from a frame at rest and contacts that push or twist the pins to known sides.

A symmetric layout is seen alike under all its turns and mirror images. The motion of the pins decides: an object that is moved to the
sensor's +x drags them along the image of +x, and one that is turned from x to y turns them likewise, unless the picture is mirrored.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.distance import cosine

from scenes.sensor import SensorSpec
from twin.calibration.sensor_file import write_sensor
from twin.camera.projection import cross_plane, project
from twin.errors import FrameError
from twin.evaluation.pictures.aligned import with_changes
from twin.frames import open_recording
from twin.frames.forms import from_raw, gray_levels
from twin.geometry.pins import rest_pins
from twin.pins.labelling.identify import SHOWN, score_layout
from twin.pins.labelling.reference import PinView, camera_modes, make_reference, project_rest, views_of
from twin.pins.labelling.rest import require_even
from twin.pins.pipeline import Pipeline
from twin.types import Form, Frame

SIDES = {"x": (1.0, 0.0), "-x": (-1.0, 0.0), "y": (0.0, 1.0), "-y": (0.0, -1.0)}
"""Direction of a push in the sensor frame, by its name."""
MOST_OFF_DEG = 25.0
"""Largest angle between a push and the pins' mean motion. Views of a hexagon are 60 deg apart."""
LEAST_MOVED = 0.05
"""Least mean motion of the pins by a push, in spacings; by a twist, at the rim."""


def registered_view(
    spec: SensorSpec, rest: Frame, pushes: Mapping[str, Frame], *, twist: Frame | None = None, out: Path | None = None
) -> tuple[SensorSpec, PinView]:
    """A copy of a specification with the turn, mirror, size and place of its camera's picture, and with its pins at rest.

    Parameters
    ----------
    rest : Frame
        A frame without contact.
    pushes : dict of str to Frame
        Frames of contacts in which the object was moved to a side of the sensor, by its name in ``SIDES``.
    twist : Frame, optional
        A contact in which the object was turned about the sensor's axis from x towards y (``--twist-deg`` above 0).
    out : Path, optional
        The ``.toml`` file to write.

    Returns
    -------
    SensorSpec
    View
        The view against the given specification.

    Raises
    ------
    FrameError
        A frame does not show the sensor, the pushes hardly move the pins or fit no view, or they do not decide about a mirror.
    """
    axes = {side.removeprefix("-") for side in pushes}
    if unknown := set(pushes) - set(SIDES):
        raise FrameError(f"`push` {min(unknown)}: must be {', '.join(SIDES)}, as x:FRAME")
    if not axes or (len(axes) < 2 and twist is None):
        raise FrameError(
            "turn and mirror need two pushes, or one and a twist: `push` x:FRAME `push` y:FRAME, or `push` x:FRAME `twist` FRAME"
        )
    form = rest.form
    shown = score_layout(spec.pins, [gray_levels(rest.image)])
    if shown is None or shown.explained < SHOWN:
        raise FrameError(f"{rest.name}: does not show {spec.pins.in_words()}; give a frame without contact of this sensor")
    require_even(spec.pins, shown.seen[0].pins_px, rest.name)
    rest_px = np.where(np.isfinite(shown.seen[0].pins_px), shown.seen[0].pins_px, shown.seen[0].places_px)
    nominal = make_reference(project_rest(spec, form), spec.pins)
    pipeline = Pipeline(_with_mask(spec, form, rest_px), form, make_reference(rest_px, spec.pins))
    views = views_of(rest_px, nominal, spec.pins, camera_modes(spec, form))
    x, y = _image_axes(spec, form)
    fit = np.zeros(len(views))
    for side, frame in pushes.items():
        moved = np.nanmean(_pin_motions(pipeline, frame), axis=0)
        if np.linalg.norm(moved) < LEAST_MOVED * nominal.spacing_px.mean():
            raise FrameError(f"{frame.name}: the push {side} hardly moves the pins; press firmly, then move the object by 2 mm or more")
        along = SIDES[side][0] * x + SIDES[side][1] * y
        fit += [-cosine(view.matrix @ along, moved) for view in views]
    if twist is not None:
        away, moved = rest_px - rest_px.mean(axis=0), _pin_motions(pipeline, twist)
        turned = float(np.nansum(cross_plane(away, moved)) / np.sum(away**2))
        if abs(turned) * np.linalg.norm(away, axis=1).max() < LEAST_MOVED * nominal.spacing_px.mean():
            raise FrameError(f"{twist.name}: the twist hardly turns the pins; press firmly, then turn the object by 5 deg or more")
        fit += [np.sign(turned * cross_plane(x, y) * np.linalg.det(view.matrix)) - 1 for view in views]
    best = int(np.argmax(fit))
    if fit[best] < len(pushes) * (np.cos(np.radians(MOST_OFF_DEG)) - 1):
        raise FrameError(f"the pushes {', '.join(pushes)} fit no view of {spec.pins.in_words()}: check their sides")
    made = _with_view(spec, form, views[best], np.vstack([rest_px, [np.nan, np.nan]])[views[best].order])
    if out is not None:
        write_sensor(out, made, f"{spec.description or spec.name}: with the camera's view by 'twin check' from {rest.name}")
    return made, views[best]


def register_files(
    spec: SensorSpec, rest: Path, pushes: Sequence[str], *, twist: Path | None = None, form: Form | None = None, out: Path | None = None
) -> tuple[SensorSpec, PinView]:
    """As ``registered_view``, from pictures; ``pushes`` are texts such as ``x:FRAME``."""
    form = form or open_recording(rest, spec).form

    def frame(path: str | Path) -> Frame:
        return open_recording(path, spec, form).read(0)

    pushed = {side: frame(path) for side, _, path in (text.partition(":") for text in pushes)}
    return registered_view(spec, frame(rest), pushed, twist=None if twist is None else frame(twist), out=out)


def _pin_motions(pipeline: Pipeline, frame: Frame) -> np.ndarray:
    """Motions (N, 2), px, of the pins from rest; NaN where lost."""
    seen = pipeline(frame)
    if not seen.valid:
        raise FrameError(f"{frame.name}: {seen.reason}; give another frame of this contact")
    return seen.pins_px - pipeline.reference.pins_px


def _image_axes(spec: SensorSpec, form: Form) -> np.ndarray:
    """Mean motions (2, 2), px, in the picture of the pins at rest by 1 mm along the sensor's x, and along its y."""
    caps_mm = rest_pins(spec.geometry).caps_mm
    at = [
        from_raw(spec.recording, form, project(spec.view, caps_mm + step)).mean(axis=0) for step in np.vstack([np.zeros(3), np.eye(3)[:2]])
    ]
    return np.array(at[1:]) - at[0]


def _with_mask(spec: SensorSpec, form: Form, rest_px: np.ndarray) -> SensorSpec:
    """The specification with its mask around pins at rest (N, 2)."""
    blob = getattr(spec.pipeline, form)
    shift = rest_px.mean(axis=0) - project_rest(spec, form).mean(axis=0)
    center = tuple((np.array(blob.mask_center_px) + shift).tolist())
    return spec.alter(pipeline={str(form): blob.alter(mask_center_px=center)})


def _with_view(spec: SensorSpec, form: Form, view: PinView, rest_px: np.ndarray) -> SensorSpec:
    """The specification whose camera has this view, with measured pins at rest (N, 2); NaN are where the camera sees them."""
    old = spec.camera
    turn_deg = view.turn_deg + (-old.turn_deg if view.mirrored else old.turn_deg)
    camera = {"turn_deg": round((turn_deg + 180) % 360 - 180, 3), "mirrored": old.mirrored != view.mirrored}
    camera |= {key: getattr(old, key) * view.scale for key in ("fx_px", "fy_px")}
    turned = with_changes(spec, camera=camera)
    known = np.isfinite(rest_px[:, 0])
    unit_px = from_raw(spec.recording, form, np.eye(2)) - from_raw(spec.recording, form, np.zeros((1, 2)))
    shift = (rest_px - project_rest(turned, form))[known].mean(axis=0) / np.diag(unit_px)
    turned = with_changes(turned, camera={"cx_px": old.cx_px + float(shift[0]), "cy_px": old.cy_px + float(shift[1])})
    places = np.where(known[:, None], rest_px, project_rest(turned, form)).round(2)
    blob = getattr(_with_mask(spec, form, rest_px[known]).pipeline, form).model_dump()
    blob |= {"rest_px": tuple(map(tuple, places.tolist())), "rest_origin": "measured"}
    return with_changes(turned, pipeline={str(form): blob})
