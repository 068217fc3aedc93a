"""JPEG 2000 code streams with precincts: made by OpenJPEG's opj_compress, taken apart into packets, put together again.

A packet left out is one zero byte in its place, which says "nothing here": so what a JPIP client would hold can be
decoded by any decoder. Packets stand in layer-resolution-component-position order, their lengths in PLT markers.
"""

from __future__ import annotations

import shutil
import struct
import subprocess
import tempfile
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import cv2
import imagecodecs
import numpy as np
from numpy.typing import NDArray

from tests.bench.cache import Cache
from tests.bench.scans import Skipped

ENCODER = "opj_compress"
RESOLUTIONS = 7
EMPTY = b"\0"
_SOT, _SOD, _PLT, _EOC = 0xFF90, 0xFF93, 0xFF58, b"\xff\xd9"


@dataclass(frozen=True)
class Layout:
    """How an image is cut up.

    precincts : side of a precinct in each resolution, finest first.  block : side of a code block.
    psnr : of each layer [dB], rising.
    """

    precincts: tuple[int, ...]
    block: int
    psnr: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class CodeStream:
    """A code stream in pieces.

    head : main header.  packets : in order.  precincts : (across, down) of each resolution, coarsest first.
    """

    head: bytes
    packets: tuple[bytes, ...]
    shape: tuple[int, ...]
    layout: Layout
    precincts: tuple[tuple[int, int], ...]

    @property
    def components(self) -> int:
        return 3 if len(self.shape) == 3 else 1

    @property
    def grid(self) -> tuple[int, int]:
        """Layers, and packets in each."""
        return self.layers, len(self.packets) // self.layers

    @cached_property
    def sizes(self) -> NDArray[np.int64]:
        """Bytes of each packet. (layers, packets of a layer)"""
        return np.array([len(packet) for packet in self.packets]).reshape(self.grid)

    def side(self, resolution: int) -> int:
        """Side of a resolution's precincts, in samples of the whole image."""
        level = len(self.precincts) - 1 - resolution
        return self.layout.precincts[level] << level

    @property
    def layers(self) -> int:
        return len(self.layout.psnr)

    def number(self, layer: int, resolution: int, component: int, precinct: int) -> int:
        """Place of a packet."""
        counts = [across * down for across, down in self.precincts]
        before = sum(counts[:resolution]) * self.components + component * counts[resolution] + precinct
        return layer * sum(counts) * self.components + before

    def decode(self, wanted: NDArray[np.bool_]) -> np.ndarray:
        """The image from the packets that are wanted."""
        body = b"".join(
            packet if keep else EMPTY for packet, keep in zip(self.packets, wanted.ravel().tolist(), strict=True)
        )
        tile = struct.pack(">HHHIBBH", _SOT, 10, 0, len(body) + 14, 0, 1, _SOD)
        return np.asarray(imagecodecs.jpeg2k_decode(self.head + tile + body + _EOC))


def make(image: np.ndarray, layout: Layout, cache: Cache, key: str) -> CodeStream:
    """Encode an image (h, w, 3) uint8 or (h, w) uint16. Raises Skipped where there is no encoder."""
    if shutil.which(ENCODER) is None:
        raise Skipped(f"{ENCODER} is not installed (apt-get install libopenjp2-tools)")
    data = cache.blob("rivals.codestream", f"{key} {layout}", lambda: _encode(image, layout))
    return _parse(data, image.shape, layout)


def _encode(image: np.ndarray, layout: Layout) -> bytes:
    precincts = ",".join(f"[{side},{side}]" for side in layout.precincts)
    with tempfile.TemporaryDirectory(prefix="foveascan-bench-") as folder:
        source, target = Path(folder) / ("image.ppm" if image.ndim == 3 else "image.pgm"), Path(folder) / "image.j2k"
        cv2.imwrite(str(source), image[..., ::-1] if image.ndim == 3 else image)
        quality = ",".join(f"{db:g}" for db in layout.psnr)
        command = [ENCODER, "-i", source, "-o", target, "-n", str(RESOLUTIONS), "-b", f"{layout.block},{layout.block}"]
        command += ["-c", precincts, "-q", quality, "-p", "LRCP", "-PLT", "-I"]
        done = subprocess.run([str(part) for part in command], capture_output=True, text=True)
        if done.returncode:
            raise Skipped(f"{ENCODER} failed: {(done.stderr or done.stdout).strip()[-200:]}")
        return target.read_bytes()


def _parse(data: bytes, shape: tuple[int, ...], layout: Layout) -> CodeStream:
    start = data.index(struct.pack(">HH", _SOT, 10))
    lengths: list[int] = []
    at = start + 12
    while (marker := int.from_bytes(data[at : at + 2], "big")) != _SOD:
        size = int.from_bytes(data[at + 2 : at + 4], "big")
        if marker == _PLT:
            lengths += _packet_lengths(data[at + 5 : at + 2 + size])
        at += 2 + size
    ends = at + 2 + np.cumsum([0, *lengths])
    packets = tuple(data[a:b] for a, b in zip(ends[:-1].tolist(), ends[1:].tolist(), strict=True))
    stream = CodeStream(data[:start], packets, shape, layout, _precincts(shape, layout))
    counted = stream.layers * stream.components * sum(across * down for across, down in stream.precincts)
    assert len(packets) == counted, f"{len(packets)} packets, {counted} expected"
    return stream


def _packet_lengths(body: bytes) -> list[int]:
    lengths, value = [], 0
    for byte in body:
        value = value << 7 | byte & 0x7F
        if not byte & 0x80:
            lengths.append(value)
            value = 0
    return lengths


def _precincts(shape: tuple[int, ...], layout: Layout) -> tuple[tuple[int, int], ...]:
    grids = []
    for level, side in reversed(list(enumerate(layout.precincts))):
        height, width = -(-shape[0] // (1 << level)), -(-shape[1] // (1 << level))
        grids.append((-(-width // side), -(-height // side)))
    return tuple(grids)
