"""Parsing of the MG400's requests, ``Name(p1,p2,Key=v)``: finds them in a stream, and checks their parameters."""

import math
import re
from dataclasses import dataclass

from hardware.arms.mg400_wire import ErrorId
from twin.errors import ErrorsAs

# Most characters of a request that is not complete. No command of the arm is nearly as long.
LONGEST_REQUEST = 4096
# Largest coordinate, mm, and angle, deg. A larger one counts as this one: no arm gets there either, and sums and products stay finite.
FARTHEST = 1e5


@dataclass(frozen=True)
class Request:
    """One request: name in lower case, parameters, keywords in lower case, and the received text.

    A malformed request has no name, so it is no command.
    """

    name: str
    values: tuple[str, ...]
    keywords: dict
    text: str

    def whole(self, n: int, parameter: "Parameter") -> int:
        """The whole number at a position of the values, from 0; raises as ``read_numbers``."""
        return int(_number(self.values[n], parameter, n + 1))


class RefusedError(Exception):
    """A request is refused with an error id."""

    def __init__(self, error_id: int) -> None:
        super().__init__(f"refused: {error_id}")
        self.error_id = int(error_id)


def refuse_if(wrong: object, error_id: int = ErrorId.FAILED) -> None:
    """Raise ``RefusedError`` if something is wrong."""
    if wrong:
        raise RefusedError(error_id)


def take_request(buffer: str) -> tuple[Request | None, str]:
    """The first request in the received text (None if there is none), and the rest of the text.

    A request ends at its closing ``)``. It needs no newline. A request that is not closed ends at a newline, or when it is longer than
    ``LONGEST_REQUEST``. It is malformed, so that it is refused and what follows it is understood.
    """
    depth = begin = 0
    for n, letter in enumerate(buffer):
        depth += {"(": 1, ")": -1}.get(letter, 0)
        if letter == ")" and depth <= 0:
            return _parse(_bare(buffer[begin : n + 1])), buffer[n + 1 :]
        if letter == "\n":
            if text := _bare(buffer[begin:n]):
                return _malformed_request(text), buffer[n + 1 :]
            begin = n + 1
    rest = buffer[begin:]
    return (_malformed_request(_bare(rest)), "") if len(rest) > LONGEST_REQUEST else (None, rest)


def _bare(text: str) -> str:
    """The text without what may separate requests."""
    return text.strip(" \r\n\t;")


def _malformed_request(text: str) -> Request:
    return Request("", (), {}, text)


def _parse(text: str) -> Request:
    name, _, inside = text.partition("(")
    values, keywords = [], {}
    for part in re.split(r",(?![^{(]*[})])", inside[:-1]):  # not at commas within braces or parentheses
        key, equals, value = part.partition("=")
        if equals:
            keywords[key.strip().lower()] = value.strip()
        elif part.strip():  # some clients send a comma at the end
            values.append(part.strip())
    return Request(name.strip().lower(), tuple(values), keywords, text)


@dataclass(frozen=True)
class Parameter:
    """Type and range of a command's parameter. A number whose size is above ``most`` counts as that size."""

    integer: bool = False
    low: float = float("-inf")
    high: float = float("inf")
    most: float = float("inf")


# A coordinate or an angle of any size.
NUMBER = Parameter(most=FARTHEST)


def read_numbers(request: Request, parameters: tuple[Parameter, ...], counts: tuple[int, ...]) -> list[float]:
    """The request's values as numbers.

    Raises
    ------
    RefusedError
        The number of values is wrong (-20000), or the type (-3000n) or the range (-4000n) of the n-th value.
    """
    refuse_if(len(request.values) not in counts, ErrorId.PARAMETER_COUNT)
    return [_number(text, parameter, n) for n, (text, parameter) in enumerate(zip(request.values, parameters, strict=False), start=1)]


def read_table(text: str, counts: tuple[int, ...], n: int, most: float = FARTHEST) -> list[float]:
    """Numbers of the n-th parameter, ``{x,y,z,r}`` or ``(x,y,z,r)``. A number whose size is above ``most`` counts as that size.

    Raises
    ------
    RefusedError
        The values are not numbers (-3000n), or are not finite or have the wrong count (-4000n).
    """
    with ErrorsAs(ValueError, lambda error: RefusedError(ErrorId.PARAMETER_TYPE - n)):
        numbers = [float(part) for part in text.strip("{}() '\"").split(",")]
    refuse_if(len(numbers) not in counts or not all(map(math.isfinite, numbers)), ErrorId.PARAMETER_RANGE - n)
    return [_at_most(number, most) for number in numbers]


def keyword_number(request: Request, key: str, parameter: Parameter, default: float) -> float:
    """The value of a keyword, or the default. In error ids, keywords are numbered after the values."""
    if key not in request.keywords:
        return default
    return _number(request.keywords[key], parameter, len(request.values) + 1 + list(request.keywords).index(key))


def _number(text: str, parameter: Parameter, n: int) -> float:
    with ErrorsAs(ValueError, lambda error: RefusedError(ErrorId.PARAMETER_TYPE - n)):
        number = int(text) if parameter.integer else float(text)
    refuse_if(
        not (parameter.low <= number <= parameter.high and math.isfinite(number)), ErrorId.PARAMETER_RANGE - n
    )  # a whole number may be too large for isfinite
    return _at_most(number, parameter.most)


def _at_most(number: float, most: float) -> float:
    """The number with its sign, and with a size of ``most`` if it is larger."""
    return min(max(number, -most), most)
