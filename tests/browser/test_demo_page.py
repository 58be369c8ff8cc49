"""The demo in the browser: the tests build the page, serve it from this machine and run it in headless Chromium."""

import functools
import http.server
import shutil
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from exported_steps import motion

import kkl_gym
from kkl_gym.simulate import simulate
from observers import load

pytestmark = pytest.mark.browser
BUILD = Path(__file__).parents[2] / "docs" / "demo" / "build.py"
FLAGS = (
    "--no-sandbox",
    "--disable-gpu",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--no-first-run",
)
NAMES = ("chromium", "chromium-browser", "google-chrome")
STEPS = 500


class Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *args):
        pass


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("site") / "demo"
    subprocess.run([sys.executable, BUILD, out], check=True)
    return out


@pytest.fixture(scope="module")
def address(folder):
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Quiet, directory=folder)) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}/"
        server.shutdown()


@pytest.fixture(scope="module")
def browser():
    playwright = pytest.importorskip(
        "playwright.sync_api", reason="needs playwright: pip install --group browser", exc_type=ImportError
    )
    found = next(filter(None, map(shutil.which, NAMES)), None)
    if found is None:
        pytest.skip(f"needs a browser, one of {', '.join(NAMES)}: apt install chromium")
    with playwright.sync_playwright() as driver:
        launched = driver.chromium.launch(executable_path=found, args=[*FLAGS])
        yield launched
        launched.close()


@pytest.fixture
def page(browser, address):
    """The page; a request to another host or an error in the console fails the test."""
    context = browser.new_context(viewport={"width": 1280, "height": 800})
    opened, asked, complaints = context.new_page(), [], []
    opened.on("request", lambda request: asked.append(request.url))
    opened.on("console", lambda message: complaints.append(message.text) if message.type != "log" else None)
    opened.on("pageerror", lambda error: complaints.append(str(error)))
    opened.goto(address)
    opened.wait_for_selector("#status", state="detached")
    yield opened
    context.close()
    assert complaints == []
    assert [url for url in asked if not url.startswith((address, "data:"))] == []


def test_its_weight(folder):
    assert sum(path.stat().st_size for path in folder.iterdir()) < 3e6


@pytest.mark.parametrize("name", kkl_gym.SYSTEMS)
def test_estimates_are_those_of_python(name, page):
    observer, system = load(name), kkl_gym.get_system(name)
    y, u = motion(observer.artifact, STEPS + 1)
    y = y + np.random.default_rng(0).normal(scale=0.5, size=y.shape)
    found = page.evaluate(
        """async ([name, y, u]) => {
            const { Observer } = await import("./kkl_observer.js");
            const observer = new Observer(await (await fetch(`${name}_step.safetensors`)).arrayBuffer());
            return y.map((sample, k) => k ? observer.step(sample, u[k - 1]) : observer.reset(sample));
        }""",
        [name, y.tolist(), u.tolist()],
    )
    assert (np.abs(np.array(found) - observer.estimate(y, u)) / system.scale).max() < 1e-4


@pytest.mark.parametrize("name", kkl_gym.SYSTEMS)
def test_motions_are_those_of_python(name, page):
    system, dt = kkl_gym.get_system(name), 0.01
    x0, u = np.mean(system.X, axis=1) + 0.25 * np.ptp(system.X, axis=1), np.full((200, 1, 1), 0.3 * system.u_max[0])
    found = page.evaluate(
        """async ([name, x, u]) => {
            const { System } = await import("./systems.js");
            const described = await (await fetch("systems.json")).json();
            const system = new System(described.find((one) => one.name === name));
            return u.map((input) => x = system.advance(x, input[0], system.scale.map(() => 0)));
        }""",
        [name, x0.tolist(), u.tolist()],
    )
    x = simulate(system, x0[None], 200, dt, u)[1:, 0]
    assert (np.abs(np.array(found) - x) / system.scale).max() < 1e-6


def test_a_frozen_sensor_raises_the_score(page):
    scores = page.evaluate(
        """async () => {
            const { Observer } = await import("./kkl_observer.js");
            const { System } = await import("./systems.js");
            const { World } = await import("./world.js");
            const described = await (await fetch("systems.json")).json();
            const buffer = await (await fetch("lorenz_step.safetensors")).arrayBuffer();
            const system = new System(described.find((one) => one.name === "lorenz"));
            const world = new World(system, new Observer(buffer), 1);
            for (let k = 0; k < 1000; k++) world.step();
            const sound = world.observer.score;
            world.fault = "frozen";
            for (let k = 0; k < 300; k++) world.step();
            return [sound, world.observer.score, world.error(1)];
        }"""
    )
    assert 0 < scores[0] < 1 < scores[1]
    assert scores[2] > 0.05


def test_every_control(page):
    page.wait_for_timeout(500)
    for system in kkl_gym.SYSTEMS:
        page.locator(f"input[value={system}]").check(force=True)
        assert page.locator("#equations").text_content()
    faults = ("bias", "frozen", "dead", "missing", "none")
    for group, values in {"input": ("hand", "sine", "off"), "fault": faults}.items():
        for value in values:
            page.locator(f"input[name={group}][value={value}]").check(force=True)
            page.wait_for_timeout(100)
    page.locator("#noise").fill("0.1")
    assert page.locator("#noise-value").text_content() == "σ = 0.10"
    page.locator("#level").fill("-0.4")
    assert page.locator("input[value=hand]").is_checked()
    page.locator("#portrait").click(position={"x": 200, "y": 150})
    page.locator("#restart").click()
    page.locator("#start").click()
    page.wait_for_timeout(700)
    assert "off by" in page.locator("#error").text_content()
    page.locator("#pause").click()
    assert page.locator("#pause").text_content() == "Play"
    shown = "document.getElementById('traces').toDataURL()"
    before = page.evaluate(shown)
    page.wait_for_timeout(200)
    assert page.evaluate(shown) == before
    page.locator("#pause").click()
    page.wait_for_timeout(300)
    assert page.evaluate(shown) != before


@pytest.mark.parametrize("width", [390, 1280])
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_nothing_overflows(width, scheme, browser, address):
    context = browser.new_context(viewport={"width": width, "height": 800}, color_scheme=scheme)
    page = context.new_page()
    page.goto(address)
    page.wait_for_selector("#status", state="detached")
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    light = page.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(252, 251, 248)"
    assert light == (scheme == "light")
    context.close()


def test_every_control_has_a_name(page):
    unnamed = page.evaluate(
        """[...document.querySelectorAll("input, button, canvas")].filter((one) =>
            !(one.labels?.[0]?.textContent || one.textContent || one.getAttribute("aria-label") || "").trim()).length"""
    )
    assert unnamed == 0


def test_time_of_a_frame(page, capsys):
    page.wait_for_timeout(1000)
    read = "import('./main.js').then(({ statistics }) => [statistics.frames, statistics.busy])"
    (frames, busy), begun = page.evaluate(read), time.perf_counter()
    page.wait_for_timeout(4000)
    later, busier = page.evaluate(read)
    seconds = time.perf_counter() - begun
    work = (busier - busy) / (later - frames)
    with capsys.disabled():
        print(f"\n{(later - frames) / seconds:.1f} frames a second, {work:.2f} ms of work in each")
    assert work < 1000 / 60
