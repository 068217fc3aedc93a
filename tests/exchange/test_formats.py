"""Which file is what, images included."""

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

from exchange.errors import ExchangeError
from exchange.formats import ReadOptions, read_scan, suffix_of
from exchange.image import encode_png, read_image
from exchange.whole_file import check_place, whole_file


@pytest.mark.parametrize(("name", "suffix"), [("a.glb", ".glb"), ("A.OBJ.ZIP", ".obj.zip"), ("d/x.y.npz", ".npz")])
def test_the_suffix_is_the_format(name: str, suffix: str) -> None:
    assert suffix_of(name) == suffix


@pytest.mark.parametrize("name", ["model", "model.xyz", "model.obj", "model.zip", ".glb.bak"])
def test_other_suffixes_are_refused_with_those_we_write(name: str) -> None:
    with pytest.raises(
        ExchangeError, match=r"cannot tell its format; end it in \.glb, \.ply, \.obj\.zip, \.stl, \.npz"
    ):
        suffix_of(name)


def test_a_mesh_is_cast_on_the_size_asked_for(tmp_path: Path) -> None:
    trimesh.creation.icosphere(radius=20).export(tmp_path / "ball.stl")
    shares: list[float] = []
    name, grid, _ = read_scan(tmp_path / "ball.stl", None, ReadOptions((36, 20, 48, 24), theta0_rad=1.0), shares.append)
    assert name == "ball" and grid.range_steps.shape == (20, 36) and grid.texture.shape == (24, 48, 3)
    assert grid.spec.theta0_rad == 1.0 and shares[-1] == 1


@pytest.mark.parametrize("name", ["notes.txt", "no_suffix"])
def test_a_file_of_another_kind_is_refused(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text("hello")
    with pytest.raises(ExchangeError, match=f"{name}: no scan: expected an Echo file"):
        read_scan(tmp_path / name)


def test_an_archive_is_to_be_unpacked(tmp_path: Path) -> None:
    (tmp_path / "head.obj.zip").write_bytes(b"PK")
    with pytest.raises(ExchangeError, match=r"head\.obj\.zip: an archive: unpack it"):
        read_scan(tmp_path / "head.obj.zip")


def test_a_refusal_names_the_file(tmp_path: Path) -> None:
    (tmp_path / "head.echo").write_bytes(b"Cyberware\nNLG=3\nDATA=\n")
    with pytest.raises(ExchangeError, match=r"head\.echo: NLT: missing"):
        read_scan(tmp_path / "head.echo")


def test_a_file_that_is_not_there_is_an_os_error(tmp_path: Path) -> None:
    for name in ("grid.npz", "mesh.glb"):
        with pytest.raises(FileNotFoundError):
            read_scan(tmp_path / name)


def test_png_is_lossless(tmp_path: Path) -> None:
    image = np.random.default_rng(0).integers(0, 256, (7, 9, 3)).astype(np.uint8)
    (tmp_path / "a.png").write_bytes(encode_png(image))
    assert np.array_equal(read_image(tmp_path / "a.png"), image)


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


PNG = b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", struct.pack(">IIBBBBB", 4, 4, 8, 2, 0, 0, 0))
NO_IMAGES = {
    "nothing": b"",
    "text": b"not an image",
    "a signature": PNG[:8],
    "cut in a header": PNG[:20],
    "cut behind it": PNG,
    "text that unpacks to megabytes": PNG + chunk(b"zTXt", b"a\0\0" + zlib.compress(bytes(2 << 20))),
    "larger than OpenCV decodes": b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 100000 +X 100000\n" + bytes(100),
}


@pytest.mark.parametrize("content", NO_IMAGES.values(), ids=NO_IMAGES)
def test_an_image_that_is_none_is_refused(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(content)
    with pytest.raises(ExchangeError, match=r"texture: .*a\.png is no image"):
        read_image(tmp_path / "a.png")


def test_an_image_too_large_is_refused_before_it_is_decoded(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((1, 16385), np.uint8))
    with pytest.raises(ExchangeError, match="16385 x 1 texels, at most 16384 x 16384"):
        read_image(tmp_path / "a.png")


def test_a_whole_file_appears_at_the_end_and_replaces_what_was_there(tmp_path: Path) -> None:
    target = tmp_path / "model.glb"
    target.write_bytes(b"old")
    with whole_file(target) as file:
        file.write(b"new")
        assert target.read_bytes() == b"old"
    assert target.read_bytes() == b"new" and list(tmp_path.iterdir()) == [target]


def test_a_place_that_cannot_be_written_is_named_by_the_target_alone(tmp_path: Path) -> None:
    target = tmp_path / "none" / "model.glb"
    for attempt in (check_place, lambda path: whole_file(path).__enter__()):
        with pytest.raises(FileNotFoundError) as refused:
            attempt(target)
        assert refused.value.filename == str(target) and str(refused.value).count("'") == 2
    with pytest.raises(IsADirectoryError, match=str(tmp_path)):
        check_place(tmp_path)
    check_place(tmp_path / "model.glb")
    assert list(tmp_path.iterdir()) == []


def test_a_failed_write_leaves_the_older_file_and_nothing_beside_it(tmp_path: Path) -> None:
    target = tmp_path / "model.glb"
    target.write_bytes(b"old")
    with pytest.raises(OSError, match="disk full"), whole_file(target) as file:
        file.write(b"half")
        raise OSError("disk full")
    assert target.read_bytes() == b"old" and list(tmp_path.iterdir()) == [target]
