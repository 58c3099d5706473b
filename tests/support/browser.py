"""A real browser for the tests of pages: headless Chromium without a network, driven by its DevTools protocol.

`python tests/support/browser.py PAGE.html OUT.png --width 390 [--dark] [--height 900]` takes a screenshot, as in docs/.
"""

from __future__ import annotations

import argparse
import base64
import contextlib
import json
import shutil
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple

from websockets.sync.client import connect

FLAGS = (
    "--headless=new", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--hide-scrollbars",
    "--disable-background-networking", "--disable-component-update", "--disable-sync", "--disable-dev-shm-usage",
    "--host-resolver-rules=MAP * ~NOTFOUND", "--remote-debugging-port=0",
)  # fmt: skip
STARTS_WITHIN = 15.0
"""Seconds."""


def chromium() -> str | None:
    """The browser's program, where there is one."""
    names = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
    return next((path for name in names if (path := shutil.which(name))), None)


class Seen(NamedTuple):
    """A page as the browser shows it."""

    requests: list[str]
    """Everything that was asked for, the page itself among it; data that is inside of it aside."""
    complaints: list[str]
    """Of the console, and exceptions."""
    width: int
    """Of the document: larger than the window's when one must scroll sideways."""
    too_wide: list[str]
    """Elements that reach beyond the window and cannot be scrolled by themselves."""
    overlapping: list[str]
    """Pairs of texts of one chart that lie on each other."""
    shot: bytes
    """PNG, of `height` pixels or all there is."""
    answer: Any
    """To the question, as JSON has it."""


class Browser:
    """One headless browser; a context manager that ends it."""

    def __init__(self, program: str) -> None:
        self._program, self._number, self._events = program, 0, list[dict[str, Any]]()

    def __enter__(self) -> Browser:
        with contextlib.ExitStack() as stack:
            folder = tempfile.TemporaryDirectory(prefix="browser-", ignore_cleanup_errors=True)
            profile = Path(stack.enter_context(folder))
            command = [self._program, *FLAGS, f"--user-data-dir={profile}", "about:blank"]
            process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
            stack.callback(_end, process)
            port, path = _address(profile / "DevToolsActivePort")
            self._socket = stack.enter_context(connect(f"ws://127.0.0.1:{port}{path}", max_size=None, proxy=None))
            self._open = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._open.close()

    def look(
        self,
        page: Path,
        width: int,
        dark: bool = False,
        height: int | None = None,
        scroll: int = 0,
        question: str = "null",
    ) -> Seen:
        """What the browser makes of a file, and its answer to JavaScript; at 640 pixels and less it is a phone."""
        target = self._ask("Target.createTarget", url="about:blank")["targetId"]
        session = self._ask("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        self._events.clear()

        def ask(method: str, **given: Any) -> dict[str, Any]:
            return self._ask(method, session, **given)

        for domain in ("Page", "Network", "Log", "Runtime"):
            ask(f"{domain}.enable")
        phone = width <= 640
        view = {"width": width, "height": 844, "deviceScaleFactor": 2 if phone else 1, "mobile": phone}
        ask("Emulation.setDeviceMetricsOverride", **view)
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        ask("Emulation.setEmulatedMedia", features=[scheme])
        ask("Page.navigate", url=page.resolve().as_uri())
        self._wait_for("Page.loadEventFired")
        measured = ask("Runtime.evaluate", expression=_MEASURE, returnByValue=True, awaitPromise=True)
        found = measured["result"]["value"]
        answered = ask("Runtime.evaluate", expression=question, returnByValue=True)
        tall = height or min(found["height"], 16_000)
        clip = {"x": 0, "y": scroll, "width": width, "height": tall, "scale": 1}
        shot = ask("Page.captureScreenshot", format="png", captureBeyondViewport=True, clip=clip)["data"]
        self._ask("Target.closeTarget", targetId=target)
        asked = [e["params"]["request"]["url"] for e in self._events if e["method"] == "Network.requestWillBeSent"]
        return Seen(
            [url for url in asked if not url.startswith("data:")],
            [text for e in self._events if (text := _complaint(e))],
            found["width"],
            found["wide"],
            found["overlapping"],
            base64.b64decode(shot),
            answered["result"].get("value"),
        )

    def _ask(self, method: str, session: str | None = None, **given: Any) -> dict[str, Any]:
        self._number += 1
        to = {"sessionId": session} if session else {}
        self._socket.send(json.dumps({"id": self._number, "method": method, "params": given, **to}))
        while (answer := self._receive()).get("id") != self._number:
            pass
        if "error" in answer:
            raise RuntimeError(f"{method}: {answer['error']}")
        result: dict[str, Any] = answer["result"]
        return result

    def _receive(self) -> dict[str, Any]:
        answer: dict[str, Any] = json.loads(self._socket.recv(timeout=30))
        if "method" in answer:
            self._events.append(answer)
        return answer

    def _wait_for(self, event: str) -> None:
        while not any(e["method"] == event for e in self._events):
            self._receive()


def _end(process: subprocess.Popen[bytes]) -> None:
    process.terminate()
    try:
        process.wait(10)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def _address(file: Path) -> tuple[str, str]:
    """Port and path of the DevTools, once the browser has written them."""
    until = time.monotonic() + STARTS_WITHIN
    while time.monotonic() < until:
        if file.exists() and len(lines := file.read_text().split()) == 2:
            return lines[0], lines[1]
        time.sleep(0.05)
    raise TimeoutError(f"the browser did not start within {STARTS_WITHIN:.0f} seconds")


def _complaint(event: dict[str, Any]) -> str:
    given = event.get("params", {})
    if event["method"] == "Log.entryAdded":
        return str(given["entry"]["text"])
    if event["method"] in ("Runtime.consoleAPICalled", "Runtime.exceptionThrown"):
        return json.dumps(given)
    return f"not loaded: {given['errorText']}" if event["method"] == "Network.loadingFailed" else ""


_MEASURE = """
(async () => {
  document.querySelectorAll("details").forEach(d => d.open = true);
  const shown = v => new Promise(r => v.readyState > 1 ? r() : v.addEventListener("loadeddata", r));
  const soon = new Promise(r => setTimeout(r, 3000));
  const videos = [...document.querySelectorAll("video")];
  await Promise.race([Promise.all(videos.map(shown)), soon]);
  if (videos.length) await new Promise(r => setTimeout(r, 500));  // until the controls have noticed
  const root = document.documentElement, wide = [], overlapping = [];
  for (const e of document.querySelectorAll("body *"))
    if (!e.closest(".scroll") && e.getBoundingClientRect().right > root.clientWidth + 1)
      wide.push(e.tagName + " " + (e.textContent || "").slice(0, 40));
  for (const svg of document.querySelectorAll("svg")) {
    const boxes = [...svg.querySelectorAll("text")].filter(t => t.textContent)
      .map(t => [t.textContent, t.getBoundingClientRect()]).filter(([, b]) => b.width);
    boxes.forEach(([s, a], i) => boxes.slice(i + 1).forEach(([t, b]) => {
      const across = Math.min(a.right, b.right) - Math.max(a.left, b.left);
      const along = Math.min(a.bottom, b.bottom) - Math.max(a.top, b.top);
      if (across > 1 && along > 0.35 * Math.min(a.height, b.height))
        overlapping.push(svg.getAttribute("aria-label").slice(0, 60) + ": " + s + " | " + t);
    }));
  }
  return {width: root.scrollWidth, height: root.scrollHeight, wide, overlapping};
})()
"""


def _main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("page", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--width", type=int, default=1280)
    parser.add_argument("--height", type=int, help="pixels of the page; default: all")
    parser.add_argument("--scroll", type=int, default=0, help="pixels from its top")
    parser.add_argument("--dark", action="store_true")
    given = parser.parse_args()
    program = chromium()
    if program is None:
        parser.error("expected Chromium, found none (apt install chromium)")
    with Browser(program) as browser:
        seen = browser.look(given.page, given.width, given.dark, given.height, given.scroll)
    given.out.write_bytes(seen.shot)
    print(json.dumps({**seen._asdict(), "shot": str(given.out)}, indent=1))


if __name__ == "__main__":
    _main()
