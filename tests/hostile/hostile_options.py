"""What options take besides a recording and a specification, made hostile: layouts, places of pins, tables and no-contact frames from
elsewhere, pictures in other formats, tables in other forms, cameras, states of the studio, addresses to listen on."""

from __future__ import annotations

import gzip
import io
import signal
import struct
from collections.abc import Callable
from pathlib import Path

import cv2
import hostile_inputs as given
import numpy as np
from hostile_entry import ANY, DONE, REFUSED, USAGE, Entry, S
from hostile_inputs import BAD, SENSOR, Maker, edited, written
from PIL import Image

Edit = Callable[[Path], object]


def _saved(kind: str, change: Callable[[Image.Image], Image.Image] = lambda picture: picture, **options: object) -> Edit:
    """An edit that saves a picture, changed, as another kind of file under its name."""

    def edit(path: Path) -> None:
        content = io.BytesIO()
        change(Image.open(path).convert("L")).save(content, kind, **options)
        path.write_bytes(content.getvalue())

    return edit


def _mode(mode: str) -> Callable[[Image.Image], Image.Image]:
    return lambda picture: picture.convert(mode)


SAME_PICTURE: dict[str, Edit] = {  # other files of the same levels
    "with alpha": _saved("PNG", _mode("RGBA")),
    "gray with alpha": _saved("PNG", _mode("LA")),
    "palette": _saved("PNG", _mode("P")),
    "colour": _saved("PNG", _mode("RGB")),
    "16 bit": _saved("PNG", lambda picture: Image.fromarray(np.asarray(picture).astype(np.uint16) * 257)),
    "TIFF": _saved("TIFF"),
    "compressed TIFF": _saved("TIFF", compression="tiff_lzw"),
    "BMP": _saved("BMP"),
    "lossless WebP": _saved("WEBP", _mode("RGB"), lossless=True),
    "PGM": _saved("PPM"),
    "GIF": _saved("GIF"),
}


def _damaged_jpeg(path: Path) -> None:
    data = cv2.imencode(".jpg", cv2.imread(str(path), cv2.IMREAD_GRAYSCALE))[1].tobytes()
    middle = len(data) // 2
    path.write_bytes(data[:middle] + bytes(500) + data[middle + 500 :])


def _vast_tiff(path: Path) -> None:
    tags = ((256, 2**31 - 1), (257, 2**31 - 1), (258, 8), (273, 8))
    path.write_bytes(
        struct.pack("<2sHIH", b"II", 42, 8, len(tags)) + b"".join(struct.pack("<HHII", t, 4, 1, v) for t, v in tags) + bytes(4)
    )


REFUSED_PICTURE: dict[str, Edit] = {
    "8000 x 10": lambda path: path.write_bytes(cv2.imencode(".png", np.zeros((10, 8000), np.uint8))[1].tobytes()),
    "10 x 8000": lambda path: path.write_bytes(cv2.imencode(".png", np.zeros((8000, 10), np.uint8))[1].tobytes()),
    "damaged JPEG": _damaged_jpeg,
    "double levels": lambda path: path.write_bytes(cv2.imencode(".tiff", np.zeros((256, 256)))[1].tobytes()),
    "HDR of 99999 x 99999": given.with_bytes(lambda data: b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 99999 +X 99999\n"),
    "PGM of 10^9 x 10^9": given.with_bytes(lambda data: b"P5 1000000000 1000000000 255\n" + bytes(100)),
    "PGM of negative width": given.with_bytes(lambda data: b"P5 -256 256 255\n" + bytes(65536)),
    "vast TIFF": _vast_tiff,
}
SAME_TABLE: dict[str, Edit] = {  # beyond those of ``hostile_inputs``
    "UTF-16 with semicolons and decimal commas": given.text(
        lambda t: t.replace(",", ";").replace(".", ",").replace(",png", ".png").encode("utf-16")
    ),
    "tabs and decimal commas": given.text(lambda t: t.replace(",", "\t").replace(".", ",").replace(",png", ".png")),
    "columns in another order": given.lines(lambda rows: [",".join([row.split(",")[k] for k in (3, 1, 0, 4, 2)]) for row in rows]),
    "a column more": given.lines(lambda rows: [rows[0] + ",note", *(f"{row},x" for row in rows[1:])]),
    "an empty column": given.lines(lambda rows: [f"{row}," for row in rows]),
    "rows of separators": given.lines(lambda rows: [*rows, ",,,,", ",,,,"]),
    "exponents": given.lines(lambda rows: [rows[0], *(f"{row}e0" for row in rows[1:])]),
}
TOLD_TABLE: dict[str, tuple[Edit, str]] = {
    "two columns of one name": (given.lines(lambda rows: [f"{rows[0]},pose_2", *(f"{row},1.0" for row in rows[1:])]), "pose_2_2"),
    "a line that names the separator": (given.text(lambda t: "sep=,\n" + t), "no column"),
    "decimal commas in quotes": (given.text(lambda t: t.replace(",", '","').replace(".", ",").replace(",png", ".png")), "column"),
    "dashes for minus": (given.text(lambda t: t.replace("-", "\u2212")), "the first"),
    "UTF-32": (given.text(lambda t: t.encode("utf-32")), "no column"),
    "compressed": (given.with_bytes(gzip.compress), "no column"),
}

READ_TABLES = {  # by option
    "audit": f"audit {{recording}} {S} --table {{data}} --out {{out}}",
    "train": f"train --model gnn {S} --data {{recording}} --table {{data}} --epochs 1 --out {{out}}",
    "new": "new {frames} --table {data} --max-frames 2 --out {out}/mine.toml",
    "predict": f"predict {SENSOR} {{frames}} --table {{data}}",
}


def _there(make: Edit) -> Maker:
    def maker(folder: Path, good: given.Harmless) -> Path:
        path = folder / "table.csv"
        path.write_text("")
        make(path)
        return path

    return maker


TABLES: dict[str, Maker] = {
    "empty": written("table.csv", ""),
    "binary": written("table.csv", bytes(range(256)) * 9),
    "of other pictures": written("table.csv", "image_name,pose_2\ng.png,1\n"),
    "a spreadsheet": written("table.csv", b"PK\x03\x04" + bytes(3000)),
    "missing": _there(Path.unlink),
    "a folder": _there(given.AS_FOLDER),
    "a named pipe": _there(given.AS_FIFO),
    "an endless device": _there(given.AS_ZEROS),
}
LAYOUTS = (
    *(
        "rings:0",
        "rings:-1",
        "rings:999999999",
        "rings:1e3",
        "rings:",
        "rings:10:3",
        "grid:1x1",
        "grid:100000x100000",
        "grid:3",
        "grid:-3x4",
    ),
    *("hexagon:x", "hexagon:99999999999999999999", "positions:nowhere.csv", "positions:/dev/zero", "positions:/", "star:4"),
)
_RANDOM = np.random.default_rng(0).normal(size=(6000, 2))
PLACES: dict[str, bytes | str] = {
    "empty": "",
    "one pin": "1,2\n",
    "not a number": "1,2\nnan,4\n5,6\n7,8\n",
    "infinite": "1,2\ninf,4\n5,6\n7,8\n",
    "1e308": "1e308,1e308\n-1e308,1e308\n1,1\n0,0\n",
    "two pins at one place": "1,2\n1,2\n3,4\n5,6\n",
    "on a line": "\n".join(f"{k},0" for k in range(30)),
    "6000 pins": "\n".join(f"{x},{y}" for x, y in _RANDOM),
    "three columns": "1,2,3\n4,5,6\n7,8,9\n",
    "text": "hello\nworld\n",
    "binary": bytes(range(256)) * 5,
}
OWN_SENSOR = """[pins]
{pins}
[camera]
width_px = 256
height_px = 256
fx_px = 100.0
fy_px = 100.0
cx_px = 128.0
cy_px = 128.0
[pipeline.raw]
threshold = -10.0
mask_center_px = [128.0, 128.0]
mask_radius_px = 120.0
"""
PINS = {
    "10^9 rings": 'layout = "rings"\nrings = 1000000000',
    "rings that are a truth": 'layout = "rings"\nrings = true',
    "a missing pin beyond": 'layout = "rings"\nrings = 4\nmissing = [99999]',
    "a missing pin below 0": 'layout = "rings"\nrings = 4\nmissing = [-1]',
    "most pins missing": 'layout = "rings"\nrings = 2\nmissing = [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10]',
    "a pin missing twice": 'layout = "rings"\nrings = 4\nmissing = [3, 3]',
    "a missing half pin": 'layout = "rings"\nrings = 4\nmissing = [3.5]',
    "a grid of 10^10": 'layout = "grid"\ncolumns = 100000\nrows = 100000',
    "one place": 'layout = "positions"\npositions = [[0.0, 0.0]]',
    "a place that is no number": 'layout = "positions"\npositions = [[nan, 0.0], [1.0, 1.0], [2.0, 0.0]]',
    "places at 1e308": 'layout = "positions"\npositions = [[1e308, 0.0], [-1e308, 1.0], [2.0, 1e308]]',
    "places that are a text": 'layout = "positions"\npositions = "x"',
    "an unknown layout": 'layout = "star"\nrings = 4',
}
CAMERAS = (
    "http://127.0.0.1:1",
    "99",
    "/dev/zero",
    "rtsp://127.0.0.1:1/x",
    "file:///etc/passwd",
    "http://[::1",
    "http://",
    "-1",
    "twin:",
    "/",
)
STATES: dict[str, bytes | str] = {
    "empty": "",
    "a list": "[1]",
    "nested 100000 deep": "[" * 100_000,
    "of another version": '{"studio": 99, "sensor": "mg400-127", "object": "plane"}',
    "binary": bytes(range(256)),
}
STUDIO = f"studio {S} --plain --saves {{out}}"
STUDIO_VALUES = {
    "--port": "-1 0 65536 x",
    "--seconds": "nan -1",
    "--host": "999.1.1.1 nowhere.invalid",
    "--model": "nowhere",
    "--arm": "nowhere",
    "--camera": "nowhere",
    "--recording": "nowhere",
}
SERVERS = {  # a while of each: whether it listens beyond this machine
    "studio": f"{STUDIO} --seconds 4 --port 9101",
    "live": f"live --model {SENSOR} --camera {{frames}} --port 9102 --seconds 4",
    "emulate mg400": "emulate mg400 --port-offset 12000",
    "emulate magician": "emulate magician",
    "emulate ur": "emulate ur --host 127.0.0.7",
}


def _options() -> list[Entry]:
    found = [
        Entry("formats", what, f"predict {SENSOR} {{data}}", {"data": edited("recording", f"frames_bw/{BAD}", edit)}, (DONE,), same=True)
        for what, edit in SAME_PICTURE.items()
    ]
    for what, edit in REFUSED_PICTURE.items():
        one = {"data": edited("frames", BAD, edit)}
        alone = {"data": lambda folder, good, make=one["data"]: make(folder, good) / BAD}
        found.append(Entry("formats", what, f"preprocess {{data}} {S} --out {{out}}", one, (DONE,), (BAD,), sample=what == "damaged JPEG"))
        for call in (
            "new {frames} --no-contact {data} --max-frames 4 --out {out}/mine.toml",
            f"live --model {SENSOR} --camera {{frames}} --headless --at-rest {{data}}",
            "servo --object can --steps 1 --out {out} --at-rest {data}",
        ):
            found.append(Entry("a picture without contact", what, call, alone, (REFUSED,), (BAD,)))
    for command, call in {"audit": f"audit {{data}} {S} --out {{out}}", "evaluate": "evaluate {run} --data {data} --out {out}"}.items():
        for what, edit in SAME_TABLE.items():
            found.append(Entry("other tables", what, call, {"data": edited("recording", "targets.csv", edit)}, ANY, same=True))
        for what, (edit, said) in TOLD_TABLE.items():
            sample = command == "audit" and what == "dashes for minus"
            found.append(Entry("other tables", what, call, {"data": edited("recording", "targets.csv", edit)}, ANY, (said,), sample=sample))
    for call in READ_TABLES.values():
        found += [Entry("tables elsewhere", what, call, {"data": make}, (REFUSED,), ("table.csv",)) for what, make in TABLES.items()]
    for layout in LAYOUTS:
        call = f"new {{frames}} --layout {layout} --max-frames 2 --out {{out}}/mine.toml"
        found.append(Entry("layouts", layout, call, {}, (REFUSED, USAGE), ("|".join(filter(None, layout.split(":"))),)))
    for what, content in PLACES.items():
        call = "new {frames} --layout positions:{data} --max-frames 2 --out {out}/mine.toml"
        found.append(Entry("layouts", f"places: {what}", call, {"data": written("places.csv", content)}, (REFUSED,), ("places.csv|pins",)))
    for what, pins in PINS.items():
        make = {"data": written("mine.toml", OWN_SENSOR.format(pins=pins))}
        found.append(Entry("own sensors", what, "preprocess {frames} --sensor {data} --out {out}", make, (REFUSED,), ("mine.toml",)))
    for camera in CAMERAS:
        for call in (f"check {camera} {S}", f"live --model {SENSOR} --camera {camera} --headless --count 1"):
            found.append(Entry("cameras", camera, call, {}, (REFUSED, USAGE), seconds=30))
    for what, content in STATES.items():
        make = {"data": written("state.json", content)}
        found.append(Entry("states", what, f"{STUDIO} --seconds 1 --state {{data}}", make, (REFUSED,), ("state.json",), seconds=40))
    for option, values in STUDIO_VALUES.items():
        for value in values.split():
            call = f"{STUDIO} --seconds 1 {option} {value}".replace("--seconds 1 --seconds", "--seconds")
            found.append(Entry("studio", f"{option} {value}", call, {}, (REFUSED, USAGE), (f"{option}|{value}",), seconds=60))
    for call in SERVERS.values():
        end = (12.0, int(signal.SIGINT), 1)
        found.append(Entry("servers", "for a while", call, {}, (DONE, REFUSED, 130), leaves=("*",), end=end, seconds=60))
    return found


OPTIONS = tuple(_options())
