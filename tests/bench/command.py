"""The subcommand `bench`: which benchmark, on which scans, told how."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from protocol.errors import ConfigError

if TYPE_CHECKING:
    from tests.bench.scans import BenchScan

REPEATS = 9
CACHE = Path(__file__).resolve().parents[2] / ".bench_cache"

Told = tuple[dict[str, Any], str]


def run_bench(args: argparse.Namespace) -> int:
    """Run one benchmark and print its figures. Raises ConfigError where nothing can be measured."""
    from tests.bench.conditions import conditions

    scans, skipped = _scans(args)
    record, told = BENCHES[args.name](args, scans)
    record = {"bench": args.name, "conditions": conditions(), "skipped": skipped, **record}
    lines = [told, "", *(f"skipped: {reason}" for reason in skipped), _where(record["conditions"])]
    print(json.dumps(record) if args.json else "\n".join(lines), flush=True)
    return 0 if record.get("ok", True) else 1


def _scans(args: argparse.Namespace) -> tuple[list[BenchScan], list[str]]:
    """The scans asked for that are there, and why others are not. Raises ConfigError where none is."""
    from tests.bench.scans import STANDARD, Skipped, load

    if args.name in ("sphere", "fuzz"):
        return [], []  # they make their own objects
    specimens = tuple(args.specimen or (("head",) if args.name in ("line", "capture", "page", "load") else STANDARD))
    if args.texture and len(specimens) != 1:
        raise ConfigError("bench: --texture goes with one --specimen FILE")
    scans, skipped = [], []
    for specimen in specimens:
        try:
            scans.append(load(specimen, args.size, args.texture))
        except Skipped as reason:
            skipped.append(str(reason))
    if not scans:
        raise ConfigError(f"bench: {'; '.join(skipped)}")
    return scans, skipped


def _line(args: argparse.Namespace, scans: list[BenchScan]) -> Told:
    from tests.bench import line

    record = line.run(scans[0], args.clicks, args.repeats)
    return record, line.told(record)


def _roi(args: argparse.Namespace, scans: list[BenchScan]) -> Told:
    from tests.bench import plots, roi
    from tests.bench.cache import Cache
    from tests.bench.rivals.contestants import RIVALS

    rivals = args.rival or tuple(RIVALS)
    for rival in rivals:
        if rival not in RIVALS:
            raise ConfigError(f"bench: no rival {rival!r}; there are {', '.join(RIVALS)}")
    record = roi.run(scans, args.size, args.clicks, Cache(args.cache), rivals)
    if args.plots:
        record["plots"] = [str(path) for path in plots.draw(scans, args.size, args.plots, Cache(args.cache))]
    return record, roi.told(record)


def _session(args: argparse.Namespace, scans: list[BenchScan]) -> Told:
    from tests.bench import session
    from tests.bench.cache import Cache

    record = session.run(scans, args.size, Cache(args.cache))
    return record, session.told(record)


def _codec(args: argparse.Namespace, scans: list[BenchScan]) -> Told:
    from tests.bench import codec

    record = codec.run(scans, args.size, args.repeats)
    return record, codec.told(record)


def _rate(args: argparse.Namespace, scans: list[BenchScan]) -> Told:
    from tests.bench import rate

    record = rate.run(scans, args.size, args.clicks)
    return record, rate.told(record)


def _sphere(args: argparse.Namespace, scans: list[BenchScan]) -> Told:
    from tests.bench import sphere

    if args.specimen or args.size not in sphere.SIZES:
        raise ConfigError(f"bench: sphere has an object of its own, at {' and '.join(sphere.SIZES)}")
    record = sphere.run(args.size, args.repeats)
    return record, sphere.told(record)


def _alpha(args: argparse.Namespace, scans: list[BenchScan]) -> Told:
    from tests.bench import alpha

    record = alpha.run(scans, args.size, args.clicks)
    return record, alpha.told(record)


def _page(args: argparse.Namespace, scans: list[BenchScan]) -> Told:
    import asyncio

    from tests.bench import page

    record = asyncio.run(page.run(scans[0], args.clicks, args.repeats, args.seconds, args.graphics))
    return record, page.told(record)


def _capture(args: argparse.Namespace, scans: list[BenchScan]) -> Told:
    from tests.bench import capture

    record = capture.run(args.repeats)
    return record, capture.told(record)


def _load(args: argparse.Namespace, scans: list[BenchScan]) -> Told:
    from tests.bench import load

    record = load.run(scans[0], args.size, args.seconds, args.viewers, args.clickers)
    return record, load.told(record)


def _fuzz(args: argparse.Namespace, scans: list[BenchScan]) -> Told:
    from tests.fuzz import campaign

    record = campaign.run(args.target or (), args.count, args.seed)
    return record, campaign.told(record)


BENCHES: dict[str, Callable[[argparse.Namespace, list[BenchScan]], Told]] = {
    "line": _line, "roi": _roi, "session": _session, "codec": _codec, "rate": _rate, "alpha": _alpha, "page": _page,
    "capture": _capture, "sphere": _sphere, "load": _load, "fuzz": _fuzz,
}  # fmt: skip


def _where(conditions: dict[str, Any]) -> str:
    versions = ", ".join(f"{name} {version}" for name, version in conditions["versions"].items())
    machine = f"{conditions['cores']} cores of {conditions['processor']}, load {conditions['load']}"
    return f"{conditions['date']}, commit {conditions['commit']}, {machine}; Python {conditions['python']}, {versions}"


def _some(text: str) -> int:
    """A number of at least one."""
    number = int(text)
    if number < 1:
        raise argparse.ArgumentTypeError(f"expected 1 or more, got {number}")
    return number



def add_arguments(parser: argparse.ArgumentParser) -> None:
    """What `foveascan bench` takes."""
    parser.add_argument("name", nargs="?", choices=BENCHES, default="line", help="what to measure (line)")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument(
        "--specimen", action="append", metavar="NAME|FILE", help="a scan, again for more (the four of DESIGN 8)"
    )
    parser.add_argument("--texture", metavar="IMAGE", help="texture of a grid FILE")
    parser.add_argument("--size", choices=("S", "M", "L"), default="M", help="size class (M)")
    parser.add_argument("--clicks", type=_some, default=5, metavar="N", help="foveae a scan (5)")
    parser.add_argument("--repeats", type=_some, default=REPEATS, metavar="N", help=f"of each timing ({REPEATS})")
    parser.add_argument("--rival", action="append", metavar="NAME", help="roi: only these rivals")
    parser.add_argument("--plots", type=Path, metavar="DIR", help="roi: write PNGs of bytes against quality")
    parser.add_argument("--seconds", type=float, default=60, metavar="S", help="page, load: of random clicks (60)")
    parser.add_argument(
        "--graphics", choices=("software", "card"), default="software", help="page: what draws it (software)"
    )
    parser.add_argument("--target", action="append", metavar="NAME", help="fuzz: only these parsers or ports")
    parser.add_argument("--count", type=_some, default=100_000, metavar="N", help="fuzz: messages for each (100000)")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="fuzz: other messages (0)")
    parser.add_argument("--viewers", type=int, default=200, metavar="N", help="load: connected (200)")
    parser.add_argument("--clickers", type=int, default=32, metavar="N", help="load: of them that click (32)")
    parser.add_argument("--cache", type=Path, default=CACHE, metavar="DIR", help="where rivals' results are kept")
