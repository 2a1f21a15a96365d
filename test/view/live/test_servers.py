"""The servers of the page and for Foxglove: where they listen, and that they go on."""

import contextlib
import gzip
import itertools
import json
import socket
import threading
import time
import urllib.error
import urllib.request
from contextlib import closing
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import pytest
from msgspec.structs import replace
from support.browser import free_port
from support.foxglove_client import FoxgloveClient
from support.nodes import wait_until
from support.view import make_edge, make_graph, make_node, updates_of
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from deworldsg_ros.scene.errors import ConfigurationError
from deworldsg_ros.view.live import server, sources, state
from deworldsg_ros.view.live.camera import CameraView
from deworldsg_ros.view.live.server import Viewer
from deworldsg_ros.view.live.state import Guard

LIMIT_S = 30.0
HERE = "127.0.0.1"


def cups(count):
    nodes = [make_node(i, "cup", (0.0, 2.0 + i, 0.0)) for i in range(1, count + 1)]
    return make_graph(nodes, sequence=count)


@contextlib.contextmanager
def shown(viewer):
    """A page that reads: a function with which it waits for some number of objects."""
    nodes, messages = {}, []
    with connect(viewer.url.replace("http", "ws"), max_size=None) as page:

        def wait_for(count):
            end_s = time.monotonic() + LIMIT_S
            while len(nodes) != count:
                message = page.recv(end_s - time.monotonic())
                if isinstance(message, str):
                    messages.append(json.loads(message))
                    nodes.update({item["id"]: item for item in messages[-1].get("nodes", ())})
                    for node_id in messages[-1].get("removed", ()):
                        del nodes[node_id]
            return messages

        yield page, wait_for


def test_pages_get_the_graph_and_choose_for_themselves():
    with closing(Viewer(HERE, free_port(), "")) as viewer:
        viewer.reset(cups(2))
        with shown(viewer) as (one, one_has), shown(viewer) as (_, two_has):
            one_has(2), two_has(2)
            assert viewer.apply(*updates_of([cups(2), cups(3)]))
            one_has(3), two_has(3)
            one.send(json.dumps({"moment": 0}))
            one_has(2)
            assert viewer.apply(*updates_of([cups(3), cups(4)]))
            two_has(4)
            for moment in ('"x"', "-1", "true", "1e99", "[]", "9" * 5000):
                with contextlib.suppress(ConnectionClosed):
                    one.send(f'{{"moment": {moment}}}'[:4000])
            for text in ("", "{", "[]", "3", b"\0", "[" * 2000):
                one.send(text)
            one.send(json.dumps({"moment": None}))
            one_has(4)


def test_a_page_that_never_reads_grows_nothing_and_holds_up_nobody():
    points = np.random.default_rng(0).uniform(size=(400, 3))
    nodes = [make_node(i, "cup", (0, i, 0), points=points) for i in range(1, 201)]
    with closing(Viewer(HERE, free_port(), "")) as viewer:
        url = urlsplit(viewer.url)
        with socket.create_connection((HERE, url.port), LIMIT_S) as lazy, shown(viewer) as (_, has):
            lazy.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            lazy.sendall(handshake(url.port, url.path))
            for count in range(1, 30):
                moved = [replace(node, observations=count) for node in nodes[: 200 - count]]
                viewer.reset(make_graph(moved, sequence=count))
                has(200 - count)
            waiting = [c.transport.get_write_buffer_size() for c in viewer._server.connections]
            assert len(waiting) == 2 and max(waiting) < 2_000_000


def test_a_step_of_the_page_that_fails_is_told_and_the_page_goes_on(monkeypatch, caplog):
    with closing(Viewer(HERE, free_port(), "")) as viewer:
        news, failed = viewer._state.news, threading.Event()

        def fail_once(*arguments):
            if not failed.is_set():
                failed.set()
                raise ValueError("an object that cannot be drawn")
            return news(*arguments)

        monkeypatch.setattr(viewer._state, "news", fail_once)
        viewer.reset(cups(1))
        with shown(viewer) as (_, has):
            assert failed.wait(LIMIT_S)
            viewer.reset(cups(2))
            has(2)
    # Without a listener the log has the first error of each type.
    logged = [record.exc_info[0] for record in caplog.records if record.exc_info]
    assert logged == [ValueError]


def test_frames_are_taken_without_a_page_and_late_pages_see_the_way():
    with closing(Viewer(HERE, free_port(), "")) as viewer:
        for number in range(3):
            T = np.eye(4)
            T[0, 3] = number
            viewer.look(CameraView(number, T, np.zeros((48, 64, 3), np.uint8)))
            wait_until(lambda: not viewer._views, LIMIT_S, "the frame")
            time.sleep(0.15)
        viewer.reset(cups(1))
        with shown(viewer) as (page, has):
            assert any(len(message.get("path", ())) == 3 for message in has(1))
            assert page.recv(LIMIT_S).startswith(b"\xff\xd8")


def test_opening_and_closing_leaves_nothing(caplog):
    def held():
        return len(list(Path("/proc/self/fd").iterdir())), threading.active_count()

    def opened(count):
        for _ in range(count):
            with closing(Viewer(HERE, free_port(), "")) as viewer, shown(viewer):
                viewer.reset(cups(1))

    opened(2)
    files, threads = held()
    opened(12)
    # A leak would be one a time. Some of other tests' end, or start, at any time.
    wait_until(
        lambda: held()[0] <= files + 5 and held()[1] <= threads + 2, LIMIT_S, "the end of all"
    )


def test_a_page_that_reads_nothing_is_closed_and_its_place_is_free(monkeypatch):
    monkeypatch.setattr(server, "READ_LIMIT_S", 0.5)
    monkeypatch.setattr(state, "IMAGE_PERIOD_S", 0.0)
    rng, count = np.random.default_rng(0), itertools.count(1)
    with closing(Viewer(HERE, free_port(), "")) as viewer:
        url = urlsplit(viewer.url)
        with socket.create_connection((HERE, url.port), LIMIT_S) as lazy:
            lazy.sendall(handshake(url.port, url.path))
            wait_until(lambda: viewer._wakers, LIMIT_S, "the page")

            def is_closed():
                noise = rng.integers(0, 255, (480, 640, 3)).astype(np.uint8)
                viewer.look(CameraView(next(count), np.eye(4), noise))
                return not viewer._wakers

            wait_until(is_closed, 2 * LIMIT_S, "the end of the page", lambda: time.sleep(0.1))


def test_the_page_a_photo_and_an_explanation_over_http():
    with closing(Viewer(HERE, free_port(), "")) as viewer:
        nodes = [make_node(1, "cup"), make_node(2, "table")]
        viewer.reset(make_graph(nodes, [make_edge(1, 2)]))

        def get(path, zips=False):
            asked = urllib.request.Request(viewer.url + path)
            if zips:
                asked.add_header("Accept-Encoding", "gzip")
            with urllib.request.urlopen(asked, timeout=LIMIT_S) as answered:
                return answered.read(), answered.headers

        page, headers = get("")
        assert (
            b"WebGLRenderer" in page and "default-src 'none'" in headers["Content-Security-Policy"]
        )
        packed, headers = get("", zips=True)
        assert headers["Content-Encoding"] == "gzip" and gzip.decompress(packed) == page
        assert len(packed) < 300_000
        lines = json.loads(get("/why/1/2")[0])
        assert any("80%" in line for line in lines)
        assert json.loads(get("/why/2/1")[0]) == []
        assert get("/?x=1")[0] == page
        for path in ("/photo/1", "/photo/x", "/why/1", "/etc/passwd", "/../page.js"):
            with pytest.raises(urllib.error.HTTPError, match="404"):
                get(path)


def handshake(port, path):
    return (
        f"GET {path} HTTP/1.1\r\nHost: {HERE}:{port}\r\nConnection: Upgrade\r\n"
        "Upgrade: websocket\r\nSec-WebSocket-Version: 13\r\n"
        "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n"
    ).encode()


@pytest.fixture
def taken():
    """A port on which a program listens."""
    with closing(socket.create_server((HERE, 0))) as holder:
        yield holder.getsockname()[1]


@pytest.mark.parametrize(("foxglove", "module"), [(False, "websockets"), (True, "foxglove")])
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


@pytest.mark.parametrize("host", ["192.0.2.1", "not an address", "a" * 70])
def test_an_address_of_another_machine_is_refused(host):
    with pytest.raises(ConfigurationError, match=host):
        sources.open_sink(host, 0, "", foxglove=False)


def answer(port, target, upgrade, foxglove, **headers):
    """The status of the answer of a server to a request."""
    fields = {"Host": f"{HERE}:{port}", **headers}
    if upgrade:
        fields |= {"Connection": "Upgrade", "Upgrade": "websocket", "Sec-WebSocket-Version": "13"}
        fields |= {"Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ=="}
        fields |= {"Sec-WebSocket-Protocol": "foxglove.sdk.v1"} if foxglove else {}
    text = "".join(f"{name}: {value}\r\n" for name, value in fields.items())
    with socket.create_connection((HERE, port), LIMIT_S) as client:
        client.sendall(f"GET {target} HTTP/1.1\r\n{text}\r\n".encode())
        return client.makefile("rb").readline().decode().split()[1]


@pytest.mark.parametrize(("foxglove", "module"), [(False, "websockets"), (True, "foxglove")])
def test_only_the_printed_address_opens_a_server_and_no_page_of_others(foxglove, module, caplog):
    pytest.importorskip(module, reason=f"needs {module}")
    with closing(sources.open_sink(HERE, free_port(), "", foxglove=foxglove)) as sink:
        port, path = urlsplit(sink.url).port, urlsplit(sink.url).path
        own, here = f"http://{HERE}:{port}", f"localhost:{port}"
        for upgrade in (True,) if foxglove else (True, False):
            good = "101" if upgrade else "200"
            assert answer(port, path, upgrade, foxglove) == good
            assert answer(port, path, upgrade, foxglove, Origin=own) == good
            both = {"Host": here, "Origin": f"http://{here}"}
            assert answer(port, path, upgrade, foxglove, **both) == good
            for target in ("/", path[:-1], path + "x", "/" + path, path.upper(), f"{own}{path}"):
                assert answer(port, target, upgrade, foxglove) == "403", target
            for origin in (
                "http://evil.example",
                f"http://evil.example:{port}",
                "null",
                "http://[",
            ):
                given = answer(port, path, upgrade, foxglove, Origin=origin)
                assert given == "403", origin
            for host in (f"evil.example:{port}", f"localhost.evil.example:{port}", "", "[", "a@b"):
                given = answer(port, path, upgrade, foxglove, Host=host)
                assert given == "403", host
        times = 1 if foxglove else 2
        assert sink.guard.refused == {"token": 6 * times, "origin": 4 * times, "host": 5 * times}
    warnings = [record for record in caplog.records if "refused" in record.getMessage()]
    assert len(warnings) == 3  # one a reason
    assert path.strip("/") not in caplog.text


def test_what_is_no_request_and_no_frame_is_one_line_in_the_log(caplog):
    server._CONNECTIONS.filters[0]._known.clear()  # of other tests
    with closing(sources.open_sink(HERE, free_port(), "", foxglove=False)) as sink:
        port, path = urlsplit(sink.url).port, urlsplit(sink.url).path
        for _ in range(3):
            for frames in (b"", b"\xff" * 200, b"\x82\x85\0\0\0\0abcde"):
                with socket.create_connection((HERE, port), LIMIT_S) as client:
                    client.settimeout(2.0)
                    begin = handshake(port, path) if frames else b"POST / HTTP/1.1\r\n\r\n"
                    client.sendall(begin + frames)
                    with contextlib.suppress(TimeoutError, ConnectionError):
                        while client.recv(65536):
                            pass
    assert not [record for record in caplog.records if record.exc_info]
    told = [r.getMessage() for r in caplog.records if r.name.endswith("connections")]
    assert told and len(told) == len(set(told)) and not any("\n" in line for line in told)


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
