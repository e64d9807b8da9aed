"""Plants of textbooks, toolboxes and standards, as their authors would write the first call (tests/data)."""

from __future__ import annotations

import json
import time
from pathlib import Path

import pytest

from ncs_gym import ChannelContract, LinearPlant
from shields import Infeasible
from tests.product import sampled_plant, synthesize
from tests.verdicts import verified

# Each has its source, what is invented of it, its model, what else describes the plant, and the age that its network
# promises.
CALLS = json.loads((Path(__file__).parents[2] / "data" / "first_calls.json").read_text())
# Which are refused, and why.
REFUSED = {"zone_22": r"those that bind: 20 <= air <= 24 .*radii shrink to"}
QUICK = ("cstr_mathworks", "buck_geyer")
# A first call takes so long at most [s of the processor].
LONGEST = 60.0


def plant_of_call(name: str) -> LinearPlant:
    given = CALLS[name]
    return sampled_plant(tuple(given["model"]), given["dt"], **given["arguments"])


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if name in QUICK else pytest.mark.slow) for name in CALLS]
)
def test_first_call_is_accepted_or_refused_with_what_helps(name):
    plant, contract, began = plant_of_call(name), ChannelContract(CALLS[name]["max_age"]), time.thread_time()
    if name in REFUSED:
        with pytest.raises(Infeasible, match=REFUSED[name]):
            synthesize(plant, contract=contract)
    else:
        found = synthesize(plant, contract=contract)
    assert time.thread_time() - began < LONGEST
    if name not in REFUSED:
        assert verified(found, plant).valid
