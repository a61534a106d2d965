"""Tables of poses and forces: what a fit finds again on forces of the twin itself, what it leaves, and which tables are refused."""

from dataclasses import replace

import numpy as np
import pytest
from force_curves import EVERY, FORCES, LABELS, LAST, make_tables

from scenes import load_experiment, load_object, load_sensor
from scenes.rig import ForceSensorSpec, RigSpec
from twin.calibration.contact import forces as module
from twin.calibration.contact.calibrate import calibrate_to_file
from twin.calibration.contact.fit import Z90
from twin.calibration.contact.forces import FORCE_PARAMETERS, ForceSetup, find_conventions, fit_forces, noise_of, read_forces
from twin.errors import FrameError, OptionError
from twin.rig.labels import ArmLabel

ACROSS = 4  # coarse, for both sides
NOISE_N = 0.004
EXPERIMENT, PLANE = load_experiment("surface-3d-sheared"), load_object("plane")
TURN_DEG, OFFSET_N = 150.0, (0.05, -0.03, 0.02)
TRUTH = {"rig.contact_offset_mm": -0.2, "rig.friction": 0.6}
ROWS, FITS = 20, 40
SLACK_SD = 4.0  # standard deviations by which a value may be off


def setup_of(**changes):
    """A sensor on an arm whose tool point is 7 mm behind the tip."""
    rig = RigSpec(tcp_to_dome_mm=-13.0, **changes)
    parameters = tuple(p for p in FORCE_PARAMETERS if p.name in TRUTH)
    return ForceSetup(load_sensor("mg400-127").model_copy(update={"rig": rig}), EXPERIMENT, PLANE, ACROSS, parameters=parameters)


@pytest.fixture(scope="module")
def made():
    """Labels of eight tilted and sheared presses, forces of a sensor on the plate, and what a turned force sensor reads of them."""
    random = np.random.default_rng(3)
    depth, angles, moves = random.uniform(1, 2, 8), random.uniform(-20, 20, (8, 2)), random.uniform(-1.5, 1.5, (8, 2))
    labels = [ArmLabel(np.array([0, 0, d, *a, 0]), np.array([*m, 0, 0, 0, 0])) for d, a, m in zip(depth, angles, moves, strict=True)]
    true = setup_of(contact_offset_mm=TRUTH["rig.contact_offset_mm"], friction=TRUTH["rig.friction"], turn_sign=-1)
    found = true.forces([true.start], labels)[0]
    readings = setup_of(force_sensor=ForceSensorSpec(gain=(1, 1, -1))).readings(found, np.array([*OFFSET_N, TURN_DEG]))
    return labels, found, readings + random.normal(scale=NOISE_N, size=readings.shape)


@pytest.fixture(scope="module")
def found(made):
    labels, _, readings = made
    return find_conventions(setup_of(), labels, readings)


def test_the_sign_of_the_angles_and_the_axes_of_the_force_sensor_are_found_and_stated(made, found):
    setup, notes = found
    rig = setup.sensor.rig
    assert rig.turn_sign == -1 and rig.force_sensor.frame == "work" and rig.force_sensor.gain == (1, 1, -1)
    assert rig.force_sensor.turn_deg == pytest.approx(TURN_DEG, abs=8.0)
    assert notes[0].startswith("determined") and "by left-handed" in notes[0] and "with z reversed" in notes[0]
    labels, _, readings = made
    given, said = find_conventions(setup, labels, readings)
    assert given is setup and said[0].startswith("given")


def test_known_parameters_are_found_again_within_their_uncertainty(made, found):
    labels, _, readings = made
    value, sd, determined, _ = fit_forces(found[0], labels[:4], readings[:4])
    truth = [parameter.fitted_quantity(TRUTH[parameter.name]) for parameter in found[0].parameters] + [*OFFSET_N, TURN_DEG]
    assert (np.abs(value - truth) < SLACK_SD * sd).all() and (determined > 0.5).all()
    rig = found[0].sensor_of(value).rig
    assert rig.friction == pytest.approx(TRUTH["rig.friction"], rel=0.05)
    assert rig.contact_offset_mm == pytest.approx(TRUTH["rig.contact_offset_mm"], abs=0.05)
    assert rig.force_sensor.turn_deg == pytest.approx(TURN_DEG, abs=2.0)


def test_a_parameter_that_the_rows_do_not_determine_is_left_at_its_start(monkeypatch, made, found):
    """Forces that depend on the depth's zero alone say nothing about friction."""
    labels, forces, _ = made

    def by_depth(self, values, labels, step=None):
        return forces * (1 + np.array(values)[:, [p.name for p in self.parameters].index("rig.contact_offset_mm"), None, None])

    monkeypatch.setattr(ForceSetup, "forces", by_depth)
    setup = found[0]
    value, _, determined, _ = fit_forces(setup, labels, setup.readings(1.3 * forces, np.array([0, 0, 0, setup.reads.turn_deg])))
    at = {p.name: k for k, p in enumerate(setup.parameters)}
    friction, zero = at["rig.friction"], at["rig.contact_offset_mm"]
    assert value[friction] == setup.start[friction] and determined[friction] == 0
    assert value[zero] == pytest.approx(0.3, abs=0.01)


def test_columns_that_are_no_forces_are_refused(monkeypatch, made):
    labels, forces, readings = made
    monkeypatch.setattr(ForceSetup, "forces", lambda self, values, labels, step=None: np.stack([forces] * len(values)))
    other = np.column_stack([readings[:, :2], np.arange(len(readings))[::-1] % 3])
    with pytest.raises(FrameError, match="Fz: does not follow the simulated force .* by `column`"):
        find_conventions(setup_of(), labels, other)
    with pytest.raises(FrameError, match="Fx, Fy: does not follow"):
        find_conventions(setup_of(), labels, np.column_stack([readings[::-1, :2] ** 2, readings[:, 2]]))


def linear(monkeypatch, forces, parameters, slope):
    """Forces that depend linearly on the fitted quantities, so that a fit costs nothing."""

    def simulate(self, values, labels, step=None):
        there = np.array(values)[:, : len(parameters)] - self.start[: len(parameters)]
        return forces + np.einsum("vp,pmk->vmk", there, slope)

    monkeypatch.setattr(ForceSetup, "forces", simulate)


def test_ninety_percent_of_the_intervals_contain_the_true_parameters(monkeypatch):
    """Parameters sampled from their prior, forces with the noise that the fit assumes."""
    random = np.random.default_rng(5)
    setup = setup_of(force_sensor=ForceSensorSpec())
    prior = np.array([p.prior for p in (*setup.parameters, *module.CELL)])
    labels, forces = [None] * ROWS, random.normal(scale=1.0, size=(ROWS, 7))
    linear(monkeypatch, forces, setup.parameters, random.normal(scale=0.3, size=(len(setup.parameters), ROWS, 7)))
    inside = []
    for _ in range(FITS):
        truth = setup.start + prior * random.normal(size=len(prior))
        true = setup.readings(setup.forces([truth], labels)[0], truth)
        value, sd, determined, _ = fit_forces(setup, labels, true + noise_of(true) * random.normal(size=true.shape))
        inside.append((np.abs(value - truth) <= Z90 * sd)[determined >= 0.5])
    assert 0.85 <= np.concatenate(inside).mean() <= 0.95


@pytest.mark.parametrize(
    ("read", "columns", "gain", "offset_n"),
    [
        ("mirrored", {}, (1, -1, 1), (0, 0, 0)),
        ("left-handed cell", {}, (1, 1, -1), (0, 0, 0)),
        ("not tared", {}, (1, 1, 1), (3.0, -4.0, 25.0)),
    ],
)
def test_signs_and_zero_of_another_laboratorys_force_sensor_are_determined(monkeypatch, made, found, read, columns, gain, offset_n):
    labels, forces, _ = made
    reads = ForceSensorSpec(gain=gain, offset_n=offset_n, turn_deg=-40.0)
    rig = setup_of(force_sensor=reads)
    readings = rig.readings(forces, rig.start)
    other = np.roll(forces, 1, axis=0)
    monkeypatch.setattr(
        ForceSetup, "forces", lambda self, values, labels, step=None: np.stack([forces if self.sensor.rig.turn_sign < 0 else other])
    )
    setup, notes = find_conventions(setup_of(), labels, readings)
    assert setup.reads.gain == gain and setup.reads.turn_deg == pytest.approx(-40.0, abs=0.1)
    assert setup.reads.offset_n == pytest.approx(offset_n, abs=0.05)
    assert ("reversed" in notes[0], "without contact" in notes[0]) == (-1 in gain, any(offset_n))


def test_a_table_in_other_units_and_signs_is_read_by_factors_or_refused(monkeypatch, tmp_path, made):
    """A second laboratory: height in m that falls towards the plate, angles in rad, forces in mN."""
    labels, forces, readings = made
    lines = ["height m;rx rad;ry rad;dx;dy;f1;f2;f3"]
    for label, reading in zip(labels, readings, strict=True):
        cells = [-label.pose[2] / 1000, *np.radians(label.pose[3:5]), *label.move[:2] / 1000, *(1000 * reading)]
        lines.append(";".join(f"{cell:.9g}" for cell in cells))
    (tmp_path / "second.csv").write_text("\n".join(lines))
    columns = {
        "pose_3": "-1000*height m",
        "pose_4": "57.29578*rx rad",
        "pose_5": "57.29578*ry rad",
        "move_1": "1000*dx",
        "move_2": "1000*dy",
    }
    own = {"Fx": "0.001*f1", "Fy": "1e-3*f2", "Fz": "0.001*f3"}
    arm, measured, doubts = read_forces(tmp_path / "second.csv", setup_of(), columns | own)
    np.testing.assert_allclose([[*a.pose, *a.move] for a in arm], [[*a.pose, *a.move] for a in labels], atol=1e-6)
    np.testing.assert_allclose(measured, readings, atol=1e-6)
    assert not doubts
    _, _, doubts = read_forces(tmp_path / "second.csv", setup_of(), {key: name.split("*")[1] for key, name in (columns | own).items()})
    assert len(doubts) == 2 and "if they are in m" in doubts[0] and "if they are in rad" in doubts[1]
    monkeypatch.setattr(ForceSetup, "forces", lambda self, values, labels, step=None: np.stack([forces]))
    with pytest.raises(FrameError, match=r"Fz: 1e\+03 times the simulated force; .* \(Fz=0.001\*NAME for mN"):
        find_conventions(setup_of(), labels, 1000 * readings)
    monkeypatch.setattr(ForceSetup, "forces", lambda self, values, labels, step=None: np.zeros((1, len(labels), 7)))
    with pytest.raises(FrameError, match=r"pose_3: in the simulation 0 of 8 contacts .* convert it by `column` \(pose_3=-NAME"):
        find_conventions(setup_of(), labels, readings)


def test_what_remains_is_explained_by_the_label_that_causes_it():
    random = np.random.default_rng(1)
    tilt, shear = random.normal(size=(2, 40, 2))
    error = tilt @ [0.3, 0.1] + random.normal(scale=0.05, size=40)
    assert module._share_explained(error, tilt) > 0.9 and module._share_explained(error, shear) < 0.2


def table(path, rows=9, **changes):
    lines = ["name,depth,pose_Rx,shear_x,Fx,Fy,Fz"] + [f"p{k},{1 + 0.1 * k:.1f},{k},0.5,0.1,0,{0.2 * k:.1f}" for k in range(rows)]
    for number, line in changes.get("lines", {}).items():
        lines[number] = line
    path.write_text("\n".join(lines) + "\n")
    return path


def test_a_table_needs_no_frames_and_its_columns_may_be_named(tmp_path):
    labels, forces, _ = read_forces(table(tmp_path / "t.csv"), setup_of(), {"pose_3": "depth"})
    assert len(labels) == 9 and labels[3].pose.tolist() == [0, 0, 1.3, 3, 0, 0] and labels[3].move[0] == 0.5
    np.testing.assert_allclose(forces[:, 2], 0.2 * np.arange(9))


@pytest.mark.parametrize(
    ("columns", "changes", "says"),
    [
        ({}, {}, r"no column pose_3; name it by `column` \(pose_3=NAME\); the table has name, depth"),
        ({"pose_3": "deep"}, {}, "no column deep"),
        ({"pose_3": ""}, {}, "no column"),
        ({"pose_3": "depth"}, {"lines": {2: "p1,1.1,1,0.5,0.1,0,-"}}, "column Fz, row 2: no number; repair or remove the row"),
        ({"pose_3": "depth"}, {"lines": {2: "p1,1.1,1,0.5"}}, "row 2 has 4 cells, the header 7"),
        ({"pose_3": "depth"}, {"rows": 5}, "column depth has 5 rows or is constant; give 8 different presses or more"),
        ({"pose_3": "shear_x"}, {}, "column shear_x has 9 rows or is constant"),
    ],
)
def test_a_bad_table_is_refused_with_its_column_and_row(tmp_path, columns, changes, says):
    with pytest.raises(FrameError, match=says):
        read_forces(table(tmp_path / "t.csv", **changes), setup_of(), columns)


def test_an_unknown_key_of_a_column_is_refused(tmp_path):
    with pytest.raises(OptionError, match="`column` fz: no such key; known: pose_1"):
        read_forces(table(tmp_path / "t.csv"), setup_of(), {"fz": "Fz"})


def test_the_experiment_must_approach_along_z(tmp_path):
    with pytest.raises(FrameError, match="approach along z"):
        read_forces(table(tmp_path / "t.csv"), replace(setup_of(), experiment=load_experiment("surface-2d")), {"pose_3": "depth"})


@pytest.mark.usefixtures("undrawn_charts")
def test_a_calibration_writes_a_specification_with_the_conventions_and_a_page(monkeypatch, tmp_path, made):
    """One function for both: frames or a table. Here forces do not depend on parameters, so that nothing is simulated."""
    labels, forces, readings = made
    labels, forces, readings = labels * 2, np.concatenate([forces, forces]), np.concatenate([readings, readings])
    lines = ["pose_z,pose_Rx,pose_Ry,shear_x,shear_y,Fx,Fy,normal"]
    lines += [",".join(map(str, [*label.pose[2:5], *label.move[:2], *reading])) for label, reading in zip(labels, readings, strict=True)]
    (tmp_path / "t.csv").write_text("\n".join(lines))
    at = {tuple(label.pose): force for label, force in zip(labels, forces, strict=True)}
    monkeypatch.setattr(
        ForceSetup, "forces", lambda self, values, labels, step=None: np.stack([[at[tuple(label.pose)] for label in labels]] * len(values))
    )
    sensor = setup_of().sensor
    made_of = calibrate_to_file(
        tmp_path / "t.csv", sensor, EXPERIMENT, tmp_path / "fit.toml", columns={"Fz": "normal"}, labels=8, hold=["rig.friction"]
    )
    assert load_sensor(str(tmp_path / "fit.toml")).rig.force_sensor == made_of.sensor.rig.force_sensor
    assert {path.name for path in made_of.written} == {"fit.toml", "index.html"} and (tmp_path / "fit-contact" / "rows.csv").is_file()
    assert made_of.summary["parts"]["evaluated"]["rows"] == 8 and max(made_of.summary["parts"]["evaluated"]["error_n"]) < 5 * NOISE_N
    said = "\n".join(made_of.lines())
    assert "note: determined" in said and "rig.contact_offset_mm" in said and "these rows do not determine it" in said
    assert "rig.friction" not in said
    with pytest.raises(OptionError, match="no such parameter"):
        calibrate_to_file(tmp_path / "t.csv", sensor, EXPERIMENT, tmp_path / "b.toml", hold=["rig.fricton"])


def test_the_error_of_a_force_grows_with_it():
    assert noise_of(np.zeros((1, 3)))[0, 0] == module.NOISE_N and noise_of(np.array([[0.0, 0, 4]]))[0, 0] > module.NOISE_N


def test_tables_of_force_curves_have_the_mean_of_the_last_samples_and_whole_curves_of_some(tmp_path):
    """A curve that oscillates about its end value with a period of LAST samples gives this value, and the reader takes the table."""
    values, turn = np.array([[0.5, -0.25, -2.0], [0.0, 0.125, -1.0]]), np.sin(2 * np.pi * np.arange(3 * LAST) / LAST)
    (tmp_path / "ft_data").mkdir()
    lines = [",".join(("ft_data_csv", *LABELS, *FORCES))]
    for k, value in enumerate(values):
        lines.append(",".join((f"c{k}.csv", *(["3.0"] * len(LABELS)), *map(str, value + 9))))
        curve = np.column_stack([np.arange(len(turn)) / 240, value + 0.3 * turn[:, None]])
        np.savetxt(tmp_path / f"ft_data/c{k}.csv", curve, delimiter=",", header=",".join(("Time", *FORCES)), comments="")
    (tmp_path / "targets.csv").write_text("\n".join(lines))
    make_tables(tmp_path, tmp_path / "out", rows=2, whole=[2])
    ends, curves = (np.genfromtxt(tmp_path / f"out/{name}.csv", delimiter=",", names=True) for name in ("targets", "curves"))
    assert np.allclose(np.stack([ends[axis] for axis in FORCES], axis=1), values, atol=1e-4)
    assert np.allclose(ends["label_Fz"] - ends["Fz"], 9, atol=1e-4) and (ends["pose_3"] == 3).all()
    assert (curves["row"] == 2).all() and len(curves) == len(turn) // EVERY and curves["Time"][1] == pytest.approx(EVERY / 240)
