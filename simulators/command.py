"""`foveascan simulate`: a software scanner as a program of its own, on a line that the node opens like any other."""

from __future__ import annotations

import argparse
import json
import math
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from simulators.carriers import PtyPort
    from simulators.specimen import Specimen

BITS_PER_BYTE = 10  # on a serial line: start, eight data, stop


def add_subcommands(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Offer `simulate`."""
    simulate = subparsers.add_parser("simulate", help="a software scanner with known truth, on a pseudo terminal")
    simulate.add_argument("--link", choices=("pty",), default="pty", help="what the node opens (pty)")
    simulate.add_argument("--path", required=True, type=Path, help="symbolic link to create for the node to open")
    simulate.add_argument(
        "--specimen",
        default="head",
        metavar="NAME|FILE",
        help="head, nutcracker, sphere, cylinder, or a .npz grid, mesh or Echo file (head)",
    )
    simulate.add_argument("--texture", type=Path, metavar="IMAGE", help="texture of a specimen from a file")
    simulate.add_argument("--size", choices=("S", "M", "L"), default="S", help="of a generated specimen or a mesh (S)")
    simulate.add_argument("--seed", type=_whole(0, 2**32 - 1), default=0, help="of specimen and jitter (0)")
    simulate.add_argument(
        "--turn", type=_real(0.01, 3600), default=1.0, metavar="S", help="time of a turn, where the line allows (1)"
    )
    simulate.add_argument(
        "--jitter", type=_real(0, 1e6), default=0.0, metavar="COUNTS", help="deviation of the triggers (0)"
    )
    speed = simulate.add_mutually_exclusive_group()
    speed.add_argument("--baud", type=_whole(300, 10**9), default=3_000_000, help="of the line (3000000)")
    speed.add_argument(
        "--link-rate", type=_real(30, 1e9), metavar="BYTES_S", help="bytes a second over the line, instead of --baud"
    )
    simulate.add_argument("--truth", type=Path, metavar="FILE", help="write what the node should see, as a .npz grid")
    simulate.add_argument("--json", action="store_true", help="print one JSON object a line")
    simulate.set_defaults(run=run_simulate)


def run_simulate(args: argparse.Namespace) -> int:
    """Serve sweeps until SIGTERM or SIGINT."""
    from exchange.native import write_native
    from exchange.whole_file import whole_file
    from simulators.carriers import PtyPort, serve
    from simulators.scanner import SimulatedScanner
    from simulators.specimen import make_specimen
    from simulators.turntable import Turntable

    specimen = make_specimen(args.specimen, args.size, args.texture, args.seed)
    if args.truth is not None:
        with whole_file(args.truth) as file:
            write_native(specimen.grid, file, specimen.name)
    table = Turntable(specimen, turn_s=args.turn, jitter_counts=args.jitter, seed=args.seed)
    baud = args.baud if args.link_rate is None else round(BITS_PER_BYTE * args.link_rate)
    with closing(PtyPort(args.path, baud)) as port, _stopped_by_signals(port) as stop:
        print(_ready(args, specimen, baud), flush=True)
        serve(SimulatedScanner(table), port, stop)
    return 0


def _ready(args: argparse.Namespace, specimen: Specimen, baud: int) -> str:
    """The line that says that the scanner can be opened now."""
    spec = specimen.grid.spec
    if args.json:
        shape = {"range": [spec.height, spec.width], "texture": [spec.texture_height, spec.texture_width]}
        report = {"ready": True, "path": str(args.path), "specimen": specimen.name, "shape": shape, "baud": baud}
        return json.dumps(report)
    return (
        f"Scanner ready at {args.path}: {specimen.name}, range {spec.width} x {spec.height}, "
        f"texture {spec.texture_width} x {spec.texture_height}, {baud} baud. Ctrl-C ends it."
    )


@contextmanager
def _stopped_by_signals(port: PtyPort) -> Iterator[threading.Event]:
    """An event that SIGTERM and SIGINT set, waking whoever reads the port."""
    stop = threading.Event()

    def end(*_: object) -> None:
        stop.set()
        port.cancel()

    before = {number: signal.signal(number, end) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _whole(low: int, high: int) -> Callable[[str], int]:
    """A whole number within bounds, for argparse."""

    def number(text: str) -> int:
        value = int(text)
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f"{text} is not between {low} and {high}")
        return value

    return number


def _real(low: float, high: float) -> Callable[[str], float]:
    """A finite number within bounds, for argparse."""

    def number(text: str) -> float:
        value = float(text)
        if not (math.isfinite(value) and low <= value <= high):
            raise argparse.ArgumentTypeError(f"{text} is not between {low:g} and {high:g}")
        return value

    return number
