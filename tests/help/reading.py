"""A message that has lived through three versions, for tests of what becomes of old ones."""

from typing import Annotated

import numpy as np

from prior_sg.schemas.codec import Message, Shape
from prior_sg.schemas.topics import Topic


class First:
    class Reading(Message, frozen=True, kw_only=True):
        robot: str
        distances_mm: Annotated[np.ndarray, Shape("int32", "beam")]


class Second:
    class Reading(Message, frozen=True, kw_only=True):
        VERSION = 2

        robot: str
        distances_m: Annotated[np.ndarray, Shape("float32", "beam")]


class Reading(Message, frozen=True, kw_only=True):
    VERSION = 3

    robot: str
    sensor: str
    distances_m: Annotated[np.ndarray, Shape("float32", "beam")]


def metres(data):
    return {"robot": data["robot"], "distances_m": (data["distances_mm"] / 1000).astype(np.float32)}


def named(data):
    return data | {"sensor": "front"}


MIGRATIONS = {("Reading", 1): metres, ("Reading", 2): named}
FIRST = First.Reading(robot="r", distances_mm=np.array([1500, 250], np.int32))
SECOND = Second.Reading(robot="r", distances_m=np.array([1.5, 0.25], np.float32))
THIRD = Reading(robot="r", sensor="front", distances_m=np.array([1.5, 0.25], np.float32))


def topic_of_version(kind):
    return Topic("READING", kind, "psg/{robot}/reading", "latest", 1, recorded=True)


READING = topic_of_version(Reading)
