"""`prior-sg bench view`: drawing a scene, what a change of it sends, and how fast a browser shows it.

The browser is Chromium without a window, driven by Playwright; where either is missing, its figures are left out. It
draws in software unless the machine lends it a graphics processor, which is far slower than any that people have.
"""

import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import msgspec
import numpy as np

from prior_sg.deploy.benches.queries import synthetic_scene
from prior_sg.deploy.viewing.drawing import Painter
from prior_sg.deploy.viewing.held import Held
from prior_sg.deploy.viewing.page import Options, Page
from prior_sg.deploy.viewing.shapes import difference
from prior_sg.schemas.scene import Scene

SIZES = (10_000, 100_000)
OBJECTS = 1000
WINDOW = (480, 320)  # pixels
SOFTWARE = ("--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-background-networking")
COUNT_S, SETTLE_S, CHANGES, PATIENCE_S = 10.0, 30.0, 5, 60.0
KEEP_PIXELS = """
const plain = HTMLCanvasElement.prototype.getContext;
HTMLCanvasElement.prototype.getContext = function (kind, more) {
  return plain.call(this, kind, kind.startsWith("webgl") ? {...more, preserveDrawingBuffer: true} : more);
};
const small = document.createElement("canvas");
small.width = 160; small.height = 100;
const brush = () => small.getContext("2d", {willReadFrequently: true});
const largest = () => [...document.querySelectorAll("canvas")].sort((a, b) => b.width - a.width)[0];
window.look = () => {
  brush().drawImage(largest(), 0, 0, 160, 100);
  return brush().getImageData(0, 0, 160, 100).data;
};
window.frames_in = async seconds => {
  let count = 0;
  const start = performance.now();
  while (performance.now() - start < 1000 * seconds) { await new Promise(requestAnimationFrame); count += 1; }
  return 1000 * count / (performance.now() - start);
};
window.watch = () => {
  const before = window.look();
  window.seen = null;
  const again = () => {
    const now = window.look();
    let changed = 0;
    for (let i = 0; i < now.length; i += 1) changed += Math.abs(now[i] - before[i]) > 12;
    if (changed > 30) window.seen = performance.timeOrigin + performance.now();
    else requestAnimationFrame(again);
  };
  requestAnimationFrame(again);
};
"""


def view_bench(sizes: tuple[int, ...] = SIZES) -> tuple[dict, dict]:
    """All figures and the settings."""
    browser = _browser()
    metrics: dict[str, Any] = {}
    for size in sizes:
        scene = synthetic_scene(size, OBJECTS)
        figures = _drawing(scene) | (_showing(scene, browser) if browser else {})
        metrics |= {f"{name}_{size}": value for name, value in figures.items()}
    settings = {"places": list(sizes), "objects": OBJECTS, "window": WINDOW, "browser": browser or "none"}
    return metrics, settings


def _browser() -> str:
    """The program; empty when it or what drives it is not there."""
    try:
        import playwright.sync_api  # noqa: F401
    except ModuleNotFoundError:
        return ""
    return shutil.which("chromium") or shutil.which("google-chrome") or ""


def changed_a_little(scene: Scene, seed: int) -> Scene:
    """As after one keyframe: fifty neighbouring places have moved, one region has another label."""
    rng = np.random.default_rng(seed)
    first = int(rng.integers(len(scene.place_ids) - 50))
    positions_m = scene.positions_m.copy()
    positions_m[first : first + 50] += rng.normal(0, 0.02, (50, 3)).astype(np.float32)
    names = sorted({region.label for region in scene.regions})
    own = scene.regions[len(scene.regions) // 2]
    other = names[(names.index(own.label) + 1) % len(names)]
    regions = [msgspec.structs.replace(one, label=other) if one is own else one for one in scene.regions]
    return msgspec.structs.replace(scene, positions_m=positions_m, regions=regions)


def divided_anew(scene: Scene, turn: int) -> Scene:
    """As after another task: every region has another label."""
    names = sorted({region.label for region in scene.regions})
    others = {name: names[(number + turn) % len(names)] for number, name in enumerate(names)}
    regions = [msgspec.structs.replace(one, label=others[one.label]) for one in scene.regions]
    return msgspec.structs.replace(scene, regions=regions)


def _drawing(scene: Scene) -> dict[str, float]:
    painter = Painter()
    first, picture = _timed(painter, scene)
    again, same = _timed(painter, scene)
    update, after = _timed(painter, changed_a_little(scene, 1))
    return {
        "draw_first_ms": first,
        "draw_same_ms": again,
        "draw_update_ms": update,
        "sent_first_kb": difference({}, picture).nbytes / 1e3,
        "sent_same_kb": difference(picture, same).nbytes / 1e3,
        "sent_update_kb": difference(picture, after).nbytes / 1e3,
    }


def _timed(painter: Painter, scene: Scene) -> tuple[float, Any]:
    since_s = time.perf_counter()
    picture = painter.draw(scene)
    return 1e3 * (time.perf_counter() - since_s), picture


def _showing(scene: Scene, browser: str) -> dict[str, float]:
    source = Held(scene)
    page = Page(source, Options(port=18080, interval_s=0.05))
    try:
        with _tab(browser, page.address) as tab:
            time.sleep(SETTLE_S)
            frames = tab.evaluate(f"window.frames_in({COUNT_S})")
            latencies = [_latency_ms(tab, source, divided_anew(scene, 1 + seed)) for seed in range(CHANGES)]
    finally:
        page.close()
        source.close()
    return {"frames_per_s": frames, "switch_to_pixel_ms_p50": float(np.median(latencies))}


@contextmanager
def _tab(browser: str, address: str) -> Iterator[Any]:
    from playwright.sync_api import sync_playwright

    with sync_playwright() as driver:
        chromium = driver.chromium.launch(executable_path=browser, args=list(SOFTWARE))
        tab = chromium.new_page(viewport={"width": WINDOW[0], "height": WINDOW[1]})
        tab.set_default_timeout(1e3 * PATIENCE_S)
        tab.add_init_script(KEEP_PIXELS)
        tab.goto(address)
        tab.wait_for_selector("canvas")
        yield tab
        chromium.close()


def _latency_ms(tab: Any, source: Held, scene: Scene) -> float:
    """From handing over a scene to the first frame that looks different; not a number when none does."""
    tab.evaluate("window.watch()")
    put_ms = 1e3 * time.time()
    source.put(scene)
    end_s = time.monotonic() + PATIENCE_S
    while (seen_ms := tab.evaluate("window.seen")) is None and time.monotonic() < end_s:
        time.sleep(0.05)
    return float("nan") if seen_ms is None else seen_ms - put_ms
