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
