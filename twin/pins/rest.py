"""Positions of the pins at rest, from a no-contact frame or extrapolated from many contact frames."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from scenes.pins import PinsSpec
from twin.errors import FrameError
from twin.geometry.pins import pin_lattice
from twin.pins.identify import SHOWN, Candidate, judge_layout, symmetries, unevenness
from twin.pins.view import MOST_UNEVEN, uneven_dent

STILL = 0.035
"""Largest rms distance of pins without contact from the smooth view of their layout, in spacings. It was measured as 0.028 in no-contact
frames of two sensors, and as at least 0.042 in contacts of 1 mm and more."""
INNER = 0.5
"""Radius of the inner pins, as a share of the layout's radius. A contact spreads the inner pins, while the rim hardly moves."""
FEWEST_CONTACTS = 8
"""Least number of contact frames from which the rest layout is extrapolated. With fewer frames it is their median."""


@dataclass(frozen=True)
class Rest:
    """Positions of the pins at rest, and their source.

    Attributes
    ----------
    pins_px : (N, 2) float
        NaN where a pin is not in view.
    source : {"given", "found", "made"}
        "given": from a frame that the user gave or named as the no-contact frame. "found": from a frame in which no contact is visible,
        although it is not named as such. "made": extrapolated from contact frames.
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
            return f"no contact: no frame is named as such; {self.frame} shows no contact as far as its pins tell"
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
        shown = judge_layout(layout.pins, [given])
        if shown is None or shown.explained < SHOWN:
            raise FrameError(
                f"{given_name}: no use as no-contact frame, it does not show {layout.pins.in_words()} as the other frames do; "
                "give another one"
            )
        require_even(layout.pins, shown.seen[0].pins_px, given_name)
        return Rest(_alike(layout, shown.seen[0].pins_px), "given", given_name)
    places = pin_lattice(layout.pins).places
    good = [k for k, seen in enumerate(layout.seen) if seen.explained >= SHOWN]
    if good:
        still = min(good, key=lambda k: unevenness(places, layout.seen[k].pins_px))
        if unevenness(places, layout.seen[still].pins_px) < STILL:
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
    """Pins at rest (N, 2), px, extrapolated from contact frames; NaN for a pin that is never seen.

    A contact flattens the dome. This spreads the inner pins and hardly moves the rim. The spread is the mean distance of the inner pins
    from their mean, divided by that of the rim. A linear regression gives each pin's position as a function of the spread. The result is
    its value at the smallest spread of all frames.
    """
    pins_px = np.stack([seen.pins_px for seen in layout.seen])
    with np.errstate(invalid="ignore"):
        known = np.isfinite(pins_px[:, :, 0])
        median = np.full(pins_px.shape[1:], np.nan)
        median[known.any(axis=0)] = np.nanmedian(pins_px[:, known.any(axis=0)], axis=0)
    good = np.array([seen.explained >= SHOWN for seen in layout.seen])
    if good.sum() < FEWEST_CONTACTS:
        return median
    filled = np.where(known[..., None], pins_px, median)[good]
    lattice = pin_lattice(layout.pins)
    inner = (np.linalg.norm(lattice.places, axis=1) < INNER) & np.isfinite(median[:, 0])
    rim = lattice.outmost[np.isfinite(median[lattice.outmost, 0])]
    spread = np.array([_radius(frame[inner]) / _radius(frame[rim]) for frame in filled])
    shape = filled.reshape(len(filled), -1)
    away = spread - spread.mean()
    slope = away @ (shape - shape.mean(axis=0)) / max(float(away @ away), 1e-12)
    return (shape.mean(axis=0) + (spread.min() - spread.mean()) * slope).reshape(-1, 2)


def _radius(px: np.ndarray) -> float:
    """Mean distance of points (n, 2) from their mean."""
    return float(np.linalg.norm(px - px.mean(axis=0), axis=1).mean())


def _alike(layout: Candidate, pins_px: np.ndarray) -> np.ndarray:
    """Pins (N, 2) of another frame, in the order that fits the layout's pins at rest best. All symmetries of the layout are tried."""
    orders: list[np.ndarray] = symmetries(layout.pins)
    away = [float(np.nanmedian(np.linalg.norm(pins_px[order] - layout.rest_px, axis=1))) for order in orders]
    return pins_px[orders[int(np.argmin(away))]]


def turn_of(pins: PinsSpec, pins_px: np.ndarray) -> float:
    """Angle, deg, from x towards y, by which the layout must be turned to fit pins (N, 2); NaN pins are left out."""
    known = np.isfinite(pins_px[:, 0])
    places, seen = pin_lattice(pins).places[known] @ [1, 1j], pins_px[known] @ [1, 1j]
    return float(np.degrees(np.angle(np.vdot(places - places.mean(), seen - seen.mean()))))
