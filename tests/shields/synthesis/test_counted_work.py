"""The search ends by counted work, whatever the processor, or by its user's time limit with the best so far."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from experiments.commands.synthesize import SynthesizeSettings
from experiments.commands.synthesize import synthesize as run_command
from ncs_gym import ChannelContract
from shields import Infeasible, verify
from shields.polytope import Polytope
from shields.synthesis import certification, ellipsoid_certificates, invariant_polytope
from tests.product import linear_plant, synthesize
from tests.verdicts import verified


class Processor:
    """Its time goes on by some seconds whenever somebody asks for it."""

    def __init__(self, step):
        self.now, self.step = 0.0, step

    def __call__(self):
        self.now += self.step
        return self.now


def test_set_that_fails_the_exact_check_is_not_sought_again_and_a_polytope_is(loaded, monkeypatch):
    def strict(certificate, plant):
        return verify(replace(certificate, K=100.0 * certificate.K), plant)

    monkeypatch.setattr(ellipsoid_certificates, "verify", strict)
    lines = []
    found = synthesize(loaded, progress=lines.append)
    assert isinstance(found.safe_set, Polytope)
    assert sum(line.startswith("initial design") for line in lines) == 1
    assert verified(found, loaded).valid
    with pytest.raises(Infeasible, match=r"but in exact arithmetic .* fails by"):
        synthesize(loaded, safe_set="ellipsoid")


def test_few_gains_whose_polytopes_have_too_many_rows_end_the_search(monkeypatch):
    plant = linear_plant(
        A=[[0.9, 0.3], [-0.3, 0.9]], B=[[0.0], [0.1]], dt=0.1, state_limits=([-0.9, -0.8], [1.1, 1.2]), u_max=1.0,
        disturbance_bound=1e-3, sensor_bound=1e-3, initial_bound=1e-3,
    )  # fmt: skip
    monkeypatch.setattr(invariant_polytope, "MOST_ROWS", 3)
    lines = []
    with pytest.raises(Infeasible, match="more than 3 rows"):
        synthesize(plant, contract=ChannelContract(1), progress=lines.append)
    assert sum("more than 3 rows" in line for line in lines) == 5 * len(invariant_polytope.MARGINS)


def test_best_certificate_in_time_is_verified_and_says_that_the_time_was_over(loaded, monkeypatch):
    monkeypatch.setattr(certification.time, "thread_time", Processor(1.0))
    certificate = synthesize(loaded, time_limit=3.0)
    assert verified(certificate, loaded).valid
    told = "the synthesis was stopped at initial design, when the time_limit of 3 s was over: other sets may be"
    assert told in " ".join(str(certificate).split())


def test_command_ends_after_a_minute_of_work(loaded, monkeypatch, tmp_path, capsys):
    loaded.save(tmp_path / "plant.json")
    monkeypatch.setattr(certification.time, "thread_time", Processor(20.0))
    run_command(SynthesizeSettings(plant=tmp_path / "plant.json", out=tmp_path / "certificate.json"))
    assert "the time_limit of 60 s was over" in " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize("limit", [0.0, -1.0, np.nan, "long"])
def test_time_limit_that_is_none_is_refused(loaded, limit):
    with pytest.raises(ValueError, match="time_limit must be"):
        synthesize(loaded, time_limit=limit)
