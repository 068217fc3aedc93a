"""Noise round a turn: cyclic, seeded, and one pattern at every size."""

import cv2
import numpy as np
import pytest

from simulators.noise import fractal_noise, lattice_noise


@pytest.mark.parametrize("cells", [(4, 8), (16, 32), (40, 360)])
def test_noise_wraps(cells: tuple[int, int]) -> None:
    noise = lattice_noise(np.random.default_rng(1), cells, (100, 360))
    inner = np.abs(np.diff(noise, axis=1)).max()
    assert np.abs(noise[:, 0] - noise[:, -1]).max() <= inner


def test_every_size_shows_the_same_pattern() -> None:
    small, large = (fractal_noise(np.random.default_rng(2), (8, 16), shape, 2) for shape in ((64, 128), (256, 512)))
    reduced = cv2.resize(large, small.shape[::-1], interpolation=cv2.INTER_AREA)
    assert np.corrcoef(small.ravel(), reduced.ravel())[0, 1] > 0.98
    assert 0.5 < large.std() < 1.3


def test_octaves_too_fine_are_left_out_without_shifting_what_is_drawn_next() -> None:
    seeds = np.random.default_rng(3), np.random.default_rng(3)
    coarse, fine = (lattice_noise(rng, (64, 64), shape) for rng, shape in zip(seeds, ((16, 16), (64, 64)), strict=True))
    assert not coarse.any() and fine.any()
    assert seeds[0].random() == seeds[1].random()
