"""Models as files: the suffix is the format."""

from __future__ import annotations

from pathlib import Path

from exchange.formats import suffix_of, writer_of
from exchange.whole_file import whole_file
from protocol.grid import Grid


def check_suffix(path: str | Path) -> None:
    """Raises ExchangeError when a file of this name cannot be written, before any work is done for it."""
    suffix_of(path)


def write_grid(grid: Grid, path: str | Path) -> None:
    """Write a model in the format its suffix names (.glb, .ply, .obj.zip, .stl, .npz): the whole file or nothing.

    Raises ExchangeError for a format we do not write or a model that spans no surface, OSError for the file.
    """
    write = writer_of(suffix_of(path))
    with whole_file(path) as file:
        write(grid, file)
