"""Changes of pictures as cameras, cables and hands make them: what each does to the frames of a recording, and to its frame at rest."""

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

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
