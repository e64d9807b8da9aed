"""Proofs by age of the newest sample: one for each, the margins of floating point, and files that say one thing."""

from dataclasses import replace

import numpy as np
import pytest

from ncs_gym import ChannelContract
from ncs_gym.plants.library import batch_reactor
from shields import Certificate, CertificateError
from shields.documents import document_of, write_document
from tests.certificates import certificate_of, with_proof


@pytest.fixture(scope="module")
def promised():
    plant, contract = batch_reactor(), ChannelContract(2, 1e-3)
    return plant, certificate_of(plant, contract=contract)


def updates(certificate, **change):
    return replace(certificate, updates=replace(certificate.updates, **change))


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
    write_document(path, document_of("certificate", "ncs-gym certificate 5", content))
    assert Certificate.load(path) == certificate
    change(content)
    write_document(path, document_of("certificate", "ncs-gym certificate 5", content))
    with pytest.raises(CertificateError, match="wrong kind"):
        Certificate.load(path)
