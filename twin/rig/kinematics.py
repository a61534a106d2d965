"""Kinematics of the rig: a label in robot coordinates becomes the object's path in the sensor's frame.

Work frame of the robot: x, y, z. The sensor, unturned, looks along the approach a0. b0 is the direction across: robot x, or robot y
where the approach is x. It appears in the image at the azimuth ``image_turn``. c0 is a0 x b0. With R the static xyz rotation by
``turn_sign (pose_4..6 + turn_offset)`` and p = ``pose_1..3``,

    origin of the sensor = p + R (tcp_to_dome a0 + tcp_lateral b0 + tcp_aside c0)

The object's frame has z along the approach, is turned about it by ``object_turn``, and leans by ``plate_tilt``. The object stands where
an unturned sensor at the robot's origin indents it by ``zero + contact_offset``, shifted by ``object_shift`` along b0 and c0.
An arm taps along a0, then makes the move in one straight line.

These are poses as commanded. What a force does to them is in ``twin.rig.contact``.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from scenes.body import SkinSpec
from scenes.experiment import ExperimentSpec
from scenes.rig import RigSpec
from scenes.sensor import SensorSpec
from twin.errors import ContactError
from twin.geometry.shapes import shape_of
from twin.mechanics.path import ContactPath
from twin.objects import ObjectField
from twin.rig.labels import ArmLabel

MOST_TURN_DEG = 1.0  # largest turn between two poses of the path; straight pieces then miss the arm's arc by a few um
TOUCH_TOLERANCE_MM = 1e-6  # gap that counts as a touch
TOUCH_POINTS = 20_000  # places on a whole sphere; a dome bulges by less than 2 um between them
MOST_MARCHES = 400  # strides of the search for the first touch; some ten are usual
CLEAR_MM = 10.0  # how far before the tap the search begins; recorded taps of 5 mm begin up to 0.4 mm inside the object

TURNING = {"x": 5, "y": 5, "z": 4}  # by approach: index of the pose's label that turns the tool in the plane of approach and across
_UNTURNED = {  # by approach; columns are the sensor's x (across), y and z (approach) in the work frame
    "x": np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]),
    "y": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
    "z": np.eye(3),
}


@dataclass(frozen=True)
class ArmPath:
    """A contact's way, and what the arm's label would be on it.

    Attributes
    ----------
    path : ContactPath
    labels : list of ArmLabel
        Of each pose of the path.
    touches : bool
        Whether the tap reaches the object.
    """

    path: ContactPath
    labels: list[ArmLabel]
    touches: bool

    def label(self, fraction: float) -> ArmLabel:
        """The label of a state at a fraction of the path: the tap or the move, as far as it has gone."""
        progress = fraction * (len(self.labels) - 1)
        leg = int(np.clip(np.floor(progress), 0, len(self.labels) - 2))
        share, start, stop = progress - leg, self.labels[leg], self.labels[leg + 1]
        pose, move = ((1 - share) * getattr(start, key) + share * getattr(stop, key) for key in ("pose", "move"))
        return ArmLabel(pose, move)


def rig_of(sensor: SensorSpec, before: str | None = None) -> RigSpec:
    """The sensor's rig, as it is before an object of this name (``RigSpec.before``).

    A sensor without a rig gets the plainest: the tool point is the tip, and nothing gives way.
    """
    rig = sensor.rig or RigSpec(tcp_to_dome_mm=-sensor.skin.apex_mm)
    return rig if before is None else rig.before(before)


def object_pose(rig: RigSpec, experiment: ExperimentSpec, pose: np.ndarray, apex_mm: float) -> np.ndarray:
    """``T_sensor_object`` (4, 4) with the arm at a pose (6,), mm and deg; ``apex_mm`` is that of the skin."""
    unturned = _UNTURNED[experiment.approach]
    turn = tool_turn(rig, pose)
    centre = pose[:3] + turn @ unturned @ [rig.tcp_lateral_mm, rig.tcp_aside_mm, rig.tcp_to_dome_mm]
    height_mm = apex_mm + rig.tcp_to_dome_mm - experiment.zero_mm - rig.contact_offset_mm
    surface = unturned @ [*rig.object_shift_mm, height_mm]
    sensor = turn @ unturned
    T = np.eye(4)
    stands = Rotation.from_euler("y", -rig.plate_tilt_deg, degrees=True) * Rotation.from_euler("z", rig.object_turn_deg, degrees=True)
    T[:3, :3] = sensor.T @ unturned @ stands.as_matrix()
    T[:3, 3] = sensor.T @ (surface - centre)
    in_image = np.eye(4)
    in_image[:3, :3] = Rotation.from_euler("z", rig.image_turn_deg, degrees=True).as_matrix()
    return in_image @ T


def tool_turn(rig: RigSpec, pose: np.ndarray) -> np.ndarray:
    """Rotation (3, 3) of the tool in the work frame with the arm at a pose (6,), mm and deg."""
    turn: np.ndarray = Rotation.from_euler(
        "xyz", rig.turn_sign * (np.asarray(pose[3:], float) + rig.turn_offset_deg), degrees=True
    ).as_matrix()
    return turn


def arm_path(rig: RigSpec, experiment: ExperimentSpec, skin: SkinSpec, field: ObjectField, label: ArmLabel) -> ArmPath:
    """The object's way relative to the sensor: first touch, tapped, and moved if the move was executed.

    Parameters
    ----------
    field : ObjectField
        Its origin is a material point of the object, so that the way from pose to pose is also the way that friction sees.

    Raises
    ------
    ContactError
        The sensor is inside the object long before the tap.
    """
    shape = shape_of(skin)

    def at(pose: np.ndarray) -> np.ndarray:
        return object_pose(rig, experiment, pose, skin.apex_mm)

    tap = np.asarray(experiment.tap) * (1 + CLEAR_MM / experiment.tap[experiment.axis])
    tapped = np.asarray(label.pose, float) - label.move
    if experiment.tap_frame == "tool":
        tap = np.concatenate([tool_turn(rig, tapped) @ tap[:3], tap[3:]])
    share, touches = _first_touch(field, at(tapped - tap), at(tapped), shape.outside(shape.even(TOUCH_POINTS)))
    still = np.zeros(6)
    labels = [ArmLabel(tapped - (1 - share) * tap, still), ArmLabel(tapped, still)]
    if label.executed:
        pieces = max(1, int(np.ceil(np.abs(label.move[3:]).max() / MOST_TURN_DEG)))
        labels += [ArmLabel(tapped + k / pieces * label.move, k / pieces * label.move) for k in range(1, pieces + 1)]
    if not touches:
        labels = labels[1:] if len(labels) > 2 else [replace(labels[1], pose=tapped - tap), labels[1]]
    return ArmPath(ContactPath(np.stack([at(each.pose) for each in labels])), labels, touches)


def _first_touch(field: ObjectField, start: np.ndarray, stop: np.ndarray, skin_mm: np.ndarray) -> tuple[float, bool]:
    """Share of the straight way from one pose to another at which the object touches the skin, and whether it touches at all.

    The object advances by its smallest distance to the skin, again and again. Where distances are exact, that never passes the first
    touch (sphere tracing, Hart 1996).
    """
    turn, way = start[:3, :3], stop[:3, 3] - start[:3, 3]
    length_mm = float(np.linalg.norm(way))
    share = 0.0
    free: float | None = None  # the largest share known to be free of contact
    for _ in range(MOST_MARCHES):
        gap_mm = float(field.distance((skin_mm - start[:3, 3] - share * way) @ turn).min())
        if abs(gap_mm) <= TOUCH_TOLERANCE_MM:
            return share, True
        if gap_mm < 0:
            if free is None:
                raise ContactError(f"the object is in the sensor's way {CLEAR_MM:g} mm before the tap; begin it elsewhere")
            share = (share + free) / 2  # far from wires or a mesh a distance can be too large: go half way back
            continue
        free = share
        share += gap_mm / length_mm
        if share >= 1:
            return 1.0, False
    return free or 0.0, True
