"""The JSON of irtt."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np

from ncs_gym.network.log_formats.record import WAY_AND_BACK, Record
from ncs_gym.reading import json_values, require_packets
from ncs_gym.validation import reason_of, shown


def of_json(text: str) -> Record:
    """Returns the round trips of irtt; that of iperf3 has counts of packets, but no times."""
    try:
        document = json_values(text)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"it is no JSON document that can be read: {reason_of(error)}") from None
    trips = document.get("round_trips") if isinstance(document, dict) else None
    if isinstance(trips, list):
        return _of_irtt(trips)
    if isinstance(document, dict) and {"intervals", "start"} <= document.keys():
        raise ValueError(
            "iperf3 counts packets per interval and records no times, from which no age follows: record with irtt, or "
            "with ping -D"
        )
    keys = shown([*document])[1:-1] if isinstance(document, dict) else "no names"
    raise ValueError(f"it is JSON with {keys}; of JSON documents only those of irtt are read (round_trips)")


def _of_irtt(trips: list[Any]) -> Record:
    """Returns the packets of irtt, by its monotonic clock if it has one [ns]."""
    sent, delays = [], []
    for number, trip in enumerate(trips):
        try:
            moments = trip["timestamps"]["client"]["send"]
            moment = moments.get("monotonic", moments.get("wall"))
            lost = trip["lost"] not in ("false", False)
            delay = np.nan if lost else trip["delay"]["rtt"] / 1e9
            if not (abs(int(moment)) < 2**63 and (lost or 0.0 <= delay < np.inf)):
                raise ValueError("out of range")
            sent.append(int(moment))
            delays.append(float(delay))
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError):
            raise ValueError(f"round trip {number} of irtt has no time sent, or neither a delay nor a loss") from None
    if len(sent) < 2:
        raise ValueError("a log needs at least two packets, each with the time at which it was sent")
    require_packets(len(sent))
    for number, (before, after) in enumerate(itertools.pairwise(sent), 1):
        if after < before:
            raise ValueError(
                f"round trip {number} of irtt: the clock was set back by {(before - after) / 1e9:g} s, cut the "
                "record there"
            )
    moments = np.array([(each - sent[0]) / 1e9 for each in sent])
    return Record(moments, np.array(delays), f"Read as the JSON of irtt: {WAY_AND_BACK}.")
