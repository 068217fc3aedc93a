"""`simulate` as a process: what it says, what it serves, how it ends."""

import argparse
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.scanner import Scanner, SweepFinished
from drivers.serial_port import SerialPort
from exchange.formats import read_scan
from protocol.errors import ConfigError
from protocol.scanner_messages import RangeColumn, SweepRequest, TextureColumn
from simulators.command import add_subcommands

CODE = """
import argparse, sys
from simulators.command import add_subcommands
parser = argparse.ArgumentParser()
add_subcommands(parser.add_subparsers())
args = parser.parse_args()
sys.exit(args.run(args))
"""
FAST = ("--specimen", "cylinder", "--link-rate", "20e6", "--turn", "0.05")


def parse(*arguments: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser(exit_on_error=False)
    add_subcommands(parser.add_subparsers())
    return parser.parse_args(["simulate", *arguments])


@contextmanager
def simulated(link: Path, *arguments: str) -> Iterator[tuple["subprocess.Popen[str]", dict[str, Any]]]:
    """A running `simulate --json` and the line it began with."""
    command = [sys.executable, "-c", CODE, "simulate", "--path", str(link), "--json", *arguments]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as program:
        assert program.stdout is not None
        try:
            yield program, json.loads(program.stdout.readline())
        finally:
            program.kill()


def sweep(link: Path) -> tuple[dict[int, bytes], dict[int, bytes]]:
    """One whole sweep: range and texture samples by column."""
    scanner = Scanner(SerialPort(str(link)))
    seen: dict[type, dict[int, list[tuple[int, bytes]]]] = {RangeColumn: {}, TextureColumn: {}}
    try:
        scanner.hello()
        for event in scanner.sweep(SweepRequest()):
            if isinstance(event, RangeColumn | TextureColumn):
                seen[type(event)].setdefault(event.column, []).append((event.row0, bytes(event.data)))
    finally:
        scanner.close()
    assert isinstance(event, SweepFinished)
    ranges, textures = (
        {column: b"".join(data for _, data in sorted(pieces)) for column, pieces in columns.items()}
        for columns in seen.values()
    )
    return ranges, textures


def columns_of(samples: NDArray[Any]) -> dict[int, bytes]:
    return {column: samples[:, column].tobytes() for column in range(samples.shape[1])}


def test_it_serves_sweep_after_sweep_of_exactly_the_truth_it_wrote(tmp_path: Path) -> None:
    link, truth = tmp_path / "scanner", tmp_path / "truth.npz"
    with simulated(link, *FAST, "--truth", str(truth)) as (_, ready):
        assert ready["ready"] is True and ready["path"] == str(link)
        name, grid, _ = read_scan(truth)
        assert name == "cylinder"
        for _ in range(2):
            assert sweep(link) == (columns_of(grid.range_steps), columns_of(grid.texture))


def test_jitter_moves_columns_off_their_nominal_angle(tmp_path: Path) -> None:
    link, truth = tmp_path / "scanner", tmp_path / "truth.npz"
    with simulated(link, *FAST, "--jitter", "12", "--truth", str(truth)):
        _, grid, _ = read_scan(truth)
        ranges, textures = sweep(link)
    nominal = columns_of(grid.texture)
    assert np.mean([textures[column] != nominal[column] for column in nominal]) > 0.5
    assert len(ranges) == grid.spec.width


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_it_cleanly_and_takes_the_link_away(tmp_path: Path, number: signal.Signals) -> None:
    link = tmp_path / "scanner"
    with simulated(link, *FAST) as (program, _):
        assert link.is_symlink()
        program.send_signal(number)
        assert program.wait(10) == 0
    assert not os.path.lexists(link)


def test_without_json_it_speaks_to_people(tmp_path: Path) -> None:
    link = tmp_path / "scanner"
    command = [sys.executable, "-c", CODE, "simulate", "--path", str(link), *FAST]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as program:
        assert program.stdout is not None
        line = program.stdout.readline()
        program.terminate()
    assert "cylinder" in line and "360 x 100" in line and str(link) in line


@pytest.mark.parametrize(
    "arguments",
    [
        (),
        ("--path", "p", "--size", "XL"),
        ("--path", "p", "--baud", "10"),
        ("--path", "p", "--link-rate", "nan"),
        ("--path", "p", "--jitter", "-1"),
        ("--path", "p", "--seed", "one"),
        ("--path", "p", "--turn", "0"),
        ("--path", "p", "--link", "tape"),
    ],
)
def test_wrong_usage_is_refused(arguments: tuple[str, ...], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises((SystemExit, argparse.ArgumentError)):
        parse(*arguments)


def test_an_unknown_specimen_is_refused_before_a_link_is_made(tmp_path: Path) -> None:
    args = parse("--path", str(tmp_path / "scanner"), "--specimen", "teapot")
    with pytest.raises(ConfigError, match="teapot"):
        args.run(args)
    assert list(tmp_path.iterdir()) == []


def test_importing_the_command_costs_nothing() -> None:
    code = "import sys, simulators.command; sys.exit('numpy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], timeout=60).returncode == 0


def test_an_unknown_fault_is_refused_with_the_names_there_are(tmp_path: Path) -> None:
    args = parse("--path", str(tmp_path / "scanner"), "--faults", "rain=1")
    with pytest.raises(ConfigError, match="'rain' is none of loss, flip"):
        args.run(args)


def test_a_busy_port_is_named_with_a_cure_there_is() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        place = f"127.0.0.1:{taken.getsockname()[1]}"
        args = parse("--path", place, "--link", "tcp", "--specimen", "cylinder")
        with pytest.raises(OSError, match=f"^.Errno 98. tcp:{place}: Address already in use; .*--path"):
            args.run(args)


def test_a_faulty_buffered_scanner_still_serves_the_truth(tmp_path: Path) -> None:
    link = tmp_path / "scanner"
    options = ("--faults", "flip=0.01,twice=0.05", "--order", "buffered", "--serial-number", "B-2")
    with simulated(link, *FAST) as _:
        clean = sweep(link)
    with simulated(link, *FAST, *options) as _:
        assert sweep(link) == clean


def test_a_usb_scanner_tells_the_environment_the_node_needs() -> None:
    with (
        tempfile.TemporaryDirectory(prefix="fs-") as folder,
        simulated(Path(folder, "usb"), "--link", "usb", "--specimen", "sphere") as (_, ready),
    ):
        assert ready["path"] == "usb:1209:5ca1" and ready["environment"]["UMOCKDEV_DIR"] == f"{folder}/usb"


def test_a_usb_scanner_at_a_path_too_long_for_sockets_says_so(tmp_path: Path) -> None:
    args = parse("--path", str(tmp_path / ("long" * 25)), "--link", "usb", "--specimen", "cylinder")
    with pytest.raises(OSError, match="choose a shorter one"):
        args.run(args)


@pytest.mark.parametrize("link", ["gadget", "acm"])
def test_a_gadget_without_a_controller_says_how_to_get_one(link: str) -> None:
    args = parse("--path", "no_udc.0", "--link", link, "--specimen", "cylinder")
    with pytest.raises(OSError, match="as root: modprobe|no such device controller; there is"):
        args.run(args)
