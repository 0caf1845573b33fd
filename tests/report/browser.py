"""Headless chromium on a folder of pages: what a script finds in them, and screenshots."""

import functools
import html
import http.server
import json
import re
import shutil
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

CHROMIUM = shutil.which("chromium")
FLAGS = (
    *("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
    "--hide-scrollbars",
)
_FRAME = """<!doctype html><body style="margin:0"><iframe id="frame" src="{page}"
style="border:0;width:{width}px;height:{height}px"></iframe><pre id="answer"></pre><script>
addEventListener("load", async () => {{
  const frame = document.getElementById("frame"), page = frame.contentWindow, answer = {{}};
  await (async () => {{ {script} }})();
  document.getElementById("answer").textContent = JSON.stringify(answer);
}});
</script></body>"""


class Browser:
    """Opens pages of a folder, which is served from this machine to this machine alone."""

    def __init__(self, folder: Path, url: str) -> None:
        self._folder, self._url = folder, url

    def run(self, page: str, width: int, script: str, height: int = 900) -> dict[str, Any]:
        """Return what a script puts into `answer`.

        page: name of a file; the script has its window as `page`, and the frame as `frame`.
        """
        name = self._frame(page, width, height, script)
        dom = self._chromium("--dump-dom", "--virtual-time-budget=20000", name=name, width=width)
        match = re.search(r'<pre id="answer">(.+?)</pre>', dom, re.DOTALL)
        assert match, "the script has not come to its end"
        found: dict[str, Any] = json.loads(html.unescape(match[1]))
        return found

    def screenshot(
        self, page: str, width: int, height: int, file: Path, dark: bool = False
    ) -> None:
        """Write a PNG of a page's upper part."""
        name = self._frame(page, width, height, "")
        scheme = f"--blink-settings=preferredColorScheme={0 if dark else 1}"
        size = f"--window-size={max(width, 500)},{height}"
        self._chromium(scheme, size, f"--screenshot={file}", name=name, width=width)

    def _frame(self, page: str, width: int, height: int, script: str) -> str:
        """Write a page that shows another one in a frame: a window has a least width."""
        name = f"frame-{width}.html"
        text = _FRAME.format(page=page, width=width, height=height, script=script)
        (self._folder / name).write_text(text, encoding="utf-8")
        return name

    def _chromium(self, *options: str, name: str, width: int) -> str:
        assert CHROMIUM is not None
        profile = self._folder / f"profile-{width}"
        command = [CHROMIUM, *FLAGS, f"--user-data-dir={profile}", *options, f"{self._url}/{name}"]
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=400, check=True)
        finally:
            shutil.rmtree(profile, ignore_errors=True)
        return done.stdout


class _Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *_: object) -> None:
        """Say nothing of a request."""


@contextmanager
def browser_on(folder: Path) -> Iterator[Browser]:
    """Serve a folder's pages until the block ends."""
    handler = functools.partial(_Quiet, directory=str(folder))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True)
        thread.start()
        try:
            yield Browser(folder, f"http://127.0.0.1:{server.server_address[1]}")
        finally:
            server.shutdown()
            thread.join()
