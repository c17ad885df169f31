"""`python -m prior_sg.deploy.benches.doors URL`: requests a second of a running HTTP interface while others follow its
changes. Start `prior-sg up --api` with a source before; prints one JSON object.
"""

import argparse
import asyncio
import itertools
import json
import time
from collections.abc import Sequence
from typing import Any

import httpx
import numpy as np

FOLLOWERS, ASKING, SECONDS = 50, 4, 20.0
ADDRESSES = ("scene", "regions", "near?x=1&y=1&z=1&k=5", "route?from=1,1,1&to=5,5,1", "scene.txt")
SEARCH = ("search?q=kitchen",)  # waits for an encoder: asked by a client of its own


async def measure(url: str, robot: str, followers: int, asking: int, seconds: float) -> dict[str, Any]:
    """Followers read events while `asking` clients go through the addresses in turn, and one more searches."""
    end_s = time.monotonic() + seconds
    limits = httpx.Limits(max_connections=followers + asking + 1)
    async with httpx.AsyncClient(base_url=f"{url}/v1/{robot}/", limits=limits, timeout=30.0) as client:
        events, requests = await asyncio.gather(
            asyncio.gather(*(_follow(client, end_s) for _ in range(followers))),
            asyncio.gather(*(_ask(client, end_s, ADDRESSES) for _ in range(asking)), _ask(client, end_s, SEARCH)),
        )
    asked = list(itertools.chain.from_iterable(requests))
    statuses = sorted({status for _, status, _ in asked})
    spent_ms = {address: [1e3 * took for one, _, took in asked if one == address] for address in ADDRESSES + SEARCH}
    return {
        "requests_per_s": len(asked) / seconds,
        "statuses": statuses,
        "events_per_follower": {"least": min(events, default=0), "most": max(events, default=0)},
        "ms_p50_p99": {address: np.percentile(took, [50, 99]).tolist() for address, took in spent_ms.items() if took},
    }


async def _follow(client: httpx.AsyncClient, end_s: float) -> int:
    """How many events came."""
    count = 0
    try:
        async with asyncio.timeout(end_s - time.monotonic()), client.stream("GET", "events") as reply:
            reply.raise_for_status()
            async for line in reply.aiter_lines():
                count += line.startswith("id:")
    except TimeoutError:
        pass
    return count


async def _ask(client: httpx.AsyncClient, end_s: float, addresses: Sequence[str]) -> list[tuple[str, int, float]]:
    """Address, status and seconds of each request."""
    asked: list[tuple[str, int, float]] = []
    for address in itertools.cycle(addresses):
        if time.monotonic() > end_s:
            return asked
        started_s = time.perf_counter()
        reply = await client.get(address)
        asked.append((address, reply.status_code, time.perf_counter() - started_s))
    return asked


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("url", help="such as http://127.0.0.1:8000")
    parser.add_argument("--robot", default="robot1")
    parser.add_argument("--followers", type=int, default=FOLLOWERS)
    parser.add_argument("--asking", type=int, default=ASKING)
    parser.add_argument("--seconds", type=float, default=SECONDS)
    given = parser.parse_args()
    found = asyncio.run(measure(given.url, given.robot, given.followers, given.asking, given.seconds))
    print(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
