"""``import twin`` offers what users need: each command is a function, and wrong arguments are refused where they are given."""

import inspect
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import typer
from generators import stubs

import twin
import twin.extend
from twin.cli import command_line
from twin.cli.options import NAMED_OTHERWISE, as_options
from twin.errors import ContactError, OptionError

COMMANDS = {  # those whose function has another name
    "new_sensor": "new",
    "make_dataset": "dataset",
    "calibrate_optics": "calibrate optics",
    "calibrate_contact": "calibrate contact",
    "run_policy": "policy",
}
FUNCTIONS = [name for name, place in twin._PLACES.items() if place.startswith("twin.cli.")]
SCREEN = 40  # lines


def command_of(name):
    found = typer.main.get_command(command_line())
    for word in COMMANDS.get(name, name).split():
        found = found.commands[word]
    return found


@pytest.mark.parametrize("module", [twin, twin.extend])
def test_every_name_is_there_and_in_the_stub(module):
    assert not [name for name in module.__all__ if getattr(module, name, None) is None]
    (path,) = [path for path, stubbed in stubs.STUBS.items() if stubbed is module]
    assert path.read_text(encoding="utf-8") == stubs.stub_of(module), "run in docs/: python -m generators.stubs"


@pytest.mark.parametrize("module", [twin, twin.extend])
def test_the_help_names_every_name_on_one_screen(module):
    words = set(module.__doc__.split())
    assert set(module.__all__) <= words and len(module.__doc__.splitlines()) <= SCREEN


def test_a_name_that_is_not_there_is_an_attribute_error():
    with pytest.raises(AttributeError, match=r"'twin' has no name 'simulate'; help\(twin\)"):
        _ = twin.simulate
    assert not hasattr(twin.extend, "train")


@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_function_takes_the_options_of_its_command(name):
    shown = {option.name for option in command_of(name).params if not option.is_eager and not getattr(option, "hidden", False)}
    taken = set(inspect.signature(getattr(twin, name)).parameters) - {"progress"}
    assert taken == shown
    assert not [option.name for option in command_of(name).params if not option.is_eager and not option_is_named(option)]


def option_is_named(option):
    """Whether an option is called as its argument in Python; an argument of the command line stands without a name."""
    wanted = f"--{NAMED_OTHERWISE.get(option.name, option.name).replace('_', '-')}"
    return option.param_type_name == "argument" or wanted in option.opts


def test_python_starts_the_command_line():
    done = subprocess.run([sys.executable, "-m", "twin", "--version"], capture_output=True, text=True, check=True)
    assert done.stdout == f"twin {twin.__version__}\n"


GIVEN = {"model": "gnn", "sensor": "mg400-127", "data": "nowhere", "out": "nowhere/run"}


@pytest.mark.parametrize(
    ("wrong", "why"),
    [
        ({"seed": -1}, "`seed=-1`: expected at least 0"),
        ({"seed": "1"}, "`seed`: expected a whole number, got '1'"),
        ({"epochs": 1.5}, "`epochs`: expected a whole number"),
        ({"max_minutes": float("nan")}, "`max_minutes`: expected a number"),
        ({"kernel": "no"}, "`kernel`: expected True or False"),
        ({"form": "cooked"}, "`form`: expected raw or processed, got 'cooked'"),
        ({"target": ["pose_2", "pose_2"]}, "`target=pose_2,pose_2`: give one name"),
        ({"data": 3}, "`data`: expected a path"),
        ({"model": None}, "`model`: expected a name"),
    ],
)
def test_a_wrong_argument_is_refused_before_any_work(wrong, why, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(OptionError, match=why):
        twin.train(**GIVEN | wrong)
    assert not list(tmp_path.iterdir())


def test_an_argument_that_is_not_known_or_missing_is_a_type_error():
    with pytest.raises(TypeError, match="sed"):
        twin.train(**GIVEN, sed=1)
    with pytest.raises(TypeError, match="out"):
        twin.evaluate("run", data="nowhere")


def test_a_function_prints_nothing_reports_progress_and_takes_specifications(tmp_path, capsys):
    told = []
    made = twin.make_dataset(
        experiment=twin.load_experiment("surface-2d"),
        sensor=twin.load_sensor("mg400-127"),
        count=1,
        images="none",
        elements=8,
        workers=1,
        out=str(tmp_path / "set"),
        progress=lambda *at: told.append(at),
    )
    assert capsys.readouterr().out == "" and told and (tmp_path / "set" / "targets.csv").is_file()
    assert str(made).splitlines()[0] in repr(made) and "\n" not in repr(made)


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("give another `out`", "give another --out"),
        ("train with `kernel=False`, or `force=True`", "train with --no-kernel, or --force"),
        ("`obj` part.stl, `indent_mm=-1`", "--object part.stl, --indent-mm -1"),
        ("`FrameError` and a `", "`FrameError` and a `"),
    ],
)
def test_the_command_line_speaks_of_options_where_the_library_speaks_of_arguments(text, shown):
    assert as_options(text) == shown


@pytest.mark.parametrize(
    "wrong",
    [
        {"indent_mm": "3"},
        {"tilt_deg": 5.0},
        {"tilt_deg": (1.0, 2.0, 3.0)},
        {"twist_deg": (1.0, 2.0)},
        {"shear_mm": None},
        {"offset_mm": "12"},
    ],
)
def test_a_pose_of_the_wrong_kind_is_refused_where_it_is_made(wrong):
    (name,) = wrong
    with pytest.raises(ContactError, match=f"`{name}`: expected"):
        twin.ContactPose(**{"indent_mm": 1.0} | wrong)


def test_pairs_of_a_pose_may_be_arrays():
    assert twin.ContactPose(np.float32(2), shear_mm=np.array([1.0, 0.0])) == twin.ContactPose(2.0, shear_mm=(1.0, 0.0))


@pytest.fixture(scope="module")
def simulator():
    return twin.Simulator(twin.load_sensor("mg400-127"), quality="rasterised")


@pytest.fixture(scope="module")
def pressed(simulator):
    return simulator.press(twin.load_object("plane"), twin.ContactPose(indent_mm=1.5, shear_mm=(1.0, 0.0)), friction=0.1)


def test_no_contact_moves_nothing_and_less_is_refused(simulator):
    plane = twin.load_object("plane")
    assert np.array_equal(simulator.press(plane, twin.ContactPose(0.0)).nodes_mm, simulator.rest.nodes_mm)
    with pytest.raises(ContactError, match="would not touch"):
        simulator.press(plane, twin.ContactPose(-1.0))
    with pytest.raises(OptionError, match="`quality`: expected rasterised"):
        twin.Simulator(simulator.spec, quality="best")


def test_friction_is_that_which_is_given(pressed):
    """Coulomb's cone, at every point; with the object's own friction of 0.5 the drag is larger."""
    assert (np.linalg.norm(pressed.tangential_n, axis=1) <= 0.1 * pressed.normal_n + 1e-6).all() and pressed.slip_share > 0.5


def test_many_contacts_are_those_of_one_after_the_other(simulator, pressed):
    plane, told = twin.load_object("plane"), []
    contacts = [(plane, twin.ContactPose(indent_mm=1.5, shear_mm=(1.0, 0.0))), (plane, twin.ContactPose(0.0))]
    found = simulator.press_many(contacts, friction=0.1, progress=lambda *at: told.append(at[1:3]))
    assert np.array_equal(found[0].nodes_mm, pressed.nodes_mm) and found[1].area_mm2 == 0.0 and told[-1] == (2, 2)


@pytest.mark.parametrize("other", ["mg400-331", "ur5-331", "pad-round"])
def test_the_state_of_another_sensor_is_not_rendered(other, pressed):
    with pytest.raises(ContactError, match=f"not one of {other}"):
        twin.Simulator(twin.load_sensor(other), quality="rasterised").render(pressed)


def test_results_are_one_line_a_table_and_files(simulator, pressed, tmp_path):
    rendered = simulator.render(pressed)
    observation = twin.Pipeline(simulator.spec, twin.Form.RAW)(rendered.frame)
    for result in (pressed, rendered, observation, rendered.frame, observation.graph, simulator):
        assert "\n" not in repr(result) and len(repr(result)) < 120
    for result, rows in ((pressed, len(pressed.contact_mm)), (rendered, 127), (observation, 127)):
        assert {column.shape for column in result.to_table().values()} == {(rows,)}
        assert all(path.is_file() for path in result.save(tmp_path / "kept"))
    again = type(pressed).load(tmp_path / "kept")
    assert all(np.array_equal(value, getattr(pressed, name)) for name, value in vars(again).items())


def test_a_function_works_in_any_thread(tmp_path):
    """Signals belong to the main thread: elsewhere they are left alone."""
    with ThreadPoolExecutor(1) as pool:
        collected = pool.submit(
            twin.collect, camera="twin", arm="simulated", sensor="mg400-127", count=1, plain_light=True, out=tmp_path / "set"
        ).result()
    assert collected.lines() and (tmp_path / "set" / "targets.csv").is_file()
