"""A file of layout 5, as the program that wrote it left it."""

import sqlite3
from pathlib import Path

HERE = Path(__file__).parent
SCENE = HERE / "layout5-spot.msgpack"  # what that program answered


def write_layout_5(path, *statements):
    """The file; further statements turn it into one of an older layout."""
    with sqlite3.connect(path) as sql:
        sql.executescript((HERE / "layout5.sql").read_text())
        for statement in statements:
            sql.execute(statement)
