"""A stub of the Hugging Face hub's HTTP API: as much as takes a model in and hands it out again, in memory."""

from __future__ import annotations

import base64
import contextlib
import json
import os
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

TOKEN = "hf_" + "x" * 34
OWNER = "somebody"


class Hub:
    """What it has been told; `repos` are name -> file -> content."""

    def __init__(self):
        self.repos, self.private, self.commits, self.requests = {}, {}, [], []
        self.server = ThreadingHTTPServer(("127.0.0.1", 0), type("Handler", (_Handler,), {"hub": self}))
        self.address = f"http://127.0.0.1:{self.server.server_port}"

    def environment(self, home, token=TOKEN):
        """Variables of a process that takes this for the hub; without `token` nobody is logged in."""
        kept = {name: value for name, value in os.environ.items() if not name.startswith(("HF_", "HUGGING"))}
        own = {"HF_ENDPOINT": self.address, "HF_HOME": str(home), "HF_HUB_DISABLE_XET": "1", "NO_PROXY": "127.0.0.1"}
        return {**kept, **own, "no_proxy": "127.0.0.1", **({"HF_TOKEN": token} if token else {})}


@contextlib.contextmanager
def hub():
    """One that runs within the block."""
    made = Hub()
    thread = threading.Thread(target=made.server.serve_forever, daemon=True)
    thread.start()
    try:
        yield made
    finally:
        made.server.shutdown()
        made.server.server_close()
        thread.join()


class _Handler(BaseHTTPRequestHandler):
    hub: Hub
    protocol_version = "HTTP/1.1"

    def log_message(self, *_):
        pass

    def do_GET(self):
        self._read()
        if self.path == "/api/whoami-v2":
            self._answer({"name": OWNER, "type": "user", "orgs": []})
        else:
            self._file()

    def do_HEAD(self):
        self._read()
        self._file()

    def do_POST(self):
        body, path = self._read(), self.path.partition("?")[0]
        if path == "/api/validate-yaml":
            self._answer({"errors": [], "warnings": []})
        elif self.headers.get("Authorization") != f"Bearer {TOKEN}":
            self._answer({"error": "Invalid credentials in Authorization header"}, 401)
        elif path == "/api/repos/create":
            asked = json.loads(body)
            name = f"{asked.get('organization') or OWNER}/{asked['name']}"
            known = name in self.hub.repos
            self.hub.repos.setdefault(name, {})
            self.hub.private.setdefault(name, asked.get("visibility") == "private" or asked.get("private"))
            self._answer({"url": f"{self.hub.address}/{name}"}, 409 if known else 200)
        elif path.endswith("/preupload/main"):
            files = [{**f, "uploadMode": "regular", "shouldIgnore": False} for f in json.loads(body)["files"]]
            self._answer({"files": [{k: f[k] for k in ("path", "uploadMode", "shouldIgnore")} for f in files]})
        elif path.endswith("/commit/main"):
            self._commit(path.removeprefix("/api/models/").removesuffix("/commit/main"), body)
        else:
            self._answer({"error": f"no {self.path} here"}, 404)

    def _commit(self, name, body):
        lines = [json.loads(line) for line in body.splitlines() if line.strip()]
        for line in lines:
            if line["key"] == "file":
                self.hub.repos[name][line["value"]["path"]] = base64.b64decode(line["value"]["content"])
        self.hub.commits.append(name)
        url = f"{self.hub.address}/{name}/commit/{len(self.hub.commits):040x}"
        self._answer({"success": True, "commitOid": f"{len(self.hub.commits):040x}", "commitUrl": url})

    def _file(self):
        repo, _, file = self.path.lstrip("/").partition("/resolve/main/")
        if repo not in self.hub.repos:
            self._answer({"error": "Repository not found"}, 404, {"X-Error-Code": "RepoNotFound"})
        elif file not in self.hub.repos[repo]:
            self._answer({"error": "Entry not found"}, 404, {"X-Error-Code": "EntryNotFound"})
        else:
            content = self.hub.repos[repo][file]
            self._send(content, 200, {"ETag": f'"{len(content):040x}"', "X-Repo-Commit": "1".zfill(40)})

    def _read(self):
        self.hub.requests.append(f"{self.command} {self.path}")
        if self.headers.get("Transfer-Encoding") != "chunked":
            return self.rfile.read(int(self.headers.get("Content-Length", 0)))
        parts = []
        while size := int(self.rfile.readline(), 16):
            parts.append(self.rfile.read(size))
            self.rfile.readline()
        self.rfile.readline()
        return b"".join(parts)

    def _answer(self, content, status=200, headers=()):
        self._send(json.dumps(content).encode(), status, {"Content-Type": "application/json", **dict(headers)})

    def _send(self, content, status, headers):
        self.send_response(status)
        for name, value in {**headers, "Content-Length": str(len(content))}.items():
            self.send_header(name, value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(content)
