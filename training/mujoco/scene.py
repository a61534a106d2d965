"""TacTips in a MuJoCo model: in each step the surrogate computes the contact of each sensor, and its forces act on sensor and object.

A sensor is a site of the model: its frame is the sensor's, with the origin at the centre of the dome and z out of its apex. Each sensor
touches one geom at a time: the one that is deepest in its dome; it stays at this geom until the contact ends. MuJoCo must not compute the
same contact itself: the soft part of a sensor has no geom that collides (``training.mujoco.model`` makes sensors so).

MuJoCo integrates velocities before positions (symplectic Euler). With forces at the present pose, this adds no energy to an elastic
contact. Therefore ``step`` uses ``mj_step1`` and ``mj_step2``: after ``mj_step`` the poses in ``data`` are those of the step before.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from scenes import SensorSpec, load_sensor
from training.environments.observe import Pictures, SensorView
from training.mujoco.model import MESH_OFF_MM, MM, solid_of
from training.surrogate.contacts import SurrogateContacts
from training.surrogate.model import surrogate_of
from training.surrogate.solids import distances_to
from twin.camera.projection import project_in_form
from twin.compiled import compiled
from twin.errors import OptionError
from twin.pins import Pipeline
from twin.types import FloatArray, Form, Frame, IntArray, Observation, PinState

Arrays = tuple[Any, ...]
NEAR_MM = 2.0
"""Distance between dome and geom from which the motion towards it is followed."""
STOP_N_PER_MM = 20.0
"""Stiffness with which a geom is pushed out that is deeper in the dome than the surrogate was trained for."""
STOP_RETURNS = 0.5
"""Share of this force while the geom moves out again, so that the stop takes energy away."""
LOSS_S_PER_M = 1.0
"""Loss of skin and gel: forces grow by this factor times the speed of indentation (Hunt and Crossley 1975). It is assumed, not measured. A
light ball at 0.2 m/s keeps some 0.85 of its speed."""
MOST_GROWTH = 2.0
"""Largest factor of this loss."""


@dataclass(frozen=True)
class TactileReading:
    """The contact of one sensor.

    Attributes
    ----------
    geom : str
        The touched geom's name; "" without contact.
    force_n, torque_nmm : (3,) float
        Wrench on the geom, sensor frame, about the sensor's origin.
    caps_mm, pins_px : (N, 3), (N, 2) float
        Centres of the pins' caps, sensor frame, and in the sensor's frame without noise.
    depth_mm, area_mm2, slip : float
        Depth of the geom in the undeformed dome, contact area, and share of this area that slides.
    lost : str
        Why the contact can't be computed, or "". Caps, area and slip are then those of the last computed contact.
    beside : tuple of str
        Further geoms in the dome. They are not felt.
    """

    geom: str
    force_n: FloatArray
    torque_nmm: FloatArray
    caps_mm: FloatArray
    pins_px: FloatArray
    depth_mm: float
    area_mm2: float
    slip: float
    lost: str
    beside: tuple[str, ...]


class TactileScene:
    """A MuJoCo model with TacTips.

    Parameters
    ----------
    model : mujoco.MjModel
    sensors : mapping of str to str or SensorSpec
        For each sensor's site: a sensor's name, file or specification.
    touchable : sequence of str, optional
        Names of the geoms that the sensors can touch. By default all that collide with others and are not of the sensor's own body.
    data : mujoco.MjData, optional
    loss_s_per_m : float
        Loss of skin and gel, see ``LOSS_S_PER_M``; with 0 a contact without friction is elastic.
    surrogates : mapping of str to path, optional
        By a sensor's name the file that ``twin surrogate`` wrote. It is needed for a sensor of which the package has none.

    Attributes
    ----------
    model, data : MjModel, MjData
    sensors : dict of str to SensorSpec

    Raises
    ------
    OptionError
        There is no such site or geom, a geom can't be touched, or the integrator is RK4.
    SurrogateError
        A sensor has no surrogate.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        sensors: Mapping[str, str | SensorSpec],
        *,
        touchable: Sequence[str] | None = None,
        data: mujoco.MjData | None = None,
        loss_s_per_m: float = LOSS_S_PER_M,
        surrogates: Mapping[str, str | Path] | None = None,
    ) -> None:
        if model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4:
            raise OptionError("integrator RK4 computes forces between two steps; choose Euler, implicit or implicitfast")
        self.model, self.data = model, mujoco.MjData(model) if data is None else data
        self._loss = loss_s_per_m
        self.sensors = {site: load_sensor(each) if isinstance(each, str) else each for site, each in sensors.items()}
        self._site = np.array([_number_of(model, mujoco.mjtObj.mjOBJ_SITE, site) for site in self.sensors], int)
        self._body = model.site_bodyid[self._site]
        geoms = [_number_of(model, mujoco.mjtObj.mjOBJ_GEOM, name) for name in touchable or ()]
        if touchable is None:
            geoms = np.flatnonzero(model.geom_contype | model.geom_conaffinity).tolist()
        self._geom, of = np.array(geoms, int), [solid_of(model, geom) for geom in geoms]
        self._solid, self._pose = [each for each, _ in of], np.array([pose for _, pose in of]).reshape(-1, 4, 4)
        sizes = np.zeros((len(of), 4))
        for row, each in enumerate(self._solid):
            sizes[row, : len(each.sizes)] = each.sizes
        fixed = np.where(model.body_weldid > 0, model.body_weldid, -np.arange(model.nbody))  # bodies of the world are no parts of a sensor
        own, bound = fixed[model.geom_bodyid[self._geom]][None] == fixed[self._body][:, None], model.geom_rbound[self._geom]
        reach = np.where(bound > 0, MM * bound + MESH_OFF_MM, np.inf)  # a plane has no bound
        self._solids = np.array([each.kind for each in self._solid], np.int64), sizes, reach, own
        specs = list(dict.fromkeys(self.sensors.values()))
        self._set = np.array([specs.index(each) for each in self.sensors.values()], int)  # of each sensor: number of its contacts
        self._row = np.array([int((self._set[:place] == number).sum()) for place, number in enumerate(self._set)], int)  # row in them
        counts = np.bincount(self._set, minlength=len(specs)).tolist()
        surrogate = [surrogate_of(each, (surrogates or {}).get(each.name)) for each in specs]
        self._contacts = [SurrogateContacts(*each, few=True) for each in zip(surrogate, specs, counts, strict=True)]
        self._radius = np.array([self._contacts[number].radius_mm for number in self._set])
        self._views: dict[tuple[str, Pictures], SensorView] = {}
        self.reset()

    def reset(self) -> None:
        """Forget all contacts, and the forces that acted in the last step. The state in ``data`` stays."""
        count = len(self._site)
        self._at = np.full(count, -1)  # the solid that each sensor touches
        self._gap = np.full((count, len(self._geom)), np.inf)
        self._lost = np.zeros(count, bool)
        self._wrench = np.zeros((count, 6))  # N, N mm, sensor frame, on the geom
        self._solved = np.zeros((count, 7))  # the newest wrench that could be computed, and its depth
        self._applied = np.zeros_like(self.data.xfrc_applied)
        for contacts in self._contacts:
            for row in range(len(contacts.felt.lost)):
                contacts.rest(row)

    def step(self, count: int = 1) -> None:
        """Step the model; the skins' forces are those at the beginning of each step."""
        for _ in range(count):
            mujoco.mj_step1(self.model, self.data)
            self.apply()
            mujoco.mj_step2(self.model, self.data)

    def apply(self) -> None:
        """Compute the contacts at the poses in ``data``, and set their forces in ``data.xfrc_applied``, beside those of others there.

        For an own loop: ``mj_step1``, ``apply``, ``mj_step2``.
        """
        data, before, normal = self.data, self._gap.copy(), np.empty((*self._gap.shape, 3))
        poses = data.site_xpos, data.site_xmat, self._site, data.geom_xpos, data.geom_xmat, self._geom, self._pose
        _gaps(poses, self._solids, self._radius, self._gap, normal)
        for sensor in range(len(self._site)):
            self._choose(sensor)
        T = _relative(poses, self._at)
        for number, contacts in enumerate(self._contacts):
            mine = np.flatnonzero((self._at >= 0) & (self._set == number))
            if len(mine):
                rows, felt = self._row[mine], contacts.felt
                contacts.move(rows, T[mine], np.full(len(mine), data.time))
                for sensor, row in zip(mine.tolist(), rows.tolist(), strict=True):
                    self._lost[sensor] = bool(felt.lost[row])
                    if not felt.lost[row]:
                        solved = self._solved[sensor]
                        solved[:3], solved[3:6], solved[6] = felt.force_n[row], felt.torque_nmm[row], -self._gap[sensor, self._at[sensor]]
        bodies, state = (self.model.geom_bodyid, self._body, data.xipos), (self._gap, before, normal, self._lost, self._solved)
        data.xfrc_applied -= self._applied
        self._applied[:] = 0.0
        _push(poses, self._at, bodies, state, self._loss / MM / self.model.opt.timestep, self._wrench, self._applied)
        data.xfrc_applied += self._applied

    def _choose(self, sensor: int) -> None:
        """Choose the solid that a sensor touches."""
        gap, at = self._gap[sensor], self._at[sensor]
        if at >= 0 and gap[at] <= 0 or not len(gap):
            return
        nearest, contacts, row = int(gap.argmin()), self._contacts[self._set[sensor]], int(self._row[sensor])
        if gap[nearest] > NEAR_MM:
            if at >= 0:
                contacts.rest(row)
                self._at[sensor] = -1
        elif nearest != at:
            friction = float(self.model.geom_friction[self._geom[nearest], 0])
            contacts.begin_solid(row, self._solid[nearest], min(friction, contacts.domain["friction"]))
            self._at[sensor], self._solved[sensor] = nearest, 0.0

    def read(self, site: str) -> TactileReading:
        """The contact of a sensor at the beginning of the last step."""
        sensor = self._number(site)
        contacts, row, at, gap = self._contacts[self._set[sensor]], int(self._row[sensor]), int(self._at[sensor]), self._gap[sensor]
        felt, caps, wrench = contacts.felt, contacts.caps_mm(row).copy(), self._wrench[sensor].copy()
        depth_mm = max(float(-gap[at]), 0.0) if at >= 0 else 0.0
        touched, beside = self._name(at) if depth_mm else "", [self._name(each) for each in np.flatnonzero(gap < 0).tolist() if each != at]
        pins_px = project_in_form(self.sensors[site], self.form(site), caps)
        area_mm2, slip = float(felt.area_mm2[row]), float(felt.slip[row])
        return TactileReading(touched, wrench[:3], wrench[3:], caps, pins_px, depth_mm, area_mm2, slip, felt.lost[row], tuple(beside))

    def form(self, site: str) -> Form:
        """Form of a sensor's frames: that of its recordings, or raw frames of the camera."""
        return Form.PROCESSED if self.sensors[site].recording else Form.RAW

    def frame(self, site: str, *, pictures: Pictures = "preview", seed: int = 0) -> Frame:
        """The sensor's frame: rasterised (``preview``) or path-traced (``traced``)."""
        return self._view(site, pictures).paint(self.pins(site), np.random.default_rng(seed))

    def pins(self, site: str) -> PinState:
        """Feet, axes and caps of the sensor's pins."""
        sensor = self._number(site)
        return self._contacts[self._set[sensor]].attitude(int(self._row[sensor]))

    def pipeline(self, site: str, *, pictures: Pictures = "preview") -> Pipeline:
        """The pipeline for a sensor's frames, with the pins at rest from a frame without contact."""
        return self._view(site, pictures).pipeline

    def observe(self, site: str, *, pictures: Pictures = "preview", seed: int = 0) -> Observation:
        """The pins that the real pipeline finds in the sensor's frame."""
        return self.pipeline(site, pictures=pictures)(self.frame(site, pictures=pictures, seed=seed))

    def _view(self, site: str, pictures: Pictures) -> SensorView:
        if (site, pictures) not in self._views:
            self._views[site, pictures] = SensorView(self.sensors[site], self.form(site), pictures)
        return self._views[site, pictures]

    def _number(self, site: str) -> int:
        if site not in self.sensors:
            raise OptionError(f"there is no sensor {site!r}; sensors are {', '.join(self.sensors)}")
        return list(self.sensors).index(site)

    def _name(self, geom: int) -> str:
        return self.model.geom(int(self._geom[geom])).name or str(self._geom[geom])


def _number_of(model: mujoco.MjModel, kind: Any, name: str) -> int:
    number = mujoco.mj_name2id(model, kind, name)
    if number < 0:
        raise OptionError(f"the model has no {mujoco.mju_type2Str(kind)} {name!r}")
    return int(number)


@compiled()
def _pose_of(xpos: FloatArray, xmat: FloatArray, number: int) -> tuple[FloatArray, FloatArray]:
    """Place (3,), mm, and axes (3, 3) of a site or geom."""
    return MM * xpos[number], xmat[number].copy().reshape(3, 3)


@compiled()
def _solid_at(xpos: FloatArray, xmat: FloatArray, geom: int, pose: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Place and axes of a geom's solid, which has a pose (4, 4) in its frame."""
    place, held = _pose_of(xpos, xmat, geom)
    turn = np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            place[i] += held[i, j] * pose[j, 3]
            for k in range(3):
                turn[i, j] += held[i, k] * pose[k, j]
    return place, turn


@compiled()
def _gaps(poses: Arrays, solids: Arrays, radius: FloatArray, gap: FloatArray, normal: FloatArray) -> None:
    """Write the distances (S, G) of solids from domes, and the solids' outward normals (S, G, 3) there, world frame.

    A solid is infinitely far if it is behind the dome, or if the sphere ``bound`` (G,) around it is out of reach.
    """
    site_xpos, site_xmat, sites, geom_xpos, geom_xmat, geoms, pose = poses
    kind, sizes, bound, own = solids
    point = np.empty((1, 3))
    for s in range(len(sites)):
        place, turn = _pose_of(site_xpos, site_xmat, sites[s])
        for g in range(len(geoms)):
            gap[s, g] = np.inf
            if own[s, g] or ((place - MM * geom_xpos[geoms[g]]) ** 2).sum() > (bound[g] + radius[s] + NEAR_MM) ** 2:
                continue
            solid_place, solid_turn = _solid_at(geom_xpos, geom_xmat, geoms[g], pose[g])
            for axis in range(3):
                point[0, axis] = (solid_turn[:, axis] * (place - solid_place)).sum()
            away, outward = distances_to(point, kind[g], sizes[g])
            ahead = 0.0
            for axis in range(3):
                normal[s, g, axis] = (solid_turn[axis] * outward[0]).sum()
                ahead -= normal[s, g, axis] * turn[axis, 2]
            if ahead > 0:
                gap[s, g] = away[0] - radius[s]


@compiled()
def _relative(poses: Arrays, at: IntArray) -> FloatArray:
    """Poses (S, 4, 4) of each sensor's solid in its frame; zero where ``at`` is -1."""
    site_xpos, site_xmat, sites, geom_xpos, geom_xmat, geoms, pose = poses
    T = np.zeros((len(at), 4, 4))
    for s in range(len(at)):
        if at[s] < 0:
            continue
        place, turn = _pose_of(site_xpos, site_xmat, sites[s])
        solid_place, solid_turn = _solid_at(geom_xpos, geom_xmat, geoms[at[s]], pose[at[s]])
        T[s, 3, 3] = 1.0
        for i in range(3):
            T[s, i, 3] = (turn[:, i] * (solid_place - place)).sum()
            for j in range(3):
                T[s, i, j] = (turn[:, i] * solid_turn[:, j]).sum()
    return T


@compiled()
def _push(poses: Arrays, at: IntArray, bodies: Arrays, contacts: Arrays, loss: float, wrench: FloatArray, applied: FloatArray) -> None:
    """Write the wrenches (S, 6) of the contacts ``solved`` (S, 7), with the loss of skin and gel, and of contacts that can't be computed.

    Add them to the forces (N) and torques (N m) on solids and sensors, ``applied`` at the bodies' centres of mass.
    """
    xpos, xmat, sites, _, _, geoms, _ = poses
    body_of, body, middle = bodies
    gap, before, normal, lost, solved = contacts
    wrench[:] = 0.0
    force, torque = np.empty(3), np.empty(3)
    for s in range(len(at)):
        if at[s] < 0:
            continue
        place, turn = _pose_of(xpos, xmat, sites[s])
        depth = -gap[s, at[s]]
        faster = depth + before[s, at[s]] if before[s, at[s]] <= NEAR_MM else 0.0  # mm in this step; none after a jump
        if lost[s]:
            size = np.sqrt((solved[s, :3] ** 2).sum()) + STOP_N_PER_MM * max(depth - solved[s, 6], 0.0)
            for i in range(3):
                wrench[s, i] = -size * (STOP_RETURNS if faster < 0 else 1.0) * (turn[:, i] * normal[s, at[s]]).sum()
        else:
            wrench[s] = solved[s, :6] * min(max(1.0 + loss * faster, 0.0), MOST_GROWTH)
        for i in range(3):
            force[i], torque[i] = (turn[i] * wrench[s, :3]).sum(), (turn[i] * wrench[s, 3:]).sum()
        for side in range(2):
            part, sign = body[s] if side else body_of[geoms[at[s]]], 1.0 - 2.0 * side
            lever = place - MM * middle[part]
            for i in range(3):
                j, k = (i + 1) % 3, (i + 2) % 3
                applied[part, i] += sign * force[i]
                applied[part, 3 + i] += sign * (torque[i] + lever[j] * force[k] - lever[k] * force[j]) / MM
