"""How long work tells that it goes on: the two kinds of callback that it takes."""

from collections.abc import Callable
from contextlib import AbstractContextManager

# progress(done, total): called after each item.
Progress = Callable[[int, int], None]
# bar(title): a context manager around one stage of work, which yields that stage's progress(done, total).
Bar = Callable[[str], AbstractContextManager[Progress]]
# progress(fraction), from 0 to 1, and a bar that yields it: for work whose items are not alike.
FractionProgress = Callable[[float], None]
FractionBar = Callable[[str], AbstractContextManager[FractionProgress]]
