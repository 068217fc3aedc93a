"""Models as files: the suffix is the format."""

from __future__ import annotations

from pathlib import Path

from exchange.formats import suffix_of, writer_of
from exchange.whole_file import check_place, whole_file
from protocol.grid import Grid


def check_target(path: str | Path) -> None:
    """Raises ExchangeError for a suffix that we do not write, OSError for a place; before any work is done for it."""
    suffix_of(path)
    check_place(path)


def write_grid(grid: Grid, path: str | Path) -> None:
    """Write a model in the format its suffix names (.glb, .ply, .obj.zip, .stl, .npz): the whole file or nothing.

    Raises ExchangeError for a format we do not write or a model that spans no surface, OSError for the file.
    """
    write = writer_of(suffix_of(path))
    with whole_file(path) as file:
        write(grid, file)
