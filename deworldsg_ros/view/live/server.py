"""The live viewer: the page of a graph, and a socket that brings it what changes."""

from __future__ import annotations

import asyncio
import gzip
import json
import logging
import re
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from typing import Any

from websockets.asyncio.server import ServerConnection, serve
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from deworldsg_ros.base.words import visible
from deworldsg_ros.graph.provenance import SeenSpace, TrailChange
from deworldsg_ros.scene.errors import ConfigurationError
from deworldsg_ros.view.live.camera import CameraView
from deworldsg_ros.view.live.state import Guard, LiveState, LogOnce, OnError, PageView, scene_of
from deworldsg_ros.view.page import html_of
from deworldsg_ros.wire import messages as wire

# Updates come at up to 30 Hz; a page gets what changed at this rate, or as fast as it reads.
PERIOD_S = 0.1
# Frames of the camera that wait to be shown; older ones are left out.
WAITING_VIEWS = 2
# A page asks for little.
MOST_REQUEST_BYTES = 4096
# More pages at once are refused: each has its own copy of what it was sent.
MOST_PAGES = 32
# A page that reads nothing for so long is closed.
READ_LIMIT_S = 20.0
# Only what is in the page runs, and it talks to its own server alone.
HEADERS = {
    "Referrer-Policy": "no-referrer",  # it would tell the secret
    "Cache-Control": "no-store",
    "X-Frame-Options": "DENY",
    "X-Content-Type-Options": "nosniff",
    "Content-Security-Policy": "default-src 'none'; script-src 'unsafe-inline'; "
    "style-src 'unsafe-inline'; img-src 'self' blob: data:; connect-src 'self'",
}
PHOTO = re.compile(r"/photo/(\d{1,18})")
WHY = re.compile(r"/why/(\d{1,18})/(\d{1,18})")


class Viewer:
    """Shows a graph on a web page. Its methods may be called from any thread.

    Args:
        host: address to listen on; 127.0.0.1 = only this machine.
        port: of the page.
        why_empty: shown while there are no objects.
        on_error: called with each exception while a page is served, which goes on; None = the log
            gets the first one of each type.

    Attributes:
        url: of the page, with its secret.
        guard: refuses who does not know the secret.

    Raises:
        ConfigurationError: if this machine cannot listen there.
    """

    def __init__(
        self, host: str, port: int, why_empty: str, on_error: OnError | None = None
    ) -> None:
        self._on_error = LogOnce() if on_error is None else on_error
        self.guard = Guard(host, "http")
        self.url = self.guard.url(port)
        self._page = html_of("Scene graph, live", None).encode()
        self._packed = gzip.compress(self._page)
        self._lock = threading.RLock()
        self._state = LiveState(why_empty)
        self._views: list[CameraView] = []
        self._wakers: set[asyncio.Event] = set()
        self._end, self._seen = asyncio.Event(), asyncio.Event()
        self._loop = asyncio.new_event_loop()
        listens: Future[None] = Future()
        self._thread = threading.Thread(
            target=self._serve_forever,
            args=(host, port, listens),
            name="viewer",
            daemon=True,
        )
        self._thread.start()
        try:
            listens.result()
        except (OSError, ValueError) as error:  # UnicodeError of a host that is no name
            raise ConfigurationError(
                f"cannot listen on host {host}, port {port}: {error}"
            ) from error

    @property
    def session(self) -> str | None:
        """The session of the graph."""
        return self._state.history.session

    @property
    def sequence(self) -> int:
        """Number of the newest update."""
        return self._state.history.sequence

    def reset(self, snapshot: wire.SceneGraphMessage) -> None:
        """Continue with a snapshot."""
        with self._lock:
            self._state.reset(snapshot)
        self._wake()

    def apply(self, update: wire.SceneGraphUpdateMessage) -> bool:
        """Apply the next update; False for one that is known.

        Raises:
            RefusedInput: ``lost_updates`` or ``other_session``: a snapshot has to come first.
        """
        with self._lock:
            applied = self._state.apply(update)
        self._wake()
        return applied

    def see(self, space: SeenSpace) -> None:
        """Show the surface of the room of a saved graph."""
        with self._lock:
            self._state.see(space)
        self._wake()

    def look(self, view: CameraView) -> None:
        """Show a frame of the camera; under load, frames are left out."""
        with self._lock:
            self._views = [*self._views, view][-WAITING_VIEWS:]
        with suppress(RuntimeError):
            self._loop.call_soon_threadsafe(self._seen.set)

    def correct(self, change: TrailChange) -> None:
        """Move the room and the way of the camera."""
        with self._lock:
            self._state.correct(change)
        self._wake()

    def say(self, why_empty: str) -> None:
        """Change the reason why there are no objects."""
        with self._lock:
            self._state.why_empty = why_empty
        self._wake()

    def close(self) -> None:
        """End the thread and the page."""
        with suppress(RuntimeError):  # it has ended
            self._loop.call_soon_threadsafe(self._end.set)
        self._thread.join(timeout=5.0)

    def _wake(self) -> None:
        with suppress(RuntimeError):
            self._loop.call_soon_threadsafe(self._wake_pages)

    def _wake_pages(self) -> None:
        for waker in self._wakers:
            waker.set()

    def _serve_forever(self, host: str, port: int, listens: Future[None]) -> None:
        try:
            self._loop.run_until_complete(self._run(host, port, listens))
            self._loop.run_until_complete(self._loop.shutdown_default_executor())
        finally:
            self._loop.close()

    async def _run(self, host: str, port: int, listens: Future[None]) -> None:
        try:
            self._server = await serve(
                self._serve,
                host,
                port,
                process_request=self._answer,
                max_size=MOST_REQUEST_BYTES,
                logger=_CONNECTIONS,
            )
        except Exception as error:
            listens.set_exception(error)
            return
        listens.set_result(None)
        watching = asyncio.create_task(self._watch())
        async with self._server:
            await self._end.wait()
            for connection in self._server.connections:
                connection.transport.abort()
            self._server.close()
        watching.cancel()

    async def _watch(self) -> None:
        """Take the frames of the camera, whether a page is open or not."""
        while True:
            await self._seen.wait()
            self._seen.clear()
            await asyncio.to_thread(self._guarded, self._take_views)
            await asyncio.sleep(PERIOD_S)

    def _answer(self, connection: ServerConnection, request: Request) -> Response | None:
        """The page, a photo, or an explanation; None = a socket follows."""
        path = self.guard.path(request.path, request.headers)
        if path is None:
            return connection.respond(403, "open the address that the program printed\n")
        if "upgrade" in ",".join(request.headers.get_all("Connection")).lower():
            return None if len(self._wakers) < MOST_PAGES else connection.respond(503, "too many\n")
        zips = "gzip" in ",".join(request.headers.get_all("Accept-Encoding"))
        path = path.partition("?")[0]
        if path == "/":
            body = self._packed if zips else self._page
            return _response("text/html; charset=utf-8", body, "gzip" if zips else "")
        with self._lock:
            if match := PHOTO.fullmatch(path):
                photo = self._state.crops[int(match[1])]
                if photo is not None:
                    return _response("image/jpeg", photo.image)
            elif match := WHY.fullmatch(path):
                lines = self._state.why(int(match[1]), int(match[2]))
                return _response("application/json", json.dumps(lines).encode())
        return connection.respond(404, "there is no such page\n")

    async def _serve(self, socket: ServerConnection) -> None:
        """Bring a page what changed, as fast as it reads, until it goes."""
        page, waker = PageView(), asyncio.Event()
        waker.set()
        self._wakers.add(waker)
        listening = asyncio.create_task(self._listen(socket, page, waker))
        try:
            while True:
                # Without a change, clouds and images that came too early still follow.
                with suppress(asyncio.TimeoutError):
                    await asyncio.wait_for(waker.wait(), 1.0)
                waker.clear()
                for message in await asyncio.to_thread(self._guarded, self._news, page) or ():
                    await asyncio.wait_for(socket.send(message), READ_LIMIT_S)
                await asyncio.sleep(PERIOD_S)
        except ConnectionClosed:
            pass
        except asyncio.TimeoutError:
            socket.transport.abort()
        finally:
            self._wakers.discard(waker)
            listening.cancel()

    async def _listen(self, socket: ServerConnection, page: PageView, waker: asyncio.Event) -> None:
        """Take what the user of a page chooses; what is no choice is left out."""
        with suppress(ConnectionClosed):
            async for text in socket:
                with suppress(ValueError, AttributeError, RecursionError):
                    chosen = json.loads(text)
                    moment = chosen.get("moment", page.moment)
                    if moment is None or (type(moment) is int and 0 <= moment < 2**53):
                        page.moment = moment
                    page.wants_images = bool(chosen.get("images", page.wants_images))
                    waker.set()

    def _take_views(self) -> None:
        with self._lock:
            views, self._views = self._views, []
            for view in views:
                self._state.look(view)
        self._wake()

    def _news(self, page: PageView) -> list[str | bytes]:
        moment = page.moment
        with self._lock:
            recipe = self._state.recipe(page)
        # The past is made without the lock: updates go on meanwhile.
        scene = None if recipe is None else scene_of(*recipe)
        with self._lock:
            if scene is not None and moment is not None:
                self._state.remember(moment, scene)
            return self._state.news(page, time.monotonic())

    def _guarded(self, step: Callable[..., Any], *arguments: Any) -> Any:
        """Take a step; one that fails must not freeze the page. None = it failed."""
        try:
            return step(*arguments)
        except Exception as error:
            self._on_error(error)
            return None


def _response(kind: str, body: bytes, encoding: str = "") -> Response:
    headers = Headers({**HEADERS, "Content-Type": kind, "Content-Length": str(len(body))})
    headers["Connection"] = "close"
    if encoding:
        headers["Content-Encoding"] = encoding
    return Response(200, "OK", headers, body)


class _OneLine(logging.Filter):
    """What a connection ends with, in one line without a traceback, and once of each kind.

    Whoever reaches the port can send what is no request and no frame of a page.
    """

    def __init__(self) -> None:
        super().__init__()
        self._known: set[str] = set()

    def filter(self, record: logging.LogRecord) -> bool:
        error = record.exc_info[1] if record.exc_info else None
        if error is None:
            return True
        kind = f"{record.getMessage()}: {type(error).__name__}"
        record.msg, record.args = visible(f"live view: {kind}: {error}"), ()
        record.exc_info = record.exc_text = None
        is_new = kind not in self._known
        self._known.add(kind)
        return is_new


_CONNECTIONS = logging.getLogger(f"{__name__}.connections")
_CONNECTIONS.addFilter(_OneLine())
