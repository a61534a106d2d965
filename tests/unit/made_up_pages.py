"""Every page, of made-up content: small, quick, and with names that a careless page would take for markup."""

from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np

from scenes import load_experiment, load_object, load_randomisation, load_sensor
from scenes.randomisation import FrictionSpread
from training.data.audit import HYPOTHESES, Audit
from training.data.pins import PinTable
from training.data.targets import PRESETS
from training.studies.label_audit import summary_of, write_audit
from training.studies.objects import ObjectsPlan, verdicts
from training.studies.tac_vgnn import study as study_report
from training.studies.tac_vgnn.models import plan_run
from training.studies.tac_vgnn.study import AreaChange, contacts_figure
from twin.calibration.contact.report import write_calibration
from twin.calibration.optics import Calibration
from twin.calibration.optics import write_page as write_calibration_page
from twin.demo.make_demo import ContactResult, DepthRow, add_contact, add_motions, add_tables
from twin.demo.make_demo import write_page as write_demo_page
from twin.evaluation.labelled.model import MeasuredFrames
from twin.evaluation.pictures import report as realism
from twin.evaluation.pictures.aligned import RealFrame
from twin.evaluation.pictures.compare import ImageFigures, Pair
from twin.evaluation.pictures.statistics import RADIAL_MEASURES, RadialRow
from twin.mechanics.path import ContactPose
from twin.pins import make_graph, nominal_reference
from twin.report.charts import ObservedFrame, new_figure, write_chart
from twin.report.page import Page, write_table
from twin.types import Form, Frame

SENSOR = "mg400-127"
HOSTILE = '<b onmouseover="x">&amp;#?%41\'"'
FRAMES = 4
LABELS = ("pose_2", "pose_6")


class Rows(SimpleNamespace):
    """Content with a length."""

    def __len__(self) -> int:
        return self.count


def pins():
    """No-contact pins of the sensor."""
    return nominal_reference(load_sensor(SENSOR), Form.PROCESSED)


def sim_to_real(out: Path) -> Path:
    from training.studies.sim_to_real.study import write_page

    told = [("simulated", 0, "vgnn", 0.066), ("simulated and real", 40, "vgnn", 0.053), ("simulated, bare", 0, "vgnn", 0.12)]
    told += [("real", n, model, e) for n, e in ((40, 0.2), (3010, 0.021)) for model in ("vgnn", "quadratic regression")]
    rows = [
        {"trained_on": name, "labelled_frames": n, "model": model}
        | {f"{label}_{kind}": e * (1 + k) for k, label in enumerate(LABELS) for kind in ("corrected", "raw")}
        | ({f"{label}_inside_90": 0.87 for label in LABELS} if model == "vgnn" else {})
        | {"leak_slope": None if n == 40 else 0.0131}
        for name, n, model, e in told
    ]
    write_table(out / "study.csv", rows)
    recording = Rows(count=3762, targets=SimpleNamespace(names=LABELS), problems=[f"no label: {HOSTILE}"])
    ground = SimpleNamespace(
        setup=SimpleNamespace(sensor=load_sensor(SENSOR)),
        plan=SimpleNamespace(labels=40, seed=0, calibrate=False),
        out=out,
        real=recording,
        chosen=SimpleNamespace(test=range(752)),
        residuals=SimpleNamespace(error_px=0.31),
        full=SimpleNamespace(randomisation=SimpleNamespace(friction=FrictionSpread(low=0.14, high=1.3))),
    )
    beside = SimpleNamespace(left_out=np.array([0.071, 0.912]))
    modes = [{"share": 0.61, "told": 0.8}, {"share": 0.2, "told": 0.0}]
    return write_page(ground, rows, beside, modes, Rows(count=25344, group=np.arange(500)))


def across_objects(out: Path) -> Path:
    from training.studies.objects import write_page

    experiment = load_experiment("objects-2d")
    train, unseen = (load_object("plane"), load_object("sphere")), (load_object("edge"),)
    plan = ObjectsPlan(load_sensor(SENSOR), experiment, load_randomisation("moves"), train, unseen, count=100, tests=50, across=24)
    rows = [
        {"model": model, "object": thing.name, "seen": thing.name in seen, "contacts": 50, "states": 1204}
        | {f"{label}_{part}": (-0.1 if part == "bias" else 1.2) * (1 + k) for label in LABELS for part in ("error", "bias", "times")}
        for model, seen in (("mixed", ("plane", "sphere")), ("plane", ("plane",)))
        for k, thing in enumerate((*train, *unseen))
    ]
    write_table(out / "objects.csv", rows)
    return write_page(out, plan, rows, verdicts(plan, rows, LABELS))


def study(out: Path) -> Path:
    rng, reference = np.random.default_rng(0), pins()
    targets = SimpleNamespace(names=LABELS, units=("mm", "deg"), raw=rng.normal(size=(FRAMES, 2)))
    data = Rows(count=FRAMES, targets=targets, problems=[HOSTILE], pins=SimpleNamespace(sensor=load_sensor(SENSOR)))
    plans = [plan_run("gnn", labels="raw", seed=0, split=0), plan_run("vgnn", labels="raw", seed=0, split=0)]
    for plan in plans[:1]:
        (out / "runs" / plan.folder).mkdir(parents=True)
        (out / "runs" / plan.folder / "curves.csv").write_text("network,seconds,held_out_error\n0,7.1,1.5\n0,7.0,0.9\n")
    models = [
        {"model": "gnn", "seed": 0, "state": "finished", "epochs": 60, "training_minutes": 12.3, "parameters": 1234567, "leak_slope": -0.01}
        | {f"{label}_{kind}": 0.1 + k for k, label in enumerate(LABELS) for kind in ("raw", "corrected")},
        {"model": "vgnn", "seed": 0, "state": "not begun"},
    ]
    graphs = [{"graph": "knn", "nodes": 127, "edges_least": 762, "ms": 0.4, "paper_ms": None}]
    efficiency = [{"model": "gnn", "batch": n, "ms_per_frame": 3 / n, "s_per_epoch": None, "memory_mib": 27.0} for n in (16, 64)]
    graph = make_graph("voronoi", reference.pins_px + rng.normal(0, 1, reference.pins_px.shape), outmost=reference.outmost)
    contacts = [AreaChange("centre", depth, graph, reference.area_px2) for depth in (2.0, 4.0)]
    write_chart(out / "curves.png", lambda: study_report.curves_figure(plans, out / "runs"))
    write_chart(out / "efficiency.png", lambda: study_report.efficiency_figure(efficiency))
    write_chart(out / "contacts.png", lambda: contacts_figure(contacts))
    figures = [contact.figures() for contact in contacts]
    tables = {"models": models, "graphs": graphs, "efficiency": efficiency, "contacts": figures}
    for name, rows in tables.items():
        write_table(out / f"{name}.csv", rows)
    return study_report.write_page(out, data, tables, SimpleNamespace(labels="raw", max_minutes=30), "cpu, 2 threads")


def contact_calibration(out: Path) -> Path:
    rng, reference = np.random.default_rng(1), pins()
    names = ["a.png", f"{HOSTILE}.png", "c.png", "d.png"]
    moved = rng.normal(0, 1, (2, 2, FRAMES, 127, 2))
    pins_px = reference.pins_px + moved[1, 0] + rng.normal(0, 0.2, moved[1, 0].shape)
    measured = MeasuredFrames(Form.PROCESSED, names, [], pins_px, reference.pins_px, [HOSTILE])
    fit = SimpleNamespace(
        before_px=np.array([1.0, 3.0, 2.0, 1.5]),
        after_px=np.array([0.3, 0.4, np.nan, 0.2]),
        trust=np.ones(FRAMES),
        executed=np.array([0.0, 1, 1, 0]),
    )
    summary = {
        "sensor": SENSOR,
        "experiment": "surface-2d",
        "parameters": [
            {"name": "rig.contact_offset_mm", "start": 0.3, "value": 0.4512, "sd": 0.012, "told": 0.99, "known": True},
            {"name": "skin.young_mpa", "start": 0.4, "value": 0.412, "sd": 0.09, "told": 0.12, "known": False},
        ],
        "turn_sign": {"start": 1, "value": -1},
        "hardly_told_apart": [["a", "b", -0.93]],
        "executed_share": 0.66,
        "fitted_px": {"before": 1.98, "after": 0.31, "frames": FRAMES},
        "held_out_px": {},
        "distrusted": [HOSTILE],
        "warnings": [HOSTILE],
        "frames": [
            {"image_name": name, "executed": 1.0, "trust": 0.99, "before_px": 1.2, "after_px": None if k else 0.3}
            for k, name in enumerate(names)
        ],
        "independent_numbers_a_frame": 20,
        "problems": [HOSTILE],
        "newtons": {"explanation": HOSTILE},
    }
    return write_calibration(out, measured, moved, fit, summary)


def audit(out: Path) -> Path:
    rng, reference, frames = np.random.default_rng(2), pins(), 60
    names = np.array([f"{HOSTILE}{k}.png" for k in range(frames)])
    shape = (frames, 127)
    nodes = reference.pins_px + rng.normal(0, 1, (*shape, 2))
    table = PinTable(
        load_sensor(SENSOR), Form.PROCESSED, reference, names, nodes, np.ones(shape), np.zeros(shape, bool), np.ones(frames, bool)
    )
    raw = rng.uniform(-3, 3, (frames, 4))
    targets = SimpleNamespace(names=PRESETS["surface-2d-shear"], raw=raw)
    data = Rows(count=frames, pins=table, targets=targets, problems=[HOSTILE], folder=Path(f"/recordings/{HOSTILE}"))
    flags = {name: np.arange(frames) % 7 == k for k, name in enumerate(("no_contact", "wrong_sign", "odd"))}
    found = Audit(
        executed=np.ones(frames),
        chi2=rng.uniform(1, 99, (frames, len(HYPOTHESES))),
        duplicates=np.arange(frames),
        depth_per_move=0.015,
        drift={"r2": 0.07},
        **flags,
    )
    return write_audit(out, found, data, summary_of(found, data))[-1]


def drawn(name: str, seed: int = 0) -> Frame:
    """A frame of noise."""
    return Frame(np.random.default_rng(seed).integers(0, 255, (48, 64), np.uint8), Form.RAW, name)


def realism_page(out: Path) -> Path:
    figures = ImageFigures(psnr_db=31.2, psnr_gray_db=30.1, ssim=0.912, ssim_gray=0.921, flip=0.062, psnr_whole_db=30.5)
    frames = [drawn("a.png"), drawn("b #2?.png", 1)]
    pairs = [Pair(RealFrame(f, np.zeros((0, 2)), {}), SimpleNamespace(), f.image, figures, 0.21, k == 0) for k, f in enumerate(frames)]
    radial = [RadialRow(m, 40.0 * b, 40.0 * b + 40, 100.0, 103.0 + 4 * b) for m in RADIAL_MEASURES for b in range(3)]
    spots = SimpleNamespace(px=np.zeros((2, 2)), peak=np.ones(2))
    found = SimpleNamespace(
        radial=radial,
        scalars={"skin_level": (31.2, 30.9)},
        frequency=np.array([0.01, 0.1]),
        real_power=np.array([9.0, 2.0]),
        rendered_power=np.array([8.0, 2.0]),
        spectrum_db=0.8,
        real_spots=spots,
        rendered_spots=spots,
        spots_apart_px=np.array([0.8]),
        worst=lambda measure: 0.03,
    )
    images = realism.image_summary(pairs)
    metrics = {
        "frames": 2,
        "quality": "standard",
        "disc": {"center_px": [32.1, 24.2], "radius_px": 20.3},
        "refused": [{"image_name": HOSTILE, "reason": "black"}],
        "pin_aligned": images,
        "fixed_residual": {"levels": 6.7, "share": 0.24},
        "statistics": realism.statistics_summary(found),
        "two_sample": {"small": {"accuracy": 0.61, "low": 0.57, "high": 0.65}},
        "pose_aligned": {"pin_error_px": {"fitted": 0.9, "test": 1.01, "test_max": 2.2}, "test_images": images},
    }
    return realism.write_results(out, load_sensor("ur5-331"), metrics, pairs, found, SimpleNamespace(pairs=pairs[:1]))[0]


def calibration(out: Path) -> Path:
    spec, frame = load_sensor("ur5-331"), drawn("a #2?.png")
    after = spec.model_copy(update={"camera": spec.camera.model_copy(update={"k1": -0.123456})})
    figures = {"psnr_db": 25.1, "psnr_gray_db": 26.1, "ssim": 0.81, "ssim_gray": 0.83, "flip": 0.12, "psnr_whole_db": 24.8}
    found = Calibration(after, figures, figures | {"flip": 0.08}, [HOSTILE], [frame], [frame.image], [frame.image])
    return write_calibration_page(out, spec, found, HOSTILE)


def demo(out: Path) -> Path:
    reference, chart = pins(), write_chart(out / "chart.png", lambda: new_figure(1, panel_inch=1.0)[0])
    cv2.imwrite(str(out / "skin.png"), drawn("skin.png").image)
    rest, graph = (make_graph("voronoi", scale * reference.pins_px, outmost=reference.outmost) for scale in (1.0, 1.05))
    none = np.zeros((0, 2))
    seen = SimpleNamespace(graph=graph, found=127, pins_px=graph.nodes_px, predicted_px=none, extra_px=none)
    frame = Frame(np.zeros((300, 300), np.uint8), Form.PROCESSED, "a.png")
    state = SimpleNamespace(force_n=np.array([0.0, 0.0, 1.0]), contact_mm=np.zeros((0, 3)), area_mm2=3.0)
    made = ContactResult(
        load_sensor(SENSOR),
        load_object("plane").model_copy(update={"name": HOSTILE}),
        ContactPose(2.0),
        state,
        SimpleNamespace(frame=drawn("raw.png")),
        ObservedFrame(frame, seen, rest),
        {"press": 1.5},
    )
    page = Page("TacTip twin", "twin demo", topic="Demo")
    add_contact(page, made, out / "skin.png")
    add_motions(page, chart)
    add_tables(page, {SENSOR: [DepthRow(1.5, 2.0, 1.9, 12.3, 0.5)]})
    return write_demo_page(out / "index.html", page, "Rendered here.", {"motions": 1.5})


PAGES = {
    "sim-to-real": sim_to_real,
    "across-objects": across_objects,
    "study": study,
    "contact-calibration": contact_calibration,
    "audit": audit,
    "realism": realism_page,
    "calibration": calibration,
    "demo": demo,
}
