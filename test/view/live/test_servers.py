"""The servers of the page and for Foxglove: where they listen, and that they go on."""

import contextlib
import socket
import threading
from contextlib import closing, nullcontext
from types import SimpleNamespace
from unittest.mock import DEFAULT, create_autospec
from urllib.parse import urlsplit

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
from deworldsg_ros.view.live.state import Guard  # noqa: E402

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
        chosen = urlsplit(sink.url).port
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


def answer(port, target, upgrade, **headers):
    """First line of the answer of a server to a request, with the version that a page names."""
    fields = {"Host": f"{HERE}:{port}", **headers}
    if upgrade:
        fields |= {"Connection": "Upgrade", "Upgrade": "websocket", "Sec-WebSocket-Version": "13"}
        fields |= {"Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ=="}
        protocols = f"viser-v{viser.__version__}, foxglove.sdk.v1"
        fields |= {"Sec-WebSocket-Protocol": protocols}
    text = "".join(f"{name}: {value}\r\n" for name, value in fields.items())
    with socket.create_connection((HERE, port), LIMIT_S) as client:
        client.sendall(f"GET {target} HTTP/1.1\r\n{text}\r\n".encode())
        return client.makefile("rb").readline().decode()


@pytest.mark.parametrize(("foxglove", "module"), [(False, "viser"), (True, "foxglove")])
def test_only_the_printed_address_opens_a_server_and_no_page_of_others(foxglove, module, caplog):
    pytest.importorskip(module, reason=f"needs {module}")
    with closing(sources.open_sink(HERE, free_port(), "", foxglove=foxglove)) as sink:
        port, path = urlsplit(sink.url).port, urlsplit(sink.url).path
        own, here = f"http://{HERE}:{port}", f"localhost:{port}"
        for upgrade in (True,) if foxglove else (True, False):
            good = "HTTP/1.1 101" if upgrade else "HTTP/1.1 200"
            assert answer(port, path, upgrade).startswith(good)
            assert answer(port, path, upgrade, Origin=own).startswith(good)
            assert answer(port, path, upgrade, Host=here, Origin=f"http://{here}").startswith(good)
            for target in ("/", path[:-1], path + "x", "/" + path, path.upper(), f"{own}{path}"):
                assert answer(port, target, upgrade).startswith("HTTP/1.1 403"), target
            for origin in (
                "http://evil.example",
                f"http://evil.example:{port}",
                "null",
                "http://[",
            ):
                assert answer(port, path, upgrade, Origin=origin).startswith("HTTP/1.1 403"), origin
            for host in (f"evil.example:{port}", f"localhost.evil.example:{port}", "", "[", "a@b"):
                assert answer(port, path, upgrade, Host=host).startswith("HTTP/1.1 403"), host
        times = 1 if foxglove else 2
        assert sink.guard.refused == {"token": 6 * times, "origin": 4 * times, "host": 5 * times}
    warnings = [record for record in caplog.records if "refused" in record.getMessage()]
    assert len(warnings) == 3  # one a reason
    assert path.strip("/") not in caplog.text


def test_what_is_no_request_and_no_frame_is_one_line_in_the_log(caplog):
    with closing(sources.open_sink(HERE, free_port(), "", foxglove=False)) as sink:
        port, path = urlsplit(sink.url).port, urlsplit(sink.url).path
        upgrade = (
            f"GET {path} HTTP/1.1\r\nHost: {HERE}:{port}\r\nConnection: Upgrade\r\n"
            "Upgrade: websocket\r\nSec-WebSocket-Version: 13\r\n"
            "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n"
            f"Sec-WebSocket-Protocol: viser-v{viser.__version__}\r\n\r\n"
        ).encode()
        for _ in range(3):
            for frames in (b"", b"\xff" * 200, b"\x82\x85\0\0\0\0abcde"):
                with socket.create_connection((HERE, port), LIMIT_S) as client:
                    client.settimeout(2.0)
                    client.sendall(upgrade + frames if frames else b"POST / HTTP/1.1\r\n\r\n")
                    with contextlib.suppress(TimeoutError, ConnectionError):
                        while client.recv(65536):
                            pass
    assert not [record for record in caplog.records if record.exc_info]
    told = [r.getMessage() for r in caplog.records if r.name.endswith("connections")]
    assert told and len(told) == len(set(told)) and not any("\n" in line for line in told)


def test_no_page_is_shown_that_is_not_guarded(monkeypatch):
    made = create_autospec(viser.ViserServer, instance=True)
    monkeypatch.setattr(viser, "ViserServer", lambda *_, **__: made)
    with pytest.raises(ConfigurationError, match="cannot be guarded"):
        Viewer(HERE, 0, "")
    made.stop.assert_called_once_with()


@pytest.mark.parametrize(
    ("host", "start"),
    [
        ("0.0.0.0", "http://localhost:80/"),
        ("::1", "http://[::1]:80/"),
        (HERE, f"http://{HERE}:80/"),
    ],
)
def test_the_printed_address_leads_to_the_server_and_is_new_each_time(host, start):
    first, second = (Guard(host, "http").url(80) for _ in range(2))
    assert first.startswith(start) and first != second and len(first) >= len(start) + 22


def test_a_gate_passes_both_ways_and_ends_what_is_no_request(monkeypatch):
    pytest.importorskip("foxglove", reason="needs foxglove-sdk")
    from deworldsg_ros.view.live import foxglove as module

    monkeypatch.setattr(module, "HEAD_S", 0.2)
    with closing(module.FoxgloveServer(HERE, 0)) as server:
        for text in (b"", b"\r\n\r\n", b"GET /\r\n\r\n", b"x" * 2 * module.HEAD_BYTES):
            client = socket.create_connection((HERE, urlsplit(server.url).port), LIMIT_S)
            with client, contextlib.suppress(ConnectionError):
                client.sendall(text)
                assert not client.recv(100)


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
