"""An object that is moved against a sensor according to the user's wishes. The module computes what the page shows, without the page.

While the object moves, contacts are solved on the usual mesh and drawn. When it stands still, the same path is repeated on the fine mesh,
and the picture is path-traced. Every answer belongs to one pose and states which mesh and which kind of picture it has.
"""

import time
from collections import deque
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any

import numpy as np

from scenes import list_specifications, load_experiment
from scenes.experiment import ExperimentSpec
from scenes.object import ObjectSpec
from scenes.sensor import SensorSpec
from twin.errors import ContactError
from twin.estimate import Estimate, SensorModel, pins_in
from twin.geometry.solid import Resolution
from twin.mechanics.follow import STEP_MM, Follower
from twin.mechanics.law import ContactLaw
from twin.mechanics.path import ContactPath, deepest_mm
from twin.mechanics.solver import SkinSolver
from twin.objects import build_field
from twin.pins import Pipeline
from twin.rig.kinematics import Mounting, rig_of
from twin.rig.touch import SmoothSurface, surface_labels, tilted_labels
from twin.studio.camera import StudioCamera
from twin.studio.pose import ObjectPose, bend_mm, motion_mm
from twin.types import FINE, ContactState, FloatArray, Form, Frame, Observation

RIM_MARGIN_MM = 5.0
"""Least height, mm, of the object's deepest point in contact above the rim's plane, where the skin is clamped."""
MOST_LIFT_MM = 60.0
"""Largest distance, mm, by which an object in an impossible place is lifted along the sensor's z."""
HALVINGS = 14
"""Number of bisections by which this lift is found. They give it to 4 um."""
FAR_MM, TOUCH_MM = 80.0, 0.01
"""Height and depth, mm, between which an object is moved to find where it first touches, and the gap that counts as touching."""
SHELL_MM = 1.0
"""Distance, mm, of the shells inside the gel that are searched for objects that are too deep. Thinner objects are not noticed."""
SHELL_POINTS = 800
"""Number of points on each such shell, counted for the whole sphere."""
SAME_MM = 1e-6
"""Largest difference of two pose matrices at which the poses count as equal."""
FINE_STEP_MM = 1.0
"""Longest part of the path, mm, that the fine mesh covers in one load step."""
FINE_BEND_MM = 0.05
"""Largest distance, mm, of the path's poses from the straight motion over such a part."""
KEPT_WAY = 2000
"""Most poses of a contact's path that are stored for the fine mesh. A contact with a longer path has no answer on the fine mesh."""


class Light(StrEnum):
    """The method by which a picture was made."""

    RASTERISED = "rasterised"
    ROUGH = "path-traced, first pass"
    TRACED = "path-traced"


class SolvedMesh(StrEnum):
    """The mesh on which a contact was solved."""

    USUAL = "usual mesh"
    FINE = "fine mesh"


Lit = tuple[FloatArray, Light]
"""Linear light of the dome's part of the frame, and how it was made."""


@dataclass(frozen=True)
class ContactAnswer:
    """Everything that the page shows of one pose.

    Attributes
    ----------
    setup : Setup
        The sensor, the object and the settings.
    number : int
        Number of the answer.
    solved : int
        Number of the solved contact. Answers with the same number differ only in light, form or model.
    pose : ObjectPose
        The object's pose.
    indent_mm : float
        Depth of the rigid object inside the undeformed dome, negative outside it.
    state : ContactState
    light : (h, w) or (h, w, 3) float
        Linear light of the dome's part of the frame.
    frame, seen : Frame, Observation
        The frame in the form that is shown, and the pipeline's observation of it.
    estimate : Estimate or None
        None without a model.
    labels : dict of str to float
        The true value of each estimated label for which it is known.
    lit, mesh : Light, Mesh
        How the picture and the contact were made.
    arrived : bool
        Whether the object has reached the wished pose, or the nearest possible one.
    stopped : str
        Why it is not at the wished pose ("" if it is, or is still moving).
    ms : dict of str to float
        Time of each stage.
    """

    setup: "ContactSetup"
    number: int
    solved: int
    pose: ObjectPose
    indent_mm: float
    state: ContactState
    light: FloatArray
    frame: Frame
    seen: Observation
    estimate: Estimate | None
    labels: dict[str, float]
    lit: Light
    mesh: SolvedMesh
    arrived: bool
    stopped: str
    ms: dict[str, float]


@dataclass(frozen=True)
class ContactSetup:
    """The sensor, the object that is moved against it, and the settings of the view.

    Attributes
    ----------
    sensor : SensorSpec
    obj : ObjectSpec
    friction : float or None
        Value that replaces the object's own friction.
    form : Form
        Form of the frames that are shown.
    """

    sensor: SensorSpec
    obj: ObjectSpec
    friction: float | None = None
    form: Form = Form.RAW

    @property
    def law(self) -> ContactLaw:
        """The contact law of the pair. No arm holds the object, so nothing else is compliant."""
        return ContactLaw.of_object(self.obj).override(friction=self.friction)


class MovingContact:
    """A sensor, an object, and the object's pose.

    It is not thread-safe: only the page's worker may use it.

    Parameters
    ----------
    setup : Setup
    model : SensorModel, optional
        Estimates the pose in each frame; it must belong to the same sensor.

    Attributes
    ----------
    pose : ObjectPose
        The object's pose.
    """

    def __init__(self, setup: ContactSetup, model: SensorModel | None = None) -> None:
        self.setup = setup
        self.camera = StudioCamera(setup.sensor)
        self.solver = SkinSolver(setup.sensor)
        self._fine_solver: SkinSolver | None = None
        skin, shape = setup.sensor.skin, self.solver.shape
        self._apex_mm = skin.apex_mm
        depths_mm = np.arange(deepest_mm(setup.sensor.geometry), max(skin.apex_mm, skin.apex_mm - setup.sensor.lens.z_mm), SHELL_MM)
        places = shape.even(SHELL_POINTS)
        self._deep_mm = np.concatenate([shape.beneath(places, depth) for depth in depths_mm])  # points that no object may reach
        self._experiment: ExperimentSpec | None = None
        self.model: SensorModel | None = None
        self._count, self._solved = 0, 0
        self.pose = ObjectPose()
        self._last: ContactAnswer | None = None
        self._take_up(setup)
        self.restart()
        if model is not None:
            self.use(model)

    def use(self, model: SensorModel) -> None:
        """Use this model for estimates from now on.

        Raises
        ------
        FrameError
            The model belongs to another sensor.
        """
        model.check(self.setup.sensor, model.form)
        self.model = model
        self._experiment = experiment_of(model)

    def change(self, **given: Any) -> None:
        """Use another ``obj``, ``friction`` or ``form`` of the frames. With another object or friction the contact starts again.

        Another object has its own friction until a friction is given again.

        Raises
        ------
        FrameError
            The sensor has no such form.
        """
        old = self.setup
        self._take_up(replace(old, **({"friction": None} if "obj" in given else {}) | given))
        if (old.obj, old.friction) != (self.setup.obj, self.setup.friction):
            self.restart()

    def _take_up(self, setup: ContactSetup) -> None:
        self._pipeline = Pipeline(setup.sensor, setup.form)
        self._surface, self._field = SmoothSurface(setup.obj), build_field(setup.obj)
        self.setup = setup

    def restart(self) -> None:
        """Forget the contact and its friction. The next move presses the object straight down to its pose."""
        self._follower = Follower(self.solver, self.setup.obj, self.setup.law)
        self._T: FloatArray | None = None
        self._blocked = False  # whether the last step had no solution
        self._fine: Follower | None = None
        self._fine_T: FloatArray | None = None
        self.fine_lost = ""  # why this contact has no answer on the fine mesh; "" if it has one or may still get one
        self._way: deque[FloatArray] = deque()
        self._refined, self._restarts = False, 0

    def warm_up(self) -> None:
        """Load compiled code, so that the first move is as fast as later ones."""
        self._follower.warm_up()

    # possible poses of the object

    def refusal(self, T: FloatArray) -> str:
        """Why the object may not have the pose ``T`` (4, 4); "" if it may."""
        if (self._field.distance((self._deep_mm - T[:3, 3]) @ T[:3, :3]) < 0).any():
            limit = deepest_mm(self.setup.sensor.geometry)
            return f"it would be more than {limit:.1f} mm inside the skin, which is half the gel's depth"
        gap_mm, place = self._follower.nearest(T)
        if gap_mm < 0 and place[2] < self.setup.sensor.skin.rim_z_mm + RIM_MARGIN_MM:
            return "it would press beyond the rim, where the skin is clamped"
        return ""

    def admissible(self, wished: ObjectPose) -> tuple[FloatArray, str]:
        """The pose to which a wish moves the object: ``T_sensor_object`` (4, 4), and why it is not the wished pose ("" if it is).

        An object at an impossible place is lifted along the sensor's z until its place is possible.
        """
        within, reason = wished.within_limits()
        T = within.matrix(self._apex_mm)
        why = self.refusal(T)
        if not why:
            return T, reason
        low, high = 0.0, MOST_LIFT_MM
        for _ in range(HALVINGS):
            lift = 0.5 * (low + high)
            low, high = (low, lift) if not self.refusal(_lift(T, lift)) else (lift, high)
        return _lift(T, high), "; ".join(part for part in (reason, f"the object stops here: {why}") if part)

    def touch_mm(self, pose: ObjectPose) -> float:
        """Depth, mm, at which the object first touches the skin if it approaches along the sensor's z, otherwise posed as ``pose``.

        It is that of a straight approach if the object passes the skin.
        """
        depth_mm = -FAR_MM
        while depth_mm < FAR_MM:  # by the gap, the object moves as far as nothing can touch
            gap_mm = self._follower.gap_mm(replace(pose, depth_mm=depth_mm).matrix(self._apex_mm))
            if gap_mm < TOUCH_MM:
                return depth_mm
            depth_mm += gap_mm
        return 0.0

    def _next(self, goal: FloatArray) -> FloatArray:
        """The next pose (4, 4) on the straight path to a goal: one load step further in contact, else as far as nothing touches."""
        if self._T is None:
            return goal
        gap_mm = self._follower.gap_mm(self._T)
        pressed = self._follower.pressed_mm(goal if gap_mm >= 0 else self._T)
        if gap_mm < 0:
            pressed = np.concatenate([pressed, self._follower.pressed_mm(goal)])
        length_mm = motion_mm(pressed, self._T, goal)
        if not length_mm:
            return goal
        share = min(1.0, max(STEP_MM, gap_mm) / length_mm)
        return goal if share == 1.0 else ContactPath(np.stack([self._T, goal])).at(share)

    # answers

    def step(self, wished: ObjectPose) -> ContactAnswer:
        """Move one load step towards a wish, draw, and observe. Without a solution the object does not move, and the answer states why."""
        started = time.perf_counter()
        goal, reason = self.admissible(wished)
        T, now = self._next(goal), time.monotonic()
        try:
            state = self._follower.move(T, now)
        except ContactError as error:
            self._blocked = True
            if self._last is None:
                raise
            self._count += 1
            self._last = replace(self._last, number=self._count, arrived=True, stopped=f"the object stays here: {error}")
            return self._last
        self._store_path(T)
        self._solved += 1
        solved_ms = 1e3 * (time.perf_counter() - started)
        arrived = bool(np.abs(T - goal).max() < SAME_MM)
        return self._answer(T, state, SolvedMesh.USUAL, None, arrived, reason if arrived else "", {"contact": solved_ms})

    def newest_traced(self, solved: int, light: FloatArray, lit: Light, traced_ms: float) -> ContactAnswer | None:
        """The newest answer with path-traced light (h, w) or (h, w, 3) of a contact; None if a newer contact was solved since."""
        last = self._last
        if last is None or last.solved != solved:
            return None
        self._last = replace(last, light=light, lit=lit, ms={"contact": last.ms["contact"], "trace": traced_ms})
        return self.again()

    def refine(self) -> ContactAnswer | None:
        """Cover one part of the contact's path on the fine mesh. Returns the answer at the path's end; None before."""
        if self.refined or self._last is None or self._T is None:
            return None
        if self._fine_solver is None:
            self._fine_solver = SkinSolver(self.setup.sensor, resolution=Resolution(across=FINE))
        if self._fine is None:
            self._fine = Follower(self._fine_solver, self.setup.obj, self.setup.law)
        started = time.perf_counter()
        piece = [self._way.popleft()]
        pressed = self._fine.pressed_mm(piece[0])
        begin = self._fine_T if self._fine_T is not None else piece[0]
        while self._way:
            longer = [*piece, self._way[0]]
            if motion_mm(pressed, begin, longer[-1]) > FINE_STEP_MM or bend_mm([begin, *longer]) > FINE_BEND_MM:
                break
            piece.append(self._way.popleft())
        try:
            state = self._fine.move(piece[-1], time.monotonic())
        except ContactError as error:
            self.fine_lost, self._refined = f"no answer on the fine mesh: {error}", True
            return None
        self._fine_T = piece[-1]
        if self._way:
            return None
        self._refined = True
        self._solved += 1
        last, ms = self._last, 1e3 * (time.perf_counter() - started)
        return self._answer(self._T, state, SolvedMesh.FINE, None, last.arrived, last.stopped, {"contact": ms})

    @property
    def refined(self) -> bool:
        """Whether there is nothing to do on the fine mesh: no contact, or a finished or failed one, or a path that is too long."""
        free = self._T is None or self._last is None or not len(self._last.state.contact_mm)
        return free or self._refined or bool(self.fine_lost)

    def again(self) -> ContactAnswer | None:
        """The newest answer, computed again after a change of form or model; None before the first answer."""
        last = self._last
        if last is None:
            return None
        traced = None if last.lit is Light.RASTERISED else (last.light, last.lit)
        return self._answer(last.pose.matrix(self._apex_mm), last.state, last.mesh, traced, last.arrived, last.stopped, last.ms)

    def _store_path(self, T: FloatArray) -> None:
        """Store the path for the fine mesh. A contact's path begins at the last free pose, or where the contact was started again."""
        begun_anew = self._T is None or self._blocked or self._follower.restarts != self._restarts
        self._blocked, self._refined, self._restarts = False, False, self._follower.restarts
        if begun_anew or self._follower.gap_mm(T) >= 0:
            self._way.clear()
            self._fine, self._fine_T, self.fine_lost = None, None, ""
        self._way.append(T)
        if len(self._way) > KEPT_WAY:
            self._way.clear()
            self.fine_lost = f"the path in contact is longer than {KEPT_WAY} poses; lift the object off to use the fine mesh again"
        self._T, self.pose = T, ObjectPose.of(T, self._apex_mm)

    def _answer(
        self, T: FloatArray, state: ContactState, mesh: SolvedMesh, given: Lit | None, arrived: bool, stopped: str, ms: dict[str, float]
    ) -> ContactAnswer:
        """The answer for a pose and state, with the given light or with rasterised one."""
        self._count += 1
        started = time.perf_counter()
        light, lit = given or (self.camera.draw(state), Light.RASTERISED)
        raw = self.camera.raw(light, seed=self._count)
        drawn = time.perf_counter()
        frame, estimate, seen = self.observe(raw, self.setup.form, self._pipeline)
        times = {"picture": drawn - started, "estimate and pins": time.perf_counter() - drawn}
        labels = self.labels(state.T_sensor_object if len(state.contact_mm) else T)
        self._last = ContactAnswer(
            self.setup, self._count, self._solved, ObjectPose.of(T, self._apex_mm), -self._follower.gap_mm(T), state, light, frame, seen,
            estimate, labels, lit, mesh, arrived, stopped, ms | {name: 1e3 * value for name, value in times.items()},
        )  # fmt: skip
        return self._last

    def observe(self, raw: Frame, form: Form, pipeline: Pipeline) -> tuple[Frame, Estimate | None, Observation]:
        """A raw frame in a form, the model's estimate (None without a model), and the pins that the pipeline finds in that form."""
        model = self.model
        frames = {each: raw if each is Form.RAW else self.camera.as_recorded(raw) for each in {form, form if model is None else model.form}}
        estimate = None if model is None else model(frames[model.form])
        of_frame = model is not None and model.form is form
        return frames[form], estimate, pins_in(frames[form], estimate if of_frame else None, pipeline)

    def labels(self, T: FloatArray) -> dict[str, float]:
        """The true values of the model's labels with the object at ``T`` (4, 4), as far as they are defined; empty without a model."""
        experiment, sensor = self._experiment, self.setup.sensor
        if experiment is None or self.model is None:
            return {}
        flat = surface_labels(experiment, Mounting.of(sensor, experiment), self._surface, T[None])
        known = {name: float(value[0]) for name, value in flat.items()}
        return known or tilted_labels(rig_of(sensor), experiment, self._surface, self._apex_mm, T)


def experiment_of(model: SensorModel) -> ExperimentSpec | None:
    """The first shipped experiment with a plane whose labels are those that a model estimates; None if there is none.

    Its axes and its zero define the labels.
    """
    names = set(getattr(model, "names", ()))
    for name in sorted(list_specifications("experiments")):
        experiment = load_experiment(name)
        if set(experiment.targets) == names and experiment.object == "plane":
            return experiment
    return None


def _lift(T: FloatArray, by_mm: float) -> FloatArray:
    """An object's pose (4, 4) moved along the sensor's z, out of the tip."""
    lifted = T.copy()
    lifted[2, 3] += by_mm
    return lifted
