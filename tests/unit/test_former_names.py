"""Options and values of version 1 still work: with a warning, and under their present name."""

import warnings
from typing import Annotated

import pytest
import typer
from typer.testing import CliRunner

import twin
from scenes.rig import RigSpec
from training.environments.batch import Options
from training.generation.config import GenerationConfig
from twin.cli import command_line
from twin.cli.options import App, Formerly, as_function
from twin.errors import OptionError, warn_once
from twin.types import Form, Quality


@pytest.fixture(autouse=True)
def each_warning_anew():
    warn_once.cache_clear()


def work(
    elements: Annotated[int, typer.Option("--elements", help="elements", min=6), Formerly("across")] = 20,
    quality: Annotated[Quality, typer.Option(help="quality")] = "standard",
    form: Annotated[Form | None, typer.Option(help="form")] = None,
) -> None:
    """Work."""
    assert form is None or isinstance(form, Form)
    print(elements, form or quality)


def run(*arguments):
    app = App()
    app.command("work")(work)
    app.callback()(lambda: None)
    return CliRunner().invoke(app, ["work", *arguments])


@pytest.mark.parametrize(
    ("former", "present", "shown"),
    [
        (["--across", "8"], "`elements`", "8 standard"),
        (["--quality", "drawn"], "'rasterised'", "20 rasterised"),
        (["--form", "recording"], "'processed'", "20 processed"),
    ],
)
def test_a_former_name_works_with_a_warning(former, present, shown):
    with pytest.warns(RuntimeWarning, match=f"is now called {present}; the old name still works"):
        ended = run(*former)
    assert ended.exit_code == 0 and ended.output.strip() == shown
    assert former[0] not in run("--help").output or former[0] != "--across"


def test_present_names_give_no_warning_and_others_are_refused():
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        assert run("--elements", "8", "--quality", "rasterised").output.strip() == "8 rasterised"
    assert run("--quality", "nice").exit_code == 2 and run("--form", "cooked").exit_code == 2 and run("--across", "2").exit_code == 2


def test_functions_of_python_take_former_names(capsys):
    function = as_function(work, "Work.")
    with pytest.warns(RuntimeWarning, match="still works"):
        function(across=8, quality="drawn")
    assert capsys.readouterr().out.strip() == "8 rasterised"
    with pytest.warns(RuntimeWarning, match="'processed'"):
        function(form="recording")
    with pytest.raises(OptionError, match="expected rasterised or preview"):
        function(quality="nice")


def test_a_data_set_of_version_1_has_the_present_quality():
    made = {"sensor": twin.load_sensor("mg400-127"), "object": twin.load_object("plane"), "friction": 0.3}
    made |= {"experiment": twin.load_experiment("surface-2d"), "quality": "drawn", "images": "recording"}
    with pytest.warns(RuntimeWarning, match="'rasterised'|'processed'"):
        config = GenerationConfig(**made)
    assert config.quality == "rasterised" and config.images == config.form == "processed"


def test_no_former_name_is_a_present_one_of_the_same_command():
    def options(command):
        for below in getattr(command, "commands", {}).values():
            yield from options(below)
        named = [(each, option) for option in command.params for each in option.opts]
        yield [each for each, _ in named], [each for each, option in named if getattr(option, "hidden", False)]

    assert sum(len(hidden) for _, hidden in options(typer.main.get_command(command_line()))) > 10
    assert all(len(names) == len(set(names)) for names, _ in options(typer.main.get_command(command_line())))


def test_keys_and_environment_options_of_version_1_are_read():
    rig = RigSpec.model_validate({"tcp_to_dome_mm": -17.0, "tcp_aside_mm": 0.4})
    assert rig.tcp_binormal_mm == 0.4
    sensor = twin.load_sensor("mg400-331")
    pipeline = sensor.model_dump(mode="json")["pipeline"]
    assert type(sensor.pipeline).model_validate({"recording" if k == "processed" else k: v for k, v in pipeline.items()}) == sensor.pipeline
    assert Options.from_keywords({"friction_memory": False}).friction_history is False
