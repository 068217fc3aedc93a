"""How long the end of a node may take, and what happens when that is over."""

import subprocess
import sys

from node.ending import ALL_BY_S, AUDIT_BY_S, CAPTURE_BY_S, GOODBYES_BY_S, Ending

STUCK = """
import sys, threading, time
sys.path.insert(0, {path!r})
from node.ending import Ending
threading.Thread(target=time.sleep, args=(600,), name="of the disk").start()
Ending(of_process=True).begin()
"""


def test_steps_share_one_time_that_runs_from_the_first() -> None:
    ending = Ending()
    assert CAPTURE_BY_S < GOODBYES_BY_S < AUDIT_BY_S < ALL_BY_S < 5
    first = ending.left_s(CAPTURE_BY_S)
    ending.begin()
    assert 0 <= ending.left_s(CAPTURE_BY_S) <= first <= CAPTURE_BY_S
    assert ending.left_s(0.0) == 0


def test_a_process_that_cannot_end_is_cut_off_and_says_who_kept_it() -> None:
    stuck = subprocess.run(
        [sys.executable, "-c", STUCK.format(path=sys.path[0])], capture_output=True, text=True, timeout=120
    )
    assert stuck.returncode == 0
    assert "the disk kept these waiting" in stuck.stderr and "of the disk" in stuck.stderr
