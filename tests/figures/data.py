"""How fast contacts and labelled states are simulated, and what a coarser mesh costs."""

from pathlib import Path
from shutil import rmtree
from tempfile import mkdtemp
from time import process_time

import numpy as np
from fresh_contacts import simulate_contacts

from figures.jobs import NO_PICTURES, Measured, Value, job
from scenes import load_sensor
from training.data.simulated import open_simulated

SENSOR, CONTACTS, SEED = "mg400-331", 12, 3
ACROSS = (20, 16, 12)


@job(
    "data.rates.mg400-331",
    "twin dataset --sensor mg400-331 --experiment surface-2d --images none --states all --elements N",
    sensors=(SENSOR,),
    code=("training.generation", "training.data.simulated"),
    minutes=3,
    beside=NO_PICTURES,
)
def rates(work: Path) -> Measured:
    """Contacts and labelled states a CPU second of one core, and pins off those of the finest of these meshes."""
    found, pins = {}, {}
    for across in ACROSS:
        folder = Path(mkdtemp(dir=work))
        try:
            simulate_contacts(folder / "warm", SENSOR, "surface-2d", 1, seed=SEED + 1, across=across)
            started = process_time()
            ends = simulate_contacts(folder / "all", SENSOR, "surface-2d", CONTACTS, seed=SEED, across=across)
            seconds = process_time() - started
            found[f"contacts_a_second_{across}"] = Value(CONTACTS / seconds, "1/s")
            states = len(open_simulated(ends, load_sensor(SENSOR))[0])
            found[f"states_a_second_{across}"] = Value(states / seconds, "1/s")
            simulate_contacts(folder / "end", SENSOR, "surface-2d", CONTACTS, seed=SEED, across=across, states="end")
            pins[across] = open_simulated(folder / "end", load_sensor(SENSOR))[1]["pins_px"]
        finally:
            rmtree(folder)
        found[f"off_px_{across}"] = Value(float(np.linalg.norm(pins[across] - pins[ACROSS[0]], axis=-1).mean()), "px")
    return found
