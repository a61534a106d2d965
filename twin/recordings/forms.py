"""Which form of a sensor's frames is at hand."""

from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from scenes.sensor import SensorSpec
from twin.errors import FrameError
from twin.recordings.images import bits_used, decode, to_eight_bits
from twin.types import Form

TWO_LEVEL_FRACTION = 0.9  # of the pixels black or white: a thresholded recording (a resized one has grays at its edges)
VOTES = 25  # frames that decide on a recording's size and form


@dataclass(frozen=True)
class Kind:
    """What the frames of a recording have in common: form, (width, height), bits in use in 16-bit files (0: 8-bit files)."""

    form: Form
    size_px: tuple
    bits: int = 0


def times(size_px: tuple) -> str:
    """A size as people write it."""
    return f"{size_px[0]}x{size_px[1]}"


def is_two_level(image: np.ndarray) -> bool:
    """Whether a picture was thresholded at capture: nearly all of it black or white, and both occur."""
    low, high = float(np.mean(image < 16)), float(np.mean(image > 239))
    return low + high > TWO_LEVEL_FRACTION and min(low, high) > 0.005


def _form_sizes(spec: SensorSpec) -> dict:
    sizes = {Form.RAW: (spec.camera.width_px, spec.camera.height_px)}
    if spec.recording:
        sizes[Form.RECORDING] = (spec.recording.width_px, spec.recording.height_px)
    return sizes


def tell_form(spec: SensorSpec, image: np.ndarray) -> Form:
    """Form of a sensor's frame, by its size and, where that doesn't decide, its content.

    Raises
    ------
    FrameError
        It has neither form's size.
    """
    size, sizes = image.shape[1::-1], _form_sizes(spec)
    fitting = [form for form, expected in sizes.items() if expected == size]
    if not fitting:
        expected = " or ".join(f"{times(expected)} ({form})" for form, expected in sizes.items())
        raise FrameError(f"expected {expected} for {spec.name}, got {times(size)}; use the matching --sensor or the unresized frame")
    if len(fitting) == 1:
        return fitting[0]
    return Form.RECORDING if is_two_level(image) else Form.RAW


def form_of(image: np.ndarray, name: str, spec: SensorSpec | None, form: Form | None) -> Form:
    """Form of a frame: the given one where its size allows, else told by size and content.

    Raises
    ------
    FrameError
        Its size isn't one of the sensor's, or not the given form's.
    """
    if form is not None:
        form = Form(form)
    if spec is None:
        return form or (Form.RECORDING if is_two_level(image) else Form.RAW)
    try:
        told = tell_form(spec, image)
    except FrameError as error:
        raise FrameError(f"{name}: {error}") from None
    if form is None:
        return told
    expected = _form_sizes(spec).get(form)
    if expected is None:
        raise FrameError(f"{name}: sensor {spec.name} has no {form} form (no [{form}] section); leave out --form")
    if expected != image.shape[1::-1]:
        raise FrameError(f"{name}: expected {times(expected)} ({form}) for {spec.name}, got {times(image.shape[1::-1])}; leave out --form")
    return form


def common_kind(files: list[Path], spec: SensorSpec | None, form: Form | None) -> Kind:
    """Kind of most of a recording's frames, by up to ``VOTES`` usable ones spread over it; on a tie that of the first.

    Raises
    ------
    FrameError
        No frame is usable.
    """
    spread = dict.fromkeys(np.linspace(0, len(files) - 1, min(VOTES, len(files))).astype(int).tolist())
    votes, reasons = {}, {}
    for k in [*spread, *(k for k in range(len(files)) if k not in spread)]:
        try:
            stored = decode(files[k])
            votes[k] = Kind(form_of(to_eight_bits(stored)[0], files[k].name, spec, form), stored.shape[1::-1], bits_used(stored))
        except FrameError as error:
            reasons[k] = str(error)
        if len(votes) == VOTES:
            break
    if not votes:
        raise FrameError(f"no usable frame among {len(files)}; the first: {reasons[0]}")
    kinds = [votes[k] for k in sorted(votes)]
    size = _most([kind.size_px for kind in kinds])
    kinds = [kind for kind in kinds if kind.size_px == size]
    return Kind(_most([kind.form for kind in kinds]), size, max(kind.bits for kind in kinds))


def _most(things: list):
    return Counter(things).most_common(1)[0][0]  # equal counts come in the order they were first met
