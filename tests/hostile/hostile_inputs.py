"""Makers of what the hostile calls are given: harmless inputs, and what becomes of them when something goes wrong.

A maker takes the folder to write to and the harmless inputs, and returns the path that the call is given.
"""

from __future__ import annotations

import io
import json
import os
import pickle
import shutil
import struct
import zipfile
import zlib
from collections.abc import Callable
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
import trimesh
from drawn_frames import drawn_frame
from forked_program import Program

from scenes import load_sensor
from scenes.load import SHIPPED
from twin.pins import nominal_reference
from twin.types import Form

SENSOR, RAW_SENSOR = "mg400-127", "ur5-331"
POLICIES = Path(__file__).parents[2] / "training" / "policies"
ROWS = 24  # labelled frames of the harmless recording
BAD = "f_3.png"  # the picture that is replaced by a hostile one
GENTLE = """description = "gentle taps"
object = "plane"
approach = "y"
zero_mm = 5.0
tap = [0, 5, 0, 0, 0, 0]
targets = ["pose_2", "pose_6"]
[pose]
pose_2 = [-4.4, -3.8]
[move]
move_1 = [-0.5, 0.5]
"""


class Harmless:
    """Inputs with which every command does what it should, each made when it is first asked for.

    Parameters
    ----------
    folder : Path
    program : Program
        Makes what only the program makes: pins, runs, sessions, data sets.
    """

    def __init__(self, folder: Path, program: Program) -> None:
        self.folder, self.program = folder, program

    def get(self, name: str) -> Path:
        """The path of an input by name."""
        return getattr(self, name)

    @cached_property
    def recording(self) -> Path:
        """A labelled recording: pins that follow depth, angle and shear, moves of which some had not been executed."""
        spec = load_sensor(SENSOR)
        rest = nominal_reference(spec, Form.PROCESSED).pins_px
        rng = np.random.default_rng(0)
        labels = np.column_stack([rng.uniform(-4, 0, ROWS), rng.uniform(-20, 20, ROWS), rng.uniform(-5, 5, (ROWS, 2))])
        executed = rng.random(ROWS) < 0.7
        path = self.folder / "recording"
        (path / "frames_bw").mkdir(parents=True)
        table, moves = ["image_name,pose_2,pose_6,move_1,move_6"], ["image_name,executed"]
        for k, label in enumerate(labels):
            picture = drawn_frame(spec, Form.PROCESSED, moved(rest, label * [1, 1, executed[k], executed[k]])).image
            cv2.imwrite(str(path / "frames_bw" / f"f_{k}.png"), picture)
            table.append(f"f_{k}.png," + ",".join(f"{v:.4f}" for v in label))
            moves.append(f"f_{k}.png,{int(executed[k])}")
        cv2.imwrite(str(path / "init_0.png"), drawn_frame(spec, Form.PROCESSED, rest).image)
        (path / "targets.csv").write_text("\n".join(table) + "\n")
        (path / "move_executed.csv").write_text("\n".join(moves) + "\n")
        return path

    @cached_property
    def policy(self) -> Path:
        """A policy that goes along an object's outline."""
        return Path(shutil.copy(POLICIES / "SurfaceFollow-mg400-331.safetensors", self.folder / "policy.safetensors"))

    @cached_property
    def grasp_policy(self) -> Path:
        """A policy of the gripper that was not trained, as stable-baselines3 writes it."""
        import gymnasium
        from stable_baselines3 import PPO

        import training.environments  # noqa: F401

        path = self.folder / "grasp.zip"
        PPO("MultiInputPolicy", gymnasium.make("tactip/GraspLift-v0"), seed=0, device="cpu", n_steps=4, batch_size=4).save(path)
        return path

    @cached_property
    def frames(self) -> Path:
        """Four frames of it in a folder."""
        path = self.folder / "frames"
        path.mkdir()
        for k in range(4):
            shutil.copy(self.recording / "frames_bw" / f"f_{k}.png", path)
        return path

    @cached_property
    def raw(self) -> Path:
        """Four raw frames of another sensor."""
        spec = load_sensor(RAW_SENSOR)
        rest = nominal_reference(spec, Form.RAW).pins_px
        path = self.folder / "raw"
        path.mkdir()
        for k in range(4):
            cv2.imwrite(str(path / f"f_{k}.png"), drawn_frame(spec, Form.RAW, moved(rest, np.array([-1.0 - k, 5.0, 0, 0]))).image)
        return path

    @cached_property
    def video(self) -> Path:
        """A video of the recording's frames."""
        path = self.folder / "clip.avi"
        pictures = [cv2.imread(str(self.recording / "frames_bw" / f"f_{k}.png")) for k in range(8)]
        writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 10, pictures[0].shape[1::-1])
        for picture in pictures:
            writer.write(picture)
        writer.release()
        return path

    @cached_property
    def run(self) -> Path:
        """A trained model."""
        return self._made("run", "train", "--model", "gnn", "--sensor", SENSOR, "--data", self.recording, "--epochs", 1)

    @cached_property
    def begin_info(self) -> Path:
        """A run that ended before it was finished, with its checkpoint."""
        asked = ("train", "--model", "gnn", "--sensor", SENSOR, "--data", self.recording, "--epochs", 3, "--max-minutes", 0)
        return self._made("begun", *asked)

    @cached_property
    def pins(self) -> Path:
        """Pins of the recording's frames."""
        return self._made("pins", "preprocess", self.recording, "--sensor", SENSOR) / "pins.npz"

    @cached_property
    def tuned(self) -> Path:
        """What 'twin tune' writes."""
        return self._made("tuned.toml", "tune", "--sensor", SENSOR, "--frames", self.frames, "--max-frames", 2)

    @cached_property
    def session(self) -> Path:
        """A recorded live session."""
        return self._made("session", "live", "--model", SENSOR, "--camera", self.frames, "--headless", "--count", 3, out="--record")

    @cached_property
    def experiment(self) -> Path:
        """An experiment of gentle taps, which coarse grids take."""
        path = self.folder / "gentle.toml"
        path.write_text(GENTLE)
        return path

    @cached_property
    def mesh(self) -> Path:
        """A ball as a mesh."""
        path = self.folder / "ball.stl"
        trimesh.creation.icosphere(subdivisions=3, radius=12.0).export(path)
        return path

    @cached_property
    def dataset(self) -> Path:
        """A small simulated data set."""
        size = ("--images", "none", "--count", 2, "--elements", 6, "--workers", 1)
        return self._made("dataset", "dataset", "--experiment", self.experiment, "--sensor", SENSOR, *size)

    def _made(self, name: str, *arguments: object, out: str = "--out") -> Path:
        path = self.folder / name
        ended = self.program.call(*arguments, out, path, folder=self.folder)
        if ended.exit or not path.exists():
            raise AssertionError(f"a harmless call failed: twin {' '.join(map(str, arguments))}: {ended.stderr[-2000:]}")
        return path


Maker = Callable[[Path, Harmless], Path]


def smaller_ball(path: Path) -> None:
    """Another mesh under the same name."""
    trimesh.creation.icosphere(subdivisions=3, radius=8.0).export(path)


def moved(rest: np.ndarray, label: np.ndarray) -> np.ndarray:
    """Pins (N, 2) of a contact with depth, angle, shear and twist: a bump that grows, moves and turns."""
    r = (rest - rest.mean(axis=0)) / np.linalg.norm(rest - rest.mean(axis=0), axis=1).max()
    depth, angle, shear, turn = label / [4, 20, 5, 5]
    bump = np.exp(-4 * ((r - [0.2 * angle, 0]) ** 2).sum(axis=1))[:, None]
    spun = np.stack([-r[:, 1], r[:, 0]], axis=1)
    return rest + 5 * (1.2 + depth) * bump * (6 * (r - [0.2 * angle, 0]) + 4 * np.array([shear, 0.1 * shear]) + 3 * turn * spun)


def copied(name: str) -> Maker:
    """A harmless input by name."""

    def make(folder: Path, good: Harmless) -> Path:
        source = good.get(name)
        return Path((shutil.copytree if source.is_dir() else shutil.copy)(source, folder / source.name))

    return make


def written(name: str, content: bytes | str) -> Maker:
    """A file."""

    def make(folder: Path, good: Harmless) -> Path:
        path = folder / name
        path.write_bytes(content.encode() if isinstance(content, str) else content)
        return path

    return make


def edited(source: str, name: str, edit: Callable[[Path], object]) -> Maker:
    """A copy of the harmless input ``source`` whose file ``name`` (of a folder; else "") is changed by ``edit``."""

    def make(folder: Path, good: Harmless) -> Path:
        path = copied(source)(folder, good)
        edit(path / name if name else path)
        return path

    return make


def with_bytes(change: Callable[[bytes], bytes]) -> Callable[[Path], object]:
    """An edit that changes a file's bytes."""
    return lambda path: path.write_bytes(change(path.read_bytes()))


def with_json(change: Callable[[dict], object]) -> Callable[[Path], object]:
    """An edit that changes a JSON file's content in place, or gives another."""

    def edit(path: Path) -> None:
        content = json.loads(path.read_text())
        changed = change(content)
        path.write_text(json.dumps(content if changed is None else changed))

    return edit


def _instead(make: Callable[[Path], object]) -> Callable[[Path], object]:
    def edit(path: Path) -> None:
        path.unlink()
        make(path)

    return edit


AS_FIFO = _instead(os.mkfifo)
AS_FOLDER = _instead(Path.mkdir)
AS_DANGLING_LINK = _instead(lambda path: path.symlink_to("nowhere"))
AS_LINK_LOOP = _instead(lambda path: path.symlink_to(path.name))
AS_ZEROS = _instead(lambda path: path.symlink_to("/dev/zero"))


class Touch:
    """Writes a file when it is unpickled: what a hostile pickle could do."""

    def __reduce__(self) -> tuple:
        return os.mkdir, ("pickle-has-run",)


def pickle_bytes() -> bytes:
    """A pickle that makes a folder where it is read."""
    return pickle.dumps(Touch())


def pickled_npz(path: Path) -> None:
    """An ``.npz`` whose arrays are pickles."""
    np.savez(path, **{name: np.array([Touch()], dtype=object) for name in ("image_name", "pins_px", "predicted_px", "valid")})


def vast_npz(path: Path) -> None:
    """An ``.npz`` of a few hundred bytes that claims an array of 4.8 TiB."""
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": (2_600_000_000, 127, 2)})
    with zipfile.ZipFile(path, "w") as file:
        for name in ("image_name", "pins_px", "predicted_px", "valid"):
            file.writestr(f"{name}.npy", header.getvalue() + bytes(64))


def npz_with(**arrays: object) -> Callable[[Path], object]:
    """An edit of an ``.npz``: some arrays replaced, or left out where the value is None."""

    def edit(path: Path) -> None:
        with np.load(path) as file:
            found = {name: file[name] for name in file.files} | arrays
        np.savez(path, **{name: array for name, array in found.items() if array is not None})

    return edit


# --- pictures ----------------------------------------------------------------------------------------------------------------------------


def _picture(extension: str, change: Callable[[np.ndarray], np.ndarray], *options: int) -> Callable[[Path], object]:
    def edit(path: Path) -> None:
        path.write_bytes(cv2.imencode(extension, change(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)), list(options))[1].tobytes())

    return edit


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png_of_size(width: int, height: int, data: bytes = b"") -> bytes:
    """A PNG whose header claims a size; with correct checksums."""
    head = _chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + head + _chunk(b"IDAT", data or zlib.compress(bytes(1000))) + _chunk(b"IEND", b"")


def _bomb(side: int) -> bytes:
    squeeze = zlib.compressobj(9)
    rows = b"".join(squeeze.compress(bytes(side + 1)) for _ in range(side))
    return png_of_size(side, side, rows + squeeze.flush())


def _animated(path: Path) -> None:
    from PIL import Image

    frames = [Image.open(path).convert("L"), Image.new("L", Image.open(path).size, 255)]
    frames[0].save(path, format="PNG", save_all=True, append_images=frames[1:])


def _pages(path: Path) -> None:
    picture = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    path.write_bytes(cv2.imencodemulti(".tiff", [picture, 255 - picture])[1].tobytes())


PICTURES: dict[str, Callable[[Path], object]] = {
    "empty": with_bytes(lambda data: b""),
    "cut": with_bytes(lambda data: data[: len(data) // 2]),
    "damaged": with_bytes(lambda data: data[:200] + b"damage" + data[206:]),
    "text": with_bytes(lambda data: b"no picture\n" * 50),
    "zeros": with_bytes(lambda data: bytes(len(data))),
    "pickle": with_bytes(lambda data: pickle_bytes()),
    "page": with_bytes(lambda data: b"<html><title>404 Not Found</title></html>"),
    "svg": with_bytes(lambda data: b'<svg xmlns="http://www.w3.org/2000/svg" width="9" height="9"/>'),
    "one pixel": _picture(".png", lambda p: p[:1, :1]),
    "half the size": _picture(".png", lambda p: p[::2, ::2]),
    "turned": _picture(".png", lambda p: p[:, :-2].T),
    "black": _picture(".png", np.zeros_like),
    "white": _picture(".png", lambda p: np.full_like(p, 255)),
    "noise": _picture(".png", lambda p: np.random.default_rng(0).integers(0, 256, p.shape, np.uint8)),
    "negative": _picture(".png", lambda p: 255 - p),
    "float levels": _picture(".tiff", lambda p: p.astype(np.float32)),
    "NaN levels": _picture(".tiff", lambda p: np.full(p.shape, np.nan, np.float32)),
    "two pages": _pages,
    "animated": _animated,
    "claims 60000 x 60000": with_bytes(lambda data: png_of_size(60_000, 60_000)),
    "claims no width": with_bytes(lambda data: png_of_size(0, 256)),
    "bomb of 20000 x 20000": with_bytes(lambda data: _bomb(20_000)),
    "named pipe": AS_FIFO,
    "folder": AS_FOLDER,
    "dangling link": AS_DANGLING_LINK,
    "link to itself": AS_LINK_LOOP,
    "endless device": AS_ZEROS,
}  # fmt: skip

VIDEOS: dict[str, Callable[[Path], object]] = {
    "empty": with_bytes(lambda data: b""),
    "cut at half": with_bytes(lambda data: data[: len(data) // 2]),
    "cut in its head": with_bytes(lambda data: data[:100]),
    "text": with_bytes(lambda data: b"no video\n" * 100),
    "damaged in the middle": with_bytes(lambda data: data[: len(data) // 2] + b"\xff" * 3000 + data[len(data) // 2 + 3000 :]),
    "a picture by its content": with_bytes(lambda data: cv2.imencode(".png", np.zeros((256, 256), np.uint8))[1].tobytes()),
    "named pipe": AS_FIFO,
    "folder": AS_FOLDER,
    "dangling link": AS_DANGLING_LINK,
    "endless device": AS_ZEROS,
}


# --- tables ------------------------------------------------------------------------------------------------------------------------------


def lines(change: Callable[[list[str]], list[str]]) -> Callable[[Path], object]:
    """An edit of a table's lines."""
    return lambda path: path.write_text("\n".join(change(path.read_text().splitlines())) + "\n")


def cell(row: int, column: int, value: str) -> Callable[[Path], object]:
    """An edit of one cell; row 0 is the header."""

    def change(rows: list[str]) -> list[str]:
        cells = rows[row].split(",")
        cells[column] = value
        return [*rows[:row], ",".join(cells), *rows[row + 1 :]]

    return lines(change)


def text(change: Callable[[str], str | bytes]) -> Callable[[Path], object]:
    """An edit of a file's text."""

    def edit(path: Path) -> None:
        made = change(path.read_text())
        path.write_bytes(made if isinstance(made, bytes) else made.encode())

    return edit


SAME_TABLE: dict[str, Callable[[Path], object]] = {  # other ways to write the same table
    "byte order mark": text(lambda t: t.encode("utf-8-sig")),
    "UTF-16": text(lambda t: t.encode("utf-16")),
    "UTF-16 without mark": text(lambda t: t.encode("utf-16-le")),
    "Windows line ends": text(lambda t: t.replace("\n", "\r\n")),
    "old Mac line ends": text(lambda t: t.replace("\n", "\r")),
    "semicolons": text(lambda t: t.replace(",", ";")),
    "semicolons and decimal commas": text(lambda t: t.replace(",", ";").replace(".", ",").replace(",png", ".png")),
    "tabs": text(lambda t: t.replace(",", "\t")),
    "quotes": text(lambda t: "\n".join(",".join(f'"{c}"' for c in row.split(",")) for row in t.splitlines())),
    "blanks around": text(lambda t: t.replace(",", " , ")),
    "blank lines": text(lambda t: t.replace("\n", "\n\n")),
    "Windows paths": text(lambda t: t.replace("f_", "C:\\data\\frames_bw\\f_")),
    "paths": text(lambda t: t.replace("f_", "frames_bw/f_")),
    "no newline at the end": text(str.rstrip),
    "open quote": lines(lambda rows: [*rows[:5], '"' + rows[5], *rows[6:]]),
}
TOLD_TABLE: dict[str, Callable[[Path], object]] = {  # read, and told; or refused
    "other case": text(lambda t: t.replace("f_", "F_")),
    "no suffixes": text(lambda t: t.replace(".png", "")),
    "half the rows": lines(lambda rows: rows[: len(rows) // 2]),
    "cut in a row": text(lambda t: t[: len(t) * 2 // 3]),
    "rows twice": lines(lambda rows: [*rows, *rows[1:]]),
    "a row contradicts another": lines(lambda rows: [*rows, rows[1].replace(rows[1].split(",")[1], "9.9")]),
    "rows without a picture": lines(lambda rows: [*rows, rows[1].replace("f_0", "f_999")]),
    "header again": lines(lambda rows: [*rows, rows[0]]),
    "ragged": lines(lambda rows: [*rows[:5], rows[5] + ",1,2", *rows[6:]]),
    "NUL bytes": text(lambda t: t.replace("f_3.png,", "f_3.png,\0")),
    "a comment": lines(lambda rows: [rows[0], "# made by hand", *rows[1:]]),
}
TOLD_CELLS: dict[str, str] = {  # as the value of one label
    "no number": "n/a",
    "not a number": "nan",
    "infinite": "inf",
    "beyond double": "1e999",
    "with a unit": "1.0 mm",
    "a formula": "=1+1",
    "a truth": "True",
    "empty": "",
    "thousands": "1'000",
}
REFUSED_TABLE: dict[str, Callable[[Path], object]] = {  # no labels to be had
    "empty": text(lambda t: ""),
    "header alone": lines(lambda rows: rows[:1]),
    "no header": lines(lambda rows: rows[1:]),
    "other columns": lines(lambda rows: ["image_name,a,b,c,d", *rows[1:]]),
    "no picture's name": lines(lambda rows: [row.replace("f_", "g_") for row in rows]),
    "binary": with_bytes(lambda data: np.random.default_rng(0).bytes(5000)),
    "JSON": text(lambda t: json.dumps({"rows": t.splitlines()})),
    "100000 columns": lines(lambda rows: [row + "," + ",".join("1" * 100_000) for row in rows]),
    "a page": text(lambda t: "<html><title>404 Not Found</title></html>"),
    "pickle": with_bytes(lambda data: pickle_bytes()),
    "one cell of 5 MB": cell(1, 1, "9" * 5_000_000),
    "named pipe": AS_FIFO,
    "folder": AS_FOLDER,
    "dangling link": AS_DANGLING_LINK,
    "endless device": AS_ZEROS,
}

# --- specifications ----------------------------------------------------------------------------------------------------------------------

SPECIFICATIONS: dict[str, bytes] = {
    "empty": b"",
    "other keys": b"a = 1\n",
    "not TOML": b"{]",
    "UTF-16": "a = 1\n".encode("utf-16"),
    "pickle": pickle_bytes(),
    "nested 100000 deep": b"a = " + b"[" * 100_000,
    "a number of 5000 digits": b"a = " + b"9" * 5000,
    "a number of 100000 hex digits": b"a = 0x" + b"f" * 100_000,
    "5 MB": b"# " + b"x" * 5_000_000,
}


def shipped(source: str, name: str, *changes: tuple[str, str]) -> Maker:
    """A shipped specification with texts replaced."""

    def make(folder: Path, good: Harmless) -> Path:
        content = (SHIPPED / source).read_text()
        for old, new in changes:
            if old not in content:
                raise AssertionError(f"{source} holds no {old!r}")
            content = content.replace(old, new, 1)
        path = folder / name
        path.write_text(content)
        return path

    return make
