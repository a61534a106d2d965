"""Positions of the pins at rest, from a no-contact frame or estimated from many contact frames."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from scenes.pins import PinsSpec
from twin.errors import FrameError
from twin.geometry.pins import pin_lattice
from twin.pins.labelling.identify import SHOWN, Candidate, order_like, score_layout, symmetries, unevenness
from twin.pins.labelling.reference import MOST_UNEVEN, mean_radius, uneven_dent

STILL = 0.035
"""Largest rms distance of pins without contact from the smooth view of their layout, in spacings. It was measured as 0.028 in no-contact
frames of two sensors, and as at least 0.042 in contacts of 1 mm and more."""
INNER = 0.5
"""Radius of the inner pins, as a share of the layout's radius. A contact spreads the inner pins, while the rim hardly moves."""
FEWEST_CONTACTS = 8
"""Least number of contact frames, and of pins at the rim, from which the places at rest are estimated. With fewer they are the median."""
CIRCLES = 6
"""Decimals of the radius by which pins belong to one circle around the middle."""
MIDDLE, OUTER = 0.3, 0.86
"""Radii, as shares of the layout's, between which circles of pins state how far the view draws the pins in. Nearer to the middle a radius
is uncertain, nearer to the rim the draw hardly moves it."""
LEAST_OUT, HARDLY_MOVED = 0.1, 0.85
"""Quantile of the radii at which a circle's pins are seen that is near their radius at rest, and quantile of the circles' draws that is
near the layout's. Both were chosen for the smallest error over seven sets of contacts of four sensors with known places at rest."""
DRAWS = 10
"""Rounds in which the view of the rim and the draw are fitted in turn."""


@dataclass(frozen=True)
class Rest:
    """Positions of the pins at rest, and their source.

    Attributes
    ----------
    pins_px : (N, 2) float
        NaN where a pin is not in view.
    source : {"given", "found", "made"}
        "given": from a frame that the user gave or named as the no-contact frame. "found": from a frame in which no contact is visible,
        although it is not named as such. "made": estimated from contact frames.
    frame : str
        Name of the frame; "" for "made".
    """

    pins_px: np.ndarray
    source: Literal["given", "found", "made"]
    frame: str = ""

    def line(self) -> str:
        """The source in words."""
        if self.source == "given":
            return f"no contact: {self.frame}"
        if self.source == "found":
            return f"no contact: no frame is named as such; {self.frame} shows no contact as far as its pins show"
        return (
            "no contact: no frame shows it. The pins' rest places were made from contacts; expect errors of a tenth of a spacing or so. "
            "Record one frame without contact and give it with `no_contact`"
        )


def rest_of(layout: Candidate, names: list[str], given: np.ndarray | None = None, given_name: str = "") -> Rest:
    """Pins at rest of a layout that was identified in frames ``names``; ``given`` is a gray no-contact frame (H, W) uint8.

    Raises
    ------
    FrameError
        The given frame does not show the layout, or shows a contact.
    """
    if given is not None:
        shown = score_layout(layout.pins, [given])
        if shown is None or shown.explained < SHOWN:
            raise FrameError(
                f"{given_name}: no use as no-contact frame, it does not show {layout.pins.in_words()} as the other frames do; "
                "give another one"
            )
        require_even(layout.pins, shown.seen[0].pins_px, given_name)
        seen_px = shown.seen[0].pins_px
        return Rest(seen_px[order_like(symmetries(layout.pins), seen_px, layout.rest_px)], "given", given_name)
    places = pin_lattice(layout.pins).places
    even = [k for k, one in enumerate(layout.seen) if one.explained >= SHOWN and unevenness(places, one.pins_px) < STILL]
    if even:
        still = min(even, key=lambda k: spread_of(layout.pins, layout.seen[k].pins_px))
        return Rest(layout.seen[still].pins_px, "found", names[still])
    return Rest(rest_from_contacts(layout), "made")


def require_even(pins: PinsSpec, pins_px: np.ndarray, name: str) -> None:
    """Refuse pins (N, 2), NaN where lost, of a no-contact frame ``name`` if they are dented from every smooth view of their layout.

    Raises
    ------
    FrameError
    """
    if (dent := uneven_dent(pins, pins_px)) > MOST_UNEVEN:
        raise FrameError(
            f"{name}: the sensor seems pressed: neighbouring pins are dented by {dent:.2f} of their spacing from a smooth view of "
            f"{pins.in_words()} (allowed {MOST_UNEVEN:.2f}); give a frame that was taken without contact, or none"
        )


def rest_from_contacts(layout: Candidate) -> np.ndarray:
    """Pins at rest (N, 2), px, estimated from contact frames; NaN for a pin that is never seen.

    By its symmetry a layout at rest is an affine map of its places p, drawn in towards the middle by the dome and the lens:
    p (1 - a (1 - |p|^3)). The map is that of the rim in the frames with the least spread, because the rim is clamped. A contact moves pins
    outwards, and some more than others, so a circle of pins is at rest near the smallest radii at which its pins are seen; the draw a is
    that of the circles that are hardly moved. With fewer frames than ``FEWEST_CONTACTS`` the result is the pins' median.
    """
    pins_px = np.stack([seen.pins_px for seen in layout.seen])
    ever = np.isfinite(pins_px[:, :, 0]).any(axis=0)
    median = np.full(pins_px.shape[1:], np.nan)
    median[ever] = np.nanmedian(pins_px[:, ever], axis=0)
    good = pins_px[[seen.explained >= SHOWN for seen in layout.seen]]
    lattice = pin_lattice(layout.pins)
    places = lattice.places / np.linalg.norm(lattice.places, axis=1).max()
    rim = lattice.outmost[ever[lattice.outmost]]
    if len(good) < FEWEST_CONTACTS or len(rim) < FEWEST_CONTACTS:
        return median
    filled = np.where(np.isfinite(good), good, median)
    stillest = np.argsort([spread_of(layout.pins, frame) for frame in filled])[: max(len(good) // 4, FEWEST_CONTACTS)]
    rim_px = np.median(filled[stillest][:, rim], axis=0)
    radius = np.linalg.norm(places, axis=1)
    circle = radius.round(CIRCLES)
    circles = [np.flatnonzero((circle == one) & ever) for one in np.unique(circle[(circle > MIDDLE) & (circle < OUTER)])]
    drawn, view, seen_places = 0.0, np.zeros((3, 2)), places
    for _ in range(DRAWS):
        seen_places = places * (1 - drawn * (1 - radius**3))[:, None]
        view = np.linalg.lstsq(np.column_stack([np.ones(len(rim)), seen_places[rim]]), rim_px, rcond=None)[0]
        out = ((good - view[0]) @ np.linalg.inv(view[1:]) * places).sum(axis=2) / np.maximum(radius, 1e-9) ** 2
        draws = [
            (1 - np.nanquantile(out[:, one], LEAST_OUT)) / (1 - radius[one[0]] ** 3) for one in circles if np.isfinite(out[:, one]).any()
        ]
        drawn = float(np.quantile(draws, HARDLY_MOVED)) if draws else 0.0
    return np.where(ever[:, None], view[0] + seen_places @ view[1:], np.nan)


def spread_of(pins: PinsSpec, pins_px: np.ndarray) -> float:
    """Mean distance of the inner pins from their mean, divided by that of the rim, of pins (N, 2), NaN where lost. Contacts increase it."""
    lattice, known = pin_lattice(pins), np.isfinite(pins_px[:, 0])
    inner = known & (np.linalg.norm(lattice.places, axis=1) < INNER)
    rim = lattice.outmost[known[lattice.outmost]]
    return mean_radius(pins_px[inner]) / mean_radius(pins_px[rim]) if inner.any() and len(rim) else np.inf


def turn_of(pins: PinsSpec, pins_px: np.ndarray) -> float:
    """Angle, deg, from x towards y, by which the layout must be turned to fit pins (N, 2); NaN pins are left out."""
    known = np.isfinite(pins_px[:, 0])
    places, seen = pin_lattice(pins).places[known] @ [1, 1j], pins_px[known] @ [1, 1j]
    return float(np.degrees(np.angle(np.vdot(places - places.mean(), seen - seen.mean()))))
