"""Small plots as inline SVG."""

from collections.abc import Mapping, Sequence
from html import escape

from prior_sg.schemas.names import shown

Point = tuple[float, float]

WIDTH_PX, HEIGHT_PX, LEFT_PX, RIGHT_PX, TOP_PX, BOTTOM_PX = 430, 280, 46, 12, 14, 42
COLORS = ("#4e79a7", "#f28e2b", "#59a14f", "#e15759", "#b07aa1", "#3fb8af", "#9c755f", "#d0549b")
TICKS = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)


def line_plot(
    series: Mapping[str, Sequence[Point]],
    x_label: str,
    y_label: str,
    *,
    x_names: Sequence[str] = (),
    diagonal: bool = False,
) -> str:
    """Lines with dots over x in [0, 1], or over positions 0, 1, ... that `x_names` names; y in [0, 1].

    `diagonal` draws the line y = x.
    """
    last = max(len(x_names) - 1, 1) if x_names else 1
    parts = [_frame(x_label, y_label), *(_y_tick(y) for y in TICKS)]
    names = {index / last: name for index, name in enumerate(x_names)} or {x: f"{x:g}" for x in TICKS}
    parts += [_text(_x(x), HEIGHT_PX - BOTTOM_PX + 16, name, "middle") for x, name in names.items()]
    if diagonal:
        parts.append(_polyline([(0, 0), (1, 1)], "#b6bcc4", 'stroke-dasharray="4 4"'))
    for index, (name, points) in enumerate(series.items()):
        color = COLORS[index % len(COLORS)]
        scaled = [(x / last, y) for x, y in points]
        parts.append(_polyline(scaled, color))
        parts += [f'<circle cx="{_x(x):.1f}" cy="{_y(y):.1f}" r="3.5" fill="{color}"/>' for x, y in scaled]
        parts.append(_text(WIDTH_PX + 10, TOP_PX + 14 + 18 * index, name, "start", color))
    width = WIDTH_PX + 150
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{HEIGHT_PX}" '
        f'viewBox="0 0 {width} {HEIGHT_PX}" role="img" aria-label="{escape(y_label)} over {escape(x_label)}">'
        f"{''.join(parts)}</svg>"
    )


def _frame(x_label: str, y_label: str) -> str:
    middle = (TOP_PX + HEIGHT_PX - BOTTOM_PX) / 2
    return (
        f'<rect x="{LEFT_PX}" y="{TOP_PX}" width="{WIDTH_PX - LEFT_PX - RIGHT_PX}" '
        f'height="{HEIGHT_PX - TOP_PX - BOTTOM_PX}" fill="#fff" stroke="#d0d5db"/>'
        + _text((LEFT_PX + WIDTH_PX - RIGHT_PX) / 2, HEIGHT_PX - 8, x_label, "middle")
        + f'<g transform="translate(12 {middle}) rotate(-90)">{_text(0, 0, y_label, "middle")}</g>'
    )


def _y_tick(y: float) -> str:
    line = f'<line x1="{LEFT_PX}" x2="{WIDTH_PX - RIGHT_PX}" y1="{_y(y):.1f}" y2="{_y(y):.1f}" stroke="#eef0f3"/>'
    return line + _text(LEFT_PX - 6, _y(y) + 4, f"{y:g}", "end")


def _polyline(points: Sequence[Point], color: str, style: str = "") -> str:
    path = " ".join(f"{_x(x):.1f},{_y(y):.1f}" for x, y in points)
    return f'<polyline points="{path}" fill="none" stroke="{color}" stroke-width="2" {style}/>'


def _text(x: float, y: float, text: str, anchor: str, color: str = "#4b525c") -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" fill="{color}">{escape(shown(text))}</text>'


def _x(x: float) -> float:
    return LEFT_PX + x * (WIDTH_PX - LEFT_PX - RIGHT_PX)


def _y(y: float) -> float:
    return TOP_PX + (1 - y) * (HEIGHT_PX - TOP_PX - BOTTOM_PX)
