"""Maximum cliques of small graphs, nodes as bits of whole numbers (pure).

Branch and bound with greedy colouring as bound, after Tomita and Seki (2003), stopped after a number of branches: what
it has by then is a clique all the same, and `complete` tells whether a larger one could exist.
"""

from typing import NamedTuple

import numpy as np

MOST_BRANCHES = 4000


class Clique(NamedTuple):
    """Nodes that are all joined to each other."""

    nodes: list[int]
    complete: bool  # whether there is surely none larger


def maximum_clique(joined: np.ndarray, most_branches: int = MOST_BRANCHES) -> Clique:
    """The largest clique of a symmetric matrix (node, node) bool; its diagonal is left out."""
    count = len(joined)
    order = np.argsort(-joined.sum(axis=1), kind="stable")
    bits = [_as_bits(joined[node][order], row) for row, node in enumerate(order.tolist())]
    best: list[int] = []
    left = most_branches

    def grow(chosen: list[int], candidates: int) -> None:
        nonlocal best, left
        coloured = _coloured(candidates, bits)
        for node, colour in reversed(coloured):
            if len(chosen) + colour <= len(best) or left <= 0:
                return
            left -= 1
            inside = candidates & bits[node]
            if inside:
                grow([*chosen, node], inside)
            elif len(chosen) + 1 > len(best):
                best = [*chosen, node]
            candidates &= ~(1 << node)

    if count:
        grow([], (1 << count) - 1)
    return Clique(sorted(int(order[node]) for node in best), left > 0)


def _as_bits(row: np.ndarray, itself: int) -> int:
    packed = np.packbits(row, bitorder="little").tobytes()
    return int.from_bytes(packed, "little") & ~(1 << itself)


def _coloured(candidates: int, bits: list[int]) -> list[tuple[int, int]]:
    """Nodes by ascending colour: within the nodes up to one, no clique is larger than its colour."""
    found, colour = [], 0
    while candidates:
        colour += 1
        free = candidates
        while free:
            low = free & -free
            node = low.bit_length() - 1
            found.append((node, colour))
            candidates ^= low
            free &= ~(bits[node] | low)
    return found
