"""A sweep that was cut, from the command line: listed, fetched, gone on with, deleted."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path

import numpy as np
import pytest

from client import connect
from client.truth import Truth
from foveascan import main, started
from tests.waiting import until_ready


def said(capsys: pytest.CaptureFixture[str], url: str, *arguments: str, status: int = 0) -> str:
    assert main(["sweeps", *arguments, "--node", url]) == status
    out, err = capsys.readouterr()
    return err if status else out


async def sweep_until(percent: float, url: str) -> None:
    """Start a sweep, and return once so much of it is shown."""
    async with connect(url) as session:
        await until_ready(session)
        await session.start_sweep()
        async for frame in session.live():
            if frame.percent > percent:
                return


def test_a_cut_sweep_becomes_a_scan_when_somebody_asks(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    truth, partial, whole = (tmp_path / f"{name}.npz" for name in ("truth", "partial", "whole"))
    simulate = ["simulate", "--path", str(tmp_path / "tty"), "--link-rate", "800000", "--truth", str(truth), "--json"]
    serve = ["serve", "--library", str(tmp_path / "library"), "--listen", "127.0.0.1:0", "--insecure", "--json"]
    with started(*simulate) as (_, link):
        with started(*serve, "--scanner", link["path"]) as (node, ready):
            asyncio.run(sweep_until(10, ready["url"]))
            node.terminate()
            node.wait()
        with started(*serve, "--scanner", link["path"]) as (_, ready):
            url = ready["url"]
            sweep = json.loads(said(capsys, url, "--json"))
            assert 0 < sweep["held"] < sweep["expected"]
            percent = 100 * sweep["held"] // sweep["expected"]
            line = said(capsys, url)
            assert line.startswith(sweep["id"]) and f"  {percent} % of 360 x 100 + 1024 x 256  SIM-0001  " in line
            said(capsys, url, "--fetch", sweep["id"][:6], "-o", str(partial))
            with np.load(partial) as file:
                assert f"{sweep['held']} of {sweep['expected']}" in str(file["note"])
            scan = said(capsys, url, "--resume", "latest").split()[1]
            assert said(capsys, url) == "no sweep was cut\n"
            assert main(["export", str(whole), "--scan", scan, "--node", url]) == 0
            capsys.readouterr()
            assert "no sweep 'latest' was cut" in said(capsys, url, "--resume", "latest", status=2)
            assert "no interrupted sweep" in said(capsys, url, "--delete", sweep["id"], status=1)
    assert np.array_equal(Truth.read(whole).texture, Truth.read(truth).texture)
