"""Independent reference for the skin's mechanics, computed with CalculiX.

A rigid plane or sphere is pressed onto the dome on its axis, without friction: axisymmetric quadratic
elements with reduced integration (CAX8R), finite strain, face-to-face penalty contact, and the rubber

    W = C10 (I1bar - 3) + C01 (I2bar - 3) + (J - 1)^2 / D1,   C10 + C01 = mu / 2,   1 / D1 = kappa / 2.

The skin ends in the rim plane, where it is clamped; the gel fills it down to the flat lens and is clamped
there and at its side wall. Nothing is shared with the twin; geometry and materials are those below. Each case
is run on two nested meshes, and on the coarsest with a stiffer penalty as well: the file states what both change.

Run: python tests/reference/calculix.py [--cases plane sphere]. Results of other cases in the file are kept.
"""

import argparse
import json
import os
import re
import shutil
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter

import numpy as np

SENSOR = {
    "name": "mg400-331",
    "skin": {"young_modulus_mpa": 0.7, "poisson_ratio": 0.47, "outer_radius_mm": 20.0, "thickness_mm": 1.0, "rim_z_mm": 0.0},
    "gel": {"young_modulus_mpa": 0.02, "poisson_ratio": 0.47},
    "lens_z_mm": -2.0,
}
OUTER_MM, LENS_MM = SENSOR["skin"]["outer_radius_mm"], SENSOR["lens_z_mm"]
INNER_MM = OUTER_MM - SENSOR["skin"]["thickness_mm"]
DEPTHS_MM = (1.0, 2.0, 3.0)
PENALTY_MPA_MM, STIFFER_PENALTY_MPA_MM = 100.0, 400.0
SPLIT_DEG = 45.0  # where the gel's upper block ends; the contact stays above
TINY_MM = 1e-6


@dataclass(frozen=True)
class Case:
    """One object and material law.

    Attributes
    ----------
    sphere_mm : float
        Radius of the object, 0 for a plane.
    mooney : float
        C01 / (C10 + C01).
    sizes : (2,) int
        Meshes to compare; the finer one's results are kept.
    """

    sphere_mm: float = 0.0
    mooney: float = 0.0
    sizes: tuple[int, int] = (1, 2)


CASES = {"plane": Case(), "sphere": Case(sphere_mm=10.0, sizes=(2, 3)), "plane_mooney_rivlin": Case(mooney=0.5)}


@dataclass(frozen=True)
class Mesh:
    """Eight-node quadrilaterals in the r, z half plane: corners counter-clockwise, then mid-sides.

    Attributes
    ----------
    points_mm : (n, 2) float
    parts : dict
        "SKIN", "GEL", "TOOL" to (m, 8) int.
    sets : dict
        Node indices by name; those of a face run from the axis outwards.
    """

    points_mm: np.ndarray
    parts: dict
    sets: dict


def build(case: Case, size: int) -> Mesh:
    """Mesh of skin, gel and object at first touch; ``size`` 2 halves the elements of ``size`` 1.

    The gel is three four-sided blocks that meet in one point, so that no element is degenerate.
    """
    outer, inner, lens = OUTER_MM, INNER_MM, LENS_MM
    upper, lower, wall, deep, thick = (size * k for k in (20, 12, 2, 6, 2))
    axis, base, middle = (0.0, 0.35 * inner), (0.52 * inner, lens), (0.42 * inner, 0.27 * inner)
    fine = 0.4  # height of the first element under the skin, relative to the mean

    def dome(radius):
        return np.concatenate([_arc(radius, 0, SPLIT_DEG, upper), _arc(radius, SPLIT_DEG, 90, lower)[1:]])

    side = np.concatenate([_arc(inner, SPLIT_DEG, 90, lower), _line((inner, 0), (inner, lens), wall)[1:]])
    inward = _line(side[0], middle, deep, fine)
    roof, flank = _line(axis, middle, upper), _line(middle, base, lower + wall)
    blocks = {
        "SKIN": [_block(dome(inner), dome(outer), _line((0, inner), (0, outer), thick), _line((inner, 0), (outer, 0), thick))],
        "GEL": [
            _block(_arc(inner, 0, SPLIT_DEG, upper), roof, _line((0, inner), axis, deep, fine), inward),
            _block(side, flank, inward, _line((inner, lens), base, deep, fine)),
            _block(roof, _line((0, lens), base, upper), _line(axis, (0, lens), lower + wall), flank),
        ],
    }
    if case.sphere_mm:
        under, back = (_arc(r, 0, 80, 40, (outer + case.sphere_mm, -1)) for r in (case.sphere_mm, case.sphere_mm - 1))
    else:
        under, back = (_line((0, z), (0.95 * outer, z), 19) for z in (outer, outer + 1))
    blocks["TOOL"] = [_block(under, back, _line(under[0], back[0], 1), _line(under[-1], back[-1], 1))]
    points, parts = _joined(blocks)
    return Mesh(points, parts, _sets(points, parts, under))


def _arc(radius, start_deg, stop_deg, count, center=(0.0, 1)):
    angle = np.radians(np.linspace(start_deg, stop_deg, 2 * count + 1))
    return np.column_stack([radius * np.sin(angle), center[0] + center[1] * radius * np.cos(angle)])


def _line(start, stop, count, slope=1.0):
    s = np.linspace(0, 1, 2 * count + 1)[:, None]
    s = slope * s + (1 - slope) * s * s
    return np.array(start) * (1 - s) + np.array(stop) * s


def _block(first, last, left, right):
    """Grid of points between four sides (``first`` and ``last`` run alike; ``left`` and ``right`` join them)."""
    s, t = np.linspace(0, 1, len(first))[:, None, None], np.linspace(0, 1, len(left))[None, :, None]
    first, last, left, right = first[:, None], last[:, None], left[None], right[None]
    corners = (1 - s) * ((1 - t) * first[0] + t * last[0]) + s * ((1 - t) * first[-1] + t * last[-1])
    return (1 - t) * first + t * last + (1 - s) * left + s * right - corners


def _joined(blocks):
    """Points and parts of all blocks: equal points of skin and gel become one node, the object keeps its own."""
    points, parts, number = [], {}, {}
    low, mid, high = slice(0, -2, 2), slice(1, None, 2), slice(2, None, 2)
    order = [(low, low), (high, low), (high, high), (low, high), (mid, low), (high, mid), (mid, high), (low, mid)]
    for name, grids in blocks.items():
        cells = []
        for grid in grids:
            index = np.empty(grid.shape[:2], int)
            for at in np.ndindex(index.shape):
                key = (name == "TOOL", *(np.round(grid[at], 7) + 0.0))
                if key not in number:
                    number[key] = len(points)
                    points.append(grid[at])
                index[at] = number[key]
            cells.append(np.stack([index[k] for k in order], axis=-1).reshape(-1, 8))
        quads = np.concatenate(cells)
        r, z = np.array(points)[quads[:, :4]].transpose(2, 0, 1)
        turned = (r * np.roll(z, -1, 1) - z * np.roll(r, -1, 1)).sum(1) < 0
        quads[turned] = quads[turned][:, [0, 3, 2, 1, 7, 6, 5, 4]]
        parts[name] = quads
    return np.array(points), parts


def _sets(points, parts, under):
    r, z = points.T
    radius = np.hypot(r, z)
    skin, gel, tool = (np.unique(parts[name]) for name in ("SKIN", "GEL", "TOOL"))
    soft = np.union1d(skin, gel)
    clamped = (z < LENS_MM + TINY_MM) | ((r > INNER_MM - TINY_MM) & (z < TINY_MM))

    def outwards(nodes):
        return nodes[np.argsort(np.arctan2(r[nodes], z[nodes]))]

    return {
        "CLAMP": soft[clamped[soft]],
        "AXIS": soft[(r < TINY_MM)[soft] & ~clamped[soft]],
        "INNER": outwards(skin[abs(radius[skin] - INNER_MM) < TINY_MM]),
        "SKINFACE": outwards(skin[abs(radius[skin] - OUTER_MM) < TINY_MM]),
        "TOOL": tool,
        "TOOLFACE": tool[(abs(points[tool][:, None] - under).max(2) < TINY_MM).any(1)],
    }


def constants(part: str, mooney: float) -> tuple[float, float, float]:
    """C10, C01 (MPa) and D1 (1/MPa)."""
    young, poisson = SENSOR[part]["young_modulus_mpa"], SENSOR[part]["poisson_ratio"]
    mu, kappa = young / (2 * (1 + poisson)), young / (3 * (1 - 2 * poisson))
    return (1 - mooney) * mu / 2, mooney * mu / 2, 2 / kappa


def deck(mesh: Mesh, case: Case, penalty_mpa_mm: float) -> str:
    """The CalculiX input: all of the object's nodes move down together, so it is rigid."""
    lines = ["*NODE, NSET=ALL"]
    lines += [f"{k}, {r:.9f}, {z:.9f}, 0" for k, (r, z) in enumerate(mesh.points_mm, 1)]
    first, count = {}, 1
    for name, quads in mesh.parts.items():
        first[name] = count
        lines.append(f"*ELEMENT, TYPE=CAX8R, ELSET={name}")
        lines += [f"{k}, " + ", ".join(map(str, quad + 1)) for k, quad in enumerate(quads, count)]
        count += len(quads)
    for name, nodes in mesh.sets.items():
        lines += [f"*NSET, NSET={name}", *(f"{k + 1}," for k in nodes)]
    for part in ("SKIN", "TOOL"):
        lines.append(f"*SURFACE, NAME={part}FACE, TYPE=ELEMENT")
        on_face = np.isin(mesh.parts[part][:, 4:], mesh.sets[f"{part}FACE"])
        lines += [f"{first[part] + k}, S{side + 1}" for k, side in np.argwhere(on_face)]
    for name in ("SKIN", "GEL"):
        c10, c01, d1 = constants(name.lower(), case.mooney)
        law = f"MOONEY-RIVLIN\n{c10:.9g}, {c01:.9g}, {d1:.9g}" if case.mooney else f"NEO HOOKE\n{c10:.9g}, {d1:.9g}"
        lines.append(f"*MATERIAL, NAME={name}\n*HYPERELASTIC, {law}\n*SOLID SECTION, ELSET={name}, MATERIAL={name}")
    end = DEPTHS_MM[-1]
    lines += ["*MATERIAL, NAME=TOOL", "*ELASTIC", "1000, 0.3", "*SOLID SECTION, ELSET=TOOL, MATERIAL=TOOL"]
    lines += ["*SURFACE INTERACTION, NAME=HARD", "*SURFACE BEHAVIOR, PRESSURE-OVERCLOSURE=LINEAR", f"{penalty_mpa_mm:g}"]
    lines += ["*CONTACT PAIR, INTERACTION=HARD, TYPE=SURFACE TO SURFACE", "SKINFACE, TOOLFACE"]
    lines += ["*TIME POINTS, NAME=DEPTHS", ", ".join(f"{depth:g}" for depth in DEPTHS_MM)]
    lines += ["*BOUNDARY", "CLAMP, 1, 2", "AXIS, 1, 1", "TOOL, 1, 1"]
    lines += ["*STEP, NLGEOM, INC=1000", "*STATIC", f"0.2, {end:g}, 1e-6, 0.4", "*BOUNDARY", f"TOOL, 2, 2, {-end:g}"]
    for name in ("TOOL", "CLAMP"):
        lines += [f"*NODE PRINT, NSET={name}, TOTALS=ONLY, TIME POINTS=DEPTHS", "RF"]
    for name in ("INNER", "SKINFACE"):
        lines += [f"*NODE PRINT, NSET={name}, TIME POINTS=DEPTHS", "U"]
    return "\n".join([*lines, "*END STEP", ""])


def solve(text: str, scratch: Path) -> dict:
    """Run CalculiX in a folder.

    Returns
    -------
    dict of (set, time) to rows
        Of TOOL and CLAMP: the total force in N, of 2 degrees of azimuth. Else: node, displacement in mm.
    """
    scratch.mkdir(parents=True, exist_ok=True)
    (scratch / "press.inp").write_text(text)
    done = subprocess.run(["ccx", "press"], cwd=scratch, capture_output=True, text=True, env=os.environ | {"OMP_NUM_THREADS": "1"})
    (scratch / "press.log").write_text(done.stdout + done.stderr)
    if done.returncode or "Job finished" not in done.stdout:
        raise SystemExit(f"ccx failed, its last words:\n{done.stdout[-1500:]}{done.stderr[-500:]}")
    printed = (scratch / "press.dat").read_text()
    found = re.findall(r"for set (\w+) and time +(\S+)\n\n(.*?)(?:\n\n|\Z)", printed, re.DOTALL)
    return {(name, round(float(time), 6)): np.array([line.split() for line in rows.splitlines()], float) for name, time, rows in found}


def run(case: Case, size: int, penalty_mpa_mm: float, scratch: Path) -> dict:
    """One press on one mesh.

    Returns
    -------
    dict
        ``polar_deg`` (k,): points along the skin's inside (0: apex). ``states``, one per indentation: the object's and
        the clamps' force (N), contact radius (mm), deepest node of the skin in the object (mm; apart from it in the
        three nodes next to the axis), ``u_rz_mm`` (k, 2): displacement of the points. ``run``: mesh, penalty, duration.
    """
    mesh = build(case, size)
    start = perf_counter()
    rows = solve(deck(mesh, case, penalty_mpa_mm), scratch)
    states, outside = [], mesh.points_mm[mesh.sets["SKINFACE"]]
    keep = slice(None, None, size)  # every mesh reports where the coarsest has nodes
    for depth in DEPTHS_MM:
        # an axisymmetric model is solved as a wedge of 2 degrees: 180 of them are the whole
        force, clamp = (180 * abs(rows[name, depth][0, 1]) for name in ("TOOL", "CLAMP"))
        moved = outside + rows["SKINFACE", depth][:, 1:3]
        gap = _gap(moved, OUTER_MM - depth, case.sphere_mm)
        state = {"indent_mm": depth, "force_n": force, "clamp_force_n": clamp, "contact_radius_mm": _contact_radius(moved[:, 0], gap)}
        state |= {"penetration_mm": -gap[3:].min(), "axis_penetration_mm": -gap[:3].min()}
        states.append(state | {"u_rz_mm": rows["INNER", depth][keep, 1:3]})
    inside = mesh.points_mm[mesh.sets["INNER"]][keep]
    about = {"size": size, "penalty_mpa_mm": penalty_mpa_mm, "seconds": perf_counter() - start}
    about |= {f"{name.lower()}_elements": len(quads) for name, quads in mesh.parts.items()}
    return {"run": about, "polar_deg": np.degrees(np.arctan2(*inside.T)), "states": states}


def _gap(points_mm, lowest_mm, sphere_mm):
    """Distance of points to the object; negative inside it."""
    r, z = points_mm.T
    return np.hypot(r, z - lowest_mm - sphere_mm) - sphere_mm if sphere_mm else lowest_mm - z


def _contact_radius(radius_mm, gap_mm):
    """Where the gap opens: outside the contact it grows as the square of the distance to its edge."""
    first = int(np.argmax(gap_mm > 0.002))
    return float(np.polynomial.Polynomial.fit(np.sqrt(gap_mm[first : first + 4]), radius_mm[first : first + 4], 1)(0.0))


def difference(a: dict, b: dict) -> dict:
    """Per indentation: force of ``a`` against ``b`` (%), contact radius (mm), largest distance of displacements (mm)."""
    pairs = list(zip(a["states"], b["states"], strict=True))
    return {
        "force_percent": [100 * (s["force_n"] / t["force_n"] - 1) for s, t in pairs],
        "contact_radius_mm": [s["contact_radius_mm"] - t["contact_radius_mm"] for s, t in pairs],
        "displacement_mm": [np.linalg.norm(s["u_rz_mm"] - t["u_rz_mm"], axis=1).max() for s, t in pairs],
    }


def _plain(value):
    """Numbers rounded for the file."""
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [_plain(v) for v in value]
    return float(f"{value:.6g}") if isinstance(value, float) else value


def main() -> None:
    """Run the cases and write them to the JSON file."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--cases", nargs="+", choices=CASES, default=list(CASES))
    parser.add_argument("--out", type=Path, default=Path(__file__).with_suffix(".json"))
    parser.add_argument("--scratch", type=Path, help="keep CalculiX's files here")
    args = parser.parse_args()
    if not shutil.which("ccx"):
        raise SystemExit("ccx is not installed; install the Debian package calculix-ccx: apt-get install calculix-ccx")
    version = subprocess.run(["ccx", "-v"], capture_output=True, text=True).stdout.split()[-1]
    about = {"solver": f"CalculiX {version}, CAX8R, face-to-face penalty contact, frictionless", "sensor": SENSOR}
    held = json.loads(args.out.read_text()) if args.out.exists() else {}
    results = held["cases"] if {k: held.get(k) for k in about} == about else {}
    with tempfile.TemporaryDirectory() as temporary:
        for name in args.cases:
            case, scratch, runs = CASES[name], args.scratch or Path(temporary), {}
            for size, penalty in ((1, PENALTY_MPA_MM), (1, STIFFER_PENALTY_MPA_MM), *((size, PENALTY_MPA_MM) for size in case.sizes)):
                if (size, penalty) not in runs:
                    runs[size, penalty] = run(case, size, penalty, scratch / f"{name}-{size}-{penalty:g}")
            first, stiffer, *_ = runs.values()
            coarse, fine = (runs[size, PENALTY_MPA_MM] for size in case.sizes)
            against = {"coarse_against_fine": difference(coarse, fine), "stiffer_penalty": difference(stiffer, first)}
            rubber = {f"{part}_c10_c01_d1": constants(part, case.mooney) for part in ("skin", "gel")}
            results[name] = {"sphere_radius_mm": case.sphere_mm or None} | rubber | {"runs": [r["run"] for r in runs.values()]} | against
            results[name] |= {"polar_deg": fine["polar_deg"], "states": fine["states"]}
            print(name, [round(float(s["force_n"]), 4) for s in fine["states"]], "N", _plain(against), flush=True)
            text = json.dumps(_plain(about | {"cases": results}), indent=1)
            text = re.sub(r"\[[-\d.e+,\s\[\]]+\]", lambda numbers: re.sub(r"\s+", "", numbers[0]).replace(",", ", "), text)
            args.out.write_text(text + "\n")


if __name__ == "__main__":
    main()
