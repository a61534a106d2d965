"""Real frames changed as cameras, cables and hands change them, given to the shipped weights.

Confidently wrong is a valid estimate of which a label lies farther outside its 90 % interval than the interval is wide. An interval wider
than a third of the labels' range counts as refused.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from training.data.label_code import label_error
from training.data.targets import choose_targets
from training.estimate.contact_estimator import ContactEstimator, contacts_folder
from training.estimate.estimator import PoseEstimator
from training.estimate.rest import MOST_CONTACTS
from twin.errors import TwinError
from twin.frames import evenly_read, open_recording
from twin.rig.labels import label_slope
from twin.types import Frame

FRAMES, SEED = 30, 3
GIVEN, CONTACTS = "a frame at rest", "contacts"
CASES = {  # weights, recording, kind of contact, where the pins at rest are known from
    "331": ("mg400-331", "tac-vgnn-331", "", GIVEN),
    "331, no frame at rest": ("mg400-331", "tac-vgnn-331", "", CONTACTS),
    "127": ("mg400-127", "tac-vgnn-127", "", GIVEN),
    "127, no frame at rest": ("mg400-127", "tac-vgnn-127", "", CONTACTS),
    "raw": ("ur5-331", "ur5-331-raw", "", CONTACTS),
    "plate": ("ur5-331", "ur5-331-surface-3d-tap", "plate", CONTACTS),
    "plate, shear": ("ur5-331", "ur5-331-surface-3d-shear", "plate-sheared", CONTACTS),
    "edge": ("ur5-331", "ur5-331-edge-2d-tap", "edge", CONTACTS),
    "edge, shear": ("ur5-331", "ur5-331-edge-2d-shear", "edge-sheared", CONTACTS),
}
Change = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Changed:
    """A change of a recording: of its frames, and of its frame at rest (None: the same)."""

    frames: Change
    rest: Change | None = None
    small: bool = False


def same(image: np.ndarray) -> np.ndarray:
    return image


def warped(image: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """The picture moved by a map (2, 3) or (3, 3) of its pixels, about its middle; beyond the border it is as dark as its corners."""
    height, width = image.shape[:2]
    middle = np.array([[1, 0, (width - 1) / 2], [0, 1, (height - 1) / 2], [0, 0, 1.0]])
    whole = middle @ np.vstack([matrix, [0, 0, 1]])[:3] @ np.linalg.inv(middle)
    return cv2.warpPerspective(image, whole, (width, height), flags=cv2.INTER_LINEAR)


def moved(x: float = 0, y: float = 0, turn_deg: float = 0, zoom: float = 1, stretch: float = 1, skew: float = 0) -> Change:
    c, s = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    linear = zoom * np.array([[c, -s], [s, c]]) @ np.array([[stretch, skew], [0, 1]])
    return lambda image: warped(image, np.column_stack([linear, [x, y]]))


def keystone(tilt: float) -> Change:
    def change(image: np.ndarray) -> np.ndarray:
        return warped(image, np.array([[1, 0, 0], [0, 1, 0], [tilt / image.shape[1], 0, 1.0]]))

    return change


def barrel(strength: float) -> Change:
    def change(image: np.ndarray) -> np.ndarray:
        height, width = image.shape[:2]
        y, x = np.mgrid[:height, :width].astype(np.float32)
        u, v = (x - (width - 1) / 2) / (height / 2), (y - (height - 1) / 2) / (height / 2)
        k = 1 + strength * (u * u + v * v)
        return cv2.remap(image, x + (k - 1) * u * height / 2, y + (k - 1) * v * height / 2, cv2.INTER_LINEAR)

    return change


def rolled(x: int = 0, y: int = 0) -> Change:
    return lambda image: np.roll(image, (y, x), (0, 1))


def torn(x: int, at: float = 0.5) -> Change:
    def change(image: np.ndarray) -> np.ndarray:
        image = image.copy()
        row = int(at * len(image))
        image[row:] = np.roll(image[row:], x, 1)
        return image

    return change


def mixed(other: np.ndarray, at: float = 0.5) -> Change:
    def change(image: np.ndarray) -> np.ndarray:
        row = int(at * len(image))
        return np.concatenate([image[:row], other[row:]])

    return change


def hole(x: float, y: float, radius: float) -> Change:
    def change(image: np.ndarray) -> np.ndarray:
        image, (h, w) = image.copy(), image.shape[:2]
        dark = np.percentile(image, 5, axis=(0, 1))
        cv2.circle(image, (int(x * w), int(y * h)), int(radius * min(h, w)), np.atleast_1d(dark).tolist(), -1)
        return image

    return change


def brighter(factor: float) -> Change:
    return lambda image: np.clip(image * factor, 0, 255).round().astype(np.uint8)


def mirrored(image: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(image[:, ::-1])


def flipped(image: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(image[::-1])


def changes(other: np.ndarray) -> dict[str, Changed]:
    """All changes by name; ``other`` is another frame of the recording."""
    both = lambda change, small=False: Changed(change, change, small)  # noqa: E731
    return {
        "none": Changed(same, same, True),
        "view 2 px": both(moved(x=1.6, y=-1.2), True),
        "view 1 deg": both(moved(turn_deg=1), True),
        "view 1 %": both(moved(zoom=1.01), True),
        "brighter 10 %": both(brighter(1.1), True),
        "darker 10 %": both(brighter(0.9), True),
        "brighter 5 %": both(brighter(1.05), True),
        "rolled 3": Changed(rolled(3)),
        "rolled 9": Changed(rolled(9)),
        "rolled 37": Changed(rolled(37)),
        "rolled y 13": Changed(rolled(y=13)),
        "torn 4": Changed(torn(4)),
        "torn 15": Changed(torn(15)),
        "torn 40 at .7": Changed(torn(40, 0.7)),
        "two frames": Changed(mixed(other)),
        "frame 4 px": Changed(moved(x=4)),
        "frame 2 deg": Changed(moved(turn_deg=2)),
        "frame 3 %": Changed(moved(zoom=1.03)),
        "frame 5 deg": Changed(moved(turn_deg=5)),
        "turned 5": both(moved(turn_deg=5)),
        "turned 37": both(moved(turn_deg=37)),
        "turned 60": both(moved(turn_deg=60)),
        "turned 90": both(moved(turn_deg=90)),
        "turned 180": both(moved(turn_deg=180)),
        "mirrored": both(mirrored),
        "flipped": both(flipped),
        "mirrored frame": Changed(mirrored),
        "turned frame 180": Changed(moved(turn_deg=180)),
        "stretched 8 %": both(moved(stretch=1.08)),
        "stretched 3 %": both(moved(stretch=1.03)),
        "stretched frame 3 %": Changed(moved(stretch=1.03)),
        "zoomed 10 %": both(moved(zoom=1.1)),
        "zoomed .9": both(moved(zoom=0.9)),
        "zoomed frame 10 %": Changed(moved(zoom=1.1)),
        "skewed 5 %": both(moved(skew=0.05)),
        "skewed frame 2 %": Changed(moved(skew=0.02)),
        "keystone": Changed(keystone(0.05)),
        "barrel": Changed(barrel(0.03)),
        "hole": Changed(hole(0.4, 0.55, 0.1)),
        "hole rim": Changed(hole(0.25, 0.4, 0.1)),
        "large hole": Changed(hole(0.6, 0.45, 0.16)),
    }


@dataclass
class Counts:
    """Frames of one change that were estimated, refused, and estimated confidently wrong."""

    valid: int = 0
    refused: int = 0
    wrong: int = 0

    @property
    def right(self) -> int:
        return self.valid - self.wrong


def count(estimate, frames, truth, span, change) -> Counts:
    found = Counts()
    for frame, labels in zip(frames, truth, strict=True):
        made = estimate(altered(frame, change))
        width = made.high - made.low
        if not made.valid or (width > span / 3).any():
            found.refused += 1
            continue
        outside = np.abs(label_error((made.low + made.high) / 2, labels, made.units)) - width / 2
        found.valid += 1
        found.wrong += bool((outside > width).any())
    return found


def altered(frame: Frame, change: Change | None) -> Frame:
    return frame if change is None else Frame(np.ascontiguousarray(change(frame.image)), frame.form, name=frame.name)


def count_changes(case: str, real: Path) -> Iterator[tuple[str, Changed, Counts]]:
    """Each change of a case in turn, and what came of its frames; ``real`` is the folder of the recordings."""
    weights, folder, kind, rest = CASES[case]
    models = ContactEstimator.load(contacts_folder(weights)) if kind else PoseEstimator.load(weights)
    part = models.parts[kind] if isinstance(models, ContactEstimator) else models
    recording = open_recording(real / folder, models.sensor, models.form)
    rows = np.sort(np.random.default_rng(SEED).choice(len(recording), min(FRAMES, len(recording)), replace=False))
    slope = label_slope(models.sensor.rig) if folder.startswith("tac-vgnn") else 0.0
    labels = choose_targets(recording, part.names, np.arange(len(recording)), slope, []).corrected
    frames = [recording.read(int(row)) for row in rows]
    contacts = evenly_read(recording, MOST_CONTACTS) if rest == CONTACTS else []
    for name, change in changes(recording.read(len(recording) // 2 + 3).image).items():
        try:
            if rest == GIVEN:
                estimate = models.at_rest(altered(recording.reference, change.rest))
            else:
                estimate, _ = models.at_rest_of([altered(frame, change.rest) for frame in contacts])
            found = count(estimate, frames, labels[rows], np.ptp(labels, axis=0), change.frames)
        except TwinError as error:
            found = Counts(refused=len(rows))
            print(f"{case}: {name}: the pins at rest are refused: {error}")
        print(f"{case}: {name}: {found.valid} valid, {found.refused} refused, {found.wrong} confidently wrong of {len(rows)}")
        yield name, change, found
