"""The library as clients use it: scans opened once, first views encoded once, work done off the event loop."""

from __future__ import annotations

import asyncio
import os
import threading
import time
from collections import OrderedDict
from collections.abc import AsyncIterator, Callable
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import asynccontextmanager, suppress
from dataclasses import replace
from typing import Literal, TypeVar, overload

import msgspec

from node.classic import ClassicView, build_classic_view
from node.first_view import FirstView, build_first_view, scan_info, texture_as_seen
from node.library import Library, Scan
from node.picture import draw_picture
from node.planners import Planners
from node.range_model import RangeModel
from node.right_of_way import RightOfWay
from node.texture_model import TextureModel
from node.wanted import NO_MODELS, Models
from protocol.errors import LibraryError
from protocol.messages import CodecName, Profile

VIEWS_MAX = 8
PICTURES_MAX = 64  # of some 10 KB
GIVES_WAY = 10  # niceness of threads that compute for clients: a scanner does not wait
MODELS_MAX = 8
THREADS_A_LOOK = 2  # that is given its full time
PAUSE_S = 0.06  # between two of a thousand tiles: a survey takes a minute longer at most
T = TypeVar("T")
Work = Literal["look", "fovea", "view", "picture", "other"]
Key = tuple[str, CodecName, Profile]
Opening = tuple[Scan, FirstView | ClassicView]


class Exhibits:
    """Opened scans with their first views. For one event loop; `work` runs in a few threads of its own.

    way : what these threads give way to.
    """

    def __init__(
        self, library: Library, first_view_bytes: int, workers: int, way: RightOfWay | None = None
    ) -> None:
        self.library = library
        self._way = way or RightOfWay()
        self._first_view_bytes = first_view_bytes
        self._pool = ThreadPoolExecutor(workers, "encode", _give_way)
        self._turns, self._waiting, self._planned = asyncio.Semaphore(workers + 1), 0, 0
        self._workers = workers
        self.planners = Planners(workers, library.folder)
        self._encoded: Callable[[Work, float, float], object] = lambda of, waited_s, took_s: None
        self._working = 0
        self._moved_s = 0.0
        self._views: OrderedDict[Key, asyncio.Future[Opening]] = OrderedDict()
        self._pictures: OrderedDict[str, asyncio.Future[bytes]] = OrderedDict()
        self._closing = threading.Event()
        self._surveyor = ThreadPoolExecutor(1, "survey", _give_way)
        self._models: OrderedDict[str, tuple[Future[RangeModel], Future[TextureModel]]] = OrderedDict()

    @overload
    async def open(self, scan_id: str, codec: CodecName) -> tuple[Scan, FirstView]: ...

    @overload
    async def open(self, scan_id: str, codec: CodecName, profile: Profile) -> Opening: ...

    async def open(self, scan_id: str, codec: CodecName, profile: Profile = "default") -> Opening:
        """A scan ("latest" or an id) and its first view. Raises LibraryError when there is none such."""
        key: Key = self.library.resolve(scan_id), codec, profile
        future = self._views.get(key)
        if future is None:
            future = asyncio.ensure_future(self.work(lambda: self._build(*key), "view"))
            self._views[key] = future
            while len(self._views) > VIEWS_MAX:
                self._views.popitem(last=False)
        self._views.move_to_end(key)
        try:
            scan, view = await asyncio.shield(future)
        except LibraryError:
            self._views.pop(key, None)
            raise
        if isinstance(view, FirstView):
            self._survey(scan, view)
        return self._up_to_date(scan, view)

    async def picture(self, scan_id: str) -> tuple[str, bytes]:
        """The id of a scan, and a picture of its first view (WebP). Raises LibraryError when there is none such."""
        key = self.library.resolve(scan_id)
        if key not in self._pictures:
            drawn = self.work(lambda: draw_picture(self.library.open(key).coarse), "picture")
            self._pictures[key] = asyncio.ensure_future(drawn)
            while len(self._pictures) > PICTURES_MAX:
                self._pictures.popitem(last=False)
        self._pictures.move_to_end(key)
        try:
            return key, await asyncio.shield(self._pictures[key])
        except LibraryError:
            self._pictures.pop(key, None)
            raise

    def models(self, scan: Scan) -> Models:
        """What was measured of the scan by now."""
        if scan.id not in self._models:
            return NO_MODELS
        of_range, of_texture = self._models[scan.id]
        return Models(_done(of_range), _done(of_texture))

    @property
    def surveying(self) -> int:
        """How many opened scans' textures are not measured yet."""
        return sum(not texture.done() for _, texture in self._models.values())

    def forget(self, scan_id: str) -> None:
        """Drop what was made of a scan that is gone."""
        for key in [key for key in self._views if key[0] == scan_id]:
            del self._views[key]
        self._models.pop(scan_id, None)
        self._pictures.pop(scan_id, None)
        self._pool.submit(self.planners.forget, scan_id)

    @asynccontextmanager
    async def turn(self) -> AsyncIterator[bool]:
        """Inside it is the caller's turn to plan a look: first come, first served, one for each thread and one more.

        Whether that is pressing: so many are planned or wait that there are no two threads for each, as one that is
        given its full time takes.
        """
        self._waiting += 1
        try:
            await self._turns.acquire()
        finally:
            self._waiting -= 1
        self._planned += 1
        try:
            yield self._planned + self._waiting > max(self._workers // THREADS_A_LOOK, 1)
        finally:
            self._planned -= 1
            self._turns.release()

    def expect_looks(self, streams: int) -> None:
        """So many streams are there: where each look of theirs may find others waiting, have processes for them."""
        if streams > self._workers:
            self._pool.submit(self.planners.start)

    def tell(self, encoded: Callable[[Work, float, float], object]) -> None:
        """Have somebody told of every job: what it was for, how long it waited and took [s], in the event loop."""
        self._encoded = encoded

    async def work(
        self, job: Callable[[], T], of: Work = "other", elsewhere: Callable[[], T | None] | None = None
    ) -> T:
        """Run a job in one of the encoding threads. elsewhere : has a process do it; where it says None, `job` does."""
        asked_s = begun_s = time.monotonic()

        def timed() -> T:
            nonlocal begun_s
            begun_s = time.monotonic()
            if elsewhere is not None and (done := elsewhere()) is not None:
                return done
            with self._way.given():
                begun_s = time.monotonic()
                return job()

        if not self._working:
            self._moved_s = asked_s
        self._working += 1
        try:
            return await asyncio.get_running_loop().run_in_executor(self._pool, timed)
        finally:
            self._working -= 1
            self._moved_s = time.monotonic()
            self._encoded(of, begun_s - asked_s, self._moved_s - begun_s)

    def idle_pool(self) -> Executor | None:
        """The encoding threads, for a job that can use two of them; None while a fast sweep takes what there is."""
        return None if self._way.is_taken else self._pool

    @property
    def queued(self) -> int:
        """How many jobs wait for a thread."""
        return max(0, self._working - self._workers)

    @property
    def beat_s(self) -> float:
        """When the encoding threads last showed that they get on; now, if nothing waits. [s, time.monotonic]"""
        return self._moved_s if self._working else time.monotonic()

    def close(self) -> None:
        """Let running jobs end, start no more."""
        self._closing.set()
        self.planners.close()
        self._surveyor.shutdown(cancel_futures=True)
        self._pool.shutdown(cancel_futures=True)

    def _up_to_date(self, scan: Scan, view: FirstView | ClassicView) -> Opening:
        """Both as they are known now: the same samples may have come again since they were opened."""
        about = self.library.summary(scan.id).about
        if about == scan.about:
            return scan, view
        scan = replace(scan, about=about)
        return scan, replace(view, info=msgspec.structs.replace(view.info, created=scan_info(scan).created))

    def _survey(self, scan: Scan, view: FirstView) -> None:
        """Have the scan's range and texture measured, one scan at a time, beside everything else."""
        if scan.id not in self._models:
            range_model = self._surveyor.submit(RangeModel, scan.spec, scan.range_steps, scan.filled)
            self._models[scan.id] = range_model, self._surveyor.submit(self._texture_model, scan, view)
            while len(self._models) > MODELS_MAX:
                for model in self._models.popitem(last=False)[1]:
                    model.cancel()
        self._models.move_to_end(scan.id)

    def _texture_model(self, scan: Scan, view: FirstView) -> TextureModel:
        def is_over() -> bool:
            self._let_looks_go_first()
            with self._way.given():
                return self._closing.is_set()

        return TextureModel(
            scan.texture, texture_as_seen(view), is_over, sphere=scan.spec.geometry == "sphere"
        )

    def _let_looks_go_first(self) -> None:
        """Pause for a moment while looks wait: what is measured serves those to come."""
        until_s = time.monotonic() + PAUSE_S
        while self._waiting and time.monotonic() < until_s:
            time.sleep(PAUSE_S / 16)  # looked at, not waited for: the event loop shall not stop to tell us

    def _build(self, scan_id: str, codec: CodecName, profile: Profile) -> Opening:
        scan = self.library.open(scan_id)
        if profile == "classic":
            return scan, build_classic_view(scan, codec)
        return scan, build_first_view(scan, codec, self._first_view_bytes)


def _done(model: Future[T]) -> T | None:
    """What a finished future holds; None of one that runs or failed."""
    return model.result() if model.done() and not model.cancelled() and model.exception() is None else None


def _give_way() -> None:
    """Have the thread that calls this run where others need not."""
    with suppress(OSError):  # a sandbox may forbid even that
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), GIVES_WAY)
