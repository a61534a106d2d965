"""Figures: kept until their inputs change, printed into documents from where they are kept, and never stated otherwise there."""

import json
from functools import partial

import numpy as np
import pytest
from figures import __main__ as driver
from figures import jobs as module
from figures import tables
from figures.jobs import FIGURES, JOBS, NO_PICTURES, NO_RESIDUAL, FiguresError, Job, Value, is_kept, read, run, values
from figures.same import SAMPLES, differences

from scenes import load_sensor
from twin.errors import RenderError
from twin.optics.relief import DETAILS, without
from twin.optics.render import Renderer
from twin.store.fingerprint import CodeOf


@pytest.fixture
def counted():
    """A job that says how often it ran."""
    calls = []

    def measure(work):
        calls.append(work)
        return {"force": Value(0.5 * len(calls), "N")}

    return Job("probe.force", partial(measure), "nothing", ("mg400-127",), ("scenes",), (), 0.0), calls


def test_a_figure_is_kept_with_what_made_it(counted, tmp_path):
    job, calls = counted
    path = tmp_path / "figures.json"
    assert not is_kept(job, path)
    run(job, path, tmp_path)
    assert is_kept(job, path) and values(path) == {"probe.force.force": Value(0.5, "N")}
    entry = json.loads(path.read_text())["jobs"]["probe.force"]
    assert set(entry) == {"command", "specification", "fingerprint", "commit", "date", "machine", "minutes", "figures"}
    assert calls[0].is_dir() and [p.name for p in tmp_path.glob("*.part")] == []


def test_what_it_was_made_from_decides_whether_it_counts(counted, tmp_path, monkeypatch):
    job, _ = counted
    path = tmp_path / "figures.json"
    run(job, path, tmp_path)
    other = Job(job.name, job.measure, job.command, ("mg400-331",), job.code, (), 0.0)
    assert not is_kept(other, path), "another specification"
    monkeypatch.setattr(module, "code_behind", lambda *names, beside=(): CodeOf({"scenes": "changed"}, {}))
    assert not is_kept(job, path), "other code"
    run(job, path, tmp_path)
    assert is_kept(job, path) and values(path)["probe.force.force"].value == 1.0


def test_every_jobs_code_and_files_are_found():
    """Code that is not found would never make a figure count as old."""
    for made in JOBS.values():
        modules = module.code_behind(*made.code).modules
        assert any(name.startswith(("twin.", "training.")) for name in modules), made.name
        assert all((module.ROOT / name).exists() for name in made.shipped), made.name
    with pytest.raises(FiguresError, match="'training.nowhere'"):
        module.code_behind("training.nowhere")


def test_only_code_that_a_figure_comes_from_makes_it_old():
    pins, poses = (set(module.code_behind(name).modules) for name in ("twin.pins.batch", "training.studies.sim_to_real"))
    assert "twin.pins.finding.blobs" in pins and "twin.mechanics.solver" not in pins
    assert {"twin.mechanics.solver", "training.studies.sim_to_real.model_inversion"} <= poses
    assert not [name for name in pins | poses if name.startswith(module.UNMEASURED)]


def test_the_renderers_code_makes_no_figure_old_that_renders_nothing():
    poses = "training.studies.sim_to_real"
    assert "twin.optics.sampling" in module.code_behind(poses).modules
    left = module.code_behind(poses, beside=NO_PICTURES).modules
    assert not [name for name in left if name.startswith("twin.optics")] and "twin.mechanics.solver" in left
    assert "twin.simulator" in left, "other code of the same packages counts"


def test_a_figure_said_to_need_no_picture_is_not_measured_with_one(tmp_path):
    def rendered(work):
        return {"light": Value(float(Renderer(load_sensor("mg400-127"), spp=1).render().mean()))}

    made = Job("one.pins", rendered, "", (), ("twin.pins.batch",), (), 1.0, beside=NO_PICTURES)
    with pytest.raises(RenderError, match="said to need no picture"):
        run(made, tmp_path / "figures.json", tmp_path)
    assert not (tmp_path / "figures.json").exists()


def test_another_version_of_a_library_makes_a_figure_old(counted, monkeypatch):
    job, _ = counted
    now, before = module.code_behind("twin.pins.batch"), module.fingerprint(job)
    assert "numpy" in now.libraries
    monkeypatch.setattr(module, "code_behind", lambda *names, beside=(): CodeOf({}, {"numpy": "1.0"}))
    first = module.fingerprint(job)
    monkeypatch.setattr(module, "code_behind", lambda *names, beside=(): CodeOf({}, {"numpy": "2.0"}))
    assert len({before, first, module.fingerprint(job)}) == 3


def test_details_of_pictures_make_no_figure_old_that_renders_nothing(monkeypatch):
    spec = load_sensor("ur5-331")
    plain, other = without(spec, DETAILS), spec.model_copy(update={"camera": spec.camera.model_copy(update={"k1": spec.camera.k1 + 0.01})})

    def digest(seen, *beside):
        monkeypatch.setattr(module, "load_sensor", lambda name: seen)
        return module.specification_digest(("ur5-331",), beside)

    assert digest(spec) != digest(plain) and digest(spec, *NO_PICTURES) == digest(plain, *NO_PICTURES)
    assert digest(spec, *NO_PICTURES) != digest(other, *NO_PICTURES)
    taught = spec.model_copy(update={"response": spec.response.model_copy(update={"residual": None})})
    assert digest(spec) != digest(taught) and digest(spec, *NO_RESIDUAL) == digest(taught, *NO_RESIDUAL)


def test_another_shipped_file_makes_a_figure_old(tmp_path, monkeypatch):
    weights = tmp_path / "weights"
    weights.mkdir()
    monkeypatch.setattr(module, "ROOT", tmp_path)
    (weights / "a").write_bytes(b"1")
    first = module.shipped_digest(("weights",))
    assert module.shipped_digest(("weights/a",)) == first, "a folder counts by its files"
    (weights / "a").write_bytes(b"2")
    second = module.shipped_digest(("weights",))
    (weights / "b").write_bytes(b"")
    assert len({first, second, module.shipped_digest(("weights",))}) == 3


def test_other_jobs_figures_stay(counted, tmp_path):
    job, _ = counted
    path = tmp_path / "figures.json"
    run(job, path, tmp_path)
    run(Job("probe.other", job.measure, "", (), ("scenes",), (), 0.0), path, tmp_path)
    assert set(values(path)) == {"probe.force.force", "probe.other.force"}


def test_jobs_are_chosen_by_family_and_name():
    assert {job.family for job in driver.chosen("pins,render")} == {"pins", "render"}
    assert [job.name for job in driver.chosen("mechanics.hertz")] == ["mechanics.hertz"]
    assert len(driver.chosen("")) == len(JOBS)
    with pytest.raises(FiguresError, match="pinz.*families: .*pins"):
        driver.chosen("pinz")


def test_every_figure_of_a_table_is_some_jobs():
    strange = [name for name in tables.named_in_templates() if not any(name.startswith(f"{job}.") for job in JOBS)]
    assert not strange and tables.templates()


def test_a_document_gets_its_tables_and_numbers(monkeypatch, tmp_path):
    table = "| what | |\n| --- | --- |\n| force | {probe.run.force:.1f} N, {probe.run.side:.1f} N |\n| share | {probe.other.share:.0%} |\n"
    (tmp_path / "forces.md").write_text(table)
    monkeypatch.setattr(tables, "TEMPLATES", tmp_path)
    text = "Before\n<!-- figures: forces -->\nold\n<!-- /figures -->\nand <!-- figure: probe.run.force .2f -->9<!-- /figure --> N."
    entry = {"command": "twin probe", "date": "2026-01-02", "commit": "abc", "minutes": 1.5, "machine": "a desk"}
    jobs = {"probe.run": entry | {"figures": {"force": {"value": 1.25, "unit": "N"}}}}
    made = tables.filled(text, jobs)
    assert "| --- | --- |\n| force | 1.2 N, – N |\n\nMeasured by `twin probe`; 2026-01-02.\n" in made
    assert "-->1.25<!-- /figure --> N." in made and "old" not in made and "share" not in made
    assert tables.filled(made, jobs) == made
    assert "Nobody has measured this table with this version: `make figures ONLY=probe` does." in tables.filled(text, {})
    assert sorted(tables.used_in(text)) == ["probe.other.share", "probe.run.force", "probe.run.force", "probe.run.side"]
    assert "| probe.run | `twin probe` | 2026-01-02 | abc | 1.5 | a desk |" in tables.render("jobs", jobs)
    with pytest.raises(FiguresError, match="no table is called 'force'.*forces"):
        tables.filled(text.replace("figures: forces", "figures: force"), {})


@pytest.mark.parametrize("path", tables.documents(), ids=lambda path: path.name)
def test_documents_state_what_was_measured(path):
    """Marked tables and numbers are those of figures.json: `make tables` writes them."""
    text = path.read_text()
    assert tables.filled(text, read(FIGURES)) == text, f"{path.name} states other figures than {FIGURES.name}: run 'make tables'"


def test_states_of_the_code_that_compute_the_same_differ_in_times_alone(tmp_path):
    for side, ms in (("before", 3.0), ("after", 4.0)):
        (tmp_path / side).mkdir()
        (tmp_path / side / "pins.csv").write_text(f"image_name,x_px,ms_detect\na.png,1.5,{ms}\n")
        np.savez(tmp_path / side / "truth.npz", caps_mm=np.array([0.1, np.nan]))
    old, new = tmp_path / "before", tmp_path / "after"
    assert differences(old, new) == []
    np.savez(new / "truth.npz", caps_mm=np.array([0.1 + 1e-15, 1.0]))
    (new / "pins.csv").write_text("image_name,x_px\na.png,1.6\n")
    assert differences(old, new) == ["pins.csv x_px", "truth.npz caps_mm"]
    (new / "pins.csv").unlink()
    assert differences(old, new) == ["pins.csv: not there", "truth.npz caps_mm"]
    assert differences(tmp_path / "none", new) == ["nothing was written"]


def test_every_family_with_a_sample_has_jobs():
    assert {family for sample in SAMPLES.values() for family in sample.families} <= {job.family for job in JOBS.values()}
