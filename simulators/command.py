"""`foveascan simulate`: a software scanner as a program of its own, on a line that the node opens like any other."""

from __future__ import annotations

import argparse
import json
import math
import shlex
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from simulators.carriers import ServedPort
    from simulators.faults import FaultyScanner
    from simulators.specimen import Specimen

LINKS = ("pty", "tcp", "usb", "gadget", "acm")
_SERIAL = ("pty", "acm")
BITS_PER_BYTE = 10  # on a serial line: start, eight data, stop
BAUD = 3_000_000
USB_BYTES_S = 35e6
USB_PORTION_BYTES = 253_000  # with a column more it fills one read of the node, as a device that has more to send does
SPECIMEN_HELP = "head, nutcracker, sphere, cylinder, post, pebble, or a .npz grid, mesh or Echo file (head)"


def add_subcommands(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Offer `simulate`."""
    simulate = subparsers.add_parser("simulate", help="a software scanner with known truth")
    simulate.add_argument("--link", choices=LINKS, default="pty", help="what the node opens (pty)")
    simulate.add_argument(
        "--path",
        required=True,
        type=Path,
        help="pty: symbolic link to create for the node to open; tcp: PORT or HOST:PORT to listen at (this machine"
        " alone; 0: any free port); usb: folder for the emulated device; gadget, acm: a device controller of this"
        " machine, as in /sys/class/udc, by which it is a real USB device, or a real serial port on USB (as root)",
    )
    simulate.add_argument(
        "--specimen",
        default="head",
        metavar="NAME|FILE",
        help=SPECIMEN_HELP,
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
    baud_help = "of the line (pty, acm: 3000000; tcp, usb, gadget: 35e6 bytes a second)"
    speed.add_argument("--baud", type=_whole(300, 10**9), help=baud_help)
    speed.add_argument(
        "--link-rate", type=link_rate, metavar="BYTES_S", help="bytes a second over the line, instead of --baud"
    )
    simulate.add_argument(
        "--faults",
        default="",
        metavar="NAME=VALUE,...",
        help="what goes wrong, e.g. flip=0.01,unplug=2; an unknown name lists them all",
    )
    simulate.add_argument("--order", choices=("live", "buffered"), default="live", help="of the columns (live)")
    simulate.add_argument(
        "--channels",
        choices=("any", "apart", "together"),
        default="any",
        help="what one turn takes: range and texture apart, together, or as asked for (any)",
    )
    simulate.add_argument(
        "--retention", type=_whole(1, 65535), default=65535, help="columns held to be sent again (65535)"
    )
    simulate.add_argument(
        "--axis",
        metavar="LATERAL,RADIAL[,LEAN,SIDE]",
        help="where the table's axis is, beside the one that the sensor believes in, in mm and degrees (0,0)",
    )
    simulate.add_argument("--serial-number", default="SIM-0001", help="of the scanner (SIM-0001)")
    simulate.add_argument("--truth", type=Path, metavar="FILE", help="write what the node should see, as a .npz grid")
    simulate.add_argument(
        "--closed", type=Path, metavar="FILE", help="write a closed specimen (pebble) whole, as a .npz grid of a sphere"
    )
    simulate.add_argument("--json", action="store_true", help="print one JSON object a line")
    simulate.set_defaults(run=run_simulate)


def run_simulate(args: argparse.Namespace) -> int:
    """Serve sweeps until SIGTERM or SIGINT."""
    from exchange.native import write_native
    from exchange.whole_file import whole_file
    from simulators.carriers import PORTION_BYTES, serve
    from simulators.specimen import make_specimen

    specimen = make_specimen(args.specimen, args.size, args.texture, args.seed)
    scanner = _scanner(args, _as_seen(args, specimen))
    for path, grid in ((args.truth, specimen.grid), (args.closed, specimen.closed)):
        if path is not None and grid is not None:
            with whole_file(path) as file:
                write_native(grid, file, specimen.name)
    portion = PORTION_BYTES if args.link in _SERIAL else USB_PORTION_BYTES
    with _port(args) as (port, about), _stopped_by_signals(port) as stop:
        print(_ready(args, specimen, about), flush=True)
        serve(scanner, port, stop, portion)
    return 0


def _as_seen(args: argparse.Namespace, specimen: Specimen) -> Specimen:
    """What the scanner sees of it: another thing where the axis is off centre. Raises UsageError."""
    from simulators.off_axis import parse_off_axis, seen_off_axis
    from simulators.specimen import Specimen

    if args.axis is None:
        return specimen
    return Specimen(specimen.name, seen_off_axis(specimen.grid, parse_off_axis(args.axis)))


def _scanner(args: argparse.Namespace, specimen: Specimen) -> FaultyScanner:
    """The scanner asked for, with its faults. Raises UsageError."""
    from protocol.framing import SERIAL_PAYLOAD_MAX, USB_PAYLOAD_MAX
    from protocol.scanner_messages import Order
    from simulators.faults import FaultyScanner, parse_faults
    from simulators.scanner import ANY_CHANNELS, APART, TOGETHER, SimulatedScanner
    from simulators.turntable import Turntable

    channels = {"any": ANY_CHANNELS, "apart": APART, "together": TOGETHER}
    faults, flaws = parse_faults(args.faults, args.seed)

    def boot(boot_id: int) -> SimulatedScanner:
        table = Turntable(specimen, turn_s=args.turn, jitter_counts=args.jitter, seed=args.seed, flaws=flaws)
        return SimulatedScanner(
            table,
            serial_number=args.serial_number,
            boot_id=boot_id,
            retention_columns=args.retention,
            payload_max=SERIAL_PAYLOAD_MAX if args.link in _SERIAL else USB_PAYLOAD_MAX,
            order=Order[args.order.upper()],
            channels=channels[args.channels],
        )

    return FaultyScanner(boot, faults, args.seed)


@contextmanager
def _port(args: argparse.Namespace) -> Iterator[tuple[ServedPort, dict[str, Any]]]:
    """The scanner's end of the line, and what the node has to know of it."""
    from simulators.carriers import PtyPort
    from simulators.tcp_carrier import TcpListener, parse_listen
    from simulators.tty_gadget import TtyGadget
    from simulators.usb_descriptors import CDC_IDENTITY, UsbIdentity
    from simulators.usb_gadget import UsbGadget
    from simulators.usb_testbed import BUS_SWITCH_S, UsbTestbed

    rate_bytes_s = args.link_rate or (args.baud or 0) / BITS_PER_BYTE
    if args.link == "usb":
        identity = UsbIdentity(serial_number=args.serial_number)
        sys.setswitchinterval(BUS_SWITCH_S)
        with closing(UsbTestbed(args.path, identity, rate_bytes_s or USB_BYTES_S)) as bed:
            yield bed, {"path": identity.address, "environment": bed.environment}
    elif args.link == "gadget":
        identity = UsbIdentity(serial_number=args.serial_number)
        with closing(UsbGadget(str(args.path), identity, rate_bytes_s or USB_BYTES_S)) as usb_gadget:
            yield usb_gadget, {"path": usb_gadget.name}
    elif args.link == "acm":
        identity = replace(CDC_IDENTITY, serial_number=args.serial_number)
        with closing(TtyGadget(str(args.path), identity, rate_bytes_s or BAUD / BITS_PER_BYTE)) as tty_gadget:
            yield tty_gadget, {"path": tty_gadget.name}
    elif args.link == "tcp":
        with closing(TcpListener(parse_listen(str(args.path)), rate_bytes_s or USB_BYTES_S)) as listener:
            yield listener, {"path": listener.name}
    else:
        baud = round(BITS_PER_BYTE * rate_bytes_s) or BAUD
        with closing(PtyPort(args.path, baud)) as pty:
            yield pty, {"path": str(args.path), "baud": baud}


def _ready(args: argparse.Namespace, specimen: Specimen, about: dict[str, Any]) -> str:
    """The line that says that the scanner can be opened now."""
    spec = specimen.grid.spec
    if args.json:
        shape = {"range": [spec.height, spec.width], "texture": [spec.texture_height, spec.texture_width]}
        is_closed = specimen.closed is not None
        return json.dumps({"ready": True, "specimen": specimen.name, "shape": shape, "closed": is_closed, **about})
    said = (
        f"Scanner ready at {about['path']}: {specimen.name}, range {spec.width} x {spec.height}, "
        f"texture {spec.texture_width} x {spec.texture_height}"
    )
    if args.link == "usb":
        variables = " ".join(f"{key}={shlex.quote(value)}" for key, value in about["environment"].items())
        return f"{said}. Start the node so: {variables} foveascan serve --scanner {about['path']} ... Ctrl-C ends it."
    return f"{said}{', {baud} baud'.format(**about) if 'baud' in about else ''}. Ctrl-C ends it."


@contextmanager
def _stopped_by_signals(port: ServedPort) -> Iterator[threading.Event]:
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


link_rate = _real(30, 1e9)  # bytes a second over a line
