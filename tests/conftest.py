"""What every test shares: hypothesis without a stopwatch, since two busy cores make slow examples look like failures.

In CI (the variable CI is set) hypothesis loads its own profile: the same examples every time, and no stopwatch either.
"""

import os

import pytest
from hypothesis import settings

settings.register_profile("local", deadline=None)
if "CI" not in os.environ:
    settings.load_profile("local")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--soak", type=int, default=0, metavar="N", help="sweep N times more with random faults")
    parser.addoption("--scanner", metavar="PATH", help="test with this scanner: a path, usb:VID:PID[:SERIAL] ...")
