"""Commands on frames, rendered or real.

- ``twin preprocess``: find the pins in frames.
- ``twin graph``: graphs of frames or of found pins, as arrays and pictures.
- ``twin tune``: parameters of the pin detection, found from a user's own frames.
- ``twin check``: the health of the sensor.
"""

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from twin.cli import app
from twin.cli.options import FormOrAuto, MaxFrames, NoContact, Out, Sensor, Table, Tuning, load_if_named, sensor_with
from twin.progress import Progress

if TYPE_CHECKING:
    from hardware.live.examining import Examination
    from twin.pins.batch import Preprocessed
    from twin.pins.graph_files import Graphs
    from twin.pins.tune_files import TunedOnFrames


@app.command("preprocess")
def preprocess(
    path: Annotated[Path, typer.Argument(help="image, folder of frames, video or recording")],
    sensor: Sensor,
    out: Out,
    form: FormOrAuto = None,
    overlay: Annotated[bool, typer.Option("--overlay", help="also write a picture of every frame with its pins and graph")] = False,
    table: Table = None,
    no_contact: NoContact = None,
    pipeline: Tuning = None,
    *,
    progress: Progress,
) -> "Preprocessed":
    """Find the pins in every frame.

    The frames are an image, a folder of images, a video, or a folder of the recordings (frames_bw/, images/, sensor_images/ or
    processed_images/ with targets.csv and metadata). A file init_* is the reference without contact, not a frame. Broken frames are
    listed and skipped. The exit code is 0 if at least one frame was good.

    \b
    Writes pins.npz:
      image_name (M,)    base names, in the order of targets.csv if there is one
      pins_px (M, N, 2)  (x, y) in px of the input frame, pixel centres at
                         integers, the specification's pin order; NaN where a pin
                         has no blob of its own
      predicted_px       same shape: the motion model's guess for the pins that
                         are NaN in pins_px, NaN for all others
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
    path: Annotated[Path, typer.Argument(help="frame, folder of frames, or pins.npz")],
    sensor: Sensor,
    out: Out,
    kind: Annotated[Literal["knn", "delaunay", "voronoi"], typer.Option("--kind", help="kind of graph")] = "voronoi",
    form: FormOrAuto = None,
    legacy: Annotated[bool, typer.Option("--legacy", help="the published release's own method and boundary, to compare with")] = False,
    table: Table = None,
    no_contact: NoContact = None,
    pipeline: Tuning = None,
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

    With --legacy (for frames in the recordings' form) pins, edges and areas are computed as by the published release: the nodes are in
    its detector's order, in px of its resized image, relative to its scalar median. A frame in which not exactly all pins are found is
    left out.

    \b
    Example:
      twin graph frame.png --sensor mg400-331 --kind voronoi --out out/graph
    """
    from twin.frames import frames_at
    from twin.pins.graph_files import write_graphs_of

    spec, at = sensor_with(sensor, pipeline), frames_at(path, table, no_contact)
    return write_graphs_of(at, spec, out, kind=kind, form=form, legacy=legacy)


@app.command("tune")
def tune(
    sensor: Sensor,
    frames: Annotated[Path, typer.Option("--frames", metavar="DIR", help="folder of frames, video or recording")],
    out: Annotated[Path | None, typer.Option("--out", metavar="FILE.toml", help="the file to write")] = None,
    method: Annotated[
        Literal["twin", "legacy", "adaptive", "fixed", "simple", "log", "dog", "doh"], typer.Option("--method", help="whose parameters")
    ] = "twin",
    form: FormOrAuto = None,
    max_frames: MaxFrames = 12,
    table: Table = None,
    no_contact: NoContact = None,
    *,
    progress: Progress,
) -> "TunedOnFrames":
    """Find parameters of the pin detection for your own frames.

    These are mask, crop, threshold and blob parameters. Of the sensor's specification only the layout of the pins is used (count, rings,
    round or hexagon). Give some frames, with or without contact, as they come from the camera or as a recorder thresholded them
    (then there is no crop, and the threshold hardly matters).

    It prints how reliable the result is: in how many frames all pins are found, by how many gray levels the threshold may change, and
    what speaks against the result. It writes a file that --pipeline of the other commands takes. The section [blob] of this file can be
    copied to [pipeline.raw] or [pipeline.recording] of a sensor's specification. The file also holds the pins' places at rest: of a frame
    without contact (init_*, --no-contact, or one among the frames), else made from the contacts, which it says.

    \b
    Example:
      twin tune --sensor ur5-331 --frames recordings/mine --out mine.toml
    """
    from scenes import load_sensor
    from twin.frames import frames_at
    from twin.pins.tune_files import tune_on_frames

    at = frames_at(frames, table, no_contact)
    return tune_on_frames(at, load_sensor(sensor), out=out, method=method, form=form, limit=max_frames, progress=progress)


# Exit code of 'twin check' if the sensor's condition is bad. It differs from those of a failure (1) and of a wrong command line (2).
BAD = 3


@app.command("check", exit_code=lambda found: BAD if found.bad else 0)
def check(
    source: Annotated[
        str, typer.Argument(metavar="FRAME", help="image, folder of frames, video, recording, or a camera: 0, /dev/video2, http://...")
    ],
    sensor: Sensor,
    form: FormOrAuto = None,
    pipeline: Annotated[Path | None, typer.Option("--pipeline", metavar="FILE.toml", help="what 'twin tune' wrote")] = None,
    max_frames: MaxFrames = 20,
    no_contact: Annotated[Path | None, typer.Option("--no-contact", metavar="FRAME", help="frame without contact, for --push")] = None,
    push: Annotated[
        list[str] | None,
        typer.Option("--push", metavar="SIDE:FRAME", help="contact whose object was moved to the sensor's x, y, -x or -y; repeat it"),
    ] = None,
    twist: Annotated[
        Path | None, typer.Option("--twist", metavar="FRAME", help="contact whose object was turned from x to y, instead of a second push")
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FILE.toml", help="copy of the specification with the view of --push")
    ] = None,
    model: Annotated[
        Path | None, typer.Option("--model", metavar="RUN", help="run that must know the contacts; the sensor's shipped weights by default")
    ] = None,
    *,
    progress: Progress,
) -> "Examination":
    """Check the health of the sensor, and say what to do.

    It checks brightness, focus, missing pins, specks, glare, and drift from the calibration. It looks at a frame, a folder of frames, a
    video or a camera, with or without contact, and compares the frames with the one that the twin draws from the sensor's specification.
    Thresholded recordings show pins, specks and place only. A lost pin or a spot counts as a fault of the sensor if it is
    there in half of the frames, so give frames of several contacts. If there are weights of the sensor, frames whose contacts they do
    not know (torn, displaced, of no known kind) are named with the reason.

    The exit code is 3 if something is bad, else 0.

    On a symmetric layout a turn by its symmetry and a mirror can't be seen in pins of an unknown unit. Contacts that push the pins to known
    sides decide: with --push and --no-contact, turn, mirror, size and place of the picture and the pins at rest are found, written to
    --out as a copy of the specification, and the frames are checked against that copy.

    \b
    Example:
      twin check recordings/today --sensor ur5-331
      twin check 0 --sensor mine.toml
      twin check today --sensor mine.toml --no-contact rest.png \\
          --push x:right.png --push y:down.png --out turned.toml
    """
    from hardware.live.examining import examine_sensor
    from scenes import load_sensor
    from training.studies.contact_check import contact_finding
    from twin.pins import load_detector

    return examine_sensor(
        source,
        load_sensor(sensor),
        form=form,
        detector=load_if_named(load_detector, pipeline),
        limit=max_frames,
        no_contact=no_contact,
        pushes=push or (),
        twist=twist,
        out=out,
        contacts=partial(contact_finding, run=model),
        progress=progress,
    )
