"""The 3D scene of the page: skin, pins, object, force, and the gizmo with which the user moves the object."""

from collections.abc import Callable, Sequence
from contextlib import suppress
from enum import StrEnum
from typing import Any

import cv2
import numpy as np
import viser
from scipy.interpolate import make_interp_spline
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from scenes.object import ObjectSpec
from scenes.sensor import PinsSpec, SensorSpec
from twin.geometry.mesh import SensorMesh
from twin.objects import build_field
from twin.optics.surfaces import PaintedSurface, lathe
from twin.report.skin3d import object_surface
from twin.types import ContactState, FloatArray, PinState

FINER = 2
"""Number of parts along each side of a mesh element in the drawn skin."""
OBJECT_BOX_MM = (-22.0, 22.0, -22.0, 22.0, -1.0, 20.0)
"""Box of the object's frame, mm, whose part of the object is shown, because many objects are infinite."""
OBJECT_SAMPLES = 44
"""Number of samples along each side of that box. The surface then has some thousand vertices."""
SIDES = 8
"""Number of sides of a drawn pin."""
FORCE_MM_PER_N = 4.0
"""Length of the force's arrow, mm per N."""
LEAST_FORCE_N = 0.01
"""Least force, N, for which an arrow is drawn."""
NEAR_FOOT_MM = 2.5
"""Largest distance, mm, of a point in contact from the pin's foot to which it belongs. The foot is on the skin's inside."""
HOLDER_MM = 14.0
"""Height of the drawn holder, mm."""
SKIN_RGB, OBJECT_RGB, HOLDER_RGB, FORCE_RGB = (128, 146, 184), (120, 168, 232), (78, 85, 98), (255, 176, 32)
UNSHADED: dict[str, Any] = {"cast_shadow": False, "receive_shadow": False}
SURFACE: dict[str, Any] = {"side": "double", **UNSHADED}
"""How solids and surfaces are drawn."""
GIZMO_MM = 16.0
"""Size of the gizmo, mm."""
GLOW = cv2.applyColorMap(np.linspace(0.22 * 255, 0.97 * 255, 256).astype(np.uint8)[:, None], cv2.COLORMAP_INFERNO)[:, 0, ::-1]
"""Colours (256, 3) RGB of pins, for increasing values."""


class PinColour(StrEnum):
    """Quantities that the pins' colours can show."""

    DISPLACEMENT = "displacement"
    PRESSURE = "pressure"
    SLIP = "slip"


FULL_SCALE = {PinColour.DISPLACEMENT: (4.0, "mm"), PinColour.PRESSURE: (0.05, "MPa"), PinColour.SLIP: (1.0, "slipping share")}
"""Value with the brightest colour, and its unit."""


class SmoothSkin:
    """The outer skin's surface, smoothly interpolated between the nodes of the mesh.

    Parameters
    ----------
    mesh : SensorMesh
    """

    def __init__(self, mesh: SensorMesh) -> None:
        _, rows, columns = mesh.grid
        self._grid = rows, columns
        self._down, self._right = _finer(rows), _finer(columns)
        high, wide = len(self._down), len(self._right)
        index = np.arange(high * wide).reshape(high, wide)
        quads = np.stack([index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]], axis=-1).reshape(-1, 4)
        faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
        self.rest = PaintedSurface(self.corners(mesh.nodes_mm), faces)
        corners = self.rest.vertices_mm[faces]
        outward = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        if np.median((outward * corners.mean(axis=1)).sum(axis=1)) < 0:
            self.rest = PaintedSurface(self.rest.vertices_mm, faces[:, ::-1])

    def corners(self, nodes_mm: FloatArray) -> FloatArray:
        """Vertices (v, 3) float32 for nodes (n, 3) of the mesh."""
        rows, columns = self._grid
        outer = nodes_mm[: rows * columns].reshape(rows, columns, 3)
        return np.einsum("ai,ijk,bj->abk", self._down, outer, self._right, optimize=True).reshape(-1, 3).astype(np.float32)


def _finer(count: int) -> FloatArray:
    """Matrix (FINER (count - 1) + 1, count) from values at nodes to a cubic spline through them, at the nodes and between them."""
    at = np.arange(count)
    return np.asarray(make_interp_spline(at, np.eye(count), k=3)(np.linspace(0, count - 1, FINER * (count - 1) + 1)))


def pin_values(state: ContactState, rest: ContactState, shown: PinColour) -> FloatArray:
    """The shown value of each pin, (N,): displacement of its cap, mm, or mean pressure, MPa, or slipping share of the skin at its foot."""
    if shown is PinColour.DISPLACEMENT:
        return np.linalg.norm(state.caps_mm - rest.caps_mm, axis=1)
    count = len(state.base_mm)
    if not len(state.contact_mm):
        return np.zeros(count)
    away, pin = cKDTree(state.base_mm).query(state.contact_mm)
    near = away < NEAR_FOOT_MM
    weight = np.bincount(pin[near], state.point_area_mm2[near], minlength=count)
    amount = state.normal_n if shown is PinColour.PRESSURE else state.slipping * state.point_area_mm2
    return np.asarray(np.bincount(pin[near], amount[near], minlength=count) / np.maximum(weight, 1e-9))


def colours(values: FloatArray, shown: PinColour) -> np.ndarray:
    """Colours (N, 3) uint8 of values (N,)."""
    return GLOW[np.clip(255 * values / FULL_SCALE[shown][0], 0, 255).astype(int)]


def turns_to(axis: FloatArray) -> FloatArray:
    """Quaternions (N, 4), w first, that turn -z to unit vectors (N, 3)."""
    turn = np.stack([1 - axis[:, 2], axis[:, 1], -axis[:, 0], np.zeros(len(axis))], axis=1)
    straight = turn[:, 0] < 1e-9
    turn[straight] = 0, 1, 0, 0
    return np.asarray(turn / np.linalg.norm(turn, axis=1, keepdims=True), np.float32)


def quaternion(T: FloatArray) -> FloatArray:
    """Quaternion (4,), w first, of a pose (4, 4)."""
    return np.asarray(Rotation.from_matrix(T[:3, :3]).as_quat(scalar_first=True))


def matrix(wxyz: FloatArray, position: FloatArray) -> FloatArray:
    """Pose (4, 4) of a quaternion (4,), w first, and a position (3,)."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat(wxyz, scalar_first=True).as_matrix()
    T[:3, 3] = position
    return T


def pin_shape(pins: PinsSpec) -> PaintedSurface:
    """A pin that points along -z, with the centre of its cap at the origin; stem and cap are tubes."""
    half, length = pins.cap_height_mm / 2, pins.length_mm + pins.cap_height_mm / 2
    stem, cap = pins.diameter_mm / 2, pins.cap_diameter_mm / 2
    profile = np.array([[stem, -length], [stem, -half], [cap, -half], [cap, half], [0, half]])
    return lathe(profile, np.zeros((1, 3)), np.array([[0.0, 0.0, -1.0]]), SIDES)


class PinScene:
    """Skin, pins, object and force in a server's scene, which all browsers share.

    Parameters
    ----------
    server : viser.ViserServer
    sensor : SensorSpec
    skin : PaintedSurface
        The skin at rest.
    rest : PinState
    """

    def __init__(self, server: viser.ViserServer, sensor: SensorSpec, skin: PaintedSurface, rest: PinState) -> None:
        radius_mm, pin = max(sensor.skin.half_size_mm), pin_shape(sensor.pins)
        self._scene = server.scene
        self._scene.configure_environment_map(None)
        self._scene.configure_default_lights(enabled=True, cast_shadow=False)
        self._scene.add_light_ambient("/light", intensity=2.0)
        server.initial_camera.position = (1.2 * radius_mm, -3.4 * radius_mm, 1.7 * radius_mm)
        server.initial_camera.look_at = (0.0, 0.0, 0.7 * sensor.skin.apex_mm)
        self._skin = self._scene.add_mesh_simple("/sensor/skin", skin.vertices_mm, skin.faces, color=SKIN_RGB, opacity=0.45, **SURFACE)
        self._pins = self._scene.add_batched_meshes_simple(
            "/sensor/pins",
            pin.vertices_mm,
            pin.faces,
            turns_to(rest.axis),
            rest.caps_mm.astype(np.float32),
            batched_colors=colours(np.zeros(len(rest.caps_mm)), PinColour.DISPLACEMENT),
            lod="off",
            **SURFACE,
        )
        place = {"color": HOLDER_RGB, "position": (0.0, 0.0, sensor.skin.rim_z_mm - HOLDER_MM / 2 - 0.05)} | UNSHADED
        if sensor.skin.shape == "rectangular-pad":
            across, along = (2.04 * half for half in sensor.skin.half_size_mm)
            self._scene.add_box("/sensor/holder", dimensions=(across, along, HOLDER_MM), **place)
        else:
            self._scene.add_cylinder("/sensor/holder", radius=1.02 * radius_mm, height=HOLDER_MM, **place)
        self._scene.add_frame("/sensor/axes", axes_length=6.0, axes_radius=0.15, position=(-1.6 * radius_mm, 0.0, 0.0))
        self._force = self._scene.add_arrows(
            "/force", np.zeros((1, 2, 3)), FORCE_RGB, shaft_radius=0.35, head_radius=0.9, head_length=1.8, visible=False
        )
        self._object: viser.MeshHandle | None = None

    def put_object(self, obj: ObjectSpec, bounds_mm: Sequence[float] = OBJECT_BOX_MM) -> None:
        """Show another object, or another part of it: that in a box (x0, x1, y0, y1, z0, z1) of its frame."""
        surface = object_surface(build_field(obj).distance, np.eye(4), bounds_mm=bounds_mm, samples=OBJECT_SAMPLES).triangulate()
        corners, faces = np.asarray(surface.points, np.float32), np.asarray(surface.regular_faces)
        self._object = self._scene.add_mesh_simple("/object", corners, faces, color=OBJECT_RGB, opacity=0.35, **SURFACE)

    def show_pins(self, pins: PinState, skin_mm: FloatArray, colour: np.ndarray) -> None:
        """Show pins with their colours (N, 3) uint8, and the skin's vertices (v, 3)."""
        self._skin.vertices = skin_mm
        self._pins.batched_positions = pins.caps_mm.astype(np.float32)
        self._pins.batched_wxyzs = turns_to(pins.axis)
        self._pins.batched_colors = colour

    def show_object(self, T: FloatArray) -> None:
        """Show the object at ``T_sensor_object`` (4, 4)."""
        if self._object is not None:
            self._object.position, self._object.wxyz = T[:3, 3], quaternion(T)

    def show_force(self, foot_mm: FloatArray, force_n: FloatArray) -> None:
        """Show the force (3,) on the object as an arrow at a place (3,), unless the force is too small."""
        self._force.visible = bool(np.linalg.norm(force_n) > LEAST_FORCE_N)
        if self._force.visible:
            self._force.points = np.stack([foot_mm, foot_mm + FORCE_MM_PER_N * force_n])[None].astype(np.float32)


class Scene(PinScene):
    """The scene of a moving contact: it also has the solved skin and the gizmo.

    Parameters
    ----------
    server : viser.ViserServer
    sensor : SensorSpec
    mesh : SensorMesh
    rest : ContactState
    """

    def __init__(self, server: viser.ViserServer, sensor: SensorSpec, mesh: SensorMesh, rest: ContactState) -> None:
        self._skin_shape, self._rest = SmoothSkin(mesh), rest
        super().__init__(server, sensor, self._skin_shape.rest, rest)
        self.gizmo = self._scene.add_transform_controls("/wish", scale=GIZMO_MM, depth_test=False, line_width=3.0)
        self.dragging = False

    def on_drag(self, moved: Callable[[FloatArray, bool], None]) -> None:
        """Call a function with each pose (4, 4) of the gizmo that a user drags, and whether the drag ends with it.

        It is called in the server's event loop, in order. Therefore it must return at once.
        """

        @self.gizmo.on_update
        async def _(event: viser.TransformControlsEvent) -> None:
            self.dragging = event.phase != "end"
            with suppress(ValueError):  # a quaternion of length zero, which no gizmo sends
                moved(matrix(event.target.wxyz, event.target.position), event.phase == "end")

    def place_gizmo(self, T: FloatArray) -> None:
        """Move the gizmo to a pose (4, 4), unless a user drags it."""
        if not self.dragging:
            self.gizmo.position, self.gizmo.wxyz = T[:3, 3], quaternion(T)

    def show(self, state: ContactState, shown: PinColour) -> None:
        """Show a state of the sensor and its object."""
        self.show_pins(state, self._skin_shape.corners(state.nodes_mm), colours(pin_values(state, self._rest, shown), shown))
        self.show_object(state.T_sensor_object)
        foot = np.average(state.contact_mm, axis=0, weights=state.normal_n) if state.normal_n.sum() > 0 else np.zeros(3)
        self.show_force(foot, state.force_n)
