"""The command line is options and one call: what it does can be done from Python, and nothing else depends on it."""

import ast
import inspect
import io
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from importlib import import_module, metadata
from pathlib import Path

import pytest
import typer
from command import run_twin
from typer.testing import CliRunner

import twin
from hardware.errors import DeviceNotConnectedError
from scenes import load_experiment, load_object, load_randomisation, load_sensor
from scenes.base import SpecError
from scenes.load import load_servo
from twin.cli import command_line, main
from twin.cli.options import INSIDE

ROOT = Path(__file__).parents[2]
CLI = ROOT / "twin" / "cli"
OURS = ("scenes", "twin", "training", "hardware")
FEW = 8  # statements of a command beside its imports: specifications loaded, a plan, a call, what is printed, an exit code
ENTRY = {"main", "command_line"}  # what others may take from the command line
ROOTS = {ROOT / "twin" / "__init__.py", ROOT / "twin" / "__main__.py"}  # they offer its functions to Python, and start it
NO_LOGIC = (ast.For, ast.While, ast.AsyncFor, ast.Try, ast.Lambda, ast.FunctionDef, ast.ClassDef, ast.ListComp, ast.DictComp, ast.SetComp)
NOT_COMMANDS = {
    "twin alone",
    "twin and labelled frames",
    "twin read",
    "model inversion, no label",
    "model inversion, evenly chosen frames",
    "twin of ",
}
HEAVY = {"numpy", "scipy", "torch", "cv2", "mitsuba", "drjit", "numba", "pyvista", "matplotlib"}


def _registers(mark: ast.expr) -> bool:
    return isinstance(mark, ast.Call) and isinstance(mark.func, ast.Attribute) and mark.func.attr == "command"


def _is_ours(module: str) -> bool:
    return module.split(".")[0] in OURS and not module.startswith("twin.cli")


COMMANDS = [
    pytest.param(node, id=f"{path.stem}.{node.name}")
    for path in sorted(CLI.glob("*.py"))
    for node in ast.parse(path.read_text()).body
    if isinstance(node, ast.FunctionDef) and any(_registers(mark) for mark in node.decorator_list)
]


def imported(node: ast.AST) -> list[tuple[str, str]]:
    """Module and name of everything that is imported below a node."""
    found = []
    for part in ast.walk(node):
        if isinstance(part, ast.Import):
            found += [(alias.name, "") for alias in part.names]
        elif isinstance(part, ast.ImportFrom) and part.module:
            found += [(part.module, alias.name) for alias in part.names]
    return found


# by command, what its module imports at its top
IMPORTS = {
    node.name: [pair for top in module.body if isinstance(top, ast.ImportFrom) for pair in imported(top)]
    for module in (ast.parse(path.read_text()) for path in sorted(CLI.glob("*.py")))
    for node in module.body
    if isinstance(node, ast.FunctionDef)
}


def test_every_command_is_looked_at():
    app = command_line()
    groups = [group.typer_instance for group in app.registered_groups]
    assert len(COMMANDS) == sum(len(each.registered_commands) for each in (app, *groups)) > 30


@pytest.mark.parametrize("command", COMMANDS)
def test_a_command_is_options_and_one_call(command):
    """Logic in a command can't be had from Python."""
    inside = [part for statement in command.body for part in ast.walk(statement)]
    assert not [type(part).__name__ for part in inside if isinstance(part, NO_LOGIC)]
    plain = (ast.Import, ast.ImportFrom)
    docstring = [command.body[0]] if ast.get_docstring(command) else []
    statements = [part for part in inside if isinstance(part, ast.stmt) and not isinstance(part, plain) and part not in docstring]
    assert len(statements) <= FEW, f"{len(statements)} statements; move what it does to a function with a plan and a result"


@pytest.mark.parametrize("command", COMMANDS)
def test_a_function_of_the_packages_is_behind_every_command(command):
    """What a command imports, or what its module imports at its top, is also called in its body."""
    called = {part.id for call in ast.walk(command) if isinstance(call, ast.Call) for part in ast.walk(call) if isinstance(part, ast.Name)}
    ours = {name for source, name in [*imported(command), *IMPORTS[command.name]] if _is_ours(source)}
    assert {name for name in called & ours if not name.startswith("load_")}


@pytest.mark.parametrize("command", COMMANDS)
def test_every_option_reaches_the_function_behind_the_command(command):
    """``call`` leaves out what a function does not take: an option is either used by its name, or an argument of what is called."""
    used = {part.id for statement in command.body for part in ast.walk(statement) if isinstance(part, ast.Name)}
    found = dict(_everything(command))
    calls = [part for part in ast.walk(command) if isinstance(part, ast.Call) and ast.unparse(part.func) == "call"]
    for each in calls:
        name, *attribute = ast.unparse(each.args[0]).split(".")
        takes = inspect.signature(getattr(found[name], attribute[0]) if attribute else found[name]).parameters
        used |= {*takes, *(option for option, inside in INSIDE.items() if inside in takes)}
        given = {keyword.arg for keyword in each.keywords if keyword.arg}
        assert given <= set(takes)
        used |= {"pipeline", "residual"} if "sensor" in set(takes) - given else set()  # ``call`` loads the sensor with them
    options = [*command.args.args, *command.args.kwonlyargs] if calls else []
    assert {option.arg for option in options if "is_eager" not in ast.unparse(option.annotation or option)} <= used


def _everything(command):
    """What a command imports, by name."""
    for source, name in imported(command):
        module = import_module(source)
        yield name, getattr(module, name, None) or import_module(f"{source}.{name}")


@pytest.mark.parametrize("command", COMMANDS)
def test_a_command_that_writes_overwrites_nothing_foreign_unless_it_is_forced(command):
    """What a command with ``--out`` calls opens its output by the store before it works. ``App.command`` adds ``--force``.

    The folder of ``--maps`` is opened by what writes each frame's maps (``Predictions``).
    """
    names = {argument.arg for argument in command.args.args}
    assert "force" not in names and "with overwriting" not in ast.unparse(command)
    if "out" in names:
        behind = [_behind(source, name) for source, name in imported(command) if _is_ours(source)]
        opens = ("@writes", " generate(", " new_sensor(")  # the second and third open what they write themselves
        assert [each for each in behind if inspect.isfunction(each) and any(word in inspect.getsource(each) for word in opens)]


def test_every_command_that_writes_can_be_forced():
    for words, command in TREE.items():
        names = {option.name for option in command.params}
        assert ("force" in names) == bool(names & {"out", "maps"}), words


def _behind(source, name):
    """What a command imports; of a study its function ``run``."""
    found = getattr(import_module(source), name, None) or import_module(f"{source}.{name}")
    return found.run if inspect.ismodule(found) else found


@pytest.mark.parametrize(("folder", "forced"), [((), True), (("OUT=out/demo",), True), (("OUT=mine",), False)])
def test_make_demo_replaces_a_demo_of_an_earlier_version_in_its_own_folder_alone(folder, forced):
    """Also if the tests themselves are run by make, which hands its flags down."""
    environment = {name: value for name, value in os.environ.items() if name not in ("MAKEFLAGS", "MAKELEVEL", "MFLAGS", "OUT")}
    told = subprocess.run(["make", "-n", "demo", *folder], cwd=ROOT, env=environment, capture_output=True, text=True, check=True).stdout
    call = told.splitlines()[-1].split()
    assert call[:2] == [".venv/bin/twin", "demo"]
    assert ("--force" in call) == forced


def in_a_new_process(code, folder, path):
    """Exit code and stderr of Python code that runs in a folder, with these folders before the installed ones."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(map(str, path))}
    done = subprocess.run([sys.executable, "-P", "-c", code], cwd=folder, env=environment, capture_output=True, text=True)
    return done.returncode, done.stderr


def test_a_deleted_working_folder_is_one_line(tmp_path):
    (tmp_path / "gone").mkdir()
    code = "import os; os.rmdir(os.getcwd()); import sys; sys.argv = ['twin', 'sensors']; from twin.cli import main; main()"
    code, err = in_a_new_process(code, tmp_path / "gone", [ROOT])
    assert code == 1 and err == "twin: error: the working folder was deleted; change into a folder that exists\n"


@pytest.mark.parametrize("name", ["training", "hardware", "scenes"])
def test_a_folder_that_hides_a_package_is_named(tmp_path, name):
    (tmp_path / name).mkdir()
    (tmp_path / name / "__init__.py").touch()
    code, err = in_a_new_process("from twin.cli import main; main()", tmp_path, [tmp_path, ROOT])
    assert code == 1 and err.splitlines()[-1].endswith(
        f"{tmp_path / name} hides {ROOT / name} of tactip-twin; rename it, or start in another folder"
    )


@pytest.mark.parametrize("path", sorted(CLI.glob("*.py")), ids=lambda path: path.stem)
def test_the_command_line_computes_nothing(path):
    assert not {name.split(".")[0] for name, _ in imported(ast.parse(path.read_text()))} & HEAVY


def test_nothing_takes_the_command_line_for_a_library():
    own = {
        CLI,
        *(ROOT / "tests" / "unit" / f"test_{name}.py" for name in ("progress", "door", "former_names", "command_line")),
    }  # what is no command is tested apart
    for package in (*OURS, "tests"):
        for path in sorted((ROOT / package).rglob("*.py")):
            source = path.read_text()
            if re.search(r"\bcli\b", source) and not (own | ROOTS) & {path, path.parent}:
                found = imported(ast.parse(source))
                taken = {name or module for module, name in found if module.startswith("twin.cli")}
                taken |= {name for module, name in found if module == "twin" and name == "cli"}
                assert taken <= ENTRY, f"{path.relative_to(ROOT)} imports {taken - ENTRY} from twin.cli"


def test_a_command_that_a_group_does_not_have_is_told_with_those_it_has():
    told = CliRunner().invoke(command_line(), ["emulate", "ur5"])
    assert told.exit_code == 2 and "There are mg400, magician, ros2, ur, camera." in told.output


def commands_below(command, words=()):
    """By its words, every command and group."""
    yield words, command
    for name, below in getattr(command, "commands", {}).items():
        yield from commands_below(below, (*words, name))


TREE = dict(commands_below(typer.main.get_command(command_line())))
OPTIONS = {name for command in TREE.values() for option in command.params for name in (*option.opts, *option.secondary_opts)} | {"--help"}
HINTED = re.compile(r"(?:^|(?<=['`$(]))(?:\$ )?twin ([a-z][a-z-]+)(?: ([a-z][a-z0-9-]+))?(?=[ '`])")  # at a text's beginning or quoted


def wrong_hints(text: str) -> list[str]:
    """Commands and options named in a text that do not exist."""
    commands = [found for found in HINTED.finditer(text) if (found[1],) not in TREE]
    groups = [found for found in HINTED.finditer(text) if hasattr(TREE.get((found[1],)), "commands") and found[2]]
    wrong = [*commands, *(found for found in groups if found.group(1, 2) not in TREE)]
    return [found[0] for found in wrong] + [name for name in re.findall(r"(?<![\w-])--[a-z][a-z0-9-]+", text) if name not in OPTIONS]


OF_FUNCTIONS = {"indent_mm", "tilt_deg", "shear_mm", "twist_deg", "offset_mm", "quality"}  # arguments that no command needs to have
ARGUMENTS = {option.name for command in TREE.values() for option in command.params} | OF_FUNCTIONS
MARKED = re.compile(r"`([a-z][a-z0-9_]*)(?:=\w+)?`")


@pytest.mark.parametrize("package", OURS)
def test_every_command_option_and_argument_that_a_text_names_exists(package):
    """An error names an argument as `name`, which the command line turns into its option."""
    wrong = []
    for path in sorted((ROOT / package).rglob("*.py")):
        nodes = list(ast.walk(ast.parse(path.read_text())))
        texts = [node for node in nodes if isinstance(node, ast.Constant) and isinstance(node.value, str)]
        raised = [part for node in nodes if isinstance(node, ast.Raise) for part in ast.walk(node) if isinstance(part, ast.Constant)]
        hints = [(node, hint) for node in texts if node.value not in NOT_COMMANDS for hint in wrong_hints(node.value)]
        hints += [(node, name) for node in raised for name in MARKED.findall(str(node.value)) if name not in ARGUMENTS]
        wrong += [f"{path.relative_to(ROOT)}:{node.lineno}: {hint}" for node, hint in hints]
    assert not wrong
    assert wrong_hints("run 'twin tun' or 'twin emulate ur5 --port 1 --no-such'") == ["twin tun", "twin emulate ur5", "--no-such"]


@pytest.mark.parametrize("name", ["nope", "nope.toml"])
@pytest.mark.parametrize("load", [load_sensor, load_object, load_experiment, load_randomisation, load_servo])
def test_a_name_that_is_not_known_names_commands_that_exist(load, name):
    with pytest.raises(SpecError) as error:
        load(name)
    assert not wrong_hints(str(error.value)) and ("lists them" in str(error.value) or "known: magician, surface" in str(error.value))


def test_what_could_not_be_let_go_of_is_printed_after_ctrl_c(monkeypatch, tmp_path):
    def interrupted(*_: object, **__: object) -> None:
        interrupt = KeyboardInterrupt()
        interrupt.add_note("stop failed: press its emergency stop")
        raise interrupt

    monkeypatch.setattr("hardware.collect.collect.collect_frames", interrupted)
    command = ["collect", "--camera", "twin", "--arm", "simulated", "--sensor", "mg400-331", "--out", str(tmp_path)]
    ended = CliRunner().invoke(command_line(), command)
    assert ended.exit_code == 130
    told = [
        "twin: interrupted",
        "twin: note: stop failed: press its emergency stop",
        "twin: note: what is finished is kept; the same command resumes from there",
    ]
    assert ended.stderr.splitlines()[-3:] == told


TRAIN = ["train", "--model", "gnn", "--sensor", "mg400-127", "--data", "nowhere", "--out", "nowhere/run"]
STUDY = ["study", "tac-vgnn", "--sensor", "mg400-127", "--data", "nowhere", "--out", "nowhere/study"]
OUT_OF_RANGE = [
    *([*TRAIN, option, value] for option, values in {
        "--seed": ("-1", "4294967296"), "--split": ("-2", "4294967296"), "--max-minutes": ("nan", "-1", "inf"),
        "--threads": ("0", "-3", "100000"), "--target": ("pose_2,pose_2", ",", ""),
    }.items() for value in values),
    *([*STUDY, option, value] for option, values in {
        "--seeds": ("-1", "x", "1.5"), "--batches": ("0", "-1", "x"), "--max-minutes": ("nan",), "--threads": ("0",),
    }.items() for value in values),
    ["study", "servo", "--model", "mg400-127", "--out", "nowhere", "--objects", ","],
    ["study", "servo", "--model", "mg400-127", "--out", "nowhere", "--objects", "can,can"],
    ["study", "sim-to-real", "--sensor", "mg400-127", "--frames", "nowhere", "--out", "nowhere", "--sim", "nowhere"],
]  # fmt: skip


@pytest.mark.parametrize("command", OUT_OF_RANGE, ids=lambda command: " ".join((command[0], *command[-2:])))
def test_an_option_out_of_range_is_a_usage_error_of_one_line_before_any_work(command, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    ended = CliRunner().invoke(command_line(), command)
    assert ended.exit_code == 2
    last = ended.output.strip().splitlines()[-1]
    assert last.startswith("Error: ") and command[-2] in last
    assert not list(tmp_path.iterdir())


def commands() -> Iterator[list[str]]:
    """The words of every command and of every group of commands."""

    def below(words, group):
        yield words
        for name, command in getattr(group, "commands", {}).items():
            yield from below([*words, name], command)

    return below([], typer.main.get_command(command_line()))


def test_ctrl_c_is_one_line(monkeypatch):
    """typer itself ends the program without a word."""

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("scenes.load.catalog_lines", interrupted)
    ended = run_twin("sensors")
    assert (ended.returncode, ended.stdout, ended.stderr) == (130, "", "twin: interrupted\n")


def test_the_version_is_that_of_the_package():
    ended = run_twin("--version")
    assert ended.returncode == 0 and ended.stdout == f"twin {metadata.version('tactip-twin')}\n"


@pytest.mark.parametrize(
    "words",
    [
        ["nonsense"],
        ["render", "--nonsense"],
        ["robustness"],
        ["graph", "frame.png", "--sensor", "mg400-127"],
        ["preprocess", "frames", "--sensor", "mg400-127"],
        ["dataset", "--experiment", "surface-2d", "--sensor", "mg400-127", "--count", "1", "--out", "out", "--elements", "7"],
        ["live", "--headless"],
    ],
    ids=lambda words: " ".join(words[:2]),
)
def test_a_wrong_command_line_is_told_apart_from_a_failure_and_begins_nothing(words, tmp_path, monkeypatch):
    """Without --out, too: nothing is begun in the folder that one happens to be in."""
    monkeypatch.chdir(tmp_path)
    ended = run_twin(*words)
    assert ended.returncode == 2 and "rror: " in ended.stderr.splitlines()[-1]
    assert not list(tmp_path.iterdir())


def test_lists_of_a_command_need_none_of_its_options():
    for words, line in ((["robustness", "--list"], "leds-dim"), (["emulate", "mg400", "--fault", "help"], "=")):
        ended = run_twin(*words)
        assert ended.returncode == 0 and line in ended.stdout


def test_the_help_of_every_command_fits_a_terminal_of_80_columns(monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    for words in commands():
        lines = run_twin(*words, "--help").stdout.splitlines()
        assert len(lines) > 4 and max(map(len, lines)) <= 80, (words, max(lines, key=len))


@pytest.mark.parametrize(
    ("typed", "offered"),
    [("twin rob", {"robustness"}), ("twin study s", {"servo", "sim-to-real"}), ("twin graph --kind ", {"knn", "delaunay", "voronoi"})],
)
def test_the_shell_completes_commands_options_and_values(typed, offered, monkeypatch):
    monkeypatch.setenv("_TWIN_COMPLETE", "complete_bash")
    monkeypatch.setenv("COMP_WORDS", typed)
    monkeypatch.setenv("COMP_CWORD", str(len(typed.split(" ")) - 1))
    assert set(run_twin().stdout.split()) == offered


def test_a_letter_that_the_terminal_lacks_is_printed_by_its_number(monkeypatch):
    written = io.BytesIO()
    monkeypatch.setattr("sys.stdout", io.TextIOWrapper(written, encoding="ascii"))
    monkeypatch.setattr("sys.argv", ["twin", "sensors"])
    monkeypatch.setattr("scenes.load.catalog_lines", lambda _: ["f_\xe4.png", "f_\udcc3\udca4.png"])
    with pytest.raises(SystemExit) as end:
        main()
    assert end.value.code == 0 and written.getvalue() == b"f_\\xe4.png\nf_\\udcc3\\udca4.png\n"


def test_a_missing_device_is_one_line_though_it_is_also_an_error_of_the_system(monkeypatch, capsys):
    """DeviceNotConnectedError is a ConnectionError, as LeRobot expects it, and so an OSError."""

    def absent(*_: object) -> None:
        raise DeviceNotConnectedError("MG400 at 127.0.0.1: no connection; check that the arm is on")

    monkeypatch.setattr("scenes.load.catalog_lines", absent)
    monkeypatch.setattr("sys.argv", ["twin", "sensors"])
    with pytest.raises(SystemExit) as end:
        main()
    said = capsys.readouterr().err
    assert end.value.code == 1 and said == "twin: error: MG400 at 127.0.0.1: no connection; check that the arm is on\n"


def test_an_option_of_two_numbers_says_so_where_one_is_missing():
    told = CliRunner().invoke(command_line(), ["render", "--sensor", "ur5-331", "--object", "edge", "--tilt-deg", "5", "--indent-mm", "3"])
    assert told.exit_code == 2 and "it needs 2 numbers" in " ".join(told.output.split()), told.output


def test_no_command_overwrites_an_option_before_it_hands_all_of_them_on():
    """Commands hand their options on as ``locals()``: an option that is assigned to would arrive as something else.

    ``frames`` may: the path becomes the frames that are there.
    """
    found, checked = [], 0
    for path in sorted((Path(twin.__file__).parent / "cli").glob("*.py")):
        for function in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if not isinstance(function, ast.FunctionDef) or "locals()" not in ast.unparse(function):
                continue
            checked += 1
            options = {one.arg for one in (*function.args.args, *function.args.kwonlyargs)}
            stored = {node.id for node in ast.walk(function) if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)}
            found += [f"{path.name}: {function.name}: {name}" for name in sorted((options & stored) - {"frames"})]
    assert checked > 20 and not found, found
