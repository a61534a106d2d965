"""Where the plate was, seen from the sensor, when a frame of a flat-surface recording was taken.

The arm of the published Tac-VGNN recordings goes to ``pose - move``, taps along robot +y into a plate, then moves along
the plate and turns, in one straight move, to ``pose``. Everything happens in one plane: the one that holds the sensor's
axis and robot +x. World coordinates there are X along robot +x and Y along robot +y. With phi the sensor's turn, a its
axis and b across it,

    phi = -(angle + angle_offset),   a = (sin phi, cos phi),   b = (cos phi, -sin phi)
    centre of the dome = TCP + tcp_to_dome a + tcp_lateral b,   TCP = (position along the plate, pose_2)

and the plate is the line Y = Y0 + plate_tilt X, Y0 such that an unturned sensor at X = 0 indents by
``pose_2 + tap + contact_offset``. In a frame whose move was not executed the path ends after the tap.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from training.labels import published_rows
from twin.mechanics.path import ContactPath

TAP_MM = 5.0  # the recordings' meta.json: tap_move


@dataclass(frozen=True)
class SurfaceTap:
    """How the arm of a recording brings the sensor to the plate; fitted, one for each sensor.

    Attributes
    ----------
    contact_offset_mm : float
        Indentation beyond ``pose_2 + TAP_MM`` of an unturned sensor.
    tcp_to_dome_mm : float
        From the TCP, about which the arm turns, to the dome's centre, along the sensor's axis towards the plate
        (negative: the TCP lies in front of the centre).
    tcp_lateral_mm : float
        The same across the axis, towards robot +x.
    angle_offset_deg : float
        Added to ``pose_6``.
    plate_tilt_deg : float
        Rise of the plate towards the sensor's far side along robot +x.
    image_turn_deg : float
        Azimuth of robot +x in the sensor frame, from image x towards image y (about 90: robot +x is down in the image).
    outer_radius_mm : float
        Of the dome.
    """

    contact_offset_mm: float
    tcp_to_dome_mm: float
    tcp_lateral_mm: float
    angle_offset_deg: float
    plate_tilt_deg: float
    image_turn_deg: float
    outer_radius_mm: float = 20.0


@dataclass(frozen=True)
class SurfaceRow:
    """One frame's row of ``targets.csv``, in mm and deg, as published; ``executed``: the move was done when the frame was taken."""

    pose_2_mm: float
    pose_6_deg: float
    move_1_mm: float
    move_6_deg: float
    executed: bool


# Fitted to the Tac-VGNN recordings (Apache-2.0)
RECORDED_TAPS = {
    "mg400-331": SurfaceTap(0.346, -17.32, 0.74, -1.29, -0.705, 89.72),
    "mg400-127": SurfaceTap(0.160, 2.14, 0.17, 0.55, 0.750, 90.09),
}


def read_surface_rows(folder: Path) -> list[SurfaceRow]:
    """Rows of a flat-surface recording, in order; without ``move_executed.csv`` every move counts as executed.

    Raises
    ------
    FrameError
        As ``published_rows``.
    """
    rows, executed = published_rows(folder)
    keys = ("pose_2", "pose_6", "move_1", "move_6")
    return [SurfaceRow(*(float(row[key]) for key in keys), bool(done > 0.5)) for row, done in zip(rows, executed, strict=True)]


def recorded_path(tap: SurfaceTap, row: SurfaceRow) -> ContactPath | None:
    """The plate's way relative to the sensor: first touch, tapped, and moved if the move was executed.

    Parameters
    ----------
    tap : SurfaceTap
    row : SurfaceRow

    Returns
    -------
    ContactPath or None
        Of an object whose surface is z = 0 and which fills z >= 0. Its origin is a material point of the plate, so that
        the way from pose to pose is also the way that friction sees. None without contact.
    """
    before = (row.pose_6_deg - row.move_6_deg, -row.move_1_mm)
    indent_mm = indentation_mm(tap, row.pose_2_mm, *before)
    if indent_mm <= 0:
        return None
    touch_mm = row.pose_2_mm - indent_mm / np.cos(np.radians(tap.plate_tilt_deg))
    poses = [_plate_pose(tap, touch_mm, *before), _plate_pose(tap, row.pose_2_mm, *before)]
    if row.executed:
        poses.append(_plate_pose(tap, row.pose_2_mm, row.pose_6_deg, 0.0))
    return ContactPath(np.stack(poses))


def indentation_mm(tap: SurfaceTap, pose_2_mm: float, angle_deg: float, along_mm: float) -> float:
    """How far the undeformed dome reaches into the plate, for an angle as ``pose_6`` and a position of the TCP along robot +x."""
    T = _plate_pose(tap, pose_2_mm, angle_deg, along_mm)
    return tap.outer_radius_mm - float(T[:3, 2] @ T[:3, 3])


def _plate_pose(tap: SurfaceTap, pose_2_mm: float, angle_deg: float, along_mm: float) -> np.ndarray:
    phi, tilt = np.radians([-(angle_deg + tap.angle_offset_deg), tap.plate_tilt_deg])
    axis, across = np.array([np.sin(phi), np.cos(phi)]), np.array([np.cos(phi), -np.sin(phi)])
    centre = np.array([along_mm, pose_2_mm]) + tap.tcp_to_dome_mm * axis + tap.tcp_lateral_mm * across
    surface = np.array([0.0, tap.outer_radius_mm + tap.tcp_to_dome_mm - TAP_MM - tap.contact_offset_mm])
    turn = -(tilt + phi)  # about the normal of the plane of motion, z towards x
    T = np.eye(4)
    T[:3, :3] = [[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]]
    T[:3, 3] = [(surface - centre) @ across, 0, (surface - centre) @ axis]
    c, s = np.cos(np.radians(tap.image_turn_deg)), np.sin(np.radians(tap.image_turn_deg))
    turn_image = np.eye(4)
    turn_image[:2, :2] = [[c, -s], [s, c]]
    return turn_image @ T
