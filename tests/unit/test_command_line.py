"""The command line is options and one call: what it does can be done from Python, and nothing else depends on it."""

import ast
from pathlib import Path

import pytest
from typer.testing import CliRunner

from twin.cli import command_line

ROOT = Path(__file__).parents[2]
CLI = ROOT / "twin" / "cli"
OURS = ("scenes", "twin", "training", "hardware")
FEW = 8  # statements of a command beside its imports: specifications loaded, a plan, a call, what is printed, an exit code
ENTRY = {"main", "command_line"}  # what others may take from the command line
NO_LOGIC = (ast.For, ast.While, ast.AsyncFor, ast.Try, ast.Lambda, ast.FunctionDef, ast.ClassDef, ast.ListComp, ast.DictComp, ast.SetComp)
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
    called = {
        part.id for call in ast.walk(command) if isinstance(call, ast.Call) for part in ast.walk(call.func) if isinstance(part, ast.Name)
    }
    ours = {name for source, name in [*imported(command), *IMPORTS[command.name]] if _is_ours(source)}
    assert {name for name in called & ours if not name.startswith("load_")}


@pytest.mark.parametrize("path", sorted(CLI.glob("*.py")), ids=lambda path: path.stem)
def test_the_command_line_computes_nothing(path):
    assert not {name.split(".")[0] for name, _ in imported(ast.parse(path.read_text()))} & HEAVY


def test_nothing_takes_the_command_line_for_a_library():
    own = {CLI, ROOT / "tests" / "unit" / "test_progress.py"}  # the bars are no command, and are tested apart
    for package in (*OURS, "tests"):
        for path in sorted((ROOT / package).rglob("*.py")):
            if not own & {path, path.parent}:
                taken = {name or module for module, name in imported(ast.parse(path.read_text())) if module.startswith("twin.cli")}
                taken |= {name for module, name in imported(ast.parse(path.read_text())) if module == "twin" and name == "cli"}
                assert taken <= ENTRY, f"{path.relative_to(ROOT)} imports {taken - ENTRY} from twin.cli"


def test_what_could_not_be_let_go_of_is_printed_after_ctrl_c(monkeypatch, tmp_path):
    def interrupted(*_: object, **__: object) -> None:
        interrupt = KeyboardInterrupt()
        interrupt.add_note("stop failed: press its emergency stop")
        raise interrupt

    monkeypatch.setattr("hardware.collect.collect_frames", interrupted)
    command = ["collect", "--camera", "twin", "--arm", "simulated", "--sensor", "mg400-331", "--out", str(tmp_path)]
    ended = CliRunner().invoke(command_line(), command)
    assert ended.exit_code == 130 and "twin: note: stop failed: press its emergency stop" in ended.stderr


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
