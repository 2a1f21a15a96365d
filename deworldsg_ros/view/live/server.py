"""The live viewer: a page on this machine that follows a graph. Needs the package viser."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import viser
import websockets.asyncio.server as websocket_server

from deworldsg_ros.base.words import visible
from deworldsg_ros.graph.extent import horizontal_axes
from deworldsg_ros.scene.errors import ConfigurationError
from deworldsg_ros.view.live.camera import CameraView
from deworldsg_ros.view.live.details import object_html
from deworldsg_ros.view.live.drawing import Label
from deworldsg_ros.view.live.scene import (
    ClientLabels,
    Panel,
    ViserScene,
    has_area,
    overview,
    set_theme,
)
from deworldsg_ros.view.live.state import Guard, LiveState, LogOnce, OnError, up_of
from deworldsg_ros.wire import messages as wire

# Updates come at up to 30 Hz; a browser shows them at this rate, and surface points more seldom.
PERIOD_S = 0.1
POINTS_PERIOD_S = 1.0
# Of the view; viser's own 75 degrees distort what is near.
FOV_RAD = 0.85
# The view follows the objects if they grow by more than this part of their extent.
GROWTH = 0.03
# The browser's camera is exact to less than this.
MOVED_M = 0.01
# Frames of the camera that wait to be shown; older ones are left out.
WAITING_VIEWS = 2


class Viewer:
    """Shows a graph on a web page. Its methods may be called from any thread.

    Args:
        host: address to listen on; 127.0.0.1 = only this machine.
        port: the next free port from this one on is taken.
        why_empty: shown while there are no objects.
        on_error: called with each exception of the page's own thread, which goes on; None = the
            log gets the first one of each type.

    Attributes:
        url: of the page, with its secret.
        guard: refuses who does not know the secret.
    """

    def __init__(
        self, host: str, port: int, why_empty: str, on_error: OnError | None = None
    ) -> None:
        self._on_error = LogOnce() if on_error is None else on_error
        self.guard = Guard(host, "http")
        quiet = contextlib.redirect_stdout(io.StringIO())  # viser prints a table
        with quiet, _guarded(self.guard) as guarded:
            self._server = viser.ViserServer(host, port, label="DeWorldSG", verbose=False)
        if not guarded:
            self._server.stop()
            raise ConfigurationError(f"viser {viser.__version__} cannot be guarded: expected 1.1")
        self.url = self.guard.url(self._server.get_port())
        self._lock = threading.RLock()
        self._state = LiveState(why_empty=why_empty)
        self._views: deque[CameraView] = deque(maxlen=WAITING_VIEWS)
        self._labels: dict[int, ClientLabels] = {}
        self._fitted: dict[int, Any] = {}
        self._changed = threading.Event()
        self._closed = False
        self._points_s = 0.0
        set_theme(self._server, dark=False)
        self._server.gui.main_panel.dock_right()
        self._server.initial_camera.fov = FOV_RAD
        self._scene = ViserScene(self._server, self._select)
        self._panel = Panel(self._server, self._change, self._fit)
        self._drawing = self._state.draw()
        self._changed.set()
        self._server.on_client_connect(lambda _: self._changed.set())
        self._thread = threading.Thread(target=self._run, name="viewer", daemon=True)
        self._thread.start()

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
        self._change(lambda state: state.reset(snapshot))

    def apply(self, update: wire.SceneGraphUpdateMessage) -> bool:
        """Apply the next update; False for one that is known.

        Raises:
            RefusedInput: ``lost_updates`` or ``other_session``: a snapshot has to come first.
        """
        with self._lock:
            applied = self._state.apply(update)
        self._changed.set()
        return applied

    def look(self, view: CameraView) -> None:
        """Show a frame of the camera; under load, frames are left out."""
        self._views.append(view)
        self._changed.set()

    def say(self, why_empty: str) -> None:
        """Change the reason why there are no objects."""
        self._change(lambda state: setattr(state, "why_empty", why_empty))

    def close(self) -> None:
        """End the thread and the page."""
        self._closed = True
        self._changed.set()
        self._thread.join(timeout=5.0)
        self._server.stop()

    def _change(self, function: Callable[[LiveState], object]) -> None:
        with self._lock:
            function(self._state)
        self._changed.set()

    def _select(self, node_id: int) -> None:
        self._change(lambda state: setattr(state, "selected", node_id))

    def _run(self) -> None:
        while not self._closed:
            began_s = time.monotonic()
            # Without a change, only the labels follow the cameras of the browsers.
            if self._changed.wait(timeout=PERIOD_S):
                self._changed.clear()
                self._guarded(self._redraw)
            self._guarded(self._place_labels)
            time.sleep(max(began_s + PERIOD_S - time.monotonic(), 0.0))

    def _guarded(self, step: Callable[..., None], *arguments: Any) -> None:
        """Take a step of the thread. One that fails must not freeze the page of all browsers."""
        try:
            step(*arguments)
        except Exception as error:
            self._on_error(error)

    def _redraw(self) -> None:
        with self._lock, self._server.atomic():
            state = self._state
            while self._views:
                state.look(self._views.popleft())
            self._drawing = state.draw()
            self._scene.show(self._drawing, state.shape)
            self._draw_surroundings(state)
            self._draw_points(state)
            self._panel.show(state, state.summary(self._drawing), self._selected_html(state))

    def _draw_surroundings(self, state: LiveState) -> None:
        frames = state.frames() if self._panel.camera.value else []
        self._scene.show_camera(frames)
        self._panel.show_image(frames[-1].image if frames else b"")
        bounds = state.bounds()
        if bounds is not None:
            self._scene.show_floor(*bounds, state.floor_m(), up_of(state.shown))
        self._scene.switch_floor(self._panel.floor.value)

    def _draw_points(self, state: LiveState) -> None:
        """Surface points are large: they follow once a second."""
        if not self._panel.points.value:
            self._scene.show_points(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8))
        elif time.monotonic() - self._points_s > POINTS_PERIOD_S:
            self._points_s = time.monotonic()
            self._scene.show_points(*state.points())

    def _selected_html(self, state: LiveState) -> str:
        if state.selected is None:
            return ""
        crop = state.crops[state.selected]
        return object_html(
            state.table.objects[state.selected],
            state.relations_of(state.selected),
            None if crop is None else crop.image,
        )

    def _place_labels(self) -> None:
        clients = self._server.get_clients()
        self._labels = {key: item for key, item in self._labels.items() if key in clients}
        labels = self._drawing.labels if self._panel.labels.value else ()
        for key, client in clients.items():
            self._guarded(self._place_labels_of, key, client, labels)

    def _place_labels_of(self, key: int, client: Any, labels: Sequence[Label]) -> None:
        if has_area(client):
            self._follow_growth(key, client)
            self._labels.setdefault(key, ClientLabels(client)).show(labels)

    def _follow_growth(self, key: int, client: Any) -> None:
        """Keep everything in view until the user moves the camera."""
        with self._lock:
            bounds = self._state.bounds()
        if bounds is None:
            return
        fitted = self._fitted.get(key)
        if fitted is not None:
            position, old, aspect = fitted
            moved = not np.allclose(client.camera.position, position, atol=MOVED_M)
            grown_m = np.abs(np.subtract(bounds, old)).max()
            same = grown_m < GROWTH * np.ptp(old, axis=0).max() and client.camera.aspect == aspect
            if moved or same:
                return
        self._fit(client)

    def _fit(self, client: Any) -> None:
        with self._lock:
            bounds, up = self._state.bounds(), up_of(self._state.shown)
        if bounds is None or not has_area(client):
            return
        camera = client.camera
        aspect = camera.aspect
        position, target = overview(*bounds, horizontal_axes(up), camera.fov, aspect)
        with client.atomic():
            camera.up_direction = up
            camera.position, camera.look_at = position, target
        self._fitted[client.client_id] = (position, bounds, aspect)


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
_GUARDING = threading.Lock()


@contextlib.contextmanager
def _guarded(guard: Guard) -> Iterator[list[Guard]]:
    """The server of viser that is made in the block asks a guard before each page and socket.

    viser has no way to say so. Its constructor returns when `serve` was called in its thread.

    Yields:
        a list that has the guard afterwards, if it was asked for.
    """
    module: Any = websocket_server
    serve, guarded = module.serve, []

    def guarded_serve(
        *arguments: Any, process_request: Callable[..., Any] | None = None, **options: Any
    ) -> Any:
        if process_request is None:  # not viser's
            return serve(*arguments, **options)

        def process(connection: Any, request: Any) -> Any:
            path = guard.path(request.path, request.headers)
            if path is None:
                return connection.respond(403, "open the address that the program printed\n")
            response = process_request(connection, dataclasses.replace(request, path=path))
            if response is not None:
                response.headers["Referrer-Policy"] = "no-referrer"  # it would tell the secret
                response.headers["Cache-Control"] = "no-store"
                response.headers["X-Frame-Options"] = "DENY"
            return response

        guarded.append(guard)
        options["logger"] = _CONNECTIONS
        return serve(*arguments, process_request=process, **options)

    with _GUARDING:
        module.serve = guarded_serve
        try:
            yield guarded
        finally:
            module.serve = serve
