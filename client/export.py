"""Models as files: what each suffix means, and the native grid as .npz."""

from __future__ import annotations

import os
import secrets
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

import numpy as np

from client.errors import ExportError
from protocol.grid import Grid


def check_suffix(path: str | Path) -> None:
    """Raises ExportError when a file of this name cannot be written, before any work is done for it."""
    if Path(path).suffix.lower() not in WRITERS:
        raise ExportError(
            f"{path}: cannot write {Path(path).suffix or 'a file without suffix'}; use {', '.join(WRITERS)}"
        )


def write_grid(grid: Grid, path: str | Path) -> None:
    """Write a model in the format its suffix names: the whole file or nothing.

    Raises ExportError for a format we do not write, OSError when the file cannot be written.
    """
    check_suffix(path)
    target = Path(path)
    temporary = target.with_name(f".{target.name}.{secrets.token_hex(4)}")
    try:
        with open(temporary, "xb") as file:
            WRITERS[target.suffix.lower()](grid, file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, target)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def _write_npz(grid: Grid, file: BinaryIO) -> None:
    """The native grid: range_steps (H, W) uint16, 0 = void; texture (Ht, Wt, 3) uint8; lengths in mm, angle in rad."""
    s = grid.spec
    np.savez(
        file,
        range_steps=grid.range_steps,
        texture=grid.texture,
        step_mm=s.step_mm,
        pitch_mm=s.pitch_mm,
        z_max_mm=s.z_max_mm,
        theta0_rad=s.theta0_rad,
    )


WRITERS: dict[str, Callable[[Grid, BinaryIO], None]] = {".npz": _write_npz}
