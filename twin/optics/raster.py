"""Outlines of pins on the film, and drawing of polygons and triangles into float images.

Polygons are drawn with exact coverage of pixels, triangles with smooth shading. Places are (x, y) in px of the raw frame, with integers at
pixel centres. Images are (H, W, C) and are changed in place.
"""

import numpy as np

from scenes.sensor import AppearanceSpec, PinsSpec, ViewSpec
from twin.camera.projection import project
from twin.compiled import compiled
from twin.geometry.pins import around_axis
from twin.optics.surfaces import CAP_BEVEL, STEM_SIDES, cap_outlines
from twin.types import BoolArray, FloatArray, IntArray

SIDES = 16
"""Number of corners of an outline's polygon."""
RIM_PLACES = 6
"""Number of places of a cap's rim that are projected. The image of the rim is smooth, so these places determine it."""
EVENLY = np.sqrt(2 * np.pi / SIDES / np.sin(2 * np.pi / SIDES))
"""Factor on the radius of a polygon that gives it the same area as the round outline."""
STEM_WIDTH = STEM_SIDES / np.pi * np.sin(np.pi / STEM_SIDES)
"""Mean width of the traced stems, which are prisms, relative to their diameter."""
TURN = np.arange(SIDES) * 2 * np.pi / SIDES
"""Azimuths of an outline's corners, rad."""
ON_EDGE = 1e-9
"""Distance in px of a pixel's centre from an edge up to which the pixel belongs to both triangles, so that there is no gap between them."""


class PinOutlines:
    """Projects the pins of one sensor.

    A cap's rim is projected at `RIM_PLACES` places t. The part of its image that is odd under half a turn is proportional to the radius,
    the even part to the square of the radius. Therefore the image of every outline about the same axis is
    ``centre + f(t) odd(t) + f(t)^2 even(t)``, where f is its radius relative to the rim's. The image of a disc at another place on the
    axis is approximated by the same image, shifted.
    """

    def __init__(self, view: ViewSpec, pins: PinsSpec, appearance: AppearanceSpec) -> None:
        self._view, self._pins = view, pins
        shapes = cap_outlines(appearance, SIDES)
        self._cap = EVENLY * (np.ones((1, SIDES)) if shapes is None else shapes)[..., None]
        apart = TURN[:, None] - np.arange(RIM_PLACES) * 2 * np.pi / RIM_PLACES
        self._odd = np.cos(apart) * 2 / RIM_PLACES
        self._even = (0.5 + np.cos(2 * apart)) * 2 / RIM_PLACES

    def __call__(self, base_mm: FloatArray, axis: FloatArray, caps_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Feet (N, 2), and outlines (N, 4, SIDES, 2) of each pin, given (N, 3) each: stem; bottom, edge and face of the cap."""
        pins = self._pins
        radius, half = 0.5 * pins.cap_diameter_mm, 0.5 * pins.cap_height_mm
        bevel = min(CAP_BEVEL * pins.cap_height_mm, 0.5 * radius)
        rim = caps_mm + radius * np.moveaxis(around_axis(axis, np.arange(RIM_PLACES) * 2 * np.pi / RIM_PLACES), 1, 0)
        seen = project(self._view, np.concatenate([rim, caps_mm[None], base_mm[None]]))
        centre, foot = seen[-2, :, None], seen[-1, :, None]
        from_centre = seen[:-2] - seen[-2]
        odd, even = (np.einsum("kj,jnc->nkc", series, from_centre) for series in (self._odd, self._even))
        along = (centre - foot) / np.linalg.norm(caps_mm - base_mm, axis=1)[:, None, None]  # px per mm of the axis

        def disc(factor: float | FloatArray) -> FloatArray:
            return factor * odd + factor**2 * even

        stem = disc(STEM_WIDTH * EVENLY * 0.5 * pins.diameter_mm / radius)
        bottom, edge = (centre + height * along + disc(self._cap) for height in (-half, half - bevel))
        face = centre + half * along + disc(self._cap * (1 - bevel / radius))
        return seen[-1], np.stack([_hull(foot + stem, centre - half * along + stem), bottom, edge, face], axis=1)


def side_normals(axis: FloatArray) -> FloatArray:
    """Outward unit normals (N, 2 SIDES, 3) of the facets of the caps' walls, then of their bevels, about axes (N, 3)."""
    wall = around_axis(axis, TURN + np.pi / SIDES)
    return np.concatenate([wall, np.sqrt(0.5) * (wall + axis[:, None])], axis=1)


def _hull(near: FloatArray, far: FloatArray) -> FloatArray:
    """Outline (N, K, 2) around two similar closed outlines (N, K, 2): its point k is the outer one of their points k."""
    tangent = np.roll(near, -1, axis=1) - np.roll(near, 1, axis=1)
    outward = np.stack([tangent[..., 1], -tangent[..., 0]], axis=-1)
    arm = near - near.mean(axis=1, keepdims=True)
    outward = outward * np.sign(np.sum(arm * outward, axis=(1, 2)))[:, None, None]
    return np.where((np.sum((far - near) * outward, axis=-1) > 0)[..., None], far, near)


def draw_pins(
    image: FloatArray, outlines: FloatArray, lights: tuple[FloatArray, FloatArray, FloatArray], facing: BoolArray, order: IntArray
) -> None:
    """Draw stems and caps over the image, pin by pin. Each pixel gets the light of each facet by the share of its area that this covers.

    The facets of a cap that show their outer side do not overlap, so their shares are added before the cap is drawn over what is there:
    common edges are not blended twice.

    Parameters
    ----------
    image : (H, W, C) float
    outlines : (N, 4, K, 2) float
        Closed outlines (`PinOutlines`), px.
    lights : ((N, C), (N, 2 K, C), (N, C)) float
        Of the stem; of the wall's facets, then of the bevel's; and of the face. Facet k lies between the corners k and k + 1.
    facing : (N,) bool
        Whether the camera sees the cap's face. Otherwise the black inside of the cap is drawn, where its wall does not hide it.
    order : (N,) int
        Numbers of the pins in the order of drawing.
    """
    xy = np.ascontiguousarray(np.moveaxis(outlines, -1, 0))
    bodies = xy[:, :, 0], xy[:, :, 1:].reshape(*xy.shape[:2], -1)
    low, high = (np.moveaxis(np.array([reduce(body, axis=2) for body in bodies]), 1, -1) for reduce in (np.min, np.max))  # (2, N, 2)
    drawn: BoolArray = np.all((high > -0.5) & (low < np.array(image.shape[1::-1]) - 0.5), axis=2)
    low, high = np.where(drawn[..., None], [low, high], 0.0)
    # two additional columns take what an edge adds beyond the last pixel; the last channel is the covered share
    first = np.floor(low + 0.5).astype(int)
    boxes = np.concatenate([first, (high + 0.5).astype(int) - first + [3, 1]], axis=2)
    stem, side, face = lights
    light = np.concatenate([stem[:, None], side, face[:, None] * facing[:, None, None]], axis=1)
    after, before = np.roll(xy, -1, axis=3), xy[:, :, ::3]
    stems, ends = np.sign(_cross(before, after[:, :, ::3]).sum(axis=2)).T
    shown = np.sign(_cross(after[:, :, 2:] - xy[:, :, 1:3], xy[:, :, 2:] - after[:, :, 1:3])).reshape(side.shape[:2])
    sense = np.where(facing, ends, -ends)[:, None]
    senses = np.column_stack([stems, np.where(shown == sense, sense, 0), ends])
    cover = np.zeros((boxes[..., 3].max(), boxes[..., 2].max(), image.shape[2] + 1))
    _draw(image, outlines, light, senses, facing, drawn, boxes, order, cover)


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """The z components (...) of cross products of vectors (2, ...)."""
    return a[0] * b[1] - a[1] * b[0]


@compiled(error_model="numpy")
def _draw(
    image: FloatArray,
    outlines: FloatArray,
    light: FloatArray,
    senses: FloatArray,
    facing: BoolArray,
    drawn: BoolArray,
    boxes: IntArray,
    order: IntArray,
    cover: FloatArray,
) -> None:
    """Draw the facets of all pins: the stem, the wall, the bevel, the face. A facet of sense 0 is out of sight.

    Each edge of a facet adds to each row of ``cover`` the area on its right, as differences along the row. Their cumulative sum is the
    coverage. ``cover`` is 0 before and after.
    """
    height, width, channels = image.shape
    sides, last = outlines.shape[2], senses.shape[1] - 1
    for p in order:
        for body in range(2):
            if not drawn[body, p]:
                continue
            x0, y0, columns, rows = boxes[body, p, 0], boxes[body, p, 1], boxes[body, p, 2], boxes[body, p, 3]
            for facet in range(body, last + 1 if body else 1):
                if senses[p, facet] == 0:
                    continue
                band, k = 1 + (facet - 1) // sides, (facet - 1) % sides
                whole = facet == 0 or facet == last
                if whole:
                    band = 0 if facet == 0 else 3 if facing[p] else 1
                for e in range(sides if whole else 4):
                    r0, c0, r1, c1 = band, e, band, (e + 1) % sides
                    if not whole:  # around the facet: k, k + 1, and both in the next outline
                        r0, r1, c0, c1 = band + e // 2, band + (e + 1) // 2 % 2, (k + (e + 1) // 2 % 2) % sides, (k + (e < 2)) % sides
                    ax, ay = outlines[p, r0, c0, 0] - x0 + 0.5, outlines[p, r0, c0, 1] - y0 + 0.5
                    bx, by = outlines[p, r1, c1, 0] - x0 + 0.5, outlines[p, r1, c1, 1] - y0 + 0.5
                    if ay == by:
                        continue
                    sign = -senses[p, facet]
                    if ay > by:
                        ax, ay, bx, by, sign = bx, by, ax, ay, -sign
                    slope = (bx - ax) / (by - ay)
                    for y in range(int(ay), min(int(np.ceil(by)), rows)):
                        low, high = max(float(y), ay), min(y + 1.0, by)
                        start, end = ax + slope * (low - ay), ax + slope * (high - ay)
                        left, right, rise = min(start, end), max(start, end), sign * (high - low)
                        for x in range(int(left), int(right) + 1):  # the part of the edge within pixel x
                            a, b = max(left, float(x)), min(right, x + 1.0)
                            part = rise if int(left) == int(right) else rise / (right - left) * (b - a)
                            beyond = 0.5 * (a + b) - x
                            for c in range(channels + 1):
                                share = part * light[p, facet, c] if c < channels else part
                                cover[y, x, c] += share * (1 - beyond)
                                cover[y, x + 1, c] += share * beyond
            for y in range(rows):
                for x in range(columns):
                    total = cover[y, x, channels]
                    seen = total > 0 and x < columns - 2 and 0 <= x + x0 < width and 0 <= y + y0 < height
                    for c in range(channels + 1):
                        value, cover[y, x, c] = cover[y, x, c], 0.0
                        if x + 1 < columns:
                            cover[y, x + 1, c] += value
                        if seen and c < channels:
                            image[y + y0, x + x0, c] = max(1 - total, 0.0) * image[y + y0, x + x0, c] + value


@compiled(error_model="numpy")
def draw_triangles(image: FloatArray, corners: FloatArray, light: FloatArray, faces: IntArray) -> None:
    """Fill the pixels whose centres lie in triangles ``faces (m, 3)`` over corners (v, 2) with linearly interpolated lights (v, C)."""
    height, width, channels = image.shape
    for f in range(len(faces)):
        i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
        ax, ay = corners[i, 0], corners[i, 1]
        bx, by = corners[j, 0] - ax, corners[j, 1] - ay
        cx, cy = corners[k, 0] - ax, corners[k, 1] - ay
        area = bx * cy - cx * by
        if not abs(area) > 0:
            continue
        # the weights of corners j and k are linear: s = sx (x - ax) + sy (y - ay), and t in the same way
        sx, sy, tx, ty = cy / area, -cx / area, -by / area, bx / area
        top = max(int(np.ceil(ay + min(0.0, by, cy) - ON_EDGE)), 0)
        bottom = min(int(np.floor(ay + max(0.0, by, cy) + ON_EDGE)), height - 1)
        for y in range(top, bottom + 1):
            s0, t0 = sy * (y - ay), ty * (y - ay)
            low, high = _inside(sx, s0, -np.inf, np.inf)
            low, high = _inside(tx, t0, low, high)
            low, high = _inside(-sx - tx, 1 - s0 - t0, low, high)
            if not low <= high:
                continue
            x0, x1 = max(int(np.ceil(max(ax + low, -1.0) - ON_EDGE)), 0), min(int(np.floor(min(ax + high, width) + ON_EDGE)), width - 1)
            s, t = s0 + sx * (x0 - ax), t0 + tx * (x0 - ax)
            for c in range(channels):
                dj, dk = light[j, c] - light[i, c], light[k, c] - light[i, c]
                start, step = light[i, c] + s * dj + t * dk, sx * dj + tx * dk
                for x in range(x0, x1 + 1):
                    image[y, x, c] = start + step * (x - x0)


@compiled(error_model="numpy")
def _inside(slope: float, at_zero: float, low: float, high: float) -> tuple[float, float]:
    """The part of [low, high] where ``at_zero + slope x >= 0``."""
    if slope > 0:
        return max(low, -at_zero / slope), high
    if slope < 0:
        return low, min(high, -at_zero / slope)
    return (low, high) if at_zero >= 0 else (np.inf, -np.inf)
