"""The pipeline: observation of the pins in a frame, the same for rendered, recorded and live frames.

The limits of an observation were chosen, not derived. A frame that is meant to show no contact is refused if its pins are displaced in a
way that no displacement of the camera explains (`measure_reference`, `twin.pins.labelling.reference`).
"""

from copy import copy
from dataclasses import replace
from time import perf_counter

import cv2
import numpy as np
from scipy.spatial import cKDTree

from scenes.sensor import BlobSpec, SensorSpec
from twin.compiled import compiled
from twin.errors import FrameError, format_count
from twin.frames.forms import blob_spec, form_named, frame_size, pin_levels
from twin.pins.finding.blobs import Blobs, Mask, circular_mask, despeckle, find_blobs, find_spots, own_threshold
from twin.pins.graph import GraphKind, make_graph
from twin.pins.labelling.identify import SHOWN, score_layout
from twin.pins.labelling.matching import Match, complete, confirm, find_again, follow, look_again, match, proven, rematch
from twin.pins.labelling.reference import NO_CONTACT_REMEDY, Reference, camera_modes, make_reference, median_px, nominal_reference, view_of
from twin.pins.labelling.rest import require_even
from twin.pins.labelling.split import split_chains, split_merged
from twin.pins.voronoi import Net
from twin.types import Form, Frame, Observation

MOST_RIM_LOST = 0.75
"""Largest share of the outermost pins in view that may be lost. Without them a smaller layout explains the frame as well."""
MIN_FOUND = 0.8
"""Least share of the pins that must be found."""
AT_BORDER = 1.0
"""Distance of a pin at rest from the frame's border, in spacings, below which the pin counts as near the border."""
CUT = 0.35
"""Distance of a cap's middle from the frame's border, in spacings, below which the border cuts the cap off."""
MAX_EXTRA = 0.35
"""Most blobs among the pins that are not pins, as a share of the number of pins, in a frame in which pins are missing."""
NEARLY_ALL = 0.97
"""Share of found pins above which no pin counts as missing. The frame may then have as many further blobs as pins."""
MAX_FOLDED = 0.02
"""Largest share of the reference's triangles that may be turned over. If more are turned over, the labelling is wrong."""
MAX_RIM_SCALE = 1.2
"""Largest ratio of the rim's radius to that at rest, and of the radius at rest to the rim's. The rim is clamped: contacts change it by
a few percent."""
MAX_SHIFT = 0.5
"""Largest displacement of the layout, in its radii. A frame with a larger displacement does not belong to this sensor."""
MAX_BLOB_PITCHES2 = 3.0
"""Largest area of a blob, in squared mean spacings. Larger blobs are housing or glare."""
SPLIT_ROUNDS = 3
"""Rounds of splitting caps that touch. Each split improves the predictions for the next."""
ENOUGH = 0.985
"""Share of found pins below which further thresholds are tried. They are also tried if there are more than MAX_EXTRA further blobs."""
OWN_SHARES = (1.0, 0.3)
"""Further thresholds, relative to the frame's own threshold between caps and skin. The low one finds caps that are much darker than
most."""
EXTRA_COST = 0.05
"""Cost of a blob that is not a pin, in units of a found pin, when the results of several thresholds are compared. Noise and clutter give
hundreds of such blobs."""
REMASK_PX = 2.0
"""Least displacement of the whole view, px, with which the mask is displaced, if a pin is close to the mask's edge."""
MASK_MARGIN, MASK_MARGIN_PX = 0.5, 1.0
"""Distance from the mask's edge below which a lost pin may be cut off, in spacings, and below which a found pin's cap is, px."""
PLAUSIBLE = 0.5
"""Least share of labelled pins for a labelling to be improved by further steps."""
NEAREST, DARKER, BRIGHT, LEAST_ABOVE = 6, 35, 75, 0.15
"""Test of whether a pin stands on a cap or between caps. The pin's level is compared with the midpoints between it and its ``NEAREST``
nearest pins: its height is its level above the percentile ``DARKER`` of these midpoints. A pin stands between caps if its height is at most
the share ``LEAST_ABOVE`` of the percentile ``BRIGHT`` of all pins' heights."""
MOST_BETWEEN = 0.2
"""Largest share of pins that may stand between caps. It is not 0, because the midpoints of touching caps are bright, too."""
LEAST_COMPARED = 12
"""Least number of found pins for this test."""
LEAST_LEAD = 0.35
"""Least lead of the labelling over the next, quite different one, in rows of pins (the square root of their number). If the whole layout
is seen, a labelling that is a row apart lacks a row. If a row is lost, or lights beside the pins look like one, it explains the frame as
well."""
ONWARD = 0.4
"""Largest distance of a blob that is no pin, in spacings, from a place where a row of pins would go on. It is farther from all pins."""
UNNAMED_AREA_RATIO = 2.0
"""Largest ratio of this blob's area to the median of the pins', and of the second to the first."""
LEAST_UNNAMED = 3
"""Least number of such blobs, and of lost pins, with which part of the layout may be named a row apart: the blobs at one end, the lost
pins at the other."""


class Pipeline:
    """Finds, labels and connects the pins of one sensor's frames.

    Parameters
    ----------
    spec : SensorSpec
    form : Form
        Form of the frames.
    reference : Reference, optional
        Layout without contact; by default that of the specification.
    graph : {"voronoi", "delaunay", "knn"}
        Kind of the graph.
    second_look : bool
        If an adaptive threshold loses pins, or finds many other blobs, also try thresholds from the frame's own contrast.
    """

    def __init__(
        self, spec: SensorSpec, form: Form, reference: Reference | None = None, *, graph: GraphKind = "voronoi", second_look: bool = True
    ) -> None:
        self.spec, self.form, self.graph, self.second_look = spec, form_named(form), graph, second_look
        self.size_px = frame_size(spec, self.form)
        self.blob_spec = blob_spec(spec.pipeline, self.form)
        self.reference = nominal_reference(spec, self.form) if reference is None else reference
        self.mask = circular_mask(self.size_px, self.blob_spec.mask_center_px, self.blob_spec.mask_radius_px)
        pitch = float(np.mean(self.reference.spacing_px))
        self._max_area_px2 = MAX_BLOB_PITCHES2 * pitch**2
        self._center_px = np.median(self.reference.pins_px, axis=0)
        self._radius_px = float(np.linalg.norm(self.reference.pins_px - self._center_px, axis=1).max())
        self._follows = False
        self._before: tuple[np.ndarray, Net | None] | None = None  # pins of the frame before, and their net
        self._at_border = self._inside_px(self.reference.pins_px) < AT_BORDER * self.reference.spacing_px

    def __call__(self, frame: Frame) -> Observation:
        """Observe one frame. If it does not show enough pins, the result has ``valid=False`` and the reason.

        Raises
        ------
        FrameError
            The image isn't one of this sensor's frames: wrong size, type or form.
        """
        self.check(frame)
        started = perf_counter()
        ms: dict[str, float] = {}
        blobs, found = self._look(frame, self.blob_spec, ms, self._before)
        now = perf_counter()
        if self.second_look and self.blob_spec.threshold_block_px and not self.blob_spec.spot_sigma_px and not self._clear(blobs, found):
            blobs, found = self._with_own_threshold(frame, blobs, found)
        ms["look again"], now = _since(now)
        paired = found.blob >= 0
        pins_px = np.full_like(self.reference.pins_px, np.nan)
        pins_px[paired] = blobs.px[found.blob[paired]]
        nodes_px = complete(self.reference, pins_px)
        predicted_px = np.where(paired[:, None], np.nan, nodes_px)
        extra_px = np.delete(blobs.px, found.blob[paired], axis=0)
        between = self._between_caps(frame, pins_px)
        ms["complete"], now = _since(now)
        expected = int((paired | ~self._cut_off(nodes_px)).sum())
        reason = self._reason(blobs, found, expected, nodes_px, extra_px, between)
        graph = None
        if not reason:
            net = self._net_of(nodes_px)
            graph = make_graph(self.graph, nodes_px, outmost=self.reference.outmost, net=net)
            self._before = (nodes_px, net) if self._follows and paired.all() else None
        ms["graph"], now = _since(now)
        ms["total"], _ = _since(started)
        return Observation(pins_px, predicted_px, int(paired.sum()), expected, not reason, reason, graph, extra_px, ms)

    def with_history(self) -> "Pipeline":
        """The pipeline for consecutive frames: it begins with the names that the pins had in the frame before.

        Its observations are those of the pipeline itself, in less than half of the time: where these names do not prove themselves, it
        searches for all pins, as always.
        """
        found = copy(self)
        found._follows, found._before = True, None
        return found

    def _net_of(self, nodes_px: np.ndarray) -> Net | None:
        """The net of the pins' Delaunay triangles, from that of the frame before, or from that at rest; None if neither leads to it, or if
        the graph needs none."""
        if self.graph == "knn":
            return None
        before = self._before[1] if self._before else None
        known = None if before is None else before.move(nodes_px)
        return known if known is not None or self.reference.net is None else self.reference.net.move(nodes_px)

    def check(self, frame: Frame) -> None:
        """Raise ``FrameError`` if the size, type or form of a frame is not that of this sensor and form."""
        if not isinstance(frame, Frame):
            raise FrameError(f"a twin.types.Frame is expected, got {type(frame).__name__}; give Frame(image, Form.{self.form.name})")
        image, (width, height) = frame.image, self.size_px
        where = frame.name or "frame"
        if not isinstance(image, np.ndarray) or image.dtype != np.uint8:
            raise FrameError(f"{where}: expected 8-bit levels, got {getattr(image, 'dtype', type(image).__name__)}; convert it to uint8")
        if image.ndim not in (2, 3) or image.shape[:2] != (height, width) or (image.ndim == 3 and image.shape[2] not in (1, 3)):
            raise FrameError(
                f"{where}: expected {width}x{height} gray or RGB ({self.form} form of {self.spec.name}), got shape {image.shape};"
                " give frames of this sensor and form as the camera or the recorder wrote them"
            )
        if frame.form != self.form:
            raise FrameError(f"{where}: expected a {self.form} frame, got a {frame.form} one; make a Pipeline of that form for it")

    def _look(
        self, frame: Frame, blob: BlobSpec, ms: dict[str, float], before: tuple[np.ndarray, Net | None] | None = None
    ) -> tuple[Blobs, Match]:
        """Blobs and their labelling with one threshold. The times of the stages are added to ``ms``."""
        started = perf_counter()
        blobs = self._detect(frame, self.mask, blob)
        ms["detect"], now = _since(started)
        followed = None if before is None else follow(self.reference, before[0], blobs.px, blobs.area_px2)
        if followed is not None and not self._cut_by_mask(blobs, followed):
            ms["match"], _ = _since(now)
            return blobs, followed
        found = match(self.reference, blobs.px, blobs.area_px2, second_look=False)
        if self._plausible(found):
            blobs, found = self._with_displaced_mask(frame, blob, blobs, found)
        if (found.blob < 0).any() and self._plausible(found):
            blobs, found = self._with_split_caps(blobs, found)
            if (found.blob < 0).any():
                found = confirm(self.reference, blobs.px, blobs.area_px2, found)
        if not proven(self.reference, blobs.px, found.blob):
            again = look_again(self.reference, blobs.px, blobs.area_px2, found)
            if again is not found:
                blobs, found = self._with_split_caps(blobs, again)
        ms["match"], _ = _since(now)
        return blobs, found

    def _with_own_threshold(self, frame: Frame, blobs: Blobs, found: Match) -> tuple[Blobs, Match]:
        """Try thresholds from this frame's own contrast until nearly all pins are found. Returns the best labelling of all."""
        own = own_threshold(self._window(frame, self.mask), self.mask.disc, self.blob_spec)
        best = blobs, found
        for share in OWN_SHARES:
            again = self._look(frame, self.blob_spec.model_copy(update={"threshold": share * own}), {})
            best = max(best, again, key=lambda look: look[1].score - EXTRA_COST * _extra(*look))
            if self._clear(*best):
                break
        return best

    def _clear(self, blobs: Blobs, found: Match) -> bool:
        """Whether nearly all pins and few other blobs are found."""
        n = len(found.blob)
        return bool((found.blob >= 0).sum() >= ENOUGH * n) and _extra(blobs, found) <= MAX_EXTRA * n

    def _window(self, frame: Frame, mask: Mask) -> np.ndarray:
        """Gray levels (h, w) of the mask's window. For an adaptive threshold hot and dead pixels are removed."""
        window = self._levels(frame.image[mask.window])
        return despeckle(window) if self.blob_spec.threshold_block_px else window

    def _levels(self, image: np.ndarray) -> np.ndarray:
        """Gray levels (h, w) of an image or a part of it, in which the pins are bright."""
        return pin_levels(np.ascontiguousarray(image), self.blob_spec.polarity)

    def _detect(self, frame: Frame, mask: Mask, blob: BlobSpec) -> Blobs:
        """Blobs in the mask's window, with chains of several caps split; or spots, if the parameters ask for spots."""
        if blob.spot_sigma_px:
            return find_spots(self._levels(frame.image[mask.window]), mask, blob)
        return split_chains(find_blobs(self._window(frame, mask), mask, blob, max_area_px2=self._max_area_px2))

    def _plausible(self, found: Match) -> bool:
        """Whether a labelling is good enough to be improved."""
        return bool((found.blob >= 0).sum() > PLAUSIBLE * len(found.blob))

    def _with_displaced_mask(self, frame: Frame, blob: BlobSpec, blobs: Blobs, found: Match) -> tuple[Blobs, Match]:
        """If the whole view is displaced so far that the mask may cut pins off, detect again with a displaced mask."""
        paired = found.blob >= 0
        rim = self.reference.outmost[paired[self.reference.outmost]]
        if not len(rim) or not self._cut_by_mask(blobs, found):
            return blobs, found
        shift = median_px(blobs.px[found.blob[rim]] - self.reference.pins_px[rim])
        if np.linalg.norm(shift) < REMASK_PX:
            return blobs, found
        center = np.asarray(self.blob_spec.mask_center_px) + shift
        displaced = self._detect(frame, circular_mask(self.size_px, tuple(center), self.blob_spec.mask_radius_px), blob)
        again = find_again(self.reference, displaced.px, displaced.area_px2, found, blobs.px)
        return (displaced, again) if again.score > found.score else (blobs, found)

    def _cut_by_mask(self, blobs: Blobs, found: Match) -> bool:
        """Whether the mask may cut off a pin's cap: that of a found pin, as a disc of its area, or the place of a lost one."""
        paired = found.blob >= 0
        px = np.where(paired[:, None], blobs.px[found.blob], found.predicted_px)
        radius = np.where(paired, np.sqrt(blobs.area_px2[found.blob] / np.pi) + MASK_MARGIN_PX, MASK_MARGIN * self.reference.spacing_px)
        return bool((np.linalg.norm(px - self.blob_spec.mask_center_px, axis=1) > self.blob_spec.mask_radius_px - radius).any())

    def _with_split_caps(self, blobs: Blobs, found: Match) -> tuple[Blobs, Match]:
        """Split caps that touch. Each split improves the predictions for the next."""
        for _ in range(SPLIT_ROUNDS):
            parts = split_merged(self.reference, blobs, found)
            if parts is blobs:
                break
            kept = {tuple(px): k for k, px in enumerate(parts.px)}
            before = np.array([kept.get(tuple(blobs.px[k]), -1) if k >= 0 else -1 for k in found.blob])
            again = rematch(self.reference, parts.px, parts.area_px2, before, found)
            if again.score <= found.score:
                break
            blobs, found = parts, again if found.drifted else replace(again, lead=found.lead)
        return blobs, found

    def _inside_px(self, px: np.ndarray) -> np.ndarray:
        """Distance (n,) of places (n, 2) from the frame's border, px; negative outside the frame."""
        return np.minimum(px, np.array(self.size_px) - 1 - px).min(axis=1)

    def _cut_off(self, nodes_px: np.ndarray) -> np.ndarray:
        """Pins (N,) bool that the frame's border cuts off: they are near it at rest, and not whole in this frame."""
        if not self._at_border.any():
            return self._at_border
        return self._at_border & (self._inside_px(nodes_px) < CUT * self.reference.spacing_px)

    def out_of_view(self, seen: Observation) -> np.ndarray:
        """Pins (N,) bool that were lost in a frame because its border cuts them off, which is no fault of the sensor."""
        with np.errstate(invalid="ignore"):
            cut: np.ndarray = self._cut_off(seen.predicted_px)  # NaN where a pin was found
        return cut

    def _count_unnamed(self, blobs: Blobs, found: Match, nodes_px: np.ndarray) -> int:
        """Number of blobs of a cap's size that are no pins, but stand where the rows of pins go on, if pins are lost.

        ``nodes_px`` (N, 2) are the pins. A row goes on as far from a pin as one of its neighbours is, on the other side.
        """
        paired = found.blob >= 0
        if paired.all() or paired.sum() == len(blobs.px):
            return 0
        extra = np.setdiff1d(np.arange(len(blobs.px)), found.blob)
        ratio = blobs.area_px2[extra] / np.median(blobs.area_px2[found.blob[paired]])
        px = blobs.px[extra[(ratio > 1 / UNNAMED_AREA_RATIO) & (ratio < UNNAMED_AREA_RATIO)]]
        pins_px = nodes_px[paired]
        onward = (2 * pins_px[:, None] - nodes_px[self.reference.neighbours[paired, :NEAREST]]).reshape(-1, 2)
        (away, _), (_, pin) = cKDTree(onward).query(px), cKDTree(pins_px).query(px)
        reach = ONWARD * self.reference.spacing_px[paired][pin]
        return int(((away < reach) & (np.linalg.norm(px - pins_px[pin], axis=1) > reach)).sum())

    def _between_caps(self, frame: Frame, pins_px: np.ndarray) -> float:
        """Share of the found pins (N, 2), NaN where lost, that do not stand out from the midpoints between them and their neighbours."""
        if np.isfinite(pins_px[:, 0]).sum() < LEAST_COMPARED:
            return 0.0
        near = self.reference.neighbours[:, :NEAREST]
        return share_between(self._levels(frame.image), pins_px, near, DARKER, BRIGHT)

    def _reason(self, blobs: Blobs, labelled: Match, n: int, nodes_px: np.ndarray, extra_px: np.ndarray, between: float) -> str:
        """Reason why a frame with ``n`` pins in view is not a valid observation; "" if it is valid.

        ``between`` is the share of the pins that stand between caps.
        """
        paired = labelled.blob >= 0
        found = int(paired.sum())
        if len(blobs.px) < MIN_FOUND * n / 2:
            return f"no pins: {format_count(len(blobs.px), 'blobs')} seen, {n} pins expected"
        if found < MIN_FOUND * n:
            return f"too few pins: {found} of {n} found among {len(blobs.px)} blobs, {MIN_FOUND:.0%} needed"
        folded = self.reference.folded_fraction(nodes_px)
        if folded > MAX_FOLDED:
            return f"inconsistent pins: the labelling inverts {folded:.1%} of the layout"
        shift = np.linalg.norm(median_px(nodes_px) - self._center_px)
        if shift > MAX_SHIFT * self._radius_px:
            return f"inconsistent pins: the layout is displaced by {shift:.0f} px"
        scale = self.reference.rim_scale(nodes_px)
        if not 1 / MAX_RIM_SCALE < scale < MAX_RIM_SCALE:
            return f"inconsistent pins: the rim is {scale:.2f} times its size at rest; another sensor's frame, or a contact too deep"
        extra = 0
        if len(extra_px):
            center = nodes_px.mean(axis=0)
            extra = int((np.linalg.norm(extra_px - center, axis=1) < np.linalg.norm(nodes_px - center, axis=1).max()).sum())
        if extra > n or (extra > MAX_EXTRA * n and found < NEARLY_ALL * n):
            return f"too many blobs: {extra} among the {found} pins found; another sensor's frame, or clutter"
        rim = self.reference.outmost[~self._cut_off(nodes_px)[self.reference.outmost]]
        if (gone := int((~paired[rim]).sum())) > MOST_RIM_LOST * len(rim):
            return (
                f"the rim is not visible: {gone} of the {len(rim)} outermost pins are lost; fading light, too high a threshold, or a "
                "sensor of fewer pins: run 'twin tune' on these frames, or 'twin new'"
            )
        if labelled.lead < LEAST_LEAD * np.sqrt(len(paired)):
            return (
                "ambiguous pins: two labellings, a row apart, explain the frame nearly equally well; press or shear less, uncover "
                "hidden pins, and cover what looks like pins beside them"
            )
        lost = len(paired) - found
        if (unnamed := self._count_unnamed(blobs, labelled, nodes_px)) >= LEAST_UNNAMED <= lost:
            return (
                f"ambiguous pins: blobs continue the rows of pins ({unnamed}), and pins are lost ({lost}): the picture is torn, or part is "
                "labelled a row apart; take the frame again, or cover what looks like pins"
            )
        if between > MOST_BETWEEN:
            return f"wrong pins: {between:.0%} of them stand between caps; stray light, a wrong threshold, or another sensor's frame"
        return ""


@compiled(error_model="numpy")
def _heights(wide: np.ndarray, pins_px: np.ndarray, near: np.ndarray, darker: float, between: np.ndarray, above: np.ndarray) -> None:
    """Height (N,) of each pin, see ``NEAREST``: NaN where unknown.

    A level is the rounded mean of the 3 x 3 pixels around the one nearest to a place; ``wide`` is the picture with one more pixel on each
    side. ``between`` (k + 1,) is for work.
    """
    last_row, last_column, most = wide.shape[0] - 3, wide.shape[1] - 3, near.shape[1]
    for i in range(len(pins_px)):
        compared, level = 0, 0.0
        for c in range(most + 1):  # the pin itself at last
            k = near[i, c] if c < most else i
            x, y = (pins_px[i, 0] + pins_px[k, 0]) / 2, (pins_px[i, 1] + pins_px[k, 1]) / 2
            if not np.isfinite(x):
                continue
            column, row, total = min(max(round(x), 0), last_column), min(max(round(y), 0), last_row), 0
            for r in range(row, row + 3):
                total += wide[r, column] + wide[r, column + 1] + wide[r, column + 2]
            level, place = round(total / 9), compared
            if c < most:
                while place > 0 and between[place - 1] > level:  # they stay sorted
                    between[place] = between[place - 1]
                    place -= 1
                between[place] = level
                compared += 1
        above[i] = np.nan
        if compared:
            between[compared] = between[compared - 1]
            rank = (compared - 1) * (darker / 100)
            low = int(rank)
            above[i] = level - (between[low] + (rank - low) * (between[low + 1] - between[low]))


def share_between(gray: np.ndarray, pins_px: np.ndarray, near: np.ndarray, darker: float, bright: float) -> float:
    """Share of the pins (N, 2), NaN where lost, that stand between caps; ``near`` (N, k) are the pins with which each is compared.

    See ``NEAREST`` for the test and the percentiles.
    """
    above, wide = np.empty(len(pins_px)), cv2.copyMakeBorder(gray, 1, 1, 1, 1, cv2.BORDER_REFLECT_101)
    _heights(wide, pins_px, near, float(darker), np.empty(near.shape[1] + 1), above)
    above = np.sort(above[np.isfinite(above)])
    if not len(above):
        return 0.0
    level = np.interp((len(above) - 1) * (bright / 100), np.arange(len(above)), above)  # as np.percentile, in a tenth of its time
    return float(np.count_nonzero(above <= LEAST_ABOVE * level) / len(above))


def _extra(blobs: Blobs, found: Match) -> int:
    """Number of blobs that are not pins."""
    return len(blobs.px) - int((found.blob >= 0).sum())


def _since(start: float) -> tuple[float, float]:
    """Time in ms since a value of ``perf_counter``, and its present value."""
    now = perf_counter()
    return 1e3 * (now - start), now


def measure_reference(spec: SensorSpec, form: Form, frame: Frame, *, known: Reference | None = None) -> Reference:
    """The reference from a no-contact frame. Lost pins are predicted from their neighbours.

    Parameters
    ----------
    known : Reference, optional
        Known places at rest, of this unit or of another; by default those of the specification.

    Raises
    ------
    FrameError
        The layout can't be found in the frame, or the sensor is pressed in it, or the picture is turned so far that the pins' names are
        not sure. The message says what to do.
    """
    name, expected, modes = frame.name or "frame", known or nominal_reference(spec, form), camera_modes(spec, form)
    seen = Pipeline(spec, form, expected, graph="delaunay")(frame)
    refused = FrameError(f"{name}: not usable as a no-contact frame: {seen.reason}; {NO_CONTACT_REMEDY}")
    if seen.graph is not None:
        try:
            if known is None and blob_spec(spec.pipeline, form).rest_origin == "contacts":  # such places are dented themselves
                require_even(spec.pins, seen.pins_px, name)
            else:
                view_of(seen.pins_px, expected, spec.pins, modes).require_unpressed(name, spec)
            return make_reference(seen.graph.nodes_px, spec.pins)
        except FrameError as error:
            refused = error
    levels = pin_levels(frame.image, blob_spec(spec.pipeline, form).polarity)
    shown = score_layout(spec.pins, [levels])  # it names the pins without known places
    if shown is not None and shown.explained >= SHOWN:
        other = view_of(shown.seen[0].pins_px, expected, spec.pins, modes)
        if not other.pressed:
            other.require_small(name, f"the pins at rest of {spec.name}")
    raise refused
