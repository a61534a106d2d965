"""Readable numbers: integers without decimals, exponents only for very large or small numbers, equal decimals in a column."""

import math
from collections.abc import Sequence
from numbers import Integral, Real
from typing import TypeGuard

# Text for a missing value.
NOTHING = "–"
# Minus sign, which has the width of a plus sign in tabular figures.
MINUS = "−"
# Narrow no-break space between groups of three digits.
GROUP = "\u202f"
# Least number that is written with groups of digits.
GROUPED_FROM = 10_000
# Absolute values between which a number is written without a power of ten.
PLAIN_LOW, PLAIN_HIGH = 1e-4, 1e9
# Least number of significant digits of a column's smallest value.
FEWEST = 2
# Most digits of a column's largest value. If it would need more, each value has its own number of decimals.
LONGEST = 6
SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def number(value: object, digits: int = 3, *, decimals: int | None = None, signed: bool = False) -> str:
    """A number as text for a sentence or a cell.

    Parameters
    ----------
    value : int, float, bool, str or None
        A bool becomes yes or no, None and NaN become a dash, a text is not changed.
    digits : int
        Significant digits of a number that is not whole; digits before the point are always written.
    decimals : int, optional
        Number of digits after the point instead, also for whole numbers.
    signed : bool
        Write a plus sign before positive numbers.
    """
    if value is None or isinstance(value, str):
        return NOTHING if value is None else value
    if isinstance(value, bool) or type(value).__name__ == "bool":  # numpy's bool is another type
        return "yes" if value else "no"
    if not isinstance(value, Real):
        return str(value)
    size = float(value)
    if math.isnan(size):
        return NOTHING
    sign = MINUS if size < 0 else "+" if signed and size > 0 else ""
    if math.isinf(size):
        return f"{sign}∞"
    if decimals is None:
        if isinstance(value, Integral):
            decimals = 0
        elif size and not PLAIN_LOW <= abs(size) < PLAIN_HIGH:
            mantissa, _, power = f"{abs(size):.{digits - 1}e}".partition("e")
            return f"{sign}{mantissa}×10{str(int(power)).translate(SUPERSCRIPTS)}"
        else:
            decimals = max(0, digits - 1 - _power(size, digits)) if size else 0
    text = f"{abs(size):.{decimals}f}"
    if not float(text):
        sign = ""  # a number that is rounded to zero has no sign
    return sign + _group_digits(text)


def column(values: Sequence[object], digits: int = 3, *, decimals: int | None = None, signed: bool = False) -> list[str]:
    """The values of a table's column with equally many decimals, so that their decimal points are aligned.

    The column's median has ``digits`` significant digits, its smallest value at least two. If the largest value would need more than six
    digits for that, each value has its own number of decimals.
    """
    sizes = sorted(abs(float(v)) for v in values if is_number(v) and math.isfinite(float(v)) and float(v))
    if decimals is None and sizes:
        if all(size == int(size) for size in sizes):
            decimals = 0
        else:
            middle, least = _power(sizes[len(sizes) // 2], digits), _power(sizes[0], FEWEST)
            wanted = max(0, digits - 1 - middle, FEWEST - 1 - least)
            decimals = wanted if wanted + max(_power(sizes[-1], digits), 0) + 1 <= LONGEST else None
    return [number(v, digits, decimals=decimals, signed=signed) for v in values]


def is_number(value: object) -> TypeGuard[Real]:
    """Whether a value is a number of Python or numpy. A bool is not a number."""
    return isinstance(value, Real) and not isinstance(value, bool)


def _power(size: float, digits: int) -> int:
    """Power of ten of a number's first digit after rounding to ``digits`` digits (9.996 to three is 10.0: 1)."""
    return int(f"{abs(size):.{digits - 1}e}".partition("e")[2])


def _group_digits(text: str) -> str:
    whole, point, rest = text.partition(".")
    return (f"{int(whole):,}".replace(",", GROUP) if int(whole) >= GROUPED_FROM else whole) + point + rest


def force_interval(force_n: Sequence[float], factor: float) -> tuple[float, float]:
    """Ends of the 90 % interval of a simulated force's size, N, if the true one is larger or smaller by ``skin.stiffness_factor``."""
    size = math.hypot(*force_n)
    return size / factor, size * factor
