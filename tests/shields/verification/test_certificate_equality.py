"""Certificates as values: equal if their files are; in words."""

from dataclasses import replace

import numpy as np
import pytest

from ncs_gym import Ellipsoid
from shields import Certificate
from tests.certificates import certificate_of, with_proof
from tests.plants import named
from tests.product import altered, synthesize


@pytest.fixture(scope="module")
def by_age():
    return certificate_of(*named("unstable"))


def test_what_is_loaded_equals_what_was_saved(certificate, by_age, tmp_path):
    for each in (certificate, by_age):
        each.save(tmp_path / "c.json")
        loaded = Certificate.load(tmp_path / "c.json")
        assert loaded == each
        assert hash(loaded) == hash(each)
        assert len({loaded, each}) == 1
    assert by_age != certificate
    assert certificate != "certificate"


def test_any_other_last_digit_makes_another_certificate(certificate, by_age):
    def moved(array, place=0):
        array = np.array(array)
        array.flat[place] = np.nextafter(array.flat[place], 1.0)
        return array

    larger = Ellipsoid(moved(certificate.safe_set.shape_matrix))
    assert replace(certificate, safe_set=larger) != certificate
    for name in ("K", "D"):
        assert replace(certificate, **{name: moved(getattr(certificate, name))}) != certificate, name
    for each in (certificate, by_age):
        for age, proof in enumerate(each.proofs):
            for name in ("Sigma", "rate", "shares", "inputs"):
                assert with_proof(each, age, **{name: moved(getattr(proof, name))}) != each, (age, name)
        assert replace(each, rounding=moved(each.rounding)) != each
    for name in ("last", "gains", "shares", "noise"):
        updates = replace(by_age.updates, **{name: moved(getattr(by_age.updates, name), -1)})
        assert replace(by_age, updates=updates) != by_age, name
    assert replace(certificate, fingerprint="0" * 64) != certificate


def test_tolerated_scale_is_one_that_some_certificate_exists_for(loaded, certificate):
    scale = certificate.provenance["tolerated_scale"]
    assert f"up to {scale:.2f} times those assumed" in " ".join(str(certificate).split())

    def scaled(factor):
        noises = loaded.process_noise, loaded.sensor_noise, loaded.initial_noise
        names = ("process_noise_cov", "measurement_noise_cov", "initial_cov")
        bounds = {name: factor**2 * each.covariance for name, each in zip(names, noises, strict=True)}
        return altered(loaded, gamma=factor**2 * loaded.gamma, **bounds)

    assert synthesize(scaled(0.99 * scale)).provenance["tolerated_scale"] == pytest.approx(1 / 0.99, rel=1e-2)
