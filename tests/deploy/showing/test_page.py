"""The page of a run: Chromium draws it without error or request, hostile names stay text, the log tells its story."""

import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from prior_sg.deploy.showing.formats import page
from prior_sg.deploy.showing.formats.page.steps import steps_of
from prior_sg.deploy.showing.material import Material, Moment
from prior_sg.deploy.showing.reading import read_material
from prior_sg.schemas.codec import encode
from prior_sg.schemas.frames import Keyframe
from prior_sg.schemas.status import Consumed, Started
from prior_sg.schemas.topics import JOURNAL, KEYFRAME, PLACE_DELTA
from prior_sg.services.runtime.record import LogWriter
from tests.deploy.showing.test_export import changed, flat, flat_map
from tests.deploy.showing.test_formats import FORMULA, HOSTILE, told
from tests.help.world import CAMERA, look, place_delta, place_grid

CHROMIUM = Path("/usr/bin/chromium")
QUIET = ("--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking")


def story():
    """Three moments: nothing labelled, four places, all."""
    first = changed(told(), stamp_ns=10**9, regions=[], objects=[])
    kept = {name: getattr(told(), name)[:4] for name in COLUMNS}
    few = changed(told(), **kept, stamp_ns=2 * 10**9)
    last = changed(told(), stamp_ns=4 * 10**9)
    return [Moment(3, first), Moment(5, few), Moment(9, last)]


PLACES = ("place_ids", "positions_m", "radii_m", "basis_points", "place_regions", "posteriors", "unknown")
COLUMNS = (*PLACES, "edges", "clearances_m")


def material(**fields):
    moments = story()
    beside = {"scores": {"f1_s": 0.5}, "settings": {"segmenter": {"space": HOSTILE}}, "losses": []}
    return Material(moments[-1].scene, flat_map(), moments=moments, **(beside | fields))


def test_steps_add_up_to_each_moment():
    places, edges = {}, set()
    for step, moment in zip(steps_of(story()), story(), strict=True):
        for gone in step["gone"]:
            del places[gone]
        places |= {row[0]: row for row in step["places"]}
        edges = (edges - {tuple(cut) for cut in step["cut"]}) | {(a, b) for a, b, _ in step["edges"]}
        assert sorted(places) == moment.scene.place_ids.tolist()
        assert edges == {tuple(pair) for pair in moment.scene.edges.tolist()}
        assert [places[place][5] for place in sorted(places)] == moment.scene.place_regions.tolist()
        assert step["seconds"] == (moment.scene.stamp_ns - 10**9) / 1e9
    assert places[13][8:] == [12, 75, 12]
    _, second, third = steps_of(story())
    assert second["gone"] == [22] and second["places"] == [] and "regions" not in third


def test_names_cannot_leave_their_element():
    text = page.page(material())
    assert "<img" not in text and text.count("</script>") == 2
    data = json.loads(re.search(r'<script type="application/json" id="data">(.*?)</script>', text, re.S)[1])
    assert data["task"] == HOSTILE and data["steps"][0]["places"][0][0] == 10
    assert "default-src 'none'" in text and "unsafe" not in text


def test_a_large_scene_is_thinned_with_a_note(monkeypatch):
    monkeypatch.setattr(page, "MAX_PLACES", 3)
    assert "Of 5 places one in 2 is drawn." in page.page(material())
    monkeypatch.setattr(page, "MAX_BYTES", 500)
    text = page.page(material())
    assert '"revision": 9' in text and '"revision": 3' not in text


@pytest.fixture(scope="module")
def browser():
    sync_api = pytest.importorskip("playwright.sync_api")
    if not CHROMIUM.exists():
        pytest.skip("needs Chromium")
    with sync_api.sync_playwright() as playwright:
        opened = playwright.chromium.launch(executable_path=str(CHROMIUM), args=list(QUIET))
        yield opened
        opened.close()


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_chromium_shows_it(browser, scheme, tmp_path):
    (tmp_path / "scene.html").write_text(page.page(material()))
    phone = {"viewport": {"width": 390, "height": 844}} if scheme == "dark" else {}
    window = browser.new_page(color_scheme=scheme, **phone)
    said, asked = [], []
    window.on("console", lambda message: said.append(message.text))
    window.on("pageerror", lambda error: said.append(str(error)))
    window.on("request", lambda request: asked.append(request.url.split(":")[0]))
    window.goto((tmp_path / "scene.html").as_uri())
    window.wait_for_function("document.documentElement.dataset.ready === 'yes'")
    assert window.locator("h1").text_content() == HOSTILE
    assert window.locator("img").count() == 0
    names = window.locator("#regions .name").all_inner_texts()
    assert sorted(names) == sorted([FORMULA, "hall"])
    window.locator("#regions .name", has_text="=cmd").click()
    card = window.locator("#chosen").inner_text()
    assert "75 %" in card and "door to hall (0.75 m wide)" in card
    width = window.locator("#chosen .fill").first.evaluate("bar => bar.clientWidth / bar.parentElement.clientWidth")
    assert width == pytest.approx(0.75, abs=0.02)
    window.locator("#step").fill("0")
    assert (
        window.locator("#regions").inner_text() == "none yet" and "revision 3" in window.locator("#when").inner_text()
    )
    assert window.evaluate("document.documentElement.scrollWidth <= innerWidth")
    window.locator("#step").fill("2")
    window.locator("#chosen button").click()
    x, y = window.evaluate("pixel(1.5, 1).map((at) => at / devicePixelRatio)")
    window.locator("#map").click(position={"x": x, "y": y})
    assert "place 13" in window.locator("#chosen").inner_text()
    window.close()
    assert said == [] and set(asked) <= {"file", "data"}


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    """Two place deltas, a keyframe of a wall 2 m ahead, and the start of a service; no final scene."""
    path = tmp_path_factory.mktemp("log") / "log.mcap"
    positions, edges = place_grid(1)
    half = edges[(edges < 8).all(axis=1)]
    deltas = [
        place_delta(positions[:8], half, robot="robot1", camera_m=(0.0, 0.0, 1.0)),
        place_delta(positions, edges, robot="robot1", revision=1, frame_id=1, camera_m=(1.0, 0.0, 1.0), stamp_ns=9),
    ]
    color = cv2.imencode(".png", np.full((48, 64, 3), (0, 0, 255), np.uint8))[1].tobytes()
    depth = cv2.imencode(".png", np.full((48, 64), 2000, np.uint16))[1].tobytes()
    keyframe = Keyframe(
        robot="robot1",
        frame_id=0,
        stamp_ns=1,
        intrinsics=CAMERA,
        world_from_camera=look(1.0, 2.0, 0.0),
        color=color,
        depth=depth,
        depth_scale_m=0.001,
    )
    started = Started(robot="robot1", service="segmenter", instance="s", epoch=1, config=b'{"space": "x/y"}')
    entry = Consumed(robot="robot1", service="segmenter", instance="s", order=0, topic="START", inline=encode(started))
    with LogWriter(path) as writer:
        rows = [(KEYFRAME, keyframe), *((PLACE_DELTA, delta) for delta in deltas), (JOURNAL, entry)]
        for number, (topic, message) in enumerate(rows):
            writer.add(topic, f"key/{topic.name}", encode(message), "w", number, number, number)
    return path


def test_a_log_tells_how_the_scene_came_about(log):
    found = read_material(log.parent, "robot1", moments_wanted=5, cloud_wanted=True)
    assert [(len(moment.scene.place_ids), moment.revision) for moment in found.moments] == [(8, 0), (16, 1)]
    assert encode(found.moments[-1].scene) == encode(found.scene)
    assert found.scene.trajectory.tolist() == [[0, 0, 1], [1, 0, 1]]
    assert found.settings == {"segmenter": {"space": "x/y"}}
    assert found.cloud.points_world[:, 0] == pytest.approx(3.0)  # 2 m ahead of a camera at x = 1 that looks along x
    assert found.cloud.points_world[:, 1:].mean(axis=0) == pytest.approx((2.0, 1.0), abs=0.1)
    assert set(map(tuple, found.cloud.colors.tolist())) == {(255, 0, 0)}
    assert [len(m.scene.place_ids) for m in read_material(log, "robot1", moments_wanted=1).moments] == [16]


def test_another_robot_of_a_log_is_not_there(log):
    with pytest.raises(Exception, match="holds no places of robot2; name one of robot1 with --robot"):
        read_material(log, "robot2")


def test_a_scene_without_walls_is_drawn_too():
    text = page.page(Material(flat()))
    assert "Without a map of walls" in text and "data:image" not in text.split('id="data"')[1].split("</script>")[0]
