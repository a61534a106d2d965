"""Specifications: shipped ones load, wrong ones say what is wrong, where, and what to do."""

import pytest

from scenes import SpecError, list_specifications, load_experiment, load_object, load_sensor
from scenes.load import SHIPPED

LOADERS = {"sensors": load_sensor, "objects": load_object, "experiments": load_experiment}


def edited(tmp_path, source, old, new):
    text = (SHIPPED / source).read_text()
    assert old in text
    path = tmp_path / "edited.toml"
    path.write_text(text.replace(old, new, 1))
    return path


def test_every_shipped_specification_loads():
    assert {"mg400-331", "mg400-127", "ur5-331"} <= set(list_specifications("sensors"))
    assert {"plane", "sphere", "cylinder", "edge", "can", "mesh-can", "square", "prism", "tin-box"} <= set(list_specifications("objects"))
    for name in list_specifications("sensors"):
        assert load_sensor(name).name == name
    for name in list_specifications("objects"):
        assert load_object(name).name == name
    for name in list_specifications("experiments"):
        assert load_object(load_experiment(name).object).name


WIDE = [name for name in list_specifications("experiments") if load_experiment(name).wide]


@pytest.mark.parametrize("name", WIDE)
def test_a_wide_experiment_holds_the_ranges_of_its_own(name):
    own, wide = load_experiment(name), load_experiment(name, wide=True)
    for label, (low, high) in own.ranges().items():
        assert wide.ranges()[label][0] <= low and high <= wide.ranges()[label][1]
    assert own.ranges() != wide.ranges() and (wide.object, wide.approach, wide.targets) == (own.object, own.approach, own.targets)
    assert load_experiment(wide) == wide


def test_the_names_of_wide_experiments_of_version_1_are_read_with_a_warning():
    with pytest.warns(RuntimeWarning, match="'surface-2d' with `wide`"):
        assert load_experiment("surface-2d-wide") == load_experiment("surface-2d", wide=True)


def test_an_experiment_without_larger_ranges_says_so():
    with pytest.raises(SpecError, match=r"drag.*\[wide\]"):
        load_experiment("drag", wide=True)


def test_the_recordings_ranges_are_those_of_their_experiment():
    experiment = load_experiment("surface-2d")
    moving = {label: ends for label, ends in experiment.ranges().items() if ends[0] < ends[1]}
    assert moving == {"pose_2": (-4, 0), "pose_6": (-20, 20), "move_1": (-5, 5), "move_6": (-5, 5)}
    assert experiment.tap == (0, 5, 0, 0, 0, 0) and experiment.axis == 1


@pytest.mark.parametrize(("sensor_name", "pins"), [("mg400-331", 331), ("ur5-331", 331), ("mg400-127", 127)])
def test_pin_counts(sensor_name, pins):
    assert load_sensor(sensor_name).pins.count == pins


@pytest.mark.parametrize(
    ("source", "old", "new", "words"),
    [
        (
            "sensors/mg400-331.toml",
            "thickness_mm = 1.0",
            "thicknes_mm = 1.0",
            ["edited.toml", "skin.thicknes_mm", "did you mean 'thickness_mm'"],
        ),
        ("sensors/mg400-331.toml", "thickness_mm = 1.0", "thickness_mm = -1.0", ["skin.thickness_mm must be greater than 0, got -1.0"]),
        ("sensors/mg400-331.toml", "distance_mm = 6.646", "distance_mm = -3.0", [".toml: camera.distance_mm must put", "got -3"]),
        ("sensors/mg400-331.toml", "thickness_mm = 1.0", "thickness_mm = 30.0", ["skin: thickness_mm must be smaller"]),
        (
            "sensors/mg400-331.toml",
            "poisson_ratio = 0.47",
            "poisson_ratio = 0.5",
            ["skin.poisson_ratio", "does not converge above 0.49999"],
        ),
        ("sensors/mg400-331.toml", "threshold_block_px = 61", "threshold_block_px = 60", ["threshold_block_px must be odd"]),
        ("sensors/mg400-331.toml", "rings = 10", "rings = nan", ["pins.rings"]),
        ("sensors/mg400-331.toml", "[skin]", "[skin", ["not readable as TOML"]),
        ("objects/sphere.toml", "radius_mm", "radius", ["shape.sphere.radius", "did you mean 'radius_mm'"]),
        ("objects/sphere.toml", '"sphere"', '"ball"', ["shape", "'ball'"]),
        ("objects/sphere.toml", "friction = 0.5", "friction = -1", ["friction", "greater than or equal to 0"]),
        ("experiments/surface-2d.toml", "pose_2 = [", "pose_7 = [", ["pose.pose_7", "did you mean 'pose_"]),
        ("experiments/surface-2d.toml", "[-4, 0]", "[0, -4]", ["pose_2", "lower end first"]),
        ("experiments/surface-2d.toml", "[-4, 0]", "[-4, 1]", ["1 mm inside the object"]),
        ("experiments/surface-2d.toml", "[-4.4, 0.3]", "[-4.4, 1.3]", ["wide: the deepest tap"]),
        ("experiments/surface-2d.toml", "[0, 5, 0", "[1, 5, 0", ["tap must go along the approach, y"]),
        ("experiments/surface-2d.toml", '["pose_2", ', '["depth", ', ["depth is no label"]),
    ],
)
def test_a_wrong_specification_names_file_key_and_remedy(tmp_path, source, old, new, words):
    path = edited(tmp_path, source, old, new)
    with pytest.raises(SpecError) as caught:
        LOADERS[source.split("/")[0]](path)
    for word in [str(path), *words]:
        assert word in str(caught.value)
    assert "\n" not in str(caught.value).strip() or "TOML" in str(caught.value)


def test_unknown_names_suggest_the_nearest():
    with pytest.raises(SpecError, match="did you mean 'mg400-331'"):
        load_sensor("mg400-313")
    with pytest.raises(SpecError, match="no such file"):
        load_object("nowhere/part.toml")
    with pytest.raises(SpecError, match="no such mesh file"):
        load_object("nowhere/part.stl")


def test_a_users_own_specification_is_found_and_wins(tmp_path, monkeypatch):
    (tmp_path / "objects").mkdir()
    (tmp_path / "objects" / "sphere.toml").write_text('description = "mine"\nshape = { kind = "sphere", radius_mm = 4.0 }\n')
    monkeypatch.setenv("TACTIP_SPECS", str(tmp_path))
    assert load_object("sphere").description == "mine"


def test_an_object_of_a_mesh_knows_its_content(tmp_path):
    mesh, spec = tmp_path / "part.stl", tmp_path / "part.toml"
    mesh.write_bytes(b"first")
    spec.write_text('description = ""\nshape = { kind = "mesh", file = "part.stl" }\n')
    before = [load_object(path) for path in (mesh, spec)]
    mesh.write_bytes(b"other")
    after = [load_object(path) for path in (mesh, spec)]
    assert before[0] != after[0] and before[1] != after[1] and before[0].shape.sha256 == before[1].shape.sha256
    spec.write_text(f'description = ""\nshape = {{ kind = "mesh", file = "part.stl", sha256 = "{before[0].shape.sha256}" }}\n')
    with pytest.raises(SpecError, match=r"part.toml: shape.sha256: .*part.stl has another content.*leave the key out"):
        load_object(spec)
    mesh.write_bytes(b"first")
    assert load_object(spec) == before[1]
