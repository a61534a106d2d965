"""Tables and single numbers of documents, printed from the kept figures.

In a document stands ``<!-- figures: NAME -->``, then whatever ``templates/NAME.md`` gives with the figures put in, how and when they were
measured, then ``<!-- /figures -->``; within a sentence ``<!-- figure: pins.mg400-331.ms .1f -->3.2<!-- /figure -->``. A template names
figures in braces, with Python's format after a colon (``{mechanics.calculix.plane_force:+.1%}``). A row whose figures were not measured is
left out; in a row that has some of them, and in a sentence, a figure that was not measured reads ``?``. The table ``jobs`` has no template:
it lists how every kept figure was measured.
"""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from figures.jobs import FIGURES, ROOT, FiguresError, Value, read

TEMPLATES = Path(__file__).with_name("templates")
UNKNOWN = "–"
"""What a table shows for a figure that was not measured."""
ALL_JOBS = "jobs"
"""Name of the table of all measurements."""
MOST_COMMANDS = 3
"""Most commands that are named below a table."""
_PLACE = re.compile(r"\{([\w.+-]+)(?::([^{}]*))?\}")
_TABLE = re.compile(r"(<!-- figures: ([\w.-]+) -->\n).*?(<!-- /figures -->)", re.DOTALL)
_NUMBER = re.compile(r"(<!-- figure: ([\w.+%-]+) (\S+) -->).*?(<!-- /figure -->)", re.DOTALL)


def documents(root: Path = ROOT) -> list[Path]:
    """README and what lies in docs."""
    return [path for path in (root / "README.md", *sorted((root / "docs").rglob("*.md"))) if path.is_file()]


def render(name: str, jobs: dict[str, dict[str, Any]]) -> str:
    """A table with its figures, and how they were measured; ``jobs`` as `figures.jobs.read` gives them."""
    if name == ALL_JOBS:
        return _all_jobs(jobs)
    known = _values(jobs)
    rows, used = [], []
    for row in _template(name).strip().splitlines():
        names = [place[1] for place in _PLACE.finditer(row)]
        if not names or any(each in known for each in names):
            rows.append(_PLACE.sub(lambda match: _said(known, match[1], match[2] or ""), row))
            used += [each for each in names if each in known]
    if not used:
        families = sorted({each.split(".")[0] for each in named_in(name)})
        return f"Nobody has measured this table with this version: `make figures ONLY={','.join(families)}` does."
    return "\n".join([*rows, "", _measured_by([jobs[job] for job in jobs if any(each.startswith(f"{job}.") for each in used)])])


def _values(jobs: dict[str, dict[str, Any]]) -> dict[str, Value]:
    return {f"{name}.{figure}": Value(**found) for name, entry in jobs.items() for figure, found in entry["figures"].items()}


def _measured_by(jobs: list[dict[str, Any]]) -> str:
    """Commands and dates of some measurements in a sentence."""
    commands = list(dict.fromkeys(job["command"] for job in jobs))
    said = ", ".join(f"`{command}`" for command in commands[:MOST_COMMANDS])
    more = f" and {len(commands) - MOST_COMMANDS} more" if len(commands) > MOST_COMMANDS else ""
    dates = sorted({job["date"] for job in jobs})
    return f"Measured by {said}{more}; {' to '.join(dict.fromkeys((dates[0], dates[-1])))}."


def _all_jobs(jobs: dict[str, dict[str, Any]]) -> str:
    lines = ["| figures | measured by | on | with | minutes | machine |", "| --- | --- | --- | --- | --- | --- |"]
    for name, job in sorted(jobs.items()):
        lines.append(f"| {name} | `{job['command']}` | {job['date']} | {job['commit']} | {job['minutes']:g} | {job['machine']} |")
    return "\n".join(lines)


def filled(text: str, jobs: dict[str, dict[str, Any]]) -> str:
    """A document's text with all its tables and numbers; ``jobs`` as `figures.jobs.read` gives them."""
    known = _values(jobs)
    text = _TABLE.sub(lambda match: f"{match[1]}\n{render(match[2], jobs).strip()}\n\n{match[3]}", text)
    return _NUMBER.sub(lambda match: f"{match[1]}{_said(known, match[2], match[3])}{match[4]}", text)


def used_in(text: str) -> Iterator[str]:
    """Names of the figures that a document needs."""
    for match in _TABLE.finditer(text):
        yield from () if match[2] == ALL_JOBS else named_in(match[2])
    yield from (match[2] for match in _NUMBER.finditer(text))


def templates() -> list[str]:
    """Names of all tables."""
    return sorted(path.stem for path in TEMPLATES.glob("*.md"))


def named_in(name: str) -> list[str]:
    """Names of the figures in one table."""
    return [place[1] for place in _PLACE.finditer(_template(name))]


def named_in_templates() -> set[str]:
    """Names of the figures in all tables, whether a document shows them or not."""
    return {figure for name in templates() for figure in named_in(name)}


def fill_documents() -> list[Path]:
    """Write the figures into the documents; those that changed."""
    jobs, changed = read(FIGURES), []
    for path in documents():
        text = path.read_text()
        if (made := filled(text, jobs)) != text:
            path.write_text(made)
            changed.append(path)
    return changed


def _template(name: str) -> str:
    path = TEMPLATES / f"{name}.md"
    if not path.is_file():
        raise FiguresError(f"no table is called {name!r}; there are {', '.join(templates())}")
    return path.read_text()


def _said(known: dict[str, Value], name: str, how: str) -> str:
    return format(known[name].value, how) if name in known else UNKNOWN
