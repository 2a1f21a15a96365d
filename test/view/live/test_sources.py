"""Where the page and the server for Foxglove listen."""

from __future__ import annotations

import socket
from contextlib import closing

import pytest

from deworldsg_ros.scene.errors import ConfigurationError
from deworldsg_ros.view.live import sources

HERE = "127.0.0.1"


def listening():
    """A socket that listens on a port of the system's choice, and the port."""
    taken = socket.create_server((HERE, 0))
    return closing(taken), taken.getsockname()[1]


@pytest.mark.parametrize(("foxglove", "module"), [(False, "viser"), (True, "foxglove")])
def test_a_server_listens_on_the_chosen_port_or_the_next_free_one(foxglove, module):
    pytest.importorskip(module, reason=f"needs {module}")
    holder, port = listening()
    with holder:
        sink = sources.open_sink(HERE, port, "", foxglove=foxglove)
    with closing(sink):
        chosen = int(sink.url.rsplit(":", 1)[1])
        assert port < chosen < port + sources.MOST_PORTS
        with socket.create_connection((HERE, chosen)):
            pass


def test_without_a_choice_each_has_its_usual_port(monkeypatch):
    asked = []
    monkeypatch.setattr(sources, "_free_port", lambda _, first: asked.append(first) or 1 / 0)
    for foxglove in (False, True):
        with pytest.raises(ZeroDivisionError):
            sources.open_sink(HERE, 0, "", foxglove=foxglove)
    assert asked == [8080, 8765]


@pytest.mark.parametrize("host", ["192.0.2.1", "not an address"])
def test_an_address_of_another_machine_is_refused(host):
    with pytest.raises(ConfigurationError, match=f"host {host}.*expected an address"):
        sources.open_sink(host, 0, "", foxglove=False)


def test_when_no_port_is_free_it_says_so(monkeypatch):
    monkeypatch.setattr(sources, "MOST_PORTS", 1)
    holder, port = listening()
    with holder, pytest.raises(ConfigurationError, match=f"from {port} on"):
        sources.open_sink(HERE, port, "", foxglove=False)
