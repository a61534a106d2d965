"""The mode 'Recording': frames of a real sensor, estimates compared with labels, and the twin's picture of each labelled contact."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from scenes import load_object
from scenes.experiment import LABELS, ExperimentSpec
from twin.errors import ContactError, FrameError, TwinError
from twin.estimate import Estimate, SensorModel, pins_in, readable_labels
from twin.frames import Recording, open_recording
from twin.pins.batch import recording_reference
from twin.pins.pipeline import Pipeline
from twin.rig.contact import RigContact
from twin.rig.labels import ArmLabel, poses_and_moves, read_arm_labels
from twin.studio.camera import dome_part
from twin.studio.contact import MovingContact, experiment_of
from twin.studio.modes.mode import PageMode
from twin.studio.modes.twin_mode import TwinMode
from twin.studio.page import CELLS, StudioPage, frame_pictures, put
from twin.studio.pictures import badge, estimate_table, number_table, paragraph
from twin.types import Form, Frame, ImageArray, Observation

UNSURE = 0.5
"""Probability below which the model doubts that a move was executed."""


@dataclass(frozen=True)
class Looked:
    """One frame of a recording, with the results for it.

    Attributes
    ----------
    index : int
    frame : Frame
    seen : Observation
    estimate : Estimate or None
    label : ArmLabel or None
        None where the recording has no labels.
    doubts : tuple of str
        Reasons to doubt the label.
    """

    index: int
    frame: Frame
    seen: Observation
    estimate: Estimate | None
    label: ArmLabel | None
    doubts: tuple[str, ...]


class RecordingView:
    """Frames of one recording, evaluated one at a time.

    Parameters
    ----------
    path : path
        Path as for ``open_recording``.
    contact : MovingContact
        Its sensor, solver and camera are used.

    Raises
    ------
    FrameError
        There is no such recording, or it belongs to another sensor.
    """

    def __init__(self, path: str | Path, contact: MovingContact) -> None:
        sensor = contact.setup.sensor
        self.contact = contact
        self.recording: Recording = open_recording(path, sensor)
        self.notes: list[str] = []
        self.reference, name = recording_reference(sensor, self.recording, self.notes)
        self._pipeline = Pipeline(sensor, self.recording.form, self.reference)
        self.notes.append(f"displacements of pins are relative to {name}")
        self._labels: list[ArmLabel] = []
        try:
            self._labels = read_arm_labels(self.recording)
        except FrameError as error:
            self.notes.append(str(error))
        self.given = contact.model
        self._model = self._fitting(self.given)
        self._experiment: ExperimentSpec | None = None if self._model is None else experiment_of(self._model)
        self._rig: RigContact | None = None

    def __len__(self) -> int:
        return len(self.recording)

    def _fitting(self, model: SensorModel | None) -> SensorModel | None:
        """The model for this recording's frames. It uses the recording's no-contact frame if both allow this."""
        form, rest = self.recording.form, self.recording.reference
        try:
            if model is None:
                raise FrameError("there is no model of this sensor")
            if model.form != form:
                raise FrameError(f"the model is for {model.form} frames, these are {form} ones")
            return model if rest is None or not model.counts_from_rest else model.at_rest(rest)
        except FrameError as error:
            self.notes.append(f"no estimates: {error}")
            return None

    def look(self, index: int) -> Looked:
        """A frame, what is found in it, and its label.

        Raises
        ------
        FrameError
            The frame can't be read, or belongs to another sensor.
        """
        frame = self.recording.read(index)
        estimate = None if self._model is None else self._model(frame)
        seen = pins_in(frame, estimate, self._pipeline)
        label = self._labels[index] if self._labels else None
        told = _label_values(label)
        doubts = [] if label is None or label.executed else ["audit: the move was not executed"]
        executed = float(getattr(estimate, "executed", np.nan))
        if label is not None and np.abs(label.move).max() > 0 and executed < UNSURE:
            doubts.append(f"model: the move was executed with a probability of {100 * executed:.0f} %")
        if estimate is not None and estimate.valid:
            values = zip(estimate.names, readable_labels(estimate.names), estimate.low, estimate.high, strict=True)
            outside = [title for name, title, low, high in values if name in told and not low <= told[name] <= high]
            doubts += [f"{name} is outside the 90 % interval" for name in outside]
        return Looked(index, frame, seen, estimate, label, tuple(doubts))

    def twin_picture(self, looked: Looked) -> ImageArray | None:
        """The dome's part of the twin's frame of a labelled contact; None without labels, or without an experiment for their axes.

        Raises
        ------
        ContactError
            The contact can't be solved.
        """
        if looked.label is None or self._experiment is None:
            return None
        if self._rig is None:
            self._rig = RigContact(self.contact.solver, self._experiment, load_object(self._experiment.object))
        camera = self.contact.camera
        raw = camera.raw(camera.draw(self._rig.end(looked.label)), seed=0)
        frame = raw if self.recording.form is Form.RAW else camera.as_recorded(raw)
        image = dome_part(self.contact.setup.sensor, frame.image, frame.form)
        return image if image.ndim == 3 else np.repeat(image[..., None], 3, axis=2)


def _label_values(label: ArmLabel | None) -> dict[str, float]:
    """A label's values by the tables' names: the arm's real pose and move, which differ from the table's if the move was not executed."""
    if label is None:
        return {}
    return dict(zip(LABELS, np.concatenate(poses_and_moves([label]), axis=None).tolist(), strict=True))


class RecordingMode(PageMode):
    """The mode 'Recording'.

    Parameters
    ----------
    page : Page
    twin : TwinMode
    first : str
        Recording that is offered at first.
    """

    title = "Recording"

    def __init__(self, page: StudioPage, twin: TwinMode, first: str = "") -> None:
        super().__init__(page)
        self._twin, self._first = twin, first
        self._view: RecordingView | None = None
        self._wanted = self.newest(self._show, "recording")
        gui = page.gui
        with self.folder:
            self._path = gui.add_text("folder or video", first, hint="any recording that 'twin preprocess' reads, on the studio's machine")
            page.button("Open", lambda: self.open(self._path.value))
            page.upload_frames(self._take_upload)
            self._number = page.watch(gui.add_slider("frame number", 0, 1, 1, 0, disabled=True), lambda: self._go(int(self._number.value)))
            steps = gui.add_button_group("step", ("-10", "-1", "+1", "+10"))
            page.button("Next doubtful label", lambda: self._wanted.give(-1), hint="the next frame whose label is doubtful")
            self._against = page.watch(gui.add_checkbox("the twin's picture beside it", True), self._show_again)
        steps.on_click(lambda event: self._go(int(self._number.value) + int(event.target.value)))

    def show(self) -> None:
        """Show the recording. The recording that the command named is opened now."""
        self._page.show_nothing("Give a recording's folder or video and press 'Open'.")
        if self._view is None and self._first:
            self._page.guard(lambda: self.open(self._first))(self)
        elif self._view is not None and self._view.contact is not self._twin.contact:  # the user has changed the sensor
            self._page.guard(lambda: self.open(self._path.value))(self)
        else:
            self._show_again()

    def _show_again(self) -> None:
        self._wanted.give(int(self._number.value))

    def open(self, path: str) -> None:
        """Show another recording.

        Raises
        ------
        TwinError
            There is no such recording, or it belongs to another sensor.
        """
        if not path.strip():
            raise TwinError("give a recording's folder or video first")
        self._view = RecordingView(path.strip(), self._twin.contact)
        self._number.max = max(1, len(self._view) - 1)
        self._number.disabled = False
        self._go(0)

    def _take_upload(self, path: str) -> None:
        put(self._path, path)
        self.open(path)

    def _go(self, index: int) -> None:
        if self._view is not None:
            put(self._number, int(np.clip(index, 0, len(self._view) - 1)))
            self._show_again()

    def follow(self, answer: object) -> None:
        """Show the frame again, with estimates, if the twin has loaded a model since it was opened."""
        if self._view is not None and self._view.given is not self._view.contact.model:
            self._show_again()

    def _show(self, index: int) -> None:
        view = self._view
        if view is None or not self._active:
            return
        if view.given is not view.contact.model:  # it was loaded after the recording was opened
            renewed = RecordingView(view.recording.path, view.contact)
            if self._view is not view:  # another one was opened meanwhile, and is shown next
                return
            view = self._view = renewed
        looked = self._next_doubt(view) if index < 0 else view.look(index)
        if looked is None:
            return
        self._show_frame(view, looked)
        if not self._against.value or looked.label is None or self._wanted.overtaken:
            return
        try:
            made = view.twin_picture(looked)
        except ContactError as error:
            self._show_frame(view, looked, note=f"The twin has no picture of this contact: {error}")
            return
        if made is not None and not self._wanted.overtaken:
            self._show_frame(view, looked, made)

    def _next_doubt(self, view: RecordingView) -> Looked | None:
        """The next frame with a doubtful label, searched after the shown frame and then from the beginning."""
        at = int(self._number.value)
        for step in range(1, len(view) + 1):
            if self._wanted.overtaken:
                return None
            looked = view.look((at + step) % len(view))
            if looked.doubts:
                put(self._number, looked.index)
                return looked
        self._page.say("No label of this recording is doubtful.")
        return None

    def _show_frame(self, view: RecordingView, looked: Looked, twins: ImageArray | None = None, *, note: str = "") -> None:
        told, values = looked.label, _label_values(looked.label)
        found = f"{looked.seen.found} of {len(looked.seen.pins_px)}"
        rows = {"frame": f"{looked.frame.name} ({looked.index + 1} of {len(view)})", "pins found": found}
        if told is not None:
            rows |= {"label, pose": _six(told.pose), "label, move": _six(told.move)}
        camera, cells = frame_pictures(view.contact.setup.sensor, view.reference, looked.frame, looked.seen)
        beside, below = (cells, CELLS) if twins is None else (twins, "the twin's picture of this contact")
        numbers = [
            badge("recorded") + badge(str(view.recording.form)),
            paragraph("; ".join(looked.doubts), "stop"),
            paragraph("" if looked.seen.valid else f"The pipeline refuses the frame: {looked.seen.reason}", "stop"),
            number_table(rows),
            estimate_table(looked.estimate, values, missing=next((n for n in view.notes if n.startswith("no estimates")), "")),
            paragraph("The label is used as ground truth." if values else "", "note"),
            paragraph(note, "said"),
            *(paragraph(text, "note") for text in [*view.recording.problems, *view.notes][:4]),
        ]
        self.put_up((camera, beside), f"recorded frame {looked.frame.name}", numbers, below=below)


def _six(values: np.ndarray) -> str:
    """Six coordinates, mm and deg."""
    return " ".join(f"{value:+.1f}" for value in values)
