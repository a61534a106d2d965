"""The reference of every command, from the program itself: what it does, its options, its examples."""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import typer

from twin.cli import command_line


@dataclass(frozen=True)
class Option:
    """One option or argument of a command.

    Attributes
    ----------
    name : str
        With its metavar, as in the help.
    text : str
        What it means; "" where the program does not say.
    """

    name: str
    text: str


@dataclass(frozen=True)
class Command:
    """One command.

    Attributes
    ----------
    name : str
        All words after ``twin``.
    help : str
        Its help; blocks that start with a line of ``\\b`` keep their lines.
    options : tuple of Option
    usage : str
    """

    name: str
    help: str
    options: tuple[Option, ...]
    usage: str

    @property
    def example(self) -> str:
        """The lines below ``Example:`` of its help; "" without one."""
        found = re.search(r"^Examples?[^\n]*:[ \t]*\n(.*?)(?=\n\n|\n\x08|\Z)", self.help, re.DOTALL | re.MULTILINE)
        return found[1] if found else ""


@dataclass(frozen=True)
class Group:
    """Commands under one title of ``twin --help``."""

    title: str
    commands: tuple[Command, ...]


def groups() -> list[Group]:
    """Every command under the title of ``twin --help`` that it stands under."""
    program = typer.main.get_command(command_line())
    context = program.make_context("twin", ["--help"], resilient_parsing=True)
    return [
        Group(title, tuple(found for name in names for found in _commands(program.get_command(context, name), name)))
        for title, names in program.commands_by_title(context).items()
    ]


def _commands(command: Any, name: str) -> Iterator[Command]:
    """A command, or those of a group of commands."""
    if hasattr(command, "commands"):
        for each, below in command.commands.items():
            yield from _commands(below, f"{name} {each}")
        return
    context = command.make_context(f"twin {name}", ["--help"], resilient_parsing=True)
    records = [(part, part.get_help_record(context)) for part in command.params]
    options = tuple(Option(record[0], record[1] if part.help else "") for part, record in records if record)
    usage = " ".join(["twin", name, *command.collect_usage_pieces(context)])
    yield Command(name, command.help or "", options, usage)


def text_of(group: Group) -> str:
    """The page of one group of commands, Markdown."""
    lines = [f"# {group.title}", ""]
    for command in group.commands:
        lines += [f"## `twin {command.name}`", "", "```text", command.usage, "```", "", _markdown(command.help), ""]
        lines += ["| option | meaning |", "| --- | --- |"]
        lines += [f"| `{_cell(option.name)}` | {_cell(option.text, code=False)} |" for option in command.options]
        lines += [""]
    return "\n".join(lines) + "\n"


def _cell(text: str, *, code: bool = True) -> str:
    """Text for a cell of a table."""
    text = " ".join(text.split()).replace("|", "\\|")
    return text if code else text.replace("<", "&lt;").replace("*", "\\*").replace("[default:", "\\[default:")


def _markdown(text: str) -> str:
    """A help text: plain paragraphs, and blocks of fixed lines as code."""
    parts = []
    for part in re.split(r"\n{2,}", text.strip()):
        fixed = part.startswith("\b")
        body = part.lstrip("\b\n") if fixed else part
        parts.append(f"```text\n{body}\n```" if fixed else body.replace("<", "&lt;").replace("*", "\\*").replace("_", "\\_"))
    return "\n\n".join(parts)
