"""The one place where this package writes files."""

from pathlib import Path


def write_text(path: Path, text: str) -> Path:
    """Write a text as UTF-8 with its line ends as they are; the path."""
    path.write_text(text, encoding="utf-8", newline="")
    return path


def write_bytes(path: Path, content: bytes) -> Path:
    """Write bytes; the path."""
    path.write_bytes(content)
    return path
