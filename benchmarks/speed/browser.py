"""A headless browser, driven over a pipe: Chromium's DevTools protocol with only Python's standard library.

>>> with Browser() as browser:  # doctest: +SKIP
...     page = browser.open("motion.html")
...     page.run("document.title")
'Motion'
"""

import base64
import fcntl
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
FLAGS = (
    *("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-sync"),
    *("--disable-background-networking", "--disable-component-update", "--remote-debugging-pipe", "--mute-audio"),
)
# The browser reads commands from file descriptor 3 and answers on file descriptor 4.
AS_3_AND_4 = "import os, sys; _, a, b, *run = sys.argv; os.dup2(int(a), 3); os.dup2(int(b), 4); os.execv(run[0], run)"
KEYS = {"ArrowRight": 39, "ArrowLeft": 37, "Home": 36, "End": 35, "Tab": 9, " ": 32}


def installed() -> str | None:
    """The path of a Chromium browser, `$LAGJAX_CHROMIUM` first; None if there is none."""
    return os.environ.get("LAGJAX_CHROMIUM") or next(filter(None, map(shutil.which, NAMES)), None)


class Browser:
    """A browser with its own profile, which is deleted when the browser is closed."""

    def __init__(self, flags=(), patience=60.0):
        self.patience, self.count, self.events = patience, 0, []
        self.profile = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)
        path = installed()
        assert path, "no Chromium or Chrome is installed"
        to_browser, self.out = os.pipe()
        self.back, from_browser = os.pipe()
        # Use descriptors that do not collide with those that the browser expects.
        ends = [fcntl.fcntl(end, fcntl.F_DUPFD_CLOEXEC, 10) for end in (to_browser, from_browser)]
        self.process = subprocess.Popen(
            [sys.executable, "-c", AS_3_AND_4, *map(str, ends), path, *FLAGS, *flags,
             f"--user-data-dir={self.profile.name}", "about:blank"],
            pass_fds=ends, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        for end in (to_browser, from_browser, *ends):
            os.close(end)
        self.rest = b""
        os.set_blocking(self.back, False)

    def __enter__(self):
        return self

    def __exit__(self, *reason):
        try:
            self.ask("Browser.close")
            self.process.wait(10)
        except (OSError, RuntimeError, subprocess.TimeoutExpired):
            self.process.kill()
            self.process.wait()
        os.close(self.out)
        os.close(self.back)
        self.profile.cleanup()

    def ask(self, method, session=None, **params):
        """Send one command to the browser and return its answer."""
        self.count += 1
        message = {"id": self.count, "method": method, "params": params}
        os.write(self.out, json.dumps(message | ({"sessionId": session} if session else {})).encode() + b"\0")
        number = self.count
        until = time.monotonic() + self.patience
        while time.monotonic() < until:
            found = self._read()
            # Events that came in one piece with the answer, some of them after it, are kept.
            self.events += [message for message in found if "id" not in message]
            for message in found:
                if message.get("id") == number:
                    if "error" in message:
                        raise RuntimeError(f"{method}: {message['error']}")
                    return message["result"]
        raise RuntimeError(f"{method}: no answer in {self.patience:g} s")

    def _read(self):
        try:
            part = os.read(self.back, 1 << 20)
        except BlockingIOError:
            time.sleep(0.001)
            return []
        if not part:
            raise RuntimeError("the browser is gone")
        *whole, self.rest = (self.rest + part).split(b"\0")
        return [json.loads(text) for text in whole]

    def open(self, address, width=1000, height=800) -> "Page":
        """Open a file or an address, and wait until it is loaded."""
        if Path(address).exists():
            address = Path(address).resolve().as_uri()
        target = self.ask("Target.createTarget", url="about:blank")["targetId"]
        session = self.ask("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        page = Page(self, session)
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        page.ask("Emulation.setDeviceMetricsOverride", **size)
        for domain in ("Page", "Runtime", "Network", "Log"):
            page.ask(f"{domain}.enable")
        page.ask("Page.navigate", url=str(address))
        page.wait("document.readyState === 'complete' && location.href !== 'about:blank'")
        return page


class Page:
    """One page of a browser."""

    def __init__(self, browser: Browser, session: str):
        self.browser, self.session = browser, session

    def ask(self, method, **params):
        """Send a command about this page and return the answer."""
        return self.browser.ask(method, self.session, **params)

    def run(self, script):
        """Evaluate an expression in the page, wait for it, and return its value."""
        message = self.ask("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        if "exceptionDetails" in message:
            raise RuntimeError(message["exceptionDetails"].get("exception", {}).get("description", str(message)))
        return message["result"].get("value")

    def wait(self, condition, seconds=30.0):
        """Wait until an expression in the page is true."""
        until = time.monotonic() + seconds
        while not self.run(f"Boolean({condition})"):
            if time.monotonic() > until:
                raise RuntimeError(f"not so after {seconds:g} s: {condition}")
            time.sleep(0.02)

    def press(self, key, modifiers=0):
        """Press a key, as a user does."""
        about = {"key": key, "code": "Space" if key == " " else key, "windowsVirtualKeyCode": KEYS.get(key, 0)}
        text = {"text": " "} if key == " " else {"text": "\r"} if key == "Enter" else {}
        if key == "Enter":
            about["windowsVirtualKeyCode"] = 13
        self.ask("Input.dispatchKeyEvent", type="keyDown", modifiers=modifiers, **about, **text)
        self.ask("Input.dispatchKeyEvent", type="keyUp", modifiers=modifiers, **about)

    def picture(self, path):
        """Write the visible part of the page as PNG."""
        message = self.ask("Page.captureScreenshot", captureBeyondViewport=True)
        Path(path).write_bytes(base64.b64decode(message["data"]))

    def complaints(self):
        """Errors of the page's scripts, and the addresses that it requested besides itself."""
        found = []
        for message in self.browser.events:
            if message.get("sessionId") != self.session:
                continue
            kind, params = message.get("method"), message.get("params", {})
            if kind == "Runtime.exceptionThrown":
                found.append(params["exceptionDetails"].get("exception", {}).get("description", "an exception"))
            elif kind == "Log.entryAdded" and params["entry"]["level"] == "error":
                found.append(params["entry"]["text"])
            elif kind == "Network.requestWillBeSent" and params.get("type") != "Document":
                found.append(params["request"]["url"][:100])
        return found
