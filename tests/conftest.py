"""What every test shares: hypothesis without a stopwatch, since two busy cores make slow examples look like failures.

In CI (the variable CI is set) hypothesis loads its own profile: the same examples every time, and no stopwatch either.
"""

import os

from hypothesis import settings

settings.register_profile("local", deadline=None)
if "CI" not in os.environ:
    settings.load_profile("local")
