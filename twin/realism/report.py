"""What the comparison leaves behind: metrics.json, tables, pictures and the page."""

import json
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from scenes.sensor import SensorSpec
from twin.realism.compare import Pair, PoseAligned
from twin.realism.images import difference_picture
from twin.realism.statistics import RADIAL_MEASURES, TARGET, TARGET_MEASURES, Statistics
from twin.recordings.images import write_image
from twin.report.page import render_page
from twin.report.table import write_rows

DPI = 110
NAMES = {
    "level": "cap level, gray",
    "contrast": "cap contrast, gray",
    "skin": "skin around a cap, gray",
    "diameter_px": "cap diameter, px",
    "eccentricity": "cap eccentricity",
    "edge_px": "edge width 10-90 %, px",
    "skin_level": "bare skin, gray",
    "noise_sd": "noise, sd in gray levels",
}


def write_pictures(folder: Path, pairs: list[Pair], kind: str) -> list[dict]:
    """Write real, rendered and difference of every pair; the page's rows."""
    folder.mkdir(exist_ok=True)
    rows = []
    for pair in pairs:
        stem = Path(pair.real.frame.name).stem
        real = pair.real.frame.image if pair.image.ndim == pair.real.frame.image.ndim else pair.real.gray
        row = _frame_row(pair, kind)
        images = {"real": real, kind: pair.image, f"{kind}-difference": difference_picture(real, pair.image)}
        for key, image in images.items():
            path = folder / f"{stem}-{key}.png"
            write_image(path, image)
            row[key.removeprefix(f"{kind}-").replace(kind, "rendered")] = f"{folder.name}/{path.name}"
        rows.append(row)
    return rows


def image_summary(pairs: list[Pair]) -> dict:
    """Mean, median, least and largest of each figure over the pairs, and the detector's share of exact frames."""
    out = {}
    for name in pairs[0].figures.as_dict():
        values = np.array([getattr(pair.figures, name) for pair in pairs])
        out[name] = {"mean": values.mean(), "median": np.median(values), "min": values.min(), "max": values.max()}
    remainder = np.array([pair.remainder_px for pair in pairs])
    return out | {
        "exact_fraction": float(np.mean([pair.exact for pair in pairs])),
        "pin_px": {"mean": remainder.mean(), "max": remainder.max()},
    }


def statistics_summary(found: Statistics) -> dict:
    """Statistics as plain numbers."""
    worst = {measure: found.worst(measure) for measure in RADIAL_MEASURES}
    return {
        "worst_relative_difference": worst,
        "target": {"relative": TARGET, "met": {measure: worst[measure] <= TARGET for measure in TARGET_MEASURES}},
        "scalars": {name: {"real": real, "rendered": rendered} for name, (real, rendered) in found.scalars.items()},
        "spectrum_db": found.spectrum_db,
        "spots": {
            "real": len(found.real_spots.px),
            "rendered": len(found.rendered_spots.px),
            "paired": len(found.spots_apart_px),
            "apart_px_median": float(np.median(found.spots_apart_px)) if len(found.spots_apart_px) else None,
        },
    }


def pose_summary(found: PoseAligned) -> dict:
    """The fitted kinematics, the pins' errors on both halves, and the image figures on the half not fitted to."""
    error = np.array([pair.remainder_px for pair in found.pairs])
    test = [pair for pair, fitted in zip(found.pairs, found.fitted, strict=True) if not fitted]
    return {
        "tap_map": vars(found.tap_map),
        "pin_error_px": {"fitted": error[found.fitted].mean(), "test": error[~found.fitted].mean(), "test_max": error[~found.fitted].max()},
        "test_images": image_summary(test),
    }


def write_tables(out: Path, pairs: list[Pair], found: Statistics, poses: PoseAligned | None) -> list[Path]:
    """CSV files: figures by frame, measures by radius, spectra, spots."""
    frames = [_frame_row(pair, "pins") for pair in pairs] + [_frame_row(pair, "pose") for pair in (poses.pairs if poses else [])]
    radial = [vars(row) | {"relative_difference": row.difference} for row in found.radial]
    spectrum = [
        {"cycles_per_px": f, "real": a, "rendered": b}
        for f, a, b in zip(found.frequency, found.real_power, found.rendered_power, strict=True)
    ]
    spots = [
        {"set": kind, "x_px": x, "y_px": y, "peak": peak}
        for kind, s in (("real", found.real_spots), ("rendered", found.rendered_spots))
        for (x, y), peak in zip(s.px, s.peak, strict=True)
    ]
    tables = {"frames": frames, "radial": radial, "spectrum": spectrum, "spots": spots}
    return [write_rows(out / f"{name}.csv", rows) for name, rows in tables.items() if rows]


def _frame_row(pair: Pair, alignment: str) -> dict:
    pins = {"pin_px": pair.remainder_px, "exact": pair.exact}
    return {"image_name": pair.real.frame.name, "alignment": alignment, **pair.figures.as_dict(), **pins}


def write_plots(folder: Path, found: Statistics) -> dict[str, str]:
    """Radial profiles and spectra as pictures; names relative to the page."""
    profile = Figure(figsize=(12, 6.4), layout="constrained")
    for ax, measure in zip(profile.subplots(2, 3).flat, RADIAL_MEASURES, strict=True):
        rows = [row for row in found.radial if row.measure == measure]
        middle = [(row.inner_px + row.outer_px) / 2 for row in rows]
        ax.plot(middle, [row.real for row in rows], "o-", label="real")
        ax.plot(middle, [row.rendered for row in rows], "s--", label="rendered")
        ax.set(xlabel="px from the disc's centre", ylabel=NAMES[measure])
    ax.legend()
    spectrum = Figure(figsize=(7, 4), layout="constrained")
    ax = spectrum.subplots()
    ax.loglog(found.frequency, found.real_power, "o-", label="real")
    ax.loglog(found.frequency, found.rendered_power, "s--", label="rendered")
    ax.set(xlabel="cycles per px", ylabel="power, squared gray levels")
    ax.legend()
    for name, figure in (("radial", profile), ("spectrum", spectrum)):
        figure.savefig(folder / f"{name}.png", dpi=DPI)
    return {name: f"{folder.name}/{name}.png" for name in ("radial", "spectrum")}


def write_metrics(path: Path, metrics: dict) -> Path:
    """metrics.json, numpy numbers and all."""
    path.write_text(json.dumps(metrics, indent=2, default=lambda thing: thing.item()) + "\n", encoding="utf-8")
    return path


def write_page(path: Path, spec: SensorSpec, metrics: dict, plots: dict, pairs: list[dict], poses: list[dict], found: Statistics) -> Path:
    """index.html; pictures lie beside it."""
    content = {"spec": spec, "metrics": metrics, "plots": plots, "pairs": pairs, "poses": poses, "radial": found.radial, "names": NAMES}
    page = render_page("twin.realism", **content, measures=RADIAL_MEASURES, target=TARGET, targets=TARGET_MEASURES)
    path.write_text(page, encoding="utf-8")
    return path
