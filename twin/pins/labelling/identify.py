"""Identification of the pin layout of an unknown sensor from its frames alone.

Each family of layouts (rings, hexagon, grid) labels the pin-like spots of each frame by its lattice (`twin.pins.labelling.families`). The
part of the lattice that holds the spots is a candidate. A candidate is evaluated by what it does not explain: pins that should be in view
but are not seen, and pin-like spots that belong to none of its pins, also at its rim and just outside it. Therefore a layout with one ring
too few or too many explains less than the right layout, and is not chosen.

Pins may be brighter or darker than the skin. The gaps between dark pins are bright spots, too, and often form a lattice that explains all
of them. But pins have skin on all sides, while gaps have skin on some sides and pins on others (`stand_out`).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np
from scipy.spatial import Delaunay, QhullError, cKDTree

from scenes.layouts.base import LatticeLayout
from scenes.pins import PinsSpec, layout_from
from scenes.sensor import Polarity
from twin.errors import FrameError, format_count
from twin.frames import spread_indices
from twin.frames.forms import is_two_level, levels_at, pin_levels
from twin.geometry.pins import namings, pin_lattice, usual_spacing
from twin.pins.finding.bumps import Bumps, recent_bumps
from twin.pins.labelling.extent import filled_area, find_beyond, in_view, open_sides, with_view
from twin.pins.labelling.families import Family, families, family, family_of_positions, label_spots, locate_places
from twin.pins.labelling.matching import match
from twin.pins.labelling.reference import make_reference, smooth_view, spread_out, together, view_terms
from twin.progress import Step, unheard

SIZES = tuple(0.003 * 1.4**k for k in range(8))
"""Sizes of spots that are tried: standard deviation of a Gaussian, as a share of the frame's longer side. A cap is about three standard
deviations wide."""
SIZED_ON = 3
"""Number of frames from which the size of the spots is determined."""
LIKE_ITS_NEIGHBOURS = 0.45
"""Least height of a pin-like spot, as a share of the median height of the pins around it."""
BEYOND = 1.25
"""Largest distance of a left-over spot from the nearest pin, in spacings. Spots farther away are ignored."""
STEADY = 0.5
"""Least share of the frames in which a pin must be seen, for its position at rest to be the median of its seen positions."""
NEVER_SEEN = 0.1
"""Share of the frames below which a pin in view counts as missing from the layout."""
MOST_MISSING = 0.05
"""Largest share of missing pins that a layout may have."""
SHOWN = 0.9
"""Least share of a frame's pins and pin-like spots that a layout must explain, for the frame to show this layout."""
AROUND = 6
"""Number of nearest pins with which a spot is compared."""
MOST_GUESSES = 3
"""Largest number of layouts that are matched to all frames."""
NO_LAYOUT = (
    "check focus and light, crop the frames to the sensor, give frames with less contact, or give the pins' places (layout = 'positions')"
)
SURE_EXPLAINED, SURE_AHEAD, SURE_AGREEING = 0.95, 0.04, 0.75
"""Thresholds of a sure layout: least share of the pins and spots that it explains, least lead in this share over the next layout, and least
share of the frames that show it."""
SAME_SHAPE = 0.8
"""Largest ratio of the misfits to a smooth view of two layouts that explain nearly the same share, for the first to be sure."""
FADED = 0.8
"""Least size of the outermost caps in thresholded frames, relative to the other caps. If they are smaller, the light fades at the rim, and
caps farther out may be black. The ratio was measured as 0.96 to 1.7 in thresholded frames of three sensors, and as 0.3 and 0.6 in frames
of a sensor with dark corners."""
SMOOTH, ODD, LIKELIER = 0.15, 0.3, 0.5
"""Largest misfit of a layout to a smooth view at which single pins of it are corrected; distance of a pin at rest from the smooth view of
the other pins, in spacings, above which an unnamed spot is looked for instead; and largest ratio of this spot's distance to the pin's."""
LEAST_EXPLAINED = 0.6
"""Least share of the pins and pin-like spots that a candidate must explain."""
ALIKE, MOST_GAPS = 0.5, 0.25
"""Test of whether spots are pins (`stand_out`): least ratio of the two heights of three neighbours above the places between them, which is
about 1 for pins and about 0 for gaps; and largest share of threes with a smaller ratio. The share was measured as at most 0.02 in frames of
seven sensors with bright and of one with dark pins, and as at least 0.44 for gaps of sampled layouts."""
SMOOTHED = 0.5
"""Standard deviation of the smoothing before these heights are measured, in standard deviations of a spot."""
MOST_PLACES = 6
"""Most places that a message lists."""
FEWEST_VIEWED = 12
"""Least number of pins to which a smooth view is fitted. The view has ten terms."""


@dataclass(frozen=True)
class LayoutInFrame:
    """A layout's pins in one frame.

    Attributes
    ----------
    pins_px : (N, 2) float
        Positions of the pins' spots; NaN for a pin without a spot.
    places_px : (N, 2) float
        Positions of all pins: of the spot, or predicted if the pin has none; NaN without a prediction.
    not_seen : int
        Number of pins in view without a spot.
    left_over_px : (k, 2) float
        Pin-like spots that belong to no pin.
    """

    pins_px: np.ndarray
    places_px: np.ndarray
    not_seen: int
    left_over_px: np.ndarray

    @property
    def explained(self) -> float:
        """Share of the pins in view and pin-like spots that are matched to each other."""
        pins = int(np.isfinite(self.pins_px[:, 0]).sum())
        return pins / max(pins + self.not_seen + len(self.left_over_px), 1)


@dataclass(frozen=True)
class Candidate:
    """A possible layout of the pins, and how well the frames agree with it.

    Attributes
    ----------
    pins : PinsSpec
        Layout and missing pins. The sizes of pins and caps are the defaults.
    explained : float
        Share of a frame's pins and pin-like spots that the layout explains, median over the frames.
    agreeing : float
        Share of the frames in which the layout explains at least ``SHOWN``.
    not_seen, left_over : float
        Number of pins in view that are not seen, and of pin-like spots that belong to no pin, medians over the frames.
    misfit : float
        Rms distance of the pins at rest from the smoothest view of the layout, in spacings.
    rest_px : (N, 2) float
        Median position of each pin over the frames.
    there : (N,) float
        Share of the frames in which each pin is seen.
    seen : tuple of Seen
        The layout's pins in each frame.
    lost : tuple of int
        Pins that are not seen in most frames, although they are in view.
    """

    pins: PinsSpec
    explained: float
    agreeing: float
    not_seen: float
    left_over: float
    misfit: float
    rest_px: np.ndarray
    there: np.ndarray
    seen: tuple[LayoutInFrame, ...]
    lost: tuple[int, ...] = ()

    def line(self) -> str:
        """The candidate in words."""
        return f"{self.pins.in_words()}: explains {100 * self.explained:.1f} % of what is there; {self.differences()}"

    def differences(self) -> str:
        """How the layout differs from most frames, in words: places where no pin is seen, and pin-like spots that are none of its pins."""
        empty = np.concatenate([self.missing_px(), self.rest_px[list(self.lost)]])
        spots = np.reshape(unnamed_spots(self.rest_px, self.seen), (-1, 2))
        lacking = [f"no pin is seen at {_places(empty)}"] * bool(len(empty))
        beyond = [f"pin-like spots that are none of its pins: at {_places(spots)}"] * bool(len(spots))
        return "; ".join(lacking + beyond) or "most frames show all its pins, and no others"

    def missing_px(self) -> np.ndarray:
        """Where the missing pins of the complete layout would be, (k, 2) px: predicted from the others."""
        complete = self.pins.model_copy(update={"missing": ()})
        px = np.full((complete.count, 2), np.nan)
        px[np.setdiff1d(np.arange(complete.count), self.pins.missing)] = self.rest_px
        return smooth_view(pin_lattice(complete).places, px)[list(self.pins.missing)] if self.pins.missing else np.zeros((0, 2))


def _places(px: np.ndarray) -> str:
    """Places (k, 2), px, in words; the first ``MOST_PLACES``."""
    more = f" and {len(px) - MOST_PLACES} more places" if len(px) > MOST_PLACES else ""
    return ", ".join(f"({x:.0f}, {y:.0f})" for x, y in px[:MOST_PLACES]) + " px" + more


@dataclass(frozen=True)
class Identified:
    """Result of the identification of a layout.

    Attributes
    ----------
    candidates : tuple of Candidate
        Candidates, the best one first; at least one.
    sure : bool
    doubts : tuple of str
        Reasons why the best candidate is not sure, and the data that would decide.
    sigma_px : float
        Size of the spots: standard deviation of the Gaussian that fits them best, px of the frame.
    polarity : {"bright", "dark"}
        Whether the pins are brighter or darker than the skin.
    """

    candidates: tuple[Candidate, ...]
    sure: bool
    doubts: tuple[str, ...]
    sigma_px: float
    polarity: Polarity = "bright"

    @property
    def best(self) -> Candidate:
        """The best candidate."""
        return self.candidates[0]


Look = Callable[[Bumps], LayoutInFrame | None]
"""Function that finds a layout in a frame's spots; None if it finds none."""


def identify(images: list[np.ndarray], *, progress: Step = unheard) -> Identified:
    """Identify the layout in gray frames (H, W) uint8 of one sensor, with or without contact, with bright or dark pins.

    First each frame is labelled by itself. The layouts that are found in most frames are then matched to all frames, starting from the
    median positions of their pins. In this way a frame in which a contact hides the middle of the layout can be used, too. Unless bright
    pins are sure, some frames are searched for dark pins, and all of them if these explain more.

    Raises
    ------
    FrameError
        No frame shows a layout.
    """
    found = _attempt(images, progress)
    if isinstance(found, Identified) and found.sure and found.best.pins.count >= FEWEST_VIEWED:
        return found
    inverted = [pin_levels(image, "dark") for image in images]
    dark = _attempt([inverted[k] for k in spread_indices(len(images), SIZED_ON)], unheard)
    if len(images) > SIZED_ON and _better(dark, found):
        dark = _attempt(inverted, progress)
    if isinstance(dark, Identified) and _better(dark, found):
        return replace(dark, polarity="dark")
    if isinstance(found, FrameError):
        raise found
    return found


def _attempt(images: list[np.ndarray], progress: Step) -> Identified | FrameError:
    """The layout of bright pins in gray frames, or the reason why there is none."""
    try:
        return _identify_bright(images, progress)
    except FrameError as error:
        return error


def _better(dark: Identified | FrameError, bright: Identified | FrameError) -> bool:
    """Whether there is a candidate of dark pins that is better than the best one of bright pins, if there is one."""
    return isinstance(dark, Identified) and (isinstance(bright, FrameError) or _merit(dark.best) > _merit(bright.best))


def stand_out(images: list[np.ndarray], seen: Sequence[LayoutInFrame], sigma_px: float) -> bool:
    """Whether spots of the size ``sigma_px`` in gray frames (H, W) uint8 are bright pins, not the gaps between dark ones.

    The level of three neighbours is compared with that midway between them, and with that in the middle of the gap between them (the centre
    of the circle through them). Both are the skin's level between pins. Between gaps one is the skin's and one a pin's.
    """
    odd: list[np.ndarray] = []
    for k in spread_indices(len(seen), SIZED_ON):
        px = seen[k].pins_px[np.isfinite(seen[k].pins_px[:, 0])]
        try:
            corners = px[Delaunay(px).simplices]
        except (QhullError, ValueError):  # too few pins, or pins on a line
            continue
        smooth = cv2.GaussianBlur(images[k].astype(np.float32), (0, 0), SMOOTHED * sigma_px)
        u, v = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        u2, v2, area = (u * u).sum(axis=1), (v * v).sum(axis=1), u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]
        to_middle = np.column_stack([v[:, 1] * u2 - u[:, 1] * v2, u[:, 0] * v2 - v[:, 0] * u2]) / (2 * area[:, None])
        before = np.roll(corners, 1, axis=1)
        sides = np.linalg.norm(corners - before, axis=2)
        level = levels_at(smooth, corners)
        rise = (level + np.roll(level, 1, axis=1)) / 2 - levels_at(smooth, (corners + before) / 2)
        row, longest = np.arange(len(corners)), sides.argmax(axis=1)  # the longest side of a grid's triangle crosses the gap
        midway = (rise.sum(axis=1) - rise[row, longest]) / 2
        in_gap = np.maximum(level.mean(axis=1) - levels_at(smooth, corners[:, 0] + to_middle), rise[row, longest])
        whole = np.linalg.norm(to_middle, axis=1) < sides.min(axis=1)  # not the flat triangles along the rim
        odd.append((np.minimum(midway, in_gap) < ALIKE * np.maximum(midway, in_gap))[whole])
    all_odd = np.concatenate([np.zeros(0), *odd])
    return not len(all_odd) or float(all_odd.mean()) <= MOST_GAPS


def _identify_bright(images: list[np.ndarray], progress: Step) -> Identified:
    """Identify the layout in frames whose caps are brighter than the skin.

    Raises
    ------
    FrameError
        No frame shows a layout.
    """
    searched = families()
    looks: list[Look] = [partial(_family_look, by) for by in searched]
    sigma = _usual_size(images, looks)
    if not sigma:
        raise FrameError(f"none of {format_count(len(images), 'frames')} shows pins in rings, a hexagon or a grid; {NO_LAYOUT}")
    spots = _spots(images, sigma)
    found: list[tuple[PinsSpec, list[LayoutInFrame]]] = []
    for k, by in enumerate(searched):
        found += _first_guesses(by, spots)
        progress(k + 1, 2 * len(searched))
    found = [guess for guess in found if np.median([one.explained for one in guess[1]]) >= LEAST_EXPLAINED]
    found.sort(key=lambda guess: -sum(one.explained for one in guess[1]))
    candidates = []
    for k, (pins, seen) in enumerate(found[:MOST_GUESSES]):
        candidates.append(_candidate(pins, seen, spots))
        progress(MOST_GUESSES + k, 2 * MOST_GUESSES)
    candidates = [c for c in candidates if c.explained >= LEAST_EXPLAINED and stand_out(images, c.seen, sigma)]
    candidates.sort(key=lambda c: -_merit(c))
    if not candidates:
        raise FrameError(f"none of {format_count(len(images), 'frames')} shows a whole layout of pins; {NO_LAYOUT}")
    doubts = _doubts(candidates)
    best, ends = candidates[0], []
    if open_sides(best.pins, best.rest_px, spots[0], find_beyond(images, best.rest_px, sigma)):
        ends.append(_describe_missing_end(best.pins))
    if _find_faded(best, images) < FADED:
        ends.append(
            f"the outermost caps of {best.pins.in_words()} are smaller than the others, as where light fades: pins further out "
            "may have been thresholded away; frames that were not thresholded, or with a local threshold, decide, or give the layout"
        )
    if ends:
        doubts += ends
        candidates = _with_larger(candidates, spots)
    return Identified(tuple(candidates), not doubts, tuple(doubts), sigma)


def _find_faded(layout: Candidate, images: list[np.ndarray]) -> float:
    """Size of the outermost caps relative to the others in thresholded frames. 1 for other frames, which would show caps farther out."""
    chosen = [k for k in spread_indices(len(images), SIZED_ON) if is_two_level(images[k])]
    outmost = np.isin(np.arange(layout.pins.count), pin_lattice(layout.pins).outmost)
    white = []
    for k in chosen:
        pins_px = layout.seen[k].pins_px
        near = make_reference(layout.rest_px, layout.pins).spacing_px / 2
        rows, columns = np.nonzero(images[k] > np.iinfo(np.uint8).max // 2)
        of = cKDTree(np.nan_to_num(pins_px, nan=-1e9)).query(np.column_stack([columns, rows]))
        white.append(np.where(np.isfinite(pins_px[:, 0]), np.bincount(of[1][of[0] < near[of[1]]], minlength=len(pins_px)), np.nan))
    if not white or outmost.all():
        return 1.0
    each = np.stack(white)
    inner, outer = (each[:, which][np.isfinite(each[:, which])] for which in (~outmost, outmost))
    return float(np.median(outer) / max(np.median(inner), 1.0)) if len(inner) and len(outer) else 1.0


def _describe_missing_end(pins: PinsSpec) -> str:
    """Message: the frames do not show the end of the layout, so the sensor may have more pins."""
    lines = getattr(pins.shape, "lines", "pins")
    return (
        f"the frames show nothing beyond {pins.in_words()}: more {lines} may be cut off or masked; frames that show the sensor's rim "
        f"decide, or count the {lines} of the sensor and give the layout"
    )


def _with_larger(candidates: list[Candidate], spots: list[Bumps]) -> list[Candidate]:
    """The candidates, with the layout that has one ring more than the first candidate inserted after it."""
    first = candidates[0].pins
    shape = first.shape
    if not isinstance(shape, LatticeLayout) or len(shape.sides()) != 1:  # of several sides it is not known which has more pins
        return candidates
    pins = layout_from(f"{first.layout}:{shape.resize(1)}")
    if any((c.pins.layout, c.pins.complete_count) == (pins.layout, pins.count) for c in candidates[1:2]):
        return candidates
    seen = [shown for one in spots if (shown := _layout_look(pins, family(type(shape)), one)) is not None]
    larger = [_candidate(pins, seen, spots, may_miss=False)] if seen else []
    return [candidates[0], *larger, *candidates[1:]]


def score_layout(pins: PinsSpec, images: list[np.ndarray]) -> Candidate | None:
    """How well a given layout of bright pins explains gray frames (H, W) uint8; None if no frame shows it, or only gaps between pins do.

    Its missing pins are not changed.
    """
    shape = pins.shape
    of_kind = family(type(shape)) if isinstance(shape, LatticeLayout) else None
    layout = _score_layout(pins, family_of_positions(pins) if of_kind is None or pins.missing else of_kind, images)
    if of_kind and pins.missing and (layout is None or layout.explained < SHOWN):
        grown = _score_layout(pins, of_kind, images)  # it follows a strongly curved view, but may be a row off
        layout = max((one for one in (layout, grown) if one is not None), key=lambda one: one.explained, default=None)
    return layout


def _score_layout(pins: PinsSpec, by: Family, images: list[np.ndarray]) -> Candidate | None:
    """How well a given layout explains frames whose spots are labelled by a family."""
    look = partial(_layout_look, pins, by)
    sigma = _usual_size(images, [look])
    if not sigma:
        return None
    spots = _spots(images, sigma)
    seen = [shown for one in spots if (shown := look(one)) is not None]
    layout = _candidate(pins, seen, spots, may_miss=False) if seen else None
    return layout if layout is not None and stand_out(images, layout.seen, sigma) else None


def _spots(images: list[np.ndarray], sigma_px: float) -> list[Bumps]:
    """Each frame's spots of one size, with the area that a mask hides in all frames."""
    filled = filled_area(images)
    found = [recent_bumps(image, sigma_px) for image in images]
    hidden = with_view(found[0], filled).hidden
    return [replace(one, hidden=hidden) for one in found]


def _usual_size(images: list[np.ndarray], looks: list[Look]) -> float:
    """The size of spots of some of the frames, their median; 0 if no layout is seen."""
    sizes = [size for k in spread_indices(len(images), SIZED_ON) if (size := _best_size(images[k], looks))]
    return float(np.median(sizes)) if sizes else 0.0


def _best_size(image: np.ndarray, looks: list[Look]) -> float:
    """The size of spots with the most pins seen, minus pins not seen and left-over spots; 0 if no layout is seen."""
    best, most = 0.0, 0
    for size in (share * max(image.shape) for share in SIZES):
        spots = recent_bumps(image, size)
        for look in looks:
            seen = look(spots)
            if seen is not None:
                score = int(np.isfinite(seen.pins_px[:, 0]).sum()) - seen.not_seen - len(seen.left_over_px)
                if score > most:
                    best, most = size, score
    return best


def _family_look(by: Family, spots: Bumps) -> LayoutInFrame | None:
    """The part of a family's lattice in one frame, without the other frames; None if there is none."""
    part = _part(by, spots)
    return None if part is None else part[1]


def _layout_look(pins: PinsSpec, by: Family, spots: Bumps) -> LayoutInFrame | None:
    """A given layout of a family in one frame, at the position with most labels; None if it is not seen, or the lattice is too small."""
    spot, shape = label_spots(spots, by), pins.shape
    if spot is None:
        return None
    if by.kind is None or not isinstance(shape, LatticeLayout):
        return _place_lattice(spots, spot, by, np.arange(len(by.lattice)))
    nodes = shape.at_most_labels(spot >= 0)
    return None if nodes is None else _place_lattice(spots, spot, by, np.delete(nodes, list(pins.missing)))


def _place_lattice(spots: Bumps, spot: np.ndarray, by: Family, nodes: np.ndarray) -> LayoutInFrame:
    """The places ``nodes`` (N,) of a lattice in a labelled frame."""
    places = locate_places(by.lattice, by.around, spots.px, spot, spots.size_px)[nodes]
    return _make_layout_result(spots, spot[nodes], places)


def _make_layout_result(spots: Bumps, spot: np.ndarray, places: np.ndarray) -> LayoutInFrame:
    """Result for a frame, from the spot (N,) of each pin, -1 for no spot, and the pins' positions (N, 2), px."""
    there, taken = spot >= 0, spot[spot >= 0]
    others = np.setdiff1d(np.arange(len(spots.px)), taken)
    left_over = np.zeros(0, int)
    if len(taken) > AROUND and len(others):
        tree = cKDTree(spots.px[taken])
        spacing = np.median(tree.query(spots.px[taken], k=4)[0][:, 1:], axis=1)
        distance, nearest = tree.query(spots.px[others], k=AROUND)
        near = distance[:, 0] < BEYOND * spacing[nearest[:, 0]]
        high = spots.response[others] > LIKE_ITS_NEIGHBOURS * np.median(spots.response[taken][nearest], axis=1)
        left_over = others[near & high]
    not_seen = int((in_view(places, spots) & ~there).sum())
    return LayoutInFrame(np.where(there[:, None], places, np.nan), places, not_seen, spots.px[left_over])


def _first_guesses(by: Family, spots: list[Bumps]) -> list[tuple[PinsSpec, list[LayoutInFrame]]]:
    """The two layouts of one family that explain most if each frame is labelled by itself."""
    votes: dict[PinsSpec, list[LayoutInFrame]] = {}
    for one in spots:
        if (part := _part(by, one)) is not None:
            votes.setdefault(part[0], []).append(part[1])
    return sorted(votes.items(), key=lambda vote: -sum(seen.explained for seen in vote[1]))[:2]


def _part(by: Family, spots: Bumps) -> tuple[PinsSpec, LayoutInFrame] | None:
    """The part of a lattice in a frame: the layout, and its pins in the frame; None if there is none."""
    spot = label_spots(spots, by)
    if spot is None:
        return None
    part = by.kind.find(spot >= 0, in_view(locate_places(by.lattice, by.around, spots.px, spot, spots.size_px), spots)) if by.kind else None
    return None if part is None else (_pins_of(part[0]), _place_lattice(spots, spot, by, part[1]))


def _pins_of(shape: LatticeLayout) -> PinsSpec:
    """Pins of a layout."""
    name = next(name for name, kind in PinsSpec.parts().items() if kind is type(shape))
    return PinsSpec.model_validate({"layout": name, **shape.model_dump()})


def _candidate(pins: PinsSpec, seen: list[LayoutInFrame], spots: list[Bumps], *, may_miss: bool = True) -> Candidate:
    """Match a layout to all frames. The start is ``seen``: the layout in those frames in which it was found without the others."""
    rest = _rest(pins, _turned_alike(pins, seen))
    again = _match_known(pins, rest, spots)
    good = [k for k, one in enumerate(again) if one.explained > LEAST_EXPLAINED]
    if good:
        rest = _at_likelier_spots(pins, _rest(pins, [again[k] for k in good]), [again[k] for k in good])
        again = _match_known(pins, rest, spots)
    there = np.mean([np.isfinite(one.pins_px[:, 0]) for one in again], axis=0)
    shown = np.mean([in_view(one.places_px, a) for one, a in zip(again, spots, strict=True)], axis=0) > STEADY
    never = np.flatnonzero((there < NEVER_SEEN) & shown)
    if may_miss and not pins.missing and len(spots) > 1 and 0 < len(never) <= MOST_MISSING * pins.count:
        kept = np.setdiff1d(np.arange(pins.count), never)
        less = PinsSpec.model_validate(pins.model_dump() | {"missing": tuple(never.tolist())})
        return _candidate(less, [replace(one, pins_px=one.pins_px[kept], places_px=one.places_px[kept]) for one in again], spots)
    share = np.array([one.explained for one in again])
    return Candidate(
        pins,
        float(np.median(share)),
        float(np.mean(share >= SHOWN)),
        float(np.median([one.not_seen for one in again])),
        float(np.median([len(one.left_over_px) for one in again])),
        unevenness(pin_lattice(pins).places, rest),
        rest,
        there,
        tuple(again),
        tuple(np.flatnonzero((there < STEADY) & shown).tolist()),
    )


def _rest(pins: PinsSpec, seen: list[LayoutInFrame]) -> np.ndarray:
    """Median positions (N, 2), px, of the pins. A pin that is seen in too few frames gets its predicted or smooth-view position."""
    pins_px, places = np.stack([one.pins_px for one in seen]), np.stack([one.places_px for one in seen])
    rest = np.full(places.shape[1:], np.nan)
    anywhere, steady = np.isfinite(places[:, :, 0]).any(axis=0), np.isfinite(pins_px[:, :, 0]).mean(axis=0) >= STEADY
    for chosen, known in ((places, anywhere), (pins_px, steady)):
        rest[known] = np.nanmedian(chosen[:, known], axis=0)
    return np.where(np.isfinite(rest), rest, smooth_view(pin_lattice(pins).places, rest))


def _at_likelier_spots(pins: PinsSpec, rest_px: np.ndarray, seen: Sequence[LayoutInFrame]) -> np.ndarray:
    """Pins at rest (N, 2), px, in which one that is far from a smooth view of the others is at an unnamed spot that fits this view.

    Growth by local affine maps may take a spot beside the sensor for a corner pin, where the view is strongly curved.
    """
    if len(rest_px) < 2 * FEWEST_VIEWED or unevenness(pin_lattice(pins).places, rest_px) > SMOOTH:
        return rest_px
    terms = view_terms(pin_lattice(pins).places)
    solve = np.linalg.pinv(terms)
    leverage = np.minimum(np.einsum("nt,tn->n", terms, solve), 1 - 1e-6)
    without_it = rest_px - (rest_px - terms @ (solve @ rest_px)) / (1 - leverage)[:, None]  # the view of all other pins, by least squares
    spacing, off_px = usual_spacing(rest_px), np.linalg.norm(rest_px - without_it, axis=1)
    odd = np.flatnonzero(off_px > ODD * spacing)
    spots = np.array(unnamed_spots(rest_px, seen) if len(odd) else []).reshape(-1, 2)
    if not len(spots):
        return rest_px
    moved = rest_px.copy()
    for pin in odd:
        away = np.linalg.norm(spots - without_it[pin], axis=1)
        if away.min() < min(ODD * spacing, LIKELIER * off_px[pin]):
            moved[pin] = spots[away.argmin()]
    return moved


def unnamed_spots(rest_px: np.ndarray, seen: Sequence[LayoutInFrame]) -> list[np.ndarray]:
    """Places (2,) px of spots near pins at rest (N, 2), and as bright, that are none of them, in most frames."""
    within, frames = usual_spacing(rest_px) / 2, [one.left_over_px for one in seen]
    places: list[np.ndarray] = []
    for spot in np.concatenate([np.zeros((0, 2)), *frames]):
        if any(np.linalg.norm(spot - place) < within for place in places):
            continue
        seen_in = sum(bool((np.linalg.norm(spots - spot, axis=1) < within).any()) for spots in frames)
        if seen_in >= STEADY * len(seen):
            places.append(spot)
    return places


def _match_known(pins: PinsSpec, rest_px: np.ndarray, spots: Sequence[Bumps]) -> list[LayoutInFrame]:
    """Match a layout with known pins at rest (N, 2), px, to the spots of frames."""
    if not spread_out(rest_px) or together(rest_px).any():
        return [_make_layout_result(one, np.full(pins.count, -1), rest_px) for one in spots]
    reference, results = make_reference(rest_px, pins), []
    for one in spots:
        found = match(reference, one.px, np.ones(len(one.px)))
        places = np.where((found.blob >= 0)[:, None], one.px[found.blob] if len(one.px) else np.nan, found.predicted_px)
        results.append(_make_layout_result(one, found.blob, np.where(np.isfinite(places), places, rest_px)))
    return results


def symmetries(pins: PinsSpec) -> list[np.ndarray]:
    """Orders (N,) of the pins for all turns that map a layout onto itself; the identity comes first."""
    return [order for order in namings(pins) if (order >= 0).all() and np.linalg.det(_map(pins, order)) > 0]


def _map(pins: PinsSpec, order: np.ndarray) -> np.ndarray:
    """Linear map (2, 2) from the places of a layout to those of its pins in another order."""
    places = pin_lattice(pins).places
    return np.linalg.lstsq(places, places[order], rcond=None)[0]


def _turned_alike(pins: PinsSpec, seen: list[LayoutInFrame]) -> list[LayoutInFrame]:
    """The frames' results with consistent labels: a symmetric layout may be labelled in several turns, so each frame gets the turn of the
    frame that the layout explains best."""
    orders = symmetries(pins)
    guide = max(seen, key=lambda one: one.explained).places_px
    chosen = [order_like(orders, one.places_px, guide) for one in seen]
    return [replace(one, pins_px=one.pins_px[order], places_px=one.places_px[order]) for one, order in zip(seen, chosen, strict=True)]


def order_like(orders: list[np.ndarray], pins_px: np.ndarray, like_px: np.ndarray) -> np.ndarray:
    """The one of some orders (N,) of pins (N, 2), NaN where unknown, in which they are nearest to ``like_px`` (N, 2), by the median."""
    away = [np.linalg.norm(pins_px[order] - like_px, axis=1) for order in orders]
    return orders[int(np.argmin([np.nanmedian(each) if np.isfinite(each).any() else np.inf for each in away]))]


def unevenness(places: np.ndarray, pins_px: np.ndarray) -> float:
    """Rms distance of pins (N, 2), px, from the smooth view of their layout's places (N, 2), in spacings; a lost pin is NaN."""
    known = np.isfinite(pins_px[:, 0])
    if known.sum() < FEWEST_VIEWED:
        return float("inf")
    away = np.linalg.norm(pins_px - smooth_view(places, pins_px), axis=1)[known]
    return float(np.sqrt(np.mean(away**2)) / max(usual_spacing(pins_px), 1e-9))


def _merit(candidate: Candidate) -> float:
    """Score of a candidate, from the explained share, the share of agreeing frames, and the misfit to a smooth view."""
    return candidate.explained + 0.1 * candidate.agreeing - 0.2 * min(candidate.misfit, 1.0)


def _doubts(found: list[Candidate]) -> list[str]:
    """Reasons why the first candidate is not sure, and the data that would decide; empty if it is sure."""
    best, doubts = found[0], []
    if best.explained < SURE_EXPLAINED:
        doubts.append(
            f"{best.pins.in_words()} explain only {100 * best.explained:.1f} % of the pins in view and pin-like spots; "
            "look at the overlay: are these all pins? Better light, focus, or frames with less contact decide"
        )
    if best.agreeing < SURE_AGREEING:
        doubts.append(f"only {100 * best.agreeing:.0f} % of the frames show {best.pins.in_words()}; give frames with less contact")
    complete = best.pins.model_copy(update={"missing": ()})
    if at_rim := sorted(set(best.pins.missing) & set(pin_lattice(complete).outmost.tolist())):
        doubts.append(
            f"no frame shows a pin of the rim at {_places(best.missing_px()[np.isin(best.pins.missing, at_rim)])}: missing, or too dark to "
            "be seen; look there in the overlay, and give the layout"
        )
    for other in found[1:]:
        if other.explained > best.explained - SURE_AHEAD and (other.misfit == np.inf or best.misfit > SAME_SHAPE * other.misfit):
            doubts.append(f"{other.pins.in_words()} explain nearly as much; count the pins of one ring or row, and give the layout")
            break
    return doubts
