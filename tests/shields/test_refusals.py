"""What synthesis, verification and certificates refuse, and in which words: one row per refusal."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from ncs_gym import Ellipsoid, truck_trailer
from shields import Certificate, CertificateError, Infeasible, certificate_for, requirements, verify
from shields.certificate import Proof
from shields.documents import document_of
from shields.paper.synthesis import kappa_rho_grid
from tests.certificates import certificate_of, with_proof
from tests.plants import named, servo
from tests.product import altered, library_plant, linear_plant, paper_synthesis, synthesize

SHARES = {"shares": np.array([0.9, 0.05, 0.05]), "inputs": np.array([0.5])}


def plant():
    return named("stable")[0]


@cache
def kept(name="stable", safe_set="ellipsoid"):
    """A certificate, by the name of its plant."""
    return certificate_of(*named(name), safe_set)


def synthesized(box, gamma=1e-4):
    noise = {"gamma": gamma, "measurement_noise_cov": 1e-5 * np.eye(2), "initial_cov": 1e-5 * np.eye(2)}
    return synthesize(linear_plant(A=[[0.9, 0.2], [0, 0.8]], B=[[0], [0.3]], box=box, u_max=1.0, dt=0.1, **noise))


def read(**changes):
    """A certificate read from a document with other entries, whose checksum fits."""
    content = json.loads(json.dumps(kept("stable", "polytope").document["certificate"]))
    return Certificate.read(document_of("certificate", "ncs-gym certificate 5", content | changes))


def read_multipliers(first):
    """A certificate read from a document with other multipliers of the first row of its polytope."""
    polytope = kept("stable", "polytope").document["certificate"]["safe_set"]
    return read(safe_set=polytope | {"multipliers": [first, *polytope["multipliers"][1:]]})


REFUSED = [
    (lambda: synthesize(plant(), safe_set="Polytope"), ValueError, "safe_set must be"),
    (lambda: certificate_for(truck_trailer(), None, "Ellipsoid"), ValueError, "safe_set must be"),
    (lambda: paper_synthesis(altered(plant(), input_limits=([-1.0], [2.0]))), ValueError, "knows limits .c_j x. <= 1"),
    *(
        (
            lambda name=name: paper_synthesis(altered(plant(), **{name: 1e-4})),
            ValueError,
            "knows a Ball of disturbances and Gaussians alone",
        )
        for name in ("disturbance_bound", "sensor_bound", "initial_bound")
    ),
    (lambda: paper_synthesis(library_plant(truck_trailer, box=[[0.5, 0.0]])), Infeasible, "unbounded"),
    (
        lambda: synthesized([1.0, 1e5], gamma=4.0),
        Infeasible,
        r"take no state to a hundredth of \|x2\| <= 1e\+05 in 2 steps: leave out limits that stand for none",
    ),
    (lambda: synthesized([[1.0, 1.0], [1.0, 1.0 + 1e-8]]), Infeasible, "the safe box is flat, .* a limit of x1 or x2"),
    (lambda: synthesized([1.0, 1e7]), Infeasible, "too ill-conditioned for .* give states units in which"),
    (lambda: requirements(servo(), ages=[]), ValueError, "ages must be different values, at least one"),
    (lambda: requirements(servo(), ages=[-1]), ValueError, "an age must be a whole number >= 0"),
    (lambda: requirements(servo(), resolutions=[np.nan]), ValueError, "a resolution must be"),
    (lambda: requirements("servo"), ValueError, "plant must be a LinearPlant"),
    (lambda: verify(plant(), kept()), ValueError, "verify takes a Certificate and a LinearPlant"),
    # Fields of certificates.
    (lambda: replace(kept(), proofs=()), CertificateError, "proofs"),
    (lambda: replace(kept("unstable"), proofs=kept("unstable").proofs[:1]), CertificateError, "must have 2 proofs"),
    (lambda: replace(kept(), updates="8"), CertificateError, "updates must be"),
    (
        lambda: replace(kept("servo", "polytope"), safe_set=Ellipsoid(np.eye(2))),
        CertificateError,
        r"multipliers of \(I\) and of rounding belong to an ellipsoid",
    ),
    (
        lambda: with_proof(kept("servo", "polytope"), **SHARES),
        CertificateError,
        "belong to an ellipsoid, which needs all of them",
    ),
    (lambda: replace(kept(), rounding=None), CertificateError, "belong to an ellipsoid, which needs all of them"),
    (lambda: replace(kept(), safe_set="S"), CertificateError, "its safe set must be an Ellipsoid or a Polytope"),
    (lambda: replace(kept(), resting_state=[0.1, 0.0]), CertificateError, "must be around its resting state"),
    (lambda: Proof(Sigma=np.eye(2), rate=0.5, shares=SHARES["shares"]), CertificateError, "both be given, or neither"),
    (lambda: with_proof(kept(), rate="x"), CertificateError, "rate of an error set must be numbers"),
    (lambda: with_proof(kept(), inputs=0.5), CertificateError, r"multipliers of \(U\) must be numbers"),
    (lambda: with_proof(kept(), inputs=None), CertificateError, "both be given, or neither"),
    (lambda: with_proof(kept(), shares=[None, 0.1, 0.1]), CertificateError, r"multipliers of \(I\) must be numbers"),
    # Files whose checksum fits.
    (lambda: read(safe_set={"L": [[float("nan"), 0.0], [0.0, 1.0]]}), CertificateError, "certificate"),
    (lambda: read(Sigma=[[1.0]]), CertificateError, "certificate"),
    (lambda: read(errors=3), CertificateError, "certificate"),
    *(
        (lambda entry=entry: read_multipliers(entry), CertificateError, "certificate")
        for entry in (
            *([[0, "1"]], [[0.5, 1.0]], [[-1, 1.0]], [[10**6, 1.0]], [[0]], "x", None),
            *([[0, 10**400]], [[0, True]], [[0, 1.0], [0, 0.5]], [[0, 0.0]]),
        )
    ),
    # Too many rows are refused before they take memory.
    (lambda: read(safe_set={"rows": [[]] * 200_000, "multipliers": [[]] * 200_000}), CertificateError, "certificate"),
    (lambda: read(safe_set={"rows": [[1.0]] * 500, "multipliers": [[]] * 501}), CertificateError, "certificate"),
    # Formulas of the paper.
    *(
        (lambda steps=steps: next(kappa_rho_grid(*steps)), ValueError, "must be a number > 0")
        for steps in ((0.0, 0.1), (0.1, -1.0), (np.nan, 0.1), (0.1, 0.0))
    ),
]


@pytest.mark.parametrize(("call", "error", "words"), REFUSED)
def test_what_is_wrong_is_refused_in_one_sentence(call, error, words):
    with pytest.raises(error, match=words) as caught:
        call()
    assert "\n" not in str(caught.value)
