"""Shows episodes of an environment on a page: picture, pins, object, force and reward of each step.

The caller hands in the steps; this package does not depend on the environments.
"""

from dataclasses import dataclass

import numpy as np

from scenes.object import ObjectSpec
from scenes.sensor import SensorSpec
from twin.estimate import pins_in
from twin.geometry.pins import rest_pins
from twin.optics.surfaces import PaintedSurface, SkinSurface
from twin.pins import Pipeline, nominal_reference
from twin.studio.modes.mode import PageMode
from twin.studio.page import LineChart, StudioPage, frame_pictures
from twin.studio.pictures import badge, number_table, pins_found
from twin.studio.scene import PinColour, PinScene, colours
from twin.types import FloatArray, Form, Frame, PinState

AROUND_MM, MOST_BESIDE_MM = 22.0, 8.0
"""The part of an object that is shown: so far around the touched place, which may move so far before another part is shown, mm."""


@dataclass(frozen=True)
class EpisodeStep:
    """The shown data of a step.

    Attributes
    ----------
    number : int
        Number of steps done in the episode; 0 at its beginning.
    frame : Frame
        The sensor's picture.
    pins : PinState
    obj : ObjectSpec
    T_sensor_object : (4, 4) float
    force_n : (3,) float
        Force of the skin on the object.
    foot_mm : (3,) float
        Start of the force's arrow.
    reward : float
        Reward of this step.
    description : dict of str to str
        Names and values of further data to show.
    """

    number: int
    frame: Frame
    pins: PinState
    obj: ObjectSpec
    T_sensor_object: FloatArray
    force_n: FloatArray
    foot_mm: FloatArray
    reward: float
    description: dict[str, str]


class EpisodeMode(PageMode):
    """The mode 'Episode'. If several steps arrive at once, only the newest is shown.

    Parameters
    ----------
    page : Page
    sensor : SensorSpec
    form : Form
        Form of the frames.
    """

    title = "Episode"
    has_scene = True

    def __init__(self, page: StudioPage, sensor: SensorSpec, form: Form) -> None:
        super().__init__(page)
        self._sensor, self._rest = sensor, rest_pins(sensor.geometry)
        self._pipeline, self._reference = Pipeline(sensor, form), nominal_reference(sensor, form)
        self._skin = SkinSurface(sensor.skin, self._rest.base_mm)  # interpolated between the pins' feet, because some backends give no skin
        self._scene = PinScene(page.server, sensor, PaintedSurface(self._skin.rest_mm.astype(np.float32), self._skin.faces), self._rest)
        self._touched: ObjectSpec | None = None
        self._middle_mm = np.zeros(3)  # of the part of the object that is shown
        self._last: EpisodeStep | None = None
        self._steps = self.newest(self._show, "episode")
        self._rewards, self._forces = self.charts = LineChart(page, "reward of a step"), LineChart(page, "force on the object, N")

    def give(self, step: EpisodeStep) -> None:
        """Give the next step to show. Returns at once."""
        self._last = step
        self._steps.give(step)

    def show(self) -> None:
        """Show the newest step again, or a message that there is none yet."""
        if self._last is None:
            self._page.show_nothing("Waiting for the first step.")
        else:
            self._steps.give(self._last)

    def _show(self, step: EpisodeStep) -> None:
        seen = pins_in(step.frame, None, self._pipeline)
        place = step.T_sensor_object[:3, :3].T @ (step.foot_mm - step.T_sensor_object[:3, 3])
        if step.obj != self._touched or np.abs(place - self._middle_mm).max() > MOST_BESIDE_MM:
            self._scene.put_object(step.obj, np.add.outer(place, [-AROUND_MM, AROUND_MM]).ravel().tolist())
            self._touched, self._middle_mm = step.obj, place
        rows = {
            "step": str(step.number),
            "reward": f"{step.reward:+.3f}",
            "object": step.obj.name,
            "force x, y, z": "  ".join(f"{value:+.2f}" for value in step.force_n + 0.0) + " N",
            "pins found": pins_found(seen),
        }
        way_mm = np.linalg.norm(step.pins.caps_mm - self._rest.caps_mm, axis=1)

        def scene() -> None:
            skin_mm = self._skin.vertices(step.pins.base_mm).astype(np.float32)
            self._scene.show_pins(step.pins, skin_mm, colours(way_mm, PinColour.DISPLACEMENT))
            self._scene.show_object(step.T_sensor_object)
            self._scene.show_force(step.foot_mm, step.force_n)
            self._rewards.add({"reward": step.reward})
            self._forces.add(dict(zip("xyz", step.force_n.tolist(), strict=True)))

        mark = f"<span data-number='{step.number}' data-depth='0'></span>"
        numbers = [mark, badge("episode", "moving"), number_table(rows | step.description)]
        pictures = frame_pictures(self._sensor, self._reference, step.frame, seen)
        self.put_up(pictures, f"camera, {step.frame.form} frame", numbers, also=scene)


class EpisodePage(StudioPage):
    """A page that shows the steps of episodes to any number of browsers. A context manager.

    Parameters
    ----------
    title : str
    sensor : SensorSpec
    form : Form
        Form of the frames.
    host, port : str, int
        As for ``StudioPage``.

    Raises
    ------
    TwinError
        The server can't listen on this host and port.
    """

    def __init__(self, title: str, sensor: SensorSpec, form: Form, *, host: str = "127.0.0.1", port: int = 0) -> None:
        super().__init__(title, host=host, port=port)
        self._episode = EpisodeMode(self, sensor, form)
        self.set_modes([self._episode])
        self._episode.start()

    def __exit__(self, *_: object) -> None:
        self._episode.stop()
        super().__exit__()

    def show(self, step: EpisodeStep) -> None:
        """Show a step; returns at once."""
        self._episode.give(step)
