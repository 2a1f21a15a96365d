"""A small Hugging Face hub on this machine: one model, files with ranges, no other network."""

from __future__ import annotations

import hashlib
import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

COMMIT = "0123456789abcdef0123456789abcdef01234567"


def git_blob(content: bytes) -> str:
    return hashlib.sha1(f"blob {len(content)}\0".encode() + content).hexdigest()


class FakeHub:
    """Serves the files of one model; weights are large files with a SHA-256."""

    def __init__(self, repository: str, files: dict[str, bytes], licence: str = "mit") -> None:
        self.repository, self.files, self.licence = repository, files, licence
        self.requested: list[tuple[str, str, str]] = []  # method, file and range
        self.damaged: set[str] = set()  # names of files that are served with one wrong byte
        self.cut: set[str] = set()  # names of files whose next download ends in the middle
        self.url = ""

    def metadata(self) -> bytes:
        siblings = []
        for name, content in self.files.items():
            entry = {"rfilename": name, "size": len(content), "blobId": git_blob(content)}
            if name.endswith(".safetensors"):
                digest = hashlib.sha256(content).hexdigest()
                entry["lfs"] = {"sha256": digest, "size": len(content), "pointerSize": 130}
            siblings.append(entry)
        info = {
            **{"id": self.repository, "modelId": self.repository, "sha": COMMIT},
            **{"siblings": siblings, "cardData": {"license": self.licence}},
            **{"tags": [], "downloads": 0, "likes": 0, "private": False},
        }
        return json.dumps(info).encode()

    def metadata_path(self, revision: str) -> str:
        return f"/api/models/{self.repository}/revision/{revision}"

    @contextmanager
    def serving(self) -> Iterator[FakeHub]:
        hub = self

        class Handler(BaseHTTPRequestHandler):
            def log_message(self, *arguments: object) -> None:
                pass

            def do_GET(self) -> None:
                path = self.path.partition("?")[0]
                if path in (f"/api/models/{hub.repository}", hub.metadata_path(COMMIT)):
                    return self._send(200, hub.metadata(), {})
                prefix = f"/{hub.repository}/resolve/{COMMIT}/"
                name = path.removeprefix(prefix)
                if not path.startswith(prefix) or name not in hub.files:
                    return self._send(404, b"{}", {"X-Error-Code": "RepoNotFound"})
                content, asked = hub.files[name], self.headers.get("Range", "")
                etag = hashlib.sha256(content).hexdigest()
                hub.requested.append((self.command, name, asked))
                if name in hub.damaged:
                    content = content[:-1] + bytes([content[-1] ^ 1])
                headers = {"ETag": f'"{etag}"', "X-Repo-Commit": COMMIT, "Accept-Ranges": "bytes"}
                if asked:
                    first = int(asked.removeprefix("bytes=").partition("-")[0])
                    total = len(content)
                    headers["Content-Range"] = f"bytes {first}-{total - 1}/{total}"
                    return self._send(206, content[first:], headers)
                return self._send(200, content, headers)

            def do_HEAD(self) -> None:
                self.do_GET()

            def _send(self, status: int, body: bytes, headers: dict[str, str]) -> None:
                self.send_response(status)
                for key, value in {**headers, "Content-Length": str(len(body))}.items():
                    self.send_header(key, value)
                self.end_headers()
                name = self.path.rpartition("/")[2]
                if self.command == "GET" and name in hub.cut:
                    hub.cut.remove(name)
                    self.wfile.write(body[: len(body) // 2])
                    self.close_connection = True
                elif self.command == "GET":
                    self.wfile.write(body)

        server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        self.url = f"http://127.0.0.1:{server.server_address[1]}"
        try:
            yield self
        finally:
            server.shutdown()
            server.server_close()
            thread.join()
