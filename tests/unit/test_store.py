"""The store: files are whole, results of other code are never offered, and one run at a time works in a folder."""

import errno
import fcntl
import json
import os
import shutil
import signal
import stat
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from scenes import load_sensor
from twin.calibration.optics import _Log
from twin.errors import StoreError
from twin.mechanics.skin_fit import FittedPins
from twin.mechanics.solver import SkinSolver
from twin.optics import variant
from twin.optics.variant import ProbeResult
from twin.store import (
    ArrayFile,
    Item,
    atomic,
    code_of,
    find_arrays,
    find_json,
    fingerprint,
    inputs_digest,
    kept_arrays,
    kept_json,
    lock_folder,
    made_by,
    require_same_code,
    write_bytes,
    write_json,
    write_npz,
    write_text,
)
from twin.store.fingerprint import PACKAGES, ROOT

SOLVER = "twin/mechanics/solver.py"
KEEPERS = (  # the module of every function whose results are kept between runs
    "twin.calibration.contact.fit",
    "training.data.dataset",
    "training.estimate.estimator",
    "training.generation.make",
    "training.models.cnn.model",
    "twin.calibration.optics",
    "twin.pins.detectors.tune",
    "twin.mechanics.skin_fit",
    "twin.geometry.solid",
    "twin.optics.preview",
    "twin.optics.variant",
    "twin.optics.render",
    "twin.evaluation.degradation.shots",
    "twin.evaluation.degradation.sweep",
    "twin.objects.mesh_field",
)
SOLVED = (
    "twin.calibration.contact.fit",
    "training.generation.make",
    "twin.evaluation.degradation.shots",
    "twin.evaluation.degradation.sweep",
)


def not_source(folder: str, names: list[str]) -> list[str]:
    return [name for name in names if "." in name and not name.endswith(".py")]


@pytest.fixture
def tree(tmp_path):
    """A copy of the packages' sources, to be changed; each is a program of its own."""
    count = 0

    def copy(*changes: tuple[str, str, str]) -> Path:
        nonlocal count
        count += 1
        root = tmp_path / f"tree-{count}"
        for package in PACKAGES:
            shutil.copytree(ROOT / package, root / package, ignore=not_source)
        for file, old, new in changes:
            text = (root / file).read_text()
            assert old in text, f"{file} no longer holds {old!r}"
            (root / file).write_text(text.replace(old, new, 1))
        return root

    return copy


def prints(root: Path, names=KEEPERS) -> dict[str, str]:
    return {name: code_of(name, root=root).fingerprint for name in names}


def test_a_changed_line_of_the_solver_is_other_code_for_all_that_was_solved(tree):
    before, after = prints(ROOT), prints(tree((SOLVER, "\nclass SkinSolver", "\nNEW = 1\n\n\nclass SkinSolver")))
    assert all(before[name] != after[name] for name in SOLVED)
    carried = prints(
        tree(("twin/mechanics/newton.py", "raise NoConvergence(balance.relative)", "raise NoConvergence(2 * balance.relative)"))
    )
    assert all(before[name] != carried[name] for name in SOLVED), "the solver decides by the number that the error carries"
    untouched = (
        "twin.geometry.solid",
        "twin.mechanics.skin_fit",
        "twin.optics.render",
        "twin.objects.mesh_field",
        "twin.pins.detectors.tune",
    )
    assert all(before[name] == after[name] for name in untouched), "these compute nothing with the solver"


HARMLESS = {
    "a help text": ("twin/cli/learning.py", 'help="', 'help="Now: '),
    "a docstring": (SOLVER, '"""', '"""Otherwise said. '),
    "the explanation of a constant": ("twin/mechanics/newton.py", '"""Convergence threshold', '"""Otherwise said: convergence threshold'),
    "what an error says": (SOLVER, 'raise ContactError(f"', 'raise ContactError(f"Otherwise said: '),
    "a comment": (SOLVER, "\nclass SkinSolver", "\n# A remark.\nclass SkinSolver"),
    "formatting": (SOLVER, "import Callable, Iterator, Sequence", "import (\n    Callable,\n    Iterator,\n    Sequence,\n)"),
    "how results are kept": ("twin/store/atomic.py", "import errno", "import errno\n\nNEW = 1"),
    "a package that only passes names on": ("twin/mechanics/__init__.py", "from twin.mechanics.law", "NEW = 1\nfrom twin.mechanics.law"),
}


def test_what_changes_no_number_is_the_same_code(tree):
    root = tree(*HARMLESS.values())
    for name in KEEPERS:
        assert not code_of(name, root=root).changes(code_of(name).record()), name


def test_nothing_that_is_kept_imports_the_command_line():
    for name in KEEPERS:
        assert not [module for module in code_of(name).modules if module.startswith("twin.cli")]


def package(root: Path, **files: str) -> Path:
    """A small tree of sources: ``twin__a`` is ``twin/a.py``."""
    for name, text in files.items():
        path = root / f"{name.replace('__', '/')}.py"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return root


def test_imports_are_followed_within_functions_and_through_packages(tmp_path):
    root = package(
        tmp_path,
        twin__a="import numpy as np\ndef f():\n    try:\n        from twin.parts import tool\n    finally:\n        import twin.b as b\n",
        twin__b="from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from twin import unread\nfrom . import d\n",
        twin__d="import torch\nfrom twin import a\n",
        twin__unread="import scipy\n",
        twin__unasked="",
        twin__parts__inner="def tool(): ...\n",
    )
    (root / "twin" / "parts" / "__init__.py").write_text("from twin.parts.inner import tool\nfrom twin import unasked\n")
    (root / "twin" / "__init__.py").write_text("")
    found = code_of("twin.a", root=root)
    assert set(found.modules) == {"twin.a", "twin.b", "twin.d", "twin.parts.inner"}
    assert set(found.libraries) == {"numpy", "torch"}


@pytest.mark.parametrize("damage", ["", "[1, 2]", "{", '{"FILE": {"KEY": 7}}', '{"FILE": {"KEY": ["0", [["twin.b"]], {}]}}'])
def test_what_was_found_in_a_module_is_stored_and_never_older_than_its_source(tmp_path, monkeypatch, damage):
    def in_a_new_process() -> dict[str, str]:
        for known in (code._known_modules, code._read_module, code._code):
            known.cache_clear()
        return dict(code_of("twin.a", root=tmp_path).modules)

    code = sys.modules["twin.store.fingerprint"]
    monkeypatch.setenv("TACTIP_CACHE", str(tmp_path / "cache"))
    package(tmp_path, twin__a="from twin.b import f\n", twin__b="def f():\n    return 1\n")
    first = in_a_new_process()
    stored = tmp_path / "cache" / "modules.json"
    with monkeypatch.context() as patch:
        patch.setattr(code, "_parse", None)
        assert in_a_new_process() == first
    if damage:
        file = str(tmp_path / "twin" / "a.py")
        (key,) = json.loads(stored.read_text())[file]
        stored.write_text(damage.replace("FILE", file).replace("KEY", key))
        assert in_a_new_process() == first
    package(tmp_path, twin__b="def f():\n    return 2\n")
    second = in_a_new_process()
    assert second["twin.a"] == first["twin.a"] and second["twin.b"] != first["twin.b"]


def test_functions_methods_and_partials_stand_for_their_modules():
    wanted = fingerprint("twin.mechanics.solver")
    assert wanted == fingerprint(SkinSolver) == fingerprint(SkinSolver.press) == fingerprint(partial(SkinSolver, None))
    assert wanted != fingerprint(SkinSolver, "twin.optics.render")


def test_changes_are_named():
    code = code_of(SkinSolver)
    record = json.loads(json.dumps(code.record()))
    assert code.changes(record) == []
    record["modules"]["twin.mechanics.newton"] = "other"
    record["modules"]["twin.mechanics.old"] = record["modules"].pop("twin.mechanics.path")
    record["libraries"]["numpy"] = "1.0"
    version = code.libraries["numpy"]
    assert code.changes(record) == [
        "twin.mechanics.newton changed", "twin.mechanics.path is new", "twin.mechanics.old is gone", f"numpy {version}, was 1.0",
    ]  # fmt: skip


WRITES = {
    "bytes": lambda path: write_bytes(path, b"new"),
    "text": lambda path: write_text(path, "new"),
    "json": lambda path: write_json(path, {"new": 1}),
    "arrays": lambda path: write_npz(path, {"new": np.arange(3)}, compressed=True),
}


@pytest.mark.parametrize("kind", WRITES)
@pytest.mark.parametrize("step", ["fsync", "replace"])
@pytest.mark.parametrize("error", [KeyboardInterrupt(), OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))])
def test_a_file_that_can_not_be_written_stays_as_it_was(tmp_path, monkeypatch, kind, step, error):
    path = tmp_path / "result"
    path.write_text("old")

    def fail(*_):
        raise error

    monkeypatch.setattr(atomic.os, step, fail)
    with pytest.raises(KeyboardInterrupt if isinstance(error, KeyboardInterrupt) else StoreError):
        WRITES[kind](path)
    monkeypatch.undo()
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]
    WRITES[kind](path)
    assert path.read_bytes() != b"old" and list(tmp_path.iterdir()) == [path]


KILLED = """
import os, signal, sys
from pathlib import Path
from twin.store import atomic, write_text
atomic.os = type("Os", (), dict(vars(os), replace=lambda *_: os.kill(os.getpid(), signal.SIGKILL)))
write_text(Path(sys.argv[1]), "new")
"""


def test_killed_between_writing_and_replacing_the_old_file_is_left(tmp_path):
    path = tmp_path / "result"
    path.write_text("old")
    done = subprocess.run([sys.executable, "-c", KILLED, str(path)], env=os.environ | {"PYTHONPATH": str(ROOT)}, capture_output=True)
    assert done.returncode == -signal.SIGKILL, done.stderr
    assert path.read_text() == "old" and len(list(tmp_path.iterdir())) == 2
    atomic.remove_parts(tmp_path)
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    ("code", "remedy"),
    [(errno.ENOSPC, "free some space"), (errno.EROFS, "a folder that may be written to"), (errno.EIO, "another folder or free some space")],
)
def test_an_unwritten_file_is_named_with_reason_and_remedy(tmp_path, monkeypatch, code, remedy):
    def fail(*_):
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(atomic.os, "fsync", fail)
    with pytest.raises(StoreError) as error:
        write_text(tmp_path / "result.csv", "new")
    assert str(tmp_path / "result.csv") in str(error.value) and os.strerror(code) in str(error.value) and remedy in str(error.value)


def test_a_missing_folder_is_said_so(tmp_path):
    with pytest.raises(StoreError, match="No such file or directory.*make its folder first"):
        write_text(tmp_path / "none" / "result.csv", "new")


def test_files_may_be_read_by_whom_the_user_allows(tmp_path):
    (tmp_path / "plain").write_text("")
    assert write_text(tmp_path / "kept", "").stat().st_mode == (tmp_path / "plain").stat().st_mode


def test_inputs_are_told_apart_by_content():
    sensor = load_sensor("mg400-127")
    softer = sensor.model_copy(update={"gel": sensor.gel.model_copy(update={"poisson_ratio": sensor.gel.poisson_ratio - 0.001})})
    values = [1, "1", b"1", [1], {"a": 1}, np.array([1]), np.array([1.0]), np.array([[1]]), sensor, softer, None]
    assert len({inputs_digest(value) for value in values}) == len(values)
    assert inputs_digest({"a": 1, "b": np.arange(4)[::2]}) == inputs_digest({"b": np.array([0, 2]), "a": 1})
    with pytest.raises(TypeError, match="not object"):
        inputs_digest({"a": [object()]})


def solve() -> dict[str, np.ndarray]:
    return {"values": np.arange(3)}


def test_an_item_is_offered_to_the_same_inputs_and_code_alone(tmp_path, monkeypatch):
    item, other = Item("a/b", (solve,), [1, "x"]), Item("a/b", (solve,), [2, "x"])
    assert find_arrays(tmp_path, item) is None
    kept_arrays(tmp_path, item, solve)
    kept_json(tmp_path, item, lambda: {"n": 1})
    assert find_arrays(tmp_path, item)["values"].tolist() == [0, 1, 2] and find_json(tmp_path, item) == {"n": 1}
    assert find_arrays(tmp_path, other) is None and find_json(tmp_path, other) is None
    told = json.loads((tmp_path / f"{item.file}.json").read_text())["made_by"]
    assert told["by"].endswith("test_store.solve") and told["code"] == fingerprint(solve) and set(told) == set(made_by(solve, inputs=1))
    monkeypatch.setattr("twin.store.resume.fingerprint", lambda *makers: "of another version")
    newer = Item("a/b", (solve,), [1, "x"])
    assert find_arrays(tmp_path, newer) is None and find_json(tmp_path, newer) is None
    kept_arrays(tmp_path, newer, lambda: {"values": np.zeros(1)})
    assert find_arrays(tmp_path, item)["values"].tolist() == [0, 1, 2], "what other code made is left where it is"


def test_a_damaged_item_is_made_anew(tmp_path):
    item = Item("a", (solve,), 1)
    kept_arrays(tmp_path, item, solve)
    kept_json(tmp_path, item, lambda: 1)
    for path in tmp_path.iterdir():
        path.write_bytes(path.read_bytes()[:-3])
    assert kept_arrays(tmp_path, item, lambda: {"values": np.array([7])})["values"].tolist() == [7]
    assert kept_json(tmp_path, item, lambda: 2) == 2
    assert find_json(tmp_path, item) == 2


def test_a_whole_keeps_to_the_code_that_began_it(tmp_path):
    require_same_code(tmp_path, SkinSolver, begun=False)
    require_same_code(tmp_path, SkinSolver, begun=True)
    with pytest.raises(StoreError, match="made by another version .*is new.* more.*; give another `out`"):
        require_same_code(tmp_path, "twin.optics.render", begun=True)


HOLDER = """
import sys, time
from pathlib import Path
import fcntl
from twin.store import lock_folder

def held(folder):  # as where the folder itself can't be locked
    file = (folder / ".lock").open("w")
    fcntl.flock(file, fcntl.LOCK_EX)
    return file

with lock_folder(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(60)
"""


@pytest.mark.parametrize("lockable", [True, False])
def test_a_folder_is_held_by_one_run_and_let_go_of_when_that_is_killed(tmp_path, monkeypatch, lockable):
    if not lockable:  # as on NFS

        def flock(place, how):
            if stat.S_ISDIR(os.fstat(place).st_mode):
                raise OSError(errno.EBADF, os.strerror(errno.EBADF))
            return fcntl.flock(place, how)

        monkeypatch.setattr(atomic, "fcntl", SimpleNamespace(**vars(fcntl) | {"flock": flock}))
    run = [sys.executable, "-c", HOLDER if lockable else HOLDER.replace("lock_folder(Path", "held(Path"), str(tmp_path)]
    with subprocess.Popen(run, env=os.environ | {"PYTHONPATH": str(ROOT)}, stdout=subprocess.PIPE, text=True) as holder:
        try:
            assert holder.stdout.readline() == "held\n"
            with pytest.raises(StoreError, match="another run is at work there; wait .* or give another `out`"), lock_folder(tmp_path):
                pass
        finally:
            holder.kill()
    with lock_folder(tmp_path), pytest.raises(StoreError, match="another run"), lock_folder(tmp_path):
        pass
    with lock_folder(tmp_path):
        pass
    assert [path.name for path in tmp_path.iterdir()] == ([] if lockable else [".lock"])


def test_probes_keep_nothing_where_the_cache_is_off(tmp_path, monkeypatch):
    library, runs = tmp_path / "libLLVM.so.19.1", []
    library.touch()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("TACTIP_CACHE", "off")
    monkeypatch.setattr(variant, "_run", lambda backend, path: runs.append(path) or ProbeResult(True, "19.1", ""))
    assert variant.probe("llvm", library) == variant.probe("llvm", library) == ProbeResult(True, "19.1", "")
    assert list(tmp_path.iterdir()) == [library] and len(runs) == 1


def test_frames_of_the_same_stem_do_not_share_a_fitted_skin(tmp_path, monkeypatch):
    """The fit here gives back what it was given, so each frame shows whose skin it has."""
    sensor = load_sensor("mg400-127")

    class Fit:
        def __init__(self, spec):
            pass

        def __call__(self, pins_px):
            return FittedPins(pins_px, pins_px, pins_px, *([np.zeros(1)] * (len(FittedPins.__dataclass_fields__) - 3)))

    monkeypatch.setattr("twin.calibration.optics.SkinFit", Fit)
    image = np.zeros((4, 4), np.uint8)
    raw = [("frame.png", image, np.zeros((3, 2))), ("frame.jpg", image, np.ones((3, 2)))]
    frames = _Log(tmp_path, sensor, raw).align_frames(sensor, raw, lambda *_: None)
    assert [float(frame.state.base_mm.mean()) for frame in frames] == [0.0, 1.0]


KIND = ArrayFile("model of dreams", "twin dream", version=3, error=StoreError)


def test_arrays_and_what_is_said_of_them_are_read_again(tmp_path):
    arrays = {"one": np.arange(6.0).reshape(2, 3), "half": np.ones(4, np.float16)}
    assert KIND.write(tmp_path / "a", arrays, {"of": "a night"}) == (tmp_path / "a").stat().st_size
    with KIND.open_arrays(tmp_path / "a") as (about, found):
        assert about == {"of": "a night"} == KIND.about(tmp_path / "a")
        assert all(np.array_equal(found[key], array) and found[key].dtype == np.float32 for key, array in arrays.items())


@pytest.mark.parametrize(
    ("damage", "says"),
    [
        (lambda whole: b"", "damaged, or no model of dreams"),
        (lambda whole: b"no arrays at all" * 50, "damaged, or no model of dreams"),
        (lambda whole: whole[:-5], "damaged, or no model of dreams"),
        (lambda whole: whole[:-7] + bytes([whole[-7] ^ 0x10]) + whole[-6:], "changed since it was written"),
        (lambda whole: whole.replace(b'version\\": 3', b'version\\": 7'), "another version"),
        (None, "no such file"),
    ],
)
def test_a_file_of_arrays_that_is_not_whole_is_refused_with_the_remedy(damage, says, tmp_path):
    path = tmp_path / "a"
    if damage is not None:
        KIND.write(path, {"one": np.arange(6.0)}, {})
        whole, changed = path.read_bytes(), damage(path.read_bytes())
        assert changed != whole
        path.write_bytes(changed)
    with pytest.raises(StoreError, match=f"{path}: .*{says}.*'twin dream'"), KIND.open_arrays(path):
        pass


def test_a_kind_of_file_has_its_own_remedy(tmp_path):
    (tmp_path / "a").write_bytes(b"")
    with pytest.raises(StoreError, match="damaged.*; copy it again"), replace(KIND, again="copy it again").open_arrays(tmp_path / "a"):
        pass


def test_what_a_reader_misses_in_a_file_of_arrays_is_told_as_damage(tmp_path):
    KIND.write(tmp_path / "a", {"one": np.arange(6.0)}, {})
    with pytest.raises(StoreError, match="damaged, or no model of dreams .*two"), KIND.open_arrays(tmp_path / "a") as (_, found):
        found["two"]
