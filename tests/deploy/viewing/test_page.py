import re
import shutil
import socket
import time
from collections.abc import Callable, Iterator

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from prior_sg.deploy.cli.main import main
from prior_sg.deploy.viewing.held import Held
from prior_sg.deploy.viewing.page import Options, Page
from prior_sg.deploy.viewing.picking import Picked, PickedMarker
from prior_sg.deploy.viewing.stage import pose_for
from prior_sg.schemas.markers import MarkerKey
from tests.help.homes import home, joined_home, marked_home, two_floors

CHROMIUM = shutil.which("chromium") or ""
SOFTWARE = ("--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-background-networking")


@pytest.fixture
def shown() -> Iterator[tuple[Held, Page]]:
    source = Held(joined_home(), "test")
    page = Page(source, Options(port=18190, interval_s=0.02))
    yield source, page
    page.close()
    source.close()


def until(true: Callable[[], bool], patience_s: float = 20.0) -> None:
    end_s = time.monotonic() + patience_s
    while not true():
        assert time.monotonic() < end_s
        time.sleep(0.05)


@pytest.mark.skipif(not CHROMIUM, reason="Chromium is not installed")
def test_the_page_opens_without_errors_finds_things_and_keeps_colours(shown: tuple[Held, Page]) -> None:
    sync_api = pytest.importorskip("playwright.sync_api")
    source, page = shown
    errors: list[str] = []
    with sync_api.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=list(SOFTWARE))
        tab = browser.new_page(viewport={"width": 360, "height": 240})
        tab.set_default_timeout(30_000)
        tab.on("console", lambda said: errors.append(said.text) if said.type == "error" else None)
        tab.on("pageerror", lambda error: errors.append(str(error)))
        tab.goto(page.address)
        tab.get_by_text("serve drinks", exact=True).wait_for()
        words = tab.locator('input.mantine-TextInput-input:not([value^="ws:"])').first  # "Find"; another is viser's own
        words.fill("stove")
        tab.get_by_text("stove", exact=True).wait_for()
        until(lambda: "/answers/objects" in page.stage.picture)
        tab.get_by_role("button", name="1", exact=True).click()
        tab.get_by_text("Way to stove").wait_for()
        assert "/way/line" in page.stage.picture
        words.fill("bed")
        until(lambda: not any(name.startswith("/way") for name in page.stage.picture))
        before = colors(page)
        source.put(grown())
        tab.get_by_text("3 regions", exact=False).wait_for()
        assert {name: color for name, color in colors(page).items() if name in before} == before
        browser.close()
    assert errors == []


def test_ways_to_and_from_what_was_clicked(shown: tuple[Held, Page]) -> None:
    page = shown[1]
    asked = page.panel.asked
    until(lambda: "kitchen" in page.panel.text("legend"))
    page._want(picked=Picked(place=12, region=3, itself=True))
    asked.start()
    until(lambda: "ways start here" in page.panel.text("way"))
    page._want(picked=Picked(place=11, region=3, itself=True))
    asked.picked()
    until(lambda: "No way to kitchen" in page.panel.text("way"))
    page._want(picked=Picked(place=10, region=3, itself=True))
    asked.picked()
    until(lambda: "from kitchen (place 12)" in page.panel.text("way"))
    asked.robot()
    until(lambda: "where the robot is" in page.panel.text("way") and "/way/line" in page.stage.picture)
    asked.arrive()
    until(lambda: page.panel.text("way") == "")


def test_what_is_known_of_a_marker_is_told_when_it_is_clicked(shown: tuple[Held, Page]) -> None:
    source, page = shown
    source.put(marked_home())
    until(lambda: "/markers/7/in_apriltag_36h11/name" in page.stage.picture)
    assert page.stage.is_on("markers")
    page._want(picked=PickedMarker(MarkerKey("apriltag_36h11", 9)))
    until(lambda: "marker 9" in page.panel.text("selected"))
    told = page.panel.text("selected")
    for part in (
        "apriltag_36h11",
        "in bedroom (region 7)",
        "x 8.00, y 1.00",
        "16.0 cm",
        "5 keyframes",
        "in doubt: it has",
    ):
        assert part in told
    page._want(picked=PickedMarker(MarkerKey("apriltag_36h11", 7)))
    page.panel.asked.picked()
    until(lambda: "Way to marker 7" in page.panel.text("way"))
    assert "no doubt" in page.panel.text("selected")
    source.put(joined_home())
    until(lambda: "not there at this time" in page.panel.text("selected"))


def test_why_a_place_of_a_merged_map_carries_its_label_is_known_of_its_robots(shown: tuple[Held, Page]) -> None:
    source, page = shown
    merged = joined_home(merged_of=["robot1", "robot2"], robot="home")
    source.put(merged)
    until(lambda: "merged map of robot1, robot2" in page.panel.text("headline"))
    picked = Picked(place=12, region=3, itself=True)
    page._want(picked=picked)
    page._explain(merged, picked)
    until(lambda: "known of a robot&#x27;s own map (--robot robot1)" in page.panel.text("selected"))


@pytest.mark.skipif(not CHROMIUM, reason="Chromium is not installed")
def test_a_click_in_the_browser_on_a_marker_tells_of_it(shown: tuple[Held, Page]) -> None:
    sync_api = pytest.importorskip("playwright.sync_api")
    source, page = shown
    source.put(marked_home())
    with sync_api.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=list(SOFTWARE))
        tab = browser.new_page(viewport={"width": 900, "height": 500})
        tab.set_default_timeout(30_000)
        tab.goto(page.address)
        tab.get_by_text("serve drinks", exact=True).wait_for()
        (viewer,) = page.server.get_clients().values()

        def tells() -> bool:
            """The eye may still turn, or the marker be on its way."""
            tab.mouse.click(*pixel_of(viewer.camera, marked_home().markers[0].position_m))
            time.sleep(0.5)
            return "marker 7" in page.panel.text("selected")

        until(tells, 60.0)
        tab.get_by_text("seen in 5 keyframes", exact=False).wait_for()
        tab.get_by_role("tab", name="Layers").click()
        tab.get_by_label("Printed markers").uncheck()
        until(lambda: not page.stage.is_on("markers"), 60.0)
        browser.close()


def pixel_of(camera, point_m: tuple) -> tuple[float, float]:
    """Where a point of the world lies in a viewer's window."""
    turn = Rotation.from_quat(np.roll(camera.wxyz, -1)).as_matrix()
    x, y, z = turn.T @ (np.array(point_m) - camera.position)
    focal_px = camera.image_height / 2 / np.tan(camera.fov / 2)
    return float(camera.image_width / 2 + focal_px * x / z), float(camera.image_height / 2 + focal_px * y / z)


def test_one_floor_is_shown_instead_of_all(shown: tuple[Held, Page]) -> None:
    source, page = shown
    until(lambda: "kitchen" in page.panel.text("legend"))
    assert not page.panel._floor.visible  # of a home on one floor
    source.put(two_floors())
    until(lambda: page.panel._floor.options == ("all", "floor 4, 9 m²", "floor 1, 9 m²"))  # from below
    assert page.panel._floor.visible and "4 regions, 20 places" in page.panel.text("headline")
    everything = set(page.stage.picture)
    page.panel.asked.floor(1)
    until(lambda: "2 regions, 10 places, 1 object" in page.panel.text("headline"))
    assert set(page.stage.picture) < everything
    source.put(home())  # that floor is gone
    until(lambda: "2 regions, 10 places" in page.panel.text("headline") and not page.panel._floor.visible)
    page.panel.asked.floor(None)
    source.put(two_floors())
    until(lambda: "4 regions, 20 places" in page.panel.text("headline"))


def colors(page: Page) -> dict[str, tuple[int, int, int]]:
    return {name: shape.color for name, shape in page.stage.picture.items() if re.match("/regions/.*/floor", name)}


def grown():
    """The bedroom is divided: half of its places make an attic."""
    scene = home()
    owners = scene.place_regions.copy()
    owners[8:] = 9
    attic = msgspec.structs.replace(scene.regions[1], id=9, label="attic", position_m=(6.5, 1.5, 1.0))
    return msgspec.structs.replace(scene, regions=[*scene.regions, attic], place_regions=owners)


@pytest.mark.parametrize(
    ("host", "origin", "refused"),
    [
        ("127.0.0.1", None, False),
        ("localhost", "http://localhost:18190", False),
        ("127.0.0.1", "https://elsewhere.example", True),
        ("elsewhere.example", "http://elsewhere.example:18190", True),  # a name that leads to this machine
    ],
)
def test_pages_of_other_sites_are_refused(shown: tuple[Held, Page], host: str, origin: str, refused: bool) -> None:
    client = pytest.importorskip("websockets.sync.client")
    import viser
    from websockets.exceptions import ConnectionClosed

    page = shown[1]
    port = page.server.get_port()
    with client.connect(
        f"ws://{host}:{port}",
        sock=socket.create_connection(("127.0.0.1", port)),
        subprotocols=[f"viser-v{viser.__version__}"],
        origin=origin and origin.replace("18190", str(port)),
        max_size=None,
    ) as spoken:
        if refused:
            with pytest.raises(ConnectionClosed):
                spoken.recv(timeout=30)
            assert spoken.close_code == 1008
        else:
            assert spoken.recv(timeout=30)


def test_a_fault_in_drawing_ends_nothing(shown: tuple[Held, Page], monkeypatch: pytest.MonkeyPatch) -> None:
    source, page = shown
    drawn: list[int] = []

    def refresh() -> int:
        drawn.append(len(drawn))
        if len(drawn) == 1:
            raise ZeroDivisionError
        return 0

    monkeypatch.setattr(page, "refresh", refresh)
    for number in (1, 2):
        source.put(joined_home())
        until(lambda number=number: len(drawn) >= number)


def test_links_through_others_cannot_be_asked_for(shown: tuple[Held, Page]) -> None:
    assert shown[1].server.request_share_url() is None


def test_names_from_outside_are_shown_and_not_run(shown: tuple[Held, Page]) -> None:
    source, page = shown
    evil = '<img src=x onerror="alert(1)">'
    region = msgspec.structs.replace(home().regions[0], label=evil)
    source.put(home(regions=[region, home().regions[1]], task=evil, environment=evil))
    until(lambda: "&lt;img" in page.panel.text("legend"))
    assert "<img" not in page.panel.text("legend") + page.panel.text("headline")


def test_other_machines_are_refused_in_a_sentence(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["view", "somewhere", "--host", "0.0.0.0"]) == 2
    said = capsys.readouterr().err
    assert "ssh -L" in said and said.count("\n") <= 3


def test_a_folder_that_is_no_run_is_told(tmp_path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["view", str(tmp_path)]) == 1
    assert "log.mcap" in capsys.readouterr().err


@pytest.mark.parametrize("aspect", [0.46, 1.6, 3.0])
@pytest.mark.parametrize("free", [(1.0, 1.0), (0.7, 1.0), (1.0, 0.42)])
@pytest.mark.parametrize("size", [(10.0, 4.0, 2.0), (4.0, 10.0, 2.0)])
def test_the_whole_map_is_in_the_free_part_of_the_window(aspect: float, free: tuple, size: tuple) -> None:
    low_m, high_m = np.array((1.0, 2.0, 0.0)), np.array((1.0, 2.0, 0.0)) + size
    eye, target = pose_for(low_m, high_m, aspect, free)
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, (0, 0, 1))
    right /= np.linalg.norm(right)
    up = np.cross(right, forward)
    corners = np.array([np.where([i >> axis & 1 for axis in range(3)], high_m, low_m) for i in range(8)]) - eye
    half_high = np.tan(np.deg2rad(38.0) / 2)
    x = corners @ right / (corners @ forward) / half_high / aspect
    y = corners @ up / (corners @ forward) / half_high
    assert x.min() > -1.001 and x.max() < 2 * free[0] - 1 + 0.001
    assert y.max() < 1.001 and y.min() > 1 - 2 * free[1] - 0.001
