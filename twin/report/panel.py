"""One picture of one contact: skin, frame, pins and graph, area change, displacement."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.image import imread

from twin.errors import FrameError
from twin.report.charts import new_figure
from twin.report.plots import draw_area_change, draw_displacement, draw_frame, draw_graph, draw_pins
from twin.types import Frame, Observation, PinGraph


@dataclass(frozen=True)
class Look:
    """A frame through the pipeline, beside the same sensor without contact.

    ``rest`` is the observation of a no-contact frame of the same form.
    """

    frame: Frame
    observation: Observation
    rest: Observation

    def graphs(self) -> tuple[PinGraph, PinGraph]:
        """The graph of the frame and that of no contact.

        Raises
        ------
        FrameError
            The pipeline found no graph in one of them.
        """
        if self.observation.graph is None or self.rest.graph is None:
            raise FrameError(f"{self.frame.name}: no graph of its pins: {self.observation.reason or self.rest.reason}")
        return self.observation.graph, self.rest.graph


def contact_panel(skin_picture: Path, look: Look, title: str) -> Figure:
    """Six panels of one contact; where the pipeline found no graph the reason stands in its place."""
    figure, axes = new_figure(3, 2, panel_inch=4.4)
    figure.suptitle(title)
    axes[0].imshow(imread(skin_picture))
    axes[0].set(title="deformed skin, cut open", xticks=[], yticks=[])
    draw_frame(axes[1], look.frame.image, "what the camera sees")
    around_px = None if look.rest.graph is None else look.rest.graph.nodes_px
    draw_frame(axes[2], look.frame.image, f"{look.observation.found} pins found", around_px=around_px)
    draw_pins(axes[2], look.observation)
    graph = look.observation.graph
    if graph is None or look.rest.graph is None:
        for ax in axes[3:]:
            ax.text(0.5, 0.5, look.observation.reason or look.rest.reason, ha="center", wrap=True)
            ax.set_axis_off()
        return figure
    draw_frame(axes[3], look.frame.image, f"Voronoi graph: {len(graph.edges)} directed edges", around_px=around_px)
    draw_graph(axes[3], graph)
    draw_area_change(axes[4], graph, look.rest.graph.area_px2, "Voronoi areas against no contact")
    draw_displacement(axes[5], look.rest.graph.nodes_px, graph.nodes_px, "pin displacement")
    return figure


def area_change_at(look: Look, center_px: np.ndarray, *, count: int) -> float:
    """Mean relative change (percent) of the Voronoi areas of the ``count`` pins nearest to a point."""
    graph, rest = look.graphs()
    near = np.argsort(np.hypot(*(graph.nodes_px - center_px).T))[:count]
    return float(100 * np.mean(graph.area_px2[near] / rest.area_px2[near] - 1))
