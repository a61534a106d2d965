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


@compiled(error_model="numpy")
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
    height, width, channels = image.shape
    sides, (stem_light, side_light, face_light) = outlines.shape[2], lights
    quad, black = np.empty((4, 2)), np.zeros(channels, np.float32)
    for p in order:
        for body in range(2):
            shapes = outlines[p, 1:] if body else outlines[p, :1]
            left, right, top, bottom = shapes[..., 0].min(), shapes[..., 0].max(), shapes[..., 1].min(), shapes[..., 1].max()
            if not (right > -0.5 and bottom > -0.5 and left < width - 0.5 and top < height - 0.5):
                continue
            x0, y0 = int(np.floor(left + 0.5)), int(np.floor(top + 0.5))
            # two additional columns take what an edge adds beyond the last pixel; the last channel is the covered share
            cover = np.zeros((int(bottom + 0.5) - y0 + 1, int(right + 0.5) - x0 + 3, channels + 1))
            if not body:
                _add_polygon(cover, shapes[0], stem_light[p], x0, y0, np.sign(_area(shapes[0])))
            else:
                sense = np.sign(_area(shapes[2])) * (1 if facing[p] else -1)
                for band in range(2):
                    for k in range(sides):
                        after = (k + 1) % sides
                        for x in range(2):
                            quad[0, x], quad[1, x] = shapes[band, k, x], shapes[band, after, x]
                            quad[2, x], quad[3, x] = shapes[band + 1, after, x], shapes[band + 1, k, x]
                        if sense * _area(quad) > 0:
                            _add_polygon(cover, quad, side_light[p, band * sides + k], x0, y0, sense)
                if facing[p]:
                    _add_polygon(cover, shapes[2], face_light[p], x0, y0, sense)
                else:
                    _add_polygon(cover, shapes[0], black, x0, y0, -sense)
            _blend(image, cover, x0, y0)


@compiled(error_model="numpy")
def _area(polygon: FloatArray) -> float:
    total = 0.0
    for k in range(len(polygon)):
        total += polygon[k - 1, 0] * polygon[k, 1] - polygon[k, 0] * polygon[k - 1, 1]
    return 0.5 * total


@compiled(error_model="numpy")
def _blend(image: FloatArray, cover: FloatArray, x0: int, y0: int) -> None:
    """Draw the cumulative sum of each row of differences (h, w + 2, C + 1) over the image, its first pixel at (x0, y0)."""
    height, width, channels = image.shape
    total = np.empty(channels + 1)
    for y in range(max(y0, 0), min(y0 + cover.shape[0], height)):
        total[:] = 0.0
        for x in range(x0, min(x0 + cover.shape[1] - 2, width)):
            for c in range(channels + 1):
                total[c] += cover[y - y0, x - x0, c]
            if x >= 0 and total[channels] > 0:
                left = max(1 - total[channels], 0.0)
                for c in range(channels):
                    image[y, x, c] = left * image[y, x, c] + total[c]


@compiled(error_model="numpy")
def _add_polygon(cover: FloatArray, polygon: FloatArray, light: FloatArray, x0: int, y0: int, sense: float) -> None:
    """Add a polygon (K, 2) to differences along the rows of a box from (x0, y0). ``sense`` is the sign of the polygon's area.

    Each edge adds to each row the area on its right. The cumulative sum of a row is the coverage.
    """
    count = len(polygon)
    for k in range(count):
        ax, ay = polygon[k, 0] - x0 + 0.5, polygon[k, 1] - y0 + 0.5
        bx, by = polygon[(k + 1) % count, 0] - x0 + 0.5, polygon[(k + 1) % count, 1] - y0 + 0.5
        if ay == by:
            continue
        sign = -sense
        if ay > by:
            ax, ay, bx, by, sign = bx, by, ax, ay, sense
        slope = (bx - ax) / (by - ay)
        for row in range(int(ay), min(int(np.ceil(by)), len(cover))):
            low, high = max(float(row), ay), min(row + 1.0, by)
            _add_edge(cover[row], light, ax + slope * (low - ay), ax + slope * (high - ay), sign * (high - low))


@compiled(error_model="numpy")
def _add_edge(row: FloatArray, light: FloatArray, start: float, end: float, rise: float) -> None:
    """Add an edge to a row of differences (w, C + 1). Within the row the edge goes from x = start to x = end and rises by ``rise``."""
    left, right = min(start, end), max(start, end)
    first, last = int(left), int(right)
    steep = rise if first == last else rise / (right - left)
    for x in range(first, last + 1):  # the part of the edge within pixel x
        a, b = max(left, float(x)), min(right, x + 1.0)
        part = steep if first == last else steep * (b - a)
        beyond = 0.5 * (a + b) - x
        for c in range(len(light)):
            row[x, c] += part * (1 - beyond) * light[c]
            row[x + 1, c] += part * beyond * light[c]
        row[x, len(light)] += part * (1 - beyond)
        row[x + 1, len(light)] += part * beyond


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
