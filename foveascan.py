"""The command `foveascan`: the one place that knows node, client and simulators, and composes what each of them offers.

A package offers its subcommands in its module `command`:

    def add_subcommands(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
        scan = subparsers.add_parser("scan", help="one line, as `foveascan --help` shows it")
        scan.add_argument("--json", action="store_true", help="print one JSON object a line")
        scan.set_defaults(run=run_scan)         # run_scan(args: argparse.Namespace) -> int, the exit status

What holds for every subcommand:

- Importing a `command` module costs nothing: argparse and its like at the top, all that is heavy inside `run`.
- Results go to standard output; progress bars (tqdm with disable=None: silent where nobody watches) and notices to
  standard error. With --json standard output carries JSON objects only, one a line.
- A program that runs until it is told to stop prints {"ready": true, ...} with --json once it is ready, and nothing
  more there, since whoever started it reads no further. It ends cleanly with status 0 on SIGTERM and SIGINT.
- Failure is raised, not printed: FoveascanError and OSError become one line on standard error here, "foveascan: ...",
  so their message names the cure; UsageError is status 2. Anything else is a bug, and shows its traceback.

Exit status: 0 done; 1 failed; 2 wrong usage; 130 interrupted; 141 whoever read standard output went away.
"""

from __future__ import annotations

import argparse
import errno
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from types import MappingProxyType, TracebackType
from typing import TYPE_CHECKING, Any

import client.command
import node.command
import simulators.command
from protocol.errors import FoveascanError, UsageError
from protocol.printable import printable

if TYPE_CHECKING:
    from client.session import Session

__version__ = "0.1.0"

PROGRAM = (sys.executable, "-P", "-m", "foveascan")  # -P: a folder called node or client where one stands is not ours
READY_LINE_MAX_BYTES = 65536
DEMO_CLICKS = 3
TRUTH, CLOSED = "truth.npz", "closed.npz"
END_S = 5.0  # what a program may take to end after SIGTERM

FAILED = 1
WRONG_USAGE = 2  # argparse's own
INTERRUPTED = 130
READER_GONE = 141

CURES = {
    errno.EACCES: "ask for the right to use it, or run as its owner",
    errno.EADDRINUSE: "another program listens there: stop it or choose another --listen",
    errno.EADDRNOTAVAIL: "no such address on this machine: choose another --listen",
    errno.ECONNREFUSED: "nothing listens there: start a node with `foveascan serve`",
    errno.EHOSTUNREACH: "check the address and the network",
    errno.ENOENT: "check the path",
    errno.ENOSPC: "free some disk space",
    errno.EISDIR: "name a file, not a folder",
    errno.ENOTDIR: "check the path: a file stands where a folder is expected",
    errno.EEXIST: "choose another name",
    errno.EROFS: "choose a folder that can be written",
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run one subcommand and return its exit status; `argv` defaults to the command line."""
    _hush_codecs()
    try:
        try:
            args = build_parser().parse_args(argv)
            status: int = args.run(args)
        finally:
            sys.stdout.flush()
        return status
    except KeyboardInterrupt:
        return INTERRUPTED
    except BrokenPipeError:
        _forget_stdout()
        return READER_GONE
    except (FoveascanError, OSError) as problem:
        print(f"foveascan: {one_line(problem)}", file=sys.stderr)
        return WRONG_USAGE if isinstance(problem, UsageError) else FAILED


class EndedEarly(FoveascanError):
    """A program that we started ended before it was ready. status : its own; below 0 by that signal."""

    def __init__(self, name: str, status: int) -> None:
        super().__init__(f"{name} ended with status {status} before it was ready")
        self.status = status


class _Parser(argparse.ArgumentParser):
    """Options are spelled out: an abbreviation in somebody's script would break with the next option."""

    def __init__(self, **options: Any) -> None:
        super().__init__(allow_abbrev=False, **options)


def build_parser() -> argparse.ArgumentParser:
    """The whole command line, composed from what the packages offer."""
    parser = _Parser(
        prog="foveascan",
        description="A turntable 3D scanner as a network appliance: the object at once, full detail where you look.",
        epilog="Every subcommand has a --help of its own.",
    )
    parser.add_argument("--version", action="version", version=f"foveascan {__version__}")
    subparsers: argparse._SubParsersAction[argparse.ArgumentParser] = parser.add_subparsers(
        title="subcommands", metavar="COMMAND", required=True, parser_class=_Parser
    )
    add_own_subcommands(subparsers)
    for package in (node.command, client.command, simulators.command):
        package.add_subcommands(subparsers)
    return parser


def add_own_subcommands(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Offer what needs several programs at once."""
    demo = subparsers.add_parser("demo", help="bring up a simulated scanner and a node, sweep once, serve until Ctrl-C")
    demo.add_argument("--specimen", default="head", metavar="NAME|FILE", help=simulators.command.SPECIMEN_HELP)
    demo.add_argument("--texture", metavar="IMAGE", help="texture of a specimen read from a .npz grid")
    demo.add_argument("--size", choices=("S", "M", "L"), default="S", help="size class of the scan (S)")
    rate_help = "bytes a second over the line, instead of its baud rate"
    demo.add_argument("--link-rate", type=simulators.command.link_rate, metavar="BYTES_S", help=rate_help)
    demo.add_argument("--once", action="store_true", help="look at three places, compare with the truth, and end")
    demo.add_argument("--json", action="store_true", help="with --once: print one JSON object")
    demo.set_defaults(run=run_demo)
    add_bench(subparsers)


def add_bench(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Offer `bench`, which lives beside the tests and so stays out of the wheel."""
    bench = subparsers.add_parser("bench", help="measure speed, bytes and quality (in a checkout)")
    if not (Path(__file__).parent / "tests" / "bench").is_dir():
        bench.add_argument("ignored", nargs=argparse.REMAINDER, help=argparse.SUPPRESS)
        bench.set_defaults(run=run_no_bench)
        return
    from tests.bench.command import add_arguments, run_bench

    add_arguments(bench)
    bench.set_defaults(run=run_bench)


def run_no_bench(args: argparse.Namespace) -> int:
    """What an installed package says to `bench`. Raises FoveascanError."""
    raise FoveascanError("bench is not part of the installed package: run it in a checkout, with `make bench`")


def run_demo(args: argparse.Namespace) -> int:
    """Simulated scanner and node as processes of their own, one sweep, then serve until a signal, or look and end."""
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, lambda *_: sys.exit(0))  # so that both programs are ended with the blocks below
    try:
        return _demo(args)
    except EndedEarly as ended:
        if ended.status < 0:
            raise
        return ended.status  # it has said why, on our standard error


def _demo(args: argparse.Namespace) -> int:
    with TemporaryDirectory(prefix="foveascan-demo-") as folder:
        with started(*_simulate(args, folder)) as (_, scanner):
            with started(*_serve(scanner["path"], folder)) as (node, ready):
                at_node = ["--node", ready["url"], *(["--json"] if args.json else [])]
                is_closed = bool(scanner.get("closed"))
                whole = [["import", f"{folder}/{CLOSED}", *at_node]] if is_closed else []
                for command in (["scan", *at_node], *whole):
                    ran = subprocess.run([*PROGRAM, *command], stdout=sys.stderr if args.json else None)
                    if ran.returncode:
                        return ran.returncode
                if args.once:
                    import asyncio

                    return asyncio.run(look_once(args, ready["url"], folder, is_closed))
                also = "; it also has the whole object, poles included, which no sweep sees" if is_closed else ""
                print(f"The scan is at {ready['url']}{also}\nCtrl-C ends the demo.", flush=True)
                return node.wait()


async def look_once(args: argparse.Namespace, url: str, folder: str, is_closed: bool) -> int:
    """Find the node, open its scan, look at three places, hold what came against the truth; 0 when it holds.

    is_closed : do the same of the whole object that was imported beside the sweep, and look at both its poles, too.
    """
    from client import connect, discover

    started_s = time.monotonic()
    nodes = await discover()
    found_s = time.monotonic() - started_s
    if url not in {node.url for node in nodes}:
        raise FoveascanError(f"the node at {url} was not discovered; does this machine allow multicast on loopback?")
    async with connect(url) as session:
        result = {"link_rate": args.link_rate, "discovered_in_s": round(found_s, 3)}
        result |= await _look_round(session, "sweep", f"{folder}/{TRUTH}", f"{folder}/model.npz")
        if is_closed:
            result["closed"] = await _look_round(session, "import", f"{folder}/{CLOSED}", f"{folder}/closed_model.npz")
    ok = result["ok"] and (not is_closed or result["closed"]["ok"])
    print(json.dumps(result) if args.json else _told(result), flush=True)
    return 0 if ok else FAILED


async def _look_round(session: Session, source: str, truth_path: str, model_path: str) -> dict[str, Any]:
    """Look at places of the newest scan that came so, and compare; export what is held then."""
    from client.truth import Truth

    truth = Truth.read(truth_path)
    scan = next(scan["id"] for scan in await session.scans() if scan["source"] == source)
    before = session.stats.bytes_received
    model = await session.open(scan)
    first_view_bytes = session.stats.bytes_received - before
    updates = []
    for u, v in truth.clicks(DEMO_CLICKS):
        update = await session.look(u, v)
        updates.append({
            "u": u, "v": v, "bytes": update.bytes_received, "elapsed_s": round(update.elapsed_s, 4),
            **truth.compare(model, u, v),
        })  # fmt: skip
    model.export(model_path)
    return {
        "scan": model.info.id, "shape": {"range": model.range_steps.shape, "texture": model.texture.shape[:2]},
        "first_view_bytes": first_view_bytes, "updates": updates, "ok": all(update["ok"] for update in updates),
    }  # fmt: skip


def _told(result: dict[str, Any]) -> str:
    lines = [f"first view {result['first_view_bytes']} bytes, found in {result['discovered_in_s']} s", *_looks(result)]
    if closed := result.get("closed"):
        lines += [f"the whole object, by direction: first view {closed['first_view_bytes']} bytes", *_looks(closed)]
    ok = result["ok"] and (not closed or closed["ok"])
    return "\n".join([*lines, "matches the truth" if ok else "does NOT match the truth"])


def _looks(result: dict[str, Any]) -> list[str]:
    return [
        f"({update['u']:.3f}, {update['v']:.3f}): {update['bytes']} bytes in {update['elapsed_s']:.3f} s, "
        f"range within {update['range_error_mm_p99']:.3f} mm (99%), texture {update['texture_psnr_db']:.1f} dB"
        for update in result["updates"]
    ]


def _simulate(args: argparse.Namespace, folder: str) -> list[str]:
    command = ["simulate", "--link", "pty", "--path", f"{folder}/scanner", "--truth", f"{folder}/{TRUTH}", "--json"]
    command += ["--closed", f"{folder}/{CLOSED}"]
    for option in ("specimen", "texture", "size", "link_rate"):
        if (value := getattr(args, option)) is not None:
            command += [f"--{option.replace('_', '-')}", str(value)]
    return command


def _serve(scanner: str, folder: str) -> list[str]:
    config = Path(folder, "node.toml")
    config.write_text("[capture]\nrepair = false\n")  # a hole in a specimen is no flaw of the camera
    chosen = ["--config", str(config), "--library", f"{folder}/library", "--listen", "127.0.0.1:0"]
    return ["serve", "--scanner", scanner, *chosen, "--insecure", "--json"]


@contextmanager
def started(
    *arguments: str, environment: Mapping[str, str] = MappingProxyType({})
) -> Iterator[tuple[subprocess.Popen[bytes], dict[str, Any]]]:
    """Another subcommand (given --json) as a process, with the line that says it is ready; ended with the block.

    environment : what its environment has beside ours.  Ctrl-C reaches us alone, so that programs end in their order.
    Raises EndedEarly when it ends before it is ready, FoveascanError when it says anything else.
    """
    all_of_it = {**os.environ, **environment}
    command = [*PROGRAM, *arguments]
    with subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, env=all_of_it, process_group=0
    ) as program:
        try:
            yield program, _ready_line(program, arguments[0])
        finally:
            _end(program)


def _ready_line(program: subprocess.Popen[bytes], name: str) -> dict[str, Any]:
    assert program.stdout is not None
    line = program.stdout.readline(READY_LINE_MAX_BYTES)
    if not line:
        raise EndedEarly(name, program.wait())
    try:
        ready: dict[str, Any] = json.loads(line)
    except ValueError as problem:
        raise FoveascanError(f"{name} began with {line[:80]!r} instead of a line of JSON") from problem
    return ready


def _end(program: subprocess.Popen[bytes]) -> None:
    program.terminate()
    try:
        program.wait(END_S)
    except subprocess.TimeoutExpired:
        program.kill()


def one_line(problem: Exception) -> str:
    """What went wrong and its cure, without line breaks."""
    text = printable(" ".join(_what(problem).split()))
    cause = problem if isinstance(problem, OSError) else problem.__cause__
    cure = CURES.get(cause.errno or 0) if isinstance(cause, OSError) and "; " not in text else None
    return f"{text}; {cure}" if cure else text


def _what(problem: Exception) -> str:
    if isinstance(problem, OSError) and problem.strerror:
        place = f"{os.fsdecode(problem.filename)}: " if isinstance(problem.filename, str | bytes) else ""
        return f"{place}{problem.strerror}"
    return str(problem) or type(problem).__name__


def _hush_codecs() -> None:
    """Print nothing of what imagecodecs drops half way through a damaged image: a CodecError says it."""
    if sys.unraisablehook is not sys.__unraisablehook__:  # somebody else's already, or ours
        return

    def dropped(what: sys.UnraisableHookArgs) -> None:
        if not str(what.object).startswith("imagecodecs."):
            sys.__unraisablehook__(what)

    def uncaught(kind: type[BaseException], problem: BaseException, trace: TracebackType | None) -> None:
        if str(problem) != "ojph error":
            sys.__excepthook__(kind, problem, trace)

    sys.unraisablehook, sys.excepthook = dropped, uncaught


def _forget_stdout() -> None:
    """Let the interpreter's own flush at exit find an open file, else it complains on standard error."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


if __name__ == "__main__":
    sys.exit(main())
