"""Proofs by age of the newest sample: one for each, the margins of floating point, and files that say one thing."""

from dataclasses import replace

import numpy as np
import pytest

from ncs_gym import ChannelContract
from ncs_gym.plants.library import batch_reactor
from shields import Certificate, CertificateError
from shields.documents import document_of, write_document
from tests.certificates import certificate_of, with_proof
from tests.product import library_plant
from tests.verdicts import verified


@pytest.fixture(scope="module")
def promised():
    plant, contract = batch_reactor(), ChannelContract(2, 1e-3)
    return plant, certificate_of(plant, contract=contract)


def updates(certificate, **change):
    return replace(certificate, updates=replace(certificate.updates, **change))


def test_margins_by_age_agree_with_floating_point(promised):
    plant, certificate = promised
    margins = {c.name.split(" ")[0] + c.name[-1]: [] for c in verified(certificate, plant).conditions}
    for condition in verified(certificate, plant).conditions:
        margins[condition.name.split(" ")[0] + condition.name[-1]].append(condition.margin)
    s, growth = certificate.updates, certificate.rounding
    shapes = [*certificate.error_shapes, s.last]
    smallest = lambda matrix: np.linalg.eigvalsh(matrix)[0]  # noqa: E731
    assert margins["(C0)0"] == [pytest.approx(smallest(shapes[0] - plant.initial_error.shape_matrix), rel=1e-6)]
    assert len(margins["(C1)0"]) == len(margins["(C2)0"]) == 3
    for j, found in enumerate(margins["(C1)0"]):
        grown = plant.A @ shapes[j] @ plant.A.T / certificate.proofs[j].rate + certificate.D / (
            1 - certificate.proofs[j].rate
        )
        assert found == pytest.approx(smallest(shapes[j + 1] - grown), rel=1e-4)
    for j, found in enumerate(margins["(C2)0"]):
        kept = np.eye(plant.n) - s.gains[j] @ plant.H
        updated = kept @ shapes[j + 1] @ kept.T / s.shares[j]
        updated += s.gains[j] @ s.noise @ s.gains[j].T / (1 - s.shares[j])
        assert found == pytest.approx(smallest(shapes[0] - updated), rel=1e-4)
    closed, gain = plant.A + plant.B @ certificate.K, plant.B @ certificate.K
    spread = plant.m * plant.B @ np.diag((plant.u_max * 2.0**-24) ** 2) @ plant.B.T
    D_u = (1 + growth) * certificate.D + (1 + 1 / growth) * spread
    for j, proof in enumerate(certificate.proofs):
        lx, le, ld = proof.shares
        grown = closed @ certificate.safe_set.shape_matrix @ closed.T / lx + gain @ shapes[j] @ gain.T / le + D_u / ld
        assert margins[f"(I){j}"] == [pytest.approx(smallest(certificate.safe_set.shape_matrix - grown), rel=1e-4)]
        for k, mu, limit, found in zip(certificate.K, proof.inputs, plant.u_max, margins[f"(U){j}"], strict=True):
            used = k @ certificate.safe_set.shape_matrix @ k / mu + k @ shapes[j] @ k / (1 - mu)
            assert found == pytest.approx((limit * (1 - 2.0**-24)) ** 2 - used, rel=1e-9)


@pytest.mark.parametrize(
    "change",
    [
        lambda c: replace(c, proofs=c.proofs[:2]),
        lambda c: replace(c, proofs=(*c.proofs, c.proofs[0])),
        lambda c: with_proof(c, 0, Sigma=np.eye(3)),
        lambda c: updates(c, last=np.eye(3)),
        lambda c: updates(c, shares=np.zeros(5)),
        lambda c: updates(c, gains=np.full((3, 4, 2), np.nan)),
        lambda c: updates(c, contract=ChannelContract(3)),
        lambda c: replace(c, updates=None),
    ],
)
def test_proof_by_age_that_does_not_fit_together_is_no_certificate(promised, change):
    _, certificate = promised
    with pytest.raises(CertificateError):
        change(certificate)


@pytest.mark.parametrize(
    "change",
    [
        lambda content: content.update(other=0.5),
        lambda content: content.update(rounding=0.5),
        lambda content: content["safe_set"].update(other=0.5),
        lambda content: content["errors"].update(other=[0.5]),
        lambda content: content["updates"].update(other=[0.5]),
        lambda content: content["updates"]["contract"].update(other=0.5),
    ],
)
def test_file_that_says_something_unknown_is_refused(promised, change, tmp_path):
    _, certificate = promised
    content = certificate.document["certificate"]
    path = tmp_path / "c.json"
    write_document(path, document_of("certificate", "ncs-gym certificate 4", content))
    assert Certificate.load(path) == certificate
    change(content)
    write_document(path, document_of("certificate", "ncs-gym certificate 4", content))
    with pytest.raises(CertificateError, match="wrong kind"):
        Certificate.load(path)


def test_certificate_for_other_outputs_does_not_fit(promised):
    _, certificate = promised
    other = library_plant(batch_reactor, H=np.eye(4), measurement_noise_cov=1e-6 * np.eye(4))
    report = verified(replace(certificate, fingerprint=other.fingerprint), other)
    assert not report.valid
    assert "shapes" in next(condition.name for condition in report.conditions if not condition.holds)
