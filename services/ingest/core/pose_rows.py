"""Lines of stamped poses as somebody writes them while they are read (pure)."""

from decimal import Decimal, InvalidOperation

from prior_sg.services.ingest.core.ros.transforms import Stamped

NS_PER = {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1}
DATED = ((10**17, "ns"), (10**14, "us"), (10**11, "ms"))  # stamps from here on, since 1970, are of this unit
FIELDS = 8


def row_of(line: str, unit: str = "", order: str = "xyzw") -> Stamped | None:
    """The pose of a line `stamp tx ty tz` and a quaternion in the order xyzw or wxyz; None for a comment.

    The unit of the stamp is s, ms, us or ns, or empty: told by its size, as since 1970. Raises ValueError with one
    sentence.
    """
    words = line.replace(",", " ").replace(";", " ").split()
    if not words or words[0].startswith("#"):
        return None
    if len(words) != FIELDS:
        raise ValueError(f"a line has {len(words)} words, not the eight of stamp tx ty tz qx qy qz qw")
    try:
        stamp, numbers = Decimal(words[0]), [float(word) for word in words[1:]]
        told = unit or next((name for least, name in DATED if stamp >= least), "s")
        stamp_ns = int(stamp * NS_PER[told])
    except (InvalidOperation, ValueError, OverflowError) as error:
        raise ValueError("a line has words that are no numbers") from error
    x_m, y_m, z_m = numbers[:3]
    qx, qy, qz, qw = numbers[3:] if order != "wxyz" else (*numbers[4:], numbers[3])
    row = Stamped(stamp_ns, "", "", (x_m, y_m, z_m), (qx, qy, qz, qw))
    if not row.is_motion() or abs(stamp_ns) >= 2**63:
        raise ValueError("a line has numbers that are no rigid motion")
    return row
