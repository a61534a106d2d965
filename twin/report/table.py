"""Tables as files."""

import csv
from pathlib import Path


def write_rows(path: Path, rows: list[dict]) -> Path:
    """Rows of the same keys as CSV, numbers in full; the path."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, rows[0].keys())
        writer.writeheader()
        writer.writerows(rows)
    return path


def write_table(path: Path, rows: list[dict]) -> Path:
    """Rows as CSV for reading, numbers to six digits; a column of any row is a column of the table."""
    columns = list(dict.fromkeys(key for row in rows for key in row))
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, fieldnames=columns, restval="")
        writer.writeheader()
        writer.writerows({key: _cell(value) for key, value in row.items()} for row in rows)
    return path


def _cell(value) -> str:
    return "" if value is None else f"{value:.6g}" if isinstance(value, float) else str(value)
