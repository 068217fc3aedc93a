"""Golden vectors of lattices round a direction, for this project's every language.

`python tests/golden/write_sphere.py` writes tests/golden/sphere/lattices.json anew; tests only read it. Angles are
radians. rings: grid [W, H], fovea [theta_v, theta_h], plateau [cap, spacing, rho, coarse]; bearings by ring; row and
column of the snapped directions. literal: down and across are [count, alpha, s]; the lattice as printed and rotated.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

from protocol.sphere import (
    DirectionGrid,
    Spread,
    literal_lattice,
    plateau_and_skirt,
    ring_lattice,
    rotated_lattice,
)

FILE = Path(__file__).with_name("sphere") / "lattices.json"
RHO_E = 178145  # round(65536 e), S' = 1
FOVEAE = [(0.0, 0.0), (math.pi, 1.0), (math.pi / 2, 0.0), (0.05, 6.28), (1.1, 3.3)]
GRIDS = [(360, 184), (40, 17)]
PLATEAUS = [(0.1, 0.0175, RHO_E, 0.3), (0.2, 0.05, 0, 0.3)]
SPREADS = [((8, 0.5, 20.0), (8, 0.5, 20.0)), ((3, 2.0, 8.0), (5, 0.1, 30.0))]
Pair = tuple[float, float]


def rings(grid: tuple[int, int], fovea: Pair, plateau: tuple[float, float, int, float]) -> dict[str, Any]:
    """One case of the default lattice."""
    circles = plateau_and_skirt(*plateau)
    row, column = ring_lattice(DirectionGrid(*grid), *fovea, circles)
    return {
        "grid": grid, "fovea": fovea, "plateau": plateau, "bearings": circles.bearings.tolist(),
        "row": row.tolist(), "column": column.tolist(),
    }  # fmt: skip


def literal(
    grid: tuple[int, int], fovea: Pair, down: tuple[int, float, float], across: tuple[int, float, float]
) -> dict[str, Any]:
    """One case of the paper's lattice, as printed and rotated."""
    case: dict[str, Any] = {"grid": grid, "fovea": fovea, "down": down, "across": across}
    for name, lattice in (("literal", literal_lattice), ("rotated", rotated_lattice)):
        row, column = DirectionGrid(*grid).snap_unique(*lattice(*fovea, Spread(*down), Spread(*across)))
        case |= {f"{name}_row": row.tolist(), f"{name}_column": column.tolist()}
    return case


def main() -> None:
    """Write the file."""
    cases = {
        "rings": [rings(grid, fovea, plateau) for grid in GRIDS for fovea in FOVEAE for plateau in PLATEAUS],
        "literal": [literal(GRIDS[0], fovea, *spreads) for fovea in FOVEAE for spreads in SPREADS],
    }
    lines = {name: ",\n  ".join(json.dumps(case) for case in entries) for name, entries in cases.items()}
    FILE.write_text("{\n" + ",\n".join(f'"{name}": [\n  {text}\n]' for name, text in lines.items()) + "\n}\n")


if __name__ == "__main__":
    main()
