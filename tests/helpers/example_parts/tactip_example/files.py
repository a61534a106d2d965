"""Specifications."""

from pathlib import Path

HERE = Path(__file__).parent
SENSOR, BALL, LIMITS = (HERE / f"{name}.toml" for name in ("tip", "ball", "limits"))
