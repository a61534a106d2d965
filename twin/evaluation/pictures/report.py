"""The output of the comparison: metrics.json, tables, pictures and the page."""

from pathlib import Path
from typing import Literal

import numpy as np
from matplotlib.figure import Figure

from scenes.sensor import SensorSpec
from twin.evaluation.pictures.compare import Pair, PoseAligned, difference_picture
from twin.evaluation.pictures.statistics import RADIAL_MEASURES, TARGET, TARGET_MEASURES, RadialRow, Statistics
from twin.frames import distinct_stems
from twin.frames.images import write_image
from twin.report.charts import sized_figure, write_chart
from twin.report.page import Cell, Column, Page, PagePicture, number, write_rows
from twin.store import made_by, write_json

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


def image_summary(pairs: list[Pair]) -> dict:
    """Mean, median, smallest and largest value of each figure over the pairs, and fraction of renders with exactly all pins found."""
    out = {}
    for name in vars(pairs[0].figures):
        values = np.array([getattr(pair.figures, name) for pair in pairs])
        out[name] = {"mean": values.mean(), "median": np.median(values), "min": values.min(), "max": values.max()}
    remainder = np.array([pair.remainder_px for pair in pairs])
    return out | {
        "exact_fraction": float(np.mean([pair.exact for pair in pairs])),
        "pin_px": {"mean": remainder.mean(), "max": remainder.max()},
    }


def statistics_summary(found: Statistics) -> dict:
    """Statistics as a dict of numbers."""
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
    """The fitted rig, the pins' errors on both halves, and the image figures on the half that was not used for the fit."""
    error = np.array([pair.remainder_px for pair in found.pairs])
    test = [pair for pair, fitted in zip(found.pairs, found.fitted, strict=True) if not fitted]
    return {
        "rig": found.rig.model_dump(),
        "pin_error_px": {"fitted": error[found.fitted].mean(), "test": error[~found.fitted].mean(), "test_max": error[~found.fitted].max()},
        "test_images": image_summary(test),
    }


def _tables(pairs: list[Pair], found: Statistics, poses: PoseAligned | None) -> dict[str, tuple[str, list[dict]]]:
    """Tables (CSV files): what they contain, and their rows."""
    frames = [_frame_row(pair, "pins") for pair in pairs] + [_frame_row(pair, "pose") for pair in (poses.pairs if poses else [])]
    radial = [vars(row) | {"relative_difference": row.difference} for row in found.radial]
    powers = zip(found.frequency, found.real_power, found.rendered_power, strict=True)
    spots = [
        {"set": kind, "x_px": x, "y_px": y, "peak": peak}
        for kind, s in (("real", found.real_spots), ("rendered", found.rendered_spots))
        for (x, y), peak in zip(s.px, s.peak, strict=True)
    ]
    return {
        "frames": ("figures of each frame", frames),
        "radial": ("measures by distance from the centre", radial),
        "spectrum": ("radial power spectra", [{"cycles_per_px": f, "real": a, "rendered": b} for f, a, b in powers]),
        "spots": ("bright spots", spots),
    }


def _frame_row(pair: Pair, alignment: str) -> dict:
    pins = {"pin_px": pair.remainder_px, "exact": pair.exact}
    return {"image_name": pair.real.frame.name, "alignment": alignment, **vars(pair.figures), **pins}


def _radial_figure(found: Statistics) -> Figure:
    figure, axes = sized_figure((12, 6.4), 3, 2)
    for ax, measure in zip(axes, RADIAL_MEASURES, strict=True):
        rows = [row for row in found.radial if row.measure == measure]
        middle = [(row.inner_px + row.outer_px) / 2 for row in rows]
        ax.plot(middle, [row.real for row in rows], "o-", label="real")
        ax.plot(middle, [row.rendered for row in rows], "s--", label="rendered")
        ax.set(xlabel="distance from the disc's centre, px", ylabel=NAMES[measure])
    axes[-1].legend()
    return figure


def _spectrum_figure(found: Statistics) -> Figure:
    figure, (ax,) = sized_figure((7, 4))
    ax.loglog(found.frequency, found.real_power, "o-", label="real")
    ax.loglog(found.frequency, found.rendered_power, "s--", label="rendered")
    ax.set(xlabel="cycles per px", ylabel="power, squared gray levels")
    ax.legend()
    return figure


def image_columns(*, mark_best: bool = False) -> list[Column]:
    """Columns of a table of image figures."""
    return [
        Column("psnr_db", "PSNR, colour", "dB", decimals=2, best="most" if mark_best else ""),
        Column("psnr_gray_db", "PSNR, gray", "dB", decimals=2, best="most" if mark_best else ""),
        Column("ssim", "SSIM, colour", decimals=3, best="most" if mark_best else ""),
        Column("ssim_gray", "SSIM, gray", decimals=3, best="most" if mark_best else ""),
        Column("flip", "FLIP", "0: none", decimals=3, best="least" if mark_best else ""),
        Column("psnr_whole_db", "PSNR, whole frame", "dB", decimals=2, best="most" if mark_best else ""),
    ]


def write_results(
    out: Path, spec: SensorSpec, metrics: dict, pairs: list[Pair], found: Statistics, poses: PoseAligned | None
) -> list[Path]:
    """Write ``index.html`` with its pictures, ``metrics.json`` and the tables, and return their paths, the page first.

    Parameters
    ----------
    out : Path
    spec : SensorSpec
    metrics : dict
        Content of metrics.json.
    pairs : list of Pair
        Pin-aligned pairs.
    found : Statistics
    poses : PoseAligned, optional
        Pose-aligned pairs.
    """
    pictures = out / "pictures"
    pictures.mkdir(exist_ok=True)
    disc = metrics["disc"]
    center = ", ".join(number(v, decimals=1) for v in disc["center_px"])
    page = Page(
        f"Realism of {spec.name}",
        "twin realism",
        topic="TacTip twin: realism",
        lead=f"{spec.description}. {metrics['frames']} real frames beside their renders ({metrics['quality']} quality), over the lens disc "
        f"of radius {number(disc['radius_px'], decimals=1)} px about ({center}) px.",
    )
    page.notice("Frames refused", [f"{row['image_name']}: {row['reason']}" for row in metrics["refused"]], tone="bad")
    page.section(
        "Pin-aligned: camera and light on trial",
        "The skin is fitted to the pins of each real frame, so the render shows the same caps in the same places, without the mechanics.",
    )
    _image_table(page, metrics["pin_aligned"])
    page.text(_detector_text(spec.pins.count, metrics))
    if fixed := metrics["fixed_residual"]:
        page.text(
            f"On the caps and their edges the renders miss {number(fixed['levels'], decimals=1)} gray levels (rms), of whose power "
            f"{number(100 * fixed['share'], decimals=1)} % is a picture fixed to each cap, which a better relief could hold."
        )
    _statistics_section(page, metrics["statistics"], pictures, found)
    if metrics["pose_aligned"]:
        error = metrics["pose_aligned"]["pin_error_px"]
        page.section(
            "Pose-aligned: the whole twin from the label",
            "Depth and two turns of each label become a contact; the arm's kinematics were fitted to the pins of one half of the frames. "
            f"Mean pin error: {number(error['fitted'], decimals=2)} px on that half, {number(error['test'], decimals=2)} px on the other "
            f"(at most {number(error['test_max'], decimals=2)} px in a frame). The figures below are those of the other half.",
        )
        _image_table(page, metrics["pose_aligned"]["test_images"])
    page.section("Frame by frame, pin-aligned")
    _add_frames(page, pictures, pairs, "pins", "skin misses the pins by")
    if poses:
        page.section("Frame by frame, pose-aligned")
        _add_frames(page, pictures, poses.pairs, "pose", "mean pin error")
    written = [write_json(out / "metrics.json", metrics | {"made_by": made_by(__name__)})]
    page.download(written[0], "all figures of this page")
    for name, (what, table) in _tables(pairs, found, poses).items():
        if table:
            written.append(write_rows(out / f"{name}.csv", table))
            page.download(written[-1], what)
    return [page.write(out / "index.html"), *written]


def _image_table(page: Page, summary: dict) -> None:
    parts = {"mean": "mean", "median": "median", "min": "least", "max": "largest"}
    columns = [Column("of", "over the lens disc"), *image_columns()]
    page.table([{"of": said} | {c.key: summary[c.key][part] for c in columns[1:]} for part, said in parts.items()], columns)


def _detector_text(count: int, metrics: dict) -> str:
    exact = f"{100 * metrics['pin_aligned']['exact_fraction']:.1f} % of the renders."
    said = f"The detector, with the parameters of the real frames, finds exactly all {count} pins in {exact}"
    if not (told := metrics["two_sample"]):
        return said
    shares = "; ".join(
        f"{name}: {100 * test['accuracy']:.1f} % (95 % interval {100 * test['low']:.1f} to {100 * test['high']:.1f} %)"
        for name, test in told.items()
    )
    return (
        f"{said} Networks assign these shares of the patches of unseen frames to the right set, where 50 % would mean that they cannot "
        f"distinguish real frames from renders: {shares}."
    )


def _statistics_section(page: Page, summary: dict, pictures: Path, found: Statistics) -> None:
    bins = [row for row in found.radial if row.measure == RADIAL_MEASURES[0]]
    page.section(
        "Statistics by distance from the disc's centre",
        f"Means over {len(bins)} bins with equally many caps. Target for cap level, diameter and edge width: within {100 * TARGET:.0f} % "
        "in each bin (green: met, red: missed).",
    )
    radial = write_chart(pictures / "radial.png", lambda: _radial_figure(found))
    page.figures(PagePicture(radial, "Six measures of caps against the distance from the disc's centre, real and rendered"))
    columns = [Column(f"bin_{k}", f"{row.inner_px:.0f} to {row.outer_px:.0f}", "px", decimals=1, signed=True) for k, row in enumerate(bins)]
    rows = []
    for measure in RADIAL_MEASURES:
        of_measure = [row for row in found.radial if row.measure == measure]
        rows.append({"measure": NAMES[measure]} | {f"bin_{k}": _difference(row) for k, row in enumerate(of_measure)})
    page.table(rows, [Column("measure", "rendered against real, %"), *columns])
    scalars = [{"measure": NAMES[key], **pair} for key, pair in summary["scalars"].items()]
    page.table(
        scalars, [Column("measure", "over all frames"), Column("real", "real", decimals=2), Column("rendered", "rendered", decimals=2)]
    )
    spots = summary["spots"]
    away = spots["apart_px_median"]
    page.text(
        f"Steady bright spots: {spots['real']} in the real frames, {spots['rendered']} in the rendered ones; {spots['paired']} have a "
        f"counterpart{'' if away is None else f', {number(away, decimals=2)} px away in the median'}. The radial power spectra differ by "
        f"{number(summary['spectrum_db'], decimals=2)} dB (rms over log frequency)."
    )
    spectrum = write_chart(pictures / "spectrum.png", lambda: _spectrum_figure(found))
    page.figures(PagePicture(spectrum, "Radial power spectra of real and rendered frames", width_px=760))


def _difference(row: RadialRow) -> Cell:
    tone: Literal["", "good", "bad"] = "good" if abs(row.difference) <= TARGET else "bad"
    return Cell(100 * row.difference, tone if row.measure in TARGET_MEASURES else "")


def _add_frames(page: Page, folder: Path, pairs: list[Pair], kind: str, what: str) -> None:
    """Write the real, the rendered and the difference picture of every pair to a folder, and show them on the page."""
    for pair, stem in zip(pairs, distinct_stems([pair.real.frame.name for pair in pairs]), strict=True):
        name, real, figures = pair.real.frame.name, pair.real.like(pair.image), pair.figures
        said = (
            f"rendered: PSNR {number(figures.psnr_db, decimals=1)} dB, SSIM {number(figures.ssim, decimals=3)}, "
            f"FLIP {number(figures.flip, decimals=3)}; {what} {number(pair.remainder_px, decimals=2)} px"
            f"{'' if pair.exact else '; the detector loses pins'}"
        )
        less = "rendered less real, twice amplified about middle gray"
        shown = (
            ("real", real, f"Real frame {name}", f"{name}, real"),
            (kind, pair.image, f"Render of {name}", said),
            (f"{kind}-difference", difference_picture(real, pair.image), f"Difference for {name}", less),
        )
        paths = [write_image(folder / f"{stem}-{key}.png", image) for key, image, _, _ in shown]
        page.figures(*(PagePicture(path, alt, text, "frame") for path, (_, _, alt, text) in zip(paths, shown, strict=True)), layout="row")
