"""Commands on frames, rendered or real.

- ``twin preprocess``: find the pins in frames.
- ``twin graph``: graphs of frames or of found pins, as arrays and pictures.
- ``twin tune``: parameters of the pin detection, found from a user's own frames.
- ``twin check``: the health of the sensor.
"""

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from typer import Argument, Option

from twin.cli import app, options
from twin.cli.options import call, load_if_named, sensor_with
from twin.progress import Progress

if TYPE_CHECKING:
    from hardware.live.examining import Examination
    from twin.pins.batch import Preprocessed
    from twin.pins.detectors.tune_files import TunedOnFrames
    from twin.pins.graph_files import Graphs

Method = Literal["twin", "legacy", "adaptive", "fixed", "simple", "log", "dog", "doh"]


@app.command("preprocess")
def preprocess(
    path: Annotated[Path, Argument(help="image, folder of frames, video or recording")],
    sensor: options.Sensor,
    out: options.Out,
    form: options.FormOrAuto = None,
    overlay: Annotated[bool, Option("--overlay", help="also write a picture of every frame with its pins and graph")] = False,
    table: options.Table = None,
    no_contact: options.NoContact = None,
    pipeline: options.Tuning = None,
    *,
    progress: Progress,
) -> "Preprocessed":
    """Find the pins in every frame.

    The input is an image, a folder of images, a video, or a recording (frames_bw/, images/, sensor_images/ or processed_images/ with
    targets.csv and metadata). A file init_* is the reference without contact, not a frame. Broken frames are listed and skipped. The exit
    code is 0 if at least one frame was good.

    \b
    Writes pins.npz:
      image_name (M,)    base names, in the order of targets.csv if there is one
      pins_px (M, N, 2)  (x, y) in px of the input frame, pixel centres at
                         integers, the specification's pin order; NaN where a pin
                         has no blob of its own
      predicted_px       same shape: positions that the motion model predicts for
                         pins that are NaN in pins_px, NaN for all others
      area_px2 (M, N)    Voronoi cell areas
      found (M,), valid (M,)
    and summary.json (frames, in_view: median number of pins that the picture's
    border does not cut off, exact_fraction: share of frames in which all these
    are found, ms.<stage>.p50|p95|p99, parameters,
    failed).

    \b
    Example:
      twin preprocess recordings/mine --sensor mg400-331 --out out/pins
    """
    from twin.frames import frames_at
    from twin.pins.batch import preprocess_recording
    from twin.progress import stage

    spec = sensor_with(sensor, pipeline)
    with stage(progress, "frames") as step:
        return preprocess_recording(frames_at(path, table, no_contact), spec, out, form=form, overlay=overlay, progress=step)


@app.command("graph")
def graph(
    path: Annotated[Path, Argument(help="frame, folder of frames, or pins.npz")],
    sensor: options.Sensor,
    out: options.Out,
    kind: Annotated[Literal["knn", "delaunay", "voronoi"], Option(help="kind of graph")] = "voronoi",
    form: options.FormOrAuto = None,
    legacy: Annotated[bool, Option("--legacy", help="method and boundary of the published code, for comparison")] = False,
    table: options.Table = None,
    no_contact: options.NoContact = None,
    pipeline: options.Tuning = None,
) -> "Graphs":
    """Build the graphs of frames or of found pins.

    The input is a frame, a folder of frames, or the pins.npz of 'twin preprocess'.

    \b
    knn       edges from each pin to its 6 nearest (directed)
    delaunay  both directions of every side of the Delaunay triangles
    voronoi   the same edges, and the area of each pin's Voronoi cell inside the
              enlarged boundary around the outermost pins

    \b
    Writes:
      graph.npz     image_name (M,), nodes_px (M, N, 2), area_px2 (M, N), and
                    edges (E, 2) of all graphs one after the other: graph k has
                    the edges edges[edge_start[k]:edge_start[k+1]]
      graph.png     the first graph
      surface.png   its cell areas as a surface: no contact, contact, difference

    With --legacy (for processed frames) pins, edges and areas are computed as by the published code: the nodes are in its detector's
    order, in px of its resized image, relative to its scalar median. A frame in which not exactly all pins are found is left out.

    \b
    Example:
      twin graph frame.png --sensor mg400-331 --kind voronoi --out out/graph
    """
    from twin.frames import frames_at
    from twin.pins.graph_files import write_graphs_of

    return call(write_graphs_of, locals(), path=frames_at(path, table, no_contact))


@app.command("tune")
def tune(
    sensor: options.Sensor,
    frames: Annotated[Path, Option(metavar="DIR", help="folder of frames, video or recording")],
    out: Annotated[Path | None, Option(metavar="FILE.toml", help="the file to write")] = None,
    method: Annotated[Method, Option(help="method to tune")] = "twin",
    form: options.FormOrAuto = None,
    max_frames: options.MaxFrames = 12,
    table: options.Table = None,
    no_contact: options.NoContact = None,
    *,
    progress: Progress,
) -> "TunedOnFrames":
    """Find parameters of the pin detection for your own frames.

    These are mask, crop, threshold and blob parameters. From the sensor's specification only the layout of the pins is used (count, rings,
    round or hexagon). Give some frames, with or without contact, raw or thresholded. For thresholded frames there is no crop, and the
    threshold hardly matters.

    It prints the reliability of the result: the share of frames in which all pins are found (recall), the range of the threshold in gray
    levels, and warnings. It writes a file for --pipeline of the other commands. You can copy the section [blob] of this file to
    [pipeline.raw] or [pipeline.processed] of a sensor's specification. The file also contains the pins' positions at rest: from a frame
    without contact (init_*, --no-contact, or one among the frames), otherwise estimated from the contacts. It prints which.

    \b
    Example:
      twin tune --sensor ur5-331 --frames recordings/mine --out mine.toml
    """
    from twin.frames import frames_at
    from twin.pins.detectors.tune_files import tune_on_frames

    return call(tune_on_frames, locals(), path=frames_at(frames, table, no_contact))


# Exit code of 'twin check' if the sensor has failed. It differs from those of a failure (1) and of a wrong command line (2).
FAILED = 3


@app.command("check", exit_code=lambda found: FAILED if found.failed else 0)
def check(
    source: Annotated[
        str, Argument(metavar="FRAME", help="image, folder of frames, video, recording, or a camera: 0, /dev/video2, http://...")
    ],
    sensor: options.Sensor,
    form: options.FormOrAuto = None,
    pipeline: Annotated[Path | None, Option(metavar="FILE.toml", help="file of 'twin tune'")] = None,
    max_frames: options.MaxFrames = 20,
    no_contact: Annotated[Path | None, Option(metavar="FRAME", help="frame without contact, for --push")] = None,
    push: Annotated[
        list[str] | None, Option(metavar="SIDE:FRAME", help="contact whose object was moved to the sensor's x, y, -x or -y; repeat it")
    ] = None,
    twist: Annotated[
        Path | None, Option(metavar="FRAME", help="contact whose object was turned from x to y, instead of a second push")
    ] = None,
    out: Annotated[Path | None, Option(metavar="FILE.toml", help="copy of the specification with the view of --push")] = None,
    page: Annotated[Path | None, Option(metavar="DIR", help="folder for a page with the findings and pictures")] = None,
    model: Annotated[Path | None, Option(metavar="RUN", help="run that must know the contacts; by default the sensor's weights")] = None,
    *,
    progress: Progress,
) -> "Examination":
    """Check the health of the sensor, with remedies.

    It checks brightness, focus, missing pins, specks, glare, and drift from the calibration. The input is a frame, a folder of frames, a
    video or a camera, with or without contact. It compares the frames with a frame that the twin renders from the sensor's specification.
    In thresholded frames it can check only pins, specks and position. A lost pin or a spot counts as a fault of the sensor if half of the
    frames show it, so give frames of several contacts. If there are weights of the sensor, it lists frames outside their domain (torn,
    displaced, unknown contact) with the reason.

    The exit code is 3 if something has failed, otherwise 0.

    On a symmetric layout, the pins of an unknown unit do not show a turn by a symmetry, or a mirror. Contacts that push the pins in known
    directions determine both. With --push and --no-contact it determines turn, mirror, size and position of the picture and the pins at
    rest, writes them to --out as a copy of the specification, and checks the frames against this copy.

    \b
    Example:
      twin check recordings/today --sensor ur5-331 --page out/health
      twin check 0 --sensor mine.toml
      twin check today --sensor mine.toml --no-contact rest.png \\
          --push x:right.png --push y:down.png --out turned.toml
    """
    from hardware.live.examining import examine_sensor
    from scenes import load_sensor
    from training.studies.contact_check import contact_finding
    from twin.pins import load_detector

    detector, contacts = load_if_named(load_detector, pipeline), partial(contact_finding, run=model)
    return call(examine_sensor, locals(), sensor=load_sensor(sensor))
