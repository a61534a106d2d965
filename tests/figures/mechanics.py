"""The skin against CalculiX, Hertz, a finer mesh and its own first version."""

from pathlib import Path

import bench_mechanics
import finer_mesh
import hertz
from against_calculix import compare
from block import material

from figures.jobs import Measured, Value, job
from twin.geometry.solid import Resolution

SENSOR = ("mg400-331",)
REPEATS = 3


@job("mechanics.calculix", "pytest -m slow -s tests/system/test_calculix.py", sensors=SENSOR, code=("against_calculix",), minutes=1)
def against_calculix(work: Path) -> Measured:
    """At the deepest press (3 mm), default mesh: relative force, and the caps' largest error over the largest displacement."""
    found = {}
    for name in ("plane", "sphere"):
        force, _, caps = compare(name, Resolution().across)[-1]
        found |= {f"{name}_force": Value(float(force)), f"{name}_caps": Value(float(caps))}
    return found | {"caps": Value(max(found["plane_caps"].value, found["sphere_caps"].value))}


SHORT = {"tilted cylinder": "cylinder", "square rod": "rod"}
"""Names of contacts in figures, where they are not those of ``finer_mesh``."""


@job("mechanics.mesh", "pytest -m slow -s tests/system/test_mesh_convergence.py", sensors=SENSOR, code=("finer_mesh",), minutes=3)
def against_a_finer_mesh(work: Path) -> Measured:
    """Caps on average and at most over the largest displacement, and the force, by contact."""
    solvers, found = finer_mesh.make_solvers(), {}
    for case in finer_mesh.CASES:
        off, _ = finer_mesh.errors_of(solvers, case)
        found |= {f"{SHORT.get(case, case).replace(' ', '_')}_{key}": Value(value) for key, value in vars(off).items()}
    return found | {"force": Value(max(value.value for name, value in found.items() if name.endswith("_force")))}


@job("mechanics.hertz", "pytest -m slow -s tests/system/test_hertz.py", code=("hertz",), minutes=2)
def against_hertz(work: Path) -> Measured:
    """A rigid sphere on a half space, Poisson's ratio 0.3: relative errors of force and contact radius."""
    spec = material(young_mpa=1.0, poisson=0.3)
    force, radius, _ = hertz.errors(spec, hertz.indent(spec, fine=4))
    return {"force": Value(force), "radius": Value(radius)}


@job("mechanics.speed", "tests/bench/bench_mechanics.py", sensors=SENSOR, code=("twin.mechanics",), minutes=5)
def speed(work: Path) -> Measured:
    """CPU time of converged states on one thread, and against the first version on the same contacts."""
    now, first = bench_mechanics.in_child(REPEATS), bench_mechanics.first_version(REPEATS)
    each = [now[title][0] / now[title][1] for title in bench_mechanics.CONTACTS]
    found = {
        "least_s_a_state": Value(min(each), "s"),
        "most_s_a_state": Value(max(each), "s"),
        "tap_and_shear_s": Value(now["plane, tap and shear"][0], "s"),
        "mesh_ratio": Value(now[bench_mechanics.BALL][0] / now["sphere"][0]),
        "sampling_s": Value(now["sampling"], "s"),
    }
    if first:
        done = [title for title in bench_mechanics.CONTACTS if not isinstance(first[title][2], str)]
        ratio = {title: first[title][0] / now[title][0] for title in done}
        by_state = {title: ratio[title] * now[title][1] / first[title][1] for title in done}
        found |= {"least_ratio_to_first": Value(min(ratio.values())), "least_ratio_to_first_by_state": Value(min(by_state.values()))}
    return found
