"""`foveascan library`: the scans in a folder, looked at and looked after without a node.

Looking (list, show, verify, backup) also works while a node runs; changing (rename, delete, restore) does not: the node
has the library to itself then, and its HTTP interface is the way.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import asdict
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

from node.audit_command import note_at_console
from node.machine import user_name
from protocol.errors import LibraryError
from protocol.printable import counted, printable

if TYPE_CHECKING:
    from node.config import Config, Retention
    from node.library import Library, ScanSummary
    from node.retention import Expired

SCAN_HELP = "the id, the beginning of one, or latest"
NO_LINK = "foveascan-vault cannot open it there, use a bind mount instead (README, \"A sealed library\")"


def add_library_command(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Offer `library` and what it can do."""
    library = subparsers.add_parser("library", help="look at scans and look after them: list, delete, back up, seal")
    actions = library.add_subparsers(title="actions", metavar="ACTION", required=True)
    _add(actions, "list", run_list, "the scans, newest first, and whatever else lies there")
    _add(actions, "show", run_show, "a scan and what is said of it").add_argument("scan", help=SCAN_HELP)
    rename = _add(actions, "rename", run_rename, "call a scan something else")
    rename.add_argument("scan", help=SCAN_HELP)
    rename.add_argument("name", help="its new name, at most 200 characters")
    delete = _add(actions, "delete", run_delete, "delete a scan for good")
    delete.add_argument("scan", help=SCAN_HELP)
    delete.add_argument("--yes", action="store_true", help="do not ask")
    verify = _add(actions, "verify", run_verify, "read every sample; exit status 1 when anything is wrong")
    verify.add_argument("scan", nargs="*", help=f"only these: {SCAN_HELP}")
    backup = _add(actions, "backup", run_backup, "write scans into one new file, a plain tar")
    backup.add_argument("file", type=Path, help="the file to write; it must not exist")
    backup.add_argument("scan", nargs="*", help=f"only these: {SCAN_HELP}")
    prune = _add(actions, "prune", run_prune, "delete what the rules of [retention] say; a node does so by itself")
    prune.add_argument("--dry-run", action="store_true", help="only say what would go; also while a node runs")
    prune.add_argument("--max-age-days", type=float, metavar="D", help="instead of the setting: 1..36500")
    prune.add_argument("--max-gb", type=float, metavar="GB", help="instead of the setting: what scans may take")
    prune.add_argument("--yes", action="store_true", help="do not ask")
    restore = _add(actions, "restore", run_restore, "take in the scans of a backup: all or none")
    restore.add_argument("file", type=Path, help="a file that `backup` wrote")
    key_help = "a file that holds it, in one line"
    seal = _add(actions, "seal", run_seal, "encrypt all of it on the disk; goes on where it was cut")
    seal.add_argument("--key", required=True, metavar="FILE", help=key_help)
    unseal = _add(actions, "unseal", run_unseal, "undo that")
    unseal.add_argument("--key", required=True, metavar="FILE", help=key_help)
    rekey = _add(actions, "rekey", run_rekey, "have a sealed library opened by another key from now on")
    rekey.add_argument("--key", required=True, metavar="FILE", help="the one it has")
    rekey.add_argument("--new-key", required=True, metavar="FILE", help="the one it gets")


def _add(
    actions: argparse._SubParsersAction[argparse.ArgumentParser],
    name: str,
    run: Callable[[argparse.Namespace], int],
    text: str,
) -> argparse.ArgumentParser:
    action = actions.add_parser(name, help=text)
    action.add_argument("--config", type=Path, metavar="FILE", help="the node's settings (TOML)")
    action.add_argument("--library", metavar="DIR", help="folder the scans are kept in; wins over the settings")
    action.add_argument("--json", action="store_true", help="print one JSON object")
    action.set_defaults(run=run)
    return action


def run_list(args: argparse.Namespace) -> int:
    """Print every scan and every problem."""
    from node.library import survey

    known, problems = survey(_folder(args))
    scans = sorted(known.values(), key=lambda scan: -scan.sequence)
    said = {"scans": [_as_json(scan) for scan in scans], "problems": [[p.name, p.reason] for p in problems]}
    troubles = [f"{problem.name}: {problem.reason}; left alone" for problem in problems]
    return _tell(args, said, "\n".join([*(_line(scan) for scan in scans), *troubles]) or "no scans")


def run_show(args: argparse.Namespace) -> int:
    """Print a scan, what is said of it, and who said it."""
    import msgspec

    from node.library import survey
    from node.sidecar import read_sidecar

    folder = _folder(args)
    scan_id = _resolve(folder, args.scan)
    scan = _as_json(survey(folder)[0][scan_id])
    said = {**scan, "sidecar": msgspec.to_builtins(read_sidecar(folder / scan_id))}
    return _tell(args, said, json.dumps(said, indent=2, ensure_ascii=False))


def run_rename(args: argparse.Namespace) -> int:
    """Give a scan another name."""
    if not args.name.strip():
        raise LibraryError("name: say what to call the scan; nothing was changed")
    folder = _folder(args)
    scan_id = _resolve(folder, args.scan)
    with _opened(folder) as library:
        try:
            library.rename(scan_id, args.name, user_name(os.getuid()))
        except ValueError as problem:
            raise LibraryError(f"name: {problem}") from problem
    note_at_console(_config(args), "changed", (scan_id,), "name")
    return _tell(args, {"id": scan_id, "name": args.name}, f'{scan_id} is called "{printable(args.name)}" now')


def run_delete(args: argparse.Namespace) -> int:
    """Delete a scan, after asking."""
    folder = _folder(args)
    scan_id = _resolve(folder, args.scan)
    with _opened(folder) as library:  # first: who is asked shall not hear then that it cannot be
        if not args.yes and not _confirmed(f"Delete scan {scan_id} for good?"):
            return 1
        library.delete(scan_id)
    note_at_console(_config(args), "deleted", (scan_id,))
    return _tell(args, {"deleted": scan_id}, f"deleted {scan_id}")


def run_prune(args: argparse.Namespace) -> int:
    """Delete what was kept long enough, after saying what that is."""
    from node.config import load_config
    from node.retention import delete

    rules = {"retention.max_age_days": args.max_age_days, "retention.max_gb": args.max_gb}
    config = load_config(args.config, {"library.folder": args.library, **rules})
    found = _expired(_folder(args), config.retention)
    said = {"expired": [asdict(one) for one in found], "deleted": 0}
    lines = [f"{one.id}  {one.kind:5}  {one.size_bytes / 1e6:8.1f} MB  {one.why}" for one in found]
    if args.dry_run or not found:
        no_rule = config.retention.max_age_days is None and config.retention.max_gb is None
        none = "there is no rule: set retention.max_age_days or retention.max_gb" if no_rule else "nothing is to go"
        return _tell(args, said, "\n".join(lines) or none)
    with _opened(_folder(args)) as library:
        if not args.yes and not _confirmed("\n".join([*lines, f"Delete {counted(len(found), 'thing')} for good?"])):
            return 1
        for one in found:
            delete(library, one)
            is_scan = one.kind == "scan"
            what = one.why if is_scan else f"sweep {one.id}, {one.why}"
            note_at_console(config, "expired", (one.id if is_scan else "",), what)
    return _tell(args, {**said, "deleted": len(found)}, f"deleted {counted(len(found), 'thing')}")


def _expired(folder: Path, rules: Retention) -> list[Expired]:
    """What is to go, looked up without the library's lock. Raises LibraryError."""
    import time

    from node.journal import survey_sweeps
    from node.library import survey
    from node.library_folder import SWEEPS
    from node.retention import expired

    known, _ = survey(folder)
    return [*expired(folder, known.values(), survey_sweeps(folder / SWEEPS), rules, time.time())]


def run_verify(args: argparse.Namespace) -> int:
    """Check scans; 1 when one is damaged or something else is wrong with the library."""
    from tqdm import tqdm

    from node.library import survey, verify

    folder = _folder(args)
    known, others = survey(folder)
    ids = [_resolve(folder, name) for name in args.scan] or sorted(known)
    checked = tqdm(verify(folder, ids), "verify", len(ids), disable=None, leave=False, unit="scan")
    problems = [problem for _, problem in checked if problem is not None]
    if not args.scan:
        problems += others
    said = {"checked": len(ids), "problems": [[problem.name, problem.reason] for problem in problems]}
    lines = [f"{problem.name}: {problem.reason}" for problem in problems]
    _tell(args, said, "\n".join([*lines, f"{counted(len(ids), 'scan')} checked, {counted(len(problems), 'problem')}"]))
    return 1 if problems else 0


def run_backup(args: argparse.Namespace) -> int:
    """Write a backup."""
    from node.archive import backup
    from node.library import survey

    folder = _folder(args)
    ids = list(dict.fromkeys(_resolve(folder, name) for name in args.scan)) or sorted(survey(folder)[0])
    backup(folder, ids, args.file)
    note_at_console(_config(args), "backed up", ids)
    size_bytes = args.file.stat().st_size
    said = {"file": str(args.file), "scans": len(ids), "bytes": size_bytes}
    return _tell(args, said, f"{counted(len(ids), 'scan')}, {counted(size_bytes, 'byte')} in {args.file}")


def run_restore(args: argparse.Namespace) -> int:
    """Take a backup in."""
    args.file.open("rb").close()  # before a library is made for what cannot be read
    with _opened(_set_folder(args)) as library:
        restored = library.restore(args.file)
    note_at_console(_config(args), "restored", restored.added)
    said = {"added": list(restored.added), "kept": list(restored.kept)}
    text = f"{counted(len(restored.added), 'scan')} restored, {len(restored.kept)} kept that were here already"
    return _tell(args, said, text)


def run_seal(args: argparse.Namespace) -> int:
    """Encrypt the library."""
    from node.sealing import seal

    status = _change_seal(args, seal, "sealed")
    library = _config(args).library
    if Path(library.folder).expanduser().is_symlink():
        print(f"foveascan: {library.folder} is a link to {library.place}: {NO_LINK}", file=sys.stderr)
    return status


def run_unseal(args: argparse.Namespace) -> int:
    """Have it in the clear again."""
    from node.sealing import unseal

    return _change_seal(args, unseal, "unsealed")


def _change_seal(
    args: argparse.Namespace, change: Callable[[Path, bytes, Callable[[int], object]], None], done: str
) -> int:
    from tqdm import tqdm

    from node.sealed import read_key, standing
    from node.sealing import size_bytes

    folder, key = _config(args).library.place, read_key(Path(args.key))
    try:
        with tqdm(total=size_bytes(folder), disable=None, leave=False, unit="B", unit_scale=True) as bar:
            change(folder, key, bar.update)
    except KeyboardInterrupt:
        print(f"foveascan: interrupted: {standing(folder)}", file=sys.stderr)
        raise
    return _tell(args, {done: str(folder)}, f"{done} {folder}")


def run_rekey(args: argparse.Namespace) -> int:
    """Exchange the key of a sealed library."""
    from node.sealed import read_key
    from node.sealing import rekey

    folder = _config(args).library.place
    rekey(folder, read_key(Path(args.key)), read_key(Path(args.new_key)))
    return _tell(args, {"rekeyed": str(folder)}, f"{folder} opens with the new key, and with the old one no more")


def _folder(args: argparse.Namespace) -> Path:
    """The library that is meant. Raises LibraryError, with a hint, where nobody named one and there is none."""
    folder = _set_folder(args)
    if not (args.library or args.config or folder.exists()):
        raise LibraryError(f"no library in {folder}: name its folder with --library, or settings with --config")
    return folder


def _set_folder(args: argparse.Namespace) -> Path:
    return _config(args).library.path


def _config(args: argparse.Namespace) -> Config:
    from node.config import load_config

    return load_config(args.config, {"library.folder": args.library})


def _resolve(folder: Path, text: str) -> str:
    """The scan that somebody means. Raises LibraryError unless it is exactly one."""
    from node.library import survey

    known, _ = survey(folder)
    if text == "latest" and known:
        return max(known.values(), key=lambda scan: (scan.sequence, scan.id)).id
    found = [scan_id for scan_id in known if text and scan_id.startswith(text)]
    if len(found) != 1:
        raise LibraryError(f"{'several scans begin' if found else 'no scan begins'} with {text[:40]!r}")
    return found[0]


@contextmanager
def _opened(folder: Path) -> Iterator[Library]:
    """The library, locked; what a crash had left there is told."""
    from node.library import Library

    with closing(Library(folder)) as library:
        for found in library.found:
            print(f"foveascan: {found}", file=sys.stderr)
        yield library


def _line(scan: ScanSummary) -> str:
    s = scan.spec
    made = datetime.fromtimestamp(scan.about.created_unix_s).isoformat(" ", "minutes")
    shape = f"{s.width} x {s.height} + {s.texture_width} x {s.texture_height}"
    if s.geometry != "cylinder":
        shape += f" {s.geometry}"
    return f"{scan.id}  {made}  {shape}  {printable(scan.about.name)}".rstrip()


def _as_json(scan: ScanSummary) -> dict[str, object]:
    return asdict(scan)


def _confirmed(question: str) -> bool:
    """Whether the person at the terminal says yes. Raises LibraryError where nobody can be asked."""
    if not sys.stdin.isatty():
        raise LibraryError("nobody can be asked here: say --yes")
    return input(f"{question} [y/N] ").strip().lower() in ("y", "yes")


def _tell(args: argparse.Namespace, said: Mapping[str, object], text: str) -> int:
    print(json.dumps(said) if args.json else text)
    return 0
