"""The camera's projection: sensor-frame points to raw-frame pixels and back to rays.

Brown-Conrady distortion (Brown 1966): with x = X / Z, y = Y / Z, r^2 = x^2 + y^2,
x_d = x (1 + k1 r^2 + k2 r^4) + 2 p1 x y + p2 (r^2 + 2 x^2),
y_d = y (1 + k1 r^2 + k2 r^4) + p1 (r^2 + 2 y^2) + 2 p2 x y.
"""

import numpy as np

from scenes.sensor import CameraSpec

NEWTON_STEPS = 12  # quadratic: the last ones only polish
MOST_NEWTON_MOVE = 0.1  # per step, normalised: keeps far starts from jumping past the fold


def sensor_to_camera(camera: CameraSpec) -> np.ndarray:
    """``T_camera_sensor`` (4, 4): camera looks along +z with x right and y down.

    The pinhole is at (0, 0, -distance) of the sensor frame; the camera is turned about it
    by tilt_x (about x), then tilt_y (about y).
    """
    ax, ay = np.radians([camera.tilt_x_deg, camera.tilt_y_deg])
    rot_x = np.array([[1, 0, 0], [0, np.cos(ax), np.sin(ax)], [0, -np.sin(ax), np.cos(ax)]])
    rot_y = np.array([[np.cos(ay), 0, np.sin(ay)], [0, 1, 0], [-np.sin(ay), 0, np.cos(ay)]])
    T_camera_sensor = np.eye(4)
    T_camera_sensor[:3, :3] = rot_y @ rot_x
    T_camera_sensor[:3, 3] = rot_y @ rot_x @ [0, 0, camera.distance_mm]
    return T_camera_sensor


def distort(camera: CameraSpec, xy: np.ndarray) -> np.ndarray:
    """Ideal normalised image coordinates (..., 2) to distorted ones."""
    x, y = xy[..., 0], xy[..., 1]
    r2 = x * x + y * y
    radial = 1 + camera.k1 * r2 + camera.k2 * r2 * r2
    return np.stack(
        [
            x * radial + 2 * camera.p1 * x * y + camera.p2 * (r2 + 2 * x * x),
            y * radial + camera.p1 * (r2 + 2 * y * y) + 2 * camera.p2 * x * y,
        ],
        axis=-1,
    )


def undistort(camera: CameraSpec, seen: np.ndarray, *, guess: np.ndarray | None = None) -> np.ndarray:
    """Distorted normalised coordinates (..., 2) to ideal ones: Newton's method on ``distort(ideal) = seen``.

    Starts at ``guess`` (default: ``seen``). Meaningless where the distortion folds back, outside its valid field.
    """
    ideal, step = np.array(seen if guess is None else guess, float), 1e-6
    for _ in range(NEWTON_STEPS):
        along_x, along_y = ((distort(camera, ideal + d) - distort(camera, ideal - d)) / (2 * step) for d in ([step, 0.0], [0.0, step]))
        miss = seen - distort(camera, ideal)
        area = _cross(along_x, along_y)
        move = np.stack([_cross(miss, along_y), _cross(along_x, miss)], axis=-1)
        ideal = ideal + np.clip(move / np.where(np.abs(area) > 1e-6, area, 1e-6)[..., None], -MOST_NEWTON_MOVE, MOST_NEWTON_MOVE)
    return ideal


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def project(camera: CameraSpec, points_mm: np.ndarray) -> np.ndarray:
    """Sensor-frame points (..., 3) to raw-frame pixels (..., 2), pixel centres at integers."""
    T = sensor_to_camera(camera)
    in_camera = points_mm @ T[:3, :3].T + T[:3, 3]
    xy = distort(camera, in_camera[..., :2] / in_camera[..., 2:])
    return xy * [camera.fx_px, camera.fy_px] + [camera.cx_px, camera.cy_px]


def pixel_rays(camera: CameraSpec, pixels: np.ndarray) -> np.ndarray:
    """Unit ray directions (..., 3) in the camera frame for raw-frame pixels (..., 2)."""
    xy = (np.asarray(pixels, float) - [camera.cx_px, camera.cy_px]) / [camera.fx_px, camera.fy_px]
    ideal = undistort(camera, xy)
    rays = np.concatenate([ideal, np.ones_like(ideal[..., :1])], axis=-1)
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)
