"""Writes a synthetic record with the shape of a Wi-Fi's, of which `ncs channel packets.csv` says how often it stalls.

For two hours a packet is sent every 20 ms. Two in a hundred are lost at random; besides there are stalls, which come in
clusters and whose lengths have a heavy tail. In a stall half of the packets are lost, and the others wait for its end.

Takes about two seconds on one core.
"""

from __future__ import annotations

import argparse

import numpy as np

PERIOD, SPAN = 0.02, 7200.0  # [s]


def main() -> None:
    """Writes the record into the file that is named, packets.csv by default."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("path", nargs="?", default="packets.csv", help="file of the record (%(default)s)")
    path = parser.parse_args().path
    rng = np.random.default_rng(0)
    sent = PERIOD * np.arange(round(SPAN / PERIOD))
    received = sent + rng.gamma(4.0, 0.002, len(sent))
    lost = rng.random(len(sent)) < 0.02
    stalls = 0
    for cluster in rng.uniform(0.0, SPAN, 14):
        for begin in cluster + np.cumsum(rng.exponential(8.0, rng.integers(1, 12))):
            end = begin + 0.06 * (1.0 + rng.pareto(1.2))
            stalled = (sent >= begin) & (sent < end)
            lost |= stalled & (rng.random(len(sent)) < 0.5)
            received[stalled] = np.maximum(received[stalled], end)
            stalls += 1
    times = zip(sent.tolist(), received.tolist(), lost.tolist(), strict=True)
    rows = [f"{a:.2f},{'' if gone else format(b, '.5f')}" for a, b, gone in times]
    with open(path, "w", encoding="utf-8") as file:
        file.write("sent,received\n" + "\n".join(rows) + "\n")
    print(f"{path}: {len(sent):,} packets, {stalls} stalls in 14 clusters")


if __name__ == "__main__":
    main()
