"""The thread of the page goes on, whatever a browser or a graph does."""

from __future__ import annotations

import threading
from contextlib import closing, nullcontext
from types import SimpleNamespace
from unittest.mock import DEFAULT, create_autospec

import numpy as np
import pytest
from support.view import make_graph, make_node

pytest.importorskip("viser", reason="needs the extra view: viser")

import viser

from deworldsg_ros.view.live.drawing import Label
from deworldsg_ros.view.live.scene import ClientLabels
from deworldsg_ros.view.live.server import LogOnce, Viewer

LIMIT_S = 30.0
PORT = 8580


class Browser:
    """A client of viser with a window of some size; it looks along +y.

    Its scene has the methods of viser's and refuses other arguments.
    """

    atomic = nullcontext
    client_id = 1

    def __init__(self, width=800, height=600):
        self.scene = create_autospec(viser.SceneApi, instance=True)
        self.camera = SimpleNamespace(
            position=np.zeros(3),
            wxyz=np.array([np.sqrt(0.5), -np.sqrt(0.5), 0, 0]),
            fov=np.pi / 2,
            image_width=width,
            image_height=height,
        )
        if height:  # viser divides, too
            self.camera.aspect = width / height

    @property
    def texts(self):
        return [call.args[0] for call in self.scene.add_label.call_args_list]


def cups(count):
    nodes = [make_node(i, "cup", (0.0, 2.0 + i, 0.0)) for i in range(1, count + 1)]
    graph = make_graph(nodes)
    graph.sequence = count
    return graph


@pytest.mark.parametrize(("width", "height"), [(80, 80), (300, 20), (1, 1)])
def test_a_window_without_room_for_a_label_has_none(width, height):
    browser = Browser(width, height)
    ClientLabels(browser).show([Label("1", "cup", np.array([0.0, 2.0, 0.0]), 1.0)])
    assert browser.texts == []


@pytest.mark.parametrize(("width", "height"), [(800, 0), (0, 600), (0, 0), (80, 80)])
def test_small_windows_are_no_errors_and_others_get_their_labels(width, height, monkeypatch):
    errors, drawn = [], threading.Event()
    small, usual = Browser(width, height), Browser()
    usual.scene.add_label.side_effect = lambda *_, **__: drawn.set() or DEFAULT
    with closing(Viewer("127.0.0.1", PORT, "", errors.append)) as viewer:
        monkeypatch.setattr(viewer._server, "get_clients", lambda: {1: small, 2: usual})
        viewer.reset(cups(2))
        assert drawn.wait(LIMIT_S)
        viewer._fit(small)  # as the button does
    assert errors == [] and small.texts == []


def test_a_step_of_the_page_that_fails_is_told_and_the_page_goes_on(monkeypatch):
    errors, drawn = [], threading.Event()
    broken, usual = Browser(), Browser()
    broken.scene.add_label.side_effect = RuntimeError("the browser has gone")
    usual.scene.add_label.side_effect = lambda *_, **__: drawn.set() or DEFAULT
    with closing(Viewer("127.0.0.1", PORT, "", errors.append)) as viewer:
        show, asked = viewer._scene.show, []

        def fail_once(*arguments):
            asked.append(arguments)
            if len(asked) == 1:
                told.set()
                raise ValueError("an object that cannot be drawn")
            show(*arguments)

        told = threading.Event()
        monkeypatch.setattr(viewer._scene, "show", fail_once)
        viewer.reset(cups(1))
        assert told.wait(LIMIT_S)
        monkeypatch.setattr(viewer._server, "get_clients", lambda: {1: broken, 2: usual})
        viewer.reset(cups(2))
        assert drawn.wait(LIMIT_S)
        assert viewer._thread.is_alive()
    assert [str(error) for error in errors[:2]] == [
        "an object that cannot be drawn", "the browser has gone",
    ]  # fmt: skip


def test_without_a_listener_the_log_has_the_first_error_of_each_type(caplog):
    log = LogOnce()
    for error in (ValueError("a"), ValueError("b"), KeyError("c")):
        log(error)
    assert [repr(record.exc_info[1]) for record in caplog.records] == [
        "ValueError('a')", "KeyError('c')",
    ]  # fmt: skip
