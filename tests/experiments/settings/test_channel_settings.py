"""Periods that `ncs channel` cannot read a record by."""

from pathlib import Path

import pytest

from experiments.settings import ChannelSettings


@pytest.mark.parametrize("period", [0.0, -0.02, float("nan"), float("inf")])
def test_sampling_period_is_positive(period):
    with pytest.raises(ValueError, match="--sampling-period must be a number > 0"):
        ChannelSettings(file=Path("packets.csv"), sampling_period=period)
