"""``twin preprocess``: the real pipeline over frames, wherever they come from.

``twin graph``: graphs of frames or of found pins, as arrays and pictures.

``twin tune``: parameters of the pin detection, found from a user's own frames.

``twin check``: is the sensor well?"""

from collections.abc import Iterator
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from twin.cli import app
from twin.cli.options import FormOrAuto, Out, Sensor, if_given, writable_folder

HELP_PREPROCESS = """Find the pins in every frame of a folder, a video, an image or a recording.

Understands any folder of images, videos, and the recordings' own folders (frames_bw/ or images/ or sensor_images/ or
processed_images/ with targets.csv and metadata). init_* is the no-contact reference, not a frame. Broken frames are
listed and skipped; exit code 0 if at least one frame was good.

\b
Writes pins.npz:
  image_name (M,)    base names, in the order of targets.csv where there is one
  pins_px (M, N, 2)  (x, y) in px of the input frame, pixel centres at integers, the
                     specification's pin order; NaN where a pin has no blob of its own
  predicted_px       same shape: the motion model's guess for those pins only
  area_px2 (M, N)    Voronoi cell areas
  found (M,), valid (M,)
and summary.json (frames, exact_fraction, ms.<stage>.p50|p95|p99, parameters, failed).
"""


@app.command("preprocess", help=HELP_PREPROCESS)
def preprocess(
    path: Annotated[Path, typer.Argument(help="image, folder of frames, video or recording")],
    sensor: Sensor,
    out: Out,
    form: FormOrAuto = None,
    overlay: Annotated[bool, typer.Option("--overlay", help="also write a picture of every frame with its pins and graph")] = False,
) -> None:
    from scenes import load_sensor
    from twin.cli.options import say
    from twin.cli.progress import shown
    from twin.pins.batch import preprocess_recording
    from twin.progress import stage

    spec = load_sensor(sensor)
    with shown() as progress, stage(progress, "frames") as step:
        summary = preprocess_recording(path, spec, writable_folder(out), form=form, overlay=overlay, progress=step)
    say(_lines(summary, spec.pins.count))
    say(f"wrote {out / name}" for name in ("pins.npz", "summary.json") + (("overlay",) if overlay else ()))


def _lines(summary: dict[str, Any], pins: int) -> Iterator[str]:
    """What ``summary.json`` says, for people."""
    yield (
        f"{summary['frames']} frames, all {pins} pins found in {100 * summary['exact_fraction']:.2f} %, "
        f"{summary['ms']['total']['p50']:.2f} ms per frame (median)"
    )
    yield from (f"not valid {invalid['image_name']}: {invalid['reason']}" for invalid in summary["invalid"])
    yield from (f"note: {problem}" for problem in summary["problems"])
    yield from (f"skipped {failed['image_name']}: {failed['reason']}" for failed in summary["failed"])


HELP_GRAPH = """Build the graph of a frame, a folder of frames, or of a pins.npz.

\b
knn       edges from each pin to its 6 nearest (directed)
delaunay  both directions of every side of the Delaunay triangles
voronoi   the same edges, and the area of each pin's Voronoi cell inside the enlarged
          boundary around the outermost pins

\b
Writes graph.npz: image_name (M,), nodes_px (M, N, 2), area_px2 (M, N), edges (E, 2) of all
graphs one after the other (graph k has edges[edge_start[k]:edge_start[k+1]]), and pictures of
the first: graph.png, and surface.png (cell area as a surface: no contact, contact, difference).

With --legacy (frames in the recordings' form only) pins, edges and areas are those of the published release: nodes in its
detector's order, px of its resized image about its scalar median; a frame without exactly all pins is left out.
"""


class Kind(StrEnum):
    """Kinds of graphs."""

    KNN = "knn"
    DELAUNAY = "delaunay"
    VORONOI = "voronoi"


@app.command("graph", help=HELP_GRAPH)
def graph(
    path: Annotated[Path, typer.Argument(help="frame, folder of frames, or pins.npz")],
    sensor: Sensor,
    kind: Annotated[Kind, typer.Option("--kind", help="kind of graph")] = Kind.VORONOI,
    out: Out = Path("out/graph"),
    form: FormOrAuto = None,
    legacy: Annotated[bool, typer.Option("--legacy", help="the published release's own method and boundary, to compare with")] = False,
) -> None:
    from scenes import load_sensor
    from twin.cli.options import tell
    from twin.pins.graph_files import write_graphs_of

    made = write_graphs_of(path, load_sensor(sensor), writable_folder(out), kind=kind.value, form=form, legacy=legacy)
    tell(made)


HELP_TUNE = """Find mask, crop, threshold and blob parameters for your own frames.

It uses nothing of the sensor but the layout of its pins (count, rings, round or hexagon). Give some frames, in contact or not, as
they come from the camera, or as a recorder thresholded them (then there is no crop, and the threshold hardly matters).

\b
Prints how sure it is: in how many frames all pins are found, by how many gray levels the
threshold may move, and what speaks against it.
Writes a file for 'twin robustness --pipeline' and 'twin check --pipeline'; its [blob] section is what
[pipeline.raw] (or [pipeline.recording]) of a sensor's specification takes.

\b
Example:
  twin tune --sensor ur5-331 --frames recordings/mine --out mine.toml
"""


@app.command("tune", help=HELP_TUNE)
def tune_command(
    sensor: Sensor,
    frames: Annotated[Path, typer.Option("--frames", metavar="DIR", help="folder of frames, video or recording")],
    out: Annotated[Path | None, typer.Option("--out", metavar="FILE.toml", help="the file to write")] = None,
    method: Annotated[
        Literal["twin", "legacy", "adaptive", "fixed", "simple", "log", "dog", "doh"], typer.Option("--method", help="whose parameters")
    ] = "twin",
    form: FormOrAuto = None,
    limit: Annotated[int, typer.Option("--limit", min=1, metavar="N", help="at most N frames, evenly spread")] = 12,
) -> None:
    from scenes import load_sensor
    from twin.cli.options import tell
    from twin.cli.progress import shown
    from twin.pins.tune_files import tune_on_frames

    with shown() as progress:
        found = tune_on_frames(frames, load_sensor(sensor), out=out, method=method, form=form, limit=limit, progress=progress)
    tell(found)


HELP_CHECK = """Is the sensor well? Brightness, focus, missing pins, specks, glare, and drift from its calibration; and what to do.

Looks at a frame, a folder of frames, a video or a camera, in contact or not, and compares with what the sensor's specification
promises (the twin draws that sensor's frame). Thresholded recordings tell of pins, specks and place only. A lost pin, or a spot,
counts as a fault of the sensor if it is so in half of the frames: give frames of several contacts.

\b
Exit code: 0 if everything is good or to be watched, 2 if something is bad.

\b
Example:
  twin check recordings/today --sensor ur5-331
  twin check 0 --sensor mine.toml
"""


@app.command("check", help=HELP_CHECK)
def check(
    source: Annotated[
        str, typer.Argument(metavar="FRAME", help="image, folder of frames, video, recording, or a camera: 0, /dev/video2, http://...")
    ],
    sensor: Sensor,
    form: FormOrAuto = None,
    pipeline: Annotated[Path | None, typer.Option("--pipeline", metavar="FILE.toml", help="what 'twin tune' wrote")] = None,
    limit: Annotated[int, typer.Option("--limit", min=1, metavar="N", help="look at most at N frames, evenly spread")] = 20,
) -> None:
    from hardware.examining import examine_sensor
    from scenes import load_sensor
    from twin.cli.options import say
    from twin.cli.progress import shown
    from twin.pins import load_detector

    spec, detector = load_sensor(sensor), if_given(load_detector, pipeline)
    with shown() as progress:
        found = examine_sensor(source, spec, form=form, detector=detector, limit=limit, progress=progress)
    say(found.lines())
    if found.bad:
        raise SystemExit(2)
