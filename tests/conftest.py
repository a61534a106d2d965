"""Shared fixtures: shipped specifications, and the real recordings where this machine has them."""

import gc
import os
import signal
import sys
from collections import Counter
from pathlib import Path

# One thread for linear algebra, here and in the processes that tests start: the tests themselves run side by side, and threads that wait
# for each other take twice the CPU time. It must be said before numpy and torch are imported.
for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_variable, "1")

# What tests say to other programs stays on this machine.
os.environ.setdefault("ROS_LOCALHOST_ONLY", "1")

# Python keeps what it compiles even where containers tell it not to: many tests start processes, and each would compile all modules again.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

import pytest  # noqa: E402
from hypothesis import settings  # noqa: E402
from threadpoolctl import threadpool_limits  # noqa: E402

from scenes import load_sensor  # noqa: E402

threadpool_limits(1)  # where a plugin of pytest has imported numpy before the variables were set

# The same code gives the same answer: what Hypothesis draws follows from the test, and nothing from the clock. `make validate` draws again.
settings.register_profile("same", derandomize=True, deadline=None)
settings.register_profile("anew", derandomize=False, deadline=None)
settings.load_profile("same")


@pytest.hookimpl(wrapper=True)
def pytest_collection():
    """Leave what is imported and collected out of every search for garbage, which would take a tenth of the tests' time."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.set_threshold(10_000)
        gc.enable()


def pytest_collection_modifyitems(items):
    """Tests of whole programs come first, and files with few tests last: so all workers end at the same time."""
    count = Counter(item.path for item in items)
    items.sort(key=lambda item: (item.path.parent.name == "unit", -count[item.path], item.path))


@pytest.fixture(scope="session")
def of_all_workers(tmp_path_factory):
    """The folder of this run that all workers share."""
    base = tmp_path_factory.getbasetemp()
    return base.parent if "PYTEST_XDIST_WORKER" in os.environ else base


@pytest.fixture(scope="session", autouse=True)
def own_cache(of_all_workers):
    """The tests keep their arrays and lists apart from the user's; what one worker has computed, the others read."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TACTIP_CACHE", str(of_all_workers / "cache"))
        patch.setenv("XDG_STATE_HOME", str(of_all_workers / "state"))
        yield


@pytest.fixture(autouse=True)
def own_signals():
    """A command that is interrupted ignores further signals until its process ends: here the next test must not inherit that."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.fixture(scope="session")
def real_dir() -> Path:
    """Folder of real recordings; tests that need it skip, with the reason, where it is missing."""
    folder = Path(os.environ.get("TACTIP_REAL", "../shared/real"))
    if not folder.is_dir():
        pytest.skip(f"no real recordings at {folder} (set TACTIP_REAL)")
    return folder


@pytest.fixture(scope="session", params=["mg400-331", "mg400-127", "ur5-331"])
def sensor(request):
    return load_sensor(request.param)
