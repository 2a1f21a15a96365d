"""A TCP link that can be cut: what is sent meanwhile is neither delivered nor refused."""

import contextlib
import select
import socket
import threading


class CutLink:
    """Forwards connections on `port` to a port of this machine, but not while `is_cut` is set."""

    def __init__(self, to_port: int) -> None:
        self._to_port = to_port
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = self._listener.getsockname()[1]
        self.is_cut, self._closed = threading.Event(), threading.Event()
        threading.Thread(target=self._accept, daemon=True).start()

    def close(self) -> None:
        self._closed.set()
        self._listener.close()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while not self._closed.is_set():
                near, _ = self._listener.accept()
                threading.Thread(target=self._forward, args=(near,), daemon=True).start()

    def _forward(self, near: socket.socket) -> None:
        with near, contextlib.suppress(OSError):
            self._wait_while_cut()
            far = socket.create_connection(("127.0.0.1", self._to_port), timeout=5)
            with far:
                other = {near: far, far: near}
                while not self._closed.is_set():
                    self._wait_while_cut()
                    for ready in select.select([near, far], [], [], 0.1)[0]:
                        data = ready.recv(1 << 16)
                        if not data:
                            return
                        other[ready].sendall(data)

    def _wait_while_cut(self) -> None:
        while self.is_cut.is_set() and not self._closed.wait(0.1):
            pass
