"""Certificates that come with the package: one for every registered plant and contract, and none for another."""

import json
from dataclasses import replace
from itertools import count

import gymnasium as gym
import numpy as np
import pytest

import shields.packaged_certificates
from ncs_gym import ChannelContract, contract_of
from ncs_gym.network.downlink import downlink_protocol
from ncs_gym.registration import ENVIRONMENTS
from shields import CertificateError, certificate_for
from shields.packaged_certificates import certificate_of_package
from shields.synthesis.invariant_polytope import share_in_polytope
from shields.verification import require_valid, verifier
from tests.certificates import certificate_of
from tests.plants import named, small
from tests.product import altered, safety_shield, synthesize
from tests.verdicts import verified

UNASKED = count(1)
IDS = [env_id for env_id, each in ENVIRONMENTS.items() if each.plant is not None]


def plant_and_contract(env_id):
    """What an environment is made with, which its process need not be installed for."""
    factory = ENVIRONMENTS[env_id]
    plant = factory.plant()
    contract = factory.contract or contract_of(factory.channel)
    if plant.spectral_radius < 1.0 and factory.contract is None:
        contract = None
    return plant, downlink_protocol(factory.downlink, None).behind(contract)


@pytest.fixture
def calls(monkeypatch):
    """Arguments of each synthesis."""
    seen, made = [], certificate_of(*named("stable"))

    def synthesize(*given, progress, **settings):
        seen.append(given)
        for stage in ("initial designs", "volume"):
            progress(stage)
        return made

    monkeypatch.setattr("shields.synthesis.synthesize", synthesize)
    return seen


@pytest.fixture
def unasked(tmp_path, monkeypatch):
    """A plant that this process has asked for no certificate of; a folder of certificates that the package reads."""
    monkeypatch.setattr(shields.packaged_certificates, "__file__", str(tmp_path / "__init__.py"))
    plant = small([[0.9, 0.1], [0.0, 0.8]], delta=0.05 * (1.0 + 1e-6 * next(UNASKED)))  # bounds are smaller then
    certificate = certificate_of(*named("stable"), "polytope")
    return plant, replace(certificate, fingerprint=plant.fingerprint), tmp_path / "own.json"


@pytest.mark.cases(4)
@pytest.mark.parametrize("env_id", IDS)
def test_every_id_has_a_verified_certificate(env_id):
    plant, contract = plant_and_contract(env_id)
    certificate = certificate_of_package(plant, contract)
    assert certificate.contract == contract
    assert verified(certificate, plant).valid
    if ENVIRONMENTS[env_id].is_installed:
        env = gym.make(env_id).unwrapped
        assert (env.plant.fingerprint, env.certificate_contract) == (plant.fingerprint, contract)


@pytest.mark.slow
@pytest.mark.parametrize("env_id", IDS)
def test_synthesis_gives_sets_as_large_as_those_that_come_with_the_package(env_id):
    # As large an ellipsoid. Many gains keep nearly the same one, which differ in their polytopes by a hundredth.
    plant, contract = plant_and_contract(env_id)
    kept, made = certificate_of_package(plant, contract), synthesize(plant, contract=contract)
    alone = synthesize(plant, contract=contract, safe_set="ellipsoid")
    for found, packed in ((made, kept), (alone, certificate_of_package(plant, contract, "ellipsoid"))):
        assert verified(found, plant).valid
        assert (found.contract, found.fingerprint) == (packed.contract, packed.fingerprint)
    volumes = [np.linalg.slogdet(each.safe_set.shape_matrix)[1] for each in (alone, packed)]
    assert volumes[0] >= volumes[1] - 1e-3
    assert share_in_polytope(made.safe_set, plant) >= 0.98 * share_in_polytope(kept.safe_set, plant)


def test_certificate_of_the_package_is_taken_and_nothing_synthesized(calls, unasked):
    plant, certificate, file = unasked
    ellipsoid = replace(certificate_of(*named("stable")), fingerprint=plant.fingerprint)
    for each, path in ((certificate, file), (ellipsoid, file.with_name("own.ellipsoid.json"))):
        each.save(path)
    assert [certificate_for(plant, None, kind) for kind in ("polytope", "ellipsoid")] == [certificate, ellipsoid]
    assert not calls


def test_shield_of_a_registered_id_synthesizes_nothing(calls):
    one, other = (safety_shield(gym.make("ncs_gym/CartPole-v0")) for _ in range(2))
    assert one.certificate is other.certificate
    assert not calls


def test_other_plants_and_contracts_are_synthesized_once_and_that_is_said(calls, capfd):
    plant, contract = plant_and_contract("ncs_gym/CartPole-v0")
    assert certificate_for(plant, contract).contract == contract
    assert capfd.readouterr().err == ""
    unasked = altered(plant, delta=0.04 * (1.0 + 1e-6 * next(UNASKED)))
    for changed in [(unasked, ChannelContract(2)), (unasked, contract), (unasked, None)]:
        assert certificate_for(*changed) is certificate_for(*changed)
        assert calls.pop() == changed[:1]
        assert not calls
        assert capfd.readouterr().err == "synthesizing a certificate, which takes seconds to minutes\n"


def test_damaged_file_of_the_package_is_refused(unasked):
    plant, certificate, file = unasked
    document = certificate.document
    document["certificate"]["K"][0][0] += 1e-9
    file.write_text(json.dumps(document))
    with pytest.raises(CertificateError, match="was altered"):
        certificate_for(plant)


def test_what_has_verified_is_not_verified_again_and_what_is_changed_is(monkeypatch, unasked):
    plant, certificate, _ = unasked
    plant = altered(plant, gamma=(1.0 - 1e-9) * plant.gamma)  # with which the certificate still verifies
    certificate = replace(certificate, fingerprint=plant.fingerprint)
    judged, verify = [], verifier.verify
    monkeypatch.setattr(verifier, "verify", lambda *given: judged.append(given) or verify(*given))
    for _ in range(3):
        require_valid(certificate, altered(plant))
    assert len(judged) == 1
    larger = replace(certificate, D=0.5 * certificate.D)
    for _ in range(2):  # what does not verify is not remembered
        with pytest.raises(CertificateError, match="does not verify"):
            require_valid(larger, plant)
    with pytest.raises(CertificateError, match="another plant"):
        require_valid(certificate, altered(plant, delta=0.04))
    assert len(judged) == 4
    worn = altered(plant)
    assert worn.fingerprint == plant.fingerprint
    object.__setattr__(worn, "box", 100.0 * worn.box)  # as nobody should, after the fingerprint was computed
    with pytest.raises(CertificateError):
        require_valid(certificate, worn)
