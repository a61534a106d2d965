"""An object that is moved against a sensor, wish by wish: what the page shows, without the page.

While the object moves, contacts are solved on the usual mesh and drawn. When it stands still, the same way is gone again on the fine
mesh, and the picture is path-traced. Every answer belongs to one pose and says which of them it is.
"""

import time
from collections import deque
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from scenes import list_experiments, load_experiment
from scenes.experiment import ExperimentSpec
from scenes.object import ObjectSpec
from scenes.sensor import SensorSpec
from twin.camera.projection import project
from twin.errors import ContactError
from twin.estimate import Estimate, SensorModel, seen_in
from twin.frames.forms import from_raw
from twin.geometry.solid import Resolution
from twin.mechanics.follow import STEP_MM, Follower
from twin.mechanics.law import ContactLaw
from twin.mechanics.path import ContactPath, deepest_mm
from twin.mechanics.solver import SkinSolver
from twin.objects import build_field
from twin.pins import Pipeline
from twin.rig.kinematics import rig_of
from twin.rig.mounting import Mounting
from twin.rig.touch import Surface, surface_labels, tilted_labels
from twin.studio.camera import DomeCamera
from twin.studio.pose import ObjectPose, bend_mm, motion_mm
from twin.types import FINE, ContactState, FloatArray, Form, Frame, Observation

RIM_MARGIN_MM = 5.0
"""The object's deepest place stays this far above the rim's plane, where the skin is clamped."""
MOST_LIFT_MM = 60.0
"""Farthest that an object in an impossible place is lifted along the sensor's z until its place is possible."""
HALVINGS = 14
"""Halvings by which that lift is found: to 4 um."""
SHELL_MM = 1.0
"""Distance of the shells on which it is looked whether the object is deeper in the gel than it may be. Thinner objects slip through."""
SHELL_POINTS = 800
"""Places on the whole sphere of such a shell."""
SAME_MM = 1e-6
"""Two poses whose matrices differ by less are one."""
FINE_STEP_MM = 1.0
"""Longest piece of the way that the fine mesh goes in one load step."""
FINE_BEND_MM = 0.05
"""Farthest that poses of the way may lie from such a piece."""
KEPT_WAY = 2000
"""Poses of a contact's way that are kept for the fine mesh. A longer way stays with the usual mesh."""


class Light(StrEnum):
    """How a picture was made."""

    DRAWN = "drawn"
    ROUGH = "path-traced, first pass"
    TRACED = "path-traced"


class Mesh(StrEnum):
    """On which mesh a contact was solved."""

    USUAL = "usual mesh"
    FINE = "fine mesh"


@dataclass(frozen=True)
class Answer:
    """Everything that the page shows of one pose.

    Attributes
    ----------
    setup : Setup
        What was moved against what.
    number : int
        Counts the answers.
    solved : int
        Counts the solved contacts: answers with the same number differ in light, form or model alone.
    pose : ObjectPose
        Where the object is.
    indent_mm : float
        How deep the rigid object is inside the undeformed dome, negative outside it.
    state : ContactState
    light : (h, w) or (h, w, 3) float
        Linear light of the dome's part of the frame.
    raw : Frame
        The whole raw frame.
    frame, seen : Frame, Observation
        The frame in the form that is shown, and what the pipeline saw in it.
    caps_px : (N, 2) float
        Where the caps are in that frame.
    estimate : Estimate or None
        None without a model.
    labels : dict of str to float
        The true value of each estimated label that has one here.
    lit, mesh : Light, Mesh
        How picture and contact were made.
    arrived : bool
        Whether the object is where it was wished, or as near as it may go.
    stopped : str
        Why it is not where it was wished ("" if it is, or is on the way).
    ms : dict of str to float
        Time of each stage.
    """

    setup: "Setup"
    number: int
    solved: int
    pose: ObjectPose
    indent_mm: float
    state: ContactState
    light: FloatArray
    raw: Frame
    frame: Frame
    seen: Observation
    caps_px: FloatArray
    estimate: Estimate | None
    labels: dict[str, float]
    lit: Light
    mesh: Mesh
    arrived: bool
    stopped: str
    ms: dict[str, float]


@dataclass(frozen=True)
class Setup:
    """What is moved against what, and what is looked at.

    Attributes
    ----------
    sensor : SensorSpec
    touched : ObjectSpec
    friction : float or None
        In place of the object's own.
    form : Form
        Form of the frames that are shown.
    """

    sensor: SensorSpec
    touched: ObjectSpec
    friction: float | None = None
    form: Form = Form.RAW

    @property
    def law(self) -> ContactLaw:
        """How the two rub and give way: no arm holds the object."""
        return ContactLaw.of_object(self.touched).override(friction=self.friction)


class MovingContact:
    """A sensor, an object, and where the object is.

    Not for several threads at once: the worker of the page owns it.

    Parameters
    ----------
    setup : Setup
    model : SensorModel, optional
        Estimates the pose in each frame; it must be of the same sensor.

    Attributes
    ----------
    pose : ObjectPose
        Where the object is.
    """

    def __init__(self, setup: Setup, model: SensorModel | None = None) -> None:
        self.setup = setup
        self.camera = DomeCamera(setup.sensor)
        self.solver = SkinSolver(setup.sensor)
        self._fine_solver: SkinSolver | None = None
        skin, shape = setup.sensor.skin, self.solver.shape
        self._apex_mm = skin.apex_mm
        depths_mm = np.arange(deepest_mm(setup.sensor.geometry), max(skin.apex_mm, skin.apex_mm - setup.sensor.lens.z_mm), SHELL_MM)
        places = shape.even(SHELL_POINTS)
        self._deep_mm = np.concatenate([shape.beneath(places, depth) for depth in depths_mm])  # where no object may reach
        self._experiment: ExperimentSpec | None = None
        self.model: SensorModel | None = None
        self._count, self._solved = 0, 0
        self.pose = ObjectPose()
        self._last: Answer | None = None
        self._take_up(setup)
        if model is not None:
            self.use(model)

    def use(self, model: SensorModel) -> None:
        """Estimate with a model from now on.

        Raises
        ------
        FrameError
            The model is of another sensor.
        """
        model.check(self.setup.sensor, model.form)
        self.model = model
        self._experiment = experiment_of(model)

    def change(self, *, touched: ObjectSpec | None = None, friction: float | None = None, form: Form | None = None) -> None:
        """Take another object, friction or form of the frames; what is not given stays. A contact is begun anew.

        With another object its own friction counts until one is given again.
        """
        setup = self.setup
        if touched is not None:
            setup = replace(setup, touched=touched, friction=None)
        if friction is not None:
            setup = replace(setup, friction=friction)
        if form is not None:
            setup = replace(setup, form=form)
        if setup.form is Form.RECORDING and setup.sensor.recording is None:
            self.camera.recorded(Frame(np.zeros((1, 1), np.uint8), Form.RAW))  # says that there is no such form
        pressed_anew = setup.touched != self.setup.touched or setup.friction != self.setup.friction
        if pressed_anew:
            self._take_up(setup)
        else:
            self.setup, self._pipeline = setup, Pipeline(setup.sensor, setup.form)

    def _take_up(self, setup: Setup) -> None:
        self.setup = setup
        self._surface, self._field = Surface(setup.touched), build_field(setup.touched)
        self._pipeline = Pipeline(setup.sensor, setup.form)
        self.begin_anew()

    def begin_anew(self) -> None:
        """Forget the contact and its friction. The next move presses the object straight down to where it is."""
        self._follower = Follower(self.solver, self.setup.touched, self.setup.law)
        self._T: FloatArray | None = None
        self._blocked: FloatArray | None = None
        self._why_blocked = ""
        self._fine: Follower | None = None
        self._fine_T: FloatArray | None = None
        self._fine_lost = ""
        self._way: deque[FloatArray] = deque()
        self._refined, self._restarts = False, 0

    def warm_up(self) -> None:
        """Load compiled code, so that the first move takes no longer than others."""
        self._follower.warm_up()

    # where the object may go

    def refusal(self, T: FloatArray) -> str:
        """Why the object may not stand at ``T`` (4, 4), "" if it may."""
        if (self._field.distance((self._deep_mm - T[:3, 3]) @ T[:3, :3]) < 0).any():
            limit = deepest_mm(self.setup.sensor.geometry)
            return f"it would be more than {limit:.1f} mm inside the skin, which is half the gel's depth"
        gap_mm, place = self._follower.nearest(T)
        if gap_mm >= 0:
            return ""
        if place[2] < self.setup.sensor.skin.rim_z_mm + RIM_MARGIN_MM:
            return "it would press beyond the rim, where the skin is clamped"
        return ""

    def admissible(self, wished: ObjectPose) -> tuple[FloatArray, str]:
        """Where the object goes for a wish: ``T_sensor_object`` (4, 4), and why it is not the wish itself ("" if it is).

        An object in an impossible place is lifted along the sensor's z until its place is possible.
        """
        within, reason = wished.within_limits()
        T = within.matrix(self._apex_mm)
        why = self.refusal(T)
        if not why:
            return T, reason
        low, high = 0.0, MOST_LIFT_MM
        for _ in range(HALVINGS):
            lift = 0.5 * (low + high)
            low, high = (low, lift) if not self.refusal(_lifted(T, lift)) else (lift, high)
        return _lifted(T, high), "; ".join(part for part in (reason, f"the object stops here: {why}") if part)

    def arrived(self, wished: ObjectPose) -> bool:
        """Whether the object is where a wish takes it, or the solver found no way there."""
        goal, _ = self.admissible(wished)
        return self._is_there(goal)

    def _is_there(self, goal: FloatArray) -> bool:
        near = (T for T in (self._T, self._blocked) if T is not None)
        return any(np.abs(T - goal).max() < SAME_MM for T in near)

    def _next(self, goal: FloatArray) -> FloatArray:
        """The next pose (4, 4) on the straight way to a goal: in contact one load step on, in the free as far as nothing is touched."""
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

    def step(self, wished: ObjectPose) -> Answer:
        """Go one load step towards a wish, draw, and look. Where the solver finds nothing, the object stays and the answer says why."""
        started = time.perf_counter()
        goal, reason = self.admissible(wished)
        T, now = self._next(goal), time.monotonic()
        try:
            state = self._follower.move(T, now)
        except ContactError as error:
            self._blocked, self._why_blocked = goal, f"the object stays here: {error}"
            if self._last is None:
                raise
            self._count += 1
            self._last = replace(self._last, number=self._count, arrived=True, stopped=self._why_blocked)
            return self._last
        self._remember(T)
        self._solved += 1
        solved_ms = 1e3 * (time.perf_counter() - started)
        arrived = self._is_there(goal)
        stopped = (self._why_blocked if self._blocked is not None and np.array_equal(self._blocked, goal) else reason) if arrived else ""
        return self._answer(T, state, Mesh.USUAL, arrived=arrived, stopped=stopped, ms={"contact": solved_ms})

    def traced(self, solved: int, light: FloatArray, lit: Light, traced_ms: float) -> Answer | None:
        """The newest answer with path-traced light (h, w) or (h, w, 3) of a contact; None if it is no longer the newest contact."""
        last = self._last
        if last is None or last.solved != solved:
            return None
        self._last = replace(last, light=light, lit=lit, ms={"contact": last.ms["contact"], "trace": traced_ms})
        return self.again()

    def refine(self) -> Answer | None:
        """Go one piece of the contact's way on the fine mesh; at its end the fine answer, None before."""
        if self.refined or self._last is None or self._T is None:
            return None
        if self._fine_solver is None:
            self._fine_solver = SkinSolver(self.setup.sensor, resolution=Resolution(across=FINE))
        if self._fine is None:
            self._fine = Follower(self._fine_solver, self.setup.touched, self.setup.law)
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
            self._fine_lost, self._refined = f"no answer on the fine mesh: {error}", True
            return None
        self._fine_T = piece[-1]
        if self._way:
            return None
        self._refined = True
        self._solved += 1
        last, ms = self._last, 1e3 * (time.perf_counter() - started)
        return self._answer(self._T, state, Mesh.FINE, arrived=last.arrived, stopped=last.stopped, ms={"contact": ms})

    @property
    def refined(self) -> bool:
        """Whether there is nothing to do on the fine mesh: no contact, done, lost, or a way that is too long."""
        free = self._T is None or self._last is None or not len(self._last.state.contact_mm)
        return free or self._refined or bool(self._fine_lost)

    @property
    def fine_lost(self) -> str:
        """Why this contact has no answer on the fine mesh, "" if it has or may have one."""
        return self._fine_lost

    def again(self) -> Answer | None:
        """The newest answer anew: after a change of form or model; None before the first."""
        last = self._last
        if last is None:
            return None
        traced = None if last.lit is Light.DRAWN else (last.light, last.lit)
        T = last.pose.matrix(self._apex_mm)
        return self._answer(T, last.state, last.mesh, traced, arrived=last.arrived, stopped=last.stopped, ms=last.ms)

    def _remember(self, T: FloatArray) -> None:
        """Keep the way for the fine mesh. A contact's way begins at the last free pose, or where the contact was begun anew."""
        begun_anew = self._T is None or self._blocked is not None or self._follower.restarts != self._restarts
        self._blocked, self._refined, self._restarts = None, False, self._follower.restarts
        if begun_anew or self._follower.gap_mm(T) >= 0:
            self._way.clear()
            self._fine, self._fine_T, self._fine_lost = None, None, ""
        self._way.append(T)
        if len(self._way) > KEPT_WAY:
            self._way.clear()
            self._fine_lost = f"the way in contact is longer than {KEPT_WAY} poses; lift the object off, and the fine mesh follows again"
        self._T, self.pose = T, ObjectPose.of(T, self._apex_mm)

    def _answer(
        self,
        T: FloatArray,
        state: ContactState,
        mesh: Mesh,
        traced: tuple[FloatArray, Light] | None = None,
        *,
        arrived: bool,
        stopped: str,
        ms: dict[str, float],
    ) -> Answer:
        self._count += 1
        started = time.perf_counter()
        light, lit = traced or (self.camera.draw(state), Light.DRAWN)
        raw = self.camera.raw(light, seed=self._count)
        now = time.perf_counter()
        needs_recorded = self.setup.form is Form.RECORDING or (self.model is not None and self.model.form is Form.RECORDING)
        frames = {Form.RAW: raw} | ({Form.RECORDING: self.camera.recorded(raw)} if needs_recorded else {})
        frame = frames[self.setup.form]
        estimate = None if self.model is None else self.model(frames[self.model.form])
        estimated = time.perf_counter()
        of_frame = self.model is not None and self.model.form is self.setup.form
        seen = seen_in(frame, estimate if of_frame else None, self._pipeline)
        times = {"picture": now - started, "estimate": estimated - now, "pins": time.perf_counter() - estimated}
        self._last = Answer(
            self.setup,
            self._count,
            self._solved,
            ObjectPose.of(T, self._apex_mm),
            -self._follower.gap_mm(T),
            state,
            light,
            raw,
            frame,
            seen,
            from_raw(self.setup.sensor.recording, self.setup.form, project(self.setup.sensor.view, state.caps_mm)),
            estimate,
            self.labels(state.T_sensor_object if len(state.contact_mm) else T),
            lit,
            mesh,
            arrived,
            stopped,
            ms | {name: 1e3 * seconds for name, seconds in times.items()},
        )
        return self._last

    def labels(self, T: FloatArray) -> dict[str, float]:
        """The true value of each of the model's labels that has one with the object at ``T`` (4, 4); empty without a model."""
        experiment, sensor = self._experiment, self.setup.sensor
        if experiment is None or self.model is None:
            return {}
        flat = surface_labels(experiment, Mounting.of(sensor, experiment), self._surface, T[None])
        known = {name: float(value[0]) for name, value in flat.items()}
        known |= tilted_labels(rig_of(sensor), experiment, self._surface, self._apex_mm, T) if not known else {}
        return known


def experiment_of(model: SensorModel) -> ExperimentSpec | None:
    """The first shipped experiment whose labels are those that a model estimates; None if there is none.

    Its axes and zero say what the labels mean.
    """
    names = set(getattr(model, "names", ()))
    for name in sorted(list_experiments()):
        experiment = load_experiment(name)
        if set(experiment.targets) == names and experiment.object == "plane":
            return experiment
    return None


def _lifted(T: FloatArray, by_mm: float) -> FloatArray:
    """An object's pose (4, 4) moved along the sensor's z, out of the tip."""
    lifted = T.copy()
    lifted[2, 3] += by_mm
    return lifted
