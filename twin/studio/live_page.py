"""Shows live frames on a page: pictures, estimate and rates as they arrive. ``twin live`` opens it; the studio's mode 'Live' shows the
same.

Frames and estimates are handed in; this package does not depend on the devices.
"""

from dataclasses import dataclass

from scenes.sensor import SensorSpec
from twin.estimate import Estimate, readable_labels
from twin.pins.labelling.reference import Reference
from twin.studio.camera import dome_part
from twin.studio.page import LineChart, StudioPage
from twin.studio.pictures import OverlayChoices, badge, camera_picture, cell_picture, estimate_table, paragraph, pins_found
from twin.types import Frame, ImageArray, Observation

CHARTED = 3
"""Number of labels that the chart shows."""


@dataclass(frozen=True)
class LiveFrame:
    """A live frame, the model's estimate, and lines about rates and losses."""

    frame: Frame
    estimate: Estimate
    lines: tuple[str, ...]


def frame_pictures(
    sensor: SensorSpec, reference: Reference, frame: Frame, seen: Observation, drawn: OverlayChoices = OverlayChoices.GRAPH
) -> tuple[ImageArray, ImageArray]:
    """The dome's part of a frame with its overlay, and its Voronoi cells by their change of area; (h, w, 3) uint8 RGB each."""

    def crop(image: ImageArray) -> ImageArray:
        return dome_part(sensor, image, frame.form)

    return crop(camera_picture(frame, seen, reference.pins_px, drawn)), cell_picture(frame, seen, reference.area_px2, crop)


def frame_numbers(live: LiveFrame, seen: Observation) -> list[str]:
    """HTML of the estimate, the number of found pins, and the lines."""
    return [estimate_table(live.estimate, {}), *(paragraph(line, "note") for line in (f"pins found: {pins_found(seen)}", *live.lines))]


def chart_values(estimate: Estimate) -> dict[str, float]:
    """The values for the chart, by label; none without an estimate."""
    named = zip(readable_labels(estimate.names)[:CHARTED], estimate.value, strict=False)
    return {name: float(value) for name, value in named} if estimate.valid else {}


class LivePage(StudioPage):
    """A page that shows live frames to any number of browsers. A context manager.

    Parameters
    ----------
    title : str
    sensor : SensorSpec
    reference : Reference
        Pins at rest.
    host, port : str, int
        As for ``StudioPage``.

    Raises
    ------
    TwinError
        The server can't listen on this host and port.
    """

    def __init__(self, title: str, sensor: SensorSpec, reference: Reference, *, host: str = "127.0.0.1", port: int = 0) -> None:
        super().__init__(title, host=host, port=port)
        self._title, self._sensor, self._reference = title, sensor, reference
        self._chart = LineChart(self, "live estimates")
        self.show_nothing("Waiting for the first frame.")

    def show(self, live: LiveFrame, seen: Observation) -> None:
        """Show a frame with the pipeline's observation of it. Browsers get pictures and numbers together."""
        pictures = frame_pictures(self._sensor, self._reference, live.frame, seen)
        numbers = [badge("live", "moving"), paragraph(self._title, "note"), *frame_numbers(live, seen)]

        def change() -> None:
            self.show_pictures(*pictures, f"live {live.frame.form} frame {live.frame.sequence}")
            self.show_numbers(*numbers)
            self._chart.add(chart_values(live.estimate))

        self.together(change)
