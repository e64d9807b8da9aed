"""Long syntheses: what they say, and what an interrupted one leaves."""

from contextlib import nullcontext
from dataclasses import replace
from importlib import import_module

import numpy as np
import pytest

from experiments.commands.synthesize import SynthesizeSettings
from shields import Certificate
from shields.errors import SynthesisInterrupted
from tests.plants import random_plant
from tests.product import synthesize
from tests.verdicts import verified


def interrupting_at(stage):
    """A progress function that interrupts, as Ctrl-C would, at a stage."""

    def progress(line):
        if line.startswith(stage):
            raise KeyboardInterrupt

    return progress


def test_every_stage_says_what_is_sought_and_the_volume_reached(loaded):
    lines = []
    certificate = synthesize(loaded, safe_set="ellipsoid", progress=lines.append)
    assert lines[:2] == ["gains, and what they bear", "error set"]
    assert lines[2].startswith("initial design: ")
    assert any(line.startswith("alternation 1 of at most 40: ") for line in lines)
    volume = certificate.provenance["volume_of_box_ellipsoid"]
    assert lines[-1] == f"exact verification: {volume:.4f} of the box ellipsoid's volume"


@pytest.mark.parametrize("stage", ["initial design", "exact verification"])
def test_interrupted_synthesis_hands_out_the_best_certificate_so_far(loaded, stage):
    with pytest.raises(
        SynthesisInterrupted, match=f"interrupted: the synthesis was at {stage}.* of the safe box.s volume, "
    ) as caught:
        synthesize(loaded, progress=interrupting_at(stage))
    certificate = caught.value.certificate
    assert verified(certificate, loaded).valid
    assert certificate.provenance["interrupted_at"].startswith(stage)
    assert "other sets may be larger" in " ".join(str(certificate).split())
    assert isinstance(caught.value, KeyboardInterrupt)


def test_best_set_that_does_not_verify_is_not_handed_out(loaded, monkeypatch):
    finished = "shields.synthesis.ellipsoid_certificates.with_best_gain"
    monkeypatch.setattr(finished, lambda problem, design: replace(design, L=3.0 * design.L))
    with pytest.raises(SynthesisInterrupted, match="had no certificate yet") as caught:
        synthesize(loaded, progress=interrupting_at("alternation 1"))
    assert caught.value.certificate is None


def test_solution_of_the_program_meets_the_conditions():
    from shields.synthesis.design_problem import design_problem
    from shields.synthesis.invariant_set_program import InvariantSetProgram

    problem, _ = design_problem(random_plant(1, 4, 2))
    multipliers, inputs = (0.85, 0.045, 0.105), np.array([0.8, 0.7])
    design = InvariantSetProgram(problem, 1e-6).solve(multipliers, inputs, np.eye(4))
    (lx, le, ld), L, K, Sigma = multipliers, design.L, design.K, problem.error_shapes[0]
    closed, BK = problem.A + problem.B @ K, problem.B @ K
    rest = L - closed @ L @ closed.T / lx - BK @ Sigma @ BK.T / le - problem.D_u / ld
    assert np.linalg.eigvalsh(rest)[0] > -1e-7
    used = np.einsum("ij,jk,ik->i", K, L, K) / inputs + np.einsum("ij,jk,ik->i", K, Sigma, K) / (1.0 - inputs)
    assert used.max() <= 1.0
    assert (np.einsum("ij,jk,ik->i", problem.C, L, problem.C) <= 1.0).all()


def test_command_saves_the_best_certificate_when_it_is_interrupted(loaded, tmp_path, monkeypatch):
    loaded.save(tmp_path / "plant.json")
    command = import_module("experiments.commands.synthesize")
    monkeypatch.setattr(command, "synthesis_status", lambda: nullcontext(interrupting_at("exact verification")))
    with pytest.raises(SynthesisInterrupted, match=r"the best certificate so far, which verifies .* was saved to"):
        command.synthesize(SynthesizeSettings(plant=tmp_path / "plant.json", out=tmp_path / "c.json"))
    assert verified(Certificate.load(tmp_path / "c.json"), loaded).valid
