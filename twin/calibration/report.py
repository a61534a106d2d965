"""The calibration's page: before, after, what is left, what changed."""

from pathlib import Path

from scenes.sensor import SensorSpec
from twin.calibration.calibrate_optics import Calibration
from twin.realism.images import difference_picture
from twin.realism.report import image_columns
from twin.recordings.images import write_image
from twin.report.page import Page, Picture, code
from twin.report.table import Column

LONGEST = 12  # numbers of a list that the page shows
KINDS = {"real": "real", "before": "before", "after": "after", "residual": "what is left, twice amplified about middle gray"}


def write_page(out: Path, start: SensorSpec, found: Calibration, source: str) -> Path:
    """Write ``index.html`` and its pictures into ``out``; the page's path."""
    rows = write_pictures(out / "pictures", found)
    lead = (
        f"{len(rows)} frames of {source}. Figures are over the lens disc, of renders without noise, the skin fitted to each frame's pins."
    )
    page = Page(f"Calibration of {found.spec.name}", "twin calibrate", topic="TacTip twin: calibration", lead=lead)
    page.table([{"of": "before"} | found.before, {"of": "after"} | found.after], [Column("of", ""), *image_columns(mark_best=True)])
    if found.notes:
        page.section("What these frames do not determine")
        page.items(found.notes)
    page.section("Frames")
    for name, pictures in rows:
        shown = [Picture(pictures[k], f"{name}: {said}", f"{name}, {said}" if k == "real" else said, "frame") for k, said in KINDS.items()]
        page.figures(*shown, layout="row")
    page.section("What changed")
    changed = [{**change, "name": code(change["name"])} for change in changes(start, found.spec)]
    page.table(changed, [Column("name", "value"), Column("before", "before"), Column("after", "after")])
    return page.write(out / "index.html")


def write_pictures(folder: Path, found: Calibration) -> list[tuple[str, dict[str, Path]]]:
    """Write each frame as it is, as rendered before and after, and what is left: its name, and the pictures by `KINDS`."""
    folder.mkdir(parents=True, exist_ok=True)
    rows = []
    for frame, before, after in zip(found.frames, found.first, found.last, strict=True):
        images = {"real": frame.image, "before": before, "after": after, "residual": difference_picture(frame.image, after)}
        stem = Path(frame.name).stem
        rows.append((frame.name, {kind: write_image(folder / f"{stem}-{kind}.png", image) for kind, image in images.items()}))
    return rows


def changes(before: SensorSpec, after: SensorSpec) -> list[dict]:
    """Every value that differs: ``name`` as section.key, ``before`` and ``after`` as text."""
    old, new = before.model_dump(), after.model_dump()
    found = []
    for section, values in new.items():
        if isinstance(values, dict):
            found += [
                {"name": f"{section}.{key}", "before": _shown(old[section][key]), "after": _shown(value)}
                for key, value in values.items()
                if old[section] is not None and old[section][key] != value
            ]
    return found


def _shown(value: object) -> str:
    if isinstance(value, tuple | list):
        return (
            f"{len(value)} entries"
            if len(value) > LONGEST or (value and not isinstance(value[0], float))
            else ", ".join(_shown(v) for v in value)
        )
    return f"{value:.5g}" if isinstance(value, float) else str(value)
