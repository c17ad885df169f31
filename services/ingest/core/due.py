"""Which frames of a stream are worth decoding (pure)."""

from prior_sg.services.ingest.core import selection
from prior_sg.services.ingest.core.config import Config
from prior_sg.services.ingest.core.frames import View


class Due:
    """Whether a frame may become a keyframe of its camera, so that its images are worth decoding."""

    def __init__(self, cfg: Config) -> None:
        self._cfg = cfg
        self._newest: dict[str, View] = {}  # by camera
        self._before: dict[str, View] = {}  # what was the newest before the last one that was due

    def __call__(self, view: View) -> bool:
        if not selection.due(self._newest.get(view.camera), view, self._cfg):
            return False
        self._before = dict(self._newest)
        self._newest[view.camera] = view
        return True

    def failed(self) -> None:
        """The newest one that was due cannot become one: the next may."""
        self._newest = dict(self._before)
