"""Plans the path of an arm to the pose clear of an object: from any pose, around the object and not through it."""

import numpy as np

from hardware.errors import DeviceError
from hardware.rig.geometry import PlacedObject, distance_to_axis
from twin.rig.arm_pose import matrix_of, pose_of

# Distance between the dome and the circle around the object, in mm.
MARGIN_MM = 10.0
# Largest angle between two poses along this circle, in deg.
STEP_DEG = 30.0
# Distance, in mm, between the points of a straight path at which the gap is checked.
SAMPLE_MM = 1.0


def path_around(placed: PlacedObject, start: np.ndarray, clear: np.ndarray) -> list[np.ndarray]:
    """Poses (6,) of the path from ``start``; the last one is ``clear``.

    The path is straight if the dome stays outside a circle around the object's section. Otherwise the arm first leaves the circle if it is
    inside, and then takes the shorter way along it, with the sensor turned towards the object. The object is treated as infinitely high.
    Therefore the path avoids it at every height. The arm's links and the object's holder are not known and not considered.

    An infinite object (a plane, an edge) can't be passed. Only its surface is considered, and the path is straight.

    Raises
    ------
    DeviceError
        The straight path to an infinite object leads through it.
    """
    outline = placed.outline()
    if not np.allclose(outline[0], outline[-1]):
        _require_in_front(placed, start, clear)
        return [clear]
    surface = outline @ placed.T_base_object[:2, [0, 2]].T + placed.T_base_object[:2, 3]
    middle = (surface.min(axis=0) + surface.max(axis=0)) / 2
    radius_mm = np.linalg.norm(surface - middle, axis=1).max() + placed.mounting.skin_reach_mm + MARGIN_MM
    T = matrix_of(clear)
    domes = [matrix_of(pose)[:2, :3] @ placed.mounting.centre_mm + pose[:2] - middle for pose in (start, clear)]
    if distance_to_axis(*domes) >= min(radius_mm, np.linalg.norm(domes[1])):
        return [clear]
    angle, end = (np.arctan2(dome[1], dome[0]) for dome in domes)
    turn = (angle - end + np.pi) % (2 * np.pi) - np.pi  # from the clear pose back to the start's side
    outward_mm = max(0.0, radius_mm / np.cos(np.radians(STEP_DEG / 2)) - np.linalg.norm(domes[1]))
    way, last = [], start
    inside_mm = np.linalg.norm(domes[1]) + outward_mm - np.linalg.norm(domes[0])
    if inside_mm > 0:
        last = start.copy()
        last[:2] += inside_mm * np.array([np.cos(angle), np.sin(angle)])
        way.append(last)
    for at in np.linspace(turn, 0.0, int(np.ceil(abs(np.degrees(turn)) / STEP_DEG)) + 1):
        spun = _spun(T, at, middle)
        spun[:2, 3] += outward_mm * np.array([np.cos(end + at), np.sin(end + at)])
        last = pose_of(spun, last)
        way.append(last)
    if outward_mm > 0:
        way.append(clear)
    return way


def _require_in_front(placed: PlacedObject, start: np.ndarray, clear: np.ndarray) -> None:
    """Raise ``DeviceError`` unless the dome's centre stays in front of the surface on its straight path. The path may begin in contact."""
    ends = [matrix_of(pose)[:3, :3] @ placed.mounting.centre_mm + pose[:3] for pose in (start, clear)]
    samples = max(2, int(np.ceil(np.linalg.norm(ends[1] - ends[0]) / SAMPLE_MM)))
    gap_mm = min(placed.distance_mm(ends[0] + share * (ends[1] - ends[0])) for share in np.linspace(0.0, 1.0, samples))
    if gap_mm < 0.0:
        raise DeviceError(
            f"the straight path to the {placed.spec.name} leads {-gap_mm:.0f} mm behind its surface, whose extent is not known; jog the "
            "arm to the side from which the sensor is to touch it, or correct the object's place ('placement' in the file for `servo`)"
        )


def _spun(T: np.ndarray, angle: float, middle: np.ndarray) -> np.ndarray:
    """A pose (4, 4) turned about the vertical through ``middle`` (2,)."""
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, -s], [s, c]])
    out = T.copy()
    out[:2, :3] = turn @ T[:2, :3]
    out[:2, 3] = middle + turn @ (T[:2, 3] - middle)
    return out
