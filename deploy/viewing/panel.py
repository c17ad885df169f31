"""The page's controls: what is written and asked beside the map."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import viser

from prior_sg.deploy.viewing.search import MOST_ANSWERS
from prior_sg.deploy.viewing.stage import LAYERS
from prior_sg.deploy.viewing.words import note
from prior_sg.schemas.levels import LevelNode

LOWEST_CUT_M, HIGHEST_CUT_M, CUT_M = 0.4, 6.0, 1.6  # of map points over the floor: by default, ceilings are off


@dataclass
class Asked:
    """What the page is to do when somebody uses a control."""

    task: Callable[[str, str], None]
    search: Callable[[str], None]
    moment: Callable[[int], None]
    follow: Callable[[], None]
    play: Callable[[], None]
    layer: Callable[[str, bool], None]
    cut: Callable[[float], None]
    floor: Callable[[int | None], None]  # its id; None = all
    frame: Callable[[viser.ClientHandle], None]
    answer: Callable[[int], None]  # the way to one of the answers, by its row
    picked: Callable[[], None]  # the way to what was clicked
    start: Callable[[], None]  # ways begin at what was clicked
    robot: Callable[[], None]  # ways begin at the robot again
    arrive: Callable[[], None]  # no way any longer
    forget: Callable[[], None]


WAY_THERE, START_HERE, CLOSE = "Way there", "Start here", "Close"
FROM_ROBOT, CLOSE_WAY = "From the robot", "Close way"
WAY_TO = "Way to"
ALL_FLOORS = "all"


@dataclass
class Panel:
    """The controls of one page, the same for everybody who looks at it."""

    server: viser.ViserServer
    asked: Asked
    live: bool
    _html: dict[str, Any] = field(default_factory=dict)
    _buttons: dict[str, tuple[Any, tuple[str, ...]]] = field(default_factory=dict)  # below a text, and all there may be
    _moment_count: int = 0
    _floors: dict[str, int] = field(default_factory=dict)  # ids by what the choice says
    _setting: bool = False  # values that the page itself sets ask for nothing

    def build(self) -> None:
        """Put all controls in their places."""
        gui = self.server.gui
        gui.set_panel_label("Prior-SG")
        self._html["headline"] = gui.add_html("")
        self._add("way", "", {CLOSE_WAY: self.asked.arrive, FROM_ROBOT: self.asked.robot})
        self._add(
            "selected", "", {WAY_THERE: self.asked.picked, START_HERE: self.asked.start, CLOSE: self.asked.forget}
        )
        tabs = gui.add_tab_group()
        with tabs.add_tab("Map", viser.Icon.MAP_2):
            self._build_map()
        with tabs.add_tab("Layers", viser.Icon.STACK_2):
            self._build_layers()
        with tabs.add_tab("Prior", viser.Icon.TOPOLOGY_STAR_3):
            self._html["prior"] = gui.add_html(note("no prior yet: it comes with a task"))
        if self.live:
            with tabs.add_tab("Health", viser.Icon.HEARTBEAT):
                self._html["health"] = gui.add_html(note("asking"))

    def _add(self, where: str, label: str, does: dict[str, Callable[[], None]]) -> None:
        """A text that is there at times, with its buttons."""
        self._html[where] = self.server.gui.add_html("", visible=False)
        buttons = self.server.gui.add_button_group(label, tuple(does), visible=False)
        buttons.on_click(lambda event: does[event.target.value]())
        self._buttons[where] = buttons, tuple(does)

    def _build_map(self) -> None:
        gui = self.server.gui
        self._search = gui.add_text("Find", "", hint="Regions and objects, for example: bed")
        self._search.on_update(lambda _: self.asked.search(self._search.value))
        rows = range(MOST_ANSWERS)
        self._add("answers", WAY_TO, {str(row + 1): partial(self.asked.answer, row) for row in rows})
        if self.live:
            with gui.add_form(None) as form:
                self._task = gui.add_text("Task", "", hint="What the robot is to do, in plain words")
                self._environment = gui.add_text("Place", "", hint="What kind of place it is; empty = as it is")
                self._give = gui.add_button("Divide the map anew", icon=viser.Icon.SPARKLES)
            self._give.on_click(lambda _: form.submit())
            form.on_submit(lambda _: self.asked.task(self._task.value, self._environment.value))
        self._floor = gui.add_dropdown("Floor", (ALL_FLOORS,), visible=False, hint="one storey instead of all")
        self._floor.on_update(self._storey_chosen)
        self._html["told"] = gui.add_html("", visible=False)
        self._html["legend"] = gui.add_html("")
        self._html["moment"] = gui.add_html("")
        self._slider = gui.add_slider("Time", min=0, max=1, step=1, initial_value=0, disabled=True)
        self._slider.on_update(self._moved)
        self._play = gui.add_button_group("", ("Play", "Follow" if self.live else "End"))
        self._play.on_click(lambda _: self.asked.play() if self._play.value == "Play" else self.asked.follow())

    def _storey_chosen(self, event: viser.GuiEvent) -> None:
        if event.client is not None:
            self.asked.floor(self._floors.get(self._floor.value))

    def _moved(self, event: viser.GuiEvent) -> None:
        if event.client is not None and not self._setting:
            self.asked.moment(int(self._slider.value))

    def _build_layers(self) -> None:
        gui = self.server.gui
        for layer in LAYERS:
            box = gui.add_checkbox(layer.title, layer.shown)
            box.on_update(partial(self._switched, layer.name))
        cut = gui.add_slider(
            "Cut at", min=LOWEST_CUT_M, max=HIGHEST_CUT_M, step=0.1, initial_value=CUT_M, hint="metres over the floor"
        )
        cut.on_update(lambda _: self.asked.cut(cut.value))
        gui.add_button("Show the whole map", icon=viser.Icon.FOCUS_CENTERED).on_click(self._framed)

    def _switched(self, layer: str, event: viser.GuiEvent) -> None:
        self.asked.layer(layer, bool(event.target.value))

    def _framed(self, event: viser.GuiEvent) -> None:
        if event.client is not None:
            self.asked.frame(event.client)

    def write(self, where: str, html: str, offered: tuple[str, ...] | None = None) -> None:
        """Change one text; an empty one takes no room, nor do its buttons, of which all are there unless some are
        `offered`."""
        if where not in self._html:
            return
        handle = self._html[where]
        if handle.content != html:
            handle.content = html
        if handle.visible != bool(html):
            handle.visible = bool(html)
        if where in self._buttons:
            buttons, all_of_them = self._buttons[where]
            self._offer(buttons, (all_of_them if offered is None else offered) if html else ())

    def _offer(self, buttons: Any, options: tuple[str, ...]) -> None:
        if options and buttons.options != options:
            buttons.options = options
        if buttons.visible != bool(options):
            buttons.visible = bool(options)

    def text(self, where: str) -> str:
        """What is written there, as HTML."""
        return str(self._html[where].content)

    def set_moments(self, count: int, moment: int) -> None:
        """How far back the map can be shown, and where it is."""
        self._setting = True
        if count != self._moment_count and count > 1:
            self._slider.max, self._slider.disabled = count - 1, False
            self._moment_count = count
        if self._slider.value != moment and count > 1:
            self._slider.value = moment  # type: ignore[misc]  # its setter lies in a base class
        self._setting = False

    def offer_floors(self, floors: list[LevelNode]) -> None:
        """Which floors can be shown alone, from below; there is no choice where there are not several."""
        told = {f"{node.label}, {node.area_m2:.0f} m²": node.id for node in floors} if len(floors) > 1 else {}
        if told == self._floors:
            return
        chosen = self._floors.get(self._floor.value)
        self._floors = told
        self._floor.options = ALL_FLOORS, *told
        self._floor.visible = bool(told)
        self._floor.value = next(  # type: ignore[misc]  # its setter lies in a base class
            (text for text, number in told.items() if number == chosen), ALL_FLOORS
        )

    def busy(self, on: bool) -> None:
        """Whether a task is being worked on."""
        if self.live:
            self._give.disabled = on
