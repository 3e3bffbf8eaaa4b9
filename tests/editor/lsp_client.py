"""A small client of the language server protocol: a process, its pipes, and one message at a time."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from pathlib import Path
from queue import Empty, Queue
from typing import Any

PATIENCE = 30.0


class Client:
    """A session with `stlc lsp`."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.process = subprocess.Popen(
            [sys.executable, "-m", "stlc", "lsp", "--stdio"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            cwd=folder,
            env={**os.environ, "OMP_NUM_THREADS": "1"},
        )
        self.messages: Queue[dict[str, Any]] = Queue()
        self.published: dict[str, list[dict[str, Any]]] = {}
        self._count = 0
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    # ------------------------------------------------------------------ the wire

    def _read(self) -> None:
        stream = self.process.stdout
        assert stream is not None
        while True:
            length = 0
            while (line := stream.readline()) not in (b"\r\n", b""):
                name, _, value = line.partition(b":")
                if name.lower() == b"content-length":
                    length = int(value)
            if not length:
                return
            self.messages.put(json.loads(stream.read(length)))

    def _send(self, message: dict[str, Any]) -> None:
        body = json.dumps({"jsonrpc": "2.0", **message}).encode()
        stream = self.process.stdin
        assert stream is not None
        stream.write(b"Content-Length: %d\r\n\r\n%s" % (len(body), body))
        stream.flush()

    def notify(self, method: str, params: object = None) -> None:
        self._send({"method": method, "params": params if params is not None else {}})

    def request(self, method: str, params: object = None) -> Any:
        """The result; an error raises LspError."""
        self._count += 1
        wanted = self._count
        self._send({"id": wanted, "method": method, "params": params})
        while True:
            message = self._next()
            if message.get("id") == wanted and "method" not in message:
                if "error" in message:
                    raise LspError(message["error"]["message"])
                return message["result"]

    def _next(self) -> dict[str, Any]:
        try:
            message = self.messages.get(timeout=PATIENCE)
        except Empty:
            raise AssertionError(f"no answer within {PATIENCE} s") from None
        if message.get("method") == "textDocument/publishDiagnostics":
            self.published.setdefault(message["params"]["uri"], []).append(message["params"]["diagnostics"])
        return message

    # ------------------------------------------------------------------ a session

    def start(self, encodings: list[str] | None = None) -> dict[str, Any]:
        general = {} if encodings is None else {"general": {"positionEncodings": encodings}}
        result = self.request(
            "initialize",
            {"processId": None, "rootUri": self.folder.as_uri(), "capabilities": general},
        )
        self.notify("initialized")
        return dict(result)

    def open(self, uri: str, text: str) -> list[dict[str, Any]]:
        document = {"uri": uri, "languageId": "stlc", "version": 1, "text": text}
        self.notify("textDocument/didOpen", {"textDocument": document})
        return self.findings(uri)

    def change(self, uri: str, text: str, version: int = 2) -> list[dict[str, Any]]:
        changed = {"textDocument": {"uri": uri, "version": version}, "contentChanges": [{"text": text}]}
        self.notify("textDocument/didChange", changed)
        return self.findings(uri)

    def findings(self, uri: str) -> list[dict[str, Any]]:
        """Diagnostics that are published next for a text."""
        queue = self.published.setdefault(uri, [])
        while not queue:
            self._next()
        return queue.pop(0)

    def at(self, method: str, uri: str, line: int, character: int, **more: object) -> Any:
        place = {"line": line, "character": character}
        return self.request(
            f"textDocument/{method}", {"textDocument": {"uri": uri}, "position": place, **more}
        )

    def stop(self) -> int:
        """Leave as an editor does; the exit code."""
        self.request("shutdown")
        self.notify("exit")
        code = self.process.wait(PATIENCE)
        for stream in (self.process.stdin, self.process.stdout, self.process.stderr):
            if stream is not None:
                stream.close()
        return code


class LspError(Exception):
    """The server refused."""
