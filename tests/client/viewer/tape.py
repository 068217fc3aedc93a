"""The shortest way over a surface that is known, found by trying: no part of it is the page's."""

from __future__ import annotations

import heapq
import math

import numpy as np

from protocol.grid import FloatArray

REACH = 4  # samples that one piece of a way spans at most, each way: so its length is at most 0.4% too long
STEPS = [
    (down, right)
    for down in range(-REACH, REACH + 1)
    for right in range(-REACH, REACH + 1)
    if math.gcd(down, right) == 1
]


def shortest_mm(points: FloatArray, start: tuple[int, int], end: tuple[int, int]) -> float:
    """Length of the shortest way from one sample to another over a surface. points : (rows, columns, 3) mm"""
    rows, columns, _ = points.shape
    known = np.full((rows, columns), math.inf)
    known[start] = 0
    ahead = [(0.0, start)]
    while ahead:
        length, (row, column) = heapq.heappop(ahead)
        if (row, column) == end:
            return length
        if length > known[row, column]:
            continue
        for down, right in STEPS:
            at = (row + down, column + right)
            if not (0 <= at[0] < rows and 0 <= at[1] < columns):
                continue
            further = length + math.dist(points[row, column], points[at])
            if further < known[at]:
                known[at] = further
                heapq.heappush(ahead, (further, at))
    raise ValueError("no way leads there")
