"""Commands that compare the twin with a real sensor, and fit it to one.

- ``twin record``: frames of a new sensor, with a camera, while a person presses it.
- ``twin new``: a specification of a sensor of which only frames are known.
- ``twin calibrate``: a specification fitted to frames of a real sensor.
- ``twin validate``: the twin's pins compared with those of labelled real frames.
- ``twin realism``: how close the renders of a sensor come to its real frames.
- ``twin robustness``: how far a sensor may degrade before its pins are lost.
- ``twin audit``: whether a recording's labels agree with its pins.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Argument, Exit, Option

from twin.cli import app, group, options
from twin.cli.options import Formerly, call, load_if_named, print_lines
from twin.errors import OptionError
from twin.progress import Progress
from twin.types import FINE, Quality

if TYPE_CHECKING:
    from hardware.collect.record import RecordedFrames
    from training.studies.degradation import DegradationResult
    from training.studies.label_audit import LabelAudit
    from training.studies.realism import Realism
    from training.studies.validation import Validation
    from twin.calibration.contact.calibrate import ContactCalibration
    from twin.calibration.contact.forces import ForceComparison
    from twin.calibration.go_on import WholeSensor
    from twin.calibration.optics import OpticsCalibration

COLUMN = "a table's column: Fz=normal, pose_3=-height, Fz=0.001*mN; repeat it"
Columns = Annotated[list[str] | None, Option("--column", metavar="KEY=NAME", help=COLUMN)]


def columns_in(pairs: list[str] | None) -> dict[str, str]:
    """A table's columns by their keys."""
    return dict(pair.partition("=")[::2] for pair in pairs or ())


@app.command("record")
def record(
    camera: Annotated[str, Option(metavar="C", help="0, /dev/videoN, http://...")],
    out: Annotated[Path, Option(metavar="DIR", help="new folder for the frames")],
    count: Annotated[int, Option(min=1, help="frames in contact")] = 40,
    port: Annotated[int, Option(min=0, max=65535, help="port of the page with the picture; 0: a free one")] = 0,
    *,
    progress: Progress,
) -> "RecordedFrames":
    """Record frames of a new sensor with a camera, as input of 'twin new'.

    First keep the sensor free of contact, then press it at different places, lightly and firmly, and hold it still each time. A page on
    this machine shows the camera's picture and what to do next. A frame is kept if the picture is still, shows a new contact, and is
    neither blurred, too bright nor too dark; otherwise the page and the command say what to change. No sensor is needed: 'twin new' finds
    out which it is.

    \b
    Writes:
      init_0.png    the frame without contact
      images/       the frames in contact

    \b
    Example:
      twin record --camera 0 --out recordings/mine
      twin new recordings/mine --out mine.toml
    """
    from hardware.cameras.source import open_camera
    from hardware.collect.record import record_frames

    return record_frames(open_camera(camera), out, count=count, port=port, progress=progress)


@app.command("new")
def new_sensor(
    out: Annotated[Path, Option(metavar="MY.toml", help="the specification to write")],
    frames: Annotated[Path | None, Argument(help="folder of frames, video or recording")] = None,
    camera: Annotated[str, Option(metavar="C", help="a live camera instead: 0, /dev/videoN, http://...")] = "",
    label_table: Annotated[Path | None, Option(metavar="TABLE", help="table of labels: also fit the contact"), Formerly("labels")] = None,
    experiment: Annotated[str | None, Option(metavar="E", help="experiment of the labelled contacts; by default from the table")] = None,
    contacts: Annotated[int, Option(min=4, metavar="N", help="labelled frames to which the contact is fitted")] = 20,
    optics: Annotated[bool, Option("--optics", help="also fit light and colours")] = False,
    workers: options.Workers = options.CORES,
    elements: options.Elements = FINE,
    layout: Annotated[str | None, Option(metavar="L", help="the layout, if it is known")] = None,
    radius_mm: Annotated[float | None, Option(metavar="R", help="radius of the tip's dome (20 if not given)")] = None,
    no_contact: options.NoContact = None,
    table: options.Table = None,
    form: options.FormOrAuto = None,
    max_frames: options.MaxFrames = 40,
    *,
    progress: Progress,
) -> "WholeSensor":
    """Make a specification of your own sensor from its frames.

    Give a folder of frames, a video or a recording, of any size, colour, gray or thresholded. Some frames should show contacts of
    different kinds, and one no contact. It identifies the layout of the pins (markers) and their positions at rest (from init_0.png,
    --no-contact, a frame without contact, or from many contacts; it prints which), and fits mask, threshold and camera. If the layout is
    unsure, it prints the two most probable ones, and what would decide; then give --layout.

    With --label-table TABLE it also fits the contact, as 'twin calibrate contact' does; with --optics also light and colours, as 'twin
    calibrate optics' does (raw frames). --table TABLE only gives the names of the frames and their order. With --camera a live camera
    replaces the folder, and the command asks you to press, as 'twin record' does.

    \b
    Writes:
      MY.toml             a short, commented specification: --sensor MY.toml
      MY-new/index.html   known values, assumed values, steps that determine more;
                          pictures of frames with their pins beside it
      MY-contact/, MY-calibration/, MY-frames/  by --label-table,
                                             --optics, --camera

    \b
    --layout rings:10         331 pins in 10 rings
             hexagon:6        127 pins in a hexagon
             grid:9x7         9 columns, 7 rows
             positions:F.csv  x,y of each pin from the sensor's axis, a line each,
                              in any unit; y down as in the picture

    \b
    Example:
      twin new recordings/mine --out mine.toml
      twin new recordings/mine --label-table recordings/mine/targets.csv \\
          --out mine.toml
      twin new --camera /dev/video0 --out mine.toml
    """
    from hardware.cameras.source import open_camera
    from hardware.collect.record import record_frames
    from scenes.pins import layout_from
    from twin.calibration.go_on import whole_sensor

    if (frames is None) == (not camera):
        raise OptionError("give either a folder of frames or `camera`")
    if frames is None:
        recorded = record_frames(open_camera(camera), out.with_name(f"{out.stem}-frames"), progress=progress)
        print_lines(recorded.lines()[:-1])
        frames = recorded.folder
    return call(whole_sensor, locals(), layout=load_if_named(layout_from, layout))


calibrate_app = group("calibrate", "Fit a sensor's specification to frames of a real one.")


@calibrate_app.command("optics")
def calibrate_optics(
    sensor: options.Sensor,
    frames: Annotated[Path, Option(metavar="DIR", help="folder of raw frames, in contact or not")],
    out: Annotated[Path, Option(metavar="SPEC.toml", help="the specification to write")],
    no_contact: Annotated[Path | None, Option(metavar="FRAME", help="a raw frame without contact: fits the camera")] = None,
    max_frames: options.MaxFrames = 6,
    pipeline: options.Tuning = None,
    *,
    progress: Progress,
) -> "OpticsCalibration":
    """Fit light, colours, sharpness and noise to raw frames.

    Start from your sensor's specification ('twin new'), or from the most similar shipped one. The frames may show any contact. The skin is
    fitted to their pins (a few may be lost), and the twin renders the same state. Its parameters are fitted until both agree, by
    differentiable path tracing (LEDs, reflectances, haze) and by least squares (ring, reflections, specks, each cap's own reflectance and
    outline, blur, aperture, sharpening, colour fringes, compression, noise). The remaining difference is measured: a tile of light and
    colour that moves with each cap and the skin around it, and a background that stays in place. With --no-contact one frame without
    contact fits the camera first.

    \b
    Writes: SPEC.toml, to be used as --sensor SPEC.toml; beside it its measured
    tables and pictures (SPEC.*.csv, SPEC.*.uri), and SPEC-calibration/ with
    index.html (before, after, remaining error, changes) and the stages' results.

    An interrupted run resumes.

    Quantities that frames do not determine keep their starting values, and are listed: the response curve (gamma) and the product of LED
    power and exposure in any case; distance and focal length if all frames are without contact.

    \b
    Example:
      twin calibrate optics --sensor ur5-331 --frames recordings/my-tactip \\
          --out my-tactip.toml
    """
    from twin.calibration.optics import calibrate_optics

    return call(calibrate_optics, locals())


@calibrate_app.command("contact", goes_on=True)
def calibrate_contact(
    sensor: options.Sensor,
    frames: Annotated[Path, Option(metavar="DIR", help="labelled recording with init_0.png, or TABLE.csv of forces")],
    out: Annotated[Path, Option(metavar="SPEC.toml", help="the specification to write")],
    num_labelled: Annotated[int, Option(min=4, metavar="N", help="frames to fit to, chosen at random"), Formerly("labels")] = 20,
    seed: Annotated[int, Option(min=0, help="seed of the choice of frames")] = 0,
    experiment: options.Experiment = "surface-2d",
    obj: options.TouchedObject = None,
    hold: Annotated[list[str] | None, Option(metavar="KEY", help="do not fit this parameter; may be repeated")] = None,
    workers: options.Workers = options.CORES,
    elements: options.Elements = FINE,
    form: options.FormOrAuto = None,
    table: options.Table = None,
    no_contact: options.NoContact = None,
    pipeline: options.Tuning = None,
    column: Columns = None,
    *,
    progress: Progress,
) -> "ContactCalibration | ForceComparison":
    """Fit the contact to labelled frames of the real sensor, or to a table of forces.

    It uses the no-contact frame (init_0.png) and N labelled frames. It fits contact offset, tool point, angle offset and sign, tilt of the
    surface, direction of the robot's axes in the image, friction, the arm's compliances, stiffness of the gel relative to the skin and its
    compressibility, thickness of the skin, and length of the pins. It also determines whether the move of each frame was executed when it
    was taken. A frame that fits neither case gets a small weight. The same number of other frames, at most 20, is held out, and the error
    is given on them.

    Pins do not determine newtons. If the table has a column of forces along the approach (N; Fz, or the column of rig.force_sensor) with 3
    or more presses, for example weighed with a kitchen scale, the stiffness of skin and gel is scaled to them; other rows may be empty. It
    prints the remaining uncertainty of forces (skin.stiffness_factor), or the assumed stiffness.

    With --frames TABLE.csv, a table of poses and forces of a load cell without frames, N rows are fitted (radius of the dome, stiffness,
    friction, zero of the depth, tool point, zero and turn of the cell), each parameter only if they determine it, and all other rows are
    evaluated. The result states the conventions of the table. The experiment must approach along z (surface-3d-sheared).

    \b
    Writes: SPEC.toml, to be used as --sensor SPEC.toml; beside it SPEC-contact/
    with index.html (parameters with their uncertainty before and after the fit,
    frames with their probabilities, before and after), calibration.json and
    contacts/. An interrupted run resumes.

    \b
    It simulates about 50 + 60 N contacts. Each takes 1 to 3 s on one core;
    --workers sets the number of processes.

    \b
    Example:
      twin calibrate contact --sensor mg400-331 --frames recordings/my-surface \\
          --num-labelled 20 --out my-tactip.toml
    """
    from twin.calibration.contact.calibrate import calibrate_to_file
    from twin.frames import frames_at

    return call(calibrate_to_file, locals(), frames=frames_at(frames, table, no_contact), columns=columns_in(column))


@app.command("validate")
def validate(
    sensor: options.Sensor,
    frames: Annotated[Path, Option(metavar="DIR", help="labelled recording, or TABLE.csv of forces")],
    out: options.Out,
    experiment: options.Experiment = "surface-2d",
    obj: Annotated[str | None, Option("--object", metavar="O", help="the touched object; the experiment's own if not given")] = None,
    max_frames: Annotated[int | None, Option(min=1, metavar="N", help="N frames, chosen at random"), Formerly("limit")] = None,
    friction_frames: Annotated[int, Option(min=0, metavar="N", help="frames for which the best friction is searched, 9 contacts each")] = 5,
    seed: Annotated[int, Option(min=0, help="seed of the choice of frames")] = 0,
    elements: options.Elements = FINE,
    form: options.FormOrAuto = None,
    table: options.Table = None,
    no_contact: options.NoContact = None,
    pipeline: options.Tuning = None,
    column: Columns = None,
    *,
    progress: Progress,
) -> "Validation | ForceComparison":
    """Compare the twin's pins with those of real frames.

    The contact of each labelled frame is simulated along the arm's path, from the frame's label and the sensor's [rig] alone ('twin
    calibrate contact' fits a [rig]). The simulated displacement is added to the recorded pins without contact (init_0.png). A move that
    move_executed.csv or labels_corrected.csv ('twin audit') marks as not executed is not simulated. Errors are given separately for
    executed and not executed moves, by depth, angle and shear. For some frames with an executed move the errors are also given with the
    friction that fits the frame best.

    With --frames TABLE.csv, a table of poses and forces without frames, the simulated forces are compared with the measured ones.

    \b
    Writes index.html, frames.csv (a row a frame), validation.json; for a table
    rows.csv and forces.json.

    \b
    Example:
      twin validate --sensor mg400-331 --frames recordings/surface \\
          --max-frames 40 --out out/validate
    """
    from training.studies.validation import validate_contacts
    from twin.frames import frames_at

    return call(validate_contacts, locals(), frames=frames_at(frames, table, no_contact), columns=columns_in(column))


@app.command("realism")
def realism(
    path: Annotated[Path, Argument(help="folder of real raw frames")],
    sensor: options.Sensor,
    out: options.Out,
    pose_aligned: Annotated[bool, Option("--pose-aligned", help="also render from the labels alone")] = False,
    max_frames: Annotated[int | None, Option(min=1, metavar="N", help="at most N frames, evenly spread"), Formerly("limit")] = None,
    fitted: Annotated[int, Option(min=0, metavar="N", help="leave out the frames that 'calibrate optics --max-frames N' fits")] = 0,
    without: Annotated[list[str] | None, Option(metavar="DETAIL", help="relief, grain or background; may be repeated")] = None,
    residual: options.Residual = False,
    quality: Annotated[Quality, Option(help=options.QUALITY)] = "standard",
    two_sample: Annotated[bool, Option("--two-sample/--no-two-sample", help="train the two-sample test (minutes)")] = True,
    thorough: Annotated[
        bool, Option("--thorough", help="test with a stronger network, too, and with halves of the real frames (ten minutes)")
    ] = False,
    table: options.Table = None,
    pipeline: options.Tuning = None,
    *,
    progress: Progress,
) -> "Realism":
    """Compare real raw frames with their renders.

    They are compared in pairs, and as two sets. The skin is fitted to the pins of each real frame, and the sensor in this state is
    rendered. Every cap has its position in the real frame, so the differences come from camera and light. With --pose-aligned the complete
    twin is evaluated as well: contacts are simulated from the labels in targets.csv (pose_3 depth in mm, pose_4 and pose_5 tilts in deg, a
    tap on a flat plate). The arm's kinematics is fitted to the pins of one half of the frames, and evaluated on the other half (held-out
    frames).

    It reads a folder of raw colour or gray frames of one size (images/ with targets.csv, or any folder). Frames that are black, saturated,
    of another size or without all their pins are left out and listed. The exit code is 0 if at least one frame was good.

    \b
    Writes:
      index.html      pictures side by side, all figures, plots
      metrics.json    every figure: PSNR, SSIM, FLIP over the lens disc; the error
                      on the caps, and its share that is the same for a cap;
                      differences by radius; spots; spectra; two-sample accuracy;
                      pin errors
      frames.csv      figures of each frame
      radial.csv      caps in 8 bins of the distance from the disc's centre
      spectrum.csv    radial power spectra
      spots.csv       bright spots that stay in place (LED reflections, bubbles)
      pictures/       real, rendered and difference of each frame

    \b
    How to read it: the upper bound of PSNR and SSIM are those of two real frames
    with the same contact. Two-sample accuracy is the share of patches of held-out
    frames that a small network classifies correctly: at 100 % it always
    distinguishes real from rendered, at 50 % never. --thorough also trains a
    stronger network, and both on two halves of the real frames, which should give
    50 %. A better relief could model the part of the error that is the same for a
    cap. --without removes a measured detail (ablation): the caps' relief, the
    skin's grain, the background. --residual adds the sensor's residual network;
    evaluate it on held-out frames.

    \b
    Example:
      twin realism recordings/my-tactip --sensor ur5-331 --max-frames 10 \\
          --out out/realism
    """
    from training.studies.realism import compare_with_renders
    from twin.frames import frames_at

    return call(compare_with_renders, locals(), frames=frames_at(path, table), test=two_sample)


def _list_conditions(asked: bool) -> None:
    from twin.evaluation.degradation.conditions import condition_lines

    if asked:
        print_lines(condition_lines())
        raise Exit


PIPELINES = "twin, legacy, adaptive, fixed, simple, log, dog, doh, a file of 'twin tune', or your own as FILE.py:FUNCTION"


@app.command("robustness", goes_on=True)
def robustness(
    sensor: options.Sensor,
    out: options.Out,
    pipeline: Annotated[list[str] | None, Option(metavar="P", help=PIPELINES)] = None,
    model: Annotated[list[Path] | None, Option(metavar="RUN", help="folder of a trained model")] = None,
    conditions: Annotated[Path | None, Option(metavar="FILE", help="TOML file: which conditions, ranges, steps, pairs")] = None,
    frames: Annotated[Path | None, Option(metavar="DIR", help="real frames instead of rendered ones")] = None,
    max_frames: Annotated[int, Option(min=2, metavar="N", help="at most N of the real frames, evenly spread"), Formerly("limit")] = 12,
    rendered: Annotated[bool, Option("--rendered/--no-rendered", help="raw --frames beside rendered ones")] = True,
    jobs: Annotated[int, Option(min=1, metavar="N", help="processes")] = options.CORES,
    show: Annotated[bool, Option("--list", is_eager=True, callback=_list_conditions, help="list the conditions and stop")] = False,
    *,
    progress: Progress,
) -> "DegradationResult":
    """Measure how far the sensor can degrade before preprocessing fails.

    It increases each condition from severity 0 (none) to 1 (unusable) on a set of contacts: dim or dead LEDs, room light, glare, defocus,
    motion, dirt, scratches, bubbles, haze, lost and faded caps, torn skin, a displaced camera, noise, JPEG, lost rows, wrong settings, ...
    (--list lists them). It runs pipelines and models on every frame, and compares with the ground truth: recall and precision of the pins.

    \b
    Writes:
      index.html      envelope (where each pipeline fails), ranking, plots, worst
                      frames
      envelope.csv    severity and parameter at which each measure crosses its
                      limit
      curves.csv      every measure against severity, with its 90 % interval
      frames.csv      every frame
      real-on-rendered.csv  with --frames: where real and rendered frames fail,
                            and their ratio
      cells/          finished work: an interrupted run resumes;
                      work of another sensor, other weights or another version is
                      not used

    \b
    With --frames DIR real frames replace the rendered ones. Then the sweep covers
    only conditions that act on a frame, and the reference is the pins on which
    several detectors agree. Raw frames are compared with the envelope of rendered
    ones. This shows the remaining margin of this sensor against a healthy one.
    For this, rendered frames are swept, too; --no-rendered turns it off.

    \b
    It can evaluate your own pin detection, too: --pipeline mine.py:my_pins
    takes the function my_pins of the file. The function gets the picture of a
    frame (uint8, gray or RGB) and returns the positions (n, 2) of the pins, x and
    y in px, in any order.

    \b
    A file for --conditions:
      steps = [0.1, 0.3, 1.0]               # severities
      pairs = [["leds-dim", "noise"]]       # conditions that grow together
      [[condition]]
      name = "noise"
      severe = 0.2                          # the parameter at severity 1

    \b
    Examples:
      twin robustness --sensor ur5-331 --pipeline twin --pipeline legacy \\
          --out out/robustness
      twin robustness --sensor ur5-331 --frames recordings/mine \\
          --pipeline mine.toml --pipeline mine.py:my_pins --out out/mine
    """
    from training.studies import degradation
    from twin.evaluation.degradation.study import SweepPlan, load_plan

    sweep = load_if_named(load_plan, conditions) or SweepPlan()
    return degradation.run(call(degradation.DegradationPlan, locals()), out, progress=progress)


@app.command("audit")
def audit(
    data: Annotated[Path, Argument(help="labelled recording")],
    sensor: options.Sensor,
    out: options.Out,
    form: options.FormOrAuto = None,
    table: options.Table = None,
    no_contact: options.NoContact = None,
    pipeline: options.Tuning = None,
    *,
    progress: Progress,
) -> "LabelAudit":
    """Find wrong labels of a recording.

    It needs a recording of one object (a plate, an edge) with labels pose_1..6 and move_1..6; some of them must vary. It uses only pins
    and targets.csv. It detects moves that were not executed when the frame was taken, sign errors, frames without contact, frames that fit
    no label, duplicate frames, drift along the table, and faults of the files.

    \b
    Writes:
      labels_corrected.csv  image_name, executed, the corrected labels, the
                            misfit to each explanation, findings
      audit.json, audit.png, audit.html

    Copy labels_corrected.csv beside targets.csv, and 'twin train' corrects the labels with it.

    \b
    Example:
      twin audit recordings/mine --sensor mg400-331 --out out/audit
    """
    from training.studies.label_audit import audit_recording
    from twin.frames import frames_at

    return call(audit_recording, locals(), data=frames_at(data, table, no_contact))
