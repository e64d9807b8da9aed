"""One mutation harness for all proofs: what is changed to harm fails in both verifiers, what verifies is true."""

from __future__ import annotations

import json
import pickle
import re
from collections import defaultdict
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from ncs_gym import Ellipsoid, LinearPlant
from ncs_gym.plants.family import Remainder
from shields import Certificate, CertificateError
from shields.documents import document_of
from shields.verification import require_valid
from tests.certificates import certificate_of, with_proof
from tests.plants import named
from tests.product import safety_filter
from tests.verdicts import assert_true, broken, verified

# Plants of `named`, and what is kept.
CASES = {
    "ellipsoid": ("stable", "ellipsoid"),
    "ellipsoid, contract": ("unstable", "ellipsoid"),
    "polytope": ("stable", "polytope"),
    "polytope, contract": ("unstable", "polytope"),
    "polytope alone": ("servo", "polytope"),
    "between samples": ("oscillator", "polytope"),
    "between samples, polytope alone": ("servo, at all times", "polytope"),
    "remainder": ("remainder", "polytope"),
}


@cache
def case(name: str) -> tuple[Certificate, LinearPlant]:
    plant, contract = named(CASES[name][0])
    return certificate_of(plant, contract, CASES[name][1]), plant


# Every number of the file.


def content_of(certificate):
    return json.loads(json.dumps(certificate.document["certificate"]))


def read(content):
    return Certificate.read(document_of("certificate", "ncs-gym certificate 5", content))


def numbers_of(content):
    """Paths of numbers that must change together, as others contradict each other: halves of a symmetric matrix."""
    together = defaultdict(list)
    for path in paths(content):
        together[meaning(path)].append(path)
    return list(together.values())


def paths(value, path=()):
    if isinstance(value, dict | list):
        items = value.items() if isinstance(value, dict) else enumerate(value)
        return [leaf for key, each in items if key != "provenance" for leaf in paths(each, (*path, key))]
    return [path] if isinstance(value, int | float) else []


def meaning(path):
    symmetric = path[0] == "D" or path[1:2] in (("L",), ("shapes",), ("last",), ("noise",))
    return (*path[:-2], *sorted(path[-2:])) if symmetric else path


def changes_of(value):
    """Other values, the smallest changes first."""
    if isinstance(value, int):
        return [value - 1, value + 1, -1]
    return [factor * value for factor in (1.0 - 1e-3, 1.0 + 1e-3, 0.5, 2.0, -1.0, 1e6) if value] + [value + 1.0]


def with_value(content, places, value):
    copy = json.loads(json.dumps(content))
    for path in places:
        inner = copy
        for key in path[:-1]:
            inner = inner[key]
        inner[path[-1]] = value
    return copy


def entry(content, path):
    for key in path:
        content = content[key]
    return content


# Of a large polytope every twentieth number; all of them in the slow tests.
LARGE = [name for name in CASES if CASES[name] in (("servo", "polytope"), ("oscillator", "polytope"))]
LARGE += ["between samples, polytope alone"]


@pytest.mark.cases(3)
@pytest.mark.parametrize(
    ("name", "every"),
    [(name, 20 if name in LARGE else 1) for name in CASES]
    + [pytest.param(name, 1, marks=pytest.mark.slow) for name in LARGE],
)
def test_every_number_of_a_certificate_counts_and_what_verifies_is_true(name, every):
    certificate, plant = case(name)
    content = content_of(certificate)
    assert verified(read(content), plant).valid
    tried = {True: 0, False: 0}
    for index, places in enumerate(numbers_of(content)):
        if places[0][0] == "safe_set" and index % every:
            continue
        for value in changes_of(entry(content, places[0])):
            accepted = is_accepted(with_value(content, places, value), plant)
            tried[accepted] += 1
            if not accepted:
                break
        else:
            pytest.fail(f"no change of {places} makes verification fail")
    assert min(tried.values()) > 0


def is_accepted(content, plant):
    """Whether the document is read and verifies; then it has to be true."""
    try:
        certificate = read(content)
    except CertificateError:
        return False
    if not verified(certificate, plant).valid:
        return False
    assert_true(certificate, plant)
    return True


@pytest.mark.parametrize("name", CASES)
def test_provenance_proves_nothing_and_the_fingerprint_names_the_plant(name):
    certificate, plant = case(name)
    report = verified(certificate, plant)
    assert report.valid
    assert verified(replace(certificate, provenance={"volume_of_box_ellipsoid": 7.0}), plant) == report
    assert broken(replace(certificate, fingerprint="0" * 64), plant) == ["plant: the certificate belongs to it"]


@pytest.mark.parametrize("name", ["H", "operating_state"])
def test_plant_that_was_altered_after_it_was_made_is_another_one(name):
    """Without a contract no condition asks for these numbers."""
    certificate, plant = case("ellipsoid")
    plant = replace(plant)
    object.__setattr__(plant, name, getattr(plant, name) + 1.0)
    assert broken(certificate, plant) == ["plant: the certificate belongs to it"]
    with pytest.raises(CertificateError, match="made for another plant"):
        require_valid(certificate, plant)


# Whole parts, of a certificate or of what a plant derives from its numbers, and the conditions that notice.


def with_multipliers(certificate, **change):
    """A certificate without a contract with other multipliers."""
    proof, names = certificate.proofs[-1], ("state", "estimate", "disturbance")
    shares = [change.get(name, share) for name, share in zip(names, proof.shares.tolist(), strict=True)]
    rate, inputs = change.get("error", proof.rate), change.get("inputs", proof.inputs)
    changed = with_proof(certificate, rate=rate, shares=shares, inputs=inputs)
    return replace(changed, rounding=change.get("rounding", certificate.rounding))


SOURCES = {"disturbance": "disturbance", "sensor": "sensor", "initial": "first_error"}
NOISES = {"process": "disturbance", "sensor": "sensor", "initial": "first_error"}


def replaced(plant, **values):
    """The plant with numbers or derived bounds replaced and nothing derived anew, as a faulty derivation leaves it."""
    assert plant.fingerprint
    assert plant.disturbance.dim == plant.initial_error.dim >= plant.sensor_error.dim
    sources = {f"{kind}_bound": (f"of_{source}", "bound") for kind, source in SOURCES.items()}
    sources |= {f"{kind}_noise": (f"of_{source}", "noise") for kind, source in NOISES.items()}
    for name in sources.keys() & values.keys():
        source, part = sources[name]
        values[source] = getattr(plant, source)._replace(**{part: values.pop(name)})
    faulty = object.__new__(type(plant))
    faulty.__dict__.update(plant.__dict__ | {"digest": plant.digest} | values)
    if "remainder" in values:
        faulty.__dict__["remainder_bound"] = values["remainder"].bound
    return faulty


def larger(bound, factor):
    return Ellipsoid(factor * bound.shape_matrix)


def remainder(size):
    return Remainder(Ellipsoid(size * np.eye(2)), False, "an example")


def of_three_states(certificate):
    proofs = (replace(certificate.proofs[0], Sigma=np.eye(3)),)
    return replace(
        certificate, safe_set=Ellipsoid(np.eye(3)), K=np.ones((1, 3)), D=np.eye(3), proofs=proofs, resting_state=None
    )


def elsewhere(certificate):
    """Resting at another point than its set is around, which no constructor lets pass."""
    forged = pickle.loads(pickle.dumps(certificate))
    object.__setattr__(forged, "resting_state", certificate.resting_state + 1e-3)
    return forged


def with_polytope(certificate, **changes):
    ends = ("low", "high", "center") if certificate.safe_set.is_symmetric else ()
    changes = dict.fromkeys(("lower_multipliers", *ends)) | changes
    return replace(certificate, safe_set=replace(certificate.safe_set, **changes))


def without_row(certificate, k):
    polytope = certificate.safe_set
    multipliers = np.delete(np.delete(polytope.multipliers, k, axis=0), k, axis=1)
    return with_polytope(certificate, rows=np.delete(polytope.rows, k, axis=0), multipliers=multipliers)


def one_entry(array, where, factor):
    changed = np.array(array)
    changed[where] *= factor
    return changed


def every_proof(certificate, **changes):
    return replace(certificate, proofs=tuple(replace(proof, **changes) for proof in certificate.proofs))


def step_rows(certificate, change):
    """The certificate with other multipliers of limits within a step: those after its rows and inputs."""
    first = len(certificate.safe_set.rows) + len(certificate.K)
    kept, others = np.split(certificate.safe_set.multipliers, [first])
    return with_polytope(certificate, multipliers=np.concatenate([kept, change(others)]))


# Each breaks one condition and no other, so that a verifier without it would accept: the kind of proof, the condition,
# and the certificate changed,
OF_CERTIFICATE = [
    ("ellipsoid", "plant", lambda c: replace(c, fingerprint="0" * 64)),
    ("ellipsoid", "shapes", lambda c: with_multipliers(c, inputs=(0.5, 0.5))),
    ("ellipsoid", "shapes", of_three_states),
    ("ellipsoid", "S: it is around the resting point", elsewhere),
    ("polytope", "S: it is around the resting point", elsewhere),
    ("ellipsoid", "multipliers: finite", lambda c: with_multipliers(c, rounding=float("inf"))),
    ("ellipsoid", "multipliers: finite", lambda c: with_multipliers(c, state=float("nan"))),
    # With a rate or multiplier below zero the sums of (E1) and (U) have terms of the wrong sign, and hold.
    ("ellipsoid", "multipliers: 0 < lam_e < 1", lambda c: with_multipliers(c, error=-0.5)),
    ("ellipsoid", "multipliers: 0 < lam_e < 1", lambda c: with_multipliers(c, error=1.5)),
    ("ellipsoid", "multipliers: 0 < lam_e < 1", lambda c: with_multipliers(c, inputs=(-0.5,))),
    ("ellipsoid", "multipliers: 0 < lam_e < 1", lambda c: with_multipliers(c, inputs=(1.0,))),
    ("ellipsoid", "multipliers: lx, le, ld, s > 0", lambda c: with_multipliers(c, estimate=-1e-9)),
    ("ellipsoid", "multipliers: lx, le, ld, s > 0", lambda c: with_multipliers(c, rounding=0.0)),
    ("ellipsoid", "multipliers: lx + le + ld", lambda c: with_multipliers(c, state=c.proofs[0].shares[0] + 1e-8)),
    ("ellipsoid", "D: the certificate's", lambda c: replace(c, D=(1 - 1.1e-9) * c.D)),
    ("ellipsoid", "(E1)", lambda c: with_multipliers(c, error=0.5 * (1.0 + c.proofs[0].rate))),
    ("ellipsoid", "(I)", lambda c: with_multipliers(c, disturbance=1e-6)),
    # Without slack for the rounding of actions to float32 a certificate that is tight in (I) would pass.
    ("ellipsoid", "(I)", lambda c: with_multipliers(c, rounding=1e-30)),
    ("ellipsoid", "(U) input 1", lambda c: with_multipliers(c, inputs=(1e-12,))),
    ("polytope alone", "D: the certificate's", lambda c: replace(c, D=0.999 * c.D)),
    ("polytope", "polytope: shapes", lambda c: with_polytope(c, multipliers=c.safe_set.multipliers[:-1])),
    ("remainder", "polytope: its first rows", lambda c: without_row(c, 0)),
    ("remainder", "polytope: its first rows", lambda c: with_polytope(c, rows=one_entry(c.safe_set.rows, 0, 1 - 1e-9))),
    ("polytope alone", "(P)", lambda c: with_polytope(c, multipliers=one_entry(c.safe_set.multipliers, -2, 0.9))),
    ("polytope", "(PU) input 1", lambda c: with_polytope(c, multipliers=one_entry(c.safe_set.multipliers, -1, 1e3))),
    ("between samples", "polytope: shapes", lambda c: step_rows(c, lambda others: others[:-2])),
    ("between samples", "(PM)", lambda c: step_rows(c, lambda others: 0.0 * others)),
]
# or what a plant derives,
OF_PLANT = [
    ("ellipsoid", "D: the plant's", lambda p: replaced(p, disturbance=larger(p.nominal_disturbance, 1 - 1e-6))),
    ("ellipsoid", "N:", lambda p: replaced(p, sensor_error=larger(p.sensor_noise.bound, 0.99))),
    ("ellipsoid", "X0:", lambda p: replaced(p, initial_error=larger(p.initial_noise.bound, 0.99))),
    ("ellipsoid", "(S) c_1", lambda p: replaced(p, box=p.box * [[1.0 + 1e-5], [1.0]])),
    ("ellipsoid", "(S) c_2", lambda p: replaced(p, box=p.box * [[1.0], [1.0 + 1e-5]])),
    ("remainder", "D: the plant's", lambda p: replaced(p, disturbance=larger(p.disturbance, 0.999))),
    ("remainder", "D: the plant's", lambda p: replaced(p, remainder=remainder(1.001e-4))),
    ("remainder", "N:", lambda p: replaced(p, sensor_bound=larger(p.of_sensor.bound, 1.001))),
    ("remainder", "X0:", lambda p: replaced(p, initial_bound=larger(p.of_first_error.bound, 1.001))),
    (
        "between samples",
        "D: the plant's",
        lambda p: replaced(p, disturbance_bound=larger(p.of_disturbance.bound, 1.001)),
    ),
    ("between samples", "N:", lambda p: replaced(p, sensor_bound=larger(p.of_sensor.bound, 1.001))),
    ("between samples", "polytope: its first rows", lambda p: replaced(p, kept_ends=(1 - 1e-9) * p.kept_ends)),
    ("between samples", "(PM)", lambda p: replaced(p, step_ends=p.step_ends * [1.0, 1.0, 0.5, 1.0])),
    ("between samples", "polytope: shapes", lambda p: replaced(p, step_rows=p.step_rows[:-1])),
]
# or one of them by a number of the other.
OF_BOTH = [
    ("ellipsoid", "D: the certificate's", lambda c, p: (c, replaced(p, disturbance=Ellipsoid((1 + 2e-9) * c.D)))),
    ("ellipsoid", "(E0)", lambda c, p: (c, replaced(p, initial_error=Ellipsoid(1.01 * c.Sigma.max() * np.eye(2))))),
]
ALONE = [
    *((name, mark, lambda c, p, change=change: (change(c), p)) for name, mark, change in OF_CERTIFICATE),
    *((name, mark, lambda c, p, change=change: (c, change(p))) for name, mark, change in OF_PLANT),
    *OF_BOTH,
]


@pytest.mark.parametrize(("name", "condition", "change"), ALONE)
def test_condition_alone_makes_a_certificate_invalid(name, condition, change):
    found = broken(*change(*case(name)))
    assert {each.split(" of row")[0].split(" at tau")[0] for each in found} == {
        found[0].split(" of row")[0].split(" at tau")[0]
    }, found
    assert found[0].startswith(condition)


TOGETHER = [
    ("ellipsoid", ["(S)"], lambda c: replace(c, safe_set=Ellipsoid((1 + 1e-5) * c.safe_set.shape_matrix))),
    ("ellipsoid", ["(I)"], lambda c: replace(c, safe_set=Ellipsoid(0.002 * c.safe_set.shape_matrix))),
    ("ellipsoid", ["(I)", "(U)"], lambda c: replace(c, K=-40.0 * c.K - 1.0)),
    ("ellipsoid", ["(E1)"], lambda c: with_proof(c, Sigma=0.5 * c.Sigma)),
    ("ellipsoid", ["(E0)", "(E1)"], lambda c: with_proof(c, Sigma=1e-4 * c.Sigma)),
    ("ellipsoid", ["L > 0", "(I)"], lambda c: replace(c, safe_set=Ellipsoid(np.diag([0.9, 0.0])))),
    ("ellipsoid, contract", ["(C0)", "(C2)"], lambda c: with_proof(c, 0, Sigma=0.01 * c.proofs[0].Sigma)),
    ("ellipsoid, contract", ["(C1)"], lambda c: replace(c, updates=replace(c.updates, last=0.9 * c.updates.last))),
    ("ellipsoid, contract", ["(C2)"], lambda c: replace(c, updates=replace(c.updates, gains=1.5 * c.updates.gains))),
    ("ellipsoid, contract", ["N:"], lambda c: replace(c, updates=replace(c.updates, noise=0.99 * c.updates.noise))),
    ("polytope", ["(P)"], lambda c: replace(c, D=1e3 * c.D)),
    ("polytope", ["(P)"], lambda c: every_proof(c, Sigma=1e6 * c.Sigma)),
    ("polytope", ["(P)"], lambda c: replace(c, K=c.K + 3.0)),
    ("polytope alone", ["(C1)"], lambda c: every_proof(c, Sigma=0.5 * c.proofs[0].Sigma)),
]  # fmt: skip


@pytest.mark.parametrize(("name", "conditions", "change"), TOGETHER)
def test_changed_part_is_noticed_by_the_right_conditions(name, conditions, change):
    certificate, plant = case(name)
    changed = change(certificate)
    found = broken(changed, plant)
    for mark in conditions:
        assert any(each.startswith(mark) for each in found), (mark, found)
    # It names the first that is broken; another plant in words.
    words = "another plant" if found[0].startswith("plant") else re.escape(found[0])
    with pytest.raises(CertificateError, match=words):
        require_valid(changed, plant)
    with pytest.raises(CertificateError):
        safety_filter(changed, plant)


@pytest.mark.parametrize("name", CASES)
def test_every_condition_has_been_broken(name):
    marks = [condition for _, condition, _ in ALONE] + [mark for _, marks, _ in TOGETHER for mark in marks]
    names = [condition.name for condition in verified(*case(name)).conditions]
    never = ("polytope: it bounds every state",)  # a plant has one
    assert [each for each in names if not each.startswith((*marks, *never))] == []
