"""The live page: one thread draws what has changed, no faster than the link and the machine follow."""

import contextlib
import io
import logging
import threading
import time
from dataclasses import dataclass, field, replace

import numpy as np
import viser

from prior_sg.deploy.parts import floors_of, storey_of
from prior_sg.deploy.showing.prior import graph_svg
from prior_sg.deploy.viewing import search, ways, words
from prior_sg.deploy.viewing.drawing import DARK, LIGHT, Painter
from prior_sg.deploy.viewing.footprint import floor_m
from prior_sg.deploy.viewing.newest import Newest
from prior_sg.deploy.viewing.panel import CLOSE_WAY, CUT_M, FROM_ROBOT, Asked, Panel
from prior_sg.deploy.viewing.picking import Picked, PickedMarker, pick, typical_place
from prior_sg.deploy.viewing.search import NOTHING_KNOWN
from prior_sg.deploy.viewing.sources import Likeness, Source
from prior_sg.deploy.viewing.stage import SafeServer, Stage
from prior_sg.deploy.viewing.ways import FROM_THE_ROBOT, Trip, Way
from prior_sg.schemas.answers import Markers
from prior_sg.schemas.members import only_of_robots
from prior_sg.schemas.queries import MarkersOf, Spot
from prior_sg.schemas.regions import NO_REGION
from prior_sg.schemas.scene import Scene
from prior_sg.services.errors import PriorSgError
from prior_sg.services.scene_store.core.queries.answering import answer
from prior_sg.services.scene_store.core.queries.index import Index

log = logging.getLogger(__name__)
SHARE = 4.0  # drawing takes at most one part in so many of the time
PLAY_S, FRAME_S = 20.0, 0.1  # a whole history, and one step of it
HEALTH_S, POLL_S, TYPING_S = 5.0, 0.5, 0.5
MOST_CATCH_UP_S = 5.0
MOST_MEANINGS = 256  # of texts that are kept
DIVIDING = "the map is being divided for another task: wait for it"
START_CHOSEN = "ways start here: now search, or click where to, and ask for the way"


@dataclass(frozen=True)
class Options:
    """How the page is served."""

    host: str = "127.0.0.1"
    port: int = 8080
    dark: bool = True
    interval_s: float = 0.2  # between updates, at least
    max_mbit: float = 0.0  # per second to each viewer, on average; 0 = no limit


@dataclass
class Wanted:
    """What viewers have asked to see."""

    moment: int | None = None  # None = the newest
    text: str = ""  # searched for
    picked: Picked | PickedMarker | None = None
    goal: Spot | None = None  # the way there is shown
    start: Spot = FROM_THE_ROBOT
    cut_m: float = CUT_M
    floor: int | None = None  # id of the one that is shown; None = all
    playing: bool = False
    told: dict[str, str] = field(default_factory=dict)  # notes by part of the panel


class Page:
    """Serves one source until `close`."""

    def __init__(self, source: Source, options: Options) -> None:
        self._source, self._options = source, options
        self._painter = Painter(DARK if options.dark else LIGHT)
        self._wanted = Wanted()
        self._wake, self._closed = threading.Event(), threading.Event()
        self._index: Index | None = None  # of the scene that is shown, all of it
        self._drawn: tuple[Scene, int | None, Scene] | None = None  # a scene, the floor wanted, and what of it is drawn
        self._hits: list[search.Hit] = []
        self._meant: dict[tuple[str, str], Likeness] = {}  # by text and prior
        self._dividing = threading.Lock()  # one task at a time
        self._clicks, self._reasons = Newest(self._pick), Newest(self._explain)
        self._meanings = Newest(self._find_meaning)
        self.sent_bytes = 0
        self.server = SafeServer(options.host, options.port)
        self.server.gui.configure_theme(
            dark_mode=options.dark, show_logo=False, show_share_button=False, brand_color=(78, 121, 167)
        )
        self.stage = Stage(self.server, self._painter.theme)
        self.panel = Panel(self.server, self._asked(), source.live)
        self.panel.build()
        self.server.scene.on_click()(self._clicks.ask)
        self._threads = [
            threading.Thread(target=work, name=work.__name__, daemon=True)
            for work in (self._draw, self._watch, self._play, self._watch_health)
        ]
        for thread in self._threads:
            thread.start()

    @property
    def address(self) -> str:
        """Where browsers find it."""
        return f"http://{self._options.host}:{self.server.get_port()}"

    def close(self) -> None:
        """End the threads and the server."""
        self._closed.set()
        self._wake.set()
        for worker in (self._clicks, self._reasons, self._meanings):
            worker.close()
        for thread in self._threads:
            thread.join(2 * MOST_CATCH_UP_S)
        with contextlib.redirect_stdout(io.StringIO()):
            self.server.stop()

    def _asked(self) -> Asked:
        return Asked(
            task=self._give_task,
            search=self._search,
            moment=lambda moment: self._want(moment=moment, playing=False),
            follow=lambda: self._want(moment=None, playing=False),
            play=self._start_playing,
            layer=self.stage.switch,
            cut=lambda height: self._want(cut_m=height),
            floor=lambda floor: self._want(floor=floor),
            frame=self.stage.frame,
            answer=self._go_to_answer,
            picked=self._go_to_picked,
            start=self._start_at_picked,
            robot=lambda: self._want(start=FROM_THE_ROBOT),
            arrive=lambda: self._want(goal=None, start=FROM_THE_ROBOT),
            forget=lambda: self._want(picked=None),
        )

    def _want(self, **changes: object) -> None:
        for name, value in changes.items():
            setattr(self._wanted, name, value)
        self._wake.set()

    def _go_to_answer(self, row: int) -> None:
        if row < len(self._hits):
            self._want(goal=self._hits[row].spot)

    def _go_to_picked(self) -> None:
        if self._wanted.picked is not None:
            self._want(goal=self._wanted.picked.spot)

    def _start_at_picked(self) -> None:
        if self._wanted.picked is not None:
            self._want(start=self._wanted.picked.spot)

    def _search(self, text: str) -> None:
        """Words are compared at once; what they mean is asked when nobody has typed for a moment."""
        self._want(text=text, goal=None)
        self._meanings.ask(text)

    def _find_meaning(self, text: str) -> None:
        index = self._index
        if self._closed.wait(TYPING_S) or index is None or text != self._wanted.text or not text.strip():
            return
        scene = index.scene
        key = (text, scene.prior_digest)
        if key in self._meant:
            return
        try:
            meant = self._source.likeness(scene, text)
        except PriorSgError as error:
            meant = Likeness({}, {}, str(error))
        if len(self._meant) >= MOST_MEANINGS:
            del self._meant[next(iter(self._meant))]
        self._meant[key] = meant
        self._wake.set()

    def _draw(self) -> None:
        """Draw when something has changed; then wait as long as that took several times over, or the link needs."""
        while not self._closed.is_set():
            self._wake.wait()
            self._wake.clear()
            if self._closed.is_set():
                return
            since_s = time.monotonic()
            try:
                sent = self.refresh()
                self.panel.write("told", self._wanted.told.get("told", ""))
            except PriorSgError as error:
                sent = 0
                self.panel.write("told", words.note(str(error)))
            except Exception:  # a fault of ours: what comes next may be drawn
                sent = 0
                log.exception("the map was not drawn")
            took_s = time.monotonic() - since_s
            link_s = 8e-6 * sent / self._options.max_mbit if self._options.max_mbit else 0.0
            rest_s = max(self._options.interval_s - took_s, min((SHARE - 1) * took_s, MOST_CATCH_UP_S), link_s)
            self._closed.wait(rest_s)

    def refresh(self) -> int:
        """Bring the page up to date; about how many bytes that sent."""
        wanted, stamps = self._wanted, self._source.stamps()
        scene = self._source.scene(wanted.moment)
        index = self._index = Index(scene) if self._index is None or self._index.scene is not scene else self._index
        until_ns = scene.stamp_ns if wanted.moment is not None else np.inf
        found = search.find(index, wanted.text, self._meant.get((wanted.text, scene.prior_digest), NOTHING_KNOWN))
        picked = wanted.picked.region if isinstance(wanted.picked, Picked) else NO_REGION
        drawn = self._on_floor(scene)
        picture = self._painter.draw(drawn, replace(found.lit, picked=picked))
        ground_m = floor_m(drawn, np.arange(len(drawn.place_ids)))
        way = None if wanted.goal is None else ways.way(index, Trip(wanted.goal, wanted.start))
        if way is not None:
            picture |= ways.picture(way, self._painter.theme.way, self._painter.theme.ink)
        picture |= self._source.cloud.picture(ground_m + wanted.cut_m, until_ns)
        sent = self.stage.show(picture).nbytes
        self.stage.look(self._source.camera(until_ns))
        self._frame(drawn, ground_m)
        self._write(index, drawn, found, len(stamps))
        self.panel.offer_floors(floors_of(scene))
        self._tell_way(way)
        self.sent_bytes += sent
        return sent

    def _on_floor(self, scene: Scene) -> Scene:
        """What of a scene is drawn: all, or the floor wanted, as long as it is there."""
        wanted = self._wanted.floor
        if self._drawn is None or self._drawn[0] is not scene or self._drawn[1] != wanted:
            there = wanted in {node.id for node in floors_of(scene)}
            self._drawn = scene, wanted, storey_of(scene, wanted) if wanted is not None and there else scene
        return self._drawn[2]

    def _frame(self, scene: Scene, ground_m: float) -> None:
        if len(scene.place_ids):
            reach = scene.radii_m[:, None]
            low_m = (scene.positions_m - reach).min(axis=0)
            high_m = (scene.positions_m + reach).max(axis=0)
            low_m[2], high_m[2] = ground_m, min(high_m[2], ground_m + CUT_M)
            self.stage.set_bounds(low_m.astype(float), high_m.astype(float))

    def _write(self, index: Index, scene: Scene, found: search.Found, count: int) -> None:
        panel, wanted = self.panel, self._wanted
        panel.write("headline", words.headline(scene, self._source.title))
        panel.write("legend", words.legend(scene, self._painter.label_colors(scene)))
        self._hits = found.hits
        said = words.answers(found.hits) + (words.note(found.said) if found.said else "")
        panel.write("answers", said, tuple(str(row + 1) for row in range(len(found.hits))))
        panel.write("selected", self._selected(index, scene, wanted.picked))
        newest = max(count - 1, 0)
        moment = newest if wanted.moment is None else min(wanted.moment, newest)
        panel.set_moments(count, moment)
        panel.write("moment", words.note(_when(self._source.stamps(), moment)) if count > 1 else "")
        prior = self._source.prior(scene.prior_digest)
        if prior is not None:
            panel.write("prior", words.card(graph_svg(prior)))

    def _tell_way(self, way: Way | None) -> None:
        chosen = not self._wanted.start.here
        story = words.way_story(way) if way is not None else words.note(START_CHOSEN) if chosen else ""
        self.panel.write("way", story, (CLOSE_WAY, FROM_ROBOT) if chosen else (CLOSE_WAY,))

    def _selected(self, index: Index, scene: Scene, picked: Picked | PickedMarker | None) -> str:
        """The story of what was clicked, as far as it is there at this moment."""
        if picked is None:
            return ""
        if isinstance(picked, PickedMarker):
            found = answer(index, MarkersOf(id=picked.key.id, dictionary=picked.key.dictionary))
            printed = found.markers if isinstance(found, Markers) else []
            return words.marker_story(printed[0]) if printed else words.note("not there at this time")
        region = words.region_of(scene, picked.region)
        why = self._wanted.told.get("why", "")
        if picked.itself:
            there = picked.place in scene.place_ids
            return (words.place_story(scene, picked.place) if there else words.note("not there at this time")) + why
        return (words.region_story(scene, region) if region else words.note("not there at this time")) + why

    def _pick(self, event: viser.SceneClickEvent) -> None:
        if self._index is None:
            return
        scene = self._on_floor(self._index.scene)
        origin, direction = np.array(event.ray_origin), np.array(event.ray_direction)
        seen = {"dots": self.stage.is_on("places"), "markers": self.stage.is_on("markers")}
        picked = pick(scene, self._painter.ground(scene), origin, direction, **seen)
        self._wanted.told.pop("why", None)
        self._want(picked=picked)
        if isinstance(picked, Picked):
            self._reasons.ask(scene, picked)

    def _explain(self, scene: Scene, picked: Picked) -> None:
        """Ask for the votes of the place, or of one in the middle of the region."""

        def tell(html: str) -> None:
            if self._wanted.picked == picked:
                self._wanted.told["why"] = html
                self._wake.set()

        place = picked.place if picked.itself else typical_place(scene, picked.region)
        if place is None:
            return
        if scene.merged_of:
            tell(words.note(only_of_robots(scene.robot, scene.merged_of, "why a place carries its label")))
            return
        try:
            tell(words.explanation(self._source.explain(place, lambda text: tell(words.note(text)))))
        except PriorSgError as error:
            tell(words.note(str(error)))

    def _give_task(self, task: str, environment: str) -> None:
        def tell(text: str) -> None:
            self._wanted.told["told"] = words.note(text)
            self._wake.set()

        def work() -> None:
            try:
                tell(self._source.switch(task.strip(), environment.strip(), tell))
            except PriorSgError as error:
                tell(str(error))
            finally:
                self.panel.busy(False)
                self._dividing.release()

        if not task.strip():
            tell("write what the robot is to do")
        elif not self._dividing.acquire(blocking=False):
            tell(DIVIDING)
        else:
            self.panel.busy(True)
            tell("asking for the prior of this task")
            self._want(moment=None, playing=False)
            threading.Thread(target=work, name="task", daemon=True).start()

    def _start_playing(self) -> None:
        newest = len(self._source.stamps()) - 1
        if self._wanted.playing or newest < 1:
            self._want(playing=False)
            return
        at_end = self._wanted.moment is None or self._wanted.moment >= newest
        self._want(moment=0 if at_end else self._wanted.moment, playing=True)

    def _play(self) -> None:
        while not self._closed.wait(FRAME_S):
            wanted, newest = self._wanted, len(self._source.stamps()) - 1
            if not wanted.playing or wanted.moment is None:
                continue
            step = max(1, round(newest * FRAME_S / PLAY_S))
            done = wanted.moment + step >= newest
            self._want(moment=None if done else wanted.moment + step, playing=not done)

    def _watch(self) -> None:
        """Wake the drawing when the source has something new."""
        points = -1
        self._wake.set()
        while not self._closed.is_set():
            if self._source.wait(POLL_S) or len(self._source.cloud) != points:
                points = len(self._source.cloud)
                self._wake.set()

    def _watch_health(self) -> None:
        while self._source.live and not self._closed.is_set():
            try:
                self.panel.write("health", words.health_table(self._source.health()))
            except PriorSgError as error:
                self.panel.write("health", words.note(str(error)))
            self._closed.wait(HEALTH_S)


def _when(stamps: list[int], moment: int) -> str:
    """Where a moment lies in the history."""
    if moment >= len(stamps) - 1:
        return f"now, after {len(stamps)} changes"
    return f"change {moment + 1} of {len(stamps)}, {(stamps[-1] - stamps[moment]) * 1e-9:.1f} s before the newest"
