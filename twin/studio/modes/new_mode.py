"""The mode 'Your own sensor': it makes a specification from a folder of frames, and the user can correct the layout."""

from pathlib import Path

import numpy as np

from scenes.base import SpecError
from scenes.files import quote
from scenes.pins import layout_from
from scenes.sensor import SensorSpec
from twin.calibration.new_sensor import NewSensor, new_sensor
from twin.errors import ErrorsAs, TwinError
from twin.frames import Recording, frames_at, open_recording
from twin.pins.pipeline import Pipeline
from twin.studio.modes.mode import PageMode
from twin.studio.modes.twin_mode import TwinMode
from twin.studio.page import StudioPage, put
from twin.studio.pictures import CONTROLS, OverlayChoices, badge, camera_picture, cell_picture, number_table, paragraph
from twin.studio.state import FIRST_DEPTH_MM, next_path
from twin.types import Form

LARGER, SMALLER = "one larger", "one smaller"
"""Corrections of a layout: one ring more or less, or for a grid one row and one column."""


Wish = tuple[Path, Path | None, str, float | None]
"""The user's input for a specification: frames, a frame without contact, text for ``layout_from`` ("" to have the layout identified), and
the dome's radius in mm (None for that of a printed TacTip)."""


class NewMode(PageMode):
    """The mode 'Your own sensor'.

    Parameters
    ----------
    page : Page
    twin : TwinMode
        The mode in which the new sensor is used.
    out : Path
        Folder for specifications.
    """

    title = "Your own sensor"

    def __init__(self, page: StudioPage, twin: TwinMode, out: Path) -> None:
        super().__init__(page)
        self._twin, self._out = twin, out
        self._proposed: tuple[NewSensor, Recording, Pipeline] | None = None
        self._absent = "Give the folder of your sensor's frames, in contact or not, and press 'Propose a specification'."
        self._making = self.newest(self._make, "new")
        self._looking = self.newest(self._look, "new-frame")
        gui = page.gui
        with self.folder:
            self._frames = gui.add_text("frames", "", hint="folder, video or recording on the studio's machine")
            page.upload_frames(self._take_upload)
            self._no_contact = gui.add_text("no-contact frame", "", hint="a picture without contact; may be empty")
            self._layout = gui.add_text("layout", "", hint="empty: identified; or rings:10, hexagon:6, grid:9x7, positions:FILE.csv")
            hint = "empty: 20, that of a printed TacTip; all lengths are in proportion to it"
            self._radius = gui.add_text(CONTROLS["radius_mm"], "", hint=hint)
            page.button("Propose a specification", self.propose)
            correct = gui.add_button_group("correct the layout", (SMALLER, LARGER))
            self._number = page.watch(gui.add_slider("frame shown", 0, 1, 1, 0, disabled=True), self._look_again)
            page.button("Use this sensor", self.use)
        correct.on_click(page.guard(lambda: self.correct(+1 if correct.value == LARGER else -1)))

    def show(self) -> None:
        """Show the newest proposal."""
        if self._proposed is None:
            self._page.show_nothing(self._absent)
        else:
            self._look_again()

    def _look_again(self) -> None:
        self._looking.give(int(self._number.value))

    def _take_upload(self, path: str) -> None:
        put(self._frames, path)
        self.propose()

    def propose(self) -> None:
        """Make a specification from the user's input. This takes some seconds to half a minute.

        Raises
        ------
        TwinError
            No frames are given, or the radius is no number.
        """
        if not self._frames.value.strip():
            raise TwinError("give the folder of your sensor's frames first")
        controls = self._frames, self._no_contact, self._layout, self._radius
        frames, no_contact, layout, radius = (control.value.strip() for control in controls)
        refusal = TwinError(f"`radius_mm` {quote(radius)}: give a number, or nothing for a printed TacTip's 20")
        with ErrorsAs(ValueError, lambda error: refusal):
            radius_mm = float(radius) if radius else None
        self._proposed, self._absent = None, "The frames are being processed."
        self.show()
        self._making.give((Path(frames), Path(no_contact) if no_contact else None, layout, radius_mm))

    def correct(self, by: int) -> None:
        """Propose again with a layout that is larger or smaller by ``by``.

        Raises
        ------
        TwinError, SpecError
            Nothing has been proposed yet, the layout is a list of positions, or it would become too small.
        """
        pins = self._proposal().sensor.pins
        text = f"{pins.layout}:{pins.shape.resize(by)}"
        layout_from(text)  # raises an error if there is no such layout
        put(self._layout, text)
        self.propose()

    def use(self) -> None:
        """Use the proposed sensor in the mode 'Twin', in contact.

        Raises
        ------
        TwinError
            Nothing has been proposed yet.
        """
        written = str(self._proposal().written[0])
        self._twin.open(self._twin.state.alter(sensor=written, form=Form.RAW, pose={"depth_mm": FIRST_DEPTH_MM}))
        self._page.choose(self._twin.title)

    def _proposal(self) -> NewSensor:
        if self._proposed is None:
            raise TwinError("nothing has been proposed yet; press 'Propose a specification' first")
        return self._proposed[0]

    def _make(self, wish: Wish) -> None:
        def report(stage: str, done: float, total: float, note: str = "") -> None:
            share = f", {100 * done / total:.0f} %" if total else ""
            self._page.say(f"processing the frames: {stage}{share}")

        frames, no_contact, layout, radius_mm = wish
        out = next_path(self._out, "my-sensor", ".toml")
        try:
            pins = layout_from(layout) if layout else None
            made = new_sensor(frames, out, layout=pins, radius_mm=radius_mm, no_contact=no_contact, progress=report)
        except (TwinError, SpecError) as error:
            self._absent = f"No specification: {error}"
            self._page.hush()
            if self._active:
                self.show()
            return
        recording = open_recording(frames_at(frames, None, no_contact), made.sensor)
        self._proposed = made, recording, Pipeline(made.sensor, recording.form)
        self._number.max, self._number.disabled = max(1, len(recording) - 1), False
        self._page.say(f"wrote {made.written[0]}, and a page beside it")
        self._looking.give(min(int(self._number.value), len(recording) - 1))

    def _look(self, index: int) -> None:
        if (proposed := self._proposed) is None or not self._active:
            return
        made, recording, pipeline = proposed
        frame = recording.read(int(np.clip(index, 0, len(recording) - 1)))
        seen = pipeline(frame)
        camera = camera_picture(frame, seen, pipeline.reference.pins_px, OverlayChoices.GRAPH)
        cells = cell_picture(frame, seen, pipeline.reference.area_px2)
        numbers = _numbers(made, f"{frame.name} ({index + 1} of {len(recording)})", f"{seen.found} of {seen.expected}", pipeline.spec)
        self.put_up((camera, cells), f"frame {frame.name} with the proposed layout", numbers)


def _numbers(made: NewSensor, frame: str, found: str, sensor: SensorSpec) -> list[str]:
    """HTML of a proposal: how certain it is, doubts, its results on the frames, and the next steps."""
    sure = made.identified.sure
    rows = {"layout": sensor.pins.in_words(), "frame": frame, "pins found": found, "file": made.written[0].name}
    lines = made.lines()
    return [
        badge("sure" if sure else "UNSURE", "still" if sure else "moving"),
        number_table(rows),
        *(paragraph(line, "stop") for line in lines if line.startswith("doubt: ")),
        *(paragraph(line, "said" if line.startswith(("or: ", "next: ")) else "note") for line in lines if not line.startswith("doubt: ")),
    ]
