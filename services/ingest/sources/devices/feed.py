"""A thread that reads a camera and never waits for who uses its pictures: what is too much is lost, and counted."""

import threading
from collections import Counter, deque
from collections.abc import Callable

from prior_sg.services.ingest.core.ros.assembly import Fault
from prior_sg.services.ingest.sources.base import SourceError
from prior_sg.services.ingest.sources.devices.device import Capture, Device, DeviceGone

WAITING = 16  # captures
MOMENT_S, AGAIN_S = 0.1, 1.0
CAPTURES = "pictures of the camera"
BEHIND, BETWEEN = "the reader was behind", "the camera or its cable lost them"
GONE, NOT_BACK = "the camera is gone", "it is not back"


class CameraFeed:
    """Captures of one camera, the newest WAITING."""

    def __init__(self, open_device: Callable[[], Device]) -> None:
        """Opens the camera. Raises SourceError and ExtraMissing."""
        self._open, self.device = open_device, open_device()
        self._arrived = threading.Condition()
        self._waiting: deque[Capture] = deque(maxlen=WAITING)
        self._faults: Counter[Fault] = Counter()
        self._stop, self._ended = threading.Event(), False
        self._broken: Exception | None = None
        self._thread = threading.Thread(target=self._run, name="camera", daemon=True)
        self._thread.start()

    def take(self, timeout_s: float) -> tuple[list[Capture], Counter[Fault], bool]:
        """All that waits, what was lost and how often, and whether nothing more comes; waits for a capture."""
        with self._arrived:
            self._arrived.wait_for(lambda: self._waiting or self._ended, timeout_s)
            if self._broken is not None:
                raise self._broken
            captures, faults = list(self._waiting), self._faults
            self._waiting.clear()
            self._faults = Counter()
            return captures, faults, self._ended

    def close(self) -> None:
        """Let go of the camera."""
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        try:
            self._read()
        except Exception as error:  # whatever it is, whoever takes captures raises it
            with self._arrived:
                self._broken, self._ended = error, True
                self._arrived.notify()

    def _read(self) -> None:
        device: Device | None = self.device
        newest: int | None = None
        while not self._stop.is_set():
            if device is None:
                device, newest = self._again(), None
                continue
            try:
                capture = device.capture(MOMENT_S)
            except DeviceGone as gone:
                self._fault(Fault("cameras", str(gone), GONE))
                device.close()
                device = None
                continue
            if capture is not None:
                self._put(capture, newest)
                newest = capture.number
            elif device.ended:
                with self._arrived:
                    self._ended = True
                    self._arrived.notify()
                break
        if device is not None:
            device.close()

    def _again(self) -> Device | None:
        """The camera, when it is there again."""
        try:
            return self._open()
        except SourceError as error:
            self._fault(Fault("cameras", str(error), NOT_BACK))
            self._stop.wait(AGAIN_S)
            return None

    def _put(self, capture: Capture, newest: int | None) -> None:
        with self._arrived:
            if newest is not None and capture.number > newest + 1:
                self._faults[Fault(CAPTURES, BETWEEN)] += capture.number - newest - 1
            if len(self._waiting) == WAITING:
                self._faults[Fault(CAPTURES, BEHIND)] += 1
            self._waiting.append(capture)
            self._arrived.notify()

    def _fault(self, fault: Fault) -> None:
        with self._arrived:
            self._faults[fault] += 1
