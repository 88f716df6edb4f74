"""Chromium for tests: started once, and driven by selenium through Debian's chromedriver of the same version."""

import contextlib
import json
import os
import shutil
import signal
import time

import psutil
import pytest

FLAGS = (
    *("--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--window-size=1200,900"),
    "--enable-unsafe-swiftshader",  # WebGL without a GPU
)
DEADLINE = 30.0


def require_browser():
    """The paths of browser and driver; without them the test is skipped, and fails with CI=true."""
    chromium, driver = shutil.which("chromium"), shutil.which("chromedriver")
    if chromium is None or driver is None:
        reason = "no browser: apt-get install chromium chromium-driver"
        (pytest.fail if os.environ.get("CI") == "true" else pytest.skip)(reason)
    return chromium, driver


def new_browser(*flags, logs=("browser", "performance")):
    """A browser without a page, with further `flags`; with the log "performance" its driver reads every image too."""
    chromium, driver = require_browser()
    from selenium import webdriver

    options = webdriver.ChromeOptions()
    options.binary_location = chromium
    for flag in (*FLAGS, *flags):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", dict.fromkeys(logs, "ALL"))
    return webdriver.Chrome(options=options, service=webdriver.ChromeService(driver))


def until(condition, what="it"):
    """Wait until a condition holds, and return its value."""
    end = time.monotonic() + DEADLINE
    while not (value := condition()):
        assert time.monotonic() < end, f"{what} did not come in {DEADLINE:g} s"
        time.sleep(0.02)
    return value


class Page:
    """The console in a browser."""

    def __init__(self, browser):
        self.browser = browser

    def open(self, url):
        self.browser.get(url)
        return self

    def element(self, name):
        return self.browser.find_element("id", name)

    def text(self, name):
        return self.element(name).text

    def click(self, name):
        until(lambda: self.element(name).is_displayed() and self.element(name).is_enabled(), f"the button {name}")
        self.run("arguments[0].scrollIntoView({block: 'center'})", self.element(name))
        self.element(name).click()

    def shows(self, name, text):
        """Wait until an element contains a text."""
        until(lambda: text in self.text(name), f"{text!r} in {name}")

    def press(self, key):
        """Press a key, and hold it."""
        self._key("rawKeyDown", key)

    def let(self, key):
        self._key("keyUp", key)

    def _key(self, kind, key):
        code = {" ": "Space", "Enter": "Enter", "Tab": "Tab"}.get(key, f"Key{key.upper()}")
        number = {"Enter": 13, "Tab": 9}.get(key, ord(key[0].upper()))
        self.cdp("Input.dispatchKeyEvent", type=kind, key=key, code=code, windowsVirtualKeyCode=number)
        if kind == "rawKeyDown" and key == "Enter":
            self.cdp("Input.dispatchKeyEvent", type="char", key=key, text="\r")

    def move(self, key, moves):
        """Hold a key until the robot moves; a page that stood still on a busy computer lets go of it: pressed again."""

        def is_held():
            if self.text("jog-state").startswith("Hold a key"):
                self.let(key)
                self.press(key)
            return moves()

        until(is_held, "a motion")

    def tap(self, key):
        self.press(key)
        self.let(key)

    def run(self, script, *arguments):
        return self.browser.execute_script(script, *arguments)

    def cdp(self, command, **arguments):
        return self.browser.execute_cdp_cmd(command, arguments)

    def complaints(self):
        """What the page wrote to its console since the last look, without what WebGL says of drawing without a GPU."""
        said = [entry["message"] for entry in self.browser.get_log("browser")]
        return [text for text in said if "GL Driver Message (OpenGL, Performance" not in text]

    def requested(self):
        """The addresses that the page asked for since the last look."""
        events = [json.loads(entry["message"])["message"] for entry in self.browser.get_log("performance")]
        http = [one["params"]["request"]["url"] for one in events if one["method"] == "Network.requestWillBeSent"]
        return http + [one["params"]["url"] for one in events if one["method"] == "Network.webSocketCreated"]

    @contextlib.contextmanager
    def frozen(self):
        """The processes that run pages are stopped, as on a computer that hangs."""
        pids = renderers(self.browser.service.process.pid)
        assert pids
        for pid in pids:
            os.kill(pid, signal.SIGSTOP)
        try:
            yield
        finally:
            for pid in pids:
                os.kill(pid, signal.SIGCONT)


def renderers(root):
    """The processes below `root` that run pages."""
    found = []
    for process in psutil.Process(root).children(recursive=True):
        with contextlib.suppress(psutil.Error):  # it has ended
            if "--type=renderer" in " ".join(process.cmdline()):
                found.append(process.pid)
    return found


@pytest.fixture(scope="module")
def browser():
    browser = new_browser()
    yield browser
    browser.quit()


@pytest.fixture
def page(browser):
    """The browser with one new tab, which is in front."""
    before = browser.window_handles
    browser.switch_to.new_window("tab")
    page = browser.current_window_handle
    for tab in before:
        browser.switch_to.window(tab)
        browser.close()
    browser.switch_to.window(page)
    browser.get_log("browser")
    return Page(browser)


def close_it(page):
    page.browser.switch_to.new_window("tab")
    other = page.browser.current_window_handle
    page.browser.switch_to.window(next(tab for tab in page.browser.window_handles if tab != other))
    page.press("w")  # the new tab took the key away
    time.sleep(0.2)
    page.browser.close()
    page.browser.switch_to.window(other)


def hide_it(page):
    page.browser.switch_to.new_window("tab")


def reload_it(page):
    page.browser.refresh()


def blur_it(page):
    page.run("window.dispatchEvent(new Event('blur'))")


def suspend_it(page):
    page.cdp("Page.setWebLifecycleState", state="frozen")


LEAVINGS = close_it, hide_it, reload_it, blur_it, suspend_it
"""How a page is left while a key is held."""
