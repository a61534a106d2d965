"""The colours of pages and charts for a light and a dark theme, and the stylesheet with these colours.

Text colours have a contrast of at least 4.5:1 to every background of their theme. Lines of charts have at least 3:1 in both themes
(WCAG 2.1, success criteria 1.4.3 and 1.4.11).
"""

from dataclasses import asdict, dataclass
from importlib import resources
from pathlib import Path


@dataclass(frozen=True)
class Theme:
    """Colours as ``#rrggbb``.

    Attributes
    ----------
    page, surface, tint : str
        Backgrounds: of the page, of figures and tables, and of marked parts.
    ink, muted, accent, good, bad : str
        Text: normal, secondary, links, values that meet their target, values that miss it.
    line : str
        Rules between rows, borders, the grid of a chart.
    """

    page: str
    surface: str
    tint: str
    ink: str
    muted: str
    accent: str
    good: str
    bad: str
    line: str


LIGHT = Theme("#f6f7f9", "#ffffff", "#e4eefa", "#1a222d", "#526070", "#0a58a8", "#0f6b3a", "#ad2118", "#d8dee6")
DARK = Theme("#0f1419", "#161c23", "#1c2f45", "#e4e9ef", "#a1b0c0", "#82bbf7", "#62d296", "#ff9488", "#2c3744")

# Colours of the series of a chart in their order, the same in both themes. They were found by a random search among the colours with the
# contrast above. Any two differ by at least 20 (CIELAB) for readers with normal colour vision, for protanopes and for deuteranopes.
BLUE, RED, GREEN, PURPLE, OLIVE = "#0a7ff8", "#b73f2c", "#35956e", "#b355ac", "#a19200"
SERIES = (BLUE, RED, GREEN, PURPLE, OLIVE)


def dark_of(path: Path) -> Path:
    """Path of a chart in the dark theme."""
    return path.with_name(f"{path.stem}-dark{path.suffix}")


def stylesheet() -> str:
    """CSS of all pages: the colours of the themes as variables, which ``prefers-color-scheme`` chooses, and ``style.css``."""
    rules = resources.files(__package__).joinpath("style.css").read_text(encoding="utf-8")
    light, dark = (f":root {{ {_variables(theme)} }}" for theme in (LIGHT, DARK))
    return f":root {{ color-scheme: light dark; }}\n{light}\n@media (prefers-color-scheme: dark) {{ {dark} }}\n{rules}"


def _variables(theme: Theme) -> str:
    return " ".join(f"--{name}: {color};" for name, color in asdict(theme).items())
