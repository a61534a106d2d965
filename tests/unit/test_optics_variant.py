"""Choosing a variant never aborts the process, whatever libraries the machine has."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from twin.errors import RenderError
from twin.optics import variant
from twin.optics.variant import ProbeResult

RENDER_TINY = """
import sys
from scenes import load_sensor
from twin.optics.render import Renderer
from twin.optics.variant import choose_variant
choice = choose_variant("mono", llvm_search={search})
image = Renderer(load_sensor("mg400-127"), choice, spp=1, window_px=(290, 250, 322, 282)).render()
assert image.shape == (32, 32) and image.max() > 0, image
print(choice.variant, "|", choice.reason)
"""


RENDER_WITH_TWO = """
import numpy as np
from scenes import load_sensor
from twin.optics.render import Renderer
first, then = ({variants})
light = [Renderer(load_sensor("mg400-127"), name, spp=16, window_px=(290, 250, 322, 282)).render().mean() for name in (first, then)]
print(abs(light[0] / light[1] - 1))
"""


def in_child(code: str, **env: str) -> str:
    """Output of ``code`` in a fresh interpreter without a display; a variable set to "" is removed."""
    environment = {k: v for k, v in (os.environ | env).items() if v != "" and k != "DISPLAY"}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, cwd=Path(__file__).parents[2])
    assert done.returncode == 0, done.stderr
    return done.stdout


def old_llvm() -> Path:
    found = [p for p in variant._usual_places() if variant._version(p).split(".")[0] in ("14", "15")]
    if not found:
        pytest.skip("no LLVM 14 or 15 on this machine to be refused")
    return found[0]


def test_nothing_heavy_at_import():
    code = "import sys, twin.optics.variant, twin.optics.render; "
    code += "print([m for m in ('mitsuba', 'drjit', 'torch') if m in sys.modules])"
    assert in_child(code).strip() == "[]"


@pytest.mark.slow
def test_without_any_llvm_the_scalar_variant_renders_and_says_what_to_install():
    out = in_child(RENDER_TINY.format(search="()"), DRJIT_LIBLLVM_PATH="", TACTIP_VARIANT="", CUDA_VISIBLE_DEVICES="-1")
    assert out.startswith("scalar_rgb") and "libllvm19" in out


@pytest.mark.slow
def test_one_process_renders_with_one_backend_after_the_other():
    """Some functions of Mitsuba stay those of the first backend; what is rendered must not use them."""
    vectorised = variant.choose_variant("mono").backend
    out = in_child(RENDER_WITH_TWO.format(variants=("scalar", vectorised)), TACTIP_VARIANT="")
    assert float(out) < 0.25  # the scalar variant approximates the window


def test_an_llvm_that_aborts_is_refused_and_another_way_is_found(tmp_path):
    """The probe, not the file name, decides about a library the user names."""
    path = old_llvm()
    code = "import json; from twin.optics.variant import find_llvm; c = find_llvm(())[1][0]; "
    code += "print(json.dumps([c.ok, c.reason]))"
    ok, reason = json.loads(in_child(code, DRJIT_LIBLLVM_PATH=str(path), TACTIP_CACHE=str(tmp_path)))
    assert not ok and "signal" in reason
    out = in_child(RENDER_TINY.format(search="None"), DRJIT_LIBLLVM_PATH=str(path), TACTIP_VARIANT="", TACTIP_CACHE=str(tmp_path))
    assert out.startswith(("llvm_ad_mono", "cuda_ad_mono", "scalar_rgb"))


def test_the_environment_overrides_and_wrong_names_are_told(monkeypatch):
    monkeypatch.setenv("TACTIP_VARIANT", "scalar")
    choice = variant.choose_variant("mono", "llvm")
    assert choice.variant == "scalar_rgb" and choice.llvm_path is None
    monkeypatch.setenv("TACTIP_VARIANT", "metal")
    with pytest.raises(RenderError, match="metal.*scalar.*llvm_ad_rgb"):
        variant.choose_variant()


def test_insisting_on_a_backend_that_does_not_work_is_an_error_not_a_fallback(monkeypatch):
    monkeypatch.delenv("TACTIP_VARIANT", raising=False)
    monkeypatch.delenv("DRJIT_LIBLLVM_PATH", raising=False)
    with pytest.raises(RenderError, match="libllvm19"):
        variant.choose_variant("color", "llvm", llvm_search=())


def test_newest_library_is_tried_first_and_old_ones_without_a_probe(tmp_path, monkeypatch):
    names = ["libLLVM-15.so.1", "libLLVM.so.19.1", "libLLVM-17.so.1"]
    paths = [tmp_path / name for name in names]
    for path in paths:
        path.touch()
    probed = []

    def refuse(backend, path):
        probed.append(path.name)
        return ProbeResult(False, "", "refused")

    monkeypatch.delenv("DRJIT_LIBLLVM_PATH", raising=False)
    monkeypatch.setattr(variant, "probe", refuse)
    found, rejected = variant.find_llvm(paths)
    assert probed == ["libLLVM.so.19.1", "libLLVM-17.so.1"]
    assert found is None and len(rejected) == 3 and "abort" in rejected[2].reason


@pytest.mark.parametrize(
    "library", ["prefix/lib/libLLVM.so.19.1", "prefix/lib/libLLVM.dylib", "prefix/Library/bin/LLVM-C.dll", "programs/LLVM/bin/LLVM-C.dll"]
)
def test_the_library_is_found_under_each_systems_name(library, tmp_path, monkeypatch):
    (tmp_path / library).parent.mkdir(parents=True)
    (tmp_path / library).touch()
    monkeypatch.setattr(variant.sys, "prefix", str(tmp_path / "prefix"))
    monkeypatch.setenv("PROGRAMFILES", str(tmp_path / "programs"))
    assert tmp_path / library in variant._usual_places()


def test_verdicts_are_remembered_until_the_library_changes(tmp_path, monkeypatch):
    library, runs = tmp_path / "libLLVM.so.19.1", []
    library.touch()
    monkeypatch.setenv("TACTIP_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(variant, "_run", lambda backend, path: runs.append(path) or ProbeResult(True, "19.1", ""))
    assert variant.probe("llvm", library) == variant.probe("llvm", library) == ProbeResult(True, "19.1", "")
    assert len(runs) == 1
    os.utime(library, ns=(1, 1))
    variant.probe("llvm", library)
    assert len(runs) == 2


def test_without_a_driver_there_is_no_gpu(monkeypatch):
    monkeypatch.setattr(variant, "_libcuda", lambda: None)
    assert variant.find_cuda() == (False, "no NVIDIA driver (libcuda) found")


def test_the_report_tells_all_a_diagnosis_needs():
    found = variant.report()
    assert {"color", "mono"} == set(found["used"]) and all(used["variant"] in found["variants"] for used in found["used"].values())
    assert (found["llvm"] or found["gpu"] or found["remedy"]) and found["gpu_reason"]
    json.dumps(found)
