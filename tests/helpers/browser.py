"""A page in headless Chromium: what a script in it tells, and what its console says."""

from __future__ import annotations

import json
import shutil
import subprocess
import threading
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any

import pytest

FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--disable-gpu",
    "--allow-file-access-from-files",
    "--no-first-run",
    "--disable-extensions",
    "--disable-background-networking",
    "--autoplay-policy=no-user-gesture-required",
    "--enable-logging=stderr",
    "--v=0",
)


def chromium() -> str:
    """Where it is; the test is skipped where there is none."""
    found = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if found is None:
        pytest.skip("no Chromium here")
    return found


def ask(page: str, folder: Path, *, width: int = 1280, seconds: float = 60.0) -> tuple[Any, list[str]]:
    """Open a page and wait until a script in it calls `tell(value)`.

    Args:
        page: HTML; what it refers to lies in the folder.
        folder: Where the page is put.
        width: Of the window that shows it, pixels; a frame, for a browser's own window is 500 wide or more.
        seconds: How long to wait.

    Returns:
        The value, None where nothing was told; the lines of the console.
    """
    program, told, done = chromium(), [], threading.Event()

    class Ear(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            told.append(json.loads(self.rfile.read(int(self.headers["Content-Length"]))))
            self.send_response(204)
            self.end_headers()
            done.set()

        def log_message(self, *words: object) -> None: ...

    with HTTPServer(("127.0.0.1", 0), Ear) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        call = f'fetch("http://127.0.0.1:{server.server_port}", {{method: "POST", mode: "no-cors", body: value}})'
        script = f"<script>const tell = (it) => {{ const value = JSON.stringify(it); {call}; }};</script>"
        (folder / "inner.html").write_text(page.replace("<head>", f"<head>{script}", 1))
        frame = f'<iframe src=inner.html style="width:{width}px;height:900px;border:0"></iframe>'
        (folder / "outer.html").write_text(f"<!DOCTYPE html><body style='margin:0'>{frame}</body>")
        words = [program, *FLAGS, "--window-size=1600,1000", f"--user-data-dir={folder / 'profile'}"]
        with (folder / "console.txt").open("w+") as errors:
            process = subprocess.Popen([*words, (folder / "outer.html").as_uri()], stdout=errors, stderr=errors)
            try:
                done.wait(seconds)
            finally:
                process.terminate()
                process.wait(20)
                server.shutdown()
            errors.seek(0)
            console = [line.strip() for line in errors if ":CONSOLE" in line]
    return (told[0] if told else None), console
