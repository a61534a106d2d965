"""The camera's projection: sensor-frame points to raw-frame pixels and back to rays, through the window.

The camera stands in air behind a plane window (acrylic); in front of the window is gel. All planes are normal to z, so a ray stays
in one plane through the axis of the pupil and obeys n sin(theta) = const. With u the tangent of the ray's angle in air and h_k the
height that it crosses in layer k, its distance

    rho(u) = sum_k h_k tan(theta_k),   sin(theta_k) = u / (n_k sqrt(1 + u^2))

from that axis follows. rho grows with u and is concave, so Newton's method from the left converges monotonically.

Distortion: Brown-Conrady (Brown 1966) with x = X / Z, y = Y / Z, r^2 = x^2 + y^2,
x_d = x (1 + k1 r^2 + k2 r^4) + 2 p1 x y + p2 (r^2 + 2 x^2),
y_d = y (1 + k1 r^2 + k2 r^4) + p1 (r^2 + 2 y^2) + 2 p2 x y;
or fisheye (Kannala and Brandt 2006), where the radius is theta (1 + k1 theta^2 + k2 theta^4).

`lens_disc` gives the part of the raw frame that shows the gel: the housing's aperture. `cap_truth` gives the exact truth of a
rendered contact: the place of every cap in space and in the frame.
"""

from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np

from scenes.sensor import CameraSpec, HousingSpec, SensorSpec, ViewSpec
from twin.compiled import compiled
from twin.frames.forms import frame_size, from_raw
from twin.types import BoolArray, FloatArray, Form, PinState

NEWTON_STEPS = 12
"""Steps of Newton's method. It converges quadratically, so the last steps change only the last digits."""
MOST_NEWTON_MOVE = 0.1
"""Largest change of a normalised coordinate in one step, so that a start far from the solution does not jump past the distortion's fold."""
GRAZING = 1e6
"""Tangent beyond which a ray counts as parallel to the window."""
LEAST_FISHEYE_SLOPE = 0.05
"""Least slope of the fisheye's radius by the angle that Newton's method uses. Near the distortion's fold the true slope is smaller."""
CORNERS = 360
"""Corners of the polygon that approximates the aperture's rim."""


@lru_cache(maxsize=64)
def sensor_to_camera(camera: CameraSpec) -> FloatArray:
    """``T_camera_sensor`` (4, 4), read-only: camera looks along +z with x right and y down.

    The entrance pupil is at (0, 0, -distance) of the sensor frame; the camera is turned about it
    by tilt_x (about x), then tilt_y (about y). A positive tilt_x turns the optical axis towards -y of the sensor frame, a positive tilt_y
    towards -x. Then the picture is mirrored left to right, if it is, and turned by ``turn_deg`` from x towards y: of a mirrored picture the
    determinant is negative.
    """
    ax, ay, turn = np.radians([camera.tilt_x_deg, camera.tilt_y_deg, camera.turn_deg])
    rot_x = np.array([[1, 0, 0], [0, np.cos(ax), np.sin(ax)], [0, -np.sin(ax), np.cos(ax)]])
    rot_y = np.array([[np.cos(ay), 0, np.sin(ay)], [0, 1, 0], [-np.sin(ay), 0, np.cos(ay)]])
    rotation = rot_y @ rot_x
    if camera.turn_deg or camera.mirrored:
        rot_z = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
        rotation = rot_z @ np.diag([-1.0 if camera.mirrored else 1.0, 1.0, 1.0]) @ rotation
    T_camera_sensor = np.eye(4)
    T_camera_sensor[:3, :3] = rotation
    T_camera_sensor[:3, 3] = rotation @ [0, 0, camera.distance_mm]
    T_camera_sensor.flags.writeable = False
    return T_camera_sensor


def distort(camera: CameraSpec, xy: FloatArray) -> FloatArray:
    """Tangents (..., 2) of rays in the camera frame to normalised image coordinates."""
    x, y = xy[..., 0], xy[..., 1]
    r2 = x * x + y * y
    if camera.projection == "fisheye":
        radius = np.sqrt(r2)
        scale = _fisheye(camera, np.arctan(radius)) / np.maximum(radius, 1e-12)
        return xy * np.where(radius > 1e-12, scale, 1.0)[..., None]
    radial = 1 + camera.k1 * r2 + camera.k2 * r2 * r2
    across = x * radial + 2 * camera.p1 * x * y + camera.p2 * (r2 + 2 * x * x)
    down = y * radial + camera.p1 * (r2 + 2 * y * y) + 2 * camera.p2 * x * y
    return np.stack([across, down], axis=-1)


def undistort(camera: CameraSpec, seen: FloatArray, *, guess: FloatArray | None = None) -> FloatArray:
    """Normalised image coordinates (..., 2) to tangents: Newton's method on ``distort(ideal) = seen``.

    It starts at ``guess`` (default: ``seen``). The result is meaningless outside the valid field, where the distortion folds back.
    """
    if camera.projection == "fisheye":
        radius = np.linalg.norm(seen, axis=-1)
        angle = radius if guess is None else np.arctan(np.linalg.norm(guess, axis=-1))
        for _ in range(NEWTON_STEPS):
            slope = 1 + 3 * camera.k1 * angle**2 + 5 * camera.k2 * angle**4
            angle = np.clip(angle - (_fisheye(camera, angle) - radius) / np.maximum(slope, LEAST_FISHEYE_SLOPE), 0, np.pi / 2 - 1e-6)
        return seen * (np.tan(angle) / np.maximum(radius, 1e-12))[..., None]
    ideal, step = np.array(seen if guess is None else guess, float), 1e-6
    for _ in range(NEWTON_STEPS):
        along_x, along_y = ((distort(camera, ideal + d) - distort(camera, ideal - d)) / (2 * step) for d in ([step, 0.0], [0.0, step]))
        miss = seen - distort(camera, ideal)
        area = cross_plane(along_x, along_y)
        move = np.stack([cross_plane(miss, along_y), cross_plane(along_x, miss)], axis=-1)
        ideal = ideal + np.clip(move / np.where(np.abs(area) > 1e-6, area, 1e-6)[..., None], -MOST_NEWTON_MOVE, MOST_NEWTON_MOVE)
    return ideal


def project(view: ViewSpec, points_mm: FloatArray) -> FloatArray:
    """Sensor-frame points (..., 3) in front of the camera to raw-frame pixels (..., 2), pixel centres at integers.

    A point's height decides which layers its ray passes. The rays of points behind the window are straight.
    """
    camera = view.camera
    rho = np.sqrt(points_mm[..., 0] ** 2 + points_mm[..., 1] ** 2)
    tangent = window_tangent(view, rho, points_mm[..., 2])
    across = points_mm[..., :2] * (tangent / np.maximum(rho, 1e-12))[..., None]
    in_sensor = np.concatenate([across, np.ones_like(across[..., :1])], axis=-1)
    in_camera = in_sensor @ sensor_to_camera(camera)[:3, :3].T
    return distort(camera, in_camera[..., :2] / in_camera[..., 2:]) * [camera.fx_px, camera.fy_px] + [camera.cx_px, camera.cy_px]


def project_in_form(spec: SensorSpec, form: Form, points_mm: FloatArray) -> FloatArray:
    """As ``project``, to pixels (..., 2) of a sensor's frames of a form; raises as ``twin.frames.forms.from_raw``."""
    return from_raw(spec.recording, form, project(spec.view, points_mm))


def window_tangent(view: ViewSpec, rho_mm: FloatArray, z_mm: FloatArray, *, behind_mm: float | None = None) -> FloatArray:
    """Tangent u of the angle in air of the rays from (0, z0) to (rho, z), where z0 is that of the pupil or ``behind_mm``."""
    back, front, z = view.lens.back_mm, view.lens.z_mm, np.asarray(z_mm, float)
    air = np.minimum(z, back) - (-view.camera.distance_mm if behind_mm is None else behind_mm)
    whole = np.broadcast_arrays(np.asarray(rho_mm, float), air, np.clip(z, back, front) - back, np.maximum(z - front, 0))
    rho, air, window, gel = (each.ravel() for each in whole)
    n_window, n_gel = view.lens.refractive_index, view.gel_index
    u = rho / (air + window / n_window + gel / n_gel)
    _refine_tangents(rho, air, window, gel, n_window, n_gel, u, np.ones(len(rho)))
    return u.reshape(whole[0].shape)


def pixel_rays(view: ViewSpec, pixels: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Places (..., 3), mm, at which the rays of raw-frame pixels (..., 2) enter the gel, and their unit directions (..., 3) in it."""
    camera = view.camera
    ideal = undistort(camera, (np.asarray(pixels, float) - [camera.cx_px, camera.cy_px]) / [camera.fx_px, camera.fy_px])
    in_camera = np.concatenate([ideal, np.ones_like(ideal[..., :1])], axis=-1)
    direction = in_camera @ sensor_to_camera(camera)[:3, :3]
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    place = np.zeros_like(direction)
    place[..., 2] = -camera.distance_mm
    for index, before, height in (
        (1.0, 1.0, view.lens.back_mm + camera.distance_mm),
        (view.lens.refractive_index, 1.0, view.lens.thickness_mm),
        (view.gel_index, view.lens.refractive_index, 0.0),
    ):
        across = direction[..., :2] * before / index
        up = np.sqrt(np.maximum(1 - np.sum(across**2, axis=-1, keepdims=True), 0))
        direction = np.concatenate([across, up], axis=-1)
        place = place + direction * height / np.maximum(up, 1e-12)
    return place, direction


@dataclass(frozen=True)
class Disc:
    """The lens disc in the raw frame.

    Attributes
    ----------
    center_px : (2,) float
    radius_px : float
    inside : (H, W) bool
        Pixels whose centre lies in the disc, or in a rectangular opening.
    """

    center_px: np.ndarray
    radius_px: float
    inside: np.ndarray

    def distance_px(self, points_px: np.ndarray) -> np.ndarray:
        """Distance (...,) of points (..., 2) from the disc's centre, px."""
        return np.linalg.norm(np.asarray(points_px, float) - self.center_px, axis=-1)


def round_disc(size_px: tuple[int, int], center_px: np.ndarray, radius_px: float) -> Disc:
    """A disc in a (width, height) frame."""
    y, x = np.mgrid[: size_px[1], : size_px[0]]
    inside = (x - center_px[0]) ** 2 + (y - center_px[1]) ** 2 <= radius_px**2
    return Disc(np.asarray(center_px, float), float(radius_px), inside)


def lens_disc(view: ViewSpec, housing: HousingSpec) -> Disc:
    """The housing's aperture as the camera sees it: centre and mean radius of its projected rim, and the pixels within it."""
    turn = np.linspace(0, 2 * np.pi, CORNERS, endpoint=False)
    out = np.column_stack([np.cos(turn), np.sin(turn), np.zeros(CORNERS)])
    if housing.aperture_mm is None:
        rim = housing.aperture_radius_mm * out
    else:
        half = np.array(housing.aperture_mm) / 2
        rim = out / np.abs(out[:, :2] / half).max(axis=1, keepdims=True)
    rim_px = project(view, rim + [*housing.center_mm, housing.z_mm])
    center = rim_px.mean(axis=0)
    radius = float(np.linalg.norm(rim_px - center, axis=1).mean())
    disc = round_disc((view.camera.width_px, view.camera.height_px), center, radius)
    if housing.aperture_mm is None:
        return disc
    inside = np.zeros(disc.inside.shape, np.uint8)
    cv2.fillConvexPoly(inside, np.round(rim_px).astype(np.int32), 1)
    return replace(disc, inside=inside.astype(bool))


@compiled(error_model="numpy")
def _refine_tangents(
    rho: FloatArray, air: FloatArray, window: FloatArray, gel: FloatArray, n_window: float, n_gel: float, u: FloatArray, moves: FloatArray
) -> None:
    """Tangents ``u`` (k,) of the angle in air of rays that reach rho (k,) through three layers, by Newton's method.

    The steps of all rays that still move (k,) are one loop without branches, which the compiler turns into vector instructions.
    """
    a, b = n_window * n_window, n_gel * n_gel
    for _ in range(NEWTON_STEPS):
        moving = 0
        for k in range(len(rho)):
            p, q = a + (a - 1) * u[k] * u[k], b + (b - 1) * u[k] * u[k]  # tan(theta) = u / sqrt(p)
            root_p, root_q = np.sqrt(p), np.sqrt(q)
            reach = air[k] * u[k] + window[k] * u[k] / root_p + gel[k] * u[k] / root_q
            slope = air[k] + window[k] * a / (p * root_p) + gel[k] * b / (q * root_q)
            step = (rho[k] - reach) / slope
            after = min(max(u[k] + step, 0.0), GRAZING)
            u[k] = after if moves[k] > 0 else u[k]
            moves[k] = moves[k] if abs(step) > 1e-15 * (1.0 + after) else 0.0
            moving += moves[k] > 0
        if not moving:
            break


def _fisheye(camera: CameraSpec, angle: FloatArray) -> FloatArray:
    return angle * (1 + camera.k1 * angle**2 + camera.k2 * angle**4)


def cross_plane(a: FloatArray, b: FloatArray) -> FloatArray:
    """The third component of the cross product of vectors (..., 2) in a plane."""
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


@dataclass(frozen=True)
class CapTruth:
    """Caps of one contact, in the specification's pin order.

    Attributes
    ----------
    caps_mm : (N, 3) float
        Cap centres, sensor frame.
    caps_px, rest_px : (N, 2) float
        Projections of the cap centres in px of the frame, in the contact and at rest.
    visible : (N,) bool
        The cap's centre is inside the frame, and the line of sight to it meets no other pin.
    """

    caps_mm: FloatArray
    caps_px: FloatArray
    rest_px: FloatArray
    visible: BoolArray


def cap_truth(spec: SensorSpec, rest: PinState, state: PinState, form: Form) -> CapTruth:
    """Ground truth of a contact for frames of the given form."""
    caps_px = project_in_form(spec, form, state.caps_mm)
    rest_px = project_in_form(spec, form, rest.caps_mm)
    inside = np.all((caps_px >= -0.5) & (caps_px <= np.array(frame_size(spec, form)) - 0.5), axis=1)
    return CapTruth(state.caps_mm, caps_px, rest_px, inside & ~find_occluded(spec.view, 0.5 * spec.pins.cap_diameter_mm, state))


def find_occluded(view: ViewSpec, cap_radius_mm: float, state: PinState) -> BoolArray:
    """(N,) bool: the ray in the gel from the window to the cap's centre passes through another pin.

    Each pin is approximated by a capsule of the cap's radius around the axis from foot to cap.
    """
    window_mm, _ = pixel_rays(view, project(view, state.caps_mm))
    return _meets_another(window_mm, state.base_mm, state.caps_mm, cap_radius_mm)


@compiled()
def _meets_another(eyes: FloatArray, base: FloatArray, caps: FloatArray, radius: float) -> BoolArray:
    """(N,) bool: the segment from ``eyes`` to ``caps``, (N, 3) each, comes nearer than ``radius`` to another pin's axis."""
    hidden = np.zeros(len(caps), np.bool_)
    for i in range(len(caps)):
        for j in range(len(caps)):
            if j != i and segment_distance(eyes[i], caps[i], base[j], caps[j]) < radius:
                hidden[i] = True
                break
    return hidden


@compiled()
def segment_distance(p0: FloatArray, p1: FloatArray, q0: FloatArray, q1: FloatArray) -> float:
    """Distance of the segment p0-p1 to the segment q0-q1, (3,) each (Ericson 2004, 5.1.9)."""
    a = b = c = e = f = 0.0
    for k in range(3):
        d1, d2, r = p1[k] - p0[k], q1[k] - q0[k], p0[k] - q0[k]
        a += d1 * d1
        b += d1 * d2
        c += d1 * r
        e += d2 * d2
        f += d2 * r
    denominator = a * e - b * b
    s = (b * f - c * e) / denominator if denominator > 1e-12 else 0.0
    t = min(max((b * min(max(s, 0.0), 1.0) + f) / e, 0.0), 1.0)
    s = min(max((t * b - c) / a, 0.0), 1.0)
    square = 0.0
    for k in range(3):
        square += (p0[k] - q0[k] + s * (p1[k] - p0[k]) - t * (q1[k] - q0[k])) ** 2
    return np.sqrt(square)
