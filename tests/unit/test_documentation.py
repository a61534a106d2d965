"""What is documented: every public function, command, option and key of a specification. References are made from these texts."""

import inspect
import re

import pytest
from generators import api, commands, specifications
from generators.specifications import FILES, UNITS, Explained, SpecificationFile

from hardware.safety.decide import SafetyLimits
from scenes import SensorSpec
from scenes.base import Positive, Section

COMMAND_GROUPS = commands.groups()
ALL_COMMANDS = [pytest.param(command, id=command.name) for group in COMMAND_GROUPS for command in group.commands]
CLASS = re.compile(r"^class (\w+)\(([^)]*)\):", re.MULTILINE)  # its name and its bases
# Sections of specifications that the program makes from others, or writes and reads by itself: no user writes them.
OF_THE_PROGRAM = {"GeometrySpec", "ViewSpec", "CaptureSpec", "GenerationConfig", "StudioState", "MaterialSpec", "NeoHookean"}
OF_THE_PROGRAM |= {"OpenSection", "Layout", "LatticeLayout", "RingedLayout", "MaterialLaw"}  # bases of sections


def test_every_public_function_class_and_method_is_explained():
    assert not api.list_undocumented()


def test_a_function_without_a_docstring_is_found(monkeypatch, tmp_path):
    source = tmp_path / "silent.py"
    source.write_text(
        '"""A module."""\ndef said():\n    """Says."""\ndef silent():\n    pass\nclass A:\n    """A."""\n    def mute(self): pass\n'
    )
    monkeypatch.setattr(api, "modules", lambda: [api.Module("twin.silent", source)])
    assert api.list_undocumented() == ["twin.silent.silent", "twin.silent.A.mute"]


def test_every_module_stands_on_a_page():
    members = [module.name for modules in api.pages().values() for module in modules]
    assert sorted(members) == [module.name for module in api.modules()] and len(members) > 250
    text = api.text_of("twin.pins", api.pages()["twin.pins"])
    assert "### Pipeline\n" in text and "as in `from twin.pins import" in text and "\n#### Pipeline." in text
    assert "`Simulator`" in api.text_of("twin", api.pages()["twin"])


@pytest.mark.parametrize("command", ALL_COMMANDS)
def test_every_option_is_explained_and_every_command_has_an_example(command):
    assert command.help.strip() and not [option.name for option in command.options if not option.text]
    lines = command.example.strip().splitlines()
    assert lines and any(line.strip().startswith(f"twin {command.name}") for line in lines), "end the help with 'Example:' and a command"


def test_every_command_stands_under_one_title():
    titles = [group.title for group in COMMAND_GROUPS]
    assert len(set(titles)) == len(titles) > 4 and all(group.commands for group in COMMAND_GROUPS)
    names = [command.name for group in COMMAND_GROUPS for command in group.commands]
    assert len(set(names)) == len(names) > 30


def test_the_page_of_commands_holds_what_the_help_says():
    text = "\n".join(map(commands.text_of, COMMAND_GROUPS))
    for group in COMMAND_GROUPS:
        for command in group.commands:
            assert f"## `twin {command.name}`" in text
            assert all(option.name.replace("|", "\\|") in text for option in command.options)


SECTIONS = {
    f"{made.stem}.{place}".rstrip("."): section for made in FILES for place, section in specifications.sections_of(made.root).items()
}


@pytest.mark.parametrize("section", SECTIONS.values(), ids=SECTIONS)
def test_every_key_is_explained(section):
    assert not specifications.list_unexplained(section), f"{section.__name__}: name these keys under 'Attributes' of its docstring"


@pytest.mark.parametrize("section", SECTIONS.values(), ids=SECTIONS)
def test_every_default_has_a_source(section):
    """0 and 1 say that there is nothing; any other number comes from somewhere, and the class says from where."""
    chosen = [key for key, field in section.model_fields.items() if isinstance(field.default, float) and field.default not in (0.0, 1.0)]
    assert not chosen or "default" in inspect.getdoc(section).lower(), f"{section.__name__}: where do the defaults of {chosen} come from?"


def test_every_section_of_a_specification_is_on_a_page():
    classes = [found for module in api.modules() for found in CLASS.findall(module.path.read_text(encoding="utf-8"))]
    known = {"Section"}
    while more := {name for name, bases in classes if name not in known and known & set(re.split(r"[\s,]+", bases))}:
        known |= more
    assert known - {"Section"} - {section.__name__ for section in SECTIONS.values()} == OF_THE_PROGRAM


def test_a_key_that_is_not_explained_is_found():
    class Springs(Section):
        """Springs.

        Attributes
        ----------
        rate_n, length_mm : float
            Of one.
        """

        rate_n: Positive
        length_mm: float = 2.5
        count: int = 1

    assert specifications.explain_attributes(Springs)["length_mm"] == Explained("float", "Of one.")
    assert specifications.list_unexplained(Springs) == ["count"]
    text = specifications.text_of(SpecificationFile("springs", "Springs", Springs, "Nowhere."))
    assert "| `length_mm` | mm | `2.5` | number | Of one. |" in text and "| `rate_n` | N | **must be given** | number, > 0 |" in text


def test_units_are_those_of_the_names():
    keys = {key for section in SECTIONS.values() for key in section.model_fields}
    assert {specifications.unit_of(key) for key in keys} - {""} <= set(UNITS.values())
    assert [specifications.unit_of(key) for key in ("compliance_mm_per_n", "linear_mm_s", "radius_px", "min_area_px2", "gamma")] == [
        "mm/N",
        "mm/s",
        "px",
        "px²",
        "",
    ]


@pytest.mark.parametrize("root", [SensorSpec, SafetyLimits])
def test_allowed_values_are_said_in_words(root):
    said = [
        specifications.values_of(f.annotation, tuple(f.metadata))
        for s in specifications.sections_of(root).values()
        for f in s.model_fields.values()
    ]
    assert all(said) and "value" not in said
