"""The servers of the page and for Foxglove: where they listen, and that they go on."""

import socket
import threading
from contextlib import closing, nullcontext
from types import SimpleNamespace
from unittest.mock import DEFAULT, create_autospec

import numpy as np
import pytest
from support.browser import free_port
from support.foxglove_client import FoxgloveClient
from support.view import make_edge, make_graph, make_node, updates_of

viser = pytest.importorskip("viser", reason="needs the extra view: viser")

from deworldsg_ros.scene.errors import ConfigurationError  # noqa: E402  after the guard
from deworldsg_ros.view.live import sources  # noqa: E402
from deworldsg_ros.view.live.camera import CameraView  # noqa: E402
from deworldsg_ros.view.live.server import Viewer  # noqa: E402

LIMIT_S = 30.0
HERE = "127.0.0.1"


class Browser:
    """A client of viser with a window of some size; it looks along +y.

    Its scene has the methods of viser's and refuses other arguments.
    """

    atomic = nullcontext
    client_id = 1

    def __init__(self, width=800, height=600):
        self.scene = create_autospec(viser.SceneApi, instance=True)
        self.drawn = threading.Event()
        self.scene.add_label.side_effect = lambda *_, **__: self.drawn.set() or DEFAULT
        self.camera = SimpleNamespace(
            position=np.zeros(3),
            wxyz=np.array([np.sqrt(0.5), -np.sqrt(0.5), 0, 0]),
            fov=np.pi / 2,
            image_width=width,
            image_height=height,
        )
        if height:  # viser divides, too
            self.camera.aspect = width / height


def cups(count):
    nodes = [make_node(i, "cup", (0.0, 2.0 + i, 0.0)) for i in range(1, count + 1)]
    return make_graph(nodes, sequence=count)


@pytest.mark.parametrize("size", [(800, 0), (0, 600), (0, 0), (80, 80), (300, 20), (1, 1)])
def test_small_windows_are_no_errors_and_others_get_their_labels(size, monkeypatch):
    errors, small, usual = [], Browser(*size), Browser()
    with closing(Viewer(HERE, free_port(), "", errors.append)) as viewer:
        monkeypatch.setattr(viewer._server, "get_clients", lambda: {1: small, 2: usual})
        viewer.reset(cups(2))
        assert usual.drawn.wait(LIMIT_S)
        viewer._fit(small)  # as the button does
    assert errors == [] and not small.drawn.is_set()


def test_a_step_of_the_page_that_fails_is_told_and_the_page_goes_on(monkeypatch, caplog):
    told = threading.Event()
    broken, usual = Browser(), Browser()
    broken.scene.add_label.side_effect = RuntimeError("the browser has gone")
    with closing(Viewer(HERE, free_port(), "")) as viewer:
        show = viewer._scene.show

        def fail_once(*arguments):
            if not told.is_set():
                told.set()
                raise ValueError("an object that cannot be drawn")
            show(*arguments)

        monkeypatch.setattr(viewer._scene, "show", fail_once)
        viewer.reset(cups(1))
        assert told.wait(LIMIT_S)
        monkeypatch.setattr(viewer._server, "get_clients", lambda: {1: broken, 2: usual})
        viewer.reset(cups(2))
        assert usual.drawn.wait(LIMIT_S)
        assert viewer._thread.is_alive()
    # Without a listener the log has the first error of each type.
    logged = [record.exc_info[0] for record in caplog.records if record.exc_info]
    assert logged == [ValueError, RuntimeError]


@pytest.fixture
def taken():
    """A port on which a program listens."""
    with closing(socket.create_server((HERE, 0))) as holder:
        yield holder.getsockname()[1]


@pytest.mark.parametrize(("foxglove", "module"), [(False, "viser"), (True, "foxglove")])
def test_a_server_listens_on_the_chosen_port_or_the_next_free_one(
    taken, foxglove, module, monkeypatch
):
    pytest.importorskip(module, reason=f"needs {module}")
    with closing(sources.open_sink(HERE, taken, "", foxglove=foxglove)) as sink:
        chosen = int(sink.url.rsplit(":", 1)[1])
        assert taken < chosen < taken + sources.MOST_PORTS
        with socket.create_connection((HERE, chosen)):
            pass
    monkeypatch.setattr(sources, "MOST_PORTS", 1)
    with pytest.raises(ConfigurationError, match=f"from {taken} on"):
        sources.open_sink(HERE, taken, "", foxglove=foxglove)


@pytest.mark.parametrize("host", ["192.0.2.1", "not an address"])
def test_an_address_of_another_machine_is_refused(host):
    with pytest.raises(ConfigurationError, match=host):
        sources.open_sink(host, 0, "", foxglove=False)


def test_a_late_client_of_foxglove_gets_the_whole_graph_and_then_the_updates():
    pytest.importorskip("foxglove", reason="needs foxglove-sdk")
    websockets = pytest.importorskip("websockets.sync.client", reason="needs websockets")
    from deworldsg_ros.view.live import foxglove as module

    table, vase = make_node(1, "dining table"), make_node(3, "vase")
    edges = [make_edge(2, 1, "on"), make_edge(2, 3, "near")]
    before = make_graph([table, make_node(2, "cup", (0, 0, 1)), vase], edges)
    after = make_graph([table, make_node(2, "teapot", (0, 0, 1)), vase], edges, sequence=2)
    with closing(module.FoxgloveServer(HERE, 0)) as server:
        server.reset(before)
        client = FoxgloveClient(websockets.connect, server.url)
        with closing(client.socket):
            client.expect(module.OBJECTS, b"cup 2")
            client.expect(module.RELATIONS, b"relation 2 1")
            client.expect(module.NEAR, b"relation 2 3")
            assert server.apply(*updates_of([before, after]))
            client.expect(module.OBJECTS, b"teapot 2")
            server.look(CameraView(1, np.eye(4), np.zeros((48, 64, 3), np.uint8)))
            client.expect(module.IMAGE, b"jpeg")
            client.expect(module.TRANSFORMS, module.CAMERA_FRAME.encode())
