"""The mode 'Twin': the user moves the object and sees the resulting contact, picture and estimate."""

import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

import numpy as np
import viser

from scenes import list_specifications, load_object, load_sensor
from scenes.base import SpecError
from twin.errors import TwinError
from twin.estimate import SensorModel, readable_labels
from twin.frames.images import write_image
from twin.objects import build_field
from twin.pins import nominal_reference
from twin.report.page import force_interval
from twin.store.atomic import make_folder
from twin.studio.contact import ContactAnswer, ContactSetup, Light, MovingContact
from twin.studio.modes.mode import PageMode
from twin.studio.page import LineChart, StudioPage, frame_pictures, put, value_of
from twin.studio.pictures import FilmWriter, OverlayChoices, badge, estimate_table, number_table, paragraph, pins_found
from twin.studio.pose import LIMITS, NAMES, ObjectPose, PressedPose, readable_name, unit_of
from twin.studio.scene import FULL_SCALE, PinColour, Scene
from twin.studio.state import LAST_STATE, StudioState, Way, heading, next_path, read_trajectory, save_trajectory, tap_and_shear
from twin.studio.worker import Tracer, Worker
from twin.types import Form

ModelOf = Callable[[str], SensorModel | None]
"""Function from a sensor's name to a trained model of it, or None."""

STEPS = {"mm": 0.25, "deg": 1.0}
"""Step by which a key moves or turns the object, mm and deg."""
KEYS = (("arrowleft", "arrowright"), ("arrowup", "arrowdown"), ("pageup", "pagedown"))
"""Pairs of keys that change one of the object's numbers, the first to smaller values."""
CHANGED = {"shift": ("x_mm", "y_mm", "depth_mm"), "cmd/ctrl+shift": ("tilt_y_deg", "tilt_x_deg", "twist_deg")}
"""The number that each pair of keys changes together with a modifier."""
ONE_GESTURE_S = 0.8
"""Longest time, s, between two wishes of one gesture. 'Undo' takes back a whole gesture."""
MOST_UNDO = 100
"""Most gestures that can be taken back."""
MOST_FRICTION = 2.0
"""Largest friction of the slider."""
MODEL_LOADING = "the model is being loaded"
"""Why there is no estimate at the beginning."""


def _as_deep(wish: ObjectPose, before_mm: float, contact: MovingContact) -> ObjectPose:
    """A wish as deep after the first touch in a contact as one that touched at the depth ``before_mm``."""
    return replace(wish, depth_mm=wish.depth_mm - before_mm + contact.touch_mm(wish)).within_limits()[0]


class TwinMode(PageMode):
    """The mode 'Twin'.

    Parameters
    ----------
    page : Page
    state : StudioState
        The state at the start.
    out : Path
        Folder for saved files.
    model_of : callable
    traces : bool
        Whether pictures are path-traced when the object stands still.

    Attributes
    ----------
    followers : list of callable
        Functions of modes that use the same contact. They are called with each answer after it was shown.
    """

    title = "Twin"
    has_scene = True

    def __init__(self, page: StudioPage, state: StudioState, out: Path, model_of: ModelOf, *, traces: bool = True) -> None:
        super().__init__(page)
        self._out, self._model_of, self._traces = out, model_of, traces
        self._state = state
        self._kept: StudioState | None = None  # as it is in the file of the last state
        self._shown, self._drawn = state.colour, state.drawn
        self._wish, self._wished_s = state.object_pose(), 0.0
        self._undo: list[ObjectPose] = []
        self.model_note, self._loading = MODEL_LOADING, False
        self._path: Way | None = None
        self._path_s = 0.0
        self._film: FilmWriter | None = None
        self.followers: list[Callable[[ContactAnswer], None]] = []
        self._rebuilding = threading.RLock()
        self._showing = threading.Lock()  # held while the scene is changed or built again
        self._take_up(*self._prepare(state))
        self._publisher = self.newest(self._publish, "page")
        self._links = self.newest(self._open_link, "link")
        page.on_address = self._links.give
        self._build_controls()
        titles = "force on the object, N", "error of the estimates", "indentation, mm"
        self._forces, self._estimates, self._depths = self.charts = tuple(LineChart(page, title) for title in titles)

    # start and end

    def _prepare(self, state: StudioState) -> tuple[MovingContact, Tracer | None]:
        """The contact of a state and its tracer. The page is not changed."""
        sensor = load_sensor(state.sensor)
        contact = MovingContact(ContactSetup(sensor, load_object(state.object), state.friction, state.form))
        return contact, Tracer(sensor) if self._traces else None

    def _take_up(self, contact: MovingContact, tracer: Tracer | None) -> None:
        """Show another contact from now on, and build its scene. No worker may be running."""
        setup = contact.setup
        with self._showing:
            self.contact, self._tracer = contact, tracer
            self.worker = Worker(contact, tracer, self._publish_answer, self._page.say)
            self._rest = nominal_reference(setup.sensor, setup.form)
            self._scene = Scene(self._page.server, setup.sensor, contact.solver.mesh, contact.solver.rest())
            if self._loading:  # otherwise ``_load_rest`` shows the object
                self._scene.put_object(setup.obj)
            self._scene.on_drag(self._follow_drag)

    def start(self) -> None:
        """Start to answer. The first wish is the state's pose. The model is loaded at the same time."""
        super().start()
        self._begin()

    def _begin(self) -> None:
        self._loading = False
        self.worker.start()
        self.worker.do(self.contact.warm_up)
        self.worker.ask(self._wish)

    def stop(self) -> None:
        """End threads and processes."""
        self._end_film()
        self.worker.stop()
        if self._tracer is not None:
            self._tracer.close()
        super().stop()

    def _load_model(self, name: str) -> None:
        try:
            model = self._model_of(name)
        except TwinError as error:
            self.model_note = str(error)
            return

        def use() -> None:
            if model is not None and name == self._state.sensor:
                self.contact.use(model)
                self.worker.show_again()
            self.model_note = "there is no model of this sensor; train one, and start the studio with it"

        self.worker.do(use)

    def show(self) -> None:
        """Show the twin's newest answer."""
        if self.worker.newest is None:
            self._page.show_nothing("The first picture is being made. For a new sensor this takes up to a minute.")
        else:
            self._publisher.give(self.worker.newest)

    @property
    def state(self) -> StudioState:
        """The whole state."""
        setup, pose = self.contact.setup, asdict(self._wish)
        return self._state.alter(friction=setup.friction, pose=pose, form=setup.form, colour=self._shown, drawn=self._drawn)

    # wishes

    def ask(self, wished: ObjectPose, *, gesture: bool = True) -> None:
        """Wish a pose of the object. With ``gesture``, 'Undo' can take it back."""
        now = time.monotonic()
        if gesture and now - self._wished_s > ONE_GESTURE_S:
            self._undo = [*self._undo[-MOST_UNDO:], self._wish]
        self._wish, self._wished_s = wished, now
        self.worker.ask(wished)

    def undo(self) -> None:
        """Take back the last gesture."""
        if self._undo:
            self._wish = self._undo.pop()
            self.worker.ask(self._wish)
        else:
            self._page.say("There is nothing to undo.")

    def nudge(self, name: str, sign: int) -> None:
        """Move the object by one step along one of its numbers."""
        value = getattr(self._wish, name) + sign * STEPS[unit_of(name)]
        self.ask(replace(self._wish, **{name: value}).within_limits()[0])

    def play(self, way: Way) -> None:
        """Move the object along a path. A contact starts again where the path leaves the skin."""
        self._undo = [*self._undo[-MOST_UNDO:], self._wish]
        self._wish = way[-1][1]
        self.worker.play(way)

    def tap_and_shear(self) -> None:
        """Play a tap and a shear with the present tilts and twist."""
        self.play(tap_and_shear(self._wish))

    def _follow_drag(self, T: np.ndarray, ended: bool) -> None:
        self.ask(ObjectPose.of(T, self.contact.setup.sensor.skin.apex_mm))
        if ended:
            self.show()

    # controls

    def _build_controls(self) -> None:
        page, gui, watch, button = self._page, self._page.gui, self._page.watch, self._page.button

        def choice(label: str, choices: Iterable[str], chosen: str, take: Callable[[], None]) -> viser.GuiDropdownHandle[str]:
            return watch(gui.add_dropdown(label, tuple(map(str, choices)), initial_value=str(chosen)), take)

        with self.folder:
            self._sliders = {}
            for name in NAMES:
                low, high, why = LIMITS[name]
                title, hint = f"{readable_name(name)}, {unit_of(name)}", f"{low:g} to {high:g}: {why}"
                slider = gui.add_slider(title, low, high, 0.05, getattr(self._wish, name), hint=hint)
                self._sliders[name] = watch(slider, partial(self._move_to_slider, name))
            with gui.add_folder("Contact"):
                sensor, touched = self._state.sensor, self._state.object
                self._sensor = choice("sensor", sorted({*list_specifications("sensors"), sensor}), sensor, self._change_sensor)
                self._object = choice("object", sorted({*list_specifications("objects"), touched}), touched, self._change_object)
                page.upload("Upload an object (mesh)", ".stl,.obj,.ply", self._touch, hint="lengths in mm; or drop the file on the page")
                self._friction = watch(gui.add_slider("friction", 0.0, MOST_FRICTION, 0.01, self._own_friction()), self._change_friction)
                button("Restart contact", self.restart_contact, hint="clear the friction history and press straight down")
            with gui.add_folder("Show"):
                self._form = choice("frame", self._forms(), self.contact.setup.form, self._change_form)
                self._drawing = choice("overlay", OverlayChoices, self._drawn, self._change_look)
                self._colour = choice("colour pins by", PinColour, self._shown, self._change_look)
            with gui.add_folder("Move", expand_by_default=False):
                button("Tap and shear", self.tap_and_shear)
                upload = gui.add_upload_button("Play trajectory (CSV)", mime_type=".csv", hint="columns time_s, x_mm, y_mm, depth_mm, ...")
                self._record_way = watch(gui.add_checkbox("record the trajectory", False), self._toggle_trajectory)
                button("Undo", self.undo)
            with gui.add_folder("Save", expand_by_default=False):
                button("Save picture", self.save_picture)
                button("Save contact files", self.save_contact)
                button("Save state", self.save_state)
                opened = gui.add_upload_button("Open a state", mime_type=".json")
                link = self.state.link(page.url)
                self._link = gui.add_text("link", link, hint="opens this state again; paste another one to open it")
                self._filming = watch(gui.add_checkbox("record a video", False), self._toggle_film)
        upload.on_upload(page.guard(lambda: self.play(read_trajectory(upload.value.content, upload.value.name))))
        opened.on_upload(page.guard(lambda: self.open(StudioState.read(opened.value.content, opened.value.name))))
        watch(self._link, lambda: self._links.give(self._link.value))
        for modifier, names in CHANGED.items():
            for keys, name in zip(KEYS, names, strict=True):
                for key, sign in zip(keys, (-1, +1), strict=True):
                    label = f"{readable_name(name)} {'+' if sign > 0 else '-'}{STEPS[unit_of(name)]:g} {unit_of(name)}"
                    command = gui.add_command(label, hotkey=key, modifier=modifier)  # type: ignore[arg-type]  # viser defines it as a literal
                    command.on_trigger(page.guard(partial(self.nudge, name, sign)))
        gui.add_command("Undo", hotkey="Z", modifier="cmd/ctrl").on_trigger(page.guard(self.undo))
        gui.add_command("Tap and shear", hotkey="T", modifier="shift").on_trigger(page.guard(self.tap_and_shear))

    def _forms(self) -> tuple[str, ...]:
        """The forms of the sensor's frames."""
        return tuple(str(form) for form in Form if form is Form.RAW or self.contact.setup.sensor.recording is not None)

    def _move_to_slider(self, name: str) -> None:
        self.ask(replace(self._wish, **{name: float(self._sliders[name].value)}))

    def _own_friction(self) -> float:
        setup = self.contact.setup
        return min(MOST_FRICTION, setup.obj.friction if setup.friction is None else setup.friction)

    def restart_contact(self) -> None:
        """Press the object straight down to its pose, without the friction's history."""
        self.worker.do(self.contact.restart)
        self.worker.ask(self._wish)

    def _change_form(self) -> None:
        form = value_of(self._form, Form, str(self.contact.setup.form))

        def change() -> None:
            self.contact.change(form=form)
            self._rest = nominal_reference(self.contact.setup.sensor, form)
            self.worker.show_again()

        self.worker.do(change)

    def _change_look(self) -> None:
        self._shown = value_of(self._colour, PinColour, str(self._shown))
        self._drawn = value_of(self._drawing, OverlayChoices, str(self._drawn))
        self.show()

    def _change_friction(self) -> None:
        friction = float(self._friction.value)
        if not 0.0 <= friction <= MOST_FRICTION:  # no browser's slider gives that
            put(self._friction, self._own_friction())
            raise TwinError(f"friction {friction:g}: give a number from 0 to {MOST_FRICTION:g}")
        self.worker.do(lambda: self.contact.change(friction=friction))
        self.worker.ask(self._wish)

    def _change_object(self) -> None:
        chosen = self._object.value
        with self._rebuilding:  # another sensor may just be opened; it keeps this choice
            self._touch(chosen)

    def _touch(self, name: str) -> None:
        try:
            obj = load_object(name)
            build_field(obj)  # an unusable mesh is refused here; what it computes is kept
        except (TwinError, SpecError):
            put(self._object, self._state.object, send=True)
            raise
        self._object.options = tuple(sorted({*self._object.options, name}))
        put(self._object, name, send=True)
        self._state = self._state.alter(object=name)

        def change() -> None:
            wish, before = self._wish, self.contact.touch_mm(self._wish)
            self.contact.change(obj=obj)
            with self._showing:
                self._scene.put_object(obj)
            put(self._friction, self._own_friction())
            deep = _as_deep(wish, before, self.contact)
            if self._wish is wish:  # otherwise the user has just wished another pose
                self.ask(deep, gesture=False)

        self.worker.do(change)

    def _change_sensor(self) -> None:
        chosen = self._sensor.value
        with self._rebuilding:
            try:
                self.open(self.state.alter(sensor=chosen, form=Form.RAW), as_deep=True)
            except (TwinError, SpecError):
                put(self._sensor, self._state.sensor, send=True)
                raise

    def open(self, state: StudioState, *, as_deep: bool = False) -> None:
        """Show another state. With another sensor everything is built again, which takes some seconds.

        Parameters
        ----------
        state : StudioState
        as_deep : bool
            Keep the depth relative to the first touch of the sensor that is shown now, instead of the state's depth.

        Raises
        ------
        TwinError, SpecError
            There is no such sensor or object; the page is then not changed.
        """
        with self._rebuilding:
            self._page.say(f"opening {state.sensor} against {state.object} ...")
            prepared = self._prepare(state)
            self.worker.stop()
            if self._tracer is not None:
                self._tracer.close()
            self._page.gui.set_panel_label(heading(state))
            before, friction = self._choices(), self._own_friction()
            self._state, wish = state, self._wish
            self._wish = _as_deep(wish, self.contact.touch_mm(wish), prepared[0]) if as_deep else state.object_pose()
            self._shown, self._drawn = state.colour, state.drawn
            self.model_note = MODEL_LOADING
            self._take_up(*prepared)
            self._form.options = self._forms()
            for control, name in ((self._sensor, state.sensor), (self._object, state.object)):
                control.options = tuple(sorted({*control.options, name}))
            for (control, old), (_, new) in zip(before, self._choices(), strict=True):
                if control.value == old and new in control.options:  # otherwise the user has just chosen another one; its callback follows
                    put(control, new)
            if self._friction.value == friction:
                put(self._friction, self._own_friction())
            self._begin()

    def _choices(self) -> list[tuple[viser.GuiDropdownHandle[str], str]]:
        """The page's dropdowns, each with the value that is in use."""
        used = (self.contact.setup.form, self._drawn, self._shown, self._state.sensor, self._state.object)
        return list(zip((self._form, self._drawing, self._colour, self._sensor, self._object), map(str, used), strict=True))

    def _open_link(self, link: str) -> None:
        """Show the state of a link, unless the page shows it already."""
        if link.partition("?")[2] != self.state.link().partition("?")[2]:
            self.open(StudioState.of_link(link))

    # answers

    def _publish_answer(self, answer: ContactAnswer) -> None:
        if self._path is not None:
            self._path.append((time.monotonic() - self._path_s, answer.pose))
        self._publisher.give(answer)

    def _load_rest(self) -> None:
        """Load the parts that the first picture does not need: the object's shape in the scene, and the model."""
        self._loading = True
        self.worker.do(self._put_object)
        threading.Thread(target=self._load_model, args=(self._state.sensor,), name="studio-model", daemon=True).start()

    def _put_object(self) -> None:
        """Show the object in the scene. Only the worker's thread may call this."""
        with self._showing:
            self._scene.put_object(self.contact.setup.obj)
        self.worker.show_again()

    def _publish(self, answer: ContactAnswer) -> None:
        """Show an answer. Scene, pictures and numbers belong to one pose, and browsers get them together."""
        with self._showing:
            if answer.setup.sensor is not self.contact.setup.sensor:  # the page now shows another sensor
                return
            self._show_answer(answer)
        if not self._loading:
            self._load_rest()
        if answer.arrived and self._kept != self.state:
            self._kept = self.state
            self._kept.save(make_folder(self._out) / LAST_STATE)
        for follow in self.followers:
            follow(answer)

    def _show_answer(self, answer: ContactAnswer) -> None:
        contact = self.contact
        if self._active:
            camera, cells = frame_pictures(contact.setup.sensor, self._rest, answer.frame, answer.seen, self._drawn)
            if self._film is not None:
                self._film.add(np.hstack([camera, cells]))
        numbers = self._numbers(answer)
        smooth = answer.lit is Light.RASTERISED and contact.setup.sensor.appearance.relief is not None
        lacking = " without relief" if smooth else ""

        def change() -> None:
            self._scene.show(answer.state, self._shown)
            if answer.arrived:
                self._scene.place_gizmo(answer.pose.matrix(contact.setup.sensor.skin.apex_mm))
                self._follow_sliders(answer)
                put(self._link, self.state.link(self._page.url))
            if self._active:
                self._page.show_pictures(camera, cells, f"camera, {answer.frame.form} frame, {answer.lit}{lacking}")
                self._page.show_numbers(*numbers)
            self._draw_charts(answer)

        self._page.together(change)

    def _follow_sliders(self, answer: ContactAnswer) -> None:
        """Set the sliders to the object's final pose, unless the user has made a new wish."""
        wishing = self.worker.newest is not answer or time.monotonic() - self._wished_s < ONE_GESTURE_S
        if wishing and not self._scene.dragging and not answer.stopped:
            return
        for name, slider in self._sliders.items():
            value = round(getattr(answer.pose, name), 2)
            if abs(slider.value - value) > 0.02:
                put(slider, value)

    def _numbers(self, answer: ContactAnswer) -> list[str]:
        state, seen = answer.state, answer.seen
        moving = "moving" if not answer.arrived else "still"
        touched, untouched = len(state.contact_mm) > 0, paragraph("No contact, therefore no estimate.", "note")
        mesh = answer.mesh if touched else "no contact"
        force, torque = np.round(state.force_n, 2) + 0.0, round(float(state.torque_nmm[2]), 1) + 0.0
        across, into = float(np.hypot(*state.force_n[:2])), float(state.force_n[2])
        ends = force_interval(state.force_n.tolist(), self.contact.setup.sensor.skin.stiffness_factor)
        rows = {
            "force x, y, z, N": f"{force[0]:+.2f} {force[1]:+.2f} {force[2]:+.2f}",
            "its size, 90 % interval": f"{ends[0]:.2f} to {ends[1]:.2f} N",
            "lateral, share of normal": f"{across:.2f} N, {across / into:.2f}" if into > 0.01 else "-",
            "torque about z": f"{torque:+.1f} N mm",
            "indentation": f"{answer.indent_mm:+.2f} mm",
            "contact area, slipping": f"{state.area_mm2:.0f} mm2, {100 * state.slip_share:.0f} %",
            "pins found": pins_found(seen),
        }
        full, unit = FULL_SCALE[self._shown]
        return [
            f"<span data-number='{answer.number}' data-depth='{answer.pose.depth_mm:.6f}'></span>",
            badge(moving, moving) + badge(answer.lit, "still" if answer.lit is Light.TRACED else "") + badge(mesh),
            paragraph(answer.stopped, "stop"),
            number_table(rows),
            estimate_table(answer.estimate, answer.labels, missing=self.model_note) if touched else untouched,
            paragraph(self.contact.fine_lost, "note"),
            paragraph(f"pins coloured by {self._shown}: dark 0, bright {full:g} {unit}; {sum(answer.ms.values()):.0f} ms latency", "note"),
        ]

    def _draw_charts(self, answer: ContactAnswer) -> None:
        self._forces.add(dict(zip("xyz", answer.state.force_n.tolist(), strict=True)))
        self._depths.add({"indentation": answer.indent_mm})
        estimate = answer.estimate
        if estimate is not None and estimate.valid:
            known = zip(readable_labels(estimate.names), estimate.names, estimate.value, strict=True)
            self._estimates.add({title: float(value) - answer.labels[name] for title, name, value in known if name in answer.labels})

    # saving

    def _require_answer(self) -> ContactAnswer:
        if self.worker.newest is None:
            raise TwinError("there is no picture yet; wait for the first one")
        return self.worker.newest

    def save_picture(self) -> None:
        """Write the frame that is shown."""
        answer = self._require_answer()
        path = next_path(self._out, "picture", ".png")
        write_image(path, answer.frame.image)
        self._page.say(f"saved {path} ({answer.lit})")

    def save_contact(self) -> None:
        """Write the contact as ``twin render`` does."""
        answer = self._require_answer()
        if self._tracer is None:
            raise TwinError("without path tracing no contact can be saved; start the studio without --plain")
        out = next_path(self._out, "contact", "")
        out.mkdir()
        pose = PressedPose(**asdict(answer.pose), indent_mm=answer.indent_mm)
        self._tracer.save(out, self.contact.setup.obj, pose, answer.state, answer.frame.form)
        self._page.say(f"writing {out} ...")

    def save_state(self) -> None:
        """Write the whole state, and offer it to the browsers."""
        path = self.state.save(next_path(self._out, "state", ".json"))
        self._page.server.send_file_download(path.name, path.read_bytes())
        self._page.say(f"saved {path}; open it here or with: twin studio --state {path}")

    def _toggle_trajectory(self) -> None:
        if self._record_way.value:
            self._path, self._path_s = [], time.monotonic()
            return
        way, self._path = self._path, None
        if way:
            kept = [pair for k, pair in enumerate(way) if k == 0 or pair[0] > way[k - 1][0]]
            self._page.say(f"saved {save_trajectory(next_path(self._out, 'trajectory', '.csv'), kept)} (poses: {len(kept)})")

    def _toggle_film(self) -> None:
        self._end_film()
        if self._filming.value:
            self._film = FilmWriter(next_path(self._out, "video", ".mp4"))

    def _end_film(self) -> None:
        film, self._film = self._film, None
        if film is not None:
            self._page.say(film.close())
