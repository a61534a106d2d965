"""Outlines of pins on the film, and drawing of polygons and triangles into float images.

Polygons are drawn with exact coverage of pixels, triangles with smooth shading. Places are (x, y) in px of the raw frame, with integers at
pixel centres. Images are (H, W, C) and are changed in place.
"""

import numpy as np

from scenes.sensor import AppearanceSpec, PinsSpec, ViewSpec
from twin.camera.projection import project
from twin.compiled import compiled
from twin.optics.surfaces import CAP_BEVEL, cap_outlines
from twin.types import BoolArray, FloatArray, IntArray

SIDES = 16
"""Corners of an outline's polygon."""
RIM_PLACES = 6
"""Number of places of a cap's rim that are projected. The image of the rim is smooth, so these places determine it."""
EVENLY = np.sqrt(np.sin(np.pi / 12) / (np.pi / 12) * (2 * np.pi / SIDES) / np.sin(2 * np.pi / SIDES))
"""Factor on the radius with which the polygon has the area of the round outline that it approximates."""
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
        """Feet (N, 2), and outlines (N, 3, SIDES, 2) of stem, side and face of each pin, given (N, 3) each."""
        pins = self._pins
        radius, half = 0.5 * pins.cap_diameter_mm, 0.5 * pins.cap_height_mm
        bevel = min(CAP_BEVEL * pins.cap_height_mm, 0.5 * radius)
        u = np.array([1.0, 0.0, 0.0]) - axis[:, :1] * axis  # direction in which an outline starts (`surfaces`)
        u /= np.linalg.norm(u, axis=1, keepdims=True)
        places = np.arange(RIM_PLACES) * 2 * np.pi / RIM_PLACES
        rim = caps_mm + radius * (np.cos(places)[:, None, None] * u + np.sin(places)[:, None, None] * np.cross(u, axis))
        seen = project(self._view, np.concatenate([rim, caps_mm[None], base_mm[None]]))
        centre, foot = seen[-2, :, None], seen[-1, :, None]
        from_centre = seen[:-2] - seen[-2]
        odd, even = (np.einsum("kj,jnc->nkc", series, from_centre) for series in (self._odd, self._even))
        along = (centre - foot) / np.linalg.norm(caps_mm - base_mm, axis=1)[:, None, None]  # px per mm of the axis

        def disc(factor: float | FloatArray) -> FloatArray:
            return factor * odd + factor**2 * even

        stem = disc(EVENLY * 0.5 * pins.diameter_mm / radius)
        bottom, edge = (centre + height * along + disc(self._cap) for height in (-half, half - bevel))
        face = centre + half * along + disc(self._cap * (1 - bevel / radius))
        return seen[-1], np.stack([_hull(foot + stem, centre - half * along + stem), _hull(bottom, edge, face), face], axis=1)


def _hull(*discs: FloatArray) -> FloatArray:
    """Outline (N, K, 2) around similar closed outlines (N, K, 2) each: its point k is the outermost of their points k."""
    tangent = np.roll(discs[0], -1, axis=1) - np.roll(discs[0], 1, axis=1)
    outward = np.stack([tangent[..., 1], -tangent[..., 0]], axis=-1)
    arm = discs[0] - discs[0].mean(axis=1, keepdims=True)
    outward = outward * np.sign(np.sum(arm * outward, axis=(1, 2)))[:, None, None]
    hull, far = discs[0], np.sum(discs[0] * outward, axis=-1)
    for disc in discs[1:]:
        reach = np.sum(disc * outward, axis=-1)
        hull, far = np.where((reach > far)[..., None], disc, hull), np.maximum(far, reach)
    return hull


@compiled(error_model="numpy")
def draw_polygons(image: FloatArray, polygons: FloatArray, light: FloatArray, inner: BoolArray) -> None:
    """Draw closed polygons (P, K, 2), each with one light (P, C), over the image in the given order.

    A pixel gets a share of the light, equal to the share of its area that the polygon covers. A polygon that is ``inner`` (P,) lies
    within the polygon before it and replaces the light of that one, so that common edges are not blended twice.
    """
    height, width, channels = image.shape
    for p in range(len(polygons)):
        polygon = polygons[p]
        left, right, top, bottom = np.inf, -np.inf, np.inf, -np.inf
        for x, y in polygon:
            left, right, top, bottom = min(left, x), max(right, x), min(top, y), max(bottom, y)
        if not (right > -0.5 and bottom > -0.5 and left < width - 0.5 and top < height - 0.5):
            continue
        x0, y0 = int(np.floor(left + 0.5)), int(np.floor(top + 0.5))
        cover = _cover(polygon, x0, y0, int(right + 0.5) - x0 + 1, int(bottom + 0.5) - y0 + 1)
        for y in range(max(y0, 0), min(y0 + cover.shape[0], height)):
            for x in range(max(x0, 0), min(x0 + cover.shape[1] - 2, width)):
                share = cover[y - y0, x - x0]
                if share > 0:
                    for c in range(channels):
                        image[y, x, c] += share * (light[p, c] - (light[p - 1, c] if inner[p] else image[y, x, c]))


@compiled(error_model="numpy")
def _cover(polygon: FloatArray, x0: int, y0: int, width: int, height: int) -> FloatArray:
    """Covered share of the pixels in a box from (x0, y0); the result has two additional columns.

    Each edge adds to each row the area on its right. The cumulative sum of a row is the coverage.
    """
    cover = np.zeros((height, width + 2))
    count = len(polygon)
    for k in range(count):
        ax, ay = polygon[k, 0] - x0 + 0.5, polygon[k, 1] - y0 + 0.5
        bx, by = polygon[(k + 1) % count, 0] - x0 + 0.5, polygon[(k + 1) % count, 1] - y0 + 0.5
        if ay == by:
            continue
        sign = 1.0
        if ay > by:
            ax, ay, bx, by, sign = bx, by, ax, ay, -1.0
        slope = (bx - ax) / (by - ay)
        for row in range(int(ay), min(int(np.ceil(by)), height)):
            low, high = max(float(row), ay), min(row + 1.0, by)
            _add_edge(cover[row], ax + slope * (low - ay), ax + slope * (high - ay), sign * (high - low))
    for row in range(height):
        total = 0.0
        for column in range(width + 2):
            total += cover[row, column]
            cover[row, column] = min(abs(total), 1.0)
    return cover


@compiled(error_model="numpy")
def _add_edge(row: FloatArray, start: float, end: float, rise: float) -> None:
    """Add an edge to a row of differences. Within the row the edge goes from x = start to x = end and rises by ``rise``."""
    left, right = min(start, end), max(start, end)
    first, last = int(left), int(right)
    if first == last:
        beyond = 0.5 * (left + right) - first
        row[first] += rise * (1 - beyond)
        row[first + 1] += rise * beyond
        return
    steep = rise / (right - left)
    for x in range(first, last + 1):  # the part of the edge within pixel x
        a, b = max(left, float(x)), min(right, x + 1.0)
        part = steep * (b - a)
        beyond = 0.5 * (a + b) - x
        row[x] += part * (1 - beyond)
        row[x + 1] += part * beyond


@compiled(error_model="numpy")
def draw_triangles(image: FloatArray, corners: FloatArray, light: FloatArray, faces: IntArray) -> None:
    """Fill the pixels whose centres lie in triangles ``faces (m, 3)`` over corners (v, 2) with linearly interpolated lights (v, C)."""
    height, width, channels = image.shape
    at = np.empty(channels)
    for f in range(len(faces)):
        i, j, k = faces[f]
        ax, ay = corners[i]
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
                at[c] = light[i, c] + s * dj + t * dk
                step = sx * dj + tx * dk
                for x in range(x0, x1 + 1):
                    image[y, x, c] = at[c] + step * (x - x0)


@compiled(error_model="numpy")
def _inside(slope: float, at_zero: float, low: float, high: float) -> tuple[float, float]:
    """The part of [low, high] where ``at_zero + slope x >= 0``."""
    if slope > 0:
        return max(low, -at_zero / slope), high
    if slope < 0:
        return low, min(high, -at_zero / slope)
    return (low, high) if at_zero >= 0 else (np.inf, -np.inf)
