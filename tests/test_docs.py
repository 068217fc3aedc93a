"""README, ARCHITECTURE and PROTOCOL say what is true: their names exist, their samples run, their bytes decode."""

from __future__ import annotations

import ast
import re
import shlex
import subprocess
import sys
import textwrap
import tomllib
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import msgspec
import numpy as np
import pytest

from foveascan import build_parser
from node.config import Config
from node.endpoints import ENDPOINTS
from protocol import messages as m
from protocol.codec import RangeCodec, decode_range
from protocol.framing import Frame, FrameReader
from protocol.holdings import ChannelHoldings, range_rank
from protocol.lattice import Channel, build_lattice
from protocol.live import LiveColumns
from protocol.reconstruct import select
from protocol.refinement import HEADER, unpack_parameters
from protocol.scanner_messages import Ack, Hello, decode_message
from protocol.session import Phase, Role, Session
from tests.system.line import RunningNode, run_line

ROOT = Path(__file__).parents[1]
README, ARCHITECTURE, PROTOCOL = ((ROOT / name).read_text() for name in ("README.md", "ARCHITECTURE.md", "PROTOCOL.md"))
VIEWER = ROOT / "client/viewer"
PACKAGES = ("protocol", "drivers", "exchange", "node", "client", "simulators")


def code_blocks(text: str, language: str = "") -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.DOTALL | re.MULTILINE)


def shell_lines(text: str) -> list[str]:
    """Commands shown as blocks: indented lines that begin with the name of the command."""
    return [line.strip().removesuffix(" &") for line in re.findall(r"^ {4}foveascan .*$", text, re.MULTILINE)]


def defined_in(path: Path) -> set[str]:
    """Names a module defines: functions, classes, Class.method, and what it assigns at its top."""
    names: set[str] = set()
    for node in ast.parse(path.read_text()).body:
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            names.add(node.name)
        if isinstance(node, ast.ClassDef):
            inner = (part for part in node.body if isinstance(part, ast.FunctionDef | ast.AsyncFunctionDef))
            names |= {f"{node.name}.{part.name}" for part in inner}
        if isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            names |= {target.id for target in targets if isinstance(target, ast.Name)}
    return names


def defined_in_page(path: Path) -> set[str]:
    """Names a TypeScript file defines: functions, classes, constants, Class.method."""
    names: set[str] = set()
    owner = ""
    for line in path.read_text().splitlines():
        if outer := re.match(r"(?:export )?(?:async )?(?:class|function|const|interface|type) (\w+)", line):
            owner = outer[1]
            names.add(owner)
        elif inner := re.match(r"  (?:(?:private|readonly|static|async|get) )*(\w+)[(<]", line):
            names.add(f"{owner}.{inner[1]}")
    return names


@pytest.mark.parametrize("text", [README, ARCHITECTURE, PROTOCOL], ids=["README", "ARCHITECTURE", "PROTOCOL"])
def test_files_named_with_their_folder_exist(text: str) -> None:
    named = set(re.findall(r"`((?:protocol|drivers|exchange|node|client|simulators|tests)/[\w/.-]*)", text))
    assert named
    assert [name for name in sorted(named) if not (ROOT / name).exists()] == []


@pytest.mark.parametrize("text", [README, ARCHITECTURE, PROTOCOL], ids=["README", "ARCHITECTURE", "PROTOCOL"])
def test_links_between_pages_lead_somewhere(text: str) -> None:
    for file, anchor in re.findall(r"\]\(([^)#]*)#?([^)]*)\)", text):
        assert (ROOT / file).exists(), file
        if not anchor:
            continue
        target = (ROOT / file).read_text() if file else text
        headings = {
            re.sub(r"[^\w -]", "", line.lower()).replace(" ", "-")
            for line in re.findall(r"^#+ (.*)$", target, re.MULTILINE)
        }
        assert anchor in headings, anchor


def test_rooms_of_the_architecture_exist() -> None:
    for package, files in re.findall(r"^\| `(\w+)/` \| (.*) \|$", ARCHITECTURE, re.MULTILINE):
        for name in re.findall(r"`(\w+\.py)`", files):
            assert (ROOT / package / name).is_file(), f"{package}/{name}"


def test_functions_are_in_the_files_named_with_them() -> None:
    pairs = re.findall(r"`(\w+/\w+\.py)`\s+`([\w.]+)`", ARCHITECTURE)
    assert len(pairs) > 60
    assert [pair for pair in pairs if pair[1] not in defined_in(ROOT / pair[0])] == []


def test_functions_of_the_page_are_in_the_files_named_with_them() -> None:
    pairs = re.findall(r"`(src/[\w/]+\.ts)`(?:\s+`([\w.]+)`)?", ARCHITECTURE)
    assert len(pairs) > 20
    assert [pair for pair in pairs if not {pair[1]} - {""} <= defined_in_page(VIEWER / pair[0])] == []


def test_every_other_name_of_the_architecture_is_defined_somewhere() -> None:
    known = {name for package in PACKAGES for path in (ROOT / package).glob("*.py") for name in defined_in(path)}
    known |= {name for path in (VIEWER / "src").rglob("*.ts") for name in defined_in_page(path)}
    named = set(re.findall(r"`(_?[A-Z]\w+(?:\.\w+)?|\w+_\w+|_\w+)`", ARCHITECTURE))
    of_others = {"call_soon_threadsafe", "max_bytes", "max_wait_s", "range_mm", "git_"}
    assert sorted(named - known - of_others) == []


def test_make_targets_exist() -> None:
    targets = set(re.findall(r"^(\w+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    assert set(re.findall(r"\bmake (?=\w)(?!a\b|made\b)([a-z]+)", README)) <= targets


@pytest.mark.parametrize("line", shell_lines(README))
def test_commands_of_the_readme_parse(line: str) -> None:
    build_parser().parse_args(shlex.split(line)[1:])


def test_the_table_of_commands_is_complete() -> None:
    listed = set(re.findall(r"^\| `foveascan ([\w-]+)` \|", README, re.MULTILINE))
    choices = build_parser()._subparsers._group_actions[0].choices  # type: ignore[union-attr]
    assert listed == set(choices or ())


def test_configuration_of_the_readme_is_the_default() -> None:
    [text] = code_blocks(README, "toml")
    assert msgspec.convert(tomllib.loads(text), Config) == Config()
    commented_too = re.sub(r"^# (?=\w+ = )", "", text, flags=re.MULTILINE)
    msgspec.convert(tomllib.loads(commented_too), Config)


def test_requests_of_the_protocol_are_those_of_the_table() -> None:
    lines = re.findall(r"^\| (GET|POST|PATCH|DELETE) ([^\s?]+)[^|(]*(?:\((\w+)\))?", PROTOCOL, re.MULTILINE)
    told = {f"{method} {path.replace('.glb,', '.{format}')}": role for method, path, role in lines}
    unmarked = (None, "view")
    assert told == {name: "" if one.role in unmarked else one.role for name, one in ENDPOINTS.items()}


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningNode]:
    with ExitStack() as stack:
        yield run_line(stack, tmp_path_factory.mktemp("docs"), "--specimen", "head")


def asking(url: str, sample: str) -> str:
    """The sample with this very node: while tests run, another one may be on this network, or none be heard in time."""
    assert "if not nodes:" in sample and "nodes[0]" in sample
    return sample.replace("if not nodes:", "if nodes is None:").replace("nodes[0]", repr(url))


def test_the_sample_of_the_readme_runs(running: RunningNode, tmp_path: Path) -> None:
    sample, _ = code_blocks(README, "python")
    script = asking(running.url, sample)
    ran = subprocess.run([sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert ran.returncode == 0, ran.stderr
    assert re.match(r"complete \d+ bytes; \(100, 360\) \(256, 1024, 3\)", ran.stdout), ran.stdout


def test_the_live_sample_of_the_readme_runs(running: RunningNode, tmp_path: Path) -> None:
    sample, live = code_blocks(README, "python")
    script = asking(running.url, sample)
    inside = "        await session.start_sweep()\n" + textwrap.indent(live, " " * 8)
    script = script.replace("\nasyncio.run", f"{inside}\nasyncio.run")
    ran = subprocess.run([sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert ran.returncode == 0, ran.stderr
    assert re.search(r"^100 %.*\npublished [0-9a-f]{32}$", ran.stdout, re.MULTILINE), ran.stdout


def transcripts() -> list[list[tuple[str, m.Message]]]:
    """(who, message) of the lines of each transcript in PROTOCOL that are messages."""
    found = []
    for block in code_blocks(PROTOCOL):
        lines = re.findall(r"^(node|client) +(\{.*)$", block, re.MULTILINE)
        if lines:
            found.append([(who, m.decode_message(text)) for who, text in lines])
    return found


def test_transcripts_of_the_protocol_are_said_in_an_order_that_a_stream_allows() -> None:
    look, live = transcripts()
    node, client = Session(Role.NODE), Session(Role.CLIENT)
    for said in (*look[:-1], *live, look[-1]):
        speaker, listener = (node, client) if said[0] == "node" else (client, node)
        listener.receive(speaker.send(said[1]))
    assert node.phase is client.phase is Phase.CLOSED


def test_the_refinement_dumped_in_the_protocol_carries_what_the_page_works_out() -> None:
    [dump] = [block for block in code_blocks(PROTOCOL) if block.startswith("46 52 01 01")]
    data = bytes.fromhex(dump)
    *_, quality, seq, look, samples, parameters_size, _, _, _ = HEADER.unpack_from(data)
    [info] = [said.scan for _, said in transcripts()[0] if isinstance(said, m.Opened)]
    shape = info.shapes()[Channel.RANGE]
    assert len(data) == HEADER.size + parameters_size
    lattice = build_lattice(shape, unpack_parameters(data[HEADER.size :]))
    chosen = select(lattice, ChannelHoldings.coarse(shape), range_rank(quality))
    assert chosen is not None
    assert (seq, look, samples) == (2, 2, 2816)
    assert chosen[0].samples == samples
    assert chosen[0].adopted.shape == (4, 11)


def test_frames_dumped_in_the_protocol_are_sound() -> None:
    reader = FrameReader()
    dumps = re.findall(r"^(f5 ca [0-9a-f |]+?)\s+[A-Z]", PROTOCOL, re.MULTILINE)
    messages = []
    for dump in dumps:
        reader.receive_data(bytes.fromhex(dump.replace("|", "")))
        frame = reader.next_event()
        assert isinstance(frame, Frame)
        messages.append(decode_message(frame.type, frame.payload))
    assert messages == [Hello(payload_max=1024, window_bytes=65536), Ack(1)]


def test_live_columns_dumped_in_the_protocol_are_what_the_page_says() -> None:
    [dump] = [block for block in code_blocks(PROTOCOL) if block.startswith("46 4c")]
    columns = LiveColumns.from_bytes(bytes.fromhex(dump))
    assert (columns.channel, columns.sweep) == (Channel.RANGE, 0x04030201)
    assert columns.samples.tolist() == [[0x0B0A], [0x0D0C]]


def test_the_lift_example_of_the_protocol_decodes() -> None:
    [example] = [block for block in code_blocks(PROTOCOL) if block.startswith("1000 1002 1004")]
    image, *_, payload = example.splitlines()
    expected = np.array([row.split() for row in image.split("|")], np.uint16)
    decoded = decode_range(bytes.fromhex(payload), RangeCodec.LIFT, (3, 3))
    np.testing.assert_array_equal(decoded, expected)
