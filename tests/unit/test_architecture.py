"""Imports point one way, and heavy or global things stay where they belong."""

import ast
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
OWN_ARRAYS = ("scenes/sensors/", "tests/golden/")  # tables of the specifications, and renders of ours to compare with
MAY_IMPORT = {
    "scenes": {"scenes"},
    "twin": {"scenes", "twin"},
    "training": {"scenes", "twin", "training"},
    "hardware": {"scenes", "twin", "hardware"},
}
COMPOSITION_ROOTS = ("twin/cli/",)  # the outermost layer may join everything; nothing joins it (test_command_line)


def imports_of(path: Path) -> set[str]:
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found.add(node.module)
    return found


def sources(package: str):
    return [p for p in sorted((ROOT / package).rglob("*.py")) if not str(p.relative_to(ROOT)).startswith(COMPOSITION_ROOTS)]


@pytest.mark.parametrize("package", MAY_IMPORT)
def test_imports_point_one_way(package):
    for path in sources(package):
        ours = {name.split(".")[0] for name in imports_of(path)} & set(MAY_IMPORT)
        assert ours <= MAY_IMPORT[package], f"{path.relative_to(ROOT)} imports {ours - MAY_IMPORT[package]}"


def test_only_the_optics_name_mitsuba():
    for package in MAY_IMPORT:
        for path in sorted((ROOT / package).rglob("*.py")):
            if "optics" not in path.parts:
                named = {name.split(".")[0] for name in imports_of(path)} & {"mitsuba", "drjit"}
                assert not named, f"{path.relative_to(ROOT)} imports {named}"


def test_specifications_import_nothing_heavy():
    code = "import sys, scenes; print([m for m in ('numpy', 'torch', 'mitsuba', 'pyvista', 'cv2') if m in sys.modules])"
    assert subprocess.check_output([sys.executable, "-c", code], text=True).strip() == "[]"


def test_the_repository_holds_no_foreign_data():
    if shutil.which("git") is None or not (ROOT / ".git").exists():
        pytest.skip("no git, or not a git checkout")
    tracked = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True).stdout.split()
    strange = [name for name in tracked if name.endswith((".csv", ".npz", ".npy", ".pt")) and not name.startswith(OWN_ARRAYS)]
    assert not strange
    too_large = [name for name in tracked if (ROOT / name).is_file() and (ROOT / name).stat().st_size > 2_000_000]
    assert not too_large
