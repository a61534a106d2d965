"""Imports point one way, and heavy or global things stay where they belong."""

import ast
import re
import shutil
import subprocess
import sys
import tomllib
from functools import cache
from importlib import metadata
from pathlib import Path

import pytest
from hostile.forked_program import LIBRARIES as FORKED_LIBRARIES

import twin
from twin import errors
from twin.store.fingerprint import LIBRARIES as FINGERPRINTED

ROOT = Path(__file__).parents[2]
OWN_ARRAYS = ("scenes/sensors/", "tests/golden/")  # tables of the specifications, and renders of ours to compare with
MAY_IMPORT = {
    "scenes": {"scenes"},
    "twin": {"scenes", "twin"},
    "training": {"scenes", "twin", "training"},
    "hardware": {"scenes", "twin", "hardware"},
}
TWIN_LAYERS = (  # of twin's packages and modules, the innermost first: each may import those before it
    "errors",
    "signals",
    "lazy",
    "types",
    "progress",
    "store",
    "workers",
    "compiled",
    "geometry",
    "objects",
    "report",
    "frames",
    "camera",
    "mechanics",
    "rig",
    "optics",
    "pins",
    "records",
    "estimate",
    "policy",
    "simulator",
    "prepare",
    "one_contact",
    "evaluation",
    "calibration",
    "demo",
    "studio",
    "cli",
    "contracts",
    "extend",
    "__main__",
)
EXTRAS = ("cluster", "models", "mujoco", "records", "rl", "ros2", "studio", "ur")  # what the extra `all` brings
BY_HAND = {"pyoidn"}  # installed by hand for the one measurement that needs it, as its head says
NAMED_OTHERWISE = {"rerun": "rerun-sdk"}  # imported under another name than it is installed by, and not installed everywhere
# The outermost layer may join everything, and nothing joins it: the command line (test_command_line), and the names that Python offers.
COMPOSITION_ROOTS = ("twin/cli/", "twin/__init__.py", "twin/__main__.py", "twin/extend.py", "twin/contracts.py")


@cache
def nodes_of(source: str) -> tuple[ast.AST, ...]:
    """Every node of a module's code, which is read once for all tests."""
    return tuple(ast.walk(ast.parse(source)))


@pytest.fixture(scope="module", autouse=True)
def forgotten():
    """The trees of all modules take a gigabyte, which the tests after these do not need."""
    yield
    nodes_of.cache_clear()


@cache
def imports_of(path: Path) -> frozenset[str]:
    found = set()
    for node in nodes_of(path.read_text(encoding="utf-8")):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module in MAY_IMPORT:  # "from twin import store" names twin.store
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found.add(node.module)
    return frozenset(found)


def sources(package: str) -> list[Path]:
    return [p for p in sorted((ROOT / package).rglob("*.py")) if not str(p.relative_to(ROOT)).startswith(COMPOSITION_ROOTS)]


@pytest.mark.parametrize("package", MAY_IMPORT)
def test_imports_point_one_way(package):
    for path in sources(package):
        ours = {name.split(".")[0] for name in imports_of(path)} & set(MAY_IMPORT)
        assert ours <= MAY_IMPORT[package], f"{path.relative_to(ROOT)} imports {ours - MAY_IMPORT[package]}"


def twin_part(name: str) -> str:
    """Package or module of twin that a dotted name belongs to; "" for a name outside twin."""
    parts = name.split(".")
    return parts[1] if parts[0] == "twin" and len(parts) > 1 else ""


def against_the_order(part: str, names: set[str], layers: tuple[str, ...]) -> set[str]:
    """Imported names that stand outside the part's own layer and those before it. Names outside twin do not count."""
    allowed = layers[: layers.index(part) + 1]
    return {name for name in names if name.split(".")[0] == "twin" and twin_part(name) not in allowed}


def test_every_part_of_twin_has_a_place_in_the_order():
    parts = {path.stem for path in (ROOT / "twin").iterdir() if path.suffix == ".py" or (path / "__init__.py").is_file()}
    assert parts - {"__init__"} == set(TWIN_LAYERS)


@pytest.mark.parametrize("part", TWIN_LAYERS)
def test_twin_imports_only_what_lies_further_in(part):
    folder = ROOT / "twin" / part
    for path in sorted(folder.rglob("*.py")) if folder.is_dir() else [folder.with_suffix(".py")]:
        names = imports_of(path) - ({"twin"} if part == "contracts" else set())  # contracts use what users use
        wrong = against_the_order(part, names, TWIN_LAYERS)
        assert not wrong, f"{path.relative_to(ROOT)} imports {sorted(wrong)}, which lies further out"


def test_the_order_refuses_an_import_that_points_outwards():
    names = {"numpy", "twin.types", "twin.pins.graph", "twin.calibration.optics", "twin"}
    assert against_the_order("pins", names, TWIN_LAYERS) == {"twin.calibration.optics", "twin"}


def test_twin_itself_imports_its_names_when_they_are_used():
    ours = {name for name in imports_of(ROOT / "twin" / "__init__.py") if name.split(".")[0] in MAY_IMPORT}
    assert ours == {"twin.lazy"}


@pytest.mark.parametrize("package", MAY_IMPORT)
def test_nothing_inside_imports_a_name_that_is_there_for_users(package):
    """``import twin`` and ``twin.extend`` join all packages, so a module that took a name from them would import upwards."""
    for path in sources(package):
        taken = {name.removeprefix("twin.") for name in imports_of(path)} & {*twin.__all__, "twin"}
        assert taken <= {"errors"}, f"{path.relative_to(ROOT)} takes {taken} from twin"


def test_imports_name_their_package_in_full():
    for package in MAY_IMPORT:
        for path in sorted((ROOT / package).rglob("*.py")):
            relative = [n for n in nodes_of(path.read_text(encoding="utf-8")) if isinstance(n, ast.ImportFrom) and n.level]
            assert not relative, f"{path.relative_to(ROOT)}: line {relative[0].lineno} imports relatively"


def test_only_the_optics_name_mitsuba():
    for package in MAY_IMPORT:
        for path in sorted((ROOT / package).rglob("*.py")):
            if path.is_relative_to(ROOT / "twin" / "optics"):
                continue
            named = {name.split(".")[0] for name in imports_of(path)} & {"mitsuba", "drjit"}
            assert not named, f"{path.relative_to(ROOT)} imports {named}"


def test_one_module_names_numba():
    """It says what happens where compiled code can't be kept, for all of them."""
    modules = [path for package in MAY_IMPORT for path in sources(package)]
    assert {path for path in modules if "numba" in {name.split(".")[0] for name in imports_of(path)}} == {ROOT / "twin" / "compiled.py"}


RENAMING = {"replace", "rename", "renames"}  # functions of os


def renames_files(source: str) -> bool:
    """Whether a module gives files their names by ``os.replace`` or ``os.rename``, however it imports them."""
    tree = nodes_of(source)
    called = {n.attr for n in tree if isinstance(n, ast.Attribute) and isinstance(n.value, ast.Name) and n.value.id == "os"}
    imported = {alias.name for n in tree if isinstance(n, ast.ImportFrom) and n.module == "os" for alias in n.names}
    return bool((called | imported) & RENAMING)


@pytest.mark.parametrize(
    ("source", "found"), [("import os\nos.replace(a, b)", True), ("from os import rename", True), ("a.replace('b', 'c')", False)]
)
def test_renames_are_recognised(source, found):
    assert renames_files(source) is found


def test_only_the_store_gives_files_their_names():
    modules = [path for package in MAY_IMPORT for path in sorted((ROOT / package).rglob("*.py"))]
    assert {path.parent for path in modules if renames_files(path.read_text(encoding="utf-8"))} == {ROOT / "twin" / "store"}


def left_to_the_locale(source: str) -> list[int]:
    """Lines on which a text file is read or written in an encoding that the user's locale chooses."""
    found = []
    for node in nodes_of(source):
        if not isinstance(node, ast.Call) or "encoding" in {keyword.arg for keyword in node.keywords}:
            continue
        name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
        texts = [each.value for each in node.args if isinstance(each, ast.Constant) and isinstance(each.value, str)]
        newline = "newline" in {keyword.arg for keyword in node.keywords}
        opened = (
            name == "open" and not any("b" in text for text in texts) and (newline or any(set(text) <= set("rwax+t") for text in texts))
        )
        whole = isinstance(node.func, ast.Attribute) and (name == "read_text" and not node.args or name == "write_text")
        found += [node.lineno] if opened or whole else []
    return found


@pytest.mark.parametrize(
    ("source", "found"),
    [
        ("path.read_text()", True),
        ("path.write_text(text)", True),
        ("path.open('w', newline='')", True),
        ("open(path, 'a')", True),
        ("write_text(path, text)", False),  # of the store
        ("path.read_text(encoding='utf-8')", False),
        ("path.open('rb')", False),
        ("arm.open()", False),
    ],
)
def test_encodings_that_are_left_to_the_locale_are_recognised(source, found):
    assert bool(left_to_the_locale(source)) is found


def test_files_are_utf_8_whatever_the_locale():
    for package in MAY_IMPORT:
        for path in sorted((ROOT / package).rglob("*.py")):
            assert not left_to_the_locale(path.read_text(encoding="utf-8")), path.relative_to(ROOT)


def test_no_module_is_a_drawer_for_everything():
    for package in MAY_IMPORT:
        for path in (ROOT / package).rglob("*.py"):
            names = {part.removesuffix(".py") for part in path.relative_to(ROOT).parts}
            assert not names & {"utils", "util", "helpers", "misc", "common"}, f"{path.relative_to(ROOT)}: name it after what it does"


@pytest.mark.parametrize(
    ("module", "heavy"),
    [
        ("scenes", ("numpy", "torch", "mitsuba", "pyvista", "cv2")),
        ("twin", ("numpy", "torch", "mitsuba", "pyvista", "numba", "cv2", "pydantic", "typer")),
        ("twin.studio.studio", ("torch", "mitsuba", "pyvista", "matplotlib", "trimesh")),  # the first picture would wait for them
    ],
)
def test_nothing_heavy_is_imported_before_it_is_needed(module, heavy):
    code = f"import sys, {module}; print([m for m in {heavy} if m in sys.modules])"
    assert subprocess.check_output([sys.executable, "-c", code], text=True).strip() == "[]"


MOST_MODULES = 15
LARGE: dict[str, int] = {}  # these may only shrink


def test_folders_stay_small_and_top_floors_empty():
    """A reader finds a module by its room."""
    folders = {path.parent for package in MAY_IMPORT for path in (ROOT / package).rglob("*.py")}
    counts = {str(folder.relative_to(ROOT)): len([path for path in folder.glob("*.py") if path.stem != "__init__"]) for folder in folders}
    assert not {name: count for name, count in counts.items() if count > LARGE.get(name, MOST_MODULES)}
    for package in ("training", "hardware"):
        assert [path.name for path in (ROOT / package).glob("*.py") if path.stem != "__init__"] == ["errors.py"]


WITHOUT_CYCLES = ("training", "hardware", "twin", "scenes")


def room_of(name: str) -> str:
    """Package and folder of a dotted name: "hardware.arms" of "hardware.arms.cri.robot"; "" for a module that lies in no folder."""
    parts = name.split(".")
    return ".".join(parts[:2]) if len(parts) > 1 and (ROOT / parts[0] / parts[1]).is_dir() else ""


def cycles_in(imports: dict[str, set[str]]) -> set[str]:
    """The nodes of a graph from which a way leads back to them."""
    reached = {name: set(to) for name, to in imports.items()}
    for middle in imports:
        for name in imports:
            if middle in reached[name]:
                reached[name] |= reached[middle]
    return {name for name, to in reached.items() if name in to}


def cycles_between_rooms(package: str) -> set[str]:
    """Folders of a package that import each other in a cycle. Imports inside functions count."""
    rooms: dict[str, set[str]] = {}
    for path in sorted((ROOT / package).rglob("*.py")):
        room = room_of(".".join(path.relative_to(ROOT).with_suffix("").parts))
        rooms.setdefault(room, set()).update(set(map(room_of, imports_of(path))) - {room})
    rooms.pop("", None)
    return cycles_in({room: to & set(rooms) for room, to in rooms.items()})


@pytest.mark.parametrize("package", WITHOUT_CYCLES)
def test_folders_import_each_other_without_cycles(package):
    assert not cycles_between_rooms(package)


def test_cycles_are_recognised():
    assert cycles_in({"a": {"b"}, "b": {"c"}, "c": {"b"}, "d": {"a"}}) == {"b", "c"}


SPEAK_OF_ARGUMENTS = ("hardware",)
OPTION = re.compile(r"(?<![\w-])--[a-z]+")


def options_in_errors(source: str) -> list[str]:
    """Options of the command line that errors of a module name. Whole commands in quotes don't count."""
    raised = [n for n in nodes_of(source) if isinstance(n, ast.Raise)]
    texts = [n.value for each in raised for n in ast.walk(each) if isinstance(n, ast.Constant) and isinstance(n.value, str)]
    return [found for text in texts for found in OPTION.findall(re.sub(r"'twin [^']*'", "", text))]


@pytest.mark.parametrize("package", SPEAK_OF_ARGUMENTS)
def test_errors_speak_of_arguments_which_the_command_line_translates(package):
    for path in sorted((ROOT / package).rglob("*.py")):
        assert not options_in_errors(path.read_text(encoding="utf-8")), path.relative_to(ROOT)


@pytest.mark.parametrize(
    ("source", "found"),
    [("raise E(f'give --out {x}')", ["--out"]), ("raise E('give `out`')", []), ("raise E(\"run 'twin new --out F'\")", [])],
)
def test_options_in_errors_are_recognised(source, found):
    assert options_in_errors(source) == found


def test_the_repository_holds_no_foreign_data():
    if shutil.which("git") is None or not (ROOT / ".git").exists():
        pytest.skip("no git, or not a git checkout")
    tracked = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True).stdout.split()
    strange = [name for name in tracked if name.endswith((".csv", ".npz", ".npy", ".pt")) and not name.startswith(OWN_ARRAYS)]
    assert not strange
    most = {name: 5_000_000 if name.startswith("training/weights/") else 2_000_000 for name in tracked}
    too_large = [name for name in tracked if (ROOT / name).is_file() and (ROOT / name).stat().st_size > most[name]]
    assert not too_large


@cache
def declared(*extras: str) -> frozenset[str]:
    """Distributions that pyproject.toml asks for, with those of some of its extras."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    asked = project["dependencies"] + [line for extra in extras for line in project["optional-dependencies"][extra]]
    return frozenset(re.split(r"[><=!\[ ]", line)[0].lower() for line in asked)


@pytest.mark.parametrize(
    ("folders", "extras"),
    [(tuple(MAY_IMPORT), ("rerun", *EXTRAS)), (("tests",), ("rerun", "dev", "browser", *EXTRAS))],
    ids=["product", "tests"],
)
def test_what_is_imported_is_asked_for(folders, extras):
    """A library that only happens to be installed is missing on the next machine."""
    of_import = metadata.packages_distributions()
    own = (
        BY_HAND
        | set(MAY_IMPORT)
        | set(sys.stdlib_module_names)
        | {path.stem for folder in ("tests", "docs") for path in (ROOT / folder).rglob("*")}
    )
    for path in (path for folder in folders for path in (ROOT / folder).rglob("*.py")):
        for name in sorted({name.split(".")[0] for name in imports_of(path)} - own):
            distributions = {name.lower() for name in of_import.get(name, [NAMED_OTHERWISE.get(name, name)])}
            assert distributions & declared(*extras), f"{path.relative_to(ROOT)} imports {name}: not in pyproject.toml"


def test_what_is_named_as_a_library_is_asked_for():
    assert set(FINGERPRINTED.values()) <= declared("models")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    for library, extra in errors.EXTRAS.items():
        assert any(library.replace("_", "-") in line.replace("_", "-") for line in project["optional-dependencies"][extra]), library
    assert project["optional-dependencies"]["all"] == [f"tactip-twin[{','.join(EXTRAS)}]"]
    known = {
        name for name, distributions in metadata.packages_distributions().items() if {d.lower() for d in distributions} & declared("models")
    }
    assert {name.split(".")[0] for name in FORKED_LIBRARIES} <= known
