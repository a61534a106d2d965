"""A day's work without what only POSIX systems have; run with this folder on PYTHONPATH: ``python everyday.py WHAT``, in a new folder."""

import importlib
import pkgutil
import sys
import threading
from contextlib import closing
from pathlib import Path


def imports():
    for package in ("scenes", "twin", "training", "hardware"):
        root = importlib.import_module(package)
        for found in pkgutil.walk_packages(root.__path__, f"{package}."):
            if not found.name.endswith("__main__"):
                importlib.import_module(found.name)


def press():
    import twin

    sensor = twin.load_sensor("mg400-127")
    simulator = twin.Simulator(sensor, quality="rasterised")
    state = simulator.press(twin.load_object("edge"), twin.ContactPose(indent_mm=2.0))
    frame = simulator.render(state, form=twin.Form.PROCESSED).frame
    seen = twin.Pipeline(sensor, twin.Form.PROCESSED)(frame)
    assert state.force_n[2] > 0 and seen.valid and seen.found == 127


def trace():
    import twin

    simulator = twin.Simulator(twin.load_sensor("mg400-127"), quality="preview")
    frame = simulator.render(simulator.press(twin.load_object("edge"), twin.ContactPose(indent_mm=2.0))).frame
    assert frame.image.std() > 1


def train():
    import twin

    twin.make_dataset(experiment="surface-2d", sensor="mg400-127", count=8, images="none", elements=12, seed=1, workers=2, out="sim")
    run = twin.train(model="vgnn", sensor="mg400-127", data="sim", target="surface-2d", epochs=1, members=1, kernel=False, out="run")
    assert Path("run/config.json").is_file() and run


def servo():
    import twin
    from hardware.emulators.mg400 import Mg400Emulator

    with Mg400Emulator(port_offset=int(sys.argv[2]), time_scale=4.0) as emulator:
        arm = f"mg400:127.0.0.1:{emulator.ports[29999]}"
        done = twin.servo(obj="can", camera="twin", arm=arm, steps=3, plain_light=True, record=True, out="servo")
    assert not done.failure and done.measures.steps == 3, done.lines()


def folders():
    from twin.errors import StoreError
    from twin.store import lock_folder

    with lock_folder(Path("out")):
        try:
            with lock_folder(Path("out")):
                raise AssertionError("a folder was reserved twice")
        except StoreError as error:
            assert "another run" in str(error)
    with lock_folder(Path("out")):
        pass
    assert not list(Path("out").iterdir())


def terminals():
    from hardware.emulators.magician import MagicianEmulator
    from twin.errors import TwinError

    try:
        MagicianEmulator().start()
    except TwinError as error:
        assert "no pseudo-terminals" in str(error)
    else:
        raise AssertionError("a pseudo-terminal was made")


def commands():
    from hardware.emulators.faults import Emulator
    from hardware.live.doctor import examine_machine
    from twin.signals import signals_as_ctrl_c

    with signals_as_ctrl_c():
        assert "Ready" in examine_machine().lines()[-1]
    from contextlib import nullcontext
    from signal import SIGINT, raise_signal

    threading.Timer(0.5, raise_signal, (SIGINT,)).start()
    device = nullcontext()
    device.place, device.error = "now", None
    Emulator.run(device)


def studio():
    import twin
    from twin.studio.worker import Failed, Tracer

    found = threading.Event()
    with closing(Tracer(twin.load_sensor("mg400-127"))) as tracer:
        tracer.on_outcome = found.set
        tracer.start()
        assert found.wait(100)
        assert not any(isinstance(outcome, Failed) for outcome in tracer.outcomes())


if __name__ == "__main__":
    globals()[sys.argv[1]]()
    print("done")
