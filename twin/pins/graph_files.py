"""Graphs of a frame, of many frames or of found pins, and their files: arrays and pictures."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from zipfile import ZipFile

import numpy as np

from scenes.files import require_regular
from scenes.sensor import SensorSpec
from twin.errors import FrameError, OptionError
from twin.frames import open_recording
from twin.frames.forms import frame_size
from twin.pins.batch import recording_reference
from twin.pins.detectors.detector import Detector, make_detector
from twin.pins.detectors.detector_spec import shipped_detector
from twin.pins.graph import GraphKind, make_graph
from twin.pins.labelling.reference import Reference, nominal_reference, spread_out
from twin.pins.pipeline import Pipeline
from twin.report.charts import area_surface_figure, draw_frame, draw_graph, draw_nodes, new_figure, save_figure
from twin.store import write_npz, writes
from twin.types import Form, PinGraph, ReadableResult

PINS = ".npz"
"""Suffix of a file of found pins."""
LARGEST_BYTES = 2_000_000_000
"""Largest unpacked size of a file of found pins, bytes. A hundred thousand frames of 331 pins have 1.3 GB."""
PICTURE_INCH = 8
"""Side of a graph's picture, inch."""
PICTURE_DPI = 120
"""Resolution of a graph's picture, dots per inch."""


@dataclass(frozen=True, repr=False)
class Graphs(ReadableResult):
    """Graphs of many frames and the files they were written to.

    Attributes
    ----------
    names : list of str
        Names of the frames that have a graph.
    graphs : list of PinGraph
    left_out : list of str
        Frames without a graph, and the reasons.
    written : list of Path
    notes : list of str
        Irregularities of the recording.
    """

    names: list[str]
    graphs: list[PinGraph]
    left_out: list[str]
    written: list[Path]
    notes: list[str]

    def lines(self) -> list[str]:
        """The result as lines of text: irregularities, frames left out, and the size of the first graph."""
        first = self.graphs[0]
        counted = f"graphs: {len(self.graphs)}; the first has {len(first.nodes_px)} nodes and {len(first.edges)} directed edges"
        return [*(f"note: {note}" for note in self.notes), *(f"skipped {reason}" for reason in self.left_out), counted]


@writes("graph.npz", "graph.png", "surface.png")
def write_graphs_of(
    path: Path, sensor: SensorSpec, out: Path, *, kind: GraphKind = "voronoi", form: Form | None = None, legacy: bool = False
) -> Graphs:
    """Build the graphs of the frames or pins at a path, and write them to a folder.

    Parameters
    ----------
    path : Path
        A frame, anything that ``open_recording`` takes, or a ``pins.npz`` of found pins.
    form : Form, optional
        Form of the frames; by default it is recognised by their size and content.
    legacy : bool
        Use the method and the boundary of the published release, which makes only Voronoi graphs of frames.

    Raises
    ------
    OptionError
        ``legacy`` does not apply to the input.
    FrameError
        No frame has a graph, or the file is not a ``pins.npz`` of this sensor.
    """
    if legacy and (kind != "voronoi" or path.suffix == PINS):
        raise OptionError("`legacy` makes Voronoi graphs of frames; leave `kind` out and give frames")
    if path.suffix == PINS:
        names, nodes_px = read_pins(path, sensor.pins.count)
        form = form or form_of_pins(sensor, nodes_px)
        reference, image = nominal_reference(sensor, form), np.zeros(frame_size(sensor, form)[::-1], np.uint8)
        graphs = [make_graph(kind, nodes, outmost=reference.outmost, net=reference.net) for nodes in nodes_px]
        found = Graphs(list(names), graphs, [], [], [])
    else:
        found, reference, image = _graphs_of_recording(path, sensor, kind, form, legacy=legacy)
    first = found.graphs[0]
    at_rest = None
    if kind == "voronoi" and not legacy:
        at_rest = make_graph(kind, reference.pins_px, outmost=reference.outmost, net=reference.net)
    pictures = draw_graph_pictures(out, sensor.name, first, at_rest, None if legacy else image)
    return replace(found, written=[write_graphs(out, found.names, found.graphs), *pictures])


def _graphs_of_recording(
    path: Path, spec: SensorSpec, kind: GraphKind, form: Form | None, *, legacy: bool = False
) -> tuple[Graphs, Reference, np.ndarray]:
    """The graphs of a recording by the pipeline or by the method of the published release, their reference, and the first picture.

    Raises
    ------
    FrameError
        No frame has a graph.
    """
    recording = open_recording(path, spec, form)
    left_out: list[str] = []
    notes: list[str] = []
    reference, _ = recording_reference(spec, recording, notes)
    pipeline: Detector | Pipeline = Pipeline(spec, recording.form, reference, graph=kind)
    if legacy:
        pipeline = make_detector(spec, shipped_detector(spec, recording.form, "legacy"))
    names: list[str] = []
    graphs: list[PinGraph] = []
    first_image: np.ndarray | None = None
    for frame in recording:
        observation = pipeline(frame)
        if observation.graph is None:
            left_out.append(f"{frame.name}: {observation.reason}")
            continue
        names.append(frame.name)
        graphs.append(observation.graph)
        first_image = frame.image if first_image is None else first_image
    left_out += [f"{bad['image_name']}: {bad['reason']}" for bad in recording.failed]
    if first_image is None:
        raise FrameError(f"{path}: no frame has a graph; the first: {left_out[0] if left_out else 'no frame in it'}")
    return Graphs(names, graphs, left_out, [], recording.problems + notes), reference, first_image


def read_pins(path: Path, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Names (M,) and node positions (M, N, 2) of the valid frames of a ``pins.npz`` with ``count`` pins N.

    The place of a lost pin is the predicted one.

    Raises
    ------
    FrameError
        The file is not a ``pins.npz``, belongs to a sensor with another number of pins, or has no valid frame.
    """
    try:
        names, pins, predicted, valid = _arrays_of(path, ("image_name", "pins_px", "predicted_px", "valid"))
    except FileNotFoundError as error:
        raise FrameError(f"{path}: no such file; 'twin preprocess' writes it") from error
    except OSError as error:
        raise FrameError(f"{path}: can't be read ({error.strerror}); write it again with 'twin preprocess'") from error
    except ValueError as error:
        raise FrameError(f"{path}: not a pins.npz, or a damaged one; write it again with 'twin preprocess'") from error
    kinds = [names.dtype.kind, pins.dtype.kind, predicted.dtype.kind, valid.dtype.kind]
    if kinds != ["U", "f", "f", "b"]:
        raise FrameError(f"{path}: its arrays are not texts, numbers, numbers and truths; write it again with 'twin preprocess'")
    frames = names.shape[0] if names.ndim else 0
    if pins.ndim != 3 or pins.shape[2] != 2 or predicted.shape != pins.shape or valid.shape != (frames,) or len(pins) != frames:
        raise FrameError(f"{path}: its arrays do not fit each other; write it again with 'twin preprocess'")
    if pins.shape[1] != count:
        raise FrameError(f"{path}: holds {pins.shape[1]} pins a frame, the sensor has {count}; give the right `sensor`")
    if not valid.any():
        raise FrameError(f"{path}: no valid frame in it; look at summary.json beside it for the reasons")
    nodes_px = np.where(np.isnan(pins), predicted, pins)[valid]
    if not np.isfinite(nodes_px).all():
        raise FrameError(f"{path}: a valid frame lacks a pin and its prediction; write it again with 'twin preprocess'")
    if not all(spread_out(nodes) for nodes in nodes_px):
        raise FrameError(f"{path}: the pins of a valid frame lie in one place, on a line or far off; write it again with 'twin preprocess'")
    return names[valid], nodes_px


def _arrays_of(path: Path, names: Sequence[str]) -> list[np.ndarray]:
    """Arrays of an ``.npz`` by name.

    Raises
    ------
    OSError
        It can't be read, or is no regular file.
    ValueError
        The file is damaged, lacks an array, holds pickles, or unpacks to more than ``LARGEST_BYTES``.
    """
    require_regular(path)
    try:
        with ZipFile(path) as packed:
            if sum(part.file_size for part in packed.infolist()) > LARGEST_BYTES:
                raise ValueError(f"unpacks to more than {LARGEST_BYTES / 1e9:g} GB")
        with np.load(path, allow_pickle=False) as data:
            return [data[name] for name in names]
    except OSError:
        raise
    except Exception as error:  # damaged bytes raise any exception in zipfile and numpy; too large a stated size raises MemoryError
        raise ValueError(str(error)) from error


def form_of_pins(spec: SensorSpec, nodes_px: np.ndarray) -> Form:
    """Form of the frames in which pins (M, N, 2) were found: the one whose layout at rest is nearer. The file does not state the form."""
    if spec.recording is None:
        return Form.RAW
    center = np.median(nodes_px.reshape(-1, 2), axis=0)
    away = {form: np.linalg.norm(center - np.median(nominal_reference(spec, form).pins_px, axis=0)) for form in Form}
    return min(away, key=lambda form: float(away[form]))


def write_graphs(out: Path, names: Sequence[str], graphs: Sequence[PinGraph]) -> Path:
    """Write M graphs to ``graph.npz``.

    Arrays: ``image_name (M,)``, ``nodes_px (M, N, 2)``, ``area_px2 (M, N)``, and the directed edges of all graphs in one array
    ``edges (E, 2)``: those of graph k are ``edges[edge_start[k]:edge_start[k + 1]]``.
    """
    arrays = {
        "image_name": np.asarray(names, dtype=np.str_),
        "nodes_px": np.stack([graph.nodes_px for graph in graphs]),
        "area_px2": np.stack([graph.area_px2 for graph in graphs]),
        "edges": np.concatenate([graph.edges for graph in graphs]),
        "edge_start": np.concatenate([[0], np.cumsum([len(graph.edges) for graph in graphs])]),
    }
    return write_npz(out / "graph.npz", arrays, compressed=True)


def draw_graph_pictures(out: Path, title: str, graph: PinGraph, at_rest: PinGraph | None, image: np.ndarray | None) -> list[Path]:
    """Draw ``graph.png``, and ``surface.png``, which compares a Voronoi graph with one ``at_rest`` if there is one. Returns the files.

    The graph is drawn over the frame (H, W[, 3]); without one, if its nodes are not in a frame's pixels, over a dark ground.
    """
    figure, (ax,) = new_figure(1, panel_inch=PICTURE_INCH)
    size = f"{len(graph.nodes_px)} nodes, {len(graph.edges)} directed edges"
    if image is not None:
        draw_frame(ax, image, f"{title}: {graph.kind}, {size}")
    else:
        ax.set(aspect="equal", title=size, facecolor="#101418")
        ax.invert_yaxis()
    draw_graph(ax, graph)
    draw_nodes(ax, graph)
    written = [save_figure(out / "graph.png", figure, dpi=PICTURE_DPI)]
    if at_rest is not None:
        written.append(save_figure(out / "surface.png", area_surface_figure(at_rest, graph), dpi=PICTURE_DPI))
    return written
