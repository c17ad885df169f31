import logging
import math
import socket
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import suppress

import msgspec
import pytest
import viser

from prior_sg.deploy.viewing.gate import Allowance, said
from prior_sg.deploy.viewing.held import Held
from prior_sg.deploy.viewing.newest import Newest
from prior_sg.deploy.viewing.page import DIVIDING, MOST_MEANINGS, Options, Page
from prior_sg.deploy.viewing.picking import Picked
from prior_sg.deploy.viewing.sources import Likeness
from prior_sg.schemas.priors import Prior
from prior_sg.schemas.scene import Scene
from tests.help.homes import joined_home

websockets = pytest.importorskip("websockets")
client = pytest.importorskip("websockets.sync.client")

EYE = {
    "type": "ViewerCameraMessage",
    "wxyz": [1.0, 0.0, 0.0, 0.0],
    "position": [0, 0, 5],
    "fov": 1.0,
    "near": 0.01,
    "far": 1000,
    "image_height": 500,
    "image_width": 900,
    "look_at": [0, 0, 0],
    "up_direction": [0, 0, 1],
}
CLICK = {
    "type": "ScenePointerMessage",
    "event_type": "click",
    "ray_origin": [6.5, 1.5, 5.0],
    "ray_direction": [0, 0, -1],
    "screen_pos": [[0.5, 0.5]],
    "modifier": None,
}
pack = msgspec.msgpack.encode


class Asked(Held):
    """A scene that finds meanings, and a running system whose task waits until it is let go on."""

    live = True

    def __init__(self, scene: Scene) -> None:
        super().__init__(scene, "test")
        self.tasks: list[str] = []
        self.meant: list[str] = []
        self.go_on = threading.Event()

    def likeness(self, scene: Scene, text: str) -> Likeness:
        self.meant.append(text)
        return Likeness({}, {})

    def prior(self, digest: str) -> Prior | None:
        return None

    def switch(self, task: str, environment: str, say: Callable[[str], None]) -> str:
        self.tasks.append(task)
        self.go_on.wait(20)
        return f"done: {task}"


@pytest.fixture
def shown() -> Iterator[tuple[Asked, Page]]:
    source = Asked(joined_home())
    page = Page(source, Options(port=18290, interval_s=0.02))
    until(lambda: "kitchen" in page.panel.text("legend"))
    yield source, page
    source.go_on.set()
    page.close()
    source.close()


def until(true: Callable[[], bool], patience_s: float = 20.0) -> None:
    end_s = time.monotonic() + patience_s
    while not true():
        assert time.monotonic() < end_s
        time.sleep(0.02)


def viewer(page: Page):
    """A connection as a viewer's."""
    return connected(page.server.get_port())


def connected(port: int, **more: object):
    return client.connect(
        f"ws://127.0.0.1:{port}",
        subprotocols=[f"viser-v{viser.__version__}"],
        max_size=None,
        max_queue=None,
        compression=None,
        **more,
    )


def use(control, value: object) -> dict:
    return {"type": "GuiUpdateMessage", "uuid": control._impl.uuid, "updates": {"value": value}}


def tell(page: Page, *messages: object) -> None:
    """Say all of this as one viewer, one after the other, and wait until all that is taken of it was."""
    search = page.panel._search
    with viewer(page) as spoken, suppress(websockets.ConnectionClosed):
        spoken.send(pack(EYE))
        until(lambda: bool(page.server.get_clients()))
        for message in messages:
            spoken.send(message if isinstance(message, bytes | str) else pack(message))
        told = f"said {len(messages)} {search.value}"[:50]
        spoken.send(pack(use(search, told)))
        until(lambda: search.value == told)
    until(lambda: not page.server.get_clients())


def answers(page: Page, text: str = "stove") -> bool:
    """Whether an honest viewer is answered."""
    tell(page, use(page.panel._search, text))
    with viewer(page) as spoken:
        spoken.send(pack(EYE))
        until(lambda: bool(page.server.get_clients()))
        spoken.send(pack(use(page.panel._search, text)))
        until(lambda: text in page.panel.text("answers"))
    return True


@pytest.mark.parametrize("honest", [EYE, CLICK, CLICK | {"modifier": "shift"}, EYE | {"image_height": 500.0}])
def test_what_browsers_say_is_taken(honest: dict) -> None:
    assert said(pack(honest)) is not None


@pytest.mark.parametrize(
    "raw",
    [
        b"",
        b"\xc1",
        b"\x81",
        b"\x91" * 100_000 + b"\x01",
        b"\x81\xa1a" * 100_000,
        pack(5),
        pack({}),
        pack({"type": "Nope"}),
        pack({"type": ["ViewerCameraMessage"]}),
        pack({"type": "ShareUrlRequest"}),
        pack({"type": "FileTransferStartUpload", "source_component_uuid": "a"}),
        pack(CLICK | {"event_type": "rect-select"}),
        pack(EYE | {"more": 1}),
        pack(EYE | {"wxyz": "abcd"}),
        pack(EYE | {"image_width": 1e308}),
        pack(EYE | {"image_height": -1}),
        *(pack(EYE | {"position": [0.0, bad, 0.0]}) for bad in (math.nan, math.inf, 1e308, None, "1")),
        *(pack(EYE | {"fov": bad}) for bad in (math.nan, -math.inf)),
        *(pack(CLICK | {"ray_origin": bad}) for bad in (None, [0, 0], [math.nan] * 3, [1e300] * 3, [[0]] * 3)),
        *(pack(CLICK | {"ray_direction": bad}) for bad in (None, [0, 0, 0], [1e-320] * 3, [math.nan] * 3)),
        *(pack(CLICK | {"screen_pos": bad}) for bad in ([], [[math.nan, 0]], [[0, 0]] * 3)),
        pack(CLICK | {"modifier": "x" * 100}),
        pack({"type": "GuiUpdateMessage", "uuid": "a", "updates": {"value": "x" * 2001}}),
        pack({"type": "GuiUpdateMessage", "uuid": "a", "updates": {"value": [1]}}),
        pack({"type": "GuiUpdateMessage", "uuid": "a", "updates": {"value": 1, "props": 1}}),
        pack({"type": "GuiUpdateMessage", "uuid": "a", "updates": {"sync_cb": None}}),
        pack({"type": "GuiFormDirtyMessage", "uuid": "x" * 100}),
    ],
)
def test_what_no_browser_says_is_not(raw: bytes) -> None:
    assert said(raw) is None


def test_the_page_outlives_what_it_is_told(
    shown: tuple[Asked, Page], capfd: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    page = shown[1]
    panel = page.panel
    upload = {"source_component_uuid": panel._search._impl.uuid, "transfer_uuid": "t"}
    buffered = len(page.server._websock_server._broadcast_buffer.message_from_id)
    tell(
        page,
        *("text", b"\xc1", {"type": "Nope"}, {"type": "ShareUrlDisconnect"}),
        *({"type": "GuiFormDirtyMessage", "uuid": f"{number}"} for number in range(50)),
        {
            "type": "FileTransferStartUpload",
            "filename": "f",
            "mime_type": "x",
            "part_count": 1,
            "size_bytes": 1,
            **upload,
        },
        {"type": "FileTransferPart", "part_index": 0, "content": b"x", **upload},
        *(use(panel._slider, value) for value in (10**9, -1, math.nan, math.inf, "x", None)),
        *(use(panel._search, value) for value in ([1], {}, 5, True)),
        *(use(panel._floor, value) for value in ("nope", 5)),
        *(use(panel._play, value) for value in ("nope", 5)),
        *(
            {"type": "GuiUpdateMessage", "uuid": panel._search._impl.uuid, "updates": {name: None}}
            for name in ("props", "update_cb", "sync_cb", "removed", "gui_api", "__class__", "nothing")
        ),
        CLICK | {"ray_direction": [0, 0, 0]},
        CLICK | {"ray_origin": [0.0, 0.0]},
        EYE | {"image_width": 1e308},
        EYE | {"position": [math.nan] * 3},
    )
    assert answers(page)
    assert page.server.gui._current_file_upload_states == {}
    assert len(page.server._websock_server._broadcast_buffer.message_from_id) < buffered + 50
    said_out = capfd.readouterr()
    assert said_out.out + said_out.err == "" and not caplog.records


def test_a_window_without_bounds_holds_nobody_up(shown: tuple[Asked, Page]) -> None:
    """The eye is moved back until all is seen, which it never is in such a window."""
    page = shown[1]
    with viewer(page) as spoken:
        spoken.send(pack(EYE | {"image_width": 1, "image_height": 1e308}))
        spoken.send(pack(use(page.panel._search, "through")))
        until(lambda: page.panel._search.value == "through")
        framed = threading.Thread(
            target=lambda: [page.stage.frame(one) for one in page.server.get_clients().values()], daemon=True
        )
        framed.start()
        framed.join(5)
        assert not framed.is_alive()


def test_what_only_the_page_sets_stays_as_it_is(shown: tuple[Asked, Page]) -> None:
    panel = shown[1].panel
    written = panel._html["legend"]
    before = written.content
    tell(
        shown[1],
        {"type": "GuiUpdateMessage", "uuid": written._impl.uuid, "updates": {"content": "<b>lies</b>"}},
        {"type": "GuiUpdateMessage", "uuid": panel._search._impl.uuid, "updates": {"uuid": written._impl.uuid}},
        use(panel._slider, 1),  # there is one moment: it cannot be used
    )
    assert written.content == before and panel._search._impl.uuid != written._impl.uuid
    assert panel._slider.value == 0


@pytest.mark.parametrize("how", ["large", "pings", "pieces", "messages"])
def test_who_sends_without_measure_is_cut_off(shown: tuple[Asked, Page], how: str) -> None:
    page = shown[1]
    port = page.server.get_port()
    head = (
        f"GET / HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        f"Sec-WebSocket-Key: {'A' * 22}==\r\nSec-WebSocket-Version: 13\r\n"
        f"Sec-WebSocket-Protocol: viser-v{viser.__version__}\r\n\r\n"
    )
    mask = bytes(4)
    flood = {
        "large": b"\x82\xfe\xff\xff" + mask + bytes(65535),  # under what may come at once
        "pings": (b"\x89\x80" + mask) * 30_000,
        "messages": (b"\x82\x81" + mask + b"\xc0") * 2000,
        "pieces": b"\x02\x80" + mask + (b"\x00\x80" + mask) * 1000,
    }[how]
    with socket.create_connection(("127.0.0.1", port)) as spoken:
        spoken.sendall(head.encode())
        spoken.settimeout(20)
        assert spoken.recv(12) == b"HTTP/1.1 101"
        until(lambda: len(page.server._websock_server._live_connections) == 1)
        with suppress(ConnectionError):
            spoken.sendall(flood)
            while spoken.recv(65536):
                continue
    until(lambda: not page.server._websock_server._live_connections, 5.0)
    assert answers(page)


def test_so_many_may_look_at_once(shown: tuple[Asked, Page], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("prior_sg.deploy.viewing.stage.MOST_VIEWERS", 2)
    page = shown[1]
    with viewer(page) as first, viewer(page) as second:
        assert first.recv(timeout=20) and second.recv(timeout=20)
        with viewer(page) as third, pytest.raises(websockets.ConnectionClosed):
            third.recv(timeout=20)
        assert third.close_code == 1013
    until(lambda: not page.server._viewers)
    with viewer(page) as again:
        assert again.recv(timeout=20)


def test_a_doubtful_host_is_refused_and_leaves_nothing(shown: tuple[Asked, Page]) -> None:
    page = shown[1]
    with connected(page.server.get_port(), additional_headers={"Host": "elsewhere.example"}) as spoken:  # a second one
        with pytest.raises(websockets.ConnectionClosed):
            spoken.recv(timeout=20)
        assert spoken.close_code == 1008
    until(lambda: not page.server._websock_server._live_connections, 5.0)


def test_who_came_while_the_page_started_sees_no_map(monkeypatch: pytest.MonkeyPatch) -> None:
    """A page of another site may try again and again until there is a server."""
    start, early = viser.ViserServer.__init__, []

    def started(self: viser.ViserServer, **options: object) -> None:
        start(self, **options)
        early.append(connected(self.get_port(), origin="https://elsewhere.example"))
        early[0].recv(timeout=20)

    monkeypatch.setattr(viser.ViserServer, "__init__", started)
    source = Asked(joined_home())
    page = Page(source, Options(port=18290))
    with early[0], pytest.raises(websockets.ConnectionClosed):
        while True:
            early[0].recv(timeout=5)
    page.close()


def test_connections_without_room_fill_no_log(shown: tuple[Asked, Page], caplog: pytest.LogCaptureFixture) -> None:
    loop = shown[1].server._event_loop
    for message in ("socket.accept() out of system resource", "something else"):
        loop.call_soon_threadsafe(loop.call_exception_handler, {"message": message})
    until(lambda: bool(caplog.records))
    assert [record.getMessage() for record in caplog.records] == ["something else"]


def test_nothing_is_said_of_who_speaks_another_protocol(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(logging.getLogger("websockets.server"), "filters", [])  # viser adds one at the first request
    page = Page(Asked(joined_home()), Options(port=18290))
    with socket.create_connection(("127.0.0.1", page.server.get_port())) as spoken, suppress(ConnectionError):
        spoken.sendall(b"\x16\x03\x01\x00\xff\r\n\r\n")
        while spoken.recv(4096):
            continue
    page.close()
    assert not caplog.records


def test_nothing_is_said_of_viewers_that_leave_at_once() -> None:
    source = Asked(joined_home())
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        page = Page(source, Options(port=18290))
        until(lambda: page.stage._bounds is not None)
        with viewer(page) as spoken:
            spoken.send(pack(EYE))
            until(lambda: bool(page.server.get_clients()))
            (gone,) = page.server.get_clients().values()
        until(lambda: not page.server.get_clients())
        gone.camera._state.fov = 2.0  # it had looked elsewhere
        page.stage.frame(gone)
        page.close()
    assert [str(one.message) for one in caught if "closed connection" in str(one.message)] == []


def test_one_task_is_worked_on_at_a_time(shown: tuple[Asked, Page]) -> None:
    source, page = shown
    for number in range(20):
        page.panel.asked.task(f"task {number}", "")
    until(lambda: DIVIDING in page.panel.text("told"))
    assert source.tasks == ["task 0"]
    source.go_on.set()
    until(lambda: "done: task 0" in page.panel.text("told"))
    until(lambda: not page._dividing.locked())
    page.panel.asked.task("another", "")
    until(lambda: source.tasks == ["task 0", "another"])


def test_only_the_newest_text_is_looked_up_and_few_are_kept(shown: tuple[Asked, Page]) -> None:
    source, page = shown
    threads = threading.active_count()
    for number in range(300):
        page.panel.asked.search(f"thing {number}")
    assert threading.active_count() <= threads
    until(lambda: bool(source.meant))
    assert source.meant == ["thing 299"]
    page._meant.update({(f"{number}", ""): Likeness({}, {}) for number in range(MOST_MEANINGS)})
    page.panel.asked.search("one more")
    until(lambda: "one more" in source.meant and ("one more", joined_home().prior_digest) in page._meant)
    assert len(page._meant) <= MOST_MEANINGS + 1


def test_explanations_that_take_long_hold_no_controls_up(shown: tuple[Asked, Page]) -> None:
    """The workers that controls have are few: clicks must not use them up."""
    source, page = shown
    begun = threading.Event()

    def explain(place_id: int, say: Callable[[str], None]):
        begun.set()
        source.go_on.wait(60)
        raise AssertionError("nobody waits")

    source.explain = explain  # type: ignore[method-assign]
    tell(page, *[CLICK] * 60)
    until(lambda: isinstance(page._wanted.picked, Picked))
    assert begun.wait(20) and answers(page)
    page._reasons._work = lambda *_: None


def test_an_allowance_is_used_up_and_comes_back() -> None:
    now_s = [0.0]
    allowance = Allowance(rate_hz=10.0, most=20.0, now_s=lambda: now_s[0])
    assert all(allowance.take(1) for _ in range(20)) and not allowance.take(1)
    now_s[0] = 0.5
    assert not allowance.take(6) and allowance.take(5) and not allowance.take(1)
    now_s[0] = 1000.0
    assert not allowance.take(21) and allowance.take(20)


def test_of_much_work_the_newest_is_done_and_a_fault_ends_nothing() -> None:
    done: list[int] = []
    begun, go_on = threading.Event(), threading.Event()

    def work(number: int) -> None:
        begun.set()
        go_on.wait(20)
        done.append(number)
        if number == 0:
            raise ValueError("a fault")

    newest = Newest(work)
    newest.ask(0)
    assert begun.wait(20)
    for number in range(1, 100):
        newest.ask(number)
    go_on.set()
    until(lambda: done == [0, 99])
    newest.close()
    newest._thread.join(20)
    assert not newest._thread.is_alive()
