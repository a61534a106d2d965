"""The catalogue of hostile calls as data: what is given to which command, and how the call must end.

An entry's arguments name its inputs in braces: ``{out}`` is where it may write, the others are made by ``make`` or are harmless inputs
of that name. The laws that hold for every entry are in ``test_hostile``: no traceback, one line that names the thing, nothing partial,
nothing foreign touched, an end in time, bounded memory, no process left and no port open beyond this machine.
"""

from __future__ import annotations

import os
import shutil
import signal
from collections.abc import Callable
from pathlib import Path

import hostile_inputs as given
from hostile_entry import ANY, BAD_SENSOR, DONE, REFUSED, USAGE, Entry, S, U
from hostile_inputs import BAD, SENSOR, Maker, copied, edited, shipped, written
from hostile_options import OPTIONS

# --- tables: every command that reads labels ---------------------------------------------------------------------------------------------

READ_LABELS = {
    "audit": f"audit {{data}} {S} --out {{out}}",
    "train": f"train --model gnn {S} --data {{data}} --out {{out}} --epochs 1",
    "evaluate": "evaluate {run} --data {data} --out {out}",
    "study tac-vgnn": f"study tac-vgnn --data {{data}} {S} --out {{out}} --models gnn --epochs 1 --batches 8 --no-contacts",
}
SLOWLY_READ_LABELS = {  # refused tables only: with others these simulate contacts for minutes
    "validate": f"validate {S} --frames {{data}} --out {{out}} --elements 6 --max-frames 1 --friction-frames 0",
    "calibrate contact": f"calibrate contact {S} --frames {{data}} --out {{out}}/spec.toml --num-labelled 4 --elements 6 --workers 1",
    "study sim-to-real": f"study sim-to-real {S} --frames {{data}} --out {{out}} --num-labelled 12 --count 10 --epochs 1 --elements 6 "
    f"--workers 1",
}
LABELS, MOVES = "targets.csv", "move_executed.csv"


def _table(edit: Callable[[Path], object], name: str = LABELS) -> dict[str, Maker]:
    return {"data": edited("recording", name, edit)}


def _tables() -> list[Entry]:
    found = []
    for command in ("audit", "evaluate"):
        call = READ_LABELS[command]
        for what, edit in given.SAME_TABLE.items():
            found.append(Entry("tables", what, call, _table(edit), ANY, same=True))
        for what, edit in given.TOLD_TABLE.items():
            found.append(Entry("tables", what, call, _table(edit), ANY, (f"{LABELS}|pose_",)))
        for what, value in given.TOLD_CELLS.items():
            found.append(Entry("tables", f"a cell: {what}", call, _table(given.cell(3, 1, value)), ANY, ("pose_2",)))
    for command, call in (READ_LABELS | SLOWLY_READ_LABELS).items():
        for what, edit in given.REFUSED_TABLE.items():
            sample = command == "train" and what in ("header alone", "binary")
            found.append(Entry("tables", what, call, _table(edit), (REFUSED,), (f"{LABELS}|column",), sample=sample))
    for what, edit in given.SAME_TABLE.items():
        found.append(Entry("moves", what, READ_LABELS["evaluate"], _table(edit, MOVES), ANY, same=True))
    for what, edit in {
        "True and False": given.text(lambda t: t.replace(",1", ",True").replace(",0", ",False")),
        "yes and no": given.text(lambda t: t.replace(",1", ",yes").replace(",0", ",no")),
        "1.0 and 0.0": given.text(lambda t: t.replace(",1", ",1.0").replace(",0", ",0.0")),
    }.items():
        found.append(Entry("moves", what, READ_LABELS["evaluate"], _table(edit, MOVES), ANY, same=True))
    for what, edit in (given.TOLD_TABLE | given.REFUSED_TABLE).items():
        found.append(Entry("moves", what, READ_LABELS["evaluate"], _table(edit, MOVES), ANY, (MOVES,)))
    for what, edit in {
        "beyond 0 to 1": given.cell(3, 1, "7"),
        "not a number": given.cell(3, 1, "nan"),
        "empty": given.cell(3, 1, ""),
    }.items():
        found.append(Entry("moves", f"a cell: {what}", READ_LABELS["evaluate"], _table(edit, MOVES), ANY, (MOVES,)))
    few = {n: edited("recording", LABELS, given.lines(lambda rows, n=n: rows[: n + 1])) for n in (0, 1, 2, 5)}
    for n, make in few.items():
        for call in READ_LABELS.values():
            found.append(Entry("tables", f"{n} labelled frames", call, {"data": make}, ANY if n else (REFUSED,), ("frame",)))
    found.append(Entry("tables", "too few frames to tell which moves were executed", READ_LABELS["audit"], {}, ANY, ("too few",)))
    metadata = {
        "nested 100000 deep": b'{"a": ' + b"[" * 100_000,
        "not JSON": b"{",
        "a list": b"[1]",
        "a number of 5000 digits": b'{"a": ' + b"9" * 5000 + b"}",
        "binary": bytes(range(256)),
    }
    for what, content in metadata.items():
        make = edited("recording", "meta.json", lambda path, content=content: path.write_bytes(content))
        says = () if what == "a list" else ("meta.json",)
        found.append(Entry("metadata", what, f"preprocess {{data}} {S} --out {{out}}", {"data": make}, (DONE,), says))
    return found


# --- pictures and videos: every command that reads frames --------------------------------------------------------------------------------

READ_FRAMES = {  # with the exit codes that are right where one picture of four can't be used
    "preprocess": (f"preprocess {{data}} {S} --out {{out}}", (DONE,)),
    "graph": (f"graph {{data}} {S} --out {{out}}", (DONE,)),
    "predict": (f"predict {SENSOR} {{data}}", (DONE,)),
    "check": (f"check {{data}} {S}", (DONE, REFUSED, BAD_SENSOR)),
    "tune": (f"tune {S} --frames {{data}} --out {{out}}/mine.toml --max-frames 4", (DONE,)),
    "live": (f"live --model {SENSOR} --camera {{data}} --headless", (DONE,)),
    "new": ("new {data} --out {out}/mine.toml --max-frames 4", (DONE,)),
}
TAKE_ANY_SIZE = ("tune", "new")
READ_RAW = {
    "realism": f"realism {{data}} {U} --out {{out}} --max-frames 2 --quality preview --no-two-sample",
    "calibrate optics": f"calibrate optics {U} --frames {{data}} --out {{out}}/spec.toml --max-frames 1",
    "robustness": f"robustness {U} --frames {{data}} --out {{out}} --no-rendered --jobs 1 --max-frames 2",
}
READ_NAMED = ("preprocess", "graph", "predict")  # these name every frame that shows no pins
READ_ALL_PICTURES = ("preprocess", "check")  # the others read them by the same reader
SOME_PICTURES = ("cut", "text", "half the size", "NaN levels", "claims 60000 x 60000", "named pipe", "folder", "endless device")
NOT_TOLD = ("negative", "white", "black", "noise")  # readable pictures: that they show no pins is told as any frame's


def _pictures() -> list[Entry]:
    found = []
    for command, (call, right) in READ_FRAMES.items():
        for what, edit in given.PICTURES.items():
            if command not in READ_ALL_PICTURES and what not in SOME_PICTURES:
                continue
            make = {"data": edited("frames", BAD, edit)}
            says = () if command == "check" and what in NOT_TOLD else (BAD,)
            sample = command == "preprocess" and what in ("cut", "text", "half the size", "folder")
            found.append(Entry("pictures", what, call, make, right, says, sample=sample))
            alone = {"data": _alone(edit)}
            usable = what in ("animated", "two pages", *NOT_TOLD) or (what == "half the size" and command in TAKE_ANY_SIZE)
            ends = ANY if usable else (REFUSED,)
            ends = (*ends, BAD_SENSOR) if command == "check" else ends
            leaves = ("pins.npz", "summary.json") if command == "preprocess" and what in NOT_TOLD else ()
            found.append(Entry("a picture", what, call, alone, ends, (BAD,) if ends == (REFUSED,) else (), leaves))
        for what, edit in given.VIDEOS.items():
            partly = what.startswith(("damaged", "a picture"))  # some of it can be read
            ends = (DONE, REFUSED, BAD_SENSOR) if partly or what == "cut at half" else (REFUSED,)
            make = {"data": edited("video", "", edit)}
            says = ("clip", *{"cut at half": ("cut",), "damaged in the middle": ("damaged|cut",)}.get(what, ()))
            if (what, command) == ("damaged in the middle", "tune"):  # it reads four frames, and those that it reads are whole
                says = ("clip",)
            elif what == "a picture by its content" and command not in READ_NAMED:  # a video of one black frame
                says = ()
            leaves = ("pins.npz", "summary.json") if partly else ()
            found.append(Entry("videos", what, call, make, ends, says, leaves, sample=command == "predict" and what == "text"))
        for what, make in FOLDERS.items():
            found.append(Entry("folders", what, call, {"data": make}, (REFUSED,), sample=command == "check" and what == "missing"))
    for command, call in READ_RAW.items():
        for what, make in FOLDERS.items():
            found.append(Entry("folders", what, call, {"data": make}, (REFUSED,), sample=command == "realism" and what == "empty"))
        found.append(Entry("pictures", "of another sensor", call, {"data": copied("frames")}, (REFUSED,), ("640x480",)))
    names = {"a line break": "f\n3.png", "an escape sequence": "f\x1b[31m.png", "an umlaut": "f_ä.png", "a leading dash": "-f.png"}
    for what, name in names.items():
        found.append(Entry("names", what, f"preprocess {{data}} {S} --out {{out}} --overlay", _renamed(name), (DONE,)))
    ascii_only = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0", "PYTHONIOENCODING": "ascii"}
    call = f"predict {SENSOR} {{data}}"
    found.append(Entry("names", "an umlaut in an ASCII locale", call, _renamed("f_ä.png"), (DONE,), env=ascii_only))
    return found


def _renamed(name: str) -> dict[str, Maker]:
    return {"data": edited("frames", BAD, lambda path: path.rename(path.with_name(name)))}


def _alone(edit: Callable[[Path], object]) -> Maker:
    def make(folder: Path, good: given.Harmless) -> Path:
        return edited("frames", BAD, edit)(folder, good) / BAD

    return make


def _empty_folder(folder: Path, good: given.Harmless) -> Path:
    (folder / "data").mkdir()
    return folder / "data"


FOLDERS: dict[str, Maker] = {
    "missing": lambda folder, good: folder / "nowhere",
    "empty": _empty_folder,
    "a text file": written("notes.txt", "no frames"),
    "a specification": written("mine.toml", "a = 1"),
}

# --- specifications: every command that reads one ----------------------------------------------------------------------------------------

READ_SPECIFICATIONS = {
    "audit": ("audit {recording} --sensor {spec} --out {out}",),
    "check": (f"check {{frames}} {S} --pipeline {{spec}}", "check {frames} --sensor {spec}"),
    "preprocess": ("preprocess {frames} --sensor {spec} --out {out}",),
    "graph": ("graph {frames} --sensor {spec} --out {out}",),
    "tune": ("tune --sensor {spec} --frames {frames} --out {out}/mine.toml",),
    "train": ("train --model gnn --sensor {spec} --data {recording} --out {out}",),
    "render": (
        "render --sensor {spec} --object plane --indent-mm 1 --out {out}",
        f"render {S} --object {{spec}} --indent-mm 1 --out {{out}}",
    ),
    "dataset": (
        f"dataset --experiment {{spec}} {S} --count 1 --images none --out {{out}}",
        f"dataset --experiment surface-2d {S} --randomise {{spec}} --count 1 --images none --out {{out}}",
        f"dataset --experiment surface-2d {S} --object {{spec}} --count 1 --images none --out {{out}}",
    ),
    "validate": (f"validate {S} --frames {{recording}} --experiment {{spec}} --out {{out}}",),
    "realism": ("realism {raw} --sensor {spec} --out {out}",),
    "calibrate optics": ("calibrate optics --sensor {spec} --frames {raw} --out {out}/spec.toml",),
    "calibrate contact": (f"calibrate contact {S} --frames {{recording}} --object {{spec}} --out {{out}}/spec.toml",),
    "robustness": (
        "robustness --sensor {spec} --out {out}",
        f"robustness {U} --conditions {{spec}} --out {{out}}",
        f"robustness {U} --pipeline {{spec}} --frames {{raw}} --out {{out}}",
    ),
    "servo": ("servo --object {spec} --out {out}", "servo --object can --servo {spec} --out {out}"),
    "collect": (
        f"collect --camera twin --arm simulated {S} --experiment {{spec}} --count 1 --out {{out}}",
        f"collect --camera twin --arm simulated {S} --safety {{spec}} --count 1 --out {{out}}",
    ),
    "emulate camera": ("emulate camera --arm mg400:127.0.0.1 --sensor {spec} --object plane",),
    "studio": (
        "studio --sensor {spec} --seconds 1 --plain",
        f"studio {S} --object {{spec}} --seconds 1",
        "studio --state {spec} --seconds 1",
    ),
    "study servo": (f"study servo --model {SENSOR} --objects {{spec}} --out {{out}}",),
    "study objects": (f"study objects {S} --experiment {{spec}} --out {{out}}",),
    "study sim-to-real": (f"study sim-to-real {S} --frames {{recording}} --experiment {{spec}} --out {{out}}",),
    "study tac-vgnn": ("study tac-vgnn --data {recording} --sensor {spec} --out {out}",),
}

READ_ALL_SPECIFICATIONS = ("preprocess", "dataset", "servo", "check", "robustness", "collect")  # each kind of file by one of them


def _specifications() -> list[Entry]:
    found = []
    for command, calls in READ_SPECIFICATIONS.items():
        for k, call in enumerate(calls):
            for what, content in given.SPECIFICATIONS.items():
                if command not in READ_ALL_SPECIFICATIONS and what not in ("empty", "UTF-16", "nested 100000 deep"):
                    continue
                if what in ("empty", "5 MB") and "--conditions" in call:
                    continue  # a sweep file without a key means: everything as it is
                name = what if len(calls) == 1 else f"{what} ({k + 1})"
                make = {"spec": written("mine.toml", content)}
                sample = (command, what) in (("servo", "nested 100000 deep"), ("render", "UTF-16"))
                found.append(Entry("specifications", name, call, make, says=("mine.toml",), sample=sample))
    sensor = "preprocess {frames} --sensor {spec} --out {out}"
    source = f"sensors/{SENSOR}.toml"
    for what, old, new, exits, says in (
        ("a truth as a number", "thickness_mm = 1.0", "thickness_mm = true", (REFUSED,), ("skin.thickness_mm",)),
        ("a text as a number", "thickness_mm = 1.0", 'thickness_mm = "1.0"', (REFUSED,), ("skin.thickness_mm",)),
        ("a name that is a path", "description", 'name = "../../../escaped"\ndescription', (REFUSED,), ("name",)),
        ("a misspelt key", "thickness_mm", "thicknes_mm", (REFUSED,), ("did you mean",)),
        ("nan", "thickness_mm = 1.0", "thickness_mm = nan", (REFUSED,), ("skin.thickness_mm",)),
        ("1e308", "fx_px = ", "fx_px = 1e308 # ", (REFUSED,), ()),
        ("a mask of 1e9 px", "mask_radius_px = ", "mask_radius_px = 1e9 # ", ANY, ()),
    ):
        make = {"spec": shipped(source, "mine.toml", (old, new))}
        found.append(Entry("specifications", what, sensor, make, exits, says, sample=what.startswith(("a truth", "a name"))))
    found.append(Entry("specifications", "a byte order mark", sensor, {"spec": _with_mark(source)}, (DONE,)))
    press = f"render {S} --object {{spec}} --indent-mm 1 --quality preview --out {{out}}"
    for what, text in {
        "a name that is a path": 'name = "../../../escaped"\ndescription = ""\nshape = { kind = "plane" }\n',
        "a radius that is a text": 'description = ""\nshape = { kind = "sphere", radius_mm = "4" }\n',
        "a radius of 1e-300 mm": 'description = ""\nshape = { kind = "sphere", radius_mm = 1e-300 }\n',
        "a mesh that is not there": 'description = ""\nshape = { kind = "mesh", file = "nowhere.stl" }\n',
        "a mesh that is no mesh": 'description = ""\nshape = { kind = "mesh", file = "mine.toml" }\n',
        "a mesh that is an endless device": 'description = ""\nshape = { kind = "mesh", file = "/dev/zero" }\n',
    }.items():
        found.append(Entry("objects", what, press, {"spec": written("mine.toml", text)}, (REFUSED,), sample=what.endswith("a path")))
    stl = b"solid x\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\nendsolid x\n"
    for what, name, content in (
        ("empty", "part.stl", b""),
        ("text", "part.stl", b"no mesh\n" * 20),
        ("one triangle", "part.stl", stl),
        ("claims 4 thousand million triangles", "part.stl", bytes(80) + b"\xff\xff\xff\xff" + bytes(50)),
        ("not a number", "part.stl", stl.replace(b"vertex 1 0 0", b"vertex nan 0 0")),
        ("pickle", "part.ply", given.pickle_bytes()),
        (
            "claims 4 thousand million points",
            "part.ply",
            b"ply\nformat binary_little_endian 1.0\nelement vertex 4000000000\nproperty float x\nend_header\n",
        ),
        ("names a file elsewhere", "part.obj", b"mtllib /etc/passwd\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"),
    ):
        found.append(Entry("meshes", what, press, {"spec": written(name, content)}, (REFUSED,), (name,)))
    own = {"TACTIP_SPECS": "{specs}"}
    for command in ("sensors", "objects", "experiments", "randomisations"):
        for what in ("empty", "UTF-16", "nested 100000 deep"):
            content = given.SPECIFICATIONS[what]
            make = {"specs": _own_specs(command, content)}
            found.append(Entry("own specifications", what, command, make, (DONE,), ("mine", "BROKEN"), env=own, seconds=90))
    return found


def _with_mark(source: str) -> Maker:
    def make(folder: Path, good: given.Harmless) -> Path:
        path = shipped(source, "mine.toml")(folder, good)
        path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
        return path

    return make


def _own_specs(kind: str, content: bytes) -> Maker:
    def make(folder: Path, good: given.Harmless) -> Path:
        (folder / "specs" / kind).mkdir(parents=True)
        (folder / "specs" / kind / "mine.toml").write_bytes(content)
        return folder / "specs"

    return make


# --- numbers -----------------------------------------------------------------------------------------------------------------------------

NUMBERS = {  # values of an option that are refused, by call; in groups of an option and its values
    READ_LABELS["train"].replace("{data}", "{recording}").removesuffix(" --epochs 1"): {
        "--seed": "-1 1e3 99999999999999999999 x",
        "--split": "-2",
        "--epochs": "0 -1 nan",
        "--batch": "0 -1",
        "--members": "0 -1",
        "--max-minutes": "nan -1",
        "--threads": "0 -3 100000",
        "--device": "tpu cuda:99",
        "--target": "nonsense pose_2,nonsense , pose_2,pose_2",
        "--label-kind": "both",
        "--model": "transformer",
        "--form": "cooked",
    },
    "evaluate {run} --data {recording} --out {out}": {"--rows": "some", "--label-kind": "both"},
    f"preprocess {{frames}} {S} --out {{out}}": {"--form": "cooked raw"},
    f"check {{frames}} {S}": {"--max-frames": "0 -1 1e3", "--pipeline": "nowhere.toml", "--page": "/proc/nowhere/page"},
    f"graph {{frames}} {S} --out {{out}}": {"--kind": "star", "--form": "cooked raw"},
    f"tune {S} --frames {{frames}} --out {{out}}/mine.toml": {"--max-frames": "0 -1", "--method": "magic"},
    f"render {S} --object plane --out {{out}} --quality preview": {
        "--indent-mm": "nan inf 1e9 x -1",
        "--indent-mm 1 --twist-deg": "nan inf",
        "--indent-mm 1 --seed": "-1 x",
        "--indent-mm 1 --tilt-deg 0": "nan 1e9",
        "--indent-mm 1 --shear-mm 0": "nan 1e9",
        "--indent-mm 1 --offset-mm 0": "nan",
    },
    f"dataset --experiment {{experiment}} {S} --images none --elements 6 --workers 1 --out {{out}}": {
        "--count": "0 -1 2000000000 99999999999999999999",
        "--count 1 --seed": "-1",
        "--count 1 --elements": "5 7 0 66 -6",
        "--count 1 --workers": "0 -1",
        "--count 1 --scheduler": "nowhere tcp://127.0.0.1:1",
    },
    f"validate {S} --frames {{recording}} --out {{out}} --elements 6 --friction-frames 0": {
        "--max-frames": "0 -1",
        "--seed": "-1",
        "--experiment": "nowhere",
        "--friction-frames": "-1",
    },
    f"realism {{raw}} {U} --out {{out}}": {"--max-frames": "0 -1", "--quality": "best"},
    f"calibrate optics {U} --frames {{raw}}": {"--out": "{out} {out}/spec", "--out {out}/spec.toml --max-frames": "0 -1"},
    f"calibrate contact {S} --frames {{recording}} --out {{out}}/spec.toml --elements 6 --workers 1": {
        "--num-labelled": "0 3 -1",
        "--seed": "-1",
        "--hold": "nonsense",
        "--workers": "0 -1",
    },
    f"robustness {U} --frames {{raw}} --out {{out}} --no-rendered": {
        "--max-frames": "0 1 -1",
        "--jobs": "0 -1",
        "--pipeline": "magic nowhere.toml",
        "--model": "nowhere",
    },
    "servo --object can --out {out}": {
        "--steps": "0 -1 2000000000",
        "--seed": "-1",
        "--rate": "0 -1 x",
        "--stream --rate": "nan inf",
        "--model": "nowhere",
        "--camera": "nowhere http://127.0.0.1:1",
        "--arm": "nowhere mg400:127.0.0.1:1 mg400:999.1.1.1 magician:nowhere simulated:nowhere ros2:nowhere",
        "--safety": "nowhere",
        "--servo": "nowhere",
        "--at-rest": "nowhere.png",
    },
    f"collect --camera twin --arm simulated {S} --out {{out}}": {
        "--count": "0 -1 2000000000",
        "--seed": "-1",
        "--object": "nowhere",
        "--design": "best",
    },
    "convert {session} --out {out}": {"--to": "cooked", "--to mcap --sensor": "nowhere", "--video --to": "recording mcap"},
    f"live --model {SENSOR} --camera {{frames}} --headless": {
        "--also": "mcap cooked",
        "--count": "0 -1",
        "--seconds": "-1 nan",
        "--port": "-1 65536",
        "--at-rest": "nowhere.png",
        "--rerun": "nowhere",
    },
    "emulate mg400": {
        "--port-offset": "-40000 70000 x",
        "--host": "999.1.1.1 nowhere.invalid",
        "--fault": "nonsense",
        "--firmware": "x",
        "--time-scale": "0 -1 nan inf",
    },
    "emulate magician": {"--link": "{frames}/f_0.png /proc/nowhere", "--fault": "nonsense", "--time-scale": "0 -1 nan inf"},
    "emulate ros2": {"--form": "nonsense", "--namespace": "1a a//b", "--fault": "nonsense"},
    "emulate ur": {"--host": "999.1.1.1 nowhere.invalid", "--fault": "nonsense", "--time-scale": "0 -1 nan inf"},
    f"emulate camera {S} --object plane": {
        "--arm": "nowhere mg400:127.0.0.1:1",
        "--arm mg400:127.0.0.1:1 --fps": "0 nan",
        "--arm mg400:127.0.0.1:1 --port": "-1 70000",
        "--arm mg400:127.0.0.1:1 --fault": "nonsense",
    },
    "record --out {out}": {"--camera": "99 nowhere", "--camera 0 --count": "0 -1", "--camera 0 --port": "-1 70000"},
    f"study servo --model {SENSOR} --out {{out}}": {
        "--steps": "0 -1",
        "--seed": "-1",
        "--objects": "nowhere ,",
        "--servo": "nowhere",
        "--model": "nowhere",
    },
    f"study objects {S} --out {{out}} --elements 6 --workers 1": {
        "--count": "0 1 -1 2000000000",
        "--tests": "0 2000000000",
        "--train": "nowhere , plane,plane",
        "--unseen": "nowhere",
        "--epochs": "0",
        "--seed": "-1",
    },
    f"study sim-to-real {S} --frames {{recording}} --out {{out}} --elements 6 --workers 1": {
        "--num-labelled": "0 -1 1000000",
        "--count": "0 -1 2000000000",
        "--draws": "0 -1 2000000000",
        "--epochs": "0",
        "--seed": "-1",
        "--sim": "nowhere",
        "--contacts": "nowhere",
    },
    f"study tac-vgnn --data {{recording}} {S} --out {{out}} --no-contacts --models gnn": {
        "--seeds": "x -1 1.5",
        "--label-kind": "both",
        "--split": "-2",
        "--epochs": "0 -1",
        "--max-minutes": "nan",
        "--batches": "0 -1 x",
        "--threads": "-3 100000",
        "--models": "nonsense",
        "--device": "tpu",
    },
}
NUMBERS["grasp {grasp_policy} --out {out}"] = {
    "--gripper": "nonsense output:x,40,10 ros2:/topic,x mujoco:nowhere",
    "--object-mm": "0 x nan",
    "--arm": "nonsense",
}
SAMPLED_NUMBERS = ("--kind star", "--max-frames -1", "--hold nonsense", "--elements 7")


def _numbers() -> list[Entry]:
    found = []
    for call, options in NUMBERS.items():
        for option, values in options.items():
            for value in values.split():
                what = f"{option} {value}"
                named = option.removesuffix(" 0").split()[-1]
                parts = {named, named.strip("-").partition("-")[0], value, *value.split(","), *value.split(":")[1:2]}
                says = ("|".join(sorted(parts - {""})),)
                found.append(Entry("numbers", what, f"{call} {what}", {}, (REFUSED, USAGE), says, sample=what in SAMPLED_NUMBERS))
    for command in EVERY:
        found.append(
            Entry("usage", "an unknown option", f"{command} --nonsense", exit=(USAGE,), says=("--nonsense",), sample=command == "doctor")
        )
        found.append(Entry("usage", "an argument too many", f"{command} a b c d", exit=(USAGE,)))
    return found


EVERY = (
    *("audit", "calibrate contact", "calibrate optics", "check", "collect", "convert", "dataset", "demo", "doctor", "emulate camera"),
    *("emulate magician", "emulate mg400", "emulate ros2", "emulate ur"),
    *("evaluate", "experiments", "graph", "live", "new", "objects", "pack", "predict", "preprocess"),
    *(
        "randomisations",
        "realism",
        "record",
        "render",
        "robustness",
        "sensors",
        "servo",
        "studio",
        "study objects",
        "study servo",
        "study sim-to-real",
        "surrogate",
        "demonstrate",
        "learn",
        "policy",
        "grasp",
    ),
    *("study tac-vgnn", "train", "tune", "validate"),
)

# --- outputs -----------------------------------------------------------------------------------------------------------------------------

WRITE = {
    "audit": f"audit {{recording}} {S} --out {{there}}",
    "train": f"train --model gnn {S} --data {{recording}} --out {{there}} --epochs 1",
    "evaluate": "evaluate {run} --data {recording} --out {there}",
    "preprocess": f"preprocess {{frames}} {S} --out {{there}}",
    "graph": f"graph {{frames}} {S} --out {{there}}",
    "pack": "pack {run} --out {there}",
    "tune": f"tune {S} --frames {{frames}} --out {{there}}/mine.toml --max-frames 2",
    "new": "new {frames} --out {there}/mine.toml --max-frames 2",
    "dataset": f"dataset --experiment {{experiment}} {S} --count 1 --images none --elements 6 --workers 1 --out {{there}}",
    "render": f"render {S} --object plane --indent-mm 1 --quality preview --out {{there}}",
    "realism": f"realism {{raw}} {U} --out {{there}} --max-frames 1 --quality preview --no-two-sample",
    "robustness": f"robustness {U} --frames {{raw}} --out {{there}} --no-rendered --jobs 1 --max-frames 2",
    "validate": f"validate {S} --frames {{recording}} --out {{there}} --elements 6 --max-frames 1 --friction-frames 0",
    "calibrate optics": f"calibrate optics {U} --frames {{raw}} --out {{there}}/spec.toml --max-frames 1",
    "calibrate contact": f"calibrate contact {S} --frames {{recording}} --out {{there}}/spec.toml --num-labelled 4 --elements 6 "
    f"--workers 1",
    "collect": f"collect --camera twin --arm simulated {S} --count 1 --out {{there}}",
    "servo": "servo --object can --steps 1 --out {there}",
    "live": f"live --model {SENSOR} --camera {{frames}} --headless --record {{there}}",
    "convert": "convert {session} --to lerobot --out {there}",
    "demo": "demo --out {there}",
    "study servo": f"study servo --model {SENSOR} --objects can --steps 1 --out {{there}}",
    "demonstrate": f"demonstrate --task GentlePress {S} --episodes 1 --out {{there}}",
    "learn": f"learn --task SurfaceFollow {S} --minutes 0.02 --environments 2 --out {{there}}",
    "policy": "policy {policy} --object can --steps 1 --plain-light --out {there}",
    "grasp": "grasp {grasp_policy} --out {there}",
    "surrogate": f"surrogate {S} --paths 10 --workers 1 --out {{there}}/mine.safetensors",
    "study objects": f"study objects {S} --count 2 --tests 1 --elements 6 --workers 1 --epochs 1 --out {{there}}",
    "study sim-to-real": f"study sim-to-real {S} --frames {{recording}} --num-labelled 12 --count 10 --epochs 1 --workers 1 "
    f"--out {{there}}",
    "study tac-vgnn": f"study tac-vgnn --data {{recording}} {S} --out {{there}} --models gnn --epochs 1 --batches 8 --no-contacts",
}
# commands that take seconds and may be given again for the same folder
AGAIN = (
    "audit",
    "evaluate",
    "preprocess",
    "graph",
    "tune",
    "dataset",
    "render",
    "validate",
    "collect",
    "convert",
    "servo",
    "study tac-vgnn",
)


def _dangling(folder: Path, good: given.Harmless) -> Path:
    (folder / "there").symlink_to("/proc/nowhere")
    return folder / "there"


def _pipe(folder: Path, good: given.Harmless) -> Path:
    os.mkfifo(folder / "there")
    return folder / "there"


def _foreign(*names: str) -> Maker:
    def make(folder: Path, good: given.Harmless) -> Path:
        for name in names:
            (folder / "there").mkdir(exist_ok=True)
            (folder / "there" / name).write_text("written by hand\n")
        return folder / "there"

    return make


PLACES: dict[str, Maker] = {
    "a file": written("there", "written by hand"),
    "below a file": lambda folder, good: written("there", "written by hand")(folder, good) / "below",
    "a named pipe": _pipe,
    "where nothing can be made": lambda folder, good: Path("/proc/nowhere"),
    "a link to nowhere": _dangling,
    "a name too long": lambda folder, good: folder / ("n" * 300),
}
OVERWRITTEN = {  # files of the user's own in --out that a command of the same names must leave alone
    "train": ("config.json", "curves.csv", "weights.pt"),
    "evaluate": ("metrics.json", "predictions.csv"),
    "audit": ("audit.json", "index.html", "labels_corrected.csv"),
    "preprocess": ("pins.npz", "summary.json"),
    "graph": ("graph.npz", "graph.png"),
    "tune": ("mine.toml",),
    "new": ("mine.toml",),
    "dataset": ("targets.csv", "meta.json", "generation.json"),
    "pack": ("config.json", "weights.safetensors"),
    "surrogate": ("mine.safetensors",),
    "demonstrate": ("tactip.json", "README.md"),
    "learn": ("policy.safetensors", "learning.csv"),
    "policy": ("measures.json", "trajectory.csv"),
    "grasp": ("left", "lerobot"),
    "render": ("frame.png", "truth.json"),
    "realism": ("metrics.json", "index.html"),
    "robustness": ("frames.csv", "index.html"),
    "validate": ("frames.csv", "index.html"),
    "calibrate optics": ("spec.toml",),
    "calibrate contact": ("spec.toml",),
    "collect": ("targets.csv", "meta.json"),
    "servo": ("measures.json", "trajectory.csv"),
    "live": ("session.json", "steps.jsonl"),
    "convert": ("tactip.json", "README.md"),
    "demo": ("index.html",),
    "study servo": ("study.csv", "index.html"),
    "study objects": ("objects.csv", "index.html"),
    "study sim-to-real": ("study.csv", "index.html"),
    "study tac-vgnn": ("index.html", "models.csv"),
}
FULL_BYTES = 2000  # a disk that is full: no file becomes larger


def _outputs() -> list[Entry]:
    found = []
    for command, call in WRITE.items():
        for what, make in PLACES.items():
            sample = command in ("preprocess", "tune") and what == "a file"
            found.append(Entry("outputs", what, call, {"there": make}, (REFUSED,), sample=sample))
        if command == "pack":  # the harmless run is of a model that has no small copy
            continue
        full = call.replace("{there}", "{out}")
        found.append(Entry("outputs", "a full disk", full, says=("can't be written",), file_bytes=FULL_BYTES, leaves=("*",)))
    for command, names in OVERWRITTEN.items():
        found.append(Entry("outputs", "files of the user's own", WRITE[command], {"there": _foreign(*names)}))
    for command in AGAIN:
        call = WRITE[command].replace("{there}", "{out}")
        found.append(Entry("outputs", "its own, once more", call, exit=(DONE,), first=call, seconds=60, sample=command == "graph"))
    own = "tune --sensor {spec} --frames {frames} --max-frames 2 --out {spec}"
    found.append(
        Entry("outputs", "its own specification", own, {"spec": shipped(f"sensors/{SENSOR}.toml", "my.toml")}, (REFUSED,), ("my.toml",))
    )
    # without --out: nothing is begun in the folder that one happens to be in
    found.append(Entry("outputs", "none given", "robustness", exit=(REFUSED, USAGE), seconds=20))
    return found


# --- damaged runs, pins, sessions, data sets, tuned files ---------------------------------------------------------------------------------

USE_RUN = {
    "predict": "predict {data} {frames}",
    "evaluate": "evaluate {data} --data {recording} --out {out}",
    "pack": "pack {data} --out {out}",
    "live": "live --model {data} --camera {frames} --headless",
    "servo": "servo --object can --model {data} --steps 1 --out {out}",
    "robustness": f"robustness {S} --model {{data}} --frames {{frames}} --no-rendered --jobs 1 --max-frames 2 --out {{out}}",
    "study servo": "study servo --model {data} --objects can --steps 1 --out {out}",
}
WEIGHTS: dict[str, Callable[[Path], object]] = {
    "empty": given.with_bytes(lambda data: b""),
    "cut": given.with_bytes(lambda data: data[: len(data) // 2]),
    "damaged": given.with_bytes(lambda data: data[:3000] + bytes(200) + data[3200:]),
    "text": given.with_bytes(lambda data: b"no weights"),
    "a pickle": given.with_bytes(lambda data: given.pickle_bytes()),
    "a folder": given.AS_FOLDER,
    "missing": Path.unlink,
    "named pipe": given.AS_FIFO,
    "endless device": given.AS_ZEROS,
}
CONFIGS: dict[str, Callable[[Path], object]] = {
    "empty": given.with_bytes(lambda data: b""),
    "cut": given.with_bytes(lambda data: data[: len(data) // 2]),
    "binary": given.with_bytes(lambda data: bytes(range(256))),
    "missing": Path.unlink,
    "a list": given.with_json(lambda config: [1]),
    "nested 100000 deep": given.with_bytes(lambda data: b"[" * 100_000),
    "another model": given.with_json(lambda config: config.update(model="transformer")),
    "no sensor": given.with_json(lambda config: config.update(sensor=None)),
    "a sensor of other pins": given.with_json(lambda config: config["sensor"]["pins"].update(rings=3)),
    "a sensor with a wrong number": given.with_json(lambda config: config["sensor"]["skin"].update(thickness_mm="thick")),
    "another size": given.with_json(lambda config: config.update(size={"width": 10**9})),
    "no columns": given.with_json(lambda config: config.update(columns=[])),
    "columns of another number": given.with_json(lambda config: config.update(columns=["pose_2"])),
    "another form": given.with_json(lambda config: config["pipeline"].update(form="cooked")),
}


def _damaged() -> list[Entry]:
    found = []
    for command, call in USE_RUN.items():
        for name, edits in {"weights.pt": WEIGHTS, "config.json": CONFIGS}.items():
            for what, edit in edits.items():
                if command not in ("predict", "evaluate") and what not in ("empty", "a pickle", "a list", "cut"):
                    continue
                make = {"data": edited("run", name, edit)}
                sample = command == "predict" and what in ("cut", "a list")
                found.append(Entry("runs", f"{name} {what}", call, make, (REFUSED,), ("run",), sample=sample))
    for what, edit in (WEIGHTS | {"of another length": given.with_bytes(lambda data: data + b"more")}).items():
        if what != "missing":
            again = f"train --model gnn {S} --data {{recording}} --epochs 3 --out {{out}}"
            found.append(Entry("runs", f"checkpoint.pt {what}", again, {"out": edited("begun", "checkpoint.pt", edit)}, ANY, leaves=("*",)))
    sorted_table = edited("recording", "targets.csv", given.lines(lambda rows: [rows[0], *reversed(rows[1:])]))
    found.append(Entry("runs", "rows in another order", "evaluate {run} --data {data} --out {out}", {"data": sorted_table}, ANY, same=True))
    pins: dict[str, Callable[[Path], object]] = {
        "empty": given.with_bytes(lambda data: b""),
        "cut": given.with_bytes(lambda data: data[: len(data) // 2]),
        "text": given.with_bytes(lambda data: b"pins"),
        "a pickle": given.with_bytes(lambda data: given.pickle_bytes()),
        "of pickles": given.pickled_npz,
        "claims 4.8 TiB": given.vast_npz,
        "no array of valid": given.npz_with(valid=None),
        "valid as text": given.npz_with(valid=given.np.full(given.ROWS, "False")),
        "pins as text": given.npz_with(pins_px=given.np.full((given.ROWS, 127, 2), "a")),
        "pins all in one place": given.npz_with(pins_px=given.np.zeros((given.ROWS, 127, 2))),
        "infinite pins": given.npz_with(pins_px=given.np.full((given.ROWS, 127, 2), given.np.inf)),
        "named pipe": given.AS_FIFO,
        "endless device": given.AS_ZEROS,
    }  # fmt: skip
    for what, edit in pins.items():
        sample = what in ("of pickles", "cut")
        found.append(
            Entry(
                "pins",
                what,
                f"graph {{data}} {S} --out {{out}}",
                {"data": edited("pins", "", edit)},
                (REFUSED,),
                ("pins.npz",),
                sample=sample,
            )
        )
    return found + _sessions() + _collected() + _gone_on()


def _gone_on() -> list[Entry]:
    """The same command again, after what it works on has changed under the same name."""
    learn = f"train --model gnn {S} --data {{recording}} --epochs 3 --out {{out}}"
    study = f"study tac-vgnn --data {{recording}} {S} --out {{out}} --models gnn --epochs 1 --batches 8 --no-contacts"
    simulate = f"dataset --experiment {{experiment}} {S} --object {{mesh}} --images none --elements 6 --workers 1 --out {{out}} --count"
    changes: dict[str, Callable[[Path], object]] = {
        "labels": lambda path: given.text(lambda t: t.replace("-", ""))(path / LABELS),
        "frames": lambda path: shutil.copy(path / "frames_bw" / "f_9.png", path / "frames_bw" / BAD),
        "moves": lambda path: given.text(lambda t: t.replace(",0", ",1"))(path / MOVES),
    }
    found = [
        Entry("gone on", "with another mesh", f"{simulate} 2", first=f"{simulate} 1", then={"mesh": given.smaller_ball}, leaves=("*",))
    ]
    for what, change in changes.items():
        then = {"recording": change}
        begun = f"{learn} --max-minutes 0"
        found.append(Entry("gone on", f"begun with other {what}", learn, first=begun, then=then, leaves=("*",)))
        found.append(Entry("gone on", f"finished with other {what}", learn, first=learn, then=then, leaves=("*",)))
        if what != "moves":
            again = Entry("gone on", f"finished with other {what}", study, {}, ANY, first=study, then=then, fresh=True, leaves=("*",))
            found.append(again)
    return found


def _sessions() -> list[Entry]:
    calls = {"live": f"live --model {SENSOR} --replay {{data}} --headless", "convert": "convert {data} --to mcap --out {out}"}
    found = []
    for name, what, edit, exits in (
        ("steps.jsonl", "empty", given.with_bytes(lambda data: b""), (REFUSED,)),
        ("steps.jsonl", "text", given.with_bytes(lambda data: b"no steps\n"), (REFUSED,)),
        ("steps.jsonl", "cut", given.with_bytes(lambda data: data[: len(data) // 2]), (DONE,)),
        ("steps.jsonl", "numbers", given.with_bytes(lambda data: b"1\n2\n"), (REFUSED,)),
        ("steps.jsonl", "without a frame", given.with_bytes(lambda data: b'{"step": 0}\n'), (REFUSED,)),
        ("steps.jsonl", "a picture elsewhere", given.text(lambda t: t.replace("frame_000000.png", "../../../frames/f_0.png")), (REFUSED,)),
        ("steps.jsonl", "an absolute path", given.text(lambda t: t.replace("frame_000000.png", "/dev/zero")), (REFUSED,)),
        ("steps.jsonl", "another form", given.text(lambda t: t.replace('"processed"', '"cooked"')), (REFUSED,)),
        ("steps.jsonl", "missing", Path.unlink, (REFUSED,)),
        ("session.json", "empty", given.with_bytes(lambda data: b""), (REFUSED,)),
        ("session.json", "a list", given.with_json(lambda about: [1]), (REFUSED,)),
        ("session.json", "of another version", given.with_json(lambda about: about.update(version=99)), (REFUSED,)),
        ("session.json", "missing", Path.unlink, (REFUSED,)),
        ("frames/frame_000000.png", "missing", Path.unlink, (REFUSED,)),
        ("frames/frame_000000.png", "cut", given.PICTURES["cut"], (REFUSED,)),
        ("frames/frame_000000.png", "half the size", given.PICTURES["half the size"], (REFUSED,)),
    ):  # fmt: skip
        sample = what in ("a picture elsewhere", "text")
        for command, call in calls.items():
            if command == "convert" and what == "missing" and not name.endswith("png"):  # it is then a folder of frames
                continue
            found.append(
                Entry(
                    "sessions",
                    f"{name} {what}",
                    call,
                    {"data": edited("session", name, edit)},
                    exits,
                    ("session|frame_",) if exits == (REFUSED,) else (),
                    sample=sample and (command, what) != ("convert", "a picture elsewhere"),
                )
            )
    found.append(Entry("sessions", "nowhere", "convert nowhere --to lerobot --out {out}", says=("nowhere",)))
    return found


def _collected() -> list[Entry]:
    """Data sets and tuned files that were damaged."""
    again = f"dataset --experiment {{experiment}} {S} --images none --count 3 --elements 6 --workers 1 --out {{out}}"
    found = []
    for what, name, edit in (
        ("generation.json empty", "generation.json", given.with_bytes(lambda data: b"")),
        ("generation.json a list", "generation.json", given.with_json(lambda config: [1])),
        ("generation.json of another seed", "generation.json", given.with_json(lambda config: config.update(seed=5))),
        ("made_by.json empty", "made_by.json", given.with_bytes(lambda data: b"")),
        ("made_by.json a list", "made_by.json", given.with_json(lambda made: [1])),
    ):
        found.append(Entry("data sets", what, again, {"out": edited("dataset", name, edit)}, (REFUSED,), ("dataset",), ("*",)))
    for what, name, edit in (
        ("generation.json cut", "generation.json", given.with_bytes(lambda data: data[: len(data) // 2])),
        ("truth.zarr missing", "truth.zarr", given.shutil.rmtree),
        ("truth.zarr's attributes empty", "truth.zarr/zarr.json", given.with_bytes(lambda data: b"")),
        ("targets.csv cut", "targets.csv", given.with_bytes(lambda data: data[: len(data) // 2])),
    ):
        learn = f"train --model gnn {S} --data {{data}} --epochs 1 --out {{out}}"
        found.append(Entry("data sets", what, learn, {"data": edited("dataset", name, edit)}, (REFUSED,), ("dataset",)))
    for what, old, new in (
        ("a truth as a number", "threshold_block_px = ", "threshold_block_px = true # "),
        ("another method", 'method = "twin"', 'method = "magic"'),
    ):
        make = {"data": edited("tuned", "", given.text(lambda t, old=old, new=new: t.replace(old, new)))}
        found.append(Entry("tuned files", what, f"check {{frames}} {S} --pipeline {{data}}", make, (REFUSED,), ("tuned.toml",)))
    return found


# --- ends --------------------------------------------------------------------------------------------------------------------------------

LONG = {  # calls that take long: how many processes they become, and how long they are then left alone
    "train": (f"train --model vgnn {S} --data {{recording}} --out {{out}} --epochs 2000", 1, 6.0),
    "dataset": (f"dataset --experiment surface-2d {S} --count 500 --images none --workers 2 --out {{out}}", 4, 4.0),
    "robustness": (f"robustness {U} --frames {{raw}} --out {{out}} --no-rendered --jobs 2", 3, 4.0),
    "render": (f"render {U} --object edge --indent-mm 4 --quality high --out {{out}}", 1, 5.0),
    "emulate mg400": ("emulate mg400 --port-offset 11000", 1, 3.0),
    "collect": (f"collect --camera twin --arm simulated {S} --count 50 --plain-light --out {{out}}", 1, 8.0),
}


def _ends() -> list[Entry]:
    found = []
    for call, processes, after_s in LONG.values():
        for what, number, exits in (
            ("Ctrl-C", signal.SIGINT, (130, DONE, REFUSED)),
            ("SIGTERM", signal.SIGTERM, (-int(signal.SIGTERM), 143, 130, DONE, REFUSED)),
            ("SIGKILL", signal.SIGKILL, (-int(signal.SIGKILL), REFUSED)),
        ):
            end = (after_s, int(number), processes)
            found.append(Entry("ends", what, call, exit=exits, leaves=("*",), end=end, seconds=60))
    workers = f"dataset --experiment {{experiment}} {S} --count 4 --images none --elements 6 --workers 2 --out {{out}}"
    found.append(Entry("ends", "with two workers", workers, exit=(DONE,), seconds=120))
    found.append(Entry("ends", "with an unwritable home", f"preprocess {{frames}} {S} --out {{out}}", exit=(DONE,), env=NO_HOME))
    found.append(Entry("ends", "with an unwritable home", "doctor", exit=(DONE,), env=NO_HOME, seconds=90))
    return found


NO_HOME = {
    "HOME": "/proc/nowhere",
    "XDG_CONFIG_HOME": "/proc/nowhere",
    "XDG_CACHE_HOME": "/proc/nowhere",
    "TACTIP_CACHE": "/proc/nowhere/cache",
}

GRASP_POLICIES: dict[str, Maker] = {
    "missing": lambda folder, good: folder / "nowhere.zip",
    "a folder": _empty_folder,
    "text": written("policy.zip", "no policy"),
    "binary": written("policy.zip", bytes(range(256))),
    "of another program": lambda folder, good: good.policy,
    "cut": lambda folder, good: Path(written("policy.zip", good.grasp_policy.read_bytes()[:5000])(folder, good)),
}


def _policies() -> list[Entry]:
    return [Entry("policies", what, "grasp {data} --out {out}", {"data": make}, (REFUSED,)) for what, make in GRASP_POLICIES.items()]


CATALOGUE = (*_policies(), *_tables(), *_pictures(), *_specifications(), *_numbers(), *_outputs(), *_damaged(), *_ends(), *OPTIONS)
