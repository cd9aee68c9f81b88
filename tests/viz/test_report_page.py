"""The page in a real browser, driven over a pipe by the DevTools protocol: no driver, no network, real clicks."""

import base64
import itertools
import json
import math
import os
import select
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from test_report import NASTY, sample

from torchvo360.cameras import Equirectangular, Pinhole
from torchvo360.viz.report import Content, write_report
from torchvo360.vo.loops import LoopEdge

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")

FLAGS = (
    "--headless=new",
    "--no-sandbox",  # tests may run as root
    "--remote-debugging-pipe",
    "--use-angle=swiftshader",  # WebGL without a graphics card
    "--enable-unsafe-swiftshader",
    "--disable-dev-shm-usage",
    "--hide-scrollbars",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
)

ON_3_AND_4 = """
import fcntl, os, sys
ends = [fcntl.fcntl(int(end), fcntl.F_DUPFD, 10) for end in sys.argv[1:3]]
for end, number in zip(ends, (3, 4)):
    os.dup2(end, number)
    os.close(end)
os.execv(sys.argv[3], sys.argv[3:])
"""
"""Starts a program with two pipes as its files 3 and 4, where Chromium expects them."""


class Browser:
    """A headless Chromium with one page."""

    def __init__(self, program: str, profile: Path) -> None:
        theirs_in, ours_out = os.pipe()
        ours_in, theirs_out = os.pipe()
        command = [sys.executable, "-c", ON_3_AND_4, str(theirs_in), str(theirs_out), program, *FLAGS]
        self._process = subprocess.Popen(
            [*command, f"--user-data-dir={profile}", "about:blank"],
            pass_fds=(theirs_in, theirs_out),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(theirs_in)
        os.close(theirs_out)
        self._in, self._out, self._rest = ours_in, ours_out, b""
        self._numbers, self._session = itertools.count(1), None
        self.complaints: list[str] = []
        self.requests: list[str] = []
        (page,) = [t for t in self("Target.getTargets")["targetInfos"] if t["type"] == "page"]
        self._session = self("Target.attachToTarget", targetId=page["targetId"], flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self(f"{domain}.enable")

    def __call__(self, method: str, **params) -> dict:
        """Call a method of the protocol and return its result."""
        number = next(self._numbers)
        message = {"id": number, "method": method, "params": params}
        if self._session:
            message["sessionId"] = self._session
        os.write(self._out, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._message()
            if answer.get("id") == number:
                assert "error" not in answer, answer
                return answer["result"]
            self._note(answer)

    def _message(self, seconds: float = 30) -> dict:
        end = time.monotonic() + seconds
        while b"\0" not in self._rest:
            ready, _, _ = select.select([self._in], [], [], max(0.0, end - time.monotonic()))
            data = os.read(self._in, 1 << 20) if ready else b""
            if not data:
                raise TimeoutError("the browser does not answer")
            self._rest += data
        text, _, self._rest = self._rest.partition(b"\0")
        return json.loads(text)

    def _note(self, event: dict) -> None:
        method, params = event.get("method"), event.get("params", {})
        if method == "Runtime.exceptionThrown":
            details = params["exceptionDetails"]
            self.complaints.append(str(details.get("exception", {}).get("description", details["text"])))
        elif method == "Runtime.consoleAPICalled" and params["type"] in ("error", "warning", "assert"):
            self.complaints.append(str([argument.get("value") for argument in params["args"]]))
        elif method == "Log.entryAdded" and params["entry"]["level"] in ("error", "warning"):
            self.complaints.append(params["entry"]["text"])
        elif method == "Network.requestWillBeSent":
            self.requests.append(params["request"]["url"])

    def js(self, expression: str):
        """Return the value of an expression in the page."""
        result = self("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in result, result
        return result["result"].get("value")

    def open(self, path: Path, *, width: int = 900, height: int = 600, dark: bool = False, touch: bool = False) -> None:
        self.complaints.clear()
        self.requests.clear()
        self.resize(width, height, touch=touch)
        self.prefer(dark=dark)
        self("Page.navigate", url=path.resolve().as_uri())
        self.wait(
            "document.readyState === 'complete' && document.getElementById('slider')?.getAttribute('aria-valuetext')"
        )
        self.settle()

    def resize(self, width: int, height: int, *, touch: bool = False) -> None:
        self("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=touch)

    def prefer(self, *, dark: bool) -> None:
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self("Emulation.setEmulatedMedia", features=[scheme])

    def wait(self, expression: str, seconds: float = 20) -> None:
        end = time.monotonic() + seconds
        while not self.js(f"Boolean({expression})"):
            assert time.monotonic() < end, (expression, self.complaints)
            time.sleep(0.02)

    def settle(self) -> None:
        """Wait until what was asked for has been drawn."""
        self.js("new Promise((go) => setTimeout(() => requestAnimationFrame(() => requestAnimationFrame(go)), 50))")

    def box(self, selector: str) -> dict:
        self.js(f"document.querySelector({selector!r}).scrollIntoView({{block: 'center'}})")
        return self.js(f"document.querySelector({selector!r}).getBoundingClientRect().toJSON()")

    def mouse(self, kind: str, x: float, y: float, **more) -> None:
        self("Input.dispatchMouseEvent", type=kind, x=x, y=y, **more)

    def click(self, selector: str, across: float = 0.5, down: float = 0.5) -> None:
        box = self.box(selector)
        x, y = box["x"] + across * box["width"], box["y"] + down * box["height"]
        for kind in ("mousePressed", "mouseReleased"):
            self.mouse(kind, x, y, button="left", buttons=1, clickCount=1)
        self.settle()

    def drag(self, selector: str, dx: float, dy: float, *, shift: bool = False) -> None:
        box = self.box(selector)
        x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
        held = {"button": "left", "buttons": 1, "modifiers": 8 * shift}
        self.mouse("mousePressed", x, y, clickCount=1, **held)
        for step in range(1, 6):
            self.mouse("mouseMoved", x + dx * step / 5, y + dy * step / 5, **held)
        self.mouse("mouseReleased", x + dx, y + dy, clickCount=1, **held)
        self.settle()

    def wheel(self, selector: str, delta: float) -> None:
        box = self.box(selector)
        self.mouse("mouseWheel", box["x"] + box["width"] / 2, box["y"] + box["height"] / 2, deltaX=0, deltaY=delta)
        self.settle()

    def pinch(self, selector: str, factor: float) -> None:
        """Draw two fingers apart by a factor."""
        box = self.box(selector)
        x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
        for kind, half in (("Start", 30), ("Move", 30 * (1 + factor) / 2), ("Move", 30 * factor)):
            fingers = [{"x": x - half, "y": y}, {"x": x + half, "y": y}]
            self("Input.dispatchTouchEvent", type=f"touch{kind}", touchPoints=fingers)
        self("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])
        self.settle()

    def key(self, key: str, *, shift: bool = False, times: int = 1) -> None:
        text = {"text": key} if len(key) == 1 else {}
        for _ in range(times):
            self("Input.dispatchKeyEvent", type="keyDown", key=key, modifiers=8 * shift, **text)
            self("Input.dispatchKeyEvent", type="keyUp", key=key, modifiers=8 * shift)
        self.settle()

    def picture(self, selector: str | None = None, *, whole: bool = False) -> np.ndarray:
        """Return what is seen, blue first."""
        clip = {}
        if selector:
            box = self.box(selector)
            clip = {"clip": {"x": box["x"], "y": box["y"], "width": box["width"], "height": box["height"], "scale": 1}}
            scroll = self.js("[window.scrollX, window.scrollY]")
            clip["clip"]["x"] += scroll[0]
            clip["clip"]["y"] += scroll[1]
        shot = self("Page.captureScreenshot", captureBeyondViewport=whole, optimizeForSpeed=True, **clip)
        data = base64.b64decode(shot["data"])
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        assert image is not None
        return image

    def close(self) -> None:
        self._process.terminate()
        try:
            self._process.wait(10)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        os.close(self._in)
        os.close(self._out)


@pytest.fixture(scope="module")
def browser(tmp_path_factory) -> Iterator[Browser]:
    program = next(filter(None, map(shutil.which, NAMES)), None)
    if program is None:
        pytest.skip("no Chromium is installed")
    browser = Browser(program, tmp_path_factory.mktemp("profile"))
    yield browser
    browser.close()


@pytest.fixture(scope="module")
def walked(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("walked") / "report.html"
    write_report(path, sample(name=NASTY, notes=(NASTY,)))
    return path


AS_OPENED = """
for (const [id, on] of [["show-points", true], ["so-far", false], ["steady", true], ["overlay", false]])
    if (document.getElementById(id).checked !== on) document.getElementById(id).click();
document.getElementById("slider").value = 0;
document.getElementById("slider").dispatchEvent(new Event("input"));
for (const view of ["scene", "plan", "picture"]) document.getElementById(`${view}-reset`).click();
document.activeElement.blur();
"""


@pytest.fixture
def page(browser, walked) -> Iterator[Browser]:
    """The page of a walk as it opens; at the end nothing may have been complained of or asked for."""
    if browser.requests == [walked.resolve().as_uri()]:  # it is open: loading it takes a second
        browser.js(AS_OPENED)
    else:
        browser.open(walked)
    browser.wait("document.getElementById('panorama').dataset.frame === '10'")
    browser.settle()
    yield browser
    browser.settle()
    assert browser.complaints == []
    assert browser.requests == [walked.resolve().as_uri()]


def where(page: Browser) -> str:
    return page.js("document.getElementById('where').textContent")


def different(a: np.ndarray, b: np.ndarray) -> float:
    """Return the share of pixels that are clearly not the same."""
    return float((np.abs(a.astype(int) - b).max(-1) > 40).mean())


def test_the_page_opens_with_its_names_as_text_and_its_first_frame(page):
    assert page.js("document.getElementById('name').textContent") == NASTY
    assert page.js("document.querySelector('#notes li').textContent") == NASTY
    assert page.js("document.querySelectorAll('img[onerror]').length") == 0
    assert where(page).startswith("Frame 10 ")
    for view in ("#scene", "#plan", "#panorama"):
        assert page.picture(view).std() > 3, view  # something is drawn
    assert "metres by the true poses" in page.js("document.getElementById('run').textContent")


def test_dragging_turns_the_world_and_reset_turns_it_back(page):
    before = page.picture("#scene")
    page.drag("#scene", 180, 40)
    assert different(before, page.picture("#scene")) > 0.01
    page.click("#scene-reset")
    assert different(before, page.picture("#scene")) < 1e-3


def test_wheel_shift_drag_and_keys_zoom_and_move_both_views_of_the_world(page):
    for view in ("#scene", "#plan"):
        pictures = [page.picture(view)]
        page.wheel(view, -400)
        pictures.append(page.picture(view))
        page.drag(view, 120, 60, shift=True)
        pictures.append(page.picture(view))
        page.js(f"document.querySelector('{view}').focus({{preventScroll: true}})")
        page.key("-")
        pictures.append(page.picture(view))
        page.key("ArrowLeft", shift=True)
        pictures.append(page.picture(view))
        assert all(different(a, b) > 3e-3 for a, b in itertools.pairwise(pictures)), view
        page.click(f"{view}-reset")
        assert different(pictures[0], page.picture(view)) < 2e-3
    assert where(page).startswith("Frame 10 ")  # with shift, arrows do not step


@pytest.mark.parametrize("view", ["#scene", "#plan"])
def test_a_click_on_the_path_picks_the_frame_there(page, view):
    page.js("document.getElementById('show-points').click()")
    page.key("End")
    marked = page.picture(view)
    page.key("Home")
    changed = (np.abs(marked.astype(int) - page.picture(view)).max(-1) > 60).astype(np.uint8)
    # the mark stands at the path's end, then at its start: the farthest spot from the present mark is the end
    count, _, stats, centres = cv2.connectedComponentsWithStats(changed)
    spots = [centres[k] for k in range(1, count) if stats[k, cv2.CC_STAT_AREA] > 60]
    height, width = changed.shape
    for x, y in spots:
        page.click(view, x / width, y / height)
        if not where(page).startswith("Frame 10 "):
            break
    assert int(where(page).split()[1]) >= 45


def test_slider_buttons_keys_and_lists_pick_frames(page):
    page.click("#slider", 0.5)
    assert 27 <= int(where(page).split()[1]) <= 32
    page.key("Home")
    page.key("ArrowRight")
    page.click("#on")
    assert where(page).startswith("Frame 12 ")
    page.click("#back")
    assert where(page).startswith("Frame 11 ")
    page.key("PageDown")
    assert where(page).startswith("Frame 21 ")
    page.click("#changes tbody tr:nth-child(2) button")
    assert where(page).startswith("Frame 25 ")
    assert where(page).endswith("lost")
    assert page.js("document.querySelector('#changes tr.now').rowIndex") == 2
    assert "neither the map nor" in page.js("document.getElementById('frame').textContent")
    page.click("#chart-milliseconds", 0.999)
    assert where(page).startswith("Frame 49 ")


def test_numbers_that_are_not_there_are_dashes(page):
    page.js("document.querySelectorAll('#changes tbody button')[1].click()")
    text = page.js("document.getElementById('frame').innerText")
    assert "Residual\n–" in text
    assert "NaN" not in page.js("document.body.innerText")


def test_play_goes_through_the_frames_to_the_end(page):
    page.js("document.querySelectorAll('#changes tbody button')[2].click()")
    page.click("#play")
    assert page.js("document.getElementById('play').getAttribute('aria-label')") == "Pause"
    page.wait("document.getElementById('where').textContent.startsWith('Frame 49 ')")
    page.wait("document.getElementById('play').getAttribute('aria-pressed') === 'false'")


def middle(image: np.ndarray) -> np.ndarray:
    height, width = image.shape[:2]
    return image[height // 2 - 4 : height // 2 + 4, width // 2 - 4 : width // 2 + 4].reshape(-1, 3).mean(0)


def turn_right(page: Browser, degrees: int) -> None:
    """Turn the panorama by keys, some degrees each, as far as it takes."""
    read = "parseInt(document.getElementById('look').textContent.slice(6))"
    page.js("document.querySelector('#panorama').focus({preventScroll: true})")
    before = page.js(read)
    page.key("ArrowRight", shift=True, times=4)
    step = (page.js(read) - before) / 4
    assert step > 1
    page.key("ArrowRight", shift=True, times=math.ceil((degrees - page.js(read)) / step))
    assert degrees - 2 <= page.js(read) <= degrees + 2 * step


def test_the_panorama_looks_ahead_and_a_quarter_turn_shows_what_is_to_the_right(page):
    red, green = [20, 20, 230], [20, 200, 20]
    np.testing.assert_allclose(middle(page.picture("#panorama")), red, atol=25)
    page.js("document.getElementById('steady').click()")
    turn_right(page, 88)
    np.testing.assert_allclose(middle(page.picture("#panorama")), green, atol=25)
    page.click("#picture-reset")
    np.testing.assert_allclose(middle(page.picture("#panorama")), red, atol=25)


def test_looking_up_shows_what_is_above_and_goes_no_farther(page):
    page.js("document.querySelector('#panorama').focus({preventScroll: true})")
    page.key("ArrowUp", shift=True, times=24)
    assert "up 90°" in page.js("document.getElementById('look').textContent")
    np.testing.assert_allclose(middle(page.picture("#panorama")), [220, 30, 30], atol=25)


def test_a_steady_view_keeps_its_direction_while_the_camera_turns(page):
    page.key("End")
    page.wait("document.getElementById('panorama').dataset.frame === '48'")
    page.settle()
    assert where(page).startswith("Frame 49 ")
    # the camera has turned half a radian to the right by then: the square ahead of it has left the middle to the right
    steady = page.picture("#panorama")
    page.click("#picture-reset")
    np.testing.assert_allclose(middle(page.picture("#panorama")), [20, 20, 230], atol=25)
    red = np.argwhere((steady[..., 2] > 180) & (steady[..., 1] < 80))
    assert red[:, 1].mean() > 0.6 * steady.shape[1]


def test_the_wheel_changes_the_field_of_view_and_the_map_lies_over_the_picture(page):
    read = "document.getElementById('look').textContent.split('view ')[1]"
    before = page.js(read)
    page.wheel("#panorama", -300)
    assert int(page.js(read)[:-1]) < int(before[:-1])
    plain = page.picture("#panorama")
    page.click("label:has(#overlay)")
    assert different(plain, page.picture("#panorama")) > 1e-3


def test_points_are_hidden_and_shown_so_far(page):
    whole = page.picture("#scene")
    page.click("label:has(#so-far)")
    so_far = page.picture("#scene")
    page.click("label:has(#so-far)")
    page.click("label:has(#show-points)")
    none = page.picture("#scene")
    assert different(whole, none) > different(so_far, none) > 1e-4


def test_views_that_nobody_touched_show_all_in_another_shape_of_the_window(page):
    page.resize(600, 800)
    page.settle()
    for view in ("#scene", "#plan"):
        fitted = page.picture(view)
        page.click(f"{view}-reset")
        assert different(fitted, page.picture(view)) < 1e-3, view
    page.resize(900, 600)


def test_a_panorama_of_half_the_sphere_shows_that_half_and_the_ground_beyond_it(browser, tmp_path):
    half = Equirectangular(64, 32, 64 / math.pi, -32 / math.pi, 32.0, 16.0)
    write_report(tmp_path / "report.html", sample(camera=half))
    browser.open(tmp_path / "report.html")
    browser.wait("document.getElementById('panorama').dataset.frame === '10'")
    browser.settle()
    np.testing.assert_allclose(middle(browser.picture("#panorama")), [20, 20, 230], atol=25)
    turn_right(browser, 43)
    np.testing.assert_allclose(middle(browser.picture("#panorama")), [20, 200, 20], atol=25)
    turn_right(browser, 130)
    np.testing.assert_allclose(middle(browser.picture("#panorama")), [0xF4, 0xF1, 0xED], atol=2)
    assert browser.complaints == []


def test_the_theme_follows_the_system_until_the_button_is_used(browser, walked):
    browser.open(walked, dark=True)
    brightness = [browser.picture().mean()]
    browser.prefer(dark=False)
    browser.settle()
    brightness.append(browser.picture().mean())
    browser.click("#theme")
    brightness.append(browser.picture().mean())
    for dark in (True, False):
        browser.prefer(dark=dark)
        browser.settle()
    brightness.append(browser.picture().mean())
    dark, light, to_dark, still_dark = brightness
    assert light > 150 > 80 > max(dark, to_dark, still_dark)
    assert browser.complaints == []


def test_two_fingers_zoom(browser, walked):
    browser.open(walked, width=400, touch=True)
    read = "parseInt(document.getElementById('look').textContent.split('view ')[1])"
    before, wide = browser.picture("#scene"), browser.js(read)
    browser.pinch("#scene", 2.0)
    assert different(before, browser.picture("#scene")) > 3e-3
    browser.pinch("#panorama", 2.0)
    assert browser.js(read) == pytest.approx(wide / 2, abs=2)
    assert where(browser).startswith("Frame 10 ")
    assert browser.complaints == []


@pytest.mark.parametrize("width", [400, 1280])
def test_nothing_sticks_out_to_the_side_and_every_control_has_a_name(browser, walked, width):
    browser.open(walked, width=width, touch=width < 500)
    assert browser.js("document.documentElement.scrollWidth") == width
    controls = "button, input, canvas[tabindex], [role=region]"
    named = f"""[...document.querySelectorAll('{controls}')].every((node) =>
        (node.ariaLabel || node.closest('label')?.textContent || node.textContent.trim()
         || document.getElementById(node.getAttribute('aria-labelledby'))?.textContent))"""
    assert browser.js(named)
    assert browser.complaints == []


def with_a_loop(content: Content) -> Content:
    eye = torch.eye(4, dtype=torch.float64)
    loop = LoopEdge(12, 45, eye, torch.eye(7, dtype=torch.float64))
    return replace(content, result=replace(content.result, loops=[loop]))


@pytest.mark.parametrize(
    "content",
    [
        sample(1, truth=False, points=0, pictures=0),
        sample(2, truth=False, points=1, pictures=1),
        sample(truth=False, pictures=3),
        sample(camera=Pinhole(64, 32, 40.0, 40.0, 32.0, 16.0), pictures=4),
        with_a_loop(sample(pictures=1)),
    ],
    ids=["one frame and nothing else", "one point", "few pictures", "pinhole", "a loop"],
)
def test_pages_of_little_content_open_without_complaint(browser, tmp_path, content):
    write_report(tmp_path / "report.html", content)
    browser.open(tmp_path / "report.html")
    browser.key("End")
    assert where(browser).startswith(f"Frame {9 + len(content.result.frames)} ")
    browser.drag("#scene", 60, 30)
    assert browser.js("document.getElementById('no-picture').hidden") == bool(content.pictures)
    pinhole = isinstance(content.camera, Pinhole)
    assert browser.js("document.getElementById('panorama').hidden") == (pinhole or not content.pictures)
    told = browser.js("document.getElementById('legend').textContent")
    assert ("before loops" in told) == bool(content.result.loops)
    if len(content.result.frames) == 1:  # a place, and room around it
        assert float(browser.js("document.getElementById('plan-scale').textContent").split()[0]) >= 0.1
    if pinhole:
        browser.wait("document.getElementById('picture').naturalWidth === 64")
    assert browser.complaints == []
